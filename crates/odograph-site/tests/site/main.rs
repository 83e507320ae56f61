//! Tests of the site, a module for a topic.

#![allow(clippy::unwrap_used)] // a test may panic

mod fleet;
mod killed;
mod refusals;
mod robots;
mod wrong;

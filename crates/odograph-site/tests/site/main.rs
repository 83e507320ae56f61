//! Tests of the site, a module for a topic.

#![allow(clippy::unwrap_used)] // a test may panic

#[cfg(feature = "tls")]
mod encrypted;
mod fleet;
mod killed;
mod refusals;
mod robots;
mod served;
mod tokens;
mod wrong;

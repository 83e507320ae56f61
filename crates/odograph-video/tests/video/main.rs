//! Tests of everything that is read. They are one binary: linking the decoders takes longer than
//! compiling most of the tests.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a test fails by panicking

mod bags;
mod boards;
mod clips;
mod pictures;
mod small_clips;

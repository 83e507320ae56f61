//! Tests with rendered boards. They are one binary, because each takes longer to link than to
//! compile.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a test fails by panicking

mod calibration_file;
mod extrinsics;
mod finder;
mod tagged;

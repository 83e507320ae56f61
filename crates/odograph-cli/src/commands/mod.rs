//! One module a command: its arguments and what it does.

pub mod board;
pub mod demo;
pub mod evaluate;
pub mod run;
pub mod simulate;
pub mod undistort;

//! Black-box tests of the program, a module for a command or a topic. They are one binary: linking
//! takes as long as compiling them.

// a test fails by panicking, and prints why it is skipped
#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod bags;
mod batch;
mod board;
#[cfg(unix)]
mod browser;
mod calibrate;
mod camera;
mod doctor;
#[cfg(unix)]
mod documents;
mod evaluate;
mod gnss;
mod ground;
mod hostile;
mod many;
mod map;
mod markers;
mod overlay_video;
mod pages;
mod pattern;
mod piped;
mod profile;
mod program;
mod recordings;
mod robot;
mod sensors;
mod simulate;
mod site;
mod stillness;
mod undistort;
mod usage;

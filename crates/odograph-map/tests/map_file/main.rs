//! Tests of the map file, a module for a topic.

#![allow(clippy::unwrap_used)] // a test may panic

mod ground;
mod hostile;
mod killed;
mod markers;
mod mosaic;
mod one_writer;
mod repair;
mod repeated_rows;
mod round_trip;
mod sessions;

//! Decodes a recording and prints the decoding speed:
//!
//! `cargo run --release -p odograph-video --example decode -- drive.mp4`.
//!
//! With a second argument, writes the concatenated gray images to that file and their times to
//! standard output.

#![allow(clippy::print_stdout, clippy::print_stderr)]

use odograph::error::{Error, Result};
use odograph_video::{SourceOptions, open};
use std::io::Write;
use std::time::Instant;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().ok_or_else(|| Error::usage("which recording?"))?;
    let mut out =
        arguments.next().map(std::fs::File::create).transpose().map_err(|e| Error::output(e.to_string()))?;
    let start = Instant::now();
    let mut source = open(&path, &SourceOptions::default())?;
    let mut frames = 0u32;
    while let Some(frame) = source.next_frame()? {
        frames += 1;
        if let Some(out) = &mut out {
            out.write_all(frame.gray.samples()).map_err(|e| Error::output(e.to_string()))?;
            println!("{} {:.9}", frame.number, frame.time_s);
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    eprintln!(
        "{}: {frames} frames in {seconds:.3} s, {:.0} a second",
        source.info().description,
        f64::from(frames) / seconds
    );
    for warning in source.take_warnings() {
        eprintln!("{warning}");
    }
    Ok(())
}

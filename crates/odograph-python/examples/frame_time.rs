//! Milliseconds a frame of a simulated drive: `frame_time FOLDER`. `bench/frame_time.py` compares
//! Python with it.

use odograph_core::formats::{camera_file, rig_file};
use odograph_core::{Error, Odometry, OdometryConfig, Result};
use odograph_session::files;
use odograph_video::{SourceOptions, open};
use std::path::PathBuf;
use std::time::Instant;

fn main() -> Result<()> {
    let folder =
        std::env::args().nth(1).map(PathBuf::from).ok_or_else(|| Error::usage("frame_time FOLDER"))?;
    let camera = camera_file::parse(&files::read_text(&folder.join("camera.yaml"))?, None)?;
    let rig = rig_file::parse(&files::read_text(&folder.join("rig.toml"))?)?;
    let options = SourceOptions { timestamps: Some(folder.join("frames.txt")), ..SourceOptions::default() };
    let mut source = open(&folder.join("frames").display().to_string(), &options)?;
    let mut frames = Vec::new();
    while let Some(frame) = source.next_frame()? {
        frames.push((frame.gray, frame.time_s));
    }
    let mut odometry = Odometry::new(camera, rig, OdometryConfig::default())?;
    let count = frames.len();
    let began = Instant::now();
    for (image, time_s) in frames {
        odometry.process(image, time_s)?;
    }
    println!("{}", 1e3 * began.elapsed().as_secs_f64() / count as f64);
    Ok(())
}

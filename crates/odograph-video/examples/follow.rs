//! Tracks a recording and prints where the camera is: `follow VIDEO CAMERA_FILE HEIGHT_M`.

use odograph::formats::camera_file;
use odograph::{Error, Odometry, OdometryConfig, Result, Rig};

#[allow(clippy::print_stdout)] // an example
fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [video, camera, height_m] = arguments.as_slice() else {
        return Err(Error::usage("follow VIDEO CAMERA_FILE HEIGHT_M"));
    };
    let mut source = odograph_video::open(video, &odograph_video::SourceOptions::default())?;
    let size = (source.info().width, source.info().height);
    let text = std::fs::read_to_string(camera).map_err(|error| Error::input(error.to_string()))?;
    let camera = camera_file::parse(&text, Some(size))?;
    let height_m = height_m.parse().map_err(|_| Error::usage("HEIGHT_M is a number of metres"))?;
    let mut odometry = Odometry::new(camera, Rig::level(height_m), OdometryConfig::default())?;
    while let Some(frame) = source.next_frame()? {
        let estimate = odometry.process(frame.gray, frame.time_s)?;
        match estimate.estimate {
            Some(known) => println!("{:.3} {:.4} {:.4}", frame.time_s, known.pose.x_m, known.pose.y_m),
            None => println!("{:.3} lost: {:?}", frame.time_s, estimate.status),
        }
    }
    Ok(())
}

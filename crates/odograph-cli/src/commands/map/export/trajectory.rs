//! The path of a session as a trajectory.

use crate::files;
use odograph::error::{Error, Result};
use odograph::formats::trajectory_file;
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_map::PathFrame;
use std::fmt::Write;
use std::path::Path;

/// The formats of a trajectory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrajectoryForm {
    Tum,
    Kitti,
    Csv,
}

/// Writes the frames, a path of this length, and reports what was written.
pub fn write((frames, length_m): (&[PathFrame], f64), path: &Path, form: TrajectoryForm) -> Result<String> {
    if frames.is_empty() {
        return Err(Error::input("the session has no frame that was tracked; there is no path to write"));
    }
    let stamped = |frame: &PathFrame| StampedPose {
        time_s: frame.time_s,
        world_from_camera: frame.pose.world_from_camera(),
    };
    let trajectory = Trajectory { poses: frames.iter().map(stamped).collect() };
    let text = match form {
        TrajectoryForm::Tum => trajectory_file::write_tum(&trajectory),
        TrajectoryForm::Kitti => trajectory_file::write_kitti(&trajectory),
        TrajectoryForm::Csv => csv(frames),
    };
    files::write(path, text.as_bytes())?;
    Ok(format!("{} poses, {length_m:.2} m", frames.len()))
}

/// One line per frame, with the names and units of a run's trajectory.csv.
fn csv(frames: &[PathFrame]) -> String {
    let mut text = String::from("frame,time_s,x_m,y_m,heading_deg,height_m,roll_deg,pitch_deg,segment\n");
    for PathFrame { frame, segment, time_s, pose } in frames {
        let _ = writeln!(
            text,
            "{frame},{time_s:.9},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{segment}",
            pose.x_m,
            pose.y_m,
            pose.heading_rad.to_degrees(),
            pose.height_m,
            pose.roll_rad.to_degrees(),
            pose.pitch_rad.to_degrees()
        );
    }
    text
}

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

/// Writes the frames and reports what was written.
pub fn write(frames: &[PathFrame], path: &Path, form: TrajectoryForm) -> Result<String> {
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
    Ok(format!("{} poses, {:.2} m", frames.len(), over_ground_m(frames)))
}

/// Length over the ground without gaps, metres: what `odograph run` calls its distance.
fn over_ground_m(frames: &[PathFrame]) -> f64 {
    let steps = frames.windows(2).filter(|two| two[0].segment == two[1].segment);
    // A fold: the sum of no numbers is −0.
    steps.map(|two| two[0].pose.distance_m(&two[1].pose)).fold(0.0, |a, b| a + b)
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

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::geometry::GroundPose;

    #[test]
    fn the_length_is_that_of_a_run() {
        let at = |frame: u64, segment: usize, x_m: f64, height_m: f64| PathFrame {
            frame,
            segment,
            time_s: frame as f64,
            pose: GroundPose { x_m, ..GroundPose::level(height_m) },
        };
        // A metre, up and down; a gap of ten; half a metre.
        let frames = [at(0, 0, 0.0, 1.0), at(1, 0, 1.0, 2.0), at(2, 1, 11.0, 1.0), at(3, 1, 11.5, 1.0)];
        assert_eq!(over_ground_m(&frames), 1.5);
        assert_eq!(over_ground_m(&frames[..1]).to_string(), "0");
    }
}

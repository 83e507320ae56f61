//! Reading trajectory files.

use odograph::error::{Error, Result};
use odograph::formats::trajectory_file::{
    Trajectory, TrajectoryFormat, guess_format, parse_kitti, parse_tum,
};
use odograph_video::read_regular_file;
use std::io::ErrorKind;
use std::path::Path;

/// A trajectory, and whether its times are seconds or pose numbers.
#[derive(Debug)]
pub struct LoadedTrajectory {
    /// The poses with their times.
    pub trajectory: Trajectory,
    /// Whether the times are seconds.
    pub timed: bool,
}

impl LoadedTrajectory {
    /// Numbers the poses of both trajectories from 0 in place of their times, unless both have
    /// times: pose numbers and seconds have no instant in common.
    pub fn number_unless_timed(one: &mut Self, other: &mut Self) {
        if one.timed && other.timed {
            return;
        }
        for poses in [&mut one.trajectory.poses, &mut other.trajectory.poses] {
            poses.iter_mut().enumerate().for_each(|(number, pose)| pose.time_s = number as f64);
        }
    }
}

/// Reads a trajectory in TUM's or KITTI's format; where `format` is `None` the number of columns
/// decides. KITTI's files have no times: `times_s` gives them, seconds.
///
/// # Errors
/// If the file cannot be read, or is no trajectory.
pub fn read_trajectory(
    path: &Path,
    format: Option<TrajectoryFormat>,
    times_s: Option<&[f64]>,
) -> Result<LoadedTrajectory> {
    let text = read_trajectory_text(path)?;
    if format.is_none() && text.starts_with("frame,time_s,") {
        return Err(Error::input(format!(
            "{} is the table of a run; its path is {}",
            path.display(),
            path.with_extension("tum").display()
        )));
    }
    let parse = || {
        let format = match format {
            Some(format) => format,
            None => guess_format(&text)?,
        };
        Ok(match format {
            TrajectoryFormat::Tum => LoadedTrajectory { trajectory: parse_tum(&text)?, timed: true },
            TrajectoryFormat::Kitti => {
                LoadedTrajectory { trajectory: parse_kitti(&text, times_s)?, timed: times_s.is_some() }
            }
        })
    };
    parse().map_err(|error: Error| error.at(path.display()))
}

/// Largest size of a trajectory file, bytes: an hour at 100 poses a second is 40 MB.
const MAX_BYTES: u64 = 1 << 30;

/// The text of a trajectory file, or of a file with its times.
///
/// # Errors
/// If the file cannot be read, is larger than a gigabyte, or is not text.
pub fn read_trajectory_text(path: &Path) -> Result<String> {
    let inside = path.join("trajectory.tum");
    if inside.is_file() {
        return Err(Error::input(format!(
            "{} is the folder of a run; its path is {}",
            path.display(),
            inside.display()
        )));
    }
    let bytes = read_regular_file(path, MAX_BYTES).map_err(|error| {
        Error::input(match error.kind() {
            ErrorKind::FileTooLarge => {
                format!("{} is larger than 1 GiB; is it a trajectory?", path.display())
            }
            _ => format!("{} cannot be read: {error}", path.display()),
        })
        .caused_by(error)
    })?;
    String::from_utf8(bytes).map_err(|error| {
        Error::input(format!("{} is not a text file; a trajectory is text", path.display())).caused_by(error)
    })
}

//! Trajectory files.
//!
//! * **TUM** (one line `time x y z qx qy qz qw` per pose): seconds, metres; translation and
//!   rotation of `world_from_camera`. A comment before the first pose may name other columns, as in
//!   EuRoC's ground truth, which has nanoseconds and `qw` first.
//! * **KITTI** (one line per pose with the 12 numbers of the upper 3 × 4 part of
//!   `world_from_camera`, row-major): without timestamps.
//! * **CSV**: one line per frame with all its estimates, for people and spreadsheets; written only.

mod frames_csv;
mod named_columns;

pub use crate::trajectory::{StampedPose, Trajectory};
pub use frames_csv::{FRAMES_HEADER, SMOOTHED_HEADER, csv_from_frames, frame_line, smoothed_line};

use crate::error::{Error, Result};
use crate::pose_frame::PoseFrame;
use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion};
use named_columns::NamedColumns;
use std::fmt::Write;

/// Format of a trajectory file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrajectoryFormat {
    /// `time x y z qx qy qz qw` per line.
    Tum,
    /// The 12 numbers of a 3 × 4 matrix per line.
    Kitti,
}

/// Infers the format: TUM where a comment names the columns of a pose, otherwise by the number of
/// values on the first data line: 8 is TUM, 12 is KITTI. Fails for any other number and for a text
/// without data.
pub fn guess_format(text: &str) -> Result<TrajectoryFormat> {
    let Some((number, line)) = data_lines(text).next() else { return Err(no_pose()) };
    match words(line).count() {
        _ if NamedColumns::of(text).is_some() => Ok(TrajectoryFormat::Tum),
        8 => Ok(TrajectoryFormat::Tum),
        12 => Ok(TrajectoryFormat::Kitti),
        count => Err(Error::input(format!(
            "line {number} has {count} values; a TUM trajectory has 8 (time x y z qx qy qz qw), a KITTI trajectory 12"
        ))),
    }
}

/// Reads a TUM trajectory.
///
/// Values are separated by white space, commas or both; empty lines and lines that start with `#`
/// are skipped; where comments before the first pose name the columns of a pose, these are read,
/// and others ignored. Quaternions are normalised. Fails, naming the line, if a line does not have
/// eight finite numbers, a quaternion is zero, or a time is not later than the one before. Also
/// fails if there is no pose.
pub fn parse_tum(text: &str) -> Result<Trajectory> {
    let mut poses: Vec<StampedPose> = Vec::new();
    let named = NamedColumns::of(text);
    for (number, line) in data_lines(text) {
        let [time_s, x, y, z, qx, qy, qz, qw] = match &named {
            Some(columns) => named_numbers(number, line, columns)?,
            None => numbers(number, line, "time x y z qx qy qz qw")?,
        };
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        // Scaling first prevents underflow and overflow of the squares.
        let largest = quaternion.coords.amax();
        if largest < 1e-6 {
            return Err(Error::input(format!(
                "line {number}: the quaternion is zero; it must be a rotation"
            )));
        }
        let rotation = UnitQuaternion::from_quaternion(quaternion / largest);
        if let Some(before) = poses.last().filter(|before| before.time_s >= time_s) {
            return Err(not_increasing(number, time_s, before.time_s));
        }
        let world_from_camera = Isometry3::from_parts(Translation3::new(x, y, z), rotation);
        poses.push(StampedPose { time_s, world_from_camera });
    }
    if poses.is_empty() { Err(no_pose()) } else { Ok(Trajectory { poses }) }
}

/// Writes a trajectory in TUM format: [`TUM_HEADER`], then one line per pose ([`tum_line`]).
pub fn write_tum(trajectory: &Trajectory) -> String {
    let mut text = String::from(TUM_HEADER);
    trajectory.poses.iter().for_each(|pose| text.push_str(&tum_line(pose)));
    text
}

/// Comment line, with its newline, that names the columns of a TUM trajectory.
pub const TUM_HEADER: &str = "# time_s x_m y_m z_m qx qy qz qw (world_from_camera)\n";

/// The same for the trajectory of a frame.
pub fn tum_header(of: &PoseFrame) -> String {
    TUM_HEADER.replace("world_from_camera", &format!("world_from_{}", of.name()))
}

/// A pose as a line in TUM format, with its newline: positions rounded to 1e-9 m, times to 1e-9 s,
/// and the quaternion with `qw` ≥ 0.
pub fn tum_line(pose: &StampedPose) -> String {
    let t = pose.world_from_camera.translation.vector;
    let q = pose.world_from_camera.rotation.coords;
    let q = if q.w < 0.0 { -q } else { q };
    format!(
        "{:.9} {:.9} {:.9} {:.9} {:.12} {:.12} {:.12} {:.12}\n",
        pose.time_s, t.x, t.y, t.z, q.x, q.y, q.z, q.w
    )
}

/// Reads a KITTI trajectory. Without `times_s` the time of a pose is its index from 0, in
/// "seconds".
///
/// Rotations that are inexact from rounding are projected onto the nearest rotation. Fails, naming
/// the line, if a line does not have twelve finite numbers or its matrix is not a rotation
/// (tolerance 1e-3). Also fails if there is no pose, or if the numbers of times and poses differ.
pub fn parse_kitti(text: &str, times_s: Option<&[f64]>) -> Result<Trajectory> {
    let mut poses = Vec::new();
    for (number, line) in data_lines(text) {
        let m: [f64; 12] = numbers(number, line, "the 12 numbers of a 3x4 matrix")?;
        let matrix = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
        let off = (matrix * matrix.transpose() - Matrix3::identity()).amax();
        if off.is_nan() || off > 1e-3 || matrix.determinant() < 0.0 {
            return Err(Error::input(format!(
                "line {number}: the left 3x3 part is not a rotation (its rows are off by {off:.2e}); is this a KITTI trajectory?"
            )));
        }
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(nearest_rotation(matrix)));
        let time_s = poses.len() as f64;
        let world_from_camera = Isometry3::from_parts(Translation3::new(m[3], m[7], m[11]), rotation);
        poses.push(StampedPose { time_s, world_from_camera });
    }
    if poses.is_empty() {
        return Err(no_pose());
    }
    if let Some(times_s) = times_s {
        if times_s.len() != poses.len() {
            return Err(Error::input(format!(
                "there are {} times for {} poses; a KITTI trajectory needs one for each",
                times_s.len(),
                poses.len()
            )));
        }
        for (pose, &time_s) in poses.iter_mut().zip(times_s) {
            pose.time_s = time_s;
        }
    }
    Ok(Trajectory { poses })
}

/// Reads the timestamps of a KITTI trajectory: one per line in seconds, strictly increasing.
pub fn parse_times(text: &str) -> Result<Vec<f64>> {
    let mut times_s: Vec<f64> = Vec::new();
    for (number, line) in data_lines(text) {
        let [time_s] = numbers(number, line, "one time in seconds")?;
        if let Some(&before) = times_s.last().filter(|&&before| before >= time_s) {
            return Err(not_increasing(number, time_s, before));
        }
        times_s.push(time_s);
    }
    Ok(times_s)
}

/// Writes a trajectory in KITTI format, translations rounded to 1e-9 m and rotations to 1e-12;
/// timestamps are not written.
pub fn write_kitti(trajectory: &Trajectory) -> String {
    let mut text = String::new();
    for pose in &trajectory.poses {
        let rotation = pose.world_from_camera.rotation.to_rotation_matrix();
        let t = pose.world_from_camera.translation.vector;
        for row in 0..3 {
            let r = rotation.matrix().row(row);
            let end = if row < 2 { ' ' } else { '\n' };
            let _ = write!(text, "{:.12} {:.12} {:.12} {:.9}{end}", r[0], r[1], r[2], t[row]);
        }
    }
    text
}

/// Nearest rotation to a matrix that is almost one: Newton's iteration for the polar decomposition
/// (Higham, "Computing the polar decomposition — with applications", 1986), `X ← (X + X⁻ᵀ) / 2`,
/// which converges quadratically.
fn nearest_rotation(matrix: Matrix3<f64>) -> Matrix3<f64> {
    let mut rotation = matrix;
    for _ in 0..4 {
        let Some(inverse) = rotation.try_inverse() else { break };
        rotation = (rotation + inverse.transpose()) * 0.5;
    }
    rotation
}

/// Lines that are neither empty nor comments, with their numbers from 1.
fn data_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let text = text.trim_start_matches('\u{feff}');
    let numbered = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
    numbered.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split(|c: char| c.is_whitespace() || c == ',').filter(|word| !word.is_empty())
}

/// Parses exactly `COUNT` finite numbers from a line.
fn numbers<const COUNT: usize>(number: usize, line: &str, expected: &str) -> Result<[f64; COUNT]> {
    let mut values = [0.0; COUNT];
    let mut count = 0;
    for word in words(line) {
        let value = finite(number, word, expected)?;
        if let Some(slot) = values.get_mut(count) {
            *slot = value;
        }
        count += 1;
    }
    if count == COUNT {
        return Ok(values);
    }
    Err(Error::input(format!("line {number} has {count} values, not {COUNT} ({expected})")))
}

/// Parses the pose of a line: its time in seconds, then as in TUM's format.
fn named_numbers(number: usize, line: &str, columns: &NamedColumns) -> Result<[f64; 8]> {
    let all: Vec<&str> = words(line).collect();
    if all.len() != columns.count {
        return Err(Error::input(format!(
            "line {number} has {} values, the comment above the poses names {} columns",
            all.len(),
            columns.count
        )));
    }
    let mut values = [0.0; 8];
    for (value, &column) in values.iter_mut().zip(&columns.pose) {
        *value = finite(number, all[column], "time, position and quaternion")?;
    }
    values[0] *= columns.time_unit_s;
    Ok(values)
}

fn finite(number: usize, word: &str, expected: &str) -> Result<f64> {
    match word.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => {
            let word: String = word.chars().take(40).collect();
            Err(Error::input(format!(
                "line {number}: {word:?} stands where a finite number belongs ({expected})"
            )))
        }
    }
}

fn not_increasing(number: usize, time_s: f64, before_s: f64) -> Error {
    Error::input(format!(
        "line {number}: the time {time_s} s is not later than {before_s} s before it; sort the file by time and drop repeated lines"
    ))
}

fn no_pose() -> Error {
    Error::input("there is no pose in the trajectory")
}

#[cfg(test)]
mod tests;

//! Poses in the rows of a table.

use odograph::geometry::GroundPose;
use rusqlite::Row;

/// Reads a pose from six consecutive columns.
pub(crate) fn pose_from(row: &Row<'_>, first: usize) -> rusqlite::Result<GroundPose> {
    Ok(GroundPose {
        x_m: row.get(first)?,
        y_m: row.get(first + 1)?,
        heading_rad: row.get(first + 2)?,
        height_m: row.get(first + 3)?,
        roll_rad: row.get(first + 4)?,
        pitch_rad: row.get(first + 5)?,
    })
}

/// Whether a camera can have this pose.
pub(crate) fn is_pose(pose: &GroundPose) -> bool {
    let GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad } = *pose;
    [x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad].iter().all(|v| v.is_finite() && v.abs() < 1e12)
        && height_m > 0.0
}

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

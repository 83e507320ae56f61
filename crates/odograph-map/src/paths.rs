//! The way of the camera in the file: every frame that was tracked, and a line of each segment.

use crate::complaint::Told;
use crate::file::MapFile;
use crate::geopackage::{self, Extent, line_geometry};
use crate::keyframes::pose_from;
use odograph::error::Result;
use odograph::geometry::{GroundPose, wrap_angle};
use odograph::mapping::plane_motion::{laid_from, seen_from};
use rusqlite::{Connection, Row, params};

/// Where the camera was at one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathFrame {
    /// Number of the frame in its source.
    pub frame: u64,
    /// Number of gaps before it in its session.
    pub segment: usize,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Where the camera was, in the map frame.
    pub pose: GroundPose,
}

impl MapFile {
    /// Puts the path of a session into the map, in place of the one that was there: the frames that were tracked, in their order.
    pub fn set_path(&mut self, session: u32, frames: &[PathFrame]) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        write(&transaction, session, frames)
            .and_then(|()| transaction.commit())
            .while_writing(&self.complaint)
    }

    /// The path of a session; empty where none was put in.
    pub fn path_of(&self, session: u32) -> Result<Vec<PathFrame>> {
        let mut statement = self
            .connection
            .prepare(
                "SELECT frame, segment, time_s, x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad FROM odograph_frame \
                 WHERE session = ?1 ORDER BY frame",
            )
            .while_reading(&self.complaint)?;
        let frame = |row: &Row<'_>| {
            Ok(PathFrame {
                frame: row.get(0)?,
                segment: row.get(1)?,
                time_s: row.get(2)?,
                pose: pose_from(row, 3)?,
            })
        };
        let rows = statement.query_map([session], frame).while_reading(&self.complaint)?;
        rows.collect::<rusqlite::Result<_>>().while_reading(&self.complaint)
    }
}

/// A keyframe that goes from one pose to another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeMove {
    /// Number of gaps before it in its session.
    pub segment: usize,
    /// Its time, seconds.
    pub time_s: f64,
    /// Where it was when the path was measured.
    pub before: GroundPose,
    /// Where it is.
    pub after: GroundPose,
}

impl KeyframeMove {
    fn take(&self, pose: &GroundPose) -> GroundPose {
        if self.before == self.after {
            return *pose;
        }
        let scale = self.after.height_m / self.before.height_m;
        let laid = laid_from(&self.after, &seen_from(&self.before, pose), scale);
        // Whole turns are kept, and how the camera leaned.
        let heading_rad = pose.heading_rad + self.after.heading_rad - self.before.heading_rad;
        GroundPose { heading_rad, roll_rad: pose.roll_rad, pitch_rad: pose.pitch_rad, ..laid }
    }
}

/// A session's path after its keyframes, given in their order, were moved: each frame goes with the keyframe before it and the one after it, with the nearer more,
/// so that the path has no steps.
pub fn carried(path: &[PathFrame], keyframes: &[KeyframeMove]) -> Vec<PathFrame> {
    let carry = |frame: &PathFrame| {
        let next = keyframes.partition_point(|keyframe| keyframe.time_s <= frame.time_s);
        let own = |keyframe: &&KeyframeMove| keyframe.segment == frame.segment;
        let before = next.checked_sub(1).and_then(|at| keyframes.get(at)).filter(own);
        let after = keyframes.get(next).filter(own);
        let pose = match (before, after) {
            (Some(before), Some(after)) => {
                let share = (frame.time_s - before.time_s) / (after.time_s - before.time_s);
                between(&before.take(&frame.pose), &after.take(&frame.pose), share)
            }
            (Some(keyframe), None) | (None, Some(keyframe)) => keyframe.take(&frame.pose),
            // A segment that has no keyframe goes with the one before.
            (None, None) => keyframes.get(next.saturating_sub(1)).map_or(frame.pose, |k| k.take(&frame.pose)),
        };
        PathFrame { pose, ..*frame }
    };
    path.iter().map(carry).collect()
}

fn between(a: &GroundPose, b: &GroundPose, share: f64) -> GroundPose {
    let mean = |a: f64, b: f64| a + share * (b - a);
    GroundPose {
        x_m: mean(a.x_m, b.x_m),
        y_m: mean(a.y_m, b.y_m),
        heading_rad: a.heading_rad + share * wrap_angle(b.heading_rad - a.heading_rad),
        height_m: mean(a.height_m, b.height_m),
        ..*a
    }
}

pub(crate) fn write(connection: &Connection, session: u32, frames: &[PathFrame]) -> rusqlite::Result<()> {
    connection.execute("DELETE FROM odograph_frame WHERE session = ?1", [session])?;
    connection.execute("DELETE FROM paths WHERE session = ?1", [session])?;
    let mut statement = connection
        .prepare_cached("INSERT INTO odograph_frame VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)")?;
    for PathFrame { frame, segment, time_s, pose } in frames {
        let GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad } = pose;
        statement.execute(params![
            session,
            frame,
            segment,
            time_s,
            x_m,
            y_m,
            heading_rad,
            height_m,
            roll_rad,
            pitch_rad
        ])?;
    }
    // A line has at least two points: a segment of one frame is in the table of frames only.
    for line in frames.chunk_by(|a, b| a.segment == b.segment).filter(|line| line.len() > 1) {
        let points: Vec<(f64, f64)> = line.iter().map(|frame| (frame.pose.x_m, frame.pose.y_m)).collect();
        let length_m: f64 =
            points.windows(2).map(|two| (two[1].0 - two[0].0).hypot(two[1].1 - two[0].1)).sum();
        connection.execute(
            "INSERT INTO paths VALUES (NULL, ?1, ?2, ?3, ?4, ?5, ?6, ?7)",
            params![
                line_geometry(&points),
                session,
                line[0].segment,
                line.len(),
                line[0].time_s,
                line[line.len() - 1].time_s,
                length_m
            ],
        )?;
        if let Some(extent) = Extent::of(points) {
            geopackage::grow_extent(connection, "paths", extent)?;
        }
    }
    Ok(())
}

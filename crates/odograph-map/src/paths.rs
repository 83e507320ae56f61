//! Camera paths in the map file: every tracked frame, and a polyline for each connected
//! stretch.

use crate::complaint::WithContext;
use crate::file::MapFile;
use crate::geopackage::{self, Extent, line_geometry};
use crate::pose_columns::pose_from;
use crate::row_order::in_order;
use odograph::error::Result;
use odograph::geometry::GroundPose;
use rusqlite::{CachedStatement, Connection, Row, params};

/// Pose of the camera at one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathFrame {
    /// Index of the frame in its source.
    pub frame: u64,
    /// Number of tracking gaps before it in its session.
    pub segment: usize,
    /// Timestamp from the source, seconds.
    pub time_s: f64,
    /// Pose of the camera in the map frame.
    pub pose: GroundPose,
}

impl MapFile {
    /// Replaces the path of a session by the given tracked frames, in order.
    pub fn set_path(&mut self, session: u32, frames: &[PathFrame]) -> Result<()> {
        self.set_path_from(session, |put| frames.iter().try_for_each(put))
    }

    /// As [`MapFile::set_path`], for frames that are not all in memory: `frames` passes them one by
    /// one to its argument. If it fails, its error is returned and the stored path is unchanged.
    pub fn set_path_from(
        &mut self,
        session: u32,
        frames: impl FnOnce(&mut dyn FnMut(&PathFrame) -> Result<()>) -> Result<()>,
    ) -> Result<()> {
        let complaint = &self.complaint;
        let transaction = self.connection.transaction().while_writing(complaint)?;
        let mut written = WrittenPath::begin(&transaction, session).while_writing(complaint)?;
        frames(&mut |frame| written.put(frame).while_writing(complaint))?;
        written.end().while_writing(complaint)?;
        transaction.commit().while_writing(complaint)
    }

    /// The path of a session; empty if none is stored.
    pub fn path_of(&self, session: u32) -> Result<Vec<PathFrame>> {
        let sql = format!("SELECT {COLUMNS} FROM odograph_frame WHERE session = ?1 ORDER BY frame");
        let mut statement = self.connection.prepare(&sql).while_reading(&self.complaint)?;
        let rows = statement.query_map([session], in_order(frame_from)).while_reading(&self.complaint)?;
        rows.collect::<rusqlite::Result<_>>().while_reading(&self.complaint)
    }
}

/// Stretches of a path without a loss in between. A map has only tracked frames: where numbers are
/// missing for longer than [`LONGEST_DROP_S`] the camera was lost, although the ground after it was
/// recognised and the segment goes on.
pub fn connected_stretches(path: &[PathFrame]) -> impl Iterator<Item = &[PathFrame]> {
    let step = path.windows(2).map(|two| two[1].frame.saturating_sub(two[0].frame)).min().unwrap_or(1);
    path.chunk_by(move |before, after| is_connected(before, after, step))
}

/// Frames that a live run has dropped are missing, too, but not for as long, seconds.
const LONGEST_DROP_S: f64 = 0.25;

/// Whether the path goes on from one frame to the next, of a run whose frames are numbered in steps
/// of `step`.
fn is_connected(before: &PathFrame, after: &PathFrame, step: u64) -> bool {
    before.segment == after.segment
        && (after.frame.saturating_sub(before.frame) <= step.max(1)
            || after.time_s - before.time_s <= LONGEST_DROP_S)
}

/// Columns of a frame as [`frame_from`] takes them.
pub(crate) const COLUMNS: &str =
    "frame, segment, time_s, x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad";

/// Reads a row of [`COLUMNS`].
pub(crate) fn frame_from(row: &Row<'_>) -> rusqlite::Result<PathFrame> {
    Ok(PathFrame { frame: row.get(0)?, segment: row.get(1)?, time_s: row.get(2)?, pose: pose_from(row, 3)? })
}

/// Correction of a keyframe's pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeMove {
    /// Number of tracking gaps before it in its session.
    pub segment: usize,
    /// Timestamp, seconds.
    pub time_s: f64,
    /// Pose before the correction, when the path was measured.
    pub before: GroundPose,
    /// Pose after the correction.
    pub after: GroundPose,
}

impl KeyframeMove {
    fn take(&self, pose: &GroundPose) -> GroundPose {
        self.before.similarity_to(&self.after).apply_to_pose(pose)
    }
}

/// Corrects the path of a session after its keyframes, given in order, have moved. Each frame gets
/// the corrections of the keyframes before and after it, linearly interpolated in time, so that the
/// path stays continuous.
pub fn corrected_path(path: &[PathFrame], keyframes: &[KeyframeMove]) -> Vec<PathFrame> {
    let correct = |frame: &PathFrame| {
        let next = keyframes.partition_point(|keyframe| keyframe.time_s <= frame.time_s);
        let own = |keyframe: &&KeyframeMove| keyframe.segment == frame.segment;
        let before = next.checked_sub(1).and_then(|at| keyframes.get(at)).filter(own);
        let after = keyframes.get(next).filter(own);
        let pose = match (before, after) {
            (Some(before), Some(after)) => {
                let share = (frame.time_s - before.time_s) / (after.time_s - before.time_s);
                before.take(&frame.pose).interpolated(&after.take(&frame.pose), share)
            }
            (Some(keyframe), None) | (None, Some(keyframe)) => keyframe.take(&frame.pose),
            // A segment without keyframes gets the correction of the previous keyframe.
            (None, None) => keyframes.get(next.saturating_sub(1)).map_or(frame.pose, |k| k.take(&frame.pose)),
        };
        PathFrame { pose, ..*frame }
    };
    path.iter().map(correct).collect()
}

pub(crate) fn write(connection: &Connection, session: u32, frames: &[PathFrame]) -> rusqlite::Result<()> {
    let mut written = WrittenPath::begin(connection, session)?;
    frames.iter().try_for_each(|frame| written.put(frame))?;
    written.end()
}

/// A path being written: frames are inserted at once, polylines at the end.
struct WrittenPath<'a> {
    connection: &'a Connection,
    insert: CachedStatement<'a>,
    session: u32,
    lines: Vec<SegmentLine>,
    before: Option<PathFrame>,
    /// Least difference of the numbers of two frames so far.
    step: u64,
}

/// Polyline of a connected stretch.
struct SegmentLine {
    segment: usize,
    from_s: f64,
    to_s: f64,
    points: Vec<(f64, f64)>,
}

impl<'a> WrittenPath<'a> {
    /// Deletes the stored path.
    fn begin(connection: &'a Connection, session: u32) -> rusqlite::Result<Self> {
        connection.execute("DELETE FROM odograph_frame WHERE session = ?1", [session])?;
        connection.execute("DELETE FROM paths WHERE session = ?1", [session])?;
        let insert = connection
            .prepare_cached("INSERT INTO odograph_frame VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)")?;
        Ok(Self { connection, insert, session, lines: Vec::new(), before: None, step: u64::MAX })
    }

    fn put(&mut self, frame: &PathFrame) -> rusqlite::Result<()> {
        let &PathFrame { frame, segment, time_s, pose } = frame;
        let GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad } = pose;
        self.insert.execute(params![
            self.session,
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
        let here = PathFrame { frame, segment, time_s, pose };
        let step = &mut self.step;
        let is_connected = self.before.replace(here).is_some_and(|before| {
            *step = (*step).min(frame.saturating_sub(before.frame));
            is_connected(&before, &here, *step)
        });
        if !is_connected {
            self.lines.push(SegmentLine { segment, from_s: time_s, to_s: time_s, points: Vec::new() });
        }
        if let Some(line) = self.lines.last_mut() {
            line.to_s = time_s;
            line.points.push((x_m, y_m));
        }
        Ok(())
    }

    fn end(self) -> rusqlite::Result<()> {
        // A polyline has at least two points; a stretch of one frame is only in the table of
        // frames.
        for SegmentLine { segment, from_s, to_s, points } in
            self.lines.into_iter().filter(|l| l.points.len() > 1)
        {
            let length_m: f64 =
                points.windows(2).map(|two| (two[1].0 - two[0].0).hypot(two[1].1 - two[0].1)).sum();
            self.connection.execute(
                "INSERT INTO paths VALUES (NULL, ?1, ?2, ?3, ?4, ?5, ?6, ?7)",
                params![line_geometry(&points), self.session, segment, points.len(), from_s, to_s, length_m],
            )?;
            if let Some(extent) = Extent::of(points) {
                geopackage::grow_extent(self.connection, "paths", extent)?;
            }
        }
        Ok(())
    }
}

//! The way of the camera in the file: every frame that was tracked, and a line of each segment.

use crate::complaint::Told;
use crate::file::MapFile;
use crate::geopackage::{self, Extent, line_geometry};
use odograph::error::Result;
use odograph::geometry::GroundPose;
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
                pose: GroundPose {
                    x_m: row.get(3)?,
                    y_m: row.get(4)?,
                    heading_rad: row.get(5)?,
                    height_m: row.get(6)?,
                    roll_rad: row.get(7)?,
                    pitch_rad: row.get(8)?,
                },
            })
        };
        let rows = statement.query_map([session], frame).while_reading(&self.complaint)?;
        rows.collect::<rusqlite::Result<_>>().while_reading(&self.complaint)
    }
}

fn write(connection: &Connection, session: u32, frames: &[PathFrame]) -> rusqlite::Result<()> {
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

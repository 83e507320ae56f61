//! Pose graph edges in the map file.

use crate::complaint::Told;
use crate::file::MapFile;
use crate::numbers::{bytes_from_symmetric, symmetric_from_bytes};
use nalgebra::Vector4;
use odograph::error::Result;
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use rusqlite::{Connection, params};

impl MapFile {
    /// Adds edges between keyframes of the map in one transaction: all of them are stored when this
    /// returns, or none.
    pub fn add_edges(&mut self, edges: &[MapEdge]) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        insert(&transaction, edges).and_then(|()| transaction.commit()).while_writing(&self.complaint)
    }

    /// The edges in the order in which they were added.
    pub(crate) fn edges(&self) -> Result<Vec<MapEdge>> {
        let mut statement = self
            .connection
            .prepare(
                "SELECT odograph_edge.id, from_keyframe, to_keyframe, kind, odograph_edge.x_m, odograph_edge.y_m, odograph_edge.heading_rad, \
                 log_height_ratio, odograph_edge.covariance, one.id IS NOT NULL AND other.id IS NOT NULL FROM odograph_edge \
                 LEFT JOIN keyframes one ON one.id = from_keyframe LEFT JOIN keyframes other ON other.id = to_keyframe \
                 ORDER BY odograph_edge.id",
            )
            .while_reading(&self.complaint)?;
        let mut rows = statement.query([]).while_reading(&self.complaint)?;
        let mut edges = Vec::new();
        while let Some(row) = rows.next().while_reading(&self.complaint)? {
            let (number, from, to, kind, motion, covariance, tied) = (|| -> rusqlite::Result<_> {
                let motion = Vector4::new(row.get(4)?, row.get(5)?, row.get(6)?, row.get(7)?);
                let ends: (u64, u64) = (row.get(1)?, row.get(2)?);
                let covariance: Vec<u8> = row.get(8)?;
                Ok((
                    row.get::<_, i64>(0)?,
                    ends.0,
                    ends.1,
                    row.get::<_, String>(3)?,
                    motion,
                    covariance,
                    row.get::<_, bool>(9)?,
                ))
            })()
            .while_reading(&self.complaint)?;
            let bad = |what: &str| {
                self.complaint.input(format!("edge {number}, from keyframe {from} to {to}, {what}"))
            };
            if !tied || from == to {
                return Err(bad("does not connect two keyframes of the map"));
            }
            if !motion.iter().all(|value: &f64| value.is_finite()) {
                return Err(bad("has a motion that is not finite"));
            }
            edges.push(MapEdge {
                from: KeyframeId(from),
                to: KeyframeId(to),
                kind: kind_named(&kind).ok_or_else(|| bad("is of a kind that this program does not know"))?,
                motion,
                covariance: symmetric_from_bytes(&covariance)
                    .ok_or_else(|| bad("has an invalid covariance"))?,
            });
        }
        Ok(edges)
    }
}

/// Inserts edges in order.
pub(crate) fn insert(connection: &Connection, edges: &[MapEdge]) -> rusqlite::Result<()> {
    let mut statement = connection
        .prepare_cached("INSERT INTO odograph_edge VALUES (NULL, ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)")?;
    for edge in edges {
        let [x_m, y_m, heading_rad, log_height_ratio] = edge.motion.into();
        let covariance = bytes_from_symmetric(&edge.covariance);
        statement.execute(params![
            edge.from.0,
            edge.to.0,
            name_of(edge.kind),
            x_m,
            y_m,
            heading_rad,
            log_height_ratio,
            covariance
        ])?;
    }
    Ok(())
}

fn name_of(kind: EdgeKind) -> &'static str {
    match kind {
        EdgeKind::Odometry => "odometry",
        EdgeKind::Gap => "gap",
        EdgeKind::Loop => "loop",
    }
}

fn kind_named(name: &str) -> Option<EdgeKind> {
    [EdgeKind::Odometry, EdgeKind::Gap, EdgeKind::Loop].into_iter().find(|kind| name_of(*kind) == name)
}

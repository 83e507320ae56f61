//! Pose graph edges in the map file.

use crate::complaint::WithContext;
use crate::file::MapFile;
use crate::numbers::{bytes_from_symmetric, symmetric_from_bytes};
use crate::row_order::in_order;
use nalgebra::Vector4;
use odograph::error::Result;
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use rusqlite::{Connection, Row, params};

impl MapFile {
    /// Adds edges between keyframes of the map in one transaction: all of them are stored when this
    /// returns, or none.
    pub fn add_edges(&mut self, edges: &[MapEdge]) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        insert(&transaction, edges).and_then(|()| transaction.commit()).while_writing(&self.complaint)
    }

    /// The edges in the order in which they were added.
    pub(crate) fn edges(&self) -> Result<Vec<MapEdge>> {
        let sql = format!(
            "SELECT {COLUMNS}, one.id IS NOT NULL AND other.id IS NOT NULL FROM odograph_edge \
             LEFT JOIN keyframes one ON one.id = from_keyframe LEFT JOIN keyframes other ON other.id = to_keyframe \
             ORDER BY odograph_edge.id"
        );
        let mut statement = self.connection.prepare(&sql).while_reading(&self.complaint)?;
        let mut rows = statement.query([]).while_reading(&self.complaint)?;
        let (mut edges, mut next) = (Vec::new(), in_order(StoredEdge::read));
        while let Some(row) = rows.next().while_reading(&self.complaint)? {
            let stored = next(row).while_reading(&self.complaint)?;
            let tied: bool = row.get(9).while_reading(&self.complaint)?;
            let edge = if tied { stored.edge() } else { Err("does not connect two keyframes of the map") };
            edges.push(edge.map_err(|what| {
                let StoredEdge { number, from, to, .. } = stored;
                self.complaint.damage(format!("edge {number}, from keyframe {from} to {to}, {what}"))
            })?);
        }
        Ok(edges)
    }
}

/// Columns of an edge as [`StoredEdge::read`] takes them.
pub(crate) const COLUMNS: &str = "odograph_edge.id, from_keyframe, to_keyframe, kind, odograph_edge.x_m, odograph_edge.y_m, \
                                  odograph_edge.heading_rad, log_height_ratio, odograph_edge.covariance";

/// An edge as it is in the file, before its values are checked.
pub(crate) struct StoredEdge {
    pub number: i64,
    pub from: u64,
    pub to: u64,
    kind: String,
    motion: Vector4<f64>,
    covariance: Vec<u8>,
}

impl StoredEdge {
    /// Reads a row of [`COLUMNS`].
    pub fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            number: row.get(0)?,
            from: row.get(1)?,
            to: row.get(2)?,
            kind: row.get(3)?,
            motion: Vector4::new(row.get(4)?, row.get(5)?, row.get(6)?, row.get(7)?),
            covariance: row.get(8)?,
        })
    }

    /// The edge, or the end of a sentence about what is wrong with it.
    pub fn edge(&self) -> std::result::Result<MapEdge, &'static str> {
        if self.from == self.to {
            return Err("does not connect two keyframes of the map");
        }
        if !self.motion.iter().all(|value| value.is_finite()) {
            return Err("has a motion that is not finite");
        }
        Ok(MapEdge {
            from: KeyframeId(self.from),
            to: KeyframeId(self.to),
            kind: kind_named(&self.kind).ok_or("is of a kind that this program does not know")?,
            motion: self.motion,
            covariance: symmetric_from_bytes(&self.covariance).ok_or("has an invalid covariance")?,
        })
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

//! The outbox: a session of a named robot as records, to be sent elsewhere in order.
//!
//! What a record contains is settled when its keyframe is in the file, so that it is the same
//! whenever it is read: the keyframe as odometry gave it, and the edges of its session that were
//! added up to and with the first of its own. The edges after the last keyframe's are what is left
//! at the end.

use crate::complaint::WithContext;
use crate::edges::{self, StoredEdge};
use crate::file::MapFile;
use crate::image::StoredImage;
use crate::keyframes;
use crate::numbers::symmetric_from_bytes;
use crate::origin::SessionOrigin;
use crate::pose_columns::is_pose;
use odograph::error::{Error, Result};
use odograph::ground_map::MapKeyframe;
use odograph::keyframe::{KeyframeId, MapEdge};

/// A keyframe of a session, for another map.
#[derive(Debug, Clone, PartialEq)]
pub struct OutgoingRecord {
    /// The keyframe's number in its session.
    pub number: u64,
    /// The keyframe; its id is its number. Pose, covariance and signature are those of the
    /// moment: of them a record must have only roll's and pitch's covariance, which stays.
    pub keyframe: MapKeyframe,
    /// Edges between keyframes of the session, by their numbers.
    pub edges: Vec<MapEdge>,
    /// The keyframe's image.
    pub image: StoredImage,
}

/// Reads the records of one session in order, while another program may write it.
#[derive(Debug, Clone)]
pub struct Outbox {
    session: u32,
    /// Id of keyframe number 0.
    first: u64,
    /// Id of the next keyframe to be read.
    next: u64,
    /// Number of the last edge read.
    last_edge: i64,
    /// Edges that belong to later records.
    waiting: Vec<MapEdge>,
}

impl Outbox {
    /// The outbox of a session, from its first record. Fails if the map has no such session, or it
    /// is of no named robot.
    pub fn new(file: &MapFile, origin: &SessionOrigin) -> Result<Self> {
        let session = file.sessions()?.into_iter().find(|session| session.origin.as_ref() == Some(origin));
        let Some(session) = session else {
            return Err(Error::input(format!(
                "{} has no session {} of {}",
                file.path().display(),
                origin.key,
                origin.robot
            )));
        };
        // Numbers follow ids: the keyframes of a session are added by one program, in order.
        let first: Option<u64> = file
            .connection
            .query_row(
                "SELECT min(id - number) FROM keyframes JOIN odograph_keyframe_origin ON keyframe = id WHERE session = ?1",
                [session.id],
                |row| row.get(0),
            )
            .while_reading(&file.complaint)?;
        let first = first.unwrap_or(file.next_keyframe()?.0);
        Ok(Self { session: session.id, first, next: first, last_edge: 0, waiting: Vec::new() })
    }

    /// Number of the session's last keyframe in the file; `None` while it has none.
    pub fn last_number(&self, file: &MapFile) -> Result<Option<u64>> {
        let last: Option<u64> = file
            .connection
            .query_row("SELECT max(id) FROM keyframes WHERE session = ?1", [self.session], |row| row.get(0))
            .while_reading(&file.complaint)?;
        Ok(last.map(|last| last.saturating_sub(self.first)))
    }

    /// The next records, at most `most`, of those that are in the file. Fails where the file cannot
    /// be read.
    pub fn next(&mut self, file: &MapFile, most: usize) -> Result<Vec<OutgoingRecord>> {
        // One moment of the file: a keyframe is added together with its first edge.
        let _moment = file.connection.unchecked_transaction().while_reading(&file.complaint)?;
        let keyframes = self.keyframes(file, most)?;
        let Some(last) = keyframes.last().map(|keyframe| keyframe.id.0) else { return Ok(Vec::new()) };
        self.read_edges(file)?;
        let mut records = Vec::new();
        for keyframe in keyframes {
            let id = keyframe.id.0;
            let own = self.waiting.iter().position(|edge| edge.from.0.max(edge.to.0) == id);
            let edges: Vec<MapEdge> = self.waiting.drain(..own.map_or(0, |own| own + 1)).collect();
            let image = file.stored_image(keyframe.id)?;
            let number = id - self.first;
            let keyframe = MapKeyframe { id: KeyframeId(number), ..keyframe };
            records.push(OutgoingRecord { number, keyframe, edges: self.numbered(edges), image });
        }
        self.next = last + 1;
        Ok(records)
    }

    /// The edges that no record has, once the session has ended.
    pub fn rest(&mut self, file: &MapFile) -> Result<Vec<MapEdge>> {
        self.read_edges(file)?;
        let rest = std::mem::take(&mut self.waiting);
        Ok(self.numbered(rest))
    }

    fn keyframes(&self, file: &MapFile, most: usize) -> Result<Vec<MapKeyframe>> {
        let sql = format!(
            "SELECT {}, NULL FROM keyframes WHERE session = ?1 AND id >= ?2 ORDER BY id LIMIT ?3",
            keyframes::COLUMNS
        );
        let mut statement = file.connection.prepare_cached(&sql).while_reading(&file.complaint)?;
        let mut rows = statement
            .query(rusqlite::params![self.session, self.next, most as i64])
            .while_reading(&file.complaint)?;
        let mut found = Vec::new();
        while let Some(row) = rows.next().while_reading(&file.complaint)? {
            let (keyframe, covariance, _) = keyframes::read(row).while_reading(&file.complaint)?;
            let covariance = symmetric_from_bytes(&covariance).ok_or_else(|| {
                file.complaint.damage(format!("keyframe {} has an invalid covariance", keyframe.id.0))
            })?;
            if !is_pose(&keyframe.odometry_pose) || !keyframe.time_s.is_finite() {
                let id = keyframe.id.0;
                return Err(file
                    .complaint
                    .damage(format!("keyframe {id} has a pose that no camera can have")));
            }
            found.push(MapKeyframe { covariance, ..keyframe });
        }
        Ok(found)
    }

    fn read_edges(&mut self, file: &MapFile) -> Result<()> {
        let sql = format!(
            "SELECT {} FROM odograph_edge JOIN keyframes one ON one.id = from_keyframe AND one.session = ?1 \
             JOIN keyframes other ON other.id = to_keyframe AND other.session = ?1 \
             WHERE odograph_edge.id > ?2 ORDER BY odograph_edge.id",
            edges::COLUMNS
        );
        let mut statement = file.connection.prepare_cached(&sql).while_reading(&file.complaint)?;
        let mut rows = statement
            .query(rusqlite::params![self.session, self.last_edge])
            .while_reading(&file.complaint)?;
        while let Some(row) = rows.next().while_reading(&file.complaint)? {
            let stored = StoredEdge::read(row).while_reading(&file.complaint)?;
            self.last_edge = stored.number;
            let edge = stored.edge();
            self.waiting
                .push(edge.map_err(|what| file.complaint.damage(format!("edge {} {what}", stored.number)))?);
        }
        Ok(())
    }

    fn numbered(&self, edges: Vec<MapEdge>) -> Vec<MapEdge> {
        let number = |id: KeyframeId| KeyframeId(id.0 - self.first);
        edges
            .into_iter()
            .map(|edge| MapEdge { from: number(edge.from), to: number(edge.to), ..edge })
            .collect()
    }
}

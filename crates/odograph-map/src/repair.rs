//! Saves what can be read of a damaged map.
//!
//! Every table is read row by row, around what is damaged. A keyframe is kept if its pose, its
//! signature and its image are valid; edges through a keyframe that lost its image are composed, so
//! that the map stays connected.

use crate::claim::MapClaim;
use crate::edges::{self, StoredEdge};
use crate::file::MapFile;
use crate::keyframes;
use crate::markers::{self, MapMarker, StoredMarker};
use crate::numbers::symmetric_from_bytes;
use crate::paths::{self, PathFrame};
use crate::pose_columns::is_pose;
use crate::row_order::RowOrder;
use crate::thinning::edges_without;
use crate::{cameras, complaint::WithContext, losses, masks, origin, schema};
use odograph::error::{Error, Result};
use odograph::ground_map::{GroundMap, KeyframeImages, MapKeyframe};
use odograph::keyframe::KeyframeId;
use odograph::place_recognition::Signature;
use rusqlite::{Connection, Row, params};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

/// Number of rows probed one by one beyond the last row that could be read in order: more recover
/// rows behind larger damage and take longer.
const PROBED_ROWS: i64 = 1 << 16;

/// What [`repair`] saved of a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Repair {
    /// Number of keyframes that were kept.
    pub keyframes: usize,
    /// Number of keyframes known to have existed that could not be kept.
    pub keyframes_lost: usize,
    /// Number of edges of the repaired map.
    pub edges: usize,
    /// Number of frames of the paths that were kept.
    pub frames: usize,
    /// Whether the map had a mosaic, which is not copied, and the size of its pixels in metres if
    /// that could be read.
    pub mosaic: Option<Option<f64>>,
}

/// Writes what can be read of the map `damaged` to the new map `to`. The damaged file is not
/// changed. The mosaic is left out: [`MapFile::render_mosaic`] renders it again. `keep_going` is
/// called for each keyframe and returns whether to continue.
///
/// Fails if the map has no readable camera and mounting or is of another version, if another
/// program is writing it, if nothing can be kept, or if `to` exists or cannot be written.
pub fn repair(damaged: &Path, to: &Path, keep_going: &mut dyn FnMut() -> bool) -> Result<Repair> {
    schema::check_is_database(damaged)?;
    let _claim = MapClaim::while_reading(damaged)?;
    let mut source = MapFile::open_damaged(damaged)?;
    schema::check_version(&source.connection, damaged)?;
    let (map, lost) = readable(&mut source, keep_going)?;
    if map.keyframes.is_empty() {
        return Err(Error::input(format!("{}: no keyframe of the map can be read", damaged.display())));
    }
    let sessions = sessions(&source.connection, &map);
    let mut file = MapFile::create(to, &map.camera, &map.rig)?;
    let written = write(&mut file, &source, &map, &sessions, keep_going);
    let frames = match written {
        Ok(frames) => frames,
        Err(error) => {
            drop(file);
            let _ = MapFile::remove(to);
            return Err(error);
        }
    };
    let mosaic = match source.mosaic() {
        Ok(layer) => layer.map(|layer| Some(layer.resolution_m)),
        Err(_) => Some(None),
    };
    file.close()?;
    let (keyframes, edges) = (map.keyframes.len(), map.edges.len());
    Ok(Repair { keyframes, keyframes_lost: lost, edges, frames, mosaic })
}

/// The valid keyframes with the edges between them, and the number of keyframes that are lost.
fn readable(source: &mut MapFile, keep_going: &mut dyn FnMut() -> bool) -> Result<(GroundMap, usize)> {
    let select = format!("SELECT {}, NULL FROM keyframes", keyframes::COLUMNS);
    let mut lost = BTreeSet::new();
    let mut keyframes = Vec::new();
    for (id, row) in rows(&source.connection, &select, "TRUE", "id", &mut { PROBED_ROWS }, keyframes::read) {
        let valid = row.ok().and_then(|(keyframe, covariance, _)| {
            let covariance = symmetric_from_bytes(&covariance)?;
            let whole = [&keyframe.pose, &keyframe.odometry_pose].into_iter().all(is_pose)
                && keyframe.time_s.is_finite();
            whole.then_some(MapKeyframe { covariance, ..keyframe })
        });
        match valid {
            Some(keyframe) => keyframes.push(keyframe),
            None => drop(lost.insert(KeyframeId(id.unsigned_abs()))),
        }
    }
    let mut without_image = Vec::new();
    for keyframe in &mut keyframes {
        go_on(keep_going)?;
        match (signature(&source.connection, keyframe.id), source.load(keyframe.id)) {
            (Some(signature), Ok(_)) => keyframe.signature = signature,
            _ => without_image.push(keyframe.id),
        }
    }
    let placed: BTreeSet<KeyframeId> = keyframes.iter().map(|keyframe| keyframe.id).collect();
    let select = format!("SELECT {} FROM odograph_edge", edges::COLUMNS);
    let mut edges = Vec::new();
    for (_, row) in rows(&source.connection, &select, "TRUE", "id", &mut { PROBED_ROWS }, StoredEdge::read) {
        let Some(edge) = row.ok().and_then(|stored| stored.edge().ok()) else { continue };
        let missing: Vec<KeyframeId> =
            [edge.from, edge.to].into_iter().filter(|end| !placed.contains(end)).collect();
        if missing.is_empty() {
            edges.push(edge);
        }
        lost.extend(missing);
    }
    lost.extend(without_image.iter().copied());
    let own_sessions: BTreeSet<u32> = keyframes.iter().map(|keyframe| keyframe.session).collect();
    let mask = |session: u32| masks::readable(&source.connection, session, source.camera_of(session));
    let map = GroundMap {
        camera: source.camera().clone(),
        rig: *source.rig(),
        other_cameras: source.other_cameras().clone(),
        masks: own_sessions.into_iter().filter_map(|session| Some((session, mask(session)?))).collect(),
        keyframes,
        edges,
    };
    let edges = edges_without(&map, &without_image);
    let mut keyframes = map.keyframes;
    keyframes.retain(|keyframe| !without_image.contains(&keyframe.id));
    Ok((GroundMap { keyframes, edges, ..map }, lost.len()))
}

fn signature(connection: &Connection, keyframe: KeyframeId) -> Option<Signature> {
    let bytes: Vec<u8> = connection
        .query_row("SELECT bytes FROM odograph_signature WHERE keyframe = ?1", [keyframe.0], |row| row.get(0))
        .ok()?;
    Signature::from_bytes(&bytes).ok()
}

/// The sessions with their sources; those of the keyframes whose row is lost have an unknown one.
fn sessions(connection: &Connection, map: &GroundMap) -> BTreeMap<u32, String> {
    let read = |row: &Row<'_>| Ok((row.get(0)?, row.get(1)?));
    let select = "SELECT id, source FROM odograph_session";
    let rows = rows(connection, select, "TRUE", "id", &mut { PROBED_ROWS }, read);
    let mut sessions: BTreeMap<u32, String> = rows.into_values().filter_map(|row| row.ok()).collect();
    for keyframe in &map.keyframes {
        sessions.entry(keyframe.session).or_insert_with(|| "unknown".to_owned());
    }
    sessions
}

/// Writes everything in one transaction; returns the number of frames of the paths.
fn write(
    file: &mut MapFile,
    source: &MapFile,
    map: &GroundMap,
    sessions: &BTreeMap<u32, String>,
    keep_going: &mut dyn FnMut() -> bool,
) -> Result<usize> {
    let complaint = file.complaint.clone();
    // Without readable origins the sessions have none.
    let origins = origin::read(&source.connection, &complaint).unwrap_or_default();
    let transaction = file.connection.transaction().while_writing(&complaint)?;
    for (id, name) in sessions {
        transaction
            .execute("INSERT INTO odograph_session VALUES (?1, ?2)", params![id, name])
            .while_writing(&complaint)?;
        if let Some(mounted) = map.other_cameras.get(id) {
            cameras::write_of_session(&transaction, *id, mounted).while_writing(&complaint)?;
        }
        masks::write(&transaction, *id, map.masks.get(id).map(Arc::as_ref), &complaint)?;
        if let Some(origin) = origins.get(id) {
            origin::write(&transaction, *id, origin).while_writing(&complaint)?;
        }
    }
    for keyframe in &map.keyframes {
        go_on(keep_going)?;
        let image = source.stored_image(keyframe.id)?;
        keyframes::insert(&transaction, keyframe, &image).while_writing(&complaint)?;
        let number = origin::number_of(&source.connection, keyframe.id).unwrap_or_default();
        if let Some(number) = number.filter(|_| origins.contains_key(&keyframe.session)) {
            origin::write_number(&transaction, keyframe.id, number).while_writing(&complaint)?;
        }
    }
    edges::insert(&transaction, &map.edges).while_writing(&complaint)?;
    markers::replace(&transaction, &readable_markers(&source.connection, map)).while_writing(&complaint)?;
    let mut frames = 0;
    // Of all sessions together: there may be many.
    let mut probes = PROBED_ROWS;
    for &session in sessions.keys() {
        go_on(keep_going)?;
        let path = path(&source.connection, session, &mut probes);
        paths::write(&transaction, session, &path).while_writing(&complaint)?;
        let lost = losses::read(&source.connection, session, &complaint).unwrap_or_default();
        losses::write(&transaction, session, &lost).while_writing(&complaint)?;
        frames += path.len();
    }
    transaction.commit().while_writing(&complaint)?;
    Ok(frames)
}

/// The valid markers of keyframes that are kept.
fn readable_markers(connection: &Connection, map: &GroundMap) -> Vec<MapMarker> {
    let select = format!("SELECT {} FROM marker_sightings", markers::COLUMNS);
    let rows = rows(connection, &select, "TRUE", "id", &mut { PROBED_ROWS }, StoredMarker::read);
    let marker = |stored: StoredMarker| {
        let at = map.keyframes.binary_search_by_key(&stored.keyframe(), |keyframe| keyframe.id).ok()?;
        stored.marker(&map.keyframes[at]).ok()
    };
    rows.into_values().filter_map(|row| row.ok().and_then(marker)).collect()
}

/// The readable frames of a session's path.
fn path(connection: &Connection, session: u32, probes: &mut i64) -> Vec<PathFrame> {
    let select = format!("SELECT {} FROM odograph_frame", paths::COLUMNS);
    let condition = format!("session = {session}");
    let frames = rows(connection, &select, &condition, "frame", probes, paths::frame_from);
    let valid = |frame: &PathFrame| is_pose(&frame.pose) && frame.time_s.is_finite();
    frames.into_values().filter_map(|frame| frame.ok().filter(valid)).collect()
}

/// The rows of a table that can be read and fulfil a condition, by their integer key, the first
/// column of `select`. A row that is there but of which `read` fails is returned with its error.
///
/// Reads upwards to the first damage and downwards to the last, then looks for at most `probes`
/// rows in between one by one, and subtracts their number.
fn rows<T>(
    connection: &Connection,
    select: &str,
    condition: &str,
    key: &str,
    probes: &mut i64,
    read: impl Fn(&Row<'_>) -> rusqlite::Result<T>,
) -> BTreeMap<i64, rusqlite::Result<T>> {
    type Found<T> = BTreeMap<i64, rusqlite::Result<T>>;
    let take = |further: String, mut order: RowOrder, found: &mut Found<T>| -> rusqlite::Result<()> {
        let mut statement = connection.prepare(&format!("{select} WHERE {condition} {further}"))?;
        let mut rows = statement.query([])?;
        while let Some(row) = rows.next()? {
            let number = row.get(0)?;
            order.check(number)?;
            found.insert(number, read(row));
        }
        Ok(())
    };
    let mut found = BTreeMap::new();
    if take(format!("ORDER BY {key}"), RowOrder::default(), &mut found).is_ok() {
        return found;
    }
    let first = found.keys().next_back().map_or(0, |last| last.saturating_add(1));
    let mut above = BTreeMap::new();
    // Ends at the damage, with what is above it.
    let _ = take(format!("AND {key} >= {first} ORDER BY {key} DESC"), RowOrder::descending(), &mut above);
    let end = above.keys().next().copied().unwrap_or(i64::MAX).min(first.saturating_add(*probes));
    *probes -= (end - first).max(0);
    // One statement in one transaction: both cost more than the row.
    let moment = connection.unchecked_transaction();
    if let Ok(mut statement) = connection.prepare(&format!("{select} WHERE {condition} AND {key} = ?1")) {
        for number in first..end {
            let row = statement.query_row([number], |row| Ok(read(row)));
            if let Ok(row) = row {
                found.insert(number, row);
            }
        }
    }
    drop(moment);
    found.append(&mut above);
    found
}

fn go_on(keep_going: &mut dyn FnMut() -> bool) -> Result<()> {
    if keep_going() { Ok(()) } else { Err(Error::input("interrupted; nothing was written")) }
}

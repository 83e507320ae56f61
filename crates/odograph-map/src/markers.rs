//! The layer of the markers that keyframes have seen, which only maps with markers have: its rows.

use crate::geopackage::{self, Extent, point_geometry};
use crate::numbers::{bytes_from_symmetric, symmetric_from_bytes};
use crate::pose_columns::{is_pose, pose_from};
use crate::row_order::in_order;
use crate::schema;
use nalgebra::{Matrix3, Matrix6};
use odograph::geometry::Se2;
use odograph::ground_map::MapKeyframe;
use odograph::keyframe::KeyframeId;
use odograph::landmark::{MarkerSighting, PlacedSighting};
use odograph::place_recognition::Signature;
use rusqlite::{Connection, Row, params};

pub(crate) const NAME: &str = "marker_sightings";

const TABLE: &str = "CREATE TABLE marker_sightings (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT NOT NULL, \
                     family TEXT NOT NULL, number INTEGER NOT NULL, size_m DOUBLE NOT NULL, place INTEGER NOT NULL, \
                     visit INTEGER NOT NULL, session INTEGER NOT NULL, keyframe INTEGER NOT NULL, time_s DOUBLE NOT NULL, \
                     x_m DOUBLE NOT NULL, y_m DOUBLE NOT NULL, heading_rad DOUBLE NOT NULL, sd_x_m DOUBLE NOT NULL, \
                     sd_y_m DOUBLE NOT NULL, sd_heading_rad DOUBLE NOT NULL, seen_size_m DOUBLE NOT NULL, \
                     sd_seen_size_m DOUBLE NOT NULL, keyframe_x_m DOUBLE NOT NULL, keyframe_y_m DOUBLE NOT NULL, \
                     keyframe_heading_rad DOUBLE NOT NULL, covariance BLOB NOT NULL)";

/// Columns of [`StoredMarker::read`].
pub(crate) const COLUMNS: &str = "marker_sightings.id, family, number, size_m, place, visit, keyframe, keyframe_x_m, \
                                  keyframe_y_m, keyframe_heading_rad, seen_size_m, sd_seen_size_m, \
                                  marker_sightings.covariance";

/// Columns of its keyframe that follow, as [`keyframe_of`] reads them.
const KEYFRAME: &str = "keyframes.session, segment, frame, keyframes.time_s, keyframes.x_m, keyframes.y_m, \
                        keyframes.heading_rad, height_m, roll_rad, pitch_rad, odometry_x_m, odometry_y_m, \
                        odometry_heading_rad, odometry_height_m, odometry_roll_rad, odometry_pitch_rad, \
                        keyframes.covariance";

/// Longest name of a family, bytes.
const LONGEST_FAMILY: usize = 64;
/// Largest number of a place or of a visit.
const MOST_PLACES: u64 = 1 << 32;

/// A marker as a keyframe of the map has seen it.
#[derive(Debug, Clone, PartialEq)]
pub struct MapMarker {
    /// Family and dictionary, such as `apriltag:36h11`.
    pub family: String,
    /// Side of its black square as stated, metres.
    pub size_m: f64,
    /// The sighting.
    pub placed: PlacedSighting,
    /// Session of the keyframe.
    pub session: u32,
    /// Time of the keyframe, seconds.
    pub time_s: f64,
    /// Where the marker is in the map, as this sighting has it.
    pub pose: Se2,
    /// Covariance of the pose: x, y, heading; metres and radians.
    pub covariance: Matrix3<f64>,
}

/// A row as it is in the file, before its values are checked.
pub(crate) struct StoredMarker {
    pub row: i64,
    family: String,
    number: u32,
    size_m: f64,
    place: u64,
    visit: u64,
    keyframe: u64,
    seen: Se2,
    side_m: f64,
    side_sigma_m: f64,
    covariance: Vec<u8>,
}

impl StoredMarker {
    /// Reads a row of [`COLUMNS`].
    pub fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            row: row.get(0)?,
            family: row.get(1)?,
            number: row.get(2)?,
            size_m: row.get(3)?,
            place: row.get(4)?,
            visit: row.get(5)?,
            keyframe: row.get(6)?,
            seen: Se2::new(row.get(7)?, row.get(8)?, row.get(9)?),
            side_m: row.get(10)?,
            side_sigma_m: row.get(11)?,
            covariance: row.get(12)?,
        })
    }

    /// Id of the keyframe that has seen it.
    pub fn keyframe(&self) -> KeyframeId {
        KeyframeId(self.keyframe)
    }

    /// The marker, seen by this keyframe, or the end of a sentence about what is wrong with it.
    pub fn marker(self, keyframe: &MapKeyframe) -> std::result::Result<MapMarker, &'static str> {
        let Se2 { x_m, y_m, heading_rad } = self.seen;
        let lengths = [x_m, y_m, heading_rad, self.side_sigma_m];
        let sides_m = [self.size_m, self.side_m];
        let is_possible = lengths.iter().chain(&sides_m).all(|value| value.is_finite() && value.abs() < 1e9)
            && sides_m.iter().all(|side_m| *side_m > 0.0)
            && self.side_sigma_m >= 0.0
            && self.place.max(self.visit) < MOST_PLACES;
        if !is_possible {
            return Err("has a number that no marker can have");
        }
        if self.family.len() > LONGEST_FAMILY || !self.family.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err("has an invalid family");
        }
        let sighting = MarkerSighting {
            number: self.number,
            keyframe: keyframe.id,
            keyframe_from_marker: self.seen,
            covariance: symmetric_from_bytes(&self.covariance).ok_or("has an invalid covariance")?,
            side_m: self.side_m,
            side_sigma_m: self.side_sigma_m,
        };
        let there = sighting.in_map(keyframe);
        Ok(MapMarker {
            family: self.family,
            size_m: self.size_m,
            placed: PlacedSighting { sighting, place: self.place as usize, visit: self.visit as usize },
            session: keyframe.session,
            time_s: keyframe.time_s,
            pose: there.transform,
            covariance: there.covariance,
        })
    }
}

/// The keyframe of a row, without its covariance, and the bytes of that.
pub(crate) struct StoredKeyframe {
    keyframe: MapKeyframe,
    covariance: Vec<u8>,
}

/// The keyframe in the columns [`KEYFRAME`] after those of its marker; `None` if it is missing.
fn keyframe_of(row: &Row<'_>) -> rusqlite::Result<Option<StoredKeyframe>> {
    let Some(session) = row.get(13)? else { return Ok(None) };
    let keyframe = MapKeyframe {
        id: KeyframeId(row.get(6)?),
        session,
        segment: row.get(14)?,
        frame: row.get(15)?,
        time_s: row.get(16)?,
        odometry_pose: pose_from(row, 23)?,
        pose: pose_from(row, 17)?,
        covariance: Matrix6::zeros(),
        signature: Signature::default(),
    };
    Ok(Some(StoredKeyframe { keyframe, covariance: row.get(29)? }))
}

/// The rows from this id on, each with its keyframe.
pub(crate) fn stored(
    connection: &Connection,
    first: i64,
) -> rusqlite::Result<Vec<(StoredMarker, Option<StoredKeyframe>)>> {
    let sql = format!(
        "SELECT {COLUMNS}, {KEYFRAME} FROM marker_sightings LEFT JOIN keyframes ON keyframes.id = keyframe \
         WHERE marker_sightings.id >= ?1 ORDER BY marker_sightings.id"
    );
    let mut statement = connection.prepare_cached(&sql)?;
    let rows =
        statement.query_map([first], in_order(|row| Ok((StoredMarker::read(row)?, keyframe_of(row)?))))?;
    rows.collect()
}

/// The marker of a row with its keyframe, or the end of a sentence about what is wrong with it.
pub(crate) fn marker_by(
    stored: StoredMarker,
    keyframe: Option<StoredKeyframe>,
) -> std::result::Result<MapMarker, &'static str> {
    let StoredKeyframe { keyframe, covariance } =
        keyframe.ok_or("is of a keyframe that is not in the map")?;
    if ![keyframe.pose, keyframe.odometry_pose].iter().all(is_pose) || !keyframe.time_s.is_finite() {
        return Err("is of a keyframe with a pose that no camera can have");
    }
    let covariance =
        symmetric_from_bytes(&covariance).ok_or("is of a keyframe with an invalid covariance")?;
    stored.marker(&MapKeyframe { covariance, ..keyframe })
}

pub(crate) fn is_there(connection: &Connection) -> rusqlite::Result<bool> {
    schema::has_further(connection, NAME, TABLE)
}

/// Inserts sightings, without the columns that [`place`] derives; makes the table if there is none.
/// Returns the id of the first row.
pub(crate) fn insert(
    connection: &Connection,
    family: &str,
    size_m: f64,
    sightings: &[PlacedSighting],
) -> rusqlite::Result<i64> {
    if !is_there(connection)? {
        connection.execute(TABLE, [])?;
        geopackage::list_layer(connection, NAME, "features", "markers on the ground, where they were seen")?;
        geopackage::list_geometry(connection, NAME, "POINT")?;
    }
    let first =
        connection.query_row("SELECT ifnull(max(id), 0) + 1 FROM marker_sightings", [], |row| row.get(0))?;
    let mut statement = connection.prepare_cached(
        "INSERT INTO marker_sightings SELECT NULL, ?1, ?2, ?3, ?4, ?5, ?6, session, id, time_s, 0, 0, 0, 0, 0, 0, ?8, ?9, ?10, \
         ?11, ?12, ?13 FROM keyframes WHERE id = ?7",
    )?;
    for PlacedSighting { sighting, place, visit } in sightings {
        let Se2 { x_m, y_m, heading_rad } = sighting.keyframe_from_marker;
        statement.execute(params![
            point_geometry(0.0, 0.0),
            family,
            sighting.number,
            size_m,
            *place as u64,
            *visit as u64,
            sighting.keyframe.0,
            sighting.side_m,
            sighting.side_sigma_m,
            x_m,
            y_m,
            heading_rad,
            bytes_from_symmetric(&sighting.covariance)
        ])?;
    }
    Ok(first)
}

/// Places the markers from this row on where the poses of their keyframes have them; all of them
/// from row 0. What is invalid stays as it is.
pub(crate) fn place(connection: &Connection, first: i64) -> rusqlite::Result<()> {
    if !is_there(connection)? {
        return Ok(());
    }
    let mut update = connection.prepare_cached(
        "UPDATE marker_sightings SET geom = ?2, x_m = ?3, y_m = ?4, heading_rad = ?5, sd_x_m = ?6, sd_y_m = ?7, \
         sd_heading_rad = ?8 WHERE id = ?1",
    )?;
    let mut places = Vec::new();
    for (stored, keyframe) in stored(connection, first)? {
        let row = stored.row;
        let Ok(MapMarker { pose: Se2 { x_m, y_m, heading_rad }, covariance, .. }) =
            marker_by(stored, keyframe)
        else {
            continue;
        };
        let sd = |k: usize| covariance[(k, k)].max(0.0).sqrt();
        let geometry = point_geometry(x_m, y_m);
        update.execute(params![row, geometry, x_m, y_m, heading_rad, sd(0), sd(1), sd(2)])?;
        places.push((x_m, y_m));
    }
    match (first, Extent::of(places)) {
        (0, extent) => geopackage::set_extent(connection, NAME, extent),
        (_, Some(extent)) => geopackage::grow_extent(connection, NAME, extent),
        (_, None) => Ok(()),
    }
}

/// Removes the sightings of keyframes.
pub(crate) fn remove(connection: &Connection, gone: &[KeyframeId]) -> rusqlite::Result<()> {
    if !is_there(connection)? {
        return Ok(());
    }
    let mut statement = connection.prepare("DELETE FROM marker_sightings WHERE keyframe = ?1")?;
    gone.iter().try_for_each(|keyframe| statement.execute([keyframe.0]).map(drop))
}

/// Writes these sightings instead of all that are there.
pub(crate) fn replace(connection: &Connection, markers: &[MapMarker]) -> rusqlite::Result<()> {
    if is_there(connection)? {
        connection.execute("DELETE FROM marker_sightings", [])?;
    }
    for marker in markers {
        insert(connection, &marker.family, marker.size_m, std::slice::from_ref(&marker.placed))?;
    }
    place(connection, 0)
}

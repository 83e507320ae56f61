//! Keyframes in the map file: ids, poses, signatures, images.

use crate::complaint::WithContext;
use crate::edges;
use crate::file::MapFile;
use crate::geopackage::{self, Extent, point_geometry};
use crate::image::{self, StoredImage};
use crate::markers::{self, MapMarker};
use crate::mosaic::staleness;
use crate::numbers::{bytes_from_symmetric, is_covariance, symmetric_from_bytes};
use crate::origin;
use crate::paths::{self, KeyframeMove, PathFrame, corrected_path};
use crate::pose_columns::{is_pose, pose_from};
use crate::row_order::in_order;
use nalgebra::Matrix6;
use odograph::error::Result;
use odograph::geometry::GroundPose;
use odograph::ground_map::{KeyframeImage, KeyframeImages, MapKeyframe};
use odograph::keyframe::{KeyframeId, MapEdge};
use odograph::place_recognition::Signature;
use rusqlite::{Connection, OptionalExtension, Row, ToSql, params, params_from_iter};
use std::collections::BTreeMap;

const INSERT: &str = "INSERT INTO keyframes VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16, ?17, ?18, ?19, ?20, \
                      ?21, ?22, ?23, ?24, ?25)";
/// Columns of a keyframe as [`read`] takes them, but for the signature.
pub(crate) const COLUMNS: &str = "keyframes.id, session, segment, frame, time_s, x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad, \
                                  odometry_x_m, odometry_y_m, odometry_heading_rad, odometry_height_m, odometry_roll_rad, \
                                  odometry_pitch_rad, covariance";
const MOVE: &str = "UPDATE keyframes SET geom = ?2, x_m = ?3, y_m = ?4, heading_rad = ?5, height_m = ?6, roll_rad = ?7, pitch_rad = ?8, \
                    sd_x_m = ?9, sd_y_m = ?10, sd_heading_rad = ?11, sd_height_m = ?12, sd_roll_rad = ?13, sd_pitch_rad = ?14, \
                    covariance = ?15 WHERE id = ?1";

/// A session and its path.
type SessionPath = (u32, Vec<PathFrame>);

impl MapFile {
    /// Id of the next keyframe: larger than any id used in this map before.
    pub fn next_keyframe(&self) -> Result<KeyframeId> {
        let highest: Option<u64> = self
            .connection
            .query_row("SELECT seq FROM sqlite_sequence WHERE name = 'keyframes'", [], |row| row.get(0))
            .optional()
            .while_reading(&self.complaint)?;
        Ok(KeyframeId(highest.map_or(0, |highest| highest + 1)))
    }

    /// Adds a keyframe with its image and the edges that connect it to the map, in one transaction:
    /// all of it is stored when this returns, or nothing.
    ///
    /// Fails if the id has been used before, the image does not have the camera's size, a pose is
    /// not finite, or the covariance is invalid.
    pub fn add_keyframe(
        &mut self,
        keyframe: &MapKeyframe,
        image: &KeyframeImage,
        edges: &[MapEdge],
    ) -> Result<()> {
        let id = keyframe.id.0;
        let size = (image.gray.width(), image.gray.height());
        let camera = self.camera_of(keyframe.session);
        if size != (camera.width(), camera.height()) {
            return Err(self.complaint.usage(format!(
                "the image of keyframe {id} has {}x{} pixels, the map's camera {}x{}",
                size.0,
                size.1,
                camera.width(),
                camera.height()
            )));
        }
        let number = self.numbered_from.get(&keyframe.session).and_then(|first| id.checked_sub(*first));
        self.store(keyframe, number, &image::encode(image)?, edges)
    }

    /// Adds a keyframe with the number that its robot gave it and its image as that robot's map
    /// has it.
    ///
    /// Fails if the id has been used before, the image cannot be decoded or does not have the size
    /// of the session's camera, a pose is not finite, or the covariance is invalid.
    pub fn add_numbered_keyframe(
        &mut self,
        keyframe: &MapKeyframe,
        number: u64,
        image: &StoredImage,
        edges: &[MapEdge],
    ) -> Result<()> {
        let camera = self.camera_of(keyframe.session);
        image
            .decode((camera.width(), camera.height()))
            .map_err(|why| self.complaint.usage(format!("the image of keyframe {} {why}", keyframe.id.0)))?;
        self.store(keyframe, Some(number), image, edges)
    }

    /// The number that a keyframe's robot gave it; `None` where it has none.
    pub fn number_of(&self, keyframe: KeyframeId) -> Result<Option<u64>> {
        origin::number_of(&self.connection, keyframe).while_reading(&self.complaint)
    }

    /// Adds a keyframe with the image that another map has under `there`, copied without
    /// re-encoding, and with the number that its robot gave it, if it did. The session has the
    /// camera that it has there.
    ///
    /// Fails as [`MapFile::add_keyframe`], and if the other map has no such image. The image is not
    /// decoded or checked.
    pub fn add_keyframe_of(
        &mut self,
        keyframe: &MapKeyframe,
        other: &MapFile,
        there: KeyframeId,
        edges: &[MapEdge],
    ) -> Result<()> {
        self.store(keyframe, other.number_of(there)?, &other.stored_image(there)?, edges)
    }

    fn store(
        &mut self,
        keyframe: &MapKeyframe,
        number: Option<u64>,
        image: &StoredImage,
        edges: &[MapEdge],
    ) -> Result<()> {
        let whole =
            [&keyframe.pose, &keyframe.odometry_pose].into_iter().all(is_pose) && keyframe.time_s.is_finite();
        let what = match whole {
            false => Some("a pose that is not finite"),
            true if !is_covariance(&keyframe.covariance) => Some("an invalid covariance"),
            true => None,
        };
        if let Some(what) = what {
            return Err(self.complaint.usage(format!("keyframe {} has {what}", keyframe.id.0)));
        }
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        insert(&transaction, keyframe, image)
            .and_then(|()| edges::insert(&transaction, edges))
            .and_then(|()| {
                number.map_or(Ok(()), |number| origin::write_number(&transaction, keyframe.id, number))
            })
            .and_then(|()| transaction.commit())
            .while_writing(&self.complaint)
    }

    /// Updates keyframes with new poses: (keyframe, pose, covariance) each. The frames of the
    /// stored paths move along with the keyframes before and after them.
    pub fn set_poses(&mut self, poses: &[(KeyframeId, GroundPose, Matrix6<f64>)]) -> Result<()> {
        if let Some((id, ..)) = poses.iter().find(|(_, pose, _)| !is_pose(pose)) {
            return Err(self.complaint.usage(format!("keyframe {} has a pose that is not finite", id.0)));
        }
        let (paths, moved_m) = self.paths_with(poses)?;
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        move_keyframes(&transaction, poses)
            .and_then(|()| {
                paths.iter().try_for_each(|(session, path)| paths::write(&transaction, *session, path))
            })
            .and_then(|()| markers::place(&transaction, 0))
            .and_then(|()| staleness::add(&transaction, moved_m))
            .and_then(|()| transaction.commit())
            .while_writing(&self.complaint)
    }

    /// The paths of all sessions whose keyframes move to new poses, corrected accordingly, and the
    /// largest move, metres.
    fn paths_with(
        &self,
        poses: &[(KeyframeId, GroundPose, Matrix6<f64>)],
    ) -> Result<(Vec<SessionPath>, f64)> {
        let after: BTreeMap<KeyframeId, GroundPose> =
            poses.iter().map(|(id, pose, _)| (*id, *pose)).collect();
        let mut moves: BTreeMap<u32, Vec<KeyframeMove>> = BTreeMap::new();
        let mut moved_m = 0.0_f64;
        for (id, session, still) in self.places()? {
            let after = after.get(&id).copied().unwrap_or(still.before);
            moved_m = moved_m.max(after.distance_m(&still.before));
            moves.entry(session).or_default().push(KeyframeMove { after, ..still });
        }
        moves.retain(|_, moves| moves.iter().any(|moved| moved.before != moved.after));
        let path =
            |(session, moves): (u32, Vec<_>)| Ok((session, corrected_path(&self.path_of(session)?, &moves)));
        Ok((moves.into_iter().map(path).collect::<Result<_>>()?, moved_m))
    }

    /// Id and session of every keyframe, with its current pose as an identity move.
    fn places(&self) -> Result<Vec<(KeyframeId, u32, KeyframeMove)>> {
        let mut statement = self
            .connection
            .prepare(
                "SELECT id, session, segment, time_s, x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad FROM keyframes ORDER BY id",
            )
            .while_reading(&self.complaint)?;
        let place = |row: &Row<'_>| {
            let (segment, time_s, before) = (row.get(2)?, row.get(3)?, pose_from(row, 4)?);
            Ok((
                KeyframeId(row.get(0)?),
                row.get(1)?,
                KeyframeMove { segment, time_s, before, after: before },
            ))
        };
        let rows = statement.query_map([], in_order(place)).while_reading(&self.complaint)?;
        rows.collect::<rusqlite::Result<_>>().while_reading(&self.complaint)
    }

    /// Removes keyframes with their images, edges and markers, and adds `edges`, which replace the
    /// connections through the removed keyframes.
    pub fn remove_keyframes(&mut self, gone: &[KeyframeId], edges: &[MapEdge]) -> Result<()> {
        self.remove_and_keep(gone, edges, None)
    }

    /// As [`MapFile::remove_keyframes`]; the markers are then these, if any are given.
    pub(crate) fn remove_and_keep(
        &mut self,
        gone: &[KeyframeId],
        edges: &[MapEdge],
        markers: Option<&[MapMarker]>,
    ) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        (|| {
            for sql in [
                "DELETE FROM keyframes WHERE id = ?1",
                "DELETE FROM odograph_image WHERE keyframe = ?1",
                "DELETE FROM odograph_signature WHERE keyframe = ?1",
                "DELETE FROM odograph_edge WHERE from_keyframe = ?1 OR to_keyframe = ?1",
            ] {
                let mut statement = transaction.prepare(sql)?;
                for keyframe in gone {
                    statement.execute([keyframe.0])?;
                }
            }
            origin::remove(&transaction, gone)?;
            match markers {
                Some(markers) => markers::replace(&transaction, markers)?,
                None => markers::remove(&transaction, gone)?,
            }
            edges::insert(&transaction, edges)?;
            set_extent(&transaction)?;
            transaction.commit()
        })()
        .while_writing(&self.complaint)
    }

    /// The keyframes in the order of their ids.
    pub(crate) fn keyframes(&self) -> Result<Vec<MapKeyframe>> {
        let sql = format!(
            "SELECT {COLUMNS}, bytes FROM keyframes LEFT JOIN odograph_signature ON keyframe = keyframes.id \
             ORDER BY keyframes.id"
        );
        let mut statement = self.connection.prepare(&sql).while_reading(&self.complaint)?;
        let mut rows = statement.query([]).while_reading(&self.complaint)?;
        let (mut keyframes, mut next) = (Vec::new(), in_order(read));
        while let Some(row) = rows.next().while_reading(&self.complaint)? {
            let (keyframe, covariance, signature) = next(row).while_reading(&self.complaint)?;
            let bad = |what: &str| self.complaint.damage(format!("keyframe {} has {what}", keyframe.id.0));
            if ![keyframe.pose, keyframe.odometry_pose].iter().all(is_pose) {
                return Err(bad("a pose that no camera can have"));
            }
            let covariance = symmetric_from_bytes(&covariance).ok_or_else(|| bad("an invalid covariance"))?;
            let signature = Signature::from_bytes(&signature.ok_or_else(|| bad("no signature"))?)
                .map_err(|error| self.complaint.damage(format!("keyframe {}: {error}", keyframe.id.0)))?;
            keyframes.push(MapKeyframe { covariance, signature, ..keyframe });
        }
        Ok(keyframes)
    }

    /// Number of keyframe images and their total size in bytes.
    pub fn image_bytes(&self) -> Result<(u64, u64)> {
        let mut statement = self
            .connection
            .prepare("SELECT keyframe, length(jpeg) FROM odograph_image ORDER BY keyframe")
            .while_reading(&self.complaint)?;
        let sizes =
            statement.query_map([], in_order(|row| row.get::<_, u64>(1))).while_reading(&self.complaint)?;
        sizes
            .map(|size| size.while_reading(&self.complaint))
            .try_fold((0, 0), |(count, bytes), size| Ok((count + 1, bytes + size?)))
    }
}

impl KeyframeImages for MapFile {
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        self.stored_image(keyframe)?
            .decode(self.image_size(keyframe)?)
            .map_err(|why| self.complaint.damage(format!("the image of keyframe {} {why}", keyframe.0)))
    }
}

impl MapFile {
    /// Width and height of a keyframe's image: those of its session's camera.
    fn image_size(&self, keyframe: KeyframeId) -> Result<(usize, usize)> {
        let session: Option<u32> = match self.other_cameras().is_empty() {
            true => None,
            false => self
                .connection
                .prepare_cached("SELECT session FROM keyframes WHERE id = ?1")
                .and_then(|mut statement| statement.query_row([keyframe.0], |row| row.get(0)).optional())
                .while_reading(&self.complaint)?,
        };
        let camera = session.map_or(self.camera(), |session| self.camera_of(session));
        Ok((camera.width(), camera.height()))
    }

    pub(crate) fn stored_image(&self, keyframe: KeyframeId) -> Result<StoredImage> {
        self.connection
            .prepare_cached(
                "SELECT colored, luma_scale, luma_offset, jpeg FROM odograph_image WHERE keyframe = ?1",
            )
            .and_then(|mut statement| {
                statement
                    .query_row([keyframe.0], |row| {
                        Ok(StoredImage {
                            colored: row.get(0)?,
                            luma_scale: row.get(1)?,
                            luma_offset: row.get(2)?,
                            jpeg: row.get(3)?,
                        })
                    })
                    .optional()
            })
            .while_reading(&self.complaint)?
            .ok_or_else(|| self.complaint.damage(format!("the image of keyframe {} is missing", keyframe.0)))
    }
}

/// Inserts a keyframe with its signature and image.
pub(crate) fn insert(
    connection: &Connection,
    keyframe: &MapKeyframe,
    image: &StoredImage,
) -> rusqlite::Result<()> {
    let id = keyframe.id.0;
    let (now, then) = (&keyframe.pose, keyframe.odometry_pose.to_vector());
    let (geometry, covariance) =
        (point_geometry(now.x_m, now.y_m), bytes_from_symmetric(&keyframe.covariance));
    let first: [&dyn ToSql; 6] =
        [&id, &geometry, &keyframe.session, &keyframe.segment, &keyframe.frame, &keyframe.time_s];
    let numbers = pose_numbers(now, &keyframe.covariance);
    let numbers = numbers.iter().chain(&then).map(|number| number as &dyn ToSql);
    let values = first.into_iter().chain(numbers).chain([&covariance as &dyn ToSql]);
    connection.prepare_cached(INSERT)?.execute(params_from_iter(values))?;
    connection
        .prepare_cached("INSERT INTO odograph_signature VALUES (?1, ?2)")?
        .execute(params![id, keyframe.signature.to_bytes()])?;
    connection.prepare_cached("INSERT INTO odograph_image VALUES (?1, ?2, ?3, ?4, ?5)")?.execute(params![
        id,
        image.colored,
        image.luma_scale,
        image.luma_offset,
        image.jpeg
    ])?;
    geopackage::grow_extent(connection, "keyframes", Extent([now.x_m, now.y_m, now.x_m, now.y_m]))
}

/// A pose in the order of its columns, and its standard deviations.
fn pose_numbers(pose: &GroundPose, covariance: &Matrix6<f64>) -> Vec<f64> {
    let deviations = covariance.diagonal().map(|variance| variance.max(0.0).sqrt());
    pose.to_vector().iter().chain(&deviations).copied().collect()
}

fn move_keyframes(
    connection: &Connection,
    poses: &[(KeyframeId, GroundPose, Matrix6<f64>)],
) -> rusqlite::Result<()> {
    let mut statement = connection.prepare_cached(MOVE)?;
    for (id, now, covariance) in poses {
        let (geometry, bytes) = (point_geometry(now.x_m, now.y_m), bytes_from_symmetric(covariance));
        let first: [&dyn ToSql; 2] = [&id.0, &geometry];
        let numbers = pose_numbers(now, covariance);
        let numbers = numbers.iter().map(|number| number as &dyn ToSql);
        statement
            .execute(params_from_iter(first.into_iter().chain(numbers).chain([&bytes as &dyn ToSql])))?;
    }
    set_extent(connection)
}

fn set_extent(connection: &Connection) -> rusqlite::Result<()> {
    let sides: [Option<f64>; 4] =
        connection.query_row("SELECT min(x_m), min(y_m), max(x_m), max(y_m) FROM keyframes", [], |row| {
            Ok([row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?])
        })?;
    let extent = match sides {
        [Some(left), Some(bottom), Some(right), Some(top)] => Some(Extent([left, bottom, right, top])),
        _ => None,
    };
    geopackage::set_extent(connection, "keyframes", extent)
}

/// A keyframe without covariance and signature, and the bytes of its covariance and signature.
pub(crate) fn read(row: &Row<'_>) -> rusqlite::Result<(MapKeyframe, Vec<u8>, Option<Vec<u8>>)> {
    let pose = |first: usize| pose_from(row, first);
    let keyframe = MapKeyframe {
        id: KeyframeId(row.get(0)?),
        session: row.get(1)?,
        segment: row.get(2)?,
        frame: row.get(3)?,
        time_s: row.get(4)?,
        odometry_pose: pose(11)?,
        pose: pose(5)?,
        covariance: Matrix6::zeros(),
        signature: Signature::default(),
    };
    Ok((keyframe, row.get(17)?, row.get(18)?))
}

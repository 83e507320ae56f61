//! Cameras and mounts in the map file: those of the first session, and, in a table that only maps
//! of several cameras have, those of sessions that were made with others.

use crate::complaint::{Complaint, WithContext};
use crate::row_order::in_order;
use crate::{lever_arm, schema};
use odograph::camera::{Camera, Distortion, LeverArm, Rig};
use odograph::error::Result;
use odograph::ground_map::MountedCamera;
use rusqlite::{Connection, Row, params};
use std::collections::BTreeMap;

/// Largest number of pixels of a map's camera: a decoded image has as many bytes.
const MAX_PIXELS: usize = 256 << 20;

const TABLE: &str = "CREATE TABLE odograph_session_camera (session INTEGER PRIMARY KEY NOT NULL, width INTEGER NOT NULL, \
                     height INTEGER NOT NULL, fx_px DOUBLE NOT NULL, fy_px DOUBLE NOT NULL, cx_px DOUBLE NOT NULL, \
                     cy_px DOUBLE NOT NULL, distortion TEXT NOT NULL, coefficients BLOB NOT NULL, height_m DOUBLE NOT NULL, \
                     roll_rad DOUBLE NOT NULL, pitch_rad DOUBLE NOT NULL, yaw_rad DOUBLE NOT NULL, x_m DOUBLE, y_m DOUBLE, \
                     z_m DOUBLE)";

/// Writes camera and mount of the first session.
pub(crate) fn write_first(connection: &Connection, camera: &Camera, rig: &Rig) -> rusqlite::Result<()> {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    connection.execute(
        "INSERT INTO odograph_camera VALUES (1, ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
        params![
            camera.width(),
            camera.height(),
            fx,
            fy,
            cx,
            cy,
            name_of(camera.distortion()),
            coefficients(camera)
        ],
    )?;
    connection.execute(
        "INSERT INTO odograph_rig VALUES (1, ?1, ?2, ?3, ?4)",
        params![rig.height_m, rig.roll_rad, rig.pitch_rad, rig.yaw_rad],
    )?;
    rig.lever_arm.map_or(Ok(()), |arm| lever_arm::write(connection, &arm))
}

/// Reads camera and mount of the first session.
pub(crate) fn read_first(connection: &Connection, complaint: &Complaint) -> Result<(Camera, Rig)> {
    let camera = connection
        .query_row(
            "SELECT width, height, fx_px, fy_px, cx_px, cy_px, distortion, coefficients FROM odograph_camera WHERE id = 1",
            [],
            |row| StoredCamera::read(row, 0),
        )
        .while_reading(complaint)?
        .camera(complaint)?;
    let lever_arm = lever_arm::read(connection).while_reading(complaint)?;
    let rig = connection
        .query_row(
            "SELECT height_m, roll_rad, pitch_rad, yaw_rad FROM odograph_rig WHERE id = 1",
            [],
            |row| read_rig(row, 0, lever_arm),
        )
        .while_reading(complaint)?;
    Ok((camera, checked(rig, complaint)?))
}

/// Writes camera and mount of a session. The map then needs a program that knows of such sessions.
pub(crate) fn write_of_session(
    connection: &Connection,
    session: u32,
    mounted: &MountedCamera,
) -> rusqlite::Result<()> {
    schema::make_further(connection, "odograph_session_camera", TABLE)?;
    schema::mark_several_cameras(connection)?;
    let MountedCamera { camera, rig } = mounted;
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    let arm = rig.lever_arm;
    connection.execute(
        "INSERT INTO odograph_session_camera VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16)",
        params![
            session,
            camera.width(),
            camera.height(),
            fx,
            fy,
            cx,
            cy,
            name_of(camera.distortion()),
            coefficients(camera),
            rig.height_m,
            rig.roll_rad,
            rig.pitch_rad,
            rig.yaw_rad,
            arm.map(|arm| arm.x_m),
            arm.map(|arm| arm.y_m),
            arm.map(|arm| arm.z_m)
        ],
    )?;
    Ok(())
}

/// Removes camera and mount of a session.
pub(crate) fn remove_of_session(connection: &Connection, session: u32) -> rusqlite::Result<()> {
    if schema::has_further(connection, "odograph_session_camera", TABLE)? {
        connection.execute("DELETE FROM odograph_session_camera WHERE session = ?1", [session])?;
    }
    Ok(())
}

/// The sessions that have a camera or a mount of their own.
pub(crate) fn read_of_sessions(
    connection: &Connection,
    complaint: &Complaint,
) -> Result<BTreeMap<u32, MountedCamera>> {
    if !schema::has_further(connection, "odograph_session_camera", TABLE).while_reading(complaint)? {
        return Ok(BTreeMap::new());
    }
    let mut statement = connection
        .prepare(
            "SELECT session, width, height, fx_px, fy_px, cx_px, cy_px, distortion, coefficients, height_m, roll_rad, \
             pitch_rad, yaw_rad, x_m, y_m, z_m FROM odograph_session_camera ORDER BY session",
        )
        .while_reading(complaint)?;
    let mut rows = statement.query([]).while_reading(complaint)?;
    let (mut cameras, mut next) = (BTreeMap::new(), in_order(read_row));
    while let Some(row) = rows.next().while_reading(complaint)? {
        let (session, stored, rig) = next(row).while_reading(complaint)?;
        let mounted = MountedCamera { camera: stored.camera(complaint)?, rig: checked(rig, complaint)? };
        cameras.insert(session, mounted);
    }
    Ok(cameras)
}

fn read_row(row: &Row<'_>) -> rusqlite::Result<(u32, StoredCamera, Rig)> {
    let arm: [Option<f64>; 3] = [row.get(13)?, row.get(14)?, row.get(15)?];
    let arm = match arm {
        [Some(x_m), Some(y_m), Some(z_m)] => Some(LeverArm { x_m, y_m, z_m }),
        _ => None,
    };
    Ok((row.get(0)?, StoredCamera::read(row, 1)?, read_rig(row, 9, arm)?))
}

fn read_rig(row: &Row<'_>, first: usize, lever_arm: Option<LeverArm>) -> rusqlite::Result<Rig> {
    Ok(Rig {
        height_m: row.get(first)?,
        roll_rad: row.get(first + 1)?,
        pitch_rad: row.get(first + 2)?,
        yaw_rad: row.get(first + 3)?,
        lever_arm,
    })
}

fn checked(rig: Rig, complaint: &Complaint) -> Result<Rig> {
    rig.validated().map_err(|error| complaint.input(error))
}

/// A camera as it is in the file, before its values are checked.
struct StoredCamera {
    size: (usize, usize),
    focal_px: (f64, f64),
    principal_px: (f64, f64),
    distortion: String,
    coefficients: Vec<u8>,
}

impl StoredCamera {
    fn read(row: &Row<'_>, first: usize) -> rusqlite::Result<Self> {
        Ok(Self {
            size: (row.get(first)?, row.get(first + 1)?),
            focal_px: (row.get(first + 2)?, row.get(first + 3)?),
            principal_px: (row.get(first + 4)?, row.get(first + 5)?),
            distortion: row.get(first + 6)?,
            coefficients: row.get(first + 7)?,
        })
    }

    fn camera(self, complaint: &Complaint) -> Result<Camera> {
        let Self { size, focal_px, principal_px, distortion: name, coefficients } = self;
        let coefficients: Vec<f64> = coefficients
            .chunks(8)
            .map(|eight| eight.try_into().map_or(f64::NAN, f64::from_le_bytes))
            .collect();
        let distortion = distortion_named(&name, &coefficients).ok_or_else(|| {
            complaint.input(format!("the camera has a lens model \"{name}\" that this program does not know"))
        })?;
        if size.0.saturating_mul(size.1) > MAX_PIXELS {
            return Err(
                complaint.input(format!("the camera's image of {}x{} pixels is too large", size.0, size.1))
            );
        }
        Camera::new(size, focal_px, principal_px, distortion).map_err(|error| complaint.input(error))
    }
}

fn coefficients(camera: &Camera) -> Vec<u8> {
    camera.distortion().coefficients().iter().flat_map(|c| c.to_le_bytes()).collect()
}

/// Names of the lens models in the file.
fn name_of(distortion: &Distortion) -> &'static str {
    match distortion {
        Distortion::None => "none",
        Distortion::BrownConrady { .. } => "brown-conrady",
        Distortion::KannalaBrandt { .. } => "kannala-brandt",
        Distortion::DoubleSphere { .. } => "double-sphere",
    }
}

fn distortion_named(name: &str, coefficients: &[f64]) -> Option<Distortion> {
    match (name, coefficients) {
        ("none", []) => Some(Distortion::None),
        ("brown-conrady", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
            Some(Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 })
        }
        ("kannala-brandt", &[k1, k2, k3, k4]) => Some(Distortion::KannalaBrandt { k1, k2, k3, k4 }),
        ("double-sphere", &[xi, alpha]) => Some(Distortion::DoubleSphere { xi, alpha }),
        _ => None,
    }
}

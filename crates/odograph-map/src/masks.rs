//! Masks in the map file, in a table that only maps with a masked session have: what of a session's
//! images is not ground.

use crate::complaint::{Complaint, WithContext};
use crate::row_order::in_order;
use crate::schema;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::fixed_pattern::ImageMask;
use odograph::image::GrayImage;
use png::{BitDepth, ColorType};
use rusqlite::{Connection, params};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

const NAME: &str = "odograph_session_mask";
const TABLE: &str =
    "CREATE TABLE odograph_session_mask (session INTEGER PRIMARY KEY NOT NULL, png BLOB NOT NULL)";

/// Largest number of pixels of all masks of a map, a byte for every sixteen: 4 GB, which are two
/// hundred thousand sessions of 640x480 pixels. Damaged or hostile files could have more.
const MOST_PIXELS: u64 = 1 << 36;

/// Writes the mask of a session, or replaces it; removes it where nothing is masked.
pub(crate) fn write(
    connection: &Connection,
    session: u32,
    mask: Option<&ImageMask>,
    complaint: &Complaint,
) -> Result<()> {
    let Some(mask) = mask.filter(|mask| !mask.is_empty()) else {
        return remove(connection, session).while_writing(complaint);
    };
    let png = encode(mask)?;
    let write = || {
        schema::make_further(connection, NAME, TABLE)?;
        let insert = "INSERT OR REPLACE INTO odograph_session_mask VALUES (?1, ?2)";
        connection.execute(insert, params![session, png]).map(drop)
    };
    write().while_writing(complaint)
}

/// The masks of all sessions that have one. `camera_of` gives the camera of a session.
pub(crate) fn read<'a>(
    connection: &Connection,
    complaint: &Complaint,
    camera_of: impl Fn(u32) -> &'a Camera,
) -> Result<BTreeMap<u32, Arc<ImageMask>>> {
    if !schema::has_further(connection, NAME, TABLE).while_reading(complaint)? {
        return Ok(BTreeMap::new());
    }
    let mut statement = connection
        .prepare("SELECT session, png FROM odograph_session_mask ORDER BY session")
        .while_reading(complaint)?;
    let rows =
        statement.query_map([], in_order(|row| Ok((row.get(0)?, row.get(1)?)))).while_reading(complaint)?;
    let mut pixels = 0;
    rows.map(|row| {
        let (session, png): (u32, Vec<u8>) = row.while_reading(complaint)?;
        let camera = camera_of(session);
        pixels += (camera.width() * camera.height()) as u64;
        if pixels > MOST_PIXELS {
            return Err(complaint.damage(format!("its masks have more than {MOST_PIXELS} pixels")));
        }
        let mask = decode(&png, camera)
            .map_err(|why| complaint.damage(format!("the mask of session {session} {why}")))?;
        Ok((session, Arc::new(mask)))
    })
    .collect()
}

/// The mask of a session in a damaged map, if it has a valid one.
pub(crate) fn readable(connection: &Connection, session: u32, camera: &Camera) -> Option<Arc<ImageMask>> {
    let select = "SELECT png FROM odograph_session_mask WHERE session = ?1";
    let png: Vec<u8> = connection.query_row(select, [session], |row| row.get(0)).ok()?;
    decode(&png, camera).ok().map(Arc::new)
}

/// Removes the mask of a session, if it has one.
pub(crate) fn remove(connection: &Connection, session: u32) -> rusqlite::Result<()> {
    if schema::has_further(connection, NAME, TABLE)? {
        connection.execute("DELETE FROM odograph_session_mask WHERE session = ?1", [session])?;
    }
    Ok(())
}

/// Encodes a mask as PNG: white is ground, black is not.
fn encode(mask: &ImageMask) -> Result<Vec<u8>> {
    let picture = mask.picture();
    let encode = || -> std::result::Result<Vec<u8>, png::EncodingError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, picture.width() as u32, picture.height() as u32);
        encoder.set_color(ColorType::Grayscale);
        encoder.set_depth(BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(picture.samples())?;
        writer.finish()?;
        Ok(bytes)
    };
    encode().map_err(|error| Error::output(format!("the mask cannot be encoded: {error}")))
}

/// Decodes the mask of this camera's images; the error is the end of a sentence.
fn decode(bytes: &[u8], camera: &Camera) -> std::result::Result<ImageMask, String> {
    let broken = |error: png::DecodingError| format!("cannot be decoded: {error}");
    let (width, height) = (camera.width(), camera.height());
    let limits = png::Limits { bytes: 2 * width * height + (1 << 20) };
    let mut reader = png::Decoder::new_with_limits(Cursor::new(bytes), limits).read_info().map_err(broken)?;
    let info = reader.info();
    if (info.width as usize, info.height as usize) != (width, height) {
        return Err(format!("has {}x{} pixels, not {width}x{height}", info.width, info.height));
    }
    if (info.color_type, info.bit_depth) != (ColorType::Grayscale, BitDepth::Eight) {
        return Err("is not a gray picture".to_owned());
    }
    let mut samples = vec![0; width * height];
    reader.next_frame(&mut samples).map_err(broken)?;
    let picture = GrayImage::from_samples(width, height, samples).ok_or("is too small")?;
    Ok(ImageMask::from_own_picture(&picture))
}

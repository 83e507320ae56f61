//! Map files are untrusted input: any content is either read or rejected with one sentence, without
//! harm.

use crate::ground;
use crate::repeated_rows;
use odograph::ground_map::KeyframeImages;
use odograph::keyframe::KeyframeId;
use odograph_map::MapFile;
use rusqlite::Connection;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A valid map of three keyframes with a mosaic.
fn good() -> &'static [u8] {
    static BYTES: OnceLock<Vec<u8>> = OnceLock::new();
    BYTES.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        let mut map = ground::map_of(&path, 3);
        map.render_mosaic(Some(0.02), &mut |_| true).unwrap();
        map.close().unwrap();
        std::fs::read(path).unwrap()
    })
}

/// All read operations on a map.
fn read_all(path: &Path) -> odograph::error::Result<()> {
    let mut map = MapFile::open_read_only(path)?;
    map.check()?;
    map.sessions()?;
    map.path_of(0)?;
    map.mosaic_picture(1 << 24)?;
    map.image_bytes()?;
    map.next_keyframe()?;
    Ok(())
}

/// The error message for reading these bytes.
fn complaint(bytes: &[u8]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    std::fs::write(&path, bytes).unwrap();
    sentence(&path)
}

fn sentence(path: &Path) -> String {
    let sentence = read_all(path).unwrap_err().to_string();
    assert!(
        sentence.contains("map.gpkg") && !sentence.contains('\n') && sentence.len() < 400,
        "{sentence:?}"
    );
    sentence
}

/// A valid map, modified by SQL statements.
fn tampered(sql: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    std::fs::write(&path, good()).unwrap();
    let connection = Connection::open(&path).unwrap();
    connection.execute_batch(sql).unwrap();
    connection.close().unwrap();
    (folder, path)
}

#[test]
fn files_that_are_not_maps_are_rejected() {
    assert!(complaint(b"").contains("not a map file"));
    assert!(complaint(&[0; 4096]).contains("not a map file"));
    assert!(complaint(b"SQLite format 3\0").contains("not a map file"));
    let noise: Vec<u8> = (0..20_000_u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    assert!(complaint(&noise).contains("not a map file"));
    let mut headed = noise;
    headed[..100].copy_from_slice(&good()[..100]);
    complaint(&headed);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    assert!(sentence(&path).contains("cannot be read"), "missing");
    std::fs::create_dir(&path).unwrap();
    assert!(sentence(&path).contains("not a file"), "a folder");
    let other = folder.path().join("other map.gpkg");
    Connection::open(&other).unwrap().execute_batch("CREATE TABLE people (name TEXT)").unwrap();
    let message = MapFile::open(&other).unwrap_err().to_string();
    assert!(message.contains("not a map of odograph"), "{message}");
}

#[test]
fn truncated_maps_are_rejected() {
    for share in [0.03, 0.2, 0.5, 0.9, 0.999] {
        let bytes = &good()[..(good().len() as f64 * share) as usize];
        assert!(complaint(bytes).contains("cut off"), "{share}");
    }
}

#[test]
fn corrupted_bytes_are_detected_or_harmless() {
    // Changes bytes at 97 positions, which hit pages of every table. Changes of plain numbers are
    // undetectable.
    let mut errors = 0;
    for at in (100..good().len()).step_by(good().len() / 97) {
        let mut bytes = good().to_vec();
        bytes[at] ^= 0xff;
        bytes[at - 1] ^= 0x55;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        std::fs::write(&path, &bytes).unwrap();
        errors += usize::from(read_all(&path).is_err());
    }
    assert!(errors > 5, "{errors} of 97 found");
}

#[test]
fn errors_name_the_invalid_content() {
    for (sql, part) in [
        ("UPDATE odograph_map SET schema_version = 7", "version 7"),
        ("PRAGMA application_id = 5", "GeoPackage"),
        ("DROP TABLE odograph_edge", "odograph_edge is missing"),
        ("ALTER TABLE keyframes ADD COLUMN more TEXT", "keyframes is not as odograph makes it"),
        ("DROP TABLE odograph_frame; CREATE VIEW odograph_frame AS SELECT 1", "odograph_frame is missing"),
        ("DELETE FROM odograph_map", "cannot be read as a map"),
        ("DELETE FROM odograph_camera", "cannot be read as a map"),
        ("UPDATE odograph_camera SET width = 65536, height = 65536", "too large"),
        ("UPDATE odograph_camera SET fx_px = -1", "fx is -1"),
        ("UPDATE odograph_camera SET distortion = 'magic'", "\"magic\""),
        ("UPDATE odograph_camera SET coefficients = x'00'", "lens model"),
        ("UPDATE odograph_rig SET height_m = -2", "height is -2"),
        ("UPDATE odograph_rig SET height_m = 1e300", "the height is 1.0e300 m"),
        ("UPDATE keyframes SET x_m = 9e999 WHERE id = 1", "keyframe 1 has a pose"),
        ("UPDATE keyframes SET height_m = 0 WHERE id = 2", "keyframe 2 has a pose"),
        ("UPDATE keyframes SET time_s = 'noon' WHERE id = 2", "what no map holds"),
        ("UPDATE keyframes SET session = -1 WHERE id = 2", "what no map holds"),
        ("UPDATE keyframes SET covariance = x'0102' WHERE id = 2", "keyframe 2 has an invalid covariance"),
        ("UPDATE odograph_signature SET bytes = x'0102' WHERE keyframe = 2", "keyframe 2: a signature"),
        ("DELETE FROM odograph_signature WHERE keyframe = 2", "keyframe 2 has no signature"),
        ("DELETE FROM odograph_image WHERE keyframe = 2", "image of keyframe 2 is missing"),
        (
            "UPDATE odograph_image SET jpeg = x'ffd8ffe0' WHERE keyframe = 0",
            "image of keyframe 0 cannot be decoded",
        ),
        (
            "UPDATE odograph_image SET jpeg = zeroblob(60000000) WHERE keyframe = 0",
            "image of keyframe 0 cannot be decoded",
        ),
        ("UPDATE odograph_camera SET width = 320", "has 160x120 pixels, the camera 320x120"),
        ("UPDATE odograph_camera SET width = 80", "image of keyframe 0"),
        (
            "UPDATE odograph_edge SET to_keyframe = 99 WHERE id = 1",
            "edge 1, from keyframe 0 to 99, does not connect two",
        ),
        ("UPDATE odograph_edge SET kind = 'magic' WHERE id = 2", "edge 2"),
        ("UPDATE odograph_edge SET x_m = 9e999 WHERE id = 2", "edge 2"),
        ("UPDATE odograph_edge SET covariance = zeroblob(79) WHERE id = 2", "edge 2"),
        ("UPDATE gpkg_contents SET max_x = 1e30 WHERE table_name = 'mosaic'", "description of the mosaic"),
        ("UPDATE gpkg_tile_matrix SET zoom_level = 60 WHERE zoom_level > 0", "description of the mosaic"),
        ("UPDATE gpkg_tile_matrix SET pixel_x_size = 0", "description of the mosaic"),
        ("UPDATE mosaic SET tile_data = x'89504e47'", "of the mosaic cannot be decoded"),
    ] {
        let (_folder, path) = tampered(sql);
        let message = sentence(&path);
        assert!(message.contains(part), "{sql}: {message}");
    }
}

#[test]
fn maps_with_triggers_are_not_opened_for_writing() {
    let (_folder, path) =
        tampered("CREATE TRIGGER more AFTER INSERT ON keyframes BEGIN DELETE FROM paths; END");
    read_all(&path).unwrap();
    let message = MapFile::open(&path).unwrap_err().to_string();
    assert!(message.contains("trigger more"), "{message}");
}

#[test]
fn a_rejected_file_is_unchanged() {
    let (_folder, path) = tampered("UPDATE odograph_map SET schema_version = 7");
    let before = std::fs::read(&path).unwrap();
    assert!(MapFile::open(&path).is_err());
    assert!(std::fs::read(&path).unwrap() == before);
    assert!(MapFile::open(&path).unwrap_err().to_string().contains("version 7"));
    let (_folder, path) = tampered("");
    assert!(
        MapFile::open(&path).unwrap().load(KeyframeId(7)).unwrap_err().to_string().contains("keyframe 7")
    );
}

/// 27 million times the same rows, in a few pages.
#[test]
fn tables_without_end_are_refused() {
    type Read = fn(&MapFile) -> odograph::error::Result<()>;
    let reads: [(&str, Read); 4] = [
        ("keyframes", |map| map.map().map(drop)),
        ("odograph_edge", |map| map.map().map(drop)),
        ("odograph_session", |map| map.sessions().map(drop)),
        ("odograph_image", |map| map.image_bytes().map(drop)),
    ];
    for (table, read) in reads {
        let (_folder, path) = tampered("SELECT 1");
        repeated_rows::repeat_rows(&path, table);
        let message = read(&MapFile::open_read_only(&path).unwrap()).unwrap_err().to_string();
        assert!(message.contains("is damaged: its rows are not in order"), "{message}");
    }
}

#[test]
fn a_damaged_mosaic_can_be_rendered_again() {
    for sql in ["UPDATE mosaic SET tile_data = x'89504e47'", "UPDATE gpkg_tile_matrix SET pixel_x_size = 0"] {
        let (_folder, path) = tampered(sql);
        let message = sentence(&path);
        assert!(message.ends_with("; odograph map mosaic renders it again"), "{message}");
        // A check reads all of it.
        let checked = MapFile::open_read_only(&path).unwrap().check().unwrap_err().to_string();
        assert_eq!(checked, message);
        let mut map = MapFile::open(&path).unwrap();
        assert!(map.render_mosaic(Some(0.02), &mut |_| true).unwrap());
        map.close().unwrap();
        read_all(&path).unwrap();
    }
}

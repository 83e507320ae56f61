//! A damaged map is repaired: what is valid is saved, the map stays connected, and the damaged file
//! is unchanged.

use crate::ground;
use crate::repeated_rows;
use odograph::keyframe::KeyframeId;
use odograph_map::{MapFile, PathFrame, Repair, repair};
use rusqlite::Connection;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

const KEYFRAMES: u64 = 24;
const FRAMES: u64 = 2000;

/// A valid map with a path and a mosaic.
fn good() -> &'static [u8] {
    static BYTES: OnceLock<Vec<u8>> = OnceLock::new();
    BYTES.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        let mut map = ground::map_of(&path, KEYFRAMES);
        let frame = |frame| PathFrame {
            frame,
            segment: 0,
            time_s: 0.03 * frame as f64,
            pose: ground::pose(frame / 200),
        };
        map.set_path(0, &(0..FRAMES).map(frame).collect::<Vec<_>>()).unwrap();
        map.render_mosaic(Some(0.02), &mut |_| true).unwrap();
        map.close().unwrap();
        fs::read(path).unwrap()
    })
}

/// Repairs these bytes after `damage`; checks that they are unchanged and that the result is a
/// valid map.
fn repaired(damage: impl FnOnce(&Path)) -> odograph::error::Result<(Repair, MapFile)> {
    let folder = tempfile::tempdir().unwrap().keep();
    let (path, to): (PathBuf, PathBuf) = (folder.join("map.gpkg"), folder.join("repaired.gpkg"));
    fs::write(&path, good()).unwrap();
    damage(&path);
    let before = fs::read(&path).unwrap();
    let saved = repair(&path, &to, &mut || true);
    assert_eq!(fs::read(&path).unwrap(), before);
    let saved = saved.inspect_err(|_| assert!(!to.exists(), "a failed repair leaves nothing"))?;
    let mut map = MapFile::open(&to).unwrap();
    map.check().unwrap();
    fs::remove_dir_all(folder).unwrap();
    Ok((saved, map))
}

fn altered(sql: &str) -> impl FnOnce(&Path) {
    move |path| Connection::open(path).unwrap().execute_batch(sql).unwrap()
}

/// Overwrites the page on which a row lies, found by a value in it. The last of its copies: SQLite
/// leaves others in unused parts of pages.
fn spoil_page_with(path: &Path, value: &[u8]) {
    let mut bytes = fs::read(path).unwrap();
    let at = bytes.windows(value.len()).rposition(|window| window == value).unwrap();
    let page = 4096 * (at / 4096);
    bytes[page..page + 4096].fill(0xa5);
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_sound_map_is_saved_whole() {
    let (saved, map) = repaired(|_| {}).unwrap();
    let all = Repair {
        keyframes: KEYFRAMES as usize,
        keyframes_lost: 0,
        edges: KEYFRAMES as usize - 1,
        frames: FRAMES as usize,
        mosaic: Some(Some(0.02)),
    };
    assert_eq!(saved, all);
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("map.gpkg"), good()).unwrap();
    let original = MapFile::open(&folder.path().join("map.gpkg")).unwrap();
    assert_eq!(map.map().unwrap(), original.map().unwrap());
    assert_eq!(map.sessions().unwrap(), original.sessions().unwrap());
    assert_eq!(map.path_of(0).unwrap(), original.path_of(0).unwrap());
}

#[test]
fn edges_to_missing_keyframes_are_left_out() {
    // As a thinning beside a running recording once left a map.
    let (saved, map) = repaired(altered("DELETE FROM keyframes WHERE id = 4")).unwrap();
    assert_eq!((saved.keyframes, saved.keyframes_lost, saved.edges), (23, 1, 21));
    assert!(map.map().unwrap().edges.iter().all(|edge| edge.from.0 != 4 && edge.to.0 != 4));
}

#[test]
fn a_keyframe_without_its_image_is_bridged() {
    let sql = "UPDATE odograph_image SET jpeg = x'00' WHERE keyframe = 4; DELETE FROM odograph_signature WHERE keyframe = 9";
    let (saved, map) = repaired(altered(sql)).unwrap();
    assert_eq!((saved.keyframes, saved.keyframes_lost, saved.edges), (22, 2, 21));
    let edges = map.map().unwrap().edges;
    assert!(
        edges.iter().any(|edge| [edge.from, edge.to].contains(&KeyframeId(3))
            && [edge.from, edge.to].contains(&KeyframeId(5)))
    );
}

#[test]
fn invalid_rows_of_every_table_are_left_out() {
    let sql = "UPDATE keyframes SET x_m = 9e999 WHERE id = 2; UPDATE odograph_edge SET kind = 'magic' WHERE id = 8; \
               UPDATE odograph_frame SET height_m = -1 WHERE frame = 7; DELETE FROM odograph_session; \
               UPDATE gpkg_tile_matrix SET pixel_x_size = 'wide'";
    let (saved, map) = repaired(altered(sql)).unwrap();
    assert_eq!((saved.keyframes, saved.keyframes_lost, saved.edges), (23, 1, 20));
    assert_eq!((saved.frames, saved.mosaic), (FRAMES as usize - 1, Some(None)));
    assert_eq!(map.sessions().unwrap()[0].source, "unknown");
}

#[test]
fn rows_around_a_damaged_page_are_saved() {
    // The time of a keyframe is unique to its row.
    let time_s = ground::keyframe(12, 0).time_s.to_be_bytes();
    let (saved, _) = repaired(|path| spoil_page_with(path, &time_s)).unwrap();
    assert!((8..24).contains(&saved.keyframes) && saved.keyframes_lost > 0, "{saved:?}");
    // A page of the path.
    let time_s = (0.03 * 1001.0_f64).to_be_bytes();
    let (saved, map) = repaired(|path| spoil_page_with(path, &time_s)).unwrap();
    assert_eq!(saved.keyframes, 24);
    let frames: Vec<u64> = map.path_of(0).unwrap().iter().map(|frame| frame.frame).collect();
    assert!((1900..2000).contains(&frames.len()), "{} frames", frames.len());
    assert!(frames.contains(&0) && frames.contains(&(FRAMES - 1)) && !frames.contains(&1001));
}

#[test]
fn tables_without_end_are_read_once() {
    let damage = |path: &Path| {
        altered("DELETE FROM odograph_edge WHERE id > 4")(path);
        repeated_rows::repeat_rows(path, "odograph_edge");
        repeated_rows::repeat_rows(path, "odograph_session");
    };
    let (saved, map) = repaired(damage).unwrap();
    assert_eq!((saved.keyframes, saved.edges, map.sessions().unwrap().len()), (24, 4, 1));
}

#[test]
fn a_truncated_map_is_saved_as_far_as_it_goes() {
    let cut = |share: f64| {
        move |path: &Path| fs::write(path, &good()[..(good().len() as f64 * share) as usize]).unwrap()
    };
    let (saved, _) = repaired(cut(0.8)).unwrap();
    assert!(saved.keyframes > 12, "{saved:?}");
    let message = repaired(cut(0.002)).unwrap_err().to_string();
    assert!(message.contains("map.gpkg") && !message.contains('\n'), "{message}");
}

#[test]
fn random_damage_never_panics_and_never_gives_an_invalid_map() {
    let mut saved = 0;
    for seed in 0..24_u64 {
        let random = |k: u64| {
            seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(k.wrapping_mul(0xd134_2543_de82_ef95)) >> 20
        };
        let damage = |path: &Path| {
            let mut bytes = fs::read(path).unwrap();
            for k in 0..40 {
                let at = 100 + (random(k) % (bytes.len() as u64 - 100)) as usize;
                bytes[at] = random(k + 1000) as u8;
            }
            fs::write(path, bytes).unwrap();
        };
        saved += usize::from(repaired(damage).is_ok());
    }
    assert!(saved > 8, "{saved} of 24 were saved");
}

#[test]
fn a_map_being_written_is_not_repaired() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    fs::write(&path, good()).unwrap();
    let _writer = MapFile::open(&path).unwrap();
    let message = repair(&path, &folder.path().join("new.gpkg"), &mut || true).unwrap_err().to_string();
    assert!(message.contains("being written"), "{message}");
}

#[test]
fn an_interrupted_repair_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (path, to) = (folder.path().join("map.gpkg"), folder.path().join("new.gpkg"));
    fs::write(&path, good()).unwrap();
    for most in [0, 5, KEYFRAMES + 3] {
        let mut turns = 0;
        let stopped = repair(&path, &to, &mut || {
            turns += 1;
            turns <= most
        });
        assert!(stopped.unwrap_err().to_string().contains("interrupted"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

//! Maps of several robots: each session with its camera and its origin.

use crate::ground::{camera, edge_to, image, keyframe, pose};
use odograph::camera::{Camera, Distortion, LeverArm, Rig};
use odograph::fixed_pattern::ImageMask;
use odograph::ground_map::{KeyframeImage, KeyframeImages, MountedCamera};
use odograph::image::GrayImage;
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use odograph_map::{MapFile, Outbox, OutgoingRecord, PathFrame, SessionOrigin, UnfinishedSession, repair};
use std::path::Path;

fn other() -> MountedCamera {
    let lens = Distortion::from_opencv(&[0.02, -0.01, 0.0, 0.0]).unwrap();
    MountedCamera {
        camera: Camera::new((96, 72), (80.0, 80.0), (47.5, 35.5), lens).unwrap(),
        rig: Rig { lever_arm: Some(LeverArm { x_m: 0.1, y_m: 0.0, z_m: 0.8 }), ..Rig::level(0.9) },
    }
}

fn small_image() -> KeyframeImage {
    KeyframeImage { gray: GrayImage::from_samples(96, 72, vec![90; 96 * 72]).unwrap(), color: None }
}

fn loop_between(from: u64, to: u64) -> MapEdge {
    MapEdge { from: KeyframeId(from), to: KeyframeId(to), kind: EdgeKind::Loop, ..edge_to(1) }
}

fn version(path: &Path) -> i64 {
    let connection = rusqlite::Connection::open(path).unwrap();
    connection.query_row("SELECT schema_version FROM odograph_map", [], |row| row.get(0)).unwrap()
}

/// A map with a session of the first camera, and one of another.
fn with_two_cameras(path: &Path) {
    let mut map = MapFile::create(path, &camera(), &Rig::level(0.5)).unwrap();
    let first = map.begin_session("a.mp4").unwrap();
    map.add_keyframe(&keyframe(0, first), &image(0), &[]).unwrap();
    map.close().unwrap();
    assert_eq!(version(path), 1, "a map of one camera is one that older programs read");
    let mut map = MapFile::open(path).unwrap();
    let second =
        map.begin_session_by(&SessionOrigin::new("cart-2").unwrap(), "b.mp4", Some(&other())).unwrap();
    map.add_keyframe(&keyframe(1, second), &small_image(), &[]).unwrap();
    map.add_keyframe(&keyframe(2, second), &small_image(), &[edge_to(2)]).unwrap();
    let wrong = map.add_keyframe(&keyframe(3, second), &image(3), &[]).unwrap_err().to_string();
    assert!(wrong.contains("160x120 pixels, the map's camera 96x72"), "{wrong}");
    map.close().unwrap();
    assert_eq!(version(path), 2);
}

#[test]
fn a_session_without_a_path_did_not_end() {
    let folder = tempfile::tempdir().unwrap();
    let mut map = MapFile::create(&folder.path().join("map.gpkg"), &camera(), &Rig::level(0.5)).unwrap();
    let ended = map.begin_session("a.mp4").unwrap();
    map.add_keyframe(&keyframe(0, ended), &image(0), &[]).unwrap();
    map.set_path(ended, &[PathFrame { frame: 0, segment: 0, time_s: 0.0, pose: pose(0) }]).unwrap();
    let killed = map.begin_session("b.mp4").unwrap();
    for number in [1, 2] {
        map.add_keyframe(&keyframe(number, killed), &image(number), &[edge_to(number)]).unwrap();
    }
    // One that saw nothing, and one of a robot, as a site has them.
    map.begin_session("c.mp4").unwrap();
    let robot = map.begin_session_by(&SessionOrigin::new("cart-2").unwrap(), "d.mp4", None).unwrap();
    map.add_keyframe(&keyframe(3, robot), &image(3), &[]).unwrap();
    let left = UnfinishedSession { id: killed, source: "b.mp4".to_owned(), keyframes: 2 };
    assert_eq!(map.unfinished_sessions().unwrap(), [left]);
}

fn check_two_cameras(map: &mut MapFile) {
    map.check().unwrap();
    let ground = map.map().unwrap();
    assert_eq!((&ground.camera, ground.rig), (&camera(), Rig::level(0.5)));
    assert_eq!((ground.camera_of(1), ground.rig_of(1)), (&other().camera, &other().rig));
    assert_eq!(ground.camera_of(0), &camera());
    assert_eq!(map.load(KeyframeId(2)).unwrap().gray.width(), 96);
    let sessions = map.sessions().unwrap();
    assert_eq!(sessions[0].origin, None);
    let origin = sessions[1].origin.as_ref().unwrap();
    assert_eq!((origin.robot.as_str(), origin.key.len()), ("cart-2", 32));
    assert_eq!([0, 1, 2].map(|id| map.number_of(KeyframeId(id)).unwrap()), [None, Some(0), Some(1)]);
}

#[test]
fn sessions_keep_their_own_camera_and_origin() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    with_two_cameras(&path);
    check_two_cameras(&mut MapFile::open_read_only(&path).unwrap());
    // The picture of the ground is made of both.
    let mut map = MapFile::open(&path).unwrap();
    assert!(map.render_mosaic(None, &mut |_| true).unwrap());
    map.remove_keyframes(&[KeyframeId(1)], &[]).unwrap();
    assert_eq!(map.number_of(KeyframeId(1)).unwrap(), None);
}

/// A mask of the lower half of this camera's images.
fn lower_half(camera: &Camera) -> ImageMask {
    let (width, height) = (camera.width(), camera.height());
    let mut shown = GrayImage::new(width, height);
    shown.samples_mut()[..width * height / 2].fill(255);
    ImageMask::from_picture(&shown)
}

#[test]
fn masks_of_sessions_are_kept_until_they_are_removed() {
    let folder = tempfile::tempdir().unwrap();
    let [path, saved] = ["map.gpkg", "saved.gpkg"].map(|name| folder.path().join(name));
    with_two_cameras(&path);
    let masks = |path: &Path| MapFile::open_read_only(path).unwrap().map().unwrap().masks;
    assert!(masks(&path).is_empty());
    let mut map = MapFile::open(&path).unwrap();
    let ground = map.map().unwrap();
    let [first, second] = [0, 1].map(|session| lower_half(ground.camera_of(session)));
    map.set_mask(0, Some(&first)).unwrap();
    map.set_mask(1, Some(&second)).unwrap();
    map.close().unwrap();
    assert_eq!(*masks(&path)[&0], first);
    assert_eq!(*masks(&path)[&1], second);
    repair(&path, &saved, &mut || true).unwrap();
    assert_eq!(masks(&saved), masks(&path));
    let mut map = MapFile::open(&path).unwrap();
    map.remove_session(1).unwrap();
    assert_eq!(map.map().unwrap().masks.keys().collect::<Vec<_>>(), [&0]);
    map.set_mask(0, None).unwrap();
    assert!(map.map().unwrap().masks.is_empty());
    // A picture that is no mask of this camera.
    map.set_mask(0, Some(&ImageMask::from_picture(&GrayImage::new(40, 40)))).unwrap();
    let sentence = map.map().unwrap_err().to_string();
    assert!(sentence.contains("the mask of session 0 has 40x40 pixels, not "), "{sentence}");
}

#[test]
fn a_removed_session_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    with_two_cameras(&path);
    let mut map = MapFile::open(&path).unwrap();
    let frame = PathFrame { frame: 3, segment: 0, time_s: 0.1, pose: pose(1) };
    map.set_path(1, &[frame, PathFrame { frame: 4, time_s: 0.2, ..frame }]).unwrap();
    map.add_edges(&[loop_between(2, 0)]).unwrap();
    map.remove_session(1).unwrap();
    map.check().unwrap();
    let ground = map.map().unwrap();
    assert_eq!(ground.keyframes.iter().map(|keyframe| keyframe.id.0).collect::<Vec<_>>(), [0]);
    assert!(ground.edges.is_empty() && ground.other_cameras.is_empty());
    assert_eq!(map.sessions().unwrap().len(), 1);
    assert!(map.path_of(1).unwrap().is_empty());
    // The next session takes its place, with a camera of its own.
    assert_eq!(map.begin_session("c.mp4").unwrap(), 1);
    map.close().unwrap();
    assert!(MapFile::open_read_only(&path).unwrap().other_cameras().is_empty());
}

#[test]
fn a_repaired_map_keeps_cameras_and_origins() {
    let folder = tempfile::tempdir().unwrap();
    let (path, repaired) = (folder.path().join("map.gpkg"), folder.path().join("repaired.gpkg"));
    with_two_cameras(&path);
    let origin = MapFile::open_read_only(&path).unwrap().sessions().unwrap().remove(1).origin;
    repair(&path, &repaired, &mut || true).unwrap();
    let mut map = MapFile::open_read_only(&repaired).unwrap();
    check_two_cameras(&mut map);
    assert_eq!(map.sessions().unwrap().remove(1).origin, origin);
}

#[test]
fn a_robot_needs_a_plain_name() {
    let folder = tempfile::tempdir().unwrap();
    let mut map = MapFile::create(&folder.path().join("map.gpkg"), &camera(), &Rig::level(0.5)).unwrap();
    for name in ["", "-a", "a b", "a/b", "größe", "a\n", &"x".repeat(65)] {
        assert!(SessionOrigin::new(name).is_err(), "{name:?}");
        let origin = SessionOrigin { robot: name.into(), key: "0".repeat(32) };
        assert!(map.begin_session_by(&origin, "a.mp4", None).is_err(), "{name:?}");
    }
    assert!(map.sessions().unwrap().is_empty());
    map.begin_session_by(&SessionOrigin::new("Cart_2.b").unwrap(), "a.mp4", None).unwrap();
}

#[test]
fn keys_are_drawn_and_the_one_that_follows_is_the_same_each_time() {
    let [one, other] = [0, 1].map(|_| SessionOrigin::new("cart").unwrap().validated().unwrap());
    assert_ne!(one.key, other.key);
    let following = one.following().validated().unwrap();
    assert!(following == one.following() && following != one, "{following:?}");
    let last = SessionOrigin { robot: "cart".into(), key: "f".repeat(32) };
    assert_eq!(last.following().key, "0".repeat(32));
}

/// Reads everything there is, `most` records at a time.
fn read(outbox: &mut Outbox, map: &MapFile, most: usize) -> Vec<OutgoingRecord> {
    let mut records = Vec::new();
    loop {
        let next = outbox.next(map, most).unwrap();
        if next.is_empty() {
            return records;
        }
        records.extend(next);
    }
}

#[test]
fn records_are_the_same_whenever_they_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let mut map = MapFile::create(&path, &camera(), &Rig::level(0.5)).unwrap();
    // Keyframes of an earlier session, so that numbers are not ids.
    let before = map.begin_session("before.mp4").unwrap();
    map.add_keyframe(&keyframe(0, before), &image(0), &[]).unwrap();
    let session = map.begin_session_by(&SessionOrigin::new("cart").unwrap(), "a.mp4", None).unwrap();
    let origin = map.sessions().unwrap()[1].origin.clone().unwrap();
    let mut early = Outbox::new(&map, &origin).unwrap();
    assert!(early.next(&map, 10).unwrap().is_empty());
    let mut records = Vec::new();
    for id in 1..6 {
        let tie = if id > 1 { vec![edge_to(id)] } else { vec![] };
        map.add_keyframe(&keyframe(id, session), &image(id), &tie).unwrap();
        // What is found about a keyframe after it was added belongs to the next one.
        records.extend(read(&mut early, &map, 3));
        if id == 3 {
            map.add_edges(&[loop_between(3, 1), loop_between(3, 0)]).unwrap();
        }
    }
    map.add_edges(&[loop_between(5, 2)]).unwrap();
    assert_eq!(records.iter().map(|record| record.number).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
    let ends = |record: &OutgoingRecord| -> Vec<_> {
        record.edges.iter().map(|edge| (edge.from.0, edge.to.0)).collect()
    };
    // The loop to the earlier session is not one of this session.
    assert_eq!(
        records.iter().map(ends).collect::<Vec<_>>(),
        [vec![], vec![(0, 1)], vec![(1, 2)], vec![(2, 0), (2, 3)], vec![(3, 4)]]
    );
    let mut late = Outbox::new(&map, &origin).unwrap();
    assert_eq!(read(&mut late, &map, 2), records);
    for outbox in [&mut early, &mut late] {
        let rest = outbox.rest(&map).unwrap();
        assert_eq!(rest.iter().map(|edge| (edge.from.0, edge.to.0)).collect::<Vec<_>>(), [(4, 1)]);
    }
}

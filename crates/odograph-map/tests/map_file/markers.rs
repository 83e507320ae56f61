//! Markers in the map file.

use crate::ground::{camera, edge_to, image, keyframe};
use nalgebra::Matrix3;
use odograph::camera::Rig;
use odograph::geometry::{GroundPose, Se2};
use odograph::keyframe::KeyframeId;
use odograph::keyframe::relative_pose::relative_motion;
use odograph::landmark::{MarkerSighting, PlacedSighting};
use odograph_map::{MapFile, MapMarker, repair};
use rusqlite::Connection;
use std::path::Path;

const FAMILY: &str = "apriltag:36h11";

/// A marker 0.1 m ahead of a keyframe and 0.05 m to its left.
fn seen(number: u32, by: u64) -> PlacedSighting {
    let sighting = MarkerSighting {
        number,
        keyframe: KeyframeId(by),
        keyframe_from_marker: Se2::new(0.1, 0.05, 0.7),
        covariance: Matrix3::from_diagonal(&[1e-8, 2e-8, 1e-6].into()),
        side_m: 0.0801,
        side_sigma_m: 1e-4,
    };
    PlacedSighting { sighting, place: 0, visit: 0 }
}

/// A map with two sessions of four keyframes each; the first has seen markers 3 and 4.
fn made(path: &Path) -> MapFile {
    let mut map = MapFile::create(path, &camera(), &Rig::level(0.5)).unwrap();
    for session in 0..2 {
        assert_eq!(map.begin_session("drive.mp4").unwrap(), session);
        for number in 4 * u64::from(session)..4 * u64::from(session) + 4 {
            let edges = if number % 4 > 0 { vec![edge_to(number)] } else { vec![] };
            map.add_keyframe(&keyframe(number, session), &image(number), &edges).unwrap();
        }
    }
    map.add_markers(FAMILY, 0.08, &[seen(3, 1)]).unwrap();
    map.add_markers(FAMILY, 0.08, &[seen(4, 2), PlacedSighting { visit: 1, ..seen(3, 3) }]).unwrap();
    map
}

/// Where a marker is that a keyframe at this pose sees as [`seen`] has it.
fn place(pose: &GroundPose) -> Se2 {
    pose.se2() * Se2::new(0.1, 0.05, 0.7)
}

fn off_m(marker: &MapMarker, at: &Se2) -> f64 {
    (marker.pose.x_m - at.x_m).hypot(marker.pose.y_m - at.y_m)
}

/// Numbers of a layer in the file, as another program reads them.
fn in_layer(path: &Path, column: &str) -> Vec<f64> {
    let connection = Connection::open(path).unwrap();
    let mut statement =
        connection.prepare(&format!("SELECT {column} FROM marker_sightings ORDER BY id")).unwrap();
    statement.query_map([], |row| row.get(0)).unwrap().map(|value| value.unwrap()).collect()
}

#[test]
fn markers_round_trip_and_move_with_their_keyframes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let mut map = made(&path);
    let markers = map.markers().unwrap();
    let placed: Vec<PlacedSighting> = markers.iter().map(|marker| marker.placed).collect();
    assert_eq!(placed, [seen(3, 1), seen(4, 2), PlacedSighting { visit: 1, ..seen(3, 3) }]);
    assert!(markers.iter().all(|marker| marker.family == FAMILY && marker.session == 0));
    assert_eq!(markers[1].time_s, keyframe(2, 0).time_s);
    assert!(off_m(&markers[1], &place(&keyframe(2, 0).pose)) < 1e-12);
    // What is unknown of the keyframe adds to what is unknown of the sighting.
    assert!(markers[1].covariance[(0, 0)] > 1e-6 && markers[1].covariance[(0, 0)] < 2e-6);

    let moved = GroundPose { x_m: 7.0, y_m: -3.0, heading_rad: 1.0, ..keyframe(2, 0).pose };
    map.set_poses(&[(KeyframeId(2), moved, keyframe(2, 0).covariance)]).unwrap();
    let after = map.markers().unwrap();
    assert!(off_m(&after[1], &place(&moved)) < 1e-12);
    assert_eq!(after[0], markers[0]);
    let landmarks = map.landmarks().unwrap();
    assert_eq!(landmarks.len(), 2);
    assert_eq!((landmarks[0].number, landmarks[0].sightings), (3, 2));
    map.check().unwrap();
    map.close().unwrap();
    assert!((in_layer(&path, "x_m")[1] - place(&moved).x_m).abs() < 1e-12);
    assert_eq!(in_layer(&path, "number"), [3.0, 4.0, 3.0]);

    let mut map = MapFile::open(&path).unwrap();
    map.set_markers(0, FAMILY, 0.08, &[seen(4, 2)]).unwrap();
    map.add_markers(FAMILY, 0.08, &[seen(4, 6)]).unwrap();
    assert_eq!(map.landmarks().unwrap()[0].sessions, [0, 1]);
    map.remove_session(0).unwrap();
    let left: Vec<PlacedSighting> = map.markers().unwrap().iter().map(|marker| marker.placed).collect();
    assert_eq!(left, [seen(4, 6)]);
}

#[test]
fn a_map_without_markers_has_no_table_of_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let mut map = MapFile::create(&path, &camera(), &Rig::level(0.5)).unwrap();
    map.begin_session("drive.mp4").unwrap();
    map.add_keyframe(&keyframe(0, 0), &image(0), &[]).unwrap();
    map.add_markers(FAMILY, 0.08, &[]).unwrap();
    map.set_poses(&[(KeyframeId(0), keyframe(0, 0).pose, keyframe(0, 0).covariance)]).unwrap();
    assert!(map.markers().unwrap().is_empty() && map.landmarks().unwrap().is_empty());
    map.check().unwrap();
    map.close().unwrap();
    let tables: i64 = Connection::open(&path)
        .unwrap()
        .query_row("SELECT count(*) FROM sqlite_schema WHERE name LIKE '%marker%'", [], |row| row.get(0))
        .unwrap();
    assert_eq!(tables, 0);
}

#[test]
fn thinning_hands_markers_to_neighbours() {
    let folder = tempfile::tempdir().unwrap();
    let mut map = MapFile::create(&folder.path().join("map.gpkg"), &camera(), &Rig::level(0.5)).unwrap();
    map.begin_session("drive.mp4").unwrap();
    let poses = |number: u64| GroundPose {
        x_m: 0.02 * number as f64,
        heading_rad: 0.1 * number as f64,
        ..keyframe(0, 0).pose
    };
    for number in 0..8 {
        let pose = poses(number);
        let edges = (number > 0).then(|| odograph::keyframe::MapEdge {
            motion: relative_motion(&poses(number - 1), &pose),
            kind: odograph::keyframe::EdgeKind::Odometry,
            ..edge_to(number)
        });
        let keyframe = odograph::ground_map::MapKeyframe { pose, odometry_pose: pose, ..keyframe(number, 0) };
        map.add_keyframe(&keyframe, &image(number), edges.as_slice()).unwrap();
        map.add_markers(FAMILY, 0.08, &[seen(number as u32, number)]).unwrap();
    }
    let before = map.markers().unwrap();
    let gone = map.thin(2).unwrap().gone;
    assert_eq!(gone.len(), 6);
    let after = map.markers().unwrap();
    assert_eq!(after.len(), before.len());
    for (before, after) in before.iter().zip(&after) {
        assert!(!gone.contains(&after.placed.sighting.keyframe));
        assert_eq!(before.placed.sighting.number, after.placed.sighting.number);
        assert!(off_m(after, &before.pose) < 1e-9, "{before:?} {after:?}");
    }
    map.check().unwrap();
}

#[test]
fn a_repaired_map_keeps_its_valid_markers() {
    let folder = tempfile::tempdir().unwrap();
    let (path, to) = (folder.path().join("map.gpkg"), folder.path().join("repaired.gpkg"));
    let map = made(&path);
    let expected = map.markers().unwrap();
    map.close().unwrap();
    repair(&path, &to, &mut || true).unwrap();
    assert_eq!(MapFile::open(&to).unwrap().markers().unwrap(), expected);
    std::fs::remove_file(&to).unwrap();
    Connection::open(&path).unwrap().execute("DELETE FROM odograph_image WHERE keyframe = 2", []).unwrap();
    repair(&path, &to, &mut || true).unwrap();
    assert_eq!(MapFile::open(&to).unwrap().markers().unwrap(), [expected[0].clone(), expected[2].clone()]);
}

#[test]
fn invalid_markers_are_named() {
    for (sql, part) in [
        (
            "UPDATE marker_sightings SET keyframe = 77 WHERE id = 2",
            "row 2 of marker_sightings is of a keyframe that is not in the map",
        ),
        (
            "UPDATE marker_sightings SET keyframe_x_m = 9e999",
            "row 1 of marker_sightings has a number that no marker can have",
        ),
        ("UPDATE marker_sightings SET size_m = -1", "has a number that no marker can have"),
        ("UPDATE marker_sightings SET covariance = x'00'", "has an invalid covariance"),
        ("UPDATE marker_sightings SET family = 'a b'", "has an invalid family"),
        ("UPDATE marker_sightings SET number = -1", "markers"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        made(&path).close().unwrap();
        Connection::open(&path).unwrap().execute_batch(sql).unwrap();
        let mut map = MapFile::open(&path).unwrap();
        let message = map.markers().unwrap_err().to_string();
        assert!(message.contains(part) || part == "markers", "{sql}: {message}");
        assert!(!message.contains('\n') && map.check().is_err());
        assert!(map.map().is_ok(), "the ground can be used without the markers");
    }
}

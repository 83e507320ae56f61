//! Round trips: what is written to a map is read back.

use crate::ground::{self, camera, covariance, edge_to, image, keyframe, pose};
use odograph::camera::{LeverArm, Rig};
use odograph::geometry::GroundPose;
use odograph::ground_map::{GroundMap, KeyframeImage, KeyframeImages};
use odograph::keyframe::KeyframeId;
use odograph::mosaic::{Mosaic, MosaicOptions, MosaicPicture};
use odograph_map::{MapFile, PathFrame, connected_stretches};

fn rig() -> Rig {
    Rig {
        height_m: 0.5,
        roll_rad: 0.01,
        pitch_rad: -0.02,
        yaw_rad: 0.3,
        lever_arm: Some(LeverArm { x_m: 0.3, y_m: -0.05, z_m: 0.4 }),
    }
}

/// A map of `count` keyframes in a new folder.
fn made(count: u64) -> (tempfile::TempDir, MapFile) {
    let folder = tempfile::tempdir().unwrap();
    let mut map = MapFile::create(&folder.path().join("map.gpkg"), &camera(), &rig()).unwrap();
    let session = map.begin_session("drive.mp4").unwrap();
    for number in 0..count {
        assert_eq!(map.next_keyframe().unwrap(), KeyframeId(number));
        let edges = if number > 0 { vec![edge_to(number)] } else { vec![] };
        map.add_keyframe(&keyframe(number, session), &image(number), &edges).unwrap();
    }
    (folder, map)
}

#[test]
fn a_loss_within_a_segment_interrupts_the_path() {
    // Every second frame is taken. Two are dropped, then sixty lost, after which the ground was
    // recognised; a segment begins at the end.
    let numbers = (0..20).map(|k| 2 * k).chain([42, 44, 46]).chain((60..80).map(|k| 2 * k));
    let path: Vec<PathFrame> = numbers
        .map(|frame| PathFrame {
            frame,
            segment: usize::from(frame >= 150),
            time_s: 0.03 * frame as f64,
            pose: GroundPose { x_m: 0.01 * frame as f64, ..pose(0) },
        })
        .collect();
    let lengths: Vec<usize> = connected_stretches(&path).map(<[PathFrame]>::len).collect();
    assert_eq!(lengths, [23, 15, 5]);
    assert_eq!(connected_stretches(&[]).count(), 0);
    let (folder, mut map) = made(2);
    map.set_path(0, &path).unwrap();
    map.close().unwrap();
    let database = rusqlite::Connection::open(folder.path().join("map.gpkg")).unwrap();
    let mut lines = database.prepare("SELECT frames, segment, length_m FROM paths ORDER BY start_s").unwrap();
    let lines: Vec<(usize, usize, f64)> = lines
        .query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))
        .unwrap()
        .collect::<rusqlite::Result<_>>()
        .unwrap();
    let counts: Vec<(usize, usize)> = lines.iter().map(|line| (line.0, line.1)).collect();
    assert_eq!(counts, [(23, 0), (15, 0), (5, 1)]);
    assert!((lines[0].2 - 0.46).abs() < 1e-9 && (lines[1].2 - 0.28).abs() < 1e-9, "{lines:?}");
}

#[test]
fn a_map_round_trips() {
    let (folder, mut map) = made(8);
    let path: Vec<PathFrame> = (0..80)
        .map(|frame| PathFrame {
            frame,
            segment: (frame / 50) as usize,
            time_s: 0.03 * frame as f64,
            pose: pose(frame / 10),
        })
        .collect();
    map.set_path(0, &path).unwrap();
    map.close().unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "one file is left");
    let mut map = MapFile::open_read_only(&folder.path().join("map.gpkg")).unwrap();
    map.check().unwrap();
    let expected = GroundMap {
        camera: camera(),
        rig: rig(),
        other_cameras: Default::default(),
        masks: Default::default(),
        keyframes: (0..8).map(|number| keyframe(number, 0)).collect(),
        edges: (1..8).map(edge_to).collect(),
    };
    assert_eq!(map.map().unwrap(), expected);
    assert_eq!(map.path_of(0).unwrap(), path);
    assert_eq!(map.sessions().unwrap()[0].source, "drive.mp4");
}

#[test]
fn images_round_trip_up_to_compression_error() {
    let (_folder, mut map) = made(2);
    let rms = |a: &[u8], b: &[u8]| {
        let sum: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
        (sum / a.len() as f64).sqrt()
    };
    let (back, before) = (map.load(KeyframeId(1)).unwrap(), image(1));
    // JPEG quality 95 changes a texture as fine as this one by one to two gray levels, comparable
    // to camera noise.
    assert!(rms(back.gray.samples(), before.gray.samples()) < 2.0);
    assert!(back.color.is_none());
    let before = ground::color_image();
    map.add_keyframe(&keyframe(2, 0), &before, &[]).unwrap();
    let back = map.load(KeyframeId(2)).unwrap();
    assert!(rms(back.gray.samples(), before.gray.samples()) < 1.0);
    // The colours vary slowly, so halving the chroma resolution has little effect; the test
    // verifies that the limited range of gray is undone.
    let error = rms(back.color.unwrap().samples(), before.color.unwrap().samples());
    assert!(error < 2.5, "{error}");
}

#[test]
fn a_map_can_be_continued_updated_and_thinned() {
    let (folder, mut map) = made(4);
    let moved = GroundPose { x_m: 100.0, y_m: -3.0, ..pose(2) };
    map.set_poses(&[(KeyframeId(2), moved, 4.0 * covariance())]).unwrap();
    let mut composed = edge_to(1);
    composed.to = KeyframeId(2);
    map.remove_keyframes(&[KeyframeId(1), KeyframeId(3)], &[composed]).unwrap();
    drop(map);
    let mut map = MapFile::open(&folder.path().join("map.gpkg")).unwrap();
    assert_eq!(map.next_keyframe().unwrap(), KeyframeId(4), "no number is given twice");
    assert_eq!(map.begin_session("again.mp4").unwrap(), 1);
    map.add_keyframe(&keyframe(4, 1), &image(4), &[]).unwrap();
    let found = map.map().unwrap();
    let numbers: Vec<u64> = found.keyframes.iter().map(|keyframe| keyframe.id.0).collect();
    assert_eq!(numbers, [0, 2, 4]);
    assert_eq!((found.keyframes[1].pose, found.keyframes[1].covariance), (moved, 4.0 * covariance()));
    assert_eq!(found.keyframes[1].odometry_pose, keyframe(2, 0).odometry_pose);
    assert_eq!(found.edges, [composed]);
    assert!(map.load(KeyframeId(1)).is_err());
    map.check().unwrap();
}

#[test]
fn the_same_keyframes_produce_identical_files() {
    let bytes = || {
        let (folder, mut map) = made(5);
        map.render_mosaic(None, &mut |_| true).unwrap();
        map.close().unwrap();
        std::fs::read(folder.path().join("map.gpkg")).unwrap()
    };
    assert!(bytes() == bytes());
}

#[test]
fn invalid_keyframes_are_rejected_without_changing_the_map() {
    let (folder, mut map) = made(2);
    let sentence = |result: odograph::error::Result<()>| result.unwrap_err().to_string();
    let other_size = KeyframeImage { gray: odograph::image::GrayImage::new(10, 10), color: None };
    assert!(sentence(map.add_keyframe(&keyframe(2, 0), &other_size, &[])).contains("10x10"));
    let mut nowhere = keyframe(2, 0);
    nowhere.pose.x_m = f64::NAN;
    assert!(sentence(map.add_keyframe(&nowhere, &image(2), &[])).contains("not finite"));
    // What would make the map unreadable.
    let mut doubtful = keyframe(2, 0);
    doubtful.covariance[(4, 4)] = -1.0;
    assert!(sentence(map.add_keyframe(&doubtful, &image(2), &[])).contains("an invalid covariance"));
    assert!(
        sentence(map.add_keyframe(&keyframe(1, 0), &image(1), &[])).contains("cannot be written"),
        "number given twice"
    );
    let path = folder.path().join("map.gpkg");
    assert!(MapFile::create(&path, &camera(), &rig()).unwrap_err().to_string().contains("already"));
    assert_eq!(map.map().unwrap().keyframes.len(), 2);
    drop(map);
    let mut map = MapFile::open_read_only(&path).unwrap();
    assert!(sentence(map.add_keyframe(&keyframe(2, 0), &image(2), &[])).contains("cannot be written"));
}

#[test]
fn a_rendered_mosaic_is_stored_and_read_as_one_picture() {
    let (_folder, mut map) = made(12);
    assert!(map.mosaic().unwrap().is_none() && map.mosaic_picture(1000).unwrap().is_none());
    assert!(map.render_mosaic(Some(0.004), &mut |_| true).unwrap());
    let layer = map.mosaic().unwrap().unwrap();
    assert!((layer.resolution_m - 0.004).abs() < 1e-12);
    let picture = map.mosaic_picture(usize::MAX).unwrap().unwrap();
    let small = map.mosaic_picture(10_000).unwrap().unwrap();
    assert!(small.width * small.height <= 10_000 && small.placement.metres_per_pixel > 0.007);
    for number in 0..12 {
        for picture in [&picture, &small] {
            let under = odograph::geometry::GroundPoint::new(pose(number).x_m, pose(number).y_m);
            let (column, row) = picture.placement.pixel_from_ground(under);
            let at = 4 * (row.round() as usize * picture.width + column.round() as usize);
            assert_eq!(picture.rgba[at + 3], 255, "keyframe {number} stands on ground that was not seen");
        }
    }
    // After cancellation the stored mosaic is unchanged.
    assert!(!map.render_mosaic(Some(0.002), &mut |_| false).unwrap());
    assert_eq!(map.mosaic().unwrap().unwrap(), layer);
}

#[test]
fn a_mosaic_rendered_elsewhere_round_trips() {
    let (_folder, mut map) = made(12);
    let mut mosaic = Mosaic::new(MosaicOptions { ground_resolution_m: Some(0.002), ..Default::default() });
    assert!(!map.set_mosaic(&mosaic).unwrap(), "nothing is rendered yet");
    assert!(map.mosaic().unwrap().is_none());
    for number in 0..12 {
        assert!(mosaic.add(&image(number).gray, &camera(), &pose(number)));
    }
    assert!(map.set_mosaic(&mosaic).unwrap());
    let (rendered, found) = (mosaic.picture().unwrap(), map.mosaic_picture(usize::MAX).unwrap().unwrap());
    assert_eq!((found.width, found.height), (rendered.width, rendered.height));
    assert!(found.rgba == rendered.rgba);
    let places = [&found, &rendered].map(|picture| picture.placement.ground_from_pixel(0.0, 0.0));
    assert!(places[0].distance(places[1]) < 1e-9);
    // Every level shows the same ground, up to the sampling of its pixels.
    let layer = map.mosaic().unwrap().unwrap();
    assert!(layer.finest >= 2, "{layer:?}");
    let pixels = |level: u32| layer.picture_at(level).0 * layer.picture_at(level).1;
    for level in 0..layer.finest {
        let coarse = map.mosaic_picture(pixels(level) as usize).unwrap().unwrap();
        let seen = |picture: &MosaicPicture| {
            let seen = picture.rgba.chunks_exact(4).filter(|pixel| pixel[3] > 0).count() as f64;
            seen * picture.placement.metres_per_pixel.powi(2)
        };
        // A reduced pixel shows ground if any of its four source pixels does, so the covered area
        // grows by half a pixel along its border.
        assert!((1.0..1.4).contains(&(seen(&coarse) / seen(&rendered))), "level {level}");
    }
    map.check().unwrap();
}

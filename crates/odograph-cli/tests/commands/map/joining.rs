//! Merged and optimised maps: `odograph map merge` and `odograph map optimize`.

use super::{odograph, text};
use nalgebra::{Matrix4, Matrix6, Vector4};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::geometry::GroundPose;
use odograph::ground_map::{KeyframeImage, KeyframeImages, MapKeyframe, MountedCamera};
use odograph::image::Pyramid;
use odograph::keyframe::relative_pose::{compose, relative_motion};
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use odograph::place_recognition::{PlacesConfig, Signature};
use odograph_map::{MapFile, PathFrame, SessionOrigin};
use odograph_simulation::{Ground, Renderer, Texture};
use std::fs;
use std::path::Path;
use std::sync::LazyLock;

const HEIGHT_M: f64 = 0.75;

/// Field of view 0.96 m by 0.72 m; a pixel is 3 mm.
fn camera() -> Camera {
    Camera::new((320, 240), (250.0, 250.0), (160.0, 119.5), Distortion::None).unwrap()
}

static GROUND: LazyLock<Ground> = LazyLock::new(|| {
    Ground::new(Texture::named("asphalt").unwrap(), Renderer::new(&camera()).footprint_m(HEIGHT_M), false, 3)
        .unwrap()
});

/// A straight path with a step of 0.25 m.
fn way(from: (f64, f64), heading_rad: f64, count: usize) -> Vec<GroundPose> {
    let (sin, cos) = heading_rad.sin_cos();
    let step = |i: usize| 0.25 * i as f64;
    let level = GroundPose::level(HEIGHT_M);
    (0..count)
        .map(|i| GroundPose {
            x_m: from.0 + step(i) * cos,
            y_m: from.1 + step(i) * sin,
            heading_rad,
            ..level
        })
        .collect()
}

fn tie(from: usize, to: usize, kind: EdgeKind, motion: Vector4<f64>) -> MapEdge {
    let [from, to] = [from, to].map(|number| KeyframeId(number as u64));
    let covariance = Matrix4::from_diagonal(&Vector4::new(1e-6, 1e-6, 1e-6, 0.0));
    MapEdge { from, to, kind, motion, covariance }
}

/// A map of the images from the poses `truth`, with keyframes and one frame of the trajectory at
/// the poses `known`, and the given edges.
fn map_of(path: &Path, truth: &[GroundPose], known: &[GroundPose], edges: &[MapEdge]) {
    map_with(path, HEIGHT_M, truth, known, edges);
}

/// The same with a rig of this height.
fn map_with(path: &Path, height_m: f64, truth: &[GroundPose], known: &[GroundPose], edges: &[MapEdge]) {
    let camera = camera();
    let renderer = Renderer::new(&camera);
    let mut map = MapFile::create(path, &camera, &Rig::level(height_m)).unwrap();
    let session = map.begin_session(path.file_name().unwrap().to_str().unwrap()).unwrap();
    let mut frames = Vec::new();
    for (number, (truth, known)) in truth.iter().zip(known).enumerate() {
        let gray = renderer.gray_view(&GROUND, truth);
        let config = PlacesConfig::new(&camera, height_m);
        let keyframe = MapKeyframe {
            id: KeyframeId(number as u64),
            session,
            segment: 0,
            frame: number as u64,
            time_s: number as f64,
            odometry_pose: *known,
            pose: *known,
            covariance: Matrix6::zeros(),
            signature: Signature::of(&Pyramid::new(gray.clone(), 4), &camera, None, known, &config),
        };
        let own: Vec<MapEdge> = edges.iter().filter(|e| e.from.max(e.to) == keyframe.id).copied().collect();
        map.add_keyframe(&keyframe, &KeyframeImage { gray, color: None }, &own).unwrap();
        frames.push(PathFrame { frame: keyframe.frame, segment: 0, time_s: keyframe.time_s, pose: *known });
    }
    map.set_path(session, &frames).unwrap();
    map.close().unwrap();
}

/// A drive in the frame of reference of its first camera, as without prior knowledge.
fn drive(path: &Path, truth: &[GroundPose]) {
    let level = GroundPose::level(HEIGHT_M);
    let known: Vec<_> =
        truth.iter().map(|pose| compose(&level, &relative_motion(&truth[0], pose), 1.0)).collect();
    let edges: Vec<_> = (1..truth.len())
        .map(|i| tie(i - 1, i, EdgeKind::Odometry, relative_motion(&truth[i - 1], &truth[i])))
        .collect();
    map_of(path, truth, &known, &edges);
}

fn apart_m(a: &GroundPose, b: &GroundPose) -> f64 {
    (a.x_m - b.x_m).hypot(a.y_m - b.y_m)
}

#[test]
fn overlapping_maps_are_merged() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    drive(&at("a.gpkg"), &way((0.0, 0.0), 0.0, 9));
    let second = way((2.3, 0.4), -2.7, 9);
    drive(&at("b.gpkg"), &second);
    let before = [fs::read(at("a.gpkg")).unwrap(), fs::read(at("b.gpkg")).unwrap()];
    let mut rendered = MapFile::open(&at("b.gpkg")).unwrap();
    rendered.render_mosaic(Some(0.01), &mut |_| true).unwrap();
    rendered.close().unwrap();

    let merge = ["merge", "a.gpkg", "b.gpkg", "-o", "c.gpkg"];
    let (code, message, complaints) = text(&odograph(&merge, folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    assert!(
        message.starts_with("b.gpkg: 9 keyframes, seen again in ") && message.ends_with("c.gpkg\n"),
        "{message}"
    );
    let mut joined = MapFile::open_read_only(&at("c.gpkg")).unwrap();
    joined.check().unwrap();
    let sources: Vec<_> = joined.sessions().unwrap().into_iter().map(|session| session.source).collect();
    assert_eq!(sources, ["a.gpkg", "b.gpkg"]);
    let map = joined.map().unwrap();
    assert_eq!(map.keyframes.len(), 18);
    // Both are in the frame of the first map, to half a pixel, and each frame has the pose of its
    // keyframe.
    let truth: Vec<GroundPose> = way((0.0, 0.0), 0.0, 9).into_iter().chain(second).collect();
    let paths = [0, 1].map(|session| joined.path_of(session).unwrap()).concat();
    for ((keyframe, truth), frame) in map.keyframes.iter().zip(&truth).zip(&paths) {
        assert!(apart_m(&keyframe.pose, truth) < 1.5e-3, "{:?} is not at {truth:?}", keyframe.pose);
        assert!(apart_m(&keyframe.pose, &frame.pose) < 1e-9, "{frame:?} is not at {:?}", keyframe.pose);
    }
    // Images are copied unchanged, and the mosaic has the same resolution as before.
    let mut other = MapFile::open_read_only(&at("b.gpkg")).unwrap();
    assert_eq!(joined.load(KeyframeId(12)).unwrap(), other.load(KeyframeId(3)).unwrap());
    assert_eq!(joined.mosaic().unwrap().map(|layer| layer.resolution_m), Some(0.01));
    assert_eq!(fs::read(at("a.gpkg")).unwrap(), before[0]);

    // Files are not overwritten, and maps are not merged without overlap.
    let whole = fs::read(at("c.gpkg")).unwrap();
    fs::write(at("b.gpkg"), &before[1]).unwrap();
    drive(&at("far.gpkg"), &way((30.0, 5.0), 1.0, 5));
    let other_camera = super::made();
    fs::copy(other_camera.path().join("map.gpkg"), at("small.gpkg")).unwrap();
    for (arguments, code, part) in [
        (merge.to_vec(), 2, "already there"),
        (vec!["merge", "a.gpkg", "./a.gpkg", "-o", "d.gpkg"], 2, "given twice"),
        (vec!["merge", "a.gpkg", "-o", "d.gpkg"], 2, "2 values required"),
        (vec!["merge", "a.gpkg", "small.gpkg", "-o", "d.gpkg"], 3, "another camera"),
        (vec!["merge", "a.gpkg", "far.gpkg", "-o", "d.gpkg"], 3, "no ground of far.gpkg was recognised"),
        (vec!["merge", "a.gpkg", "none.gpkg", "-o", "d.gpkg"], 3, "none.gpkg"),
        (vec!["merge", "a.gpkg", "far.gpkg", "-o", "c.gpkg", "--force"], 3, "no ground of far.gpkg"),
    ] {
        let (found, message, complaint) = text(&odograph(&arguments, folder.path()));
        assert_eq!((found, message.as_str()), (code, ""), "{arguments:?}: {complaint}");
        assert!(complaint.contains(part), "{arguments:?}: {complaint}");
    }
    let mut left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["a.gpkg", "b.gpkg", "c.gpkg", "far.gpkg", "small.gpkg"]);
    assert_eq!(fs::read(at("c.gpkg")).unwrap(), whole, "what failed left what was there");
}

/// Another camera, higher up.
fn second_camera() -> MountedCamera {
    let camera = Camera::new((256, 192), (180.0, 180.0), (127.5, 95.5), Distortion::None).unwrap();
    MountedCamera { camera, rig: Rig::level(0.8) }
}

/// A map of two robots, the second of which has the second camera, in the frame of the first one's
/// first keyframe. Returns their origins.
fn drive_of_two(path: &Path, robots: [&str; 2], truth: [Vec<GroundPose>; 2]) -> [SessionOrigin; 2] {
    let cameras = [MountedCamera { camera: camera(), rig: Rig::level(HEIGHT_M) }, second_camera()];
    let mut map = MapFile::create(path, &cameras[0].camera, &cameras[0].rig).unwrap();
    let config = PlacesConfig::new(&camera(), HEIGHT_M);
    let (start, begin) = (GroundPose::level(HEIGHT_M), truth[0][0]);
    let mut next = 0;
    let origins = robots.map(|robot| SessionOrigin::new(robot).unwrap());
    for ((origin, MountedCamera { camera, rig }), truth) in origins.iter().zip(&cameras).zip(truth) {
        let mounted = MountedCamera { camera: camera.clone(), rig: *rig };
        let session = map.begin_session_by(origin, "drive.mp4", Some(&mounted)).unwrap();
        let (renderer, mut frames) = (Renderer::new(camera), Vec::new());
        for (at, pose) in truth.iter().enumerate() {
            let truth_here = GroundPose { height_m: rig.height_m, ..*pose };
            let known = compose(&start, &relative_motion(&begin, pose), 1.0);
            let known = GroundPose { height_m: rig.height_m, ..known };
            let gray = renderer.gray_view(&GROUND, &truth_here);
            let keyframe = MapKeyframe {
                id: KeyframeId(next),
                session,
                segment: 0,
                frame: at as u64,
                time_s: at as f64,
                odometry_pose: known,
                pose: known,
                covariance: Matrix6::zeros(),
                signature: Signature::of(&Pyramid::new(gray.clone(), 4), camera, None, &known, &config),
            };
            let step = |at: usize| relative_motion(&truth[at - 1], &truth[at]);
            let edge = (at > 0).then(|| tie(next as usize - 1, next as usize, EdgeKind::Odometry, step(at)));
            map.add_keyframe(&keyframe, &KeyframeImage { gray, color: None }, edge.as_slice()).unwrap();
            frames.push(PathFrame {
                frame: keyframe.frame,
                segment: 0,
                time_s: keyframe.time_s,
                pose: known,
            });
            next += 1;
        }
        map.set_path(session, &frames).unwrap();
    }
    map.close().unwrap();
    origins
}

#[test]
fn merged_sessions_keep_their_cameras_and_robots() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    drive(&at("one_camera.gpkg"), &way((0.0, 0.0), 0.0, 9));
    let first = [way((0.0, 0.0), 0.0, 9), way((0.1, 0.3), 0.0, 6)];
    let second = [way((2.3, 0.4), -2.7, 9), way((2.2, 0.1), 3.0, 6)];
    let here = drive_of_two(&at("a.gpkg"), ["one", "two"], first);
    let there = drive_of_two(&at("b.gpkg"), ["three", "four"], second);
    let merge = |maps: [&str; 2], output: &str| {
        text(&odograph(&["merge", maps[0], maps[1], "-o", output], folder.path()))
    };
    let (code, message, told) = merge(["a.gpkg", "b.gpkg"], "c.gpkg");
    assert_eq!((code, told.as_str()), (0, ""), "{message}");
    let mut joined = MapFile::open_read_only(&at("c.gpkg")).unwrap();
    joined.check().unwrap();
    let origins: Vec<_> = joined.sessions().unwrap().into_iter().map(|session| session.origin).collect();
    assert_eq!(origins, here.into_iter().chain(there).map(Some).collect::<Vec<_>>());
    let map = joined.map().unwrap();
    for (session, mounted) in [(1, true), (2, false), (3, true)] {
        let other = mounted.then(second_camera);
        assert_eq!(joined.other_cameras().get(&session), other.as_ref(), "session {session}");
        let own = map.keyframes.iter().filter(|keyframe| keyframe.session == session);
        let numbers: Vec<_> = own.map(|keyframe| joined.number_of(keyframe.id).unwrap().unwrap()).collect();
        assert_eq!(numbers, (0..numbers.len() as u64).collect::<Vec<_>>(), "session {session}");
    }
    let mut other = MapFile::open_read_only(&at("b.gpkg")).unwrap();
    assert_eq!(joined.load(KeyframeId(25)).unwrap(), other.load(KeyframeId(10)).unwrap());
    // The same again is noticed, and so is a camera that is not the first.
    for (maps, part) in [
        (["c.gpkg", "b.gpkg"], "every session of b.gpkg is in c.gpkg already"),
        (["one_camera.gpkg", "b.gpkg"], "another camera"),
    ] {
        let (code, _, complaint) = merge(maps, "d.gpkg");
        assert!(code == 3 && complaint.contains(part), "{complaint}");
        assert!(!at("d.gpkg").exists());
    }
}

#[test]
fn sessions_that_are_there_already_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    drive(&at("a.gpkg"), &way((0.0, 0.0), 0.0, 9));
    drive(&at("b.gpkg"), &way((2.3, 0.4), -2.7, 9));
    fs::copy(at("a.gpkg"), at("copy.gpkg")).unwrap();
    let merge = |maps: [&str; 2], output: &str| {
        text(&odograph(&["merge", maps[0], maps[1], "-o", output], folder.path()))
    };
    assert_eq!(merge(["a.gpkg", "b.gpkg"], "c.gpkg").0, 0);
    // A copy, and maps that the first one contains.
    for maps in [["a.gpkg", "copy.gpkg"], ["c.gpkg", "a.gpkg"], ["c.gpkg", "b.gpkg"]] {
        let (code, message, complaint) = merge(maps, "d.gpkg");
        assert_eq!((code, message.as_str()), (3, ""), "{complaint}");
        let sentence = format!("every session of {} is in {} already", maps[1], maps[0]);
        assert!(complaint.contains(&sentence) && complaint.lines().count() == 1, "{complaint}");
        assert!(!at("d.gpkg").exists());
    }
    // A map that contains the first one: only what is new is joined.
    let (code, message, told) = merge(["b.gpkg", "c.gpkg"], "d.gpkg");
    assert_eq!(code, 0, "{told}");
    assert!(message.starts_with("c.gpkg: 9 keyframes, "), "{message}");
    assert!(told.contains("note: b.gpkg of c.gpkg is in b.gpkg already, and is left out"), "{told}");
    let joined = MapFile::open_read_only(&at("d.gpkg")).unwrap();
    let sources: Vec<_> = joined.sessions().unwrap().into_iter().map(|session| session.source).collect();
    assert_eq!(
        (sources, joined.map().unwrap().keyframes.len()),
        (vec!["b.gpkg".into(), "a.gpkg".into()], 18)
    );
}

#[test]
fn a_map_with_other_metres_is_named_when_it_is_merged() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("again")).unwrap();
    drive(&at("a.gpkg"), &way((0.0, 0.0), 0.0, 9));
    // All lengths of this map are 5 % too long, as with a height of 0.788 m.
    let second = way((2.3, 0.4), -2.7, 9);
    let longer = |pose: &GroundPose| GroundPose {
        x_m: 1.05 * pose.x_m,
        y_m: 1.05 * pose.y_m,
        height_m: 1.05 * pose.height_m,
        ..*pose
    };
    let first = compose(&GroundPose::level(HEIGHT_M), &relative_motion(&second[0], &second[0]), 1.0);
    let known: Vec<_> =
        second.iter().map(|pose| longer(&compose(&first, &relative_motion(&second[0], pose), 1.0))).collect();
    let edges: Vec<_> = (1..known.len())
        .map(|i| tie(i - 1, i, EdgeKind::Odometry, relative_motion(&known[i - 1], &known[i])))
        .collect();
    map_with(&at("b.gpkg"), 1.05 * HEIGHT_M, &second, &known, &edges);
    let (code, _, told) = text(&odograph(&["merge", "a.gpkg", "b.gpkg", "-o", "c.gpkg"], folder.path()));
    assert_eq!(code, 0, "{told}");
    // So is the same recording, run again with another height: it is not the same session.
    map_with(&at("again/a.gpkg"), 1.05 * HEIGHT_M, &way((0.0, 0.0), 0.0, 9), &known, &edges);
    let again = text(&odograph(&["merge", "a.gpkg", "again/a.gpkg", "-o", "d.gpkg"], folder.path()));
    assert!(again.0 == 0 && again.2.contains(" m above it, not 0.788 m: check height"), "{again:?}");
    let sentence = "warning: by the ground that was recognised in a.gpkg the camera of b.gpkg was 0.75";
    assert!(told.starts_with(sentence) && told.contains(" m above it, not 0.788 m: check height"), "{told}");
}

#[test]
fn optimisation_straightens_a_bent_map_with_its_trajectory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    // Back and forth; every step has a heading error of half a degree, and the return path has loop
    // closures with the outward path.
    let there = way((0.0, 0.0), 0.0, 6);
    let back = way((1.25, 0.2), std::f64::consts::PI, 6);
    let truth: Vec<GroundPose> = there.into_iter().chain(back).collect();
    let (mut edges, mut known) = (Vec::new(), vec![truth[0]]);
    for i in 1..truth.len() {
        let mut motion = relative_motion(&truth[i - 1], &truth[i]);
        motion[2] += 0.01;
        edges.push(tie(i - 1, i, EdgeKind::Odometry, motion));
        known.push(compose(&known[i - 1], &motion, 1.0));
    }
    let exact = |edge: MapEdge| MapEdge { covariance: edge.covariance * 1e-2, ..edge };
    edges.extend(
        (6..12).map(|i| exact(tie(i, 11 - i, EdgeKind::Loop, relative_motion(&truth[i], &truth[11 - i])))),
    );
    map_of(&path, &truth, &known, &edges);
    let worst_m = |map: &MapFile| {
        let keyframes = map.map().unwrap().keyframes;
        keyframes.iter().zip(&truth).map(|(k, truth)| apart_m(&k.pose, truth)).fold(0.0, f64::max)
    };
    let bent_m = worst_m(&MapFile::open_read_only(&path).unwrap());

    let bytes = fs::read(&path).unwrap();
    let (code, message, complaints) =
        text(&odograph(&["optimize", "map.gpkg", "-o", "straight.gpkg"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    assert!(message.starts_with("12 keyframes, 17 edges, 6 of them loops; moved by up to "), "{message}");
    assert_eq!(fs::read(&path).unwrap(), bytes, "the map itself was not asked to be changed");
    let straight = MapFile::open_read_only(&folder.path().join("straight.gpkg")).unwrap();
    // Loop closures correct everything observable: all except a rotation of the first keyframes,
    // which only the bent steps measure.
    let straight_m = worst_m(&straight);
    assert!(straight_m < 0.2 * bent_m, "{bent_m} m bent, {straight_m} m straightened");
    for (frame, keyframe) in straight.path_of(0).unwrap().iter().zip(straight.map().unwrap().keyframes) {
        assert!(apart_m(&frame.pose, &keyframe.pose) < 1e-9);
        assert!(keyframe.id.0 == 0 || keyframe.covariance[(0, 0)] > 0.0, "{:?}", keyframe.id);
    }
    drop(straight);

    // Optimised again in place: it is at the optimum already, so nothing moves by a micrometre.
    let message = text(&odograph(&["optimize", "straight.gpkg"], folder.path()));
    assert!(message.0 == 0 && message.1.ends_with("moved by up to 0.00 mm\n"), "{message:?}");
    let (code, _, complaint) =
        text(&odograph(&["optimize", "map.gpkg", "-o", "straight.gpkg"], folder.path()));
    assert!(code == 2 && complaint.contains("already there"), "{complaint}");
}

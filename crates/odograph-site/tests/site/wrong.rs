//! Robots that are wrong about themselves: their names, and the poses of the others.

use crate::fleet::{Served, any_port};
use crate::robots::{Robot, camera};
use odograph::camera::Distortion;
use odograph_map::MapFile;
use std::path::Path;

/// A robot over the ground of the two others, from elsewhere.
fn third() -> Robot {
    Robot { name: "three", lane: ((0.4, 0.1), 0.05, 90), ..Robot::second() }
}

/// Largest distance of a keyframe from where the robot was, metres; `None` without any.
fn worst_m(place: &Path, robot: &Robot) -> Option<f64> {
    let file = MapFile::open_read_only(&place.join("map.gpkg")).unwrap();
    let sessions = file.sessions().unwrap();
    let own = sessions.iter().find(|session| session.origin.as_ref().unwrap().robot == robot.name)?.id;
    let keyframes = file.map().unwrap().keyframes.into_iter().filter(|keyframe| keyframe.session == own);
    keyframes
        .map(|keyframe| keyframe.pose.distance_m(&robot.pose(0.04 * keyframe.frame as f64)))
        .reduce(f64::max)
}

#[test]
fn a_wrong_robot_is_named_and_moves_no_other() {
    let mut brown = [0.0; 8];
    brown[0] = 0.05;
    let [k1, k2, p1, p2, k3, k4, k5, k6] = brown;
    let lens = Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 };
    let told = |focal_px: f64| camera((400, 300), focal_px, Distortion::None);
    let driven = tempfile::tempdir().unwrap();
    let others = [Robot::first(), Robot::second()];
    let maps = [0, 1].map(|index| others[index].drive(driven.path()));
    // What is said of it; whether it is in the common map.
    for (robot, said, connected) in [
        (third(), "", true),
        // Times are not measurements.
        (Robot { step_s: 0.0, ..third() }, "", true),
        // Nothing of it is recognised, which is no evidence.
        (Robot { is_mirrored: true, ..third() }, "", false),
        (Robot { told: told(1.05 * 330.0), ..third() }, "a focal length in the same ratio", false),
        (Robot { told_m: 0.95 * 0.9, ..third() }, "a height of 0.900 m in place of 0.855 m", false),
        (Robot { camera: camera((400, 300), 330.0, lens), ..third() }, "check its lens", false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("site");
        let served = Served::new(&place, any_port());
        for (other, map) in others.iter().zip(&maps) {
            served.send(other, map);
        }
        served.send(&robot, &robot.drive(folder.path()));
        let session = served.session(&robot);
        let page = served.site.page();
        let named = format!("{} {}", page["robots"]["three"]["reason"], session["doubt"]);
        assert!(named.contains(said) && (named == "null null") == said.is_empty(), "{named}");
        assert_eq!(session["connected"], connected, "{named} {session}");
        for other in &others {
            assert!(worst_m(&place, other).unwrap() < 1e-3, "{named}");
        }
        assert!(!connected || worst_m(&place, &robot).unwrap() < 1e-3);
    }
}

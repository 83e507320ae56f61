//! The mosaic that a run stores in its map, and the comparison with a reference trajectory.

use crate::program::{done, done_once};
use odograph::geometry::Pixel;
use odograph::ground_map::MountedCamera;
use odograph::keyframe::EdgeKind;
use odograph_map::MapFile;
use std::fs;
use std::path::Path;
use std::process::Command;

fn odograph(arguments: &str, folder: &Path) -> (i32, String) {
    let done = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .args(arguments.split(' '))
        .current_dir(folder)
        .output()
        .unwrap();
    (done.status.code().unwrap(), String::from_utf8(done.stderr).unwrap())
}

#[test]
fn a_run_stores_the_mosaic_in_its_map() {
    let folder = tempfile::tempdir().unwrap();
    let simulate = "simulate --path straight --length 1.2 --speed 1 --size 160x120 --fps 20 --height 0.8 --texture asphalt -o sim --quiet";
    let simulated = odograph(simulate, folder.path());
    assert_eq!(simulated, (0, String::new()));
    // The ground truth scaled and rotated by 90°: a receiver does not know the frame of reference
    // of a run.
    let truth = fs::read_to_string(folder.path().join("sim/truth.tum")).unwrap();
    let elsewhere: String = truth
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| {
            let numbers: Vec<f64> = line.split(' ').map(|number| number.parse().unwrap()).collect();
            let [time, x, y, z] = numbers[..4] else { panic!("{line}") };
            format!("{time} {} {} {} 0 0 0 1\n", 7.0 - 2.0 * y, 5.0 + 2.0 * x, 2.0 * z)
        })
        .collect();
    fs::write(folder.path().join("fixes & more.tum"), elsewhere).unwrap();
    let run = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --rig sim/rig.toml";
    let done = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .args(run.split(' '))
        .args(["--reference", "fixes & more.tum", "-o", "out"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert_eq!((done.status.code(), String::from_utf8(done.stderr).unwrap().as_str()), (Some(0), ""));
    let page = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    let section = &page[page.find("Beside fixes &amp; more.tum").unwrap()..];
    // The reference is scaled by 2; the estimate has the accuracy of a run of 1 m.
    assert!(
        section.contains("scale of the alignment is 2.00")
            || section.contains("scale of the alignment is 1.99")
    );
    assert!(section.contains(">reference</text>") && section.contains(">distance (m)</text>"));

    // The mosaic exists without a further command: all observed ground, with pixels twice as large
    // as those of the image.
    let map = MapFile::open_read_only(&folder.path().join("out/map.gpkg")).unwrap();
    let layer = map.mosaic().unwrap().expect("the run lays the ground");
    let pixel_m = 0.8 / map.camera().focal_px().0;
    // The height may vary as estimated from the images, here by micrometres.
    assert!((layer.resolution_m / pixel_m - 2.0).abs() < 1e-4, "{} m, {pixel_m} m", layer.resolution_m);
    let (width, _, _) = layer.picture_at(layer.finest);
    // The lens distorts the image border: the corners see farthest.
    let along = |x: f64, y: f64| 0.8 * map.camera().ray_from_pixel(Pixel::new(x, y)).unwrap().y;
    let back_m = along(0.0, 119.0).max(along(159.0, 119.0)).max(along(79.5, 119.0));
    let ahead_m = along(0.0, 0.0).min(along(159.0, 0.0)).min(along(79.5, 0.0));
    let seen_m = 1.2 + back_m - ahead_m;
    let rendered_m = width as f64 * layer.resolution_m;
    // It covers the ground from the first frame to the last, except for frames that add little new
    // ground; a ground pixel at each end is partly observed.
    let new_m = 0.1 * (back_m - ahead_m);
    assert!(
        rendered_m < seen_m + 2.0 * layer.resolution_m && rendered_m > seen_m - new_m,
        "{rendered_m} m of {seen_m} m"
    );
    drop(map);

    // A missing reference is reported before tracking; one without overlap in time causes a
    // warning.
    let missing = odograph(&format!("{run} --reference none.tum -o out2 --quiet"), folder.path());
    assert!(missing.0 == 3 && missing.1.contains("none.tum"), "{missing:?}");
    fs::write(folder.path().join("later.tum"), "900 0 0 0 0 0 0 1\n901 1 0 0 0 0 0 1\n902 2 0 0 0 0 0 1\n")
        .unwrap();
    let later = odograph(&format!("{run} --reference later.tum -o out3"), folder.path());
    assert!(later.0 == 0 && later.1.contains("cannot be compared"), "{later:?}");
}

#[test]
fn an_image_is_localised_without_changing_the_map() {
    let folder = tempfile::tempdir().unwrap();
    let simulate =
        "simulate --path straight --length 1.2 --speed 1 --size 320x240 --fps 20 --height 0.8 --quiet";
    for (texture, name) in [("asphalt", "sim"), ("grass", "other")] {
        let done = odograph(&format!("{simulate} --texture {texture} -o {name}"), folder.path());
        assert_eq!(done, (0, String::new()));
    }
    let run = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --rig sim/rig.toml -o out --quiet";
    assert_eq!(odograph(run, folder.path()), (0, String::new()));
    let map = fs::read(folder.path().join("out/map.gpkg")).unwrap();
    let mut frames: Vec<_> =
        fs::read_dir(folder.path().join("sim/frames")).unwrap().map(|entry| entry.unwrap().path()).collect();
    frames.sort();
    let middle = frames.len() / 2;
    let localize = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(["localize", "--map", "out/map.gpkg"])
            .args(arguments)
            .current_dir(folder.path())
            .output()
            .unwrap()
    };
    let picture = frames[middle].to_str().unwrap();
    let found = localize(&[picture]);
    let message = String::from_utf8(found.stdout).unwrap();
    assert_eq!(found.status.code(), Some(0), "{message} {}", String::from_utf8_lossy(&found.stderr));
    assert!(
        message.contains("heading") && message.contains("nearest: keyframe") && message.contains("session 0"),
        "{message}"
    );

    let json = localize(&[picture, "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&json.stdout).unwrap();
    let trajectory = fs::read_to_string(folder.path().join("out/trajectory.tum")).unwrap();
    let line = trajectory.lines().filter(|line| !line.starts_with('#')).nth(middle).unwrap();
    let known: Vec<f64> = line.split(' ').map(|number| number.parse().unwrap()).collect();
    let place = |key: &str| json["place"][key].as_f64().unwrap();
    assert_eq!(json["recognised"], true);
    let off_m = (place("x_m") - known[1]).hypot(place("y_m") - known[2]);
    assert!(off_m < 2e-3 && place("heading_deg").abs() < 0.5, "{off_m} m off, {json}");
    assert!(place("sd_x_m") > 0.0 && place("sd_x_m") < 0.01 && place("sd_heading_deg") > 0.0, "{json}");
    assert_eq!(
        (json["session_source"].as_str(), json["verdict"].as_str()),
        (Some("sim/frames"), Some("found"))
    );

    // A blank picture gives no verdict.
    fs::write(folder.path().join("blank.pgm"), [&b"P5 320 240 255\n"[..], &[128; 320 * 240]].concat())
        .unwrap();
    let nothing = localize(&["blank.pgm", "--json"]);
    let nothing: serde_json::Value = serde_json::from_slice(&nothing.stdout).unwrap();
    assert_eq!(nothing["verdict"], "too-few-features", "{nothing}");

    // Unknown ground is not recognised, which is reported, and nothing is written.
    let mut others: Vec<_> = fs::read_dir(folder.path().join("other/frames"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    others.sort();
    for more in [&[][..], &["--json"], &["-o", "nowhere"]] {
        let lost = localize(&[&[others[3].to_str().unwrap()], more].concat());
        let message = String::from_utf8(lost.stderr).unwrap();
        assert!(
            lost.status.code() == Some(4)
                && message
                    .contains("resembles nothing in out/map.gpkg; this ground was probably never mapped"),
            "{message}"
        );
        let json = serde_json::from_slice::<serde_json::Value>(&lost.stdout);
        let never_seen = |json: serde_json::Value| {
            json["recognised"] == false
                && json["verdict"] == "never-seen"
                && json["alike"] == serde_json::json!([])
        };
        assert_eq!(json.is_ok_and(never_seen), more == ["--json"]);
    }
    // One picture cannot extend a map. It is found as without `--extend`, or as little.
    let extending = localize(&[picture, "--extend"]);
    let warned = String::from_utf8(extending.stderr).unwrap();
    assert_eq!(extending.status.code(), Some(0), "{warned}");
    assert_eq!(String::from_utf8(extending.stdout).unwrap(), message);
    assert!(warned.contains("out/map.gpkg was not extended: that needs two sightings"), "{warned}");
    let lost = localize(&[others[3].to_str().unwrap(), "--extend"]);
    let refused = String::from_utf8(lost.stderr).unwrap();
    assert!(lost.status.code() == Some(4) && refused.contains("resembles nothing"), "{refused}");
    assert!(fs::read(folder.path().join("out/map.gpkg")).unwrap() == map, "the map was changed");
    // A recording of foreign ground is not taken for one without texture.
    fs::copy(folder.path().join("out/map.gpkg"), folder.path().join("copy.gpkg")).unwrap();
    let (status, refused) =
        odograph("localize other/frames --fps 20 --max-frames 4 --map copy.gpkg --extend", folder.path());
    assert!(status == 4 && refused.contains("resembles nothing in copy.gpkg"), "{refused}");
    // The map has nothing of it either. One sighting of mapped ground is found, and extends
    // nothing.
    let (status, warned) =
        odograph("localize sim/frames --fps 20 --max-frames 3 --map copy.gpkg --extend", folder.path());
    assert!(status == 0 && warned.contains("copy.gpkg was not extended: that needs two"), "{warned}");
    let copy = MapFile::open_read_only(&folder.path().join("copy.gpkg")).unwrap();
    let own = MapFile::open_read_only(&folder.path().join("out/map.gpkg")).unwrap();
    assert_eq!(copy.sessions().unwrap().len(), 1);
    assert_eq!(copy.map().unwrap(), own.map().unwrap());
    drop((copy, own));
    // With `--extend` the map grows.
    let grown = localize(&["sim/frames", "--extend", "-o", "grown"]);
    assert_eq!(grown.status.code(), Some(0), "{}", String::from_utf8_lossy(&grown.stderr));
    let sessions = MapFile::open_read_only(&folder.path().join("out/map.gpkg")).unwrap().sessions().unwrap();
    assert_eq!(sessions.len(), 2);
}

#[test]
fn every_camera_of_a_map_is_recognised_and_continues_it() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let simulate =
        "simulate --path straight --length 1.2 --speed 1 --fps 20 --texture asphalt --seed 3 --quiet";
    for (name, view) in
        [("a", "--size 320x240 --height 0.8"), ("b", "--size 400x300 --height 0.9"), ("c", "--size 360x280")]
    {
        assert_eq!(odograph(&format!("{simulate} {view} -o {name}"), place), (0, String::new()));
    }
    let run = |name: &str, more: &str| {
        let camera =
            format!("--timestamps {name}/frames.txt --camera {name}/camera.yaml --rig {name}/rig.toml");
        odograph(&format!("run {name}/frames {camera} --quiet {more}"), place)
    };
    assert_eq!(run("a", "-o out-a"), (0, String::new()));
    assert_eq!(run("b", "-o out-b"), (0, String::new()));
    // A session of the second camera, as a site makes one.
    let there = MapFile::open_read_only(&place.join("out-b/map.gpkg")).unwrap();
    let mounted = MountedCamera { camera: there.camera().clone(), rig: *there.rig() };
    let mut map = MapFile::open(&place.join("out-a/map.gpkg")).unwrap();
    map.begin_session_with("elsewhere", &mounted).unwrap();
    map.close().unwrap();
    // A picture of either camera is found, and a run with either continues the map.
    for name in ["a", "b"] {
        let picture = format!("{name}/frames/000010.png");
        let found = odograph(&format!("localize {picture} --map out-a/map.gpkg"), place);
        assert_eq!(found.0, 0, "{found:?}");
    }
    // The mount is that of the camera's session, too.
    let continued =
        "run b/frames --timestamps b/frames.txt --camera b/camera.yaml --quiet --map out-a/map.gpkg -o out-c";
    assert_eq!(odograph(continued, place), (0, String::new()));
    let map = MapFile::open_read_only(&place.join("out-a/map.gpkg")).unwrap();
    let session = map.sessions().unwrap().last().unwrap().id;
    assert_eq!((session, map.camera_of(session)), (2, &mounted.camera));
    assert!(map.map().unwrap().edges.iter().any(|edge| edge.kind == EdgeKind::Loop));
    drop(map);
    let refused = run("c", "--map out-a/map.gpkg -o out-d");
    assert!(
        refused.0 == 3 && refused.1.contains("was made with another camera than this run's"),
        "{refused:?}"
    );
    let refused = odograph("localize c/frames/000010.png --map out-a/map.gpkg", place);
    assert!(refused.0 == 3 && refused.1.contains("are 360x280 but the map was made"), "{refused:?}");
}

#[test]
fn ambiguous_places_are_listed_and_not_accepted() {
    let folder = tempfile::tempdir().unwrap();
    let photograph = "simulate --texture asphalt --path still --duration 0.1 --size 640x640 --height 60cm --noise 0 -q -o photo";
    assert_eq!(odograph(photograph, folder.path()), (0, String::new()));
    let repeated = "simulate --texture photo/frames/000000.png --photo-width 70cm --tiling repeat --path straight \
                    --length 1.6 --speed 0.8 --size 320x240 --fps 20 --height 30cm -q -o sim";
    assert_eq!(odograph(repeated, folder.path()), (0, String::new()));
    let run = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --rig sim/rig.toml -o out --quiet";
    assert_eq!(odograph(run, folder.path()), (0, String::new()));
    let map = fs::read(folder.path().join("out/map.gpkg")).unwrap();
    let localize = |more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(["localize", "sim/frames/000012.png", "--map", "out/map.gpkg"])
            .args(more)
            .current_dir(folder.path())
            .output()
            .unwrap()
    };
    let listed = localize(&[]);
    let (places, message) =
        (String::from_utf8(listed.stdout).unwrap(), String::from_utf8(listed.stderr).unwrap());
    assert_eq!(listed.status.code(), Some(4), "{message}");
    assert!(
        message.starts_with("error: cannot tell: ") && message.contains("none of them is certain"),
        "{message}"
    );
    assert!(
        places.lines().count() >= 2 && places.lines().all(|line| line.starts_with("perhaps ")),
        "{places}"
    );

    let json: serde_json::Value = serde_json::from_slice(&localize(&["--json"]).stdout).unwrap();
    assert_eq!((json["verdict"].as_str(), json["recognised"].as_bool()), (Some("ambiguous"), Some(false)));
    let trajectory = fs::read_to_string(folder.path().join("out/trajectory.tum")).unwrap();
    let line = trajectory.lines().filter(|line| !line.starts_with('#')).nth(12).unwrap();
    let true_x_m: f64 = line.split(' ').nth(1).unwrap().parse().unwrap();
    let alike = json["alike"].as_array().unwrap();
    assert!(alike.iter().any(|place| (place["x_m"].as_f64().unwrap() - true_x_m).abs() < 0.01), "{json}");
    let all: f64 = alike.iter().map(|place| place["probability"].as_f64().unwrap()).sum();
    assert!((all - 1.0).abs() < 1e-9, "{json}");
    assert!(fs::read(folder.path().join("out/map.gpkg")).unwrap() == map, "the map was changed");
}

#[test]
fn a_place_comes_without_advice_of_options_that_are_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    done_once(
        here,
        "simulate -o sim --path lanes --height 0.75 --fps 15 --size 320x240 --readout-ms 20 --duration 8 --quiet",
    );
    // A map of one second, in which the readout time cannot be learned.
    let source = "sim/frames --timestamps sim/frames.txt";
    done(
        here,
        &format!("run {source} --camera sim/camera.yaml --height 0.75 --max-frames 15 -o map --quiet"),
    );
    let message = done(here, &format!("localize {source} --map map/map.gpkg"));
    assert!(!message.contains("--readout-ms"), "{message}");
}

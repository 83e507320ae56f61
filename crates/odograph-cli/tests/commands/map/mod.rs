//! Black-box tests of `odograph map`.

#[path = "../../../../odograph-map/tests/map_file/ground.rs"]
#[allow(dead_code)] // only a part of it is used here
mod ground;
mod floor;
mod gdal;
mod joining;

#[cfg(target_os = "linux")]
use crate::hostile::run_folder::Mounted;
use odograph::camera::Rig;
use odograph::formats::trajectory_file;
use odograph_map::{MapFile, PathFrame};
use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::OnceLock;

fn odograph(arguments: &[&str], folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph"))
        .arg("map")
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

/// A folder with `map.gpkg`: two lanes of six keyframes, one session.
fn made() -> tempfile::TempDir {
    static BYTES: OnceLock<Vec<u8>> = OnceLock::new();
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("map.gpkg"), BYTES.get_or_init(map_bytes)).unwrap();
    folder
}

fn map_bytes() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let mut map =
        MapFile::create(&folder.path().join("map.gpkg"), &ground::camera(), &Rig::level(0.5)).unwrap();
    let session = map.begin_session("drive & home.mp4").unwrap();
    let mut path = Vec::new();
    for number in 0..12 {
        let edges = if number > 0 { vec![ground::edge_to(number)] } else { vec![] };
        map.add_keyframe(&ground::keyframe(number, session), &ground::image(number), &edges).unwrap();
        path.push(PathFrame { frame: number, segment: 0, time_s: number as f64, pose: ground::pose(number) });
    }
    map.set_path(session, &path).unwrap();
    map.render_mosaic(None, &mut |_| true).unwrap();
    map.close().unwrap();
    fs::read(folder.path().join("map.gpkg")).unwrap()
}

fn text(output: &Output) -> (i32, String, String) {
    let string = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (output.status.code().unwrap(), string(&output.stdout), string(&output.stderr))
}

#[test]
fn info_lists_the_contents_of_a_map() {
    let folder = made();
    let (code, message, complaints) = text(&odograph(&["info", "map.gpkg", "--check"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    for part in
        ["12 in 1 piece,", "9 odometry, 2 gaps, 0 loops", "session 0  drive & home.mp4", "no damage found"]
    {
        assert!(message.contains(part), "{part:?} is not in\n{message}");
    }
    let (code, message, _) = text(&odograph(&["info", "map.gpkg", "--json"], folder.path()));
    let json: serde_json::Value = serde_json::from_str(&message).unwrap();
    assert_eq!((code, &json["keyframes"], &json["sessions"][0]["frames"]), (0, &12.into(), &12.into()));
    assert_eq!(json["features"], 240);
}

#[test]
fn a_map_in_use_is_read_but_not_written() {
    let folder = made();
    let before = fs::read(folder.path().join("map.gpkg")).unwrap();
    let writer = MapFile::open(&folder.path().join("map.gpkg")).unwrap();
    let refused = [
        &["thin", "map.gpkg", "--max-keyframes", "2"][..],
        &["optimize", "map.gpkg"],
        &["mosaic", "map.gpkg"],
        &["optimize", "other.gpkg", "-o", "map.gpkg", "--force"],
        &["merge", "other.gpkg", "third.gpkg", "-o", "map.gpkg", "--force"],
    ];
    for other in ["other.gpkg", "third.gpkg"] {
        fs::write(folder.path().join(other), &before).unwrap();
    }
    for arguments in refused {
        let (code, message, complaint) = text(&odograph(arguments, folder.path()));
        let holder =
            format!("map.gpkg: the map is being written by another program (process {})", std::process::id());
        assert!(code == 3 && message.is_empty() && complaint.contains(&holder), "{arguments:?}: {complaint}");
        assert_eq!(complaint.lines().count(), 1, "{complaint}");
    }
    for arguments in [&["info", "map.gpkg", "--check"][..], &["export", "map.gpkg", "-o", "path.tum"]] {
        assert_eq!(text(&odograph(arguments, folder.path())).0, 0, "{arguments:?}");
    }
    assert_eq!(writer.map().unwrap().keyframes.len(), 12);
    writer.close().unwrap();
    assert_eq!(text(&odograph(refused[0], folder.path())).0, 0);
}

#[test]
fn distant_ground_is_exported_with_bounded_size() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let mut map = MapFile::create(&path, &ground::camera(), &Rig::level(0.5)).unwrap();
    let session = map.begin_session("drive.mp4").unwrap();
    for number in 0..2 {
        let mut keyframe = ground::keyframe(number, session);
        // 1000 km apart along both axes: a complete image would have 10^16 pixels.
        keyframe.pose.x_m += 1e6 * number as f64;
        keyframe.pose.y_m += 1e6 * number as f64;
        map.add_keyframe(&keyframe, &ground::image(number), &[]).unwrap();
    }
    assert!(map.render_mosaic(Some(0.01), &mut |_| true).unwrap());
    map.close().unwrap();
    for (name, most_bytes) in [("floor.ply", 60_000_000), ("floor.tif", 300_000_000), ("floor.yaml", 1 << 28)]
    {
        let (code, message, complaint) = text(&odograph(&["export", "map.gpkg", "-o", name], folder.path()));
        assert_eq!((code, complaint.as_str()), (0, ""), "{name}");
        let written = folder.path().join(name.replace("yaml", "pgm"));
        let bytes = fs::metadata(written).unwrap().len();
        assert!(bytes > 1000 && bytes < most_bytes, "{name}: {bytes} bytes, {message}");
        assert_eq!(
            message.contains("too far apart for a picture that fine"),
            name.ends_with("tif"),
            "{message}"
        );
    }
}

#[test]
fn exported_trajectories_equal_the_stored_one() {
    let folder = made();
    for name in ["path.tum", "path.kitti", "path.csv"] {
        let (code, message, complaints) = text(&odograph(&["export", "map.gpkg", "-o", name], folder.path()));
        assert_eq!((code, complaints.as_str()), (0, ""), "{name}");
        assert!(message.starts_with("12 poses"), "{message}");
    }
    let read = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();
    let tum = trajectory_file::parse_tum(&read("path.tum")).unwrap();
    let times: Vec<f64> = tum.poses.iter().map(|pose| pose.time_s).collect();
    for trajectory in [&tum, &trajectory_file::parse_kitti(&read("path.kitti"), Some(&times)).unwrap()] {
        for (number, pose) in trajectory.poses.iter().enumerate() {
            let apart = pose.world_from_camera.inverse() * ground::pose(number as u64).world_from_camera();
            assert!(apart.translation.vector.norm() < 1e-8 && apart.rotation.angle() < 1e-6);
        }
    }
    assert_eq!(
        read("path.csv").lines().nth(3).unwrap().split(',').take(4).collect::<Vec<_>>()[2..],
        ["0.400000", "0.000000"]
    );
}

#[test]
fn a_grid_for_nav2_is_free_where_the_mosaic_shows_ground() {
    let folder = made();
    let name = "der \"Hof\": ü.yaml";
    let (code, message, complaints) = text(&odograph(&["export", "map.gpkg", "-o", name], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    assert!(message.contains("cells of 0.05 m"), "{message}");
    let description = fs::read_to_string(folder.path().join(name)).unwrap();
    let value = |key: &str| {
        let line = description.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(": "));
        line.unwrap_or_else(|| panic!("{key} is not in\n{description}")).to_owned()
    };
    assert_eq!(value("image"), "\"der \\\"Hof\\\": ü.pgm\"");
    assert_eq!([value("mode"), value("resolution"), value("negate")], ["trinary", "0.05", "0"]);
    let origin = value("origin");
    let origin: Vec<f64> =
        origin.trim_matches(['[', ']']).split(", ").map(|number| number.parse().unwrap()).collect();
    let [left_m, bottom_m, yaw_rad] = origin[..] else { panic!("{origin:?}") };
    assert_eq!(yaw_rad, 0.0);
    let bytes = fs::read(folder.path().join("der \"Hof\": ü.pgm")).unwrap();
    let header = String::from_utf8_lossy(&bytes[..16]).into_owned();
    let numbers: Vec<usize> = header.split_whitespace().filter_map(|number| number.parse().ok()).collect();
    let (width, height) = (numbers[0], numbers[1]);
    let grid = &bytes[bytes.len() - width * height..];
    // As the map server reads it: the last row is that at the origin.
    let is_free = |x_m: f64, y_m: f64| {
        let (column, row) = ((x_m - left_m) / 0.05, (y_m - bottom_m) / 0.05);
        grid[(height - 1 - row as usize) * width + column as usize] == 254
    };
    assert!(grid.iter().all(|gray| [205, 254].contains(gray)));
    assert!((0..12).map(ground::pose).all(|pose| is_free(pose.x_m, pose.y_m)));
    let map = MapFile::open_read_only(&folder.path().join("map.gpkg")).unwrap();
    let mosaic = map.mosaic_picture(usize::MAX).unwrap().unwrap();
    let shown = mosaic.rgba.chunks_exact(4).filter(|pixel| pixel[3] > 0).count() as f64;
    let shown_m2 = shown * mosaic.placement.metres_per_pixel.powi(2);
    let free_m2 = 0.05 * 0.05 * grid.iter().filter(|gray| **gray == 254).count() as f64;
    // Cells that the border of the ground divides count as a whole or not at all.
    assert!((free_m2 / shown_m2 - 1.0).abs() < 0.03, "{free_m2} m² of {shown_m2} m²");
    let again = text(&odograph(&["export", "map.gpkg", "-o", name], folder.path()));
    assert!(again.0 == 2 && again.2.contains("already there"), "{again:?}");
}

#[test]
fn points_are_written_with_their_colours() {
    let folder = made();
    let (code, message, complaints) =
        text(&odograph(&["export", "map.gpkg", "-o", "ground.ply", "--max-points", "20000"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    let bytes = fs::read(folder.path().join("ground.ply")).unwrap();
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let count: usize =
        header.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap().parse().unwrap();
    assert!(message.starts_with(&format!("{} points of ground, 12 cameras", count - 12)), "{message}");
    assert!(count > 5000 && count <= 20_012 && bytes.len() - end == 27 * count);
    let few = ["export", "map.gpkg", "-o", "few.ply", "--max-points", "100"];
    let (_, message, _) = text(&odograph(&few, folder.path()));
    let points: usize = message.split(' ').next().unwrap().parse().unwrap();
    assert!(points > 50 && points <= 100, "fewer than even the coarsest picture has pixels: {message}");
    let last = &bytes[bytes.len() - 27..];
    assert_eq!((f64::from_le_bytes(last[16..24].try_into().unwrap()), &last[24..]), (0.5, &[255, 0, 0][..]));
}

#[test]
fn points_of_a_colmap_model_project_onto_their_observations() {
    let folder = made();
    let (code, _, complaints) = text(&odograph(&["export", "map.gpkg", "-o", "model"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    let read = |name: &str| fs::read_to_string(folder.path().join("model").join(name)).unwrap();
    assert!(
        read("cameras.txt").contains("1 OPENCV 160 120 130.0 131.0 79.5 61.0"),
        "{}",
        read("cameras.txt")
    );
    let camera = ground::camera();
    let numbers = |line: &str| -> Vec<f64> { line.split(' ').filter_map(|n| n.parse().ok()).collect() };
    let points: std::collections::BTreeMap<u64, Vec<f64>> = read("points3D.txt")
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| (numbers(line)[0] as u64, numbers(line)[1..4].to_vec()))
        .collect();
    let images = read("images.txt");
    let lines: Vec<&str> = images.lines().filter(|line| !line.starts_with('#')).collect();
    assert_eq!(lines.len(), 24);
    let mut seen = 0;
    for image in lines.chunks(2) {
        let pose = numbers(image[0]);
        let q = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
            pose[1], pose[2], pose[3], pose[4],
        ));
        let t = nalgebra::Vector3::new(pose[5], pose[6], pose[7]);
        assert!(folder.path().join("model/images").join(image[0].rsplit(' ').next().unwrap()).exists());
        for point in numbers(image[1]).chunks(3) {
            let world = &points[&(point[2] as u64)];
            let v = q * nalgebra::Vector3::new(world[0], world[1], world[2]) + t;
            let pixel = camera.pixel_from_ray(odograph::geometry::Ray::new(v.x / v.z, v.y / v.z)).unwrap();
            assert!((pixel.x + 0.5 - point[0]).hypot(pixel.y + 0.5 - point[1]) < 0.01);
            seen += 1;
        }
    }
    assert!(seen > 50, "{seen}");
}

#[test]
fn the_mosaic_is_redrawn_at_the_requested_resolution() {
    let folder = made();
    let (code, message, complaints) =
        text(&odograph(&["mosaic", "map.gpkg", "--resolution", "0.01", "-o", "floor.png"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    assert!(message.ends_with("px of 10.00 mm\n"), "{message}");
    let world = fs::read_to_string(folder.path().join("floor.pgw")).unwrap();
    assert!(world.starts_with("0.01\n0.0\n0.0\n-0.01\n"), "{world}");
    let left: f64 = world.lines().nth(4).unwrap().parse().unwrap();
    // Half an image height from the first keyframe: 60 px of 3.8 mm, before distortion, at the top
    // of the image.
    assert!((-0.4..-0.1).contains(&left), "{left}");

    // Much finer than the images: the message states the resolution used instead, a quarter of a
    // pixel at 0.8 m, and the reason.
    let (code, message, complaint) =
        text(&odograph(&["mosaic", "map.gpkg", "--resolution", "1e-9"], folder.path()));
    assert_eq!((code, complaint.lines().count()), (0, 1), "{complaint}");
    assert!(
        complaint.contains("--resolution 1e-9 is finer") && complaint.contains("a quarter"),
        "{complaint}"
    );
    let rendered = message.trim_end().rsplit_once(" px of ").unwrap().1;
    assert!(complaint.contains(rendered), "{message} {complaint}");
}

#[test]
fn a_mosaic_older_than_the_poses_is_named_and_rendered_again() {
    let folder = made();
    let path = folder.path().join("map.gpkg");
    // As an optimisation leaves it that is killed before it renders: twice, so that moves add up.
    for _ in 0..2 {
        let mut map = MapFile::open(&path).unwrap();
        let mut poses: Vec<_> =
            map.map().unwrap().keyframes.iter().map(|k| (k.id, k.pose, k.covariance)).collect();
        poses.iter_mut().for_each(|(_, pose, _)| pose.y_m += 0.02);
        map.set_poses(&poses).unwrap();
        map.close().unwrap();
    }
    let older = "older than the poses, which have moved by up to 40.0 mm since; odograph map mosaic map.gpkg renders it";
    for arguments in [&["info", "map.gpkg", "--check"][..], &["repair", "map.gpkg"]] {
        let (code, message, _) = text(&odograph(arguments, folder.path()));
        assert!(code == 0 && message.contains(older), "{arguments:?}: {message}");
    }
    let (code, _, complaint) = text(&odograph(&["export", "map.gpkg", "-o", "floor.png"], folder.path()));
    assert!(code == 0 && complaint.contains(older), "{complaint}");
    let (code, message, _) = text(&odograph(&["info", "map.gpkg", "--json"], folder.path()));
    assert!(code == 0 && message.contains("\"shift_m\": 0.04"), "{message}");
    // Nothing moves, and the mosaic is rendered all the same.
    let top_m = |map: &MapFile| map.mosaic().unwrap().unwrap().picture_at(9).2.y_m;
    let before_m = top_m(&MapFile::open_read_only(&path).unwrap());
    assert_eq!(text(&odograph(&["optimize", "map.gpkg", "-q"], folder.path())).0, 0);
    let map = MapFile::open_read_only(&path).unwrap();
    assert_eq!(map.mosaic_shift_m().unwrap(), None);
    assert!((top_m(&map) - before_m - 0.04).abs() < 0.01, "{before_m} {}", top_m(&map));
}

#[test]
fn thinning_makes_a_map_smaller() {
    let folder = made();
    let path = folder.path().join("map.gpkg");
    let (code, message, complaints) =
        text(&odograph(&["thin", "map.gpkg", "--max-keyframes", "8"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    assert!(message.starts_with("8 of 12 keyframes kept, "), "{message}");
    let mut map = MapFile::open_read_only(&path).unwrap();
    map.check().unwrap();
    let most = 9 * fs::metadata(&path).unwrap().len() / 10;
    drop(map);
    let (code, message, complaints) =
        text(&odograph(&["thin", "map.gpkg", "--max-size", &format!("{most}B")], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""), "{message}");
    assert!(fs::metadata(&path).unwrap().len() <= most);
    let (code, _, complaint) = text(&odograph(&["thin", "map.gpkg", "--max-size", "1kB"], folder.path()));
    assert!(code == 3 && complaint.contains("even without"), "{complaint}");
}

#[test]
fn the_mosaic_is_reduced_before_keyframes_are_removed() {
    let folder = made();
    let path = folder.path().join("map.gpkg");
    let mut map = MapFile::open(&path).unwrap();
    map.render_mosaic(Some(0.001), &mut |_| true).unwrap();
    let mosaic = map.mosaic_bytes().unwrap();
    map.close().unwrap();
    let size = || fs::metadata(&path).unwrap().len();
    let thin = |most: u64| {
        let (code, message, told) =
            text(&odograph(&["thin", "map.gpkg", "--max-size", &format!("{most}B")], folder.path()));
        assert_eq!(code, 0, "{told}");
        assert!(size() <= most, "{message}");
        assert_eq!(told, "");
        message
    };
    // A coarser picture is enough.
    let message = thin(size() - mosaic / 2);
    assert!(message.contains("\n12 of 12 keyframes kept, 100.0 % of the ground"), "{message}");
    assert!(
        message.starts_with(
            "the mosaic has pixels of 2.00 mm now instead of 1.00 mm; odograph map mosaic map.gpkg"
        ),
        "{message}"
    );
    let mut map = MapFile::open_read_only(&path).unwrap();
    map.check().unwrap();
    let layer = map.mosaic().unwrap().unwrap();
    let picture = map.mosaic_picture(usize::MAX).unwrap().unwrap();
    assert_eq!((picture.width as u64, layer.resolution_m), (layer.picture_at(layer.finest).0, 0.002));
    // Without any picture there is room for all keyframes.
    let rest = size() - map.mosaic_bytes().unwrap();
    drop(map);
    let message = thin(rest + 20_000);
    assert!(message.contains("\n12 of 12 keyframes kept"), "{message}");
    assert!(message.starts_with("the mosaic "), "{message}");
    // Only then keyframes go.
    let message = thin(8 * rest / 10);
    assert!(!message.contains("12 of 12"), "{message}");
    MapFile::open(&path).unwrap().check().unwrap();
    assert_eq!(text(&odograph(&["mosaic", "map.gpkg"], folder.path())).0, 0);
}

#[test]
fn a_damaged_map_is_repaired() {
    let folder = made();
    let path = folder.path().join("map.gpkg");
    let (code, message, complaints) = text(&odograph(&["repair", "map.gpkg"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    assert!(message.contains("no damage found; nothing was written"), "{message}");
    // As a thinning beside a running recording once left a map.
    let mut map = MapFile::open(&path).unwrap();
    map.add_edges(&[ground::edge_to(99)]).unwrap();
    map.close().unwrap();
    let (code, _, complaint) = text(&odograph(&["info", "map.gpkg"], folder.path()));
    assert!(code == 3 && complaint.contains("odograph map repair saves the rest"), "{complaint}");
    let (code, message, complaints) = text(&odograph(&["repair", "map.gpkg"], folder.path()));
    assert_eq!((code, complaints.as_str()), (0, ""));
    let saved = "12 keyframes saved, 2 known to be lost; 11 edges, 12 frames of paths\nmap-repaired.gpkg\n";
    assert_eq!(message, saved);
    let (code, message, _) = text(&odograph(&["info", "map-repaired.gpkg", "--check"], folder.path()));
    assert!(
        code == 0 && message.contains("12 in 1 piece,") && !message.contains("mosaic     none"),
        "{message}"
    );
    // Never onto the damaged map, nor unasked onto another.
    for (output, part) in [("map-repaired.gpkg", "already there"), ("map.gpkg", "already there")] {
        let (code, _, complaint) = text(&odograph(&["repair", "map.gpkg", "-o", output], folder.path()));
        assert!(code == 2 && complaint.contains(part), "{complaint}");
    }
    let forced = ["repair", "map.gpkg", "-o", "map.gpkg", "--force"];
    let (code, _, complaint) = text(&odograph(&forced, folder.path()));
    assert!(code == 2 && complaint.contains("another name"), "{complaint}");
    let left = fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(left, 2, "the damaged map and the repaired one");
}

#[test]
#[cfg(target_os = "linux")]
fn a_map_on_a_read_only_medium_is_repaired_elsewhere() {
    let folder = made();
    let medium = folder.path().join("medium");
    let Some(mounted) = Mounted::new(&medium, "size=10m") else { return };
    fs::copy(folder.path().join("map.gpkg"), medium.join("sound.gpkg")).unwrap();
    let mut map = MapFile::open(&folder.path().join("map.gpkg")).unwrap();
    map.add_edges(&[ground::edge_to(99)]).unwrap();
    map.close().unwrap();
    fs::copy(folder.path().join("map.gpkg"), medium.join("bad.gpkg")).unwrap();
    mounted.make_read_only();
    for (arguments, code, part) in [
        ("repair medium/sound.gpkg", 0, "no damage found; nothing was written"),
        ("repair medium/sound.gpkg --drop-unfinished", 0, "every session ended; nothing was written"),
        ("repair medium/bad.gpkg", 3, "medium/bad-repaired.gpkg cannot be written: Read-only file system"),
        ("repair medium/bad.gpkg", 3, "; give a place where you may write with -o FILE"),
        ("repair medium/bad.gpkg -o medium/new.gpkg", 3, "; choose a place where you may write"),
        ("repair medium/bad.gpkg -o saved.gpkg", 0, "12 keyframes saved, 2 known to be lost"),
        ("info saved.gpkg --check", 0, "12 in 1 piece"),
    ] {
        let arguments: Vec<&str> = arguments.split(' ').collect();
        let (found, message, complaint) = text(&odograph(&arguments, folder.path()));
        assert_eq!(found, code, "{arguments:?}: {complaint}");
        assert!((message + &complaint).contains(part), "{arguments:?}: {complaint}");
        assert!(complaint.lines().count() == usize::from(code != 0), "{arguments:?}: {complaint}");
    }
}

#[test]
fn invalid_usage_is_refused_in_one_sentence() {
    let folder = made();
    fs::write(folder.path().join("noise.gpkg"), [7_u8; 5000]).unwrap();
    fs::write(folder.path().join("there.tum"), "mine").unwrap();
    for (arguments, code, part) in [
        (vec!["info", "nowhere.gpkg"], 3, "nowhere.gpkg"),
        (vec!["info", "noise.gpkg"], 3, "not a map file"),
        (vec!["export", "noise.gpkg", "-o", "a.tif"], 3, "not a map file"),
        (vec!["export", "map.gpkg", "-o", "a.xyz"], 2, ".xyz"),
        (vec!["export", "map.gpkg", "-o", "a.kml"], 2, "--anchor"),
        (vec!["export", "map.gpkg", "-o", "a.tum", "--anchor", "1,2,3"], 2, "--anchor"),
        (vec!["export", "map.gpkg", "-o", "a.kml", "--anchor", "1,2"], 2, "LAT,LON,HEADING"),
        (vec!["export", "map.gpkg", "-o", "there.tum"], 2, "already there"),
        (vec!["export", "map.gpkg", "-o", "a.tum", "--session", "4"], 2, "no session 4"),
        (vec!["mosaic", "map.gpkg", "--resolution", "-1"], 2, "--resolution"),
        (vec!["mosaic", "map.gpkg", "-o", "a.tum"], 2, "picture"),
        (vec!["mosaic", "map.gpkg", "--resolution", "100"], 3, "a finer --resolution"),
        // Thinning must not remove all of a map, which could not be undone.
        (vec!["thin", "map.gpkg", "--max-keyframes", "0"], 2, "--max-keyframes"),
        (vec!["export", "map.gpkg", "-o", "a.ply", "--max-points", "0"], 2, "--max-points"),
        (vec!["export", "map.gpkg", "-o", "a.yaml", "--resolution", "0.00101"], 2, "is too fine"),
        (vec!["export", "map.gpkg", "-o", "a.yaml", "--resolution", "0"], 2, "--resolution is 0.0 m"),
        (vec!["export", "map.gpkg", "-o", "a.png", "--resolution", "5cm"], 2, "--resolution is for .yaml"),
    ] {
        let (found, message, complaint) = text(&odograph(&arguments, folder.path()));
        assert_eq!((found, message.as_str()), (code, ""), "{arguments:?}: {complaint}");
        assert!(complaint.contains(part), "{arguments:?}: {complaint}");
    }
    assert_eq!(fs::read_to_string(folder.path().join("there.tum")).unwrap(), "mine");
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 3, "nothing was left behind: {left:?}");
}

//! Black-box tests of `odograph calibrate`: its results, and its messages for unsuitable input.

pub mod boards;
#[path = "../../live/browser.rs"]
#[allow(dead_code)] // only a part of it is used here
mod browser;
mod watching;

use boards::{BOARD, bent, camera, folder, held, mirrored, pictures, scene, scene_of, write_png, y4m};
use odograph::formats::camera_file;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use odograph_simulation::Framing;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use tempfile::TempDir;

const REPORT: [&str; 6] =
    ["coverage.png", "distortion.png", "expected-error.png", "report.html", "residuals.png", "views.png"];

struct CalibrationFolder {
    temporary: TempDir,
}

impl CalibrationFolder {
    fn new() -> Self {
        Self { temporary: tempfile::tempdir().unwrap() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.temporary.path().join(name)
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(self.temporary.path()).env("ODOGRAPH_FFMPEG", "");
        command.arg("calibrate").args(arguments.split_whitespace()).stdin(Stdio::null());
        command
    }

    fn calibrate(&self, arguments: &str) -> Output {
        self.command(arguments).output().unwrap()
    }

    /// Asserts that a calibration is refused with `code` and one sentence that contains all
    /// `words`, and leaves no files.
    fn refused(&self, arguments: &str, code: i32, words: &[&str]) {
        let before = names(self.temporary.path());
        let done = self.calibrate(arguments);
        let outcome = String::from_utf8(done.stderr).unwrap();
        assert_eq!(done.status.code(), Some(code), "`{arguments}` outcome: {outcome}");
        assert!(
            words.iter().all(|words| outcome.contains(words)),
            "`{arguments}` did not tell {words:?} but: {outcome}"
        );
        assert!(
            outcome.lines().count() == 1 && !outcome.contains("panicked"),
            "`{arguments}` outcome: {outcome}"
        );
        assert!(done.stdout.is_empty(), "{:?}", String::from_utf8_lossy(&done.stdout));
        assert_eq!(names(self.temporary.path()), before, "`{arguments}` left something behind");
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// Asserts that the result is complete, and close to the true camera within the accuracy of some
/// twenty small images.
fn assert_calibrated(place: &CalibrationFolder, name: &str, done: &Output) {
    let outcome =
        format!("{}{}", String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    assert_eq!(done.status.code(), Some(0), "{outcome}");
    assert_eq!(names(&place.path(&format!("{name}-report"))), REPORT, "{outcome}");
    let text = fs::read_to_string(place.path(&format!("{name}.yaml"))).unwrap();
    let found = camera_file::parse(&text, None).unwrap();
    let truth = camera();
    assert_eq!((found.width(), found.height()), (320, 240));
    let near = |a: (f64, f64), b: (f64, f64), by: f64| (a.0 - b.0).abs() < by && (a.1 - b.1).abs() < by;
    assert!(near(found.focal_px(), truth.focal_px(), 1.0), "{found:?}");
    assert!(near(found.principal_px(), truth.principal_px(), 1.0), "{found:?}");
    for key in [
        "verdict: ",
        "rms_px: ",
        "hold_out_rms_px: ",
        "views_used: ",
        "parameter_covariance: !!opencv-matrix",
        "calibration_board: \"chessboard:7x5:30mm\"",
    ] {
        assert!(text.contains(key), "{key} in {text}");
    }
}

#[test]
fn video_calibration_is_independent_of_the_thread_count() {
    let place = CalibrationFolder::new();
    let mut frames = held(&pictures(&scene(), 18), 3);
    // The first and the last frame do not show the board.
    frames.insert(0, GrayImage::new(320, 240));
    frames.push(GrayImage::new(320, 240));
    fs::write(place.path("board.y4m"), y4m(&frames)).unwrap();
    let done = place.calibrate(&format!("board.y4m --board {BOARD} -o one.yaml --model brown4 --threads 1"));
    assert_calibrated(&place, "one", &done);
    let said = String::from_utf8(done.stdout).unwrap();
    assert!(said.contains("found in 54 of 56 frames") || said.contains("of 56 frames"), "{said}");
    assert!(
        said.contains("Look at one-report/report.html") && said.contains("Next: odograph ground"),
        "{said}"
    );
    let three =
        place.calibrate(&format!("board.y4m --board {BOARD} -o three.yaml --model brown4 --threads 3 -q"));
    assert_calibrated(&place, "three", &three);
    assert!(three.stdout.is_empty() && three.stderr.is_empty(), "{three:?}");
    let bytes = |name: &str| fs::read(place.path(name)).unwrap();
    assert_eq!(bytes("one.yaml"), bytes("three.yaml"));
    for name in REPORT {
        let page = |folder: &str| {
            let bytes = bytes(&format!("{folder}-report/{name}"));
            // The page contains the name of the camera file.
            String::from_utf8_lossy(&bytes)
                .replace("one.yaml", "camera.yaml")
                .replace("three.yaml", "camera.yaml")
        };
        assert!(page("one") == page("three"), "{name} differs");
    }
    // The same over standard input.
    let mut child = place
        .command(&format!("- --board {BOARD} -o stream.yaml --report elsewhere --model brown4"))
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(&bytes("board.y4m")).unwrap();
    assert!(child.wait().unwrap().success());
    assert_eq!(bytes("stream.yaml"), bytes("one.yaml"));
    assert_eq!(names(&place.path("elsewhere")), REPORT);
}

#[test]
fn all_images_are_used_as_folder_or_list() {
    let place = CalibrationFolder::new();
    let shown = pictures(&scene(), 14);
    folder(&place.path("shots"), &shown);
    fs::write(place.path("shots/notes.txt"), "not a picture").unwrap();
    let done = place.calibrate(&format!("shots --board {BOARD} -o camera.yaml --model brown4"));
    assert_calibrated(&place, "camera", &done);
    let page = fs::read_to_string(place.path("camera-report/report.html")).unwrap();
    assert!(page.contains("board00.png") && page.contains("board13.png"));
    fs::remove_file(place.path("shots/notes.txt")).unwrap();
    let each: Vec<String> = (0..14).map(|n| format!("shots/board{n:02}.png")).collect();
    let done = place.calibrate(&format!("{} --board {BOARD} -o each.yaml --model brown4", each.join(" ")));
    assert_calibrated(&place, "each", &done);
    let bytes = |name: &str| fs::read(place.path(name)).unwrap();
    assert_eq!(bytes("each.yaml"), bytes("camera.yaml"));

    // Existing results are not overwritten without `--force`.
    place.refused(
        &format!("shots --board {BOARD} -o camera.yaml"),
        2,
        &["camera.yaml is already there", "--force"],
    );
    fs::remove_file(place.path("camera.yaml")).unwrap();
    place.refused(
        &format!("shots --board {BOARD} -o camera.yaml"),
        2,
        &["camera-report/report.html is already there"],
    );
    let again = place.calibrate(&format!("shots --board {BOARD} -o camera.yaml --model brown4 --force -q"));
    assert_calibrated(&place, "camera", &again);
}

#[test]
fn input_without_board_is_refused_in_one_sentence() {
    let place = CalibrationFolder::new();
    let shown = pictures(&scene(), 4);
    folder(&place.path("shots"), &shown);
    let usual = |source: &str| format!("{source} --board {BOARD} -o camera.yaml");
    place.refused(&usual("none.mp4"), 3, &["none.mp4: there is no such file"]);
    place.refused(&usual("shots/board00.png none.png"), 3, &["none.png: there is no such file"]);
    fs::create_dir(place.path("empty")).unwrap();
    place.refused(&usual("empty"), 3, &["empty: the folder is empty"]);
    fs::create_dir(place.path("texts")).unwrap();
    fs::write(place.path("texts/a.txt"), "not a picture").unwrap();
    place.refused(&usual("texts"), 3, &["texts: there are no pictures"]);
    // The drawings of a run are no pictures of a board.
    fs::create_dir(place.path("drive")).unwrap();
    for name in ["run.toml", "trajectory.csv", "map.png"] {
        fs::write(place.path(&format!("drive/{name}")), "").unwrap();
    }
    place.refused(&usual("drive"), 3, &["drive is the folder of a run, not of a recording"]);
    fs::write(place.path("text.png"), "not a picture").unwrap();
    place.refused(&usual("text.png"), 3, &["text.png"]);

    let blank = vec![GrayImage::new(320, 240); 5];
    folder(&place.path("blank"), &blank);
    place.refused(
        &usual("blank"),
        3,
        &["blank: the board chessboard:7x5:30mm was not found in any of 5 pictures", "count"],
    );
    place.refused(&usual("blank/board00.png"), 3, &["was not found in the one picture"]);
    place.refused(&usual("blank --start 90"), 3, &["no frame in the chosen range"]);
    // For a board of another size than specified, the message names the detected size.
    place.refused(
        "shots --board chessboard:9x6:30mm -o camera.yaml",
        3,
        &["the board chessboard:9x6:30mm was not found", "7x5"],
    );
}

#[test]
fn another_board_than_the_one_stated_is_named() {
    let place = CalibrationFolder::new();
    let charuco = "charuco:6x5:40mm";
    folder(&place.path("charuco"), &pictures(&scene_of(charuco, &camera()), 5));
    folder(&place.path("chessboard"), &pictures(&scene(), 5));
    let state = "state that board, with the lengths of your print";
    place.refused(
        "charuco --board chessboard:7x5:40mm -o camera.yaml",
        3,
        &[
            "the board chessboard:7x5:40mm was not found",
            "5 that were compared show charuco:6x5:40mm:30mm:4x4_50 instead",
            state,
        ],
    );
    place.refused(
        "chessboard --board charuco:8x6:30mm -o camera.yaml",
        3,
        &[
            "was not found in any of 5 pictures",
            "of 5 that were compared show chessboard:7x5:30mm instead",
            state,
        ],
    );
    place.refused(
        "charuco --board charuco:6x5:40mm:30mm:5x5_50 -o camera.yaml",
        3,
        &["show charuco:6x5:40mm:30mm:4x4_50 instead", state],
    );
    place.refused(
        "chessboard/board00.png --board circles:7x5:30mm -o camera.yaml",
        3,
        &["was not found in the one picture", "it shows chessboard:7x5:30mm instead", state],
    );
}

#[test]
fn a_board_that_resembles_a_part_of_the_one_shown_is_doubted() {
    let place = CalibrationFolder::new();
    folder(&place.path("shots"), &pictures(&scene_of("charuco:8x11:20mm", &camera()), 12));
    // Rows and columns were mistaken for each other: a row of markers still agrees now and then.
    let done = place.calibrate("shots --board charuco:11x8:20mm -o camera.yaml --model brown4");
    let outcome = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(outcome.contains("charuco:8x11:20mm:15mm:4x4_50 instead"), "{outcome}");
}

#[test]
fn too_few_or_equal_views_are_refused_with_advice() {
    let place = CalibrationFolder::new();
    let shown = pictures(&scene(), 2);
    let usual = |source: &str| format!("{source} --board {BOARD} -o camera.yaml");
    folder(&place.path("one"), &shown[..1]);
    place.refused(&usual("one"), 3, &["one: the board was seen in one view only", "15 to 40 places"]);
    folder(&place.path("two"), &shown);
    place.refused(&usual("two"), 3, &["only 2 different places"]);
    folder(&place.path("same"), &held(&shown[..1], 20));
    place.refused(&usual("same"), 3, &["all 20 views show the board at the same place", "tilted"]);
    fs::write(place.path("same.y4m"), y4m(&held(&shown[..1], 40))).unwrap();
    place.refused(&usual("same.y4m"), 3, &["all 40 views show the board at the same place"]);
}

#[test]
fn mixed_sizes_are_refused_by_name() {
    let place = CalibrationFolder::new();
    let shown = pictures(&scene(), 4);
    folder(&place.path("mixed"), &shown);
    write_png(&place.path("mixed/board02.png"), &GrayImage::new(160, 120));
    let usual = |source: &str| format!("{source} --board {BOARD} -o camera.yaml");
    place.refused(&usual("mixed"), 3, &["board02.png has 160x120 pixels, the first has 320x240"]);
    place.refused(
        &usual("mixed/board00.png mixed/board02.png"),
        3,
        &["mixed/board02.png has 160x120 pixels, mixed/board00.png has 320x240"],
    );
}

#[test]
fn a_mirrored_board_with_markers_is_reported() {
    let place = CalibrationFolder::new();
    let board = "charuco:6x5:40mm";
    let scene = scene_of(board, &camera());
    let shown: Vec<GrayImage> = pictures(&scene, 5).iter().map(mirrored).collect();
    folder(&place.path("mirrored"), &shown);
    place.refused(&format!("mirrored --board {board} -o camera.yaml"), 3, &["mirrored", "was not found"]);
}

#[test]
fn invalid_usage_is_refused() {
    let place = CalibrationFolder::new();
    folder(&place.path("shots"), &pictures(&scene(), 1));
    place.refused("shots --board chessboard:9x6 -o camera.yaml", 2, &["chessboard:9x6", "write it like"]);
    place.refused("shots --board chessboard:9x6:25 -o camera.yaml", 2, &["not a length with its unit"]);
    place.refused(&format!("shots --board {BOARD} -o camera.yaml --every 0"), 2, &["every 0th frame"]);
    place.refused(&format!("shots --board {BOARD} -o shots"), 2, &["shots is a folder", "shots/camera.yaml"]);
    fs::write(place.path("file"), "mine").unwrap();
    place.refused(&format!("shots --board {BOARD} -o file/camera.yaml"), 3, &["file cannot be made"]);
    // Folders created for a failed calibration are removed.
    place.refused("shots --board chessboard:31x37:25mm -o new/folder/camera.yaml -q", 3, &["was not found"]);
    place.refused(&format!("shots --board {BOARD} -o camera.yaml --report file"), 2, &["file is a file"]);
    for wrong in ["--threads 0", "--max-views 1", "--model barrel", "--nonsense"] {
        let done = place.calibrate(&format!("shots --board {BOARD} -o camera.yaml {wrong}"));
        assert_eq!(done.status.code(), Some(2), "{wrong}");
    }
    assert_eq!(names(place.temporary.path()), ["file", "shots"]);
}

/// `/dev/full` takes the place of each file in turn.
#[test]
#[cfg(unix)]
fn a_full_disk_leaves_nothing_half_written() {
    if !Path::new("/dev/full").exists() {
        println!("skipped: dev-full: there is no /dev/full");
        return;
    }
    let place = CalibrationFolder::new();
    folder(&place.path("shots"), &pictures(&scene(), 10));
    for name in ["report.html", "views.png"] {
        fs::create_dir(place.path("camera-report")).unwrap();
        std::os::unix::fs::symlink("/dev/full", place.path(&format!("camera-report/{name}.part"))).unwrap();
        let done = place.calibrate(&format!("shots --board {BOARD} -o camera.yaml --model brown4"));
        let outcome = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.code() == Some(3) && outcome.contains("No space left on device"), "{outcome}");
        assert!(!place.path("camera.yaml").exists());
        assert!(names(&place.path("camera-report")).iter().all(|name| !name.ends_with(".part")));
        fs::remove_dir_all(place.path("camera-report")).unwrap();
    }
}

#[test]
#[cfg(unix)]
fn a_disk_without_space_is_reported_before_calibrating() {
    let place = CalibrationFolder::new();
    folder(&place.path("shots"), &pictures(&scene(), 3));
    // Each file that is written may have 64 blocks of 512 or 1024 bytes.
    let limited = format!("ulimit -f 64; exec \"$0\" calibrate shots --board {BOARD} -o camera.yaml");
    let mut command = Command::new("sh");
    command.args(["-c", &limited, env!("CARGO_BIN_EXE_odograph")]).current_dir(place.temporary.path());
    let done = command.output().unwrap();
    let told = String::from_utf8(done.stderr).unwrap();
    // Of three alike pictures it would say that they are too few.
    assert!(done.status.code() == Some(3) && told.contains("camera.yaml cannot be written"), "{told}");
    assert_eq!(names(place.temporary.path()), ["shots"]);
}

#[test]
#[cfg(unix)]
fn an_interrupt_calibrates_with_the_views_so_far() {
    for threads in ["1", "3"] {
        let place = CalibrationFolder::new();
        let frames = held(&pictures(&scene(), 15), 2);
        let stream = y4m(&frames);
        let header = y4m(&[]).len();
        let mut child = place
            .command(&format!("- --board {BOARD} -o camera.yaml --model brown4 --threads {threads}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut input = child.stdin.take().unwrap();
        input.write_all(&stream).unwrap();
        // The pipe holds less than all frames, so most have been read by now.
        let sent = Command::new("sh").args(["-c", &format!("kill -INT {}", child.id())]).status().unwrap();
        assert!(sent.success());
        // The interrupt is checked between frames, so the stream stays open until the program ends.
        while child.try_wait().unwrap().is_none() && input.write_all(&stream[header..]).is_ok() {}
        drop(input);
        let done = child.wait_with_output().unwrap();
        let outcome = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(outcome.contains("warning: interrupted: only the first"), "{outcome}");
        assert_calibrated(&place, "camera", &done);
    }
}

#[test]
fn a_bent_board_is_offered_with_its_bend_estimated() {
    let place = CalibrationFolder::new();
    let scene = scene();
    let poses = scene.poses(14, Framing::Whole, 3);
    let shown: Vec<GrayImage> = poses.iter().map(|pose| bent(&scene, &camera(), pose, 0.006)).collect();
    folder(&place.path("shots"), &shown);
    let usual = format!("shots --board {BOARD} -o camera.yaml --model brown4");
    let done = place.calibrate(&usual);
    let said = String::from_utf8(done.stdout).unwrap();
    let offer = said.lines().find(|line| line.starts_with("With the board's bend estimated: "));
    let offer = offer.unwrap_or_else(|| panic!("{said}"));
    assert!(offer.contains("camera-report/bent-board.yaml") && offer.contains("--bent-board"), "{offer}");
    let bent_file = fs::read_to_string(place.path("camera-report/bent-board.yaml")).unwrap();
    assert!(bent_file.contains("bend_x"));
    // One expected error: that of the file is what terminal and page have.
    let file = fs::read_to_string(place.path("camera.yaml")).unwrap();
    let stated = file.lines().find_map(|line| line.strip_prefix("expected_error_px: ")).unwrap();
    let stated = odograph_report::calibration::pixels_text(stated.parse().unwrap());
    assert!(said.contains(&format!("expected error of a ray {stated}")), "{stated} {said}");
    let page = fs::read_to_string(place.path("camera-report/report.html")).unwrap();
    assert!(page.contains(&format!("<em>Expected error of a ray</em><b>{stated}</b>")), "{stated}");
    assert!(page.contains("href=\"bent-board.yaml\""));
    // The bend estimated is what the option makes the result.
    let figures = place.calibrate(&format!("{usual} --force --json"));
    let figures: serde_json::Value = serde_json::from_slice(&figures.stdout).unwrap();
    let asked = place.calibrate(&format!("{usual} --force --json --bent-board"));
    let asked: serde_json::Value = serde_json::from_slice(&asked.stdout).unwrap();
    assert_eq!(figures["bent_board"]["rms_px"], asked["rms_px"]);
    assert!(asked["rms_px"].as_f64().unwrap() < 0.9 * figures["rms_px"].as_f64().unwrap(), "{figures}");
    assert!(asked["bent_board"].is_null() && !place.path("camera-report/bent-board.yaml").exists());
}

/// The folder of real recordings, if it exists.
fn data() -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::var_os("ODOGRAPH_DATA").map_or_else(beside, PathBuf::from);
    folder.is_dir().then_some(folder)
}

/// The calibration images of OpenCV: every board is detected, with a smaller error than OpenCV's
/// own (0.1954 and 0.2070 px with the same lens model, corners refined in windows of 11x11 pixels).
/// Two detectors locate corners differently, so the results may differ by two of OpenCV's standard
/// deviations (0.44 to 0.53 px).
#[test]
fn opencv_images_calibrate_as_well_as_with_opencv() {
    let Some(folder) = data().map(|data| data.join("calib_opencv")).filter(|folder| folder.is_dir()) else {
        println!("skipped: data: no folder calib_opencv in ODOGRAPH_DATA");
        return;
    };
    let place = CalibrationFolder::new();
    for (name, rms_px, focal_px, principal_px) in [
        ("left", 0.1954, (532.83, 532.95), (342.49, 233.86)),
        ("right", 0.2070, (537.45, 536.97), (327.59, 248.88)),
    ] {
        let pictures: Vec<String> = (1..15)
            .filter(|number| *number != 10)
            .map(|number| folder.join(format!("{name}{number:02}.jpg")).display().to_string())
            .collect();
        let output = format!("{name}.yaml");
        let mut command = place.command("--board chessboard:9x6:25mm --model brown5 --json -o");
        let done = command.arg(&output).args(&pictures).output().unwrap();
        // The image corners were never covered by the board, so either verdict is possible.
        assert!(matches!(done.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&done.stderr));
        let figures: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
        assert_eq!(figures["views_used"], 13, "{figures}");
        let rms = figures["rms_px"].as_f64().unwrap();
        assert!(rms < 1.01 * rms_px, "{name}: {rms} px");
        let camera = camera_file::parse(&fs::read_to_string(place.path(&output)).unwrap(), None).unwrap();
        let near = |a: (f64, f64), b: (f64, f64)| (a.0 - b.0).abs() < 1.0 && (a.1 - b.1).abs() < 1.0;
        assert!(near(camera.focal_px(), focal_px) && near(camera.principal_px(), principal_px), "{camera:?}");
    }
}

/// Wide-angle images whose corners no board has reached. The rational model predicts views best, by
/// 2 %, and its radius has a maximum at 74°, short of the corners.
#[test]
fn a_lens_model_without_rays_in_the_corners_is_not_chosen() {
    let Some(folder) = data().map(|data| data.join("calib_carnd_wide")).filter(|folder| folder.is_dir())
    else {
        println!("skipped: data: no folder calib_carnd_wide in ODOGRAPH_DATA");
        return;
    };
    let place = CalibrationFolder::new();
    let pictures = folder.join("calibration_wide").display().to_string();
    let mut command = place.command("--board chessboard:8x6:25mm --json -o camera.yaml");
    let done = command.arg(pictures).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let camera = camera_file::parse(&fs::read_to_string(place.path("camera.yaml")).unwrap(), None).unwrap();
    for (x, y) in [(0.0, 0.0), (1279.0, 0.0), (0.0, 959.0), (1279.0, 959.0)] {
        assert!(camera.ray_from_pixel(Pixel::new(x, y)).is_some(), "{x}, {y}: {camera:?}");
    }
}

/// A live camera simulated by the test: Y4M on standard input, and the messages to the page.
#[test]
fn live_calibration_guides_until_the_result_is_good() {
    let place = CalibrationFolder::new();
    // The name contains a space, which the page must encode in the URL.
    let mut command =
        place.command(&format!("--live - --board {BOARD} --model brown4 --serve 127.0.0.1:0 -o"));
    let mut camera = watching::WatchedCamera::start(command.arg("my camera.yaml"), (320, 240));
    let pictures = pictures(&scene(), 40);
    let outcome = camera.hold(&pictures[0]);
    assert!(outcome["why"].is_null() && outcome["with_board"] == 1 && outcome["looked_at"] == 2, "{outcome}");
    pictures[1..6].iter().for_each(|picture| drop(camera.hold(picture)));
    let mut outcome = camera.guided(&pictures[6]);
    let missing = |outcome: &serde_json::Value| outcome["missing"].as_array().unwrap().len();
    assert!(missing(&outcome) > 0 && outcome["views"].as_u64().unwrap() > 2, "{outcome}");
    let mut browser = browser::Browser::start()
        .map_err(|why| println!("skipped: chromium: no look at the page: {why}"))
        .ok();
    let page = browser.as_mut().map(|browser| browser.open(&camera.url, (1280, 800), false));
    if let (Some(browser), Some(page)) = (&mut browser, &page) {
        browser.wait(page, "document.body.dataset.views > 2");
        camera.hold(&pictures[6]);
        browser.wait(page, "document.body.dataset.pictures > 0");
        let hint = browser.evaluate(page, "document.querySelector('#missing li').textContent");
        assert_eq!(hint, outcome["missing"][0]);
        browser.picture(page, "calibrate-desktop-light");
        browser.look(page, (390, 844), true);
        browser
            .evaluate(page, "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))");
        browser.picture(page, "calibrate-phone-dark");
        browser.look(page, (1280, 800), false);
    }
    for picture in &pictures[7..] {
        outcome = camera.hold_still(picture);
    }
    // It ends by itself with nothing missing, independent of the duration.
    let outcome = camera.until_it_ends(outcome, &pictures[39]);
    assert_eq!((&outcome["verdict"], missing(&outcome)), (&"good".into(), 0), "{outcome}");
    if let (Some(browser), Some(page)) = (&mut browser, &page) {
        browser
            .wait(page, "document.body.dataset.verdict == 'good' && document.body.dataset.phase == 'saved'");
        let download = "[...document.querySelectorAll('#downloads a')].map(link => link.href).filter(link => link.endsWith('.yaml'))[0]";
        browser.wait(page, download);
        let text = browser.evaluate(page, &format!("fetch({download}).then(answer => answer.text())"));
        assert_eq!(text.as_str().unwrap().as_bytes(), fs::read(place.path("my camera.yaml")).unwrap());
        browser.picture(page, "calibrated-desktop-light");
    }
    drop(browser);
    let done = camera.end();
    fs::rename(place.path("my camera.yaml"), place.path("camera.yaml")).unwrap();
    fs::rename(place.path("my camera-report"), place.path("camera-report")).unwrap();
    assert_calibrated(&place, "camera", &done);
}

#[test]
fn wrong_live_usage_is_refused_with_a_message() {
    let place = CalibrationFolder::new();
    fs::write(place.path("board.y4m"), y4m(&pictures(&scene(), 4))).unwrap();
    place.refused(&format!("board.y4m --board {BOARD} -o a.yaml --serve"), 2, &["--live"]);
    place.refused(&format!("board.y4m --board {BOARD} -o a.yaml --size 640x480"), 2, &["--live"]);
    place.refused(&format!("--live board.y4m more.y4m --board {BOARD} -o a.yaml"), 2, &["more.y4m"]);
    place.refused(&format!("--live /dev/video99 --board {BOARD} -o a.yaml"), 3, &["/dev/video99"]);
    // Another board than the one in front of the camera.
    place.refused(
        "--live board.y4m --board chessboard:9x6:25mm -o a.yaml -q",
        3,
        &["was not found in any of 4 frames"],
    );
}

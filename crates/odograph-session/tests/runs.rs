//! Runs as a program that uses the library has them.

#![allow(clippy::unwrap_used)] // a test fails by panicking

mod clip;

use odograph::error::{ErrorKind, Result};
use odograph::formats::trajectory_file::parse_tum;
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::{FrameEstimate, FrameSummary};
use odograph_map::MapFile;
use odograph_session::{MapUse, Observer, ReportInput, RunBuilder, RunEnd, RunReporter, SourcePlan};
use std::error::Error;
use std::fs;
use std::io;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Notes what it hears, and asks to stop after some frames.
#[derive(Default)]
struct Listening {
    heard: Mutex<Vec<String>>,
    frames: AtomicU64,
    finals: Mutex<Vec<FrameSummary>>,
    stops_after: Option<u64>,
}

impl Observer for Listening {
    fn tracking_again(&self, why: &str) {
        self.heard.lock().unwrap().push(why.to_owned());
    }

    fn tracking_begins(&self, frames: Option<u64>) {
        self.heard.lock().unwrap().push(format!("begins {}", frames.is_some()));
    }

    fn frame(&self, _: &FrameEstimate) {
        self.frames.fetch_add(1, Ordering::Relaxed);
    }

    fn tracking_ends(&self) {
        self.heard.lock().unwrap().push("ends".to_owned());
    }

    fn final_frame(&self, estimate: &FrameEstimate, _: &PoseFrame) {
        self.finals.lock().unwrap().push(estimate.into());
    }

    fn warn(&self, sentence: &str) {
        self.heard.lock().unwrap().push(sentence.to_owned());
    }

    fn is_stop_asked(&self) -> bool {
        self.stops_after.is_some_and(|stops_after| self.frames.load(Ordering::Relaxed) >= stops_after)
    }
}

/// Writes how many frames it was shown.
struct CountingReporter;

impl RunReporter for CountingReporter {
    fn map_png(&self, svg: &str) -> Result<Vec<u8>> {
        Ok(svg.as_bytes()[..4].to_vec())
    }

    fn page(&self, contents: &ReportInput<'_>) -> String {
        format!("{} frames of {}", contents.frames.len(), contents.title)
    }
}

#[test]
fn the_deviation_of_a_measured_height_is_one_of_the_path() {
    let folder = tempfile::tempdir().unwrap();
    let given = fs::read_to_string(clip::input("rig.toml")).unwrap();
    let rig = folder.path().join("rig.toml");
    let end = |deviation: &str| {
        fs::write(&rig, format!("{given}\nheight_deviation_m = {deviation}\n")).unwrap();
        let outcome = clip::run(40).rig_file(&rig).run(&Listening::default())?;
        Ok::<_, odograph::error::Error>(outcome.trajectory.last().unwrap().place.unwrap())
    };
    let (exact, measured) = (end("0").unwrap(), end("0.009").unwrap());
    assert_eq!((exact.x_m, exact.y_m), (measured.x_m, measured.y_m));
    let scale = 0.009 / exact.height_m;
    let added_m2 = measured.position_covariance[0] - exact.position_covariance[0];
    assert!((added_m2.sqrt() / (scale * exact.x_m.abs()) - 1.0).abs() < 0.01, "{exact:?} {measured:?}");
    let refused = end("-0.009").unwrap_err().to_string();
    assert!(refused.contains("rig.toml") && refused.contains("negative"), "{refused}");
}

#[test]
fn a_run_returns_what_it_writes_and_reports_progress() {
    let folder = tempfile::tempdir().unwrap();
    let observer = Listening::default();
    let outcome = clip::run(40).folder(folder.path()).run(&observer).unwrap();
    assert_eq!(outcome.end, RunEnd::Completed);
    assert_eq!((outcome.trajectory.len(), outcome.statistics.frames), (40, 40));
    assert_eq!(observer.frames.into_inner(), 40);
    assert_eq!(observer.heard.into_inner().unwrap(), ["begins true", "ends"]);
    assert_eq!(observer.finals.into_inner().unwrap(), outcome.trajectory);
    let text = fs::read_to_string(folder.path().join("trajectory.tum")).unwrap();
    let poses = parse_tum(&text).unwrap().poses;
    let places: Vec<_> = outcome.trajectory.iter().filter_map(|frame| frame.place).collect();
    assert_eq!(poses.len(), places.len());
    for (pose, place) in poses.iter().zip(&places) {
        let written = pose.world_from_camera.translation;
        assert!((written.x - place.x_m).hypot(written.y - place.y_m) < 1e-5);
    }
    // Everything that is there was named, and nothing else.
    let mut there: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|file| file.unwrap().path()).collect();
    let mut written = outcome.written;
    there.sort();
    written.sort();
    assert_eq!(there, written);
    assert!(!written.contains(&folder.path().join("report.html")));
}

#[test]
fn a_recording_that_is_tracked_again_says_why() {
    let observer = Listening::default();
    // The mount is tilted, and its height alone is given.
    let outcome = clip::run(122).height_m(0.9).run(&observer).unwrap();
    assert!(outcome.statistics.mount.is_some());
    let heard = observer.heard.into_inner().unwrap();
    assert_eq!(heard, ["begins true", "again, with the camera as found", "begins true", "ends"]);
}

#[test]
fn a_run_that_is_asked_to_stop_has_written_what_there_is() {
    let folder = tempfile::tempdir().unwrap();
    let observer = Listening { stops_after: Some(10), ..Listening::default() };
    let outcome = clip::run(200).threads(1).folder(folder.path()).run(&observer).unwrap();
    assert_eq!(outcome.end, RunEnd::Interrupted);
    assert_eq!(outcome.trajectory.len(), 10);
    assert!(folder.path().join("stats.json").exists());
    // It has ended, and is not complete.
    let refused = RunBuilder::resuming(folder.path()).unwrap_err().to_string();
    assert!(refused.contains("was interrupted, which cannot be continued; odograph run"), "{refused}");
}

#[test]
fn a_reporter_makes_the_page_and_its_files_go_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let run = clip::run(5).folder(folder.path());
    run.clone().reporter(CountingReporter).run(&()).unwrap();
    let text = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();
    assert_eq!(text("report.html"), "5 frames of drive.mp4");
    assert_eq!(text("map.png"), "<svg");
    assert_eq!(run.run(&()).unwrap_err().kind(), ErrorKind::Usage);
    // Those of an earlier run would show another path.
    run.overwriting(true).run(&()).unwrap();
    assert!(!folder.path().join("report.html").exists() && !folder.path().join("map.png").exists());
}

#[test]
fn a_run_repeated_by_its_run_toml_writes_the_same_trajectory() {
    let place = tempfile::tempdir().unwrap();
    let (first, second) = (place.path().join("first"), place.path().join("second"));
    clip::run(40).folder(&first).run(&()).unwrap();
    let run_toml = first.join("run.toml").display().to_string();
    RunBuilder::repeating(run_toml).folder(&second).threads(1).run(&()).unwrap();
    for name in ["trajectory.csv", "odometry.tum", "run.toml", "map.svg"] {
        assert_eq!(fs::read(first.join(name)).unwrap(), fs::read(second.join(name)).unwrap(), "{name}");
    }
}

#[test]
fn a_picture_is_found_in_a_map_that_stays_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    clip::run(40).folder(folder.path()).run(&()).unwrap();
    let map = folder.path().join("map.gpkg");
    let before = fs::read(&map).unwrap();
    let outcome = RunBuilder::localizing(clip::source(1), &map).run(&()).unwrap();
    let place = outcome.place.unwrap();
    assert!(place.x_m.hypot(place.y_m) < 0.01, "{place:?}");
    assert_eq!(fs::read(&map).unwrap(), before);
    // Without a folder the results were in a temporary one, and nobody would have seen pictures.
    assert!(!outcome.folder.exists());
    let is_written = |name: &str| outcome.written.contains(&outcome.folder.join(name));
    assert!(is_written("trajectory.csv") && !is_written("mosaic.png") && !is_written("map.svg"));
    let seen = folder.path().join("seen");
    let outcome = RunBuilder::localizing(clip::source(1), &map).folder(&seen).run(&()).unwrap();
    assert!(outcome.written.contains(&seen.join("mosaic.png")) && seen.join("map.svg").exists());
    let observer = Listening::default();
    let continued = clip::run(40).map(MapUse::Continue(map.clone())).run(&observer).unwrap();
    assert!(continued.place.is_some());
    assert_eq!(continued.written.last(), Some(&map));
    // The frames of the examination are heard of like those of the run.
    let heard = observer.heard.into_inner().unwrap();
    assert_eq!(heard[..3], ["examining the beginning", "begins false", "begins true"], "{heard:?}");
    assert!((41..=80).contains(&observer.frames.into_inner()));
}

#[test]
fn a_wrong_height_in_a_map_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    clip::run(120).folder(folder.path()).run(&()).unwrap();
    let map = folder.path().join("map.gpkg");
    let rig = |height_m: f64| {
        let path = folder.path().join(format!("{height_m}.toml"));
        fs::write(&path, format!("height_m = {height_m}\nroll_deg = 1.5\npitch_deg = -3\n")).unwrap();
        path
    };
    let warning = |run: RunBuilder| {
        let outcome = run.run(&()).unwrap();
        assert!(outcome.place.is_some());
        outcome.warnings.into_iter().find(|warning| warning.contains("check height and focal length"))
    };
    for (height_m, is_warned) in [(0.9, false), (0.93, true), (0.87, true)] {
        let found = warning(RunBuilder::localizing(clip::source(120), &map).rig_file(rig(height_m)));
        assert_eq!(found.is_some(), is_warned, "{height_m}: {found:?}");
        assert!(found.is_none_or(|found| found.contains("the camera was 0.90")), "{height_m}");
    }
    let continued = clip::run(120).rig_file(rig(0.93)).map(MapUse::Continue(map));
    assert!(warning(continued).is_some());
}

#[test]
fn one_recognised_place_is_enough_for_the_warning() {
    let folder = tempfile::tempdir().unwrap();
    // The map has a single keyframe.
    clip::run(4).folder(folder.path()).run(&()).unwrap();
    let map = folder.path().join("map.gpkg");
    let keyframes = MapFile::open_read_only(&map).unwrap().map().unwrap().keyframes.len();
    assert_eq!(keyframes, 1);
    for (height_m, is_warned) in [(0.9, false), (0.905, false), (0.95, true), (0.86, true)] {
        let rig = folder.path().join("rig.toml");
        fs::write(&rig, format!("height_m = {height_m}\nroll_deg = 1.5\npitch_deg = -3\n")).unwrap();
        let outcome = RunBuilder::localizing(clip::source(1), &map).rig_file(rig).run(&()).unwrap();
        assert!(outcome.place.is_some());
        let found = outcome.warnings.iter().find(|warning| warning.contains("check height and focal length"));
        assert_eq!(found.is_some(), is_warned, "{height_m}: {found:?}");
        assert!(found.is_none_or(|found| found.contains("the camera was 0.90")), "{height_m}: {found:?}");
    }
}

#[test]
fn a_run_that_is_stopped_at_once_leaves_no_session_in_a_map() {
    let folder = tempfile::tempdir().unwrap();
    clip::run(40).folder(folder.path()).run(&()).unwrap();
    let map = folder.path().join("map.gpkg");
    let stopping = Listening { stops_after: Some(1), ..Listening::default() };
    let outcome = clip::run(40).map(MapUse::Continue(map.clone())).run(&stopping).unwrap();
    assert_eq!((outcome.end, outcome.statistics.frames), (RunEnd::Interrupted, 0));
    assert_eq!(odograph_map::MapFile::open_read_only(&map).unwrap().sessions().unwrap().len(), 1);
}

#[test]
fn errors_say_what_to_do_and_have_their_cause() {
    let error = RunBuilder::over(clip::source(5)).run(&()).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Usage);
    assert!(error.source().is_none());
    let error = clip::run(5).camera_file("no such file.yaml").run(&()).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Input);
    let cause = error.source().and_then(|cause| cause.downcast_ref::<io::Error>()).unwrap();
    assert_eq!(cause.kind(), io::ErrorKind::NotFound);
    let source = SourcePlan::new("no such recording.mp4");
    let missing = RunBuilder::over(source).height_m(1.0).field_of_view_m(1.0, 0.75).run(&()).unwrap_err();
    assert!(missing.to_string().contains("no such recording.mp4"), "{missing}");
}

#[test]
fn a_reference_without_times_is_refused_before_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("truth.kitti");
    std::fs::write(&path, "1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(5)).unwrap();
    let error = clip::run(5).reference(&path).run(&()).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Input);
    let error = error.to_string();
    assert!(error.contains("truth.kitti has no times") && error.contains("TUM's format"), "{error}");
}

#[test]
fn a_field_of_view_with_its_sides_exchanged_is_questioned() {
    let observer = Listening::default();
    drop(RunBuilder::over(clip::source(5)).field_of_view_m(0.9, 1.2).open(&observer).unwrap());
    let heard = observer.heard.into_inner().unwrap();
    assert!(heard.len() == 1 && heard[0].contains("probably exchanged: 1.2x0.9"), "{heard:?}");
}

#[test]
fn a_doubtful_height_in_a_rig_file_is_questioned() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    fs::write(&rig, "height_m = 90\n").unwrap();
    let observer = Listening::default();
    drop(clip::run(5).rig_file(&rig).open(&observer).unwrap());
    let heard = observer.heard.into_inner().unwrap();
    assert!(heard.len() == 1 && heard[0].contains("are centimetres meant?"), "{heard:?}");
}

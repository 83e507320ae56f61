//! Live runs as a program that uses the library has them.

#![cfg(feature = "live")]
#![allow(clippy::unwrap_used)] // a test fails by panicking

mod clip;

use odograph::error::{Error, Result};
use odograph::filter::fusion::{Quantity, SensorRecord, Sensors};
use odograph::trajectory::FrameEstimate;
use odograph_live::capture::{Captured, LiveSource, Policy};
use odograph_session::live::{CaptureOptions, LiveFrame, LiveInput, LiveOptions, PoseSink, open_live_input};
use odograph_session::{Observer, ReportInput, RunEnd, RunReporter};
use odograph_video::SourceInfo;
use std::fs;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Keeps the numbers of the frames, and fails at one of them.
#[derive(Default)]
struct Numbers {
    frames: Vec<u64>,
    fails_at: Option<u64>,
}

impl PoseSink for Numbers {
    fn take(&mut self, frame: &LiveFrame<'_>) -> Result<()> {
        assert!(frame.latency_ms >= 0.0);
        let number = frame.estimate.frame;
        self.frames.push(number);
        match self.fails_at == Some(number) {
            true => Err(Error::output("the robot is away")),
            false => Ok(()),
        }
    }
}

/// The first frames of the clip, which is not a live source's to choose: a hub ends the run.
#[test]
fn poses_reach_a_sink_as_they_come_and_a_hub_can_end_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let run = clip::run(30).folder(folder.path()).open_live(&LiveOptions::default(), &()).unwrap();
    assert_eq!(run.hub().introduction().title, "drive.mp4");
    run.hub().ask_to_stop();
    let mut sink = Numbers::default();
    let error = run.follow(Some(&mut sink), &());
    // Asked to stop before the first frame, it has none.
    assert!(sink.frames.is_empty());
    assert!(error.is_ok_and(|outcome| outcome.trajectory.is_empty()));
}

#[test]
fn a_live_run_over_a_recording_gives_the_odometry_of_a_run() {
    let place = tempfile::tempdir().unwrap();
    let (recorded, live) = (place.path().join("recorded"), place.path().join("live"));
    clip::run(30).folder(&recorded).run(&()).unwrap();
    let mut sink = Numbers::default();
    let run = clip::run(30).folder(&live).open_live(&LiveOptions::default(), &()).unwrap();
    let outcome = run.follow(Some(&mut sink), &()).unwrap();
    assert_eq!(outcome.end, RunEnd::Completed);
    assert_eq!(sink.frames, (0..30).collect::<Vec<u64>>());
    let odometry = |folder: &std::path::Path| fs::read(folder.join("odometry.tum")).unwrap();
    assert_eq!(odometry(&recorded), odometry(&live));
}

/// Asks to stop after ten frames.
#[derive(Default)]
struct Impatient(AtomicU64);

impl Observer for Impatient {
    fn frame(&self, _: &FrameEstimate) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    fn is_stop_asked(&self) -> bool {
        self.0.load(Ordering::Relaxed) >= 10
    }
}

/// Writes how far the run got.
struct HowFar;

impl RunReporter for HowFar {
    fn map_png(&self, _: &str) -> Result<Vec<u8>> {
        Ok(Vec::new())
    }

    fn page(&self, contents: &ReportInput<'_>) -> String {
        assert!(contents.files.contains(&"odometry.tum") && contents.files.contains(&"map.gpkg"));
        contents.interruption.unwrap_or("whole").to_owned()
    }
}

#[test]
fn a_live_run_that_is_stopped_before_its_recording_ends_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let page = || fs::read_to_string(folder.path().join("report.html")).unwrap();
    let run = clip::run(200).folder(folder.path()).reporter(HowFar);
    let live = run.clone().open_live(&LiveOptions::default(), &()).unwrap();
    let outcome = live.follow(None, &Impatient::default()).unwrap();
    let early = outcome.statistics.stopped_early().unwrap();
    assert!(early.starts_with(&format!("interrupted after {} of ", outcome.trajectory.len())), "{early}");
    assert_eq!(page(), early);
    // That is how live runs end, and no failure.
    assert_eq!(outcome.end, RunEnd::Completed);
    let live = run.overwriting(true).open_live(&LiveOptions::default(), &()).unwrap();
    assert_eq!(live.follow(None, &()).unwrap().statistics.stopped_early(), None);
    assert_eq!(page(), "whole");
}

const WARNING: &str = "the bumper was touched";

/// A source of the caller, which had no time for three frames and knows how fast the wheel turned.
struct Robot(Box<dyn LiveSource>);

impl LiveSource for Robot {
    fn info(&self) -> &SourceInfo {
        self.0.info()
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        self.0.next_frame()
    }

    fn take_sensors(&mut self) -> Sensors {
        let (times_s, speeds) = (vec![0.0, 0.5, 1.0], vec![0.3; 3]);
        let wheel = SensorRecord::new(Quantity::Speed, times_s, vec![speeds]).unwrap();
        Sensors { wheel: Some(wheel), ..Sensors::default() }
    }

    fn take_warnings(&mut self) -> Vec<String> {
        vec![WARNING.to_owned()]
    }

    fn dropped(&self) -> u64 {
        3
    }
}

#[test]
fn a_source_of_the_caller_has_its_sensors_and_its_drops() {
    let folder = tempfile::tempdir().unwrap();
    let run =
        clip::run(30).folder(folder.path()).open_live_over(&LiveOptions::default(), &(), |plan, watch| {
            let source = open_live_input(plan, &CaptureOptions::default(), || None, watch)?.source;
            Ok(LiveInput { source: Box::new(Robot(source)), policy: Policy::Wait })
        });
    let outcome = run.unwrap().follow(None, &()).unwrap();
    let live = outcome.statistics.live.unwrap();
    assert_eq!((live.frames_captured, live.frames_dropped), (33, 3));
    assert_eq!(outcome.statistics.sensors.len(), 1);
}

#[test]
fn a_sink_that_fails_ends_the_run_with_its_results_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut sink = Numbers { fails_at: Some(12), ..Numbers::default() };
    let run = clip::run(30).folder(folder.path()).open_live(&LiveOptions::default(), &()).unwrap();
    let error = run.follow(Some(&mut sink), &()).unwrap_err();
    assert_eq!(error.to_string(), "the robot is away");
    assert_eq!(sink.frames.last(), Some(&12));
    assert!(folder.path().join("trajectory.tum").exists());
}

/// Keeps what it is warned of.
#[derive(Default)]
struct Warned(Mutex<Vec<String>>);

impl Observer for Warned {
    fn warn(&self, sentence: &str) {
        self.0.lock().unwrap().push(sentence.to_owned());
    }
}

#[test]
fn warnings_of_a_live_run_that_fails_are_told_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let mut sink = Numbers { fails_at: Some(12), ..Numbers::default() };
    let warned = Warned::default();
    let run =
        clip::run(30).folder(folder.path()).open_live_over(&LiveOptions::default(), &(), |plan, watch| {
            let source = open_live_input(plan, &CaptureOptions::default(), || None, watch)?.source;
            Ok(LiveInput { source: Box::new(Robot(source)), policy: Policy::Wait })
        });
    let error = run.unwrap().follow(Some(&mut sink), &warned).unwrap_err();
    assert_eq!(error.to_string(), "the robot is away");
    let warned = warned.0.into_inner().unwrap();
    assert!(warned.iter().any(|warning| warning == WARNING), "{warned:?}");
    // What the error says itself is not told twice.
    assert!(warned.iter().all(|warning| !warning.contains("the robot is away")), "{warned:?}");
    let kept = fs::read_to_string(folder.path().join("stats.json")).unwrap();
    assert!(
        kept.contains(WARNING) && kept.contains("the recording ended early: the robot is away"),
        "{kept}"
    );
}

//! `odograph calibrate --live`: calibrates with a live camera and a page that says what to show
//! next, until the result is good.

use super::search::{Gathering, look};
use super::{
    CalibrateArguments, CalibrationResult, SearchedSource, conclude, input::SearchedImage,
    output::CalibrationOutput,
};
use crate::commands::live::{Offer, Serving};
use crate::report::calibration::pixels_text;
use crate::{Outcome, interrupt};
use odograph::error::{Error, ErrorKind, Result};
use odograph::image::GrayImage;
use odograph::mosaic::Mosaic;
use odograph::numerics::median;
use odograph::odometry::TrackView;
use odograph_calibration::selection::{Guidance, MIN_VIEWS, SelectionConfig, ViewCoverage, ViewSelector};
use odograph_calibration::{Board, BoardFinder, BoardView, Calibration, CalibrationConfig, Verdict};
use odograph_live::capture::{Captured, Newest, Taken, Watch, without_credentials};
use odograph_live::{Hub, Introduction, Phase, Status, View};
use odograph_session::SourcePlan;
use odograph_session::live::{
    FAREWELL, FRAMES_WAITING, LiveInput, PATIENCE, STATUS_EVERY, capture, open_live_input,
};
use odograph_video::SourceInfo;
use serde_json::json;
use std::path::Path;
use std::sync::{Arc, Mutex, mpsc};
use std::thread;
use std::time::{Duration, Instant};

/// Interval of the search for what is missing, which costs about as much as a frame.
const GUIDED_EVERY: Duration = Duration::from_millis(300);
/// Number of new views after which a trial that was not good is repeated.
const VIEWS_UNTIL_NEXT_TRIAL: usize = 4;

/// Whether arguments were given that require `--live`.
pub fn is_asked(arguments: &CalibrateArguments) -> Result<bool> {
    let asked = arguments.live;
    let only_live =
        !arguments.capture.is_empty() || arguments.serve.serve.is_some() || arguments.serve.token.is_some();
    match (asked, arguments.sources.as_slice()) {
        (false, _) if only_live => Err(Error::usage(
            "--serve and how frames are captured go with --live; without it whole recordings are read",
        )),
        (true, [_, second, ..]) => {
            Err(Error::usage(format!("--live looks through one camera; what is {second}?")))
        }
        _ => arguments.serve.check().map(|()| asked),
    }
}

/// Runs the command.
pub fn calibrate(
    arguments: &CalibrateArguments,
    board: Board,
    output: &CalibrationOutput,
    selection: SelectionConfig,
) -> Result<Outcome> {
    let watch = Watch::default();
    let opened = open(arguments, &watch)?;
    let info = opened.source.info().clone();
    let name = &without_credentials(arguments.sources.first().map_or("", String::as_str));
    let no_ground = Mutex::new(Mosaic::new(Default::default()));
    let hub = Arc::new(Hub::new(introduction(name, &info), Arc::new(no_ground)));
    let serving = Serving::start(&arguments.serve, hub, offer(output))?;
    serving.show_address("", arguments.quiet);
    let started = Instant::now();
    let queue = Arc::new(Newest::new(opened.policy, FRAMES_WAITING));
    let ended = capture(opened.source, Arc::clone(&queue));
    let mut showing = Showing {
        hub: serving.hub(),
        watch: &watch,
        queue: &queue,
        finder: BoardFinder::new(&board),
        board: &board,
        config: arguments.config(),
        gathering: Gathering::new(&board, selection, info.description),
        guidance: None,
        guided: None,
        sent: None,
        trial: TrialCalibration::default(),
        rate: Rate::default(),
    };
    showing.follow();
    watch.end();
    queue.close();
    let farewell = ended.recv_timeout(FAREWELL).unwrap_or_default();
    showing.send_status(Phase::Saving);
    let mut search = showing.gathering.finished();
    search.warnings.extend(farewell.warnings);
    // A lost camera ends the calibration; the views until then may suffice.
    search.warnings.extend(farewell.failure.as_ref().map(ToString::to_string));
    let source = SearchedSource { description: name.to_owned(), searched: started.elapsed() };
    let concluded = conclude(arguments, board, search, selection, source)
        .and_then(|calibrated| output.write(&calibrated).map(|_| calibrated));
    let calibrated = concluded.map_err(|error| {
        serving.set_phase(Phase::Failed, Some(&error));
        serving.linger(arguments.quiet);
        // The loss of the camera takes precedence over a board that was not found.
        farewell.failure.filter(|_| error.kind() == ErrorKind::Input).unwrap_or(error)
    })?;
    send_result(serving.hub(), &calibrated);
    serving.set_phase(Phase::Saved, None);
    let outcome = super::print_summary(arguments, &calibrated, output)?;
    serving.linger(arguments.quiet);
    Ok(outcome)
}

fn introduction(name: &str, info: &SourceInfo) -> Introduction {
    Introduction {
        title: format!("calibration with {}", if name == "-" { "standard input" } else { name }),
        source: info.description.clone(),
        width: info.width,
        height: info.height,
        height_m: 0.0,
        live: true,
        recovered: false,
        calibration: true,
    }
}

fn open(arguments: &CalibrateArguments, watch: &Watch) -> Result<LiveInput> {
    let path = arguments.sources.first().cloned().unwrap_or_default();
    let plan = SourcePlan {
        fps: arguments.capture.fps,
        start_s: arguments.start,
        end_s: arguments.end,
        every: arguments.every,
        topic: arguments.topic.clone(),
        ..SourcePlan::new(path)
    };
    open_live_input(&plan, &arguments.capture.options(), || None, watch)
}

/// The camera files, and the report if it is below the same folder.
fn offer(output: &CalibrationOutput) -> Offer {
    let camera = output.camera_file();
    let folder = match camera.parent() {
        Some(folder) if folder != Path::new("") => folder.to_owned(),
        _ => ".".into(),
    };
    let name = camera.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let below = [output.report_page(), output.bent_board_file()].into_iter().filter_map(|path| {
        let beside = path.strip_prefix(&folder).unwrap_or(&path);
        beside.is_relative().then(|| beside.to_string_lossy().into_owned())
    });
    let files = [name].into_iter().chain(below).collect();
    Offer { folder, files }
}

/// The loop: look for the board, show, say what is missing, try.
struct Showing<'a> {
    hub: &'a Hub,
    watch: &'a Watch,
    queue: &'a Newest<(Captured, Duration)>,
    finder: BoardFinder,
    board: &'a Board,
    config: CalibrationConfig,
    gathering: Gathering,
    guidance: Option<Guidance>,
    guided: Option<Instant>,
    sent: Option<Instant>,
    trial: TrialCalibration,
    rate: Rate,
}

impl Showing<'_> {
    /// Runs until the source ends, a person ends it, or a trial is good.
    fn follow(&mut self) {
        while !interrupt::asked() && !self.hub.stop_asked() && !self.trial.is_good() {
            match self.queue.take(PATIENCE) {
                Taken::Item((captured, _)) => self.look(captured),
                Taken::Nothing => {}
                Taken::End => break,
            }
            self.trial.collect();
            if self.sent.is_none_or(|sent| sent.elapsed() >= STATUS_EVERY) {
                self.sent = Some(Instant::now());
                let waits = self.watch.waiting().is_some();
                self.send_status(if waits { Phase::Waiting } else { Phase::Running });
            }
        }
        self.trial.wait();
    }

    fn look(&mut self, captured: Captured) {
        let Captured { frame, at } = captured;
        let (number, _) = self.gathering.counts();
        let name = format!("frame {} ({:.2} s)", frame.number, frame.time_s);
        let shown = (self.hub.viewers() > 0).then(|| frame.gray.clone());
        let image = frame.gray;
        let looked = look(
            &self.finder,
            SearchedImage { number, name, time_s: Some(frame.time_s), picture: false, image },
        );
        let (points, why) = match looked.view() {
            Ok(view) => (corners(view), None),
            Err(why) => (Vec::new(), Some(why.to_string())),
        };
        let seen = why.is_none();
        self.gathering.add(looked);
        self.rate.add(at);
        if let Some(gray) = shown {
            self.show(number as usize, &gray, &points);
        }
        if seen && self.guided.is_none_or(|guided| guided.elapsed() >= GUIDED_EVERY) {
            self.guide();
        }
        self.send(why);
    }

    fn show(&self, number: usize, gray: &GrayImage, points: &[TrackView]) {
        if let Some(view) = View::new(number, gray, points) {
            self.hub.show_view(view);
        }
    }

    /// Determines what is missing; if nothing is, calibrates.
    fn guide(&mut self) {
        self.guided = Some(Instant::now());
        let selector = self.gathering.selector();
        let guidance = selector.guidance();
        if guidance.missing.is_empty() {
            self.trial.begin(selector, self.board, &self.config);
        }
        self.guidance = Some(guidance);
    }

    fn send(&self, why: Option<String>) {
        let (looked_at, with_board) = self.gathering.counts();
        let coverage = self.guidance.as_ref().map_or(&[][..], |guidance| &guidance.coverage.points);
        let missing: Vec<String> =
            self.guidance.iter().flat_map(|guidance| &guidance.missing).map(ToString::to_string).collect();
        self.hub.notify(
            "calibration",
            &json!({
                "board": self.board.to_string(), "why": why, "looked_at": looked_at, "with_board": with_board,
                "views": self.guidance.as_ref().map_or(0, |guidance| guidance.views),
                "columns": ViewCoverage::COLUMNS, "rows": ViewCoverage::ROWS, "coverage": coverage, "missing": missing,
                "trying": self.trial.runs(), "tried": self.trial.said(), "verdict": null,
            }),
        );
    }

    fn send_status(&mut self, phase: Phase) {
        let (captured, dropped) = self.queue.counts();
        let [fps, latency_median_ms] = self.rate.recent();
        self.hub.set_status(Status {
            phase,
            message: self.watch.waiting(),
            captured,
            dropped,
            fps,
            latency_median_ms,
            latency_p99_ms: latency_median_ms,
            keyframes: 0,
            distance_m: 0.0,
            recording: true,
        });
    }
}

/// The board's points, to be drawn.
fn corners(view: &BoardView) -> Vec<TrackView> {
    view.points.iter().map(|point| TrackView::exact(point.pixel)).collect()
}

fn send_result(hub: &Hub, calibrated: &CalibrationResult) {
    let (calibration, found) = (&calibrated.calibration, &calibrated.search.found);
    let missing: Vec<String> = match calibration.verdict {
        Verdict::Good => Vec::new(),
        _ => calibrated.guidance.missing.iter().map(ToString::to_string).collect(),
    };
    hub.notify(
        "calibration",
        &json!({
            "board": calibrated.board.to_string(), "why": null, "looked_at": found.looked_at, "with_board": found.with_board,
            "views": calibration.views_used(), "columns": ViewCoverage::COLUMNS, "rows": ViewCoverage::ROWS,
            "coverage": calibrated.guidance.coverage.points, "missing": missing, "trying": false,
            "tried": said(calibration), "verdict": calibration.verdict.to_string(),
        }),
    );
}

fn said(calibration: &Calibration) -> String {
    let reason = calibration.reasons.first().map_or_else(String::new, |reason| format!(": {reason}"));
    format!(
        "{}, expected error of a ray {}, {} on views held out{reason}",
        calibration.verdict,
        pixels_text(calibration.expected_error_over_image_px()),
        pixels_text(calibration.hold_out_rms_px)
    )
}

/// Trial calibrations with the views so far, in parallel to the search.
#[derive(Default)]
struct TrialCalibration {
    running: Option<mpsc::Receiver<Result<Calibration>>>,
    /// How many different views the last one had.
    views: usize,
    result: Option<(bool, String)>,
}

impl TrialCalibration {
    fn runs(&self) -> bool {
        self.running.is_some()
    }

    fn is_good(&self) -> bool {
        self.result.as_ref().is_some_and(|(good, _)| *good)
    }

    fn said(&self) -> Option<&str> {
        self.result.as_ref().map(|(_, said)| said.as_str())
    }

    fn begin(&mut self, selector: &ViewSelector, board: &Board, config: &CalibrationConfig) {
        let distinct = selector.distinct();
        if self.runs() || distinct < (self.views + VIEWS_UNTIL_NEXT_TRIAL).max(MIN_VIEWS) {
            return;
        }
        self.views = distinct;
        let views: Vec<BoardView> =
            selector.chosen().into_iter().map(|sighting| sighting.view.clone()).collect();
        let (board, config) = (*board, *config);
        let (done, result) = mpsc::channel();
        thread::spawn(move || {
            // The receiver may be gone.
            let _ = done.send(odograph_calibration::calibrate(&board, &views, &config));
        });
        self.running = Some(result);
    }

    /// Takes the result if it is available.
    fn collect(&mut self) {
        if let Some(result) = self.running.as_ref().and_then(|running| running.try_recv().ok()) {
            self.take(result);
        }
    }

    /// Waits for a running trial: two at a time would slow each other down.
    fn wait(&mut self) {
        if let Some(result) = self.running.as_ref().and_then(|running| running.recv().ok()) {
            self.take(result);
        }
    }

    fn take(&mut self, result: Result<Calibration>) {
        self.running = None;
        self.result = Some(match result {
            Ok(calibration) => (calibration.verdict == Verdict::Good, said(&calibration)),
            Err(error) => (false, error.to_string()),
        });
    }
}

/// Frames a second, and how long a frame takes from capture on, of the last seconds.
#[derive(Default)]
struct Rate(std::collections::VecDeque<(Instant, f64)>);

impl Rate {
    fn add(&mut self, captured: Instant) {
        self.0.push_back((Instant::now(), 1e3 * captured.elapsed().as_secs_f64()));
        while self.0.front().is_some_and(|(at, _)| at.elapsed() > Duration::from_secs(3)) {
            self.0.pop_front();
        }
    }

    fn recent(&self) -> [f64; 2] {
        let Some((first, _)) = self.0.front() else { return [0.0; 2] };
        let mut latencies: Vec<f64> = self.0.iter().map(|(_, ms)| *ms).collect();
        let latency_ms = median(&mut latencies).unwrap_or(0.0);
        [self.0.len() as f64 / first.elapsed().as_secs_f64().max(0.2), latency_ms]
    }
}

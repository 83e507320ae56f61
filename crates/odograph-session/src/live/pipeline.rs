//! The live pipeline capture | track | map and show, on threads. Only tracking is waited for; other
//! stages get what they can handle.

use super::capturing::{FAREWELL, FRAMES_WAITING, Farewell, PATIENCE, STATUS_EVERY, capture};
use super::gnss::LiveGnss;
use super::ground::{LiveGround, MosaicUpdate};
use super::latency::Latencies;
use super::map_frame::{self, MapFrameUpdates};
use super::mcap::McapLog;
use super::mosaic_rendering::MosaicRenderingSummary;
use super::page_layers::{PageLayers, show_results};
use super::recorder::Recorder;
use super::sensors::LiveFusion;
use super::sinks::{LiveFrame, LiveSinks, PoseSink};
use super::source::LiveInput;
use crate::finish::{Ending, finish, give_warnings};
use crate::folder::OutputFolder;
use crate::kept_frames::KeptFrames;
use crate::mapping::Mapping;
use crate::observer::Observer;
use crate::outcome::RunOutcome;
use crate::pipeline::{StageTimes, Tracked, is_made, number_as_source};
use crate::plan::RunPlan;
use crate::recalibrated_odometry::RecalibratedOdometry;
use crate::statistics::LiveStatistics;
use crate::views::{MosaicFrames, Posed};
use odograph::error::{Error, Result};
use odograph::filter::fusion::Sensors;
use odograph::fixed_pattern::ImageMask;
use odograph::geometry::{GroundPose, PlaneTransform, Sim2};
use odograph::image::GrayImage;
use odograph::odometry::{KeyframeEvent, TrackView};
use odograph_live::capture::{Captured, Newest, Policy, Taken, Watch};
use odograph_live::foxglove::TrackedImage;
use odograph_live::{Hub, Phase, Status, TrackRecord, View};
use odograph_video::Frame;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Length of the queue to rendering: longer smooths over a slow frame, but the page shows older
/// ground.
const RENDERING_QUEUE: usize = 4;
/// Length of the queue to the map. No keyframe may be dropped, so tracking waits when the map is
/// this far behind; longer waits later but needs more memory.
const MAPPING_QUEUE: usize = 32;
/// Queue length from which the map of a camera suspends the search for loops and markers until the
/// queue is empty: without it the map is faster than keyframes can come.
const BEHIND: usize = 8;

/// Time for which the page shows what was said about the source or its sensors.
const SENSORS_TOLD: Duration = Duration::from_secs(20);

/// Inputs of the pipeline.
pub struct PipelineInput {
    pub frames: LiveInput,
    pub gnss: LiveGnss,
    pub fusion: LiveFusion,
}

/// Tracks a source until it ends or the run is asked to end, then writes everything.
pub fn follow(
    plan: &RunPlan,
    tracker: RecalibratedOdometry,
    PipelineInput { frames: opened, gnss, fusion }: PipelineInput,
    watch: &Watch,
    ground: &LiveGround,
    hub: &Arc<Hub>,
    mut mapping: Mapping,
    recorder: Recorder,
    sinks: LiveSinks<'_, '_>,
    ending: &Ending<'_>,
) -> Result<RunOutcome> {
    let LiveSinks { poses, log, shown } = sinks;
    let mut following = Following {
        tracker,
        frames: KeptFrames::new(recorder.path()),
        times: StageTimes::default(),
        latencies: Latencies::default(),
        distance_m: 0.0,
        seen_before: None,
        recorder,
        poses,
        observer: ending.observer,
        log,
        hub,
        shown,
        gnss: &gnss,
        fusion,
        told: None,
        watch,
        queue: Arc::new(Newest::new(opened.policy, FRAMES_WAITING)),
        policy: opened.policy,
        not_rendered: 0,
        not_compared: 0,
        unmapped: None,
        status_sent: None,
        layers: PageLayers::default(),
    };
    let whole = plan.source.start_s.is_none() && plan.source.end_s.is_none();
    let announced = opened.source.info().frame_count.filter(|_| whole);
    let ended = capture(opened.source, Arc::clone(&following.queue));
    ending.observer.tracking_begins(None);
    let outcome = following.run(ground, &mut mapping);
    ending.observer.tracking_ends();
    watch.end();
    following.queue.close();
    let Farewell { warnings, failure, sensors: of_source, dropped } =
        ended.recv_timeout(FAREWELL).unwrap_or_default();
    following.send_status(Phase::Saving);
    let rendered = ground.finish().ok_or_else(|| Error::usage("a live run ends once"))?;
    let MosaicRenderingSummary { views, failure: not_kept, times } = rendered;
    following.times.map = times;
    // Also those that were set since tracking ended.
    hub.close_marks();
    following.recorder.record_marks(hub);
    let (received, left_out) = following.fusion.finish();
    let warnings = warnings.into_iter().chain(left_out).chain(log.into_iter().flat_map(McapLog::warnings));
    let warnings = warnings.collect();
    let sensors = Sensors {
        gyro: received.gyro.or(of_source.gyro),
        heading: received.heading.or(of_source.heading),
        wheel: received.wheel.or(of_source.wheel),
        range: received.range.or(of_source.range),
    };
    let failure = outcome.err().or(failure).or(not_kept);
    let (mut tracked, mut folder) = following.end(plan, mapping, views, warnings, dropped, failure);
    tracked.interrupted = ending.observer.is_stop_asked() || hub.stop_asked();
    tracked.announced = announced;
    let (gnss, left_out) = gnss.finish();
    tracked.warnings.extend(left_out);
    let ending = Ending { sensors: &sensors, gnss: gnss.as_ref(), ..*ending };
    let outcome = finish(plan, tracked, &mut folder, &ending)?;
    if shown {
        show_results(hub, ground, folder.path());
    }
    let failure = log.and_then(McapLog::take_failure);
    failure.iter().for_each(|error| give_warnings(&outcome.warnings, error, ending.observer));
    failure.map_or(Ok(outcome), Err)
}

/// Closes the queues of the other threads however tracking ends, so that they end too.
struct Closing<'a>(&'a Beside, Option<&'a McapLog>);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.rendering.close();
        self.0.mapping.close();
        self.0.views.close();
        self.1.inspect(|log| log.close());
    }
}

/// The keyframe event of a frame, and the frame, whose colours the map stores.
struct Happened {
    events: Vec<KeyframeEvent>,
    /// Present if it became a keyframe.
    frame: Option<Frame>,
}

/// The queues to the other threads.
struct Beside {
    rendering: Newest<(Posed, Option<Arc<ImageMask>>)>,
    mapping: Newest<Happened>,
    views: Newest<PageImage>,
    updates: Newest<MosaicUpdate>,
    /// That of the newest keyframe in the map.
    correction: Mutex<Sim2>,
    /// Whether the run is connected to the map that it continues.
    is_recognised: AtomicBool,
}

impl Beside {
    fn map_from_odometry(&self) -> Sim2 {
        *self.correction.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn correct(&self, correction: Sim2) {
        *self.correction.lock().unwrap_or_else(PoisonError::into_inner) = correction;
    }
}

/// An image for the page.
struct PageImage {
    record: usize,
    gray: GrayImage,
    tracks: Vec<TrackView>,
}

/// The tracking stage.
struct Following<'a, 'p> {
    tracker: RecalibratedOdometry,
    frames: KeptFrames,
    times: StageTimes,
    latencies: Latencies,
    distance_m: f64,
    /// Place of the frame before, and its segment.
    seen_before: Option<(GroundPose, usize)>,
    recorder: Recorder,
    poses: Option<&'a mut (dyn PoseSink + 'p)>,
    observer: &'a dyn Observer,
    log: Option<&'a McapLog>,
    hub: &'a Hub,
    /// Whether the path is kept in the hub.
    shown: bool,
    gnss: &'a LiveGnss,
    fusion: LiveFusion,
    /// What was last said about the source or its sensors, and when.
    told: Option<(Instant, String)>,
    watch: &'a Watch,
    queue: Arc<Newest<(Captured, Duration)>>,
    policy: Policy,
    not_rendered: u64,
    not_compared: u64,
    unmapped: Option<Error>,
    status_sent: Option<Instant>,
    layers: PageLayers,
}

impl Following<'_, '_> {
    /// Tracks until the end; an error keeps what was measured.
    fn run(&mut self, ground: &LiveGround, mapping: &mut Mapping) -> Result<()> {
        let beside = Beside {
            rendering: Newest::new(self.policy, RENDERING_QUEUE),
            mapping: Newest::new(Policy::Wait, MAPPING_QUEUE),
            views: Newest::new(Policy::NewestWins, 1),
            updates: Newest::new(Policy::NewestWins, 1),
            correction: Mutex::new(Sim2::IDENTITY),
            is_recognised: AtomicBool::new(mapping.mapper().map().keyframes.is_empty()),
        };
        let (beside, hub, log, policy) = (&beside, self.hub, self.log, self.policy);
        let outcome = thread::scope(|scope| {
            if let Some(log) = log {
                scope.spawn(|| log.write_all());
            }
            scope.spawn(move || each(&beside.rendering, |(posed, mask)| ground.render(posed, mask)));
            scope.spawn(move || {
                each(&beside.views, |sight: PageImage| {
                    if let Some(view) = View::new(sight.record, &sight.gray, &sight.tracks) {
                        hub.show_view(view);
                    }
                });
            });
            scope.spawn(move || map_frame::render_again(&beside.updates, ground));
            let mapper = scope.spawn(move || {
                let (mut failure, mut not_compared) = (None, 0);
                let mut updates = MapFrameUpdates::new(hub, &beside.updates);
                let mut is_suspended = false;
                each(&beside.mapping, |happened: Happened| {
                    let waiting = beside.mapping.waiting();
                    is_suspended =
                        policy == Policy::NewestWins && (waiting >= BEHIND || is_suspended && waiting > 0);
                    let made = |event: &&KeyframeEvent| matches!(event, KeyframeEvent::Made(_));
                    not_compared +=
                        if is_suspended { happened.events.iter().filter(made).count() as u64 } else { 0 };
                    mapping.suspend_search(is_suspended);
                    // A map that cannot be written (full disk) ends; tracking continues.
                    if failure.is_none() {
                        failure = mapping.take(happened.events, happened.frame.as_ref()).err();
                        if let Some(correction) = map_frame::newest_correction(mapping) {
                            beside.correct(correction);
                        }
                        if !beside.is_recognised.load(Ordering::Relaxed) {
                            beside.is_recognised.store(mapping.mapper().is_recognised(), Ordering::Relaxed);
                        }
                        if ground.is_shown() {
                            updates.publish_markers(mapping);
                            updates.publish_if_closed(mapping);
                        }
                    }
                });
                beside.updates.close();
                (failure, not_compared)
            });
            let outcome = {
                let _ending = Closing(beside, log);
                self.track_all(beside)
            };
            let ended = mapper.join();
            (self.unmapped, self.not_compared) =
                ended.unwrap_or_else(|_| (Some(Error::output("the map ended unexpectedly")), 0));
            outcome
        });
        self.not_rendered = beside.rendering.counts().1;
        outcome
    }

    fn track_all(&mut self, beside: &Beside) -> Result<()> {
        while !self.observer.is_stop_asked() && !self.hub.stop_asked() {
            match self.queue.take(PATIENCE) {
                Taken::Item((captured, decoding)) => self.track(captured, decoding, beside)?,
                Taken::Nothing => {}
                Taken::End => break,
            }
            if self.status_sent.is_none_or(|sent| sent.elapsed() >= STATUS_EVERY) {
                self.recorder.record_marks(self.hub);
                self.send_status(if self.watch.waiting().is_some() {
                    Phase::Waiting
                } else {
                    Phase::Running
                });
            }
        }
        self.recorder.record_marks(self.hub);
        Ok(())
    }

    fn track(&mut self, captured: Captured, decoding: Duration, beside: &Beside) -> Result<()> {
        let Captured { frame, at } = captured;
        self.gnss.frame(at, frame.time_s);
        self.fusion.frame(at, frame.time_s);
        let begun = Instant::now();
        let (estimate, mut events) = self.tracker.process(&frame)?;
        let mut reference = self.tracker.odometry.reference();
        let fused = self.fusion.fuse(estimate, &mut events, &mut reference);
        let latency_ms = self.latencies.add(at.elapsed());
        self.times.decode.push(decoding);
        self.times.track.push(begun.elapsed());
        let seen = self.tracker.pose_frames.frame(&fused);
        if let Some(poses) = &mut self.poses {
            let of = self.tracker.pose_frames.at(frame.number);
            let map_from_odometry = beside.map_from_odometry();
            let is_recognised = beside.is_recognised.load(Ordering::Relaxed);
            poses.take(&LiveFrame { estimate: &seen, of, latency_ms, map_from_odometry, is_recognised })?;
        }
        self.observer.frame(&seen);
        self.recorder.record(&seen.measured());
        if let Some(log) = self.log {
            let tracks = || self.tracker.odometry.tracks().to_vec();
            log.give(&seen, self.tracker.pose_frames.at(frame.number), latency_ms, || TrackedImage {
                gray: frame.gray.clone(),
                tracks: tracks(),
            });
        }
        let first_time_s = self.frames.first_time_s().unwrap_or(fused.time_s);
        let keyframe = reference.map(|reference| reference.keyframe.0);
        // Without viewers the path need not be kept in memory.
        if self.shown {
            let record = TrackRecord::new(&seen, first_time_s, Some(latency_ms)).measured_against(keyframe);
            let record = self.hub.add_record(&record);
            if self.hub.viewers() > 0 {
                let tracks = self.tracker.odometry.tracks().to_vec();
                beside.views.give(PageImage { record, gray: frame.gray.clone(), tracks });
            }
        }
        let place = seen.estimate.as_ref().map(|known| (known.pose, seen.segment));
        self.distance_m += self.step_m(place);
        let pose = fused.ground_pose();
        let segment = fused.segment;
        self.frames.push(fused.measured().into_owned(), reference);
        number_as_source(&mut events, |index| self.frames.number_in_source(index));
        let is_keyframe = is_made(&events, frame.number);
        if self.shown && is_keyframe {
            self.layers.show(&self.tracker.odometry, self.hub, &beside.map_from_odometry());
        }
        if !events.is_empty() {
            beside.mapping.give(Happened { events, frame: is_keyframe.then(|| frame.clone()) });
        }
        if let Some(pose) = pose {
            let mask = self.tracker.odometry.mask();
            beside.rendering.give((Posed { frame, pose, segment, is_keyframe }, mask));
        }
        Ok(())
    }

    /// Distance since the previous frame, where both have connected poses, metres.
    fn step_m(&mut self, next: Option<(GroundPose, usize)>) -> f64 {
        match (std::mem::replace(&mut self.seen_before, next), next) {
            (Some((before, segment)), Some((pose, now))) if segment == now => pose.distance_m(&before),
            _ => 0.0,
        }
    }

    fn send_status(&mut self, phase: Phase) {
        self.status_sent = Some(Instant::now());
        for sentence in self.fusion.take_news().into_iter().chain(self.watch.take_notices()) {
            self.observer.warn(&sentence);
            self.told = Some((Instant::now(), sentence));
        }
        self.told.take_if(|(told, _)| told.elapsed() >= SENSORS_TOLD);
        let (fps, latency_median_ms, latency_p99_ms) = self.latencies.recent();
        let (captured, dropped) = self.queue.counts();
        self.hub.set_status(Status {
            phase,
            message: self
                .watch
                .waiting()
                .or_else(|| self.recorder.message())
                .or_else(|| self.log.and_then(McapLog::message))
                .or_else(|| self.told.as_ref().map(|(_, sentence)| sentence.clone())),
            captured,
            dropped,
            fps,
            latency_median_ms,
            latency_p99_ms,
            keyframes: self.tracker.odometry.keyframes(),
            distance_m: self.distance_m,
            recording: self.recorder.is_recording(),
        });
    }

    /// What was tracked, and the folder of its results; `dropped` frames were dropped before they
    /// were captured.
    fn end(
        self,
        plan: &RunPlan,
        mapping: Mapping,
        views: MosaicFrames,
        warnings: Vec<String>,
        dropped: u64,
        failure: Option<Error>,
    ) -> (Tracked, OutputFolder) {
        let live = self.statistics(dropped);
        let (mount, lens) = self.tracker.found(plan);
        let tracked = Tracked {
            marks: self.recorder.report_marks(),
            recalibrated: self.tracker.recalibrated.clone(),
            warnings,
            times: self.times,
            live: Some(live),
            failure,
            unmapped: self.unmapped,
            mount,
            lens,
            ..Tracked::of(plan, &self.tracker.odometry, self.frames, views, mapping)
        };
        (tracked, self.recorder.into_folder())
    }

    /// `dropped` frames were dropped before they were captured.
    fn statistics(&self, dropped: u64) -> LiveStatistics {
        let (taken, displaced) = self.queue.counts();
        let (frames_captured, frames_dropped) = (taken + dropped, displaced + dropped);
        let [latency_median_ms, latency_p99_ms, latency_most_ms] = self.latencies.overall();
        LiveStatistics {
            frames_captured,
            frames_dropped,
            frames_not_laid: self.not_rendered,
            keyframes_not_compared: self.not_compared,
            reconnects: self.watch.reconnects(),
            latency_median_ms,
            latency_p99_ms,
            latency_most_ms,
        }
    }
}

/// Empties a queue until its end.
fn each<T>(queue: &Newest<T>, mut take: impl FnMut(T)) {
    loop {
        match queue.take(Duration::from_secs(1)) {
            Taken::Item(item) => take(item),
            Taken::Nothing => {}
            Taken::End => return,
        }
    }
}

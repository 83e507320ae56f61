//! The pipeline decode | track | map, on threads connected by short queues. The order of frames is
//! kept, so any number of threads gives the same bytes.

use crate::folder::OutputFolder;
use crate::found::{FixedInImage, FoundLens, FoundMount, FoundReadout};
use crate::kept_frames::KeptFrames;
use crate::mapping::Mapping;
use crate::observer::Observer;
use crate::output::RunOutput;
use crate::overlay_video::OverlayVideo;
use crate::plan::RunPlan;
use crate::recalibrated_odometry::RecalibratedOdometry;
use crate::report::{OverlayFrame, ReportMark, RunReporter};
use crate::statistics::LiveStatistics;
use crate::timings::Timings;
use crate::views::{MosaicFrames, Posed};
use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::image::ImageDefects;
use odograph::odometry::{KeyframeEvent, Odometry, TrackView};
use odograph::self_calibration::{CameraDifference, CameraMonitor, PassEnd};
use odograph::trajectory::FrameEstimate;
use odograph_video::{Frame, Source};
use std::path::Path;
use std::sync::mpsc;
use std::thread;
use std::time::Instant;

/// Result of the pipeline.
pub struct Tracked {
    /// Frames, each with its reference.
    pub frames: KeptFrames,
    /// The rig from a frame on, at each recalibration of a source that is read once.
    pub recalibrated: Vec<(u64, Rig)>,
    /// Frames of the mosaic.
    pub views: MosaicFrames,
    pub mapping: Mapping,
    pub keyframes: u64,
    /// Mask of what is static in the image.
    pub fixed: FixedInImage,
    pub warnings: Vec<String>,
    pub times: StageTimes,
    pub interrupted: bool,
    /// Number of frames that the source states.
    pub announced: Option<u64>,
    /// Marks set during a live run.
    pub marks: Vec<ReportMark>,
    /// Drops and latencies of a live run.
    pub live: Option<LiveStatistics>,
    /// The error that ended the recording early, if any.
    pub failure: Option<Error>,
    /// The error that ended mapping early, such as a full disk. The path does not depend on the
    /// map.
    pub unmapped: Option<Error>,
    /// The overlay video that was written, if any: a warning where it does not show the whole run,
    /// or what prevented it.
    pub video: Option<Result<Option<String>>>,
    /// The mount, where it differs from the plan.
    pub mount: Option<FoundMount>,
    /// The lens, where it differs from the plan.
    pub lens: Option<FoundLens>,
    /// The readout time of the image.
    pub readout: Option<FoundReadout>,
    /// What was found to be wrong with the images.
    pub defects: ImageDefects,
}

impl Tracked {
    /// What odometry found by itself, of a recording that was read to its end.
    pub fn of(
        plan: &RunPlan,
        odometry: &Odometry,
        frames: KeptFrames,
        views: MosaicFrames,
        mapping: Mapping,
    ) -> Self {
        Self {
            frames,
            recalibrated: Vec::new(),
            views,
            mapping,
            keyframes: odometry.keyframes(),
            fixed: FixedInImage::of(odometry),
            warnings: Vec::new(),
            times: StageTimes::default(),
            interrupted: false,
            announced: None,
            marks: Vec::new(),
            live: None,
            failure: None,
            unmapped: None,
            video: None,
            mount: None,
            lens: None,
            readout: FoundReadout::of(plan, odometry),
            defects: odometry.image_defects(),
        }
    }
}

/// Processing times of each frame per stage.
#[derive(Debug, Default)]
pub struct StageTimes {
    pub decode: Timings,
    pub track: Timings,
    pub self_calibration: Timings,
    pub map: Timings,
}

/// Length of the queue between two stages: enough to even out a keyframe, which takes as long as
/// decoding ten frames, and short enough to need little memory.
const LONGEST_QUEUE: usize = 24;
const SHORTEST_QUEUE: usize = 4;
/// Largest memory of a queue's frames, gray and colour, bytes.
const QUEUE_BYTES: usize = 12 << 20;

/// Longest queue of a camera's frames.
fn queue(camera: &Camera) -> usize {
    let frame_bytes = 3 * camera.width() * camera.height() / 2;
    (QUEUE_BYTES / frame_bytes.max(1)).clamp(SHORTEST_QUEUE, LONGEST_QUEUE)
}

/// Tracks every frame of the source, or until self-calibration is certain of a different camera.
/// Each frame's result is in the folder within a second of video.
pub fn track(
    plan: &RunPlan,
    source: Source,
    folder: &mut OutputFolder,
    output: &RunOutput,
    reporter: Option<&dyn RunReporter>,
    tracker: RecalibratedOdometry,
    monitor: CameraMonitor,
    observer: &dyn Observer,
) -> Result<PassEnd<Tracked>> {
    let mapping = Mapping::new(plan, folder, output)?;
    let tracker = tracker.expecting(mapping.expected_mask().filter(|_| plan.images.fixed.is_none()));
    let views = MosaicFrames::new(&plan.camera, folder.path());
    let video = output.video.as_ref().map(|path| begin_video(path, &plan.camera, reporter)).transpose()?;
    let mut tracking = TrackingStage {
        shows: video.is_some(),
        tracker,
        frames: KeptFrames::new(folder.path()),
        times: Timings::default(),
        calibration_times: Timings::default(),
        monitor,
        difference: None,
        observer,
        folder,
    };
    observer.tracking_begins(source.info().frame_count);
    let whole = plan.source.start_s.is_none() && plan.source.end_s.is_none();
    let announced = source.info().frame_count.filter(|_| whole);
    let mut decoding = DecodingStage { source, times: Timings::default(), observer };
    let mut ground = MappingStage {
        draws: output.draws(),
        views,
        mapping,
        video,
        unmapped: None,
        times: Timings::default(),
    };
    let outcome = match output.threads() {
        1 => one_by_one(&mut decoding, &mut tracking, &mut ground),
        threads => side_by_side(&mut decoding, &mut tracking, &mut ground, threads, queue(&plan.camera)),
    };
    let to_the_end = outcome.is_ok() && tracking.difference.is_none() && !observer.is_stop_asked();
    let at_end = if to_the_end { tracking.monitor.at_end(&tracking.tracker.odometry) } else { None };
    if let Some(difference) = tracking.difference.or(at_end) {
        ground.mapping.discard()?;
        return Ok(PassEnd::Differs(difference));
    }
    observer.tracking_ends();
    let (mount, lens) = tracking.tracker.found(plan);
    let MappingStage { views, mapping, video, unmapped, times: map_times, .. } = ground;
    // An interrupt after the last frame changes no result.
    let interrupted = observer.is_stop_asked() && announced != Some(tracking.frames.count() as u64);
    Ok(PassEnd::Finished(Tracked {
        warnings: decoding.source.take_warnings(),
        times: StageTimes {
            decode: decoding.times,
            track: tracking.times,
            self_calibration: tracking.calibration_times,
            map: map_times,
        },
        interrupted,
        announced,
        failure: outcome.err(),
        unmapped,
        video: video.map(OverlayVideo::finish),
        mount,
        lens,
        recalibrated: std::mem::take(&mut tracking.tracker.recalibrated),
        ..Tracked::of(plan, &tracking.tracker.odometry, tracking.frames, views, mapping)
    }))
}

/// Begins the overlay video of this camera.
fn begin_video(path: &Path, camera: &Camera, reporter: Option<&dyn RunReporter>) -> Result<OverlayVideo> {
    match reporter.and_then(|reporter| reporter.frame_painter(camera)) {
        Some(painter) => OverlayVideo::new(path, painter),
        None => Err(Error::usage(format!("{} needs a reporter that draws it", path.display()))),
    }
}

/// The three stages in one thread.
fn one_by_one(
    decoding: &mut DecodingStage<'_>,
    tracking: &mut TrackingStage<'_>,
    ground: &mut MappingStage,
) -> Result<()> {
    while let Some(frame) = decoding.next()? {
        match tracking.next(frame)? {
            Some(followed) => ground.next(followed)?,
            None => break,
        }
    }
    Ok(())
}

/// The three stages on two or three threads; with two, tracking and mapping share one.
fn side_by_side(
    decoding: &mut DecodingStage<'_>,
    tracking: &mut TrackingStage<'_>,
    ground: &mut MappingStage,
    threads: usize,
    queue: usize,
) -> Result<()> {
    let (frames_in, frames_out) = mpsc::sync_channel::<Frame>(queue);
    let (followed_in, followed_out) = mpsc::sync_channel::<TrackedFrame>(queue);
    thread::scope(|scope| {
        let decoder = scope.spawn(move || -> Result<()> {
            while let Some(frame) = decoding.next()? {
                if frames_in.send(frame).is_err() {
                    break; // tracking has ended, and says why itself
                }
            }
            Ok(())
        });
        let mut here = None;
        let mapper = if threads > 2 {
            Some(scope.spawn(move || followed_out.iter().try_for_each(|followed| ground.next(followed))))
        } else {
            drop(followed_out);
            here = Some(ground);
            None
        };
        let mut follow = || -> Result<()> {
            for frame in &frames_out {
                let Some(followed) = tracking.next(frame)? else { break };
                match &mut here {
                    Some(ground) => ground.next(followed)?,
                    None if followed_in.send(followed).is_err() => return Err(ended()),
                    None => {}
                }
            }
            Ok(())
        };
        let outcome = follow();
        drop((frames_out, followed_in));
        let died = |_| ended();
        // An error of mapping ended tracking.
        let mapped = mapper.map_or(Ok(Ok(())), |mapper| mapper.join()).map_err(died)?;
        let decoded = decoder.join().map_err(died)?;
        mapped.and(outcome).and(decoded)
    })
}

fn ended() -> Error {
    Error::input("a stage of the pipeline ended unexpectedly; please report this recording")
}

/// Stage one: decodes frames until the end of the source or a request to stop.
struct DecodingStage<'a> {
    source: Source,
    times: Timings,
    observer: &'a dyn Observer,
}

impl DecodingStage<'_> {
    fn next(&mut self) -> Result<Option<Frame>> {
        if self.observer.is_stop_asked() {
            return Ok(None);
        }
        let started = Instant::now();
        let frame = self.source.next_frame()?;
        if frame.is_some() {
            self.times.push(started.elapsed());
        }
        Ok(frame)
    }
}

/// Stage two: tracking.
struct TrackingStage<'a> {
    /// Whether the frames are drawn for a video.
    shows: bool,
    tracker: RecalibratedOdometry,
    frames: KeptFrames,
    times: Timings,
    calibration_times: Timings,
    monitor: CameraMonitor,
    /// What ends the pass.
    difference: Option<CameraDifference>,
    observer: &'a dyn Observer,
    folder: &'a mut OutputFolder,
}

/// Result of stage two for a frame.
struct TrackedFrame {
    /// Present where it has a pose.
    posed: Option<Posed>,
    events: Vec<KeyframeEvent>,
    /// Present where the frames are drawn for a video.
    shown: Option<Box<ShownFrame>>,
}

/// What an overlay video shows of a frame.
struct ShownFrame {
    image: Frame,
    camera: FrameEstimate,
    written: FrameEstimate,
    tracks: Vec<TrackView>,
}

impl TrackingStage<'_> {
    /// `None` once it is certain that the camera is different.
    fn next(&mut self, frame: Frame) -> Result<Option<TrackedFrame>> {
        let started = Instant::now();
        let (estimate, mut events) = self.tracker.process(&frame)?;
        self.times.push(started.elapsed());
        let started = Instant::now();
        self.difference = self.monitor.watch(&estimate, &self.tracker.odometry);
        if self.difference.is_some() {
            return Ok(None);
        }
        self.calibration_times.push(started.elapsed());
        let seen = self.tracker.pose_frames.frame(&estimate);
        self.folder.record(&seen)?;
        self.observer.frame(&seen);
        let shown = self.shows.then(|| {
            Box::new(ShownFrame {
                image: frame.clone(),
                camera: estimate.clone(),
                written: seen.into_owned(),
                tracks: self.tracker.odometry.tracks().to_vec(),
            })
        });
        let pose = estimate.ground_pose();
        let segment = estimate.segment;
        self.frames.push(estimate, self.tracker.odometry.reference());
        number_as_source(&mut events, |index| self.frames.number_in_source(index));
        let is_keyframe = is_made(&events, frame.number);
        let posed = pose.map(|pose| Posed { frame, pose, segment, is_keyframe });
        Ok(Some(TrackedFrame { posed, events, shown }))
    }
}

/// Renumbers frames from their count in the odometry to their numbers in the source (`in_source`).
pub fn number_as_source(events: &mut [KeyframeEvent], in_source: impl Fn(u64) -> Option<u64>) {
    for event in events {
        if let KeyframeEvent::Made(new) = event
            && let Some(number) = in_source(new.frame)
        {
            new.frame = number;
        }
    }
}

/// Whether a frame of the source became a keyframe.
pub fn is_made(events: &[KeyframeEvent], frame: u64) -> bool {
    events.iter().any(|event| matches!(event, KeyframeEvent::Made(new) if new.frame == frame))
}

/// Stage three: mapping.
struct MappingStage {
    /// Whether there will be a mosaic.
    draws: bool,
    views: MosaicFrames,
    mapping: Mapping,
    video: Option<OverlayVideo>,
    unmapped: Option<Error>,
    times: Timings,
}

impl MappingStage {
    fn next(&mut self, followed: TrackedFrame) -> Result<()> {
        let TrackedFrame { posed, events, shown } = followed;
        if let (Some(video), Some(shown)) = (&mut self.video, shown) {
            let ShownFrame { image, camera, written, tracks } = &*shown;
            video.add(&OverlayFrame { image, camera, written, tracks });
        }
        if self.unmapped.is_none() {
            self.unmapped = self.mapping.take(events, posed.as_ref().map(|posed| &posed.frame)).err();
        }
        let Some(posed) = posed else { return Ok(()) };
        let started = Instant::now();
        if self.draws {
            self.views.next(posed)?;
        }
        self.times.push(started.elapsed());
        Ok(())
    }
}

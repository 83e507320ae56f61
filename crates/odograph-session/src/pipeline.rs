//! Decode | track | map, side by side, joined by short queues. The order of frames is kept, so any
//! number of threads gives the same bytes.

use crate::folder::OutputFolder;
use crate::found::{FixedInImage, FoundLens, FoundMount, FoundReadout};
use crate::kept_frames::KeptFrames;
use crate::mapping::Mapping;
use crate::observer::Observer;
use crate::output::Output;
use crate::plan::RunPlan;
use crate::statistics::LiveStatistics;
use crate::timings::Timings;
use crate::views::{Posed, Views};
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::mounting::{Found, Untold};
use odograph::odometry::{KeyframeEvent, Odometry};
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::FrameEstimate;
use odograph_video::{Frame, Source};
use std::sync::mpsc;
use std::thread;
use std::time::Instant;

/// What came out of the pipeline.
pub struct Tracked {
    /// With what each was measured against.
    pub frames: KeptFrames,
    /// Of which frames the mosaic is laid.
    pub views: Views,
    pub mapping: Mapping,
    pub keyframes: u64,
    /// What of the image does not move with the ground.
    pub fixed: FixedInImage,
    pub warnings: Vec<String>,
    pub times: StageTimes,
    pub interrupted: bool,
    /// How many frames the source says it has.
    pub announced: Option<u64>,
    /// How a live run kept up with its source.
    pub live: Option<LiveStatistics>,
    /// What ended the recording before its end, if anything did.
    pub failure: Option<Error>,
    /// What ended the mapping early, such as a full disk. The path does not need the map.
    pub unmapped: Option<Error>,
    /// How the camera sits, where that is not what was told.
    pub mount: Option<FoundMount>,
    /// How the lens bends, where not as told.
    pub lens: Option<FoundLens>,
    /// The readout time of the image.
    pub readout: Option<FoundReadout>,
}

/// How the pipeline ended.
pub enum Ended {
    /// With all of the source that there was.
    Tracked(Box<Tracked>),
    /// At a frame from which on it is sure that the camera is not as the plan says.
    IsAnother(Box<Found>),
}

/// How long each frame took in each stage.
#[derive(Debug, Default)]
pub struct StageTimes {
    pub decode: Timings,
    pub track: Timings,
    pub self_calibration: Timings,
    pub map: Timings,
}

/// Frames that wait between two stages: enough to even out a keyframe, which takes as long as
/// decoding ten frames, and few enough to need little memory.
const LONGEST_QUEUE: usize = 24;
const SHORTEST_QUEUE: usize = 4;
/// Bytes of samples that the frames of a queue may have, in gray and colour.
const QUEUE_BYTES: usize = 12 << 20;

/// How many frames of a camera may wait.
fn queue(camera: &Camera) -> usize {
    let frame_bytes = 3 * camera.width() * camera.height() / 2;
    (QUEUE_BYTES / frame_bytes.max(1)).clamp(SHORTEST_QUEUE, LONGEST_QUEUE)
}

/// Follows every frame of the source, or until `untold` is sure. Each frame's result is in the
/// folder within a second of video.
pub fn track(
    plan: &RunPlan,
    source: Source,
    folder: &mut OutputFolder,
    output: &Output,
    untold: Option<Untold>,
    observer: &dyn Observer,
) -> Result<Ended> {
    let mut odometry = plan.odometry()?;
    odometry.tell_keyframes();
    let mapping = Mapping::new(plan, folder, &output.map)?;
    let views = Views::new(&plan.camera, folder.path());
    let mut tracking = Tracking {
        odometry,
        of: plan.pose_frame()?,
        frames: KeptFrames::new(folder.path()),
        times: Timings::default(),
        calibration_times: Timings::default(),
        untold,
        found: None,
        observer,
        folder,
    };
    observer.tracking_begins(source.info().frame_count);
    let whole = plan.source.start_s.is_none() && plan.source.end_s.is_none();
    let announced = source.info().frame_count.filter(|_| whole);
    let mut decoding = Decoding { source, times: Timings::default(), observer };
    let mut ground = Ground { views, mapping, unmapped: None, times: Timings::default() };
    let outcome = match output.threads() {
        1 => one_by_one(&mut decoding, &mut tracking, &mut ground),
        threads => side_by_side(&mut decoding, &mut tracking, &mut ground, threads, queue(&plan.camera)),
    };
    observer.tracking_ends();
    let to_the_end = outcome.is_ok() && tracking.found.is_none() && !observer.is_stop_asked();
    let at_end = tracking.untold.as_ref().filter(|_| to_the_end).and_then(Untold::at_end);
    if let Some(found) = tracking.found.or(at_end) {
        ground.mapping.discard()?;
        return Ok(Ended::IsAnother(Box::new(found)));
    }
    let Ground { views, mapping, unmapped, times: map_times } = ground;
    // An interrupt that comes when all frames are there already changes nothing of them.
    let interrupted = observer.is_stop_asked() && announced != Some(tracking.frames.count() as u64);
    Ok(Ended::Tracked(Box::new(Tracked {
        readout: FoundReadout::of(&plan.camera, &tracking.odometry),
        keyframes: tracking.odometry.keyframes(),
        fixed: FixedInImage::of(&tracking.odometry),
        frames: tracking.frames,
        views,
        mapping,
        warnings: decoding.source.take_warnings(),
        times: StageTimes {
            decode: decoding.times,
            track: tracking.times,
            self_calibration: tracking.calibration_times,
            map: map_times,
        },
        interrupted,
        announced,
        live: None,
        failure: outcome.err(),
        unmapped,
        mount: None,
        lens: None,
    })))
}

/// The three stages in turn.
fn one_by_one(decoding: &mut Decoding<'_>, tracking: &mut Tracking<'_>, ground: &mut Ground) -> Result<()> {
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
    decoding: &mut Decoding<'_>,
    tracking: &mut Tracking<'_>,
    ground: &mut Ground,
    threads: usize,
    queue: usize,
) -> Result<()> {
    let (frames_in, frames_out) = mpsc::sync_channel::<Frame>(queue);
    let (followed_in, followed_out) = mpsc::sync_channel::<Followed>(queue);
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
        // What ended the mapping ended the tracking after it.
        let mapped = mapper.map_or(Ok(Ok(())), |mapper| mapper.join()).map_err(died)?;
        let decoded = decoder.join().map_err(died)?;
        mapped.and(outcome).and(decoded)
    })
}

fn ended() -> Error {
    Error::input("a stage of the pipeline ended unexpectedly; please report this recording")
}

/// Stage one: frames from the source, until its end or until the run is asked to end.
struct Decoding<'a> {
    source: Source,
    times: Timings,
    observer: &'a dyn Observer,
}

impl Decoding<'_> {
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

/// Stage two: poses.
struct Tracking<'a> {
    odometry: Odometry,
    /// Whose poses are written and told.
    of: PoseFrame,
    frames: KeptFrames,
    times: Timings,
    calibration_times: Timings,
    untold: Option<Untold>,
    /// What that has found: the run ends there.
    found: Option<Found>,
    observer: &'a dyn Observer,
    folder: &'a mut OutputFolder,
}

/// What stage two makes of a frame.
struct Followed {
    /// Where it has a pose.
    posed: Option<Posed>,
    events: Vec<KeyframeEvent>,
}

impl Tracking<'_> {
    /// Nothing once it is sure that the camera is not as it was told.
    fn next(&mut self, frame: Frame) -> Result<Option<Followed>> {
        let started = Instant::now();
        let estimate = self.odometry.process(frame.gray.clone(), frame.time_s)?;
        let estimate = FrameEstimate { frame: frame.number, ..estimate };
        let mut events = self.odometry.take_keyframe_events();
        self.times.push(started.elapsed());
        let started = Instant::now();
        if let Some(untold) = &mut self.untold {
            self.found = untold.watch(&estimate, &self.odometry);
            if self.found.is_some() {
                return Ok(None);
            }
        }
        self.calibration_times.push(started.elapsed());
        let told = self.of.frame(&estimate);
        self.folder.record(&told)?;
        self.observer.frame(&told);
        drop(told);
        let pose = estimate.ground_pose();
        let segment = estimate.segment;
        self.frames.push(estimate, self.odometry.reference());
        number_as_source(&mut events, |index| self.frames.number_in_source(index));
        let is_keyframe = is_made(&events, frame.number);
        Ok(Some(Followed { posed: pose.map(|pose| Posed { frame, pose, segment, is_keyframe }), events }))
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

/// Stage three: what is made of the ground.
struct Ground {
    views: Views,
    mapping: Mapping,
    unmapped: Option<Error>,
    times: Timings,
}

impl Ground {
    fn next(&mut self, followed: Followed) -> Result<()> {
        let Followed { posed, events } = followed;
        if self.unmapped.is_none() {
            self.unmapped = self.mapping.take(events, posed.as_ref().map(|posed| &posed.frame)).err();
        }
        let Some(posed) = posed else { return Ok(()) };
        let started = Instant::now();
        self.views.next(posed)?;
        self.times.push(started.elapsed());
        Ok(())
    }
}

//! Tracks a clip in the same way as `odograph run` and `odograph live`.

use crate::clip::Clip;
use crate::processor::busy_ms;
use crate::rows::Follow;
use odograph::camera::{Camera, Rig};
use odograph::error::Result;
use odograph::fixed_pattern::NonuniformityCorrection;
use odograph::ground_map::MemoryImages;
use odograph::loop_closure::LoopClosureConfig;
use odograph::motion::MotionModel;
use odograph::mounting::{CalibrationMonitor, CalibrationUpdate, OnlineCalibration};
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::slam::{Mapper, map_frames};
use odograph::trajectory::FrameEstimate;

/// Result of tracking a clip.
#[derive(Debug, Default)]
pub struct TrackedClip {
    /// All frames; in the map frame if a map was built, otherwise in the odometry frame.
    pub frames: Vec<FrameEstimate>,
    /// Processor time of the odometry per frame, milliseconds.
    pub times_ms: Vec<f64>,
    /// Number of restarts because mount or lens were found to differ from the given calibration.
    pub restarts: usize,
}

/// Result of one pass over a clip.
enum Pass {
    Finished(TrackedClip),
    /// The calibration differs from the given one, so the clip is tracked again with the new one.
    Again(Box<CalibrationUpdate>),
    /// The camera adds a pattern to its images, so the clip is tracked again without it.
    Corrected(NonuniformityCorrection),
}

/// Tracks a clip from its first frame to its last.
pub fn follow(clip: &Clip, follow: Follow, model: MotionModel) -> Result<TrackedClip> {
    let mut config = OdometryConfig::default();
    config.motion.model = model;
    let watched = follow != Follow::Live && model == MotionModel::Auto;
    let (mut camera, mut rig) = (clip.camera.clone(), clip.rig);
    let mut watch = watched.then(|| CalibrationMonitor::new(&camera, &rig));
    let mut correction = None;
    let mut restarts = 0;
    loop {
        match pass(clip, follow, &config, &camera, rig, watch.clone(), correction.clone())? {
            Pass::Finished(followed) => {
                return Ok(TrackedClip { restarts: restarts + followed.restarts, ..followed });
            }
            Pass::Again(found) => {
                rig = found.rig(&rig);
                camera = found.camera(&camera);
                watch = Some(CalibrationMonitor::found(&camera, &rig, &found));
                restarts += 1;
            }
            Pass::Corrected(pattern) => {
                correction = Some(pattern);
                restarts += 1;
            }
        }
    }
}

fn pass(
    clip: &Clip,
    follow: Follow,
    config: &OdometryConfig,
    camera: &Camera,
    rig: Rig,
    mut watch: Option<CalibrationMonitor>,
    correction: Option<NonuniformityCorrection>,
) -> Result<Pass> {
    let pattern_ends_pass = follow != Follow::Live && correction.is_none();
    let mut odometry = Odometry::new(camera.clone(), rig, *config)?;
    if let Some(correction) = correction {
        odometry = odometry.with_correction(correction);
    }
    let mut mapper = (follow == Follow::Mapped).then(|| {
        odometry.record_keyframes();
        (Mapper::new(camera, rig, config, LoopClosureConfig::default()), MemoryImages::default())
    });
    let mut online = (follow == Follow::Live && config.motion.model == MotionModel::Auto)
        .then(|| OnlineCalibration::new(camera, &rig, false));
    let mut followed = TrackedClip::default();
    let mut references = Vec::new();
    for (time_s, image) in &clip.frames {
        // A decoder would hand over ownership of the image, so the copy is not timed.
        let image = image.clone();
        let begun = busy_ms();
        let frame = odometry.process(image, *time_s)?;
        if let Some(online) = &mut online
            && online.watch(&frame, &mut odometry)?
        {
            followed.restarts += 1;
        }
        followed.times_ms.push(busy_ms() - begun);
        if let Some(pattern) = odometry.correction().filter(|_| pattern_ends_pass) {
            return Ok(Pass::Corrected(pattern.clone()));
        }
        if let Some(found) = watch.as_mut().and_then(|watch| watch.watch(&frame, &odometry)) {
            return Ok(Pass::Again(Box::new(found)));
        }
        followed.frames.push(frame);
        if let Some((mapper, images)) = &mut mapper {
            references.push(odometry.reference());
            for event in odometry.take_keyframe_events() {
                mapper.take(event, None, images)?;
            }
        }
    }
    if let Some(found) = watch.as_ref().and_then(CalibrationMonitor::at_end) {
        return Ok(Pass::Again(Box::new(found)));
    }
    if let Some((mapper, _)) = &mut mapper {
        mapper.finish();
        followed.frames = map_frames(mapper, &followed.frames, &references);
    }
    Ok(Pass::Finished(followed))
}

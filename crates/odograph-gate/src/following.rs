//! Tracks a clip in the same way as `odograph run` and `odograph live`.

use crate::clip::Clip;
use crate::processor::{Reference, busy_ms};
use crate::rows::Follow;
use odograph::error::Result;
use odograph::ground_map::MemoryImages;
use odograph::loop_closure::LoopClosureConfig;
use odograph::motion::MotionModel;
use odograph::mounting::OnlineCalibration;
use odograph::odometry::OdometryConfig;
use odograph::self_calibration::{MultiPassCalibration, PassEnd};
use odograph::slam::{Mapper, map_frames};
use odograph::trajectory::FrameEstimate;

/// Result of tracking a clip.
#[derive(Debug, Default)]
pub struct TrackedClip {
    /// All frames; in the map frame if a map was built, otherwise in the odometry frame.
    pub frames: Vec<FrameEstimate>,
    /// Processor time of the odometry per frame, milliseconds.
    pub times_ms: Vec<f64>,
    /// The workload that was timed between the frames.
    pub reference: Reference,
    /// Number of restarts because mount or lens were found to differ from the given calibration.
    pub restarts: usize,
}

/// Tracks a clip from its first frame to its last.
pub fn follow(clip: &Clip, follow: Follow, model: MotionModel) -> Result<TrackedClip> {
    let mut config = OdometryConfig::default();
    config.motion.model = model;
    let mut calibration = MultiPassCalibration::new(clip.camera.clone(), clip.rig);
    calibration.calibrates = follow != Follow::Live && model == MotionModel::Auto;
    calibration.measures_shutter =
        follow != Follow::Live && matches!(model, MotionModel::Auto | MotionModel::Free);
    calibration.corrects_images = follow != Follow::Live;
    let mut passes = 0;
    let tracked = calibration.track(|camera| {
        passes += 1;
        pass(clip, follow, &config, camera)
    })?;
    Ok(TrackedClip { restarts: passes - 1 + tracked.restarts, ..tracked })
}

fn pass(
    clip: &Clip,
    follow: Follow,
    config: &OdometryConfig,
    calibration: &MultiPassCalibration,
) -> Result<PassEnd<TrackedClip>> {
    let MultiPassCalibration { camera, rig, .. } = calibration;
    let mut monitor = calibration.monitor();
    let mut odometry = calibration.odometry(*config)?;
    let mut mapper = (follow == Follow::Mapped).then(|| {
        odometry.record_keyframes();
        (Mapper::new(camera, *rig, config, LoopClosureConfig::default()), MemoryImages::default())
    });
    let mut online = (follow == Follow::Live && config.motion.model == MotionModel::Auto)
        .then(|| OnlineCalibration::new(camera, rig, false));
    let mut followed = TrackedClip::default();
    let mut references = Vec::new();
    for (time_s, image) in &clip.frames {
        // A decoder would hand over ownership of the image, so the copy is not timed.
        let own = image.clone();
        let begun = busy_ms();
        let frame = odometry.process(own, *time_s)?;
        if let Some(online) = &mut online
            && online.watch(image, &frame, &mut odometry)?
        {
            followed.restarts += 1;
        }
        followed.times_ms.push(busy_ms() - begun);
        followed.reference.time_a_piece();
        if let Some(difference) = monitor.watch(&frame, &odometry) {
            return Ok(PassEnd::Differs(difference));
        }
        followed.frames.push(frame);
        if let Some((mapper, images)) = &mut mapper {
            references.push(odometry.reference());
            for event in odometry.take_keyframe_events() {
                mapper.take(event, None, images)?;
            }
        }
    }
    if let Some(difference) = monitor.at_end(&odometry) {
        return Ok(PassEnd::Differs(difference));
    }
    if let Some((mapper, _)) = &mut mapper {
        mapper.finish();
        followed.frames = map_frames(mapper, &followed.frames, &references);
    }
    Ok(PassEnd::Finished(followed))
}

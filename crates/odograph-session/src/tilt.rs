//! Warning about an unknown mount tilt.

use crate::kept_frames::KeptFrames;
use odograph::camera::Rig;
use odograph::error::Result;
use odograph::formats::decimal::Rounded;
use odograph::motion::MotionModel;

/// Minimum number of posed frames in the second half of a recording: two seconds at 30 frames a
/// second. More make the mean tilt more certain and leave more short recordings without a warning.
const MIN_FRAMES: usize = 60;
/// Smallest tilt that is reported, radians: at a height of 1 m it rotates the path by 0.1° per
/// metre.
const WORTH_TELLING_RAD: f64 = 0.0035;
/// Largest scatter of a mount's tilt relative to itself. Larger warns hand-held cameras of a tilt
/// that they do not have; smaller misses a tilted mount on rough ground.
const STEADY: f64 = 1.0 / 3.0;

/// A warning where the mount differed from the plan all through the second half of a recording.
/// While a tilt is estimated, in the first metres, it distorts the path, and nothing later corrects
/// that. Fails where the frames cannot be read back.
pub fn mount_warning(frames: &mut KeptFrames, rig: &Rig, model: MotionModel) -> Result<Option<String>> {
    if model != MotionModel::Auto {
        return Ok(None); // either held, or the recording's own affair
    }
    let nominal = rig.first_pose();
    let mut earlier = frames.posed() / 2;
    let mut later = Vec::with_capacity(frames.posed() - earlier);
    frames.each(|frame, _| {
        let Some(known) = &frame.estimate else { return Ok(()) };
        match earlier.checked_sub(1) {
            Some(left) => earlier = left,
            None => {
                later.push([known.pose.roll_rad - nominal.roll_rad, known.pose.pitch_rad - nominal.pitch_rad])
            }
        }
        Ok(())
    })?;
    Ok(steady(&later))
}

/// A warning where these deviations from the plan are a mount's.
fn steady(later: &[[f64; 2]]) -> Option<String> {
    if later.len() < MIN_FRAMES {
        return None;
    }
    let count = later.len() as f64;
    let mean = [0, 1].map(|i| later.iter().map(|tilt| tilt[i]).sum::<f64>() / count);
    let variance =
        later.iter().map(|tilt| (tilt[0] - mean[0]).powi(2) + (tilt[1] - mean[1]).powi(2)).sum::<f64>()
            / count;
    let size = mean[0].hypot(mean[1]);
    (size > WORTH_TELLING_RAD && variance.sqrt() < STEADY * size).then(|| {
        let [roll, pitch] = mean.map(|tilt_rad| Rounded(tilt_rad.to_degrees()));
        format!(
            "the camera is tilted against the rig file by {roll:+.1}° of roll and {pitch:+.1}° of pitch: until that was learned the path was bent and \
             stretched; odograph ground measures its mount, and --rig gives it"
        )
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::geometry::GroundPose;
    use odograph::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate, TrackStatus};

    fn frames(roll_rad: impl Fn(f64) -> f64) -> Vec<FrameEstimate> {
        let frame = |number: u64| {
            let pose = GroundPose { roll_rad: roll_rad(number as f64), ..GroundPose::level(1.0) };
            let covariance = nalgebra::Matrix6::zeros();
            let measured = PlaneMeasurement::new(&pose, &covariance);
            FrameEstimate {
                frame: number,
                time_s: number as f64 / 30.0,
                status: TrackStatus::Tracked,
                estimate: Some(PoseEstimate { pose, velocity: Default::default(), covariance, measured }),
                tracks: 300,
                inliers: 300,
                residual_px: 0.1,
                keyframe: false,
                segment: 0,
            }
        };
        (0..300).map(frame).collect()
    }

    fn note_for(frames: &[FrameEstimate], model: MotionModel) -> Option<String> {
        let mut kept = KeptFrames::new(&std::env::temp_dir());
        frames.iter().for_each(|frame| kept.push(frame.clone(), None));
        mount_warning(&mut kept, &Rig::level(1.0), model).unwrap()
    }

    fn nominal(frames: &[FrameEstimate]) -> Option<String> {
        note_for(frames, MotionModel::Auto)
    }

    #[test]
    fn a_learned_steady_tilt_is_noted_and_that_of_a_hand_is_not() {
        let learned = frames(|k| 0.0175 * (k / 60.0).min(1.0) + 2e-4 * (0.7 * k).sin());
        assert!(
            nominal(&learned).is_some_and(|sentence| sentence.contains("+1.0° of roll and +0.0° of pitch"))
        );
        assert_eq!(nominal(&frames(|k| 0.01 + 0.02 * (0.05 * k).sin())), None);
        assert_eq!(nominal(&frames(|k| 1e-3 * (0.05 * k).sin())), None);
        assert_eq!(nominal(&learned[..100]), None);
        assert_eq!(note_for(&learned, MotionModel::Free), None);
    }
}

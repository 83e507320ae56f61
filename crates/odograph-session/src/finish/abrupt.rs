//! Frames that no motion of the camera explains: their deviations are stated larger, and reported.

use crate::kept_frames::KeptFrames;
use odograph::drawing::scale::{duration_text, length_text};
use odograph::error::Result;
use odograph::filter::{AbruptFrame, AbruptMotion};
use std::path::Path;

/// Widens the covariances of frames that deviate from what the motion of their neighbours allows,
/// and returns a warning about them; `None` if there are none. Fails if the frames cannot be read
/// back.
pub fn widen_abrupt(frames: &mut KeptFrames, folder: &Path) -> Result<Option<String>> {
    let mut motion = AbruptMotion::default();
    frames.each(|frame, _| {
        motion.push(frame);
        Ok(())
    })?;
    let found = motion.frames();
    let Some(first) = found.first() else { return Ok(None) };
    let (mut widened, mut first_s) = (KeptFrames::new(folder), 0.0);
    let mut deviating = found.iter().peekable();
    frames.each(|frame, reference| {
        let mut frame = frame.clone();
        if let Some(abrupt) = deviating.next_if(|abrupt| abrupt.index == widened.count()) {
            abrupt.widen(&mut frame);
            if abrupt.index == first.index {
                first_s = frame.time_s - widened.first_time_s().unwrap_or(frame.time_s);
            }
        }
        widened.push(frame, reference.copied());
        Ok(())
    })?;
    *frames = widened;
    Ok(Some(warning(&found, frames.count(), first_s)))
}

fn warning(found: &[AbruptFrame], count: usize, first_s: f64) -> String {
    let largest = |size: fn(&AbruptFrame) -> f64| found.iter().map(size).fold(0.0, f64::max);
    let metres = largest(|abrupt| abrupt.deviation.xy().norm());
    let degrees = largest(|abrupt| abrupt.deviation.z.abs()).to_degrees();
    format!(
        "{} of {count} frames, the first at {}, are up to {} and {degrees:.2}° off the motion of their neighbours, which \
         would take more than 2 g: images are out of order, frozen or badly timed, or were measured wrongly; their \
         stated deviations include it",
        found.len(),
        duration_text(first_s),
        length_text(metres)
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::geometry::GroundPose;
    use odograph::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate, TrackStatus};

    fn kept(shown: impl Fn(u64) -> u64, folder: &Path) -> KeptFrames {
        let mut frames = KeptFrames::new(folder);
        for number in 0..300 {
            let pose = GroundPose { x_m: 0.02 * shown(number) as f64, ..GroundPose::level(0.75) };
            let covariance = nalgebra::Matrix6::identity() * 1e-8;
            let estimate = PoseEstimate {
                pose,
                velocity: Default::default(),
                covariance,
                measured: PlaneMeasurement::new(&pose, &covariance),
            };
            let frame = FrameEstimate {
                frame: number,
                time_s: number as f64 / 30.0,
                status: TrackStatus::Tracked,
                estimate: Some(estimate),
                tracks: 300,
                inliers: 300,
                residual_px: 0.1,
                keyframe: false,
                segment: 0,
            };
            frames.push(frame, None);
        }
        frames
    }

    #[test]
    fn exchanged_frames_are_reported_and_stated_as_uncertain() {
        let folder = tempfile::tempdir().unwrap();
        let mut in_order = kept(|number| number, folder.path());
        assert_eq!(widen_abrupt(&mut in_order, folder.path()).unwrap(), None);
        let exchanged = |number| match number {
            270 => 271,
            271 => 270,
            number => number,
        };
        let mut frames = kept(exchanged, folder.path());
        let warning = widen_abrupt(&mut frames, folder.path()).unwrap().unwrap();
        assert!(warning.starts_with("2 of 300 frames, the first at 9.00 s, are up to 30.0 mm"), "{warning}");
        let (widened, _) = frames.all().unwrap();
        assert_eq!(widened.len(), 300);
        for frame in widened {
            let sigma_m = frame.estimate.unwrap().covariance[(0, 0)].sqrt();
            // An exchanged frame is 20 mm from where it should be.
            assert_eq!(sigma_m > 0.02, matches!(frame.frame, 270 | 271), "{}: {sigma_m}", frame.frame);
        }
    }
}

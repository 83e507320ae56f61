//! Warning about a recording in which nothing moves.

use crate::kept_frames::KeptFrames;
use odograph::camera::Camera;
use odograph::error::Result;
use odograph::geometry::{GroundPoint, GroundPose, Pixel};
use odograph::numerics::median;
use odograph::trajectory::{FrameEstimate, LossReason, TrackStatus};

/// Largest displacement of the image at rest, pixels: this much, and this share of the median
/// residual. Of 15 rendered recordings at rest (noise of 0 to 25 gray levels, a lamp, a bumper,
/// changing light) the largest displacement was 0.37 of the residual; 0.3 mm of motion in 3 s give
/// 6.7 times the residual, vibration of 0.2 mm 3.7 times. Larger values take small motions for
/// noise, smaller ones noise for motion.
const AT_REST_PX: f64 = 0.03;
const AT_REST_RESIDUALS: f64 = 0.4;

/// Smallest share of the frames that have a pose or were lost to corners that stand still, and of
/// those with a pose that are at rest beside such losses: in the others the camera may have moved.
pub(crate) const MIN_SHARE: f64 = 0.9;

/// A warning where the camera did not move from the first frame to the last, or where what was
/// tracked is likely to be a part of the carrier. Fails where the frames cannot be read back.
pub fn stillness_warning(frames: &mut KeptFrames, camera: &Camera) -> Result<Option<String>> {
    let (count, posed) = (frames.count(), frames.posed());
    // Where it was in the end, or when it was lost to corners that stand still.
    let mut last = None;
    frames.each(|frame, _| {
        last = match &frame.estimate {
            Some(known) => Some((frame.segment, known.pose)),
            None => last.filter(|_| stands_still(frame)),
        };
        Ok(())
    })?;
    let Some((segment, last)) = last.filter(|_| posed >= 2) else { return Ok(None) };
    let seen = seen_from(camera, &last);
    let (mut moved_px, mut residuals_px) = (Vec::with_capacity(posed), Vec::with_capacity(posed));
    let mut stood_still = 0;
    frames.each(|frame, _| {
        stood_still += usize::from(stands_still(frame));
        let Some(known) = &frame.estimate else { return Ok(()) };
        let is_connected = frame.segment == segment;
        moved_px.push(if is_connected { moved(camera, &seen, &known.pose) } else { f64::INFINITY });
        residuals_px.push(frame.residual_px);
        Ok(())
    })?;
    if ((posed + stood_still) as f64) < MIN_SHARE * count as f64 {
        return Ok(None);
    }
    let limit_px = at_rest_px(&mut residuals_px);
    let at_rest = moved_px.iter().filter(|&&moved_px| moved_px <= limit_px).count();
    Ok(if at_rest == posed {
        let most_px = moved_px.iter().copied().fold(0.01, f64::max);
        Some(format!(
            "the camera did not move: in {posed} of {count} frames the image stays where it is, to {most_px:.2} px; if \
             it was driven, the stream is frozen, this is another recording, or everything in view moves with the \
             camera (a bumper, something over the lens)"
        ))
    } else if stood_still > 0 && at_rest as f64 >= MIN_SHARE * posed as f64 {
        Some(format!(
            "what was tracked stands still in the image in {at_rest} of {count} frames; if the camera was driven, that \
             is a part of the carrier and not the ground, and the path is wrong: --mask with that part in black leaves \
             it out"
        ))
    } else {
        None
    })
}

/// Largest displacement of the image at rest, for frames with these residuals, pixels.
pub(crate) fn at_rest_px(residuals_px: &mut [f64]) -> f64 {
    AT_REST_PX + AT_REST_RESIDUALS * median(residuals_px).unwrap_or(0.0)
}

/// Whether a frame was lost to corners that stand still in the image.
pub(crate) fn stands_still(frame: &FrameEstimate) -> bool {
    frame.status == TrackStatus::Lost { reason: LossReason::Shadow }
}

/// Points of the ground, and where they are in an image taken from a pose: a quarter of the image
/// from its edges, where turning, rising and tilting move them, too.
fn seen_from(camera: &Camera, pose: &GroundPose) -> Vec<(GroundPoint, Pixel)> {
    let at = |share: f64, pixels: usize| share * (pixels - 1) as f64;
    let corners = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)];
    let pixels = corners.map(|(x, y)| Pixel::new(at(x, camera.width()), at(y, camera.height())));
    let seen = |pixel| Some((pose.ground_from_ray(camera.ray_from_pixel(pixel)?)?, pixel));
    pixels.into_iter().filter_map(seen).collect()
}

/// Largest displacement of these points in an image taken from another pose, pixels; infinite if
/// one cannot be seen from there, or if there is none.
fn moved(camera: &Camera, seen: &[(GroundPoint, Pixel)], pose: &GroundPose) -> f64 {
    let displacement = |(point, pixel): &(GroundPoint, Pixel)| {
        let now = pose.ray_from_ground(*point).and_then(|ray| camera.pixel_from_ray(ray));
        now.map_or(f64::INFINITY, |now| (now.x - pixel.x).hypot(now.y - pixel.y))
    };
    seen.iter().map(displacement).reduce(f64::max).unwrap_or(f64::INFINITY)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::camera::Distortion;
    use odograph::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate};

    fn frame(number: u64, pose: Option<GroundPose>, reason: LossReason) -> FrameEstimate {
        let covariance = nalgebra::Matrix6::zeros();
        let estimate = pose.map(|pose| PoseEstimate {
            pose,
            velocity: Default::default(),
            covariance,
            measured: PlaneMeasurement::new(&pose, &covariance),
        });
        FrameEstimate {
            frame: number,
            time_s: number as f64 / 30.0,
            status: match estimate {
                Some(_) => TrackStatus::Tracked,
                None => TrackStatus::Lost { reason },
            },
            estimate,
            tracks: 300,
            inliers: 300,
            residual_px: 0.05,
            keyframe: false,
            segment: 0,
        }
    }

    /// The warning about 100 frames; one pixel in the middle of the image is 2 mm.
    fn warning(pose: impl Fn(f64) -> Option<GroundPose>) -> Option<String> {
        warning_with(LossReason::Dark, pose)
    }

    fn warning_with(reason: LossReason, pose: impl Fn(f64) -> Option<GroundPose>) -> Option<String> {
        let camera = Camera::new((640, 480), (500.0, 500.0), (319.5, 239.5), Distortion::None).unwrap();
        let mut kept = KeptFrames::new(&std::env::temp_dir());
        (0..100_u32)
            .for_each(|number| kept.push(frame(number.into(), pose(f64::from(number)), reason), None));
        stillness_warning(&mut kept, &camera).unwrap()
    }

    #[test]
    fn noise_is_rest_and_any_motion_is_none() {
        let level = GroundPose::level(1.0);
        let noise = warning(|k| Some(GroundPose { x_m: 5e-5 * (7.0 * k).sin(), ..level }));
        assert!(noise.is_some_and(|text| text.contains("did not move: in 100 of 100 frames")));
        let motions: [&dyn Fn(f64) -> GroundPose; 5] = [
            &|k| GroundPose { x_m: 3e-6 * k, ..level },
            &|k| GroundPose { heading_rad: 1e-5 * k, ..level },
            &|k| GroundPose { height_m: 1.0 + 1e-5 * k, ..level },
            &|k| GroundPose { pitch_rad: 3e-6 * k, ..level },
            // There and back.
            &|k| GroundPose { y_m: if k == 50.0 { 2e-3 } else { 0.0 }, ..level },
        ];
        for motion in motions {
            assert_eq!(warning(|k| Some(motion(k))), None);
        }
    }

    #[test]
    fn nothing_is_said_of_what_was_not_seen() {
        let level = GroundPose::level(1.0);
        assert!(warning(|k| (k != 50.0).then_some(level)).is_some());
        assert_eq!(warning(|k| (k < 80.0).then_some(level)), None);
        assert_eq!(warning(|k| (k < 99.0).then_some(level)), None);
        assert_eq!(warning(|k| (k == 0.0).then_some(level)), None);
    }

    #[test]
    fn a_carrier_that_is_tracked_instead_of_the_ground_is_named() {
        let begins = |k: f64| {
            let pose = GroundPose { x_m: if k < 6.0 { 1e-3 * k } else { 0.0 }, ..GroundPose::level(1.0) };
            (k != 6.0).then_some(pose)
        };
        let carrier = warning_with(LossReason::Shadow, begins);
        assert!(carrier.is_some_and(|text| text.contains("stands still in the image in 94 of 100 frames")));
        assert_eq!(warning(begins), None);
    }
}

//! Where a frame is looked for: near the predicted pose, then widely about it. Where few corners
//! agree with what that found, near the other poses that the motion so far predicts.

use super::Odometry;
use super::keyframe::Keyframe;
use super::last_pose::{LastPose, USUAL_STEP, seen_apart};
use super::standing::STILL_PX;
use super::tracking::{Measurement, Tracker};
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use crate::motion::{MotionModel, Random};
use crate::trajectory::LossReason;

/// Fraction of the expected inliers from which the rest is taken to be out of view, so that a
/// second search would find nothing.
const NEARLY_ALL: f64 = 0.95;

/// A prediction that is off by more than this in the image, pixels, is searched for widely.
const FULL_SEARCH_PX: f64 = 4.0;

/// Reach of the search near the other predictions, pixels; what is within it is the same place. On
/// a pattern with a period of less than twice this, it may end a period off, too. Chosen on a
/// flight over a checkerboard whose period is 30 pixels or more.
const NEAR_PX: f64 = 6.0;

/// Ground that moves as predicted is preferred to something that moves otherwise, or stands still
/// in the image, if it has at least this fraction of the other's inliers. Not derived; chosen.
const LEAST_GROUND: f64 = 0.2;

/// A pose that is farther from the prediction than its usual error, by more than this, is another
/// motion, pixels: as far as inliers are from a pose. Not derived; chosen.
const MATCH_PX: f64 = 2.0;

type Measured = Result<Measurement, LossReason>;

impl Odometry {
    /// Where the keyframe should show the next frame; `None` before the first one.
    pub(super) fn expected(&self, time_s: f64) -> Option<GroundPose> {
        let last = self.last.as_ref()?;
        Some(match self.config.motion.model {
            // The mean vector is measured from the last frame.
            MotionModel::Mean => last.pose,
            _ => self.uncorrected(&last.extrapolated(time_s)),
        })
    }

    /// What measures a frame against a keyframe.
    pub(super) fn tracker<'a>(&'a self, keyframe: &'a Keyframe, pyramid: &'a Pyramid) -> Tracker<'a> {
        Tracker { keyframe, pyramid, camera: &self.camera, config: &self.config, learned: &self.learned }
    }

    /// The pose of a frame near where it is expected, tried from several predictions.
    pub(super) fn measure_near(&self, pyramid: &Pyramid, time_s: f64) -> Measured {
        let expected = self.expected(time_s);
        let (Some(keyframe), Some(last), Some(extrapolated)) = (&self.keyframe, &self.last, expected) else {
            return Err(LossReason::Bare);
        };
        let tracker = self.tracker(keyframe, pyramid);
        let predictions = [&extrapolated, &self.uncorrected(&last.pose)];
        // What others will be built on is searched in full, unless that could not find more.
        let found_enough = |near: &Measurement| {
            near.refined || near.support >= self.enough_support() || self.nearly_all_agree(keyframe, near)
        };
        let near = || {
            let off_px = self.prediction_off_px(last, time_s)?;
            self.measure_within(&tracker, &extrapolated, off_px).ok().filter(found_enough)
        };
        let measured = match tracker.measure_drowned(predictions).or_else(near) {
            Some(found) => Ok(found),
            None => {
                let random = &mut Random::new(self.frames);
                let [first, second] = predictions;
                let wide = tracker.measure(first, random).or_else(|_| tracker.measure(second, random));
                self.or_elsewhere(wide, &tracker, last, time_s)
            }
        };
        self.or_predicted(measured, &tracker, last, &extrapolated, time_s)
    }

    /// The measured pose or, where that is not the predicted motion, the one near the prediction if
    /// enough corners agree with it. Drops on the lens, rows of the image before, or something that
    /// crosses the view may outnumber the corners of the ground, but only the ground moves as
    /// predicted. A prediction that the image stands still tells nothing: what is fixed to the
    /// camera does so, too.
    fn or_predicted(
        &self,
        measured: Measured,
        tracker: &Tracker<'_>,
        last: &LastPose,
        prediction: &GroundPose,
        time_s: f64,
    ) -> Measured {
        let (Tracker { keyframe, camera, config, .. }, Ok(other)) = (*tracker, &measured) else {
            return measured;
        };
        if config.motion.model == MotionModel::Mean {
            return measured;
        }
        let stands = other.stands_still(keyframe, camera, prediction);
        let moves = self.seen_apart_px(prediction, &self.uncorrected(&last.pose)) > STILL_PX;
        let off_px = self.prediction_off_px(last, time_s).filter(|_| moves);
        let is_predicted =
            |pose: &GroundPose, off_px: f64| self.seen_apart_px(pose, prediction) <= off_px + MATCH_PX;
        if !stands && off_px.is_none_or(|off_px| is_predicted(&other.estimate.pose, off_px)) {
            return measured;
        }
        let least = LEAST_GROUND * other.estimate.inlier_count() as f64;
        let is_ground = |found: &Measurement| {
            !found.stands_still(keyframe, camera, prediction)
                && found.estimate.inlier_count() as f64 >= least
                && (stands || off_px.is_some_and(|off_px| is_predicted(&found.estimate.pose, off_px)))
        };
        let random = &mut Random::new(self.frames);
        // By corners, even where the whole image was registered onto something else.
        let reach_px = if stands { NEAR_PX } else { off_px.unwrap_or(NEAR_PX) };
        let ground = tracker.measure_corners(prediction, reach_px, random).filter(is_ground);
        let Some(ground) = ground else { return measured };
        if other.agreement.is_some() || !stands {
            return Ok(ground);
        }
        let tracks = other.found.iter().zip(&other.estimate.inliers);
        let fixed = tracks.filter(|(_, inlier)| **inlier).map(|(found, _)| found.corner).collect();
        Ok(ground.beside(fixed, keyframe))
    }

    /// Whether a pose is farther from the predicted one than predictions usually are; their error
    /// grows with the square of the time. False where they are not reliable.
    pub(super) fn contradicts_prediction(&self, pose: &GroundPose, time_s: f64) -> bool {
        let (Some(last), Some(expected)) = (&self.last, self.expected(time_s)) else { return false };
        let (steps, off_px) = (((time_s - last.time_s) / last.step_s).max(1.0), self.usual_off_px(last));
        off_px < FULL_SEARCH_PX && self.seen_apart_px(pose, &expected) > off_px * steps * steps + MATCH_PX
    }

    /// [`seen_apart`], pixels.
    pub(super) fn seen_apart_px(&self, a: &GroundPose, b: &GroundPose) -> f64 {
        seen_apart(a, b) * self.camera.focal_px().0
    }

    /// What a wide search found or, if fewer corners than usual agree with that and more with a
    /// place near another prediction, that place: on a repeating pattern a wide search may end a
    /// period off.
    fn or_elsewhere(&self, wide: Measured, tracker: &Tracker<'_>, last: &LastPose, time_s: f64) -> Measured {
        let found = wide.as_ref().ok();
        if self.config.motion.model == MotionModel::Mean
            || found.is_some_and(|found| self.nearly_all_agree(tracker.keyframe, found))
        {
            return wide;
        }
        let is_elsewhere = |pose: &GroundPose| {
            found.is_none_or(|found| self.seen_apart_px(pose, &found.estimate.pose) > NEAR_PX)
        };
        let elsewhere = last
            .predictions(time_s)
            .iter()
            .map(|prediction| self.uncorrected(prediction))
            .filter(is_elsewhere)
            .filter_map(|prediction| self.measure_within(tracker, &prediction, NEAR_PX).ok())
            .filter(|near| is_elsewhere(&near.estimate.pose))
            .max_by(|a, b| a.support.total_cmp(&b.support));
        match elsewhere {
            Some(near) if found.is_none_or(|found| near.support > found.support) => Ok(near),
            _ => wide,
        }
    }

    /// The pose of a frame if a prediction is off by at most `off_px` in the image.
    fn measure_within(&self, tracker: &Tracker<'_>, prediction: &GroundPose, off_px: f64) -> Measured {
        tracker.measure_near(prediction, off_px, &mut Random::new(self.frames))
    }

    /// Whether nearly as many of the corners in view agree with a pose as usual.
    fn nearly_all_agree(&self, keyframe: &Keyframe, found: &Measurement) -> bool {
        found.inlier_ratio(keyframe, &self.camera) >= NEARLY_ALL * self.learned.usual_inlier_ratio()
    }

    /// The pose without the estimated error of the keyframe's height and tilt: where its corners
    /// appear.
    fn uncorrected(&self, pose: &GroundPose) -> GroundPose {
        GroundPose::from_vector(&(pose.to_vector() - self.keyframe_off))
    }

    /// Expected error of the extrapolated pose in the image; `None` if unknown or so large that the
    /// search covers everything anyway.
    fn prediction_off_px(&self, last: &LastPose, time_s: f64) -> Option<f64> {
        let usual_step = time_s - last.time_s <= USUAL_STEP * last.step_s;
        let off_px = self.usual_off_px(last);
        (self.config.motion.model != MotionModel::Mean && usual_step && off_px < FULL_SEARCH_PX)
            .then_some(off_px)
    }

    /// Error of the prediction by one frame, as the last frames had it, pixels.
    fn usual_off_px(&self, last: &LastPose) -> f64 {
        0.5 + 2.0 * last.off_by() * self.camera.focal_px().0
    }
}

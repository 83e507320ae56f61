//! How a keyframe was exposed: the rates of its pose, refined by the frames after it.

use super::Odometry;
use super::keyframe::Keyframe;
use crate::geometry::GroundPose;
use crate::motion::{MotionEstimate, PoseRates, RollingShutter};

/// What tells the rates of the present keyframe's pose.
#[derive(Debug, Clone)]
pub struct Exposure {
    /// Times and poses of the frame before the keyframe, of the keyframe, and of the frame after it.
    before: Option<(f64, GroundPose)>,
    keyframe: (f64, GroundPose),
    after: Option<(f64, GroundPose)>,
    /// The rates that the keyframe's own tracks tell, their variances, and those of what was foretold.
    evidence: Option<(PoseRates, PoseRates, PoseRates)>,
}

impl Exposure {
    /// Of the first keyframe of all.
    pub fn first(time_s: f64, pose: GroundPose) -> Self {
        Self { before: None, keyframe: (time_s, pose), after: None, evidence: None }
    }

    /// The rates as the next measured pose tells them, and whether no later one tells them better.
    fn refined(&mut self, time_s: f64, pose: &GroundPose) -> Option<(PoseRates, bool)> {
        let rate = |from: &(f64, GroundPose), to: &(f64, GroundPose)| {
            (to.1.to_vector() - from.1.to_vector()) / (to.0 - from.0)
        };
        let now = (time_s, *pose);
        if now.0 <= self.after.map_or(self.keyframe.0, |after| after.0) {
            return None;
        }
        // The slope at the keyframe of the parabola through three poses.
        let (foretold, is_last) = match (&self.before, &self.after) {
            (Some(before), _) => {
                let (first, second) = (rate(before, &self.keyframe), rate(&self.keyframe, &now));
                let (first_s, second_s) = (self.keyframe.0 - before.0, now.0 - self.keyframe.0);
                ((first * second_s + second * first_s) / (first_s + second_s), true)
            }
            (None, None) => (rate(&self.keyframe, &now), false),
            (None, Some(after)) => {
                let (first, second) = (rate(&self.keyframe, after), rate(after, &now));
                let share = (after.0 - self.keyframe.0) / (now.0 - self.keyframe.0);
                (first - (second - first) * share, true)
            }
        };
        self.after = Some(now);
        let rates = match &self.evidence {
            // A parabola through the frame after is twice as close as one through those before.
            Some((own, variance, foretold_variance)) => PoseRates::from_fn(|i, _| {
                let (a, b) = (1.0 / variance[i], 4.0 / foretold_variance[i].max(1e-12));
                (a * own[i] + b * foretold[i]) / (a + b)
            }),
            None => foretold,
        };
        Some((rates, is_last))
    }
}

impl Odometry {
    /// Tells a new keyframe how it was exposed, as far as it is known by now. `self.last` is this frame.
    pub(super) fn expose(&mut self, next: &mut Keyframe, time_s: f64, estimate: &MotionEstimate) {
        let (Some(shutter), Some(prior)) = (&estimate.shutter, &self.learned.frame_shutter) else {
            self.exposure = None;
            return;
        };
        let readout_s = self.learned.shutter().map_or(0.0, |state| state.readout().mean_s);
        next.shutter = RollingShutter::new(&self.camera, readout_s, shutter.rates);
        let before = self.last.as_ref().and_then(|last| {
            let moved = last.pose_rates? * last.step_s;
            Some((time_s - last.step_s, GroundPose::from_vector(&(last.pose.to_vector() - moved))))
        });
        let variance = prior.rate_sigma.map(|sigma| sigma * sigma);
        self.exposure = Some(Exposure {
            before,
            keyframe: (time_s, estimate.pose),
            after: None,
            evidence: Some((shutter.evidence, shutter.evidence_variance, variance)),
        });
    }

    /// Refines how the present keyframe was exposed by a frame measured after it.
    pub(super) fn expose_keyframe(&mut self, time_s: f64, estimate: &MotionEstimate) {
        let (Some(exposure), Some(keyframe)) = (&mut self.exposure, &mut self.keyframe) else { return };
        let Some(state) = self.learned.shutter().filter(|state| !state.is_global()) else {
            self.exposure = None;
            return;
        };
        let Some((rates, is_last)) = exposure.refined(time_s, &estimate.pose) else { return };
        let shutter = RollingShutter::new(&self.camera, state.readout().mean_s, rates);
        keyframe.expose(&self.camera, shutter);
        if is_last {
            self.exposure = None;
        }
    }
}

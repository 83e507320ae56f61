//! The shutter of the camera: its readout time, and how well the rates of the pose within an image
//! can be predicted from the poses before it.

use super::last_pose::LastPose;
use super::rate_filter::RateFilter;
use crate::camera::Camera;
use crate::geometry::pose_index::{X, Y};
use crate::motion::{ImageMotion, MotionModel, PoseRates, Readout, ShutterPrior};

/// What is known of the shutter.
#[derive(Debug, Clone)]
pub struct ShutterState {
    readout: Readout,
    is_free: bool,
    steps_seen: u64,
    /// How far the camera has moved, in heights.
    moved: f64,
    /// The motion of the camera.
    rates: RateFilter,
    /// Mean rates of the first two steps without a gap, and how many steps there were.
    first_steps: [PoseRates; 2],
    steps: usize,
}

/// A change of the pose from one frame to the next.
#[derive(Debug, Clone, Copy)]
pub struct PoseChange {
    /// Mean rates.
    pub rates: PoseRates,
    /// The time it took.
    pub step_s: f64,
    /// Variances of the second pose.
    pub variance: PoseRates,
}

/// While an unknown shutter is taken for a global one, one frame in this many is fitted with a skew
/// beside: it shows what the readout time would change, and that uneven ground is no skew.
const LOOKED_AT: u64 = 4;

/// Images of an unknown shutter may be skewed as any readout time does it, until the camera has
/// moved by this many heights: a freer model that is not needed loses. Not with
/// [`MotionModel::Auto`], where mount, lens and readout time are estimated.
const FREE_HEIGHTS: f64 = 0.6;

/// Movement, in heights, after which an unknown readout time is reported.
const MATTERING_HEIGHTS: f64 = 3.0;

/// A shutter is global if its readout time is zero to this, seconds.
const GLOBAL_WITHIN_S: f64 = 1e-4;

impl ShutterState {
    /// What the camera's file says, or nothing.
    pub fn new(camera: &Camera, height_m: f64, model: MotionModel) -> Self {
        let readout = match camera.readout_s() {
            Some(mean_s) => Readout { mean_s, variance_s2: camera.readout_deviation_s().powi(2) },
            None => Readout { mean_s: 0.0, variance_s2: Readout::UNKNOWN_S.powi(2) },
        };
        Self {
            readout,
            is_free: model != MotionModel::Auto,
            steps_seen: 0,
            moved: 0.0,
            rates: RateFilter::new(height_m),
            first_steps: [PoseRates::zeros(); 2],
            steps: 0,
        }
    }

    /// Takes over how the camera has moved so far.
    pub fn move_as(&mut self, before: &Self) {
        self.steps_seen = before.steps_seen;
        self.moved = before.moved;
        self.rates.clone_from(&before.rates);
        (self.first_steps, self.steps) = (before.first_steps, before.steps);
    }

    /// An unknown shutter is taken for a global one from here on.
    pub fn take_for_global(&mut self) {
        self.is_free = false;
    }

    /// The readout time.
    pub fn readout(&self) -> Readout {
        self.readout
    }

    /// Whether the camera has moved far enough for the readout time to matter.
    pub fn has_moved(&self) -> bool {
        self.moved > MATTERING_HEIGHTS
    }

    /// Whether images are skewed, so that rows determine rates.
    pub fn rolls(&self) -> bool {
        self.readout.mean_s != 0.0
    }

    /// Whether all rows are known to be exposed at once.
    pub fn is_global(&self) -> bool {
        !self.rolls() && self.readout.variance_s2 <= GLOBAL_WITHIN_S * GLOBAL_WITHIN_S
    }

    /// What is expected of the image at `time_s`, whose motion may have been measured by an earlier
    /// pass; `None` where the shutter is taken for a global one.
    pub fn prior(
        &self,
        last: &LastPose,
        time_s: f64,
        measured: Option<&ImageMotion>,
    ) -> Option<ShutterPrior> {
        let step_s = time_s - last.time_s;
        let applies = self.rolls() || (self.is_free && self.moved < FREE_HEIGHTS);
        let is_looked_at = applies || self.steps_seen.is_multiple_of(LOOKED_AT);
        if self.is_global() || step_s <= 0.0 || !is_looked_at {
            return None;
        }
        // All images share the error of a known readout time, which no frame may explain by itself.
        let readout = if self.rolls() { Readout { variance_s2: 0.0, ..self.readout } } else { self.readout };
        let expected = match measured {
            Some(motion) => motion.expected(),
            None => self.rates.expected(step_s, &last.pose.to_vector()),
        };
        Some(ShutterPrior { readout, applies, expected })
    }

    /// The pose has changed by `change` since the last one, `None` where there was none.
    pub fn saw_step(&mut self, change: Option<&PoseChange>, height_m: f64) {
        self.steps_seen += 1;
        let Some(PoseChange { rates, step_s, variance }) = change else {
            self.steps = 0;
            self.rates = RateFilter::new(height_m);
            return;
        };
        self.moved += step_s * rates[X].hypot(rates[Y]) / height_m;
        self.rates.update(*step_s, &(*step_s * rates), variance);
        if let Some(step) = self.first_steps.get_mut(self.steps) {
            *step = *rates;
        }
        self.steps += 1;
    }

    /// The first two steps where there were no others: mean rates.
    pub fn first_steps(&self) -> Option<[PoseRates; 2]> {
        (self.steps == self.first_steps.len()).then_some(self.first_steps)
    }
}

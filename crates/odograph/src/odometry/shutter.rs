//! The shutter of the camera: its readout time, and how well the rates of the pose within an image
//! can be predicted from the poses before it.

use super::last_pose::LastPose;
use super::rate_filter::RateFilter;
use crate::camera::Camera;
use crate::geometry::pose_index::{X, Y};
use crate::motion::{ImageMotion, PoseRates, Readout, ShutterEstimate, ShutterPrior};
use std::collections::VecDeque;

/// What is known of the shutter so far.
#[derive(Debug, Clone)]
pub struct ShutterState {
    readout: Readout,
    /// What was known of it before the first image.
    first: Readout,
    phase: ShutterDecision,
    steps_seen: u64,
    /// How far the camera has moved while it was undecided, in heights.
    moved: f64,
    /// The motion of the camera.
    rates: RateFilter,
    /// Mean rates between the last poses, the newest first.
    history: VecDeque<PoseRates>,
    /// Skew over rates of x, y and heading, of the frames measured against the present keyframe.
    serving: [SkewRegression; 3],
    /// Of those before.
    past: RegressionSums,
    /// Skew against the keyframe's, its variances, and the displacement from there, of the last
    /// frame.
    waiting: Option<(PoseRates, PoseRates, PoseRates)>,
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

/// What the shutter is taken for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ShutterDecision {
    /// Its readout time was given, or found to be none.
    Settled,
    /// Nothing is known yet: images may be skewed as much as any readout time does it.
    Undecided,
    /// No evidence of a rolling shutter: taken to be global, and monitored.
    TakenGlobal,
    /// It was seen to roll.
    Rolling,
}

/// A shutter rolls where its readout time is this many standard deviations from zero, and longer
/// than this, seconds.
const SIGNIFICANT: f64 = 3.5;
const LEAST_ROLLING_S: f64 = 3e-4;

/// After a path of this many heights a shutter that was not seen to roll is taken to be global: a
/// freer model that has not proved itself by then only loses.
const UNDECIDED_HEIGHTS: f64 = 0.6;

/// While the shutter is assumed global, one frame in this many is tested for a skew.
const LOOKED_AT: u64 = 4;

/// Degrees of freedom, three for each frame, after which skews that the displacement explains
/// better make the shutter be taken for a global one at once.
const ENOUGH_DEGREES: f64 = 24.0;

/// Movement, in heights, after which an unknown readout time is reported.
const MATTERING_HEIGHTS: f64 = 3.0;

/// Standard deviation of a readout time of which nothing is known: half of a frame at 30 a second.
const UNKNOWN_READOUT_S: f64 = 0.015;

/// The standard deviation of a sure readout time, a part of itself.
const SURE: f64 = 0.03;

/// A readout time is known no better than this, seconds: a thousandth of the image at usual speeds.
const LEAST_READOUT_S: f64 = 2e-5;

/// The shutter is global if the readout time is known to this, seconds, and is zero within three
/// times that.
const GLOBAL_WITHIN_S: f64 = 1e-4;

impl ShutterState {
    /// What the camera's file says, or nothing.
    pub fn new(camera: &Camera, height_m: f64) -> Self {
        let readout = match camera.readout_s() {
            Some(mean_s) => Readout { mean_s, variance_s2: camera.readout_deviation_s().powi(2) },
            None => Readout { mean_s: 0.0, variance_s2: UNKNOWN_READOUT_S.powi(2) },
        };
        Self {
            readout,
            first: readout,
            phase: match camera.readout_s() {
                Some(_) => ShutterDecision::Settled,
                None => ShutterDecision::Undecided,
            },
            steps_seen: 0,
            moved: 0.0,
            rates: RateFilter::new(height_m),
            history: VecDeque::with_capacity(MOST_STEPS + 1),
            serving: Default::default(),
            past: RegressionSums::default(),
            waiting: None,
        }
    }

    /// Takes over how the camera has moved so far.
    pub fn move_as(&mut self, before: &Self) {
        self.steps_seen = before.steps_seen;
        self.moved = before.moved;
        self.rates.clone_from(&before.rates);
        self.history.clone_from(&before.history);
    }

    /// Drops what frames showed under a wrong shape of the ground, unless the readout time is sure:
    /// uneven ground looks like a skew. With free elevations a skew along the motion cannot be
    /// distinguished from a slope, so it is not fitted before the readout time is known again.
    pub fn forget_evidence(&mut self) {
        if self.phase == ShutterDecision::Settled
            || (self.phase == ShutterDecision::Rolling && self.is_sure())
        {
            return;
        }
        (self.readout, self.phase) = (self.first, ShutterDecision::TakenGlobal);
        (self.serving, self.past, self.waiting) = Default::default();
    }

    /// The readout time as it is known now.
    pub fn readout(&self) -> Readout {
        self.readout
    }

    /// The readout time that images are taken to have, seconds.
    pub fn assumed_readout_s(&self) -> f64 {
        if self.phase == ShutterDecision::TakenGlobal { 0.0 } else { self.readout.mean_s }
    }

    /// The mean square of what the readout time that is taken may be off by, seconds².
    pub fn readout_variance_s2(&self) -> f64 {
        let Readout { mean_s, variance_s2 } = self.readout;
        if self.phase == ShutterDecision::TakenGlobal { mean_s * mean_s + variance_s2 } else { variance_s2 }
    }

    /// Whether the camera has moved far enough for the readout time to matter.
    pub fn has_moved(&self) -> bool {
        self.moved > MATTERING_HEIGHTS
    }

    /// Whether the readout time is known to a third, so that rows determine rates.
    pub fn is_known(&self) -> bool {
        self.phase == ShutterDecision::Settled
            || (self.phase != ShutterDecision::TakenGlobal
                && self.readout.variance_s2 < (0.3 * self.readout.mean_s).powi(2))
    }

    /// Whether the skew of an image is known so well that the remaining residuals are not skew.
    pub fn is_sure(&self) -> bool {
        match self.phase {
            ShutterDecision::Settled | ShutterDecision::TakenGlobal | ShutterDecision::Undecided => true,
            ShutterDecision::Rolling => self.readout.variance_s2 < (SURE * self.readout.mean_s).powi(2),
        }
    }

    /// Whether all rows are exposed at once.
    pub fn is_global(&self) -> bool {
        self.phase == ShutterDecision::Settled && self.readout.mean_s == 0.0
    }

    /// What is expected of the image at `time_s`, whose motion may have been measured by an earlier
    /// pass; `None` where the shutter is global.
    pub fn prior(
        &self,
        last: &LastPose,
        time_s: f64,
        measured: Option<&ImageMotion>,
    ) -> Option<ShutterPrior> {
        let step_s = time_s - last.time_s;
        let applies = self.phase != ShutterDecision::TakenGlobal;
        let is_looked_at = applies || self.steps_seen.is_multiple_of(LOOKED_AT);
        if self.is_global() || step_s <= 0.0 || !is_looked_at {
            return None;
        }
        // What is only looked at may be anything.
        let readout = match self.phase {
            ShutterDecision::TakenGlobal => Readout { mean_s: 0.0, variance_s2: UNKNOWN_READOUT_S.powi(2) },
            // All images share its error, which no frame may explain by itself.
            ShutterDecision::Settled => Readout { variance_s2: 0.0, ..self.readout },
            _ => self.readout,
        };
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
            self.history.clear();
            self.waiting = None;
            self.rates = RateFilter::new(height_m);
            return;
        };
        self.moved += step_s * rates[X].hypot(rates[Y]) / height_m;
        if self.phase == ShutterDecision::Undecided && self.moved > UNDECIDED_HEIGHTS {
            self.phase = ShutterDecision::TakenGlobal;
        }
        if let Some(last) = self.history.front() {
            self.learn(&(0.5 * (rates + *last)));
        }
        self.rates.update(*step_s, &(*step_s * rates), variance);
        self.history.push_front(*rates);
        self.history.truncate(MOST_STEPS);
    }

    /// The first two steps where there were no others: mean rates, the first one first.
    pub fn first_steps(&self) -> Option<[PoseRates; 2]> {
        (self.history.len() == 2).then(|| [self.history[1], self.history[0]])
    }

    /// Learns the readout time from a measured frame, once the next one determines its rates.
    pub fn saw(
        &mut self,
        seen: &ShutterEstimate,
        prior: &ShutterPrior,
        keyframe_rates: &PoseRates,
        displacement: PoseRates,
    ) {
        if self.phase == ShutterDecision::Settled {
            return;
        }
        let skew = seen.evidence - prior.readout.mean_s * keyframe_rates;
        let readout_s = self.readout.mean_s.abs().max(UNKNOWN_READOUT_S);
        let variance = seen.evidence_variance + readout_s.powi(2) * prior.expected.rate_variance;
        self.waiting = Some((skew, variance, displacement));
    }

    /// Learns from the frame before with its rates from the poses on both sides of it.
    fn learn(&mut self, rates: &PoseRates) {
        let Some((skew, variance, displacement)) = self.waiting.take() else { return };
        let Some(instrument) = self.slow_rates() else { return };
        for i in 0..3 {
            if variance[i].is_finite() && variance[i] > 0.0 {
                self.serving[i].add(1.0 / variance[i], [skew[i], rates[i], instrument[i], displacement[i]]);
            }
        }
        self.estimate();
    }

    /// Another keyframe serves from here on.
    pub fn end_keyframe(&mut self) {
        self.waiting = None;
        let serving = std::mem::take(&mut self.serving);
        self.past = serving.iter().fold(self.past, |sum, line| sum.and(&line.sums()));
    }

    /// Mean rates over some steps before the last two: independent of the errors of the rates that
    /// are predicted now.
    fn slow_rates(&self) -> Option<PoseRates> {
        let steps = self.history.len().saturating_sub(1);
        (steps >= SLOW_STEPS).then(|| self.history.iter().skip(1).sum::<PoseRates>() / steps as f64)
    }

    /// The slope of the skew over the rates: the readout time.
    fn estimate(&mut self) {
        let all = self.serving.iter().fold(self.past, |sum, line| sum.and(&line.sums()));
        let Some((readout_s, variance_s2)) = all.slope() else { return };
        let is_explained =
            self.phase != ShutterDecision::Rolling && all.left_by(readout_s) > all.left_by_displacement;
        let (readout_s, variance_s2) =
            if is_explained { (0.0, variance_s2 + readout_s * readout_s) } else { (readout_s, variance_s2) };
        let (before, now) = (1.0 / self.first.variance_s2, 1.0 / variance_s2);
        let mean_s = (before * self.first.mean_s + now * readout_s) / (before + now);
        let seen =
            mean_s.abs() > LEAST_ROLLING_S && readout_s * readout_s > SIGNIFICANT.powi(2) * variance_s2;
        if seen && self.phase != ShutterDecision::Rolling {
            self.phase = ShutterDecision::Rolling;
        }
        if is_explained && self.phase == ShutterDecision::Undecided && all.degrees > ENOUGH_DEGREES {
            self.phase = ShutterDecision::TakenGlobal;
        }
        self.readout.mean_s = mean_s.clamp(-Camera::LONGEST_READOUT_S, Camera::LONGEST_READOUT_S);
        self.readout.variance_s2 = (1.0 / (before + now)).max(LEAST_READOUT_S.powi(2));
        let deviation_s = self.readout.variance_s2.sqrt();
        if deviation_s < GLOBAL_WITHIN_S && self.readout.mean_s.abs() < 3.0 * GLOBAL_WITHIN_S {
            self.readout = Readout { mean_s: 0.0, variance_s2: 0.0 };
            self.phase = ShutterDecision::Settled;
        }
    }
}

/// A weighted line through (rates, skew), with an instrument: frames against one keyframe share
/// what its own skew is off by, so that each keyframe has a line of its own with the same slope.
///
/// Predicted rates have errors, which would flatten the slope; an instrumental variable that
/// follows the rates but not their errors does not (P. Wright, 1928; J. Sargan, 1958). An unknown
/// tilt, a wrong lens and ground that slopes or bends look like a skew that grows with the
/// displacement from the keyframe: where that explains the skews better than the rates do, no
/// shutter rolls.
#[derive(Debug, Clone, Copy, Default)]
struct SkewRegression {
    weight: f64,
    /// Weighted sums of skew, rates, instrument and displacement.
    first: [f64; 4],
    /// Weighted sums of their products.
    second: [[f64; 4]; 4],
    count: f64,
}

const SKEW: usize = 0;
const RATES: usize = 1;
const INSTRUMENT: usize = 2;
const DISPLACEMENT: usize = 3;

impl SkewRegression {
    fn add(&mut self, weight: f64, values: [f64; 4]) {
        self.weight += weight;
        for i in 0..4 {
            self.first[i] += weight * values[i];
            for k in 0..4 {
                self.second[i][k] += weight * values[i] * values[k];
            }
        }
        self.count += 1.0;
    }

    /// The sums about the means.
    fn sums(&self) -> RegressionSums {
        if self.count < 3.0 {
            return RegressionSums::default();
        }
        let about = |i: usize, k: usize| self.second[i][k] - self.first[i] * self.first[k] / self.weight;
        let displaced = about(SKEW, DISPLACEMENT).powi(2) / about(DISPLACEMENT, DISPLACEMENT);
        RegressionSums {
            skew_instrument: about(SKEW, INSTRUMENT),
            rates_instrument: about(RATES, INSTRUMENT),
            instrument_square: about(INSTRUMENT, INSTRUMENT),
            skew_square: about(SKEW, SKEW),
            skew_rates: about(SKEW, RATES),
            rates_square: about(RATES, RATES),
            left_by_displacement: about(SKEW, SKEW) - if displaced.is_finite() { displaced } else { 0.0 },
            degrees: self.count - 1.0,
        }
    }
}

/// Sums over the lines of several keyframes.
#[derive(Debug, Clone, Copy, Default)]
struct RegressionSums {
    skew_instrument: f64,
    rates_instrument: f64,
    instrument_square: f64,
    skew_square: f64,
    skew_rates: f64,
    rates_square: f64,
    /// Squares of the skew that lines through the displacement leave.
    left_by_displacement: f64,
    degrees: f64,
}

impl RegressionSums {
    fn and(&self, other: &Self) -> Self {
        Self {
            skew_instrument: self.skew_instrument + other.skew_instrument,
            rates_instrument: self.rates_instrument + other.rates_instrument,
            instrument_square: self.instrument_square + other.instrument_square,
            skew_square: self.skew_square + other.skew_square,
            skew_rates: self.skew_rates + other.skew_rates,
            rates_square: self.rates_square + other.rates_square,
            left_by_displacement: self.left_by_displacement + other.left_by_displacement,
            degrees: self.degrees + other.degrees,
        }
    }

    /// Squares of the skew that a slope over the rates leaves.
    fn left_by(&self, slope: f64) -> f64 {
        self.skew_square - 2.0 * slope * self.skew_rates + slope * slope * self.rates_square
    }

    /// The slope and its variance; `None` where nothing determines it.
    fn slope(&self) -> Option<(f64, f64)> {
        if self.rates_instrument.abs() < 1e-12 || self.degrees < 3.0 {
            return None;
        }
        let slope = self.skew_instrument / self.rates_instrument;
        let left = self.left_by(slope);
        // At least what the weights say; neighbouring frames share their errors.
        let scatter = (left / (self.degrees - 1.0)).max(1.0) * SHARED;
        let variance = scatter * self.instrument_square / (self.rates_instrument * self.rates_instrument);
        variance.is_finite().then_some((slope, variance))
    }
}

/// Frames against one keyframe share the errors of its patches: this many have the information of
/// one.
const SHARED: f64 = 5.0;

/// Number of steps over which rates are averaged for the instrument: a vibration passes, a turn
/// does not.
const SLOW_STEPS: usize = 4;
const MOST_STEPS: usize = 8;

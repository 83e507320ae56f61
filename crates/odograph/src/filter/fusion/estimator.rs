//! The fusion estimator: corrects the camera's path with the other sensors, forward and backward in
//! time.
//!
//! An error-state Kalman filter over the measured frames, followed by the Rauch–Tung–Striebel
//! smoother in modified Bryson–Frazier form (G. Bierman, 1973). The process model is the camera's
//! own motion with the camera's covariance, and dead reckoning with wheel and gyroscope across
//! gaps. The compass measures the heading and the range finder the height, each with an unknown
//! bias.

use super::calibration::{CONSISTENT_NIS, Sight};
use super::camera_motion::MeasuredFrame;
use super::reckoning::ReckonedPose;
use crate::geometry::pose_index::{HEADING, LN_SCALE, X, Y};
use crate::geometry::{PlaneTransform, Se2, Sim2, propagated, wrap_angle};
use nalgebra::{Matrix3, SMatrix, SVector};

/// x, y (metres), heading correction (radians), logarithm of the scale correction, bias of the
/// compass (radians), bias of the range finder (metres).
type FusionState = SVector<f64, 6>;
type StateMatrix = SMatrix<f64, 6, 6>;

/// Where the zeros of the compass and of the range finder stand in the state.
const COMPASS: usize = 4;
const RANGE: usize = 5;

/// Correction of a measured frame.
#[derive(Debug, Clone, Copy)]
pub struct Corrected {
    pub x_m: f64,
    pub y_m: f64,
    /// Correction to add to the camera's heading, radians.
    pub turn_rad: f64,
    /// Factor for the camera's height and translations.
    pub scale: f64,
    /// Covariance of (x, y, heading) of the frame's reference keyframe.
    pub covariance: Matrix3<f64>,
    /// Variance of the logarithm of the scale.
    pub scale_variance: f64,
}

impl Corrected {
    fn of(state: &FusionState, covariance: &StateMatrix) -> Self {
        Self {
            x_m: state[X],
            y_m: state[Y],
            turn_rad: state[HEADING],
            scale: state[LN_SCALE].exp(),
            covariance: covariance.fixed_view::<3, 3>(0, 0).into_owned(),
            scale_variance: covariance[(LN_SCALE, LN_SCALE)].max(0.0),
        }
    }
}

/// Innovation consistency of a sensor.
#[derive(Debug, Clone, Copy, Default)]
pub struct Consistency {
    pub readings: usize,
    pub contradictions: usize,
    nis_sum: f64,
}

impl Consistency {
    pub fn nis(&self) -> Option<f64> {
        (self.readings > 0).then(|| self.nis_sum / self.readings as f64)
    }
}

/// The corrected path, and the consistency and bias (with variance) of compass and range finder.
pub struct Estimate {
    pub corrected: Vec<Corrected>,
    pub heading: Consistency,
    pub range: Consistency,
    pub heading_zero: (f64, f64),
    pub range_zero: (f64, f64),
}

/// One event of the forward pass, stored for the backward pass.
enum Event {
    Moved(StateMatrix),
    Measured { row: FusionState, innovation: f64, spread: f64, gain: FusionState },
    MeasuredFrame(FusionState, StateMatrix),
}

/// Estimates the path over `nodes`. `gaps[k]` is the dead-reckoned motion from node k − 1 to node k
/// if there is a gap between them.
pub fn estimate(
    nodes: &[MeasuredFrame],
    gaps: &[Option<ReckonedPose>],
    heading: &[Sight],
    range: &[Sight],
) -> Estimate {
    let mut forward = Forward::new(&nodes[0]);
    let (mut headings, mut ranges) = (heading.iter().peekable(), range.iter().peekable());
    for (k, node) in nodes.iter().enumerate() {
        if k > 0 {
            match &gaps[k] {
                Some(reckoned) => {
                    let change = height_change(nodes, node.time_s - nodes[k - 1].time_s);
                    forward.cross(&nodes[k - 1], node, reckoned, change);
                }
                None => forward.follow(&nodes[k - 1], node),
            }
        }
        while let Some(sight) = headings.next_if(|sight| sight.node <= k) {
            let mut row = FusionState::zeros();
            (row[HEADING], row[COMPASS]) = (1.0, 1.0);
            let expected = node.heading_rad + forward.state[HEADING] + forward.state[COMPASS];
            let innovation = wrap_angle(sight.reading - expected);
            forward.measure(row, innovation, sight.variance, |forward| &mut forward.heading);
        }
        while let Some(sight) = ranges.next_if(|sight| sight.node <= k) {
            let height_m = node.height_m * forward.state[LN_SCALE].exp();
            let mut row = FusionState::zeros();
            (row[LN_SCALE], row[RANGE]) = (height_m, -1.0);
            let innovation = sight.reading - (height_m - forward.state[RANGE]);
            forward.measure(row, innovation, sight.variance, |forward| &mut forward.range);
        }
        forward.events.push(Event::MeasuredFrame(forward.state, forward.covariance));
    }
    forward.back(nodes.len())
}

/// The forward pass.
pub struct Forward {
    pub state: FusionState,
    covariance: StateMatrix,
    /// Largest relative variance of the camera's height so far.
    height_variance: f64,
    events: Vec<Event>,
    heading: Consistency,
    range: Consistency,
}

impl Forward {
    pub fn new(first: &MeasuredFrame) -> Self {
        let mut state = FusionState::zeros();
        (state[X], state[Y]) = (first.x_m, first.y_m);
        let mut covariance = StateMatrix::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&first.keyframe_covariance);
        // Uninformative prior of the two biases: any heading zero, any mounting.
        (covariance[(COMPASS, COMPASS)], covariance[(RANGE, RANGE)]) = (10.0, 10.0);
        let (heading, range) = Default::default();
        let height_variance = first.height_variance / first.height_m.powi(2);
        Self { state, covariance, height_variance, events: Vec::new(), heading, range }
    }

    /// Propagates by the camera's own motion.
    pub fn follow(&mut self, before: &MeasuredFrame, node: &MeasuredFrame) {
        let (dx, dy) = (node.x_m - before.x_m, node.y_m - before.y_m);
        let corrected = Sim2::about_origin(self.state[HEADING], self.state[LN_SCALE].exp());
        let (mx, my) = corrected.rotate(dx, dy);
        let mut transition = StateMatrix::identity();
        transition.fixed_view_mut::<4, 4>(0, 0).copy_from(&Sim2::lever_arm(mx, my));
        self.state[X] += mx;
        self.state[Y] += my;
        // Process noise: growth of the camera's covariance beyond the propagation of the previous
        // errors.
        let grown =
            node.keyframe_covariance - propagated(&Se2::lever_arm(dx, dy), &before.keyframe_covariance);
        let mut noise = StateMatrix::zeros();
        for i in 0..3 {
            noise[(i, i)] = grown[(i, i)].max(0.0);
        }
        // A frame's own noise makes the height variance fluctuate; only a new maximum counts as
        // growth.
        let height_variance = self.height_variance.max(node.height_variance / node.height_m.powi(2));
        noise[(LN_SCALE, LN_SCALE)] = height_variance - self.height_variance;
        self.height_variance = height_variance;
        self.moved(transition, noise);
    }

    /// Propagates across a gap by dead reckoning.
    pub fn cross(
        &mut self,
        before: &MeasuredFrame,
        node: &MeasuredFrame,
        reckoned: &ReckonedPose,
        height_change: f64,
    ) {
        let heading_rad = before.heading_rad + self.state[HEADING];
        let turned = Se2::rotation(heading_rad);
        let (mx, my) = turned.rotate(reckoned.pose[X], reckoned.pose[Y]);
        let mut transition = StateMatrix::identity();
        transition.fixed_view_mut::<3, 3>(0, 0).copy_from(&Se2::lever_arm(mx, my));
        self.state[X] += mx;
        self.state[Y] += my;
        self.state[HEADING] = heading_rad + reckoned.pose[HEADING] - node.heading_rad;
        let mut noise = StateMatrix::zeros();
        let own = propagated(&turned.product_by_right(), &reckoned.covariance);
        noise.fixed_view_mut::<3, 3>(0, 0).copy_from(&own);
        if node.height_variance > 0.0 {
            // The height after the gap is assumed to equal the height before it.
            noise[(LN_SCALE, LN_SCALE)] = height_change.powi(2);
        }
        self.moved(transition, noise);
    }

    fn moved(&mut self, transition: StateMatrix, noise: StateMatrix) {
        self.covariance = propagated(&transition, &self.covariance) + noise;
        self.events.push(Event::Moved(transition));
    }

    fn measure(
        &mut self,
        row: FusionState,
        innovation: f64,
        variance: f64,
        consistency: impl Fn(&mut Self) -> &mut Consistency,
    ) {
        let across = self.covariance * row;
        let spread = row.dot(&across) + variance;
        let nis = innovation * innovation / spread;
        let counted = consistency(self);
        counted.readings += 1;
        counted.nis_sum += nis;
        if nis > CONSISTENT_NIS {
            counted.contradictions += 1;
            return;
        }
        let gain = across / spread;
        self.state += gain * innovation;
        let keep = StateMatrix::identity() - gain * row.transpose();
        self.covariance = keep * self.covariance * keep.transpose() + gain * gain.transpose() * variance;
        self.events.push(Event::Measured { row, innovation, spread, gain });
    }

    /// The correction at the newest node, as far as earlier ones tell it.
    pub fn present(&self) -> Corrected {
        Corrected::of(&self.state, &self.covariance)
    }

    /// Forgets what only the backward pass needs.
    pub fn forget(&mut self) {
        self.events.clear();
    }

    fn back(self, count: usize) -> Estimate {
        let (mut adjoint, mut information) = (FusionState::zeros(), StateMatrix::zeros());
        let mut corrected = Vec::with_capacity(count);
        let (heading_zero, range_zero) =
            [COMPASS, RANGE].map(|i| (self.state[i], self.covariance[(i, i)])).into();
        for event in self.events.iter().rev() {
            match event {
                Event::Moved(transition) => {
                    adjoint = transition.transpose() * adjoint;
                    information = transition.transpose() * information * transition;
                }
                Event::Measured { row, innovation, spread, gain } => {
                    let keep = StateMatrix::identity() - gain * row.transpose();
                    adjoint = keep.transpose() * adjoint - row * (innovation / spread);
                    information = keep.transpose() * information * keep + row * row.transpose() / *spread;
                }
                Event::MeasuredFrame(state, covariance) => {
                    let state = state - covariance * adjoint;
                    let covariance = covariance - covariance * information * covariance;
                    corrected.push(Corrected::of(&state, &covariance));
                }
            }
        }
        corrected.reverse();
        Estimate { corrected, heading: self.heading, range: self.range, heading_zero, range_zero }
    }
}

/// Standard deviation of the logarithm of the height's change over a gap of the given length: twice
/// the root mean square change over such a time where it is measured, at most
/// [`HEIGHT_CHANGE_PER_S`], which is also used where there are too few pairs of frames.
pub fn height_change(nodes: &[MeasuredFrame], gap_s: f64) -> f64 {
    let most = HEIGHT_CHANGE_PER_S * gap_s;
    let (mut later, mut squares, mut pairs) = (0, 0.0, 0);
    for node in nodes {
        while nodes.get(later).is_some_and(|other| other.time_s < node.time_s + gap_s) {
            later += 1;
        }
        if let Some(other) = nodes.get(later).filter(|other| other.segment == node.segment) {
            squares += (other.height_m / node.height_m).ln().powi(2);
            pairs += 1;
        }
    }
    if pairs < ENOUGH_PAIRS { most } else { (2.0 * (squares / f64::from(pairs)).sqrt()).min(most) }
}

/// Fewest pairs of frames from which the change of height is estimated: about a second of video.
const ENOUGH_PAIRS: u32 = 30;

/// Largest relative change of the height per second in a gap, one standard deviation.
const HEIGHT_CHANGE_PER_S: f64 = 0.02;

//! Segments of paths: their shape, and progress along them as a function of time.

use super::super::noise::Wobble;
use odograph::geometry::{PlaneTransform, Se2, wrap_angle};
use std::f64::consts::{FRAC_PI_2, TAU};

/// Shape of a segment, as a function of progress from 0 to the law's amount.
#[derive(Debug, Clone)]
pub(super) enum SegmentShape {
    Still,
    /// Progress in metres along a direction relative to the heading.
    Line {
        direction_rad: f64,
    },
    /// Progress in radians about a point in the segment's frame.
    Turn {
        about: (f64, f64),
        sign: f64,
    },
    /// Progress in radians of the lemniscate's parameter.
    Eight {
        half_length_m: f64,
    },
    /// Progress in metres along a curve that is tabulated at equal arc lengths.
    Curve {
        bend: Bend,
        step_m: f64,
        nodes: Vec<(f64, f64)>,
    },
}

/// Heading of a curve as a function of arc length.
#[derive(Debug, Clone)]
pub(super) enum Bend {
    /// A single turn; curvature rises and falls over the whole length.
    Once { length_m: f64, turn_rad: f64 },
    /// Smooth random heading.
    RandomWalk { wobble: Wobble, amplitude_rad: f64 },
    /// Heading and curvature at equal steps of arc length; curvature is linear between them.
    Steered { step_m: f64, nodes: Vec<(f64, f64)> },
}

/// Timing law: progress at a constant rate, with smooth ramps where the segment starts or ends at
/// rest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Law {
    pub(super) amount: f64,
    rate: f64,
    ramp_s: f64,
    from_rest: bool,
    to_rest: bool,
}

/// Maximum duration of a ramp between rest and full speed, seconds.
const RAMP_S: f64 = 0.5;

impl Law {
    pub(super) fn constant(amount: f64, rate: f64) -> Self {
        Self { amount, rate, ramp_s: 0.0, from_rest: false, to_rest: false }
    }

    pub(super) fn ramped(amount: f64, rate: f64, from_rest: bool, to_rest: bool) -> Self {
        // A ramp covers half the distance of full speed; short segments have shorter ramps.
        Self { amount, rate, ramp_s: RAMP_S.min(amount / rate), from_rest, to_rest }
    }

    pub(super) fn duration_s(&self) -> f64 {
        let ramps = f64::from(u8::from(self.from_rest) + u8::from(self.to_rest));
        self.amount / self.rate + 0.5 * self.ramp_s * ramps
    }

    pub(super) fn progress(&self, time_s: f64) -> f64 {
        let duration_s = self.duration_s();
        let time_s = time_s.clamp(0.0, duration_s);
        let left_s = duration_s - time_s;
        // The rate is the smoothstep 3t² − 2t³; this is its integral.
        let ramp = |t: f64| self.rate * self.ramp_s * (t * t * t - 0.5 * t * t * t * t);
        if self.from_rest && time_s < self.ramp_s {
            ramp(time_s / self.ramp_s)
        } else if self.to_rest && left_s < self.ramp_s {
            self.amount - ramp(left_s / self.ramp_s)
        } else if self.from_rest {
            self.rate * (time_s - 0.5 * self.ramp_s)
        } else {
            self.rate * time_s
        }
    }
}

impl SegmentShape {
    /// Pose after the given progress, relative to the start of the segment.
    pub(super) fn end(&self, progress: f64) -> Se2 {
        match self {
            Self::Still => Se2::IDENTITY,
            Self::Line { direction_rad } => Se2 {
                x_m: progress * direction_rad.cos(),
                y_m: progress * direction_rad.sin(),
                heading_rad: 0.0,
            },
            Self::Turn { about: (x, y), sign } => {
                let heading_rad = sign * progress;
                let (turned_x, turned_y) = Se2::rotation(heading_rad).rotate(*x, *y);
                // The point is invariant: position + R · point = point.
                Se2 { x_m: x - turned_x, y_m: y - turned_y, heading_rad }
            }
            Self::Eight { half_length_m } => {
                // x = a sin s, y = a/2 sin 2s leaves the crossing at 45°; rotated so that it starts
                // along x.
                let (a, s) = (*half_length_m, progress);
                let (x, y) = (a * s.sin(), 0.5 * a * (2.0 * s).sin());
                let (dx, dy) = (s.cos(), (2.0 * s).cos());
                let quarter = FRAC_PI_2 / 2.0;
                // The tangent turns right by 270° and then left by 270°; relative to the start its
                // angle is never positive.
                let raw = dy.atan2(dx) - quarter;
                let heading_rad = if raw > 0.1 { raw - TAU } else { raw };
                let (x_m, y_m) = Se2::rotation(-quarter).rotate(x, y);
                Se2 { x_m, y_m, heading_rad }
            }
            Self::Curve { bend, step_m, nodes } => {
                let node = ((progress / step_m) as usize).min(nodes.len() - 1);
                let from_m = node as f64 * step_m;
                let (dx, dy) = bend.integral(from_m, progress);
                Se2 {
                    x_m: nodes[node].0 + dx,
                    y_m: nodes[node].1 + dy,
                    heading_rad: bend.heading_rad(progress),
                }
            }
        }
    }

    pub(super) fn lap_length_m(&self) -> f64 {
        chords_m(2000, |i| self.end(TAU * i as f64 / 2000.0))
    }
}

/// Length of the polygon through the places with the numbers 0 to `count`, metres.
pub(super) fn chords_m(count: usize, place: impl Fn(usize) -> Se2) -> f64 {
    let chord_m = |[a, b]: [Se2; 2]| (b.x_m - a.x_m).hypot(b.y_m - a.y_m);
    (0..count).map(|i| chord_m([place(i), place(i + 1)])).sum()
}

/// A curve of that length: positions are tabulated every few centimetres and integrated exactly
/// between.
pub(super) fn curve(bend: Bend, length_m: f64) -> SegmentShape {
    let steps = (length_m / 0.05).ceil().max(16.0);
    let step_m = length_m / steps;
    let mut nodes = vec![(0.0, 0.0)];
    let mut at = (0.0, 0.0);
    for i in 0..steps as usize {
        let (dx, dy) = bend.integral(i as f64 * step_m, (i + 1) as f64 * step_m);
        at = (at.0 + dx, at.1 + dy);
        nodes.push(at);
    }
    SegmentShape::Curve { bend, step_m, nodes }
}

impl Bend {
    /// Random curvature, steered back towards the start where the distance from it approaches
    /// `radius_m`.
    pub(super) fn within(radius_m: f64, length_m: f64, seed: u64) -> Self {
        const STEP_M: f64 = 0.05;
        /// Maximum curvature, 1/m: a minimum turning radius of about 1.2 m.
        const MOST: f64 = 0.8;
        /// Arc length constant of the steering, metres: two cascaded low-pass filters smooth the
        /// requested curvature, which may jump.
        const EASE_M: f64 = 0.5;
        let wobble = Wobble::new(seed, 0.12);
        let (mut at, mut heading_rad, mut eased, mut curvature) = ((0.0f64, 0.0f64), 0.0f64, 0.0, 0.0);
        let mut nodes = vec![(heading_rad, curvature)];
        for step in 1..=(length_m / STEP_M).ceil() as usize + 1 {
            // Bearing of the start relative to the heading, positive to the left.
            let home_rad = wrap_angle((-at.1).atan2(-at.0) - heading_rad);
            let away = (at.0.hypot(at.1) / radius_m - 0.5).clamp(0.0, 0.2) / 0.2;
            let at_random = 1.6 * wobble.at(step as f64 * STEP_M);
            let wanted = MOST * ((1.0 - away) * at_random + away * home_rad).clamp(-1.0, 1.0);
            eased += (wanted - eased) * STEP_M / EASE_M;
            let next = curvature + (eased - curvature) * STEP_M / EASE_M;
            let piece = Self::Steered { step_m: STEP_M, nodes: vec![(heading_rad, curvature), (0.0, next)] };
            let (dx, dy) = piece.integral(0.0, STEP_M);
            at = (at.0 + dx, at.1 + dy);
            heading_rad += 0.5 * STEP_M * (curvature + next);
            curvature = next;
            nodes.push((heading_rad, curvature));
        }
        Self::Steered { step_m: STEP_M, nodes }
    }

    pub(super) fn heading_rad(&self, distance_m: f64) -> f64 {
        match self {
            Self::Once { length_m, turn_rad } => {
                let t = (distance_m / length_m).clamp(0.0, 1.0);
                // Quintic: curvature and its derivative are zero at both ends.
                turn_rad * t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
            }
            Self::RandomWalk { wobble, amplitude_rad } => {
                amplitude_rad * (wobble.at(distance_m) - wobble.at(0.0))
            }
            Self::Steered { step_m, nodes } => {
                let node = ((distance_m / step_m).max(0.0) as usize).min(nodes.len().saturating_sub(2));
                let (Some(from), Some(to)) = (nodes.get(node), nodes.get(node + 1)) else { return 0.0 };
                let along_m = distance_m - node as f64 * step_m;
                from.0 + along_m * (from.1 + 0.5 * along_m / step_m * (to.1 - from.1))
            }
        }
    }

    /// Displacement between two arc lengths: the integral of the direction by five-point
    /// Gauss–Legendre quadrature.
    pub(super) fn integral(&self, from_m: f64, to_m: f64) -> (f64, f64) {
        const NODES: [(f64, f64); 5] = [
            (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
            (-0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
            (0.0, 0.568_888_888_888_888_9),
            (0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
            (0.906_179_845_938_664, 0.236_926_885_056_189_1),
        ];
        let (middle, half) = (0.5 * (from_m + to_m), 0.5 * (to_m - from_m));
        NODES.iter().fold((0.0, 0.0), |sum, (node, weight)| {
            let heading = self.heading_rad(middle + half * node);
            (sum.0 + half * weight * heading.cos(), sum.1 + half * weight * heading.sin())
        })
    }
}

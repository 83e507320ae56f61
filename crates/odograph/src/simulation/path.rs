//! Where the camera goes: paths over the ground as smooth functions of time.
//!
//! Every path has continuous velocity and acceleration (it is C² in time): starts, stops and turns are ramped, never abrupt.

use super::noise::Wobble;
use crate::camera::Rig;
use crate::error::{Error, Result};
use crate::geometry::{GroundPoint, GroundPose};
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// The shape of a path. Lengths in metres, angles in radians, counter-clockwise positive. Forward is the carrier's forward.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "shape", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum PathKind {
    /// Stands still.
    Still {
        /// For how long, seconds.
        duration_s: f64,
    },
    /// Straight ahead.
    Straight {
        /// How far.
        length_m: f64,
    },
    /// Forward, left, back, right without ever turning: the paper's square. Rests at the corners.
    SquareByTranslation {
        /// Side of the square.
        side_m: f64,
    },
    /// Around a square with a left turn on the spot at every corner.
    SquareWithTurns {
        /// Side of the square.
        side_m: f64,
    },
    /// Turns about a ground point, given in the world; about the one that a corner of the image sees for the paper's
    /// Figure 14a: `camera.ray_from_pixel(corner)`, then `rig.first_pose().ground_from_ray(ray)`.
    Pivot {
        /// The ground point that stays where it is in the image.
        about: GroundPoint,
        /// How far it turns, any number of turns.
        turn_rad: f64,
    },
    /// The lemniscate of Gerono, started at its crossing: a closed path that crosses itself in the middle of every lap.
    FigureEight {
        /// From tip to tip.
        length_m: f64,
        /// How often.
        laps: f64,
    },
    /// Up and down a field in parallel lanes, with half turns to the left and right.
    Lanes {
        /// Straight part of every lane.
        length_m: f64,
        /// Distance between lanes.
        spacing_m: f64,
        /// How many.
        count: u32,
    },
    /// Forward with a heading that wanders smoothly and at random, as a mower without a plan goes.
    RandomWalk {
        /// How far.
        length_m: f64,
        /// Which of them.
        seed: u64,
    },
}

/// A path with its timing.
#[derive(Debug, Clone)]
pub struct Path {
    segments: Vec<Segment>,
    duration_s: f64,
    length_m: f64,
}

/// Position and direction on the ground, in the carrier's frame at the start.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    x_m: f64,
    y_m: f64,
    heading_rad: f64,
}

/// A piece of the path with its own law of progress.
#[derive(Debug, Clone)]
struct Segment {
    start_s: f64,
    start: Place,
    law: Law,
    motion: Motion,
}

/// How a piece of the path leads from its start; progress runs from 0 to the law's amount.
#[derive(Debug, Clone)]
enum Motion {
    Still,
    /// Progress in metres along a direction against the heading.
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
    /// Progress in metres along a curve that is tabulated at even distances.
    Curve {
        bend: Bend,
        step_m: f64,
        nodes: Vec<(f64, f64)>,
    },
}

/// Heading along a curve, by distance from its start.
#[derive(Debug, Clone)]
enum Bend {
    /// A turn whose rate swells and falls off over the whole length.
    Once { length_m: f64, turn_rad: f64 },
    /// Wandering heading.
    Wandering { wobble: Wobble, amplitude_rad: f64 },
}

/// Progress by time: constant rate, with smooth ramps where the segment starts or ends at rest.
#[derive(Debug, Clone, Copy)]
struct Law {
    amount: f64,
    rate: f64,
    ramp_s: f64,
    from_rest: bool,
    to_rest: bool,
}

/// Longest ramp between rest and full speed, seconds.
const RAMP_S: f64 = 0.5;

impl Path {
    /// The path of that shape at a speed over ground and, where it turns on the spot or about a point, a turn rate. With
    /// `at_rest` it starts and ends at rest; otherwise it is at full speed from the first frame to the last.
    ///
    /// Fails where a number is not positive and finite, or the path is longer than a day.
    pub fn new(kind: PathKind, speed_m_s: f64, turn_rate_rad_s: f64, at_rest: bool) -> Result<Self> {
        positive("speed", speed_m_s, "metres per second")?;
        positive("turn rate", turn_rate_rad_s, "radians per second")?;
        let mut path =
            Builder { speed_m_s, turn_rate_rad_s, segments: vec![], end: Place::ORIGIN, end_s: 0.0 };
        let line = |direction_rad: f64| Motion::Line { direction_rad };
        match kind {
            PathKind::Still { duration_s } => {
                positive("duration", duration_s, "seconds")?;
                path.add(Motion::Still, Law::constant(duration_s, 1.0));
            }
            PathKind::Straight { length_m } => {
                positive("length", length_m, "metres")?;
                path.add(line(0.0), path.drive(length_m, at_rest, at_rest));
            }
            PathKind::SquareByTranslation { side_m } => {
                positive("side", side_m, "metres")?;
                for side in 0..4 {
                    let law = path.drive(side_m, at_rest || side > 0, at_rest || side < 3);
                    path.add(line(f64::from(side) * FRAC_PI_2), law);
                }
            }
            PathKind::SquareWithTurns { side_m } => {
                positive("side", side_m, "metres")?;
                for side in 0..4 {
                    path.add(line(0.0), path.drive(side_m, at_rest || side > 0, true));
                    let law = path.turn(FRAC_PI_2, true, at_rest || side < 3);
                    path.add(Motion::Turn { about: (0.0, 0.0), sign: 1.0 }, law);
                }
            }
            PathKind::Pivot { about, turn_rad } => {
                if !(about.x_m.is_finite() && about.y_m.is_finite()) {
                    return Err(Error::usage("the pivot is not a point on the ground".to_string()));
                }
                positive("turn", turn_rad.abs(), "radians")?;
                let law = path.turn(turn_rad.abs(), at_rest, at_rest);
                path.add(Motion::Turn { about: (about.x_m, about.y_m), sign: turn_rad.signum() }, law);
            }
            PathKind::FigureEight { length_m, laps } => {
                positive("length", length_m, "metres")?;
                positive("number of laps", laps, "laps")?;
                let motion = Motion::Eight { half_length_m: length_m / 2.0 };
                // The mean speed over a lap is the speed asked for.
                let rate = speed_m_s * TAU / motion.lap_length_m();
                path.add(motion, Law::ramped(TAU * laps, rate, at_rest, at_rest));
            }
            PathKind::Lanes { length_m, spacing_m, count } => {
                positive("length", length_m, "metres")?;
                positive("spacing", spacing_m, "metres")?;
                if count == 0 || count > 10_000 {
                    return Err(Error::usage(format!("{count} lanes cannot be driven; 1 to 10000 can")));
                }
                for lane in 0..count {
                    let (first, last) = (lane == 0, lane + 1 == count);
                    path.add(line(0.0), path.drive(length_m, at_rest && first, at_rest && last));
                    if !last {
                        let turn_rad = if lane % 2 == 0 { PI } else { -PI };
                        // A half turn of length 1 ends this far to the side; all of it scales with its length.
                        let side = curve(Bend::Once { length_m: 1.0, turn_rad }, 1.0).end(1.0).y_m.abs();
                        let turn_m = spacing_m / side;
                        path.add(
                            curve(Bend::Once { length_m: turn_m, turn_rad }, turn_m),
                            path.drive(turn_m, false, false),
                        );
                    }
                }
            }
            PathKind::RandomWalk { length_m, seed } => {
                positive("length", length_m, "metres")?;
                // One change of direction in about two metres, up to 150° to either side.
                let bend = Bend::Wandering { wobble: Wobble::new(seed, 0.25), amplitude_rad: 2.6 };
                path.add(curve(bend, length_m), path.drive(length_m, at_rest, at_rest));
            }
        }
        let duration_s = path.end_s;
        if !(duration_s < 86_400.0) {
            return Err(Error::usage(format!(
                "the path would take {duration_s:.0} s; make it shorter or faster, a day is the limit"
            )));
        }
        let mut path = Self { segments: path.segments, duration_s, length_m: 0.0 };
        path.length_m = path.measured_length_m();
        Ok(path)
    }

    /// How long the path takes, seconds.
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// Length of the camera's way over the ground, metres.
    pub fn length_m(&self) -> f64 {
        self.length_m
    }

    /// The pose of a camera mounted as `rig` says, at a time in seconds; before the start and after the end the camera stands.
    ///
    /// The world is that of [`crate::geometry`]: at time 0 the camera is over the origin and the top of its image points along x.
    pub fn pose(&self, time_s: f64, rig: &Rig) -> GroundPose {
        let place = self.place(time_s);
        // The world's x is where the image's top points, which the mount yaw turns away from the carrier's forward.
        let (sin, cos) = (-rig.yaw_rad).sin_cos();
        GroundPose {
            x_m: cos * place.x_m - sin * place.y_m,
            y_m: sin * place.x_m + cos * place.y_m,
            heading_rad: place.heading_rad,
            ..rig.first_pose()
        }
    }

    fn place(&self, time_s: f64) -> Place {
        let time_s = time_s.clamp(0.0, self.duration_s);
        let next = self.segments.partition_point(|segment| segment.start_s <= time_s);
        let segment = &self.segments[next.saturating_sub(1)];
        segment.start.then(segment.motion.end(segment.law.progress(time_s - segment.start_s)))
    }

    fn measured_length_m(&self) -> f64 {
        let steps = (self.duration_s * 50.0).ceil().clamp(1.0, 1e6) as usize;
        let place = |i: usize| self.place(self.duration_s * i as f64 / steps as f64);
        (0..steps)
            .map(|i| {
                let (a, b) = (place(i), place(i + 1));
                (b.x_m - a.x_m).hypot(b.y_m - a.y_m)
            })
            .sum()
    }
}

fn positive(name: &str, value: f64, unit: &str) -> Result<()> {
    if value.is_finite() && value > 0.0 && value < 1e7 {
        return Ok(());
    }
    Err(Error::usage(format!("the path's {name} is {value}; it must be a positive number of {unit}")))
}

struct Builder {
    speed_m_s: f64,
    turn_rate_rad_s: f64,
    segments: Vec<Segment>,
    end: Place,
    end_s: f64,
}

impl Builder {
    fn drive(&self, length_m: f64, from_rest: bool, to_rest: bool) -> Law {
        Law::ramped(length_m, self.speed_m_s, from_rest, to_rest)
    }

    fn turn(&self, angle_rad: f64, from_rest: bool, to_rest: bool) -> Law {
        Law::ramped(angle_rad, self.turn_rate_rad_s, from_rest, to_rest)
    }

    fn add(&mut self, motion: Motion, law: Law) {
        let start = self.end;
        self.end = start.then(motion.end(law.amount));
        self.segments.push(Segment { start_s: self.end_s, start, law, motion });
        self.end_s += law.duration_s();
    }
}

impl Place {
    const ORIGIN: Self = Self { x_m: 0.0, y_m: 0.0, heading_rad: 0.0 };

    /// A place given in the frame of this one.
    fn then(self, local: Self) -> Self {
        let (sin, cos) = self.heading_rad.sin_cos();
        Self {
            x_m: self.x_m + cos * local.x_m - sin * local.y_m,
            y_m: self.y_m + sin * local.x_m + cos * local.y_m,
            heading_rad: self.heading_rad + local.heading_rad,
        }
    }
}

impl Law {
    fn constant(amount: f64, rate: f64) -> Self {
        Self { amount, rate, ramp_s: 0.0, from_rest: false, to_rest: false }
    }

    fn ramped(amount: f64, rate: f64, from_rest: bool, to_rest: bool) -> Self {
        // Ramps take as much time as they cost distance twice; a short way gets shorter ones.
        Self { amount, rate, ramp_s: RAMP_S.min(amount / rate), from_rest, to_rest }
    }

    fn duration_s(&self) -> f64 {
        let ramps = f64::from(u8::from(self.from_rest) + u8::from(self.to_rest));
        self.amount / self.rate + 0.5 * self.ramp_s * ramps
    }

    fn progress(&self, time_s: f64) -> f64 {
        let duration_s = self.duration_s();
        let time_s = time_s.clamp(0.0, duration_s);
        let left_s = duration_s - time_s;
        // The rate follows 3t² − 2t³ up and down; this is its integral.
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

impl Motion {
    /// Where this leads after that much progress, from the start of the segment.
    fn end(&self, progress: f64) -> Place {
        match self {
            Self::Still => Place::ORIGIN,
            Self::Line { direction_rad } => Place {
                x_m: progress * direction_rad.cos(),
                y_m: progress * direction_rad.sin(),
                heading_rad: 0.0,
            },
            Self::Turn { about: (x, y), sign } => {
                let heading_rad = sign * progress;
                let (sin, cos) = heading_rad.sin_cos();
                // The point stays: place + R · point = point.
                Place { x_m: x - (cos * x - sin * y), y_m: y - (sin * x + cos * y), heading_rad }
            }
            Self::Eight { half_length_m } => {
                // x = a sin s, y = a/2 sin 2s leaves the crossing at 45°; turned so that it leaves along x.
                let (a, s) = (*half_length_m, progress);
                let (x, y) = (a * s.sin(), 0.5 * a * (2.0 * s).sin());
                let (dx, dy) = (s.cos(), (2.0 * s).cos());
                let quarter = FRAC_PI_2 / 2.0;
                // The tangent turns right by 270° and then left by as much; its angle against the start never is positive.
                let raw = dy.atan2(dx) - quarter;
                let heading_rad = if raw > 0.1 { raw - TAU } else { raw };
                let (sin, cos) = (-quarter).sin_cos();
                Place { x_m: cos * x - sin * y, y_m: sin * x + cos * y, heading_rad }
            }
            Self::Curve { bend, step_m, nodes } => {
                let node = ((progress / step_m) as usize).min(nodes.len() - 1);
                let from_m = node as f64 * step_m;
                let (dx, dy) = bend.integral(from_m, progress);
                Place {
                    x_m: nodes[node].0 + dx,
                    y_m: nodes[node].1 + dy,
                    heading_rad: bend.heading_rad(progress),
                }
            }
        }
    }

    fn lap_length_m(&self) -> f64 {
        let n = 2000;
        let place = |i: usize| self.end(TAU * i as f64 / n as f64);
        (0..n)
            .map(|i| {
                let (a, b) = (place(i), place(i + 1));
                (b.x_m - a.x_m).hypot(b.y_m - a.y_m)
            })
            .sum()
    }
}

/// A curve of that length: positions tabulated every few centimetres, exact between them.
fn curve(bend: Bend, length_m: f64) -> Motion {
    let steps = (length_m / 0.05).ceil().max(16.0);
    let step_m = length_m / steps;
    let mut nodes = vec![(0.0, 0.0)];
    let mut at = (0.0, 0.0);
    for i in 0..steps as usize {
        let (dx, dy) = bend.integral(i as f64 * step_m, (i + 1) as f64 * step_m);
        at = (at.0 + dx, at.1 + dy);
        nodes.push(at);
    }
    Motion::Curve { bend, step_m, nodes }
}

impl Bend {
    fn heading_rad(&self, distance_m: f64) -> f64 {
        match self {
            Self::Once { length_m, turn_rad } => {
                let t = (distance_m / length_m).clamp(0.0, 1.0);
                // Quintic: curvature and its change are zero at both ends.
                turn_rad * t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
            }
            Self::Wandering { wobble, amplitude_rad } => {
                amplitude_rad * (wobble.at(distance_m) - wobble.at(0.0))
            }
        }
    }

    /// The way between two distances: the integral of the direction, by Gauss–Legendre quadrature with five points.
    fn integral(&self, from_m: f64, to_m: f64) -> (f64, f64) {
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

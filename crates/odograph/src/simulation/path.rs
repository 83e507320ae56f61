//! Where the camera goes: paths over the ground as smooth functions of time.
//!
//! Every path has continuous velocity and acceleration (it is C² in time): starts, stops and turns are ramped, never abrupt.

mod motion;

use super::noise::Wobble;
use crate::camera::Rig;
use crate::error::{Error, Result};
use crate::geometry::{GroundPoint, GroundPose, PlaneTransform, Se2};
use motion::{Bend, Law, Motion, curve};
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
    /// The same without leaving a round yard about the start, as a mower with a fence goes: it crosses its own way again and again.
    RandomWithin {
        /// How far.
        length_m: f64,
        /// How far the yard reaches. A turn takes 1.2 m to either side, and the wheel another metre, so it is 10 m at least.
        radius_m: f64,
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
    /// Whether places are in the world already, not in the frame of the carrier at the start.
    in_world: bool,
}

/// A piece of the path with its own law of progress.
#[derive(Debug, Clone)]
struct Segment {
    start_s: f64,
    start: Se2,
    law: Law,
    motion: Motion,
}

impl Path {
    /// The path of that shape at a speed over ground and, where it turns on the spot or about a point, a turn rate. With
    /// `at_rest` it starts and ends at rest; otherwise it is at full speed from the first frame to the last.
    ///
    /// Fails where a number is not positive and finite, or the path is longer than a day.
    pub fn new(kind: PathKind, speed_m_s: f64, turn_rate_rad_s: f64, at_rest: bool) -> Result<Self> {
        positive("speed", speed_m_s, "metres per second")?;
        positive("turn rate", turn_rate_rad_s, "radians per second")?;
        let mut path =
            Builder { speed_m_s, turn_rate_rad_s, segments: vec![], end: Se2::IDENTITY, end_s: 0.0 };
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
            PathKind::RandomWithin { length_m, radius_m, seed } => {
                positive("length", length_m, "metres")?;
                if !(10.0..=1e6).contains(&radius_m) {
                    return Err(Error::usage(format!(
                        "the yard's radius is {radius_m}; it must lie between 10 and 1000000 metres"
                    )));
                }
                path.add(
                    curve(Bend::within(radius_m, length_m, seed), length_m),
                    path.drive(length_m, at_rest, at_rest),
                );
            }
        }
        let duration_s = path.end_s;
        if duration_s.is_nan() || duration_s > 86_400.0 {
            return Err(Error::usage(format!(
                "the path would take {duration_s:.0} s; make it shorter or faster, a day is the limit"
            )));
        }
        // A pivot is given in the world; all other shapes run along the carrier's forward.
        let in_world = matches!(kind, PathKind::Pivot { .. });
        let mut path = Self { segments: path.segments, duration_s, length_m: 0.0, in_world };
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
        let forward_rad = if self.in_world { 0.0 } else { -rig.yaw_rad };
        let (x_m, y_m) = Se2::rotation(forward_rad).rotate(place.x_m, place.y_m);
        GroundPose { x_m, y_m, heading_rad: place.heading_rad, ..rig.first_pose() }
    }

    fn place(&self, time_s: f64) -> Se2 {
        let time_s = time_s.clamp(0.0, self.duration_s);
        let next = self.segments.partition_point(|segment| segment.start_s <= time_s);
        let segment = &self.segments[next.saturating_sub(1)];
        segment.start * segment.motion.end(segment.law.progress(time_s - segment.start_s))
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
    end: Se2,
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
        self.end = start * motion.end(law.amount);
        self.segments.push(Segment { start_s: self.end_s, start, law, motion });
        self.end_s += law.duration_s();
    }
}

#[cfg(test)]
mod tests;

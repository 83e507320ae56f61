//! Paths of the camera over the ground as smooth functions of time.
//!
//! Every path is C² in time: velocity and acceleration are continuous, and starts, stops and turns
//! are ramped.

mod motion;

use super::noise::Wobble;
use motion::{Bend, Law, SegmentShape, chords_m, curve};
use odograph::camera::Rig;
use odograph::error::{Error, Result};
use odograph::geometry::{GroundPoint, GroundPose, PlaneTransform, Se2};
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// The shape of a path. Lengths in metres, angles in radians, positive counter-clockwise. Forward
/// is the vehicle's forward direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "shape", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum PathKind {
    /// At rest.
    Still {
        /// Duration, seconds.
        duration_s: f64,
    },
    /// Straight ahead.
    Straight {
        /// Length, metres.
        length_m: f64,
    },
    /// Forward, left, back, right with constant heading: the square of the paper. At rest in the
    /// corners.
    SquareByTranslation {
        /// Side of the square, metres.
        side_m: f64,
    },
    /// Around a square with a left turn in place at every corner.
    SquareWithTurns {
        /// Side of the square, metres.
        side_m: f64,
    },
    /// Rotation about a point on the ground, in world coordinates. For Figure 14a of the paper it
    /// is the point seen in a corner of the image: `camera.ray_from_pixel(corner)`, then
    /// `rig.first_pose().ground_from_ray(ray)`.
    Pivot {
        /// Centre of rotation; it stays at the same pixel.
        about: GroundPoint,
        /// Total angle, radians; any number of turns.
        turn_rad: f64,
    },
    /// Lemniscate of Gerono, started at its crossing: a closed path that crosses itself in the
    /// middle of every lap.
    FigureEight {
        /// Length from tip to tip, metres.
        length_m: f64,
        /// Number of laps.
        laps: f64,
    },
    /// Parallel lanes back and forth over a field, with U-turns alternating to the left and right.
    Lanes {
        /// Length of the straight part of each lane, metres.
        length_m: f64,
        /// Distance between lanes, metres.
        spacing_m: f64,
        /// Number of lanes.
        count: u32,
    },
    /// Forward with a smooth random heading, as an unguided robotic mower drives.
    RandomWalk {
        /// Path length, metres.
        length_m: f64,
        /// Seed of the random heading.
        seed: u64,
    },
    /// A random walk confined to a disc around the start, as of a robotic mower with a boundary: it
    /// crosses its own path many times.
    RandomWithin {
        /// Path length, metres.
        length_m: f64,
        /// Radius of the disc, metres; at least 10, because the minimum turning radius is 1.2 m and
        /// the steering takes another metre.
        radius_m: f64,
        /// Seed of the random heading.
        seed: u64,
    },
}

/// A path with its timing.
#[derive(Debug, Clone)]
pub struct Path {
    segments: Vec<Segment>,
    duration_s: f64,
    length_m: f64,
    /// Whether positions are in the world frame already, not in the vehicle frame at the start.
    in_world: bool,
}

/// A segment of the path with its own timing law.
#[derive(Debug, Clone)]
struct Segment {
    start_s: f64,
    start: Se2,
    law: Law,
    motion: SegmentShape,
}

impl Path {
    /// The path of that shape at a speed over ground, and at a turn rate where it turns in place or
    /// about a point. With `at_rest` it starts and ends at rest; otherwise it is at full speed from
    /// the first frame to the last.
    ///
    /// Fails where a value is not positive and finite, or the path takes more than a day.
    pub fn new(kind: PathKind, speed_m_s: f64, turn_rate_rad_s: f64, at_rest: bool) -> Result<Self> {
        positive("speed", speed_m_s, "metres per second")?;
        positive("turn rate", turn_rate_rad_s, "radians per second")?;
        let mut path =
            Builder { speed_m_s, turn_rate_rad_s, segments: vec![], end: Se2::IDENTITY, end_s: 0.0 };
        path.add_kind(kind, at_rest)?;
        let duration_s = path.end_s;
        if duration_s.is_nan() || duration_s > 86_400.0 {
            return Err(Error::usage(format!(
                "the path would take {duration_s:?} s; make it shorter or faster, a day is the limit"
            )));
        }
        // A pivot is in world coordinates; all other shapes start along the vehicle's forward
        // direction.
        let in_world = matches!(kind, PathKind::Pivot { .. });
        let mut path = Self { segments: path.segments, duration_s, length_m: 0.0, in_world };
        path.length_m = path.measured_length_m();
        Ok(path)
    }

    /// Duration of the path, seconds.
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// Length of the camera's path over the ground, metres.
    pub fn length_m(&self) -> f64 {
        self.length_m
    }

    /// Pose at a time, seconds, of a camera mounted as in `rig`. A path from rest to rest is at
    /// rest before its start and after its end.
    ///
    /// The world frame is that of [`odograph::geometry`]: at time 0 the camera is above the origin
    /// and the top of its image points along x.
    pub fn pose(&self, time_s: f64, rig: &Rig) -> GroundPose {
        let place = self.place_beyond(time_s);
        // World x is the direction of the image's top, which the mount yaw rotates away from the
        // vehicle's forward direction.
        let forward_rad = if self.in_world { 0.0 } else { -rig.yaw_rad };
        let (x_m, y_m) = Se2::rotation(forward_rad).rotate(place.x_m, place.y_m);
        GroundPose { x_m, y_m, heading_rad: place.heading_rad, ..rig.first_pose() }
    }

    /// The place at a time that may be a little before the first frame or after the last one, when
    /// rows of these are exposed: the camera goes on at the same rates.
    fn place_beyond(&self, time_s: f64) -> Se2 {
        let nearest_s = time_s.clamp(0.0, self.duration_s);
        let beyond_s = (time_s - nearest_s).clamp(-MARGIN_S, MARGIN_S);
        let place = self.place(nearest_s);
        if beyond_s == 0.0 {
            return place;
        }
        let inside = self.place(nearest_s - DIFFERENCE_S.copysign(beyond_s));
        let steps = beyond_s.abs() / DIFFERENCE_S;
        Se2 {
            x_m: place.x_m + steps * (place.x_m - inside.x_m),
            y_m: place.y_m + steps * (place.y_m - inside.y_m),
            heading_rad: place.heading_rad + steps * (place.heading_rad - inside.heading_rad),
        }
    }

    fn place(&self, time_s: f64) -> Se2 {
        let time_s = time_s.clamp(0.0, self.duration_s);
        let next = self.segments.partition_point(|segment| segment.start_s <= time_s);
        let segment = &self.segments[next.saturating_sub(1)];
        segment.start * segment.motion.end(segment.law.progress(time_s - segment.start_s))
    }

    fn measured_length_m(&self) -> f64 {
        let steps = (self.duration_s * 50.0).ceil().clamp(1.0, 1e6) as usize;
        chords_m(steps, |i| self.place(self.duration_s * i as f64 / steps as f64))
    }
}

fn line(direction_rad: f64) -> SegmentShape {
    SegmentShape::Line { direction_rad }
}

/// No measure of a path is larger, in its unit.
const LARGEST: f64 = 1e7;

fn positive(name: &str, value: f64, unit: &str) -> Result<()> {
    if value.is_finite() && value > 0.0 && value < LARGEST {
        return Ok(());
    }
    Err(Error::usage(format!(
        "the path's {name} is {value:?}; it must be a positive number of {unit}, below {LARGEST}"
    )))
}

/// Rows of a frame are exposed within this time about its middle, seconds.
const MARGIN_S: f64 = 0.05;

/// Time over which the rates at the ends are differences, seconds.
const DIFFERENCE_S: f64 = 1e-4;

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

    fn add(&mut self, motion: SegmentShape, law: Law) {
        let start = self.end;
        self.end = start * motion.end(law.amount);
        self.segments.push(Segment { start_s: self.end_s, start, law, motion });
        self.end_s += law.duration_s();
    }

    /// Adds the segments of a whole path.
    fn add_kind(&mut self, kind: PathKind, at_rest: bool) -> Result<()> {
        match kind {
            PathKind::Still { duration_s } => {
                positive("duration", duration_s, "seconds")?;
                self.add(SegmentShape::Still, Law::constant(duration_s, 1.0));
            }
            PathKind::Straight { length_m } => {
                positive("length", length_m, "metres")?;
                self.add(line(0.0), self.drive(length_m, at_rest, at_rest));
            }
            PathKind::SquareByTranslation { side_m } => {
                positive("side", side_m, "metres")?;
                for side in 0..4 {
                    let law = self.drive(side_m, at_rest || side > 0, at_rest || side < 3);
                    self.add(line(f64::from(side) * FRAC_PI_2), law);
                }
            }
            PathKind::SquareWithTurns { side_m } => {
                positive("side", side_m, "metres")?;
                for side in 0..4 {
                    self.add(line(0.0), self.drive(side_m, at_rest || side > 0, true));
                    let law = self.turn(FRAC_PI_2, true, at_rest || side < 3);
                    self.add(SegmentShape::Turn { about: (0.0, 0.0), sign: 1.0 }, law);
                }
            }
            PathKind::Pivot { about, turn_rad } => {
                if !(about.x_m.is_finite() && about.y_m.is_finite()) {
                    return Err(Error::usage("the pivot is not a point on the ground".to_string()));
                }
                positive("turn", turn_rad.abs(), "radians")?;
                let law = self.turn(turn_rad.abs(), at_rest, at_rest);
                self.add(SegmentShape::Turn { about: (about.x_m, about.y_m), sign: turn_rad.signum() }, law);
            }
            PathKind::FigureEight { length_m, laps } => {
                positive("length", length_m, "metres")?;
                positive("number of laps", laps, "laps")?;
                let motion = SegmentShape::Eight { half_length_m: length_m / 2.0 };
                // The mean speed over a lap is the configured speed.
                let rate = self.speed_m_s * TAU / motion.lap_length_m();
                self.add(motion, Law::ramped(TAU * laps, rate, at_rest, at_rest));
            }
            PathKind::Lanes { length_m, spacing_m, count } => {
                self.add_lanes(length_m, spacing_m, count, at_rest)?;
            }
            PathKind::RandomWalk { length_m, seed } => {
                positive("length", length_m, "metres")?;
                // About one change of direction in two metres, by up to 150° to either side.
                let bend = Bend::RandomWalk { wobble: Wobble::new(seed, 0.25), amplitude_rad: 2.6 };
                self.add(curve(bend, length_m), self.drive(length_m, at_rest, at_rest));
            }
            PathKind::RandomWithin { length_m, radius_m, seed } => {
                positive("length", length_m, "metres")?;
                if !(10.0..=1e6).contains(&radius_m) {
                    return Err(Error::usage(format!(
                        "the yard's radius is {radius_m}; it must lie between 10 and 1000000 metres"
                    )));
                }
                let bend = Bend::within(radius_m, length_m, seed);
                self.add(curve(bend, length_m), self.drive(length_m, at_rest, at_rest));
            }
        }
        Ok(())
    }

    fn add_lanes(&mut self, length_m: f64, spacing_m: f64, count: u32, at_rest: bool) -> Result<()> {
        positive("length", length_m, "metres")?;
        positive("spacing", spacing_m, "metres")?;
        if count == 0 || count > 10_000 {
            return Err(Error::usage(format!("{count} lanes cannot be driven; 1 to 10000 can")));
        }
        for lane in 0..count {
            let (first, last) = (lane == 0, lane + 1 == count);
            self.add(line(0.0), self.drive(length_m, at_rest && first, at_rest && last));
            if !last {
                let turn_rad = if lane % 2 == 0 { PI } else { -PI };
                // Lateral displacement of a U-turn of length 1; it scales with the length.
                let side = curve(Bend::Once { length_m: 1.0, turn_rad }, 1.0).end(1.0).y_m.abs();
                let turn_m = spacing_m / side;
                let turn = curve(Bend::Once { length_m: turn_m, turn_rad }, turn_m);
                self.add(turn, self.drive(turn_m, false, false));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;

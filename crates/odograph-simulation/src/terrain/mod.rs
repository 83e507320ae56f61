//! Uneven ground as a height field: stones, undulation, kerbs and ramps.

use super::noise::{cell, interpolated, mix, smooth_step};
use nalgebra::{Rotation3, Vector3};
use odograph::error::{Error, Result};
use odograph::geometry::{GroundPoint, GroundPose, wrap_angle};
use serde::{Deserialize, Serialize};

/// The shape of the ground; [`Terrain::default`] is the plane z = 0.
///
/// Undulation, kerb and ramp form the level of the ground, which is 0 at the world origin. Relief
/// is added to the level and has zero mean.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Terrain {
    /// Stones and gravel.
    pub relief: Option<Relief>,
    /// Long-wavelength undulation.
    pub undulation: Option<Undulation>,
    /// A step across the path.
    pub kerb: Option<Kerb>,
    /// An incline across the path.
    pub ramp: Option<Ramp>,
    /// Whether the camera follows the level of the ground on wheels 0.5 m apart: it keeps its
    /// height above the mean level under the wheels and tilts with them. Otherwise it keeps its
    /// height above z = 0 and its orientation.
    pub ride: bool,
}

/// Stones and gravel: smooth bumps with directional shading.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Relief {
    /// Maximum height above and depth below the level, metres.
    pub amplitude_m: f64,
    /// Spacing of the stones, metres.
    pub scale_m: f64,
}

/// Long-wavelength height variation: sines in three directions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Undulation {
    /// Maximum height above and depth below z = 0, metres.
    pub amplitude_m: f64,
    /// Wavelength, metres.
    pub wavelength_m: f64,
}

/// A step along the line x = `at_m`; its face has a horizontal depth of 10 mm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Kerb {
    /// Height of the ground beyond the line, metres; negative is a step down.
    pub height_m: f64,
    /// World x of the middle of the face, metres.
    pub at_m: f64,
}

/// An incline that begins at the line x = `at_m` and does not end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ramp {
    /// Slope, rise over run; negative is downhill.
    pub slope: f64,
    /// World x of the beginning, metres; rounded over 10 cm to either side.
    pub at_m: f64,
}

impl Terrain {
    /// Whether the ground is the plane z = 0.
    pub fn is_flat(&self) -> bool {
        self.relief.is_none() && self.undulation.is_none() && self.kerb.is_none() && self.ramp.is_none()
    }

    /// Checks that every value is in range; the error names the first that is not.
    pub fn validated(self) -> Result<Self> {
        let mut checks = vec![];
        if let Some(Relief { amplitude_m, scale_m }) = self.relief {
            checks.push(("relief's scale", scale_m, 1e-3, 10.0, "m"));
            // Higher amplitudes would be mostly self-occlusion.
            checks.push(("relief", amplitude_m, 0.0, scale_m, "m"));
        }
        if let Some(Undulation { amplitude_m, wavelength_m }) = self.undulation {
            checks.push(("undulation's wavelength", wavelength_m, 0.1, 1e4, "m"));
            checks.push(("undulation", amplitude_m, 0.0, 0.1 * wavelength_m, "m"));
        }
        if let Some(Kerb { height_m, at_m }) = self.kerb {
            checks.push(("kerb", height_m, -10.0, 10.0, "m"));
            checks.push(("kerb's place", at_m, -1e6, 1e6, "m"));
        }
        if let Some(Ramp { slope, at_m }) = self.ramp {
            checks.push(("ramp's slope", slope, -1.0, 1.0, ""));
            checks.push(("ramp's beginning", at_m, -1e6, 1e6, "m"));
        }
        match checks.into_iter().find(|(_, value, least, most, _)| !(least..=most).contains(&value)) {
            None => Ok(self),
            Some((name, value, least, most, unit)) => {
                let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
                Err(Error::usage(format!(
                    "the {name} is {value:?}{unit}; it must be between {least} and {most}{unit}"
                )))
            }
        }
    }
}

/// Half the wheelbase and half the track width of the vehicle that carries the camera, metres.
const HALF_WHEELBASE_M: f64 = 0.25;
/// Horizontal depth of the face of a kerb, metres.
const KERB_FACE_M: f64 = 0.01;
/// Distance over which a wheel climbs a kerb, metres.
const KERB_CLIMB_M: f64 = 0.12;
/// Half the length over which the beginning of a ramp is rounded, metres.
const RAMP_ROUNDING_M: f64 = 0.1;
/// Tolerance of the intersection of a ray with the surface, metres.
const PRECISION_M: f64 = 1e-6;
/// Maximum number of steps along a ray; shallower rays do not resolve the ground in detail.
const MAX_STEPS: f64 = 64.0;

/// A terrain with its random functions; does not exist for flat ground.
#[derive(Debug)]
pub(super) struct TerrainSurface {
    waves: Vec<Wave>,
    kerb: Option<Kerb>,
    ramp: Option<Ramp>,
    stones: Option<Stones>,
    /// Mean level under the wheels of a vehicle at the origin, metres; `None` where the camera does
    /// not ride.
    ridden_from_m: Option<f64>,
    /// Horizontal step along a ray within which the surface is taken as monotonic, metres.
    step_m: f64,
}

/// A wave of the undulation.
#[derive(Debug, Clone, Copy)]
struct Wave {
    amplitude_m: f64,
    /// Spatial frequency along x and y, waves per metre.
    per_m: [f64; 2],
}

impl TerrainSurface {
    /// `None` where the terrain is flat.
    pub(super) fn new(terrain: &Terrain, seed: u64) -> Option<Self> {
        if terrain.is_flat() {
            return None;
        }
        let waves = terrain.undulation.map_or(vec![], |Undulation { amplitude_m, wavelength_m }| {
            // Amplitudes sum to 1. Directions are 50° to 70° apart, so that no path runs along a
            // crest.
            [(0.55, 0.2, 1.0), (0.27, 1.2, 0.81), (0.18, -0.9, 1.27)]
                .map(|(strength, direction, length): (f64, f64, f64)| {
                    let (sin, cos) = direction.sin_cos();
                    let per_m = 1.0 / (length * wavelength_m);
                    Wave { amplitude_m: strength * amplitude_m, per_m: [cos * per_m, sin * per_m] }
                })
                .to_vec()
        });
        let steps = [
            terrain.relief.map(|relief| relief.scale_m / 8.0),
            terrain.kerb.map(|_| KERB_FACE_M / 2.0),
            terrain.undulation.map(|undulation| undulation.wavelength_m / 16.0),
            Some(RAMP_ROUNDING_M),
        ];
        let mut surface = Self {
            waves,
            kerb: terrain.kerb,
            ramp: terrain.ramp,
            stones: terrain.relief.map(|relief| Stones::new(relief, mix(seed ^ 0x0005_704E))),
            ridden_from_m: None,
            step_m: steps.into_iter().flatten().fold(f64::INFINITY, f64::min),
        };
        if terrain.ride {
            surface.ridden_from_m = Some(surface.wheels(&GroundPose::level(0.0)).0);
        }
        Some(surface)
    }

    /// Level of the ground at a point, without relief, metres above z = 0.
    pub(super) fn level_m(&self, x_m: f64, y_m: f64) -> f64 {
        self.level_with_face(x_m, y_m, KERB_FACE_M)
    }

    /// Height of the ground at a point, metres above z = 0.
    pub(super) fn height_m(&self, x_m: f64, y_m: f64) -> f64 {
        self.level_m(x_m, y_m) + self.stones.as_ref().map_or(0.0, |stones| stones.at(x_m, y_m)[0])
    }

    /// Relative brightness of the surface at a point, 1 where it is level.
    pub(super) fn shade(&self, x_m: f64, y_m: f64) -> f32 {
        let mut shade = self.stones.as_ref().map_or(1.0, |stones| stones.at(x_m, y_m)[1]);
        if let Some(kerb) = self.kerb {
            // A vertical face receives less light than level ground.
            let across = 2.0 * (x_m - kerb.at_m).abs() / KERB_FACE_M;
            shade *= 1.0 - 0.45 * smooth_step(1.5 - across);
        }
        shade as f32
    }

    /// Bounds of the surface height over an axis-aligned area, metres.
    pub(super) fn bounds(&self, (x0, x1): (f64, f64), (y0, y1): (f64, f64)) -> (f64, f64) {
        let (x, y) = (0.5 * (x0 + x1), 0.5 * (y0 + y1));
        let (mut low, mut high) = (0.0, 0.0);
        for wave in &self.waves {
            let middle = wave.at(x, y);
            // The slope of a wave is at most 2π amplitude / wavelength (3 % more for [`sine`]).
            let turns = wave.per_m[0].abs() * 0.5 * (x1 - x0) + wave.per_m[1].abs() * 0.5 * (y1 - y0);
            let reach_m = 6.5 * wave.amplitude_m * turns;
            low += (middle - reach_m).max(-wave.amplitude_m);
            high += (middle + reach_m).min(wave.amplitude_m);
        }
        let monotone = |before: f64, after: f64| (before.min(after), before.max(after));
        for (least, most) in [
            monotone(self.kerb_m(x0, KERB_FACE_M), self.kerb_m(x1, KERB_FACE_M)),
            monotone(self.ramp_m(x0), self.ramp_m(x1)),
        ] {
            low += least;
            high += most;
        }
        let stones_m = self.stones.as_ref().map_or(0.0, |stones| stones.amplitude_m);
        (low - stones_m, high + stones_m)
    }

    /// First intersection of a ray from `camera` with the surface: its height above z = 0, metres.
    /// `bounds` must bound the surface along the ray. `per_drop` is the horizontal displacement (x,
    /// y) per metre of descent.
    pub(super) fn meet(&self, camera: [f64; 3], per_drop: [f64; 2], (low, high): (f64, f64)) -> f64 {
        if high - low < PRECISION_M {
            return low;
        }
        let gap = |z: f64| {
            let drop = camera[2] - z;
            z - self.height_m(camera[0] + drop * per_drop[0], camera[1] + drop * per_drop[1])
        };
        let way_m = (high - low) * (per_drop[0] * per_drop[0] + per_drop[1] * per_drop[1]).sqrt();
        let steps = (way_m / self.step_m).ceil().clamp(1.0, MAX_STEPS);
        let (mut above, mut below) = ((high, gap(high)), (low, 0.0));
        let mut step = 1.0;
        while step <= steps {
            let z = high + (low - high) * (step / steps);
            let here = (z, gap(z));
            if here.1 <= 0.0 {
                below = here;
                break;
            }
            above = here;
            step += 1.0;
        }
        if below.1 >= 0.0 {
            return below.0; // intersection at the lower bound, within rounding
        }
        // Regula falsi, Illinois variant (Dowell and Jarratt 1971), which keeps the root bracketed.
        let mut last_above = None;
        for _ in 0..40 {
            let z = (above.0 * below.1 - below.0 * above.1) / (below.1 - above.1);
            let here = (z, gap(z));
            if here.1.abs() < PRECISION_M {
                return z;
            }
            let is_above = here.1 > 0.0;
            let again = last_above == Some(is_above);
            if is_above {
                above = here;
                below.1 *= if again { 0.5 } else { 1.0 };
            } else {
                below = here;
                above.1 *= if again { 0.5 } else { 1.0 };
            }
            last_above = Some(is_above);
        }
        0.5 * (above.0 + below.0)
    }

    /// Pose of a camera on a vehicle that follows this surface; unchanged where it does not ride.
    /// `carrier` is the pose over level ground without disturbances, `pose` the one with them.
    pub(super) fn ridden(&self, carrier: &GroundPose, pose: GroundPose) -> GroundPose {
        let Some(from_m) = self.ridden_from_m else { return pose };
        let (level_m, forward, left) = self.wheels(carrier);
        // In the vehicle's axes: nose up is a negative rotation about the left axis, left side up a
        // positive one about the forward axis.
        let pitch_rad = -forward.atan();
        let roll_rad = (left * pitch_rad.cos()).atan();
        let heading = carrier.heading_rad;
        let lean = Rotation3::from_euler_angles(roll_rad, pitch_rad, heading)
            * Rotation3::from_euler_angles(0.0, 0.0, -heading);
        let own = Rotation3::from_euler_angles(pose.roll_rad, pose.pitch_rad, pose.heading_rad);
        let (roll_rad, pitch_rad, heading_rad) = (lean * own).euler_angles();
        // The mast stands upright on the vehicle, not on the plane z = 0.
        let mast = lean * Vector3::new(0.0, 0.0, pose.height_m);
        GroundPose {
            x_m: pose.x_m + mast.x,
            y_m: pose.y_m + mast.y,
            height_m: mast.z + level_m - from_m,
            heading_rad: pose.heading_rad + wrap_angle(heading_rad - pose.heading_rad),
            roll_rad,
            pitch_rad,
        }
    }

    /// Mean level under four wheels, metres, and the slopes along the heading and to its left.
    fn wheels(&self, carrier: &GroundPose) -> (f64, f64, f64) {
        let level = |forward: f64, left: f64| {
            let GroundPoint { x_m, y_m } = carrier.se2().apply(GroundPoint::new(forward, left));
            self.level_with_face(x_m, y_m, KERB_CLIMB_M)
        };
        let half = HALF_WHEELBASE_M;
        let [front, back, left, right] =
            [level(half, 0.0), level(-half, 0.0), level(0.0, half), level(0.0, -half)];
        let slope = |ahead: f64, behind: f64| (ahead - behind) / (2.0 * half);
        (0.25 * (front + back + left + right), slope(front, back), slope(left, right))
    }

    fn level_with_face(&self, x_m: f64, y_m: f64, face_m: f64) -> f64 {
        let waves: f64 = self.waves.iter().map(|wave| wave.at(x_m, y_m)).sum();
        waves + self.kerb_m(x_m, face_m) + self.ramp_m(x_m)
    }

    fn kerb_m(&self, x_m: f64, face_m: f64) -> f64 {
        self.kerb.map_or(0.0, |kerb| {
            let share = |x_m: f64| smooth_step((x_m - kerb.at_m) / face_m + 0.5);
            kerb.height_m * (share(x_m) - share(0.0))
        })
    }

    fn ramp_m(&self, x_m: f64) -> f64 {
        self.ramp.map_or(0.0, |ramp| {
            // A parabola joins the two tangents.
            let way_m = |x_m: f64| {
                let beyond = (x_m - ramp.at_m + RAMP_ROUNDING_M).max(0.0);
                if beyond < 2.0 * RAMP_ROUNDING_M {
                    beyond * beyond / (4.0 * RAMP_ROUNDING_M)
                } else {
                    beyond - RAMP_ROUNDING_M
                }
            };
            ramp.slope * (way_m(x_m) - way_m(0.0))
        })
    }
}

impl Wave {
    fn at(&self, x_m: f64, y_m: f64) -> f64 {
        self.amplitude_m * sine(x_m * self.per_m[0] + y_m * self.per_m[1])
    }
}

/// Approximate sine of an angle in turns, to 0.1 %: parabolas with a correction term. It is
/// evaluated three times per pixel, and any smooth periodic function would serve, provided it is
/// used everywhere.
fn sine(turns: f64) -> f64 {
    let t = turns - nearest(turns);
    let parabola = 8.0 * t - 16.0 * t * t.abs();
    parabola + 0.225 * (parabola * parabola.abs() - parabola)
}

/// Rounds a number below 2⁵¹ to the nearest integer: adding 1.5 · 2⁵² leaves no bits for a
/// fraction. `f64::round` is a library call on the baseline x86-64 target.
fn nearest(value: f64) -> f64 {
    const SHIFT: f64 = 6_755_399_441_055_744.0; // 1.5 · 2⁵²
    (value + SHIFT) - SHIFT
}

/// Side length of the periodic raster of stones, texels.
const RASTER: usize = 1024;
/// Texels per stone spacing.
const TEXELS_PER_SCALE: usize = 16;

/// Relief: a raster of heights that repeats every 64 stones, interpolated bilinearly.
#[derive(Debug)]
struct Stones {
    amplitude_m: f64,
    texels_per_m: f64,
    /// Height in metres and relative brightness.
    texels: Vec<[f32; 2]>,
}

impl Stones {
    fn new(relief: Relief, seed: u64) -> Self {
        let (coarse, fine) = (mix(seed ^ 1) as u32, mix(seed ^ 2) as u32);
        let cells = (RASTER / TEXELS_PER_SCALE) as i32;
        let heights: Vec<f32> = (0..RASTER * RASTER)
            .map(|at| {
                let (x, y) = ((at % RASTER) as f32, (at / RASTER) as f32);
                let scale = TEXELS_PER_SCALE as f32;
                0.75 * periodic_noise(coarse, x / scale, y / scale, cells)
                    + 0.25 * periodic_noise(fine, 2.0 * x / scale, 2.0 * y / scale, 2 * cells)
            })
            .collect();
        let texel_m = relief.scale_m / TEXELS_PER_SCALE as f64;
        let amplitude_m = relief.amplitude_m as f32;
        let at = |x: usize, y: usize| heights[(y % RASTER) * RASTER + x % RASTER];
        let texels = (0..RASTER * RASTER).map(|i| {
            let (x, y) = (i % RASTER, i / RASTER);
            let slope = |after: f32, before: f32| (after - before) * amplitude_m / (2.0 * texel_m as f32);
            let slope_x = slope(at(x + 1, y), at(x + RASTER - 1, y));
            let slope_y = slope(at(x, y + 1), at(x, y + RASTER - 1));
            // Directional light from one side, and less ambient light in the hollows between steep
            // stones.
            let depth = heights[i] * (4.0 * amplitude_m / relief.scale_m as f32).min(1.0);
            let shade = (1.0 + 0.35 * (0.6 * slope_x + 0.8 * slope_y) + 0.2 * depth).clamp(0.4, 1.6);
            [amplitude_m * heights[i], shade]
        });
        Self { amplitude_m: relief.amplitude_m, texels_per_m: 1.0 / texel_m, texels: texels.collect() }
    }

    /// Height in metres and relative brightness at a point.
    fn at(&self, x_m: f64, y_m: f64) -> [f64; 2] {
        // Adds whole periods to make the coordinates positive, so that truncation is `floor`.
        const PERIODS: f64 = (RASTER as u64 * (1 << 24)) as f64;
        let split = |m: f64| {
            let texels = m * self.texels_per_m + PERIODS;
            let whole = texels as i64;
            (whole as usize % RASTER, texels - whole as f64)
        };
        let ((column, u), (row, v)) = (split(x_m), split(y_m));
        let (next_column, next_row) = ((column + 1) % RASTER, (row + 1) % RASTER);
        let texel = |column: usize, row: usize| &self.texels[row * RASTER + column];
        let (a, b) = (texel(column, row), texel(next_column, row));
        let (c, d) = (texel(column, next_row), texel(next_column, next_row));
        std::array::from_fn(|i| {
            let top = f64::from(a[i]) + u * f64::from(b[i] - a[i]);
            let bottom = f64::from(c[i]) + u * f64::from(d[i] - c[i]);
            top + v * (bottom - top)
        })
    }
}

/// Value noise in [−1, 1] with a period of `cells` cells.
fn periodic_noise(seed: u32, x: f32, y: f32, cells: i32) -> f32 {
    let (i, j) = (x as i32, y as i32);
    let (u, v) = (x - i as f32, y - j as f32);
    let value = |i: i32, j: i32| cell(seed, i % cells, j % cells);
    interpolated([value(i, j), value(i + 1, j), value(i, j + 1), value(i + 1, j + 1)], u, v)
}

#[cfg(test)]
mod tests;

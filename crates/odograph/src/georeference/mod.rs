//! Where on Earth a path is: positions of a satellite receiver (GNSS) against the path of its
//! antenna, by robust least squares.
//!
//! The path is exact to millimetres per metre, and a receiver, but for RTK, to metres. So the path
//! keeps its shape: rotation, shift and the receiver's clock are estimated, and a scale if the
//! fixes show one. Derivation: `docs/math/georeference.md`.

mod anchor;
mod fit;

pub use anchor::Anchor;

use crate::geometry::{EarthPosition, TangentPlane, wrap_angle};
use crate::numerics::median;
use fit::{Fitted, Pairing};
use nalgebra::{Matrix2, Vector2};
use std::f64::consts::PI;
use std::fmt;

/// A position by a satellite receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GnssFix {
    /// Time by its clock, seconds.
    pub time_s: f64,
    /// Where its antenna was.
    pub place: EarthPosition,
    /// Altitude above the ellipsoid, metres, where it is known.
    pub altitude_m: Option<f64>,
    /// Covariance of east and north, square metres.
    pub covariance_m2: Matrix2<f64>,
}

impl GnssFix {
    /// Standard deviation of a fix that states none, metres: of a receiver without corrections
    /// under open sky.
    pub const USUAL_SIGMA_M: f64 = 3.0;
    /// Standard deviation for a horizontal dilution of precision of 1, metres: the user range error
    /// of a receiver without corrections.
    pub const RANGE_ERROR_M: f64 = 2.5;
    /// Range of standard deviations that are taken as stated, metres; others are brought into it.
    pub const SIGMAS_M: std::ops::RangeInclusive<f64> = 0.002..=1e4;

    /// The covariance of independent standard deviations to the east and to the north, metres.
    pub fn covariance_m2(sigma_east_m: f64, sigma_north_m: f64) -> Matrix2<f64> {
        let variance = |sigma_m: f64| sigma_m.clamp(*Self::SIGMAS_M.start(), *Self::SIGMAS_M.end()).powi(2);
        Matrix2::new(variance(sigma_east_m), 0.0, 0.0, variance(sigma_north_m))
    }
}

/// A position of the antenna along the path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AntennaPosition {
    /// Time by the camera's clock, seconds.
    pub time_s: f64,
    /// World x and y, metres.
    pub position_m: Vector2<f64>,
    /// Heading of the robot or, where its place on it is not known, of the camera, radians.
    pub heading_rad: f64,
    /// Their covariance relative to the start of the run, square metres.
    pub covariance_m2: Matrix2<f64>,
    /// Number of tracking gaps before it.
    pub segment: usize,
}

impl AntennaPosition {
    /// Longest time between two positions over which the path is interpolated, seconds.
    pub const LONGEST_STEP_S: f64 = 1.0;
}

/// What became of a fix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FixUse {
    /// It was used; its distance from the path, metres.
    Used(f64),
    /// It contradicts the others; its distance from the path, metres.
    Rejected(f64),
    /// There is no path at its time.
    NoPath,
}

/// Where the path is.
#[derive(Debug, Clone, PartialEq)]
pub struct Georeference {
    /// From the map to Earth.
    pub anchor: Anchor,
    /// Standard deviation of the rotation, radians.
    pub heading_sigma_rad: f64,
    /// Covariance of the shift to the east and to the north, at the middle of the path, square
    /// metres. An error that all fixes have in common cannot be known and is part of it.
    pub shift_covariance_m2: Matrix2<f64>,
    /// Length on Earth of a metre of the map; 1 unless the fixes show another.
    pub scale: f64,
    /// Its standard deviation; 0 where it was not estimated.
    pub scale_sigma: f64,
    /// The antenna ahead and to the left of where the path has it, metres, and the larger standard
    /// deviation; `None` if it was not sought or the fixes do not show it.
    pub antenna_m: Option<(Vector2<f64>, f64)>,
    /// The receiver's time less the camera's, seconds.
    pub clock_offset_s: f64,
    /// Its standard deviation, seconds.
    pub clock_offset_sigma_s: f64,
    /// Root mean square distance of the used fixes from the path, metres.
    pub rmse_m: f64,
    /// Robust variance of the distances of all fixes from the path in units of the stated one:
    /// about 1, and more where the path drifts.
    pub spread: f64,
    /// What became of each fix.
    pub fixes: Vec<FixUse>,
    /// The middle of the path, world metres.
    middle_m: Vector2<f64>,
    /// East and north of a metre along x and along y.
    earth_from_map: Matrix2<f64>,
}

impl Georeference {
    /// Covariance of a point of the path to the east and to the north, square metres, from that in
    /// the map relative to the start of the run.
    pub fn covariance_m2(&self, position_m: Vector2<f64>, in_map: &Matrix2<f64>) -> Matrix2<f64> {
        let arm = self.earth_from_map * (position_m - self.middle_m);
        let by_heading = Vector2::new(-arm.y, arm.x);
        self.shift_covariance_m2
            + by_heading * by_heading.transpose() * self.heading_sigma_rad.powi(2)
            + arm * arm.transpose() * self.scale_sigma.powi(2)
            + self.earth_from_map * in_map * self.earth_from_map.transpose()
    }

    /// Number of fixes that were used.
    pub fn used(&self) -> usize {
        self.fixes.iter().filter(|fix| matches!(fix, FixUse::Used(_))).count()
    }
}

/// Why a path has no place on Earth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unplaced {
    /// Fewer fixes than three at times at which there is a path.
    TooFew {
        /// How many there are.
        fixes: usize,
    },
    /// Less than half of the fixes agree with the path.
    Contradiction {
        /// How many agree.
        agree: usize,
        /// Of how many.
        of: usize,
    },
    /// The fixes do not determine the direction.
    NoHeading {
        /// Extent of the path at the fixes, metres.
        extent_m: f64,
        /// Standard deviation of the direction, radians.
        sigma_rad: f64,
    },
}

impl fmt::Display for Unplaced {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooFew { fixes } => write!(
                f,
                "only {fixes} of its positions fall on the path; three are the least, better one a second"
            ),
            Self::Contradiction { agree, of } => write!(
                f,
                "only {agree} of its {of} positions agree with the path; are its times those of the recording?"
            ),
            Self::NoHeading { extent_m, sigma_rad } => write!(
                f,
                "its positions lie within {extent_m:.1} m, which leaves the direction uncertain by {:.0}°; drive further",
                sigma_rad.to_degrees()
            ),
        }
    }
}

/// Fewest fixes: two determine the place, and a third is the first that can contradict.
const FEWEST: usize = 3;
/// Largest standard deviation of a direction that is called known.
const HEADING_KNOWN_RAD: f64 = 10.0 * PI / 180.0;

/// Places a path on Earth.
///
/// `path` is in order of time. `clock_sigma_s` is the standard deviation of the receiver's time
/// less the camera's, which is estimated where the path shows it. If `antenna_is_known` is false,
/// the antenna may be elsewhere on the robot, which turns reveal.
///
/// # Errors
/// The reason why the path has no place.
pub fn georeference(
    path: &[AntennaPosition],
    fixes: &[GnssFix],
    clock_sigma_s: f64,
    antenna_is_known: bool,
) -> Result<Georeference, Unplaced> {
    let plane = plane_of(fixes).ok_or(Unplaced::TooFew { fixes: 0 })?;
    let in_plane: Vec<Vector2<f64>> = fixes.iter().map(|fix| Vector2::from(plane.point(fix.place))).collect();
    let pairing = Pairing { path, fixes, in_plane: &in_plane };
    let on_path = pairing.at(0.0).len();
    if on_path < FEWEST {
        return Err(Unplaced::TooFew { fixes: on_path });
    }
    let found =
        fit::fit(&pairing, clock_sigma_s, !antenna_is_known).ok_or(Unplaced::TooFew { fixes: on_path })?;
    let Fitted { pose, offset_s, middle_m, covariance, used, .. } = &found;
    let agree = used.len();
    if agree < FEWEST || 2 * agree < on_path {
        return Err(Unplaced::Contradiction { agree, of: on_path });
    }
    let heading_sigma_rad = covariance[(fit::HEADING, fit::HEADING)].sqrt();
    if heading_sigma_rad >= HEADING_KNOWN_RAD {
        let extent_m = used.iter().map(|pair| (pair.position_m - middle_m).norm()).fold(0.0, f64::max);
        return Err(Unplaced::NoHeading { extent_m: 2.0 * extent_m, sigma_rad: heading_sigma_rad.min(PI) });
    }
    let mut uses = vec![FixUse::NoPath; fixes.len()];
    for pair in pairing.at(*offset_s) {
        uses[pair.fix] = FixUse::Rejected(found.residual(&pair).norm());
    }
    let mut squares_m2 = 0.0;
    for pair in used {
        let off_m = found.residual(pair).norm();
        uses[pair.fix] = FixUse::Used(off_m);
        squares_m2 += off_m * off_m;
    }
    let (along, across) = pose.rotate(1.0, 0.0);
    let earth_from_map = Matrix2::new(along, -across, across, along);
    Ok(Georeference {
        anchor: Anchor::new(plane, [pose.x_m, pose.y_m], [along, across]),
        heading_sigma_rad,
        shift_covariance_m2: covariance.fixed_view::<2, 2>(fit::EAST, fit::EAST) + common(used),
        scale: pose.scale,
        scale_sigma: covariance[(fit::SCALE, fit::SCALE)].sqrt(),
        antenna_m: found.antenna_m.map(|at_m| {
            let covariance = covariance.fixed_view::<2, 2>(fit::ANTENNA, fit::ANTENNA);
            (at_m, covariance.symmetric_eigenvalues().max().sqrt())
        }),
        clock_offset_s: *offset_s,
        clock_offset_sigma_s: covariance[(fit::CLOCK, fit::CLOCK)].sqrt(),
        rmse_m: (squares_m2 / agree as f64).sqrt(),
        spread: found.spread,
        fixes: uses,
        middle_m: *middle_m,
        earth_from_map,
    })
}

/// Covariance of an error that all fixes have in common, as that of satellite orbits, atmosphere
/// and base station: taken to be as large as that of one fix.
fn common(used: &[fit::FixPair]) -> Matrix2<f64> {
    used.iter().map(|pair| pair.covariance_m2).sum::<Matrix2<f64>>() / used.len() as f64
}

/// The plane at the median place; `None` without fixes.
fn plane_of(fixes: &[GnssFix]) -> Option<TangentPlane> {
    let first = fixes.first()?.place;
    let mut latitudes: Vec<f64> = fixes.iter().map(|fix| fix.place.latitude_rad).collect();
    // From the first, which may be at the date line.
    let eastward = |fix: &GnssFix| wrap_angle(fix.place.longitude_rad - first.longitude_rad);
    let mut longitudes: Vec<f64> = fixes.iter().map(eastward).collect();
    let mut altitudes_m: Vec<f64> = fixes.iter().filter_map(|fix| fix.altitude_m).collect();
    let reference = EarthPosition {
        latitude_rad: median(&mut latitudes)?,
        longitude_rad: first.longitude_rad + median(&mut longitudes)?,
    };
    Some(TangentPlane { reference, altitude_m: median(&mut altitudes_m).unwrap_or(0.0) })
}

#[cfg(test)]
mod tests;

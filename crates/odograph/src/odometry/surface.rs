//! The surface of ground that is not flat: elevations between points where they are known, by
//! kriging (G. Matheron, 1963; N. Cressie, "Statistics for Spatial Data", 1993) with a variogram
//! fitted to the points themselves. Ground that undulates has no mean that a view could show:
//! ordinary kriging with a power variogram. The mean of gravel is known from hundreds of stones:
//! simple kriging with a stationary covariance.

use crate::geometry::GroundPoint;
use crate::motion::{Elevation, GroundShape};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Points of the ground with their elevations, and how these vary with the distance.
#[derive(Debug, Clone)]
pub struct Surface {
    points: Vec<(GroundPoint, Elevation)>,
    variogram: Variogram,
    /// `None` unless enough stones are in view for their mean to be the level of the ground.
    stones: Option<StationaryCovariance>,
    mean_m: f64,
    /// Mean of the ground about which stones vary, metres.
    level_m: f64,
    /// Points per square metre.
    density: f64,
    /// The error that the elevations share; `None` where their errors are independent.
    pub shape: Option<GroundShape>,
}

/// Exponent of the variogram above which the ground undulates: gravel has 0.2, undulations that are
/// as long as the image is wide and longer 0.9 and more.
const SMOOTH: f64 = 0.5;

/// From this number of stones in view, their mean is the level of the ground. Gravel of 6 cm below
/// 0.75 m has 140, ground with a kerb fewer than 5.
const MANY_STONES: f64 = 30.0;

/// Points that an elevation is interpolated from.
const NEIGHBOURS: usize = 8;

impl Surface {
    /// Through these points, on ground whose elevations have this variance and, as far as was known
    /// before, this level. `None` for fewer points than an elevation is interpolated from.
    pub fn new(
        points: Vec<(GroundPoint, Elevation)>,
        variance_m2: f64,
        level_before_m: f64,
        shape: Option<GroundShape>,
    ) -> Option<Self> {
        if points.len() < NEIGHBOURS {
            return None;
        }
        let known =
            |(_, elevation): &&(GroundPoint, Elevation)| elevation.variance_m2 < WELL_KNOWN * variance_m2;
        let differences = ElevationDifferences::of(&points.iter().filter(known).collect::<Vec<_>>());
        let variogram = Variogram::fitted(&differences, variance_m2);
        let mean_m = points.iter().map(|(_, elevation)| elevation.mean_m).sum::<f64>() / points.len() as f64;
        let bounds = |along: fn(&GroundPoint) -> f64| {
            let along = points.iter().map(|(place, _)| along(place));
            let (least, most) =
                along.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
            most - least
        };
        let area_m2 = bounds(|place| place.x_m) * bounds(|place| place.y_m);
        let density = points.len() as f64 / area_m2.max(f64::MIN_POSITIVE);
        let is_smooth = variogram.exponent > SMOOTH;
        let stones = StationaryCovariance::fitted(&differences)
            .filter(|stones| !is_smooth && variance_m2 > 0.0 && stones.number_in(area_m2) > MANY_STONES);
        // The mean of the stones in view differs from their level by less than a stone does.
        let is_same = |stones: StationaryCovariance| (mean_m - level_before_m).powi(2) < stones.sill_m2;
        let level_m = if stones.is_some_and(is_same) { level_before_m } else { mean_m };
        Some(Self { points, variogram, stones, mean_m, level_m, density, shape })
    }

    /// Whether differences grow with the distance as on undulating ground; on gravel they do not,
    /// and the level of the ground is the mean of many stones.
    pub fn is_smooth(&self) -> bool {
        self.variogram.exponent > SMOOTH
    }

    /// The mean elevation of its points, metres.
    pub fn mean_m(&self) -> f64 {
        self.mean_m
    }

    /// The plane of least squares through the elevations at these points, weighted by what is known
    /// of them: its elevation at `centre`, its slopes along x and y, and the standard deviation of
    /// elevations about it. `None` where the points determine no plane.
    pub fn plane(
        &self,
        points: impl Iterator<Item = GroundPoint>,
        centre: GroundPoint,
    ) -> Option<(f64, (f64, f64), f64)> {
        let seen: Vec<_> = points.map(|point| (point, self.at(point))).collect();
        let row = |point: &GroundPoint| Vector3::new(1.0, point.x_m - centre.x_m, point.y_m - centre.y_m);
        let weight = |elevation: &Elevation| 1.0 / (elevation.variance_m2 + PLANE_SIGMA_M * PLANE_SIGMA_M);
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (point, elevation) in &seen {
            let (row, weight) = (row(point), weight(elevation));
            normal += weight * row * row.transpose();
            right += weight * elevation.mean_m * row;
        }
        if seen.len() < 3 {
            return None;
        }
        let plane = normal.cholesky()?.solve(&right);
        // What is not known weighs less here, too: the rest determines the plane.
        let off_m2 = |(point, elevation): &(GroundPoint, Elevation)| {
            (elevation.mean_m - plane.dot(&row(point))).powi(2) + elevation.variance_m2
        };
        let squares_m2: f64 = seen.iter().map(|seen| weight(&seen.1) * off_m2(seen)).sum();
        let relief_m = (squares_m2 / normal[(0, 0)] + PLANE_SIGMA_M * PLANE_SIGMA_M).sqrt();
        Some((plane.x, (plane.y, plane.z), relief_m))
    }

    /// Mean of the ground about which stones vary, metres.
    pub fn level_m(&self) -> f64 {
        self.level_m
    }

    /// The elevation at a point.
    pub fn at(&self, point: GroundPoint) -> Elevation {
        match &self.stones {
            Some(stones) => self.simple_kriging(stones, point),
            None => self.ordinary_kriging(point),
        }
    }

    fn simple_kriging(&self, stones: &StationaryCovariance, point: GroundPoint) -> Elevation {
        let nearest = self.nearest(point).map(|(_, index)| &self.points[index]);
        let covariance = |a: GroundPoint, b: GroundPoint| stones.covariance_m2(a.distance(b));
        let right = SVector::from(nearest.map(|(place, _)| covariance(*place, point)));
        let system = SMatrix::<f64, NEIGHBOURS, NEIGHBOURS>::from_fn(|i, k| {
            let error_m2 = if i == k { nearest[i].1.variance_m2 } else { 0.0 };
            covariance(nearest[i].0, nearest[k].0) + error_m2
        });
        let unknown = Elevation { mean_m: self.level_m, variance_m2: stones.sill_m2 };
        let Some(weights) = system.lu().solve(&right) else { return unknown };
        let above_m = SVector::from(nearest.map(|(_, elevation)| elevation.mean_m - self.level_m));
        let variance_m2 = stones.sill_m2 - weights.dot(&right);
        Elevation {
            mean_m: self.level_m + weights.dot(&above_m),
            variance_m2: variance_m2.max(LEAST_SIGMA_M * LEAST_SIGMA_M),
        }
    }

    fn ordinary_kriging(&self, point: GroundPoint) -> Elevation {
        let nearest = self.nearest(point);
        let semivariance =
            |a: GroundPoint, b: GroundPoint| 0.5 * self.variogram.squared_difference(a.distance(b));
        // Weights λ and the Lagrange multiplier of Σ λ = 1.
        let mut system = SMatrix::<f64, { NEIGHBOURS + 1 }, { NEIGHBOURS + 1 }>::zeros();
        let mut right = SVector::<f64, { NEIGHBOURS + 1 }>::zeros();
        for (i, &(_, a)) in nearest.iter().enumerate() {
            let (place, elevation) = &self.points[a];
            for (k, &(_, b)) in nearest.iter().enumerate() {
                system[(i, k)] =
                    if i == k { -elevation.variance_m2 } else { semivariance(*place, self.points[b].0) };
            }
            system[(i, NEIGHBOURS)] = 1.0;
            system[(NEIGHBOURS, i)] = 1.0;
            right[i] = semivariance(*place, point);
        }
        right[NEIGHBOURS] = 1.0;
        let nearest_one = self.points[nearest[0].1].1;
        let Some(weights) = system.lu().solve(&right) else {
            let variance_m2 = nearest_one.variance_m2 + 2.0 * right[0];
            return Elevation { variance_m2, ..nearest_one };
        };
        let mean_m =
            nearest.iter().enumerate().map(|(i, &(_, a))| weights[i] * self.points[a].1.mean_m).sum();
        // The variance of the kriging estimate.
        let variance_m2 = self.sharing(nearest[0].0) * weights.dot(&right);
        Elevation { mean_m, variance_m2: variance_m2.max(LEAST_SIGMA_M * LEAST_SIGMA_M) }
    }

    /// Number of points that share the error of an elevation this far from the nearest known point:
    /// those within the same distance. The fit takes the errors of different points to be
    /// independent; with the variance multiplied by it they weigh as one.
    fn sharing(&self, squared_m2: f64) -> f64 {
        (std::f64::consts::PI * squared_m2 * self.density).max(1.0)
    }

    /// The nearest points: squared distance and index, the nearest first.
    fn nearest(&self, point: GroundPoint) -> [(f64, usize); NEIGHBOURS] {
        let mut nearest = [(f64::INFINITY, 0); NEIGHBOURS];
        for (index, (place, _)) in self.points.iter().enumerate() {
            let squared = (place.x_m - point.x_m).powi(2) + (place.y_m - point.y_m).powi(2);
            if squared < nearest[NEIGHBOURS - 1].0 {
                let at = nearest.partition_point(|(other, _)| *other <= squared);
                nearest[at..].rotate_right(1);
                nearest[at] = (squared, index);
            }
        }
        nearest
    }
}

/// Least standard deviation of elevations about a plane, metres. Elevations of a kerb carry a
/// common error from keyframe to keyframe: beyond it, at 0.9 m, the scale is off by 0.06 to 0.1 %.
const PLANE_SIGMA_M: f64 = 0.002;

/// Elevations are never taken to be known better than this, metres.
const LEAST_SIGMA_M: f64 = 1e-5;

/// Distances from twice one lag to the next, the first in metres.
const LAGS: usize = 9;
const FIRST_LAG_M: f64 = 0.01;

/// Pairs of points that a lag must have.
const LEAST_PAIRS: f64 = 30.0;

/// Points whose own variance is below this part of that of all elevations determine the variogram.
const WELL_KNOWN: f64 = 0.25;

/// The empirical variogram: mean squared differences of elevations by the distance of the points.
#[derive(Debug, Clone, Copy, Default)]
struct ElevationDifferences {
    lags: [SquaredDifference; LAGS],
    all: SquaredDifference,
}

/// The mean squared difference of pairs of points.
#[derive(Debug, Clone, Copy, Default)]
struct SquaredDifference {
    roots: f64,
    noise_m2: f64,
    pairs: f64,
}

impl SquaredDifference {
    fn add(&mut self, a: &Elevation, b: &Elevation) {
        self.roots += (a.mean_m - b.mean_m).abs().sqrt();
        self.noise_m2 += a.variance_m2 + b.variance_m2;
        self.pairs += 1.0;
    }

    /// Without that by the errors of the elevations, metres²; `None` for too few pairs. The fourth
    /// power of the mean root is robust (N. Cressie and D. Hawkins, 1980).
    fn mean_m2(&self) -> Option<f64> {
        let mean_m2 = f64::powi(self.roots / self.pairs, 4) / 0.457 - self.noise_m2 / self.pairs;
        (self.pairs >= LEAST_PAIRS && mean_m2 > 0.0).then_some(mean_m2)
    }
}

impl ElevationDifferences {
    fn of(points: &[&(GroundPoint, Elevation)]) -> Self {
        let mut differences = Self::default();
        for (i, (place, elevation)) in points.iter().enumerate() {
            for (other, beside) in &points[..i] {
                let lag = (place.distance(*other) / FIRST_LAG_M).log2().round();
                if (0.0..LAGS as f64).contains(&lag) {
                    differences.lags[lag as usize].add(elevation, beside);
                }
                differences.all.add(elevation, beside);
            }
        }
        differences
    }

    /// Distance and mean squared difference of the lags that have enough pairs.
    fn by_distance(&self) -> impl Iterator<Item = (f64, f64)> {
        let distance_m = |lag: usize| FIRST_LAG_M * f64::powi(2.0, lag as i32);
        let lags = self.lags.iter().enumerate();
        lags.filter_map(move |(lag, differences)| Some((distance_m(lag), differences.mean_m2()?)))
    }
}

/// The mean squared difference of two elevations as a power of their distance: near 0 for gravel,
/// near 2 for smooth ground.
#[derive(Debug, Clone, Copy)]
struct Variogram {
    /// Metres² for points a metre apart.
    at_metre_m2: f64,
    exponent: f64,
}

/// A power variogram is valid for exponents between 0 and 2, both excluded.
const EXPONENTS: (f64, f64) = (0.05, 1.9);

impl Variogram {
    /// That of these differences on ground whose elevations have this variance.
    fn fitted(differences: &ElevationDifferences, variance_m2: f64) -> Self {
        // A line through logarithms.
        let (mut count, mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (distance_m, squared_m2) in differences.by_distance() {
            let (log_m, log_m2) = (distance_m.ln(), squared_m2.ln());
            (count, x, y) = (count + 1.0, x + log_m, y + log_m2);
            (xx, xy) = (xx + log_m * log_m, xy + log_m * log_m2);
        }
        if count < 2.0 {
            return Self { at_metre_m2: 2.0 * variance_m2, exponent: EXPONENTS.0 };
        }
        let slope = (xy - x * y / count) / (xx - x * x / count);
        let exponent = slope.clamp(EXPONENTS.0, EXPONENTS.1);
        Self { at_metre_m2: ((y - exponent * x) / count).exp(), exponent }
    }

    /// The mean squared difference of two elevations this far apart, metres².
    fn squared_difference(&self, distance_m: f64) -> f64 {
        self.at_metre_m2 * distance_m.powf(self.exponent)
    }
}

/// Powered exponential covariance of the elevations of two points:
/// sill · exp(−(distance / range)^p) with the power p = [`STONE_POWER`].
#[derive(Debug, Clone, Copy)]
struct StationaryCovariance {
    /// Variance of the elevations, metres².
    sill_m2: f64,
    /// Where it has fallen to 1/e, metres.
    range_m: f64,
}

/// Between an edge (1) and a smooth bump (2). Not derived; chosen.
const STONE_POWER: f64 = 1.5;

/// From where a mean squared difference is this part of the sill, it shows no range.
const NEAR_SILL: f64 = 0.9;

/// Range of stones where it is shorter than the distances between points, metres.
const LEAST_RANGE_M: f64 = 0.5 * FIRST_LAG_M;

impl StationaryCovariance {
    /// Fits sill and range to the differences; `None` with too few of them.
    fn fitted(differences: &ElevationDifferences) -> Option<Self> {
        let sill_m2 = 0.5 * differences.all.mean_m2()?;
        let parts = differences.by_distance().map(|(distance_m, m2)| (distance_m, 0.5 * m2 / sill_m2));
        let ranges = parts
            .take_while(|(_, part)| *part < NEAR_SILL)
            .map(|(distance_m, part)| distance_m / (-(1.0 - part).ln()).powf(1.0 / STONE_POWER));
        let (logs, count) =
            ranges.fold((0.0, 0.0), |(logs, count), range_m| (logs + range_m.ln(), count + 1.0));
        let range_m = if count > 0.0 { f64::exp(logs / count).max(LEAST_RANGE_M) } else { LEAST_RANGE_M };
        Some(Self { sill_m2, range_m })
    }

    /// Number of independent stones in an area.
    fn number_in(&self, area_m2: f64) -> f64 {
        area_m2 / (std::f64::consts::PI * self.range_m * self.range_m)
    }

    fn covariance_m2(&self, distance_m: f64) -> f64 {
        self.sill_m2 * (-(distance_m / self.range_m).powf(STONE_POWER)).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on a lattice of 5 cm with these elevations, each known to a tenth of a millimetre.
    fn surface(elevation: impl Fn(f64, f64) -> f64) -> Surface {
        let point = |i: usize| {
            let (x_m, y_m) = (0.05 * (i % 16) as f64, 0.05 * (i / 16) as f64);
            let mean_m = elevation(x_m, y_m);
            (GroundPoint::new(x_m, y_m), Elevation { mean_m, variance_m2: 1e-8 })
        };
        Surface::new((0..256).map(point).collect(), 1e-4, 0.0, None).unwrap()
    }

    #[test]
    fn a_wave_is_interpolated_and_undulates() {
        let wave = |x: f64, y: f64| 0.03 * (3.0 * x).sin() * (2.0 * y).cos();
        let surface = surface(wave);
        let found = surface.at(GroundPoint::new(0.38, 0.42));
        assert!((found.mean_m - wave(0.38, 0.42)).abs() < 5e-4, "{found:?}");
        assert!(surface.is_smooth());
        let beyond = surface.at(GroundPoint::new(1.2, 0.42));
        assert!(beyond.variance_m2 > 10.0 * found.variance_m2, "unseen ground is not known");
    }

    #[test]
    fn a_ramp_has_its_level_and_slopes() {
        let surface = surface(|x, y| 0.02 + 0.08 * x - 0.03 * y);
        let places = [(0.1, 0.1), (0.6, 0.1), (0.1, 0.6), (0.6, 0.6), (0.3, 0.4)];
        let points = || places.into_iter().map(|(x_m, y_m)| GroundPoint::new(x_m, y_m));
        let (level_m, slopes, relief_m) = surface.plane(points(), GroundPoint::new(0.5, 0.2)).unwrap();
        assert!((level_m - 0.054).abs() < 1e-4, "{level_m}");
        assert!((slopes.0 - 0.08).abs() < 1e-3 && (slopes.1 + 0.03).abs() < 1e-3, "{slopes:?}");
        assert!(relief_m < 1.1 * PLANE_SIGMA_M, "{relief_m}");
        let alone = surface.plane(points().take(2), GroundPoint::new(0.5, 0.2));
        assert!(alone.is_none(), "two points determine no plane");
    }

    #[test]
    fn gravel_determines_nothing_between_its_stones() {
        let stone = |x: f64, y: f64| 0.005 * (1e4 * (x * 7.1 + y * 3.3)).sin();
        let surface = surface(stone);
        assert!(!surface.is_smooth());
        let found = surface.at(GroundPoint::new(0.38, 0.42));
        assert!(found.variance_m2.sqrt() > 0.002, "{found:?}");
    }

    #[test]
    fn unseen_gravel_is_at_the_level_of_all_stones() {
        // Pseudo-random heights of ±5 mm.
        let fraction = |x: f64, y: f64| (1299.0 * x + 7823.0 * y).sin().abs() * 43758.5453 % 1.0;
        let stone = |x: f64, y: f64| 0.01 * (fraction(x, y) - 0.5);
        let beyond = GroundPoint::new(1.2, 0.42);
        assert!(surface(stone).at(beyond).mean_m.abs() < 1e-4, "not at that of the nearest stones");
        let raised = surface(|x, y| 0.05 + stone(x, y));
        assert!((raised.at(beyond).mean_m - 0.05).abs() < 1e-3, "{:?}", raised.at(beyond));
    }

    #[test]
    fn unseen_ground_weighs_as_one_point() {
        let surface = surface(|x: f64, y: f64| 0.03 * (3.0 * x).sin() * (2.0 * y).cos());
        // 25 points beside the surface within 20 cm of each other: the information of all of them
        // is at most that of one that the variogram alone would give.
        let beyond = GroundPoint::new(0.95, 0.4);
        let alone_m2 = surface.variogram.squared_difference(0.2);
        assert!(25.0 / surface.at(beyond).variance_m2 < 1.0 / alone_m2, "{:?}", surface.at(beyond));
    }

    #[test]
    fn fewer_points_than_neighbours_make_no_surface() {
        assert!(
            Surface::new(vec![(GroundPoint::new(0.0, 0.0), Elevation::FLAT); 7], 1e-4, 0.0, None).is_none()
        );
    }
}

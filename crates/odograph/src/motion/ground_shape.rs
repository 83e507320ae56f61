//! The trend surface of uneven ground: level, slope and curvature, whose errors all points share.
//! Derivation: `docs/math/elevation.md`.

use super::normal_equations::SHAPE;
use crate::geometry::{GroundPoint, GroundPose};
use nalgebra::{Matrix6, Vector6};

/// Normal distribution of the error that the elevations of all points share: a trend surface, a
/// polynomial of second order. Distances from the origin and elevations are in units of a height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundShape {
    origin: GroundPoint,
    height_m: f64,
    /// Means of the powers over the points: slope and curvature do not change the mean elevation.
    mean_powers: Vector6<f64>,
    /// Covariance of the coefficients of 1, u, v, u², u v and v².
    covariance: Matrix6<f64>,
}

/// Standard deviations of slopes, and of the coefficients of second order, of ground of which
/// nothing is known. Undulations of ±3 cm over 2 m have at most 0.09 and 0.11 below 0.75 m.
pub const UNKNOWN_SLOPE: f64 = 0.1;
const UNKNOWN_CURVATURE: f64 = 0.1;

impl GroundShape {
    /// Ground of which only the mean elevation of these points is known, seen from `pose`.
    pub fn unknown(pose: &GroundPose, points: impl Iterator<Item = GroundPoint>) -> Self {
        let (slope, curvature) = (UNKNOWN_SLOPE.powi(2), UNKNOWN_CURVATURE.powi(2));
        let variances = Vector6::new(0.0, slope, slope, curvature, curvature, curvature);
        Self { covariance: Matrix6::from_diagonal(&variances), ..Self::known(pose, points) }
    }

    /// Without errors.
    fn known(pose: &GroundPose, points: impl Iterator<Item = GroundPoint>) -> Self {
        let mut shape = Self {
            origin: GroundPoint::new(pose.x_m, pose.y_m),
            height_m: pose.height_m,
            mean_powers: Vector6::zeros(),
            covariance: Matrix6::zeros(),
        };
        let mut count = 0.0;
        let sum = points.fold(Vector6::zeros(), |sum, point| {
            count += 1.0;
            sum + shape.powers(point)
        });
        shape.mean_powers = sum / f64::max(count, 1.0);
        shape.mean_powers[0] = 0.0;
        shape
    }

    /// The same distribution about the ground below another pose, and about the mean of other
    /// points.
    pub fn about(&self, pose: &GroundPose, points: impl Iterator<Item = GroundPoint>) -> Self {
        let next = Self::known(pose, points);
        // u = a + s u', v = b + s v' with u' and v' about the new origin.
        let s = next.height_m / self.height_m;
        let (a, b) = (
            (next.origin.x_m - self.origin.x_m) / self.height_m,
            (next.origin.y_m - self.origin.y_m) / self.height_m,
        );
        #[rustfmt::skip]
        let moved = Matrix6::new(
            1.0, a, b, a * a, a * b, b * b,
            0.0, s, 0.0, 2.0 * a * s, b * s, 0.0,
            0.0, 0.0, s, 0.0, a * s, 2.0 * b * s,
            0.0, 0.0, 0.0, s * s, 0.0, 0.0,
            0.0, 0.0, 0.0, 0.0, s * s, 0.0,
            0.0, 0.0, 0.0, 0.0, 0.0, s * s,
        ) / s;
        let raised = |by: &Vector6<f64>| {
            let mut raised = Matrix6::identity();
            (1..SHAPE).for_each(|k| raised[(0, k)] = by[k]);
            raised
        };
        let change = raised(&next.mean_powers) * moved * raised(&-self.mean_powers);
        Self { covariance: change * self.covariance * change.transpose(), ..next }
    }

    /// The same with another covariance.
    pub fn with_covariance(self, covariance: Matrix6<f64>) -> Self {
        Self { covariance, ..self }
    }

    /// Covariance of the coefficients of 1, u, v, u², u v and v².
    pub fn covariance(&self) -> &Matrix6<f64> {
        &self.covariance
    }

    /// Powers of the distances of a point from the origin, in heights.
    fn powers(&self, point: GroundPoint) -> Vector6<f64> {
        let u = (point.x_m - self.origin.x_m) / self.height_m;
        let v = (point.y_m - self.origin.y_m) / self.height_m;
        Vector6::new(1.0, u, v, u * u, u * v, v * v)
    }

    /// Derivative of the elevation at a point by the coefficients, metres.
    pub fn basis(&self, point: GroundPoint) -> Vector6<f64> {
        self.height_m * (self.powers(point) - self.mean_powers)
    }

    /// Elevation at a point for some coefficients, metres.
    pub fn at(&self, point: GroundPoint, coefficients: &Vector6<f64>) -> f64 {
        self.basis(point).dot(coefficients)
    }

    /// Variance of the elevation at a point, metres².
    pub fn variance_m2(&self, point: GroundPoint) -> f64 {
        let basis = self.basis(point);
        basis.dot(&(self.covariance * basis)).max(0.0)
    }
}

/// What a frame measured of the shape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShapeEstimate {
    /// The coefficients.
    pub coefficients: Vector6<f64>,
    /// The posterior about them.
    pub shape: GroundShape,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variance_of_an_elevation_is_the_same_about_any_origin() {
        let points = |x_m: f64| (0..20).map(move |i| GroundPoint::new(x_m + 0.03 * f64::from(i), -0.1));
        let here = GroundPose { x_m: 0.2, y_m: -0.3, ..GroundPose::level(0.7) };
        let there = GroundPose { x_m: 0.5, y_m: 0.1, ..GroundPose::level(0.9) };
        let shape = GroundShape::unknown(&here, points(0.0));
        let moved = shape.about(&there, points(0.4));
        for (x_m, y_m) in [(0.0, 0.0), (0.7, -0.2), (-0.4, 0.5)] {
            let point = GroundPoint::new(x_m, y_m);
            let (was, is) = (shape.variance_m2(point), moved.variance_m2(point));
            assert!((is - was).abs() < 1e-12, "{was} {is}");
        }
        let back = moved.about(&here, points(0.0));
        assert!((back.covariance - shape.covariance).norm() < 1e-12);
    }

    #[test]
    fn a_slope_does_not_change_the_mean_elevation() {
        let points: Vec<_> = (0..30).map(|i| GroundPoint::new(0.02 * f64::from(i), 0.3)).collect();
        let shape = GroundShape::unknown(&GroundPose::level(0.75), points.iter().copied());
        let coefficients = Vector6::new(0.0, 0.1, -0.2, 0.3, 0.0, 0.1);
        let mean_m = points.iter().map(|&point| shape.at(point, &coefficients)).sum::<f64>() / 30.0;
        assert!(mean_m.abs() < 1e-12, "{mean_m}");
    }
}

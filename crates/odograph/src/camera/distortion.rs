//! Lens distortion models.

use crate::geometry::{Ray, length};
use nalgebra::Matrix2;
use serde::{Deserialize, Serialize};

/// Lens distortion model: maps undistorted to distorted normalised image coordinates. All
/// coefficients are dimensionless.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "kebab-case")]
pub enum Distortion {
    /// No distortion: a pinhole camera.
    None,
    /// Brown–Conrady with OpenCV's rational extension (D. C. Brown, "Close-range camera
    /// calibration", 1971; OpenCV `calib3d`, equation of `projectPoints`):
    ///
    /// `d = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)`,
    ///
    /// `x' = x d + 2 p1 x y + p2 (r² + 2 x²)`, `y' = y d + p1 (r² + 2 y²) + 2 p2 x y`.
    BrownConrady {
        /// Radial, numerator, coefficient of r².
        k1: f64,
        /// Radial, numerator, coefficient of r⁴.
        k2: f64,
        /// Tangential, first coefficient.
        p1: f64,
        /// Tangential, second coefficient.
        p2: f64,
        /// Radial, numerator, coefficient of r⁶.
        k3: f64,
        /// Radial, denominator, coefficient of r².
        k4: f64,
        /// Radial, denominator, coefficient of r⁴.
        k5: f64,
        /// Radial, denominator, coefficient of r⁶.
        k6: f64,
    },
    /// Equidistant fisheye (J. Kannala and S. Brandt, "A generic camera model and calibration
    /// method for conventional, wide-angle, and fish-eye lenses", 2006):
    ///
    /// `θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, with θ the angle from the optical axis.
    KannalaBrandt {
        /// Coefficient of θ³.
        k1: f64,
        /// Coefficient of θ⁵.
        k2: f64,
        /// Coefficient of θ⁷.
        k3: f64,
        /// Coefficient of θ⁹.
        k4: f64,
    },
    /// Double sphere model for fisheye and other very wide lenses (V. Usenko, N. Demmel and D.
    /// Cremers, "The double sphere camera model", 2018, equations 40 to 43): with z = 1,
    ///
    /// `d1 = √(r² + 1)`, `ζ = ξ d1 + 1`, `d2 = √(r² + ζ²)`, `x' = x / (α d2 + (1 − α) ζ)`.
    ///
    /// On the optical axis the magnification is `1 / (1 + ξ)` times the focal length.
    DoubleSphere {
        /// ξ: distance between the centres of the two unit spheres; −1 to 1 for real lenses.
        xi: f64,
        /// α: shift of the pinhole behind the second sphere; 0 (a pinhole where ξ = 0) to 1.
        alpha: f64,
    },
}

impl Distortion {
    /// Brown–Conrady distortion from coefficients in OpenCV's order `k1 k2 p1 p2 [k3 [k4 k5 k6]]`.
    /// `None` unless there are 0 (pinhole), 4, 5 or 8 coefficients.
    pub fn from_opencv(coefficients: &[f64]) -> Option<Self> {
        let c = |i: usize| coefficients.get(i).copied().unwrap_or(0.0);
        match coefficients.len() {
            0 => Some(Self::None),
            4 | 5 | 8 => Some(Self::BrownConrady {
                k1: c(0),
                k2: c(1),
                p1: c(2),
                p2: c(3),
                k3: c(4),
                k4: c(5),
                k5: c(6),
                k6: c(7),
            }),
            _ => None,
        }
    }

    /// All coefficients in the order of their declaration.
    pub fn coefficients(&self) -> Vec<f64> {
        match *self {
            Self::None => vec![],
            Self::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } => vec![k1, k2, p1, p2, k3, k4, k5, k6],
            Self::KannalaBrandt { k1, k2, k3, k4 } => vec![k1, k2, k3, k4],
            Self::DoubleSphere { xi, alpha } => vec![xi, alpha],
        }
    }

    /// Distorted normalised image coordinates of a ray, and their Jacobian with respect to the ray.
    #[inline]
    pub(super) fn distort(&self, ray: Ray) -> ((f64, f64), Matrix2<f64>) {
        let Ray { x, y } = ray;
        let r2 = x * x + y * y;
        match *self {
            Self::None => ((x, y), Matrix2::identity()),
            Self::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } => {
                let numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let numerator_by_r2 = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
                // ∂radial/∂x = 2 x · radial_by_r2; likewise for y.
                let (radial, radial_by_r2) = if k4 == 0.0 && k5 == 0.0 && k6 == 0.0 {
                    // Fast path: most lenses have no denominator, and the division costs as much as
                    // everything else.
                    (numerator, numerator_by_r2)
                } else {
                    let denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                    let denominator_by_r2 = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
                    let radial = numerator / denominator;
                    (radial, (numerator_by_r2 - radial * denominator_by_r2) / denominator)
                };
                let at = (
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                );
                let cross = 2.0 * x * y * radial_by_r2 + 2.0 * p1 * x + 2.0 * p2 * y;
                let derivative = Matrix2::new(
                    radial + 2.0 * x * x * radial_by_r2 + 2.0 * p1 * y + 6.0 * p2 * x,
                    cross,
                    cross,
                    radial + 2.0 * y * y * radial_by_r2 + 6.0 * p1 * y + 2.0 * p2 * x,
                );
                (at, derivative)
            }
            Self::KannalaBrandt { k1, k2, k3, k4 } => {
                let r = r2.sqrt();
                if r < 1e-9 {
                    return ((x, y), Matrix2::identity());
                }
                let angle = r.atan();
                let a2 = angle * angle;
                let bent = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
                let bent_by_angle = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
                let scale = bent / r;
                // scale_by_r is d(scale)/dr; the chain rule uses ∂r/∂x = x / r.
                let scale_by_r = (bent_by_angle / (1.0 + r2) - scale) / r;
                let (dx, dy) = (x / r, y / r);
                let derivative = Matrix2::new(
                    scale + x * scale_by_r * dx,
                    x * scale_by_r * dy,
                    y * scale_by_r * dx,
                    scale + y * scale_by_r * dy,
                );
                ((x * scale, y * scale), derivative)
            }
            Self::DoubleSphere { xi, alpha } => {
                let d1 = (r2 + 1.0).sqrt();
                let zeta = xi * d1 + 1.0;
                let d2 = (r2 + zeta * zeta).sqrt();
                let scale = 1.0 / (alpha * d2 + (1.0 - alpha) * zeta);
                // ∂scale/∂x = 2 x · scale_by_r2; likewise for y.
                let zeta_by_r2 = 0.5 * xi / d1;
                let d2_by_r2 = (0.5 + zeta * zeta_by_r2) / d2;
                let scale_by_r2 = -scale * scale * (alpha * d2_by_r2 + (1.0 - alpha) * zeta_by_r2);
                let cross = 2.0 * x * y * scale_by_r2;
                let derivative = Matrix2::new(
                    scale + 2.0 * x * x * scale_by_r2,
                    cross,
                    cross,
                    scale + 2.0 * y * y * scale_by_r2,
                );
                ((x * scale, y * scale), derivative)
            }
        }
    }

    /// Initial guess for Newton's method: a ray near the one that projects to the given normalised
    /// image coordinates.
    pub(super) fn ray_near(&self, (x, y): (f64, f64), tangent_limit: f64) -> Option<Ray> {
        let radius = length(x, y);
        let tangent = match *self {
            Self::KannalaBrandt { .. } => radius.min(1.5).tan(),
            Self::DoubleSphere { xi, alpha } => {
                // Unprojection by equations 46 to 50 of the paper; exact for rays in front of the
                // camera.
                let r2 = radius * radius;
                let under = (1.0 - (2.0 * alpha - 1.0) * r2).max(0.0);
                let mz = (1.0 - alpha * alpha * r2) / (alpha * under.sqrt() + 1.0 - alpha);
                let stretch = (mz * xi + (mz * mz + (1.0 - xi * xi) * r2).max(0.0).sqrt()) / (mz * mz + r2);
                let z = stretch * mz - xi;
                if z <= 0.0 {
                    return None;
                }
                stretch * radius / z
            }
            _ => radius,
        };
        let scale = if radius > 1e-12 { tangent.min(tangent_limit * 0.99) / radius } else { 1.0 };
        Some(Ray::new(x * scale, y * scale))
    }

    /// Largest tangent of the angle from the optical axis up to which the distortion is monotonic
    /// (invertible), at most [`MAX_TANGENT`].
    pub(super) fn tangent_limit(&self) -> f64 {
        let steps = 1000;
        let mut before = 0.0;
        for i in 1..=steps {
            // Equal steps in angle, because the tangent grows without bound towards the edge of a
            // fisheye.
            let angle = MAX_TANGENT.atan() * i as f64 / steps as f64;
            let tangent = angle.tan();
            let radius = match *self {
                Self::None => tangent,
                // The radial part determines monotonicity; the tangential terms are small in
                // comparison.
                Self::BrownConrady { k1, k2, k3, k4, k5, k6, .. } => {
                    let radial = Self::BrownConrady { k1, k2, p1: 0.0, p2: 0.0, k3, k4, k5, k6 };
                    radial.distort(Ray::new(tangent, 0.0)).0.0
                }
                Self::KannalaBrandt { .. } | Self::DoubleSphere { .. } => {
                    self.distort(Ray::new(tangent, 0.0)).0.0
                }
            };
            if radius.is_nan() || radius <= before {
                return (MAX_TANGENT.atan() * (i - 1) as f64 / steps as f64).tan();
            }
            before = radius;
        }
        MAX_TANGENT
    }
}

/// Field-of-view limit: tangent of the largest used angle from the optical axis (86.2°). Rays
/// farther out graze the ground. A [`Ray`] `(x, y, 1)` cannot represent angles of 90° or more,
/// whatever the lens model allows; pixels beyond the limit have no ray.
const MAX_TANGENT: f64 = 15.0;

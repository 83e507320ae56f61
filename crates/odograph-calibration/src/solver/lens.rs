//! Lens models of the solver: projection of points in the camera frame, with derivatives with
//! respect to the point and to all lens parameters.
//!
//! [`odograph::camera::Camera`] works on rays (x, y, 1) and is limited to less than 90° from the
//! optical axis. Here points are projected, so that views of a fisheye lens can be used in full.

use super::config::LensModel;
use nalgebra::{Matrix2x3, Vector3};
use odograph::camera::{Camera, Distortion};
use odograph::error::Result;

/// Number of lens parameters: fx, fy, cx, cy and up to eight distortion coefficients.
pub const NUMBERS: usize = 12;

/// A camera: lens model and parameters. Only the first [`LensModel::coefficients`] distortion
/// coefficients are used.
///
/// The coefficients of Brown–Conrady are in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    pub model: LensModel,
    pub numbers: [f64; NUMBERS],
}

/// The projection of a point, pixels, with its derivatives with respect to the point and to all
/// parameters.
#[derive(Debug, Clone, Copy)]
pub struct Projection {
    pub pixel: [f64; 2],
    pub by_point: Matrix2x3<f64>,
    pub by_numbers: [[f64; NUMBERS]; 2],
}

/// A free lens parameter: its name and the index it sets. `also` is a second index that is set to
/// the same value: fy with square pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Free {
    pub name: &'static str,
    pub at: usize,
    pub also: Option<usize>,
}

/// The free parameters of a model. `square` constrains fx = fy, `centred` fixes the principal
/// point, and only the first `coefficients` distortion coefficients are free.
pub fn free_numbers(model: LensModel, square: bool, centred: bool, coefficients: usize) -> Vec<Free> {
    let one = |name, at| Free { name, at, also: None };
    let mut free = match square {
        true => vec![Free { name: "f", at: 0, also: Some(1) }],
        false => vec![one("fx", 0), one("fy", 1)],
    };
    if !centred {
        free.extend([one("cx", 2), one("cy", 3)]);
    }
    let names: &[&'static str] = match model {
        LensModel::DoubleSphere => &["xi", "alpha"],
        LensModel::KannalaBrandt4 => &["k1", "k2", "k3", "k4"],
        _ => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
    };
    let count = coefficients.min(model.coefficients());
    free.extend(names.iter().take(count).enumerate().map(|(i, name)| one(name, 4 + i)));
    free
}

impl Lens {
    /// A lens with all distortion coefficients zero: undistorted, or equidistant for
    /// Kannala–Brandt.
    pub fn new(model: LensModel, focal_px: f64, principal_px: (f64, f64)) -> Self {
        let mut numbers = [0.0; NUMBERS];
        numbers[..4].copy_from_slice(&[focal_px, focal_px, principal_px.0, principal_px.1]);
        Self { model, numbers }
    }

    /// Converts to a camera with the given image size; fails if the parameters are invalid.
    pub fn camera(&self, size: (usize, usize)) -> Result<Camera> {
        let [fx, fy, cx, cy, a, b, c, d, e, f, g, h] = self.numbers;
        let distortion = match self.model {
            LensModel::Pinhole => Distortion::None,
            LensModel::KannalaBrandt4 => Distortion::KannalaBrandt { k1: a, k2: b, k3: c, k4: d },
            LensModel::DoubleSphere => Distortion::DoubleSphere { xi: a, alpha: b },
            _ => Distortion::BrownConrady { k1: a, k2: b, p1: c, p2: d, k3: e, k4: f, k5: g, k6: h },
        };
        Camera::new(size, (fx, fy), (cx, cy), distortion)
    }

    /// Projects a point in the camera frame to pixels; `None` outside the domain of the model.
    pub fn pixel(&self, point: &Vector3<f64>) -> Option<[f64; 2]> {
        let (x, y) = (point.x, point.y);
        let [fx, fy, cx, cy, a, b, c, d, e, f, g, h] = self.numbers;
        let (u, v) = match self.model {
            LensModel::KannalaBrandt4 => {
                let r = x.hypot(y);
                let scale = if r < 1e-9 * point.z {
                    1.0 / point.z
                } else {
                    let angle = r.atan2(point.z);
                    let a2 = angle * angle;
                    angle * (1.0 + a2 * (a + a2 * (b + a2 * (c + a2 * d)))) / r
                };
                (x * scale, y * scale)
            }
            LensModel::DoubleSphere => {
                let d1 = point.norm();
                let zeta = a * d1 + point.z;
                let d2 = (x * x + y * y + zeta * zeta).sqrt();
                let under = b * d2 + (1.0 - b) * zeta;
                if under < 1e-6 * d1 {
                    return None;
                }
                (x / under, y / under)
            }
            _ => {
                if point.z < 1e-9 {
                    return None;
                }
                let (x, y) = (x / point.z, y / point.z);
                let r2 = x * x + y * y;
                let under = 1.0 + r2 * (f + r2 * (g + r2 * h));
                if under < 1e-6 {
                    return None;
                }
                let radial = (1.0 + r2 * (a + r2 * (b + r2 * e))) / under;
                (
                    x * radial + 2.0 * c * x * y + d * (r2 + 2.0 * x * x),
                    y * radial + c * (r2 + 2.0 * y * y) + 2.0 * d * x * y,
                )
            }
        };
        let pixel = [fx * u + cx, fy * v + cy];
        (pixel[0].is_finite() && pixel[1].is_finite()).then_some(pixel)
    }

    /// [`Lens::pixel`] with derivatives.
    pub fn project(&self, point: &Vector3<f64>) -> Option<Projection> {
        let [fx, fy, cx, cy, ..] = self.numbers;
        let mut by_numbers = [[0.0; NUMBERS]; 2];
        let [by_x, by_y] = &mut by_numbers;
        let ((u, v), mut by_point) = match self.model {
            LensModel::KannalaBrandt4 => self.kannala_brandt(point, &mut by_x[4..], &mut by_y[4..])?,
            LensModel::DoubleSphere => self.double_sphere(point, &mut by_x[4..], &mut by_y[4..])?,
            _ => self.brown_conrady(point, &mut by_x[4..], &mut by_y[4..])?,
        };
        by_x[4..].iter_mut().for_each(|d| *d *= fx);
        by_y[4..].iter_mut().for_each(|d| *d *= fy);
        (by_x[0], by_x[2], by_y[1], by_y[3]) = (u, 1.0, v, 1.0);
        for column in 0..3 {
            by_point[(0, column)] *= fx;
            by_point[(1, column)] *= fy;
        }
        let pixel = [fx * u + cx, fy * v + cy];
        let finite = pixel[0].is_finite() && pixel[1].is_finite();
        finite.then_some(Projection { pixel, by_point, by_numbers })
    }

    fn brown_conrady(&self, point: &Vector3<f64>, by_u: &mut [f64], by_v: &mut [f64]) -> Option<Normalised> {
        if point.z < 1e-9 {
            return None;
        }
        let [_, _, _, _, k1, k2, p1, p2, k3, k4, k5, k6] = self.numbers;
        let inverse_z = 1.0 / point.z;
        let (x, y) = (point.x * inverse_z, point.y * inverse_z);
        let r2 = x * x + y * y;
        let under = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        if under < 1e-6 {
            return None;
        }
        let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / under;
        let radial_by_r2 =
            (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / under;
        let at = (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let powers = [r2 / under, r2 * r2 / under, r2 * r2 * r2 / under];
        for (by, s) in [(&mut *by_u, x), (&mut *by_v, y)] {
            (by[0], by[1], by[4]) = (s * powers[0], s * powers[1], s * powers[2]);
            for i in 0..3 {
                by[5 + i] = -s * radial * powers[i];
            }
        }
        (by_u[2], by_u[3]) = (2.0 * x * y, r2 + 2.0 * x * x);
        (by_v[2], by_v[3]) = (r2 + 2.0 * y * y, 2.0 * x * y);
        let cross = 2.0 * x * y * radial_by_r2 + 2.0 * p1 * x + 2.0 * p2 * y;
        let u_x = radial + 2.0 * x * x * radial_by_r2 + 2.0 * p1 * y + 6.0 * p2 * x;
        let v_y = radial + 2.0 * y * y * radial_by_r2 + 6.0 * p1 * y + 2.0 * p2 * x;
        let by_point = Matrix2x3::new(
            u_x * inverse_z,
            cross * inverse_z,
            -(u_x * x + cross * y) * inverse_z,
            cross * inverse_z,
            v_y * inverse_z,
            -(cross * x + v_y * y) * inverse_z,
        );
        Some((at, by_point))
    }

    fn kannala_brandt(&self, point: &Vector3<f64>, by_u: &mut [f64], by_v: &mut [f64]) -> Option<Normalised> {
        let [_, _, _, _, k1, k2, k3, k4, ..] = self.numbers;
        let (x, y, z) = (point.x, point.y, point.z);
        let r = x.hypot(y);
        if r < 1e-9 * z {
            let s = 1.0 / z;
            return Some(((x * s, y * s), Matrix2x3::new(s, 0.0, -x * s * s, 0.0, s, -y * s * s)));
        }
        if r == 0.0 {
            return None;
        }
        let angle = r.atan2(z);
        let a2 = angle * angle;
        let bent = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
        let bent_by_angle = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
        let scale = bent / r;
        let distance2 = r * r + z * z;
        let scale_by_r = (bent_by_angle * z / distance2 - scale) / r;
        let scale_by_z = -bent_by_angle / distance2;
        let mut power = angle;
        for i in 0..4 {
            power *= a2;
            (by_u[i], by_v[i]) = (x / r * power, y / r * power);
        }
        let cross = x * y / r * scale_by_r;
        let by_point = Matrix2x3::new(
            scale + x * x / r * scale_by_r,
            cross,
            x * scale_by_z,
            cross,
            scale + y * y / r * scale_by_r,
            y * scale_by_z,
        );
        Some(((x * scale, y * scale), by_point))
    }

    fn double_sphere(&self, point: &Vector3<f64>, by_u: &mut [f64], by_v: &mut [f64]) -> Option<Normalised> {
        let [_, _, _, _, xi, alpha, ..] = self.numbers;
        let (x, y, z) = (point.x, point.y, point.z);
        let d1 = point.norm();
        let zeta = xi * d1 + z;
        let d2 = (x * x + y * y + zeta * zeta).sqrt();
        let under = alpha * d2 + (1.0 - alpha) * zeta;
        if under < 1e-6 * d1 {
            return None;
        }
        let s = 1.0 / under;
        // Derivative of `under` with respect to a variable for which ζ has the derivative `zeta_by`
        // and x² + y² has the derivative 2 · `half_r2_by`.
        let under_by = |zeta_by: f64, half_r2_by: f64| {
            alpha * (half_r2_by + zeta * zeta_by) / d2 + (1.0 - alpha) * zeta_by
        };
        let by_x = under_by(xi * x / d1, x);
        let by_y = under_by(xi * y / d1, y);
        let by_z = under_by(xi * z / d1 + 1.0, 0.0);
        let (by_xi, by_alpha) = (under_by(d1, 0.0), d2 - zeta);
        let s2 = s * s;
        (by_u[0], by_u[1]) = (-x * s2 * by_xi, -x * s2 * by_alpha);
        (by_v[0], by_v[1]) = (-y * s2 * by_xi, -y * s2 * by_alpha);
        let by_point = Matrix2x3::new(
            s - x * s2 * by_x,
            -x * s2 * by_y,
            -x * s2 * by_z,
            -y * s2 * by_x,
            s - y * s2 * by_y,
            -y * s2 * by_z,
        );
        Some(((x * s, y * s), by_point))
    }

    /// Unit direction of the ray through a pixel, at most `limit_rad` from the optical axis. The
    /// distortion of models other than Kannala–Brandt is ignored.
    pub fn direction(&self, pixel: (f64, f64), limit_rad: f64) -> Option<Vector3<f64>> {
        let [fx, fy, cx, cy, k1, k2, k3, k4, ..] = self.numbers;
        let (u, v) = ((pixel.0 - cx) / fx, (pixel.1 - cy) / fy);
        if self.model != LensModel::KannalaBrandt4 {
            return Some(Vector3::new(u, v, 1.0).normalize());
        }
        let radius = u.hypot(v);
        if radius < 1e-12 {
            return Some(Vector3::z());
        }
        let mut angle = radius.min(limit_rad);
        for _ in 0..20 {
            let a2 = angle * angle;
            let misfit = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) - radius;
            let slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
            if slope <= 0.05 {
                return None;
            }
            angle = (angle - misfit / slope).clamp(0.0, limit_rad * 1.001);
            if misfit.abs() < 1e-12 {
                break;
            }
        }
        (angle < limit_rad)
            .then(|| Vector3::new(u / radius * angle.sin(), v / radius * angle.sin(), angle.cos()))
    }

    /// Whether the parameters are valid: finite, positive focal lengths, ξ and α of the double
    /// sphere in their range.
    pub fn possible(&self) -> bool {
        let [fx, fy, _, _, xi, alpha, ..] = self.numbers;
        let sphere = self.model != LensModel::DoubleSphere
            || ((-1.0..=1.5).contains(&xi) && (-0.05..=1.0).contains(&alpha));
        fx > 1.0 && fy > 1.0 && sphere && self.numbers.iter().all(|number| number.is_finite())
    }
}

/// Normalised image coordinates (before focal length and principal point are applied) and their
/// derivative with respect to the point.
type Normalised = ((f64, f64), Matrix2x3<f64>);

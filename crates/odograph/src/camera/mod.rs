//! Camera model (intrinsics and lens distortion) and mounting of the camera on its carrier
//! (extrinsics).
//!
//! [`Camera`] projects rays to pixels and back-projects pixels to rays. [`Rig`] is the pose of the
//! camera above the ground. Together they map a pixel to a ground point in metres
//! ([`crate::geometry::GroundPose`]).

pub mod uncertainty;
mod lever_arm;
mod posed_camera;

pub use lever_arm::LeverArm;
pub use posed_camera::{Met, PosedCamera, Seen};
pub use uncertainty::{CameraUncertainty, MeasuredRig, RigDeviations};

use crate::error::{Error, Result};
use crate::geometry::{GroundPose, Pixel, Ray, length};
use nalgebra::{Isometry3, Matrix2};
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
    fn distort(&self, ray: Ray) -> ((f64, f64), Matrix2<f64>) {
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
    fn ray_near(&self, (x, y): (f64, f64), tangent_limit: f64) -> Option<Ray> {
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
    fn tangent_limit(&self) -> f64 {
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

/// A calibrated camera: image size, intrinsics (focal lengths and principal point in pixels), lens
/// distortion and, where known, the readout time of its shutter.
///
/// Pixel centres are at integer coordinates, as in OpenCV.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "CameraParameters", into = "CameraParameters")]
pub struct Camera {
    width: usize,
    height: usize,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    distortion: Distortion,
    tangent_limit: f64,
    readout_s: Option<f64>,
    readout_deviation_s: f64,
}

/// The serialised form of a [`Camera`]: plain, unchecked numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct CameraParameters {
    width: usize,
    height: usize,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    distortion: Distortion,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    readout_s: Option<f64>,
    #[serde(default, skip_serializing_if = "is_zero")]
    readout_deviation_s: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl TryFrom<CameraParameters> for Camera {
    type Error = Error;

    fn try_from(p: CameraParameters) -> Result<Self> {
        let camera = Self::new((p.width, p.height), (p.fx, p.fy), (p.cx, p.cy), p.distortion)?;
        Ok(camera.with_readout_s(p.readout_s)?.with_readout_deviation_s(p.readout_deviation_s))
    }
}

impl From<Camera> for CameraParameters {
    fn from(c: Camera) -> Self {
        let Camera { width, height, fx, fy, cx, cy, distortion, readout_s, readout_deviation_s, .. } = c;
        Self { width, height, fx, fy, cx, cy, distortion, readout_s, readout_deviation_s }
    }
}

impl Camera {
    /// A camera from its intrinsics: image `size` (width, height), focal lengths `(fx, fy)` and
    /// principal point `(cx, cy)`, all in pixels.
    ///
    /// Fails if a number is not finite, a focal length is not positive, a side of the image is zero
    /// or longer than 65536 pixels, or the principal point is outside the image by more than the
    /// image's width or height.
    pub fn new(
        size: (usize, usize),
        focal_px: (f64, f64),
        principal_px: (f64, f64),
        distortion: Distortion,
    ) -> Result<Self> {
        let (width, height) = size;
        if width == 0 || height == 0 || width > 1 << 16 || height > 1 << 16 {
            return Err(Error::input(format!("an image size of {width}x{height} is not usable")));
        }
        for (name, value) in
            [("fx", focal_px.0), ("fy", focal_px.1), ("cx", principal_px.0), ("cy", principal_px.1)]
        {
            if !value.is_finite() {
                return Err(Error::input(format!("{name} is {value}; it must be a finite number of pixels")));
            }
        }
        for (name, value) in [("fx", focal_px.0), ("fy", focal_px.1)] {
            if value <= 0.0 {
                return Err(Error::input(format!("{name} is {value}; a focal length must be positive")));
            }
        }
        if let Some(bad) = distortion.coefficients().into_iter().find(|c| !c.is_finite()) {
            return Err(Error::input(format!(
                "a distortion coefficient is {bad}; it must be a finite number"
            )));
        }
        let (w, h) = (width as f64, height as f64);
        if !(-w..2.0 * w).contains(&principal_px.0) || !(-h..2.0 * h).contains(&principal_px.1) {
            return Err(Error::input(format!(
                "the principal point ({}, {}) is far outside the {width}x{height} image",
                principal_px.0, principal_px.1
            )));
        }
        let tangent_limit = distortion.tangent_limit();
        Ok(Self {
            width,
            height,
            fx: focal_px.0,
            fy: focal_px.1,
            cx: principal_px.0,
            cy: principal_px.1,
            distortion,
            tangent_limit,
            readout_s: None,
            readout_deviation_s: 0.0,
        })
    }

    /// The same camera with its readout time in seconds: the delay between the exposures of the
    /// first and the last row. 0 is a global shutter, positive a rolling shutter that reads from
    /// top to bottom, negative one that reads from bottom to top, and `None` an unknown readout
    /// time.
    ///
    /// Fails if the time is not finite or its magnitude exceeds [`Camera::LONGEST_READOUT_S`].
    pub fn with_readout_s(self, readout_s: Option<f64>) -> Result<Self> {
        match readout_s {
            Some(readout) if !readout.is_finite() || readout.abs() > Self::LONGEST_READOUT_S => {
                Err(Error::input(format!(
                    "the readout time is {} ms; it must lie within {} ms, and is shorter than a frame lasts",
                    1e3 * readout,
                    1e3 * Self::LONGEST_READOUT_S
                )))
            }
            _ => Ok(Self { readout_s, readout_deviation_s: 0.0, ..self }),
        }
    }

    /// Longest readout time of a rolling shutter, seconds: 10 frames per second, read without a
    /// pause.
    pub const LONGEST_READOUT_S: f64 = 0.1;

    /// Readout time of the shutter, seconds ([`Camera::with_readout_s`]); `None` if unknown.
    pub fn readout_s(&self) -> Option<f64> {
        self.readout_s
    }

    /// The same camera whose readout time has this standard deviation, seconds; 0, which
    /// [`Camera::with_readout_s`] sets, where it is exact. What is not finite or negative counts as
    /// 0.
    pub fn with_readout_deviation_s(self, deviation_s: f64) -> Self {
        let readout_deviation_s = if deviation_s.is_finite() { deviation_s.max(0.0) } else { 0.0 };
        Self { readout_deviation_s, ..self }
    }

    /// Standard deviation of [`Camera::readout_s`], seconds.
    pub fn readout_deviation_s(&self) -> f64 {
        self.readout_deviation_s
    }

    /// A pinhole camera whose image covers `field_of_view_m` (width, height, metres) on level
    /// ground seen from `height_m`: a measured field of view in place of a calibration. The field
    /// of view is measured between the outer edges of the outermost pixels.
    pub fn from_field_of_view(
        size: (usize, usize),
        field_of_view_m: (f64, f64),
        height_m: f64,
    ) -> Result<Self> {
        let (w, h) = (size.0 as f64, size.1 as f64);
        let focal_px = (w * height_m / field_of_view_m.0, h * height_m / field_of_view_m.1);
        Self::new(size, focal_px, ((w - 1.0) / 2.0, (h - 1.0) / 2.0), Distortion::None)
    }

    /// Image width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Image height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Focal lengths (fx, fy) in pixels.
    pub fn focal_px(&self) -> (f64, f64) {
        (self.fx, self.fy)
    }

    /// Principal point (cx, cy) in pixels.
    pub fn principal_px(&self) -> (f64, f64) {
        (self.cx, self.cy)
    }

    /// The distortion model.
    pub fn distortion(&self) -> &Distortion {
        &self.distortion
    }

    /// Projects a ray; the pixel may lie outside the image. `None` where the lens model is not
    /// invertible.
    pub fn pixel_from_ray(&self, ray: Ray) -> Option<Pixel> {
        self.pixel_and_derivative(ray).map(|(pixel, _)| pixel)
    }

    /// [`Camera::pixel_from_ray`] with the 2 × 2 Jacobian of the pixel with respect to the ray,
    /// pixels per unit tangent.
    #[inline]
    pub fn pixel_and_derivative(&self, ray: Ray) -> Option<(Pixel, Matrix2<f64>)> {
        let beyond = ray.x * ray.x + ray.y * ray.y > self.tangent_limit * self.tangent_limit;
        if beyond || ray.x.is_nan() || ray.y.is_nan() {
            return None;
        }
        let ((x, y), derivative) = self.distortion.distort(ray);
        let pixel = Pixel::new(self.fx * x + self.cx, self.fy * y + self.cy);
        Some((pixel, Matrix2::new(self.fx, 0.0, 0.0, self.fy) * derivative))
    }

    /// Back-projects a pixel to its undistorted ray: Newton's method on [`Camera::pixel_from_ray`],
    /// exact to 1e-9 pixels. `None` where no ray of the lens model projects to the pixel.
    pub fn ray_from_pixel(&self, pixel: Pixel) -> Option<Ray> {
        let target = ((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        if let Distortion::None = self.distortion {
            return Some(Ray::new(target.0, target.1));
        }
        let mut ray = self.distortion.ray_near(target, self.tangent_limit)?;
        let misfit = |ray: Ray| {
            let ((x, y), derivative) = self.distortion.distort(ray);
            ((target.0 - x, target.1 - y), derivative)
        };
        let (mut residual, mut derivative) = misfit(ray);
        for _ in 0..50 {
            let size = length(residual.0, residual.1);
            if size * self.fx.max(self.fy) < 1e-9 {
                let inside = length(ray.x, ray.y) <= self.tangent_limit;
                return inside.then_some(ray);
            }
            let inverse = derivative.try_inverse()?;
            let (dx, dy) = (
                inverse[(0, 0)] * residual.0 + inverse[(0, 1)] * residual.1,
                inverse[(1, 0)] * residual.0 + inverse[(1, 1)] * residual.1,
            );
            // Step halving (line search): far from the axis, barrel distortion makes a full step
            // overshoot.
            let mut factor = 1.0;
            loop {
                let next = Ray::new(ray.x + factor * dx, ray.y + factor * dy);
                let (next_residual, next_derivative) = misfit(next);
                let better = length(next_residual.0, next_residual.1) < size;
                if better && length(next.x, next.y) <= self.tangent_limit * 1.001 {
                    (ray, residual, derivative) = (next, next_residual, next_derivative);
                    break;
                }
                factor *= 0.5;
                if factor < 1e-6 {
                    let good_enough = size * self.fx.max(self.fy) < 1e-6;
                    return good_enough.then_some(ray);
                }
            }
        }
        None
    }

    /// Whether a pixel is inside the image and at least `margin_px` from every border.
    pub fn contains(&self, pixel: Pixel, margin_px: f64) -> bool {
        let inside = |v: f64, size: usize| v >= margin_px && v <= size as f64 - 1.0 - margin_px;
        inside(pixel.x, self.width) && inside(pixel.y, self.height)
    }
}

/// Mounting (extrinsics) of the camera on its carrier over flat ground.
///
/// The angles are those of [`GroundPose`]: roll about the carrier's forward axis and pitch about
/// its left axis, both right-handed and 0 for a nadir-looking camera. With `yaw_rad` = 0 the top of
/// the image points forward.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Height of the camera centre above the ground, metres.
    pub height_m: f64,
    /// Roll, 0 for a nadir-looking camera, radians.
    #[serde(default)]
    pub roll_rad: f64,
    /// Pitch, 0 for a nadir-looking camera, radians.
    #[serde(default)]
    pub pitch_rad: f64,
    /// Mount yaw: direction of the top of the image, counter-clockwise from the carrier's forward
    /// axis, radians.
    #[serde(default)]
    pub yaw_rad: f64,
    /// Position of the camera centre on the robot, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lever_arm: Option<LeverArm>,
}

impl Rig {
    /// A nadir-looking camera at `height_m` with the top of its image forward.
    pub fn level(height_m: f64) -> Self {
        Self { height_m, roll_rad: 0.0, pitch_rad: 0.0, yaw_rad: 0.0, lever_arm: None }
    }

    /// Checks the mounting. Fails if a number is not finite, the height is not positive, the
    /// camera does not look at the ground, or the lever arm is longer than
    /// [`LeverArm::GREATEST_M`].
    pub fn validated(self) -> Result<Self> {
        let Self { height_m, roll_rad, pitch_rad, yaw_rad, lever_arm } = self;
        if !(height_m.is_finite() && height_m > 0.0) {
            return Err(Error::usage(format!(
                "the height is {height_m} m; it must be a positive number of metres above the ground"
            )));
        }
        for (name, value) in [("roll", roll_rad), ("pitch", pitch_rad), ("yaw", yaw_rad)] {
            if !value.is_finite() {
                return Err(Error::usage(format!("the rig's {name} is {value}; it must be finite")));
            }
        }
        if roll_rad.cos() * pitch_rad.cos() < 0.1 || roll_rad.abs() > 1.6 || pitch_rad.abs() > 1.6 {
            return Err(Error::usage(format!(
                "a rig with roll {:.1}° and pitch {:.1}° does not look at the ground; angles count from straight down",
                roll_rad.to_degrees(),
                pitch_rad.to_degrees()
            )));
        }
        lever_arm.map(LeverArm::validated).transpose()?;
        Ok(self)
    }

    /// Pose of the camera in `base_link`, where the lever arm is known: the axes of a level robot,
    /// x forward, y left, z up.
    pub fn base_from_camera(&self) -> Option<Isometry3<f64>> {
        let LeverArm { x_m, y_m, z_m } = self.lever_arm?;
        let on_robot = GroundPose {
            x_m,
            y_m,
            heading_rad: self.yaw_rad,
            height_m: z_m,
            roll_rad: self.roll_rad,
            pitch_rad: self.pitch_rad,
        };
        Some(on_robot.world_from_camera())
    }

    /// Initial pose of a run: above the world's origin, with the top of the image along world x.
    pub fn first_pose(&self) -> GroundPose {
        GroundPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
            height_m: self.height_m,
            roll_rad: self.roll_rad,
            pitch_rad: self.pitch_rad,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cameras() -> Vec<Camera> {
        let size = (640, 480);
        let make = |distortion| Camera::new(size, (500.0, 505.0), (320.5, 238.0), distortion).unwrap();
        vec![
            make(Distortion::None),
            make(Distortion::from_opencv(&[-0.28, 0.07, 0.0002, -0.0003]).unwrap()),
            make(Distortion::from_opencv(&[-0.3, 0.15, -0.0008, 0.0003, -0.066]).unwrap()),
            make(Distortion::from_opencv(&[0.4, 0.1, 0.0, 0.0, 0.01, 0.7, 0.2, 0.02]).unwrap()),
            Camera::new(
                size,
                (300.0, 301.0),
                (320.0, 240.0),
                Distortion::KannalaBrandt { k1: -0.01, k2: 0.003, k3: -0.002, k4: 0.0003 },
            )
            .unwrap(),
            make(Distortion::DoubleSphere { xi: 0.0, alpha: 0.0 }),
            Camera::new(
                size,
                (240.0, 241.0),
                (320.0, 240.0),
                Distortion::DoubleSphere { xi: -0.18, alpha: 0.59 },
            )
            .unwrap(),
        ]
    }

    proptest! {
        #[test]
        fn every_pixel_comes_back_from_its_ray(x in 0.0..640.0, y in 0.0..480.0) {
            for camera in cameras() {
                let pixel = Pixel::new(x, y);
                let Some(ray) = camera.ray_from_pixel(pixel) else {
                    return Err(TestCaseError::fail(format!("no ray for {pixel:?} in {camera:?}")));
                };
                let back = camera.pixel_from_ray(ray).unwrap();
                prop_assert!(pixel.distance(back) < 1e-6, "{camera:?} {pixel:?} {back:?}");
            }
        }

        #[test]
        fn the_derivative_is_that_of_the_projection(x in -0.5..0.5, y in -0.4..0.4) {
            for camera in cameras() {
                let (_, derivative) = camera.pixel_and_derivative(Ray::new(x, y)).unwrap();
                let step = 1e-6;
                for (column, (dx, dy)) in [(step, 0.0), (0.0, step)].into_iter().enumerate() {
                    let ahead = camera.pixel_from_ray(Ray::new(x + dx, y + dy)).unwrap();
                    let behind = camera.pixel_from_ray(Ray::new(x - dx, y - dy)).unwrap();
                    let numeric = ((ahead.x - behind.x) / (2.0 * step), (ahead.y - behind.y) / (2.0 * step));
                    prop_assert!((numeric.0 - derivative[(0, column)]).abs() < 1e-3);
                    prop_assert!((numeric.1 - derivative[(1, column)]).abs() < 1e-3);
                }
            }
        }
    }

    #[test]
    fn projection_agrees_with_opencv() {
        // The values of cv2.projectPoints((0.3, -0.2, 1), …) with the same parameters.
        let camera = Camera::new(
            (640, 480),
            (532.83, 532.95),
            (342.49, 233.86),
            Distortion::from_opencv(&[-0.28088, 0.02518, 0.00122, -0.00014, 0.16343]).unwrap(),
        )
        .unwrap();
        let pixel = camera.pixel_from_ray(Ray::new(0.3, -0.2)).unwrap();
        let r2: f64 = 0.13;
        let d = 1.0 - 0.28088 * r2 + 0.02518 * r2 * r2 + 0.16343 * r2 * r2 * r2;
        let x = 0.3 * d + 2.0 * 0.00122 * 0.3 * -0.2 - 0.00014 * (r2 + 2.0 * 0.09);
        let y = -0.2 * d + 0.00122 * (r2 + 2.0 * 0.04) - 2.0 * 0.00014 * 0.3 * -0.2;
        assert!((pixel.x - (532.83 * x + 342.49)).abs() < 1e-9);
        assert!((pixel.y - (532.95 * y + 233.86)).abs() < 1e-9);
    }

    #[test]
    fn rays_beyond_the_monotonic_range_have_no_pixel() {
        let camera = Camera::new(
            (640, 480),
            (500.0, 500.0),
            (320.0, 240.0),
            Distortion::from_opencv(&[-0.3, 0.0, 0.0, 0.0]).unwrap(),
        )
        .unwrap();
        // d/dr (r − 0.3 r³) = 1 − 0.9 r² = 0 at r = 1.054.
        assert!(camera.pixel_from_ray(Ray::new(1.0, 0.0)).is_some());
        assert!(camera.pixel_from_ray(Ray::new(1.2, 0.0)).is_none());
    }

    #[test]
    fn invalid_cameras_and_rigs_are_rejected() {
        let bad = Camera::new((640, 480), (f64::NAN, 500.0), (320.0, 240.0), Distortion::None).unwrap_err();
        assert!(bad.to_string().contains("fx is NaN"));
        assert!(Rig::level(-1.0).validated().is_err());
        assert!(Rig { pitch_rad: 2.0, ..Rig::level(1.0) }.validated().is_err());
    }

    #[test]
    fn field_of_view_spans_outer_pixel_edges() {
        let camera = Camera::from_field_of_view((640, 480), (1.2, 0.9), 1.0).unwrap();
        let pose = GroundPose::level(1.0);
        let left = pose.ground_from_ray(camera.ray_from_pixel(Pixel::new(-0.5, 239.5)).unwrap()).unwrap();
        let right = pose.ground_from_ray(camera.ray_from_pixel(Pixel::new(639.5, 239.5)).unwrap()).unwrap();
        assert!((left.y_m - right.y_m - 1.2).abs() < 1e-12);
    }
}

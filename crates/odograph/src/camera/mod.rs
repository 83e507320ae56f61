//! Camera model (intrinsics and lens distortion) and mounting of the camera on its carrier
//! (extrinsics).
//!
//! [`Camera`] projects rays to pixels and back-projects pixels to rays. [`Rig`] is the pose of the
//! camera above the ground. Together they map a pixel to a ground point in metres
//! ([`crate::geometry::GroundPose`]).

pub mod uncertainty;
mod distortion;
mod lever_arm;
mod posed_camera;
mod rig;

pub use distortion::Distortion;
pub use lever_arm::LeverArm;
pub use posed_camera::{GroundIntersection, PosedCamera, ProjectedPoint};
pub use rig::Rig;
pub use uncertainty::{CalibrationDeviations, CameraUncertainty, MeasuredRig, RigDeviations};

use crate::error::{Error, Result};
use crate::geometry::{Pixel, Ray, length};
use nalgebra::Matrix2;
use serde::{Deserialize, Serialize};

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

/// Largest magnitude of a distortion coefficient. Those of a rational model may be in the hundreds.
const MAX_DISTORTION: f64 = 1e6;

impl Camera {
    /// A camera from its intrinsics: image `size` (width, height), focal lengths `(fx, fy)` and
    /// principal point `(cx, cy)`, all in pixels.
    ///
    /// Fails if a number is not finite, a focal length is not positive or not within a factor of
    /// 1000 of the image's longer side, a coefficient is beyond a million, a side of the image is
    /// zero or longer than 65536 pixels, or the principal point is outside the image by more than
    /// the image's width or height.
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
            let longer = width.max(height) as f64;
            if !(1e-3 * longer..=1e3 * longer).contains(&value) {
                return Err(Error::input(format!(
                    "{name} is {value:?}; a focal length is in pixels, near the {longer} of the image"
                )));
            }
        }
        if let Some(bad) =
            distortion.coefficients().into_iter().find(|c| !(-MAX_DISTORTION..=MAX_DISTORTION).contains(c))
        {
            return Err(Error::input(format!(
                "a distortion coefficient is {bad:?}; it must be a number of at most a million"
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

    /// The camera of the images at this level of a Gaussian pyramid: (x, y) of the full image is at
    /// (x, y) / 2^`level` there.
    pub(crate) fn halved(&self, level: u32) -> Self {
        let scale = 0.5f64.powi(level as i32);
        let side = |side: usize| (0..level).fold(side, |side, _| side.div_ceil(2));
        Self {
            width: side(self.width),
            height: side(self.height),
            fx: scale * self.fx,
            fy: scale * self.fy,
            cx: scale * self.cx,
            cy: scale * self.cy,
            ..self.clone()
        }
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

    /// Whether one of two cameras may be the other with a lens that was estimated while driving.
    /// Such an estimate keeps size and geometric mean of the focal lengths, and no two calibrations
    /// agree in that.
    pub fn differs_by_estimate(&self, other: &Self) -> bool {
        const ROUNDING: f64 = 1e-9;
        let [own, others] = [self, other].map(|camera| camera.focal_px().0 * camera.focal_px().1);
        (self.width(), self.height()) == (other.width(), other.height())
            && (own / others - 1.0).abs() < ROUNDING
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

#[cfg(test)]
mod tests;

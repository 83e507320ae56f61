//! Uncertainty of a rig, and propagation of the camera's own uncertainty.

use super::{Camera, Distortion, Rig};
use crate::error::{Error, Result};
use crate::geometry::Pixel;
use nalgebra::{DMatrix, Matrix3, SMatrix, SVector, Vector2};
use serde::{Deserialize, Serialize};

/// A measured rig.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredRig {
    /// The rig.
    pub rig: Rig,
    /// One standard deviation of each of its numbers.
    pub deviations: RigDeviations,
}

/// One standard deviation of each number of a [`Rig`]; `None` if it was given or is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RigDeviations {
    /// Of the height, metres.
    pub height_m: Option<f64>,
    /// Of the roll, radians.
    pub roll_rad: Option<f64>,
    /// Of the pitch, radians.
    pub pitch_rad: Option<f64>,
    /// Of the mount yaw, radians.
    pub yaw_rad: Option<f64>,
    /// Of the camera's place ahead of `base_link`, metres.
    pub x_m: Option<f64>,
    /// Of the camera's place to the left of `base_link`, metres.
    pub y_m: Option<f64>,
    /// Of the place of a satellite receiver's antenna, ahead and to the left, metres.
    pub antenna_m: Option<f64>,
}

impl RigDeviations {
    /// From the covariance of (height, roll, pitch).
    pub fn of(covariance: &Matrix3<f64>, yaw_rad: Option<f64>) -> Self {
        let deviation = |i: usize| Some(covariance[(i, i)].sqrt());
        let [height_m, roll_rad, pitch_rad] = [0, 1, 2].map(deviation);
        Self { height_m, roll_rad, pitch_rad, yaw_rad, ..Self::default() }
    }
}

/// Standard deviations of a calibration as they reach a path: they are the same all the way, so
/// that no frame shows them.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CalibrationDeviations {
    /// Of the scale, relative: that of height and focal length. 0 if they were given.
    pub scale: f64,
    /// Of the roll of the mount, radians; `None` if it is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub roll_rad: Option<f64>,
    /// Of the pitch of the mount, radians; `None` if it is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pitch_rad: Option<f64>,
}

impl CalibrationDeviations {
    /// Of a camera at this height, metres.
    pub fn new(
        (camera, uncertainty): (&Camera, Option<&CameraUncertainty>),
        (height_m, mount): (f64, &RigDeviations),
    ) -> Self {
        let of_lens = uncertainty.and_then(|uncertainty| {
            let variance = uncertainty.propagated(camera, |varied| Some([ground_scale(camera, varied)?]))?;
            Some(variance[(0, 0)].sqrt())
        });
        let of_height = mount.height_m.map(|deviation_m| deviation_m / height_m);
        Self {
            scale: of_lens.unwrap_or(0.0).hypot(of_height.unwrap_or(0.0)),
            roll_rad: mount.roll_rad,
            pitch_rad: mount.pitch_rad,
        }
    }

    /// Whether nothing is known of them.
    pub fn is_unknown(&self) -> bool {
        *self == Self::default()
    }
}

/// The scale of level ground as another lens sees it, relative to that of `camera`: least squares
/// over a grid of pixels, whose common shift is no scale.
fn ground_scale(camera: &Camera, other: &Camera) -> Option<f64> {
    const PIXELS: usize = 5;
    let at = |k: usize, size: usize| (k as f64 + 0.5) / PIXELS as f64 * size as f64 - 0.5;
    let seen = |lens: &Camera| -> Option<Vec<Vector2<f64>>> {
        let pixels = (0..PIXELS * PIXELS)
            .map(|k| Pixel::new(at(k % PIXELS, camera.width()), at(k / PIXELS, camera.height())));
        let points = pixels.map(|pixel| lens.ray_from_pixel(pixel).map(|ray| Vector2::new(ray.x, ray.y)));
        let points: Vec<_> = points.collect::<Option<_>>()?;
        let mean = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
        Some(points.iter().map(|point| point - mean).collect())
    };
    let (points, others) = (seen(camera)?, seen(other)?);
    let product: f64 = points.iter().zip(&others).map(|(point, other)| point.dot(other)).sum();
    Some(product / points.iter().map(Vector2::norm_squared).sum::<f64>())
}

/// The covariance of a camera's parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraUncertainty {
    names: Vec<String>,
    covariance: DMatrix<f64>,
}

impl CameraUncertainty {
    /// From the parameters' names, in the order of the covariance's rows: `fx`, `fy` (or `f` for
    /// both), `cx`, `cy` in pixels and the coefficients of the lens (`k1`, `p1`, …). Names that the
    /// camera does not have are ignored.
    ///
    /// Fails if the size of the covariance is not the number of names, or if it is no covariance.
    pub fn new(names: Vec<String>, covariance: DMatrix<f64>) -> Result<Self> {
        let n = names.len();
        let sound = covariance.shape() == (n, n)
            && covariance.iter().all(|v| v.is_finite())
            && (0..n).all(|i| covariance[(i, i)] >= 0.0);
        if !sound {
            return Err(Error::input(format!(
                "the covariance of the {n} camera parameters is {}x{} or holds impossible numbers",
                covariance.nrows(),
                covariance.ncols()
            )));
        }
        Ok(Self { names, covariance })
    }

    /// Propagates the covariance to `outcome`, a function of the camera: first order, by central
    /// differences of one standard deviation along the principal axes of the correlation. `None` if
    /// the outcome is undefined for a varied camera.
    ///
    /// The coefficients of a rational lens are known much better together than one by one: a
    /// standard deviation of one alone may be no lens any more.
    pub fn propagated<const N: usize>(
        &self,
        camera: &Camera,
        outcome: impl Fn(&Camera) -> Option<[f64; N]>,
    ) -> Option<SMatrix<f64, N, N>> {
        let deviations = self.covariance.diagonal().map(f64::sqrt);
        let correlation = DMatrix::from_fn(self.names.len(), self.names.len(), |i, j| {
            let scale = deviations[i] * deviations[j];
            if scale > 0.0 { self.covariance[(i, j)] / scale } else { 0.0 }
        });
        let axes = correlation.symmetric_eigen();
        let mut covariance = SMatrix::zeros();
        for (axis, variance) in axes.eigenvectors.column_iter().zip(&axes.eigenvalues) {
            if *variance <= 0.0 {
                continue;
            }
            let step = axis.component_mul(&deviations) * variance.sqrt();
            let at = |sign: f64| {
                let changes = self.names.iter().zip(step.iter()).map(|(name, by)| (name.as_str(), sign * by));
                outcome(&changed(camera, changes)?).map(SVector::from)
            };
            let half: SVector<f64, N> = 0.5 * (at(1.0)? - at(-1.0)?);
            covariance += half * half.transpose();
        }
        Some(covariance)
    }
}

/// Name of the ratio of the focal lengths, fy/fx.
pub const ASPECT: &str = "fy/fx";

/// The camera with one parameter changed; `None` for a name that it does not have, or if the result
/// is no valid camera.
pub fn varied(camera: &Camera, name: &str, by: f64) -> Option<Camera> {
    parameter(camera, name)?;
    changed(camera, [(name, by)])
}

/// The camera with several parameters changed; names that it does not have are ignored. `None` if
/// the result is no valid camera.
fn changed<'a>(camera: &Camera, changes: impl IntoIterator<Item = (&'a str, f64)>) -> Option<Camera> {
    let ((mut fx, mut fy), (mut cx, mut cy)) = (camera.focal_px(), camera.principal_px());
    let mut distortion = *camera.distortion();
    for (name, by) in changes {
        match name {
            "fx" => fx += by,
            "fy" => fy += by,
            "f" => {
                // Of square pixels only one focal length is estimated.
                fy += by * fy / fx;
                fx += by;
            }
            // Of the same geometric mean.
            ASPECT => {
                let factor = (1.0 + by * fx / fy).sqrt();
                (fx, fy) = (fx / factor, fy * factor);
            }
            "cx" => cx += by,
            "cy" => cy += by,
            _ => coefficient(&mut distortion, name).into_iter().for_each(|value| *value += by),
        }
    }
    let changed = Camera::new((camera.width(), camera.height()), (fx, fy), (cx, cy), distortion).ok()?;
    changed.with_readout_s(camera.readout_s()).ok()
}

/// A parameter of a camera by its name.
pub fn parameter(camera: &Camera, name: &str) -> Option<f64> {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    match name {
        "fx" | "f" => Some(fx),
        "fy" => Some(fy),
        ASPECT => Some(fy / fx),
        "cx" => Some(cx),
        "cy" => Some(cy),
        _ => coefficient(&mut camera.distortion().clone(), name).copied(),
    }
}

fn coefficient<'a>(distortion: &'a mut Distortion, name: &str) -> Option<&'a mut f64> {
    match distortion {
        Distortion::None => None,
        Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } => {
            let all = [
                ("k1", k1),
                ("k2", k2),
                ("p1", p1),
                ("p2", p2),
                ("k3", k3),
                ("k4", k4),
                ("k5", k5),
                ("k6", k6),
            ];
            all.into_iter().find(|(own, _)| *own == name).map(|(_, value)| value)
        }
        Distortion::DoubleSphere { xi, alpha } => match name {
            "xi" => Some(xi),
            "alpha" => Some(alpha),
            _ => None,
        },
        Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
            let all = [("k1", k1), ("k2", k2), ("k3", k3), ("k4", k4)];
            all.into_iter().find(|(own, _)| *own == name).map(|(_, value)| value)
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    fn camera() -> Camera {
        let lens = Distortion::from_opencv(&[-5.4, 7.1, 0.0, 0.0, 0.5, -5.3, 6.5, 1.4]).unwrap();
        Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), lens).unwrap()
    }

    fn uncertainty(names: &[&str], rows: &[f64]) -> CameraUncertainty {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let covariance = DMatrix::from_row_slice(names.len(), names.len(), rows);
        CameraUncertainty::new(names, covariance).unwrap()
    }

    #[test]
    fn a_linear_outcome_has_the_covariance_of_its_parameters() {
        let known = uncertainty(&["fx", "cy", "unknown"], &[4.0, 1.5, 0.3, 1.5, 1.0, 0.2, 0.3, 0.2, 1.0]);
        let outcome = |camera: &Camera| Some([camera.focal_px().0, 2.0 * camera.principal_px().1]);
        let found = known.propagated(&camera(), outcome).unwrap();
        assert!((found - SMatrix::<f64, 2, 2>::new(4.0, 3.0, 3.0, 4.0)).norm() < 1e-9, "{found}");
    }

    #[test]
    fn the_scale_of_a_path_is_as_uncertain_as_height_and_focal_length() {
        let mount = RigDeviations { height_m: Some(0.003), roll_rad: Some(0.01), ..RigDeviations::default() };
        let plain = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
        let lens = uncertainty(&["f", "cx"], &[4.0, 0.0, 0.0, 100.0]);
        let both = CalibrationDeviations::new((&plain, Some(&lens)), (0.75, &mount));
        assert!((both.scale - f64::hypot(0.004, 0.004)).abs() < 1e-5, "{both:?}");
        assert_eq!((both.roll_rad, both.pitch_rad), (Some(0.01), None));
        assert!(CalibrationDeviations::new((&plain, None), (0.75, &RigDeviations::default())).is_unknown());
    }

    #[test]
    fn coefficients_that_are_known_together_are_varied_together() {
        let known = uncertainty(&["k1", "k4"], &[1.0, 1.0, 1.0, 1.0]);
        // Alone, a change of k1 or k4 is no lens any more.
        let outcome = |camera: &Camera| {
            let [k1, k4] = ["k1", "k4"].map(|name| parameter(camera, name).unwrap());
            ((k1 - k4 + 0.1).abs() < 1e-6).then_some([k1])
        };
        let found = known.propagated(&camera(), outcome).unwrap();
        assert!((found[(0, 0)] - 1.0).abs() < 1e-9, "{found}");
    }
}

//! Distortion parameters as unknowns of the bundle adjustment.

use super::LENS_START;
use crate::camera::uncertainty::{ASPECT, parameter, varied};
use crate::camera::{Camera, Distortion};
use crate::geometry::Ray;
use crate::numerics::Part;
use nalgebra::Vector2;

/// The distortion parameters that are estimated: the leading ones of the camera's model.
pub struct LensUnknowns {
    camera: Camera,
    names: &'static [&'static str],
    /// The change of each parameter so far.
    change: Vec<f64>,
    /// The camera with each parameter increased and decreased by [`STEP`].
    perturbed: Vec<[Camera; 2]>,
}

/// Half the width of a central difference by a coefficient.
const STEP: f64 = 1e-5;

/// Prior standard deviation of a parameter, of the principal point as a fraction of the focal
/// length: that of a careless calibration, and of radial coefficients, which may not have been
/// calibrated at all. It decides what the motion leaves open: straight driving shows a tilt and
/// errors of principal point and decentering together, but hardly one by one.
fn calibration_sigma(parameter: &str) -> f64 {
    match parameter {
        "cx" | "cy" => 0.01,
        ASPECT => 0.005,
        "p1" | "p2" => 0.002,
        _ => 0.1,
    }
}

/// Largest number of parameters.
pub const MAX_PARAMETERS: usize = 7;

impl LensUnknowns {
    /// `None` if the changed parameters are no valid camera. Parameters that the lens model lacks
    /// stay zero, with zero derivatives.
    pub fn new(camera: &Camera, count: usize) -> Option<Self> {
        // A pinhole without distortion is given a radial model.
        let distortion = match *camera.distortion() {
            Distortion::None if count > 0 => Distortion::from_opencv(&[0.0; 4])?,
            known => known,
        };
        let all: &[&str] = match distortion {
            Distortion::None => &[],
            Distortion::BrownConrady { .. } => &["k1", "k2", "cx", "cy", ASPECT, "p1", "p2"],
            Distortion::KannalaBrandt { .. } => &["k1", "k2", "cx", "cy", ASPECT],
            Distortion::DoubleSphere { .. } => &["alpha"],
        };
        let size = (camera.width(), camera.height());
        let lens = Camera::new(size, camera.focal_px(), camera.principal_px(), distortion).ok()?;
        let camera = lens.with_readout_s(camera.readout_s()).ok()?;
        let mut lens = Self {
            camera,
            names: &all[..count.min(all.len())],
            change: vec![0.0; count],
            perturbed: Vec::new(),
        };
        lens.perturb()?;
        Some(lens)
    }

    /// The camera with the present parameters.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The change of each parameter.
    pub fn change(&self) -> &[f64] {
        &self.change
    }

    /// Names and present values of the parameters.
    pub fn coefficients(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let value = |name: &&'static str| Some((*name, parameter(&self.camera, name)?));
        self.names.iter().filter_map(value)
    }

    /// Adds to the parameters. `None` if the result is no valid camera.
    pub fn add_change(&mut self, by: &[f64]) -> Option<()> {
        for ((name, change), by) in self.names.iter().zip(&mut self.change).zip(by) {
            self.camera = varied(&self.camera, name, *by)?;
            *change += by;
        }
        self.perturb()
    }

    fn perturb(&mut self) -> Option<()> {
        let both =
            |name: &&str| Some([varied(&self.camera, name, STEP)?, varied(&self.camera, name, -STEP)?]);
        self.perturbed = self.names.iter().map(both).collect::<Option<_>>()?;
        Some(())
    }

    /// ∂pixel/∂parameter for a fixed ray; zero for parameters that the model lacks.
    pub fn pixel_by_lens(&self, ray: Ray) -> Option<[Vector2<f64>; MAX_PARAMETERS]> {
        let mut pixel_by_lens = [Vector2::zeros(); MAX_PARAMETERS];
        for (derivative, [more, less]) in pixel_by_lens.iter_mut().zip(&self.perturbed) {
            let (more, less) = (more.pixel_from_ray(ray)?, less.pixel_from_ray(ray)?);
            *derivative = Vector2::new(more.x - less.x, more.y - less.y) / (2.0 * STEP);
        }
        Some(pixel_by_lens)
    }

    /// ∂ray/∂parameter for a fixed pixel; `ray` is its present ray.
    pub fn ray_by_lens(&self, ray: Ray) -> Option<[Vector2<f64>; MAX_PARAMETERS]> {
        if self.perturbed.is_empty() {
            return Some([Vector2::zeros(); MAX_PARAMETERS]);
        }
        let (_, pixel_by_ray) = self.camera.pixel_and_derivative(ray)?;
        let ray_by_pixel = pixel_by_ray.try_inverse()?;
        Some(self.pixel_by_lens(ray)?.map(|derivative| -(ray_by_pixel * derivative)))
    }

    /// Prior of tilt and lens, without any pair.
    pub fn prior<const N: usize>(&self) -> Part<N> {
        let mut prior = Part::default();
        for (k, change) in self.change.iter().enumerate() {
            let name = self.names.get(k).copied().unwrap_or_default();
            let unit = if matches!(name, "cx" | "cy") { self.camera.focal_px().0 } else { 1.0 };
            let variance = (calibration_sigma(name) * unit).powi(2);
            prior.information[(LENS_START + k, LENS_START + k)] = 1.0 / variance;
            prior.slope[LENS_START + k] = -change / variance;
        }
        prior
    }
}

//! Rolling shutters: each row of an image is exposed at its own time, while the camera moves.
//! Derivation: `docs/math/rolling-shutter.md`.
//!
//! Time and pose of an image are those of its middle row. Within the image the pose changes at
//! constant accelerations. A pixel is corrected to where a global shutter would have seen the same
//! ground ([`RollingShutter::global_pixel`]); errors of rates and readout time are nuisance
//! parameters of the pose (`super::normal_equations`).

use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use nalgebra::{Matrix6, Vector6};

/// Rates of (x, y, heading, height, roll, pitch), metres and radians per second.
pub type PoseRates = Vector6<f64>;

/// Exposure time of each row of an image, and the motion of the camera meanwhile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RollingShutter {
    /// Readout time: from the exposure of the first row to that of the last, seconds.
    pub readout_s: f64,
    /// Rows of the image.
    pub rows: usize,
    /// Rates of the pose in the middle of the image.
    pub rates: PoseRates,
    /// Accelerations of the pose, per second.
    pub accelerations: PoseRates,
}

impl RollingShutter {
    /// A camera with a readout time, moving at `rates`.
    pub fn new(camera: &Camera, readout_s: f64, rates: PoseRates) -> Self {
        Self { readout_s, rows: camera.height(), rates, accelerations: PoseRates::zeros() }
    }

    /// Row relative to the image: −1/2 at its upper edge, 1/2 at its lower edge.
    pub fn row_fraction(&self, y: f64) -> f64 {
        (y + 0.5) / self.rows as f64 - 0.5
    }

    /// Exposure time of a row after that of the middle row, seconds.
    pub fn row_time_s(&self, y: f64) -> f64 {
        self.readout_s * self.row_fraction(y)
    }

    /// The pose at the time of a row; `pose` is that of the middle row.
    pub fn pose_at(&self, pose: &GroundPose, y: f64) -> GroundPose {
        let dt_s = self.row_time_s(y);
        let moved = dt_s * (self.rates + 0.5 * dt_s * self.accelerations);
        GroundPose::from_vector(&(pose.to_vector() + moved))
    }

    /// Whether all rows have the same pose.
    pub fn is_global(&self) -> bool {
        self.readout_s == 0.0 || self.rates == PoseRates::zeros()
    }

    /// Whether the camera stands, so that exposure times do not matter.
    pub fn is_static(&self) -> bool {
        self.rates == PoseRates::zeros()
    }

    /// The pixel at which a global shutter at `pose` would have seen the ground of a pixel, at an
    /// elevation, metres. `None` where the pixel shows no ground.
    pub fn global_pixel(
        &self,
        camera: &Camera,
        pose: &GroundPose,
        pixel: Pixel,
        elevation_m: f64,
    ) -> Option<Pixel> {
        if self.is_global() {
            return Some(pixel);
        }
        let above = |pose: &GroundPose| GroundPose { height_m: pose.height_m - elevation_m, ..*pose };
        let at_row = above(&self.pose_at(pose, pixel.y));
        let ground = at_row.ground_from_ray(camera.ray_from_pixel(pixel)?)?;
        camera.pixel_from_ray(above(pose).ray_from_ground(ground)?)
    }
}

/// A normal distribution of the readout time, seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Readout {
    /// Its mean.
    pub mean_s: f64,
    /// Its variance, seconds²; 0 where the readout time is known.
    pub variance_s2: f64,
}

impl Readout {
    /// Standard deviation of a readout time of which nothing is known, seconds: half of a frame at
    /// 30 a second.
    pub const UNKNOWN_S: f64 = 0.015;
}

/// What is expected of the rates and accelerations of an image: linear functions of its pose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExpectedRates {
    /// Derivatives of the rates by the pose, per second.
    pub rate_by_pose_hz: PoseRates,
    /// The rates are these plus `rate_by_pose_hz` times the pose.
    pub rate_offset: PoseRates,
    /// Variances of the rates given the pose.
    pub rate_variance: PoseRates,
    /// Derivatives of the accelerations by the pose, per second².
    pub acceleration_by_pose: PoseRates,
    /// The accelerations are these plus `acceleration_by_pose` times the pose.
    pub acceleration_offset: PoseRates,
}

impl ExpectedRates {
    /// Expected rates of an image at a pose.
    pub fn rates_at(&self, pose: &PoseRates) -> PoseRates {
        self.rate_by_pose_hz.component_mul(pose) + self.rate_offset
    }

    /// Expected accelerations of an image at a pose.
    pub fn accelerations_at(&self, pose: &PoseRates) -> PoseRates {
        self.acceleration_by_pose.component_mul(pose) + self.acceleration_offset
    }
}

/// Prior of an image's exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShutterPrior {
    /// The readout time.
    pub readout: Readout,
    /// The motion of the camera.
    pub expected: ExpectedRates,
    /// Whether the skew is an unknown of the pose's fit; otherwise it is only estimated from its
    /// end.
    pub applies: bool,
}

impl ShutterPrior {
    /// The predicted shutter of an image at `pose`.
    pub fn shutter_at(&self, camera: &Camera, pose: &GroundPose) -> RollingShutter {
        let pose = pose.to_vector();
        let (rates, accelerations) = (self.expected.rates_at(&pose), self.expected.accelerations_at(&pose));
        RollingShutter { accelerations, ..RollingShutter::new(camera, self.readout.mean_s, rates) }
    }

    /// Prior standard deviations of the skew of an image with predicted `rates`.
    pub fn skew_sigma(&self, rates: &PoseRates) -> PoseRates {
        let Readout { mean_s, variance_s2 } = self.readout;
        rates.zip_map(&self.expected.rate_variance, |rate, variance| {
            (mean_s * mean_s * variance + variance_s2 * (rate * rate + variance)).sqrt()
        })
    }
}

/// Estimate of a frame's skew: the change of the pose from the first row to the last, metres and
/// radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShutterEstimate {
    /// Predicted rates of the pose.
    pub expected_rates: PoseRates,
    /// Skew from the tracks alone.
    pub evidence: PoseRates,
    /// Its variances; infinite where the tracks contain no information.
    pub evidence_variance: PoseRates,
    /// Derivative of the pose by the predicted skew.
    pub pose_by_expected_skew: Matrix6<f64>,
    /// Derivative of the pose by the skew of the keyframe.
    pub pose_by_keyframe_skew: Matrix6<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;

    #[test]
    fn a_corrected_pixel_shows_the_same_ground() {
        let lens = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap();
        let camera = Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), lens).unwrap();
        let rates = PoseRates::new(0.5, -0.2, 0.7, 0.1, 0.2, -0.3);
        let shutter = RollingShutter::new(&camera, 0.02, rates);
        let pose = GroundPose { x_m: 1.0, heading_rad: 0.4, ..GroundPose::level(0.75) };
        let pixel = Pixel::new(100.0, 50.0);
        let at_row = shutter.pose_at(&pose, pixel.y);
        let ground = at_row.ground_from_ray(camera.ray_from_pixel(pixel).unwrap()).unwrap();
        let global = shutter.global_pixel(&camera, &pose, pixel, 0.0).unwrap();
        let again = pose.ground_from_ray(camera.ray_from_pixel(global).unwrap()).unwrap();
        assert!(ground.distance(again) < 1e-9, "{}", ground.distance(again));
        assert!(global.distance(pixel) > 1.0, "{}", global.distance(pixel));
        let middle = Pixel::new(100.0, 239.5);
        assert!(shutter.global_pixel(&camera, &pose, middle, 0.0).unwrap().distance(middle) < 1e-6);
    }

    #[test]
    fn higher_ground_is_corrected_by_more() {
        let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
        let (pose, elevation_m) = (GroundPose::level(0.75), 0.03);
        let shutter = RollingShutter::new(&camera, 0.02, PoseRates::new(0.6, 0.1, 0.0, 0.0, 0.0, 0.0));
        let ground = crate::geometry::GroundPoint::new(0.3, -0.2);
        let seen = |pose: GroundPose| {
            crate::motion::ViewingPose::new(pose).pixel(&camera, ground, elevation_m).unwrap()
        };
        // The row in which the point is seen.
        let at_row = (0..20).fold(240.0, |row, _| seen(shutter.pose_at(&pose, row)).y);
        let pixel = seen(shutter.pose_at(&pose, at_row));
        let off = |elevation_m| {
            shutter.global_pixel(&camera, &pose, pixel, elevation_m).unwrap().distance(seen(pose))
        };
        assert!(off(elevation_m) < 1e-6 && off(0.0) > 0.05, "{} {}", off(elevation_m), off(0.0));
    }
}

//! How far a calibration can be trusted.

use crate::camera::Camera;
use crate::geometry::Pixel;

/// Error of rays over the image from the covariance of the camera.
#[derive(Debug, Clone)]
pub struct ErrorMap;

impl ErrorMap {
    pub fn expected_error_px(&self, _camera: &Camera, _pixel: Pixel) -> Option<f64> {
        None
    }

    pub fn over_image_px(&self) -> f64 {
        f64::NAN
    }
}

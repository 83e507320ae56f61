//! The camera of a simulation that names none.

use odograph::camera::{Camera, Distortion};
use odograph::error::Result;

/// An ordinary camera of images of this size (width, height), pixels: 65° wide, principal point a
/// little off the centre, mild barrel distortion.
///
/// Fails as [`Camera::new`] does.
pub fn ordinary_camera(size: (usize, usize)) -> Result<Camera> {
    let scale = size.0 as f64 / 640.0;
    let center = ((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
    let distortion = Distortion::BrownConrady {
        k1: -0.12,
        k2: 0.02,
        p1: 0.0004,
        p2: -0.0003,
        k3: 0.0,
        k4: 0.0,
        k5: 0.0,
        k6: 0.0,
    };
    let principal_px = (center.0 + 2.5 * scale, center.1 - 1.5 * scale);
    Camera::new(size, (500.0 * scale, 500.0 * scale), principal_px, distortion)
}

//! The focal length of a calibration, comparable between lens models.

use odograph_calibration::Calibration;

/// Pixels per tangent on the axis across the image, and their standard deviation: what people mean
/// by the focal length.
///
/// The double sphere's own focal length is `1 + ξ` times as large, and poorly determined alone (V.
/// Usenko et al., 2018, section 3.5).
pub fn focal_px(calibration: &Calibration) -> (f64, f64) {
    let place = |names: &[&str]| calibration.parameters.iter().position(|p| names.contains(&p.name));
    let Some(focal) = place(&["fx", "f"]) else { return (calibration.camera.focal_px().0, 0.0) };
    let (parameters, covariance) = (&calibration.parameters, &calibration.covariance);
    let value = parameters[focal].value;
    let Some(xi) = place(&["xi"]) else { return (value, parameters[focal].deviation) };
    let scale = 1.0 / (1.0 + parameters[xi].value);
    let (by_focal, by_xi) = (scale, -value * scale * scale);
    let variance = by_focal * by_focal * covariance[(focal, focal)]
        + 2.0 * by_focal * by_xi * covariance[(focal, xi)]
        + by_xi * by_xi * covariance[(xi, xi)];
    (value * scale, variance.max(0.0).sqrt())
}

//! Camera files in common formats.
//!
//! Read: OpenCV FileStorage YAML (and its JSON), ROS `camera_info` YAML, a Kalibr camchain with one
//! camera, EuRoC's `sensor.yaml`, COLMAP's `cameras.txt`. Written: the formats of [`CameraFormat`].
//! Unknown keys are ignored.
//!
//! Principal points follow OpenCV's convention that pixel centres are at integers. COLMAP's are
//! half a pixel larger and are converted.

mod colmap;
mod uncertainty;
mod value;
mod writing;
mod yaml;

pub use uncertainty::parse_uncertainty;
pub use writing::{CameraFormat, write_as};

use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};
use crate::formats::decimal::decimals;
use std::fmt::Write;
use writing::model_and_coefficients;

/// Reads a camera from a camera file in any of the formats of the [module](self).
///
/// `fallback_size` is the image size (width, height) in pixels for a file that has none; a size in
/// the file takes precedence.
///
/// Fails, naming the key and the value, if a number is missing, not finite or not a number, a focal
/// length is not positive, the skew is not zero, the lens model is not one of [`Distortion`], the
/// file has several cameras, or the image size is unknown.
pub fn parse(text: &str, fallback_size: Option<(usize, usize)>) -> Result<Camera> {
    let text = text.trim_start_matches('\u{feff}').trim();
    if text.is_empty() {
        return Err(Error::input("the camera file is empty"));
    }
    if text.starts_with('<') {
        return Err(Error::input(
            "the camera file is XML; save it as OpenCV YAML instead (cv::FileStorage does so for a name that ends in .yml)",
        ));
    }
    if colmap::recognised(text) { colmap::parse(text) } else { yaml::parse(text, fallback_size) }
}

/// Writes the camera as OpenCV FileStorage YAML; [`parse`] returns the identical camera.
///
/// `distortion_model` is the lens model by its ROS name (`none`, `plumb_bob`,
/// `rational_polynomial`, `equidistant`) or `double_sphere` (ξ, α).
pub fn write(camera: &Camera) -> String {
    let (fx, fy) = camera.focal_px();
    let (cx, cy) = camera.principal_px();
    let (model, coefficients) = model_and_coefficients(camera);
    let mut text =
        format!("%YAML:1.0\n---\nimage_width: {}\nimage_height: {}\n", camera.width(), camera.height());
    write_matrix(&mut text, "camera_matrix", 3, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    let _ = writeln!(text, "distortion_model: {model}");
    write_matrix(&mut text, "distortion_coefficients", 1, &coefficients);
    if let Some(readout_s) = camera.readout_s() {
        let _ = writeln!(text, "readout_time_s: {readout_s:?}");
    }
    text
}

fn write_matrix(text: &mut String, key: &str, rows: usize, data: &[f64]) {
    let cols = data.len() / rows;
    let _ = writeln!(
        text,
        "{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {} ]",
        decimals(data)
    );
}

/// [`Camera::new`], with the location of the numbers prefixed to its error message.
fn checked_camera(
    place: &str,
    size: (usize, usize),
    focal_px: (f64, f64),
    principal_px: (f64, f64),
    distortion: Distortion,
) -> Result<Camera> {
    Camera::new(size, focal_px, principal_px, distortion).map_err(|error| error.at(place))
}

/// Fails for a double sphere lens; of these programs only Kalibr supports it.
fn refuse_double_sphere(camera: &Camera, program: &str) -> Result<()> {
    match camera.distortion() {
        Distortion::DoubleSphere { .. } => Err(Error::usage(format!(
            "{program} knows no double-sphere lens; write Kalibr's format, or calibrate with `--model fisheye`"
        ))),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;

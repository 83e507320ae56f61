//! Camera files as people already have them.
//!
//! Read: OpenCV FileStorage YAML (and its JSON), ROS `camera_info` YAML, a Kalibr camchain with one camera, EuRoC's
//! `sensor.yaml`, COLMAP's `cameras.txt`. Written: the forms of [`CameraFormat`]. Keys that are not ours are ignored.
//!
//! Principal points follow OpenCV: pixel centres at integers. COLMAP's are half a pixel larger and are brought over.

mod colmap;
mod uncertainty;
mod value;
mod writing;
mod yaml;

pub use uncertainty::parse_uncertainty;
pub(super) use writing::number;
pub use writing::{CameraFormat, write_as};

use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};
use std::fmt::Write;
use writing::{model_and_coefficients, numbers};

/// Reads a camera from the text of a camera file, in any of the forms that the [module](self) names.
///
/// `fallback_size` is the image size (width, height) in pixels to use where the text names none; a size in the text wins.
///
/// Fails, naming the key and the value, where a number is missing, not finite or not a number, a focal length is not
/// positive, the pixels are skewed, the lens model is none of [`Distortion`], the text holds several cameras, or neither text
/// nor caller tells the image size.
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

/// The text of an OpenCV FileStorage YAML file that describes the camera; [`parse`] returns the identical camera.
///
/// `distortion_model` names the lens model as ROS does (`none`, `plumb_bob`, `rational_polynomial`, `equidistant`) or,
/// for the double sphere (ξ, α), `double_sphere`.
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
        numbers(data)
    );
}

/// [`Camera::new`] with the place of the numbers put before its sentence.
fn checked_camera(
    place: &str,
    size: (usize, usize),
    focal_px: (f64, f64),
    principal_px: (f64, f64),
    distortion: Distortion,
) -> Result<Camera> {
    Camera::new(size, focal_px, principal_px, distortion).map_err(|error| error.at(place))
}

#[cfg(test)]
mod tests;

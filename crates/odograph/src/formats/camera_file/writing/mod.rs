//! Writes camera files in the formats of other programs.

use super::{colmap, refuse_double_sphere};
use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};
use crate::formats::decimal::decimals;
use std::fmt::{self, Write};
use std::str::FromStr;

/// Output format of a camera file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CameraFormat {
    /// OpenCV FileStorage YAML.
    OpenCv,
    /// ROS `camera_info` YAML, as `camera_calibration` writes it and `camera_info_manager` reads
    /// it.
    Ros,
    /// A Kalibr `camchain.yaml` with one camera.
    Kalibr,
    /// COLMAP's `cameras.txt` with one camera.
    Colmap,
}

impl CameraFormat {
    /// All formats with their names.
    pub const NAMED: [(&'static str, Self); 4] =
        [("opencv", Self::OpenCv), ("ros", Self::Ros), ("kalibr", Self::Kalibr), ("colmap", Self::Colmap)];

    /// Infers the format from a file name: `.txt` is COLMAP; a name with `camchain` or `kalibr` is
    /// Kalibr; one with `camera_info` or `ros` is ROS; one with `opencv` or the extension `.yml` is
    /// OpenCV. `None` for other names, because three of the formats are YAML.
    pub fn of_file_name(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        let words: Vec<&str> = name.split(|c: char| !c.is_ascii_alphanumeric()).collect();
        let has = |word: &str| words.contains(&word);
        if name.contains("camchain") || has("kalibr") {
            Some(Self::Kalibr)
        } else if name.contains("camera_info") || has("ros") {
            Some(Self::Ros)
        } else if name.ends_with(".txt") || has("colmap") {
            Some(Self::Colmap)
        } else if name.ends_with(".yml") || has("opencv") {
            Some(Self::OpenCv)
        } else {
            None
        }
    }
}

impl fmt::Display for CameraFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::NAMED.iter().find(|(_, format)| format == self).map_or("", |(name, _)| name);
        f.write_str(name)
    }
}

impl FromStr for CameraFormat {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        Self::NAMED.iter().find(|(name, _)| *name == text).map(|(_, format)| *format).ok_or_else(|| {
            Error::usage(format!("no camera format `{text}`; there are opencv, ros, kalibr and colmap"))
        })
    }
}

/// Writes a camera file in the given format. [`super::parse`] returns the same camera, except that
/// a pinhole may come back as a lens with zero coefficients, and that COLMAP's principal point is
/// rounded to 1e-12 pixels.
///
/// Fails, naming the lens model or the coefficient, if the format cannot represent the camera:
/// Kalibr's `radtan` has no k3 to k6, and OpenCV, ROS and COLMAP have no double sphere model.
pub fn write_as(camera: &Camera, format: CameraFormat) -> Result<String> {
    match format {
        CameraFormat::OpenCv => {
            refuse_double_sphere(camera, "OpenCV")?;
            Ok(super::write(camera))
        }
        CameraFormat::Ros => ros(camera),
        CameraFormat::Kalibr => kalibr(camera),
        CameraFormat::Colmap => colmap::write(camera),
    }
}

/// ROS name of the lens model, and its coefficients in the common order of OpenCV and ROS.
pub(super) fn model_and_coefficients(camera: &Camera) -> (&'static str, Vec<f64>) {
    let all = camera.distortion().coefficients();
    match *camera.distortion() {
        Distortion::None => ("none", vec![0.0; 5]),
        Distortion::BrownConrady { k4, k5, k6, .. } if [k4, k5, k6] == [0.0; 3] => {
            ("plumb_bob", all[..5].to_vec())
        }
        Distortion::BrownConrady { .. } => ("rational_polynomial", all),
        Distortion::KannalaBrandt { .. } => ("equidistant", all),
        Distortion::DoubleSphere { .. } => ("double_sphere", all),
    }
}

fn ros(camera: &Camera) -> Result<String> {
    refuse_double_sphere(camera, "ROS")?;
    let (fx, fy) = camera.focal_px();
    let (cx, cy) = camera.principal_px();
    let (model, coefficients) = model_and_coefficients(camera);
    // ROS has no model without distortion; its own drivers use plumb_bob with zero coefficients.
    let model = if model == "none" { "plumb_bob" } else { model };
    let mut text = format!("image_width: {}\nimage_height: {}\n", camera.width(), camera.height());
    text.push_str("camera_name: camera\n");
    let mut matrix = |key: &str, rows: usize, data: &[f64]| {
        let cols = data.len() / rows;
        let _ = writeln!(text, "{key}:\n  rows: {rows}\n  cols: {cols}\n  data: [{}]", decimals(data));
        if key == "camera_matrix" {
            let _ = writeln!(text, "distortion_model: {model}");
        }
    };
    matrix("camera_matrix", 3, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    matrix("distortion_coefficients", 1, &coefficients);
    matrix("rectification_matrix", 3, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    // The rectified image keeps the focal lengths and the principal point.
    matrix("projection_matrix", 3, &[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]);
    Ok(text)
}

fn kalibr(camera: &Camera) -> Result<String> {
    let (fx, fy) = camera.focal_px();
    let (cx, cy) = camera.principal_px();
    let (camera_model, intrinsics, model, coefficients) = match *camera.distortion() {
        Distortion::None => ("pinhole", vec![fx, fy, cx, cy], "none", vec![]),
        Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } => {
            refuse_any("Kalibr's radtan model", &[("k3", k3), ("k4", k4), ("k5", k5), ("k6", k6)])?;
            ("pinhole", vec![fx, fy, cx, cy], "radtan", vec![k1, k2, p1, p2])
        }
        Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
            ("pinhole", vec![fx, fy, cx, cy], "equidistant", vec![k1, k2, k3, k4])
        }
        // In Kalibr's double sphere model, xi and alpha precede the focal lengths.
        Distortion::DoubleSphere { xi, alpha } => ("ds", vec![xi, alpha, fx, fy, cx, cy], "none", vec![]),
    };
    Ok(format!(
        "cam0:\n  camera_model: {camera_model}\n  intrinsics: [{}]\n  distortion_model: {model}\n  distortion_coeffs: [{}]\n\
         \x20 resolution: [{}, {}]\n  rostopic: /camera/image_raw\n  cam_overlaps: []\n",
        decimals(&intrinsics),
        decimals(&coefficients),
        camera.width(),
        camera.height(),
    ))
}

/// Fails, naming the first, if a coefficient that `model` does not have is not zero.
fn refuse_any(model: &str, coefficients: &[(&str, f64)]) -> Result<()> {
    match coefficients.iter().find(|(_, value)| *value != 0.0) {
        None => Ok(()),
        Some((name, value)) => Err(Error::usage(format!(
            "{model} has only k1, k2, p1 and p2, but the camera's {name} is {value}; calibrate with \
             `--model brown4`, or write another format"
        ))),
    }
}

#[cfg(test)]
mod tests;

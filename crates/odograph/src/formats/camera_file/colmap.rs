//! COLMAP's `cameras.txt`: one camera per line, `CAMERA_ID MODEL WIDTH HEIGHT PARAMS…`.

use super::{checked_camera, refuse_double_sphere};
use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};
use crate::formats::decimal::decimal;

/// COLMAP's pixel convention: (0, 0) is the outer corner of the top-left pixel, whose centre is
/// (0.5, 0.5).
const PIXEL_CENTRE: f64 = 0.5;

/// Whether the text looks like `cameras.txt` and not like YAML.
pub(super) fn recognised(text: &str) -> bool {
    lines(text).next().is_some_and(|(_, line)| {
        let words: Vec<_> = line.split_whitespace().take(4).collect();
        let model = |word: &str| {
            word.starts_with(|c: char| c.is_ascii_uppercase())
                && word.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
        };
        words.len() == 4 && words[0].chars().all(|c| c.is_ascii_digit()) && model(words[1])
    })
}

/// Reads the camera; fails unless the text has exactly one.
pub(super) fn parse(text: &str) -> Result<Camera> {
    let count = lines(text).count();
    let Some((number, line)) = lines(text).next().filter(|_| count == 1) else {
        return Err(Error::input(format!(
            "the COLMAP file holds {count} cameras; keep the line of the one that took the recording"
        )));
    };
    let words: Vec<_> = line.split_whitespace().collect();
    let [_, model, sizes_and_parameters @ ..] = words.as_slice() else {
        return Err(Error::input(format!("line {number} is not a COLMAP camera: {line:?}")));
    };
    let numbers = sizes_and_parameters
        .iter()
        .map(|word| match word.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(Error::input(format!("line {number}: {word:?} stands where a finite number belongs"))),
        })
        .collect::<Result<Vec<_>>>()?;
    let [width, height, parameters @ ..] = numbers.as_slice() else {
        return Err(Error::input(format!("line {number} has no image size: {line:?}")));
    };
    let whole = |value: f64| value.fract() == 0.0 && (1.0..=65_536.0).contains(&value);
    if !whole(*width) || !whole(*height) {
        return Err(Error::input(format!(
            "line {number} has an image size of {width}x{height}; it must be whole pixels from 1 to 65536"
        )));
    }
    let (focal_px, principal_px, distortion) = lens(model, parameters).ok_or_else(|| {
        let expected = EXPECTED.iter().find(|(name, _)| name == model);
        Error::input(match expected {
            Some((_, count)) => {
                format!("line {number}: {model} has {count} parameters, not {}", parameters.len())
            }
            None => format!(
                "line {number}: the COLMAP model {model} is not supported; SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, \
                 OPENCV, FULL_OPENCV and OPENCV_FISHEYE are"
            ),
        })
    })?;
    let principal_px = (principal_px.0 - PIXEL_CENTRE, principal_px.1 - PIXEL_CENTRE);
    checked_camera(
        &format!("line {number}"),
        (*width as usize, *height as usize),
        focal_px,
        principal_px,
        distortion,
    )
}

/// Writes a `cameras.txt` with the camera as camera 1.
pub(super) fn write(camera: &Camera) -> Result<String> {
    refuse_double_sphere(camera, "COLMAP")?;
    let (fx, fy) = camera.focal_px();
    let (cx, cy) = camera.principal_px();
    let (model, coefficients) = match *camera.distortion() {
        Distortion::None | Distortion::DoubleSphere { .. } => ("PINHOLE", vec![]),
        Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } if [k3, k4, k5, k6] == [0.0; 4] => {
            ("OPENCV", vec![k1, k2, p1, p2])
        }
        Distortion::BrownConrady { .. } => ("FULL_OPENCV", camera.distortion().coefficients()),
        Distortion::KannalaBrandt { .. } => ("OPENCV_FISHEYE", camera.distortion().coefficients()),
    };
    let mut parameters = vec![fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE];
    parameters.extend(coefficients);
    let parameters: Vec<String> = parameters.into_iter().map(decimal).collect();
    Ok(format!(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n\
         # Number of cameras: 1\n1 {model} {} {} {}\n",
        camera.width(),
        camera.height(),
        parameters.join(" ")
    ))
}

/// Supported models and their numbers of parameters.
const EXPECTED: [(&str, usize); 7] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("FULL_OPENCV", 12),
    ("OPENCV_FISHEYE", 8),
];

type NamedValue = (f64, f64);

/// Focal lengths, principal point and distortion of a model of COLMAP's `sensor/models.h`; `None`
/// for an unknown model or a wrong number of parameters.
fn lens(model: &str, parameters: &[f64]) -> Option<(NamedValue, NamedValue, Distortion)> {
    let brown = |k: &[f64]| Distortion::from_opencv(k);
    Some(match (model, parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ((f, f), (cx, cy), Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => ((fx, fy), (cx, cy), Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ((f, f), (cx, cy), brown(&[k, 0.0, 0.0, 0.0])?),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ((f, f), (cx, cy), brown(&[k1, k2, 0.0, 0.0])?),
        ("OPENCV", &[fx, fy, cx, cy, ref k @ ..]) if k.len() == 4 => ((fx, fy), (cx, cy), brown(k)?),
        ("FULL_OPENCV", &[fx, fy, cx, cy, ref k @ ..]) if k.len() == 8 => ((fx, fy), (cx, cy), brown(k)?),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            ((fx, fy), (cx, cy), Distortion::KannalaBrandt { k1, k2, k3, k4 })
        }
        _ => return None,
    })
}

/// Lines that are neither empty nor comments, with their numbers from 1.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let numbered = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
    numbered.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

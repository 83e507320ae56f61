//! Cameras in YAML: OpenCV, ROS, Kalibr and EuRoC, distinguished by their keys.

use super::checked_camera;
use super::value::Value;
use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};

const MATRIX_KEYS: [&str; 9] = [
    "camera_matrix",
    "cameraMatrix",
    "Camera_Matrix",
    "CameraMatrix",
    "K",
    "k",
    "intrinsic_matrix",
    "camera_intrinsics",
    "mtx",
];
const DISTORTION_KEYS: [&str; 13] = [
    "distortion_coefficients",
    "distCoeffs",
    "Distortion_Coefficients",
    "DistortionCoefficients",
    "distortionCoefficients",
    "dist_coeffs",
    "dist_coeff",
    "distortion_coeffs",
    "distortion",
    "dist",
    "D",
    "d",
    "dist_coefs",
];
const SIZE_KEYS: [(&str, &str); 4] = [
    ("image_width", "image_height"),
    ("image_Width", "image_Height"),
    ("imageWidth", "imageHeight"),
    ("width", "height"),
];
const SIZE_LIST_KEYS: [&str; 6] =
    ["imageSize", "image_size", "img_size", "image_resolution", "resolution", "size"];

pub(super) fn parse(text: &str, fallback_size: Option<(usize, usize)>) -> Result<Camera> {
    // OpenCV before version 3 and EuRoC write `%YAML:1.0` without the `---` that YAML requires
    // after a directive; turned into a comment, it is harmless.
    let as_comment = text.strip_prefix('%').map(|rest| format!("#{rest}"));
    let text = as_comment.as_deref().unwrap_or(text);
    // `rostopic echo` ends each message with a document separator.
    let root = Value::parse(text.trim_end_matches("---").trim_end_matches("..."))?;
    let Value::Map(entries) = &root else {
        return Err(Error::input(format!(
            "the camera file holds {root} instead of keys such as `camera_matrix`"
        )));
    };
    let kalibr = |name: &str| name.strip_prefix("cam").is_some_and(|n| n.parse::<u16>().is_ok());
    let chain: Vec<_> =
        entries.iter().filter(|(name, value)| kalibr(name) && matches!(value, Value::Map(_))).collect();
    match chain.as_slice() {
        [] => camera(&root, "", fallback_size),
        [(name, only)] => camera(only, &format!("{name}."), fallback_size),
        several => {
            let names: Vec<_> = several.iter().take(6).map(|(name, _)| name.as_str()).collect();
            Err(Error::input(format!(
                "the camera file holds {} cameras ({}); keep the one that took the recording",
                several.len(),
                names.join(", ")
            )))
        }
    }
}

/// The camera of one map; `prefix` precedes its keys in error messages.
fn camera(map: &Value, prefix: &str, fallback_size: Option<(usize, usize)>) -> Result<Camera> {
    let double_sphere = kalibrs_double_sphere(map, prefix)?;
    let (place, focal_px, principal_px) = intrinsics(map, prefix)?;
    let distortion = double_sphere.map_or_else(|| distortion(map, prefix), Ok)?;
    let size = image_size(map, prefix)?.or(fallback_size).ok_or_else(|| {
        Error::input(
            "the camera file does not say how large the calibrated images were; add `image_width:` and `image_height:` in pixels",
        )
    })?;
    checked_camera(&place, size, focal_px, principal_px, distortion)?
        .with_readout_s(readout_s(map, prefix, size.1)?)
}

/// Readout time of the shutter, seconds: from `readout_time_s`, or from Kalibr's `line_delay` per
/// row.
fn readout_s(map: &Value, prefix: &str, rows: usize) -> Result<Option<f64>> {
    let read = |key: &str, scale: f64| -> Result<Option<f64>> {
        let Some(value) = map.get(key) else { return Ok(None) };
        let name = format!("{prefix}{key}");
        let seconds = scale * value.number(&name)?;
        if (0.0..=Camera::LONGEST_READOUT_S).contains(&seconds) {
            return Ok(Some(seconds));
        }
        Err(Error::input(format!(
            "{name} makes a readout time of {} ms; it must lie between 0 and {} ms",
            1e3 * seconds,
            1e3 * Camera::LONGEST_READOUT_S
        )))
    };
    match read("readout_time_s", 1.0)? {
        Some(readout) => Ok(Some(readout)),
        None => read("line_delay", rows as f64),
    }
}

type KeyValue = (f64, f64);

/// Location of the intrinsics in the file (for error messages), focal lengths and principal point.
fn intrinsics(map: &Value, prefix: &str) -> Result<(String, KeyValue, KeyValue)> {
    if let Some(list) = map.get("intrinsics") {
        let place = format!("{prefix}intrinsics");
        return match list.numbers(&place)?.as_slice() {
            &[fx, fy, cx, cy] | &[_, _, fx, fy, cx, cy] => Ok((place, (fx, fy), (cx, cy))),
            &[fx, skew, cx, zero, fy, cy, zero_2, zero_3, one] => {
                let matrix = [fx, skew, cx, zero, fy, cy, zero_2, zero_3, one];
                from_matrix(place, matrix)
            }
            other => Err(Error::input(format!(
                "{place} has {} numbers; a pinhole's are fx, fy, cx, cy",
                other.len()
            ))),
        };
    }
    let mut found: Option<(&str, Vec<f64>)> = None;
    for key in MATRIX_KEYS {
        let Some(value) = map.get(key) else { continue };
        let numbers = value.numbers(&format!("{prefix}{key}"))?;
        match &found {
            Some((first, same)) if *same != numbers => {
                return Err(Error::input(format!(
                    "{prefix}{first} and {prefix}{key} hold different numbers; keep one of them"
                )));
            }
            Some(_) => {}
            None => found = Some((key, numbers)),
        }
    }
    let Some((key, numbers)) = found else { return Err(no_matrix(map)) };
    let place = format!("{prefix}{key}");
    match <[f64; 9]>::try_from(numbers) {
        Ok(matrix) => from_matrix(place, matrix),
        Err(numbers) => {
            Err(Error::input(format!("{place} has {} numbers; a camera matrix has 3 x 3", numbers.len())))
        }
    }
}

/// Kalibr's camera model `ds`, whose intrinsics begin with xi and alpha and which has no further
/// distortion.
fn kalibrs_double_sphere(map: &Value, prefix: &str) -> Result<Option<Distortion>> {
    let place = format!("{prefix}intrinsics");
    let intrinsics = map.get("intrinsics").map(|list| list.numbers(&place)).transpose()?;
    let said = matches!(map.get("camera_model"), Some(Value::Text(name)) if name == "ds");
    match (said, intrinsics.as_deref()) {
        (true, Some(&[xi, alpha, ..])) if intrinsics.as_ref().is_some_and(|all| all.len() == 6) => {
            Ok(Some(Distortion::DoubleSphere { xi, alpha }))
        }
        (true, other) => Err(Error::input(format!(
            "{place} has {} numbers; a double sphere's are xi, alpha, fx, fy, cx, cy",
            other.map_or(0, <[f64]>::len)
        ))),
        (false, Some(all)) if all.len() == 6 => Err(Error::input(format!(
            "{place} has 6 numbers, as only the camera model `ds` (double sphere) does; a pinhole's are fx, fy, cx, cy"
        ))),
        (false, _) => Ok(None),
    }
}

fn from_matrix(place: String, matrix: [f64; 9]) -> Result<(String, KeyValue, KeyValue)> {
    let [fx, skew, cx, zero, fy, cy, bottom @ ..] = matrix;
    if skew != 0.0 {
        return Err(Error::input(format!(
            "{place} has a skew of {skew} (row 1, column 2); cameras with skewed pixels are not supported"
        )));
    }
    if zero != 0.0 || bottom != [0.0, 0.0, 1.0] {
        return Err(Error::input(format!(
            "{place} is not a camera matrix: its rows must be [fx 0 cx], [0 fy cy], [0 0 1], but it is {matrix:?}"
        )));
    }
    Ok((place, (fx, fy), (cx, cy)))
}

/// Explains a missing camera matrix: a stereo file, or a file without a camera.
fn no_matrix(map: &Value) -> Error {
    const PAIRS: [(&str, &str); 5] = [
        ("M1", "M2"),
        ("K1", "K2"),
        ("cameraMatrix1", "cameraMatrix2"),
        ("camera_matrix_1", "camera_matrix_2"),
        ("left", "right"),
    ];
    if let Some((one, two)) = PAIRS.iter().find(|(one, two)| map.get(one).is_some() && map.get(two).is_some())
    {
        return Error::input(format!(
            "the camera file holds a pair of cameras ({one}, {two}); write one of them as `camera_matrix` and \
             `distortion_coefficients` into a file of its own"
        ));
    }
    let keys = match map {
        Value::Map(entries) => {
            entries.iter().take(8).map(|(key, _)| key.chars().take(40).collect::<String>()).collect()
        }
        _ => vec![],
    };
    Error::input(format!(
        "the camera file has neither `camera_matrix` nor `intrinsics`; its keys are: {}",
        if keys.is_empty() { "none".to_owned() } else { keys.join(", ") }
    ))
}

/// Families of lens models by their names in camera files.
enum LensFamily {
    None,
    BrownConrady,
    KannalaBrandt,
    DoubleSphere,
}

fn distortion(map: &Value, prefix: &str) -> Result<Distortion> {
    let family = lens_family(map, prefix)?;
    let coefficients = map.first_of(&DISTORTION_KEYS);
    let Some((key, value)) = coefficients else {
        return match family {
            Some(LensFamily::None) => Ok(Distortion::None),
            _ => Err(Error::input(
                "the camera file has no `distortion_coefficients`; for a lens without distortion add \
                 `distortion_coefficients: [0, 0, 0, 0]`",
            )),
        };
    };
    let place = format!("{prefix}{key}");
    // ROS writes an empty list for rectified images.
    let numbers = if *value == Value::Nothing { vec![] } else { value.numbers(&place)? };
    let all_zero = numbers.iter().all(|&number| number == 0.0);
    match family {
        Some(LensFamily::None) if all_zero => Ok(Distortion::None),
        Some(LensFamily::None) => Err(Error::input(format!(
            "{place} is not zero, but the distortion model says that there is none"
        ))),
        Some(LensFamily::KannalaBrandt) => match numbers.as_slice() {
            &[k1, k2, k3, k4] => Ok(Distortion::KannalaBrandt { k1, k2, k3, k4 }),
            other => Err(Error::input(format!(
                "{place} has {} numbers; the equidistant fisheye model has 4",
                other.len()
            ))),
        },
        Some(LensFamily::DoubleSphere) => match numbers.as_slice() {
            &[xi, alpha] => Ok(Distortion::DoubleSphere { xi, alpha }),
            other => Err(Error::input(format!(
                "{place} has {} numbers; the double sphere model has 2, xi and alpha",
                other.len()
            ))),
        },
        Some(LensFamily::BrownConrady) | None => brown_conrady(&place, &numbers),
    }
}

/// OpenCV's 0, 4, 5 or 8 coefficients; of its 12 (thin prism) or 14 (tilted sensor) those after the
/// 8th must be zero.
fn brown_conrady(place: &str, numbers: &[f64]) -> Result<Distortion> {
    let used = match numbers {
        [used @ .., a, b, c, d] if numbers.len() == 12 && [a, b, c, d] == [&0.0; 4] => used,
        [used @ .., a, b, c, d, e, f] if numbers.len() == 14 && [a, b, c, d, e, f] == [&0.0; 6] => used,
        _ if matches!(numbers.len(), 12 | 14) => {
            return Err(Error::input(format!(
                "{place} uses the thin-prism or tilted-sensor terms (its numbers 9 to {} are not zero), which are not \
                 supported; calibrate without them",
                numbers.len()
            )));
        }
        all => all,
    };
    Distortion::from_opencv(used).ok_or_else(|| {
        Error::input(format!("{place} has {} numbers; OpenCV's lens model has 4, 5 or 8", numbers.len()))
    })
}

/// The lens model named in the file; `None` if there is none.
fn lens_family(map: &Value, prefix: &str) -> Result<Option<LensFamily>> {
    let mut family = None;
    for key in ["camera_model", "distortion_model"] {
        let name = match map.get(key) {
            None | Some(Value::Nothing) => continue,
            Some(Value::Text(name)) => name.trim().to_ascii_lowercase().replace(['-', ' '], "_"),
            Some(other) => {
                return Err(Error::input(format!("{prefix}{key} is {other}; it must name a lens model")));
            }
        };
        let said = match name.as_str() {
            // "pinhole" is the projection; it does not specify the distortion.
            "" | "pinhole" | "perspective" => continue,
            "none" | "no_distortion" => LensFamily::None,
            "plumb_bob"
            | "radtan"
            | "radial_tangential"
            | "brown_conrady"
            | "brown"
            | "opencv"
            | "standard"
            | "rational_polynomial"
            | "rational" => LensFamily::BrownConrady,
            "double_sphere" => LensFamily::DoubleSphere,
            "equidistant" | "fisheye" | "kannala_brandt" | "kannalabrandt8" | "kannalabrandt"
            | "opencv_fisheye" | "equi" | "kb4" => LensFamily::KannalaBrandt,
            _ => {
                return Err(Error::input(format!(
                    "{prefix}{key} is {name:?}, which is not supported; plumb_bob (radtan), rational_polynomial, equidistant \
                     (fisheye) and none are"
                )));
            }
        };
        family = Some(said);
    }
    // Flag of OpenCV's calibration sample.
    let flagged = match map.get("fisheye_model") {
        Some(Value::Truth(flag)) => *flag,
        Some(Value::Number(flag)) => *flag != 0.0,
        _ => false,
    };
    Ok(if flagged && family.is_none() { Some(LensFamily::KannalaBrandt) } else { family })
}

fn image_size(map: &Value, prefix: &str) -> Result<Option<(usize, usize)>> {
    for (width_key, height_key) in SIZE_KEYS {
        match (map.get(width_key), map.get(height_key)) {
            (Some(width), Some(height)) => {
                let width = width.pixels(&format!("{prefix}{width_key}"))?;
                let height = height.pixels(&format!("{prefix}{height_key}"))?;
                return Ok(Some((width, height)));
            }
            (None, None) => {}
            (Some(_), None) => {
                return Err(Error::input(format!(
                    "{prefix}{width_key} is there, but {height_key} is missing"
                )));
            }
            (None, Some(_)) => {
                return Err(Error::input(format!(
                    "{prefix}{height_key} is there, but {width_key} is missing"
                )));
            }
        }
    }
    let Some((key, value)) = map.first_of(&SIZE_LIST_KEYS) else { return Ok(None) };
    let place = format!("{prefix}{key}");
    if let (Some(width), Some(height)) = (value.get("width"), value.get("height")) {
        return Ok(Some((
            width.pixels(&format!("{place}.width"))?,
            height.pixels(&format!("{place}.height"))?,
        )));
    }
    match value.numbers(&place)?.as_slice() {
        &[width, height] => {
            let pixels =
                |number: f64, side: &str| Value::Number(number).pixels(&format!("the {side} in {place}"));
            Ok(Some((pixels(width, "width")?, pixels(height, "height")?)))
        }
        other => {
            Err(Error::input(format!("{place} has {} numbers; it must be [width, height]", other.len())))
        }
    }
}

//! Covariance of a camera's calibration parameters in a camera file.

use super::value::Value;
use crate::camera::CameraUncertainty;
use crate::error::{Error, Result};
use nalgebra::DMatrix;

/// Reads the covariance that a calibration has written under `parameter_names` and
/// `parameter_covariance`; `None` if the file has neither, as files of other programs, or is not
/// YAML.
///
/// Fails if only one of the two keys is present or their values are invalid.
pub fn parse_uncertainty(text: &str) -> Result<Option<CameraUncertainty>> {
    let text = text.trim_start_matches('\u{feff}').trim();
    let as_comment = text.strip_prefix('%').map(|rest| format!("#{rest}"));
    let Ok(root) = Value::parse(as_comment.as_deref().unwrap_or(text)) else { return Ok(None) };
    let (names, covariance) = match (root.get("parameter_names"), root.get("parameter_covariance")) {
        (None, None) => return Ok(None),
        (Some(names), Some(covariance)) => (names, covariance.numbers("parameter_covariance")?),
        (Some(_), None) => {
            return Err(Error::input("parameter_names is there, but parameter_covariance is missing"));
        }
        (None, Some(_)) => {
            return Err(Error::input("parameter_covariance is there, but parameter_names is missing"));
        }
    };
    let not_names = || Error::input("parameter_names is not a list of names");
    let Value::List(items) = names else { return Err(not_names()) };
    let name = |item: &Value| match item {
        Value::Text(name) => Some(name.clone()),
        _ => None,
    };
    let names: Vec<String> = items.iter().map(name).collect::<Option<_>>().ok_or_else(not_names)?;
    let n = names.len();
    if n > MAX_PARAMETERS || covariance.len() != n * n {
        return Err(Error::input(format!(
            "parameter_covariance has {} numbers for {n} parameters; it must have {n} x {n}",
            covariance.len()
        )));
    }
    CameraUncertainty::new(names, DMatrix::from_row_slice(n, n, &covariance)).map(Some)
}

/// Largest accepted number of parameters, far beyond any camera model.
const MAX_PARAMETERS: usize = 64;

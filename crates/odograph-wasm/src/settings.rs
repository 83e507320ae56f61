//! What a person says about camera and mount, as text.

use odograph_core::error::{Error, Result};
use odograph_core::formats::{camera_file, length, rig_file};
use odograph_core::{Camera, Rig};
use serde::{Deserialize, Serialize};

/// Camera and mount as they were typed or chosen; empty text is nothing given.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub struct Settings {
    /// Content of a camera file.
    pub camera_file: String,
    /// Ground in view, as `1.20x0.90`; instead of a camera file.
    pub field_of_view: String,
    /// Height of the camera, as `0.75` or `75cm`.
    pub height: String,
    /// Content of a rig file; instead of a height.
    pub rig_file: String,
}

/// Camera and mount as they were understood.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Setup {
    /// Height above the ground, metres.
    pub height_m: f64,
    /// Focal lengths, pixels.
    pub focal_px: (f64, f64),
    /// Roll and pitch of the mount, degrees.
    pub tilt_deg: (f64, f64),
}

/// A bare number above this is probably no number of metres: cameras on vehicles are lower.
const DOUBTFUL_HEIGHT_M: f64 = 10.0;

impl Settings {
    /// Camera and mount for frames of this size, pixels.
    ///
    /// # Errors
    /// If one of the texts cannot be read, or something is missing.
    pub fn camera_and_rig(&self, size: (usize, usize)) -> Result<(Camera, Rig)> {
        let rig = self.rig()?;
        let camera = if !self.camera_file.trim().is_empty() {
            let camera = camera_file::parse(&self.camera_file, Some(size))
                .map_err(|error| error.at("the camera file"))?;
            let its = (camera.width(), camera.height());
            if its != size {
                return Err(Error::input(format!(
                    "the video is {}x{} but the camera file is for {}x{}; choose the file of this camera at \
                     this size",
                    size.0, size.1, its.0, its.1
                )));
            }
            camera
        } else if !self.field_of_view.trim().is_empty() {
            Camera::from_field_of_view(size, field_of_view(&self.field_of_view)?, rig.height_m)?
        } else {
            return Err(Error::usage("choose a camera file, or give the ground in view"));
        };
        Ok((camera, rig))
    }

    fn rig(&self) -> Result<Rig> {
        if !self.rig_file.trim().is_empty() {
            return rig_file::parse(&self.rig_file).map_err(|error| error.at("the rig file"));
        }
        if self.height.trim().is_empty() {
            // A field of view already gives the scale; any height gives the same path.
            if self.camera_file.trim().is_empty() && !self.field_of_view.trim().is_empty() {
                return Ok(Rig::level(1.0));
            }
            return Err(Error::usage("give the height of the camera above the ground, such as 75cm"));
        }
        Rig::level(height(&self.height)?).validated()
    }
}

fn height(text: &str) -> Result<f64> {
    let (metres, has_unit) = length::parse(text).ok_or_else(|| {
        Error::usage(format!("the height {text} is no length; give it as 0.75 (metres), 0.75m, 75cm or 30in"))
    })?;
    if metres > DOUBTFUL_HEIGHT_M && !has_unit {
        return Err(Error::usage(format!(
            "a height of {metres} metres is unusual; write {metres}m if it is meant, or another unit, such as {metres}cm"
        )));
    }
    Ok(metres)
}

fn field_of_view(text: &str) -> Result<(f64, f64)> {
    let side = |text: &str| Some(length::parse(text)?.0).filter(|side| Rig::HEIGHTS_M.contains(side));
    let sides = text.split_once(['x', 'X', '×']);
    sides.and_then(|(width, height)| Some((side(width)?, side(height)?))).ok_or_else(|| {
        Error::usage(format!(
            "the ground in view, {text}, is no width and height; give both as 1.20x0.90 (metres) or 120cmx90cm"
        ))
    })
}

impl Setup {
    /// Of a camera and its mount.
    pub fn of(camera: &Camera, rig: &Rig) -> Self {
        let tilt_deg = (rig.roll_rad.to_degrees(), rig.pitch_rad.to_degrees());
        Self { height_m: rig.height_m, focal_px: camera.focal_px(), tilt_deg }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (640, 480);

    fn settings(field_of_view: &str, height: &str) -> Settings {
        Settings { field_of_view: field_of_view.into(), height: height.into(), ..Settings::default() }
    }

    #[test]
    fn lengths_may_have_units() {
        for (field, typed) in [("1.20x0.90", "0.75"), ("120cmx90cm", "75cm"), ("1.2 × 0.9", "750 mm")] {
            let (camera, rig) = settings(field, typed).camera_and_rig(SIZE).unwrap();
            assert!((rig.height_m - 0.75).abs() < 1e-12, "{typed}");
            assert!((camera.focal_px().0 - 400.0).abs() < 1e-9, "{field}");
        }
        assert!(settings("1.2x0.9", "").camera_and_rig(SIZE).is_ok());
    }

    #[test]
    fn wrong_text_is_an_error_that_says_what_to_do() {
        for (field, typed, says) in [
            ("1.2x0.9", "75", "75cm"),
            ("1.2x0.9", "high", "75cm"),
            ("1.2x0.9", "-1", "height"),
            ("1.2", "0.75", "1.20x0.90"),
            ("", "0.75", "camera file"),
        ] {
            let error = settings(field, typed).camera_and_rig(SIZE).unwrap_err().to_string();
            assert!(error.contains(says), "{field}, {typed}: {error}");
        }
    }

    #[test]
    fn a_camera_file_of_another_size_is_refused() {
        let camera_file = camera_file::write(&Camera::from_field_of_view(SIZE, (1.2, 0.9), 1.0).unwrap());
        let settings = Settings { camera_file, height: "1".into(), ..Settings::default() };
        assert!(settings.camera_and_rig(SIZE).is_ok());
        let error = settings.camera_and_rig((320, 240)).unwrap_err().to_string();
        assert!(error.contains("320x240") && error.contains("640x480"), "{error}");
    }
}

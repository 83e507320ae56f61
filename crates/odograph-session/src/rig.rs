//! Camera and rig files, which are easily mistaken for each other, and heights that were probably
//! not meant in metres.

use crate::files;
use crate::observer::Observer;
use odograph::camera::{Camera, Distortion, LeverArm, Rig, RigDeviations};
use odograph::error::{Error, Result};
use odograph::formats::decimal::Rounded;
use odograph::formats::{camera_file, rig_file};
use odograph_video::{RecordedMount, RecordedTransforms};
use std::fmt::Display;
use std::path::Path;

/// Cameras on vehicles are lower: above this a height without a unit is probably in another unit
/// than metres.
const DOUBTFUL_HEIGHT_M: f64 = 10.0;

/// Above this such a number is probably in millimetres, below it in centimetres.
const MILLIMETRES_FROM: f64 = 300.0;

/// The error that a camera is not calibrated for the frames of a recording, and what to do; sizes
/// are width and height, pixels.
pub fn other_size(recording: impl Display, frames: (usize, usize), calibrated: (usize, usize)) -> Error {
    Error::input(format!(
        "the frames of {recording} are {}x{} but the camera is calibrated for {}x{}; {}",
        frames.0,
        frames.1,
        calibrated.0,
        calibrated.1,
        advice_for_other_size(frames, calibrated)
    ))
}

/// What to do where a camera is calibrated for frames of another size. Telephones turn a video
/// that is taken upright.
pub(crate) fn advice_for_other_size(frames: (usize, usize), calibrated: (usize, usize)) -> &'static str {
    if frames == (calibrated.1, calibrated.0) {
        "the recording is turned by 90° against the calibration: hold the camera as it was held there, or \
         calibrate with a video that is turned like this one"
    } else {
        "calibrate at the recording's size"
    }
}

/// The unit in which a height was probably meant that was given as a bare number, short and in
/// full; `None` where metres are plausible.
pub fn doubtful_unit(height_m: f64) -> Option<(&'static str, &'static str)> {
    if height_m <= DOUBTFUL_HEIGHT_M || !Rig::HEIGHTS_M.contains(&height_m) {
        return None;
    }
    Some(if height_m >= MILLIMETRES_FROM { ("mm", "millimetres") } else { ("cm", "centimetres") })
}

/// A pinhole of a wider view than this, degrees, is no lens: one so wide is modelled as a fisheye.
const WIDEST_PINHOLE_DEG: f64 = 150.0;

/// A warning about a camera without a fisheye's model whose focal length makes its view wider than
/// lenses of that kind are: it is probably not in pixels.
pub(crate) fn doubtful_focal_length(camera: &Camera) -> Option<String> {
    if matches!(camera.distortion(), Distortion::KannalaBrandt { .. } | Distortion::DoubleSphere { .. }) {
        return None;
    }
    let ((fx, fy), (width, height)) = (camera.focal_px(), (camera.width() as f64, camera.height() as f64));
    let (focal_px, side_px) = if width / fx > height / fy { (fx, width) } else { (fy, height) };
    let view_deg = 2.0 * (0.5 * side_px / focal_px).atan().to_degrees();
    (view_deg > WIDEST_PINHOLE_DEG).then(|| {
        format!(
            "a focal length of {:.1} px in images of {}x{} is a view of {view_deg:.0}°, in which distances are far too \
             long; are millimetres meant? Camera files have pixels",
            Rounded(focal_px),
            camera.width(),
            camera.height()
        )
    })
}

/// A mount, how well it is known, and where the antenna is: what a rig file states.
#[derive(Debug, Clone)]
pub(crate) struct StatedRig {
    pub rig: Rig,
    pub deviations: RigDeviations,
    /// The antenna of the satellite receiver.
    pub antenna: Option<LeverArm>,
}

impl From<Rig> for StatedRig {
    fn from(rig: Rig) -> Self {
        Self { rig, deviations: RigDeviations::default(), antenna: None }
    }
}

/// The rig in a file; the observer hears of a height that is probably in another unit.
///
/// # Errors
/// If the file cannot be read or is no rig file.
pub fn read_rig(path: &Path, observer: &dyn Observer) -> Result<Rig> {
    StatedRig::read(path, observer).map(|stated| stated.rig)
}

impl StatedRig {
    /// See [`read_rig`].
    pub fn read(path: &Path, observer: &dyn Observer) -> Result<Self> {
        let text = files::read_text(path)?;
        let measured = rig_file::parse_measured(&text).map_err(|error| {
            if camera_file::parse(&text, Some((640, 480))).is_ok() {
                return Error::input("this is a camera file, not a rig file; give it with --camera")
                    .at(path.display());
            }
            error.at(path.display())
        })?;
        let rig = measured.rig;
        if let Some(LeverArm { z_m, .. }) = rig.lever_arm.filter(|arm| arm.z_m > rig.height_m) {
            return Err(Error::input(format!(
            "z_m is {z_m} and height_m {}: base_link would lie below the ground; z_m is how far the camera is above \
             base_link, at most height_m",
            rig.height_m
        ))
        .at(path.display()));
        }
        if let Some((_, name)) = doubtful_unit(rig.height_m) {
            observer.warn(&format!(
                "{}: height_m is {}, a camera {} metres above the ground; are {name} meant?",
                path.display(),
                rig.height_m,
                rig.height_m,
            ));
        }
        let antenna = rig_file::parse_antenna(&text).map_err(|error| error.at(path.display()))?;
        Ok(Self { rig, deviations: measured.deviations, antenna })
    }
}

/// The camera in the text of the file at `path`, for images of this size, pixels.
///
/// # Errors
/// If it is no camera file.
pub fn parse_camera(path: &Path, text: &str, size: (usize, usize)) -> Result<Camera> {
    camera_file::parse(text, Some(size)).map_err(|error| {
        if rig_file::parse(text).is_ok() {
            return Error::input("this is a rig file, not a camera file; give it with --rig")
                .at(path.display());
        }
        error.at(path.display())
    })
}

/// The rig in the static transforms of a robot recording, at the given height or that over
/// `base_footprint`; `None` if there is none, or no height. The observer hears what was taken.
///
/// # Errors
/// If the recording cannot be read.
pub(crate) fn recorded_rig(
    source: &str,
    topic: Option<&str>,
    height_m: Option<f64>,
    observer: &dyn Observer,
) -> Result<Option<Rig>> {
    if !odograph_video::is_robot_recording(source) {
        return Ok(None);
    }
    Ok(match odograph_video::recorded_mount(source, topic)? {
        Some(RecordedTransforms::Mount(mount)) => rig_of_mount(&mount, source, height_m, observer),
        Some(RecordedTransforms::Apart { camera_frame, frames }) => {
            let camera = match camera_frame.as_str() {
                "" => "the images, which name no frame,".to_owned(),
                frame => format!("the frame {frame} of the images"),
            };
            observer.note(&format!(
                "/tf_static ({}) does not connect {camera} with base_link; poses are those of the camera",
                shortened(&frames)
            ));
            None
        }
        None => None,
    })
}

/// Names for people, the first of many.
fn shortened(names: &[String]) -> String {
    const MOST: usize = 8;
    let more = if names.len() > MOST { ", …" } else { "" };
    names[..names.len().min(MOST)].join(", ") + more
}

/// The rig of a camera whose mount is known from static transforms `of` a recording or robot, at
/// the given height or that over `base_footprint`; `None` without a height, or if the camera does
/// not look at the ground. The observer hears what was taken, or why nothing was.
pub fn rig_of_mount(
    mount: &RecordedMount,
    of: &str,
    height_m: Option<f64>,
    observer: &dyn Observer,
) -> Option<Rig> {
    let used_m = height_m.or(mount.height_m)?;
    let frame = &mount.camera_frame;
    let rig = match mount.rig(used_m) {
        Ok(rig) => rig,
        Err(error) => {
            observer.warn(&format!(
                "the transforms of {of} are not used: {error}; the frame {frame} of the images should be the optical \
                 frame of the camera"
            ));
            return None;
        }
    };
    let from = if height_m.is_some() { "" } else { " over base_footprint" };
    let arm = rig.lever_arm.map_or_else(String::new, |LeverArm { x_m, y_m, z_m }| {
        let [x_m, y_m, z_m] = [x_m, y_m, z_m].map(Rounded);
        format!("x {x_m:.3} m, y {y_m:.3} m, z {z_m:.3} m, ")
    });
    observer.note(&format!(
        "{frame} in base_link, from /tf_static: {arm}roll {:.1}°, pitch {:.1}°, yaw {:.1}°; height {used_m:.3} m{from} \
         (--rig overrides)",
        Rounded(rig.roll_rad.to_degrees()),
        Rounded(rig.pitch_rad.to_degrees()),
        Rounded(rig.yaw_rad.to_degrees()),
    ));
    Some(rig)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn a_focal_length_in_millimetres_is_doubted() {
        let camera =
            |focal: f64, distortion| Camera::new((640, 480), (focal, focal), (320.0, 240.0), distortion);
        let said = |focal: f64, distortion| doubtful_focal_length(&camera(focal, distortion).unwrap());
        let doubt = said(4.2, Distortion::None).unwrap();
        assert!(
            doubt.starts_with("a focal length of 4.2 px in images of 640x480 is a view of 178°"),
            "{doubt}"
        );
        // The widest lenses of action cameras, and fisheyes.
        assert_eq!(said(170.0, Distortion::from_opencv(&[-0.3, 0.1, 0.0, 0.0]).unwrap()), None);
        assert_eq!(said(80.0, Distortion::KannalaBrandt { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 }), None);
    }
}

//! The camera of the examination: the given one, or an assumed one where there is none that fits.

use crate::builder::{CameraChoice, MountChoice, RunBuilder};
use crate::files;
use crate::observer::Observer;
use crate::rig::recorded_rig;
use odograph::camera::Camera;
use odograph::error::Result;
use odograph::formats::camera_file;
use odograph::motion::MotionModel;
use odograph_video::SourceInfo;
use std::fs;
use std::path::Path;

/// Where the camera comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GivenLens {
    /// A calibration of the size of the frames.
    Fits,
    /// The measured field of view, width and height in metres.
    FieldOfView(f64, f64),
    /// A calibration of another size, pixels.
    OtherSize(usize, usize),
    /// None.
    Missing,
}

/// Field of view of an assumed camera: its width over the height, as of 64°.
const ASSUMED_FIELD: f64 = 1.25;

/// Assumed height where it is not given, metres. Only distances depend on it.
const ASSUMED_HEIGHT_M: f64 = 1.0;

/// The run with a camera and a height in any case, and what was given.
pub fn with_some_camera(
    builder: &RunBuilder,
    size: (usize, usize),
    observer: &dyn Observer,
) -> Result<(RunBuilder, GivenLens)> {
    let path = &builder.source.path;
    let topic = builder.source.topic.as_deref();
    let calibrated = match &builder.camera {
        Some(CameraChoice::File(file)) => {
            let text = files::read_text(file)?;
            Some(camera_file::parse(&text, Some(size)).map_err(|error| error.at(file.display()))?)
        }
        Some(CameraChoice::Known(camera)) => Some(camera.as_ref().clone()),
        None if odograph_video::is_robot_recording(path) => {
            odograph_video::recorded_camera(path, topic)?.map(|recorded| recorded.camera)
        }
        Some(CameraChoice::FieldOfView(..) | CameraChoice::OfMap) | None => None,
    };
    let given = match &calibrated {
        Some(camera) if (camera.width(), camera.height()) == size => GivenLens::Fits,
        Some(camera) => GivenLens::OtherSize(camera.width(), camera.height()),
        None => match builder.camera {
            Some(CameraChoice::FieldOfView(width_m, height_m)) => GivenLens::FieldOfView(width_m, height_m),
            _ => GivenLens::Missing,
        },
    };
    let rig = match &builder.mount {
        None => recorded_rig(path, topic, None, observer)?.map(MountChoice::Known),
        Some(mount) => Some(mount.clone()),
    };
    let mut builder = builder.clone();
    builder.mount = Some(rig.unwrap_or(MountChoice::Height(ASSUMED_HEIGHT_M)));
    match (given, calibrated) {
        (GivenLens::Fits, Some(camera)) => builder.camera = Some(CameraChoice::Known(Box::new(camera))),
        (GivenLens::FieldOfView(..), _) => {}
        _ => {
            let (width, height) = (size.0 as f64, size.1 as f64);
            let field_m = (ASSUMED_FIELD, ASSUMED_FIELD * height / width);
            let camera = Camera::from_field_of_view(size, field_m, 1.0)?;
            builder.camera = Some(CameraChoice::Known(Box::new(camera)));
            // The assumed focal length and distortion are not this camera's: estimated with them,
            // motions out of the plane would be spurious, and frames would be lost.
            if builder.motion == MotionModel::Auto {
                builder.motion = MotionModel::Similarity;
            }
        }
    }
    Ok((builder, given))
}

/// How the frames are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coded {
    pub by: Codec,
    /// Bits per pixel and frame.
    pub bits_per_pixel: f64,
}

/// Kinds of lossy coding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// Each picture by itself.
    Jpeg,
    /// From picture to picture.
    H264,
    /// From picture to picture, in half of the bits of H.264.
    Newer,
}

/// The bits of a lossy recording; `None` if it is lossless, or no file or folder of frames alone.
pub fn bits_per_pixel(path: &str, info: &SourceInfo, passed: u64) -> Option<Coded> {
    let description = &info.description;
    let begins = |names: &[&str]| names.iter().any(|name| description.contains(name));
    let by = match () {
        () if begins(&["JPEG"]) => Codec::Jpeg,
        () if begins(&["Lossless", "lossless", "Y4M", "PNG", "TIFF", "PGM"]) => return None,
        () if begins(&["H.265", "VP9", "AV1"]) => Codec::Newer,
        () if begins(&["H.264", "MPEG-4", "VP8"]) => Codec::H264,
        () => return None,
    };
    if odograph_video::is_robot_recording(path) {
        return None;
    }
    let path = Path::new(path);
    let bytes = match fs::metadata(path).ok()? {
        file if file.is_file() => file.len(),
        _ => fs::read_dir(path).ok()?.flatten().filter_map(|entry| Some(entry.metadata().ok()?.len())).sum(),
    };
    let frames = info.frame_count.unwrap_or(0).max(passed);
    let pixels = frames as f64 * info.width as f64 * info.height as f64;
    (pixels > 0.0).then(|| Coded { by, bits_per_pixel: 8.0 * bytes as f64 / pixels })
}

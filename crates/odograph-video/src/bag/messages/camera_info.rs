//! `sensor_msgs/CameraInfo`: the camera that took the images of a topic.

use crate::bag::cursor::MessageCursor;
use crate::bag::recording::Topic;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::formats::camera_file;

/// A camera as a message describes it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CameraInfo {
    /// Size of the calibrated image, pixels.
    size: (u32, u32),
    model: String,
    distortion: Vec<f64>,
    k: [f64; 9],
    p: [f64; 12],
    /// Binned pixels per pixel of the image; 0 is 1.
    binning: (u32, u32),
    /// Offset and size of the part of the calibrated image that the images show; a size of 0 is
    /// all of it.
    region: [u32; 4],
}

/// Most coefficients of a lens.
const MAX_COEFFICIENTS: usize = 64;

impl CameraInfo {
    /// Reads a message; `None` if it is cut off.
    pub fn read(topic: &Topic, data: &[u8]) -> Option<Self> {
        let mut message = MessageCursor::new(data, &topic.serialization)?;
        message.header()?;
        let (height, width) = (message.u32()?, message.u32()?);
        let model = message.string()?.into_owned();
        let distortion = message.double_sequence(MAX_COEFFICIENTS)?;
        let k = message.doubles()?;
        let _rotation: [f64; 9] = message.doubles()?;
        let p = message.doubles()?;
        let binning = (message.u32()?, message.u32()?);
        let [x, y, region_height, region_width] =
            [message.u32()?, message.u32()?, message.u32()?, message.u32()?];
        let region = [x, y, region_width, region_height];
        Some(Self { size: (width, height), model, distortion, k, p, binning, region })
    }

    /// Whether it is calibrated: drivers publish zeros otherwise.
    pub fn is_calibrated(&self) -> bool {
        self.k[0] > 0.0
    }

    /// Size of the images, pixels.
    pub fn image_size(&self) -> (u32, u32) {
        let [_, _, width, height] = self.region;
        let whole = |part: u32, whole: u32| if part == 0 { whole } else { part };
        let (width, height) = (whole(width, self.size.0), whole(height, self.size.1));
        (width / self.binning.0.max(1), height / self.binning.1.max(1))
    }

    /// The camera of the original images, or of `rectified` ones, whose projection is in P and
    /// which have no distortion.
    ///
    /// Fails if it is not calibrated, or its lens model is not known.
    pub fn camera(&self, rectified: bool) -> Result<Camera> {
        if !self.is_calibrated() {
            return Err(Error::input(
                "its camera_info is not calibrated (fx is 0); give --camera FILE, as odograph calibrate writes it",
            ));
        }
        let projection = [self.p[0], self.p[2], self.p[5], self.p[6]];
        let [fx, cx, fy, cy] = if rectified && self.p[0] > 0.0 {
            projection
        } else {
            [self.k[0], self.k[2], self.k[4], self.k[5]]
        };
        // Binning averages pixels; their centres are at integers.
        let scaled = |value: f64, offset: u32, binning: u32| {
            let binning = f64::from(binning.max(1));
            (value - f64::from(offset) + 0.5) / binning - 0.5
        };
        let (cx, cy) =
            (scaled(cx, self.region[0], self.binning.0), scaled(cy, self.region[1], self.binning.1));
        let (fx, fy) = (fx / f64::from(self.binning.0.max(1)), fy / f64::from(self.binning.1.max(1)));
        let (width, height) = self.image_size();
        let unnamed = self.model.is_empty() && self.distortion.iter().all(|&d| d == 0.0);
        let (model, distortion) = if rectified || unnamed {
            ("none", Vec::new())
        } else {
            (self.model.as_str(), self.distortion.clone())
        };
        // One reader knows the lens models.
        let text = format!(
            "image_width: {width}\nimage_height: {height}\ncamera_matrix:\n  data: [{fx:?}, 0.0, {cx:?}, 0.0, {fy:?}, {cy:?}, \
             0.0, 0.0, 1.0]\ndistortion_model: {}\ndistortion_coefficients:\n  data: {distortion:?}\n",
            model.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '_').collect::<String>()
        );
        camera_file::parse(&text, None)
    }
}

//! How the camera moved while each image of a recording was read out, as an earlier pass over the
//! recording has measured it.

use super::rolling_shutter::{ExpectedRates, PoseRates};

/// The motion of the camera within one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageMotion {
    /// Time of the image, seconds.
    pub time_s: f64,
    /// Rates of the pose in the middle of the image.
    pub rates: PoseRates,
    /// Their variances.
    pub rate_variance: PoseRates,
    /// Accelerations of the pose, per second.
    pub accelerations: PoseRates,
}

impl ImageMotion {
    /// What is expected of the image, whatever its pose: no frame alone knows better, so that the
    /// variance of the rates is left out.
    pub fn expected(&self) -> ExpectedRates {
        ExpectedRates {
            rate_offset: self.rates,
            acceleration_offset: self.accelerations,
            ..ExpectedRates::default()
        }
    }
}

/// The motion within the images of a recording.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredMotion {
    /// In the order of their times.
    images: Vec<ImageMotion>,
}

impl MeasuredMotion {
    /// Adds an image; those that are not later than the last one are left out.
    pub fn push(&mut self, image: ImageMotion) {
        if self.images.last().is_none_or(|last| last.time_s < image.time_s) {
            self.images.push(image);
        }
    }

    /// The motion within the image of this time, seconds; `None` where it was not measured.
    pub fn at(&self, time_s: f64) -> Option<&ImageMotion> {
        let index = self.images.binary_search_by(|image| image.time_s.total_cmp(&time_s)).ok()?;
        Some(&self.images[index])
    }

    /// Whether no image was measured.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }
}

//! The camera that a recording describes.

use odograph::camera::Camera;

/// A camera that a recording describes.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedCamera {
    /// The camera of the images.
    pub camera: Camera,
    /// Topic that describes it.
    pub topic: String,
    /// Whether the images are rectified: the camera is that of the projection matrix P, and has no
    /// distortion.
    pub rectified: bool,
}

//! A recording in memory: frames, calibration as given to the odometry, and ground truth.

use odograph::camera::{Camera, Rig};
use odograph::image::GrayImage;
use odograph::trajectory::Trajectory;

/// A recording with its ground truth.
#[derive(Debug)]
pub struct Clip {
    /// The camera model given to the odometry.
    pub camera: Camera,
    /// The mount given to the odometry.
    pub rig: Rig,
    /// Timestamp in seconds and luminance of each frame. All frames are rendered before anything is
    /// timed, and once even if the clip is tracked twice.
    pub frames: Vec<(f64, GrayImage)>,
    /// Ground-truth trajectory.
    pub truth: Trajectory,
    /// Frame rate, frames per second.
    pub fps: f64,
}

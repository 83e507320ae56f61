//! The parameters of the pipeline.

use crate::camera::Camera;
use crate::detection::DetectionConfig;
use crate::filter::FilterConfig;
use crate::flow::FlowConfig;
use crate::motion::MotionConfig;
use serde::{Deserialize, Serialize};

/// Every parameter of the pipeline, by stage.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryConfig {
    /// Objects of interest.
    pub detection: DetectionConfig,
    /// Optical flow.
    pub flow: FlowConfig,
    /// Movement parameters.
    pub motion: MotionConfig,
    /// When a frame becomes a keyframe.
    pub keyframe: KeyframeConfig,
    /// Estimation improvement.
    pub filter: FilterConfig,
}

/// When a frame becomes a keyframe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct KeyframeConfig {
    /// A new keyframe is made when less than this fraction of the keyframe's corners are inliers.
    pub support: f64,
    /// An older keyframe is reused, instead of making a new one, if at least this fraction of its
    /// corners is in view.
    pub revisit: f64,
    /// Number of older keyframes kept.
    pub remembered: usize,
}

impl Default for KeyframeConfig {
    fn default() -> Self {
        Self { support: 0.5, revisit: 0.75, remembered: 32 }
    }
}

impl OdometryConfig {
    /// Scales what depends on the image size: blur, rolling shutter and relief grow with it.
    pub(crate) fn for_camera(mut self, camera: &Camera) -> Self {
        self.motion.inlier_px *= (camera.width() as f64 / 640.0).max(1.0);
        self
    }
}

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
    /// A new keyframe is made when less than this part of the keyframe's corners still supports the movement.
    pub support: f64,
    /// An older keyframe of which at least this part of the corners is in view again is taken up instead of making a new one.
    pub revisit: f64,
    /// So many older keyframes are remembered.
    pub remembered: usize,
}

impl Default for KeyframeConfig {
    fn default() -> Self {
        Self { support: 0.5, revisit: 0.75, remembered: 32 }
    }
}

impl OdometryConfig {
    /// With what depends on the size of the image: blur, rolling shutters and what stands a little above the ground grow with it.
    pub(crate) fn for_camera(mut self, camera: &Camera) -> Self {
        self.motion.inlier_px *= (camera.width() as f64 / 640.0).max(1.0);
        self
    }
}

//! What an earlier pass over the same images has found.

use super::Odometry;
use super::pattern_noise::PatternNoise;
use crate::fixed_pattern::{ImageMask, NonuniformityCorrection};
use crate::motion::MeasuredMotion;
use nalgebra::Matrix2;
use std::sync::Arc;

/// What an earlier pass over the same images has found.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EarlierPass {
    /// How often the images are halved before they are tracked, because single pixels are mostly
    /// noise.
    pub halvings: u32,
    /// Correction of the fixed-pattern noise of images that were halved so often.
    pub correction: Option<NonuniformityCorrection>,
    /// Much of the view that does not move with the ground.
    pub fixed: Option<Arc<ImageMask>>,
    /// The motion within the images of a rolling shutter.
    pub motion: Option<Arc<MeasuredMotion>>,
    /// Covariance of the mount's roll and pitch, radians², where they were estimated.
    pub mount_tilt: Option<Matrix2<f64>>,
}

impl Odometry {
    /// The fixed-pattern noise of the camera for a later pass; `None` where there is none.
    pub fn found_pattern(&self) -> Option<EarlierPass> {
        let correction = Some(self.correction()?.clone());
        Some(EarlierPass { halvings: self.halvings(), correction, ..EarlierPass::default() })
    }

    /// Begins with what an earlier pass over the same images has found.
    pub fn with_earlier_pass(mut self, found: &EarlierPass) -> Self {
        (0..found.halvings).for_each(|_| self.halve_resolution());
        if let Some(correction) = &found.correction {
            self.pattern_noise = PatternNoise::known(correction.clone());
        }
        if let Some(motion) = &found.motion {
            self.motion = Arc::clone(motion);
        }
        if let Some(covariance) = &found.mount_tilt {
            self.learned.rig_prior.set_earlier_mount_tilt_covariance(covariance);
        }
        match &found.fixed {
            Some(fixed) => self.with_fixed(fixed),
            None => self,
        }
    }
}

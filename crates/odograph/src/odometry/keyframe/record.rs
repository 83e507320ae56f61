//! What is kept of a keyframe that is no longer in use.

use super::super::moving_ground::MovingGround;
use super::super::surface::Surface;
use super::Keyframe;
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::geometry::pose_index::{HEADING, HEIGHT, PITCH, ROLL, X, Y};
use crate::image::Pyramid;
use crate::keyframe::KeyframeId;
use crate::motion::{GroundView, PoseRates, RollingShutter};
use nalgebra::{Matrix6, Matrix6x2};
use std::sync::{Arc, OnceLock};

/// A keyframe without its templates: a tenth of the memory.
#[derive(Debug)]
pub struct KeyframeRecord {
    pub(super) id: Option<KeyframeId>,
    pub(super) pyramid: Pyramid,
    pub(super) pose: GroundPose,
    pub(super) covariance: Matrix6<f64>,
    pub(super) model_covariance: Matrix6<f64>,
    pub(super) shutter: RollingShutter,
    pub(super) rate_variance: PoseRates,
    pub(super) by_readout: PoseRates,
    pub(super) by_mount_tilt: Matrix6x2<f64>,
    pub(super) surface: Option<Surface>,
    pub(super) mask: Option<Arc<ImageMask>>,
    pub(super) places: Vec<(usize, usize)>,
    pub(super) view: OnceLock<GroundView>,
    /// Whether its pose is connected with the present one by measurement.
    pub(super) reachable: bool,
}

impl KeyframeRecord {
    /// Sum of the pose's variances, metres²: angles count as displacements at a distance of one
    /// height.
    pub(super) fn spread_m2(&self) -> f64 {
        let of = |i: usize| self.covariance[(i, i)];
        of(X) + of(Y) + of(HEIGHT) + self.pose.height_m.powi(2) * (of(HEADING) + of(ROLL) + of(PITCH))
    }
}

impl Keyframe {
    /// A keyframe as it was remembered, without its corners.
    pub(super) fn recorded(record: KeyframeRecord) -> Self {
        let KeyframeRecord {
            id,
            pyramid,
            pose,
            covariance,
            model_covariance,
            shutter,
            rate_variance,
            by_readout,
            by_mount_tilt,
            surface,
            mask,
            places,
            view,
            ..
        } = record;
        let (corners, texture, dense) = (Vec::new(), OnceLock::new(), OnceLock::new());
        Self {
            id,
            corners_at_first: 0,
            corners,
            pyramid,
            pose,
            covariance,
            model_covariance,
            shutter,
            rate_variance,
            rates_on_slope: None,
            by_readout,
            by_mount_tilt,
            level_m: 0.0,
            shape: None,
            seen_before_from: None,
            new_ground_is_kerb: false,
            undulates: surface.as_ref().is_some_and(Surface::is_smooth),
            surface,
            mask,
            stale: None,
            places,
            moving: MovingGround::default(),
            sought: None,
            prepared: 0,
            in_halves: false,
            view,
            texture,
            dense,
        }
    }

    /// What is kept of a keyframe that is no longer in use.
    pub fn retire(mut self) -> KeyframeRecord {
        self.find();
        let Self {
            id,
            pyramid,
            pose,
            covariance,
            model_covariance,
            shutter,
            rate_variance,
            by_readout,
            by_mount_tilt,
            surface,
            mask,
            places,
            view,
            ..
        } = self;
        let reachable = true;
        KeyframeRecord {
            id,
            pyramid,
            pose,
            covariance,
            model_covariance,
            shutter,
            rate_variance,
            by_readout,
            by_mount_tilt,
            surface,
            mask,
            places,
            view,
            reachable,
        }
    }
}

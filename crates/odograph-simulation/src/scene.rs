//! What a readout sees: the pose of the camera at each row, and the state of the ground.

use super::sway::Swaying;
use super::terrain::TerrainSurface;
use nalgebra::Matrix3;
use odograph::geometry::{GroundPoint, GroundPose};

/// One instant or one readout: the camera pose of each row and the state of the ground.
pub(super) struct Scene<'a> {
    pub(super) rows: Vec<RowView>,
    /// Ground point relative to which the row positions are given, so that single precision
    /// suffices.
    pub(super) origin: GroundPoint,
    /// Height of the level plane near the camera, metres.
    pub(super) level_m: f64,
    pub(super) surface: Option<&'a TerrainSurface>,
    pub(super) sway: Option<&'a Swaying>,
}

/// The camera during the exposure of one row.
pub(super) struct RowView {
    pub(super) rotation: Matrix3<f32>,
    /// Height above the level plane, metres.
    pub(super) height: f32,
    pub(super) x_m: f32,
    pub(super) y_m: f32,
    pub(super) time_s: f64,
}

impl<'a> Scene<'a> {
    /// Flat, static ground; one pose for all rows or one per row.
    pub(super) fn flat(poses: &[GroundPose]) -> Self {
        Self::new(poses, &[0.0], None, None)
    }

    /// One pose and time for all rows or one per row. The origin is the ground point below the
    /// middle row's camera.
    pub(super) fn new(
        poses: &[GroundPose],
        times_s: &[f64],
        surface: Option<&'a TerrainSurface>,
        sway: Option<&'a Swaying>,
    ) -> Self {
        let middle = &poses[poses.len() / 2];
        let origin = GroundPoint::new(middle.x_m, middle.y_m);
        let level_m = surface.map_or(0.0, |surface| surface.level_m(origin.x_m, origin.y_m));
        let rows = poses.iter().zip(times_s).map(|(pose, time_s)| RowView {
            rotation: pose.world_from_camera_rotation().map(|v| v as f32),
            height: (pose.height_m - level_m) as f32,
            x_m: (pose.x_m - origin.x_m) as f32,
            y_m: (pose.y_m - origin.y_m) as f32,
            time_s: *time_s,
        });
        Self { rows: rows.collect(), origin, level_m, surface, sway }
    }

    pub(super) fn row(&self, row: usize) -> &RowView {
        &self.rows[row.min(self.rows.len() - 1)]
    }
}

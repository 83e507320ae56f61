//! Where the patches of an image lie on the ground.

use super::super::surface::Surface;
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use crate::motion::{Axes, Elevation, GroundFromRay, GroundPatch, RollingShutter};

/// Where the patches of an image lie on the ground.
pub(super) struct GroundProjection<'a> {
    camera: &'a Camera,
    pose: &'a GroundPose,
    shutter: &'a RollingShutter,
    /// Elevation where nothing else is known, metres.
    level_m: f64,
    surface: Option<&'a Surface>,
    from_ray: GroundFromRay<'a>,
    axes: Axes,
}

impl<'a> GroundProjection<'a> {
    pub(super) fn new(
        camera: &'a Camera,
        pose: &'a GroundPose,
        shutter: &'a RollingShutter,
        (level_m, surface): (f64, Option<&'a Surface>),
    ) -> Self {
        let (from_ray, axes) = (GroundFromRay::new(pose), Axes::new(pose));
        Self { camera, pose, shutter, level_m, surface, from_ray, axes }
    }

    pub(super) fn patch(&self, centre: Pixel) -> Option<(GroundPatch, Option<Elevation>)> {
        let elevation = self.surface.map(|surface| self.elevation(surface, centre));
        let elevation_m = elevation.map_or(self.level_m, |elevation| elevation.mean_m);
        Some((self.patch_at(centre, elevation_m)?, elevation))
    }

    /// Height of the camera, metres.
    pub(super) fn height_m(&self) -> f64 {
        self.pose.height_m
    }

    /// A patch of the image at a given elevation.
    pub(super) fn patch_at(&self, centre: Pixel, elevation_m: f64) -> Option<GroundPatch> {
        if self.shutter.is_static() {
            let from_ray = self.from_ray.at_elevation(elevation_m);
            GroundPatch::new(self.camera, &from_ray, centre, 1.0)
        } else {
            let pose = (self.pose, &self.axes);
            GroundPatch::with_rolling_shutter(self.camera, pose, self.shutter, elevation_m, centre)
        }
    }

    /// The elevation where the ray of a pixel meets the surface.
    fn elevation(&self, surface: &Surface, pixel: Pixel) -> Elevation {
        let mut elevation = Elevation { mean_m: surface.mean_m(), variance_m2: 0.0 };
        let Some(ray) = self.camera.ray_from_pixel(pixel) else { return elevation };
        // Slopes are small: the second step is off by their square.
        for _ in 0..2 {
            let Some(ground) = self.from_ray.at_elevation(elevation.mean_m).of(ray) else { break };
            elevation = surface.at(ground);
        }
        elevation
    }
}

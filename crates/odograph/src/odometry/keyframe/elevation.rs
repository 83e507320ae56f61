//! The elevations of a keyframe's corners: relief, undulation and kerbs.

use super::super::found_corner::FoundCorner;
use super::super::surface::Surface;
use super::corner::KeyCorner;
use super::overlap::image_grid;
use super::projection::GroundProjection;
use super::{Keyframe, MARGIN_PX};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose};
use crate::keyframe::GroundInView;
use crate::motion::{
    Elevation, GroundPatch, GroundShape, MAX_KERB_HEIGHT, MeasuredElevation, MotionEstimate, Roughness,
    ShapeEstimate, ViewingPose,
};

/// Ground within this part of the height is below the camera.
const BELOW: f64 = 0.15;

/// Ground beyond this distance, in heights, does not count in the plane of the ground in view.
const FURTHEST_IN_HEIGHTS: f64 = 3.0;

/// A camera lower than this part of its height over the plane of the ground in view is a plane that
/// was extrapolated wrongly.
const LOWEST_OVER_GROUND: f64 = 0.5;

/// Frames whose tracks are off by more than this, pixels, show no kerb: the shutter rolls, or
/// images are blurred.
const KERB_PX: f64 = 0.3;

/// Of fewer confirmed corners a kerb is not remembered: tracks that slip along an edge are off the
/// ground as well.
const CORNERS_OF_KERB: usize = 12;

/// Whether ground was not in view of a keyframe at `before`.
pub(super) fn is_new_ground(before: Option<&ViewingPose>, camera: &Camera, patch: &GroundPatch) -> bool {
    let Some(before) = before else { return false };
    let pixel = patch.pixel(camera, before);
    !pixel.is_some_and(|pixel| camera.contains(pixel, MARGIN_PX as f64))
}

impl Keyframe {
    /// Sets the mean elevation of its corners so that the ground below the camera is on the plane
    /// z = 0, as the height of the rig has it.
    pub fn set_level(&mut self, camera: &Camera, relief_m2: f64) {
        if relief_m2 <= 0.0 {
            return;
        }
        let Some(surface) = self.surface_now(relief_m2) else { return };
        self.undulates = surface.is_smooth();
        if !self.undulates {
            return;
        }
        let below = surface.at(GroundPoint::new(self.pose.x_m, self.pose.y_m));
        self.level_m -= below.mean_m;
        self.corners.iter_mut().for_each(|corner| corner.raise(-below.mean_m));
        self.project_again(camera);
    }

    /// The weight of a corner in the level of the ground below a camera at `pose`.
    pub fn level_weight(&self, corner: usize, pose: &GroundPose) -> f64 {
        if !self.undulates {
            return 1.0;
        }
        let GroundPatch { ground, .. } = self.corners[corner].patch;
        let squared_m2 = (ground.x_m - pose.x_m).powi(2) + (ground.y_m - pose.y_m).powi(2);
        (1.0 + squared_m2 / (BELOW * pose.height_m).powi(2)).powi(-2)
    }

    /// Whether the ground undulates.
    pub fn undulates(&self) -> bool {
        self.undulates
    }

    /// Takes a surface into use that earlier keyframes saw.
    pub fn set_surface(&mut self, surface: Option<Surface>) {
        self.undulates = surface.as_ref().is_some_and(Surface::is_smooth);
        (self.surface, self.shape) = (surface, None);
    }

    /// The error that the elevations of its corners share; `None` where their errors are
    /// independent. Ground that no earlier keyframe has measured has one only if it `may_begin`.
    pub fn shape(&self, may_begin: bool) -> Option<GroundShape> {
        let corners = self.corners.iter().map(|corner| corner.patch.ground);
        match (self.shape, &self.surface) {
            (Some(shape), _) => Some(shape),
            (None, Some(surface)) => Some(surface.shape?.about(&self.pose, corners)),
            (None, None) => may_begin.then(|| GroundShape::unknown(&self.pose, corners)),
        }
    }

    /// Sets the pose of the keyframe before, whose ground is known.
    pub fn set_seen_before(&mut self, from: &GroundPose) {
        self.seen_before_from = Some(ViewingPose::new(*from));
    }

    /// Whether some of its ground is new, and may be off what is known of the ground.
    pub fn may_leave_plane(&self) -> bool {
        self.seen_before_from.is_some() && !self.new_ground_is_kerb
    }

    /// Ground that the keyframe before did not see is off what is known of the ground: its
    /// elevations are measured.
    pub fn leave_plane(&mut self) {
        self.new_ground_is_kerb = true;
        let highest_m = MAX_KERB_HEIGHT * self.pose.height_m;
        let new = self.corners.iter_mut().filter(|corner| corner.is_on_new_ground && !corner.is_on_kerb);
        new.for_each(|corner| corner.put_on_kerb(highest_m));
    }

    /// Drops what frames measured of elevations, among them those of kerbs, under a wrong pose.
    pub fn forget_elevations(&mut self, camera: &Camera) {
        self.corners.iter_mut().for_each(|corner| {
            corner.forget_elevations();
            corner.is_on_kerb = false;
        });
        (self.shape, self.new_ground_is_kerb) = (None, false);
        self.project_again(camera);
    }

    /// Learns the elevations of its corners from a frame measured against it, and how rough the
    /// ground is.
    pub fn learn_elevations(
        &mut self,
        found: &[FoundCorner],
        frame: &MotionEstimate,
        camera: &Camera,
    ) -> Roughness {
        let ground = GroundProjection::new(camera, &self.pose, &self.shutter, (self.level_m, None));
        let mut roughness = Roughness::default();
        let level_m = self.surface.as_ref().map_or(self.level_m, Surface::mean_m);
        let highest_m = MAX_KERB_HEIGHT * self.pose.height_m;
        let is_exact = frame.residual_px < KERB_PX;
        for ((found, seen), agrees) in found.iter().zip(&frame.elevations).zip(&frame.inliers) {
            let corner = &mut self.corners[found.corner];
            if seen.is_plausible
                && !corner.is_on_kerb
                && let Some(before) = corner.compare(seen, is_exact.then_some(highest_m))
            {
                let [first, second] = [&before, seen].map(|seen| (seen.alone_m - level_m, seen.information));
                roughness.add([first, second]);
            }
            if *agrees
                && !seen.is_significant
                && seen.elevation.variance_m2 > 0.0
                && corner.measured.is_none_or(|known| seen.parallax_squared > known.parallax_squared)
            {
                corner.measured = Some(*seen);
            }
        }
        let measured = || found.iter().zip(&frame.elevations).zip(&frame.inliers);
        let is_uneven = self.undulates || self.surface.is_some();
        let surpasses = |found: &FoundCorner, seen: &MeasuredElevation| {
            let corner = &self.corners[found.corner];
            let may_be_off = is_uneven || (self.new_ground_is_kerb && corner.is_on_kerb);
            may_be_off && !seen.is_significant && corner.surpasses(seen)
        };
        let surpassing = measured().filter(|((found, seen), agrees)| **agrees && surpasses(found, seen));
        let taken: Vec<_> = surpassing.map(|((found, seen), _)| (found.corner, *seen)).collect();
        // The shape contains what they share.
        let sharing = if frame.shape.is_some() { 1.0 } else { taken.len() as f64 };
        taken.iter().for_each(|(corner, seen)| self.corners[*corner].take_over(seen, sharing, &ground));
        if let Some(ShapeEstimate { coefficients, shape }) = frame.shape {
            let mut bends = vec![true; self.corners.len()];
            taken.iter().for_each(|(corner, _)| bends[*corner] = false);
            for (corner, _) in self.corners.iter_mut().zip(bends).filter(|(_, bends)| *bends) {
                corner.bend(shape.at(corner.patch.ground, &coefficients), &ground);
            }
            self.shape = Some(shape);
        }
        roughness
    }

    /// The plane of the ground in view, as earlier keyframes have measured it; `None` where the
    /// ground is flat.
    pub fn ground_in_view(&self, camera: &Camera) -> Option<GroundInView> {
        let surface = self.surface.as_ref()?;
        let below = GroundPoint::new(self.pose.x_m, self.pose.y_m);
        let rays = image_grid(camera).into_iter().flatten();
        let points = rays.filter_map(|ray| self.pose.ground_from_ray(ray));
        let near = points.filter(|point| point.distance(below) < FURTHEST_IN_HEIGHTS * self.pose.height_m);
        let (elevation_m, slopes, relief_m) = surface.plane(near, below)?;
        let ground = GroundInView::new(&self.pose, elevation_m, slopes, relief_m);
        // Below a camera that looks ahead the ground is extrapolated.
        (ground.camera.height_m > LOWEST_OVER_GROUND * self.pose.height_m).then_some(ground)
    }

    /// The ground as it is known now, where elevations have this variance; `None` where it is flat.
    pub fn surface_now(&self, relief_m2: f64) -> Option<Surface> {
        let kerb = self.corners.iter().filter(|corner| corner.is_on_kerb).count();
        if relief_m2 <= 0.0 && kerb < CORNERS_OF_KERB && self.surface.is_none() {
            return None;
        }
        let point = |corner: &KeyCorner| {
            let unknown = Elevation { mean_m: corner.patch.elevation_m, variance_m2: relief_m2 };
            let measured = corner.measured.map(|measured| measured.elevation);
            let elevation = measured.or(corner.elevation).unwrap_or(unknown);
            (corner.patch.at_elevation(elevation.mean_m), elevation)
        };
        let level_m = self.surface.as_ref().map_or(self.level_m, Surface::level_m);
        Surface::new(self.corners.iter().map(point).collect(), relief_m2, level_m, self.shape)
    }
}

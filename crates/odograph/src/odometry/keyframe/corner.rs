//! A corner of a keyframe, and what later frames measured of its elevation.

use super::super::moving_ground::StrayCount;
use super::projection::GroundProjection;
use crate::camera::Camera;
use crate::flow::{Template, Warp};
use crate::motion::{Elevation, GroundPatch, MeasuredElevation, SIGNIFICANT_SQUARED, ViewingPose};
use nalgebra::Vector2;

/// A corner of a keyframe.
#[derive(Debug)]
pub struct KeyCorner {
    pub template: Template,
    /// Where it lies on the ground.
    pub patch: GroundPatch,
    /// Its elevation as earlier keyframes have it; `None` on flat ground.
    pub elevation: Option<Elevation>,
    /// Its elevation by the frame that determines it best.
    pub(super) measured: Option<MeasuredElevation>,
    /// Its elevation by an earlier frame, and how often later ones confirmed that it is off the
    /// ground.
    seen_before: Option<MeasuredElevation>,
    confirmations: usize,
    pub(super) is_on_kerb: bool,
    /// Information of the elevation that was taken over from a frame, 1/metres²; zero without.
    information_taken_over: f64,
    /// By how much the shape of the ground has raised it, metres.
    pub(super) bent_m: f64,
    /// Whether the keyframe before did not have its ground in view.
    pub is_on_new_ground: bool,
    pub(super) strays: StrayCount,
    /// How it was last found.
    pub seen: Warp,
}

/// A corner is on a kerb where an elevation was confirmed this many times, each time by this many
/// times the information of the time before: a parallax that is half as long again.
const CONFIRMATIONS: usize = 2;
const LONGER_PARALLAX: f64 = 2.0;

impl KeyCorner {
    /// A corner whose template lies on `patch`; `elevation` is what earlier keyframes measured.
    pub(super) fn new(template: Template, patch: GroundPatch, elevation: Option<Elevation>) -> Self {
        Self {
            seen: Warp::translation(template.centre()),
            template,
            patch,
            elevation,
            measured: None,
            seen_before: None,
            confirmations: 0,
            is_on_kerb: false,
            information_taken_over: 0.0,
            bent_m: 0.0,
            is_on_new_ground: false,
            strays: StrayCount::default(),
        }
    }

    /// Drops the measured elevations: they were measured under another calibration.
    pub(super) fn forget_elevations(&mut self) {
        (self.measured, self.seen_before, self.confirmations) = (None, None, 0);
        (self.information_taken_over, self.bent_m) = (0.0, 0.0);
    }

    /// Projects it onto the ground again: at an elevation of its own where frames measured it.
    pub(super) fn project_again(&mut self, ground: &GroundProjection<'_>) {
        let centre = self.template.centre();
        let own = self.elevation.filter(|_| self.has_own_elevation());
        let projected = match own {
            Some(own) => ground.patch_at(centre, own.mean_m).map(|patch| (patch, Some(own))),
            None => ground.patch(centre),
        };
        if let Some((patch, elevation)) = projected {
            (self.patch, self.elevation) = (patch, elevation);
        }
        if own.is_none() && self.bent_m != 0.0 {
            self.put_at(self.patch.elevation_m + self.bent_m, ground);
        }
    }

    /// Moves it to another elevation, as well known as the one before.
    fn put_at(&mut self, mean_m: f64, ground: &GroundProjection<'_>) {
        if let Some(patch) = ground.patch_at(self.template.centre(), mean_m) {
            self.patch = patch;
            self.elevation.iter_mut().for_each(|elevation| elevation.mean_m = mean_m);
        }
    }

    /// Raises it with the shape of the ground.
    pub(super) fn bend(&mut self, by_m: f64, ground: &GroundProjection<'_>) {
        self.bent_m += by_m;
        self.put_at(self.patch.elevation_m + by_m, ground);
    }

    fn has_own_elevation(&self) -> bool {
        self.is_on_kerb || self.information_taken_over > 0.0
    }

    /// Raises the ground by `by_m`.
    pub(super) fn raise(&mut self, by_m: f64) {
        let own = self.elevation.as_mut();
        let measured = self.measured.as_mut().map(|measured| &mut measured.elevation);
        own.into_iter().chain(measured).for_each(|elevation| elevation.mean_m += by_m);
    }

    /// Compares its elevation with that of an earlier frame, where the parallax has grown enough
    /// since, and gives the earlier one. Where both say several times that it is off the ground it
    /// is on a kerb, and its elevation may be anything up to `highest_m`; with `None` the tracks
    /// are off for another reason.
    pub(super) fn compare(
        &mut self,
        seen: &MeasuredElevation,
        highest_m: Option<f64>,
    ) -> Option<MeasuredElevation> {
        let Some(before) = self.seen_before else {
            self.seen_before = Some(*seen);
            return None;
        };
        if seen.parallax_squared < LONGER_PARALLAX * before.parallax_squared {
            return None;
        }
        self.seen_before = Some(*seen);
        let off_m = seen.alone_m - before.alone_m;
        let variance_m2 = 1.0 / seen.information + 1.0 / before.information;
        let confirms =
            seen.is_significant && before.is_significant && off_m * off_m < SIGNIFICANT_SQUARED * variance_m2;
        self.confirmations = if confirms { self.confirmations + 1 } else { 0 };
        if let Some(highest_m) = highest_m
            && self.confirmations >= CONFIRMATIONS
            && !self.is_on_kerb
        {
            self.put_on_kerb(highest_m);
        }
        Some(before)
    }

    /// Whether a frame knows its elevation much better than the prior, and better than the frame
    /// whose elevation was last taken over.
    pub(super) fn surpasses(&self, seen: &MeasuredElevation) -> bool {
        let prior_counts = 1.0 - seen.elevation.variance_m2 * seen.information;
        seen.elevation.variance_m2 > 0.0
            && prior_counts < 1.0 / (1.0 + LONGER_PARALLAX)
            && seen.information > LONGER_PARALLAX * self.information_taken_over
    }

    /// Takes over the elevation that a frame measured as the prior of the next frames, without what
    /// was known before: where the ground that earlier keyframes saw leaves the view, the rest
    /// carries the scale. `sharing` elevations are taken over together and share the error of the
    /// pose, so that together they weigh as one.
    pub(super) fn take_over(
        &mut self,
        seen: &MeasuredElevation,
        sharing: f64,
        ground: &GroundProjection<'_>,
    ) {
        let known_m = seen.prior_m;
        // Parallax is linear in the inverse of the depth.
        let depth_m = ground.height_m() - known_m;
        let linear_m = seen.alone_m - known_m;
        let mean_m = known_m + linear_m * depth_m / (depth_m + linear_m);
        if let Some(patch) = ground.patch_at(self.template.centre(), mean_m) {
            let variance_m2 = sharing / seen.information;
            (self.patch, self.elevation) = (patch, Some(Elevation { mean_m, variance_m2 }));
            (self.information_taken_over, self.bent_m) = (seen.information, 0.0);
        }
    }

    /// Its elevation may be anything up to `highest_m` from here on.
    pub(super) fn put_on_kerb(&mut self, highest_m: f64) {
        self.is_on_kerb = true;
        let mean_m = self.patch.elevation_m;
        self.elevation = Some(Elevation { mean_m, variance_m2: highest_m * highest_m });
    }

    /// How far from its patch a camera at `pose` is expected to see it for its measured elevation,
    /// pixels.
    pub fn parallax_px(&self, camera: &Camera, pose: &ViewingPose) -> Vector2<f64> {
        let Some(MeasuredElevation { elevation: measured, .. }) = self.measured else {
            return Vector2::zeros();
        };
        let raised = self.patch.at_elevation(measured.mean_m);
        let (from, to) = (self.patch.pixel(camera, pose), pose.pixel(camera, raised, measured.mean_m));
        from.zip(to).map_or(Vector2::zeros(), |(from, to)| Vector2::new(to.x - from.x, to.y - from.y))
    }
}

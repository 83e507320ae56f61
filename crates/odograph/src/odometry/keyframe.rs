//! Keyframes: images whose corners lie on the ground as metric points.

use super::follow::Found;
use super::moving_ground::{MovingGround, StrayCount};
use super::surface::Surface;
use super::texture::{self, Texture};
use crate::camera::Camera;
use crate::detection::{Detection, DetectionConfig};
use crate::fixed_pattern::ImageMask;
use crate::flow::{Template, Warp};
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use crate::image::{GrayImage, Pyramid};
use crate::keyframe::KeyframeId;
use crate::motion::dense::{DenseImage, DenseReference};
use crate::motion::{
    Axes, CoarseRegistration, Elevation, GroundFromRay, GroundPatch, GroundView, MAX_KERB_HEIGHT,
    MeasuredElevation, MotionEstimate, PoseRates, RollingShutter, Roughness, SIGNIFICANT_SQUARED,
    ViewingPose,
};
use nalgebra::{Matrix3, Matrix6, Matrix6x2, Vector2, Vector6};
use std::collections::VecDeque;
use std::sync::{Arc, OnceLock};

/// Ground within this part of the height is below the camera.
const BELOW: f64 = 0.15;

/// Corners this near the border cannot carry a full template with its gradients.
const MARGIN_PX: usize = 9;

/// An image in use as the reference, with its corners prepared for being found again.
#[derive(Debug)]
pub struct Keyframe {
    /// Its number; one that has not been taken into use yet has none.
    pub id: Option<KeyframeId>,
    pub pyramid: Pyramid,
    pub pose: GroundPose,
    /// Of the pose against the start of the run, (x, y, heading, height, roll, pitch).
    pub covariance: Matrix6<f64>,
    /// How its image was exposed.
    pub shutter: RollingShutter,
    /// Variances of the rates of the pose meanwhile.
    pub rate_variance: PoseRates,
    /// How the pose changes with the readout time, metres and radians per second: what a readout
    /// time that is off has done to it since the start.
    pub by_readout: PoseRates,
    /// How the pose changes with roll and pitch of the mount.
    pub by_mount_tilt: Matrix6x2<f64>,
    /// Mean elevation of its corners where no earlier keyframe saw them, metres.
    level_m: f64,
    /// Whether the ground undulates, so that its level is its elevation below the camera.
    undulates: bool,
    /// The ground that earlier keyframes saw, where it is not flat.
    pub surface: Option<Surface>,
    pub corners: Vec<KeyCorner>,
    /// What of the image is known not to be ground.
    pub mask: Option<Arc<ImageMask>>,
    /// How many corners it began with.
    pub corners_at_first: usize,
    /// Ground that moves by itself.
    pub moving: MovingGround,
    /// Where the corners are, enough to prepare the keyframe again; [`Keyframe::find`] gives them.
    places: Vec<(usize, usize)>,
    /// What looks for them, where only a part of the image has been looked at.
    sought: Option<Box<Detection>>,
    /// How many of the places have been prepared.
    prepared: usize,
    /// Whether the corners are prepared in two halves, the second one frame later, where there is
    /// time.
    pub in_halves: bool,
    /// The ground as the keyframe saw it, for coarse registration; made when it is first needed.
    view: Option<GroundView>,
    /// What can be made of its corners; found out when it is first needed.
    texture: OnceLock<Texture>,
    /// The whole image, to be compared with others; made when it is first needed.
    dense: OnceLock<DenseReference>,
}

/// Where the patches of an image lie on the ground.
struct GroundOf<'a> {
    camera: &'a Camera,
    pose: &'a GroundPose,
    shutter: &'a RollingShutter,
    /// Elevation where nothing else is known, metres.
    level_m: f64,
    surface: Option<&'a Surface>,
    from_ray: GroundFromRay<'a>,
    axes: Axes,
}

impl<'a> GroundOf<'a> {
    fn new(
        camera: &'a Camera,
        pose: &'a GroundPose,
        shutter: &'a RollingShutter,
        (level_m, surface): (f64, Option<&'a Surface>),
    ) -> Self {
        let (from_ray, axes) = (GroundFromRay::new(pose), Axes::new(pose));
        Self { camera, pose, shutter, level_m, surface, from_ray, axes }
    }

    fn patch(&self, centre: Pixel) -> Option<(GroundPatch, Option<Elevation>)> {
        let elevation = self.surface.map(|surface| self.elevation(surface, centre));
        let elevation_m = elevation.map_or(self.level_m, |elevation| elevation.mean_m);
        let patch = if self.shutter.is_static() {
            let from_ray = self.from_ray.at_elevation(elevation_m);
            GroundPatch::new(self.camera, &from_ray, centre, 1.0)?
        } else {
            let pose = (self.pose, &self.axes);
            GroundPatch::with_rolling_shutter(self.camera, pose, self.shutter, elevation_m, centre)?
        };
        Some((patch, elevation))
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

/// What looks for the corners of an image outside the mask.
fn sought(image: &GrayImage, mask: Option<&Arc<ImageMask>>, detection: &DetectionConfig) -> Detection {
    let sought = Detection::new((image.width(), image.height()), detection, MARGIN_PX);
    sought.without(mask.cloned(), 0)
}

/// A corner of a keyframe.
#[derive(Debug)]
pub struct KeyCorner {
    pub template: Template,
    /// Where it lies on the ground.
    pub patch: GroundPatch,
    /// Its elevation as earlier keyframes have it; `None` on flat ground.
    pub elevation: Option<Elevation>,
    /// Its elevation by the frame that determines it best.
    measured: Option<MeasuredElevation>,
    /// Its elevation by an earlier frame, and how often later ones confirmed that it is off the
    /// ground.
    seen_before: Option<MeasuredElevation>,
    confirmations: usize,
    is_on_kerb: bool,
    strays: StrayCount,
    /// How it was last found.
    pub seen: Warp,
}

/// Root mean square motion of the inliers in the image, pixels, below which they may be fixed to
/// the camera. Four times the 1.5 px below which an image counts as standing still; chosen, not
/// derived.
const MIN_FLOW_PX: f64 = 6.0;

/// A corner is on a kerb where an elevation was confirmed this many times, each time by this many
/// times the information of the time before: a parallax that is half as long again.
const CONFIRMATIONS: usize = 2;
const LONGER_PARALLAX: f64 = 2.0;

/// Frames whose tracks are off by more than this, pixels, show no kerb: the shutter rolls, or
/// images are blurred.
const KERB_PX: f64 = 0.3;

/// Of fewer confirmed corners a kerb is not remembered: tracks that slip along an edge are off the
/// ground as well.
const CORNERS_OF_KERB: usize = 12;

impl KeyCorner {
    /// Compares its elevation with that of an earlier frame, where the parallax has grown enough
    /// since, and gives the earlier one. Where both say several times that it is off the ground it
    /// is on a kerb, and its elevation may be anything up to `highest_m`; with `None` the tracks
    /// are off for another reason.
    fn compare(&mut self, seen: &MeasuredElevation, highest_m: Option<f64>) -> Option<MeasuredElevation> {
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
            self.is_on_kerb = true;
            let mean_m = self.patch.elevation_m;
            self.elevation = Some(Elevation { mean_m, variance_m2: highest_m * highest_m });
        }
        Some(before)
    }

    /// How far from its patch a camera at `pose` is expected to see it for its measured elevation,
    /// pixels.
    pub fn parallax_px(&self, camera: &Camera, keyframe: &GroundPose, pose: &ViewingPose) -> Vector2<f64> {
        let Some(MeasuredElevation { elevation: measured, .. }) = self.measured else {
            return Vector2::zeros();
        };
        let GroundPatch { ground, elevation_m, .. } = self.patch;
        let nearer = (keyframe.height_m - measured.mean_m) / (keyframe.height_m - elevation_m);
        let raised = GroundPoint::new(
            keyframe.x_m + nearer * (ground.x_m - keyframe.x_m),
            keyframe.y_m + nearer * (ground.y_m - keyframe.y_m),
        );
        let (from, to) = (self.patch.pixel(camera, pose), pose.pixel(camera, raised, measured.mean_m));
        from.zip(to).map_or(Vector2::zeros(), |(from, to)| Vector2::new(to.x - from.x, to.y - from.y))
    }
}

impl Keyframe {
    /// Makes a keyframe of an image at a known pose: finds its corners and lays them on the ground.
    pub fn new(
        pyramid: Pyramid,
        pose: GroundPose,
        covariance: Matrix6<f64>,
        mask: Option<&Arc<ImageMask>>,
        camera: &Camera,
        detection: &DetectionConfig,
    ) -> Self {
        let mut keyframe = Self::to_be_prepared(pyramid, pose, covariance, mask, detection);
        keyframe.prepare(camera);
        keyframe
    }

    /// The same with corners detected in half of the image; [`Keyframe::prepare`] must be called
    /// before measuring against it. The frame that becomes a keyframe is among the slowest; the
    /// next one does the rest.
    pub fn to_be_prepared(
        pyramid: Pyramid,
        pose: GroundPose,
        covariance: Matrix6<f64>,
        mask: Option<&Arc<ImageMask>>,
        detection: &DetectionConfig,
    ) -> Self {
        let image = pyramid.base();
        let mut sought = sought(image, mask, detection);
        sought.look(image, image.height() / 2);
        let rows = image.height();
        let record = KeyframeRecord {
            id: None,
            pyramid,
            pose,
            covariance,
            shutter: RollingShutter {
                readout_s: 0.0,
                rows,
                rates: PoseRates::zeros(),
                accelerations: PoseRates::zeros(),
            },
            rate_variance: PoseRates::zeros(),
            by_readout: PoseRates::zeros(),
            by_mount_tilt: Matrix6x2::zeros(),
            surface: None,
            mask: mask.cloned(),
            places: Vec::new(),
            view: None,
            reachable: true,
        };
        Self { sought: Some(Box::new(sought)), ..Self::recorded(record) }
    }

    /// Where the corners are.
    fn find(&mut self) -> &[(usize, usize)] {
        if let Some(sought) = self.sought.take() {
            let corners = sought.corners(self.pyramid.base());
            self.places = corners.iter().map(|corner| (corner.x, corner.y)).collect();
        }
        &self.places
    }

    /// A keyframe as it was remembered, without its corners.
    fn recorded(record: KeyframeRecord) -> Self {
        let KeyframeRecord {
            id,
            pyramid,
            pose,
            covariance,
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
            shutter,
            rate_variance,
            by_readout,
            by_mount_tilt,
            level_m: 0.0,
            undulates: surface.as_ref().is_some_and(Surface::is_smooth),
            surface,
            mask,
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

    /// Sets the mask. If a corner lies in it, all are detected again, and [`Keyframe::prepare`]
    /// must be called before measuring.
    pub fn set_mask(&mut self, mask: &Arc<ImageMask>, detection: &DetectionConfig) {
        let image = self.pyramid.base();
        let begun = self.sought.is_some();
        if begun || self.places.iter().any(|&(x, y)| mask.covers(x, y)) {
            self.sought = Some(Box::new(sought(image, Some(mask), detection)));
            self.places.clear();
            self.corners.clear();
            (self.prepared, self.corners_at_first, self.in_halves) = (0, 0, false);
            self.texture = OnceLock::new();
        }
        self.mask = Some(mask.clone());
        self.view = None;
        self.dense = OnceLock::new();
    }

    /// Whether a place in the image is known not to be ground.
    pub fn is_masked(&self, pixel: Pixel) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask.covers_pixel(pixel))
    }

    /// Projects the corners onto the ground and prepares their templates, where not done yet. In
    /// two halves, each spread over the image, one call does one half.
    pub fn prepare(&mut self, camera: &Camera) {
        let places = self.find().len();
        let first = self.prepared;
        let until = if self.in_halves && first == 0 { places.div_ceil(2) } else { places };
        if first == until {
            return;
        }
        let ground = GroundOf::new(camera, &self.pose, &self.shutter, (self.level_m, self.surface.as_ref()));
        let corner = |&place: &(usize, usize)| {
            let template = Template::of_finest_level(&self.pyramid, place)?;
            let centre = template.centre();
            let (patch, elevation) = ground.patch(centre)?;
            if self.moving.contains(&patch.ground, self.pose.height_m) {
                return None;
            }
            Some(KeyCorner {
                patch,
                elevation,
                measured: None,
                seen_before: None,
                confirmations: 0,
                is_on_kerb: false,
                strays: StrayCount::default(),
                seen: Warp::translation(centre),
                template,
            })
        };
        self.corners.reserve_exact(places - first);
        self.corners.extend(self.places[first..until].iter().filter_map(corner));
        self.prepared = until;
        self.corners_at_first = self.corners.len();
    }

    /// Drops corners that move by themselves, as leaves do, once a frame has been measured. Of what
    /// moves, neither motion nor elevation explains where it is found. While the inliers stand
    /// still in the image, they may be fixed to the camera and the ground be what strays.
    pub fn drop_moving(&mut self, found: &[Found], frame: &MotionEstimate) {
        let moved_px =
            |found: &Found| found.warp.position.distance(self.corners[found.corner].template.centre());
        let inliers = || found.iter().zip(&frame.inliers).filter(|(_, inlier)| **inlier);
        let sum_px2: f64 = inliers().map(|(found, _)| moved_px(found).powi(2)).sum();
        if sum_px2 < MIN_FLOW_PX.powi(2) * inliers().count() as f64 {
            return;
        }
        for ((found, seen), agrees) in found.iter().zip(&frame.elevations).zip(&frame.inliers) {
            self.corners[found.corner].strays.add(!agrees && !seen.is_plausible);
        }
        let moving = || self.corners.iter().filter(|corner| corner.strays.moves());
        let count = moving().count();
        if self.moving.accepts(count, self.corners.len()) {
            self.moving.extend(moving().map(|corner| corner.patch.ground));
            self.corners.retain(|corner| !corner.strays.moves());
            self.corners_at_first -= count;
        }
    }

    /// What is known of ground that moves by itself, for the next keyframe.
    pub fn moving_ground(&self) -> MovingGround {
        let centre = GroundPoint { x_m: self.pose.x_m, y_m: self.pose.y_m };
        let still = self.corners.iter().filter(|corner| corner.strays.is_still());
        self.moving.next(centre, self.pose.height_m, still.map(|corner| corner.patch.ground))
    }

    /// Sets right how its image was exposed, and with it where its corners lie.
    pub fn expose(&mut self, camera: &Camera, shutter: RollingShutter) {
        self.shutter = shutter;
        self.lay_again(camera);
    }

    /// Projects its corners onto the ground again with a better calibration: height and tilt of
    /// `mount`, if given, and this readout time.
    pub fn recalibrate(&mut self, camera: &Camera, mount: Option<&GroundPose>, readout_s: Option<f64>) {
        if let Some(mount) = mount {
            self.pose = self.pose.with_mount_of(mount);
            self.covariance.fixed_rows_mut::<3>(3).fill(0.0);
            self.covariance.fixed_columns_mut::<3>(3).fill(0.0);
            (self.level_m, self.undulates, self.surface) = (0.0, false, None);
        }
        self.shutter.readout_s = readout_s.unwrap_or(self.shutter.readout_s);
        self.dense = OnceLock::new();
        self.view = None;
        self.lay_again(camera);
        for corner in &mut self.corners {
            (corner.measured, corner.seen_before, corner.confirmations) = (None, None, 0);
        }
    }

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
        self.corners.iter_mut().filter_map(|corner| corner.measured.as_mut()).for_each(|measured| {
            measured.elevation.mean_m -= below.mean_m;
        });
        self.lay_again(camera);
    }

    /// Lays its corners on the ground as it is known now.
    fn lay_again(&mut self, camera: &Camera) {
        let ground = GroundOf::new(camera, &self.pose, &self.shutter, (self.level_m, self.surface.as_ref()));
        for corner in &mut self.corners {
            if let Some((patch, elevation)) = ground.patch(corner.template.centre()) {
                (corner.patch, corner.elevation) = (patch, elevation);
            }
        }
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
        self.surface = surface;
    }

    /// In which quarter of the image a corner is.
    pub fn quadrant(&self, corner: usize) -> usize {
        let (image, centre) = (self.pyramid.base(), self.corners[corner].template.centre());
        let is_right = 2.0 * centre.x > image.width() as f64;
        let is_below = 2.0 * centre.y > image.height() as f64;
        usize::from(is_right) + 2 * usize::from(is_below)
    }

    /// Learns the elevations of its corners from a frame measured against it, and how rough the
    /// ground is; kerbs only where the shutter is known, because skew looks like one.
    pub fn learn_elevations(
        &mut self,
        found: &[Found],
        frame: &MotionEstimate,
        tells_kerbs: bool,
    ) -> Roughness {
        let mut roughness = Roughness::default();
        let level_m = self.surface.as_ref().map_or(self.level_m, Surface::mean_m);
        let highest_m = MAX_KERB_HEIGHT * self.pose.height_m;
        let is_exact = tells_kerbs && frame.residual_px < KERB_PX;
        for ((found, seen), agrees) in found.iter().zip(&frame.elevations).zip(&frame.inliers) {
            let corner = &mut self.corners[found.corner];
            if seen.is_plausible
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
        roughness
    }

    /// The ground as it is known now, where elevations have this variance; `None` where it is flat.
    pub fn surface_now(&self, relief_m2: f64) -> Option<Surface> {
        let kerb = self.corners.iter().filter(|corner| corner.is_on_kerb).count();
        if relief_m2 <= 0.0 && kerb < CORNERS_OF_KERB && self.surface.is_none() {
            return None;
        }
        let point = |corner: &KeyCorner| {
            let GroundPatch { ground, elevation_m, .. } = corner.patch;
            let unknown = Elevation { mean_m: elevation_m, variance_m2: relief_m2 };
            let measured = corner.measured.map(|measured| measured.elevation);
            let elevation = measured.or(corner.elevation).unwrap_or(unknown);
            let nearer = (self.pose.height_m - elevation.mean_m) / (self.pose.height_m - elevation_m);
            let x_m = self.pose.x_m + nearer * (ground.x_m - self.pose.x_m);
            let y_m = self.pose.y_m + nearer * (ground.y_m - self.pose.y_m);
            (GroundPoint::new(x_m, y_m), elevation)
        };
        Surface::new(self.corners.iter().map(point).collect(), relief_m2)
    }

    /// What can be made of its corners.
    pub fn texture(&self) -> Texture {
        *self.texture.get_or_init(|| Texture::of(&self.pyramid, self.mask.as_ref()))
    }

    /// The whole image as a reference for registration, at half resolution: on faint ground the
    /// rest is noise.
    pub fn dense(&self, camera: &Camera) -> &DenseReference {
        self.dense.get_or_init(|| {
            let image = DenseImage::new(self.pyramid.base()).without(self.mask.clone());
            DenseReference::new(camera, &image, &self.pose, 1)
        })
    }

    /// Whether there is enough to follow: this many corners or, on faint ground, any texture.
    pub fn can_be_followed(&mut self, corners: usize) -> bool {
        if self.texture() == Texture::Faint {
            return !texture::is_bare(self.pyramid.base());
        }
        if self.prepared > 0 {
            return self.corners.len() >= corners;
        }
        self.sought.as_ref().is_some_and(|sought| sought.will_find(corners)) || self.find().len() >= corners
    }

    /// Makes the view for coarse registration, where there is none yet.
    pub fn prepare_view(&mut self, registration: &CoarseRegistration) {
        if self.view.is_none() {
            self.view = registration.view(&self.pyramid, self.mask.as_deref(), &self.pose);
        }
    }

    /// The view that [`Keyframe::prepare_view`] made; none where it could not be made.
    pub fn view(&self) -> Option<&GroundView> {
        self.view.as_ref()
    }

    /// Covariance of height, roll and pitch.
    pub fn rig_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(3, 3).into_owned()
    }

    /// By how much the pose is off as a frame measured against it has it, and the covariance that
    /// is left: what is learned of height and tilt tells of the place, too, as far as both were
    /// wrong together.
    pub fn improved_by(&self, frame: &MotionEstimate) -> (Vector6<f64>, Matrix6<f64>) {
        let unchanged = (Vector6::zeros(), self.covariance);
        let Some(error) = &frame.keyframe_error else { return unchanged };
        let before = self.rig_covariance();
        let Some(information) = before.try_inverse() else { return unchanged };
        let gain = self.covariance.fixed_view::<6, 3>(0, 3) * information;
        let covariance = self.covariance - gain * (before - error.covariance) * gain.transpose();
        (gain * error.mean, 0.5 * (covariance + covariance.transpose()))
    }

    /// Keeps only the given corners, with where they were seen.
    pub fn keep_only(&mut self, seen: impl Iterator<Item = (usize, Warp)>) {
        let mut kept = vec![None; self.corners.len()];
        seen.for_each(|(corner, warp)| kept[corner] = Some(warp));
        let mut index = 0;
        self.corners.retain_mut(|corner| {
            let warp = kept[index];
            index += 1;
            if let Some(warp) = warp {
                corner.seen = warp;
            }
            warp.is_some()
        });
    }

    /// What is kept of a keyframe that is no longer in use.
    pub fn retire(mut self) -> KeyframeRecord {
        self.find();
        let Self {
            id,
            pyramid,
            pose,
            covariance,
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

/// A keyframe without its templates: a tenth of the memory.
#[derive(Debug)]
pub struct KeyframeRecord {
    id: Option<KeyframeId>,
    pyramid: Pyramid,
    pose: GroundPose,
    covariance: Matrix6<f64>,
    shutter: RollingShutter,
    rate_variance: PoseRates,
    by_readout: PoseRates,
    by_mount_tilt: Matrix6x2<f64>,
    surface: Option<Surface>,
    mask: Option<Arc<ImageMask>>,
    places: Vec<(usize, usize)>,
    view: Option<GroundView>,
    /// Whether its pose is connected with the present one by measurement.
    reachable: bool,
}

/// The last keyframes, to be taken up again when the camera comes back to them.
#[derive(Debug)]
pub struct KeyframeMemory {
    records: VecDeque<KeyframeRecord>,
    most: usize,
    /// What is known by now not to be ground, and how corners are sought where one lies there.
    mask: Option<(Arc<ImageMask>, DetectionConfig)>,
}

impl KeyframeMemory {
    pub fn new(most: usize) -> Self {
        Self { records: VecDeque::new(), most, mask: None }
    }

    pub fn remember(&mut self, record: KeyframeRecord) {
        self.records.push_back(record);
        while self.records.len() > self.most {
            self.records.pop_front();
        }
    }

    /// Removes and returns the keyframe of which a camera at `pose` sees most, if that is at least
    /// `least` of its image.
    pub fn take_best(&mut self, camera: &Camera, pose: &GroundPose, least: f64) -> Option<Keyframe> {
        let seen = ViewingPose::new(*pose);
        let rays = grid_rays(camera);
        let overlap = |record: &KeyframeRecord| overlap(record, &rays, camera, &seen);
        let best = self
            .records
            .iter()
            .enumerate()
            .map(|(i, record)| (overlap(record), i))
            .filter(|(overlap, _)| *overlap >= least)
            .max_by(|a, b| a.0.total_cmp(&b.0))?;
        self.take(best.1, camera)
    }

    /// Sets height and tilt of all records to those of `mount`, if given.
    pub fn recalibrate(&mut self, mount: Option<&GroundPose>) {
        for record in &mut self.records {
            record.view = None;
            if let Some(mount) = mount {
                record.pose = record.pose.with_mount_of(mount);
                record.surface = None;
            }
        }
    }

    /// More is known about what is not ground.
    pub fn set_mask(&mut self, mask: &Arc<ImageMask>, detection: &DetectionConfig) {
        self.mask = Some((mask.clone(), *detection));
    }

    /// Puts a keyframe back that was taken out in vain.
    pub fn put_back(&mut self, keyframe: Keyframe) {
        self.remember(keyframe.retire());
    }

    /// Takes out the keyframe with that index.
    pub fn take(&mut self, index: usize, camera: &Camera) -> Option<Keyframe> {
        let mut keyframe = Keyframe::recorded(self.records.remove(index)?);
        if let Some((mask, detection)) = &self.mask
            && keyframe.mask.as_ref().is_none_or(|known| !Arc::ptr_eq(known, mask))
        {
            keyframe.set_mask(mask, detection);
        }
        keyframe.prepare(camera);
        Some(keyframe)
    }

    /// Puts a keyframe back where [`KeyframeMemory::take`] took it from.
    pub fn put_back_at(&mut self, index: usize, keyframe: Keyframe) {
        self.records.insert(index.min(self.records.len()), keyframe.retire());
    }

    /// Starts a new segment: remembered keyframes are no longer connected to the present pose.
    pub fn close_segment(&mut self) {
        self.records.iter_mut().for_each(|record| record.reachable = false);
    }

    /// How many keyframes are connected with the present by measurement.
    pub fn reachable(&self) -> usize {
        self.records.iter().filter(|record| record.reachable).count()
    }

    /// The indices of those keyframes, the newest first.
    pub fn newest(&self) -> Vec<usize> {
        (0..self.records.len()).rev().filter(|&index| self.records[index].reachable).collect()
    }

    /// The indices of those keyframes, the nearest to a pose first.
    pub fn nearest(&self, pose: &GroundPose) -> Vec<usize> {
        let away = |index: usize| {
            let other = &self.records[index].pose;
            (other.x_m - pose.x_m).hypot(other.y_m - pose.y_m)
        };
        let mut indices = self.newest();
        indices.sort_by(|&a, &b| away(a).total_cmp(&away(b)));
        indices
    }
}

/// Points of a coarse grid over an image, on a side.
pub const GRID: usize = 8;

/// What the camera sees at the points of a coarse grid over its image.
pub fn grid_rays(camera: &Camera) -> [Option<Ray>; GRID * GRID] {
    let (width, height) = (camera.width() as f64, camera.height() as f64);
    std::array::from_fn(|at| {
        let along = |i: usize, size: f64| (i as f64 + 0.5) / GRID as f64 * size - 0.5;
        camera.ray_from_pixel(Pixel::new(along(at % GRID, width), along(at / GRID, height)))
    })
}

/// The part of a coarse grid over a keyframe's image that a camera at `pose` would have in view.
fn overlap(
    record: &KeyframeRecord,
    rays: &[Option<Ray>; GRID * GRID],
    camera: &Camera,
    pose: &ViewingPose,
) -> f64 {
    seen_share(&record.pose, rays, camera, pose)
}

/// Fraction of a coarse grid over the image of a camera at `at` that a camera at `pose` sees.
pub fn seen_share(
    at: &GroundPose,
    rays: &[Option<Ray>; GRID * GRID],
    camera: &Camera,
    pose: &ViewingPose,
) -> f64 {
    let ground_from_ray = GroundFromRay::new(at);
    let seen = rays.iter().filter(|ray| {
        let ground = ray.and_then(|ray| ground_from_ray.of(ray));
        let back = ground.and_then(|ground| pose.pixel(camera, ground, 0.0));
        back.is_some_and(|pixel| camera.contains(pixel, MARGIN_PX as f64))
    });
    seen.count() as f64 / (GRID * GRID) as f64
}

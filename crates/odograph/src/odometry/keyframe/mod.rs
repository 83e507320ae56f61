//! Keyframes: images whose corners lie on the ground as metric points.

mod corner;
mod elevation;
mod memory;
mod moving_corners;
mod overlap;
mod projection;

use super::OdometryConfig;
use super::moving_ground::MovingGround;
use super::surface::Surface;
use super::texture::{self, TextureClass};
use crate::camera::Camera;
use crate::detection::{Detection, DetectionConfig};
use crate::fixed_pattern::{ImageMask, NonuniformityCorrection};
use crate::flow::{Template, Warp};
use crate::geometry::pose_index::{HEADING, HEIGHT, PITCH, ROLL, X, Y};
use crate::geometry::{GroundPose, Pixel, propagated};
use crate::image::{GrayImage, Pyramid};
use crate::keyframe::KeyframeId;
use crate::motion::dense::{DenseImage, DenseReference};
use crate::motion::{
    CoarseRegistration, GroundShape, GroundView, MAX_KERB_HEIGHT, MotionEstimate, MotionModel, PoseRates,
    RollingShutter, ViewingPose,
};
pub use corner::KeyCorner;
use elevation::is_new_ground;
pub use memory::KeyframeMemory;
use nalgebra::{Matrix3, Matrix6, Matrix6x2, Vector6};
pub use overlap::{GRID, image_grid, overlap};
use projection::GroundProjection;
use std::sync::{Arc, OnceLock};

/// Corners this near the border cannot carry a full template with its gradients.
const MARGIN_PX: usize = 9;

/// What a frame tells of the errors of its keyframe.
#[derive(Debug, Clone, Copy, Default)]
pub struct KeyframeUpdate {
    /// By how much the pose is off, (x, y, heading, height, roll, pitch).
    pub moved: Vector6<f64>,
    /// Covariance that is left.
    pub covariance: Matrix6<f64>,
    /// The same by errors of the model.
    pub model_covariance: Matrix6<f64>,
}

/// An image in use as the reference, with its corners prepared for being found again.
#[derive(Debug)]
pub struct Keyframe {
    /// Its number; one that has not been taken into use yet has none.
    pub id: Option<KeyframeId>,
    pub pyramid: Pyramid,
    pub pose: GroundPose,
    /// Of the pose against the start of the run, (x, y, heading, height, roll, pitch).
    pub covariance: Matrix6<f64>,
    /// The same by errors of the model.
    pub model_covariance: Matrix6<f64>,
    /// How its image was exposed.
    pub shutter: RollingShutter,
    /// Variances of the rates of the pose meanwhile.
    pub rate_variance: PoseRates,
    /// The rates and their variances if the ground slopes, which looks like a skew.
    pub rates_on_slope: Option<(PoseRates, PoseRates)>,
    /// How the pose changes with the readout time, metres and radians per second: what a readout
    /// time that is off has done to it since the start.
    pub by_readout: PoseRates,
    /// How the pose changes with roll and pitch of the mount.
    pub by_mount_tilt: Matrix6x2<f64>,
    /// Mean elevation of its corners where no earlier keyframe saw them, metres.
    level_m: f64,
    /// Where the keyframe before was, and whether the ground that it did not see has elevations of
    /// its own.
    seen_before_from: Option<ViewingPose>,
    new_ground_is_kerb: bool,
    /// Whether the ground undulates, so that its level is its elevation below the camera.
    undulates: bool,
    /// The ground that earlier keyframes saw, where it is not flat.
    pub surface: Option<Surface>,
    /// What its frames found of the shape of the ground.
    shape: Option<GroundShape>,
    pub corners: Vec<KeyCorner>,
    /// Mask of pixels that are known not to show ground.
    pub mask: Option<Arc<ImageMask>>,
    /// What of the frame that is measured against it is a copy of the frame before.
    pub stale: Option<Arc<ImageMask>>,
    /// How many corners it began with.
    pub corners_at_first: usize,
    /// Whether something may have covered the ground when it was made.
    pub was_on_trial: bool,
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
    view: OnceLock<GroundView>,
    /// What can be made of its corners; found out when it is first needed.
    texture: OnceLock<TextureClass>,
    /// The whole image, to be compared with others; made when it is first needed.
    dense: OnceLock<DenseReference>,
}

/// What looks for the corners of an image outside the mask.
fn sought(image: &GrayImage, mask: Option<&Arc<ImageMask>>, detection: &DetectionConfig) -> Detection {
    let sought = Detection::new((image.width(), image.height()), detection, MARGIN_PX);
    sought.without(mask.cloned(), 0)
}

impl Keyframe {
    /// Makes a keyframe of an image at a known pose: finds its corners and projects them onto the
    /// ground.
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
        Self {
            id: None,
            corners_at_first: 0,
            was_on_trial: false,
            corners: Vec::new(),
            pyramid,
            pose,
            covariance,
            model_covariance: Matrix6::zeros(),
            shutter: RollingShutter {
                readout_s: 0.0,
                rows,
                rates: PoseRates::zeros(),
                accelerations: PoseRates::zeros(),
            },
            rate_variance: PoseRates::zeros(),
            rates_on_slope: None,
            by_readout: PoseRates::zeros(),
            by_mount_tilt: Matrix6x2::zeros(),
            level_m: 0.0,
            shape: None,
            seen_before_from: None,
            new_ground_is_kerb: false,
            undulates: false,
            surface: None,
            mask: mask.cloned(),
            stale: None,
            places: Vec::new(),
            moving: MovingGround::default(),
            sought: Some(Box::new(sought)),
            prepared: 0,
            in_halves: false,
            view: OnceLock::new(),
            texture: OnceLock::new(),
            dense: OnceLock::new(),
        }
    }

    /// The same keyframe at half the resolution. It must be prepared again, with a camera of that
    /// resolution, and elevations are learned anew.
    pub fn halved(self, mask: Option<&Arc<ImageMask>>, config: &OdometryConfig) -> Self {
        let pyramid = Pyramid::new(self.pyramid.level(1).clone(), config.flow.levels);
        let half = Self::to_be_prepared(pyramid, self.pose, self.covariance, mask, &config.detection);
        Self {
            id: self.id,
            model_covariance: self.model_covariance,
            shutter: RollingShutter { rows: half.shutter.rows, ..self.shutter },
            rate_variance: self.rate_variance,
            rates_on_slope: self.rates_on_slope,
            by_readout: self.by_readout,
            by_mount_tilt: self.by_mount_tilt,
            level_m: self.level_m,
            undulates: self.undulates,
            surface: self.surface,
            moving: self.moving,
            ..half
        }
    }

    /// A keyframe that is no longer in use, without its templates: a tenth of the memory. It must
    /// be prepared again.
    fn retired(mut self) -> Self {
        self.find();
        Self {
            corners_at_first: 0,
            corners: Vec::new(),
            rates_on_slope: None,
            level_m: 0.0,
            shape: None,
            seen_before_from: None,
            new_ground_is_kerb: false,
            undulates: self.surface.as_ref().is_some_and(Surface::is_smooth),
            stale: None,
            moving: MovingGround::default(),
            sought: None,
            prepared: 0,
            in_halves: false,
            texture: OnceLock::new(),
            dense: OnceLock::new(),
            ..self
        }
    }

    /// Sum of the pose's variances, metres²: angles count as displacements at a distance of one
    /// height.
    fn spread_m2(&self) -> f64 {
        let of = |i: usize| self.covariance[(i, i)];
        of(X) + of(Y) + of(HEIGHT) + self.pose.height_m.powi(2) * (of(HEADING) + of(ROLL) + of(PITCH))
    }

    /// Where the corners are.
    fn find(&mut self) -> &[(usize, usize)] {
        if let Some(sought) = self.sought.take() {
            let corners = sought.corners(self.pyramid.base());
            self.places = corners.iter().map(|corner| (corner.x, corner.y)).collect();
        }
        &self.places
    }

    /// Sets the mask. If a corner lies in it, all are detected again, and [`Keyframe::prepare`]
    /// must be called before measuring.
    pub fn set_mask(&mut self, mask: &Arc<ImageMask>, detection: &DetectionConfig) {
        let begun = self.sought.is_some();
        self.mask = Some(mask.clone());
        self.view = OnceLock::new();
        self.dense = OnceLock::new();
        if begun || self.places.iter().any(|&(x, y)| mask.covers(x, y)) {
            self.detect_again(detection);
        }
    }

    /// Subtracts fixed-pattern noise from its image and detects its corners again outside the mask;
    /// [`Keyframe::prepare`] must be called before measuring.
    pub fn correct(
        &mut self,
        correction: &NonuniformityCorrection,
        mask: Option<&Arc<ImageMask>>,
        detection: &DetectionConfig,
    ) {
        let mut image = self.pyramid.base().clone();
        correction.apply(&mut image);
        self.pyramid.replace(image);
        self.mask = mask.cloned();
        self.view = OnceLock::new();
        self.dense = OnceLock::new();
        self.detect_again(detection);
    }

    fn detect_again(&mut self, detection: &DetectionConfig) {
        self.sought = Some(Box::new(sought(self.pyramid.base(), self.mask.as_ref(), detection)));
        self.places.clear();
        self.corners.clear();
        (self.prepared, self.corners_at_first, self.in_halves) = (0, 0, false);
        self.texture = OnceLock::new();
    }

    /// Looks for no corners in a part of its image, and again in the rest.
    pub fn leave_out(&mut self, part: &ImageMask, detection: &DetectionConfig) {
        let image = self.pyramid.base();
        let mask = self.mask.as_ref().map_or_else(|| part.clone(), |mask| mask.union(part));
        let mut sought = sought(image, Some(&Arc::new(mask)), detection);
        sought.look(image, image.height() / 2);
        self.sought = Some(Box::new(sought));
    }

    /// Whether a place in the frame that is measured is known not to show the ground now.
    pub fn is_masked(&self, pixel: Pixel) -> bool {
        [&self.mask, &self.stale].into_iter().flatten().any(|mask| mask.covers_pixel(pixel))
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
        let ground =
            GroundProjection::new(camera, &self.pose, &self.shutter, (self.level_m, self.surface.as_ref()));
        let corner = |&place: &(usize, usize)| {
            let template = Template::of_finest_level(&self.pyramid, place)?;
            let centre = template.centre();
            let (patch, elevation) = ground.patch(centre)?;
            if self.moving.contains(&patch.ground, self.pose.height_m) {
                return None;
            }
            let mut corner = KeyCorner::new(template, patch, elevation);
            corner.is_on_new_ground = is_new_ground(self.seen_before_from.as_ref(), camera, &patch);
            if corner.is_on_new_ground && self.new_ground_is_kerb {
                corner.put_on_kerb(MAX_KERB_HEIGHT * self.pose.height_m);
            }
            Some(corner)
        };
        self.corners.reserve_exact(places - first);
        self.corners.extend(self.places[first..until].iter().filter_map(corner));
        self.prepared = until;
        self.corners_at_first = self.corners.len();
    }

    /// Sets right how its image was exposed, and with it where its corners lie.
    pub fn expose(&mut self, camera: &Camera, shutter: RollingShutter) {
        self.shutter = shutter;
        self.project_again(camera);
    }

    /// Projects its corners onto the ground again with a better calibration: height and tilt of
    /// `mount`, if given, and this readout time.
    pub fn recalibrate(&mut self, camera: &Camera, mount: Option<&GroundPose>, readout_s: Option<f64>) {
        if let Some(mount) = mount {
            self.pose = self.pose.with_mount_of(mount);
            for covariance in [&mut self.covariance, &mut self.model_covariance] {
                covariance.fixed_rows_mut::<3>(3).fill(0.0);
                covariance.fixed_columns_mut::<3>(3).fill(0.0);
            }
            (self.level_m, self.undulates, self.surface) = (0.0, false, None);
        }
        self.shutter.readout_s = readout_s.unwrap_or(self.shutter.readout_s);
        self.dense = OnceLock::new();
        self.view = OnceLock::new();
        self.shape = None;
        self.corners.iter_mut().for_each(|corner| corner.bent_m = 0.0);
        self.project_again(camera);
        self.corners.iter_mut().for_each(KeyCorner::forget_elevations);
    }

    /// Projects its corners onto the ground as it is known now.
    fn project_again(&mut self, camera: &Camera) {
        let ground =
            GroundProjection::new(camera, &self.pose, &self.shutter, (self.level_m, self.surface.as_ref()));
        self.corners.iter_mut().for_each(|corner| corner.project_again(&ground));
    }

    /// In which quarter of the image a corner is.
    pub fn quadrant(&self, corner: usize) -> usize {
        let (image, centre) = (self.pyramid.base(), self.corners[corner].template.centre());
        let is_right = 2.0 * centre.x > image.width() as f64;
        let is_below = 2.0 * centre.y > image.height() as f64;
        usize::from(is_right) + 2 * usize::from(is_below)
    }

    /// What can be made of its corners.
    pub fn texture(&self) -> TextureClass {
        *self.texture.get_or_init(|| TextureClass::of(&self.pyramid, self.mask.as_ref()))
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
        if self.texture() == TextureClass::Faint {
            return !texture::is_bare(self.pyramid.base());
        }
        if self.prepared > 0 {
            return self.corners.len() >= corners;
        }
        self.sought.as_ref().is_some_and(|sought| sought.will_find(corners)) || self.find().len() >= corners
    }

    /// The ground as it saw it, for coarse registration; `None` where that cannot be made.
    pub fn view(&self, registration: &CoarseRegistration) -> Option<&GroundView> {
        if self.view.get().is_none() {
            let view = registration.view(&self.pyramid, self.mask.as_deref(), &self.pose)?;
            return Some(self.view.get_or_init(|| view));
        }
        self.view.get()
    }

    /// Covariance of height, roll and pitch.
    pub fn rig_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(3, 3).into_owned()
    }

    /// What a frame measured against it tells of its errors: what is learned of height and tilt
    /// also corrects the place, as far as their errors are correlated.
    pub fn improved_by(&self, frame: &MotionEstimate) -> KeyframeUpdate {
        let (covariance, model_covariance) = (self.covariance, self.model_covariance);
        let unchanged = KeyframeUpdate { moved: Vector6::zeros(), covariance, model_covariance };
        let Some(error) = &frame.keyframe_error else { return unchanged };
        let before = self.rig_covariance();
        let Some(information) = before.try_inverse() else { return unchanged };
        let by_rig = self.covariance.fixed_view::<6, 3>(0, 3) * information;
        let removed = before - error.covariance;
        let covariance = self.covariance - by_rig * removed * by_rig.transpose();
        // I − K H of the Kalman filter.
        let mut remaining = Matrix6::identity();
        let mut of_rig = remaining.fixed_view_mut::<6, 3>(0, 3);
        of_rig -= by_rig * removed * information;
        KeyframeUpdate {
            moved: by_rig * error.mean,
            covariance: 0.5 * (covariance + covariance.transpose()),
            model_covariance: propagated(&remaining, &self.model_covariance),
        }
    }

    /// Covariance of the pose of a frame relative to this keyframe. The fit is conditional on the
    /// keyframe's height, tilt and skew, which are uncertain themselves; where scale is free, the
    /// metres are those at the keyframe's height, whatever that is.
    pub fn relative_covariance(&self, frame: &MotionEstimate, model: MotionModel) -> Matrix6<f64> {
        let KeyframeUpdate { covariance, model_covariance, .. } = self.improved_by(frame);
        let improved = covariance + model_covariance;
        let of = if model.scale_is_free() { ROLL..ROLL + 2 } else { HEIGHT..ROLL + 2 };
        let mut uncertain = Matrix6::zeros();
        let (at, size) = ((of.start, of.start), (of.len(), of.len()));
        uncertain.view_mut(at, size).copy_from(&improved.view(at, size));
        let own = frame.covariance + frame.model_covariance;
        own + propagated(&frame.by_keyframe, &uncertain) + self.covariance_by_skew(frame)
    }

    /// What the uncertain skew of this keyframe adds to the covariance of a frame's pose.
    pub fn covariance_by_skew(&self, frame: &MotionEstimate) -> Matrix6<f64> {
        let Some(seen) = &frame.shutter else { return Matrix6::zeros() };
        let variance = self.rate_variance * self.shutter.readout_s.powi(2);
        propagated(&seen.pose_by_keyframe_skew, &Matrix6::from_diagonal(&variance))
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
}

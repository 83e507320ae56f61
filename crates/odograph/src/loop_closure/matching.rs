//! Registration of one keyframe in the image of another, which verifies loop closures: the tracker
//! and the planar pose estimation of odometry, and the coarse registration of its relocalisation.

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPose, Ray};
use crate::image::{GrayImage, Pyramid};
use crate::keyframe::GroundInView;
use crate::keyframe::relative_pose::{compose, motion_covariance, relative_motion};
use crate::loop_closure::overlap::{OverlapGrid, RegisteredImage};
use crate::motion::MotionEstimate;
use crate::motion::ViewingPose;
use crate::motion::dense::{self, DenseEstimate, DenseImage};
use crate::motion::{CoarseOptions, CoarseRegistration, GroundView, Random};
use crate::odometry::OdometryConfig;
use crate::odometry::keyframe::{GRID, Keyframe, image_grid, overlap};
use crate::odometry::learned::Learned;
use crate::odometry::tracking::{Measurement, Tracker};
use crate::place_recognition::{PlacesConfig, Signature};
use nalgebra::{Matrix3, Matrix4, Matrix6, Vector4};
use std::sync::Arc;

/// Index of a camera of the map, in the order in which they were added; 0 is that of
/// the first session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CameraIndex(usize);

/// A pose, the camera that is there, and the ground that it sees.
#[derive(Debug, Clone, Copy)]
pub struct CameraPose {
    pub camera: CameraIndex,
    pub pose: GroundPose,
    /// `None` where that is the plane z = 0, or not known.
    pub ground: Option<GroundInView>,
}

impl CameraPose {
    /// Height, roll and pitch over the ground in view, at the origin.
    fn over_ground(&self) -> GroundPose {
        self.ground.map_or(at_origin(&self.pose), |ground| ground.camera)
    }

    /// The motion to a pose in the frame of the plane in view.
    fn motion_to(&self, there: &GroundPose) -> Vector4<f64> {
        let here = at_origin(&self.pose);
        let Some(ground) = &self.ground else { return relative_motion(&here, there) };
        let there = ground.plane_from_ground(&self.pose).inverse() * there.world_from_camera();
        relative_motion(&here, &GroundPose::from_world_from_camera(&there))
    }

    /// Elevations about the plane in view over the height: the parallax of a metre of motion.
    fn unevenness(&self) -> f64 {
        self.ground.map_or(0.0, |ground| ground.relief_m / ground.camera.height_m)
    }
}

/// The query: a keyframe whose corners are searched for.
#[derive(Debug)]
pub struct QueryKeyframe {
    at: CameraPose,
    /// At the origin, over the ground in view.
    keyframe: Keyframe,
}

/// The reference: a keyframe in whose image they are searched for.
#[derive(Debug)]
pub struct ReferenceKeyframe {
    at: CameraPose,
    pyramid: Pyramid,
    /// Height, roll and pitch over the ground in view.
    pose: GroundPose,
    mask: Option<Arc<ImageMask>>,
    view: Option<GroundView>,
}

/// The relative pose of two keyframes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopSighting {
    /// As [`crate::keyframe::MapEdge::motion`].
    pub motion: Vector4<f64>,
    pub covariance: Matrix4<f64>,
    /// Pose of the reference's camera in the frame of the plane that the query sees, height and
    /// tilt as measured here.
    pub pose: GroundPose,
    /// Number of inliers, and their share of the corners that should be in view.
    pub inliers: usize,
    pub inlier_ratio: f64,
}

/// A hypothesis of the relative pose, from registration of whole images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Guess {
    pub motion: Vector4<f64>,
    pub score: f64,
}

/// Registers keyframes with each other.
#[derive(Debug)]
pub struct Matcher {
    cameras: Vec<MatcherCamera>,
    config: OdometryConfig,
}

/// What depends on the camera.
#[derive(Debug)]
struct MatcherCamera {
    camera: Camera,
    config: OdometryConfig,
    registration: CoarseRegistration,
    rays: [Option<Ray>; GRID * GRID],
}

impl MatcherCamera {
    fn new(camera: &Camera, config: &OdometryConfig) -> Self {
        Self {
            camera: camera.clone(),
            config: config.for_camera(camera),
            registration: CoarseRegistration::new(camera),
            rays: image_grid(camera),
        }
    }
}

impl Matcher {
    pub fn new(camera: &Camera, config: &OdometryConfig) -> Self {
        Self { cameras: vec![MatcherCamera::new(camera, config)], config: *config }
    }

    /// The index of a camera; one that is not known yet is added.
    pub fn index_of(&mut self, camera: &Camera) -> CameraIndex {
        let known = self.cameras.iter().position(|known| known.camera == *camera);
        CameraIndex(known.unwrap_or_else(|| {
            self.cameras.push(MatcherCamera::new(camera, &self.config));
            self.cameras.len() - 1
        }))
    }

    fn of(&self, camera: CameraIndex) -> &MatcherCamera {
        &self.cameras[camera.0]
    }

    /// The signature of a query for place recognition.
    pub fn signature(&self, query: &QueryKeyframe, config: &PlacesConfig) -> Signature {
        let QueryKeyframe { at: CameraPose { camera, .. }, keyframe } = query;
        let mask = keyframe.mask.as_deref();
        Signature::of(&keyframe.pyramid, &self.of(*camera).camera, mask, &keyframe.pose, config)
    }

    /// Prepares a query keyframe with its height, roll and pitch. What the mask covers is no
    /// evidence of a place.
    pub fn query(&self, image: GrayImage, at: &CameraPose, mask: Option<&Arc<ImageMask>>) -> QueryKeyframe {
        let pyramid = Pyramid::new(image, self.config.flow.levels);
        QueryKeyframe {
            at: *at,
            keyframe: Keyframe::new(
                pyramid,
                at.over_ground(),
                Matrix6::zeros(),
                mask,
                &self.of(at.camera).camera,
                &self.config.detection,
            ),
        }
    }

    /// Prepares a reference keyframe with its height, roll and pitch. What the mask covers is no
    /// evidence of a place.
    pub fn reference(
        &self,
        image: GrayImage,
        at: &CameraPose,
        mask: Option<&Arc<ImageMask>>,
    ) -> ReferenceKeyframe {
        let pyramid = Pyramid::new(image, self.config.flow.levels);
        let (pose, mask) = (at.over_ground(), mask.cloned());
        ReferenceKeyframe { at: *at, pyramid, pose, mask, view: None }
    }

    /// The overlap: the share of a keyframe's view, with height, roll and pitch of `from`, that is
    /// in view of one with those of `to` at `motion`.
    pub fn overlap(&self, from: &CameraPose, to: &CameraPose, motion: &Vector4<f64>) -> f64 {
        let there = ViewingPose::new(self.placed(from, to, motion));
        overlap(&from.over_ground(), &self.of(from.camera).rays, &self.of(to.camera).camera, &there)
    }

    /// The pose of a camera `to` at `motion` from `from`, in the frame of the plane that `from`
    /// sees, with height and tilt of `to`: over the ground that it sees, where both know theirs.
    /// Where heights drift, the height is the measured one.
    fn placed(&self, from: &CameraPose, to: &CameraPose, motion: &Vector4<f64>) -> GroundPose {
        let with_tilt_of = |there: GroundPose, to: &GroundPose| {
            let height_m = if self.scale_is_free() { there.height_m } else { to.height_m };
            GroundPose { height_m, roll_rad: to.roll_rad, pitch_rad: to.pitch_rad, ..there }
        };
        let there = with_tilt_of(compose(&at_origin(&from.pose), motion, 1.0), &to.pose);
        let Some(ground) = &from.ground else { return there };
        let there = ground.plane_from_ground(&from.pose) * there.world_from_camera();
        let there = GroundPose::from_world_from_camera(&there);
        to.ground.map_or(there, |own| with_tilt_of(there, &own.camera))
    }

    fn scale_is_free(&self) -> bool {
        self.config.motion.model.scale_is_free()
    }

    /// Metres on the ground that a pixel in the middle of an image covers.
    pub fn pixel_m(&self, at: &CameraPose) -> f64 {
        at.pose.height_m / self.of(at.camera).camera.focal_px().0
    }

    /// The shorter side of the ground in view, metres.
    pub fn view_m(&self, at: &CameraPose) -> f64 {
        let camera = &self.of(at.camera).camera;
        self.pixel_m(at) * camera.width().min(camera.height()) as f64
    }

    /// Tracks a keyframe's corners into the image of another, predicted at `motion` with an error
    /// of at most `off_px` in the image. `None` if too few are found.
    pub fn find(
        &self,
        query: &QueryKeyframe,
        reference: &ReferenceKeyframe,
        motion: &Vector4<f64>,
        off_px: f64,
    ) -> Option<LoopSighting> {
        let keyframe = &query.keyframe;
        let prediction = self.predicted(query, reference, motion);
        let MatcherCamera { camera, config, .. } = self.of(reference.at.camera);
        if reference.at.camera != query.at.camera {
            // The tracker would make it with the camera of the image in which it looks.
            keyframe.dense(&self.of(query.at.camera).camera);
        }
        // Height and tilt of both are known; the prior widens if the recording contradicts it.
        let learned = Learned::new(&prediction);
        let tracker = Tracker { keyframe, pyramid: &reference.pyramid, camera, config, learned: &learned };
        let mut random = Random::new(0);
        let first = tracker.measure_near(&prediction, off_px, &mut random).ok()?;
        let found = tracker.confirm(first, &mut random);
        // On a rigid mount, a match that needs another height or tilt is unreliable.
        let still = has_equal_tilt(&keyframe.pose, &reference.pose, STILL);
        if still && !has_equal_tilt(&prediction, &found.estimate.pose, CONTRADICTING) {
            return None;
        }
        let inlier_ratio = found.inlier_ratio(keyframe, camera);
        let inliers = found.estimate.inlier_count();
        let whole =
            if found.agreement.is_none() { self.refined(query, reference, &found, &learned) } else { None };
        let estimate = whole.unwrap_or(found.estimate);
        let off_px = if still { UNMODELLED_PX } else { UNMODELLED_MOVING_PX };
        let unevenness = query.at.unevenness().hypot(reference.at.unevenness());
        self.sighting(query, &estimate, (inliers, inlier_ratio), off_px, unevenness)
    }

    /// Pose of a reference in the frame of the plane that the query sees, if it is at `motion`.
    pub fn predicted(
        &self,
        query: &QueryKeyframe,
        reference: &ReferenceKeyframe,
        motion: &Vector4<f64>,
    ) -> GroundPose {
        self.placed(&query.at, &reference.at, motion)
    }

    /// The ground that the images of the query and of a reference, registered at `pose`, both show.
    pub fn overlap_grid(
        &self,
        query: &QueryKeyframe,
        reference: &ReferenceKeyframe,
        pose: &GroundPose,
    ) -> OverlapGrid {
        let QueryKeyframe { at: CameraPose { camera, .. }, keyframe } = query;
        let here = RegisteredImage {
            camera: &self.of(*camera).camera,
            pyramid: &keyframe.pyramid,
            pose: keyframe.pose,
            mask: keyframe.mask.as_deref(),
        };
        let there = RegisteredImage {
            camera: &self.of(reference.at.camera).camera,
            pyramid: &reference.pyramid,
            pose: *pose,
            mask: reference.mask.as_deref(),
        };
        OverlapGrid::new(&here, &there)
    }

    /// The pose from dense registration of the overlap, if the corners are less certain than the
    /// unmodelled error of lens and interpolation: on faint or noisy images. `None` if they are
    /// more certain, or if the dense registration contradicts them.
    fn refined(
        &self,
        query: &QueryKeyframe,
        reference: &ReferenceKeyframe,
        found: &Measurement,
        learned: &Learned,
    ) -> Option<MotionEstimate> {
        let keyframe = &query.keyframe;
        let MatcherCamera { camera, config, .. } = self.of(reference.at.camera);
        let motion = &config.motion;
        let corners = &found.estimate;
        let spread = |estimate: &MotionEstimate| estimate.covariance[(0, 0)] + estimate.covariance[(1, 1)];
        let pixel_m = self.pixel_m(&query.at);
        if spread(corners) < 2.0 * (UNMODELLED_PX * pixel_m).powi(2) {
            return None;
        }
        let image = DenseImage::new(reference.pyramid.base()).without(reference.mask.clone());
        let prior = learned.rig_prior.prior(&found.prediction, motion);
        let reference = keyframe.dense(&self.of(query.at.camera).camera);
        let whole =
            dense::refine(camera, (reference, &Matrix3::zeros()), &image, &corners.pose, &prior, motion)?;
        let off_m = whole.estimate.pose.distance_m(&corners.pose);
        let is_significant = whole.score >= DenseEstimate::LEAST_SCORE
            && whole.agreement >= DenseEstimate::LEAST_AGREEMENT
            && off_m < pixel_m
            && has_equal_tilt(&corners.pose, &whole.estimate.pose, CONTRADICTING);
        (is_significant && spread(&whole.estimate) < spread(corners)).then_some(whole.estimate)
    }

    /// The sighting of a keyframe, with the number and the share of its corners that were found,
    /// over ground off its plane by this part of the height.
    fn sighting(
        &self,
        query: &QueryKeyframe,
        estimate: &MotionEstimate,
        (inliers, inlier_ratio): (usize, f64),
        off_px: f64,
        unevenness: f64,
    ) -> Option<LoopSighting> {
        let (keyframe, pose) = (&query.keyframe, &estimate.pose);
        let parallax_m = unevenness * pose.distance_m(&keyframe.pose);
        let off_m2 = (off_px * self.pixel_m(&query.at)).powi(2) + parallax_m * parallax_m;
        let off_rad2 = off_m2 / (0.5 * self.view_m(&query.at)).powi(2);
        let unmodelled = Matrix4::from_diagonal(&Vector4::new(off_m2, off_m2, off_rad2, 0.0));
        let sighting = LoopSighting {
            motion: query.at.motion_to(pose),
            covariance: motion_covariance(&keyframe.pose, pose, &estimate.covariance) + unmodelled,
            pose: *pose,
            inliers,
            inlier_ratio,
        };
        sighting.motion.iter().all(|value| value.is_finite()).then_some(sighting)
    }

    /// Hypotheses of the relative pose from registration of the whole images, the best first; the
    /// heading is within `heading_off_rad` of that of `motion`.
    pub fn guess(
        &self,
        query: &QueryKeyframe,
        reference: &mut ReferenceKeyframe,
        motion: &Vector4<f64>,
        heading_off_rad: f64,
    ) -> Vec<Guess> {
        if query.at.camera != reference.at.camera {
            // Views of different cameras differ in size and resolution.
            return Vec::new();
        }
        let registration = &self.of(query.at.camera).registration;
        if reference.view.is_none() {
            reference.view =
                registration.view(&reference.pyramid, reference.mask.as_deref(), &reference.pose);
        }
        let (Some(from), Some(to)) = (query.keyframe.view(registration), &reference.view) else {
            return Vec::new();
        };
        let options = CoarseOptions {
            heading_rad: (motion[2], heading_off_rad),
            scale_free: self.scale_is_free(),
            ..Default::default()
        };
        let here = &query.keyframe.pose;
        let guess = |hypothesis: crate::motion::Hypothesis| Guess {
            motion: query.at.motion_to(&hypothesis.pose(here, &reference.pose)),
            score: hypothesis.score,
        };
        registration.register(from, to, &options).into_iter().map(guess).collect()
    }
}

/// Standard deviation of the unmodelled error of lens and interpolation under shift and rotation,
/// pixels. Measured on rendered drives: 0.02 on a rigid mount. If height and tilt vary, each
/// keyframe knows its own to 1e-4, which looks like a shift.
const UNMODELLED_PX: f64 = 0.03;
const UNMODELLED_MOVING_PX: f64 = 0.1;

/// Differences of height (relative) and tilt (radians) between two keyframes. Below `STILL` the
/// mount is rigid, and an estimate that differs from it by more than `CONTRADICTING` is wrong.
/// Without the second, a match of a quarter of the image took 0.27 % off the height on a rendered
/// carpet.
const STILL: f64 = 3e-4;
const CONTRADICTING: f64 = 1e-3;

/// Whether two poses have the same height, roll and pitch within `most`, relative to the height and
/// in radians.
fn has_equal_tilt(a: &GroundPose, b: &GroundPose, most: f64) -> bool {
    let height = (a.height_m / b.height_m - 1.0).abs();
    height.max((a.roll_rad - b.roll_rad).abs()).max((a.pitch_rad - b.pitch_rad).abs()) < most
}

fn at_origin(pose: &GroundPose) -> GroundPose {
    GroundPose { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, ..*pose }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;
    use crate::simulation::{Ground, Renderer, Texture};

    #[test]
    fn a_keyframe_full_of_noise_is_found_by_all_of_its_pixels() {
        let lens = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap();
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), lens).unwrap();
        let renderer = Renderer::new(&camera);
        let matcher = Matcher::new(&camera, &OdometryConfig::default());
        let ground = Ground::new(Texture::Carpet, renderer.footprint_m(0.75), false, 9).unwrap();
        let mut random = Random::new(4);
        let mut picture = |pose: &GroundPose| {
            let mut image = renderer.gray_view(&ground, pose);
            for sample in image.samples_mut() {
                // The sum of four uniform numbers deviates by 0.577 of their width: 10 gray levels
                // of noise.
                let noise: f64 = (0..4).map(|_| random.below(1 << 16) as f64 / 65536.0 - 0.5).sum();
                *sample = (f64::from(*sample) + 10.0 / 0.577 * noise).round().clamp(0.0, 255.0) as u8;
            }
            image
        };
        let mut squares_m2 = Vec::new();
        for number in 0..10 {
            let turn = f64::from(number);
            let here = GroundPose { x_m: 2.0 * turn, heading_rad: 0.9 * turn, ..GroundPose::level(0.75) };
            let (sin, cos) = (1.3 * turn).sin_cos();
            let heading_rad = 2.6 * turn;
            let there = GroundPose { x_m: here.x_m + 0.2 * cos, y_m: 0.2 * sin, heading_rad, ..here };
            let at = |pose: GroundPose| CameraPose { camera: CameraIndex::default(), pose, ground: None };
            let query = matcher.query(picture(&here), &at(here), None);
            let reference = matcher.reference(picture(&there), &at(there), None);
            let truth = relative_motion(&here, &there);
            let expected = truth + Vector4::new(0.004 * cos, -0.004 * sin, 0.006 * sin, 0.0);
            let found = matcher.find(&query, &reference, &expected, 8.0).expect("in view");
            squares_m2.push((found.motion - truth).xy().norm_squared());
        }
        // Corners alone have an error of 0.4 mm, a seventh of a pixel; dense registration 0.17 mm.
        let off_m = (squares_m2.iter().sum::<f64>() / squares_m2.len() as f64).sqrt();
        assert!(off_m < 0.28e-3, "{off_m}");
    }
}

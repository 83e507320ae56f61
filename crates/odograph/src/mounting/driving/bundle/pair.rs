//! One pair of views in the bundle adjustment.

use super::lens::{self, LensUnknowns};
use super::{MIN_INLIERS, ROBUST_ITERATIONS};
use crate::camera::Camera;
use crate::camera::PosedCamera;
use crate::geometry::{GroundPoint, GroundPose, Ray};
use crate::motion::{PoseRates, RollingShutter};
use crate::mounting::driving::{PairedTrack, ViewPair};
use crate::numerics::{Loss, RAYLEIGH_MEDIAN, TUKEY_95, median};
use nalgebra::{Vector2, Vector6};

/// Motion of the camera between two views: x, y (heights), turn (radians), change of height
/// (heights), change of roll and pitch (radians). A rigid mount leaves the last three at zero.
pub type Movement = Vector6<f64>;

/// Lower bound of the noise, pixels: neighbouring tracks share errors of about this size.
const MIN_NOISE_PX: f64 = 0.01;

/// The ray of a corner and its derivative by each distortion parameter.
pub struct CornerRay {
    pub ray: Ray,
    pub by_lens: [Vector2<f64>; lens::MAX_PARAMETERS],
}

/// The two views of a pair under a rolling shutter.
pub struct Views<'a> {
    camera: &'a Camera,
    /// Poses of the middle rows.
    poses: [GroundPose; 2],
    shutters: [RollingShutter; 2],
    /// The camera in the middle rows.
    global: [PosedCamera<'a>; 2],
}

impl<'a> Views<'a> {
    /// The pose of a row of a view, 0 or 1.
    pub fn pose(&self, view: usize, y: f64) -> GroundPose {
        self.shutters[view].pose_at(&self.poses[view], y)
    }

    /// The camera in a row of a view.
    pub fn posed(&self, view: usize, y: f64) -> PosedCamera<'a> {
        if self.shutters[view].readout_s == 0.0 {
            return self.global[view];
        }
        PosedCamera::new(self.camera, self.pose(view, y))
    }
}

/// Over shorter distances, heights, the ratio to the odometry's distance is mostly noise.
const MIN_DISTANCE: f64 = 0.05;

/// A pair and its present estimate.
pub struct SolvedPair<'a> {
    pub pair: &'a ViewPair,
    /// The tracks' corners in the first view.
    pub corners: Vec<Option<CornerRay>>,
    pub group: usize,
    pub movement: Movement,
    pub weights: Vec<f64>,
    pub variance_px2: f64,
}

impl<'a> SolvedPair<'a> {
    /// The planar motion that best aligns the ground points of the inliers of the odometry
    /// (Umeyama, "Least-squares estimation of transformation parameters", 1991, without scale).
    pub fn begin(lens: &LensUnknowns, group: usize, pair: &'a ViewPair, rig: &GroundPose) -> Option<Self> {
        let camera = lens.camera();
        let on_ground = |pixel| camera.ray_from_pixel(pixel).and_then(|ray| rig.ground_from_ray(ray));
        let agreeing: Vec<(GroundPoint, GroundPoint)> = pair
            .tracks
            .iter()
            .filter(|track| track.agrees)
            .filter_map(|track| Some((on_ground(track.first)?, on_ground(track.second)?)))
            .collect();
        if (agreeing.len() as f64) < MIN_INLIERS {
            return None;
        }
        let n = agreeing.len() as f64;
        let mean = agreeing.iter().fold([0.0; 4], |m, (a, b)| {
            [m[0] + a.x_m / n, m[1] + a.y_m / n, m[2] + b.x_m / n, m[3] + b.y_m / n]
        });
        let (mut along, mut across) = (0.0, 0.0);
        for (a, b) in &agreeing {
            let (ax, ay, bx, by) = (a.x_m - mean[0], a.y_m - mean[1], b.x_m - mean[2], b.y_m - mean[3]);
            along += ax * bx + ay * by;
            across += ay * bx - ax * by;
        }
        // The ground turns in the opposite sense to the camera.
        let turn_rad = across.atan2(along);
        let (sin, cos) = turn_rad.sin_cos();
        let movement = Vector6::new(
            mean[0] - cos * mean[2] + sin * mean[3],
            mean[1] - sin * mean[2] - cos * mean[3],
            turn_rad,
            0.0,
            0.0,
            0.0,
        );
        let weights = vec![1.0; pair.tracks.len()];
        let mut solved = Self { pair, corners: Vec::new(), group, movement, weights, variance_px2: 1.0 };
        solved.update_rays(lens);
        solved.reweight(lens.camera(), rig, 0);
        Some(solved)
    }
}

impl SolvedPair<'_> {
    /// Updates the corners' rays with the present lens.
    pub fn update_rays(&mut self, lens: &LensUnknowns) {
        let corner = |pixel| {
            let ray = lens.camera().ray_from_pixel(pixel)?;
            Some(CornerRay { ray, by_lens: lens.ray_by_lens(ray)? })
        };
        self.corners = self.pair.tracks.iter().map(|track| corner(track.first)).collect();
    }

    /// The pose of the second view.
    pub fn second_pose(&self, rig: &GroundPose) -> GroundPose {
        GroundPose {
            x_m: self.movement[0],
            y_m: self.movement[1],
            heading_rad: self.movement[2],
            height_m: rig.height_m + self.movement[3],
            roll_rad: rig.roll_rad + self.movement[4],
            pitch_rad: rig.pitch_rad + self.movement[5],
        }
    }

    /// The two views with their rolling shutter.
    pub fn views<'b>(&self, camera: &'b Camera, rig: &GroundPose) -> Views<'b> {
        let poses = [*rig, self.second_pose(rig)];
        let readout_s = camera.readout_s().unwrap_or(0.0);
        let mut shutters = [RollingShutter::new(camera, readout_s, PoseRates::zeros()); 2];
        if let Some(exposure) = &self.pair.exposure {
            let moved = self.movement[0].hypot(self.movement[1]);
            let scale = if exposure.distance > MIN_DISTANCE { moved / exposure.distance } else { 1.0 };
            let scaled = |r: PoseRates| PoseRates::new(scale * r[0], scale * r[1], r[2], r[3], r[4], r[5]);
            for (view, shutter) in shutters.iter_mut().enumerate() {
                shutter.rates = scaled(exposure.rates[view]);
                shutter.accelerations = scaled(exposure.accelerations[view]);
            }
        }
        let global = poses.map(|pose| PosedCamera::new(camera, pose));
        Views { camera, poses, shutters, global }
    }

    /// The number of coordinates that count.
    pub fn coordinates(&self) -> f64 {
        let tracks = self.pair.tracks.iter().zip(&self.weights);
        tracks.filter(|(_, weight)| **weight > 0.0).map(|(track, weight)| weight * track.coordinates()).sum()
    }

    /// Updates the robust weights and the noise from the present residuals.
    pub fn reweight(&mut self, camera: &Camera, rig: &GroundPose, iteration: usize) {
        let views = self.views(camera, rig);
        let errors: Vec<f64> = self
            .pair
            .tracks
            .iter()
            .zip(&self.corners)
            .map(|(track, corner)| {
                let PairedTrack { first, second, whitening, .. } = track;
                let ray = corner.as_ref().map(|corner| corner.ray);
                ray.and_then(|ray| views.pose(0, first.y).ground_from_ray(ray))
                    .and_then(|ground| views.pose(1, second.y).ray_from_ground(ground))
                    .and_then(|ray| camera.pixel_from_ray(ray))
                    .map_or(f64::INFINITY, |pixel| {
                        (whitening * Vector2::new(second.x - pixel.x, second.y - pixel.y)).norm()
                    })
            })
            .collect();
        if iteration > ROBUST_ITERATIONS {
            let squares: f64 =
                errors.iter().zip(&self.weights).filter(|(_, w)| **w > 0.0).map(|(e, _)| e * e).sum();
            self.variance_px2 =
                (squares / (self.coordinates() - 3.0).max(1.0)).max(MIN_NOISE_PX * MIN_NOISE_PX);
            return;
        }
        let median_px = median(&mut errors.clone()).unwrap_or(f64::INFINITY);
        let scale_px = (median_px / RAYLEIGH_MEDIAN).max(MIN_NOISE_PX);
        if !scale_px.is_finite() {
            self.weights.fill(0.0);
            return;
        }
        let reach_px = scale_px * if iteration < ROBUST_ITERATIONS { TUKEY_95 } else { CUTOFF_SIGMAS };
        let weight = |error: f64| match iteration {
            ROBUST_ITERATIONS => f64::from(u8::from(error < reach_px)),
            _ => Loss::Tukey(1.0).weight_of_square((error / reach_px).powi(2)),
        };
        self.weights = errors.iter().map(|&error| weight(error)).collect();
        self.variance_px2 = scale_px * scale_px;
    }
}

/// Residual above which a track is an outlier, in σ of a coordinate; 2 in 1000 inliers exceed it.
const CUTOFF_SIGMAS: f64 = 3.5;

//! The re-projection error of a track whose corner and whose image are each seen from the pose of
//! their row.

use super::frames::{WindowTrack, unit};
use super::spline::State;
use crate::camera::Camera;
use crate::geometry::{GroundPose, Ray};
use crate::motion::{Axes, Elevation, Observation, PoseRates, RollingShutter, ground_by_pose, residual};
use nalgebra::Vector3;

/// Numbers that determine the poses of the rows of a frame and of its keyframe: pose, rate and
/// acceleration of both, and the readout time.
pub const LOCAL: usize = 37;
pub const KEYFRAME: usize = 18;
pub const READOUT: usize = 36;

/// A re-projection error, whitened, pixels, and its derivatives by [`LOCAL`] numbers.
pub struct TrackResidual {
    pub error: [f64; 2],
    pub rows: [[f64; LOCAL]; 2],
    /// Derivative by the elevation of the corner, heights.
    pub by_elevation: [f64; 2],
}

/// Step of the elevation for its derivative, heights.
const STEP: f64 = 1e-4;

impl TrackResidual {
    /// Of a track in rows of its frame and of its keyframe, which move as `states` say; its corner
    /// has an elevation, in heights.
    pub fn new(
        camera: &Camera,
        track: &WindowTrack,
        readout_s: f64,
        states: [&State; 2],
        (elevation, height_m): (f64, f64),
    ) -> Option<Self> {
        let shutter = RollingShutter::new(camera, readout_s, PoseRates::zeros());
        let at = |[pose, rates, accelerations]: &State, y: f64| {
            let (rates, accelerations) = (*rates, *accelerations);
            RollingShutter { rates, accelerations, ..shutter }.pose_at(&GroundPose::from_vector(pose), y)
        };
        let (pose, keyframe) = (at(states[0], track.pixel.y), at(states[1], track.corner.y));
        let ray: Ray = camera.ray_from_pixel(track.corner)?;
        let at_elevation = |elevation: f64| {
            Some(Observation {
                ground: GroundPose { height_m: keyframe.height_m - elevation * height_m, ..keyframe }
                    .ground_from_ray(ray)?,
                elevation: Elevation { mean_m: elevation * height_m, variance_m2: 0.0 },
                pixel: track.pixel,
                whitening: track.whitening,
                row_fraction: 0.0,
                keyframe_row_fraction: 0.0,
                centre_of_projection: Vector3::zeros(),
                corrected_at_m: 0.0,
            })
        };
        let axes = Axes::new(&pose);
        let observation = at_elevation(elevation)?;
        let seen = residual(camera, &observation, &pose, &axes)?;
        let moved = residual(camera, &at_elevation(elevation + STEP)?, &pose, &axes)?;
        let by_elevation = [0, 1].map(|k| (moved.error[k] - seen.error[k]) / STEP);
        let ground = ground_by_pose(&observation, &keyframe, &Axes::new(&keyframe));
        let mut rows = [[0.0; LOCAL]; 2];
        for (row, by_pose) in rows.iter_mut().zip(&seen.by_pose) {
            for i in 0..6 {
                // The ground moves against the camera.
                let by_keyframe = -by_pose[0] * ground[0][i] - by_pose[1] * ground[1][i];
                let both = [(by_pose[i], track.pixel.y), (by_keyframe, track.corner.y)];
                for (part, (derivative, y)) in both.into_iter().enumerate() {
                    let time_s = shutter.row_time_s(y);
                    let [_, rates, accelerations] = states[part];
                    let rate = rates[i] + time_s * accelerations[i];
                    row[READOUT] += derivative * rate * shutter.row_fraction(y);
                    for (order, factor) in [1.0, time_s, 0.5 * time_s * time_s].into_iter().enumerate() {
                        row[part * KEYFRAME + 6 * order + i] = factor * derivative * unit(i, height_m);
                    }
                }
            }
        }
        Some(Self { error: seen.error, rows, by_elevation })
    }
}

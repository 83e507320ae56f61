//! Path of the carrier: the camera's path, low-pass filtered to remove vibration.

use super::SmoothedFrame;
use super::coordinate::{Measured, smooth_coordinate};
use crate::camera::Rig;
use crate::pose_frame::PoseFrames;
use crate::trajectory::StampedPose;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// Cutoff frequency between the carrier's motion and the camera's vibration, hertz.
///
/// Wheeled carriers and people steer below 1 Hz; vehicle bodies, masts and engines vibrate at 4 Hz
/// and more.
pub const CARRIER_CUTOFF_HZ: f64 = 2.0;

/// Estimates the path of the carrier, low-pass filtered at [`CARRIER_CUTOFF_HZ`]: level, with x
/// along its forward direction. With a lever arm it is the path of `base_link`
/// ([`crate::pose_frame`]), at its nominal height; without one, that of the ground point below the
/// camera (z = 0), its heading less the mount yaw.
///
/// The filter is a quintic smoothing spline (G. Wahba, "Spline models for observational data",
/// 1990), which equals the fixed-interval smoother for white jerk of spectral density `ω⁶` and
/// measurement noise of density 1. Its zero-phase gain at angular frequency w is 1 / (1 + (w /
/// ω)⁶).
#[derive(Debug)]
pub struct Carrier {
    of: PoseFrames,
    /// What is still to be subtracted from the heading, radians.
    yaw_rad: f64,
    z_m: f64,
    times_s: Vec<f64>,
    /// x, y (metres) and heading (radians).
    axes: [Vec<f64>; 3],
}

impl Carrier {
    /// An empty path of what carries a camera mounted like this, with capacity for `frames` frames.
    pub fn for_frames(rig: &Rig, frames: usize) -> Self {
        let axes = [(); 3].map(|()| Vec::with_capacity(frames));
        let (yaw_rad, z_m) = match rig.lever_arm {
            Some(arm) => (0.0, rig.height_m - arm.z_m),
            None => (rig.yaw_rad, 0.0),
        };
        Self { of: PoseFrames::of_carrier(rig), yaw_rad, z_m, times_s: Vec::with_capacity(frames), axes }
    }

    /// The tilt of the mount is that of another rig from a frame on, which is later than those of
    /// earlier calls.
    pub fn recalibrate(&mut self, frame: u64, rig: &Rig) {
        self.of.recalibrate(frame, rig);
    }

    /// Whose path it is: `base_link`'s, where the rig has a lever arm.
    pub fn of(&self) -> &PoseFrames {
        &self.of
    }

    /// Appends the next frame of the camera's path.
    pub fn push(&mut self, frame: &SmoothedFrame) {
        let pose = frame.seen_as(self.of.at(frame.frame)).pose;
        self.times_s.push(frame.time_s);
        for (axis, value) in self.axes.iter_mut().zip([pose.x_m, pose.y_m, pose.heading_rad]) {
            axis.push(value);
        }
    }

    /// The filtered pose of the carrier at each frame. Frames with a repeated timestamp are
    /// dropped.
    pub fn path(self) -> impl Iterator<Item = StampedPose> {
        let Self { yaw_rad, z_m, times_s, axes, .. } = self;
        let axes = axes.map(|values| without_shaking(&times_s, values));
        let mut before_s = f64::NEG_INFINITY;
        (0..times_s.len()).filter_map(move |i| {
            if times_s[i] <= before_s {
                return None;
            }
            before_s = times_s[i];
            let [x_m, y_m, heading_rad] = axes.each_ref().map(|axis| axis[i]);
            let forward = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad - yaw_rad);
            let world_from_camera = Isometry3::from_parts(Translation3::new(x_m, y_m, z_m), forward);
            Some(StampedPose { time_s: times_s[i], world_from_camera })
        })
    }
}

/// Spectral density of the measurement noise. Its value is uncritical as long as the noise is small
/// compared with speeds of metres per second.
const NOISE_DENSITY: f64 = 1e-6;

fn without_shaking(times_s: &[f64], values: Vec<f64>) -> Vec<f64> {
    let last = times_s.len().saturating_sub(1);
    let measured = |(i, value): (usize, f64)| {
        let around = (i.saturating_sub(1), (i + 1).min(last));
        // Each sample has the weight of the time interval between the midpoints to its neighbours.
        let spacing_s = (times_s[around.1] - times_s[around.0]) / (around.1 - around.0).max(1) as f64;
        Some((value, NOISE_DENSITY / spacing_s.max(1e-6)))
    };
    let measured: Vec<Measured> = values.into_iter().enumerate().map(measured).collect();
    let density = NOISE_DENSITY * (TAU * CARRIER_CUTOFF_HZ).powi(6);
    let smoothed = smooth_coordinate(times_s, &measured, |_| density);
    smoothed.into_iter().map(|smoothed| smoothed.state[0]).collect()
}

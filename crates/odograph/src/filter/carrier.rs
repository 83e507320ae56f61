//! The way of the carrier: that of the camera without its shaking.

use super::SmoothedFrame;
use super::coordinate::{Measured, smooth_coordinate};
use crate::camera::Rig;
use crate::trajectory::{StampedPose, Trajectory};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// Movements that repeat faster than this are the camera's shaking, slower ones are the carrier's way; hertz.
///
/// Wheeled carriers and people steer below 1 Hz; bodies on wheels, masts and engines shake at 4 Hz and more.
pub const CARRIER_CUTOFF_HZ: f64 = 2.0;

/// The path of the carrier: the point of the ground below the camera and the carrier's forward (the rig's yaw taken off), on level ground,
/// z = 0, without what shakes faster than [`CARRIER_CUTOFF_HZ`].
///
/// A smoothing spline of fifth degree (G. Wahba, "Spline models for observational data", 1990), which is the smoother's estimate for a white
/// jerk of density `ω⁶` over noise of density 1. It passes a vibration of angular frequency w by 1 / (1 + (w / ω)⁶), without delay.
#[derive(Debug, Default)]
pub struct Carrier {
    times_s: Vec<f64>,
    /// x, y and heading.
    axes: [Vec<f64>; 3],
}

impl Carrier {
    /// Of a path of about so many frames.
    pub fn for_frames(frames: usize) -> Self {
        let axes = [(); 3].map(|()| Vec::with_capacity(frames));
        Self { times_s: Vec::with_capacity(frames), axes }
    }

    /// Takes the next frame of the camera's path.
    pub fn push(&mut self, frame: &SmoothedFrame) {
        let pose = &frame.pose;
        self.times_s.push(frame.time_s);
        for (axis, value) in self.axes.iter_mut().zip([pose.x_m, pose.y_m, pose.heading_rad]) {
            axis.push(value);
        }
    }

    /// Where the carrier was at each frame. Of frames at the same moment the first counts.
    pub fn path(self, rig: &Rig) -> impl Iterator<Item = StampedPose> {
        let Self { times_s, axes } = self;
        let axes = axes.map(|values| without_shaking(&times_s, values));
        let yaw_rad = rig.yaw_rad;
        let mut before_s = f64::NEG_INFINITY;
        (0..times_s.len()).filter_map(move |i| {
            if times_s[i] <= before_s {
                return None;
            }
            before_s = times_s[i];
            let [x_m, y_m, heading_rad] = axes.each_ref().map(|axis| axis[i]);
            let forward = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad - yaw_rad);
            let world_from_camera = Isometry3::from_parts(Translation3::new(x_m, y_m, 0.0), forward);
            Some(StampedPose { time_s: times_s[i], world_from_camera })
        })
    }
}

/// The path of the carrier ([`Carrier`]) of a whole path of the camera.
pub fn carrier_path(path: &[SmoothedFrame], rig: &Rig) -> Trajectory {
    let mut carrier = Carrier::for_frames(path.len());
    path.iter().for_each(|frame| carrier.push(frame));
    Trajectory { poses: carrier.path(rig).collect() }
}

/// The density of the noise: what matters is only that it is small beside speeds of metres a second.
const NOISE_DENSITY: f64 = 1e-6;

fn without_shaking(times_s: &[f64], values: Vec<f64>) -> Vec<f64> {
    let last = times_s.len().saturating_sub(1);
    let measured = |(i, value): (usize, f64)| {
        let around = (i.saturating_sub(1), (i + 1).min(last));
        // A frame stands for the time from half way to the one before to half way to the one after.
        let spacing_s = (times_s[around.1] - times_s[around.0]) / (around.1 - around.0).max(1) as f64;
        Some((value, NOISE_DENSITY / spacing_s.max(1e-6)))
    };
    let measured: Vec<Measured> = values.into_iter().enumerate().map(measured).collect();
    let density = NOISE_DENSITY * (TAU * CARRIER_CUTOFF_HZ).powi(6);
    let smoothed = smooth_coordinate(times_s, &measured, |_| density);
    smoothed.into_iter().map(|smoothed| smoothed.state[0]).collect()
}

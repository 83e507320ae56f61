//! The way of the carrier: that of the camera without its shaking.

use super::SmoothedFrame;
use super::smoother::{Sample, smooth_axis};
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
pub fn carrier_path(path: &[SmoothedFrame], rig: &Rig) -> Trajectory {
    let times_s: Vec<f64> = path.iter().map(|frame| frame.time_s).collect();
    let axes = [0, 1, 2].map(|axis| {
        let value = |frame: &SmoothedFrame| [frame.pose.x_m, frame.pose.y_m, frame.pose.heading_rad][axis];
        without_shaking(&times_s, &path.iter().map(value).collect::<Vec<f64>>())
    });
    let mut poses: Vec<StampedPose> = Vec::with_capacity(path.len());
    for (i, &time_s) in times_s.iter().enumerate() {
        if poses.last().is_some_and(|before| before.time_s >= time_s) {
            continue;
        }
        let [x_m, y_m, heading_rad] = axes.each_ref().map(|axis| axis[i]);
        let forward = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad - rig.yaw_rad);
        let world_from_camera = Isometry3::from_parts(Translation3::new(x_m, y_m, 0.0), forward);
        poses.push(StampedPose { time_s, world_from_camera });
    }
    Trajectory { poses }
}

/// The density of the noise: what matters is only that it is small beside speeds of metres a second.
const NOISE_DENSITY: f64 = 1e-6;

fn without_shaking(times_s: &[f64], values: &[f64]) -> Vec<f64> {
    let last = times_s.len().saturating_sub(1);
    let sample = |i: usize| {
        let around = (i.saturating_sub(1), (i + 1).min(last));
        // A frame stands for the time from half way to the one before to half way to the one after.
        let spacing_s = (times_s[around.1] - times_s[around.0]) / (around.1 - around.0).max(1) as f64;
        Sample { time_s: times_s[i], measured: Some((values[i], NOISE_DENSITY / spacing_s.max(1e-6))) }
    };
    let samples: Vec<Sample> = (0..times_s.len()).map(sample).collect();
    let density = NOISE_DENSITY * (TAU * CARRIER_CUTOFF_HZ).powi(6);
    smooth_axis(&samples, &vec![density; samples.len()])
        .into_iter()
        .map(|smoothed| smoothed.state[0])
        .collect()
}

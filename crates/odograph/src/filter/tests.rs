//! Smoother and carrier path on synthetic paths with exact ground truth and on rendered drives.

use super::*;
use crate::camera::{Camera, LeverArm, Rig};
use crate::geometry::GroundPose;
use crate::motion::Random;
use crate::odometry::{Odometry, OdometryConfig};
use crate::simulation::{Effects, Path, PathKind, Simulation, SimulationConfig, Texture};
use crate::trajectory::{
    FrameEstimate, LossReason, PlaneMeasurement, PoseEstimate, TrackStatus, Trajectory, Velocity,
};
use nalgebra::{Matrix6, Rotation3};

fn gaussian(random: &mut Random) -> f64 {
    let uniform = |r: &mut Random| ((r.bits() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    (-2.0 * uniform(random).ln()).sqrt() * (std::f64::consts::TAU * uniform(random)).cos()
}

/// Frames measured along a path (x, y, heading) at 30 frames per second, with relative timing
/// jitter `uneven` and noise of standard deviation `sigma`, which their covariance states.
fn measured_at(uneven: f64, path: impl Fn(f64) -> [f64; 3], sigma: f64, count: usize) -> Vec<FrameEstimate> {
    let mut random = Random::new(11);
    let mut time_s = 0.0;
    (0..count)
        .map(|number| {
            time_s += 1.0 / 30.0 * (1.0 + uneven * gaussian(&mut random).clamp(-2.0, 2.0));
            let [x_m, y_m, heading_rad] = path(time_s).map(|value| value + sigma * gaussian(&mut random));
            let pose = GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(1.0) };
            let covariance = Matrix6::identity() * sigma * sigma;
            FrameEstimate {
                frame: number as u64,
                time_s,
                status: TrackStatus::Tracked,
                estimate: Some(PoseEstimate {
                    pose,
                    velocity: Velocity::default(),
                    covariance,
                    measured: PlaneMeasurement::new(&pose, &covariance),
                }),
                tracks: 100,
                inliers: 100,
                residual_px: 0.1,
                keyframe: false,
                segment: 0,
            }
        })
        .collect()
}

fn measured(path: impl Fn(f64) -> [f64; 3], sigma: f64, count: usize) -> Vec<FrameEstimate> {
    measured_at(0.3, path, sigma, count)
}

fn lose(frame: &mut FrameEstimate) {
    frame.estimate = None;
    frame.status = TrackStatus::Lost { reason: LossReason::Bare };
}

/// Smooths a recording whose frames are all in memory.
pub(super) fn smooth(frames: &[FrameEstimate], config: &FilterConfig) -> Vec<SmoothedFrame> {
    let mut smoother = Smoother::for_frames(frames.len());
    frames.iter().for_each(|frame| smoother.push(frame));
    let path = smoother.smoothed(config);
    let mut walk = path.walk();
    let mut smoothed = Vec::with_capacity(frames.len());
    frames.iter().for_each(|frame| walk.next(frame, &mut |frame| smoothed.push(frame)));
    smoothed
}

/// The path of the carrier from a complete path of the camera.
fn carrier_path(path: &[SmoothedFrame], rig: &Rig) -> Trajectory {
    let mut carrier = Carrier::for_frames(rig, path.len());
    path.iter().for_each(|frame| carrier.push(frame));
    Trajectory { poses: carrier.path().collect() }
}

/// Root mean square position errors of the measured and of the smoothed positions.
fn errors(frames: &[FrameEstimate], path: impl Fn(f64) -> [f64; 3]) -> (f64, f64) {
    let off = |time_s: f64, x_m: f64, y_m: f64| {
        let [x, y, _] = path(time_s);
        (x_m - x).powi(2) + (y_m - y).powi(2)
    };
    let root_mean = |values: Vec<f64>| (values.iter().sum::<f64>() / values.len() as f64).sqrt();
    let plane = |frame: &FrameEstimate| {
        frame.estimate.as_ref().map(|known| off(frame.time_s, known.measured.x_m, known.measured.y_m))
    };
    let smoothed = smooth(frames, &FilterConfig::default());
    (
        root_mean(frames.iter().filter_map(plane).collect()),
        root_mean(smoothed.iter().map(|frame| off(frame.time_s, frame.pose.x_m, frame.pose.y_m)).collect()),
    )
}

#[test]
fn smoothing_halves_the_noise_of_positions() {
    let path = |t: f64| [0.5 * t + 0.3 * (0.5 * t).sin(), 0.2 * (0.7 * t).cos(), 0.1 * t];
    let (raw, smoothed) = errors(&measured(path, 0.01, 900), path);
    assert!(smoothed < 0.5 * raw, "{smoothed} {raw}");
}

#[test]
fn smoothing_keeps_exact_positions_under_vibration_and_sudden_starts() {
    let shaken = |t: f64| [0.5 * t + 0.003 * (55.0 * t).sin(), 0.002 * (40.0 * t).cos(), 0.0];
    // At rest, then suddenly at half a metre per second, then at rest again.
    let pushed = |t: f64| [0.5 * (t - 5.0).clamp(0.0, 3.0), 0.0, 0.0];
    for sigma in [1e-4, 1e-6] {
        let (raw, smoothed) = errors(&measured(shaken, sigma, 600), shaken);
        assert!(smoothed < 1.02 * raw, "{smoothed} {raw}");
        let (raw, smoothed) = errors(&measured(pushed, sigma, 400), pushed);
        assert!(smoothed < 1.02 * raw, "{smoothed} {raw}");
    }
}

#[test]
fn interpolation_through_a_gap_agrees_with_its_covariance() {
    let path = |t: f64| [0.5 * t + 0.2 * (0.8 * t).sin(), 0.3 * (0.6 * t).cos(), 0.2 * (0.5 * t).sin()];
    let mut frames = measured(path, 1e-4, 600);
    frames[300..330].iter_mut().for_each(lose);
    // There is no output before the first measured frame and after the last.
    frames[..5].iter_mut().for_each(lose);
    frames[590..].iter_mut().for_each(lose);
    let smoothed = smooth(&frames, &FilterConfig::default());
    assert_eq!((smoothed.len(), smoothed[0].frame), (585, 5));
    for frame in &smoothed[295..325] {
        assert_eq!(frame.source, PoseSource::Bridged);
        let [x, y, heading] = path(frame.time_s);
        let off = [frame.pose.x_m - x, frame.pose.y_m - y, frame.pose.heading_rad - heading];
        for (axis, off) in off.into_iter().enumerate() {
            let sigma = frame.covariance[(axis, axis)].sqrt();
            assert!(off.abs() < 3.0 * sigma + 1e-5, "frame {} axis {axis}: {off} {sigma}", frame.frame);
            // One second at half a metre per second.
            assert!(sigma < 0.2, "{sigma}");
        }
    }
    let middle = smoothed[310].covariance[(0, 0)].sqrt();
    assert!(
        middle > 3.0 * smoothed[295].covariance[(0, 0)].sqrt()
            && middle > 3.0 * smoothed[324].covariance[(0, 0)].sqrt()
    );
}

#[test]
fn covariance_stays_large_after_an_unmeasured_gap() {
    let path = |t: f64| [0.5 * t, 0.0, 0.0];
    let mut frames = measured(path, 1e-4, 300);
    frames[100..130].iter_mut().for_each(lose);
    for frame in &mut frames[130..] {
        frame.segment = 1;
        if let Some(known) = &mut frame.estimate {
            known.covariance[(0, 0)] += 0.04;
        }
    }
    let smoothed = smooth(&frames, &FilterConfig::default());
    let sigma = |i: usize| smoothed[i].covariance[(0, 0)].sqrt();
    assert!(
        sigma(99) < 2e-4 && sigma(130) > 0.19 && sigma(115) > 0.1 && sigma(115) < 0.3,
        "{} {} {}",
        sigma(99),
        sigma(115),
        sigma(130)
    );
    assert_eq!((smoothed[115].segment, smoothed[130].segment), (0, 1));
}

#[test]
fn the_carrier_path_has_no_vibration() {
    // A turn at half a metre per second, with vibrations of 4 mm and 0.5° at 6 to 9 Hz and a mount
    // yaw of 30°.
    let way = |t: f64| [1.0 - (0.5 * t).cos(), (0.5 * t).sin(), 0.5 * t];
    let shaken = |t: f64| {
        let [x, y, heading] = way(t);
        [x + 0.004 * (37.7 * t).sin(), y + 0.004 * (56.5 * t).cos(), heading + 0.009 * (45.0 * t).sin()]
    };
    let rig = Rig { yaw_rad: std::f64::consts::FRAC_PI_6, ..Rig::level(1.0) };
    let path = smooth(&measured_at(0.0, shaken, 1e-5, 600), &FilterConfig::default());
    let carrier = carrier_path(&path, &rig);
    assert_eq!(carrier.poses.len(), path.len());
    let inner = &carrier.poses[30..570];
    let mut worst = (0.0f64, 0.0f64);
    for pose in inner {
        let [x, y, heading] = way(pose.time_s);
        let at = pose.world_from_camera.translation.vector;
        assert_eq!(at.z, 0.0);
        let forward = Rotation3::from(pose.world_from_camera.rotation).euler_angles().2;
        let off_rad = crate::geometry::wrap_angle(forward - (heading - rig.yaw_rad));
        worst = (worst.0.max((at.x - x).hypot(at.y - y)), worst.1.max(off_rad.abs()));
    }
    // About a hundredth of 4 mm and 9 mrad: the filter passes (1 + 3⁶)⁻¹ at 6 Hz, plus measurement
    // noise.
    assert!(worst.0 < 5e-5 && worst.1 < 1e-4, "{worst:?}");
}

/// Odometry of a rendered drive with image noise: the frames and the simulation.
fn rendered(noise_gray: f64) -> (Vec<FrameEstimate>, Simulation) {
    let rig = Rig::level(0.75);
    let camera = Camera::from_field_of_view((240, 180), (0.96, 0.72), rig.height_m).unwrap();
    let config = SimulationConfig {
        camera: camera.clone(),
        rig,
        texture: Texture::Asphalt,
        path: Path::new(PathKind::FigureEight { length_m: 1.2, laps: 1.0 }, 0.4, 1.0, true).unwrap(),
        effects: Effects { noise_gray, ..Effects::default() },
        fps: 30.0,
        duration_s: Some(4.0),
        colored: false,
        seed: 3,
    };
    let simulation = Simulation::new(config).unwrap();
    let mut odometry = Odometry::new(camera, rig, OdometryConfig::default()).unwrap();
    let frames =
        simulation.frames().map(|frame| odometry.process(frame.image, frame.time_s).unwrap()).collect();
    (frames, simulation)
}

#[test]
fn the_carrier_of_a_camera_on_a_lever_arm_is_base_link() {
    // The robot turns on the spot; its camera circles about it.
    let lever_arm = Some(LeverArm { x_m: 0.3, y_m: 0.1, z_m: 0.9 });
    let rig = Rig { yaw_rad: 0.7, lever_arm, ..Rig::level(1.0) };
    let circling = |t: f64| {
        let (sin, cos) = (0.5 * t).sin_cos();
        [0.3 * cos - 0.1 * sin, 0.3 * sin + 0.1 * cos, 0.5 * t + 0.7]
    };
    let path = smooth(&measured(circling, 1e-5, 300), &FilterConfig::default());
    let carrier = carrier_path(&path, &rig);
    for pose in &carrier.poses[30..270] {
        let at = pose.world_from_camera.translation.vector;
        assert!(at.xy().norm() < 1e-4 && (at.z - 0.1).abs() < 1e-12, "{at:?}");
        let (roll, pitch, heading) = pose.world_from_camera.rotation.euler_angles();
        let off = crate::geometry::wrap_angle(heading - 0.5 * pose.time_s);
        assert!(roll.abs() < 1e-12 && pitch.abs() < 1e-12 && off.abs() < 1e-4, "{off}");
    }
}

#[test]
fn smoothing_rendered_drives_never_increases_the_error() {
    for (noise_gray, most) in [(12.0, 1.0), (0.5, 1.02)] {
        let (frames, simulation) = rendered(noise_gray);
        assert!(frames.iter().all(|frame| frame.estimate.is_some()));
        let truth = |time_s: f64| {
            let pose = simulation.truth(time_s);
            [pose.x_m, pose.y_m, pose.heading_rad]
        };
        let (measured, smoothed) = errors(&frames, truth);
        assert!(smoothed <= most * measured, "noise {noise_gray}: {smoothed} {measured}");
    }
}

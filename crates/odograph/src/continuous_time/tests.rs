//! Tracks of a shaken camera with exact truth.

use super::frames::{FrameReader, WindowFrame};
use super::*;
use crate::geometry::{GroundPose, Pixel};
use crate::keyframe::KeyframeId;
use crate::motion::{Elevation, PoseRates, Random, RollingShutter};
use crate::odometry::{FrameReference, TrackView};
use nalgebra::Matrix2;
use std::f64::consts::TAU;

const READOUT_S: f64 = 0.020;
const STEP_S: f64 = 1.0 / 30.0;
const NOISE_PX: f64 = 0.03;

/// A camera 0.75 m above the ground that moves at 0.5 m/s and is shaken: at 9 Hz by 1 mm, 3 mrad.
fn motion(time_s: f64) -> [PoseRates; 3] {
    let rate = TAU * 9.0;
    let along = PoseRates::new(0.5, 0.1, 0.2, 0.0, 0.0, 0.0);
    let level = PoseRates::new(0.0, 0.0, 0.0, 0.75, 0.01, -0.02);
    let amplitudes = [1e-3, 1e-3, 3e-3, 5e-4, 3e-3, 2e-3];
    let shaken = |value: fn(f64) -> f64| {
        PoseRates::from_fn(|i, _| amplitudes[i] * value(rate * time_s + 1.3 * i as f64))
    };
    [
        level + time_s * along + shaken(f64::sin),
        along + rate * shaken(f64::cos),
        -rate * rate * shaken(f64::sin),
    ]
}

fn camera() -> Camera {
    let camera = Camera::from_field_of_view((640, 480), (0.96, 0.72), 0.75).unwrap();
    camera.with_readout_s(Some(READOUT_S)).unwrap()
}

/// Pose, rates and accelerations at a time.
type Motion = fn(f64) -> [PoseRates; 3];

fn shutter(camera: &Camera, motion: Motion, time_s: f64) -> (GroundPose, RollingShutter) {
    let [pose, rates, accelerations] = motion(time_s);
    let shutter = RollingShutter { accelerations, ..RollingShutter::new(camera, READOUT_S, rates) };
    (GroundPose::from_vector(&pose), shutter)
}

/// Noise that is nearly normal: the sum of twelve uniform numbers.
fn noise(random: &mut Random) -> f64 {
    let uniform = |random: &mut Random| random.below(1 << 20) as f64 / f64::from(1 << 20) - 0.5;
    NOISE_PX * (0..12).map(|_| uniform(random)).sum::<f64>()
}

/// Where a corner of the image at `from_s` is in that at `to_s`.
fn seen(camera: &Camera, motion: Motion, corner: Pixel, from_s: f64, to_s: f64) -> Option<Pixel> {
    let (keyframe, exposed) = shutter(camera, motion, from_s);
    let ground = exposed.pose_at(&keyframe, corner.y).ground_from_ray(camera.ray_from_pixel(corner)?)?;
    let (pose, exposed) = shutter(camera, motion, to_s);
    let mut y = corner.y;
    let mut pixel = corner;
    for _ in 0..20 {
        pixel = camera.pixel_from_ray(exposed.pose_at(&pose, y).ray_from_ground(ground)?)?;
        y = pixel.y;
    }
    camera.contains(pixel, 8.0).then_some(pixel)
}

/// Frames of a drive, each keyframe serving a dozen of them, as `reader` makes them of the tracks
/// and of poses that are off by `off`.
fn frames(
    reader: &mut FrameReader,
    motion: Motion,
    off: impl Fn(usize) -> PoseRates,
    count: usize,
) -> Vec<WindowFrame> {
    const SERVES: usize = 12;
    let (camera, mut random) = (camera(), Random::new(7));
    let frame = |k: usize| {
        let keyframe = k.saturating_sub(1) / SERVES;
        let (from_s, to_s) = ((keyframe * SERVES) as f64 * STEP_S, k as f64 * STEP_S);
        let mut tracks = Vec::new();
        while tracks.len() < 150 {
            let corner = Pixel::new(random.below(640) as f64, random.below(480) as f64);
            let Some(exact) = seen(&camera, motion, corner, from_s, to_s) else { continue };
            let pixel = Pixel::new(exact.x + noise(&mut random), exact.y + noise(&mut random));
            let covariance_px2 = NOISE_PX * NOISE_PX * Matrix2::identity();
            tracks.push(TrackView {
                pixel,
                corner,
                inlier: true,
                covariance_px2,
                elevation: Elevation::FLAT,
            });
        }
        let next = (k > 0 && k.is_multiple_of(SERVES))
            .then(|| (KeyframeId((k / SERVES) as u64), GroundPose::from_vector(&motion(to_s)[0])));
        let reference = FrameReference { keyframe: KeyframeId(keyframe as u64), next };
        reader.frame((to_s, motion(to_s)[0] + off(k)), reference, &tracks)
    };
    (0..count).map(frame).collect()
}

/// A drive of `count` frames with a camera whose readout time is known to this. Poses are off by
/// half a millimetre or milliradian, as those of an odometry.
fn measured(assumed: &Camera, deviation_s: f64, count: usize) -> MotionWithinImages {
    let mut measurement = MotionMeasurement::new(assumed, deviation_s).unwrap();
    let off = |k: usize| PoseRates::repeat(5e-4 * (1.7 * k as f64).sin());
    for frame in frames(&mut measurement.reader, motion, off, count) {
        measurement.add(frame);
    }
    measurement.finish().expect("every image")
}

#[test]
fn the_rates_of_a_shaken_camera_are_measured() {
    let count = 100;
    let MotionWithinImages { motion: found, readout } = measured(&camera(), 0.0, count);
    assert_eq!(readout, None, "it was given");
    let (mut square, mut normalized) = (PoseRates::zeros(), 0.0);
    for k in 4..count - 4 {
        let time_s = k as f64 * STEP_S;
        let image = found.at(time_s).expect("every image");
        let error = image.rates - motion(time_s)[1];
        square += error.component_mul(&error) / (count - 8) as f64;
        normalized += error.component_mul(&error).component_div(&image.rate_variance).mean();
    }
    // Central differences of exact poses are off by 21 mm/s in x and by 42 mrad/s in pitch.
    let rms = square.map(f64::sqrt);
    assert!(rms.max() < 0.008, "{rms}");
    let normalized = normalized / (count - 8) as f64;
    assert!((0.1..2.0).contains(&normalized), "{normalized}");
}

#[test]
fn the_readout_time_follows_from_the_tracks() {
    let camera = camera().with_readout_s(Some(0.016)).unwrap();
    let Readout { mean_s, variance_s2 } = measured(&camera, 5e-3, 100).readout.expect("shaking shows it");
    assert!((mean_s - READOUT_S).abs() < 1e-4, "{mean_s}");
    assert!((mean_s - READOUT_S).powi(2) < 16.0 * variance_s2, "{mean_s} {variance_s2}");
}

/// From a standstill to 1.2 m/s within a second: the skew reaches 3 % of the view.
fn start(time_s: f64) -> [PoseRates; 3] {
    let level = PoseRates::new(0.0, 0.0, 0.0, 0.75, 0.0, 0.0);
    let along = |value: f64| PoseRates::new(value, 0.0, 0.0, 0.0, 0.0, 0.0);
    let (speed, turn) = (0.6, std::f64::consts::PI);
    let time_s = time_s.clamp(0.0, 1.0);
    [
        level + along(speed * (time_s - (turn * time_s).sin() / turn)),
        along(speed * (1.0 - (turn * time_s).cos())),
        along(speed * turn * (turn * time_s).sin()),
    ]
}

#[test]
fn the_readout_time_is_found_from_poses_that_were_fitted_to_skewed_images() {
    let unknown = camera().with_readout_s(None).unwrap();
    // Height and pitch absorb the skew.
    let off = |k: usize| {
        let speed = start(k as f64 * STEP_S)[1][0];
        PoseRates::new(-0.02, 0.0, 0.0, 0.02, 0.01, 0.02) * speed
    };
    let window = frames(&mut FrameReader::new(80), start, off, 30);
    let (readout_s, variance_s2) = readout::of_window(&unknown, &window).expect("rates that change");
    assert!((readout_s - READOUT_S).abs() < 2e-4, "{readout_s} ± {}", variance_s2.sqrt());
}

#[test]
fn nothing_is_measured_without_frames_or_a_readout_time() {
    let mut measurement = MotionMeasurement::new(&camera(), 0.0).unwrap();
    measurement.end_window();
    assert!(measurement.finish().is_none());
    assert!(MotionMeasurement::new(&camera().with_readout_s(None).unwrap(), 0.0).is_none());
}

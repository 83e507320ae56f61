//! Tracks of a shaken camera with exact truth.

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

fn shutter(camera: &Camera, time_s: f64) -> (GroundPose, RollingShutter) {
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
fn seen(camera: &Camera, corner: Pixel, from_s: f64, to_s: f64) -> Option<Pixel> {
    let (keyframe, exposed) = shutter(camera, from_s);
    let ground = exposed.pose_at(&keyframe, corner.y).ground_from_ray(camera.ray_from_pixel(corner)?)?;
    let (pose, exposed) = shutter(camera, to_s);
    let mut y = corner.y;
    let mut pixel = corner;
    for _ in 0..20 {
        pixel = camera.pixel_from_ray(exposed.pose_at(&pose, y).ray_from_ground(ground)?)?;
        y = pixel.y;
    }
    camera.contains(pixel, 8.0).then_some(pixel)
}

/// A drive of `frames` with a camera whose readout time is known to this, each keyframe serving a
/// dozen of them. Poses are off by half a millimetre or milliradian, as those of an odometry.
fn measured(assumed: &Camera, deviation_s: f64, frames: usize) -> MotionWithinImages {
    const SERVES: usize = 12;
    let (camera, mut random) = (camera(), Random::new(7));
    let mut measurement = MotionMeasurement::new(assumed, deviation_s).unwrap();
    for k in 0..frames {
        let keyframe = k.saturating_sub(1) / SERVES;
        let (from_s, to_s) = ((keyframe * SERVES) as f64 * STEP_S, k as f64 * STEP_S);
        let mut tracks = Vec::new();
        while tracks.len() < 150 {
            let corner = Pixel::new(random.below(640) as f64, random.below(480) as f64);
            let Some(exact) = seen(&camera, corner, from_s, to_s) else { continue };
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
        let off = PoseRates::repeat(5e-4 * (1.7 * k as f64).sin());
        let next = (k > 0 && k % SERVES == 0)
            .then(|| (KeyframeId((k / SERVES) as u64), GroundPose::from_vector(&motion(to_s)[0])));
        let reference = FrameReference { keyframe: KeyframeId(keyframe as u64), next };
        let frame = measurement.reader.frame((to_s, motion(to_s)[0] + off), reference, &tracks);
        measurement.add(frame);
    }
    measurement.finish().expect("every image")
}

#[test]
fn the_rates_of_a_shaken_camera_are_measured() {
    let frames = 100;
    let MotionWithinImages { motion: found, readout } = measured(&camera(), 0.0, frames);
    assert_eq!(readout, None, "it was given");
    let (mut square, mut normalized) = (PoseRates::zeros(), 0.0);
    for k in 4..frames - 4 {
        let time_s = k as f64 * STEP_S;
        let image = found.at(time_s).expect("every image");
        let error = image.rates - motion(time_s)[1];
        square += error.component_mul(&error) / (frames - 8) as f64;
        normalized += error.component_mul(&error).component_div(&image.rate_variance).mean();
    }
    // Central differences of exact poses are off by 21 mm/s in x and by 42 mrad/s in pitch.
    let rms = square.map(f64::sqrt);
    assert!(rms.max() < 0.008, "{rms}");
    let normalized = normalized / (frames - 8) as f64;
    assert!((0.1..2.0).contains(&normalized), "{normalized}");
}

#[test]
fn the_readout_time_follows_from_the_tracks() {
    let camera = camera().with_readout_s(Some(0.016)).unwrap();
    let Readout { mean_s, variance_s2 } = measured(&camera, 5e-3, 100).readout.expect("shaking shows it");
    assert!((mean_s - READOUT_S).abs() < 1e-4, "{mean_s}");
    assert!((mean_s - READOUT_S).powi(2) < 16.0 * variance_s2, "{mean_s} {variance_s2}");
}

#[test]
fn nothing_is_measured_without_frames_or_a_readout_time() {
    let mut measurement = MotionMeasurement::new(&camera(), 0.0).unwrap();
    measurement.end_window();
    assert!(measurement.finish().is_none());
    assert!(MotionMeasurement::new(&camera().with_readout_s(None).unwrap(), 0.0).is_none());
}

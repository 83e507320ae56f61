//! Ground that moves by itself and images parts of which stand still, rendered with exact truth.

use super::*;
use crate::geometry::pose_index::{X, Y};
use crate::simulation::Sway;

#[test]
fn swaying_grass_does_not_shift_the_path() {
    let world = World::new("grass");
    let sway = Some(Sway { amplitude_m: 0.009, share: 0.5, period_s: 1.3 });
    let simulation = Simulation::new(SimulationConfig {
        camera: world.camera.clone(),
        rig: Rig::level(HEIGHT_M),
        texture: Texture::Grass,
        path: Path::new(PathKind::Straight { length_m: 2.0 }, 0.6, 1.0, true).unwrap(),
        effects: Effects { sway, noise_gray: 2.0, ..Effects::default() },
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed: 7,
    })
    .unwrap();
    let mut odometry = Odometry::new(world.camera, Rig::level(HEIGHT_M), OdometryConfig::default()).unwrap();
    let mut off_mm = f64::NAN;
    for frame in simulation.frames() {
        let pose = odometry.process(frame.image, frame.time_s).unwrap().estimate.expect("tracked").pose;
        off_mm = 1e3 * (pose.x_m - frame.truth.x_m).hypot(pose.y_m - frame.truth.y_m);
    }
    // 1.1 mm where moving corners are kept. Measured: 0.01 mm.
    assert!(off_mm < 0.3, "{off_mm} mm");
}

#[test]
fn rows_of_the_image_before_do_not_stop_the_camera() {
    let world = World::new("asphalt");
    let mut odometry = world.odometry();
    let (mut before, mut keyframes): (Option<(GrayImage, bool)>, _) = (None, 0);
    for frame in 0..24 {
        let truth = at(0.08 * frame as f64, 0.0, 0.0);
        let image = world.image(truth, frame);
        let mut shown = image.clone();
        // Where a keyframe has just been made, half of what it shows stays where it was.
        if let Some((before, true)) = before.filter(|_| frame > 2) {
            let rows = 80 * 640..320 * 640;
            shown.samples_mut()[rows.clone()].copy_from_slice(&before.samples()[rows]);
            keyframes += 1;
        }
        let found = odometry.process(shown, frame as f64 * FRAME_S).unwrap();
        // 80 mm where the image before is followed.
        assert_right(&found, &truth, 2.0);
        before = Some((image, found.keyframe));
    }
    assert!(keyframes >= 3, "{keyframes} keyframes");
}

#[test]
fn copies_are_recognised_after_a_return_to_an_older_keyframe() {
    let world = World::new("asphalt");
    let mut odometry = world.odometry();
    let (mut before, mut copies): (Option<GrayImage>, _) = (None, 0);
    for frame in 0..100 {
        let x_m = 0.02 * if frame < 50 { frame } else { 100 - frame } as f64;
        let is_copy = frame % 2 == 1 && frame > 8;
        let rendered = || world.image(at(x_m, 0.0, 0.0), frame);
        let image = before.take().filter(|_| is_copy).unwrap_or_else(rendered);
        before = Some(image.clone());
        let found = odometry.process(image, frame as f64 * FRAME_S).unwrap();
        if is_copy {
            assert_eq!(found.tracks, 0, "frame {frame}");
            copies += 1;
        }
    }
    assert!(copies > 40 && odometry.keyframes() < 8, "{copies} copies, {} keyframes", odometry.keyframes());
}

#[test]
fn a_cart_that_crosses_most_of_the_view_is_not_followed() {
    let world = World::new("concrete");
    let mut odometry = world.odometry();
    let mut random = Random::new(5);
    let cart: Vec<u8> = (0..640 * 480).map(|_| 60 + random.below(100) as u8).collect();
    for frame in 0..90 {
        // The ground goes by at 13 pixels a frame, the cart comes in from the side.
        let truth = at(0.02 * frame as f64, 0.0, 0.0);
        let mut shown = world.image(truth, frame);
        let covered = 5 * frame as usize;
        for (row, cart) in shown.samples_mut().chunks_mut(640).zip(cart.chunks(640)) {
            row[..covered].copy_from_slice(&cart[640 - covered..]);
        }
        let found = odometry.process(shown, frame as f64 * FRAME_S).unwrap();
        assert_right(&found, &truth, 1.0);
    }
}

/// An arm comes in from the side within eight frames, rests over the whole view, and goes back.
#[test]
fn an_arm_that_comes_to_rest_over_the_view_does_not_stop_the_camera() {
    let world = World::new("concrete");
    let mut odometry = world.odometry();
    let mut random = Random::new(5);
    let arm: Vec<u8> = (0..640 * 480).map(|_| 60 + random.below(100) as u8).collect();
    for frame in 0..80_usize {
        let truth = at(0.02 * frame as f64, 0.0, 0.0);
        let mut shown = world.image(truth, frame as u64);
        let covered = 80 * frame.saturating_sub(20).min(8).min(56_usize.saturating_sub(frame));
        for (row, arm) in shown.samples_mut().chunks_mut(640).zip(arm.chunks(640)) {
            row[..covered].copy_from_slice(&arm[640 - covered..]);
        }
        let found = odometry.process(shown, frame as f64 * FRAME_S).unwrap();
        let truth = truth.unwrap();
        let Some(estimate) = &found.estimate else {
            assert!((26..70).contains(&frame), "frame {frame} is lost: {:?}", found.status);
            continue;
        };
        let off_m = (estimate.pose.x_m - truth.x_m).hypot(estimate.pose.y_m - truth.y_m);
        let sigma_m = (estimate.covariance[(X, X)] + estimate.covariance[(Y, Y)]).sqrt();
        assert!(off_m < 4.0 * sigma_m + 1e-3, "frame {frame}: {off_m} m off, {sigma_m} m stated");
        assert!(!(30..48).contains(&frame), "frame {frame} shows no ground");
    }
}

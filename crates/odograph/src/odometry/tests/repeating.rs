//! Floors that repeat.

use super::*;
use crate::image::Pyramid;
use crate::odometry::last_pose::LastPose;

const SQUARE_M: f64 = 0.05;

/// A checkerboard in which every fifth square is gray.
fn checkerboard(camera: &Camera, pose: &GroundPose) -> GrayImage {
    let mut image = GrayImage::new(camera.width(), camera.height());
    for (index, sample) in image.samples_mut().iter_mut().enumerate() {
        let (x, y) = ((index % camera.width()) as f64, (index / camera.width()) as f64);
        // Four samples a pixel: edges are as smooth as a lens makes them.
        let sum: f64 = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]
            .iter()
            .map(|(dx, dy)| {
                let ray = camera.ray_from_pixel(Pixel { x: x + dx, y: y + dy }).unwrap();
                let ground = pose.ground_from_ray(ray).unwrap();
                let square = [ground.x_m, ground.y_m].map(|m| (m / SQUARE_M).floor() as i64);
                match (square[0] * 7 + square[1] * 13 + square[0] * square[1]).rem_euclid(5) {
                    0 => 120.0,
                    _ if (square[0] + square[1]).rem_euclid(2) == 0 => 60.0,
                    _ => 180.0,
                }
            })
            .sum();
        *sample = (0.25 * sum).round() as u8;
    }
    image
}

#[test]
fn a_prediction_that_is_a_period_off_is_not_believed() {
    let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
    let mut odometry =
        Odometry::new(camera.clone(), Rig::level(HEIGHT_M), OdometryConfig::default()).unwrap();
    let pose = |frame: usize| GroundPose { x_m: 0.003 * frame as f64, ..GroundPose::level(HEIGHT_M) };
    for frame in 0..8 {
        odometry.process(checkerboard(&camera, &pose(frame)), frame as f64 * FRAME_S).unwrap();
    }
    let last = odometry.last.take().unwrap();
    let (time_s, truth) = (8.0 * FRAME_S, pose(8));
    let off_m = 2.0 * SQUARE_M;
    let mut wrong = LastPose::still(last.time_s, last.pose, last.covariance);
    (wrong.rates[0], wrong.step_s) = (off_m / FRAME_S, FRAME_S);
    odometry.last = Some(wrong);
    let pyramid = Pyramid::new(checkerboard(&camera, &truth), odometry.config.flow.levels);
    let found = odometry.measure_near(&pyramid, time_s).unwrap().estimate.pose;
    let error_mm = 1e3 * (found.x_m - truth.x_m).hypot(found.y_m - truth.y_m);
    // One period is 100 mm.
    assert!(error_mm < 1.0, "{error_mm} mm");
}

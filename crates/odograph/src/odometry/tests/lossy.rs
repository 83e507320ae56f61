//! Lossy video: blocks are copied from about where they were in the previous frame, and small
//! residuals are dropped.

use super::*;
use crate::motion::{GroundFromRay, ViewingPose};

const BLOCK: usize = 16;
const PART: usize = 4;

/// An encoder with its decoder: motion by quarters of a pixel, one vector a block, and a Hadamard
/// transform of what is left, in coarse steps.
struct TestCodec {
    step: i32,
    last: Option<(GrayImage, GroundPose)>,
}

impl TestCodec {
    /// The image of a camera at `pose` as it comes out.
    fn pass(&mut self, world: &World, image: GrayImage, pose: GroundPose) -> GrayImage {
        let mut decoded = image.clone();
        for top in (0..480).step_by(BLOCK) {
            for left in (0..640).step_by(BLOCK) {
                let moved = self.last.as_ref().and_then(|(_, last)| moved(world, (left, top), &pose, last));
                self.code(&image, &mut decoded, (left, top), moved);
            }
        }
        self.last = Some((decoded.clone(), pose));
        decoded
    }

    fn code(
        &self,
        image: &GrayImage,
        decoded: &mut GrayImage,
        (left, top): (usize, usize),
        moved: Option<(i32, i32)>,
    ) {
        for y0 in (top..top + BLOCK).step_by(PART) {
            for x0 in (left..left + BLOCK).step_by(PART) {
                let guess = |i: usize| self.predicted(x0 + i % PART, y0 + i / PART, moved);
                let guess: [i32; PART * PART] = std::array::from_fn(guess);
                let mut rest: [i32; PART * PART] =
                    std::array::from_fn(|i| i32::from(image.row(y0 + i / PART)[x0 + i % PART]) - guess[i]);
                hadamard(&mut rest);
                // Less than two thirds of a step is left out.
                rest.iter_mut()
                    .for_each(|c| *c = c.signum() * ((c.abs() + self.step / 3) / self.step) * self.step);
                hadamard(&mut rest);
                for (i, rest) in rest.iter().enumerate() {
                    let at = (y0 + i / PART) * 640 + x0 + i % PART;
                    decoded.samples_mut()[at] = (guess[i] + (rest + 8).div_euclid(16)).clamp(0, 255) as u8;
                }
            }
        }
    }

    /// A sample of the previous frame, displaced by quarters of a pixel; gray without one or
    /// outside it.
    fn predicted(&self, x: usize, y: usize, moved: Option<(i32, i32)>) -> i32 {
        let (Some((last, _)), Some((dx, dy))) = (&self.last, moved) else { return 128 };
        let (x, y) = ((4 * x as i32 + dx).clamp(0, 4 * 638), (4 * y as i32 + dy).clamp(0, 4 * 478));
        let (column, row, fx, fy) = ((x / 4) as usize, (y / 4) as usize, x % 4, y % 4);
        let at = |i: usize, j: usize| i32::from(last.row(row + j)[column + i]);
        let (upper, lower) = ((4 - fx) * at(0, 0) + fx * at(1, 0), (4 - fx) * at(0, 1) + fx * at(1, 1));
        ((4 - fy) * upper + fy * lower + 8) / 16
    }
}

/// Displacement of a block's content in the previous frame, to the right and down, in quarters of a
/// pixel.
fn moved(
    world: &World,
    (left, top): (usize, usize),
    pose: &GroundPose,
    last: &GroundPose,
) -> Option<(i32, i32)> {
    let middle = Pixel::new(left as f64 + 7.5, top as f64 + 7.5);
    let ground = GroundFromRay::new(pose).of(world.camera.ray_from_pixel(middle)?)?;
    let before = ViewingPose::new(*last).pixel(&world.camera, ground, 0.0)?;
    let quarters = |distance: f64| (4.0 * distance).round() as i32;
    Some((quarters(before.x - middle.x), quarters(before.y - middle.y)))
}

/// The Hadamard transform of four by four samples; twice makes sixteen times what there was.
fn hadamard(samples: &mut [i32; PART * PART]) {
    for (stride, next) in [(1, PART), (PART, 1)] {
        for line in 0..PART {
            let at = |i: usize| line * next + i * stride;
            let [a, b, c, d] = [0, 1, 2, 3].map(|i| samples[at(i)]);
            let (p, q, r, s) = (a + b, a - b, c + d, c - d);
            samples[at(0)] = p + r;
            samples[at(1)] = q + s;
            samples[at(2)] = p - r;
            samples[at(3)] = q - s;
        }
    }
}

/// Follows the camera over an arc at 0.4 m/s, two keyframes long, tilted in frame i by what `sway`
/// says.
fn follow(sway: impl Fn(f64) -> f64) -> Vec<(FrameEstimate, GroundPose)> {
    let world = World::new("asphalt");
    let mut odometry = world.odometry();
    // Tracks are off by a fifth of a pixel, as between H.264's crf 28 and 38.
    let mut codec = TestCodec { step: 200, last: None };
    let frame = |number: u32| {
        let time_s = f64::from(number) * FRAME_S;
        let s = 0.4 * time_s;
        let pose = GroundPose {
            x_m: s,
            y_m: 0.2 * s * s,
            heading_rad: 0.4 * s,
            pitch_rad: sway(time_s),
            ..GroundPose::level(HEIGHT_M)
        };
        let image = codec.pass(&world, world.image(Some(pose), number.into()), pose);
        (odometry.process(image, time_s).unwrap(), pose)
    };
    (0..60).map(frame).collect()
}

#[test]
fn a_steady_mount_is_taken_for_steady_in_lossy_video() {
    for (frame, truth) in follow(|_| 0.0) {
        let found = frame.estimate.as_ref().unwrap();
        assert!(frame.residual_px < 0.4, "the video is worse than it is meant to be: {}", frame.residual_px);
        // By themselves the tracks say 0.1 mm and 0.0003 rad, and the way were 0.2 mm off if they
        // were accepted.
        assert!((found.pose.height_m - HEIGHT_M).abs() < 2e-5, "frame {}: {:?}", frame.frame, found.pose);
        assert!(
            found.pose.roll_rad.abs().max(found.pose.pitch_rad.abs()) < 1e-4,
            "frame {}: {:?}",
            frame.frame,
            found.pose
        );
        // A keyframe is off by what all its tracks share, 0.05 px of 1.5 mm.
        assert_right(&frame, &Some(truth), 0.1);
        let off = nalgebra::Vector2::new(found.pose.x_m - truth.x_m, found.pose.y_m - truth.y_m);
        if let Some(information) = found.covariance.fixed_view::<2, 2>(0, 0).try_inverse() {
            let squared = (off.transpose() * information * off)[0];
            assert!(squared < 12.0, "frame {}: {squared} for two degrees of freedom", frame.frame); // one in 400
        }
    }
}

#[test]
fn a_swaying_mount_is_followed_in_lossy_video() {
    let frames = follow(|time_s| 0.01 * (std::f64::consts::TAU * 3.0 * time_s).sin());
    for (frame, truth) in &frames[10..] {
        // Held for level, the camera would be put 7 mm off. The tracks determine its tilt to 0.0003
        // rad, that of the keyframe to as much.
        assert_right(frame, &Some(*truth), 1.5);
    }
}

//! Poses of a hand-held calibration board.

use super::{BoardScene, uniform};
use nalgebra::{Isometry3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};
use odograph::geometry::Pixel;
use odograph_calibration::BoardPoint;

/// Required visibility of the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framing {
    /// The whole pattern.
    Whole,
    /// At least a third of the points, for boards that can be detected partially.
    Partial,
}

/// Maximum tilt of the board against the line of sight, radians.
const MAX_TILT_RAD: f64 = std::f64::consts::FRAC_PI_4;

impl BoardScene {
    /// `count` poses whose boards cover the image: between a third and the whole of it large,
    /// tilted in all directions by up to 45° and rotated in the image by up to 25°. Deterministic
    /// for a seed.
    pub fn poses(&self, count: usize, framing: Framing, seed: u64) -> Vec<Isometry3<f64>> {
        (0..count).map(|number| self.pose(number, framing, seed)).collect()
    }

    fn pose(&self, number: usize, framing: Framing, seed: u64) -> Isometry3<f64> {
        // Low-discrepancy additive recurrences of the plastic number (M. Roberts, "The unreasonable
        // effectiveness of quasirandom sequences", 2018) for positions and tilts, with an offset
        // from the seed.
        let spread = |dimension: u64, step: f64| (uniform(seed, dimension) + step * number as f64).fract();
        let draw = |index: u64| uniform(seed ^ 0x905E, 16 * number as u64 + index);
        let (mut u, mut v) = (spread(1, 0.754_877_666), spread(2, 0.569_840_291));
        let tilt_rad = MAX_TILT_RAD * spread(3, 0.618_033_989).powf(0.6);
        let towards_rad = std::f64::consts::TAU * spread(4, 0.381_966_011 + 0.1);
        let turn_rad = (2.0 * draw(0) - 1.0) * 25f64.to_radians();
        let mut size = match framing {
            Framing::Whole => 0.35 + 0.6 * draw(1),
            Framing::Partial => 0.6 + 0.9 * draw(1),
        };
        // Move towards the image centre and away from the camera until enough of the board is
        // visible.
        for _ in 0..200 {
            let pose = self.posed((u, v), size, tilt_rad, towards_rad, turn_rad);
            if let Some(pose) = pose
                && self.is_framed(&pose, framing)
            {
                return pose;
            }
            (u, v) = (0.5 + 0.97 * (u - 0.5), 0.5 + 0.97 * (v - 0.5));
            size *= 0.975;
        }
        Isometry3::translation(0.0, 0.0, 1.0)
    }

    /// Pose with the board's centre at (`u`, `v`) in the image; `size` is the ratio of the board's
    /// diagonal to the image's without tilt.
    fn posed(
        &self,
        (u, v): (f64, f64),
        size: f64,
        tilt_rad: f64,
        towards_rad: f64,
        turn_rad: f64,
    ) -> Option<Isometry3<f64>> {
        let (width, height) = (self.camera.width() as f64, self.camera.height() as f64);
        let (fx, fy) = self.camera.focal_px();
        let pattern = self.drawing.pattern();
        let distance_m =
            (fx * fy).sqrt() * pattern.width_m().hypot(pattern.height_m()) / (size * width.hypot(height));
        let ray = self.camera.ray_from_pixel(Pixel::new(u * width - 0.5, v * height - 0.5))?;
        let sight = Unit::new_normalize(ray.vector());
        let facing = Rotation3::rotation_between(&Vector3::z(), &sight)?;
        let axis = Unit::new_normalize(Vector3::new(towards_rad.cos(), towards_rad.sin(), 0.0));
        let rotation = facing
            * Rotation3::from_axis_angle(&axis, tilt_rad)
            * Rotation3::from_axis_angle(&Vector3::z_axis(), turn_rad);
        let translation = sight.into_inner() * distance_m - rotation * self.middle().coords;
        Some(Isometry3::from_parts(
            Translation3::from(translation),
            UnitQuaternion::from_rotation_matrix(&rotation),
        ))
    }

    fn is_framed(&self, pose: &Isometry3<f64>, framing: Framing) -> bool {
        let seen = |point: BoardPoint, margin_px: f64| {
            self.project(pose, point).is_some_and(|pixel| self.camera.contains(pixel, margin_px))
        };
        let points = self.board.points();
        match framing {
            Framing::Whole => {
                let margin_px = 0.01 * self.camera.width() as f64;
                let pattern = self.drawing.pattern();
                let corners = [pattern.from.x_m, pattern.to.x_m]
                    .into_iter()
                    .flat_map(|x_m| [pattern.from.y_m, pattern.to.y_m].map(|y_m| BoardPoint { x_m, y_m }));
                // With strong distortion the corners may be inside the image and an edge between
                // them outside, so points along the edge are checked as well.
                corners.chain(points).all(|point| seen(point, margin_px))
            }
            Framing::Partial => 3 * points.iter().filter(|point| seen(**point, 0.0)).count() >= points.len(),
        }
    }
}

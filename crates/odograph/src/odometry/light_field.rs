//! How the light of a frame differs from that of its keyframe, from place to place.

use super::found_corner::FoundCorner;
use crate::buffer::Buffer;
use crate::geometry::Pixel;
use nalgebra::{Matrix6, Vector2, Vector6};

/// Logarithm of the illumination relative to that of the keyframe, as a quadratic over the image:
/// vignetting has that form, since the ground has moved in it, and so have, approximately, a lamp,
/// a window or a soft shadow.
#[derive(Debug, Clone)]
pub struct LightField {
    /// Coefficients of 1, x, y, x², x y and y², with x and y from `middle` in units of [`UNIT_PX`].
    coefficients: Vector6<f64>,
    middle: Vector2<f64>,
}

/// So that all coefficients are about as large.
const UNIT_PX: f64 = 256.0;

/// Fewer tracks do not determine a field.
const FEWEST: usize = 30;

/// Fits, each without what was far off in the one before: the edge of a shadow, what moves.
const ROUNDS: usize = 3;

/// Further off than this many standard deviations is something else.
const REACH: f64 = 3.0;

impl LightField {
    /// The field that the brightness of tracks determines; `None` where they are too few.
    pub fn between(found: &[FoundCorner]) -> Option<Self> {
        if found.len() < FEWEST {
            return None;
        }
        let sum = found.iter().map(|found| Vector2::new(found.warp.position.x, found.warp.position.y));
        let middle = sum.sum::<Vector2<f64>>() / found.len() as f64;
        let mut field = Self { coefficients: Vector6::zeros(), middle };
        let mut off: Buffer<f64> = Buffer::of(0.0, found.len());
        let mut sorted: Buffer<f64> = Buffer::new();
        let mut reach = f64::INFINITY;
        for _ in 0..ROUNDS {
            let (mut products, mut slope) = (Matrix6::zeros(), Vector6::zeros());
            for (found, _) in found.iter().zip(&off).filter(|(_, off)| off.abs() <= reach) {
                let powers = field.powers(found.warp.position);
                products.syger(1.0, &powers, &powers, 1.0);
                slope += powers * found.light;
            }
            products.fill_upper_triangle_with_lower_triangle();
            field.coefficients = products.cholesky()?.solve(&slope);
            for (off, found) in off.iter_mut().zip(found) {
                *off = found.light - field.coefficients.dot(&field.powers(found.warp.position));
            }
            sorted.clear();
            sorted.extend(off.iter().map(|off| off.abs()));
            let middle = sorted.len() / 2;
            // The median of what is off is 0.6745 standard deviations.
            reach = REACH / 0.6745 * *sorted.select_nth_unstable_by(middle, f64::total_cmp).1;
        }
        Some(field)
    }

    /// How the logarithm of the light grows at a place, a pixel.
    pub fn slope(&self, pixel: Pixel) -> Vector2<f64> {
        let place = self.place(pixel);
        let (x, y) = (place.x, place.y);
        let [_, by_x, by_y, xx, xy, yy] = self.coefficients.data.0[0];
        Vector2::new(by_x + 2.0 * xx * x + xy * y, by_y + xy * x + 2.0 * yy * y) / UNIT_PX
    }

    fn place(&self, pixel: Pixel) -> Vector2<f64> {
        (Vector2::new(pixel.x, pixel.y) - self.middle) / UNIT_PX
    }

    fn powers(&self, pixel: Pixel) -> Vector6<f64> {
        let place = self.place(pixel);
        let (x, y) = (place.x, place.y);
        Vector6::new(1.0, x, y, x * x, x * y, y * y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::{Noise, Warp};
    use crate::motion::Random;
    use nalgebra::Matrix2;

    #[test]
    fn vignetting_is_separated_from_other_bright_areas() {
        let mut random = Random::new(5);
        let mut uniform = || random.below(1 << 16) as f64 / 65536.0;
        // Ground that was 150 px further left is now in less light: 30 % less in the corners.
        let vignetted = |x: f64, y: f64| (1.0 - 0.3 * (x * x + y * y) / 160_000.0).ln();
        let mut found = Vec::new();
        for corner in 0..300 {
            let (x, y) = (620.0 * uniform() + 10.0, 460.0 * uniform() + 10.0);
            let (from_x, from_y) = (x - 320.0, y - 240.0);
            let mut light = vignetted(from_x, from_y) - vignetted(from_x - 150.0, from_y) - 0.05;
            light += 0.004 * (uniform() - 0.5);
            if corner % 5 == 0 {
                light += 0.5 * uniform();
            }
            let warp = Warp::translation(Pixel::new(x, y));
            let (covariance_px2, noise) = (Matrix2::identity(), Noise::default());
            found.push(FoundCorner { corner, warp, covariance_px2, light, noise });
        }
        let field = LightField::between(&found).unwrap();
        for (x, y) in [(100.0, 100.0), (320.0, 240.0), (500.0, 400.0)] {
            let (from_x, from_y) = (x - 320.0, y - 240.0);
            let at = |dx: f64, dy: f64| {
                vignetted(from_x + dx, from_y + dy) - vignetted(from_x + dx - 150.0, from_y + dy)
            };
            let truth = Vector2::new(at(0.5, 0.0) - at(-0.5, 0.0), at(0.0, 0.5) - at(0.0, -0.5));
            // The quadratic leaves a fifth of the slope in the corners.
            let off = (field.slope(Pixel::new(x, y)) - truth).norm();
            assert!(off < 2.5e-4, "at {x}, {y}: {off} of {}", truth.norm());
        }
        assert!(LightField::between(&found[..20]).is_none());
    }
}

//! One point of a board with markers: where four squares meet, the colours known beforehand.

use super::markers::interpolated;
use super::subpixel;
use crate::geometry::Pixel;
use crate::image::GrayImage;

/// A point that was looked at and is there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PointLook {
    pub pixel: Pixel,
    /// Standard deviation of the blur of its edges, pixels.
    pub blur_px: f64,
}

/// The least contrast of black and white around a point, gray levels.
const LEAST_CONTRAST: f64 = 8.0;
/// The window of the fit, pixels: three arms of a few pixels hold a point to some hundredths of a pixel under noise; with more, the
/// lens's bending of the edges comes in.
const WINDOW_PX: (f64, f64) = (2.5, 6.0);

/// The point near `predicted`, found sub-pixel; `None` unless four squares meet there with black where it must be.
///
/// `steps` are what a metre along x and along y is in the image, `plain_m` how far from the point its four squares are plain.
pub(super) fn look_at(
    image: &GrayImage,
    predicted: Pixel,
    steps: [(f64, f64); 2],
    plain_m: f64,
    black_upper_left: bool,
    most_off_px: f64,
) -> Option<PointLook> {
    let plain_px = super::plane_map::least_width(steps) * plain_m;
    let window = (1.6 * plain_px).clamp(WINDOW_PX.0, WINDOW_PX.1);
    let start = if meets(image, predicted, steps, plain_m, black_upper_left) {
        predicted
    } else {
        search(image, predicted, steps, plain_m, black_upper_left, most_off_px)?
    };
    let saddle = subpixel::fit(image, start, window)?;
    let pixel = saddle.pixel;
    (pixel.distance(predicted) <= most_off_px && meets(image, pixel, steps, plain_m, black_upper_left))
        .then_some(PointLook { pixel, blur_px: saddle.blur_px })
}

/// White less black around a point: the lesser of the whites against the greater of the blacks.
fn contrast(
    image: &GrayImage,
    at: Pixel,
    steps: [(f64, f64); 2],
    plain_m: f64,
    black_upper_left: bool,
) -> Option<f64> {
    // In the middle of the plain part of each square, but not within a pixel's blur of the edges.
    let along = |(x, y): (f64, f64)| {
        let reach = (0.6 * plain_m).max(1.0 / x.hypot(y).max(1e-9));
        (reach * x, reach * y)
    };
    let [a, b] = steps.map(along);
    let sample = |sx: f64, sy: f64| {
        interpolated(image, Pixel::new(at.x + sx * a.0 + sy * b.0, at.y + sx * a.1 + sy * b.1))
    };
    let falling = (sample(-1.0, -1.0)?, sample(1.0, 1.0)?);
    let rising = (sample(1.0, -1.0)?, sample(-1.0, 1.0)?);
    let (black, white) = if black_upper_left { (falling, rising) } else { (rising, falling) };
    Some(white.0.min(white.1) - black.0.max(black.1))
}

fn meets(image: &GrayImage, at: Pixel, steps: [(f64, f64); 2], plain_m: f64, black_upper_left: bool) -> bool {
    contrast(image, at, steps, plain_m, black_upper_left).is_some_and(|contrast| contrast > LEAST_CONTRAST)
}

/// The pixel within reach around which black and white differ most in the right way.
fn search(
    image: &GrayImage,
    predicted: Pixel,
    steps: [(f64, f64); 2],
    plain_m: f64,
    black_upper_left: bool,
    most_off_px: f64,
) -> Option<Pixel> {
    let reach = most_off_px.min(8.0).ceil() as i32;
    let mut best = (LEAST_CONTRAST, None);
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let at = Pixel::new(predicted.x + f64::from(dx), predicted.y + f64::from(dy));
            if let Some(contrast) = contrast(image, at, steps, plain_m, black_upper_left)
                && contrast > best.0
            {
                best = (contrast, Some(at));
            }
        }
    }
    best.1
}

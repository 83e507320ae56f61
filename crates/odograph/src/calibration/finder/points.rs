//! One point of a board with markers: where four squares meet, the colours known beforehand.

use super::markers::interpolated;
use super::pattern_fit::Pattern;
use super::plane_map::{PlaneMap, least_width};
use super::subpixel;
use crate::calibration::Drawing;
use crate::geometry::Pixel;
use crate::image::GrayImage;

/// A point that was looked at and is there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PointLook {
    pub pixel: Pixel,
    /// What is left unexplained of the image around it, in parts of its contrast.
    pub residual: f64,
}

/// The least contrast of black and white around a point, gray levels.
const LEAST_CONTRAST: f64 = 8.0;
/// The window of the fit, pixels: three arms of a few pixels hold a point to some hundredths of a pixel under noise; with more, the
/// lens's bending of the edges comes in.
const WINDOW_PX: (f64, f64) = (2.5, 6.0);
/// With less, a pattern's six unknowns are not held, pixels.
const SMALLEST_PATTERN_PX: f64 = 4.0;

/// What is known of a point before it is looked for.
pub(super) struct Expected<'a> {
    /// The board around it in the image.
    pub map: &'a PlaneMap,
    /// Its place on the board, metres.
    pub place: (f64, f64),
    /// How far from the point its four squares are plain, metres, and its distance to the next point.
    pub plain_m: f64,
    pub spacing_m: f64,
    pub black_upper_left: bool,
    /// How far it may be from where it is predicted, pixels.
    pub most_off_px: f64,
    /// What is printed, where that is known to the last bit, and the blur it is seen with.
    pub drawing: Option<(&'a Drawing, f64)>,
}

/// The part of the contrast that may be left unexplained where a pattern is laid on the image.
const MOST_UNEXPLAINED: f64 = 0.2;
/// A point that noise and blur leave less certain is no point, pixels.
const MOST_DEVIATION_PX: f64 = 0.1;

/// A point near where it is expected, found sub-pixel; `None` unless four squares meet there with black where it must be.
pub(super) fn look_at(image: &GrayImage, expected: &Expected<'_>) -> Option<PointLook> {
    let predicted = expected.map.pixel(expected.place)?;
    let steps = expected.map.steps(expected.place, 1.0)?;
    let width = least_width(steps);
    let colours = Colours { steps, plain_m: expected.plain_m, black_upper_left: expected.black_upper_left };
    let start = if colours.meet(image, predicted) {
        predicted
    } else {
        colours.search(image, predicted, expected.most_off_px)?
    };
    let window = (1.6 * width * expected.plain_m).clamp(WINDOW_PX.0, WINDOW_PX.1);
    let look = match expected.drawing {
        Some((drawing, blur_px)) if 1.6 * width * expected.plain_m < WINDOW_PX.1 => {
            let near = subpixel::orthogonal(image, start, window)
                .filter(|near| near.distance(predicted) <= expected.most_off_px && colours.meet(image, *near))
                .unwrap_or(start);
            let window = (0.4 * width * expected.spacing_m).clamp(SMALLEST_PATTERN_PX, WINDOW_PX.1 + 1.0);
            let fit =
                Pattern::new(drawing, expected.map, expected.place, window, blur_px)?.fit(image, near)?;
            if fit.residual > MOST_UNEXPLAINED * fit.contrast || fit.deviation_px > MOST_DEVIATION_PX {
                return None;
            }
            PointLook { pixel: fit.pixel, residual: fit.residual / fit.contrast }
        }
        _ => {
            let saddle = subpixel::fit(image, start, window)?;
            // Along each edge as many samples as the window is wide, across it as many as the blur is; each as sure as the slope is steep.
            let blur_px = saddle.blur_px.max(0.5);
            let deviation_px =
                2.5 * blur_px * saddle.residual / saddle.contrast / (2.0 * window * blur_px).sqrt();
            // Not `>`: a NaN is no point either.
            if !(deviation_px <= MOST_DEVIATION_PX) {
                return None;
            }
            PointLook { pixel: saddle.pixel, residual: saddle.residual / saddle.contrast }
        }
    };
    (look.pixel.distance(predicted) <= expected.most_off_px && colours.meet(image, look.pixel))
        .then_some(look)
}

/// The colours of the four squares around a point.
struct Colours {
    /// What a metre along x and along y is in the image, pixels.
    steps: [(f64, f64); 2],
    plain_m: f64,
    black_upper_left: bool,
}

impl Colours {
    /// White less black around a point: the lesser of the whites against the greater of the blacks.
    fn contrast(&self, image: &GrayImage, at: Pixel) -> Option<f64> {
        // In the middle of the plain part of each square, but not within a pixel's blur of the edges.
        let along = |(x, y): (f64, f64)| {
            let reach = (0.6 * self.plain_m).max(1.0 / x.hypot(y).max(1e-9));
            (reach * x, reach * y)
        };
        let [a, b] = self.steps.map(along);
        let sample = |sx: f64, sy: f64| {
            interpolated(image, Pixel::new(at.x + sx * a.0 + sy * b.0, at.y + sx * a.1 + sy * b.1))
        };
        let falling = (sample(-1.0, -1.0)?, sample(1.0, 1.0)?);
        let rising = (sample(1.0, -1.0)?, sample(-1.0, 1.0)?);
        let (black, white) = if self.black_upper_left { (falling, rising) } else { (rising, falling) };
        Some(white.0.min(white.1) - black.0.max(black.1))
    }

    fn meet(&self, image: &GrayImage, at: Pixel) -> bool {
        self.contrast(image, at).is_some_and(|contrast| contrast > LEAST_CONTRAST)
    }

    /// The pixel within reach around which black and white differ most in the right way.
    fn search(&self, image: &GrayImage, predicted: Pixel, most_off_px: f64) -> Option<Pixel> {
        let reach = most_off_px.min(8.0).ceil() as i32;
        let mut best = (LEAST_CONTRAST, None);
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let at = Pixel::new(predicted.x + f64::from(dx), predicted.y + f64::from(dy));
                if let Some(contrast) = self.contrast(image, at)
                    && contrast > best.0
                {
                    best = (contrast, Some(at));
                }
            }
        }
        best.1
    }
}

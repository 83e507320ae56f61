//! Sub-pixel localisation of one corner of a board with markers. The polarity of the four squares
//! that meet there is known.

use super::pattern_fit::Pattern;
use super::plane_map::{PlaneMap, least_width};
use super::ring::interpolated;
use super::subpixel;
use crate::Drawing;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// A located corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PointLook {
    pub pixel: Pixel,
    /// RMS residual of the fit, relative to the contrast.
    pub residual: f64,
}

/// Minimum contrast between black and white around a corner, gray levels.
const MIN_CONTRAST: f64 = 8.0;
/// Limits of the window radius of the fit, pixels. Edges of a few pixels determine a corner to some
/// hundredths of a pixel under noise; in larger windows the lens distortion bends the edges
/// noticeably.
const WINDOW_PX: (f64, f64) = (2.5, 6.0);
/// Minimum window radius of a pattern fit, pixels; smaller windows do not constrain its six
/// unknowns.
const SMALLEST_PATTERN_PX: f64 = 4.0;

/// Prediction and prior knowledge of a corner.
pub(super) struct Expected<'a> {
    /// Local map from the board to the image.
    pub map: &'a PlaneMap,
    /// Position on the board, metres.
    pub place: (f64, f64),
    /// Distance from the corner within which the four squares are uniform, and distance to the next
    /// corner, both in metres.
    pub plain_m: f64,
    pub spacing_m: f64,
    pub black_upper_left: bool,
    /// Maximum distance between prediction and detection, pixels.
    pub most_off_px: f64,
    /// The printed pattern and its blur in the image (standard deviation, pixels); `None` if the
    /// print differs from the drawing.
    pub drawing: Option<(&'a Drawing, f64)>,
}

/// Maximum RMS residual of a fit: a noise term (gray levels) plus a share of the contrast for blur
/// that deviates from the model. Occlusions cause larger residuals.
const NOISE_GRAY: f64 = 3.0;
const MAX_UNEXPLAINED: f64 = 0.12;
/// Maximum standard deviation of a corner, pixels.
const MAX_DEVIATION_PX: f64 = 0.1;

/// Locates a corner near its predicted position. `None` unless four squares of the expected
/// polarity meet there.
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
            if fit.residual > NOISE_GRAY + MAX_UNEXPLAINED * fit.contrast
                || fit.deviation_px > MAX_DEVIATION_PX
            {
                return None;
            }
            PointLook { pixel: fit.pixel, residual: fit.residual / fit.contrast }
        }
        _ => {
            let saddle = subpixel::fit(image, start, window)?;
            // Standard deviation of the corner: along each edge there are as many samples as the
            // window is wide, across it as many as the blur is wide, and the accuracy of each is
            // the residual over the slope.
            let blur_px = saddle.blur_px.max(0.5);
            let deviation_px =
                2.5 * blur_px * saddle.residual / saddle.contrast / (2.0 * window * blur_px).sqrt();
            // Not `>`, so that NaN is rejected too.
            if !(deviation_px <= MAX_DEVIATION_PX
                && saddle.residual <= NOISE_GRAY + MAX_UNEXPLAINED * saddle.contrast)
            {
                return None;
            }
            PointLook { pixel: saddle.pixel, residual: saddle.residual / saddle.contrast }
        }
    };
    (look.pixel.distance(predicted) <= expected.most_off_px && colours.meet(image, look.pixel))
        .then_some(look)
}

/// Polarity check of the four squares around a corner.
struct Colours {
    /// Image vectors of one metre along x and along y on the board, pixels.
    steps: [(f64, f64); 2],
    plain_m: f64,
    black_upper_left: bool,
}

impl Colours {
    /// Contrast between white and black: the darker of the two white samples minus the brighter of
    /// the two black ones, gray levels.
    fn contrast(&self, image: &GrayImage, at: Pixel) -> Option<f64> {
        // Sample the middle of the uniform part of each square, but at least one pixel from the
        // edges because of blur.
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
        self.contrast(image, at).is_some_and(|contrast| contrast > MIN_CONTRAST)
    }

    /// The pixel with the largest contrast of the expected polarity within reach.
    fn search(&self, image: &GrayImage, predicted: Pixel, most_off_px: f64) -> Option<Pixel> {
        let reach = most_off_px.min(8.0).ceil() as i32;
        let mut best = (MIN_CONTRAST, None);
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

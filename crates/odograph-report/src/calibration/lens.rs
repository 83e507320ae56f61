//! Drawings of the lens: its distortion and its uncertainty.

use super::drawing::{ImageFrame, PageDrawing};
use odograph::camera::Camera;
use odograph::drawing::scale::{label, round_step};
use odograph::drawing::svg::coordinate;
use odograph::geometry::{Pixel, Ray};
use std::fmt::Write;

/// A grid of straight lines as distorted by the lens, over the same grid through a pinhole camera.
pub fn distortion(camera: &Camera) -> PageDrawing {
    let frame = ImageFrame::new((camera.width(), camera.height()));
    let (reach_x, reach_y) = reach(camera);
    let (focal, middle) = (focal_on_axis_px(camera), camera.principal_px());
    let straight = |ray: Ray| Some(Pixel::new(focal.0 * ray.x + middle.0, focal.1 * ray.y + middle.1));
    let bent = |ray: Ray| camera.pixel_from_ray(ray);
    let step = round_step(2.0 * reach_x.max(reach_y), 16.0);
    let mut content = String::new();
    let mut draw = |class: &str, pixel_of: &dyn Fn(Ray) -> Option<Pixel>| {
        let mut d = String::new();
        let (columns, rows) = ((reach_x / step).ceil() as i32, (reach_y / step).ceil() as i32);
        // Points per line, enough for a smooth curve.
        const POINTS: i32 = 160;
        let mut line = |ray_at: &dyn Fn(f64) -> Ray| {
            let mut pen_down = false;
            for n in -POINTS..=POINTS {
                let pixel = pixel_of(ray_at(f64::from(n) / f64::from(POINTS)));
                match pixel.filter(|pixel| camera.contains(*pixel, -0.5)) {
                    Some(pixel) => {
                        let (x, y) = frame.at(pixel);
                        let _ = write!(
                            d,
                            "{}{} {}",
                            if pen_down { 'L' } else { 'M' },
                            coordinate(x),
                            coordinate(y)
                        );
                        pen_down = true;
                    }
                    None => pen_down = false,
                }
            }
        };
        for column in -columns..=columns {
            line(&|t| Ray::new(f64::from(column) * step, t * f64::from(rows) * step));
        }
        for row in -rows..=rows {
            line(&|t| Ray::new(t * f64::from(columns) * step, f64::from(row) * step));
        }
        let _ = writeln!(content, "<path class=\"{class}\" d=\"{d}\"/>");
    };
    draw("straight", &straight);
    draw("bent", &bent);
    let (x, y) = frame.at(Pixel::new(middle.0, middle.1));
    let _ = writeln!(
        content,
        "<circle class=\"tips\" cx=\"{}\" cy=\"{}\" r=\"5\"/>",
        coordinate(x),
        coordinate(y)
    );
    frame.drawing(&content, 0.0)
}

/// Focal lengths on the optical axis, horizontal and vertical: pixels per unit of the tangent. For
/// a pinhole camera they are the focal lengths themselves.
fn focal_on_axis_px(camera: &Camera) -> (f64, f64) {
    let on_axis = camera.pixel_and_derivative(Ray::new(0.0, 0.0));
    on_axis.map_or(camera.focal_px(), |(_, derivative)| (derivative[(0, 0)], derivative[(1, 1)]))
}

/// Pixels along the image border.
fn border(camera: &Camera) -> impl Iterator<Item = Pixel> {
    let (right, bottom) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    (0..=32).flat_map(move |n| {
        let t = f64::from(n) / 32.0;
        [
            Pixel::new(t * right, 0.0),
            Pixel::new(t * right, bottom),
            Pixel::new(0.0, t * bottom),
            Pixel::new(right, t * bottom),
        ]
    })
}

/// Maximum tangents of the viewing angle, horizontal and vertical; a wide lens is drawn up to 72°.
fn reach(camera: &Camera) -> (f64, f64) {
    const FURTHEST: f64 = 3.0;
    let rays = || border(camera).map(|pixel| camera.ray_from_pixel(pixel));
    let furthest = |along: fn(&Ray) -> f64| {
        rays().fold(0.0, |far: f64, ray| far.max(ray.map_or(FURTHEST, |ray| along(&ray).abs()))).min(FURTHEST)
    };
    (furthest(|ray| ray.x).max(0.01), furthest(|ray| ray.y).max(0.01))
}

/// Maximum displacement by distortion on the image border, pixels, relative to a pinhole camera
/// with the same focal lengths on the axis.
pub fn greatest_displacement_px(camera: &Camera) -> Option<f64> {
    let (focal, middle) = (focal_on_axis_px(camera), camera.principal_px());
    border(camera)
        .map(|pixel| {
            let ray = camera.ray_from_pixel(pixel)?;
            Some(pixel.distance(Pixel::new(focal.0 * ray.x + middle.0, focal.1 * ray.y + middle.1)))
        })
        .try_fold(0.0, |most: f64, displacement| Some(most.max(displacement?)))
}

/// Full horizontal and vertical field of view, radians.
pub fn field_of_view_rad(camera: &Camera) -> Option<(f64, f64)> {
    let (cx, cy) = camera.principal_px();
    let angle = |x: f64, y: f64| {
        let ray = camera.ray_from_pixel(Pixel::new(x, y))?;
        Some(ray.x.hypot(ray.y).atan())
    };
    let (right, bottom) = (camera.width() as f64 - 0.5, camera.height() as f64 - 0.5);
    Some((angle(-0.5, cy)? + angle(right, cy)?, angle(cx, -0.5)? + angle(cx, bottom)?))
}

/// Standard deviation of a point's position in the image, pixels, in the cells of a grid,
/// propagated from the covariance of the calibration.
pub struct ExpectedError {
    size: (usize, usize),
    columns: usize,
    rows: usize,
    /// In row order; `None` where the lens model has no valid pixel.
    errors_px: Vec<Option<f64>>,
}

impl ExpectedError {
    /// In images of this size, from the standard deviation at a pixel (`error_px`).
    pub fn new(size: (usize, usize), error_px: impl Fn(Pixel) -> Option<f64>) -> Self {
        const ALONG: usize = 44;
        let longest = size.0.max(size.1);
        let along = |length: usize| (length * ALONG).div_ceil(longest).max(2);
        let (columns, rows) = (along(size.0), along(size.1));
        let errors_px = (0..columns * rows)
            .map(|cell| {
                let (column, row) = ((cell % columns) as f64, (cell / columns) as f64);
                let pixel = Pixel::new(
                    (column + 0.5) / columns as f64 * size.0 as f64 - 0.5,
                    (row + 0.5) / rows as f64 * size.1 as f64 - 0.5,
                );
                error_px(pixel).filter(|error| error.is_finite() && *error >= 0.0)
            })
            .collect();
        Self { size, columns, rows, errors_px }
    }

    fn known(&self) -> Vec<f64> {
        let mut known: Vec<f64> = self.errors_px.iter().flatten().copied().collect();
        known.sort_by(f64::total_cmp);
        known
    }

    /// Maximum over the image, pixels.
    pub fn worst_px(&self) -> Option<f64> {
        self.known().last().copied()
    }

    /// What the colours are scaled to, pixels. A few cells at the edge of the lens's view may be
    /// worse by a factor of 1000; they must not determine the scale.
    fn range_px(&self) -> (f64, f64) {
        let known = self.known();
        let quantile = |hundredths: usize| known.get(known.len() * hundredths / 100).copied();
        let low = quantile(1).unwrap_or(0.01).max(1e-4);
        (low, quantile(98).unwrap_or(1.0).max(2.0 * low))
    }

    /// What the colours cannot say: which cells are gray, and that the scale does not reach the
    /// worst of them. Empty if there is neither.
    pub fn key(&self) -> String {
        let mut key = String::new();
        let (_, high) = self.range_px();
        if let Some(worst) = self.worst_px().filter(|worst| *worst > 1.5 * high) {
            let _ = write!(
                key,
                " Yellow is {} and more; the worst is {}.",
                pixels_text(high),
                pixels_text(worst)
            );
        }
        if self.errors_px.iter().any(Option::is_none) {
            key.push_str(" Gray: there the lens model has no ray.");
        }
        key
    }

    /// The image coloured by the error, with a colour scale below it and values at nine positions.
    pub fn drawing(&self) -> PageDrawing {
        let frame = ImageFrame::new(self.size);
        let (low, high) = self.range_px();
        let share = |error: f64| ((error.max(low) / low).ln() / (high / low).ln()).clamp(0.0, 1.0);
        let (left, right, top, bottom) = frame.sides();
        let (width, height) = ((right - left) / self.columns as f64, (bottom - top) / self.rows as f64);
        let mut content = String::new();
        for (cell, error) in self.errors_px.iter().enumerate() {
            let (x, y) =
                ((cell % self.columns) as f64 * width + left, (cell / self.columns) as f64 * height + top);
            let fill = error.map_or_else(|| "#8a8f98".to_owned(), |error| heat(share(error)));
            // Slightly larger than the cell, to hide seams.
            let _ = writeln!(
                content,
                "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" fill=\"{fill}\"/>",
                coordinate(x),
                coordinate(y),
                coordinate((width + 0.6).min(right - x)),
                coordinate((height + 0.6).min(bottom - y))
            );
        }
        for (column, row) in [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2)] {
            let (i, j) = (column * (self.columns - 1) / 2, row * (self.rows - 1) / 2);
            let Some(error) = self.errors_px[j * self.columns + i] else { continue };
            let anchor = ["start", "middle", "end"][column];
            let x = [left + 7.0, 0.5 * (left + right), right - 7.0][column];
            let y = [top + 20.0, 0.5 * (top + bottom) + 5.0, bottom - 9.0][row];
            let _ = writeln!(
                content,
                "<text class=\"value\" text-anchor=\"{anchor}\" x=\"{}\" y=\"{}\">{}</text>",
                coordinate(x),
                coordinate(y),
                pixels_text(error)
            );
        }
        self.scale(low, high, &frame, &mut content);
        frame.drawing(&content, 64.0)
    }

    /// The colour scale with round values.
    fn scale(&self, low: f64, high: f64, frame: &ImageFrame, content: &mut String) {
        let (left, right, _, bottom) = frame.sides();
        let top = bottom + 36.0;
        const STEPS: usize = 60;
        let width = (right - left) / STEPS as f64;
        for step in 0..STEPS {
            let x = left + step as f64 * width;
            let _ = writeln!(
                content,
                "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"16\" fill=\"{}\"/>",
                coordinate(x),
                coordinate(top),
                coordinate((width + 0.6).min(right - x)),
                heat((step as f64 + 0.5) / STEPS as f64)
            );
        }
        let decade = low.log10().floor() as i32;
        let values: Vec<f64> = (decade..decade + 9)
            .flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10f64.powi(power)))
            .filter(|value| (low..=high).contains(value))
            .collect();
        // Nine labels fit side by side.
        let every = values.len().div_ceil(9).max(1);
        for value in values.iter().step_by(every) {
            let x = left + (right - left) * (value / low).ln() / (high / low).ln();
            let _ = writeln!(
                content,
                "<line class=\"base\" x1=\"{0}\" x2=\"{0}\" y1=\"{1}\" y2=\"{2}\"/><text text-anchor=\"middle\" x=\"{3}\" y=\"{4}\">{5}</text>",
                coordinate(x),
                coordinate(top + 16.0),
                coordinate(top + 22.0),
                coordinate(x.clamp(left + 24.0, right - 24.0)),
                coordinate(top + 38.0),
                pixels_text(*value)
            );
        }
    }
}

/// Formats an error in pixels with two significant digits.
pub fn pixels_text(pixels: f64) -> String {
    if !pixels.is_finite() {
        return "?".into();
    }
    let step = match pixels.abs() {
        p if p >= 9.95 => 1.0,
        p if p >= 0.995 => 0.1,
        p if p >= 0.0995 => 0.01,
        p if p >= 0.00995 => 0.001,
        _ => 0.0001,
    };
    format!("{} px", label(pixels, step))
}

/// A colour from dark blue (0) over green to yellow (1), perceptually uniform, also in grayscale
/// and for colour-blind readers (the stops are those of matplotlib's viridis).
fn heat(share: f64) -> String {
    const STOPS: [[f64; 3]; 6] = [
        [68.0, 1.0, 84.0],
        [65.0, 68.0, 135.0],
        [42.0, 120.0, 142.0],
        [34.0, 168.0, 132.0],
        [122.0, 209.0, 81.0],
        [253.0, 231.0, 37.0],
    ];
    let at = share.clamp(0.0, 1.0) * (STOPS.len() - 1) as f64;
    let below = (at as usize).min(STOPS.len() - 2);
    let t = at - below as f64;
    let channel = |c: usize| (STOPS[below][c] * (1.0 - t) + STOPS[below + 1][c] * t).round() as u8;
    format!("#{:02x}{:02x}{:02x}", channel(0), channel(1), channel(2))
}

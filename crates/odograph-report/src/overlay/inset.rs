//! The path so far over the ground that was seen, in a corner of the picture, with a scale bar.

use super::lettering::Lettering;
use super::{AGREES, INK, SHADE};
use odograph::camera::Camera;
use odograph::drawing::canvas::{Canvas, Colour};
use odograph::drawing::scale::{length_text, round_step};
use odograph::geometry::{GroundPoint, GroundPose, Pixel};
use odograph_session::OverlayFrame;
use std::collections::HashMap;

/// Cells of ground across the view: more show more of the ground and take longer to draw.
const CELLS_ACROSS: f64 = 48.0;
/// Motion, in widths of the view, after which its ground is drawn again.
const DRAWN_AGAIN: f64 = 0.2;
/// Brightness of the ground under the path, 0 to 1.
const GROUND_SHARE: f32 = 0.55;
/// Share of the inset that the path may fill before the ground in it is shown smaller, and how much
/// more it then shows than is needed.
const FILLED: f64 = 0.86;
const AHEAD: f64 = 1.5;

/// The inset.
pub struct PathInset {
    side_px: usize,
    /// Length of a cell of ground, metres; the colours of those that were seen.
    cell_m: f64,
    ground: HashMap<(i32, i32), Colour>,
    /// Width of the view, metres, and the last pose whose ground was drawn.
    view_m: f64,
    drawn: Option<GroundPose>,
    /// Segments of the path.
    path: Vec<Vec<GroundPoint>>,
    segment: Option<usize>,
    window: Window,
    /// Where the newest frame is, and its heading, radians.
    here: Option<(GroundPoint, f64)>,
    /// Ground and path in the window.
    picture: Canvas,
}

/// The square of ground that is shown, metres.
#[derive(Debug, Clone, Copy)]
struct Window {
    left_m: f64,
    top_m: f64,
    side_m: f64,
}

impl PathInset {
    /// An inset of this side, pixels.
    pub fn new(camera: &Camera, side_px: usize) -> Self {
        // Metres are known with the first pose.
        let window = Window { left_m: 0.0, top_m: 0.0, side_m: 0.0 };
        let view_m = camera.width() as f64 / camera.focal_px().0;
        Self {
            side_px,
            cell_m: 0.0,
            ground: HashMap::new(),
            view_m,
            drawn: None,
            path: Vec::new(),
            segment: None,
            window,
            here: None,
            picture: Canvas::new(side_px, side_px),
        }
    }

    /// Adds a frame.
    pub fn add(&mut self, frame: &OverlayFrame<'_>, camera: &Camera) {
        let (Some(seen), Some(written)) = (&frame.camera.estimate, &frame.written.estimate) else {
            self.here = None;
            self.segment = None;
            return;
        };
        let at = GroundPoint::new(written.pose.x_m, written.pose.y_m);
        if !(at.x_m.is_finite() && at.y_m.is_finite()) {
            return;
        }
        if self.cell_m == 0.0 {
            self.view_m *= seen.pose.height_m;
            self.cell_m = (self.view_m / CELLS_ACROSS).max(1e-6);
            let side_m = 3.0 * self.view_m;
            self.window = Window { left_m: at.x_m - 0.5 * side_m, top_m: at.y_m + 0.5 * side_m, side_m };
            self.picture = self.redrawn();
        }
        let before = match self.path.last().and_then(|segment| segment.last()) {
            Some(before) if self.segment == Some(frame.camera.segment) => Some(*before),
            _ => {
                self.path.push(Vec::new());
                None
            }
        };
        self.segment = Some(frame.camera.segment);
        self.here = Some((at, written.pose.heading_rad));
        let is_new_ground = self.drawn.is_none_or(|drawn| self.is_apart(&drawn, &seen.pose));
        if is_new_ground && frame.camera.ground_pose().is_some() {
            self.add_ground(frame, camera, &seen.pose);
            self.drawn = Some(seen.pose);
        }
        // Points closer than half a pixel show nothing.
        let shortest_m = 0.5 * self.window.side_m / self.side_px as f64;
        let stays = before.is_some_and(|before| distance_m(before, at) < shortest_m);
        if !stays && let Some(segment) = self.path.last_mut() {
            segment.push(at);
        }
        if self.window.holds(at) {
            if !stays && !is_new_ground {
                let window = self.window;
                draw_path(&mut self.picture, &window, self.side_px, &[before.unwrap_or(at), at]);
            } else if is_new_ground {
                self.picture = self.redrawn();
            }
        } else {
            self.window = self.fitted();
            self.picture = self.redrawn();
        }
    }

    fn is_apart(&self, a: &GroundPose, b: &GroundPose) -> bool {
        let moved_m = distance_m(GroundPoint::new(a.x_m, a.y_m), GroundPoint::new(b.x_m, b.y_m));
        moved_m > DRAWN_AGAIN * self.view_m || (a.heading_rad - b.heading_rad).abs() > DRAWN_AGAIN
    }

    /// Takes the colours of the ground in the image.
    fn add_ground(&mut self, frame: &OverlayFrame<'_>, camera: &Camera, pose: &GroundPose) {
        let image = frame.image.rgb();
        let reach = (0.75 * CELLS_ACROSS) as i32;
        let cell = |metres: f64| (metres / self.cell_m).floor().clamp(-1e9, 1e9) as i32;
        let (column, row) = (cell(pose.x_m), cell(pose.y_m));
        let step = (camera.width() as f64 / CELLS_ACROSS / 4.0).max(1.0) as usize;
        for i in column - reach..=column + reach {
            for j in row - reach..=row + reach {
                let middle = |index: i32| (f64::from(index) + 0.5) * self.cell_m;
                let ray = pose.ray_from_ground(GroundPoint::new(middle(i), middle(j)));
                let Some(pixel) = ray.and_then(|ray| camera.pixel_from_ray(ray)) else { continue };
                let margin = 2 * step;
                if camera.contains(pixel, margin as f64 + 1.0) {
                    self.ground.insert((i, j), mean(&image, pixel, step));
                }
            }
        }
    }

    /// The window around the whole path.
    fn fitted(&self) -> Window {
        let points = || self.path.iter().flatten();
        let span = |of: fn(&GroundPoint) -> f64| {
            points()
                .map(of)
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)))
        };
        let ((left_m, right_m), (bottom_m, top_m)) = (span(|point| point.x_m), span(|point| point.y_m));
        let side_m = AHEAD * ((right_m - left_m).max(top_m - bottom_m) + self.view_m);
        Window { left_m: 0.5 * (left_m + right_m - side_m), top_m: 0.5 * (bottom_m + top_m + side_m), side_m }
    }

    /// Ground and path in the window.
    fn redrawn(&self) -> Canvas {
        let mut picture = Canvas::new(self.side_px, self.side_px);
        let Window { left_m, top_m, side_m } = self.window;
        let pixel_m = side_m / self.side_px as f64;
        for y in 0..self.side_px {
            for x in 0..self.side_px {
                picture.set(x, y, SHADE);
                let cell = |metres: f64| (metres / self.cell_m).floor().clamp(-1e9, 1e9) as i32;
                let at =
                    (cell(left_m + (x as f64 + 0.5) * pixel_m), cell(top_m - (y as f64 + 0.5) * pixel_m));
                if let Some(colour) = self.ground.get(&at) {
                    picture.blend(x, y, *colour, GROUND_SHARE);
                }
            }
        }
        for segment in &self.path {
            draw_path(&mut picture, &self.window, self.side_px, segment);
        }
        picture
    }

    /// Draws it at the lower right.
    pub fn draw(&self, canvas: &mut Canvas, lettering: &Lettering) {
        let margin = lettering.line_px() / 3;
        let left = canvas.width().saturating_sub(self.side_px + margin);
        let top = canvas.height().saturating_sub(self.side_px + margin);
        canvas.place(&self.picture, (left, top));
        let unit = lettering.height_px() as f32 / 16.0;
        if let Some((here, heading_rad)) = self.here {
            let (x, y) = self.window.page(here, self.side_px);
            let at = (left as f32 + x, top as f32 + y);
            let ahead = 9.0 * unit;
            let tip = (at.0 + ahead * heading_rad.cos() as f32, at.1 - ahead * heading_rad.sin() as f32);
            canvas.stroke(at, tip, 2.6 * unit, SHADE);
            canvas.disc(at, 4.6 * unit, SHADE);
            canvas.stroke(at, tip, 1.4 * unit, INK);
            canvas.disc(at, 3.4 * unit, INK);
        }
        self.draw_scale(canvas, lettering, (left, top), unit);
    }

    /// A bar of a round length with its label, at the bottom.
    fn draw_scale(&self, canvas: &mut Canvas, lettering: &Lettering, (left, top): (usize, usize), unit: f32) {
        if self.cell_m == 0.0 {
            return;
        }
        let length_m = round_step(self.window.side_m, 5.0);
        let length_px = (length_m / self.window.side_m * self.side_px as f64) as usize;
        let label = length_text(length_m).replace(".00", "").replace(".0 ", " ");
        let margin = lettering.line_px() / 2;
        let width = length_px.max(lettering.width_px(&label));
        let (x, y) = (left + self.side_px - margin - width, top + self.side_px - margin);
        let text_top = y.saturating_sub(lettering.line_px() + margin / 3);
        let pad = margin / 2;
        canvas.shade(
            (x.saturating_sub(pad), text_top.saturating_sub(pad / 2)),
            (width + 2 * pad, y + pad - text_top),
            SHADE,
            0.6,
        );
        lettering.write(canvas, (x, text_top), &label, INK);
        let ends = [x as f32, (x + length_px) as f32];
        let y = y as f32;
        canvas.stroke((ends[0], y), (ends[1], y), 1.0 * unit, INK);
        for end in ends {
            canvas.stroke((end, y - 3.0 * unit), (end, y + 3.0 * unit), 0.8 * unit, INK);
        }
    }
}

impl Window {
    /// Where a point is in a picture of this side, pixels.
    fn page(&self, point: GroundPoint, side_px: usize) -> (f32, f32) {
        let scale = side_px as f64 / self.side_m;
        (((point.x_m - self.left_m) * scale) as f32, ((self.top_m - point.y_m) * scale) as f32)
    }

    /// Whether a point is not too close to the edge.
    fn holds(&self, point: GroundPoint) -> bool {
        let (x, y) =
            (point.x_m - self.left_m - 0.5 * self.side_m, self.top_m - point.y_m - 0.5 * self.side_m);
        x.abs().max(y.abs()) <= 0.5 * FILLED * self.side_m
    }
}

fn draw_path(picture: &mut Canvas, window: &Window, side_px: usize, points: &[GroundPoint]) {
    let half = (side_px as f32 / 180.0).max(0.9);
    for pair in points.windows(2) {
        let [from, to] = [pair[0], pair[1]].map(|point| window.page(point, side_px));
        picture.stroke(from, to, half, AGREES);
    }
}

fn distance_m(a: GroundPoint, b: GroundPoint) -> f64 {
    let (x_m, y_m) = (a.x_m - b.x_m, a.y_m - b.y_m);
    (x_m * x_m + y_m * y_m).sqrt()
}

/// Mean colour around a pixel that is far enough from the edge, of every `step`th of 5×5.
fn mean(image: &odograph::image::RgbImage, pixel: Pixel, step: usize) -> Colour {
    let (x, y) = (pixel.x as usize, pixel.y as usize);
    let mut sums = [0_u32; 3];
    for row in (0..5).map(|k| y + k * step - 2 * step) {
        for column in (0..5).map(|k| x + k * step - 2 * step) {
            let at = 3 * (row * image.width() + column);
            if let Some(samples) = image.samples().get(at..at + 3) {
                sums.iter_mut().zip(samples).for_each(|(sum, sample)| *sum += u32::from(*sample));
            }
        }
    }
    sums.map(|sum| (sum / 25) as u8)
}

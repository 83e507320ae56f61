//! Rendered images of a calibration board with exact ground truth.

use super::noise::{GaussianStream, cell, mix, uniform, value_noise};
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use odograph::camera::Camera;
use odograph::geometry::{Pixel, Ray};
use odograph::image::GrayImage;
use odograph_calibration::{Board, BoardPoint, BoardView, Drawing, Rectangle, SeenPoint};

mod light;
mod poses;
mod recording;

pub use light::{BoardEffects, Occlusion};
pub use poses::Framing;
pub use recording::BoardRecording;

/// A board printed on a white sheet, in front of a cluttered background that is static in the
/// image.
///
/// A pixel is the mean over its area, sampled at 64 points. The points are interpolated bilinearly
/// between the intersections of its four corner rays with the board, which neglects the curvature
/// of lens and perspective within a pixel: less than 0.001 px for common lenses. Pixels that are
/// entirely black, white or background are not sampled.
#[derive(Debug, Clone)]
pub struct BoardScene {
    board: Board,
    camera: Camera,
    drawing: Drawing,
    sheet: Rectangle,
    /// Rays of the corners of all pixels in row order, one more per row and column than pixels; NaN
    /// where the lens model has none.
    rays: Vec<[f64; 2]>,
    /// Background beside the sheet, gray levels.
    background: Vec<f32>,
}

impl BoardScene {
    /// The scene of a board and a camera; `seed` determines the background.
    pub fn new(board: &Board, camera: &Camera, seed: u64) -> Self {
        let drawing = Drawing::new(board);
        let (width, height) = (camera.width(), camera.height());
        let corner = |at: usize| {
            let (column, row) = (at % (width + 1), at / (width + 1));
            let pixel = Pixel::new(column as f64 - 0.5, row as f64 - 0.5);
            camera.ray_from_pixel(pixel).map_or([f64::NAN; 2], |ray| [ray.x, ray.y])
        };
        Self {
            board: *board,
            camera: camera.clone(),
            sheet: sheet(&drawing, board),
            drawing,
            rays: (0..(width + 1) * (height + 1)).map(corner).collect(),
            background: background(width, height, seed),
        }
    }

    /// The calibration board.
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// The camera model.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The middle of the printed pattern, in the board frame.
    fn middle(&self) -> Point3<f64> {
        let Rectangle { from, to } = self.drawing.pattern();
        Point3::new((from.x_m + to.x_m) / 2.0, (from.y_m + to.y_m) / 2.0, 0.0)
    }

    /// True image positions of the board points in front of the camera and inside the image
    /// (including the outer half of its border pixels). For a disc it is the projection of its
    /// centre, which is not the centre of the projected ellipse. Ignores occlusion and mirroring by
    /// [`BoardEffects`].
    pub fn true_view(&self, camera_from_board: &Isometry3<f64>) -> BoardView {
        let points = self.board.points().into_iter().enumerate();
        let seen = points.filter_map(|(index, point)| {
            let pixel = self.project(camera_from_board, point)?;
            self.camera.contains(pixel, -0.5).then_some(SeenPoint { index, pixel })
        });
        BoardView { size: (self.camera.width(), self.camera.height()), points: seen.collect() }
    }

    /// Projection of a point of the board plane; may lie outside the image. `None` behind the
    /// camera and outside the lens model.
    pub fn project(&self, camera_from_board: &Isometry3<f64>, point: BoardPoint) -> Option<Pixel> {
        let at = camera_from_board * Point3::new(point.x_m, point.y_m, 0.0);
        if at.z <= 0.0 {
            return None;
        }
        self.camera.pixel_from_ray(Ray::new(at.x / at.z, at.y / at.z))
    }

    /// Renders the image of the board at a pose.
    pub fn render(&self, camera_from_board: &Isometry3<f64>, effects: &BoardEffects) -> GrayImage {
        let (width, height) = (self.camera.width(), self.camera.height());
        let mut light = vec![0.0f32; width * height];
        self.expose(camera_from_board, effects, &mut light);
        effects.develop(width, height, light)
    }

    /// Fills `light` with gray levels before any effect of illumination, lens or sensor.
    fn expose(&self, camera_from_board: &Isometry3<f64>, effects: &BoardEffects, light: &mut [f32]) {
        let width = self.camera.width();
        let rotation = camera_from_board.rotation.to_rotation_matrix();
        // A point (x, y) of the board lies on the ray H (x, y, 1), so H⁻¹ · ray is (x, y, 1)
        // divided by its depth.
        let camera_from_plane = Matrix3::from_columns(&[
            rotation.matrix().column(0).into_owned(),
            rotation.matrix().column(1).into_owned(),
            camera_from_board.translation.vector,
        ]);
        let Some(plane_from_camera) = camera_from_plane.try_inverse() else {
            // The board plane contains the camera centre: its image is a line at most.
            light.copy_from_slice(&self.background);
            return;
        };
        let meet = |ray: &[f64; 2]| {
            let at = plane_from_camera * Vector3::new(ray[0], ray[1], 1.0);
            let scale = if at.z > 0.0 { 1.0 / at.z } else { f64::NAN };
            BoardPoint { x_m: at.x * scale, y_m: at.y * scale }
        };
        let (black, white) = (effects.black_gray as f32, effects.white_gray as f32);
        let meet_row = |row: usize| -> Vec<BoardPoint> {
            self.rays[row * (width + 1)..(row + 1) * (width + 1)].iter().map(meet).collect()
        };
        let mut above = meet_row(0);
        for (row, (light, background)) in
            light.chunks_exact_mut(width).zip(self.background.chunks_exact(width)).enumerate()
        {
            let below = meet_row(row + 1);
            for (column, (light, background)) in light.iter_mut().zip(background).enumerate() {
                let corners = [above[column], above[column + 1], below[column], below[column + 1]];
                let (dark, paper) = self.shares(&corners);
                *light = dark * black + (paper - dark) * white + (1.0 - paper) * background;
            }
            above = below;
        }
    }

    /// Fractions of a pixel that are black and on the sheet, from the intersections of its corner
    /// rays with the board plane.
    fn shares(&self, corners: &[BoardPoint; 4]) -> (f32, f32) {
        let bound = |of: fn(&BoardPoint) -> f64, pick: fn(f64, f64) -> f64| {
            corners.iter().map(of).reduce(pick).unwrap_or(f64::NAN)
        };
        if corners.iter().any(|corner| corner.x_m.is_nan()) {
            return (0.0, 0.0);
        }
        let x = |corner: &BoardPoint| corner.x_m;
        let y = |corner: &BoardPoint| corner.y_m;
        let area = Rectangle {
            from: BoardPoint { x_m: bound(x, f64::min), y_m: bound(y, f64::min) },
            to: BoardPoint { x_m: bound(x, f64::max), y_m: bound(y, f64::max) },
        };
        let Rectangle { from, to } = self.sheet;
        let apart = area.to.x_m < from.x_m
            || area.to.y_m < from.y_m
            || area.from.x_m >= to.x_m
            || area.from.y_m >= to.y_m;
        if apart {
            return (0.0, 0.0);
        }
        let on_the_sheet = self.sheet.contains(area.from) && self.sheet.contains(area.to);
        if on_the_sheet && let Some(black) = self.drawing.is_black_all_over(area) {
            return (if black { 1.0 } else { 0.0 }, 1.0);
        }
        let (mut dark, mut paper) = (0, 0);
        for place in 0..PLACES {
            let (u, v) = place_in_pixel(place);
            let between = |of: fn(&BoardPoint) -> f64| {
                let upper = of(&corners[0]) * (1.0 - u) + of(&corners[1]) * u;
                let lower = of(&corners[2]) * (1.0 - u) + of(&corners[3]) * u;
                upper * (1.0 - v) + lower * v
            };
            let point = BoardPoint { x_m: between(x), y_m: between(y) };
            dark += u32::from(self.drawing.is_black(point));
            paper += u32::from(self.sheet.contains(point));
        }
        (dark as f32 / PLACES as f32, paper as f32 / PLACES as f32)
    }
}

/// Sample points per pixel that is not of one colour.
const PLACES: usize = 64;

/// Rank-one lattice. Every point has its own column and row, so that an edge parallel to a side of
/// the pixel is resolved to 1/64 pixel; the generator 19 spreads the points evenly.
fn place_in_pixel(place: usize) -> (f64, f64) {
    let at = |n: usize| ((n % PLACES) as f64 + 0.5) / PLACES as f64;
    (at(place), at(place * 19))
}

/// The white sheet around the pattern: the board's quiet zone, and at least one square of white
/// (half a square for boards that may be partially visible).
fn sheet(drawing: &Drawing, board: &Board) -> Rectangle {
    let pattern = drawing.pattern();
    let by_m = drawing.quiet_m().max(board.spacing_m() * if board.may_be_partial() { 0.5 } else { 1.0 });
    Rectangle {
        from: BoardPoint { x_m: pattern.from.x_m - by_m, y_m: pattern.from.y_m - by_m },
        to: BoardPoint { x_m: pattern.to.x_m + by_m, y_m: pattern.to.y_m + by_m },
    }
}

/// Cluttered background: blotches of two sizes (out of focus) and sharp rectangles in random
/// orientations.
fn background(width: usize, height: usize, seed: u64) -> Vec<f32> {
    let diagonal_px = (width as f64).hypot(height as f64);
    let (coarse, fine) = (mix(seed ^ 1) as u32, mix(seed ^ 2) as u32);
    let mut gray: Vec<f32> = (0..width * height)
        .map(|at| {
            let (x, y) = ((at % width) as f64, (at / width) as f64);
            let grain = cell(fine, x as i32, y as i32) - 0.5;
            118.0
                + 55.0 * value_noise(coarse, 12.0 * x / diagonal_px, 12.0 * y / diagonal_px)
                + 20.0 * value_noise(fine, 90.0 * x / diagonal_px, 90.0 * y / diagonal_px)
                + 6.0 * grain
        })
        .collect();
    for thing in 0..14 {
        let draw = |index: u64| uniform(seed ^ 0x7411, 8 * thing + index);
        let (center_x, center_y) = (draw(0) * width as f64, draw(1) * height as f64);
        let (half_x, half_y) =
            (diagonal_px * (0.01 + 0.06 * draw(2)), diagonal_px * (0.005 + 0.03 * draw(3)));
        let (sin, cos) = (std::f64::consts::TAU * draw(4)).sin_cos();
        let level = 40.0 + 170.0 * draw(5) as f32;
        let reach = half_x.hypot(half_y) + 1.0;
        let span = |center: f64, size: usize| {
            (center - reach).max(0.0) as usize..((center + reach).max(0.0) as usize).min(size)
        };
        for row in span(center_y, height) {
            for column in span(center_x, width) {
                let (dx, dy) = (column as f64 - center_x, row as f64 - center_y);
                let outside_px =
                    ((cos * dx + sin * dy).abs() - half_x).max((cos * dy - sin * dx).abs() - half_y);
                let covered = (0.5 - outside_px).clamp(0.0, 1.0) as f32;
                let sample = &mut gray[row * width + column];
                *sample += covered * (level - *sample);
            }
        }
    }
    gray
}

#[cfg(test)]
mod tests;

//! Approximate board poses for the selection of views: one homography per view and one nominal
//! pinhole camera without distortion.

use crate::{Board, BoardPoint, BoardView};
use nalgebra::{Matrix3, SMatrix, Vector3};
use odograph::geometry::Pixel;

/// A view with its homography.
#[derive(Debug, Clone)]
pub struct NominalView {
    /// Width and height of the image, pixels.
    pub size: (usize, usize),
    /// Board points with their detected pixels.
    pub points: Vec<(BoardPoint, Pixel)>,
    /// Homography from board coordinates (metres) to pixels relative to the image centre.
    image_from_board: Matrix3<f64>,
    /// Homography of the board rotated by 180°, for boards whose orientation is ambiguous.
    turned: Option<Matrix3<f64>>,
}

/// Pose of the board in the frame of a nominal camera.
#[derive(Debug, Clone, Copy)]
pub struct NominalPose {
    pub camera_from_board: Matrix3<f64>,
    pub translation_m: Vector3<f64>,
}

impl NominalView {
    /// `None` if the points do not determine a homography.
    pub fn new(board: &Board, view: &BoardView) -> Option<Self> {
        let all = board.points();
        let points: Vec<(BoardPoint, Pixel)> =
            view.points.iter().filter_map(|seen| Some((*all.get(seen.index)?, seen.pixel))).collect();
        let size = view.size;
        let image_from_board = homography(&points, size)?;
        // Boards with markers have a unique orientation. So has a chessboard with one odd and one
        // even count, but not every detector uses it.
        let turned = (!board.may_be_partial()).then(|| {
            let (first, last) = (all[0], all[all.len() - 1]);
            let (x_m, y_m) = (first.x_m + last.x_m, first.y_m + last.y_m);
            image_from_board * Matrix3::new(-1.0, 0.0, x_m, 0.0, -1.0, y_m, 0.0, 0.0, 1.0)
        });
        Some(Self { size, points, image_from_board, turned })
    }

    /// Diagonal of the image, pixels.
    pub fn diagonal_px(&self) -> f64 {
        (self.size.0 as f64).hypot(self.size.1 as f64)
    }

    /// RMS distance between this view's points and their positions in the other view, pixels.
    pub fn displacement_px(&self, other: &Self) -> f64 {
        let by = |image_from_board: &Matrix3<f64>| {
            let squares: f64 = self
                .points
                .iter()
                .map(|(point, pixel)| {
                    let there = applied(image_from_board, *point, self.size);
                    there.map_or(f64::INFINITY, |there| pixel.distance(there).powi(2))
                })
                .sum();
            (squares / self.points.len() as f64).sqrt()
        };
        let straight = by(&other.image_from_board);
        other.turned.as_ref().map_or(straight, |turned| straight.min(by(turned)))
    }

    /// Angle between the board normals of the two views for a camera with the default focal length,
    /// radians.
    pub fn turn_rad(&self, other: &Self) -> f64 {
        let focal_px = ORDINARY_FOCAL * self.size.0.max(self.size.1) as f64;
        match (self.pose(focal_px), other.pose(focal_px)) {
            (Some(one), Some(two)) => one.normal().dot(&two.normal()).clamp(-1.0, 1.0).acos(),
            _ => 0.0,
        }
    }

    /// Pose of the board for a pinhole with this focal length and a centred principal point (Z.
    /// Zhang, "A flexible new technique for camera calibration", 2000, section 3.1).
    pub fn pose(&self, focal_px: f64) -> Option<NominalPose> {
        let normalised = Matrix3::from_diagonal(&Vector3::new(1.0 / focal_px, 1.0 / focal_px, 1.0))
            * self.image_from_board;
        let (first, second, third) = (
            normalised.column(0).into_owned(),
            normalised.column(1).into_owned(),
            normalised.column(2).into_owned(),
        );
        let size = 0.5 * (first.norm() + second.norm());
        let scale = if third.z < 0.0 { -1.0 / size } else { 1.0 / size };
        let (x, y) = (first * scale, second * scale);
        let rotation = Matrix3::from_columns(&[x, y, x.cross(&y)]);
        let svd = rotation.svd(true, true);
        let rotation = svd.u? * svd.v_t?;
        let translation_m = third * scale;
        let usable = rotation.determinant() > 0.0
            && rotation.iter().chain(translation_m.iter()).all(|v| v.is_finite())
            && translation_m.z > 0.0;
        usable.then_some(NominalPose { camera_from_board: rotation, translation_m })
    }

    /// Two equations `a u + b = 0` for `u = 1/f²` from the orthogonality and the equal length of
    /// the board axes (Zhang, equations 3 and 4, for square pixels and a centred principal point).
    fn focal_equations(&self) -> [(f64, f64); 2] {
        let h = &self.image_from_board;
        let (a, b, c) = (h[(0, 0)], h[(1, 0)], h[(2, 0)]);
        let (d, e, g) = (h[(0, 1)], h[(1, 1)], h[(2, 1)]);
        // Near and far views get equal weight.
        let weight = 1.0 / (a * a + b * b + d * d + e * e);
        [
            (weight * (a * d + b * e), weight * c * g),
            (weight * (a * a + b * b - d * d - e * e), weight * (c * c - g * g)),
        ]
    }
}

impl NominalPose {
    /// The board normal, pointing away from the camera, in the camera frame.
    pub fn normal(&self) -> Vector3<f64> {
        self.camera_from_board.column(2).into_owned()
    }
}

/// Default focal length, in image widths; a field of view of 58°.
const ORDINARY_FOCAL: f64 = 0.9;

/// Closed-form focal length from all views, pixels. Falls back to the default if the views do not
/// determine it (all of them fronto-parallel).
pub fn nominal_focal_px<'a>(views: impl Iterator<Item = &'a NominalView>) -> f64 {
    let (mut products, mut squares, mut side) = (0.0, 0.0, 1.0);
    for seen in views {
        side = seen.size.0.max(seen.size.1) as f64;
        for (a, b) in seen.focal_equations() {
            if (a * b).is_finite() {
                products += a * b;
                squares += a * a;
            }
        }
    }
    let focal_px = (-squares / products).sqrt();
    if focal_px.is_finite() { focal_px.clamp(0.25 * side, 8.0 * side) } else { ORDINARY_FOCAL * side }
}

fn middle(size: (usize, usize)) -> (f64, f64) {
    (0.5 * (size.0 as f64 - 1.0), 0.5 * (size.1 as f64 - 1.0))
}

fn applied(image_from_board: &Matrix3<f64>, point: BoardPoint, size: (usize, usize)) -> Option<Pixel> {
    let at = image_from_board * Vector3::new(point.x_m, point.y_m, 1.0);
    let (x, y) = (at.x / at.z, at.y / at.z);
    let (cx, cy) = middle(size);
    (x.is_finite() && y.is_finite()).then(|| Pixel::new(x + cx, y + cy))
}

/// The homography from board points to pixels relative to the image centre: direct linear transform
/// with normalised points (R. Hartley, "In defense of the eight-point algorithm", 1997). The sign
/// is chosen so that the board is in front of the camera.
fn homography(points: &[(BoardPoint, Pixel)], size: (usize, usize)) -> Option<Matrix3<f64>> {
    if points.len() < 4 {
        return None;
    }
    let (cx, cy) = middle(size);
    let board = normalisation(points.iter().map(|(b, _)| (b.x_m, b.y_m)))?;
    let image = normalisation(points.iter().map(|(_, p)| (p.x - cx, p.y - cy)))?;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (b, p) in points {
        let from = board * Vector3::new(b.x_m, b.y_m, 1.0);
        let to = image * Vector3::new(p.x - cx, p.y - cy, 1.0);
        for (row, target) in [(0, to.x), (1, to.y)] {
            let mut equation = nalgebra::SVector::<f64, 9>::zeros();
            for i in 0..3 {
                equation[3 * row + i] = from[i];
                equation[6 + i] = -target * from[i];
            }
            normal.ger(1.0, &equation, &equation, 1.0);
        }
    }
    let eigen = normal.symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    // The null space has a second dimension: the points are collinear.
    if eigen.eigenvalues[order[1]] < 1e-9 * points.len() as f64 {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let normalised = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    let homography = image.try_inverse()? * normalised * board;
    let (first, _) = points.first()?;
    let before = (homography * Vector3::new(first.x_m, first.y_m, 1.0)).z;
    let homography = homography * before.signum();
    homography.iter().all(|v| v.is_finite()).then_some(homography)
}

/// The similarity transform that moves the centroid to the origin and scales the mean squared
/// distance from it to two.
fn normalisation(points: impl Iterator<Item = (f64, f64)> + Clone) -> Option<Matrix3<f64>> {
    let count = points.clone().count() as f64;
    let (x, y) = points.clone().fold((0.0, 0.0), |(x, y), p| (x + p.0 / count, y + p.1 / count));
    let squares: f64 = points.map(|p| ((p.0 - x).powi(2) + (p.1 - y).powi(2)) / count).sum();
    let scale = (2.0 / squares).sqrt();
    scale.is_finite().then(|| Matrix3::new(scale, 0.0, -scale * x, 0.0, scale, -scale * y, 0.0, 0.0, 1.0))
}

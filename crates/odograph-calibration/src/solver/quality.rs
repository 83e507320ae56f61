//! Uncertainty of a calibration: covariance of the parameters and expected ray error over the
//! image.

use super::bundle::{BoardCorrespondence, Bundle, SHARED, counts_in_full, residuals};
use super::fit::{LensFit, chosen};
use super::lens::{Free, Lens};
use nalgebra::{DMatrix, Matrix2x3, Matrix3, Rotation3, SMatrix, Vector2, Vector3};
use odograph::camera::Camera;
use odograph::geometry::Pixel;

/// Covariance of the shared unknowns of a fit, with the poses marginalised out.
///
/// It is the inverse of the information matrix, scaled by the residual variance with the correction
/// for a robust loss (P. Huber, "Robust statistics", 1981, section 7.6): `σ² · (mean of w² r²) /
/// (mean of ψ')²`. For this loss the mean of ψ' over both axes is the share of inliers: beyond the
/// threshold, the negative derivative along the residual cancels the positive one across it.
pub fn covariance(fit: &LensFit, sights: &[Vec<BoardCorrespondence>]) -> DMatrix<f64> {
    let views = chosen(sights, &fit.views);
    let count = fit.unknowns.shared();
    let (mut squares, mut weights, mut within, mut points) = (0.0, 0.0, 0.0, 0.0);
    for (view, pose) in views.iter().zip(&fit.state.poses) {
        for (dx, dy) in residuals(&fit.state.lens, &fit.state.shape, pose, view).flatten() {
            let deviations = dx.hypot(dy) / fit.noise_px;
            let weight = if counts_in_full(deviations) { 1.0 } else { (3.0 / deviations).powi(2) };
            squares += (weight * deviations).powi(2);
            weights += weight;
            within += if counts_in_full(deviations) { 1.0 } else { 0.0 };
            points += 1.0;
        }
    }
    let freedom = (2.0 * points - (count + 6 * views.len()) as f64).max(1.0);
    let share: f64 = within / points;
    let factor = squares / freedom * (weights / points) / (share * share);
    let bundle = Bundle { views: &views, unknowns: &fit.unknowns, noise_px: fit.noise_px };
    let Some(information) = bundle.information(&fit.state) else {
        return DMatrix::from_diagonal_element(count, count, 1e12);
    };
    // Scaled to a unit diagonal. Unconstrained directions get a large but finite variance.
    let scale: Vec<f64> = (0..SHARED).map(|i| 1.0 / information[(i, i)].max(1e-300).sqrt()).collect();
    let scaled = DMatrix::from_fn(count, count, |i, j| information[(i, j)] * scale[i] * scale[j]);
    let eigen = scaled.symmetric_eigen();
    let inverse = eigen.eigenvalues.map(|value| 1.0 / value.max(1e-13));
    let inverse = &eigen.eigenvectors * DMatrix::from_diagonal(&inverse) * eigen.eigenvectors.transpose();
    DMatrix::from_fn(count, count, |i, j| inverse[(i, j)] * scale[i] * scale[j] * factor)
}

/// Expected ray error over the image, from the covariance of the lens parameters.
#[derive(Debug, Clone)]
pub struct ErrorMap {
    lens: Lens,
    free: Vec<Free>,
    covariance: DMatrix<f64>,
    /// Derivative of the best-aligning camera rotation with respect to the free parameters; 3 rows.
    rotation_by_free: DMatrix<f64>,
    over_image_px: f64,
}

/// Columns and rows of the evaluation grid over the image.
const ACROSS: usize = 16;
const DOWN: usize = 12;

fn places(camera: &Camera) -> impl Iterator<Item = Pixel> + use<> {
    let part = (camera.width() as f64 / ACROSS as f64, camera.height() as f64 / DOWN as f64);
    let middle = move |i: usize, part: f64| (i as f64 + 0.5) * part - 0.5;
    (0..DOWN * ACROSS).map(move |at| Pixel::new(middle(at % ACROSS, part.0), middle(at / ACROSS, part.1)))
}

/// RMS distance over the image between the projections of the same directions by two cameras,
/// pixels, after the best-aligning rotation. Infinite if the overlap of their fields of view is too
/// small.
pub fn disagreement_px(camera: &Camera, other: &Lens) -> f64 {
    let rays: Vec<(Pixel, Vector3<f64>)> = places(camera)
        .filter_map(|pixel| Some((pixel, camera.ray_from_pixel(pixel)?.vector().normalize())))
        .collect();
    let mut rotation = Rotation3::identity();
    // Gauss–Newton from the identity; cameras fitted to the same views are nearly aligned.
    for _ in 0..5 {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (pixel, ray) in &rays {
            let turned = rotation * ray;
            let Some(seen) = other.project(&turned) else { continue };
            let by_rotation = -(seen.by_point * turned.cross_matrix());
            normal += by_rotation.transpose() * by_rotation;
            right += by_rotation.transpose() * Vector2::new(pixel.x - seen.pixel[0], pixel.y - seen.pixel[1]);
        }
        let Some(inverse) = normal.try_inverse() else { return f64::INFINITY };
        rotation = Rotation3::from_scaled_axis(inverse * right) * rotation;
    }
    let (mut squares, mut count) = (0.0, 0.0);
    for (pixel, ray) in &rays {
        if let Some([x, y]) = other.pixel(&(rotation * ray)) {
            squares += (pixel.x - x).powi(2) + (pixel.y - y).powi(2);
            count += 1.0;
        }
    }
    if count > 0.0 { (squares / count).sqrt() } else { f64::INFINITY }
}

impl ErrorMap {
    /// Error map of a lens with the covariance of its free parameters.
    pub fn new(camera: &Camera, lens: &Lens, free: &[Free], covariance: DMatrix<f64>) -> Self {
        let count = free.len();
        let covariance = covariance.view((0, 0), (count, count)).into_owned();
        let mut map = Self {
            lens: *lens,
            free: free.to_vec(),
            covariance,
            rotation_by_free: DMatrix::zeros(3, count),
            over_image_px: f64::INFINITY,
        };
        let grid: Vec<(DMatrix<f64>, Matrix2x3<f64>)> =
            places(camera).filter_map(|pixel| map.derivatives(camera, pixel)).collect();
        // Least squares over the grid: minimise |Jθ δθ + Jω ω|².
        let mut normal = Matrix3::<f64>::zeros();
        let mut right = DMatrix::<f64>::zeros(3, count);
        for (by_free, by_rotation) in &grid {
            normal += by_rotation.transpose() * by_rotation;
            right += DMatrix::from_fn(3, 2, |i, j| by_rotation[(j, i)]) * by_free;
        }
        if let Some(inverse) = normal.try_inverse() {
            map.rotation_by_free = -(DMatrix::from_fn(3, 3, |i, j| inverse[(i, j)]) * right);
            let squares =
                grid.iter().map(|(by_free, by_rotation)| map.square(by_free, by_rotation)).sum::<f64>();
            map.over_image_px = (squares / grid.len() as f64).sqrt();
        }
        map
    }

    fn derivatives(&self, camera: &Camera, pixel: Pixel) -> Option<(DMatrix<f64>, Matrix2x3<f64>)> {
        let ray = camera.ray_from_pixel(pixel)?.vector().normalize();
        let projection = self.lens.project(&ray)?;
        let by_free = DMatrix::from_fn(2, self.free.len(), |axis, i| {
            let Free { at, also, .. } = self.free[i];
            projection.by_numbers[axis][at] + also.map_or(0.0, |also| projection.by_numbers[axis][also])
        });
        let cross: SMatrix<f64, 3, 3> = ray.cross_matrix();
        Some((by_free, -(projection.by_point * cross)))
    }

    fn square(&self, by_free: &DMatrix<f64>, by_rotation: &Matrix2x3<f64>) -> f64 {
        let by_rotation = DMatrix::from_fn(2, 3, |i, j| by_rotation[(i, j)]);
        let all = by_free + by_rotation * &self.rotation_by_free;
        (&all * &self.covariance * all.transpose()).trace().max(0.0)
    }

    pub fn expected_error_px(&self, camera: &Camera, pixel: Pixel) -> Option<f64> {
        let (by_free, by_rotation) = self.derivatives(camera, pixel)?;
        Some(self.square(&by_free, &by_rotation).sqrt())
    }

    pub fn over_image_px(&self) -> f64 {
        self.over_image_px
    }
}

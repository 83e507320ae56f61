//! How far a calibration can be trusted: covariance, the error of rays over the image, and the verdict.

use super::bundle::{Bundle, SHARED, Sight, counts_in_full, residuals};
use super::fit::Fit;
use super::lens::{Free, Lens};
use crate::camera::Camera;
use crate::geometry::Pixel;
use nalgebra::{DMatrix, Matrix2x3, Matrix3, SMatrix};

/// Covariance of the shared unknowns of a fit, poses eliminated.
///
/// The inverse of the information, with the noise that the weighted residuals tell and the correction for a robust loss (P. Huber,
/// "Robust statistics", 1981, section 7.6): `σ² · (mean of w² r²) / (mean of ψ')²`. For this loss the mean of ψ' over both
/// directions is the share of points within the bend: beyond it, what is lost along the residual is won across it.
pub fn covariance(fit: &Fit, sights: &[Vec<Sight>]) -> DMatrix<f64> {
    let views: Vec<&[Sight]> = fit.views.iter().map(|&view| sights[view].as_slice()).collect();
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
    // Scaled to a diagonal of ones; directions that the views say nothing about get a large, finite variance.
    let scale: Vec<f64> = (0..SHARED).map(|i| 1.0 / information[(i, i)].max(1e-300).sqrt()).collect();
    let scaled = DMatrix::from_fn(count, count, |i, j| information[(i, j)] * scale[i] * scale[j]);
    let eigen = scaled.symmetric_eigen();
    let inverse = eigen.eigenvalues.map(|value| 1.0 / value.max(1e-13));
    let inverse = &eigen.eigenvectors * DMatrix::from_diagonal(&inverse) * eigen.eigenvectors.transpose();
    DMatrix::from_fn(count, count, |i, j| inverse[(i, j)] * scale[i] * scale[j] * factor)
}

/// Error of rays over the image from the covariance of the lens.
#[derive(Debug, Clone)]
pub struct ErrorMap {
    lens: Lens,
    free: Vec<Free>,
    covariance: DMatrix<f64>,
    /// The rotation of the camera that best undoes a change of the free numbers: 3 rows.
    rotation_by_free: DMatrix<f64>,
    over_image_px: f64,
}

/// The image is asked at this many places across and down.
const ACROSS: usize = 17;
const DOWN: usize = 13;

impl ErrorMap {
    /// Of a lens with the covariance of its free numbers.
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
        let mut grid: Vec<(DMatrix<f64>, Matrix2x3<f64>)> = Vec::new();
        for (i, j) in (0..DOWN).flat_map(|i| (0..ACROSS).map(move |j| (i, j))) {
            let x = (camera.width() as f64 - 1.0) * j as f64 / (ACROSS - 1) as f64;
            let y = (camera.height() as f64 - 1.0) * i as f64 / (DOWN - 1) as f64;
            grid.extend(map.derivatives(camera, Pixel::new(x, y)));
        }
        // Least squares over the grid: of Jθ δθ + Jω ω as little as possible.
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

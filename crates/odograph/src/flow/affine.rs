//! Dissimilarity of Shi and Tomasi: comparison with the first appearance under an affine warp.

use super::level_template::LevelTemplate;
use super::patch::{AREA, SIDE, Samples, TO_CENTRE, sample};
use super::template::Template;
use super::track;
use super::{Track, Warp};
use crate::geometry::Pixel;
use crate::image::Pyramid;
use crate::image::simd::{dot, plane_and_energy};
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Most Gauss–Newton steps; the start is within a pixel of the solution. Not derived; chosen.
const ITERATIONS: usize = 8;

/// Registers a tracked template against its first appearance under an affine warp (J. Shi and C.
/// Tomasi, 1994, equation 5) with unknown gain and light, from `start`. Returns the refined warp
/// and the match. Its interpolation bias is not corrected.
///
/// `None` where the patch leaves the image or is deformed too much to be the same surface.
pub fn dissimilarity(template: &Template, image: &Pyramid, start: &Warp) -> Option<(Warp, Track)> {
    let patch = template.finest();
    let inverse_hessian = affine_hessian(patch).try_inverse()?;
    let mut warp = *start;
    let mut samples: Samples = [0.0; AREA];
    for _ in 0..ITERATIONS {
        // On level 0 the patch and the template have the same centre.
        if !sample(image.base(), Vector2::new(warp.position.x, warp.position.y), &warp.linear, &mut samples) {
            return None;
        }
        let gain = dot(&patch.appearance().contrast, &samples) / patch.contrast_energy;
        if gain < 0.05 {
            return None;
        }
        let (plane, _) = plane_and_energy(&samples);
        let by_place = if patch.is_in_uneven_light() { plane.slope } else { [0.0; 2] };
        let mut slope = SVector::<f64, 6>::zeros();
        for (at, &value) in samples.iter().enumerate() {
            let (x, y) = place(at);
            let light = plane.mean + by_place[0] * x + by_place[1] * y;
            let residual = (f64::from(value) - light) / gain - f64::from(patch.appearance().contrast[at]);
            slope += steepest_descent(patch, at) * residual;
        }
        let step = inverse_hessian * slope;
        let grow = Matrix2::new(1.0 + step[2], step[3], step[4], 1.0 + step[5]);
        let linear = warp.linear * grow.try_inverse()?;
        let shift = linear * Vector2::new(step[0], step[1]);
        let deformed = (start.linear.try_inverse()? * linear - Matrix2::identity()).norm();
        warp = Warp { position: Pixel::new(warp.position.x - shift.x, warp.position.y - shift.y), linear };
        let moved = warp.position.distance(start.position);
        if deformed > 0.5 || moved > TO_CENTRE || moved.is_nan() || deformed.is_nan() {
            return None;
        }
        if step.norm() < 1e-3 {
            break;
        }
    }
    let product = dot(&patch.appearance().contrast, &samples);
    let dissimilarity = track::dissimilarity(patch, product, &samples);
    let position = warp.position;
    let noise = template.noise(Vector2::new(position.x, position.y), &warp.linear, dissimilarity);
    let covariance_px2 = noise.covariance(&warp.linear);
    Some((warp, Track { position, dissimilarity, covariance_px2, noise }))
}

/// Steepest-descent image at sample `at`: derivative by the shift (x, y) and the affine terms (xx,
/// xy, yx, yy).
fn steepest_descent(patch: &LevelTemplate, at: usize) -> SVector<f64, 6> {
    let (gx, gy) =
        (f64::from(patch.appearance().gradient_x[at]), f64::from(patch.appearance().gradient_y[at]));
    let (x, y) = place(at);
    SVector::from([gx, gy, gx * x, gx * y, gy * x, gy * y])
}

/// Sample `at` relative to the centre of the patch.
fn place(at: usize) -> (f64, f64) {
    ((at % SIDE) as f64 - TO_CENTRE, (at / SIDE) as f64 - TO_CENTRE)
}

fn affine_hessian(patch: &LevelTemplate) -> SMatrix<f64, 6, 6> {
    (0..AREA).map(|at| steepest_descent(patch, at)).map(|d| d * d.transpose()).sum()
}

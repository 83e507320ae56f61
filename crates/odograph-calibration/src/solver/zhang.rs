//! Homographies of the board, poses from homographies, and Zhang's closed-form camera.

use super::bundle::BoardCorrespondence;
use nalgebra::{DMatrix, Isometry3, Matrix3, Rotation3, SMatrix, Translation3, UnitQuaternion, Vector3};

/// The homography `direction ~ H (x, y, 1)` from board points to ray directions, by the direct
/// linear transform: `b × H X = 0` for every pair, least squares with `|H| = 1` (R. Hartley and A.
/// Zisserman, "Multiple View Geometry", 2004, section 4.1). The board points are normalised first
/// (section 4.4). Directions may be more than 90° from the optical axis.
///
/// The sign is chosen so that the points are in front of the camera. `None` if the points do not
/// determine the homography.
pub fn homography(pairs: &[((f64, f64), Vector3<f64>)]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let count = pairs.len() as f64;
    let mean = |f: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(|(board, _)| f(board)).sum::<f64>() / count;
    let (x0, y0) = (mean(&|b| b.0), mean(&|b| b.1));
    let spread = mean(&|b| (b.0 - x0).hypot(b.1 - y0)) / std::f64::consts::SQRT_2;
    if spread <= 0.0 {
        return None;
    }
    // |b × H X|² = (H X)ᵀ (1 − b bᵀ) (H X): a sum of Kronecker products over the nine entries of H.
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for (board, direction) in pairs {
        let point = Vector3::new((board.0 - x0) / spread, (board.1 - y0) / spread, 1.0);
        let across = Matrix3::identity() - direction * direction.transpose();
        let outer = point * point.transpose();
        for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
            let mut block = sum.fixed_view_mut::<3, 3>(3 * i, 3 * j);
            block += outer * across[(i, j)];
        }
    }
    let eigen = sum.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = eigen.eigenvectors.column(least);
    let normalised = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    let shift = Matrix3::new(1.0 / spread, 0.0, -x0 / spread, 0.0, 1.0 / spread, -y0 / spread, 0.0, 0.0, 1.0);
    let h = normalised * shift;
    let ahead: f64 =
        pairs.iter().map(|(b, direction)| direction.dot(&(h * Vector3::new(b.0, b.1, 1.0)))).sum();
    let h = if ahead < 0.0 { -h } else { h };
    h.iter().all(|number| number.is_finite()).then_some(h)
}

/// The pose from a homography of ray directions (Z. Zhang, "A flexible new technique for camera
/// calibration", 2000, section 3.1). Up to scale, the first two columns are the x and y axes of the
/// board and the third is the translation. The rotation is projected onto SO(3).
pub fn pose_from_homography(h: &Matrix3<f64>) -> Option<Isometry3<f64>> {
    let (first, second) = (h.column(0).into_owned(), h.column(1).into_owned());
    let scale = 2.0 / (first.norm() + second.norm());
    if !scale.is_finite() {
        return None;
    }
    let (first, second) = (first * scale, second * scale);
    let svd = Matrix3::from_columns(&[first, second, first.cross(&second)]).svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    if rotation.determinant() < 0.5 {
        return None;
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Some(Isometry3::from_parts(Translation3::from(h.column(2) * scale), rotation))
}

/// The second solution of the two-fold ambiguity of planar poses: the board normal reflected about
/// the line of sight to the middle of the board (T. Collins and A. Bartoli, "Infinitesimal
/// plane-based pose estimation", 2014, section 4).
pub fn mirrored_pose(pose: &Isometry3<f64>, middle: (f64, f64)) -> Option<Isometry3<f64>> {
    let on_board = Vector3::new(middle.0, middle.1, 0.0);
    let centre = pose.rotation * on_board + pose.translation.vector;
    let sight = centre.try_normalize(1e-12)?;
    let normal = pose.rotation * Vector3::z();
    let mirrored = sight * (2.0 * normal.dot(&sight)) - normal;
    let rotation = UnitQuaternion::rotation_between(&normal, &mirrored)? * pose.rotation;
    Some(Isometry3::from_parts(Translation3::from(centre - rotation * on_board), rotation))
}

/// The homography from board points to pixels relative to `centre`, in units of `unit_px`; input of
/// the closed-form solutions.
pub fn pixel_homography(
    sights: &[BoardCorrespondence],
    centre: (f64, f64),
    unit_px: f64,
) -> Option<Matrix3<f64>> {
    let direction = |(x, y): (f64, f64)| {
        Vector3::new((x - centre.0) / unit_px, (y - centre.1) / unit_px, 1.0).normalize()
    };
    let pairs: Vec<_> = sights.iter().map(|sight| (sight.on_board, direction(sight.pixel))).collect();
    homography(&pairs)
}

/// Zhang's closed-form focal length for square pixels and a centred principal point, from
/// [`pixel_homography`]s with the same centre. Each homography contributes two equations for 1 / f²
/// (2000, equations 3 and 4). The result is in units of `unit_px`.
pub fn focal_length_centred(homographies: &[Matrix3<f64>]) -> Option<f64> {
    let (mut numerator, mut denominator) = (0.0, 0.0);
    for h in homographies {
        let h = h / h.column(0).norm().max(h.column(1).norm()).max(1e-300);
        let (a, b) = (h.column(0), h.column(1));
        // Orthogonality a₁b₁ + a₂b₂ + f² a₃b₃ = 0 and equality of the two lengths, both as
        // equations for 1 / f².
        for (plane, depth) in [
            (a[0] * b[0] + a[1] * b[1], a[2] * b[2]),
            (a[0] * a[0] + a[1] * a[1] - b[0] * b[0] - b[1] * b[1], a[2] * a[2] - b[2] * b[2]),
        ] {
            numerator -= plane * depth;
            denominator += plane * plane;
        }
    }
    let inverse_square = numerator / denominator;
    (inverse_square > 0.0 && denominator > 0.0).then(|| 1.0 / inverse_square.sqrt())
}

/// Zhang's closed-form focal length from a camera matrix with all five parameters (2000, appendix
/// B), from the image of the absolute conic; needs at least three views. Returns the geometric mean
/// of both focal lengths in units of `unit_px`. `None` if the conic is invalid.
pub fn focal_length_free(homographies: &[Matrix3<f64>]) -> Option<f64> {
    if homographies.len() < 3 {
        return None;
    }
    let row = |h: &Matrix3<f64>, i: usize, j: usize| {
        let (a, b) = (h.column(i), h.column(j));
        [
            a[0] * b[0],
            a[0] * b[1] + a[1] * b[0],
            a[1] * b[1],
            a[2] * b[0] + a[0] * b[2],
            a[2] * b[1] + a[1] * b[2],
            a[2] * b[2],
        ]
    };
    let mut sum = DMatrix::<f64>::zeros(6, 6);
    for h in homographies {
        let h = h / h.column(0).norm().max(h.column(1).norm()).max(1e-300);
        let (both, first, second) = (row(&h, 0, 1), row(&h, 0, 0), row(&h, 1, 1));
        let difference: [f64; 6] = std::array::from_fn(|i| first[i] - second[i]);
        for v in [both, difference] {
            for (i, j) in (0..6).flat_map(|i| (0..6).map(move |j| (i, j))) {
                sum[(i, j)] += v[i] * v[j];
            }
        }
    }
    let eigen = sum.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let b = eigen.eigenvectors.column(least);
    let (b11, b12, b22, b13, b23, b33) = (b[0], b[1], b[2], b[3], b[4], b[5]);
    let minor = b11 * b22 - b12 * b12;
    let cy = (b12 * b13 - b11 * b23) / minor;
    let scale = b33 - (b13 * b13 + cy * (b12 * b13 - b11 * b23)) / b11;
    let fx = (scale / b11).sqrt();
    let fy = (scale * b11 / minor).sqrt();
    (fx.is_finite() && fy.is_finite()).then(|| (fx * fy).sqrt())
}

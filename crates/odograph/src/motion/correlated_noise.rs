//! Spatially correlated noise: errors that tracks have in common and that no number of tracks
//! averages out. Derivation: `docs/math/correlated-noise.md`.

use super::Observation;
use super::normal_equations::Unknowns;
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use nalgebra::{Matrix6, Matrix6x2, Vector6};

/// Correlation of the residuals of neighbouring tracks, averaged over frames.
///
/// Sensor noise is independent between tracks. Lossy video copies blocks from where they nearly
/// were in the previous frame and omits small corrections: all tracks of a block, and to a lesser
/// degree of the whole image, have the same error. The correlation between neighbours determines
/// the size of the common error. Measured on three rendered grounds: correlations of 0.10–0.15
/// (H.264 at crf 28) went with common shifts of 0.26–0.31 of a track's error, 0.21–0.33 (crf 38)
/// with 0.6, and 0.03 or less (not compressed) with no more than the mean of independent errors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ResidualCorrelation {
    /// Sum of the products of their errors, in units of the variance of one.
    products: f64,
    /// Number of pairs, counted once for each coordinate.
    pairs: f64,
}

/// Side of the cells within which tracks are neighbours, pixels: two macroblocks of 16 pixels.
const CELL_PX: f64 = 32.0;

/// Weight of all earlier frames relative to the present one: a memory of about 50 frames. Not
/// derived; chosen.
const FORGETTING_FACTOR: f64 = 0.98;

/// Weight of the prior of no correlation, in pairs: a single frame has too few. Not derived;
/// chosen.
const PRIOR_PAIRS: f64 = 1000.0;

/// Correlation of neighbours without coding noise, because their patches overlap. See
/// `docs/math/correlated-noise.md`.
const OVERLAP_CORRELATION: f64 = 0.05;

/// Shared fraction of a track's error over the excess correlation of its neighbours. Empirical; see
/// [`ResidualCorrelation`].
const SHARED_PER_CORRELATION: f64 = 3.0;

impl ResidualCorrelation {
    /// Of the weighted tracks of a frame, after a quadratic trend over the image is removed: a
    /// wrong pose or tilt gives such a trend, coding noise does not.
    pub(super) fn of(
        camera: &Camera,
        observations: &[Observation],
        errors: &[[f64; 2]],
        weights: &[f64],
    ) -> Self {
        let counted = || {
            let all = observations.iter().zip(errors).zip(weights);
            all.filter(|((observation, _), weight)| **weight > 0.0 && !is_on_edge(observation))
        };
        // Robust weights also apply here.
        let mut trend = QuadraticTrend::new(camera);
        counted().for_each(|((observation, error), &weight)| trend.add(observation.pixel, *error, weight));
        let Some(fit) = trend.fit() else { return Self::default() };
        let columns = (camera.width() as f64 / CELL_PX).ceil() as usize;
        let rows = (camera.height() as f64 / CELL_PX).ceil() as usize;
        // Per cell: sums of the errors along x and y, and number of tracks.
        let [mut x, mut y, mut counts] = [0; 3].map(|_| Buffer::of(0.0, columns * rows));
        let (mut squares, mut count) = (0.0, 0.0);
        for ((observation, error), &weight) in counted() {
            let along = |pixel: f64, cells: usize| ((pixel / CELL_PX).max(0.0) as usize).min(cells - 1);
            let cell = along(observation.pixel.y, rows) * columns + along(observation.pixel.x, columns);
            let smooth = trend.at(&fit, observation.pixel);
            let [error_x, error_y] = [0, 1].map(|i| weight * (error[i] - smooth[i]));
            x[cell] += error_x;
            y[cell] += error_y;
            counts[cell] += 1.0;
            squares += error_x * error_x + error_y * error_y;
            count += 1.0;
        }
        // The square of a sum is the sum of the squares plus twice that of the products.
        let squared_sums: f64 = x.iter().zip(&*y).map(|(x, y)| x * x + y * y).sum();
        let pairs: f64 = counts.iter().map(|n| n * (n - 1.0)).sum();
        if pairs <= 0.0 || squares <= 0.0 {
            return Self::default();
        }
        Self { products: (squared_sums - squares) / (squares / (2.0 * count)), pairs: 2.0 * pairs }
    }

    /// Adds a frame.
    pub(super) fn learn(&mut self, frame: &Self) {
        self.products = FORGETTING_FACTOR * self.products + frame.products;
        self.pairs = FORGETTING_FACTOR * self.pairs + frame.pairs;
    }

    /// Fraction of a track's error that all tracks share, 0 to 1.
    pub(super) fn shared_fraction(&self) -> f64 {
        let correlation = self.products / (self.pairs + PRIOR_PAIRS);
        (SHARED_PER_CORRELATION * (correlation - OVERLAP_CORRELATION)).clamp(0.0, 1.0)
    }
}

/// Weighted fit of second-order polynomials in the image coordinates: the form of the residuals
/// that a wrong plane leaves.
struct QuadraticTrend {
    centre: [f64; 2],
    per_px: f64,
    information: Matrix6<f64>,
    slopes: Matrix6x2<f64>,
}

impl QuadraticTrend {
    fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width() as f64, camera.height() as f64);
        let centre = [0.5 * width, 0.5 * height];
        Self {
            centre,
            per_px: 2.0 / width.max(height),
            information: Matrix6::zeros(),
            slopes: Matrix6x2::zeros(),
        }
    }

    fn terms(&self, pixel: Pixel) -> Vector6<f64> {
        let (x, y) = (self.per_px * (pixel.x - self.centre[0]), self.per_px * (pixel.y - self.centre[1]));
        Vector6::new(1.0, x, y, x * x, x * y, y * y)
    }

    fn add(&mut self, pixel: Pixel, error: [f64; 2], weight: f64) {
        let terms = self.terms(pixel);
        self.information.syger(weight, &terms, &terms, 1.0);
        for (mut slope, error) in self.slopes.column_iter_mut().zip(error) {
            slope.axpy(weight * error, &terms, 1.0);
        }
    }

    /// Coefficients for x and y; `None` from too few errors.
    fn fit(&self) -> Option<Matrix6x2<f64>> {
        Some(self.information.cholesky()?.solve(&self.slopes))
    }

    fn at(&self, fit: &Matrix6x2<f64>, pixel: Pixel) -> [f64; 2] {
        let terms = self.terms(pixel);
        [0, 1].map(|i| fit.column(i).dot(&terms))
    }
}

/// Whether a track lies on a straight edge (aperture problem): its information across is more than
/// four times that along. Along the edge it stays where it was predicted, as its neighbours do.
fn is_on_edge(observation: &Observation) -> bool {
    const MAX_RATIO: f64 = 4.0;
    let information = observation.whitening.tr_mul(&observation.whitening);
    let ratio = |largest: f64| (1.0 + largest) * (1.0 + largest) / largest;
    information.trace().powi(2) > ratio(MAX_RATIO) * information.determinant()
}

/// Standard deviation of the error that all tracks share, pixels: the one inferred from neighbours,
/// with a floor in proportion to the scale of the residuals that rendered drives show without
/// compression. Moving light makes residuals larger and shifts all tracks alike; noise of a dim
/// sensor is independent.
pub fn shared_px(scale_px: f64, inferred_px: f64) -> f64 {
    const FLOOR_FRACTION: f64 = 0.05;
    (FLOOR_FRACTION * scale_px).clamp(0.001, 0.003).max(inferred_px)
}

/// Covariance of the pose by an error of `shared_px` that all tracks share: changing light, errors
/// of the lens model and the ground, interpolation bias, coding noise. Heading, height and tilt
/// follow from such an error at half the image. Correlations are neglected.
pub fn shared_covariance(
    camera: &Camera,
    pose: &GroundPose,
    unknowns: &Unknowns,
    shared_px: f64,
) -> Matrix6<f64> {
    let focal_px = camera.focal_px().0;
    let shift_m = shared_px * pose.height_m / focal_px;
    let turn_rad = 2.0 * shared_px / (camera.width().min(camera.height()) as f64);
    let tilt_rad = shared_px / focal_px;
    let sigmas = [shift_m, shift_m, turn_rad, turn_rad * pose.height_m, tilt_rad, tilt_rad];
    Matrix6::from_fn(|i, j| if i == j && i < unknowns.count() { sigmas[i] * sigmas[i] } else { 0.0 })
}

/// Variances of height, roll and pitch from the tracks alone by an error that all tracks share.
/// They decide how far the motion model opens.
pub fn shared_rig_variances(camera: &Camera, pose: &GroundPose, shared_px: f64) -> [f64; 3] {
    let errors = |part: f64, least_px: f64| {
        shared_covariance(camera, pose, &Unknowns::ALL, least_px.max(part * shared_px))
    };
    let (of_height, of_tilt) = (errors(0.35, MIN_SHARED_HEIGHT_PX), errors(1.5, MIN_SHARED_TILT_PX));
    [of_height[(3, 3)], of_tilt[(4, 4)], of_tilt[(5, 5)]]
}

/// Least shared errors for height and for tilt, pixels, as rendered drives with shadows and moving
/// light show them. Coding noise loads the modes of tilt more than a common shift, and that of
/// height less.
const MIN_SHARED_HEIGHT_PX: f64 = 0.005;
const MIN_SHARED_TILT_PX: f64 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;
    use crate::geometry::GroundPoint;
    use crate::motion::{Elevation, Random};
    use nalgebra::{Matrix2, Vector3};

    fn observation(ground: GroundPoint, pixel: Pixel, whitening: Matrix2<f64>) -> Observation {
        Observation {
            ground,
            elevation: Elevation::FLAT,
            pixel,
            whitening,
            row_fraction: 0.0,
            keyframe_row_fraction: 0.0,
            centre_of_projection: Vector3::z(),
            corrected_at_m: 0.0,
        }
    }

    /// The correlation from 50 frames of 300 tracks with independent noise and noise of their block
    /// of 16 pixels.
    fn learned(independent: f64, of_block: f64, whitening: Matrix2<f64>) -> ResidualCorrelation {
        let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
        let mut random = Random::new(7);
        let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
        let mut neighbours = ResidualCorrelation::default();
        for _ in 0..50 {
            let blocks: Vec<[f64; 2]> = (0..40 * 30).map(|_| [uniform() - 0.5, uniform() - 0.5]).collect();
            let tracks = (0..300).map(|_| {
                let pixel = Pixel::new(639.0 * uniform(), 479.0 * uniform());
                let block = blocks[(pixel.y / 16.0) as usize * 40 + (pixel.x / 16.0) as usize];
                let error = block.map(|error| of_block * error + independent * (uniform() - 0.5));
                let ground = GroundPoint { x_m: 0.0, y_m: 0.0 };
                (observation(ground, pixel, whitening), error)
            });
            let (observations, errors): (Vec<_>, Vec<_>) = tracks.unzip();
            neighbours.learn(&ResidualCorrelation::of(&camera, &observations, &errors, &[1.0; 300]));
        }
        neighbours
    }

    #[test]
    fn independent_noise_is_not_shared() {
        assert_eq!(learned(0.1, 0.0, Matrix2::identity()).shared_fraction(), 0.0);
    }

    #[test]
    fn the_shared_fraction_grows_with_the_noise_of_blocks() {
        // A quarter of the pairs in a cell of 2×2 blocks are in the same block.
        let parts =
            [1.0, 1.5, 3.0].map(|of_block| learned(1.0, of_block, Matrix2::identity()).shared_fraction());
        assert!(parts[0] > 0.0 && parts[0] < parts[1] && parts[1] < parts[2] && parts[2] < 1.0, "{parts:?}");
    }

    #[test]
    fn an_unknown_mount_tilt_is_not_shared_noise() {
        let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
        let mut random = Random::new(3);
        let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
        let mut neighbours = ResidualCorrelation::default();
        for _ in 0..50 {
            let tracks = (0..400).map(|_| {
                let pixel = Pixel::new(639.0 * uniform(), 479.0 * uniform());
                let (x, y) = (pixel.x - 320.0, pixel.y - 240.0);
                // The trend of a camera rolled by 0.001 rad over ground that slopes by 0.01 rad.
                let smooth = [0.5 + 0.001 * x * x / 500.0 + 0.005 * x, 0.001 * x * y / 500.0];
                let ground = GroundPoint { x_m: 0.0, y_m: 0.0 };
                let error = smooth.map(|error| error + 0.2 * (uniform() - 0.5));
                (observation(ground, pixel, Matrix2::identity()), error)
            });
            let (observations, errors): (Vec<_>, Vec<_>) = tracks.unzip();
            neighbours.learn(&ResidualCorrelation::of(&camera, &observations, &errors, &[1.0; 400]));
        }
        assert_eq!(neighbours.shared_fraction(), 0.0);
    }

    #[test]
    fn tracks_on_edges_are_left_out() {
        assert_eq!(learned(1.0, 3.0, Matrix2::new(1.5, 0.0, 0.3, 0.4)), ResidualCorrelation::default());
    }

    #[test]
    fn without_pairs_the_shared_fraction_is_zero() {
        assert_eq!(ResidualCorrelation::default().shared_fraction(), 0.0);
        assert_eq!(shared_px(1.0, 0.0), 0.003);
        assert_eq!(shared_px(0.1, 0.05), 0.05);
    }
}

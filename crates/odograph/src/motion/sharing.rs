//! What tracks share of their errors: no number of them averages it away.

use super::Observation;
use super::planar_pose::{Residual, Unknowns};
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use nalgebra::{Matrix6, Matrix6x2, Vector6};

/// How alike the errors of neighbouring tracks are.
///
/// The noise of a sensor is each track's own. Lossy video copies blocks from where they nearly were a frame before, and leaves what is too little to be
/// worth its bits: all of a block is off in the same way, and so, less visibly, is the whole image. The one tells the other: where neighbours correlated
/// by 0.10–0.15 (H.264 at crf 28, three rendered grounds), the whole image was shifted by 0.26–0.31 of a track's error; by 0.21–0.33 (crf 38), 0.6;
/// by 0.03 and less (not compressed), by no more than the mean of as many tracks is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Neighbours {
    /// Sum of the products of their errors, in units of the variance of one.
    products: f64,
    /// Over so many pairs, counted once for each coordinate.
    pairs: f64,
}

/// Tracks in one cell of a grid of this size are neighbours, pixels: two blocks of a video across.
const CELL_PX: f64 = 32.0;

/// Weight that all earlier frames keep: about the last fifty count.
const KEPT: f64 = 0.98;

/// So many pairs that share nothing are taken to have been seen before the first frame: those of one frame tell little.
const PAIRS_BEFORE: f64 = 1000.0;

/// Neighbours correlate by this much anyway, where their patches overlap.
const CORRELATED_ANYWAY: f64 = 0.05;

/// The part of its error that a track shares with all others, over what its neighbours correlate by beyond that; see [`Neighbours`].
const SHARED_PER_CORRELATION: f64 = 3.0;

impl Neighbours {
    /// Of the tracks of a frame that count, less what of them grows evenly over the image: that is what a pose or a mount that is not known yet
    /// makes of them, and no block of a video.
    pub(super) fn of(
        camera: &Camera,
        observations: &[Observation],
        residuals: &[Residual],
        weights: &[f64],
    ) -> Self {
        let told = || {
            let all = observations.iter().zip(residuals).zip(weights);
            all.filter(|((observation, _), weight)| **weight > 0.0 && !is_on_an_edge(observation))
        };
        // What is far off counts little here too.
        let mut evenly = Evenly::new(camera);
        told().for_each(|((observation, residual), &weight)| {
            evenly.add(observation.pixel, residual.error, weight)
        });
        let Some(fit) = evenly.fit() else { return Self::default() };
        let columns = (camera.width() as f64 / CELL_PX).ceil() as usize;
        let rows = (camera.height() as f64 / CELL_PX).ceil() as usize;
        // Of each cell: the sum of the errors along x and y, and how many there are.
        let [mut x, mut y, mut counts] = [0; 3].map(|_| Buffer::of(0.0, columns * rows));
        let (mut squares, mut count) = (0.0, 0.0);
        for ((observation, residual), &weight) in told() {
            let along = |pixel: f64, cells: usize| ((pixel / CELL_PX).max(0.0) as usize).min(cells - 1);
            let cell = along(observation.pixel.y, rows) * columns + along(observation.pixel.x, columns);
            let even = evenly.at(&fit, observation.pixel);
            let [error_x, error_y] = [0, 1].map(|i| weight * (residual.error[i] - even[i]));
            x[cell] += error_x;
            y[cell] += error_y;
            counts[cell] += 1.0;
            squares += error_x * error_x + error_y * error_y;
            count += 1.0;
        }
        // The square of a sum is the squares and every product twice.
        let squared_sums: f64 = x.iter().zip(&*y).map(|(x, y)| x * x + y * y).sum();
        let pairs: f64 = counts.iter().map(|n| n * (n - 1.0)).sum();
        if pairs <= 0.0 || squares <= 0.0 {
            return Self::default();
        }
        Self { products: (squared_sums - squares) / (squares / (2.0 * count)), pairs: 2.0 * pairs }
    }

    /// Adds what a frame shows.
    pub(super) fn learn(&mut self, frame: &Self) {
        self.products = KEPT * self.products + frame.products;
        self.pairs = KEPT * self.pairs + frame.pairs;
    }

    /// The part of its error that a track shares with all the others, 0 to 1.
    pub(super) fn shared_part(&self) -> f64 {
        let correlation = self.products / (self.pairs + PAIRS_BEFORE);
        (SHARED_PER_CORRELATION * (correlation - CORRELATED_ANYWAY)).clamp(0.0, 1.0)
    }
}

/// What grows evenly over the image: polynomials of the second order, as a plane that is seen otherwise than thought makes them.
struct Evenly {
    middle: [f64; 2],
    per_px: f64,
    information: Matrix6<f64>,
    slopes: Matrix6x2<f64>,
}

impl Evenly {
    fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width() as f64, camera.height() as f64);
        let middle = [0.5 * width, 0.5 * height];
        Self {
            middle,
            per_px: 2.0 / width.max(height),
            information: Matrix6::zeros(),
            slopes: Matrix6x2::zeros(),
        }
    }

    fn terms(&self, pixel: Pixel) -> Vector6<f64> {
        let (x, y) = (self.per_px * (pixel.x - self.middle[0]), self.per_px * (pixel.y - self.middle[1]));
        Vector6::new(1.0, x, y, x * x, x * y, y * y)
    }

    fn add(&mut self, pixel: Pixel, error: [f64; 2], weight: f64) {
        let terms = self.terms(pixel);
        self.information.syger(weight, &terms, &terms, 1.0);
        for (mut slope, error) in self.slopes.column_iter_mut().zip(error) {
            slope.axpy(weight * error, &terms, 1.0);
        }
    }

    /// The polynomials of x and y; `None` from too few errors.
    fn fit(&self) -> Option<Matrix6x2<f64>> {
        Some(self.information.cholesky()?.solve(&self.slopes))
    }

    fn at(&self, fit: &Matrix6x2<f64>, pixel: Pixel) -> [f64; 2] {
        let terms = self.terms(pixel);
        [0, 1].map(|i| fit.column(i).dot(&terms))
    }
}

/// Whether a track is held four times as well across as along: along it stays where it was expected, which its neighbours do too.
fn is_on_an_edge(observation: &Observation) -> bool {
    const MOST_RATIO: f64 = 4.0;
    let information = observation.whitening.tr_mul(&observation.whitening);
    let ratio = |largest: f64| (1.0 + largest) * (1.0 + largest) / largest;
    information.trace().powi(2) > ratio(MOST_RATIO) * information.determinant()
}

/// What all tracks are off by, pixels, one standard deviation: what their neighbours tell, and at least what rendered drives show without compression, of
/// which the usual error of a track tells something. Moving light leaves tracks worse and all in the same way; the noise of a dim sensor is each one's own.
pub fn shared_px(scale_px: f64, told_px: f64) -> f64 {
    const USUAL_PART: f64 = 0.05;
    (USUAL_PART * scale_px).clamp(0.001, 0.003).max(told_px)
}

/// Covariance of what tracks have in common: light that changes, what the models of lens and ground leave, the bias of interpolation, the blocks of a
/// video. An error of `shared_px`, turned into heading and tilt over half the image.
pub fn shared_errors(
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

/// The same for height, roll and pitch as the tracks alone have them, which decide how far the motion model opens: variances.
pub fn shared_errors_of_rig(camera: &Camera, pose: &GroundPose, shared_px: f64) -> [f64; 3] {
    let errors = |part: f64, least_px: f64| {
        shared_errors(camera, pose, &Unknowns::ALL, least_px.max(part * shared_px))
    };
    let (of_height, of_tilt) = (errors(0.35, LEAST_OF_HEIGHT_PX), errors(1.5, LEAST_OF_TILT_PX));
    [of_height[(3, 3)], of_tilt[(4, 4)], of_tilt[(5, 5)]]
}

/// Lossy video makes tracks share more of their errors in the modes of tilt than in a common shift, and less in that of height; shadows and light that
/// move make them share this much, pixels, that rendered drives show.
const LEAST_OF_HEIGHT_PX: f64 = 0.005;
const LEAST_OF_TILT_PX: f64 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;
    use crate::geometry::GroundPoint;
    use crate::motion::{Elevation, Random};
    use nalgebra::Matrix2;

    fn observation(ground: GroundPoint, pixel: Pixel, whitening: Matrix2<f64>) -> Observation {
        let elevation = Elevation::FLAT;
        Observation { ground, elevation, pixel, whitening, row_fraction: 0.0, keyframe_row_fraction: 0.0 }
    }

    /// What fifty frames show whose 300 tracks are off by noise of their own and by that of the block of sixteen pixels in which they lie.
    fn learned(own: f64, of_block: f64, whitening: Matrix2<f64>) -> Neighbours {
        let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
        let mut random = Random::new(7);
        let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
        let mut neighbours = Neighbours::default();
        for _ in 0..50 {
            let blocks: Vec<[f64; 2]> = (0..40 * 30).map(|_| [uniform() - 0.5, uniform() - 0.5]).collect();
            let tracks = (0..300).map(|_| {
                let pixel = Pixel::new(639.0 * uniform(), 479.0 * uniform());
                let block = blocks[(pixel.y / 16.0) as usize * 40 + (pixel.x / 16.0) as usize];
                let error = block.map(|error| of_block * error + own * (uniform() - 0.5));
                let ground = GroundPoint { x_m: 0.0, y_m: 0.0 };
                let mut residual = Residual::NONE;
                residual.error = error;
                (observation(ground, pixel, whitening), residual)
            });
            let (observations, residuals): (Vec<_>, Vec<_>) = tracks.unzip();
            neighbours.learn(&Neighbours::of(&camera, &observations, &residuals, &[1.0; 300]));
        }
        neighbours
    }

    #[test]
    fn noise_of_their_own_is_not_shared() {
        assert_eq!(learned(0.1, 0.0, Matrix2::identity()).shared_part(), 0.0);
    }

    #[test]
    fn the_more_of_the_error_is_that_of_blocks_the_more_is_shared() {
        // Of the pairs in a cell of two by two blocks a quarter are in the same.
        let parts = [1.0, 1.5, 3.0].map(|of_block| learned(1.0, of_block, Matrix2::identity()).shared_part());
        assert!(parts[0] > 0.0 && parts[0] < parts[1] && parts[1] < parts[2] && parts[2] < 1.0, "{parts:?}");
    }

    #[test]
    fn a_mount_that_is_not_known_yet_is_not_shared_noise() {
        let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), Distortion::None).unwrap();
        let mut random = Random::new(3);
        let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
        let mut neighbours = Neighbours::default();
        for _ in 0..50 {
            let tracks = (0..400).map(|_| {
                let pixel = Pixel::new(639.0 * uniform(), 479.0 * uniform());
                let (x, y) = (pixel.x - 320.0, pixel.y - 240.0);
                // A camera that rolls by a thousandth over ground that it takes for level, but slopes by a hundredth.
                let even = [0.5 + 0.001 * x * x / 500.0 + 0.005 * x, 0.001 * x * y / 500.0];
                let ground = GroundPoint { x_m: 0.0, y_m: 0.0 };
                let mut residual = Residual::NONE;
                residual.error = even.map(|error| error + 0.2 * (uniform() - 0.5));
                (observation(ground, pixel, Matrix2::identity()), residual)
            });
            let (observations, residuals): (Vec<_>, Vec<_>) = tracks.unzip();
            neighbours.learn(&Neighbours::of(&camera, &observations, &residuals, &[1.0; 400]));
        }
        assert_eq!(neighbours.shared_part(), 0.0);
    }

    #[test]
    fn tracks_on_edges_tell_nothing() {
        assert_eq!(learned(1.0, 3.0, Matrix2::new(1.5, 0.0, 0.3, 0.4)), Neighbours::default());
    }

    #[test]
    fn without_pairs_nothing_is_shared() {
        assert_eq!(Neighbours::default().shared_part(), 0.0);
        assert_eq!(shared_px(1.0, 0.0), 0.003);
        assert_eq!(shared_px(0.1, 0.05), 0.05);
    }
}

//! What remains of the difference between a picture and the keyframes of a place, and the odds that
//! it is noise.
//!
//! Copies of a printed or paved floor have the same corners and the same grain. They differ by what
//! is smooth: wear, stains, and how much light they reflect. So the logarithm of the ratio of
//! brightness is modelled by a low order cosine transform over the picture, together with what
//! light and lens add. The keyframes of a place show the same smooth difference, so their normal
//! equations are added.
//!
//! Neither images of one place nor copies differ by white noise: lossy video and uneven light leave
//! amplitudes that fall in proportion to the order, as those of copies do. The two differ in
//! size.

use super::overlap::{OverlapCell, OverlapGrid};
use nalgebra::{DMatrix, DVector};

/// Highest order of the cosine transform, along both axes together: waves of two fifths of the
/// picture. On the demo's ground a copy has 4 times the amplitude of noise there, 8 at the first.
const ORDER: usize = 5;

/// Number of terms of the orders 1 to [`ORDER`].
const TERMS: usize = ORDER * (ORDER + 3) / 2;

/// Light and lens: two terms of darker corners, black level, and two of where darkening has its
/// centre. All are of the cameras, so they are common to the keyframes of a place.
const LIGHT: usize = 5;

/// Standard deviations of these. The first are wide: the darkening of a lens by half, 30 gray
/// levels, and a centre some hundredths of the focal length off.
const LIGHT_DEVIATIONS: [f64; LIGHT] = [0.5, 0.5, 0.3, 0.02, 0.02];

/// Standard deviation of the amplitude of images of one place at the first order. In the demo's
/// lossy video, 45 pictures at their places, it is 0.0011 at the first two orders and 0.0014 over
/// the order at the others (medians), with a tail. Larger tolerates more uneven light, and leaves
/// more places uncertain.
const NOISE: f64 = 0.002;

/// Standard deviations at the first order that copies are assumed to have; the last is what copies
/// of the demo's ground have.
const AMPLITUDES: [f64; 11] =
    [0.0, 0.0005, 0.001, 0.0015, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008, MAX_AMPLITUDE];
const MAX_AMPLITUDE: f64 = 0.01;

/// Standard deviations of the residual and of the amplitudes in the first fit, which only yields
/// the variance of the residual.
const FIRST_RESIDUAL: f64 = 0.01;
const FIRST_AMPLITUDE: f64 = 0.03;

/// Normal equations of the smooth difference of a picture and keyframes, without their gains.
#[derive(Debug, Clone)]
pub struct DifferenceEquations {
    /// Of the terms of light and lens, then those of the cosine transform.
    normal: DMatrix<f64>,
    right: DVector<f64>,
    /// Sum of the squared differences, and number of cells.
    squares: f64,
    cells: usize,
}

/// Estimate of the cosine transform of a difference, in information form.
#[derive(Debug, Clone)]
pub struct SmoothDifference {
    information: DMatrix<f64>,
    vector: DVector<f64>,
}

impl DifferenceEquations {
    /// Of the picture and one keyframe. The gain of the keyframe is eliminated.
    pub fn of(overlap: &OverlapGrid) -> Self {
        let rows = overlap.cells.len() / overlap.columns.max(1);
        let (across, down) = (cosines(overlap.columns), cosines(rows));
        let size = LIGHT + TERMS;
        let (mut normal, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        let (mut sum, mut total, mut squares, mut cells) = (DVector::zeros(size), 0.0, 0.0, 0usize);
        for (at, cell) in overlap.cells.iter().enumerate() {
            let Some(cell) = cell else { continue };
            let (column, row) = (at % overlap.columns, at / overlap.columns);
            let terms = terms(cell, &across[column], &down[row]);
            let difference = cell.mean();
            normal.syger(1.0, &terms, &terms, 1.0);
            right.axpy(difference, &terms, 1.0);
            sum += &terms;
            total += difference;
            squares += difference * difference;
            cells += 1;
        }
        let count = cells.max(1) as f64;
        normal.syger(-1.0 / count, &sum, &sum, 1.0);
        normal.fill_upper_triangle_with_lower_triangle();
        right.axpy(-total / count, &sum, 1.0);
        Self { normal, right, squares: squares - total * total / count, cells }
    }

    /// With another keyframe of the same place.
    pub fn add(&mut self, other: &Self) {
        self.normal += &other.normal;
        self.right += &other.right;
        self.squares += other.squares;
        self.cells += other.cells;
    }

    /// The estimate, with the variance of the residual as that of each cell. `None` if the
    /// equations cannot be solved.
    pub fn solved(&self) -> Option<SmoothDifference> {
        let variance = self.residual_variance()?;
        let (normal, right) = (&self.normal / variance, &self.right / variance);
        let mut light = normal.view((0, 0), (LIGHT, LIGHT)).into_owned();
        for (at, deviation) in LIGHT_DEVIATIONS.into_iter().enumerate() {
            light[(at, at)] += 1.0 / (deviation * deviation);
        }
        let mixed = normal.view((0, LIGHT), (LIGHT, TERMS));
        let eliminated = light.cholesky()?;
        let information =
            normal.view((LIGHT, LIGHT), (TERMS, TERMS)) - mixed.transpose() * eliminated.solve(&mixed);
        let vector = right.rows(LIGHT, TERMS) - mixed.transpose() * eliminated.solve(&right.rows(0, LIGHT));
        Some(SmoothDifference { information, vector })
    }

    fn residual_variance(&self) -> Option<f64> {
        let light = LIGHT_DEVIATIONS.into_iter();
        let deviations = light.chain(std::iter::repeat_n(FIRST_AMPLITUDE, TERMS));
        let mut regularised = self.normal.clone();
        for (at, deviation) in deviations.enumerate() {
            regularised[(at, at)] += (FIRST_RESIDUAL / deviation).powi(2);
        }
        let fitted = regularised.cholesky()?.solve(&self.right);
        let squares = self.squares - 2.0 * fitted.dot(&self.right) + fitted.dot(&(&self.normal * &fitted));
        let variance = squares / self.cells.max(1) as f64;
        (variance > 0.0).then_some(variance)
    }
}

impl SmoothDifference {
    /// The amplitude, of those that copies are assumed to have, that explains it best.
    pub fn amplitude(&self) -> f64 {
        let evidence = AMPLITUDES.map(|amplitude| (amplitude, self.evidence(amplitude)));
        evidence.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0.0, |(amplitude, _)| amplitude)
    }

    /// Logarithm of the odds that the picture shows the place against that it shows a copy that
    /// differs with this amplitude.
    pub fn log_odds(&self, amplitude: f64) -> f64 {
        self.evidence(0.0) - self.evidence(amplitude)
    }

    /// Logarithm of the likelihood, up to a constant, if the terms are normally distributed with
    /// the amplitude of noise and this one.
    fn evidence(&self, amplitude: f64) -> f64 {
        let orders = (1..=ORDER).flat_map(|order| std::iter::repeat_n(order as f64, order + 1));
        let deviation = amplitude.hypot(NOISE);
        let inverse = DVector::from_iterator(TERMS, orders.map(|order| (order / deviation).powi(2)));
        let logarithms: f64 = inverse.iter().map(|one| one.ln()).sum();
        let Some(factor) = (&self.information + DMatrix::from_diagonal(&inverse)).cholesky() else {
            return f64::NEG_INFINITY;
        };
        let determinant = 2.0 * factor.l_dirty().diagonal().iter().map(|one| one.ln()).sum::<f64>();
        0.5 * (logarithms - determinant + self.vector.dot(&factor.solve(&self.vector)))
    }
}

/// The functions of one axis, for each of `count` cells, with a mean square of one.
fn cosines(count: usize) -> Vec<[f64; ORDER + 1]> {
    let at = |cell: usize| {
        let phase = std::f64::consts::PI * (cell as f64 + 0.5) / count as f64;
        std::array::from_fn(|order| match order {
            0 => 1.0,
            _ => std::f64::consts::SQRT_2 * (order as f64 * phase).cos(),
        })
    };
    (0..count).map(at).collect()
}

/// What each unknown adds to a cell.
fn terms(cell: &OverlapCell, across: &[f64; ORDER + 1], down: &[f64; ORDER + 1]) -> DVector<f64> {
    let light = [cell.radial[0], cell.radial[1], cell.lift(), cell.shift[0], cell.shift[1]];
    let smooth = (1..=ORDER).flat_map(|order| (0..=order).map(move |k| across[k] * down[order - k]));
    DVector::from_iterator(LIGHT + TERMS, light.into_iter().chain(smooth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Distortion};
    use crate::geometry::GroundPose;
    use crate::image::{GrayImage, Pyramid};
    use crate::loop_closure::overlap::RegisteredImage;
    use crate::motion::Random;
    use crate::simulation::{Ground, Renderer, Texture};

    /// A picture, and three keyframes turned against it, each with its own gain; all with noise of
    /// two gray levels, and darker corners about a centre off the optical axis. The picture has
    /// smooth differences of this size.
    fn overlaps(size: f64) -> Vec<OverlapGrid> {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let renderer = Renderer::new(&camera);
        let ground = Ground::new(Texture::Bricks, renderer.footprint_m(0.9), false, 9).unwrap();
        let mut random = Random::new(4);
        let mut picture = |pose: &GroundPose, gain: f64, size: f64| {
            let mut image: GrayImage = renderer.gray_view(&ground, pose);
            for (at, sample) in image.samples_mut().iter_mut().enumerate() {
                let (x, y) = ((at % 320) as f64 / 320.0, (at / 320) as f64 / 240.0);
                let darker = 0.4 * ((x - 0.51).powi(2) + 0.56 * (y - 0.49).powi(2));
                let smooth = 1.0 + size * ((3.0 * x).sin() + (5.0 * y + x).cos());
                let noise: f64 = (0..4).map(|_| random.below(1 << 16) as f64 / 65536.0 - 0.5).sum();
                let gray = gain * (1.0 - darker) * smooth * f64::from(*sample) + 3.5 * noise;
                *sample = gray.round().clamp(0.0, 255.0) as u8;
            }
            Pyramid::new(image, 3)
        };
        let here = GroundPose::level(0.9);
        let query = picture(&here, 1.0, size);
        let keyframes = [(-0.1, 0.05, 0.4), (0.1, 0.1, -1.2), (0.0, -0.15, 2.9)];
        let overlaps = keyframes.map(|(x_m, y_m, heading_rad)| {
            let there = GroundPose { x_m, y_m, heading_rad, ..here };
            let keyframe = picture(&there, 0.8 + 0.1 * heading_rad, 0.0);
            let registered = |pyramid, pose| RegisteredImage { camera: &camera, pyramid, pose, mask: None };
            OverlapGrid::new(&registered(&query, here), &registered(&keyframe, there))
        });
        overlaps.into()
    }

    fn pooled(overlaps: &[OverlapGrid]) -> SmoothDifference {
        let mut equations = DifferenceEquations::of(&overlaps[0]);
        overlaps[1..].iter().for_each(|overlap| equations.add(&DifferenceEquations::of(overlap)));
        equations.solved().unwrap()
    }

    #[test]
    fn a_smooth_difference_of_copies_is_no_noise() {
        let [place, copy] = [0.0, 0.02].map(|size| pooled(&overlaps(size)));
        let odds = [&place, &copy].map(|one| one.log_odds(MAX_AMPLITUDE));
        assert!(odds[0] > 15.0 && odds[1] < -15.0, "{odds:?}");
        let amplitudes = [&place, &copy].map(SmoothDifference::amplitude);
        assert!(amplitudes[0] <= 0.001 && amplitudes[1] >= 0.006, "{amplitudes:?}");
        // Copies that differ by as little as images of one place are not told apart.
        assert!(place.log_odds(0.0).abs() < 1e-9 && place.log_odds(0.001) < 3.0);
    }

    #[test]
    fn more_keyframes_make_a_place_more_certain() {
        let overlaps = overlaps(0.0);
        let [one, three] = [1, 3].map(|count| pooled(&overlaps[..count]).log_odds(MAX_AMPLITUDE));
        assert!(three > one + 2.0, "{one} {three}");
    }
}

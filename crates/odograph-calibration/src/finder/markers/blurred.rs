//! Decoding of blurred markers, whose bits merge, by template matching of the whole marker.

use super::bits::MAX_BITS;
use crate::dictionary::bit;

/// Standard deviations of the blur of the templates, in bits.
const BLURS: [f64; 4] = [0.35, 0.55, 0.75, 1.0];
/// Minimum correlation with the best template, and minimum margin over the next-best marker or
/// orientation.
const MIN_CORRELATION: f64 = 0.88;
const MIN_LEAD: f64 = 0.08;

/// Gray levels of a marker's bits, with zero mean and unit norm.
type Grays = [f32; MAX_BITS * MAX_BITS];

/// Templates of the blurred markers in four orientations.
#[derive(Debug, Clone)]
pub(super) struct Blurred {
    bits: usize,
    /// Indexed by marker, orientation and blur.
    looks: Vec<[[Grays; BLURS.len()]; 4]>,
}

impl Blurred {
    /// Templates of markers given in their four orientations.
    pub fn new(turned: &[[u64; 4]], bits: usize) -> Self {
        let looks =
            turned.iter().map(|turns| turns.map(|code| BLURS.map(|blur| look(code, bits, blur)))).collect();
        Self { bits, looks }
    }

    /// The marker with the highest correlation, and its number of quarter turns. `None` if the
    /// correlation is too low or the result is ambiguous.
    ///
    /// This is a matched filter for each marker: the maximum-likelihood decision for uniform blur
    /// and Gaussian noise.
    pub fn look_up(&self, grays: &[f64; MAX_BITS * MAX_BITS]) -> Option<(usize, usize)> {
        let seen = self.normalised(grays)?;
        let (mut best, mut next) = ((0.0, None), 0.0);
        for (id, turns) in self.looks.iter().enumerate() {
            for (turn, blurs) in turns.iter().enumerate() {
                let like = self.correlation(blurs, &seen);
                if like > best.0 {
                    next = best.0;
                    best = (like, Some((id, turn)));
                } else if like > next {
                    next = like;
                }
            }
        }
        (best.0 >= MIN_CORRELATION && best.0 - next >= MIN_LEAD).then_some(best.1).flatten()
    }

    /// Correlation of a reading with an upright marker, maximised over the blur.
    pub fn likeness(&self, id: usize, grays: &[f64; MAX_BITS * MAX_BITS]) -> f64 {
        self.normalised(grays).map_or(0.0, |seen| self.correlation(&self.looks[id][0], &seen))
    }

    fn correlation(&self, blurs: &[Grays; BLURS.len()], seen: &Grays) -> f64 {
        let count = self.bits * self.bits;
        let product =
            |look: &Grays| look[..count].iter().zip(&seen[..count]).map(|(a, b)| a * b).sum::<f32>();
        f64::from(blurs.iter().map(product).fold(0.0, f32::max))
    }

    fn normalised(&self, grays: &[f64; MAX_BITS * MAX_BITS]) -> Option<Grays> {
        normalised(grays, self.bits * self.bits)
    }
}

/// Normalises to zero mean and unit norm; `None` for constant gray levels.
fn normalised(grays: &[f64; MAX_BITS * MAX_BITS], count: usize) -> Option<Grays> {
    let mean = grays[..count].iter().sum::<f64>() / count as f64;
    let length = grays[..count].iter().map(|gray| (gray - mean).powi(2)).sum::<f64>().sqrt();
    (length > 1e-9).then(|| {
        let mut result = [0.0; MAX_BITS * MAX_BITS];
        for (result, gray) in result[..count].iter_mut().zip(grays) {
            *result = ((gray - mean) / length) as f32;
        }
        result
    })
}

/// Gray levels at the bit centres of a marker under Gaussian blur, with a black surround.
fn look(code: u64, bits: usize, blur: f64) -> Grays {
    // The weights of a bit and of each of its two neighbours along a row, for the value at its
    // centre.
    let own = error_function(0.5 / (blur * std::f64::consts::SQRT_2));
    let side = 0.5 * (1.0 - own);
    let white = |column: usize, row: usize| {
        // Counted from one; the border is at 0.
        let inside = (1..=bits).contains(&column) && (1..=bits).contains(&row);
        inside && bit(code, bits, column - 1, row - 1) == 1
    };
    let mut grays = [0.0; MAX_BITS * MAX_BITS];
    for row in 0..bits {
        for column in 0..bits {
            for (y, share_y) in [side, own, side].into_iter().enumerate() {
                for (x, share_x) in [side, own, side].into_iter().enumerate() {
                    if white(column + x, row + y) {
                        grays[row * bits + column] += share_x * share_y;
                    }
                }
            }
        }
    }
    normalised(&grays, bits * bits).unwrap_or([0.0; MAX_BITS * MAX_BITS])
}

/// The error function for non-negative x, accurate to 3e-5 (M. Abramowitz and I. Stegun, "Handbook
/// of mathematical functions", 1964, 7.1.25).
fn error_function(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.47047 * x);
    1.0 - t * (0.348_024_2 - t * (0.095_879_8 - t * 0.747_855_6)) * (-x * x).exp()
}

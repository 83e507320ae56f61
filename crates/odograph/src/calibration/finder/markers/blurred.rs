//! Markers whose bits run into each other: told by their looks as a whole.

use super::bits::MOST_BITS;

/// Standard deviations of the blur that markers are compared under, bits.
const BLURS: [f64; 4] = [0.35, 0.55, 0.75, 1.0];
/// The least correlation of the grays of a marker's bits with what is expected, and by how much the best marker must be ahead of the next.
const LEAST_CORRELATION: f64 = 0.88;
const LEAST_LEAD: f64 = 0.08;

/// The grays of a marker's bits, without their mean and of unit length.
type Grays = [f32; MOST_BITS * MOST_BITS];

/// What markers look like when blurred, in each of four turns.
#[derive(Debug, Clone)]
pub(super) struct Blurred {
    bits: usize,
    /// For each marker, turn and blur.
    looks: Vec<[[Grays; BLURS.len()]; 4]>,
}

impl Blurred {
    /// The looks of markers given in their four turns.
    pub fn new(turned: &[[u64; 4]], bits: usize) -> Self {
        let looks =
            turned.iter().map(|turns| turns.map(|code| BLURS.map(|blur| look(code, bits, blur)))).collect();
        Self { bits, looks }
    }

    /// The marker that looks most like what was read, and how often it is turned; `None` where none does or two do.
    ///
    /// A matched filter for each marker: with equal blur all around it, the most probable marker under Gaussian noise.
    pub fn look_up(&self, grays: &[f64; MOST_BITS * MOST_BITS]) -> Option<(usize, usize)> {
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
        (best.0 >= LEAST_CORRELATION && best.0 - next >= LEAST_LEAD).then_some(best.1).flatten()
    }

    /// The correlation of what was read with an upright marker under the blur that fits best.
    pub fn likeness(&self, id: usize, grays: &[f64; MOST_BITS * MOST_BITS]) -> f64 {
        self.normalised(grays).map_or(0.0, |seen| self.correlation(&self.looks[id][0], &seen))
    }

    fn correlation(&self, blurs: &[Grays; BLURS.len()], seen: &Grays) -> f64 {
        let count = self.bits * self.bits;
        let product =
            |look: &Grays| look[..count].iter().zip(&seen[..count]).map(|(a, b)| a * b).sum::<f32>();
        f64::from(blurs.iter().map(product).fold(0.0, f32::max))
    }

    fn normalised(&self, grays: &[f64; MOST_BITS * MOST_BITS]) -> Option<Grays> {
        normalised(grays, self.bits * self.bits)
    }
}

/// Without their mean and of unit length; `None` where all are the same.
fn normalised(grays: &[f64; MOST_BITS * MOST_BITS], count: usize) -> Option<Grays> {
    let mean = grays[..count].iter().sum::<f64>() / count as f64;
    let length = grays[..count].iter().map(|gray| (gray - mean).powi(2)).sum::<f64>().sqrt();
    (length > 1e-9).then(|| {
        let mut result = [0.0; MOST_BITS * MOST_BITS];
        for (result, gray) in result[..count].iter_mut().zip(grays) {
            *result = ((gray - mean) / length) as f32;
        }
        result
    })
}

/// The grays at the middles of a marker's bits under a Gaussian blur, black all around.
fn look(code: u64, bits: usize, blur: f64) -> Grays {
    // The shares of a bit and of each of its two neighbours along a row in what is seen at its middle.
    let own = error_function(0.5 / (blur * std::f64::consts::SQRT_2));
    let side = 0.5 * (1.0 - own);
    let white = |column: usize, row: usize| {
        // Counted from one, so that the border is at 0.
        let inside = (1..=bits).contains(&column) && (1..=bits).contains(&row);
        inside && code >> (bits * bits - 1 - (row - 1) * bits - (column - 1)) & 1 == 1
    };
    let mut grays = [0.0; MOST_BITS * MOST_BITS];
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
    normalised(&grays, bits * bits).unwrap_or([0.0; MOST_BITS * MOST_BITS])
}

/// The error function for what is not negative (M. Abramowitz and I. Stegun, "Handbook of mathematical functions", 1964, 7.1.25), to
/// 3e-5.
fn error_function(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.47047 * x);
    1.0 - t * (0.348_024_2 - t * (0.095_879_8 - t * 0.747_855_6)) * (-x * x).exp()
}

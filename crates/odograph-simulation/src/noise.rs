//! Reproducible randomness: hashes, noise over the plane and smooth random functions of time.

use std::f64::consts::TAU;

/// 64-bit hash: the finaliser of SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom
/// number generators", 2014).
pub(super) fn mix(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Uniform number in [0, 1), a hash of the seed and the index.
pub(super) fn uniform(seed: u64, index: u64) -> f64 {
    (mix(seed ^ mix(index)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Uniform number in [0, 1), a hash of an integer cell of the plane.
#[inline]
pub(super) fn cell(seed: u32, x: i32, y: i32) -> f32 {
    let mut h =
        (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77).rotate_left(13) ^ seed;
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^= h >> 15;
    (h >> 8) as f32 / (1u32 << 24) as f32
}

/// Value noise in [−1, 1] with lattice spacing 1: random values at integer points, interpolated
/// with continuous second derivatives.
#[inline]
pub(super) fn value_noise(seed: u32, x: f64, y: f64) -> f32 {
    let ((i, u), (j, v)) = (cell_and_rest(x), cell_and_rest(y));
    interpolated(corners(seed, i, j), u, v)
}

/// Largest integer not above `x`, and what remains. The lattice wraps after 2³² cells, which is
/// farther than any path reaches.
#[inline]
fn cell_and_rest(x: f64) -> (i32, f32) {
    // To this sum, integers are exact and lie in the lowest bits: without SSE 4.1, `f64::floor` is
    // a call of a function.
    const SHIFT: f64 = 1.5 * (1u64 << 52) as f64;
    let shifted = x + SHIFT;
    let nearest = shifted - SHIFT;
    let is_above = nearest > x;
    let floor = if is_above { nearest - 1.0 } else { nearest };
    ((shifted.to_bits() as i32).wrapping_sub(i32::from(is_above)), (x - floor) as f32)
}

/// Random values of a cell's corners: left and right above, left and right below.
#[inline]
fn corners(seed: u32, i: i32, j: i32) -> [f32; 4] {
    let (right, below) = (i.wrapping_add(1), j.wrapping_add(1));
    [cell(seed, i, j), cell(seed, right, j), cell(seed, i, below), cell(seed, right, below)]
}

/// Noise in a lattice cell with these corner values, −1 to 1; `u` and `v` are the position in it.
#[inline]
pub(super) fn interpolated([left, right, left_below, right_below]: [f32; 4], u: f32, v: f32) -> f32 {
    let fade = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (a, b) = (fade(u), fade(v));
    let top = left * (1.0 - a) + right * a;
    let bottom = left_below * (1.0 - a) + right_below * a;
    2.0 * (top * (1.0 - b) + bottom * b) - 1.0
}

/// Corners of the lattice cells that noise was last evaluated in, in the order of evaluation.
/// Neighbouring points lie in the same cells of most octaves, and hashing takes most of the time.
#[derive(Debug, Default)]
pub(super) struct LatticeCache {
    cells: Vec<LatticeCell>,
    next: usize,
}

#[derive(Debug, Clone, Copy)]
struct LatticeCell {
    index: (u32, i32, i32),
    corners: [f32; 4],
}

impl LatticeCache {
    /// To be called before the evaluations at another point.
    pub(super) fn rewind(&mut self) {
        self.next = 0;
    }

    /// [`value_noise`].
    #[inline]
    pub(super) fn value_noise(&mut self, seed: u32, x: f64, y: f64) -> f32 {
        let ((i, u), (j, v)) = (cell_and_rest(x), cell_and_rest(y));
        let index = (seed, i, j);
        let at = self.next;
        self.next += 1;
        match self.cells.get_mut(at) {
            Some(known) if known.index == index => interpolated(known.corners, u, v),
            known => {
                let cell = LatticeCell { index, corners: corners(seed, i, j) };
                match known {
                    Some(known) => *known = cell,
                    None => self.cells.push(cell),
                }
                interpolated(cell.corners, u, v)
            }
        }
    }
}

/// Contrast, 0 to 1, of a structure of size `spacing_m` in a pixel with a footprint of
/// `footprint_m`: fades out structures that would alias.
#[inline]
pub(super) fn visibility(spacing_m: f64, footprint_m: f64) -> f32 {
    // Most structures are much larger, and a division takes long.
    if spacing_m > 3.0 * footprint_m {
        return 1.0;
    }
    smooth_step((spacing_m / footprint_m - 1.1) / 1.7) as f32
}

/// Smoothstep: 0 below 0, 1 above 1, between them a cubic with zero slope at both ends.
#[inline]
pub(super) fn smooth_step(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Fractal noise: `octaves` octaves of value noise with lattice spacings `coarsest_m`, half of it,
/// and so on. Amplitudes fall by the factor `roughness` per octave and sum to 1. Successive octaves
/// are rotated to hide the lattice.
pub(super) fn fractal(
    cache: &mut LatticeCache,
    seed: u32,
    (x_m, y_m): (f64, f64),
    footprint_m: f64,
    coarsest_m: f64,
    octaves: u32,
    roughness: f32,
) -> f32 {
    let (mut sum, mut total, mut strength, mut spacing_m) = (0.0, 0.0, 1.0f32, coarsest_m);
    let (mut x, mut y) = (x_m, y_m);
    for octave in 0..octaves {
        let seen = visibility(spacing_m, footprint_m);
        if seen > 0.0 {
            let octave_seed = seed.wrapping_add(octave.wrapping_mul(0x9E37_79B9));
            sum += strength * seen * cache.value_noise(octave_seed, x / spacing_m, y / spacing_m);
        }
        total += strength;
        strength *= roughness;
        spacing_m *= 0.5;
        // A rotation by 36.87°, exact in short decimals.
        (x, y) = (0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y);
    }
    sum / total
}

/// A smooth random function of time in [−1, 1]: the mean of four sines around one frequency.
#[derive(Debug, Clone)]
pub(super) struct Wobble {
    waves: [(f64, f64); 4],
}

impl Wobble {
    /// Frequencies between 0.6 and 1.4 times `frequency_hz`; phases from the seed.
    pub(super) fn new(seed: u64, frequency_hz: f64) -> Self {
        let wave = |i: u64| {
            // One sine in each quarter of the band, so that they never coincide.
            let spread = 0.6 + 0.2 * (i as f64 + uniform(seed, 2 * i));
            (TAU * frequency_hz * spread, TAU * uniform(seed, 2 * i + 1))
        };
        Self { waves: [wave(0), wave(1), wave(2), wave(3)] }
    }

    /// The value at a time, seconds.
    pub(super) fn at(&self, time_s: f64) -> f64 {
        self.waves.iter().map(|(rate, phase)| (rate * time_s + phase).sin()).sum::<f64>() / 4.0
    }
}

/// A fast stream of approximately Gaussian numbers: sums of eight uniform ones, with exact variance
/// and tails to ±4.9 σ.
#[derive(Debug, Clone)]
pub(super) struct GaussianStream {
    state: u64,
}

impl GaussianStream {
    /// A stream determined by the seed alone.
    pub(super) fn new(seed: u64) -> Self {
        Self { state: mix(seed) }
    }

    /// The next number, mean 0 and standard deviation 1.
    #[inline]
    pub(super) fn sample(&mut self) -> f32 {
        let mut sum = 0u32;
        for _ in 0..2 {
            self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = self.state;
            z = (z ^ (z >> 32)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
            z ^= z >> 32;
            sum += (z & 0xFFFF) as u32
                + (z >> 16 & 0xFFFF) as u32
                + (z >> 32 & 0xFFFF) as u32
                + (z >> 48) as u32;
        }
        // Eight uniform 16-bit numbers: mean 8 · 65535 / 2, variance 8 · (65536² − 1) / 12.
        (sum as f32 - 262_140.0) * 1.868_817e-5
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gaussian_stream_has_mean_0_and_deviation_1() {
        let mut stream = GaussianStream::new(3);
        let n = 200_000;
        let samples: Vec<f64> = (0..n).map(|_| f64::from(stream.sample())).collect();
        let mean = samples.iter().sum::<f64>() / n as f64;
        let variance = samples.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / n as f64;
        let beyond_two = samples.iter().filter(|s| s.abs() > 2.0).count() as f64 / n as f64;
        assert!(mean.abs() < 0.01, "{mean}");
        assert!((variance - 1.0).abs() < 0.015, "{variance}");
        assert!((beyond_two - 0.0455).abs() < 0.005, "{beyond_two}");
    }

    #[test]
    fn noise_is_continuous_and_bounded() {
        for i in 0..2000 {
            let x = f64::from(i) * 0.0501 - 50.0;
            let here = value_noise(7, x, 0.37 * x);
            let next = value_noise(7, x + 1e-4, 0.37 * x);
            assert!(here.abs() <= 1.0 && (here - next).abs() < 1e-3);
        }
    }

    #[test]
    fn a_wobble_stays_within_one() {
        let wobble = Wobble::new(1, 10.0);
        assert!((0..1000).all(|i| wobble.at(f64::from(i) * 0.01).abs() <= 1.0));
    }
}

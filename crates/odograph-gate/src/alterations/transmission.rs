//! What sensors, encoders and links do to images.

use super::RandomStream;
use odograph::image::GrayImage;
use std::f64::consts::PI;

/// A thermal camera: little contrast below a pattern of columns and pixels that is fixed.
pub fn thermal(width: usize, gray: f64, seed: u64, samples: &mut [u8]) {
    let mut random = RandomStream(seed.wrapping_mul(77).wrapping_add(13) | 1);
    let mut spread = || (random.below(2001) as f64 / 1000.0 - 1.0) * 3f64.sqrt() * gray;
    let columns: Vec<f64> = (0..width).map(|_| spread()).collect();
    for row in samples.chunks_exact_mut(width) {
        for (sample, column) in row.iter_mut().zip(&columns) {
            let faint = 128.0 + 0.4 * (f64::from(*sample) - 128.0);
            *sample = (faint + 0.7 * column + 0.7 * spread()).round().clamp(0.0, 255.0) as u8;
        }
    }
}

/// Smears of some pixels with a standard deviation of one: noise, averaged three times over 5x5
/// pixels.
pub fn smears((width, height): (usize, usize), seed: u64) -> Vec<f64> {
    const REACH: usize = 2;
    let mut random = RandomStream(seed.wrapping_mul(91).wrapping_add(7) | 1);
    let mut smears: Vec<f64> =
        (0..width * height).map(|_| random.below(2001) as f64 / 1000.0 - 1.0).collect();
    for _ in 0..3 {
        let before = smears.clone();
        for (at, smear) in smears.iter_mut().enumerate() {
            let (x, y) = (at % width, at / width);
            let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(height);
            let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(width);
            let count = (rows.len() * columns.len()) as f64;
            *smear =
                rows.map(|v| before[v * width..][columns.clone()].iter().sum::<f64>()).sum::<f64>() / count;
        }
    }
    let deviation =
        (smears.iter().map(|smear| smear * smear).sum::<f64>() / smears.len().max(1) as f64).sqrt();
    smears.iter_mut().for_each(|smear| *smear /= deviation.max(f64::MIN_POSITIVE));
    smears
}

/// Half of the contrast, behind smears.
pub fn dirty_window(smears: &[f64], gray: f64, samples: &mut [u8]) {
    for (sample, smear) in samples.iter_mut().zip(smears) {
        *sample = (64.0 + 0.5 * f64::from(*sample) + gray * smear).round().clamp(0.0, 255.0) as u8;
    }
}

/// Bars of 5 pixels, 32 pixels apart.
pub fn grille(width: usize, samples: &mut [u8]) {
    for (at, sample) in samples.iter_mut().enumerate() {
        if at % width % 32 < 5 || at / width % 32 < 5 {
            *sample = 30;
        }
    }
}

/// Little light, noise of 4 gray levels, columns that differ by 2, and three hot pixels in a
/// thousand.
pub fn dark_sensor(width: usize, light: f64, seed: u64, random: &mut RandomStream, samples: &mut [u8]) {
    let mut fixed = RandomStream(seed.wrapping_mul(53).wrapping_add(11) | 1);
    let columns: Vec<f64> =
        (0..width).map(|_| (fixed.below(2001) as f64 / 1000.0 - 1.0) * 2.0 * 3f64.sqrt()).collect();
    for row in samples.chunks_exact_mut(width) {
        for (sample, column) in row.iter_mut().zip(&columns) {
            let noise =
                (0..4).map(|_| random.below(2001) as f64 / 1000.0 - 1.0).sum::<f64>() * 2.0 * 3f64.sqrt();
            let dark = 8.0 + light * f64::from(*sample) + column + noise;
            *sample = if fixed.below(1000) < 3 { 200 } else { dark.round().clamp(0.0, 255.0) as u8 };
        }
    }
}

/// A band of 2 to 13 macroblock rows that was not delivered: it shows what was shown before.
pub fn lost_rows(width: usize, shown: &mut Vec<u8>, random: &mut RandomStream, samples: &mut [u8]) {
    const MACROBLOCK: usize = 16;
    let is_hit = random.below(4) == 0;
    let rows = samples.len() / width / MACROBLOCK;
    let (first, count) = (random.below(rows), 2 + random.below(12));
    if is_hit && !shown.is_empty() {
        let band = first * MACROBLOCK * width..(first + count).min(rows) * MACROBLOCK * width;
        samples[band.clone()].copy_from_slice(&shown[band]);
    }
    *shown = samples.to_vec();
}

/// Row noise with a standard deviation in gray levels.
pub fn row_noise(width: usize, gray: f64, random: &mut RandomStream, samples: &mut [u8]) {
    for row in samples.chunks_exact_mut(width) {
        let offset =
            (0..4).map(|_| random.below(2001) as f64 / 1000.0 - 1.0).sum::<f64>() * 0.5 * 3f64.sqrt() * gray;
        for sample in row {
            *sample = (f64::from(*sample) + offset).round().clamp(0.0, 255.0) as u8;
        }
    }
}

/// A share of the pixels is black or white.
pub fn impulses(share: f64, random: &mut RandomStream, samples: &mut [u8]) {
    for _ in 0..(share * samples.len() as f64) as usize {
        let at = random.below(samples.len());
        samples[at] = if random.below(2) == 0 { 0 } else { 255 };
    }
}

/// Black rows and white columns, always the same.
pub fn dead_lines(width: usize, count: usize, seed: u64, samples: &mut [u8]) {
    let mut random = RandomStream(seed.wrapping_mul(29).wrapping_add(17) | 1);
    let height = samples.len() / width;
    for _ in 0..count {
        let (row, column) = (random.below(height), random.below(width));
        samples[row * width..(row + 1) * width].fill(0);
        samples.iter_mut().skip(column).step_by(width).for_each(|sample| *sample = 255);
    }
}

/// Torn images: below a line that wanders, the image before.
pub fn torn(number: usize, before: &GrayImage, samples: &mut [u8]) {
    let line = (number * 37) % before.height();
    let from = line * before.width();
    samples[from..].copy_from_slice(&before.samples()[from..]);
}

/// Lost packets: blocks of 16 by 16 pixels stay as they were two images before.
pub fn lost_blocks(before: &GrayImage, share: f64, random: &mut RandomStream, samples: &mut [u8]) {
    let width = before.width();
    for y in (0..before.height()).step_by(16) {
        for x in (0..width).step_by(16) {
            if (random.below(1000) as f64) < 1000.0 * share {
                for v in y..(y + 16).min(before.height()) {
                    let row = v * width + x..v * width + (x + 16).min(width);
                    samples[row.clone()].copy_from_slice(&before.samples()[row]);
                }
            }
        }
    }
}

/// Motion-JPEG of low quality: the cosine transform of blocks of 8 by 8 pixels, quantised.
pub fn blocky(width: usize, quantum: f64, samples: &mut [u8]) {
    let cosine = |k: usize, i: usize| {
        let norm = if k == 0 { (0.125f64).sqrt() } else { 0.5 };
        norm * (PI * (i as f64 + 0.5) * k as f64 / 8.0).cos()
    };
    let basis: [[f64; 8]; 8] = std::array::from_fn(|k| std::array::from_fn(|i| cosine(k, i)));
    let height = samples.len() / width;
    for y in (0..height - 7).step_by(8) {
        for x in (0..width - 7).step_by(8) {
            let block: [[f64; 8]; 8] =
                std::array::from_fn(|i| std::array::from_fn(|k| f64::from(samples[(y + i) * width + x + k])));
            let mut coarse = [[0.0; 8]; 8];
            for (u, row) in coarse.iter_mut().enumerate() {
                for (v, value) in row.iter_mut().enumerate() {
                    let sum: f64 =
                        (0..64).map(|n| basis[u][n / 8] * basis[v][n % 8] * block[n / 8][n % 8]).sum();
                    let step = quantum * (1.0 + 0.5 * (u + v) as f64);
                    *value = step * (sum / step).round();
                }
            }
            for i in 0..8 {
                for k in 0..8 {
                    let sum: f64 =
                        (0..64).map(|n| basis[n / 8][i] * basis[n % 8][k] * coarse[n / 8][n % 8]).sum();
                    samples[(y + i) * width + x + k] = sum.round().clamp(0.0, 255.0) as u8;
                }
            }
        }
    }
}

/// Local tone mapping: each pixel over the mean of its surroundings.
pub fn tone_mapped(image: &GrayImage, samples: &mut [u8]) {
    const REACH: usize = 24;
    let (width, height) = (image.width(), image.height());
    let mut sums = vec![0u32; (width + 1) * (height + 1)];
    for y in 0..height {
        let mut row = 0;
        for x in 0..width {
            row += u32::from(image.samples()[y * width + x]);
            sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + row;
        }
    }
    for y in 0..height {
        for x in 0..width {
            let (top, bottom) = (y.saturating_sub(REACH), (y + REACH).min(height));
            let (left, right) = (x.saturating_sub(REACH), (x + REACH).min(width));
            let at = |v: usize, u: usize| i64::from(sums[v * (width + 1) + u]);
            let sum = at(bottom, right) + at(top, left) - at(top, right) - at(bottom, left);
            let mean = sum as f64 / ((bottom - top) * (right - left)) as f64;
            let mapped = 128.0 + 2.0 * (f64::from(samples[y * width + x]) - mean);
            samples[y * width + x] = mapped.round().clamp(0.0, 255.0) as u8;
        }
    }
}

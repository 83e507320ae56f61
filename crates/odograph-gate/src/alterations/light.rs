//! Light, water and things before the lens that are neither fixed in the image nor on the ground.

use super::RandomStream;
use odograph::image::GrayImage;
use std::f64::consts::TAU;

/// Light through water or moving leaves: a pattern that moves over the ground by itself.
pub fn caustics(time_s: f64, width: usize, amount: f64, samples: &mut [u8]) {
    for (y, row) in samples.chunks_exact_mut(width).enumerate() {
        for (x, sample) in row.iter_mut().enumerate() {
            let (x, y) = (x as f64, y as f64);
            let bend = 6.0 * (0.031 * y + 1.9 * time_s).sin();
            let sum = (0.045 * (x + bend) + 2.3 * time_s).sin()
                + (0.038 * y - 0.021 * x - 1.7 * time_s).sin()
                + (0.029 * x + 0.044 * y + 2.9 * time_s).sin();
            let gain = 1.0 + amount * (1.0 - 2.0 * (sum / 3.0).abs());
            *sample = (gain * f64::from(*sample)).clamp(0.0, 255.0) as u8;
        }
    }
}

/// Drops of water on the lens: each shows a wide view of the scene, upside down and out of focus.
pub fn drops(image: &GrayImage, drops: &[(f64, f64, f64)], samples: &mut [u8]) {
    const MINIFIED: f64 = 6.0;
    let (width, height) = (image.width() as f64, image.height() as f64);
    for &(x_px, y_px, radius_px) in drops {
        for y in (y_px - radius_px).max(0.0) as usize..(y_px + radius_px).min(height) as usize {
            for x in (x_px - radius_px).max(0.0) as usize..(x_px + radius_px).min(width) as usize {
                let (dx, dy) = (x as f64 - x_px, y as f64 - y_px);
                if dx.hypot(dy) >= radius_px {
                    continue;
                }
                let mut sum = 0.0;
                for step in 0..16 {
                    let off = |i: usize| 4.0 * (i as f64 - 1.5);
                    let u = (x_px - MINIFIED * dx + off(step % 4)).clamp(0.0, width - 1.0);
                    let v = (y_px - MINIFIED * dy + off(step / 4)).clamp(0.0, height - 1.0);
                    sum += f64::from(image.samples()[v as usize * image.width() + u as usize]);
                }
                let edge = 1.0 - 0.4 * (dx.hypot(dy) / radius_px).powi(4);
                samples[y * image.width() + x] = (edge * sum / 16.0) as u8;
            }
        }
    }
}

/// Snow or dust near the lens: bright spots, elsewhere in each image.
pub fn snow(width: usize, flakes: usize, random: &mut RandomStream, samples: &mut [u8]) {
    let height = samples.len() / width;
    for _ in 0..flakes {
        let (x, y, radius) = (random.below(width), random.below(height), 2 + random.below(6));
        for v in y.saturating_sub(radius)..(y + radius).min(height) {
            for u in x.saturating_sub(radius)..(x + radius).min(width) {
                let away = (u as f64 - x as f64).hypot(v as f64 - y as f64) / radius as f64;
                if away < 1.0 {
                    let sample = &mut samples[v * width + u];
                    *sample = sample.saturating_add((110.0 * (1.0 - away * away)) as u8);
                }
            }
        }
    }
}

/// A wheel of the robot at the left edge of the image, that turns as the robot drives.
pub fn wheel(path_m: f64, width: usize, radius_px: f64, samples: &mut [u8]) {
    const WHEEL_M: f64 = 0.1;
    let height = samples.len() / width;
    let turn = path_m / WHEEL_M;
    let (cx, cy) = (0.0, 0.5 * height as f64);
    for y in 0..height {
        for x in 0..(radius_px as usize).min(width) {
            let (dx, dy) = (x as f64 - cx, y as f64 - cy);
            let away = dx.hypot(dy) / radius_px;
            if away < 1.0 {
                let angle = dy.atan2(dx) + turn;
                let spokes = 60.0 + 50.0 * (7.0 * angle).sin().signum() * (9.0 * away).sin();
                let bolts = 25.0 * (23.0 * angle + 40.0 * away).sin();
                samples[y * width + x] = (spokes + bolts).clamp(0.0, 255.0) as u8;
            }
        }
    }
}

/// A glossy floor mirrors lamps and beams of the ceiling, which move as far behind the floor as the
/// ceiling is above it. `shift_px` is the image's motion at the distance of the floor.
pub fn reflection(shift_px: (f64, f64), width: usize, amount: f64, samples: &mut [u8]) {
    /// Height of the camera over its distance to the mirrored ceiling.
    const FARTHER: f64 = 0.15;
    for (y, row) in samples.chunks_exact_mut(width).enumerate() {
        for (x, sample) in row.iter_mut().enumerate() {
            let (u, v) = (x as f64 + FARTHER * shift_px.0, y as f64 + FARTHER * shift_px.1);
            let lamp = (0.018 * u).sin().max(0.0).powi(6) * (0.05 * v).sin().max(0.0).powi(2);
            let beam = 0.3 * (0.09 * u + 0.02 * v).sin().max(0.0);
            *sample = (f64::from(*sample) + 255.0 * amount * (lamp + beam)).min(255.0) as u8;
        }
    }
}

/// A net of ropes or the shadow of a tree that swings before the camera: dark bars that move by
/// themselves.
pub fn swinging(time_s: f64, width: usize, samples: &mut [u8]) {
    let swing = 60.0 * (TAU * 0.7 * time_s).sin();
    for (y, row) in samples.chunks_exact_mut(width).enumerate() {
        for bar in 0..3 {
            let middle = width as f64 * (0.25 + 0.25 * bar as f64) + swing * y as f64 / 240.0;
            let (from, to) = ((middle - 9.0).max(0.0) as usize, (middle + 9.0).max(0.0) as usize);
            for (x, sample) in row.iter_mut().enumerate().take(to).skip(from) {
                *sample = if (y / 12 + x / 6) % 2 == 0 { 30 } else { 70 };
            }
        }
    }
}

//! Procedural textures. Colours are gray levels 0 to 255; lengths are metres.

use super::noise::{LatticeCache, cell, fractal, smooth_step, visibility};

type PatternPoint = (f64, f64);

fn tinted(gray: f32, tint: [f32; 3]) -> [f32; 3] {
    tint.map(|t| (gray * t).clamp(0.0, 255.0))
}

/// Stones in bitumen: octaves from 16 to 1 mm for the detail, metres for the wear.
pub(super) fn asphalt(cache: &mut LatticeCache, seed: u32, at: PatternPoint, footprint_m: f64) -> [f32; 3] {
    let wear = fractal(cache, seed ^ 1, at, footprint_m, 1.2, 4, 0.6);
    let stones = fractal(cache, seed ^ 2, at, footprint_m, 0.016, 5, 0.95);
    let bright = visibility(0.0045, footprint_m)
        * (fractal(cache, seed ^ 3, at, footprint_m, 0.009, 2, 0.7) - 0.35).max(0.0);
    tinted(102.0 + 16.0 * wear + 115.0 * stones + 150.0 * bright, [1.0, 1.0, 1.02])
}

/// Loops of 5 by 4 mm, each with its own brightness and brighter in the middle; two shades of yarn
/// in clouds.
pub(super) fn carpet(
    cache: &mut LatticeCache,
    seed: u32,
    (x, y): PatternPoint,
    footprint_m: f64,
) -> [f32; 3] {
    let (loop_x, loop_y) = (0.005, 0.004);
    // Real rows are not quite straight.
    let bent_x = x + 0.002 * f64::from(cache.value_noise(seed ^ 11, x / 0.05, y / 0.05));
    let bent_y = y + 0.002 * f64::from(cache.value_noise(seed ^ 12, x / 0.05, y / 0.05));
    let row = (bent_y / loop_y).floor();
    let along = bent_x / loop_x + 0.5 * row.rem_euclid(2.0);
    let (u, v) = (along - along.floor() - 0.5, bent_y / loop_y - row - 0.5);
    let bump = (1.0 - 4.0 * u * u).max(0.0) * (1.0 - 4.0 * v * v).max(0.0);
    let seen = visibility(loop_y, footprint_m);
    let own = cell(seed ^ 13, along.floor() as i64 as i32, row as i64 as i32) - 0.5;
    let shade = fractal(cache, seed ^ 14, (x, y), footprint_m, 0.06, 4, 0.8);
    let fibre = fractal(cache, seed ^ 16, (x, y), footprint_m, 0.004, 2, 0.8);
    let wear = fractal(cache, seed ^ 15, (x, y), footprint_m, 1.5, 3, 0.5);
    let gray = 98.0
        + seen * (46.0 * own * bump as f32 + 30.0 * (bump as f32 - 0.44))
        + 38.0 * shade
        + 45.0 * fibre
        + 12.0 * wear;
    tinted(gray, [1.08, 0.98, 0.92])
}

/// Square tiles with 4 mm of grout, each slightly lighter or darker, with faint marbling.
pub(super) fn tiles(cache: &mut LatticeCache, seed: u32, (x, y): PatternPoint, footprint_m: f64) -> [f32; 3] {
    let side = 0.20;
    let grout = joint(x, side, 0.004, footprint_m).max(joint(y, side, 0.004, footprint_m));
    let (i, j) = ((x / side).floor() as i64 as i32, (y / side).floor() as i64 as i32);
    let own = cell(seed ^ 21, i, j) - 0.5;
    // The marbling is different on every tile.
    let shift = f64::from(cell(seed ^ 22, i, j)) * 50.0;
    let marble = fractal(cache, seed ^ 23, (x + shift, y - shift), footprint_m, 0.05, 5, 0.6);
    let face = 168.0 + 6.0 * own + 10.0 * marble;
    let mortar = 95.0 + 14.0 * fractal(cache, seed ^ 24, (x, y), footprint_m, 0.02, 4, 0.8);
    tinted(face + grout * (mortar - face), [1.0, 0.99, 0.95])
}

/// Bricks in running bond with 8 mm of mortar, each with its own colour and a rough face.
pub(super) fn bricks(
    cache: &mut LatticeCache,
    seed: u32,
    (x, y): PatternPoint,
    footprint_m: f64,
) -> [f32; 3] {
    let (length, width) = (0.218, 0.073);
    let row = (y / width).floor();
    let along = x + 0.5 * length * row.rem_euclid(2.0);
    let mortar_share = joint(along, length, 0.008, footprint_m).max(joint(y, width, 0.008, footprint_m));
    let (i, j) = ((along / length).floor() as i64 as i32, row as i64 as i32);
    let own = cell(seed ^ 31, i, j) - 0.5;
    let red = cell(seed ^ 32, i, j) - 0.5;
    let face = fractal(cache, seed ^ 33, (x, y), footprint_m, 0.03, 5, 0.75);
    let gray = 108.0 + 34.0 * own + 44.0 * face;
    let mortar = 140.0 + 40.0 * fractal(cache, seed ^ 34, (x, y), footprint_m, 0.012, 4, 0.85);
    let brick = tinted(gray, [1.32 + 0.2 * red, 0.88, 0.72]);
    let mortar = tinted(mortar, [1.0, 0.98, 0.94]);
    std::array::from_fn(|c| brick[c] + mortar_share * (mortar[c] - brick[c]))
}

/// Sine and cosine of the directions of blades: 0.2 rad and every 0.628 rad from there. Written
/// down, because their last bits depend on the compiler and on the C library.
const BLADES: [(f64, f64); 4] = [
    (0.19866933079506122, 0.9800665778412416),
    (0.7365801446274042, 0.6763502720785085),
    (0.9934181345354686, 0.11454435811540296),
    (0.8711760712434613, -0.4909707250873596),
];

/// Blades: noise elongated along four directions, the brightest on top, over dark soil.
pub(super) fn grass(
    cache: &mut LatticeCache,
    seed: u32,
    at @ (x, y): PatternPoint,
    footprint_m: f64,
) -> [f32; 3] {
    // Bent blades: coordinates are shifted by millimetres, with a correlation length of
    // centimetres.
    let mut bend = |seed: u32| 0.006 * f64::from(cache.value_noise(seed, x / 0.04, y / 0.04));
    let (bent_x, bent_y) = (x + bend(seed ^ 40), y + bend(seed ^ 41));
    let seen = visibility(0.004, footprint_m);
    let mut top = -1.0f32;
    for (blade, (sin, cos)) in (0u32..).zip(BLADES) {
        let (along, across) = (cos * bent_x + sin * bent_y, -sin * bent_x + cos * bent_y);
        top = top.max(cache.value_noise(seed ^ (42 + blade), along / 0.026, across / 0.004));
    }
    let tufts = fractal(cache, seed ^ 48, at, footprint_m, 0.05, 4, 0.8);
    let patches = fractal(cache, seed ^ 49, at, footprint_m, 1.5, 4, 0.6);
    let gray = 92.0 + seen * 55.0 * (top - 0.45) + 55.0 * tufts + 26.0 * patches;
    let dry = 0.25 * patches;
    tinted(gray, [0.85 + dry, 1.18, 0.48 + 0.5 * dry])
}

/// Clouds over decimetres, fine grain and sparse pores.
pub(super) fn concrete(cache: &mut LatticeCache, seed: u32, at: PatternPoint, footprint_m: f64) -> [f32; 3] {
    let clouds = fractal(cache, seed ^ 51, at, footprint_m, 0.8, 5, 0.6);
    let grain = fractal(cache, seed ^ 52, at, footprint_m, 0.064, 6, 0.9);
    // Thresholding adds frequencies above those of its input, so the pores fade out before a pixel
    // would alias them.
    let pores = visibility(0.006, footprint_m)
        * (fractal(cache, seed ^ 53, at, footprint_m, 0.012, 2, 0.5) - 0.62).max(0.0);
    tinted(148.0 + 9.0 * clouds + 17.0 * grain - 130.0 * pores, [1.0, 1.0, 0.98])
}

/// A painted floor with a contrast of about one gray level.
pub(super) fn bare(cache: &mut LatticeCache, seed: u32, at: PatternPoint, footprint_m: f64) -> [f32; 3] {
    let clouds = fractal(cache, seed ^ 61, at, footprint_m, 0.5, 4, 0.7);
    let grain = fractal(cache, seed ^ 62, at, footprint_m, 0.02, 4, 0.8);
    tinted(152.0 + 1.6 * clouds + 2.0 * grain, [1.0, 1.0, 1.0])
}

/// Membership of a point in a patch, 0 to 1; patches cover about a third of the ground.
pub(super) fn patch(cache: &mut LatticeCache, seed: u32, (x, y): PatternPoint, patch_m: f64) -> f32 {
    let coarse = fractal(cache, seed ^ 71, (x, y), 1e-4, patch_m, 3, 0.4);
    // Borders are ragged at the scale of centimetres.
    let ragged = fractal(cache, seed ^ 72, (x, y), 1e-4, 0.12, 4, 0.7);
    smooth_step(0.5 + f64::from(coarse - 0.06 + 0.10 * ragged) / 0.12) as f32
}

/// Darkness of the shadows fixed to the ground, 0 (lit) to 1.
pub(super) fn ground_shadow(cache: &mut LatticeCache, seed: u32, (x, y): PatternPoint) -> f32 {
    // Elongated, as the shadows of poles and branches are.
    let (along, across) = (0.94 * x + 0.34 * y, -0.34 * x + 0.94 * y);
    let value = cache.value_noise(seed ^ 81, along / 3.0, across / 0.6);
    smooth_step(f64::from(value - 0.25) / 0.12) as f32
}

/// Fraction of a pixel covered by a joint of `width` that repeats every `period`, 0 to 1.
fn joint(x: f64, period: f64, width: f64, footprint_m: f64) -> f32 {
    let from_middle = (x / period - (x / period).round()).abs() * period;
    // The edge is blurred by the footprint of the pixel, and by at least a millimetre.
    let soft = footprint_m.max(0.001);
    let covered = smooth_step(0.5 + (0.5 * width - from_middle) / (1.5 * soft));
    // A joint narrower than the pixel cannot fill it.
    (covered * (width / footprint_m).min(1.0)) as f32
}

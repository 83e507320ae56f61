//! What cameras and their software do to images after the exposure, applied to rendered clips.
//!
//! None of these is modelled by the odometry: they show how it fares with effects that it was not
//! designed for.

mod light;
mod transmission;

use crate::clip::Clip;
use odograph::image::GrayImage;
use std::f64::consts::TAU;

/// A change of the images of a clip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Alteration {
    /// Sharpening as in phones: an unsharp mask of 3x3 pixels.
    Sharpened {
        /// How much of the difference from the local mean is added.
        amount: f64,
    },
    /// Temporal noise reduction: each image keeps a share of the one before.
    Ghosting {
        /// That share, 0 to 1.
        share: f64,
    },
    /// A line of digits that change, as surveillance cameras print it into the image.
    Overlay,
    /// Lamps that flicker, seen by a rolling shutter: dark bands that drift.
    Bands {
        /// Relative amplitude.
        amount: f64,
    },
    /// Every n-th image is a copy of the one before, with a time of its own.
    Duplicated {
        /// n.
        every: usize,
    },
    /// Streaks of rain, different in each image.
    Rain {
        /// How many.
        streaks: usize,
    },
    /// Even rows show the time of the image, odd rows that of the one before: interlaced video.
    Interlaced,
    /// Two images are one: a camera that resizes its images up by two.
    Upscaled,
    /// Light through water or moving leaves.
    Caustics {
        /// Relative amplitude.
        amount: f64,
    },
    /// Drops of water on the lens.
    Drops {
        /// How many.
        count: usize,
    },
    /// Snow or dust near the lens.
    Snow {
        /// How many in each image.
        flakes: usize,
    },
    /// A wheel of the robot in the image that turns as it drives.
    Wheel {
        /// Its radius.
        radius_px: f64,
    },
    /// Lamps and beams mirrored in a glossy floor.
    Reflection {
        /// How bright, as a fraction of white.
        amount: f64,
    },
    /// Ropes that swing before the camera.
    Swinging,
    /// Little contrast below a fixed pattern, as in thermal cameras.
    Thermal {
        /// Standard deviation of the pattern.
        gray: f64,
    },
    /// A dirty window before the lens: half of the contrast, and smears that are fixed.
    DirtyWindow {
        /// Standard deviation of the smears.
        gray: f64,
    },
    /// A grille before the lens.
    Grille,
    /// A sensor in the dark: little light, noise, columns that differ, and hot pixels.
    DarkSensor {
        /// Part of the light that is left.
        light: f64,
    },
    /// Below a line, the image before.
    Torn,
    /// Blocks that stay as they were two images before.
    LostBlocks {
        /// Share of all blocks.
        share: f64,
    },
    /// In every fourth image on average, a band of rows that stays as the image before was shown.
    LostRows,
    /// Each row of each image is brighter or darker by a random amount.
    RowNoise {
        /// Standard deviation.
        gray: f64,
    },
    /// Single pixels are black or white.
    Impulses {
        /// Share of all pixels.
        share: f64,
    },
    /// Rows of the sensor are black, and columns white.
    DeadLines {
        /// How many of each.
        count: usize,
    },
    /// Motion-JPEG of low quality.
    Blocky {
        /// Quantisation step of the lowest frequency, gray levels.
        quantum: f64,
    },
    /// Each pixel over the mean of its surroundings.
    ToneMapped,
    /// Overexposed: what is brighter than a fraction of white is white.
    Clipped {
        /// That fraction.
        at: f64,
    },
    /// Few gray levels.
    Posterized {
        /// How many.
        levels: usize,
    },
    /// Every n-th image is exchanged with the next.
    Swapped {
        /// n.
        every: usize,
    },
}

impl Alteration {
    /// Applies it to all images of a clip.
    pub fn apply(self, clip: &mut Clip, seed: u64) {
        let mut source = AlterationSource::new(self, clip, seed);
        for (number, (time_s, image)) in clip.frames.iter_mut().enumerate() {
            let mut samples = image.samples().to_vec();
            self.alter(number, *time_s, image, &mut source, &mut samples);
            if let Some(altered) = GrayImage::from_samples(image.width(), image.height(), samples) {
                *image = altered;
            }
        }
    }

    /// Alters the samples of an image.
    fn alter(
        self,
        number: usize,
        time_s: f64,
        image: &GrayImage,
        source: &mut AlterationSource,
        samples: &mut [u8],
    ) {
        let (width, seed) = (image.width(), source.seed);
        let before = source.originals.get(number.wrapping_sub(1));
        let random = &mut source.random;
        match self {
            Self::Sharpened { amount } => sharpen(image, amount, samples),
            Self::Ghosting { share } => ghost(share, &mut source.ghost, samples),
            Self::Overlay => overlay(number, width, samples),
            Self::Bands { amount } => bands(time_s, image, amount, samples),
            Self::Duplicated { every } => {
                if let Some(before) = before.filter(|_| number % every == every - 1) {
                    samples.copy_from_slice(before.samples());
                }
            }
            Self::Rain { streaks } => rain(image, streaks, random, samples),
            Self::Interlaced => {
                if let Some(before) = before {
                    interlace(before, samples);
                }
            }
            Self::Upscaled => upscale(image, samples),
            Self::Caustics { amount } => light::caustics(time_s, width, amount, samples),
            Self::Drops { count } => {
                light::drops(image, &source.drops[..count.min(source.drops.len())], samples);
            }
            Self::Snow { flakes } => light::snow(width, flakes, random, samples),
            Self::Wheel { radius_px } => {
                light::wheel(source.motion.path_m[number], width, radius_px, samples)
            }
            Self::Reflection { amount } => {
                light::reflection(source.motion.shift_px[number], width, amount, samples);
            }
            Self::Swinging => light::swinging(time_s, width, samples),
            Self::Thermal { gray } => transmission::thermal(width, gray, seed, samples),
            Self::DirtyWindow { gray } => transmission::dirty_window(&source.smears, gray, samples),
            Self::Grille => transmission::grille(width, samples),
            Self::DarkSensor { light } => transmission::dark_sensor(width, light, seed, random, samples),
            Self::Torn => {
                if let Some(before) = before {
                    transmission::torn(number, before, samples);
                }
            }
            Self::LostBlocks { share } => {
                if let Some(before) = source.originals.get(number.wrapping_sub(2)) {
                    transmission::lost_blocks(before, share, random, samples);
                }
            }
            Self::LostRows => transmission::lost_rows(width, &mut source.shown, random, samples),
            Self::RowNoise { gray } => transmission::row_noise(width, gray, random, samples),
            Self::Impulses { share } => transmission::impulses(share, random, samples),
            Self::DeadLines { count } => transmission::dead_lines(width, count, seed, samples),
            Self::Blocky { quantum } => transmission::blocky(width, quantum, samples),
            Self::ToneMapped => transmission::tone_mapped(image, samples),
            Self::Clipped { at } => {
                samples.iter_mut().for_each(|sample| *sample = (f64::from(*sample) / at).min(255.0) as u8);
            }
            Self::Posterized { levels } => posterize(levels, samples),
            Self::Swapped { every } => {
                if let Some(other) = source.originals.get(swapped_with(number, every)) {
                    samples.copy_from_slice(other.samples());
                }
            }
        }
    }
}

/// What the alterations of all images of a clip draw on.
struct AlterationSource {
    seed: u64,
    originals: Vec<GrayImage>,
    motion: TrueMotion,
    random: RandomStream,
    /// Running mean of [`Alteration::Ghosting`]; empty before the first image.
    ghost: Vec<f64>,
    /// The last image of [`Alteration::LostRows`]; empty before the first.
    shown: Vec<u8>,
    /// Of [`Alteration::DirtyWindow`].
    smears: Vec<f64>,
    /// Centres and radii of drops, pixels.
    drops: Vec<(f64, f64, f64)>,
}

impl AlterationSource {
    fn new(alteration: Alteration, clip: &Clip, seed: u64) -> Self {
        let originals: Vec<GrayImage> = clip.frames.iter().map(|(_, image)| image.clone()).collect();
        let mut random = RandomStream(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let size = originals.first().map_or((0, 0), |image| (image.width(), image.height()));
        let smears = match alteration {
            Alteration::DirtyWindow { .. } => transmission::smears(size, seed),
            _ => Vec::new(),
        };
        let drop = |_| {
            let x = random.below(size.0.max(1)) as f64;
            let y = random.below(size.1.max(1)) as f64;
            (x, y, 12.0 + random.below(24) as f64)
        };
        let drops = (0..30).map(drop).collect();
        let (ghost, shown) = (Vec::new(), Vec::new());
        Self { seed, originals, motion: TrueMotion::new(clip), random, ghost, shown, smears, drops }
    }
}

fn ghost(share: f64, ghost: &mut Vec<f64>, samples: &mut [u8]) {
    if ghost.is_empty() {
        *ghost = samples.iter().map(|&sample| f64::from(sample)).collect();
    }
    for (kept, sample) in ghost.iter_mut().zip(samples) {
        *kept = share * *kept + (1.0 - share) * f64::from(*sample);
        *sample = kept.round() as u8;
    }
}

fn bands(time_s: f64, image: &GrayImage, amount: f64, samples: &mut [u8]) {
    for (y, row) in samples.chunks_exact_mut(image.width()).enumerate() {
        let row_s = time_s + 0.02 * y as f64 / image.height() as f64;
        let gain = 1.0 + amount * (TAU * 100.0 * row_s).sin();
        row.iter_mut().for_each(|sample| *sample = (gain * f64::from(*sample)) as u8);
    }
}

fn rain(image: &GrayImage, streaks: usize, random: &mut RandomStream, samples: &mut [u8]) {
    let (width, height) = (image.width(), image.height());
    for _ in 0..streaks {
        let (x, y) = (random.below(width), random.below(height));
        for step in 0..24.min(height - y) {
            let at = (y + step) * width + (x + step / 6).min(width - 1);
            samples[at] = samples[at].saturating_add(60);
        }
    }
}

fn interlace(before: &GrayImage, samples: &mut [u8]) {
    for y in (1..before.height()).step_by(2) {
        let row = y * before.width()..(y + 1) * before.width();
        samples[row.clone()].copy_from_slice(&before.samples()[row]);
    }
}

fn posterize(levels: usize, samples: &mut [u8]) {
    let step = 256.0 / levels as f64;
    samples
        .iter_mut()
        .for_each(|sample| *sample = (step * ((f64::from(*sample) / step).floor() + 0.5)) as u8);
}

/// The image that takes the place of image `number`.
fn swapped_with(number: usize, every: usize) -> usize {
    match number % every {
        n if n + 2 == every => number + 1,
        n if n + 1 == every => number - 1,
        _ => number,
    }
}

/// True motion of the camera in a clip.
struct TrueMotion {
    /// Length of the path up to each frame, metres.
    path_m: Vec<f64>,
    /// Displacement of the image of the ground since the first frame, pixels.
    shift_px: Vec<(f64, f64)>,
}

impl TrueMotion {
    fn new(clip: &Clip) -> Self {
        let px_per_m = clip.camera.focal_px().0 / clip.rig.first_pose().height_m;
        let (mut path_m, mut shift_px) = (vec![0.0], vec![(0.0, 0.0)]);
        for pair in clip.truth.poses.windows(2) {
            let [before, after] = [&pair[0], &pair[1]].map(|pose| &pose.world_from_camera);
            let step = after.rotation.inverse() * (after.translation.vector - before.translation.vector);
            let (length, (x, y)) = (path_m[path_m.len() - 1], shift_px[shift_px.len() - 1]);
            path_m.push(length + step.norm());
            shift_px.push((x + px_per_m * step.x, y + px_per_m * step.y));
        }
        Self { path_m, shift_px }
    }
}

fn sharpen(image: &GrayImage, amount: f64, samples: &mut [u8]) {
    let (width, height, from) = (image.width(), image.height(), image.samples());
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let rows = [y - 1, y, y + 1].map(|y| y * width + x);
            let sum: f64 = rows.iter().flat_map(|&at| &from[at - 1..=at + 1]).map(|&s| f64::from(s)).sum();
            let here = f64::from(from[y * width + x]);
            samples[y * width + x] = (here + amount * (here - sum / 9.0)).round().clamp(0.0, 255.0) as u8;
        }
    }
}

/// Eighteen digits of 16 by 24 pixels, each a pattern of its own that stands for a digit.
fn overlay(number: usize, width: usize, samples: &mut [u8]) {
    for place in 0..18 {
        let digit = if place < 12 { place * 7 % 10 } else { number / 10usize.pow(17 - place as u32) % 10 };
        for (y, bits) in [0x7u8, 0x5, 0x7, 0x1, 0x7, 0x4].iter().enumerate() {
            let bits = bits.rotate_left(digit as u32);
            for x in 0..4 {
                let lit = bits >> x & 1 == 1;
                for at in 0..16 {
                    let (px, py) = (16 + 20 * place + 4 * x + at % 4, 12 + 4 * y + at / 4);
                    if px < width {
                        samples[py * width + px] = if lit { 250 } else { 10 };
                    }
                }
            }
        }
    }
}

/// Half the resolution, made large again by repeating pixels bilinearly.
fn upscale(image: &GrayImage, samples: &mut [u8]) {
    let (width, height, from) = (image.width(), image.height(), image.samples());
    let half = |x: usize, y: usize| {
        let (x, y) = (2 * x.min(width / 2 - 1), 2 * y.min(height / 2 - 1));
        let at = y * width + x;
        [from[at], from[at + 1], from[at + width], from[at + width + 1]].map(f64::from).iter().sum::<f64>()
            / 4.0
    };
    for y in 0..height {
        for x in 0..width {
            let (u, v) = ((x as f64 - 0.5) / 2.0, (y as f64 - 0.5) / 2.0);
            let (u, v) = (u.max(0.0), v.max(0.0));
            let (a, b) = (u.fract(), v.fract());
            let (i, k) = (u as usize, v as usize);
            let top = (1.0 - a) * half(i, k) + a * half(i + 1, k);
            let bottom = (1.0 - a) * half(i, k + 1) + a * half(i + 1, k + 1);
            samples[y * width + x] = ((1.0 - b) * top + b * bottom).round() as u8;
        }
    }
}

/// A stream of random numbers (xorshift; G. Marsaglia, 2003).
pub(super) struct RandomStream(u64);

impl RandomStream {
    fn below(&mut self, count: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 33) as usize % count
    }
}

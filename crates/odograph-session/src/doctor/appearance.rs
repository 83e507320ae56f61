//! What the images show by themselves: exposure, corners, traces of coding, sharpness by direction.

use odograph::detection::{DetectionConfig, detect};
use odograph::geometry::length;
use odograph::image::{GrayImage, noise_variance};
use odograph::numerics::median;

/// One frame in this many is examined in full.
const EVERY: u64 = 5;

/// Cells along the width and along the height in which corners are counted.
const CELLS: (usize, usize) = (8, 6);

/// Distance of corners from the border of the image, pixels.
const MARGIN_PX: usize = 9;

/// Pixels along the side of a block of JPEG, and of the transforms of older video codecs.
const BLOCK_PX: usize = 8;

/// Black and white are at most this far from the ends of the gray levels: 16 and 235 in video of
/// limited range.
const FARTHEST_END: usize = 40;

/// Larger steps between neighbouring pixels are edges of the texture, not of blocks, gray levels.
const MOST_STEP: u32 = 12;

/// Energy of the gradient by direction: the structure tensor of a whole image,
/// (gray levels per pixel)².
#[derive(Debug, Clone, Copy, PartialEq)]
struct GradientEnergy {
    xx: f64,
    xy: f64,
    yy: f64,
}

impl GradientEnergy {
    /// Of an image reduced by this factor, less the noise.
    fn of(image: &GrayImage, reduced_by: usize, noise_variance: f64) -> Self {
        let (width, height) = (image.width() / reduced_by, image.height() / reduced_by);
        let pixels = (reduced_by * reduced_by) as f64;
        let mean = |x: usize, y: usize| {
            let rows = (reduced_by * y..reduced_by * (y + 1)).map(|row| image.row(row));
            let sum: u32 =
                rows.flat_map(|row| &row[reduced_by * x..][..reduced_by]).map(|gray| u32::from(*gray)).sum();
            f64::from(sum) / pixels
        };
        let rows: Vec<Vec<f64>> = (0..height).map(|y| (0..width).map(|x| mean(x, y)).collect()).collect();
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for three in rows.windows(3) {
            for x in 1..width.saturating_sub(1) {
                let (dx, dy) = (three[1][x + 1] - three[1][x - 1], three[2][x] - three[0][x]);
                xx += dx * dx;
                xy += dx * dy;
                yy += dy * dy;
            }
        }
        let count = (width.saturating_sub(2) * height.saturating_sub(2)).max(1) as f64;
        // A difference of two means has twice the noise variance of a mean.
        let noise = 2.0 * noise_variance / pixels;
        Self { xx: (xx / count - noise).max(0.0), xy: xy / count, yy: (yy / count - noise).max(0.0) }
    }

    /// Amplitude along a direction of length 1 over that across it; `None` without texture.
    fn along(&self, (x, y): (f64, f64)) -> Option<f64> {
        let along = x * x * self.xx + 2.0 * x * y * self.xy + y * y * self.yy;
        let across = self.xx + self.yy - along;
        (along > 0.0 && across > 0.0).then(|| (along / across).sqrt())
    }
}

/// Gradient energies of fine and of coarse structures. Motion blur removes the fine ones along the
/// motion; the grain of a floor, such as the joints of bricks, is in both.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sharpness {
    fine: GradientEnergy,
    coarse: GradientEnergy,
    noise_variance: f64,
}

/// Noise of the quantisation to gray levels, (gray levels)².
const LEAST_NOISE: f64 = 1.0 / 12.0;

/// Factors by which an image is reduced for fine and for coarse structures.
const FINE: usize = 2;
const COARSE: usize = 8;

impl Sharpness {
    fn of(image: &GrayImage) -> Self {
        let noise_variance = noise_variance(image);
        let [fine, coarse] =
            [FINE, COARSE].map(|reduced_by| GradientEnergy::of(image, reduced_by, noise_variance));
        Self { fine, coarse, noise_variance }
    }

    /// Amplitude of the fine gradients over that of the noise in them. Fine texture is partly taken
    /// for noise, so that this is a lower bound.
    fn over_noise(&self) -> f64 {
        // As in `GradientEnergy::of`, in both directions.
        let noise = 4.0 * self.noise_variance / (FINE * FINE) as f64;
        ((self.fine.xx + self.fine.yy) / noise.max(LEAST_NOISE)).sqrt()
    }

    /// Amplitude of fine gradients along a direction over that across it, relative to the same of
    /// coarse ones: 1 where no direction is blurred. `None` without texture.
    pub fn along(&self, (x, y): (f64, f64)) -> Option<f64> {
        let norm = length(x, y);
        let direction = (x / norm, y / norm);
        Some(self.fine.along(direction)? / self.coarse.along(direction)?)
    }
}

/// Sums over the images.
#[derive(Debug)]
pub struct Appearance {
    size: (usize, usize),
    detection: DetectionConfig,
    images: u64,
    /// Number of samples of each gray level.
    levels: [u64; 256],
    /// Corners, and cells with a corner, of each image that was looked at in full.
    corners: Vec<f64>,
    cells: Vec<f64>,
    /// Texture over noise of these images.
    over_noise: Vec<f64>,
    /// Steps between a column or row and the next by its place in a block, clipped, and their
    /// number.
    steps: [(u64, u64); BLOCK_PX],
}

impl Appearance {
    /// For images of this size.
    pub fn new(size: (usize, usize), detection: DetectionConfig) -> Self {
        Self {
            size,
            detection,
            images: 0,
            levels: [0; 256],
            corners: Vec::new(),
            cells: Vec::new(),
            over_noise: Vec::new(),
            steps: [(0, 0); BLOCK_PX],
        }
    }

    /// Takes the next image; returns its sharpness where it is looked at in full.
    pub fn look(&mut self, image: &GrayImage) -> Option<Sharpness> {
        self.images += 1;
        if !(self.images - 1).is_multiple_of(EVERY) {
            return None;
        }
        for &sample in image.samples() {
            self.levels[usize::from(sample)] += 1;
        }
        let corners = detect(image, &self.detection, MARGIN_PX);
        let mut has_corner = [false; CELLS.0 * CELLS.1];
        for corner in &corners {
            let (column, row) = (corner.x * CELLS.0 / self.size.0, corner.y * CELLS.1 / self.size.1);
            has_corner[(row * CELLS.0 + column).min(CELLS.0 * CELLS.1 - 1)] = true;
        }
        self.corners.push(corners.len() as f64);
        self.cells.push(has_corner.iter().filter(|has| **has).count() as f64 / has_corner.len() as f64);
        self.add_steps(image);
        let sharpness = Sharpness::of(image);
        self.over_noise.push(sharpness.over_noise());
        Some(sharpness)
    }

    fn add_steps(&mut self, image: &GrayImage) {
        let step = |a: u8, b: u8| u64::from(u32::from(a.abs_diff(b)).min(MOST_STEP));
        for y in 0..image.height() {
            let row = image.row(y);
            for (x, pair) in row.windows(2).enumerate() {
                let place = &mut self.steps[x % BLOCK_PX];
                *place = (place.0 + step(pair[0], pair[1]), place.1 + 1);
            }
            if y + 1 < image.height() {
                let place = &mut self.steps[y % BLOCK_PX];
                let sum: u64 = row.iter().zip(image.row(y + 1)).map(|(a, b)| step(*a, *b)).sum();
                *place = (place.0 + sum, place.1 + row.len() as u64);
            }
        }
    }

    /// Number of corners per image, and the fraction of the image's cells that have one; medians.
    pub fn corners(&self) -> (f64, f64) {
        let of = |values: &[f64]| median(&mut values.to_vec()).unwrap_or(0.0);
        (of(&self.corners), of(&self.cells))
    }

    /// Amplitude of the texture over that of the noise, the median.
    pub fn over_noise(&self) -> f64 {
        median(&mut self.over_noise.clone()).unwrap_or(0.0)
    }

    /// Number of corners that are looked for.
    pub fn wanted_corners(&self) -> usize {
        self.detection.corners
    }

    /// Mean gray level, 0 to 255.
    pub fn mean_gray(&self) -> f64 {
        let sum: f64 = self.levels.iter().enumerate().map(|(gray, count)| gray as f64 * *count as f64).sum();
        sum / self.samples()
    }

    /// Fractions of the samples that are clipped to black and to white. Samples are taken to be
    /// clipped if the darkest or brightest three levels have more of them than the three beside.
    pub fn clipped(&self) -> (f64, f64) {
        let few = 1e-4 * self.samples();
        let share = |levels: &mut dyn Iterator<Item = &u64>| {
            let levels: Vec<f64> = levels.map(|count| *count as f64).collect();
            let mut passed = 0.0;
            let end = levels.iter().position(|count| {
                passed += count;
                passed > few
            });
            let sum = |from: usize| levels.iter().skip(from).take(3).sum::<f64>();
            match end {
                Some(end) if end <= FARTHEST_END && sum(end) > 2.0 * sum(end + 3) => {
                    sum(end) / self.samples()
                }
                _ => 0.0,
            }
        };
        (share(&mut self.levels.iter()), share(&mut self.levels.iter().rev()))
    }

    /// Steps at the borders of blocks over the other steps: 1 without blocks.
    pub fn blockiness(&self) -> f64 {
        let mut means: Vec<f64> =
            self.steps.iter().map(|(sum, count)| *sum as f64 / (*count).max(1) as f64).collect();
        let largest = means.iter().copied().fold(0.0, f64::max);
        match median(&mut means) {
            Some(usual) if usual > 0.0 => largest / usual,
            _ => 1.0,
        }
    }

    fn samples(&self) -> f64 {
        self.levels.iter().sum::<u64>().max(1) as f64
    }
}

/// Lengths of a blur, pixels, and the sharpness along it that they leave: means over rendered
/// asphalt, carpet, grass and concrete.
const SHARPNESS_BY_BLUR: [(f64, f64); 5] =
    [(0.0, 1.0), (3.0, 0.905), (5.0, 0.772), (8.0, 0.643), (13.0, 0.555)];

/// Length of a blur that leaves this sharpness, pixels.
pub fn blur_px(sharpness: f64) -> f64 {
    let (longest_px, least) = SHARPNESS_BY_BLUR[SHARPNESS_BY_BLUR.len() - 1];
    let sharpness = sharpness.clamp(least, 1.0);
    let between = SHARPNESS_BY_BLUR.windows(2).find(|pair| sharpness >= pair[1].1);
    between.map_or(longest_px, |pair| {
        let ((from_px, from), (to_px, to)) = (pair[0], pair[1]);
        from_px + (to_px - from_px) * (from - sharpness) / (from - to)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An image of noise in squares of `width` by `height` pixels, and fainter noise of each pixel.
    fn squares(width: usize, height: usize) -> GrayImage {
        let gray = |x: usize, y: usize| {
            let mixed = ((x / width + 1) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
                ^ ((y / height + 1) as u64).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            64 + ((mixed ^ (mixed >> 29)).wrapping_mul(0x94D0_49BB_1331_11EB) >> 57) as u8
                + ((7 * x + 3 * y) % 5) as u8
        };
        let samples = (0..320 * 240).map(|at| gray(at % 320, at / 320)).collect();
        GrayImage::from_samples(320, 240, samples).unwrap()
    }

    fn looked(image: &GrayImage) -> Appearance {
        let mut appearance = Appearance::new((320, 240), DetectionConfig::default());
        appearance.look(image).unwrap();
        appearance
    }

    #[test]
    fn blocks_of_eight_are_seen_and_others_are_not() {
        assert!(looked(&squares(8, 8)).blockiness() > 2.0);
        assert!((looked(&squares(5, 7)).blockiness() - 1.0).abs() < 0.1);
    }

    #[test]
    fn clipped_samples_are_those_at_an_end_of_the_levels() {
        let image = squares(5, 7);
        assert_eq!(looked(&image).clipped(), (0.0, 0.0));
        let white = GrayImage::from_samples(320, 240, vec![255; 320 * 240]).unwrap();
        assert_eq!(looked(&white).clipped(), (0.0, 1.0));
        let brighter = image.samples().iter().map(|gray| gray.saturating_add(100)).collect();
        let (dark, bright) = looked(&GrayImage::from_samples(320, 240, brighter).unwrap()).clipped();
        let expected = image.samples().iter().filter(|gray| **gray >= 153).count() as f64 / 76_800.0;
        assert!(dark == 0.0 && (bright - expected).abs() < 0.02, "{dark} {bright} {expected}");
    }

    #[test]
    fn a_blurred_image_is_less_sharp_along_the_blur_and_grain_is_no_blur() {
        let blurred = |image: &GrayImage| {
            let mean = |at: usize| {
                let (x, row) = (at % 320, image.row(at / 320));
                let window = &row[x.saturating_sub(4)..(x + 4).min(320)];
                (window.iter().map(|gray| u32::from(*gray)).sum::<u32>() / window.len() as u32) as u8
            };
            GrayImage::from_samples(320, 240, (0..320 * 240).map(mean).collect()).unwrap()
        };
        let along = |image: &GrayImage| Sharpness::of(image).along((2.0, 0.0)).unwrap();
        assert!((along(&squares(5, 5)) - 1.0).abs() < 0.1);
        assert!(along(&blurred(&squares(5, 5))) < 0.8);
        assert!(Sharpness::of(&blurred(&squares(5, 5))).along((0.0, -1.0)).unwrap() > 1.2);
        assert_eq!(Sharpness::of(&GrayImage::new(320, 240)).along((1.0, 0.0)), None);
    }

    #[test]
    fn blur_follows_from_sharpness() {
        assert_eq!(blur_px(1.2), 0.0);
        assert!((blur_px(0.772) - 5.0).abs() < 1e-9);
        assert!((blur_px(0.7075) - 6.5).abs() < 1e-9);
        assert!((blur_px(0.1) - 13.0).abs() < 1e-9);
    }
}

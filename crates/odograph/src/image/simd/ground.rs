//! Laying frames on the ground: eight ground pixels of a row at a time are taken from a frame and averaged into what lies there already.
//!
//! The reference is one pixel after the other, [`lay_eight_by_one`]; for AVX2 and for NEON eight are done side by side (`wide`, `neon`). All give the same bytes:
//! no multiply-add is fused, and each pixel's operations have the reference's order.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "x86_64")]
mod wide;

/// Ground pixels that are laid at a time.
pub const LANES: usize = 8;

/// Ground seen this many times as well before is not touched again.
const OUTWEIGHED: i32 = 6;

/// How much a sample counts by where in the image it is.
#[derive(Debug, Clone, Copy)]
pub struct Feather {
    pub right: f32,
    pub bottom: f32,
    /// One over half the shorter side, 1/px.
    by_half: f32,
}

impl Feather {
    /// For images of this size.
    pub fn new(width: usize, height: usize) -> Self {
        let (width, height) = (width as f32, height as f32);
        Self { right: width - 1.0, bottom: height - 1.0, by_half: 2.0 / width.min(height) }
    }

    /// The weight, 1 to 63: greatest in the middle of the image, 1 at its border, less where the ground is seen at a slant.
    /// 0 outside the centres of the outermost pixels.
    #[inline(always)]
    pub fn weight(&self, x: f32, y: f32, quality: f32) -> i32 {
        let from_border = x.min(self.right - x).min(y.min(self.bottom - y));
        let share = ((from_border + 0.5) * self.by_half).min(1.0);
        let weight = (1.0 + 62.0 * share * share * quality) as i32;
        if from_border >= 0.0 { weight } else { 0 }
    }
}

/// Where eight ground pixels are in the full image, and how well each is seen there, 0 to 1. A place that is not a number is outside.
#[derive(Debug, Clone, Copy)]
pub struct Places {
    pub x: [f32; LANES],
    pub y: [f32; LANES],
    pub quality: [f32; LANES],
}

/// A frame of `N` interleaved channels that is being laid.
#[derive(Debug, Clone, Copy)]
pub struct Laid<'a, const N: usize> {
    samples: &'a [u8],
    width: usize,
    /// Pixels of these samples per pixel of the full image.
    scale: f32,
    /// Greatest coordinates between which can be sampled.
    right: f32,
    bottom: f32,
    feather: Feather,
    /// What the samples are multiplied with.
    gains: [f32; N],
}

impl<'a, const N: usize> Laid<'a, N> {
    /// A frame as its samples, `size` wide and high, `scale` times as many along a side as `feather`'s full image. `None` where there are not
    /// as many samples as that, fewer than two columns or rows, or more than can be counted in 31 bits.
    pub fn new(
        samples: &'a [u8],
        size: (usize, usize),
        scale: f32,
        feather: Feather,
        gains: [f32; N],
    ) -> Option<Self> {
        let (width, height) = size;
        let whole = width > 1 && height > 1 && samples.len() == width * height * N;
        (whole && i32::try_from(samples.len()).is_ok()).then_some(Self {
            samples,
            width,
            scale,
            right: width as f32 - 1.0,
            bottom: height as f32 - 1.0,
            feather,
            gains,
        })
    }

    /// Where a place of the full image is between these samples.
    #[inline(always)]
    fn between(&self, x: f32, y: f32) -> (f32, f32) {
        let offset = 0.5 * self.scale - 0.5;
        (x * self.scale + offset, y * self.scale + offset)
    }

    #[inline(always)]
    fn contains(&self, x: f32, y: f32) -> bool {
        x >= 0.0 && y >= 0.0 && x <= self.right && y <= self.bottom
    }

    /// The bilinear sample at a place between the samples, which must be contained.
    #[inline(always)]
    fn sample(&self, x: f32, y: f32) -> [f32; N] {
        let (left, top) = self.upper_left(x, y);
        let (dx, dy) = (x - left as f32, y - top as f32);
        let at = (top as usize * self.width + left as usize) * N;
        let below = at + self.width * N;
        std::array::from_fn(|channel| {
            let value = |at: usize| f32::from(self.samples[at + channel]);
            let (a, b) = (value(at), value(at + N));
            let (c, d) = (value(below), value(below + N));
            let (up, down) = (a + (b - a) * dx, c + (d - c) * dx);
            up + (down - up) * dy
        })
    }

    /// The column and the row of the upper left of the four samples about a place.
    #[inline(always)]
    fn upper_left(&self, x: f32, y: f32) -> (i32, i32) {
        ((x as i32).min(self.right as i32 - 1), (y as i32).min(self.bottom as i32 - 1))
    }
}

/// Averages a frame into eight neighbouring ground pixels (red, green, blue and weight). Returns whether it shows any of them.
pub fn lay_eight<const N: usize>(
    frame: &Laid<'_, N>,
    places: &Places,
    pixels: &mut [[u8; 4]; LANES],
) -> bool {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { wide::lay_eight(frame, places, pixels) };
    }
    #[cfg(target_arch = "aarch64")]
    if std::arch::is_aarch64_feature_detected!("neon") {
        // SAFETY: the processor has NEON.
        return unsafe { neon::lay_eight(frame, places, pixels) };
    }
    lay_eight_by_one(frame, places, pixels)
}

/// The reference of [`lay_eight`].
fn lay_eight_by_one<const N: usize>(
    frame: &Laid<'_, N>,
    places: &Places,
    pixels: &mut [[u8; 4]; LANES],
) -> bool {
    let mut seen = false;
    for (i, pixel) in pixels.iter_mut().enumerate() {
        let weight = frame.feather.weight(places.x[i], places.y[i], places.quality[i]);
        seen |= weight > 0;
        let (x, y) = frame.between(places.x[i], places.y[i]);
        // What was seen much better before is left as it is: sharper, and quicker.
        if i32::from(pixel[3]) < OUTWEIGHED * weight && frame.contains(x, y) {
            *pixel = blended(*pixel, frame.sample(x, y), &frame.gains, weight);
        }
    }
    seen
}

/// The weighted mean of a stored pixel (colour and weight) and a sample.
#[inline(always)]
fn blended<const N: usize>(pixel: [u8; 4], sample: [f32; N], gains: &[f32; N], weight: i32) -> [u8; 4] {
    let before = i32::from(pixel[3]);
    let share = weight as f32 / (before as f32 + weight as f32);
    let mut blended = [0; 4];
    for (channel, into) in blended[..3].iter_mut().enumerate() {
        let from = channel.min(N - 1); // gray is laid as three channels alike
        let old = f32::from(pixel[channel]);
        let new = (sample[from] * gains[from]).min(255.0);
        *into = (old + (new - old) * share + 0.5) as i32 as u8;
    }
    blended[3] = (before + weight).min(255) as u8;
    blended
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn random(seed: u32) -> impl Iterator<Item = u8> {
        let mut state = seed;
        std::iter::repeat_with(move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
    }

    /// Eight places in a row from `first` in steps of `step`, laid by the kernel and by its reference.
    fn both<const N: usize>(
        size: (usize, usize),
        scale: f32,
        seed: u32,
        first: [f32; 2],
        step: [f32; 2],
    ) -> [(bool, [[u8; 4]; LANES]); 2] {
        let mut bytes = random(seed);
        let samples: Vec<u8> = bytes.by_ref().take(size.0 * size.1 * N).collect();
        let full = ((size.0 as f32 / scale) as usize, (size.1 as f32 / scale) as usize);
        let gains = std::array::from_fn(|channel| 0.8 + 0.3 * channel as f32);
        let frame = Laid::<N>::new(&samples, size, scale, Feather::new(full.0, full.1), gains).unwrap();
        let along = |axis: usize| {
            std::array::from_fn(|i| first[axis] * (full.0.min(full.1) as f32) + step[axis] * i as f32)
        };
        let mut quality = [1.0; LANES];
        quality[3] = 0.3;
        let places = Places { x: along(0), y: along(1), quality };
        let pixels: [[u8; 4]; LANES] = [(); LANES].map(|()| [(); 4].map(|()| bytes.next().unwrap()));
        [lay_eight::<N>, lay_eight_by_one::<N>].map(|lay| {
            let mut pixels = pixels;
            (lay(&frame, &places, &mut pixels), pixels)
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn eight_pixels_are_laid_as_one_by_one(
            width in 2usize..60, height in 2usize..60, half in any::<bool>(), seed in any::<u32>(),
            first in prop::array::uniform2(-0.2..1.2f32), step in prop::array::uniform2(-2.0..2.0f32),
        ) {
            let scale = if half { 0.5 } else { 1.0 };
            let [found, expected] = both::<1>((width, height), scale, seed, first, step);
            prop_assert_eq!(found, expected);
            let [found, expected] = both::<3>((width, height), scale, seed, first, step);
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn the_last_samples_of_an_image_can_be_laid_and_what_is_no_number_is_not() {
        for kernel in [lay_eight::<3>, lay_eight_by_one::<3>] {
            let samples = [10, 20, 30].repeat(4);
            let frame = Laid::new(&samples, (2, 2), 1.0, Feather::new(2, 2), [1.0; 3]).unwrap();
            let mut x = [1.0; LANES];
            x[0] = f32::NAN;
            let mut pixels = [[0; 4]; LANES];
            assert!(kernel(&frame, &Places { x, y: [1.0; LANES], quality: [1.0; LANES] }, &mut pixels));
            assert_eq!(pixels[0], [0; 4]);
            assert_eq!(pixels[1][..3], [10, 20, 30]);
        }
    }
}

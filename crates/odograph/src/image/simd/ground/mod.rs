//! Orthorectification: samples a frame at eight ground pixels of a row at a time and averages them
//! into the orthophoto.
//!
//! The scalar reference is [`orthorectify_eight_by_one`], one pixel after the other; AVX2 and NEON
//! process eight in parallel (`wide`, `neon`). All produce the same bytes: multiply-adds are never
//! fused, and each pixel's operations have the reference's order.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "x86_64")]
mod wide;

/// Ground pixels processed at a time.
pub const LANES: usize = 8;

/// Ground pixels whose accumulated weight is at least this many times the new weight are not
/// updated.
const OUTWEIGHED: i32 = 6;

/// Weight of a sample by its position in the image (feathering).
#[derive(Debug, Clone, Copy)]
pub struct Feather {
    pub right: f32,
    pub bottom: f32,
    /// Inverse of half the shorter side, 1/px.
    by_half: f32,
}

impl Feather {
    /// Feathering for images of this size, pixels.
    pub fn new(width: usize, height: usize) -> Self {
        let (width, height) = (width as f32, height as f32);
        Self { right: width - 1.0, bottom: height - 1.0, by_half: 2.0 / width.min(height) }
    }

    /// Weight from 1 to 63: highest in the middle of the image, 1 at its border, lower for oblique
    /// views (`quality` below 1). 0 outside the centres of the outermost pixels.
    #[inline(always)]
    pub fn weight(&self, x: f32, y: f32, quality: f32) -> i32 {
        let from_border = x.min(self.right - x).min(y.min(self.bottom - y));
        let share = ((from_border + 0.5) * self.by_half).min(1.0);
        let weight = (1.0 + 62.0 * share * share * quality) as i32;
        if from_border >= 0.0 { weight } else { 0 }
    }
}

/// Positions of eight ground pixels in the full-resolution image, with their viewing quality from 0
/// to 1. NaN counts as outside.
#[derive(Debug, Clone, Copy)]
pub struct Places {
    pub x: [f32; LANES],
    pub y: [f32; LANES],
    pub quality: [f32; LANES],
}

/// A frame of `N` interleaved channels to be orthorectified.
#[derive(Debug, Clone, Copy)]
pub struct UnrectifiedFrame<'a, const N: usize> {
    samples: &'a [u8],
    width: usize,
    /// Size of these samples relative to the full-resolution image.
    scale: f32,
    /// Largest coordinates that can be sampled.
    right: f32,
    bottom: f32,
    feather: Feather,
    /// Gain of each channel.
    gains: [f32; N],
}

impl<'a, const N: usize> UnrectifiedFrame<'a, N> {
    /// A frame of `size` (width, height); `scale` is its size relative to the full-resolution image
    /// of `feather`. `None` where the number of samples does not match, where there are fewer than
    /// two columns or rows, or where the number exceeds 31 bits.
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

    /// Converts a position in the full-resolution image to one in these samples.
    #[inline(always)]
    fn between(&self, x: f32, y: f32) -> (f32, f32) {
        let offset = 0.5 * self.scale - 0.5;
        (x * self.scale + offset, y * self.scale + offset)
    }

    #[inline(always)]
    fn contains(&self, x: f32, y: f32) -> bool {
        x >= 0.0 && y >= 0.0 && x <= self.right && y <= self.bottom
    }

    /// Bilinear sample at a position, which must be contained.
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

    /// Column and row of the upper left of the four samples around a position.
    #[inline(always)]
    fn upper_left(&self, x: f32, y: f32) -> (i32, i32) {
        ((x as i32).min(self.right as i32 - 1), (y as i32).min(self.bottom as i32 - 1))
    }
}

/// Averages a frame into eight neighbouring ground pixels (red, green, blue and weight). Returns
/// whether the frame shows any of them.
pub fn orthorectify_eight<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    places: &Places,
    pixels: &mut [[u8; 4]; LANES],
) -> bool {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { wide::orthorectify_eight(frame, places, pixels) };
    }
    #[cfg(target_arch = "aarch64")]
    if std::arch::is_aarch64_feature_detected!("neon") {
        // SAFETY: the processor has NEON.
        return unsafe { neon::orthorectify_eight(frame, places, pixels) };
    }
    orthorectify_eight_by_one(frame, places, pixels)
}

/// The scalar reference of [`orthorectify_eight`].
fn orthorectify_eight_by_one<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    places: &Places,
    pixels: &mut [[u8; 4]; LANES],
) -> bool {
    let mut seen = false;
    for (i, pixel) in pixels.iter_mut().enumerate() {
        let weight = frame.feather.weight(places.x[i], places.y[i], places.quality[i]);
        seen |= weight > 0;
        let (x, y) = frame.between(places.x[i], places.y[i]);
        // Ground seen with much higher weight before is left unchanged: sharper, and faster.
        if i32::from(pixel[3]) < OUTWEIGHED * weight && frame.contains(x, y) {
            *pixel = blended(*pixel, frame.sample(x, y), &frame.gains, weight);
        }
    }
    seen
}

/// Weighted mean of a stored pixel (colour and weight) and a sample.
#[inline(always)]
fn blended<const N: usize>(pixel: [u8; 4], sample: [f32; N], gains: &[f32; N], weight: i32) -> [u8; 4] {
    let before = i32::from(pixel[3]);
    let share = weight as f32 / (before as f32 + weight as f32);
    let mut blended = [0; 4];
    for (channel, into) in blended[..3].iter_mut().enumerate() {
        let from = channel.min(N - 1); // a gray sample sets all three channels
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

    /// Eight positions in a row from `first` in steps of `step`, processed by the kernel and by its
    /// reference.
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
        let frame =
            UnrectifiedFrame::<N>::new(&samples, size, scale, Feather::new(full.0, full.1), gains).unwrap();
        let along = |axis: usize| {
            std::array::from_fn(|i| first[axis] * (full.0.min(full.1) as f32) + step[axis] * i as f32)
        };
        let mut quality = [1.0; LANES];
        quality[3] = 0.3;
        let places = Places { x: along(0), y: along(1), quality };
        let pixels: [[u8; 4]; LANES] = [(); LANES].map(|()| [(); 4].map(|()| bytes.next().unwrap()));
        [orthorectify_eight::<N>, orthorectify_eight_by_one::<N>].map(|lay| {
            let mut pixels = pixels;
            (lay(&frame, &places, &mut pixels), pixels)
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn eight_pixels_are_rendered_as_one_by_one(
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
    fn border_samples_are_used_and_nan_positions_are_skipped() {
        for kernel in [orthorectify_eight::<3>, orthorectify_eight_by_one::<3>] {
            let samples = [10, 20, 30].repeat(4);
            let frame = UnrectifiedFrame::new(&samples, (2, 2), 1.0, Feather::new(2, 2), [1.0; 3]).unwrap();
            let mut x = [1.0; LANES];
            x[0] = f32::NAN;
            let mut pixels = [[0; 4]; LANES];
            assert!(kernel(&frame, &Places { x, y: [1.0; LANES], quality: [1.0; LANES] }, &mut pixels));
            assert_eq!(pixels[0], [0; 4]);
            assert_eq!(pixels[1][..3], [10, 20, 30]);
        }
    }
}

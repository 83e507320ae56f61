//! The ground as a raster that is made where it is looked at.

use super::patterns::ground_shadow;
use super::texture::{Texture, luminance};
use crate::error::{Error, Result};
use crate::geometry::GroundPoint;
use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock};

/// Texels along the side of a chunk.
pub(super) const CHUNK: usize = 128;
/// Texels along the side of a stored chunk: one more before and two after, so that a bicubic sample never needs a second chunk.
pub(super) const STRIDE: usize = CHUNK + 3;
/// Stored samples are gray levels times this.
pub(super) const SAMPLE_SCALE: f32 = 256.0;
/// Chunks are thrown away when they hold more than this; they come back the same.
const MEMORY_LIMIT_BYTES: usize = 384 << 20;

/// A texture, rasterised at a resolution that suits a camera, chunk by chunk as it is looked at.
///
/// Level 0 has two texels for every `footprint_m`; every further level is half as fine, every negative one twice. Each holds what a
/// pixel with a footprint of two of its texels sees. May be shared between threads.
#[derive(Debug)]
pub struct Ground {
    texture: Texture,
    footprint_m: f64,
    colored: bool,
    shadow: f32,
    seed: u64,
    chunks: RwLock<HashMap<ChunkIndex, Arc<Chunk>>>,
}

/// Which piece of the raster: level, and chunk counts along x and y.
pub(super) type ChunkIndex = (i32, i64, i64);

/// A piece of the raster: one plane of `STRIDE` × `STRIDE` samples a channel.
#[derive(Debug)]
pub(super) struct Chunk {
    samples: Vec<u16>,
}

impl Chunk {
    /// The samples of one channel, row by row.
    #[inline]
    pub(super) fn plane(&self, channel: usize) -> &[u16] {
        &self.samples[channel * STRIDE * STRIDE..][..STRIDE * STRIDE]
    }
}

impl Ground {
    /// A ground for a camera whose pixels cover about `footprint_m` of it. `colored` ground costs three times as much as gray.
    ///
    /// Fails where the footprint is not a positive number of metres.
    pub fn new(texture: Texture, footprint_m: f64, colored: bool, seed: u64) -> Result<Self> {
        if !(footprint_m.is_finite() && footprint_m > 0.0) {
            return Err(Error::usage(format!(
                "a pixel's footprint of {footprint_m} m is not usable; it must be positive"
            )));
        }
        Ok(Self { texture, footprint_m, colored, shadow: 0.0, seed, chunks: RwLock::default() })
    }

    /// The same ground with shadows lying on it, which take `darkness` (0 to 1) of the light.
    #[must_use]
    pub fn with_shadows(self, darkness: f64) -> Self {
        Self { shadow: darkness.clamp(0.0, 1.0) as f32, chunks: RwLock::default(), ..self }
    }

    /// Number of channels: 3 where the ground is coloured, else 1.
    pub fn channels(&self) -> usize {
        if self.colored { 3 } else { 1 }
    }

    /// The footprint this ground was made for, metres.
    pub fn footprint_m(&self) -> f64 {
        self.footprint_m
    }

    /// Size of a texel of a level, metres.
    pub(super) fn texel_m(&self, level: i32) -> f64 {
        0.5 * self.footprint_m * f64::from(level).exp2()
    }

    /// A chunk, made now if nobody has looked there before.
    pub(super) fn chunk(&self, index: ChunkIndex) -> Arc<Chunk> {
        // A poisoned lock only means that another thread panicked between two whole insertions.
        let known = self.chunks.read().unwrap_or_else(PoisonError::into_inner).get(&index).cloned();
        known.unwrap_or_else(|| {
            let chunk = Arc::new(self.rasterised(index));
            let mut chunks = self.chunks.write().unwrap_or_else(PoisonError::into_inner);
            if chunks.len() * 2 * STRIDE * STRIDE * self.channels() > MEMORY_LIMIT_BYTES {
                chunks.clear();
            }
            chunks.insert(index, chunk.clone());
            chunk
        })
    }

    fn rasterised(&self, (level, chunk_x, chunk_y): ChunkIndex) -> Chunk {
        let texel_m = self.texel_m(level);
        let plane = STRIDE * STRIDE;
        let mut samples = vec![0u16; plane * self.channels()];
        for j in 0..STRIDE {
            for i in 0..STRIDE {
                let place =
                    |chunk: i64, inside: usize| (chunk * CHUNK as i64 + inside as i64 - 1) as f64 * texel_m;
                let point = GroundPoint::new(place(chunk_x, i), place(chunk_y, j));
                let mut color = self.texture.color(point, 2.0 * texel_m, self.seed);
                if self.shadow > 0.0 {
                    let dark = 1.0 - self.shadow * ground_shadow(self.seed as u32, (point.x_m, point.y_m));
                    color = color.map(|c| c * dark);
                }
                let store = |value: f32| (value * SAMPLE_SCALE + 0.5) as u16;
                let at = j * STRIDE + i;
                if self.colored {
                    for (channel, value) in color.into_iter().enumerate() {
                        samples[channel * plane + at] = store(value);
                    }
                } else {
                    samples[at] = store(luminance(color));
                }
            }
        }
        Chunk { samples }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_chunks_share_their_borders() {
        let ground = Ground::new(Texture::Asphalt, 0.0015, false, 1).unwrap();
        let (left, right) = (ground.chunk((0, -1, 0)), ground.chunk((0, 0, 0)));
        for row in 0..STRIDE {
            for apron in 0..3 {
                assert_eq!(left.plane(0)[row * STRIDE + CHUNK + apron], right.plane(0)[row * STRIDE + apron]);
            }
        }
    }

    #[test]
    fn a_gray_ground_is_the_luminance_of_the_coloured_one() {
        let gray = Ground::new(Texture::Bricks, 0.0015, false, 1).unwrap().chunk((0, 3, 4));
        let color = Ground::new(Texture::Bricks, 0.0015, true, 1).unwrap().chunk((0, 3, 4));
        for i in (0..STRIDE * STRIDE).step_by(97) {
            let channels = std::array::from_fn(|c| f32::from(color.plane(c)[i]));
            assert!((luminance(channels) - f32::from(gray.plane(0)[i])).abs() <= 1.5);
        }
    }

    #[test]
    fn a_footprint_of_nothing_is_refused() {
        assert!(Ground::new(Texture::Bare, 0.0, false, 1).is_err());
    }
}

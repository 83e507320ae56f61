//! The ground as a raster that is computed on demand.

use super::floor_markers::FloorMarkers;
use super::noise::LatticeCache;
use super::patterns::ground_shadow;
use super::texture::{Texture, luminance};
use odograph::error::{Error, Result};
use odograph::geometry::GroundPoint;
use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock};

/// Side length of a chunk, texels.
pub(super) const CHUNK: usize = 128;
/// Side length of a stored chunk, texels: one more before and two after, so that bicubic
/// interpolation needs only one chunk.
pub(super) const STRIDE: usize = CHUNK + 3;
/// Scale of the stored samples per gray level.
pub(super) const SAMPLE_SCALE: f32 = 256.0;
/// Memory limit of the chunk cache. Beyond it the cache is cleared; chunks are deterministic and
/// can be recomputed.
const MEMORY_LIMIT_BYTES: usize = 384 << 20;

/// A texture rasterised at a resolution that suits a camera, in chunks computed on demand.
///
/// Level 0 has two texels per `footprint_m`; each further level halves the resolution, each
/// negative one doubles it. A texel holds the texture averaged over a footprint of two texels. May
/// be shared between threads.
#[derive(Debug)]
pub struct Ground {
    texture: Texture,
    footprint_m: f64,
    colored: bool,
    shadow: f32,
    markers: Option<FloorMarkers>,
    seed: u64,
    chunks: RwLock<HashMap<ChunkIndex, Arc<Chunk>>>,
}

/// Index of a chunk: level, and chunk coordinates along x and y.
pub(super) type ChunkIndex = (i32, i64, i64);

/// A chunk of the raster: one plane of `STRIDE` × `STRIDE` samples per channel.
#[derive(Debug)]
pub(super) struct Chunk {
    samples: Vec<u16>,
}

impl Chunk {
    /// The samples of one channel in row order.
    #[inline]
    pub(super) fn plane(&self, channel: usize) -> &[u16] {
        &self.samples[channel * STRIDE * STRIDE..][..STRIDE * STRIDE]
    }
}

impl Ground {
    /// A ground for a camera whose pixels have a footprint of about `footprint_m`. Coloured ground
    /// costs three times as much as gray.
    ///
    /// Fails where the footprint is not a positive number of metres.
    pub fn new(texture: Texture, footprint_m: f64, colored: bool, seed: u64) -> Result<Self> {
        if !(footprint_m.is_finite() && footprint_m > 0.0) {
            return Err(Error::usage(format!(
                "a pixel's footprint of {footprint_m} m is not usable; it must be positive"
            )));
        }
        Ok(Self {
            texture,
            footprint_m,
            colored,
            shadow: 0.0,
            markers: None,
            seed,
            chunks: RwLock::default(),
        })
    }

    /// Adds shadows fixed to the ground, which remove the fraction `darkness` (0 to 1) of the
    /// light.
    #[must_use]
    pub fn with_shadows(self, darkness: f64) -> Self {
        Self { shadow: darkness.clamp(0.0, 1.0) as f32, chunks: RwLock::default(), ..self }
    }

    /// Lays markers on the ground.
    #[must_use]
    pub(super) fn with_markers(self, markers: FloorMarkers) -> Self {
        Self { markers: Some(markers), chunks: RwLock::default(), ..self }
    }

    /// Number of channels: 3 for coloured ground, otherwise 1.
    pub fn channels(&self) -> usize {
        if self.colored { 3 } else { 1 }
    }

    /// The pixel footprint this ground was made for, metres.
    pub fn footprint_m(&self) -> f64 {
        self.footprint_m
    }

    /// Texel size of a level, metres.
    pub(super) fn texel_m(&self, level: i32) -> f64 {
        0.5 * self.footprint_m * f64::from(level).exp2()
    }

    /// A chunk from the cache, computed if it is missing.
    pub(super) fn chunk(&self, index: ChunkIndex) -> Arc<Chunk> {
        // A poisoned lock only means that another thread panicked between two complete insertions.
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
        let middle = |chunk: i64| (chunk as f64 + 0.5) * CHUNK as f64 * texel_m;
        let near = self.markers.as_ref().map(|markers| {
            markers.near(GroundPoint::new(middle(chunk_x), middle(chunk_y)), STRIDE as f64 * texel_m)
        });
        let mut samples = vec![0u16; plane * self.channels()];
        let mut cache = LatticeCache::default();
        for j in 0..STRIDE {
            for i in 0..STRIDE {
                let place =
                    |chunk: i64, inside: usize| (chunk * CHUNK as i64 + inside as i64 - 1) as f64 * texel_m;
                let point = GroundPoint::new(place(chunk_x, i), place(chunk_y, j));
                cache.rewind();
                let mut color = self.texture.color_beside(&mut cache, point, 2.0 * texel_m, self.seed);
                if let Some(near) = &near {
                    near.cover(point, 2.0 * texel_m, &mut color);
                }
                if self.shadow > 0.0 {
                    let dark = 1.0
                        - self.shadow * ground_shadow(&mut cache, self.seed as u32, (point.x_m, point.y_m));
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
    fn neighbouring_chunks_agree_on_their_overlap() {
        let ground = Ground::new(Texture::Asphalt, 0.0015, false, 1).unwrap();
        let (left, right) = (ground.chunk((0, -1, 0)), ground.chunk((0, 0, 0)));
        for row in 0..STRIDE {
            for apron in 0..3 {
                assert_eq!(left.plane(0)[row * STRIDE + CHUNK + apron], right.plane(0)[row * STRIDE + apron]);
            }
        }
    }

    #[test]
    fn gray_ground_is_the_luminance_of_coloured_ground() {
        let gray = Ground::new(Texture::Bricks, 0.0015, false, 1).unwrap().chunk((0, 3, 4));
        let color = Ground::new(Texture::Bricks, 0.0015, true, 1).unwrap().chunk((0, 3, 4));
        for i in (0..STRIDE * STRIDE).step_by(97) {
            let channels = std::array::from_fn(|c| f32::from(color.plane(c)[i]));
            assert!((luminance(channels) - f32::from(gray.plane(0)[i])).abs() <= 1.5);
        }
    }

    #[test]
    fn a_zero_footprint_is_rejected() {
        assert!(Ground::new(Texture::Bare, 0.0, false, 1).is_err());
    }
}

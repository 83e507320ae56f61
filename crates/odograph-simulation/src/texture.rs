//! Textures of the ground.

use super::noise::LatticeCache;
use super::patterns;
use super::photograph::{Photograph, Tiling};
use odograph::error::Result;
use odograph::geometry::GroundPoint;
use odograph::image::RgbImage;
use std::sync::Arc;

/// Texture of the ground: a colour at every point of an unbounded plane.
///
/// The procedural textures are made of noise and do not repeat, except that tiles and bricks lie on
/// a periodic grid, each slightly different. Values are averaged over the footprint of a pixel, so
/// nothing aliases.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Texture {
    /// Stones of 2 to 16 mm in bitumen: many corners.
    Asphalt,
    /// Loops of yarn in two shades.
    Carpet,
    /// Square tiles of 20 cm with grout, slightly varied: nearly periodic.
    Tiles,
    /// Bricks of 21 by 6.5 cm in running bond: periodic.
    Bricks,
    /// Blades in all directions, with lighter and darker patches.
    Grass,
    /// Low texture: clouds, fine grain and some pores.
    Concrete,
    /// Very low texture: a contrast of about one gray level.
    Bare,
    /// A photograph tiled over the plane.
    Photograph(Arc<Photograph>),
    /// Patches of one texture in another, with soft borders.
    Patchwork {
        /// Texture outside the patches.
        first: Arc<Texture>,
        /// Texture of the patches.
        second: Arc<Texture>,
        /// Size of a patch, metres.
        patch_m: f64,
    },
}

/// The procedural textures and their names.
const NAMED: [(&str, Texture); 7] = [
    ("asphalt", Texture::Asphalt),
    ("carpet", Texture::Carpet),
    ("tiles", Texture::Tiles),
    ("bricks", Texture::Bricks),
    ("grass", Texture::Grass),
    ("concrete", Texture::Concrete),
    ("bare", Texture::Bare),
];

impl Texture {
    /// The procedural texture of that name (`asphalt`, `carpet`, `tiles`, `bricks`, `grass`,
    /// `concrete`, `bare`); `None` where the name is unknown.
    pub fn named(name: &str) -> Option<Self> {
        NAMED.iter().find(|(known, _)| *known == name).map(|(_, texture)| texture.clone())
    }

    /// The names known to [`Texture::named`].
    pub fn names() -> impl Iterator<Item = &'static str> {
        NAMED.iter().map(|(name, _)| *name)
    }

    /// A photograph of a floor, tiled over the plane. Gray images are converted by [`RgbImage`]'s
    /// `From<&GrayImage>`.
    ///
    /// Fails where the image is smaller than 8 pixels or `metres_per_pixel` is not positive.
    pub fn from_image(image: &RgbImage, metres_per_pixel: f64, tiling: Tiling) -> Result<Self> {
        Photograph::new(image, metres_per_pixel, tiling)
            .map(|photograph| Self::Photograph(Arc::new(photograph)))
    }

    /// The colour (red, green, blue; gray levels 0 to 255) of a pixel whose footprint is about
    /// `footprint_m` × `footprint_m` around `point`.
    pub fn color(&self, point: GroundPoint, footprint_m: f64, seed: u64) -> [f32; 3] {
        self.color_beside(&mut LatticeCache::default(), point, footprint_m, seed)
    }

    /// [`Texture::color`], beside a point for which the cache was used before.
    pub(super) fn color_beside(
        &self,
        cache: &mut LatticeCache,
        point: GroundPoint,
        footprint_m: f64,
        seed: u64,
    ) -> [f32; 3] {
        let at = (point.x_m, point.y_m);
        let noise_seed = seed as u32 ^ (seed >> 32) as u32;
        match self {
            Self::Asphalt => patterns::asphalt(cache, noise_seed, at, footprint_m),
            Self::Carpet => patterns::carpet(cache, noise_seed, at, footprint_m),
            Self::Tiles => patterns::tiles(cache, noise_seed, at, footprint_m),
            Self::Bricks => patterns::bricks(cache, noise_seed, at, footprint_m),
            Self::Grass => patterns::grass(cache, noise_seed, at, footprint_m),
            Self::Concrete => patterns::concrete(cache, noise_seed, at, footprint_m),
            Self::Bare => patterns::bare(cache, noise_seed, at, footprint_m),
            Self::Photograph(photograph) => photograph.color(cache, noise_seed, at, footprint_m),
            Self::Patchwork { first, second, patch_m } => {
                let share = patterns::patch(cache, noise_seed, at, *patch_m);
                // Only the borders of patches evaluate both textures.
                if share <= 0.0 {
                    return first.color_beside(cache, point, footprint_m, seed);
                }
                let inside = second.color_beside(cache, point, footprint_m, seed);
                if share >= 1.0 {
                    return inside;
                }
                let outside = first.color_beside(cache, point, footprint_m, seed);
                std::array::from_fn(|c| outside[c] + share * (inside[c] - outside[c]))
            }
        }
    }
}

/// Luminance of a colour (ITU-R BT.601).
#[inline]
pub(super) fn luminance([red, green, blue]: [f32; 3]) -> f32 {
    0.299 * red + 0.587 * green + 0.114 * blue
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean and standard deviation of the luminance over 46 cm, sampled every 2.3 mm.
    fn statistics(texture: &Texture) -> (f64, f64) {
        let n = 200;
        let values: Vec<f64> = (0..n * n)
            .map(|i| {
                let point = GroundPoint::new((i % n) as f64 * 0.0023, (i / n) as f64 * 0.0023);
                f64::from(luminance(texture.color(point, 0.0015, 5)))
            })
            .collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        (mean, variance.sqrt())
    }

    #[test]
    fn every_texture_has_its_documented_brightness_and_contrast() {
        for (name, texture) in &NAMED {
            let (mean, deviation) = statistics(texture);
            assert!((60.0..190.0).contains(&mean), "{name}: mean {mean:.1}");
            let wanted = match *name {
                "bare" => 0.4..1.5,
                "concrete" => 2.0..9.0,
                "tiles" => 3.0..40.0,
                _ => 8.0..45.0,
            };
            assert!(wanted.contains(&deviation), "{name}: standard deviation {deviation:.2}");
        }
    }

    #[test]
    fn a_larger_footprint_has_less_detail() {
        for name in ["asphalt", "carpet", "grass"] {
            let texture = Texture::named(name).unwrap();
            let spread = |footprint_m: f64| {
                (0..500)
                    .map(|i| {
                        let x = f64::from(i) * 0.013;
                        let step =
                            |d: f64| luminance(texture.color(GroundPoint::new(x + d, 0.3), footprint_m, 1));
                        f64::from((step(0.004) - step(0.0)).abs())
                    })
                    .sum::<f64>()
            };
            assert!(spread(0.05) < 0.3 * spread(0.001), "{name}");
        }
    }

    #[test]
    fn unknown_names_are_rejected() {
        assert!(Texture::named("lava").is_none());
        assert_eq!(Texture::names().count(), 7);
    }
}

//! The whole ground map in one picture of bounded size.

use crate::followed_tiles::FollowedTiles;
use crate::ground::TiledGround;
use odograph::geometry::Placement;
use odograph::mosaic::{Mosaic, MosaicSquare};
use odograph_video::png_from_rgb_samples;

/// A picture of the ground with its georeference.
#[derive(Debug, Clone, PartialEq)]
pub struct OverviewPicture {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// Red, green, blue and opacity, row by row; white and opacity 0 where the ground was not seen.
    pub rgba: Vec<u8>,
    /// Where it is.
    pub placement: Placement,
}

impl OverviewPicture {
    /// The picture as PNG without opacity; `None` if it is too large for one.
    pub fn rgb_png(&self) -> Option<Vec<u8>> {
        let rgb = self.rgba.as_chunks::<4>().0.iter().flat_map(|[red, green, blue, _]| [*red, *green, *blue]);
        let rgb: Vec<u8> = rgb.collect();
        png_from_rgb_samples(self.width, self.height, &rgb).ok()
    }

    /// Corner of least x and y, metres: the outer corner of the bottom-left pixel.
    pub fn corner_m(&self) -> [f64; 2] {
        let Placement { metres_per_pixel, x_m, y_m } = self.placement;
        [x_m - 0.5 * metres_per_pixel, y_m - (self.height as f64 - 0.5) * metres_per_pixel]
    }
}

/// Follows a ground map with a picture of at most a number of pixels.
#[derive(Debug)]
pub struct Overview {
    most_pixels: usize,
    tiles: FollowedTiles<ReducedTile>,
    halvings: u32,
}

/// A tile with pixels of 2^`halvings` times their side.
#[derive(Debug)]
struct ReducedTile {
    halvings: u32,
    rgba: Vec<u8>,
}

/// A tile is reduced to one pixel at most.
const MOST_HALVINGS: u32 = Mosaic::TILE_SIDE_PX.ilog2();

impl ReducedTile {
    fn side(halvings: u32) -> usize {
        Mosaic::TILE_SIDE_PX >> halvings
    }

    /// Pixels of twice the side: the mean of the up to four that were seen.
    fn halve(&mut self) {
        let (before, side) = (Self::side(self.halvings), Self::side(self.halvings + 1));
        let pixel = |x: usize, y: usize| &self.rgba[4 * (y * before + x)..][..4];
        let mut halved = Vec::with_capacity(4 * side * side);
        for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
            let four =
                [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(right, below)| pixel(2 * x + right, 2 * y + below));
            let seen = four.iter().filter(|pixel| pixel[3] > 0);
            let count = seen.clone().count() as u32;
            let mean = |channel: usize| {
                let sum: u32 = seen.clone().map(|pixel| u32::from(pixel[channel])).sum();
                (sum + count / 2).checked_div(count).map_or(255, |mean| mean as u8)
            };
            halved.extend([mean(0), mean(1), mean(2), if count > 0 { 255 } else { 0 }]);
        }
        (self.rgba, self.halvings) = (halved, self.halvings + 1);
    }

    fn reduce_to(&mut self, halvings: u32) {
        while self.halvings < halvings {
            self.halve();
        }
    }
}

impl Overview {
    /// Follows a ground map: the picture becomes coarser by halves where it would have more than
    /// `most_pixels`.
    pub fn new(most_pixels: usize) -> Self {
        Self { most_pixels, tiles: FollowedTiles::default(), halvings: 0 }
    }

    /// Takes what has changed; `false` if nothing has.
    pub fn update(&mut self, ground: &dyn TiledGround) -> bool {
        let before = self.tiles.metres_per_pixel;
        if ground.state().is_some_and(|state| state.metres_per_pixel != before) {
            self.halvings = 0;
        }
        let halvings = self.halvings;
        let changed = self.tiles.update(ground, |_, _, rgba| {
            let mut tile = ReducedTile { halvings: 0, rgba: rgba.to_vec() };
            tile.reduce_to(halvings);
            tile
        });
        while self.halvings < MOST_HALVINGS && self.pixels() > self.most_pixels {
            self.halvings += 1;
            self.tiles.made.values_mut().for_each(|tile| tile.reduce_to(self.halvings));
        }
        changed
    }

    /// Columns and rows of the tiles: first and last.
    fn extent(&self) -> Option<[i64; 4]> {
        let squares = self.tiles.made.keys();
        squares.fold(None, |extent, &MosaicSquare { column, row }| {
            let [left, right, top, bottom] = extent.unwrap_or([column, column, row, row]);
            Some([left.min(column), right.max(column), top.min(row), bottom.max(row)])
        })
    }

    fn size(&self) -> Option<(usize, usize)> {
        let [left, right, top, bottom] = self.extent()?;
        let side = ReducedTile::side(self.halvings);
        let length = |first: i64, last: i64| usize::try_from(last - first + 1).unwrap_or(usize::MAX);
        Some((length(left, right).saturating_mul(side), length(top, bottom).saturating_mul(side)))
    }

    fn pixels(&self) -> usize {
        self.size().map_or(0, |(width, height)| width.saturating_mul(height))
    }

    /// The picture of all tiles; `None` where there is none, or where they are so far apart that
    /// even a pixel for each is too much.
    pub fn picture(&self) -> Option<OverviewPicture> {
        let ([left, _, top, _], (width, height)) = (self.extent()?, self.size()?);
        if self.pixels() > self.most_pixels {
            return None;
        }
        let side = ReducedTile::side(self.halvings);
        let mut rgba = [255, 255, 255, 0].repeat(width * height);
        for (square, tile) in &self.tiles.made {
            let (x, y) = ((square.column - left) as usize * side, (square.row - top) as usize * side);
            for (line, y) in tile.rgba.chunks_exact(4 * side).zip(y..) {
                rgba[4 * (y * width + x)..][..4 * side].copy_from_slice(line);
            }
        }
        let metres_per_pixel = self.tiles.metres_per_pixel * (1u64 << self.halvings) as f64;
        let centre_m = |first: i64| (first as f64 * side as f64 + 0.5) * metres_per_pixel;
        let placement = Placement { metres_per_pixel, x_m: centre_m(left), y_m: -centre_m(top) };
        Some(OverviewPicture { width, height, rgba, placement })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use crate::ground::GrowingTiles;

    const SIDE: usize = Mosaic::TILE_SIDE_PX;

    #[test]
    fn a_growing_map_is_one_picture_within_its_bound() {
        let (ground, mut overview) = (GrowingTiles::default(), Overview::new(4 * SIDE * SIDE));
        assert!(!overview.update(&ground) && overview.picture().is_none());
        ground.begin(0.01);
        let shade = |shade: u8| [shade, shade, shade, 255].repeat(SIDE * SIDE);
        ground.put(MosaicSquare { column: 1, row: -2 }, shade(40));
        assert!(overview.update(&ground) && !overview.update(&ground));
        let picture = overview.picture().unwrap();
        assert_eq!((picture.width, picture.height), (SIDE, SIDE));
        assert_eq!(picture.placement, Placement { metres_per_pixel: 0.01, x_m: 2.565, y_m: 5.115 });
        let near = |picture: &OverviewPicture, x: f64, y: f64| {
            let corner = picture.corner_m();
            assert!((corner[0] - x).abs() < 1e-9 && (corner[1] - y).abs() < 1e-9, "{corner:?}");
        };
        near(&picture, 2.56, 2.56);
        // Four times as wide: twice as coarse.
        ground.put(MosaicSquare { column: 5, row: -2 }, shade(80));
        assert!(overview.update(&ground));
        let picture = overview.picture().unwrap();
        assert_eq!((picture.width, picture.height), (5 * SIDE / 2, SIDE / 2));
        assert_eq!(picture.placement.metres_per_pixel, 0.02);
        near(&picture, 2.56, 2.56);
        let pixel = |column: usize| picture.rgba[4 * column..][..4].to_vec();
        assert_eq!((pixel(0), pixel(SIDE)), (vec![40, 40, 40, 255], vec![255, 255, 255, 0]));
        assert_eq!(pixel(2 * SIDE + 1), [80, 80, 80, 255]);
        // What can be decoded is what was there.
        let png = picture.rgb_png().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut rgb).unwrap();
        assert_eq!((rgb.len(), &rgb[..3]), (3 * picture.rgba.len() / 4, &[40, 40, 40][..]));
        assert_eq!(rgb[3 * SIDE..][..3], [255, 255, 255]);
        // Tiles that are too far apart for one picture.
        ground.put(MosaicSquare { column: i64::from(u32::MAX), row: -2 }, shade(80));
        assert!(overview.update(&ground) && overview.picture().is_none());
    }

    #[test]
    fn coarser_pixels_are_the_mean_of_what_was_seen() {
        let mut tile = ReducedTile { halvings: 0, rgba: [255, 255, 255, 0].repeat(SIDE * SIDE) };
        tile.rgba[..8].copy_from_slice(&[10, 0, 0, 255, 21, 0, 0, 255]);
        tile.reduce_to(1);
        assert_eq!((&tile.rgba[..4], &tile.rgba[4..8]), (&[16, 0, 0, 255][..], &[255, 255, 255, 0][..]));
        tile.reduce_to(MOST_HALVINGS);
        assert_eq!(tile.rgba, [16, 0, 0, 255]);
    }
}

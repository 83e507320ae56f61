//! What is made of each tile of a ground map, kept up to date with the map.

use crate::ground::TiledGround;
use odograph::mosaic::MosaicSquare;
use std::collections::BTreeMap;

/// A value for each tile of a ground map; only tiles that change are made again.
#[derive(Debug)]
pub(crate) struct FollowedTiles<T> {
    /// Ground sampling distance of the map, metres; 0 before the first tile.
    pub metres_per_pixel: f64,
    pub made: BTreeMap<MosaicSquare, T>,
    revision: u64,
}

impl<T> Default for FollowedTiles<T> {
    fn default() -> Self {
        Self { metres_per_pixel: 0.0, made: BTreeMap::new(), revision: 0 }
    }
}

impl<T> FollowedTiles<T> {
    /// Makes the values of changed tiles from their RGBA samples, and returns whether any tile has
    /// changed.
    pub fn update(
        &mut self,
        ground: &dyn TiledGround,
        mut make: impl FnMut(MosaicSquare, f64, &[u8]) -> T,
    ) -> bool {
        let Some(state) = ground.state() else { return false };
        if state.metres_per_pixel != self.metres_per_pixel {
            *self = Self { metres_per_pixel: state.metres_per_pixel, ..Self::default() };
        } else if state.revision == self.revision {
            return false;
        }
        for square in ground.changed_since(self.revision) {
            match ground.tile_rgba(square) {
                Some(rgba) => drop(self.made.insert(square, make(square, state.metres_per_pixel, &rgba))),
                None => drop(self.made.remove(&square)),
            }
        }
        self.revision = state.revision;
        true
    }
}

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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use crate::ground::GroundState;

    /// A map of which a loop closure moves a tile elsewhere.
    struct Moved(bool);

    impl TiledGround for Moved {
        fn state(&self) -> Option<GroundState> {
            Some(GroundState { metres_per_pixel: 0.01, revision: if self.0 { 2 } else { 1 } })
        }

        fn changed_since(&self, revision: u64) -> Vec<MosaicSquare> {
            let there = if self.0 { vec![0, 1] } else { vec![0] };
            let is_new = self.state().unwrap().revision > revision;
            there.into_iter().filter(|_| is_new).map(|column| MosaicSquare { column, row: 0 }).collect()
        }

        fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
            (tile.column == i64::from(self.0)).then(|| vec![7])
        }
    }

    #[test]
    fn a_tile_that_a_loop_closure_has_moved_is_forgotten() {
        let mut tiles = FollowedTiles::default();
        let mut columns = |ground| {
            let changed = tiles.update(&Moved(ground), |square, _, rgba| (square.column, rgba[0]));
            (changed, tiles.made.values().copied().collect::<Vec<_>>())
        };
        assert_eq!(columns(false), (true, vec![(0, 7)]));
        assert_eq!(columns(false), (false, vec![(0, 7)]));
        assert_eq!(columns(true), (true, vec![(1, 7)]));
    }
}

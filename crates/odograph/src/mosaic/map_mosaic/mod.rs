//! The mosaic of a whole map: all keyframes at their final poses, patch by patch.
//!
//! What [`Mosaic`](super::Mosaic) has blended cannot be moved when a loop closure corrects the
//! path. This builds the mosaic anew from a map and its images: patch by patch, so that memory does
//! not grow with the map, each from all keyframes that show it. Gain compensation covers all
//! keyframes ([`exposure`]); within a patch low frequencies are the mean of all views and high
//! frequencies come from the best one ([`patch`]; P. J. Burt and E. H. Adelson, "A multiresolution
//! spline with application to image mosaics", 1983, with two bands), so that seams show neither
//! steps of brightness nor doubled patterns.

mod exposure;
mod images;
mod patch;

use super::footprint::{Footprint, GroundCamera};
use super::tiles::TILE;
use crate::camera::Camera;
use crate::error::Result;
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::ground_map::{GroundMap, KeyframeImages};
use crate::keyframe::KeyframeId;
use crate::numerics::median;
use exposure::Gains;
use images::Images;
use patch::MosaicPatch;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Side of a tile of the mosaic, ground pixels.
pub const MOSAIC_TILE_PX: usize = TILE as usize;
/// Side of a patch, tiles: small enough that what is computed in it stays near, large enough that
/// few images are needed twice.
const PATCH: i64 = 4;
/// No picture is wider than this, ground pixels: a mosaic that would be is made coarser.
const WIDEST: f64 = (1u64 << 30) as f64;

/// A square piece of the mosaic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MosaicTile {
    /// Its column: tile `c` has the ground from x = `c` to `c + 1` sides of a tile.
    pub column: i64,
    /// Its row: tile `r` has the ground from y = −`r` down to −(`r` + 1) sides of a tile.
    pub row: i64,
    /// Red, green, blue and opacity of [`MOSAIC_TILE_PX`]² pixels in row order; opacity is 255
    /// where the ground was seen and 0 elsewhere.
    pub rgba: Vec<u8>,
}

/// A keyframe whose image shows the ground.
#[derive(Debug, Clone)]
struct PlacedKeyframe {
    id: KeyframeId,
    /// Index of its camera.
    camera: usize,
    pose: GroundPose,
    /// Mask of its pixels that do not show ground.
    mask: Option<Arc<ImageMask>>,
    /// Side of the ground that a pixel in the middle of its image sees, metres.
    sample_m: f64,
    /// Least and greatest x and y of its footprint, metres.
    bounds: [f64; 4],
}

/// The mosaic of a whole map: all keyframes at their final poses, patch by patch.
#[derive(Debug)]
pub struct MapMosaic {
    cameras: Vec<Camera>,
    resolution_m: f64,
    keyframes: Vec<PlacedKeyframe>,
    gains: Gains,
    /// The remaining patches with the keyframes that may show them, in reverse order.
    patches: Vec<((i64, i64), Vec<usize>)>,
    tiles: (Range<i64>, Range<i64>),
    images: Images,
    patch: MosaicPatch,
}

impl MapMosaic {
    /// Prepares the mosaic of a map, with the gain compensation of its keyframes. Every image is
    /// loaded once. `ground_resolution_m` is the side of a ground pixel; by default what a pixel in
    /// the middle of the median keyframe sees. It is not made finer than a quarter of that, and
    /// coarser by halves if the picture would be wider than 2³⁰ pixels.
    ///
    /// `None` where no keyframe shows the ground. Fails where an image cannot be loaded.
    pub fn new(
        map: &GroundMap,
        images: &mut dyn KeyframeImages,
        ground_resolution_m: Option<f64>,
    ) -> Result<Option<Self>> {
        let (cameras, of_session) = cameras(map);
        let mut footprints: Vec<Option<Footprint>> = vec![None; cameras.len()];
        let mut keyframes: Vec<PlacedKeyframe> = map
            .keyframes
            .iter()
            .filter_map(|keyframe| {
                let index = of_session.get(&keyframe.session).copied().unwrap_or(0);
                let camera = &cameras[index];
                let view = GroundCamera::new(camera, &keyframe.pose)?;
                let (low, high) = Footprint::of(&mut footprints[index], camera).bounds(&view)?;
                Some(PlacedKeyframe {
                    id: keyframe.id,
                    camera: index,
                    pose: keyframe.pose,
                    mask: map.masks.get(&keyframe.session).cloned(),
                    sample_m: view.centre_resolution_m(),
                    bounds: [low.x_m, low.y_m, high.x_m, high.y_m],
                })
            })
            .collect();
        let Some(resolution_m) = resolution_m(&keyframes, ground_resolution_m) else {
            return Ok(None);
        };
        // A keyframe from far above shows more ground than fits in memory, and more coarsely than
        // the others.
        let pixels = |camera: &Camera| (camera.width() * camera.height()) as f64;
        keyframes.retain(|placed| {
            let pixels = pixels(&cameras[placed.camera]);
            let [left, bottom, right, top] = placed.bounds;
            (right - left) * (top - bottom) / (resolution_m * resolution_m) <= 64.0 * pixels + 1e6
        });
        let patches = patches(&keyframes, resolution_m);
        let Some(tiles) = tiles(&keyframes, resolution_m) else {
            return Ok(None);
        };
        let gains = Gains::settle(&cameras, &keyframes, images)?;
        Ok(Some(Self {
            cameras,
            resolution_m,
            keyframes,
            gains,
            patches,
            tiles,
            images: Images::default(),
            patch: MosaicPatch::default(),
        }))
    }

    /// Side of a ground pixel, metres.
    pub fn resolution_m(&self) -> f64 {
        self.resolution_m
    }

    /// The columns and rows of tiles within which all tiles will be.
    pub fn tiles(&self) -> (Range<i64>, Range<i64>) {
        self.tiles.clone()
    }

    /// Number of remaining patches.
    pub fn patches_left(&self) -> usize {
        self.patches.len()
    }

    /// Blends the next patch and returns its tiles that show any ground; `None` at the end. Every
    /// tile is returned once.
    pub fn next_tiles(&mut self, images: &mut dyn KeyframeImages) -> Result<Option<Vec<MosaicTile>>> {
        let Some(((row, column), keyframes)) = self.patches.pop() else {
            return Ok(None);
        };
        self.patch.begin(column * PATCH, row * PATCH, self.resolution_m);
        for &index in &keyframes {
            let placed = &self.keyframes[index];
            let Some(view) = GroundCamera::new(&self.cameras[placed.camera], &placed.pose) else { continue };
            let image = self.images.get(placed.id, images)?;
            self.patch.orthorectify(
                image,
                &view,
                placed,
                self.gains.of(index),
                self.gains.darkening(placed.camera),
            );
        }
        Ok(Some(self.patch.tiles()))
    }
}

/// The different cameras of a map, and the index of that of each session with another one than the
/// first.
fn cameras(map: &GroundMap) -> (Vec<Camera>, BTreeMap<u32, usize>) {
    let mut cameras = vec![map.camera.clone()];
    let mut of_session = BTreeMap::new();
    for (&session, other) in &map.other_cameras {
        let index = cameras.iter().position(|known| *known == other.camera).unwrap_or_else(|| {
            cameras.push(other.camera.clone());
            cameras.len() - 1
        });
        of_session.insert(session, index);
    }
    (cameras, of_session)
}

/// The resolution asked for, or that of the median keyframe, within bounds.
fn resolution_m(keyframes: &[PlacedKeyframe], asked: Option<f64>) -> Option<f64> {
    let mut samples: Vec<f64> = keyframes.iter().map(|placed| placed.sample_m).collect();
    let median = median(&mut samples)?;
    let asked = asked.filter(|asked| asked.is_finite() && *asked > 0.0);
    let mut resolution_m = asked.map_or(median, |asked| asked.max(0.25 * median));
    let farthest =
        keyframes.iter().flat_map(|placed| placed.bounds).fold(0.0, |far: f64, side| far.max(side.abs()));
    while 2.0 * farthest > WIDEST * resolution_m {
        resolution_m *= 2.0;
    }
    Some(resolution_m)
}

/// The indices of the squares of `side_m` that overlap a range of metres.
fn touched(from_m: f64, to_m: f64, side_m: f64) -> Range<i64> {
    (from_m / side_m).floor() as i64..(to_m / side_m).floor() as i64 + 1
}

/// The patches that footprints overlap, row by row in alternating direction, so that neighbours
/// share their images; reversed.
fn patches(keyframes: &[PlacedKeyframe], resolution_m: f64) -> Vec<((i64, i64), Vec<usize>)> {
    let side_m = (PATCH * TILE) as f64 * resolution_m;
    let mut found: BTreeMap<(i64, i64), Vec<usize>> = BTreeMap::new();
    for (index, placed) in keyframes.iter().enumerate() {
        let [left, bottom, right, top] = placed.bounds;
        for row in touched(-top, -bottom, side_m) {
            for column in touched(left, right, side_m) {
                found.entry((row, column)).or_default().push(index);
            }
        }
    }
    let mut patches: Vec<_> = found.into_iter().collect();
    patches.sort_by_key(|((row, column), _)| (*row, if row.rem_euclid(2) == 0 { *column } else { -*column }));
    patches.reverse();
    patches
}

fn tiles(keyframes: &[PlacedKeyframe], resolution_m: f64) -> Option<(Range<i64>, Range<i64>)> {
    let side_m = TILE as f64 * resolution_m;
    let one = |placed: &PlacedKeyframe| {
        let [left, bottom, right, top] = placed.bounds;
        (touched(left, right, side_m), touched(-top, -bottom, side_m))
    };
    let wide = |a: Range<i64>, b: Range<i64>| a.start.min(b.start)..a.end.max(b.end);
    keyframes.iter().map(one).reduce(|a, b| (wide(a.0, b.0), wide(a.1, b.1)))
}

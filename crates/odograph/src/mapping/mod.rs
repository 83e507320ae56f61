//! Subsystem 7: the movement map in metres: the drawn path and the mosaic of the ground.
//!
//! Both pictures stand the same way: **world x to the right, world y up**, as any graph of the trajectory file shows it. So
//! the mosaic lies under the drawn path without turning, and its world file has no rotation terms, which every GIS reads.

pub mod placement;
pub mod drawing;
pub mod places;
pub mod ground_map;
pub mod plane_motion;
pub mod graph;
pub mod mosaic;

pub use drawing::{Backdrop, MapDrawing};
pub use ground_map::{EdgeKind, GroundMap, KeyframeId, KeyframeImage, KeyframeImages, MapEdge, MapKeyframe};
pub use mosaic::{
    Coverage, MOSAIC_TILE_PX, MapMosaic, Mosaic, MosaicBands, MosaicOptions, MosaicPicture, MosaicSquare,
    MosaicTile,
};
pub use placement::Placement;

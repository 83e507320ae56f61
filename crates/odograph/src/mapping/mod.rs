//! Subsystem 7: the map in metres, as a drawn path and a mosaic of the ground.
//!
//! Both have the same axes: **world x to the right, world y up**, as any plot of the trajectory
//! file. So the mosaic aligns with the drawn path, and its world file has no rotation terms, which
//! every GIS reads.

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

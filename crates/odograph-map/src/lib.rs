//! The map file: one SQLite database that is also a GeoPackage (OGC 12-128), so that what was seen of the ground survives the program and
//! opens in the tools that people have.
//!
//! [`MapFile`] grows with a run: every keyframe is on disk when [`MapFile::add_keyframe`] returns, and a program that is killed loses at most
//! the keyframe that it was writing. What is read back is checked: a map file may come from anybody. `docs/map_file.md` describes the tables.

mod claim;
mod complaint;
mod edges;
mod file;
mod frames;
mod geopackage;
mod image;
mod keyframes;
mod mosaic;
mod numbers;
mod paths;
mod schema;
mod thinning;

pub use claim::MapClaim;
pub use file::{MapFile, Session};
pub use frames::FrameImages;
pub use mosaic::MosaicLayer;
pub use paths::{KeyframeMove, PathFrame, carried};
pub use thinning::Thinning;

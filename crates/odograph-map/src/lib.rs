//! The map file: an SQLite database that is also a GeoPackage (OGC 12-128), which stores a map
//! persistently and opens in common GIS programs.
//!
//! [`MapFile`] grows during a run: every keyframe is on disk when [`MapFile::add_keyframe`]
//! returns, and a program that is killed loses at most the keyframe being written. Map files are
//! untrusted input: everything read is validated. `docs/map_file.md` describes the tables.

mod cameras;
mod claim;
mod complaint;
mod row_order;
mod edges;
mod file;
mod frames;
mod geopackage;
mod geotiff;
mod image;
mod keyframes;
mod landmarks;
mod losses;
mod lever_arm;
mod markers;
mod masks;
mod mosaic;
mod numbers;
mod origin;
mod outbox;
mod paths;
mod pose_columns;
mod repair;
mod schema;
mod thinning;
mod unfinished;

pub use claim::MapClaim;
pub use file::{MapFile, Session};
pub use frames::FrameImages;
pub use geotiff::GeoTiff;
pub use image::StoredImage;
pub use landmarks::MapLandmark;
pub use markers::MapMarker;
pub use mosaic::MosaicLayer;
pub use numbers::is_covariance;
pub use origin::{SessionOrigin, check_name};
pub use outbox::{Outbox, OutgoingRecord};
pub use paths::{KeyframeMove, PathFrame, connected_stretches, corrected_path};
pub use repair::{Repair, repair};
pub use thinning::Thinning;
pub use unfinished::UnfinishedSession;

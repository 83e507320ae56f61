//! # odograph-live
//!
//! Live video sources, and the web page that displays the running odometry.
//!
//! [`capture`] reads frames from cameras, network streams and recordings in real time and never
//! blocks on a slow consumer. A [`Hub`] holds the current state of the run; a [`Server`] serves it
//! to any number of browsers. No browser can slow down the tracking: each one polls the hub at its
//! own rate, and the hub keeps no backlog per client. [`SeenGrid`] and [`Overview`] are the whole
//! ground map in a bounded number of cells or pixels. [`stream`] sends poses to other programs,
//! [`foxglove`] writes a run as an MCAP file.
//!
//! Unlike the other libraries, this one reads the clock and opens network connections. It prints
//! nothing.

pub mod capture;
pub mod ground;
mod followed_tiles;
mod seen_grid;
mod overview;
mod records;
mod shown;
pub mod hub;
mod view;
pub mod stream;
pub mod foxglove;
pub mod server;

pub use foxglove::McapFile;
pub use ground::{GroundPicture, TiledGround};
pub use hub::{Hub, Introduction, Mark, Phase, Status, View};
pub use odograph::formats::track_record::TrackRecord;
pub use overview::{Overview, OverviewPicture};
pub use seen_grid::{CELL_M, LEAST_CELL_PX, SEEN_SHARE, SeenCells, SeenGrid};
pub use server::{Server, ServerOptions};

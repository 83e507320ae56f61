//! Simultaneous localization and mapping: odometry, and a map whose loop closures correct its
//! drift.
//!
//! There are two frames of reference (as in ROS's REP-105). In the **odometry frame** poses are
//! available at once and never jump, but drift. In the **map frame** every place has one pose,
//! which changes when a loop closure corrects it. The map never feeds back into odometry: odometry
//! gives the same poses with and without a map, and mapping may run behind it in its own thread.
//!
//! Derivation: `docs/math/loop-closure.md`.

mod backoff;
mod session_scale;
mod mapper;
mod antenna;
mod closing;
mod correction;
mod fusion;
mod landmarks;
mod merge;
mod fleet;

pub use antenna::{AntennaFix, DriftCorrection};
pub use correction::{KeyframeSpans, MapFrameCorrection, map_frames};
pub use fleet::{FleetMapper, OdometryPlacement};
pub use landmarks::{ControlUse, Landmark, Surveyed};
pub use mapper::Mapper;
pub use merge::{Merged, merge, optimize};
pub use session_scale::{PlaceScale, SessionScale};

#[cfg(test)]
mod tests;

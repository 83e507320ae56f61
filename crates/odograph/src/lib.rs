//! # odograph
//!
//! Monocular visual odometry and mapping over flat ground: one video camera in, a metric trajectory
//! and map out.
//!
//! The library takes gray images with timestamps, a calibrated [`camera::Camera`] and its mounting
//! [`camera::Rig`] over flat ground. It returns poses in metres with their covariance. It prints
//! nothing, reads no clock and opens no connection.
//!
//! The modules are listed in reading order, which is the order of the data flow and of the
//! dependencies: a module imports only modules listed above it.
//!
//! Derivations with their formulas and references: `docs/math/frames.md` (conventions),
//! `docs/math/interpolation-bias.md`, `docs/math/frame-pose.md`, `docs/math/elevation.md`,
//! `docs/math/correlated-noise.md`, `docs/math/rolling-shutter.md`, `docs/math/filter.md`,
//! `docs/math/extrinsics-from-driving.md`, `docs/math/loop-closure.md`, `docs/math/pose-graph.md`.

pub mod error;
pub mod buffer;
pub mod geometry;
pub mod numerics;
pub mod image;
pub mod camera;
pub mod correction;
pub mod fixed_pattern;
pub mod detection;
pub mod flow;
pub mod motion;
pub mod trajectory;
pub mod filter;
pub mod keyframe;
pub mod odometry;
pub mod pose_graph;
pub mod place_recognition;
pub mod ground_map;
pub mod loop_closure;
pub mod slam;
pub mod mosaic;
pub mod drawing;
pub mod mounting;
pub mod evaluation;
pub mod formats;

#[cfg(test)]
mod simulation;

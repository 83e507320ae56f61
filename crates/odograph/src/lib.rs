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

pub mod error;
pub mod buffer;
pub mod geometry;
pub mod numerics;
pub mod image;
pub mod camera;
pub mod calibration;
pub mod correction;
pub mod fixed_pattern;
pub mod detection;
pub mod flow;
pub mod motion;
pub mod trajectory;
pub mod filter;
pub mod mapping;
pub mod odometry;
pub mod slam;
pub mod mounting;
pub mod evaluation;
pub mod formats;
pub mod simulation;

//! # odograph
//!
//! Monocular visual odometry and mapping over flat ground: one video camera in, a metric trajectory
//! and map out.
//!
//! The library takes gray images with timestamps, a calibrated [`camera::Camera`] and its mounting
//! [`camera::Rig`] over flat ground. It returns poses in metres with their covariance. It prints
//! nothing, reads no clock and opens no connection.
//!
//! [`Odometry`] is where to begin: it takes one image after the other and returns a
//! [`FrameEstimate`] for each. What follows is ground that moves 3 pixels a frame through the image
//! of a camera half a metre above it:
//!
//! ```
//! use odograph::{Camera, GrayImage, Odometry, OdometryConfig, Rig};
//!
//! // 320x240 pixels that see 0.64 m x 0.48 m of ground: 2 mm a pixel.
//! let camera = Camera::from_field_of_view((320, 240), (0.64, 0.48), 0.5)?;
//! let mut odometry = Odometry::new(camera, Rig::level(0.5), OdometryConfig::default())?;
//! for k in 0..20 {
//!     let samples = (0..320 * 240).map(|at| ground(at % 320, at / 320 + 3 * (20 - k)));
//!     let image = GrayImage::from_samples(320, 240, samples.collect()).expect("as many as pixels");
//!     let frame = odometry.process(image, k as f64 / 30.0)?;
//!     let known = frame.estimate.expect("textured ground is tracked");
//!     assert!((known.pose.x_m - 0.006 * k as f64).abs() < 1e-4);
//! }
//!
//! /// Spots of every gray, six pixels apart.
//! fn ground(x: usize, y: usize) -> u8 {
//!     let shade = |x: usize, y: usize| (x * x * 7 + y * y * 13 + x * y * 29) % 251;
//!     let (u, v) = (x % 6, y % 6);
//!     let near = |du: usize, dv: usize| shade(x / 6 + du, y / 6 + dv);
//!     let sum = (6 - u) * (6 - v) * near(0, 0)
//!         + u * (6 - v) * near(1, 0)
//!         + (6 - u) * v * near(0, 1)
//!         + u * v * near(1, 1);
//!     (sum / 36) as u8
//! }
//! # Ok::<(), odograph::Error>(())
//! ```
//!
//! | to | use |
//! |---|---|
//! | read a camera or rig file | [`formats::camera_file`], [`formats::rig_file`] |
//! | calibrate a camera | the crate `odograph-calibration` |
//! | decode recordings | the crate `odograph-video` |
//! | close loops | [`slam::Mapper`], beside odometry |
//! | have a whole run, with map file and reports | the crate `odograph-session` |
//! | compare with the truth | [`evaluation::evaluate`] |
//! | know what is uncertain | [`PoseEstimate`]: the pose's covariance |
//!
//! Lengths are metres, angles radians, times seconds; pixel centres lie at integers. A frame that
//! cannot be measured is no error but has a [`TrackStatus`] that says why; bad input is an
//! [`Error`], one sentence for people.
//!
//! The modules are listed in reading order, which is the order of the data flow and of the
//! dependencies: a module imports only modules listed above it.
//!
//! Derivations with their formulas and references: `docs/math/frames.md` (conventions),
//! `docs/math/interpolation-bias.md`, `docs/math/frame-pose.md`, `docs/math/elevation.md`,
//! `docs/math/correlated-noise.md`, `docs/math/rolling-shutter.md`, `docs/math/filter.md`,
//! `docs/math/extrinsics-from-driving.md`, `docs/math/georeference.md`,
//! `docs/math/loop-closure.md`, `docs/math/pose-graph.md`.

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
pub mod pose_frame;
pub mod filter;
pub mod georeference;
pub mod keyframe;
pub mod odometry;
pub mod pose_graph;
pub mod place_recognition;
pub mod ground_map;
pub mod landmark;
pub mod loop_closure;
pub mod slam;
pub mod mosaic;
pub mod drawing;
pub mod continuous_time;
pub mod mounting;
pub mod self_calibration;
pub mod evaluation;
pub mod formats;

#[cfg(test)]
mod simulation;

pub use camera::{Camera, Rig};
pub use error::{Error, ErrorKind, Result};
pub use geometry::GroundPose;
pub use image::{GrayImage, RgbImage};
pub use motion::MotionModel;
pub use odometry::{Odometry, OdometryConfig};
pub use slam::Mapper;
pub use trajectory::{FrameEstimate, LossReason, PoseEstimate, TrackStatus};

//! # odograph-simulation
//!
//! Synthetic image sequences with exact ground truth, for tests, demos and benchmarks.
//!
//! A [`Simulation`] is a camera on a [`Path`] over a [`Texture`], degraded by [`Effects`]. Every
//! frame is a pure function of its index, so frames can be rendered in any order and from any
//! number of threads.
//!
//! Why the ground truth is exact: the ground is one continuous brightness function, a bicubic
//! interpolation of a raster that is finer than a pixel and band-limited to a pixel's footprint.
//! Every pixel is that function at the intersection of its undistorted ray with the ground. Nothing
//! is resampled between ground and image, so neither the lens model nor the pose is approximated.
//! With a rolling shutter every row has the pose of its own exposure time. On uneven ground every
//! ray is traced to its first intersection.

mod applied_effects;
mod board_scene;
mod effects;
mod fixtures;
mod floor_markers;
mod ground;
mod noise;
mod ordinary;
mod path;
mod patterns;
mod photograph;
mod render_block;
mod renderer;
mod scene;
mod sensors;
mod sequence;
mod sway;
mod terrain;
mod texture;

/// The library whose cameras, poses and images this crate takes and returns.
pub use odograph;

pub use board_scene::{BoardEffects, BoardRecording, BoardScene, Framing, Occlusion};
pub use effects::{
    Blackout, Breathing, Effects, ExposureJumps, Lighting, MovingObject, Shadow, SlowVariation, Timing,
    Vibration,
};
pub use fixtures::{Bumper, Dirt, Lamp};
pub use ground::Ground;
pub use ordinary::ordinary_camera;
pub use path::{Path, PathKind};
pub use photograph::Tiling;
pub use renderer::Renderer;
pub use sensors::{SensorErrors, SimulatedSensors};
pub use sequence::{RenderedFrame, Simulation, SimulationConfig};
pub use sway::Sway;
pub use terrain::{Kerb, Ramp, Relief, Terrain, Undulation};
pub use texture::Texture;

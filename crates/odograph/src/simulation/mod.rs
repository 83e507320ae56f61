//! Rendered ground with exact truth, for tests, demos and measurements.
//!
//! A [`Simulation`] is a camera on a [`Path`] over a [`Texture`], with [`Effects`] that make it hard. Every frame is a
//! function of its number alone, so frames may be asked for in any order and from any number of threads.
//!
//! Why the truth is exact: the ground is one continuous brightness function (a bicubic interpolation of a raster that is finer
//! than a pixel and holds what a pixel of that size would see), and every pixel is that function at the point its undistorted ray
//! meets the ground. Nothing is resampled between ground and image, so neither the lens nor the pose is approximated. With a rolling
//! shutter every row has the pose of its own time; on ground that is not flat every ray is followed to where it first meets it.

mod board_scene;
mod effects;
mod fixtures;
mod ground;
mod noise;
mod path;
mod patterns;
mod photograph;
mod renderer;
mod sensors;
mod sequence;
mod sway;
mod terrain;
mod texture;

pub use board_scene::{BoardEffects, BoardScene, Framing, Occlusion};
pub use effects::{
    Blackout, Breathing, Effects, ExposureJumps, Lighting, MovingObject, Shadow, Timing, Vibration, Wander,
};
pub use fixtures::{Bumper, Dirt, Lamp};
pub use ground::Ground;
pub use path::{Path, PathKind};
pub use photograph::Tiling;
pub use renderer::Renderer;
pub use sensors::{SensorErrors, SimulatedSensors};
pub use sequence::{RenderedFrame, Simulation, SimulationConfig};
pub use sway::Sway;
pub use terrain::{Kerb, Ramp, Relief, Terrain, Undulation};
pub use texture::Texture;

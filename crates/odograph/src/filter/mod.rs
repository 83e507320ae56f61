//! Subsystem 6: estimation improvement.
//!
//! * [`ConstantAcceleration`]: the paper's Kalman filter, for what must be known at once;
//! * [`smooth`]: a smoother for recordings, which knows what came after, and bridges what was lost;
//! * [`carrier_path`]: the way of the carrier without the shaking of its camera;
//! * [`fusion`]: cheap sensors beside the camera.

mod carrier;
mod constant_acceleration;
mod coordinate;
pub mod fusion;
mod smoother;

pub use carrier::{CARRIER_CUTOFF_HZ, Carrier, carrier_path};
pub use constant_acceleration::{ConstantAcceleration, Filtered};
pub use smoother::{PoseSource, SmoothedFrame, SmoothedPath, Smoother, Walk, smooth};

use serde::{Deserialize, Serialize};

/// How lively the filter expects the camera to be when it knows nothing yet.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilterConfig {
    /// Spectral density of the jerk of x and y, (m/s³)² s. It rises with the innovations and sinks back to this.
    pub jerk_density: f64,
    /// Spectral density of the jerk of the heading, (rad/s³)² s.
    pub heading_jerk_density: f64,
}

impl Default for FilterConfig {
    fn default() -> Self {
        // A slow cart: a tenth of a g built up within about a second.
        Self { jerk_density: 1.0, heading_jerk_density: 10.0 }
    }
}

#[cfg(test)]
mod tests;

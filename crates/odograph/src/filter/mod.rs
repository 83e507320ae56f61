//! Filtering, smoothing and sensor fusion (subsystem 6, estimation improvement).
//!
//! * [`ConstantAcceleration`]: causal Kalman filter after Perić et al., "Software system for
//!   simultaneous localization and mapping based on video content analysis", for live use;
//! * [`Smoother`]: fixed-interval smoother for recordings, which also interpolates through tracking
//!   gaps;
//! * [`Carrier`]: low-pass filtered path of the carrier, without the vibration of its camera;
//! * [`AbruptMotion`]: frames that no motion of a camera explains;
//! * [`fusion`]: fusion with a gyroscope, compass, wheel odometer and range finder.
//!
//! Derivation: `docs/math/filter.md`.

mod abrupt_motion;
mod carrier;
mod constant_acceleration;
mod coordinate;
pub mod fusion;
mod smoother;

pub use abrupt_motion::{AbruptFrame, AbruptMotion};
pub use carrier::{CARRIER_CUTOFF_HZ, Carrier};
pub use constant_acceleration::{ConstantAcceleration, Filtered};
pub use smoother::{PoseSource, SmoothedFrame, SmoothedPath, Smoother, Walk};

use serde::{Deserialize, Serialize};

/// Lower bounds of the process noise of filter and smoother.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilterConfig {
    /// Spectral density of the jerk of x and y, (m/s³)² s. The filter raises its density above this
    /// value when the innovations are larger than predicted.
    pub jerk_density: f64,
    /// Spectral density of the jerk of the heading, (rad/s³)² s.
    pub heading_jerk_density: f64,
}

impl Default for FilterConfig {
    fn default() -> Self {
        // A slow cart: it builds up a tenth of g within about a second.
        Self { jerk_density: 1.0, heading_jerk_density: 10.0 }
    }
}

#[cfg(test)]
mod tests;

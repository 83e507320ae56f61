//! Ground texture that moves by itself, such as grass and leaves in the wind.

use super::noise::{mix, smooth_step, value_noise};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Grass or leaves in the wind: patches of ground whose texture oscillates. The phase is similar
/// for neighbouring blades and differs between patches.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sway {
    /// Maximum displacement, metres.
    pub amplitude_m: f64,
    /// Fraction of the ground that sways, above 0 to 1.
    pub share: f64,
    /// Period of the oscillation, seconds.
    pub period_s: f64,
}

/// Size of a swaying or static patch, metres.
const PATCH_M: f64 = 0.25;
/// Correlation length of the phase, metres.
const GUST_M: f64 = 0.3;
/// Width of the transition between static and swaying, in values of the patch noise.
const BORDER: f64 = 0.3;

/// A sway with its random patches.
#[derive(Debug, Clone)]
pub(super) struct Swaying {
    sway: Sway,
    seed: u32,
    /// The patch noise exceeds this on the swaying fraction of the ground.
    threshold: f64,
}

impl Swaying {
    pub(super) fn new(sway: Sway, seed: u64) -> Self {
        let seed = mix(seed ^ 0x5_3A17) as u32;
        // 40,000 samples determine the quantile of the noise to half a percent.
        let mut values: Vec<f32> = (0..40_000)
            .map(|i| value_noise(seed, f64::from(i % 200) * 0.37, f64::from(i / 200) * 0.37))
            .collect();
        values.sort_by(f32::total_cmp);
        let still = ((1.0 - sway.share) * values.len() as f64) as usize;
        let threshold = values.get(still).map_or(f64::INFINITY, |value| f64::from(*value));
        // Everything sways: no point is in a transition.
        let threshold = if sway.share >= 1.0 { -2.0 } else { threshold };
        Self { sway, seed, threshold }
    }

    /// Displacement of the ground at a point and time, metres; `None` where it is static.
    pub(super) fn displacement_m(&self, x_m: f64, y_m: f64, time_s: f64) -> Option<(f64, f64)> {
        let patch = f64::from(value_noise(self.seed, x_m / PATCH_M, y_m / PATCH_M));
        let part = smooth_step((patch - self.threshold) / BORDER + 0.5);
        if part <= 0.0 {
            return None;
        }
        let phase = |seed: u32| 4.0 * f64::from(value_noise(self.seed ^ seed, x_m / GUST_M, y_m / GUST_M));
        let turns = TAU * time_s / self.sway.period_s;
        let amplitude_m = part * self.sway.amplitude_m;
        // Mostly along one direction, the wind's; 0.8² + 0.6² = 1.
        Some((
            0.8 * amplitude_m * (turns + phase(1)).sin(),
            0.6 * amplitude_m * (1.37 * turns + phase(2)).sin(),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_swaying_fraction_is_the_configured_one() {
        for share in [0.1, 0.3, 0.7, 1.0] {
            let sway = Sway { amplitude_m: 0.004, share, period_s: 2.0 };
            let swaying = Swaying::new(sway, 7);
            let mut moved = 0;
            for i in 0..20_000 {
                let (x_m, y_m) = (f64::from(i % 150) * 0.11 + 3.0, f64::from(i / 150) * 0.13 - 5.0);
                // In the middle of a patch's transition the amplitude is halved.
                let largest_m = (0..16)
                    .filter_map(|t| swaying.displacement_m(x_m, y_m, f64::from(t) * 0.125))
                    .map(|(dx, _)| dx.abs())
                    .fold(0.0, f64::max);
                assert!(largest_m <= 0.0032 + 1e-12);
                moved += usize::from(largest_m > 0.0016);
            }
            let found = moved as f64 / 20_000.0;
            assert!((found - share).abs() < 0.04, "{found} of {share}");
        }
    }
}

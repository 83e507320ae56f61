//! Scale of a session relative to the sessions before it, from places that both have seen.

use crate::numerics::median;

/// Standard deviation over the median absolute deviation, for the normal distribution.
const DEVIATION_OF_MEDIAN: f64 = 1.4826;
/// Standard deviation of the median over that of the mean, for the normal distribution.
const MEDIAN_OVER_MEAN: f64 = 1.2533;
/// Relative difference from the map's scale that is tolerated: about what a height measured with a
/// tape is exact to.
const TOLERATED: f64 = 0.01;
/// A difference of scale is reported if it exceeds this many of its standard deviations: by chance
/// one in sixteen thousand does.
const CERTAIN: f64 = 4.0;

/// Scale of a session relative to the sessions before it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SessionScale {
    /// Metres of the map over metres of the session: the true height of its camera over its given
    /// height, if the map is right.
    pub ratio: f64,
    /// Standard deviation of the ratio.
    pub deviation: f64,
    /// Number of recognised places.
    pub places: usize,
}

impl SessionScale {
    /// The median over recognised places, by the logarithms of their ratios; `None` without any.
    pub(super) fn of(logarithms: &[f64]) -> Option<Self> {
        let places = logarithms.len();
        let middle = median(&mut logarithms.to_vec())?;
        let mut off: Vec<f64> = logarithms.iter().map(|value| (value - middle).abs()).collect();
        let spread = DEVIATION_OF_MEDIAN * median(&mut off)?;
        let deviation = MEDIAN_OVER_MEAN * spread / (places as f64).sqrt();
        Some(Self { ratio: middle.exp(), deviation: middle.exp() * deviation, places })
    }

    /// Whether it differs significantly from the map's, by more than 1 %.
    pub fn is_doubtful(&self) -> bool {
        let off = (self.ratio - 1.0).abs();
        off > TOLERATED && off - TOLERATED > CERTAIN * self.deviation
    }
}

//! Scale of a session relative to the sessions before it, from places that both have seen.

use crate::numerics::{DEVIATION_OF_MEDIAN, median};

/// Standard deviation of the median over that of the mean, for the normal distribution.
const MEDIAN_OVER_MEAN: f64 = 1.2533;
/// Relative difference from the map's scale that is tolerated: about what a height measured with a
/// tape is exact to.
const TOLERATED: f64 = 0.01;
/// A difference of scale is reported if it exceeds this many of its standard deviations: by chance
/// one in sixteen thousand does.
const CERTAIN: f64 = 4.0;

/// Least standard deviation of the logarithm of the scale at one place: twice what places over
/// rendered asphalt, concrete, grass and tiles scatter by, at heights that are off by 2 to 10 %.
const PLACE_DEVIATION: f64 = 0.002;

/// Scale of a session relative to an earlier one at one recognised place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceScale {
    /// Logarithm of the ratio of [`SessionScale::ratio`].
    ln_ratio: f64,
    /// Its standard deviation.
    deviation: f64,
}

impl PlaceScale {
    /// From the logarithm of the ratio and its standard deviation. `None` if the place shows no
    /// scale: its deviation is not finite.
    pub fn new(ln_ratio: f64, deviation: f64) -> Option<Self> {
        deviation.is_finite().then(|| Self { ln_ratio, deviation: deviation.max(PLACE_DEVIATION) })
    }

    /// That of the earlier session relative to this one.
    pub fn inverse(self) -> Self {
        Self { ln_ratio: -self.ln_ratio, ..self }
    }
}

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
    /// Its deviation is by their spread, which in a few places may be small by chance, and not less
    /// than by the deviation that places usually have by themselves.
    pub fn of(places: &[PlaceScale]) -> Option<Self> {
        let middle = median(&mut places.iter().map(|place| place.ln_ratio).collect::<Vec<_>>())?;
        let mut off: Vec<f64> = places.iter().map(|place| (place.ln_ratio - middle).abs()).collect();
        let spread = DEVIATION_OF_MEDIAN * median(&mut off)?;
        let usual = median(&mut places.iter().map(|place| place.deviation).collect::<Vec<_>>())?;
        let deviation = middle.exp() * MEDIAN_OVER_MEAN * spread.max(usual) / (places.len() as f64).sqrt();
        Some(Self { ratio: middle.exp(), deviation, places: places.len() })
    }

    /// Whether it differs significantly from the map's, by more than 1 %.
    pub fn is_doubtful(&self) -> bool {
        let off = (self.ratio - 1.0).abs();
        off > TOLERATED && off - TOLERATED > CERTAIN * self.deviation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale(places: &[(f64, f64)]) -> SessionScale {
        let of = |&(ratio, deviation): &(f64, f64)| PlaceScale::new(f64::ln(ratio), deviation);
        SessionScale::of(&places.iter().filter_map(of).collect::<Vec<_>>()).unwrap()
    }

    #[test]
    fn one_place_is_enough_where_its_scale_is_certain() {
        assert!(scale(&[(1.05, 0.004)]).is_doubtful());
        assert!(!scale(&[(1.05, 0.02)]).is_doubtful());
        assert!(!scale(&[(1.009, 0.0)]).is_doubtful());
        // The scale of a place has errors that its residuals do not show.
        assert!(!scale(&[(1.017, 0.0)]).is_doubtful());
        assert!(PlaceScale::new(0.05, f64::INFINITY).is_none());
    }

    #[test]
    fn two_places_must_agree() {
        assert!(scale(&[(1.05, 0.004), (1.053, 0.004)]).is_doubtful());
        assert!(!scale(&[(1.01, 0.004), (1.1, 0.004)]).is_doubtful());
        let [one, two] = [1, 2].map(|count| scale(&vec![(0.95, 0.01); count]));
        assert!((one.deviation / two.deviation - 2_f64.sqrt()).abs() < 1e-12 && two.places == 2);
    }
}

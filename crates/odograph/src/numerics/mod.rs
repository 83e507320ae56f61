//! Robust statistics: the median, scales from it, and losses with their weights; and measurements
//! of the same quantities combined into one.

mod combination;

pub use combination::{Combined, Part, combine, combine_with, inverse};

use nalgebra::Vector2;

/// The median, or `None` of no values. Of an even count it is the **greater of the middle two**, so
/// it is always one of the values; [`f64::total_cmp`] orders them. The order of `values` is lost.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// The median of |x| of normal x, in standard deviations.
pub const NORMAL_MEDIAN: f64 = 0.6745;

/// The median length of normal vectors of the plane (Rayleigh distribution), in standard deviations
/// of a coordinate.
pub const RAYLEIGH_MEDIAN: f64 = 1.1774;

/// Limit of [`Loss::Tukey`] with an efficiency of 95 % on normal residuals.
pub const TUKEY_95: f64 = 4.685;

/// Standard deviation over the median absolute deviation (MAD), for the normal distribution.
pub const DEVIATION_OF_MEDIAN: f64 = 1.4826;

/// The standard deviation of zero-mean normal values from their median magnitude (MAD); 0 of no
/// values.
pub fn normal_sigma(values: &[f64]) -> f64 {
    let mut magnitudes: Vec<f64> = values.iter().map(|value| value.abs()).collect();
    DEVIATION_OF_MEDIAN * median(&mut magnitudes).unwrap_or(0.0)
}

/// The variance of each of `N` normal numbers (1 to 3) by the median of the sums of their squares,
/// which is that of a chi-square distribution; `None` of no values. The order of `squares` is lost.
pub fn robust_variance<const N: usize>(squares: &mut [f64]) -> Option<f64> {
    const { assert!(N >= 1 && N <= 3) };
    let of_chi_square = [0.455, 2.0 * std::f64::consts::LN_2, 2.37][N - 1];
    Some(median(squares)? / of_chi_square)
}

/// How many times more uncertain the mean of these residuals is than one of independent residuals,
/// as variance: (1 + ρ) / (1 − ρ) of a first-order autoregressive process with the correlation ρ of
/// neighbours.
pub fn variance_of_mean_factor(residuals: &[Vector2<f64>]) -> f64 {
    let both: f64 = residuals.windows(2).map(|two| two[0].dot(&two[1])).sum();
    let all: f64 = residuals.iter().map(Vector2::norm_squared).sum();
    let correlation = if all > 0.0 { (both / all).clamp(0.0, 0.98) } else { 0.0 };
    (1.0 + correlation) / (1.0 - correlation)
}

/// A robust loss of residuals in standard deviations, with the number of them up to which a
/// residual counts (nearly) in full.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Loss {
    /// Quadratic, then linear (P. Huber, "Robust estimation of a location parameter", 1964).
    Huber(f64),
    /// Quadratic, then logarithmic: weights fall with the square of the residual.
    Logarithmic(f64),
    /// Cauchy's: as [`Loss::Logarithmic`], without the bend between the two.
    Cauchy(f64),
    /// Tukey's biweight: zero weight beyond the limit ([`TUKEY_95`]).
    Tukey(f64),
}

impl Loss {
    /// The loss of a residual whose square is `square`; for small ones that square.
    pub fn of_square(self, square: f64) -> f64 {
        match self {
            Self::Huber(limit) if square > limit * limit => limit * (2.0 * square.sqrt() - limit),
            Self::Logarithmic(limit) if square > limit * limit => {
                limit * limit * (1.0 + (square / (limit * limit)).ln())
            }
            Self::Huber(_) | Self::Logarithmic(_) => square,
            Self::Cauchy(limit) => limit * limit * (square / (limit * limit)).ln_1p(),
            Self::Tukey(limit) => {
                limit * limit / 3.0 * (1.0 - (1.0 - square / (limit * limit)).max(0.0).powi(3))
            }
        }
    }

    /// The weight of a residual in iteratively reweighted least squares, 0 to 1: the derivative of
    /// the loss by the square.
    pub fn weight_of_square(self, square: f64) -> f64 {
        match self {
            Self::Huber(limit) if square > limit * limit => limit / square.sqrt(),
            Self::Logarithmic(limit) if square > limit * limit => limit * limit / square,
            Self::Huber(_) | Self::Logarithmic(_) => 1.0,
            Self::Cauchy(limit) => 1.0 / (1.0 + square / (limit * limit)),
            Self::Tukey(limit) => (1.0 - square / (limit * limit)).max(0.0).powi(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;
    use proptest::prelude::*;

    #[test]
    fn the_median_of_an_even_count_is_the_upper_one() {
        assert_eq!(median(&mut []), None);
        assert_eq!(median(&mut [3.0]), Some(3.0));
        assert_eq!(median(&mut [4.0, 1.0, 3.0, 2.0]), Some(3.0));
        assert_eq!(median(&mut [5.0, 1.0, 2.0]), Some(2.0));
    }

    #[test]
    fn robust_scales_tolerate_a_tenth_of_outliers() {
        let mut random = Random::new(5);
        let mut uniform = || (random.below(1 << 20) as f64 + 0.5) / f64::from(1 << 20);
        let mut normal = || {
            let (radius, angle) = ((-2.0 * uniform().ln()).sqrt(), std::f64::consts::TAU * uniform());
            if uniform() < 0.1 { 1e6 } else { 0.2 * radius * angle.cos() }
        };
        let values: Vec<f64> = (0..20_000).map(|_| normal()).collect();
        assert!((normal_sigma(&values) / 0.2 - 1.0).abs() < 0.2);
        let mut squares = |numbers: usize| -> Vec<f64> {
            (0..20_000).map(|_| (0..numbers).map(|_| normal().powi(2)).sum()).collect()
        };
        for variance in [
            robust_variance::<1>(&mut squares(1)),
            robust_variance::<2>(&mut squares(2)),
            robust_variance::<3>(&mut squares(3)),
        ] {
            assert!((variance.unwrap() / 0.04 - 1.0).abs() < 0.6, "{variance:?}");
        }
    }

    proptest! {
        #[test]
        fn a_weight_is_the_derivative_of_its_loss(square in 0.01..50.0f64, limit in 0.5..5.0f64) {
            for loss in [Loss::Huber(limit), Loss::Logarithmic(limit), Loss::Cauchy(limit), Loss::Tukey(limit)] {
                let slope = (loss.of_square(square + 1e-6) - loss.of_square(square - 1e-6)) / 2e-6;
                prop_assert!((slope - loss.weight_of_square(square)).abs() < 1e-5, "{:?}", loss);
                prop_assert!(loss.of_square(square) <= square * (1.0 + 1e-12));
            }
        }
    }
}

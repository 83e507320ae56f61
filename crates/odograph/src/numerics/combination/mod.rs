//! Combination of measurements of the same quantities that scatter by more than their own noise
//! (random-effects model).

use nalgebra::{SMatrix, SVector};
use std::ops::AddAssign;

/// One measurement of `N` quantities in information form about a common point: its information
/// matrix, and that times its offset. It may carry no information on some of them.
#[derive(Debug, Clone, Copy)]
pub struct Part<const N: usize> {
    /// Information matrix.
    pub information: SMatrix<f64, N, N>,
    /// Information times the offset from the common point.
    pub slope: SVector<f64, N>,
}

impl<const N: usize> Default for Part<N> {
    /// No information.
    fn default() -> Self {
        Self { information: SMatrix::zeros(), slope: SVector::zeros() }
    }
}

impl<const N: usize> AddAssign for Part<N> {
    fn add_assign(&mut self, other: Self) {
        self.information += other.information;
        self.slope += other.slope;
    }
}

impl<const N: usize> Part<N> {
    /// The information on the first `M` quantities, conditional on the others being at an offset
    /// from the common point.
    pub fn with_known<const M: usize>(&self, offset: &SVector<f64, N>) -> Part<M> {
        let mut left = Part::default();
        for i in 0..M {
            left.slope[i] = self.slope[i] - (M..N).map(|k| self.information[(i, k)] * offset[k]).sum::<f64>();
            for k in 0..M {
                left.information[(i, k)] = self.information[(i, k)];
            }
        }
        left
    }
}

/// The combined estimate.
#[derive(Debug, Clone, Copy)]
pub struct Combined<const N: usize> {
    /// Offset from the common point.
    pub offset: SVector<f64, N>,
    /// Covariance of the offset.
    pub covariance: SMatrix<f64, N, N>,
    /// Variance between the measurements in addition to their own noise.
    pub scatter: SVector<f64, N>,
}

impl<const N: usize> Combined<N> {
    /// The same with the covariance of the first `M` quantities given the others. `None` if the
    /// others are known exactly.
    pub fn given_the_last<const M: usize>(mut self) -> Option<Self> {
        let information = inverse(&self.covariance)?;
        let first = inverse(&information.fixed_view::<M, M>(0, 0).into_owned())?;
        self.covariance.fixed_view_mut::<M, M>(0, 0).copy_from(&first);
        Some(self)
    }
}

/// The random-effects mean (R. DerSimonian and N. Laird, "Meta-analysis in clinical trials", 1986):
/// each measurement's true value scatters about the common one with a common diagonal covariance,
/// which is estimated by restricted maximum likelihood (D. Harville, 1977) with a multiplicative
/// fixed point. If the measurements agree within their noise it is the weighted mean.
///
/// `None` if the measurements do not determine every quantity. Derivation:
/// `docs/math/extrinsics-from-driving.md`.
pub fn combine<const N: usize>(parts: &[Part<N>]) -> Option<Combined<N>> {
    combine_with(parts, &Part::default())
}

/// The same with what was known before.
pub fn combine_with<const N: usize>(parts: &[Part<N>], prior: &Part<N>) -> Option<Combined<N>> {
    let mut scatter = SVector::<f64, N>::zeros();
    let mut combined = mean(parts, prior, &scatter)?;
    if parts.len() < 2 {
        return Some(combined);
    }
    // Start from the scatter without measurement noise, an upper bound, so that the iteration
    // descends to the solution.
    for k in 0..N {
        let (mut squares, mut weight) = (0.0, 0.0);
        for part in parts {
            let w = part.information[(k, k)];
            if w > 0.0 {
                let slope = part.slope[k] - (part.information * combined.offset)[k];
                squares += slope * slope / w;
                weight += w;
            }
        }
        scatter[k] = if weight > 0.0 { squares / weight } else { 0.0 };
    }
    for _ in 0..ROUNDS {
        combined = mean(parts, prior, &scatter)?;
        let (mut found, mut expected) = (SVector::<f64, N>::zeros(), SVector::<f64, N>::zeros());
        for part in parts {
            let (information, slope) = softened(part, &scatter)?;
            let left = slope - information * combined.offset;
            let spread = information - information * combined.covariance * information;
            for k in 0..N {
                found[k] += left[k] * left[k];
                expected[k] += spread[(k, k)];
            }
        }
        for k in 0..N {
            scatter[k] *= if expected[k] > 0.0 { (found[k] / expected[k]).clamp(0.1, 10.0) } else { 0.0 };
        }
    }
    combined = mean(parts, prior, &scatter)?;
    Some(Combined { scatter, ..combined })
}

/// Number of steps in which the fixed point converges to a few per cent of the noise.
const ROUNDS: usize = 60;

/// Information and slope of a measurement whose true value scatters: `(W⁻¹ + T)⁻¹` without W having
/// an inverse.
fn softened<const N: usize>(
    part: &Part<N>,
    scatter: &SVector<f64, N>,
) -> Option<(SMatrix<f64, N, N>, SVector<f64, N>)> {
    let mut soften = SMatrix::<f64, N, N>::identity();
    for i in 0..N {
        for k in 0..N {
            soften[(i, k)] += part.information[(i, k)] * scatter[k];
        }
    }
    let inverse = soften.try_inverse()?;
    Some((inverse * part.information, inverse * part.slope))
}

fn mean<const N: usize>(
    parts: &[Part<N>],
    prior: &Part<N>,
    scatter: &SVector<f64, N>,
) -> Option<Combined<N>> {
    let Part { mut information, mut slope } = *prior;
    for part in parts {
        let (w, s) = softened(part, scatter)?;
        information += w;
        slope += s;
    }
    let covariance = inverse(&information)?;
    Some(Combined { offset: covariance * slope, covariance, scatter: *scatter })
}

/// The inverse of a symmetric positive definite matrix whose rows may have very different units;
/// `None` if it is singular.
pub fn inverse<const N: usize>(information: &SMatrix<f64, N, N>) -> Option<SMatrix<f64, N, N>> {
    let scale = SVector::<f64, N>::from_fn(|k, _| 1.0 / information[(k, k)].sqrt());
    if scale.iter().any(|s| !s.is_finite()) {
        return None;
    }
    let unit = SMatrix::<f64, N, N>::from_fn(|i, j| {
        0.5 * (information[(i, j)] + information[(j, i)]) * scale[i] * scale[j]
    });
    let cholesky = unit.cholesky()?;
    // Below this, rounding errors dominate.
    let least = (0..N).map(|k| cholesky.l_dirty()[(k, k)]).fold(f64::INFINITY, f64::min);
    if least < 1e-7 {
        return None;
    }
    let inverse = cholesky.inverse();
    Some(SMatrix::from_fn(|i, j| inverse[(i, j)] * scale[i] * scale[j]))
}

#[cfg(test)]
mod tests;

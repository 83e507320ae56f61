//! Motion estimation of the original paper: the mean of the flow vectors that agree.

use super::{MotionConfig, Random};
use crate::buffer::Buffer;
use crate::geometry::GroundPoint;

/// The displacement of the camera as in the paper: each track gives the vector from its present
/// ground point to its previous one, RANSAC finds the vector with most inliers, and their mean is
/// the displacement.
///
/// `pairs` holds the previous and the present ground point of each track, both from the same,
/// unmoved camera; `within_m` is the inlier distance. Returns the displacement (x, y) in metres,
/// the variance of each coordinate of that mean, and the inliers; `None` where there are too few.
/// Rotation is not modelled: where the camera turns the vectors disagree, which is the known limit
/// of this method.
pub fn mean_displacement(
    pairs: &[(GroundPoint, GroundPoint)],
    within_m: f64,
    config: &MotionConfig,
    random: &mut Random,
) -> Option<((f64, f64), f64, Buffer<bool>)> {
    if pairs.len() < config.minimum_inliers {
        return None;
    }
    let vectors: Vec<(f64, f64)> =
        pairs.iter().map(|(before, now)| (before.x_m - now.x_m, before.y_m - now.y_m)).collect();
    let agreeing = |centre: (f64, f64)| -> Buffer<bool> {
        vectors.iter().map(|v| (v.0 - centre.0).hypot(v.1 - centre.1) < within_m).collect()
    };
    let count = |agreeing: &[bool]| agreeing.iter().filter(|&&a| a).count();
    let mut best = Buffer::of(false, vectors.len());
    for _ in 0..SAMPLES.min(vectors.len()) {
        let candidate = agreeing(vectors[random.below(vectors.len())]);
        if count(&candidate) > count(&best) {
            best = candidate;
        }
    }
    let inliers = count(&best);
    if inliers < config.minimum_inliers
        || (inliers as f64) < config.minimum_inlier_fraction * vectors.len() as f64
    {
        return None;
    }
    let n = inliers as f64;
    let chosen = || vectors.iter().zip(&best).filter(|(_, agrees)| **agrees).map(|(v, _)| v);
    let mean = (chosen().map(|v| v.0).sum::<f64>() / n, chosen().map(|v| v.1).sum::<f64>() / n);
    let spread = chosen().map(|v| (v.0 - mean.0).powi(2) + (v.1 - mean.1).powi(2)).sum::<f64>();
    let variance = spread / (2.0 * (n - 1.0)) / n;
    Some((mean, variance, best))
}

/// Number of samples. With half the vectors wrong the probability that none is right is 10⁻¹⁵.
const SAMPLES: usize = 50;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_the_inliers_is_the_displacement() {
        let mut random = Random::new(1);
        let mut pairs = Vec::new();
        for i in 0..60 {
            let now = GroundPoint::new(0.01 * i as f64, 0.02 * (i % 7) as f64);
            let moved = if i % 3 == 0 { (0.1 * i as f64, -0.3) } else { (0.05, -0.02) };
            pairs.push((GroundPoint::new(now.x_m + moved.0, now.y_m + moved.1), now));
        }
        let ((x, y), variance, inliers) =
            mean_displacement(&pairs, 0.003, &MotionConfig::default(), &mut random).unwrap();
        assert!((x - 0.05).abs() < 1e-12 && (y + 0.02).abs() < 1e-12);
        assert!(variance < 1e-20);
        assert_eq!(inliers.iter().filter(|&&a| a).count(), 40);
        assert!(mean_displacement(&pairs[..5], 0.003, &MotionConfig::default(), &mut random).is_none());
    }
}

use super::*;
use crate::motion::Random;
use nalgebra::{Matrix2, Vector2};

/// A standard normal number: twelve uniform ones.
fn normal(random: &mut Random) -> f64 {
    (0..12).map(|_| random.below(1 << 20) as f64 / f64::from(1 << 20)).sum::<f64>() - 6.0
}

/// Measurements of (1, −2) with noise and scatter; every third has little information on one of
/// them.
fn parts(random: &mut Random, count: usize, scatter: [f64; 2]) -> Vec<Part<2>> {
    let part = |i: usize, random: &mut Random| {
        let deviations = [0.1, if i.is_multiple_of(3) { 5.0 } else { 0.2 }];
        let at = Vector2::new(1.0, -2.0)
            + Vector2::from_fn(|k, _| deviations[k] * normal(random) + scatter[k] * normal(random));
        let information = Matrix2::from_diagonal(&Vector2::from(deviations.map(|d| 1.0 / (d * d))));
        Part { information, slope: information * at }
    };
    (0..count).map(|i| part(i, random)).collect()
}

#[test]
fn the_stated_covariance_is_true_with_and_without_scatter() {
    for scatter in [[0.0, 0.0], [0.3, 0.05], [0.02, 1.0]] {
        let mut random = Random::new(1);
        let trials = 300;
        let mut nees = 0.0;
        let mut found = Vector2::zeros();
        for _ in 0..trials {
            let combined = combine(&parts(&mut random, 24, scatter)).unwrap();
            let error = combined.offset - Vector2::new(1.0, -2.0);
            nees += error.dot(&(combined.covariance.try_inverse().unwrap() * error));
            found += combined.scatter / f64::from(trials);
        }
        // The mean of 300 sums of two squares is within 1.78 to 2.23 with 95 %; an estimated
        // scatter widens that a little.
        let mean = nees / f64::from(trials);
        assert!((1.6..2.4).contains(&mean), "{scatter:?}: {mean}");
        for k in 0..2 {
            let off = found[k] - scatter[k] * scatter[k];
            // The estimate is never negative, so that zero scatter is overestimated by chance.
            assert!(off.abs() < 0.15 * scatter[k] * scatter[k] + 0.008, "{scatter:?}: {found}");
        }
    }
}

#[test]
fn what_no_measurement_knows_is_not_answered() {
    let information = Matrix2::new(4.0, 4.0, 4.0, 4.0);
    let part = Part { information, slope: Vector2::new(1.0, 1.0) };
    assert!(combine(&[part; 5]).is_none());
    assert!(combine::<2>(&[]).is_none());
    let other = Part { information: Matrix2::new(1.0, -1.0, -1.0, 1.0), slope: Vector2::zeros() };
    assert!(combine(&[part, other]).is_some());
}

//! Views that contradict the others.

use super::{Fitted, LeftOut, ViewPoseFit};
use nalgebra::Matrix3;
use odograph::error::{Error, Result};
use odograph::numerics::{Part, combine, inverse};

/// Squared Mahalanobis distance of a view from the others above which it is excluded: one in a
/// million (χ², three degrees of freedom).
const CONTRADICTION: f64 = 30.7;

/// Minimum scatter of views of one rig over a real floor: relative height, degrees.
const MIN_SCATTER: (f64, f64) = (1e-3, 0.05);

/// Largest difference between views of one rig on any floor: relative height, degrees.
const SAME_RIG: (f64, f64) = (0.05, 3.0);

/// Excludes the views outside the largest consistent set around one of them; then those that
/// contradict the rest by their own standard deviations. Fails if no two of several views are
/// consistent, or fewer than half of them are left: the few that agree by chance state a rig that
/// the others contradict.
pub fn leave_out(fits: &mut [Fitted]) -> Result<()> {
    let all: Vec<(usize, ViewPoseFit)> = used(fits);
    let near = |fit: &ViewPoseFit| -> Vec<usize> {
        all.iter().filter(|(_, other)| may_be_of_one_rig(fit, other)).map(|(index, _)| *index).collect()
    };
    // Of equally large sets the first, so that the result is deterministic.
    let largest = all.iter().map(|(_, fit)| near(fit)).reduce(|a, b| if b.len() > a.len() { b } else { a });
    let Some(largest) = largest.filter(|_| all.len() > 1) else { return Ok(()) };
    if largest.len() < 2 {
        return Err(Error::input(format!(
            "the {} views of the board contradict each other by more than {:.0}°; leave the camera fixed to its carrier and the board flat \
             on the floor in all of them",
            all.len(),
            SAME_RIG.1
        )));
    }
    for (index, fit) in all.iter().filter(|(index, _)| !largest.contains(index)) {
        let why = "it is of another height or tilt than most views".to_owned();
        fits[*index] = Err(LeftOut { why, fit: Some(Box::new(fit.clone())) });
    }
    leave_out_one_by_one(fits);
    let agreeing = used(fits).len();
    if 2 * agreeing < all.len() {
        return Err(Error::input(format!(
            "only {agreeing} of the {} views of the board agree on a height and tilt of the camera; leave the camera fixed to its carrier \
             and the board flat on the floor in all of them, and give no pictures that were taken for odograph calibrate",
            all.len()
        )));
    }
    Ok(())
}

fn may_be_of_one_rig(a: &ViewPoseFit, b: &ViewPoseFit) -> bool {
    let (a, b) = (a.quantities(), b.quantities());
    (a[0] / b[0] - 1.0).abs() < SAME_RIG.0 && (a[1] - b[1]).hypot(a[2] - b[2]) < SAME_RIG.1.to_radians()
}

/// The views that are used, with their indices.
pub fn used(fits: &[Fitted]) -> Vec<(usize, ViewPoseFit)> {
    let used = fits.iter().enumerate();
    used.filter_map(|(index, fit)| Some((index, fit.as_ref().ok()?.clone()))).collect()
}

/// Excludes the views that contradict all others, worst first, while at least two others remain. Of
/// two contradictory views either may be wrong.
fn leave_out_one_by_one(fits: &mut [Fitted]) {
    loop {
        let used = used(fits);
        if used.len() < 3 {
            return;
        }
        let worst = (0..used.len())
            .filter_map(|left| Some((left, distance(&used, left)?)))
            .max_by(|a, b| a.1.0.total_cmp(&b.1.0));
        match worst {
            Some((left, (distance, off_deg, off_part))) if distance > CONTRADICTION => {
                let (index, fit) = &used[left];
                let why = format!(
                    "it contradicts the other views (tilt by {off_deg:.2}°, height by {:.2} %)",
                    100.0 * off_part
                );
                fits[*index] = Err(LeftOut { why, fit: Some(Box::new(fit.clone())) });
            }
            _ => return,
        }
    }
}

/// Distance of a view from the combination of the others: squared Mahalanobis distance, then
/// degrees of tilt and relative height.
fn distance(used: &[(usize, ViewPoseFit)], left: usize) -> Option<(f64, f64, f64)> {
    let fit = &used[left].1;
    let around = fit.quantities();
    let others: Vec<Part<3>> = used
        .iter()
        .enumerate()
        .filter(|(index, _)| *index != left)
        .map(|(_, (_, other))| other.part(&around))
        .collect::<Option<_>>()?;
    let combined = combine(&others)?;
    let own = inverse(&fit.part(&around)?.information)?;
    let least = [MIN_SCATTER.0 * around[0], MIN_SCATTER.1.to_radians(), MIN_SCATTER.1.to_radians()];
    let scatter = combined.scatter;
    let spread = Matrix3::from_fn(|i, j| if i == j { scatter[i].max(least[i] * least[i]) } else { 0.0 });
    let information = (own + combined.covariance + spread).try_inverse()?;
    let off = combined.offset;
    Some((
        (off.transpose() * information * off)[0],
        off[1].hypot(off[2]).to_degrees(),
        off[0].abs() / around[0],
    ))
}

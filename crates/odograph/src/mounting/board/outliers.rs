//! Views that contradict the others.

use super::super::combination::{Part, combine};
use super::{Fit, LeftOut};
use nalgebra::Matrix3;

/// Squared distance of a view from the others, in their common deviations, beyond which it is left out: one in a million of three
/// normal numbers.
const CONTRADICTION: f64 = 30.7;

/// Views of one rig over a real floor differ by this much at least: a part of the height, degrees.
const LEAST_SCATTER: (f64, f64) = (1e-3, 0.05);

/// Leaves out, worst first, the views that contradict all others, as long as at least two others remain. Of two views that contradict each
/// other nobody knows which is wrong.
pub fn leave_out(fits: &mut [std::result::Result<Fit, LeftOut>]) {
    loop {
        let used: Vec<(usize, Fit)> = fits
            .iter()
            .enumerate()
            .filter_map(|(index, fit)| Some((index, fit.as_ref().ok()?.clone())))
            .collect();
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
                fits[*index] = Err(LeftOut { why, fit: Some(fit.clone()) });
            }
            _ => return,
        }
    }
}

/// How far a view is from what the others say together: squared, in deviations; then degrees of tilt and part of the height.
fn distance(used: &[(usize, Fit)], left: usize) -> Option<(f64, f64, f64)> {
    let fit = &used[left].1;
    let around = fit.quantities();
    let others: Vec<Part<3>> = used
        .iter()
        .enumerate()
        .filter(|(index, _)| *index != left)
        .map(|(_, (_, other))| other.part(&around))
        .collect::<Option<_>>()?;
    let combined = combine(&others)?;
    let own = super::inverse(&fit.part(&around)?.information)?;
    let least = [LEAST_SCATTER.0 * around[0], LEAST_SCATTER.1.to_radians(), LEAST_SCATTER.1.to_radians()];
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

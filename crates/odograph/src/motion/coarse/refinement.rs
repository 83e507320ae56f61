//! A placement of one view on another, improved between the steps of the search.

use super::Hypothesis;
use super::correlation::Peak;
use super::view::GroundView;
use crate::geometry::wrap_angle;

/// Where the view of a frame lies on that of a keyframe. Shifts are in samples of the keyframe's view, right and down.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placement {
    heading_rad: f64,
    /// Samples of the keyframe's view over samples of the frame's, for the same ground.
    zoom: f64,
    shift: (f64, f64),
}

/// How well two views agree under a placement.
#[derive(Debug, Clone, Copy)]
pub(super) struct Agreement {
    /// Normalised correlation over the overlap.
    pub correlation: f64,
    /// Samples of the keyframe's view in the overlap.
    pub samples: usize,
}

/// Smaller overlaps are not judged, samples.
const FEWEST_SAMPLES: usize = 300;

impl Placement {
    pub fn of(peak: &Peak) -> Self {
        Self { heading_rad: peak.heading_rad, zoom: peak.zoom, shift: peak.shift }
    }

    /// Whether two placements are steps of the same one.
    pub fn near(&self, other: &Self, heading_rad: f64) -> bool {
        (self.shift.0 - other.shift.0).hypot(self.shift.1 - other.shift.1) < 3.0
            && wrap_angle(self.heading_rad - other.heading_rad).abs() < heading_rad
            && (self.zoom / other.zoom).ln().abs() < 0.2
    }

    pub fn hypothesis(
        &self,
        keyframe: &GroundView,
        now: &GroundView,
        agreement: &Agreement,
        score: f64,
    ) -> Hypothesis {
        let scale = self.zoom * keyframe.pixel_m / now.pixel_m;
        let (sin, cos) = self.heading_rad.sin_cos();
        let (from_x, from_y) = (scale * now.centre_m.0, scale * now.centre_m.1);
        // Right is against y, down against x.
        let (x, y) = (-self.shift.1 * keyframe.pixel_m, -self.shift.0 * keyframe.pixel_m);
        Hypothesis {
            x_m: keyframe.centre_m.0 + x - (cos * from_x - sin * from_y),
            y_m: keyframe.centre_m.1 + y - (sin * from_x + cos * from_y),
            heading_rad: wrap_angle(self.heading_rad),
            scale,
            correlation: agreement.correlation,
            overlap: agreement.samples as f64 / keyframe.area as f64,
            score,
        }
    }

    fn moved(&self, axis: usize, by: f64) -> Self {
        let mut moved = *self;
        match axis {
            0 => moved.shift.0 += by,
            1 => moved.shift.1 += by,
            2 => moved.heading_rad += by / REACH,
            _ => moved.zoom *= (by / REACH).exp(),
        }
        moved
    }
}

/// A turn by 1 / this many radians moves the outer samples of a view by one.
const REACH: f64 = 35.0;

/// Climbs from a placement to the best correlation near it, to a sixth of a sample. `None` where the views hardly overlap.
pub(super) fn improve(
    keyframe: &GroundView,
    now: &GroundView,
    start: Placement,
    scale_free: bool,
) -> Option<(Placement, Agreement)> {
    let mut best = (start, agreement(keyframe, now, &start)?);
    let axes = if scale_free { 4 } else { 3 };
    let mut step = 1.5;
    while step > 0.15 {
        let mut improved = false;
        for axis in 0..axes {
            for by in [step, -step] {
                let next = best.0.moved(axis, by);
                if let Some(found) =
                    agreement(keyframe, now, &next).filter(|f| f.quality() > best.1.quality())
                {
                    best = (next, found);
                    improved = true;
                    break;
                }
            }
        }
        if !improved {
            step *= 0.5;
        }
    }
    Some(best)
}

impl Agreement {
    /// The root of twice the logarithm of how much likelier these samples are when related than when not: the correlation times the root of
    /// the overlap where it is small; a good fit of half a view beats a fair one of all of it.
    pub fn quality(&self) -> f64 {
        let correlation = self.correlation.clamp(0.0, 0.9999);
        (-(self.samples as f64) * (1.0 - correlation * correlation).ln()).sqrt()
    }
}

/// Normalised correlation over what both views show; `None` where that is hardly anything.
pub(super) fn agreement(keyframe: &GroundView, now: &GroundView, placement: &Placement) -> Option<Agreement> {
    let (sin, cos) = placement.heading_rad.sin_cos();
    let (sin, cos) = ((sin / placement.zoom) as f32, (cos / placement.zoom) as f32);
    let from = (
        0.5 * (keyframe.width as f64 - 1.0) + placement.shift.0,
        0.5 * (keyframe.height as f64 - 1.0) + placement.shift.1,
    );
    let (middle_x, middle_y) = (0.5 * (now.width as f32 - 1.0), 0.5 * (now.height as f32 - 1.0));
    let mut count = 0usize;
    let [mut product, mut energy, mut energy_now, mut sum, mut sum_now] = [0.0f64; 5];
    for j in 0..keyframe.height {
        let down = (j as f64 - from.1) as f32;
        let mut row = [0.0f32; 5];
        for i in 0..keyframe.width {
            let at = j * keyframe.width + i;
            if keyframe.seen[at] == 0.0 {
                continue;
            }
            let right = (i as f64 - from.0) as f32;
            let (x, y) = (cos * right - sin * down + middle_x, sin * right + cos * down + middle_y);
            if let Some((b, true)) = now.sample(x, y) {
                let a = keyframe.samples[at];
                count += 1;
                row[0] += a * b;
                row[1] += a * a;
                row[2] += b * b;
                row[3] += a;
                row[4] += b;
            }
        }
        product += f64::from(row[0]);
        energy += f64::from(row[1]);
        energy_now += f64::from(row[2]);
        sum += f64::from(row[3]);
        sum_now += f64::from(row[4]);
    }
    if count < FEWEST_SAMPLES {
        return None;
    }
    let n = count as f64;
    let covariance = product - sum * sum_now / n;
    let variances = (energy - sum * sum / n) * (energy_now - sum_now * sum_now / n);
    (variances > 1e-9).then(|| Agreement { correlation: covariance / variances.sqrt(), samples: count })
}

impl GroundView {
    /// The view between its samples, and whether all of that is ground that was seen; `None` outside.
    pub(super) fn sample(&self, x: f32, y: f32) -> Option<(f32, bool)> {
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f32 - 1.0 && y < self.height as f32 - 1.0) {
            return None;
        }
        let (column, line) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - line as f32);
        let at = line * self.width + column;
        let between = |values: &[f32]| {
            let upper = values[at] + fx * (values[at + 1] - values[at]);
            let lower =
                values[at + self.width] + fx * (values[at + self.width + 1] - values[at + self.width]);
            upper + fy * (lower - upper)
        };
        Some((between(&self.samples), between(&self.seen) > 0.99))
    }
}

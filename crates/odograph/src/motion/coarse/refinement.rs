//! Refinement of a placement of one view on another between the grid points of the search.

use super::Hypothesis;
use super::correlation::Peak;
use super::view::GroundView;
use crate::geometry::wrap_angle;

/// Rotation, scale and shift of a frame's view on a keyframe's. Shifts are in samples of the
/// keyframe's view, right and down.
#[derive(Debug, Clone, Copy)]
pub(super) struct ViewPlacement {
    heading_rad: f64,
    /// Scale: samples of the keyframe's view per sample of the frame's, for the same ground.
    zoom: f64,
    shift: (f64, f64),
}

/// Similarity of two views under a placement.
#[derive(Debug, Clone, Copy)]
pub(super) struct OverlapCorrelation {
    /// Normalised correlation over the overlap.
    pub correlation: f64,
    /// Samples of the keyframe's view in the overlap.
    pub samples: usize,
}

/// Minimum overlap, samples. Not derived; chosen.
const MIN_SAMPLES: usize = 300;

impl ViewPlacement {
    /// Two views of the same place.
    pub const SAME: Self = Self { heading_rad: 0.0, zoom: 1.0, shift: (0.0, 0.0) };

    pub fn of(peak: &Peak) -> Self {
        Self { heading_rad: peak.heading_rad, zoom: peak.zoom, shift: peak.shift }
    }

    /// Whether two placements belong to the same peak.
    pub fn is_near(&self, other: &Self, heading_rad: f64) -> bool {
        (self.shift.0 - other.shift.0).hypot(self.shift.1 - other.shift.1) < 3.0
            && wrap_angle(self.heading_rad - other.heading_rad).abs() < heading_rad
            && (self.zoom / other.zoom).ln().abs() < 0.2
    }

    pub fn hypothesis(&self, keyframe: &GroundView, now: &GroundView, score: f64) -> Hypothesis {
        let scale = self.zoom * keyframe.pixel_m / now.pixel_m;
        let (sin, cos) = self.heading_rad.sin_cos();
        let (from_x, from_y) = (scale * now.centre_m.0, scale * now.centre_m.1);
        // Right is −y, down is −x.
        let (x, y) = (-self.shift.1 * keyframe.pixel_m, -self.shift.0 * keyframe.pixel_m);
        Hypothesis {
            x_m: keyframe.centre_m.0 + x - (cos * from_x - sin * from_y),
            y_m: keyframe.centre_m.1 + y - (sin * from_x + cos * from_y),
            heading_rad: wrap_angle(self.heading_rad),
            scale,
            agreement: agreeing_share(keyframe, now, self),
            score,
        }
    }

    fn moved(&self, axis: usize, by: f64) -> Self {
        let mut moved = *self;
        match axis {
            0 => moved.shift.0 += by,
            1 => moved.shift.1 += by,
            2 => moved.heading_rad += by / RADIUS,
            _ => moved.zoom *= (by / RADIUS).exp(),
        }
        moved
    }
}

/// Radius of a view, samples: a rotation by its inverse moves the outer samples by one.
const RADIUS: f64 = 35.0;

/// Coordinate ascent from a placement to the local maximum of the correlation, with step lengths
/// `steps` in samples, on one in `stride` samples along each side, with its quality. `None` where
/// the views hardly overlap.
pub(super) fn improve(
    keyframe: &GroundView,
    now: &GroundView,
    start: ViewPlacement,
    scale_free: bool,
    (steps, stride): (&[f64], usize),
) -> Option<(f64, ViewPlacement)> {
    let quality = |placement: &ViewPlacement| Some(compare(keyframe, now, placement, stride)?.quality());
    let mut best = (quality(&start)?, start);
    let axes = if scale_free { 4 } else { 3 };
    for &step in steps {
        let mut improved = true;
        while std::mem::take(&mut improved) {
            for axis in 0..axes {
                for by in [step, -step] {
                    let next = best.1.moved(axis, by);
                    if let Some(found) = quality(&next).filter(|found| *found > best.0) {
                        best = (found, next);
                        improved = true;
                        break;
                    }
                }
            }
        }
    }
    Some(best)
}

impl OverlapCorrelation {
    /// Root of twice the log-likelihood ratio of related against unrelated samples. For a small
    /// correlation it is the correlation times the root of the overlap: a good fit of half a view
    /// exceeds a fair one of all of it.
    pub fn quality(&self) -> f64 {
        let correlation = self.correlation.clamp(0.0, 0.9999);
        (-(self.samples as f64) * (1.0 - correlation * correlation).ln()).sqrt()
    }
}

/// Normalised correlation over the overlap, on one in `stride` samples along each side; `None`
/// where the overlap is too small.
pub(super) fn compare(
    keyframe: &GroundView,
    now: &GroundView,
    placement: &ViewPlacement,
    stride: usize,
) -> Option<OverlapCorrelation> {
    let (sin, cos) = placement.heading_rad.sin_cos();
    let (sin, cos) = ((sin / placement.zoom) as f32, (cos / placement.zoom) as f32);
    let from = (
        0.5 * (keyframe.width as f64 - 1.0) + placement.shift.0,
        0.5 * (keyframe.height as f64 - 1.0) + placement.shift.1,
    );
    let (middle_x, middle_y) = (0.5 * (now.width as f32 - 1.0), 0.5 * (now.height as f32 - 1.0));
    let (last_x, last_y) = (now.width as f32 - 1.0, now.height as f32 - 1.0);
    let mut count = 0usize;
    let [mut product, mut energy, mut energy_now, mut sum, mut sum_now] = [0.0f64; 5];
    for j in (0..keyframe.height).step_by(stride) {
        let down = (j as f64 - from.1) as f32;
        let right = |i: usize| (i as f64 - from.0) as f32;
        // Along a row both coordinates are linear, so that the part inside the view is one
        // interval.
        let (x, y) = (middle_x - sin * down, middle_y + cos * down);
        let (across, along) = (interval_inside(x, cos, last_x), interval_inside(y, sin, last_y));
        let column = |right: f32| (f64::from(right) + from.0).clamp(0.0, keyframe.width as f64);
        let first = column(across.0.max(along.0)).ceil() as usize;
        let last = column(across.1.min(along.1)).floor() as usize;
        let row = &keyframe.known[j * keyframe.width..][..keyframe.width];
        let mut sums = [0.0f32; 5];
        for i in (first.next_multiple_of(stride)..keyframe.width.min(last + 1)).step_by(stride) {
            let (a, right) = (row[i], right(i));
            let b = now.interpolate_known(x + cos * right, y + sin * right);
            if a.is_nan() || b.is_nan() {
                continue;
            }
            count += 1;
            sums[0] += a * b;
            sums[1] += a * a;
            sums[2] += b * b;
            sums[3] += a;
            sums[4] += b;
        }
        product += f64::from(sums[0]);
        energy += f64::from(sums[1]);
        energy_now += f64::from(sums[2]);
        sum += f64::from(sums[3]);
        sum_now += f64::from(sums[4]);
    }
    let samples = count * stride * stride;
    if samples < MIN_SAMPLES {
        return None;
    }
    let n = count as f64;
    let covariance = product - sum * sum_now / n;
    let variances = (energy - sum * sum / n) * (energy_now - sum_now * sum_now / n);
    (variances > 1e-9).then(|| OverlapCorrelation { correlation: covariance / variances.sqrt(), samples })
}

/// Side of the blocks of [`agreeing_share`], samples.
const BLOCK: usize = 10;

/// The part of the overlap's blocks in which the views are correlated positively: a half by chance,
/// and all where the whole view is placed alike.
pub(super) fn agreeing_share(keyframe: &GroundView, now: &GroundView, placement: &ViewPlacement) -> f64 {
    let (sin, cos) = placement.heading_rad.sin_cos();
    let (sin, cos) = (sin / placement.zoom, cos / placement.zoom);
    let middle = |view: &GroundView| (0.5 * (view.width as f64 - 1.0), 0.5 * (view.height as f64 - 1.0));
    let (from, to) = (middle(keyframe), middle(now));
    let columns = keyframe.width.div_ceil(BLOCK);
    // Per block: number of samples, their sums and the sum of their products.
    let mut blocks = vec![[0.0f32; 4]; columns * keyframe.height.div_ceil(BLOCK)];
    for (at, &a) in keyframe.known.iter().enumerate() {
        let (i, j) = (at % keyframe.width, at / keyframe.width);
        let (right, down) = (i as f64 - from.0 - placement.shift.0, j as f64 - from.1 - placement.shift.1);
        let (x, y) = (to.0 + cos * right - sin * down, to.1 + sin * right + cos * down);
        let b = now.interpolate_known(x as f32, y as f32);
        if !a.is_nan() && !b.is_nan() {
            let block = &mut blocks[j / BLOCK * columns + i / BLOCK];
            block.iter_mut().zip([1.0, a, b, a * b]).for_each(|(sum, own)| *sum += own);
        }
    }
    let seen = blocks.iter().filter(|[count, ..]| 2.0 * count > (BLOCK * BLOCK) as f32);
    let covary = |[count, a, b, product]: &&[f32; 4]| product * count > a * b;
    seen.clone().filter(covary).count() as f64 / seen.count().max(1) as f64
}

/// The interval of t in which `start` + `slope` t lies between 0 and `last`.
fn interval_inside(start: f32, slope: f32, last: f32) -> (f32, f32) {
    if slope.abs() < 1e-6 {
        let inside = start >= 0.0 && start <= last;
        return if inside { (f32::NEG_INFINITY, f32::INFINITY) } else { (f32::INFINITY, f32::NEG_INFINITY) };
    }
    let (a, b) = (-start / slope, (last - start) / slope);
    (a.min(b), a.max(b))
}

impl GroundView {
    /// Bilinear interpolation; NaN outside the view and where one of the four samples is unknown.
    fn interpolate_known(&self, x: f32, y: f32) -> f32 {
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f32 - 1.0 && y < self.height as f32 - 1.0) {
            return f32::NAN;
        }
        bilinear(&self.known, self.width, x, y)
    }

    /// Bilinear interpolation with zeros where nothing is seen; `None` outside.
    pub(super) fn sample(&self, x: f32, y: f32) -> Option<f32> {
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f32 - 1.0 && y < self.height as f32 - 1.0;
        inside.then(|| bilinear(&self.samples, self.width, x, y))
    }
}

/// Bilinear interpolation in a grid; `x` and `y` must be below its last column and row.
#[inline]
fn bilinear(values: &[f32], width: usize, x: f32, y: f32) -> f32 {
    let (column, line) = (x as usize, y as usize);
    let (fx, fy) = (x - column as f32, y - line as f32);
    let at = line * width + column;
    let (upper, lower) = (&values[at..at + 2], &values[at + width..at + width + 2]);
    let upper = upper[0] + fx * (upper[1] - upper[0]);
    let lower = lower[0] + fx * (lower[1] - lower[0]);
    upper + fy * (lower - upper)
}

//! Correlation of views over all shifts in the Fourier domain.

use super::view::GroundView;
use crate::numerics::median;
use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};
use std::sync::Arc;

/// Side of the transforms, samples: two views fit beside each other, so that shifts do not alias.
const SIDE: usize = 192;

/// Peaks kept per rotation. Not derived; chosen.
const PEAKS_PER_ROTATION: usize = 8;

/// Minimum overlap of the views, as a fraction of the smaller one. Not derived; chosen.
const MIN_OVERLAP: f64 = 0.18;

pub(super) type Spectrum = Vec<Complex<f32>>;

/// A local maximum of the correlation at one rotation and scale. Shifts are in samples of the
/// keyframe's view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Peak {
    /// Correlation over the square root of the overlap, which has equal variance at all shifts.
    pub value: f64,
    pub heading_rad: f64,
    pub zoom: f64,
    /// Right and down, from the centre of the keyframe's view to that of the rotated one.
    pub shift: (f64, f64),
    /// Root mean square of the values over all shifts of this rotation.
    pub spread: f64,
}

/// The Fourier transforms of one size.
pub(super) struct Correlator {
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
}

impl std::fmt::Debug for Correlator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Correlator").field("side", &SIDE).finish()
    }
}

impl Correlator {
    pub fn new() -> Self {
        let mut planner = FftPlanner::new();
        Self { forward: planner.plan_fft_forward(SIDE), inverse: planner.plan_fft_inverse(SIDE) }
    }

    /// Conjugate spectrum of a keyframe's view, with the centre of the view at the origin.
    pub fn spectrum(&self, view: &GroundView) -> Spectrum {
        let mut field = rotated_pair(view, [0.0, 0.0], 1.0);
        field.iter_mut().for_each(|value| value.im = 0.0);
        self.transform(&mut field, &self.forward);
        field.iter_mut().for_each(|value| *value = value.conj());
        field
    }

    /// The best shifts of a view rotated by each of two headings and scaled by `zoom`. `weights`
    /// are [`overlap_weights`].
    pub fn peaks(
        &self,
        keyframe: &Spectrum,
        now: &GroundView,
        headings: [f64; 2],
        zoom: f64,
        weights: &[f32],
    ) -> Vec<Peak> {
        let mut product = rotated_pair(now, headings, zoom);
        self.transform(&mut product, &self.forward);
        product.iter_mut().zip(keyframe).for_each(|(value, conjugate)| *value *= conjugate);
        self.transform(&mut product, &self.inverse);
        let valid = weights.iter().filter(|&&w| w > 0.0).count().max(1) as f64;
        let mut found = Vec::new();
        for (part, heading_rad) in headings.into_iter().enumerate() {
            let value = |value: &Complex<f32>| if part == 0 { value.re } else { value.im };
            let surface: Vec<f32> = product.iter().zip(weights).map(|(v, w)| value(v) * w).collect();
            let spread = (surface.iter().map(|v| f64::from(v * v)).sum::<f64>() / valid).sqrt();
            let peak = |(value, x, y)| Peak { value, heading_rad, zoom, shift: (x, y), spread };
            found.extend(local_maxima(&surface).into_iter().map(peak));
        }
        found
    }

    /// Two-dimensional transform. The forward one leaves the result transposed, the inverse one
    /// undoes that.
    fn transform(&self, field: &mut Spectrum, fft: &Arc<dyn Fft<f32>>) {
        fft.process(field);
        for j in 0..SIDE {
            for i in 0..j {
                field.swap(j * SIDE + i, i * SIDE + j);
            }
        }
        fft.process(field);
    }
}

/// A view rotated by each of two headings and scaled by `zoom`, one as the real, the other as the
/// imaginary part.
fn rotated_pair(view: &GroundView, headings: [f64; 2], zoom: f64) -> Spectrum {
    let mut field = vec![Complex::new(0.0, 0.0); SIDE * SIDE];
    let (middle_x, middle_y) = (0.5 * (view.width as f32 - 1.0), 0.5 * (view.height as f32 - 1.0));
    let radius = (0.5 * zoom * (view.width as f64).hypot(view.height as f64)).ceil() as isize;
    let radius = radius.min(SIDE as isize / 2 - 1);
    let wrapped = |i: isize| i.rem_euclid(SIDE as isize) as usize;
    for (part, heading) in headings.into_iter().enumerate() {
        let (sin, cos) = heading.sin_cos();
        let (sin, cos) = ((sin / zoom) as f32, (cos / zoom) as f32);
        for j in -radius..=radius {
            for i in -radius..=radius {
                // Forward is up, left is left: a rotation to the left takes (right, down) = (i, j)
                // from (c i − s j, s i + c j).
                let x = cos * i as f32 - sin * j as f32 + middle_x;
                let y = sin * i as f32 + cos * j as f32 + middle_y;
                if let Some(value) = view.sample(x, y) {
                    let at = &mut field[wrapped(j) * SIDE + wrapped(i)];
                    *(if part == 0 { &mut at.re } else { &mut at.im }) = value;
                }
            }
        }
    }
    field
}

/// Standard deviation of the correlation at unrelated places: the median over rotations.
pub(super) fn noise(peaks: &[Peak]) -> f64 {
    let mut spreads: Vec<f64> = peaks.iter().map(|peak| peak.spread).collect();
    median(&mut spreads).map_or(1.0, |spread| spread.max(1e-6))
}

/// Inverse root of the overlap of two discs of that area, for all shifts; zero where it is too
/// small. Includes the scale of the unnormalised inverse transform.
pub(super) fn overlap_weights(area: f64) -> Vec<f32> {
    let radius = (area / std::f64::consts::PI).sqrt();
    let scale = 1.0 / (SIDE * SIDE) as f64;
    let distance = |i: usize| if i < SIDE / 2 { i as f64 } else { i as f64 - SIDE as f64 };
    (0..SIDE * SIDE)
        .map(|at| {
            let half = 0.5 * distance(at % SIDE).hypot(distance(at / SIDE)) / radius;
            // Overlap of two unit discs relative to the area of one.
            let share = if half < 1.0 {
                (2.0 / std::f64::consts::PI) * (half.acos() - half * (1.0 - half * half).sqrt())
            } else {
                0.0
            };
            // Rectangles overlap slightly more than discs at the same distance.
            if half > 0.85 { 0.0 } else { (scale / (share.max(MIN_OVERLAP) * area).sqrt()) as f32 }
        })
        .collect()
}

/// The highest local maxima of a surface that are not neighbours: value and signed shift,
/// interpolated by parabolas.
fn local_maxima(surface: &[f32]) -> Vec<(f64, f64, f64)> {
    const MIN_DISTANCE: isize = 4;
    let wrapped = |i: isize| i.rem_euclid(SIDE as isize) as usize;
    let at = |x: isize, y: isize| surface[wrapped(y) * SIDE + wrapped(x)];
    let signed = |i: usize| if i < SIDE / 2 { i as isize } else { i as isize - SIDE as isize };
    let mut best: Vec<(f32, isize, isize)> = Vec::new();
    for (index, &value) in surface.iter().enumerate() {
        if value <= 0.0 || (best.len() >= 2 * PEAKS_PER_ROTATION && value <= best[best.len() - 1].0) {
            continue;
        }
        let (x, y) = (signed(index % SIDE), signed(index / SIDE));
        let is_maximum = (-1..=1).all(|dy| (-1..=1).all(|dx| at(x + dx, y + dy) <= value));
        if is_maximum {
            best.push((value, x, y));
            best.sort_by(|a, b| b.0.total_cmp(&a.0));
            best.truncate(2 * PEAKS_PER_ROTATION);
        }
    }
    let mut kept: Vec<(f32, isize, isize)> = Vec::new();
    for peak in best {
        let is_near = |other: &(f32, isize, isize)| {
            (other.1 - peak.1).abs() < MIN_DISTANCE && (other.2 - peak.2).abs() < MIN_DISTANCE
        };
        if kept.len() < PEAKS_PER_ROTATION && !kept.iter().any(is_near) {
            kept.push(peak);
        }
    }
    let vertex = |before: f32, here: f32, after: f32| {
        let curvature = 2.0 * here - before - after;
        if curvature > 1e-9 { f64::from(0.5 * (after - before) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
    };
    kept.into_iter()
        .map(|(value, x, y)| {
            let dx = vertex(at(x - 1, y), value, at(x + 1, y));
            let dy = vertex(at(x, y - 1), value, at(x, y + 1));
            // The correlation peaks at minus the shift of the centre.
            (f64::from(value), -(x as f64 + dx), -(y as f64 + dy))
        })
        .collect()
}

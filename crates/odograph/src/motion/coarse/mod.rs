//! Global registration of a frame against a keyframe without a prediction: whole images are
//! compared, at any rotation and any shift.
//!
//! Both images are orthorectified into [`GroundView`]s, small views of the ground from above
//! without tilt and lens distortion. Between two of them only a rotation, a shift and, where the
//! height is free, a scale are left. Rotations (and scales) are tried on a grid, each by a
//! correlation over all shifts in the Fourier domain (C. Kuglin and D. Hines, "The phase
//! correlation image alignment method", 1975); the best peaks are then refined between the grid
//! points on the views themselves.
//!
//! A Fourier–Mellin transform (B. Reddy and B. Chatterji, 1996) finds rotation and scale at once,
//! but from the spectra of whole images, which have too little in common below half an overlap.
//! Trying the rotations works down to a quarter of an overlap and costs some tens of milliseconds,
//! which the rare loss can afford. Instead of whitening the spectrum, as phase correlation does,
//! each view is normalised to equal local contrast, which removes exposure, vignetting and soft
//! shadows and leaves what is outside a view without weight.

mod correlation;
mod refinement;
mod view;

pub use view::GroundView;

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use correlation::{Correlator, Peak, Spectrum, overlap_weights};
use refinement::ViewPlacement;
use view::ViewGeometry;

/// Unknowns between two views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoarseOptions {
    /// Expected heading of the frame relative to the keyframe, and its largest error, radians; an
    /// error of π is any heading.
    pub heading_rad: (f64, f64),
    /// Whether the height is unknown: 0.6 to 1.6 times the height that the view was made for.
    pub scale_free: bool,
    /// Most hypotheses per keyframe.
    pub hypotheses: usize,
}

impl Default for CoarseOptions {
    fn default() -> Self {
        Self { heading_rad: (0.0, std::f64::consts::PI), scale_free: false, hypotheses: 4 }
    }
}

/// A candidate pose of a frame relative to a keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Position of the camera in the level frame of the keyframe (origin on the ground below it, x
    /// along its heading), forward, metres.
    pub x_m: f64,
    /// Position to the left, metres.
    pub y_m: f64,
    /// Heading relative to the keyframe, radians, in (−π, π].
    pub heading_rad: f64,
    /// True height over the height that the frame's view was made for.
    pub scale: f64,
    /// Fraction of the overlap's blocks of 10x10 samples whose correlation is positive, 0 to 1.
    pub agreement: f64,
    /// Correlation in standard deviations of that of unrelated places. The maximum over all tried
    /// places reaches five to eight by chance.
    pub score: f64,
}

impl Hypothesis {
    /// The pose of the frame in the world, from the pose of the keyframe and the one that the
    /// frame's view was made for.
    pub fn pose(&self, keyframe: &GroundPose, assumed: &GroundPose) -> GroundPose {
        let (sin, cos) = keyframe.heading_rad.sin_cos();
        GroundPose {
            x_m: keyframe.x_m + cos * self.x_m - sin * self.y_m,
            y_m: keyframe.y_m + sin * self.x_m + cos * self.y_m,
            heading_rad: keyframe.heading_rad + self.heading_rad,
            height_m: assumed.height_m * self.scale,
            ..*assumed
        }
    }
}

/// Registers views of one camera.
#[derive(Debug)]
pub struct CoarseRegistration {
    camera: Camera,
    geometry: ViewGeometry,
    correlator: Correlator,
}

/// Grid of rotations, radians: 6°, at which the edge of a view is at most two samples off.
const ROTATION_STEP_RAD: f64 = std::f64::consts::TAU / 60.0;

/// Grid of scales: ratio of neighbours. Not derived; chosen.
const SCALE_STEP: f64 = 1.13;

/// Scales on either side of one: 0.61 to 1.63.
const SCALE_STEPS: i32 = 4;

/// Score that unrelated places do not reach; see [`Hypothesis::score`].
const CERTAIN_SCORE: f64 = 12.0;

/// Peaks whose normalised correlation over the overlap is computed. Not derived; chosen.
const MAX_PEAKS_COMPARED: usize = 100;

/// Peaks that are refined, per hypothesis. Not derived; chosen.
const PEAKS_PER_HYPOTHESIS: usize = 4;

/// Steps of the two refinements, in samples, and their subsampling along each side: a quarter of
/// the samples is enough for the first.
const COARSE_STEPS: (&[f64], usize) = (&[1.5, 0.75], 2);
const FINE_STEPS: (&[f64], usize) = (&[0.75, 0.375, 0.1875], 1);

impl CoarseRegistration {
    /// For a camera.
    pub fn new(camera: &Camera) -> Self {
        Self { camera: camera.clone(), geometry: ViewGeometry::new(camera), correlator: Correlator::new() }
    }

    /// Orthorectified view of an image, taken at this height and tilt; position and heading do not
    /// matter. Masked pixels are left out. `None` where the image shows no ground.
    pub fn view(&self, pyramid: &Pyramid, mask: Option<&ImageMask>, pose: &GroundPose) -> Option<GroundView> {
        self.geometry.view(&self.camera, pyramid, mask, pose)
    }

    /// Hypotheses of the pose of `now` relative to `keyframe`, the best first; empty where nothing
    /// was found.
    pub fn register(
        &self,
        keyframe: &GroundView,
        now: &GroundView,
        options: &CoarseOptions,
    ) -> Vec<Hypothesis> {
        let spectrum = self.correlator.spectrum(keyframe);
        let mut peaks = Vec::new();
        let mut found = Vec::new();
        // Height changes are usually small: nearby scales are tried first.
        for round in scales(options.scale_free) {
            peaks.extend(round.into_iter().flat_map(|scale| {
                let zoom = scale * now.pixel_m / keyframe.pixel_m;
                self.search(&spectrum, keyframe, now, zoom, options)
            }));
            found = refine(keyframe, now, &mut peaks, options);
            if found.first().is_some_and(|best| best.score > CERTAIN_SCORE) {
                break;
            }
        }
        found
    }

    /// How much of two views has not moved: [`Hypothesis::agreement`] of the same pose.
    pub fn static_share(&self, before: &GroundView, now: &GroundView) -> f64 {
        refinement::agreeing_share(before, now, &ViewPlacement::SAME)
    }

    /// The best shifts at every rotation, at one scale.
    fn search(
        &self,
        spectrum: &Spectrum,
        keyframe: &GroundView,
        now: &GroundView,
        zoom: f64,
        options: &CoarseOptions,
    ) -> Vec<Peak> {
        let weights = overlap_weights(keyframe.area.min(now.area) as f64 * zoom.min(1.0));
        let rotations = rotations(options);
        // Two rotations at a time, one as the real, the other as the imaginary part.
        let pairs = rotations.chunks(2).map(|pair| [pair[0], pair[pair.len() - 1]]);
        pairs.flat_map(|pair| self.correlator.peaks(spectrum, now, pair, zoom, &weights)).collect()
    }
}

/// The grid of rotations.
fn rotations(options: &CoarseOptions) -> Vec<f64> {
    let (expected, tolerance) = options.heading_rad;
    if tolerance >= std::f64::consts::PI - 0.5 * ROTATION_STEP_RAD {
        return (0..60).map(|i| expected + f64::from(i) * ROTATION_STEP_RAD).collect();
    }
    let steps = (tolerance / ROTATION_STEP_RAD).ceil().max(0.0) as i32;
    (-steps..=steps).map(|i| expected + f64::from(i) * ROTATION_STEP_RAD).collect()
}

/// The grid of scales, in rounds.
fn scales(free: bool) -> Vec<Vec<f64>> {
    if !free {
        return vec![vec![1.0]];
    }
    let (near, far): (Vec<i32>, Vec<i32>) = (-SCALE_STEPS..=SCALE_STEPS).partition(|steps| steps.abs() <= 1);
    [near, far].map(|steps| steps.into_iter().map(|steps| SCALE_STEP.powi(steps)).collect()).into()
}

/// Refines the best peaks between the grid points; duplicates are merged.
fn refine(
    keyframe: &GroundView,
    now: &GroundView,
    peaks: &mut [Peak],
    options: &CoarseOptions,
) -> Vec<Hypothesis> {
    let noise = correlation::noise(peaks);
    peaks.sort_by(|a, b| b.value.total_cmp(&a.value));
    let mut starts: Vec<(f64, ViewPlacement)> = Vec::new();
    for start in peaks.iter().map(ViewPlacement::of) {
        if starts.len() >= MAX_PEAKS_COMPARED {
            break;
        }
        if !starts.iter().any(|(_, other)| other.is_near(&start, 2.0 * ROTATION_STEP_RAD)) {
            let found = refinement::compare(keyframe, now, &start, COARSE_STEPS.1);
            starts.push((found.map_or(0.0, |found| found.quality()), start));
        }
    }
    let improve = |from, effort| refinement::improve(keyframe, now, from, options.scale_free, effort);
    best_of(&mut starts, PEAKS_PER_HYPOTHESIS * options.hypotheses);
    let mut coarse: Vec<_> = starts.iter().filter_map(|(_, start)| improve(*start, COARSE_STEPS)).collect();
    // On tiles the true place is not always among the best before the fine steps.
    best_of(&mut coarse, 2 * options.hypotheses);
    let mut fine: Vec<_> = coarse.iter().filter_map(|(_, start)| improve(*start, FINE_STEPS)).collect();
    best_of(&mut fine, options.hypotheses);
    let hypothesis =
        |(quality, placement): &(f64, ViewPlacement)| placement.hypothesis(keyframe, now, quality / noise);
    fine.iter().map(hypothesis).collect()
}

/// Keeps the best placements, the best first, and of several at one place only the best.
fn best_of(placements: &mut Vec<(f64, ViewPlacement)>, count: usize) {
    placements.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut kept: Vec<(f64, ViewPlacement)> = Vec::with_capacity(count);
    for (quality, placement) in placements.drain(..) {
        let is_same = |(_, other): &(f64, ViewPlacement)| other.is_near(&placement, 0.5 * ROTATION_STEP_RAD);
        if kept.len() < count && !kept.iter().any(is_same) {
            kept.push((quality, placement));
        }
    }
    *placements = kept;
}

#[cfg(test)]
mod tests;

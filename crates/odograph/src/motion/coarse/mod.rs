//! Where a frame lies against a keyframe when nothing is known beforehand: the whole images compared, at any rotation and any shift.
//!
//! Both images are turned into [`GroundView`]s: small top-down pictures of the ground, in which tilt and lens are gone. What is left
//! between two of them is a rotation, a shift and, where the height is free, a scale. Rotations (and scales) are tried in steps, each
//! by a correlation over all shifts in the Fourier domain (C. Kuglin and D. Hines, "The phase correlation image alignment
//! method", 1975); the best peaks are then refined between the steps on the views themselves.
//!
//! A Fourier–Mellin transform (B. Reddy and B. Chatterji, 1996) finds rotation and scale in one go, but from the spectra of whole
//! images: below half an overlap they have too little in common. Trying the rotations works down to a quarter of an overlap, and
//! costs some tens of milliseconds, which the rare moment of a loss can afford. Where phase correlation whitens the spectrum, here
//! each view is brought to even contrast in the image domain, so that exposure, vignetting and soft shadows are gone as well, and
//! so that what is outside a view counts nothing.

mod correlation;
mod refinement;
mod view;

pub use view::GroundView;

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use correlation::{Correlator, Peak, Spectrum, overlap_weights};
use refinement::Placement;
use view::ViewGeometry;

/// What is unknown between two views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoarseOptions {
    /// The heading of the frame against the keyframe that is expected, and how far it may be off, both in radians; π off is any.
    pub heading_rad: (f64, f64),
    /// Whether the height is unknown too: from 0.6 to 1.6 times what the view was made for.
    pub scale_free: bool,
    /// At most so many hypotheses are given for each keyframe.
    pub hypotheses: usize,
}

impl Default for CoarseOptions {
    fn default() -> Self {
        Self { heading_rad: (0.0, std::f64::consts::PI), scale_free: false, hypotheses: 4 }
    }
}

/// Where a frame may be against a keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Of the camera in the level frame of the keyframe (origin on the ground below it, x along its heading), metres.
    pub x_m: f64,
    /// To the left, metres.
    pub y_m: f64,
    /// Heading less the keyframe's, radians, in (−π, π].
    pub heading_rad: f64,
    /// True height over the height that the frame's view was made for.
    pub scale: f64,
    /// Normalised correlation over the overlap, −1 to 1.
    pub correlation: f64,
    /// Overlap as a part of the keyframe's view, 0 to 1.
    pub overlap: f64,
    /// How far the correlation stands above that of unrelated places, in their standard deviations. Among all the places that are
    /// tried, chance reaches five to eight.
    pub score: f64,
}

impl Hypothesis {
    /// The pose of the frame in the world, from that of the keyframe and the one that the frame's view was made for.
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

/// Rotations are tried this far apart, radians: 6°, so that the edge of a view is at most two samples off.
const ROTATION_STEP_RAD: f64 = std::f64::consts::TAU / 60.0;

/// Scales are tried this factor apart.
const SCALE_STEP: f64 = 1.13;

/// So many scales on either side of one: 0.61 to 1.63.
const SCALE_STEPS: i32 = 4;

/// Chance does not reach this score.
const CERTAIN_SCORE: f64 = 12.0;

/// So many peaks of the correlation are judged by what the views have in common there.
const PEAKS_JUDGED: usize = 100;

/// Peaks that are refined, for every hypothesis that is asked for.
const PEAKS_PER_HYPOTHESIS: usize = 4;

/// Steps of an improvement, in samples, and of how many samples along each side one is looked at: for the first of them a quarter of all is enough.
const ROUGH: (&[f64], usize) = (&[1.5, 0.75], 2);
const FINE: (&[f64], usize) = (&[0.75, 0.375, 0.1875], 1);

impl CoarseRegistration {
    /// Made ready for a camera.
    pub fn new(camera: &Camera) -> Self {
        Self { camera: camera.clone(), geometry: ViewGeometry::new(camera), correlator: Correlator::new() }
    }

    /// The ground as seen from a camera of this height and tilt; position and heading do not matter. `None` where the image shows no ground.
    /// What the mask covers is not seen.
    pub fn view(&self, pyramid: &Pyramid, mask: Option<&ImageMask>, pose: &GroundPose) -> Option<GroundView> {
        self.geometry.view(&self.camera, pyramid, mask, pose)
    }

    /// Where `now` may lie against `keyframe`: the best hypothesis first, none where nothing was found.
    pub fn register(
        &self,
        keyframe: &GroundView,
        now: &GroundView,
        options: &CoarseOptions,
    ) -> Vec<Hypothesis> {
        let spectrum = self.correlator.spectrum(keyframe);
        let mut peaks = Vec::new();
        let mut found = Vec::new();
        // Heights seldom change much: nearby scales are tried first.
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

    /// The best shifts at every heading, at one scale.
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
        // Two rotations at a time: one is the real, the other the imaginary part.
        let pairs = rotations.chunks(2).map(|pair| [pair[0], pair[pair.len() - 1]]);
        pairs.flat_map(|pair| self.correlator.peaks(spectrum, now, pair, zoom, &weights)).collect()
    }
}

/// The headings to be tried.
fn rotations(options: &CoarseOptions) -> Vec<f64> {
    let (expected, off) = options.heading_rad;
    if off >= std::f64::consts::PI - 0.5 * ROTATION_STEP_RAD {
        return (0..60).map(|i| expected + f64::from(i) * ROTATION_STEP_RAD).collect();
    }
    let steps = (off / ROTATION_STEP_RAD).ceil().max(0.0) as i32;
    (-steps..=steps).map(|i| expected + f64::from(i) * ROTATION_STEP_RAD).collect()
}

/// The scales to be tried, in rounds.
fn scales(free: bool) -> Vec<Vec<f64>> {
    if !free {
        return vec![vec![1.0]];
    }
    let (near, far): (Vec<i32>, Vec<i32>) = (-SCALE_STEPS..=SCALE_STEPS).partition(|steps| steps.abs() <= 1);
    [near, far].map(|steps| steps.into_iter().map(|steps| SCALE_STEP.powi(steps)).collect()).into()
}

/// The best peaks between the steps, each once.
fn refine(
    keyframe: &GroundView,
    now: &GroundView,
    peaks: &mut [Peak],
    options: &CoarseOptions,
) -> Vec<Hypothesis> {
    let noise = correlation::noise(peaks);
    peaks.sort_by(|a, b| b.value.total_cmp(&a.value));
    let mut starts: Vec<(f64, Placement)> = Vec::new();
    for start in peaks.iter().map(Placement::of) {
        if starts.len() >= PEAKS_JUDGED {
            break;
        }
        if !starts.iter().any(|(_, other)| other.near(&start, 2.0 * ROTATION_STEP_RAD)) {
            let quality =
                refinement::agreement(keyframe, now, &start, 1).map_or(0.0, |found| found.quality());
            starts.push((quality, start));
        }
    }
    starts.sort_by(|a, b| b.0.total_cmp(&a.0));
    starts.truncate(PEAKS_PER_HYPOTHESIS * options.hypotheses);
    let mut found: Vec<(Placement, Hypothesis)> = Vec::new();
    for (_, start) in starts {
        let improve = |from, effort| refinement::improve(keyframe, now, from, options.scale_free, effort);
        let improved = improve(start, ROUGH).and_then(|(roughly, _)| improve(roughly, FINE));
        let Some((placement, agreement)) = improved else { continue };
        let score = agreement.quality() / noise;
        let twin = found.iter_mut().find(|(other, _)| other.near(&placement, 0.5 * ROTATION_STEP_RAD));
        let hypothesis = placement.hypothesis(keyframe, now, &agreement, score);
        match twin {
            Some(twin) if twin.1.score < score => *twin = (placement, hypothesis),
            Some(_) => {}
            None => found.push((placement, hypothesis)),
        }
    }
    found.sort_by(|a, b| b.1.score.total_cmp(&a.1.score));
    found.into_iter().take(options.hypotheses).map(|(_, hypothesis)| hypothesis).collect()
}

#[cfg(test)]
mod tests;

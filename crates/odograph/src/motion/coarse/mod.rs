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
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use correlation::{Correlator, Peak, Turned, overlap_weights};
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
    /// tried, chance reaches about five.
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

/// Peaks of the correlation that are refined, for every hypothesis that is asked for.
const PEAKS_PER_HYPOTHESIS: usize = 4;

impl CoarseRegistration {
    /// Made ready for a camera.
    pub fn new(camera: &Camera) -> Self {
        Self { camera: camera.clone(), geometry: ViewGeometry::new(camera), correlator: Correlator::new() }
    }

    /// The ground as seen from a camera of this height and tilt; position and heading do not matter. `None` where the image shows no ground.
    pub fn view(&self, pyramid: &Pyramid, pose: &GroundPose) -> Option<GroundView> {
        self.geometry.view(&self.camera, pyramid, pose)
    }

    /// Where `now` may lie against each of `keyframes`: a list a keyframe, the best hypothesis first; empty where nothing was found.
    pub fn register(
        &self,
        keyframes: &[&GroundView],
        now: &GroundView,
        options: &CoarseOptions,
    ) -> Vec<Vec<Hypothesis>> {
        let spectra: Vec<_> = keyframes.iter().map(|keyframe| self.correlator.spectrum(keyframe)).collect();
        let mut peaks: Vec<Vec<Peak>> = vec![Vec::new(); keyframes.len()];
        for scale in scales(options.scale_free) {
            let zoom = |keyframe: &GroundView| scale * now.pixel_m / keyframe.pixel_m;
            let weights: Vec<_> = keyframes
                .iter()
                .map(|keyframe| overlap_weights(keyframe.area.min(now.area) as f64 * zoom(keyframe).min(1.0)))
                .collect();
            // Two rotations at a time: one is the real, the other the imaginary part.
            for pair in rotations(options).chunks(2) {
                let headings = [pair[0], pair[pair.len() - 1]];
                let mut turned: Option<Turned> = None;
                for (k, keyframe) in keyframes.iter().enumerate() {
                    let zoom = zoom(keyframe);
                    let again = turned.take().filter(|turned| turned.zoom == zoom);
                    let turned =
                        turned.insert(again.unwrap_or_else(|| self.correlator.turned(now, headings, zoom)));
                    peaks[k].extend(self.correlator.peaks(&spectra[k], turned, &weights[k]));
                }
            }
        }
        let refined = |(keyframe, peaks): (&&GroundView, Vec<Peak>)| refine(keyframe, now, peaks, options);
        keyframes.iter().zip(peaks).map(refined).collect()
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

fn scales(free: bool) -> Vec<f64> {
    let steps = if free { SCALE_STEPS } else { 0 };
    (-steps..=steps).map(|i| SCALE_STEP.powi(i)).collect()
}

/// The best peaks between the steps, each once.
fn refine(
    keyframe: &GroundView,
    now: &GroundView,
    mut peaks: Vec<Peak>,
    options: &CoarseOptions,
) -> Vec<Hypothesis> {
    let noise = correlation::noise(&peaks);
    peaks.sort_by(|a, b| b.value.total_cmp(&a.value));
    let mut starts: Vec<Placement> = Vec::new();
    for peak in &peaks {
        if starts.len() >= PEAKS_PER_HYPOTHESIS * options.hypotheses {
            break;
        }
        let start = Placement::of(peak);
        if !starts.iter().any(|other| other.near(&start, 2.0 * ROTATION_STEP_RAD)) {
            starts.push(start);
        }
    }
    let mut found: Vec<(Placement, Hypothesis)> = Vec::new();
    for start in starts {
        let Some((placement, agreement)) = refinement::improve(keyframe, now, start, options.scale_free)
        else {
            continue;
        };
        let score = agreement.correlation * (agreement.samples as f64).sqrt() / noise;
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

//! The readout time of a camera of which nothing is known, while it is followed.
//!
//! Rows that are read one after another skew an image in proportion to the rates of the camera, and
//! its keyframe's image to those at that time. Windows of frames in which the rates change show the
//! readout time; at a constant velocity it is no different from another speed. Derivation:
//! `docs/math/rolling-shutter.md`.

use super::frames::{FrameReader, Read, WindowFrame, unit};
use super::window::{Ground, Window};
use crate::camera::Camera;
use crate::motion::{MeasuredMotion, PoseRates, Readout};
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use std::collections::HashMap;

/// Frames that are adjusted together, and tracks of each that are used.
const FRAMES: usize = 40;
const TRACKS: usize = 80;

/// Frames of the first windows of a live camera. Twelve from a standstill showed 10 and 20 ms to
/// 0.1 ms; over tiles with a moving shadow they state 0.6 ms.
const LIVE_FRAMES: [usize; 2] = [12, 24];

/// A first window ends early if the skew of a frame could differ from its keyframe's by this much,
/// pixels: from there on, corners that happen to agree with a global shutter are followed instead
/// of the others. With a readout of 28 ms that skewed images by 16 %, forty frames from a
/// standstill gave 11.9 ± 0.2 and 15.6 ± 0.2 ms, the first twelve 26.6 and 25.8 ± 0.3. Chosen on
/// these two drives; at 0.5 m/s and a height of 0.75 m it is 2.5 pixels.
const MISLEADING_PX: f64 = 3.5;

/// Fewer frames are not adjusted. Not derived; chosen.
const LEAST_FRAMES: usize = 12;

/// Frames further apart than this, seconds, show nothing of the rates within them: stills. Not
/// derived; chosen.
const LONGEST_FRAME_S: f64 = 0.25;

/// Iterations of Gauss–Newton from a global shutter, at most: poses that were fitted to images with
/// a skew of 15 % as if there were none take 30.
const ITERATIONS: usize = 40;

/// A window is adjusted if the skew of a frame could differ from its keyframe's by this much,
/// pixels.
const NOTICEABLE_PX: f64 = 0.5;

/// Windows of a drive are off by some times what the noise of the tracks explains: their errors are
/// correlated. Measured on rendered drives over flat ground, gravel and undulations: 1 to 8 times.
const CORRELATED: f64 = 5.0;

/// Standard deviations from zero of a shutter that rolls …
const SIGNIFICANT: f64 = 5.0;

/// … the least readout time, seconds: 0.3 ms at 1 m/s and 0.75 m is 0.2 px …
const LEAST_ROLLING_S: f64 = 3e-4;

/// … and the part by which it lowers the logarithm of the residuals, at least. Measured over flat
/// ground, gravel, undulations and tiles: 0.11 to 2.3 with a readout of 10 or 20 ms; at most 0.016
/// where a global shutter seemed to roll significantly.
const LEAST_GAIN: f64 = 0.05;

/// A readout time is known if its standard deviation is less than this part of it; a shutter is
/// taken for a global one where that is less than this, seconds: at 0.5 m/s over a view of 0.5 m it
/// makes distances uncertain by 0.1 %.
const SURE: f64 = 0.15;
const GLOBAL_WITHIN_S: f64 = 1e-3;

/// Estimates the readout time while [`Odometry`] takes the shutter for a global one.
#[derive(Debug, Clone)]
pub struct ReadoutEstimation {
    camera: Camera,
    is_live: bool,
    reader: FrameReader,
    frames: Vec<WindowFrame>,
    /// The window that shows most among those since the last adjustment, and how much.
    best: Option<(f64, Vec<WindowFrame>)>,
    /// Windows in which the rates changed.
    windows: usize,
    /// Readout times of the adjusted windows, and their variances.
    adjusted: Vec<(f64, f64)>,
}

impl ReadoutEstimation {
    /// `None` of a camera whose readout time is given.
    pub fn new(camera: &Camera) -> Option<Self> {
        camera.readout_s().is_none().then(|| Self {
            camera: camera.clone(),
            is_live: false,
            reader: FrameReader::new(TRACKS),
            frames: Vec::new(),
            best: None,
            windows: 0,
            adjusted: Vec::new(),
        })
    }

    /// The same with short windows at first, which show less, and show it sooner.
    pub fn live(self) -> Self {
        Self { is_live: true, ..self }
    }

    /// Takes the next frame, the result of [`Odometry::process`], and its tracks. The readout time
    /// as soon as it is known.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<Readout> {
        if self.collect(frame, odometry) { self.adjust() } else { None }
    }

    /// Takes the next frame; whether the readout time is to be adjusted now. Each time twice as
    /// many windows have passed as before, so that the cost for each frame decreases.
    pub fn collect(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> bool {
        match self.reader.read(frame, odometry) {
            Read::Frame(frame) => {
                let is_later = self.frames.last().is_none_or(|last| last.time_s < frame.time_s);
                let ends = !is_later && self.end_window();
                self.frames.push(frame);
                ends || (self.is_window() && self.end_window())
            }
            Read::Untracked => false,
            Read::Gap => self.end_window(),
        }
    }

    /// Whether the frames make a window.
    fn is_window(&self) -> bool {
        let full = LIVE_FRAMES.get(self.windows).filter(|_| self.is_live).copied().unwrap_or(FRAMES);
        let is_misleading = || {
            let is_first = self.windows == 0 && self.frames.len() >= LEAST_FRAMES;
            is_first && skew_px(&self.camera, &self.frames).0 > MISLEADING_PX
        };
        self.frames.len() >= full || is_misleading()
    }

    /// Whether an adjustment is due with this window.
    fn end_window(&mut self) -> bool {
        let frames = std::mem::take(&mut self.frames);
        let (most_px, sum_px2) = skew_px(&self.camera, &frames);
        if frames.len() < LEAST_FRAMES || frame_s(&frames) > LONGEST_FRAME_S || most_px < NOTICEABLE_PX {
            return false;
        }
        if self.best.as_ref().is_none_or(|(best_px2, _)| *best_px2 < sum_px2) {
            self.best = Some((sum_px2, frames));
        }
        self.windows += 1;
        self.windows.is_power_of_two()
    }

    /// Adjusts the best window. The readout time where it is known then.
    pub fn adjust(&mut self) -> Option<Readout> {
        let (_, frames) = self.best.take()?;
        self.adjusted.extend(of_window(&self.camera, &frames));
        self.known()
    }

    /// Number of frames of the best window.
    pub fn frames_to_adjust(&self) -> usize {
        self.best.as_ref().map_or(0, |(_, frames)| frames.len())
    }

    /// A copy that adjusts the best window, for another thread.
    pub fn take_window(&mut self) -> Self {
        Self { best: self.best.take(), ..self.clone() }
    }

    /// Takes over what that copy has adjusted.
    pub fn take_adjusted(&mut self, copy: Self) {
        self.adjusted = copy.adjusted;
    }

    /// The same at the end of a recording, however short.
    pub fn at_end(&self) -> Option<Readout> {
        let mut whole = self.clone();
        whole.end_window();
        whole.adjust()
    }

    /// The mean of the windows where that is certain.
    fn known(&self) -> Option<Readout> {
        let Readout { mean_s, variance_s2 } = weighted_mean(&self.adjusted, CORRELATED)?;
        let deviation_s = variance_s2.sqrt();
        let rolls = mean_s.abs() > LEAST_ROLLING_S.max(SIGNIFICANT * deviation_s);
        if rolls {
            (deviation_s < SURE * mean_s.abs()).then_some(Readout { mean_s, variance_s2 })
        } else {
            let of_zero_s = deviation_s.hypot(mean_s);
            (of_zero_s < GLOBAL_WITHIN_S)
                .then_some(Readout { mean_s: 0.0, variance_s2: of_zero_s * of_zero_s })
        }
    }
}

/// The mean of readout times with variances, which are at least `factor`² times as large as they
/// state, and larger where the readout times differ by more; `None` of none.
pub fn weighted_mean(readouts: &[(f64, f64)], factor: f64) -> Option<Readout> {
    let weights = || readouts.iter().map(|&(readout_s, variance_s2)| (readout_s, 1.0 / variance_s2));
    let total: f64 = weights().map(|(_, weight)| weight).sum();
    let mean_s = weights().map(|(readout_s, weight)| weight * readout_s).sum::<f64>() / total;
    let squares: f64 = weights().map(|(readout_s, weight)| weight * (readout_s - mean_s).powi(2)).sum();
    let scatter = squares / readouts.len().saturating_sub(1).max(1) as f64;
    let variance_s2 = scatter.max(factor * factor) / total;
    variance_s2.is_finite().then_some(Readout { mean_s, variance_s2 })
}

/// The readout time of a window and its variance. Where a rolling shutter seems significant, but
/// explains the tracks no better than a global one does, or is impossible, something else is in the
/// tracks, which has at least that effect.
pub fn of_window(camera: &Camera, frames: &[WindowFrame]) -> Option<(f64, f64)> {
    let adjusted = |deviation_s: f64, ground: Ground| {
        let readout = Readout { mean_s: 0.0, variance_s2: deviation_s * deviation_s };
        Window::adjusted(camera, readout, frames, &MeasuredMotion::default(), ground, ITERATIONS)
    };
    // Elevations that begin at zero may stop in a local minimum, those of the odometry may have
    // absorbed the skew.
    let of_ground = |ground| Some((ground, adjusted(Readout::UNKNOWN_S, ground)?));
    let (ground, rolling) = [Ground::Uneven, Ground::AsTracked]
        .into_iter()
        .filter_map(of_ground)
        .min_by(|a, b| a.1.sigma_px.total_cmp(&b.1.sigma_px))?;
    let (readout_s, variance_s2) = (rolling.readout_s, rolling.readout_variance_s2());
    let is_significant =
        readout_s.abs() > LEAST_ROLLING_S && readout_s * readout_s > SIGNIFICANT.powi(2) * variance_s2;
    if is_significant
        && (gain(&adjusted(0.0, ground)?, &rolling) < LEAST_GAIN || readout_s.abs() > frame_s(frames))
    {
        let off_s = readout_s / CORRELATED;
        return Some((readout_s, variance_s2 + off_s * off_s));
    }
    Some((readout_s, variance_s2))
}

/// By how much a window lowers the logarithm of the residuals of another one.
fn gain(before: &Window<'_>, after: &Window<'_>) -> f64 {
    (before.sigma_px / after.sigma_px).ln()
}

/// The mean time between two frames, seconds.
fn frame_s(frames: &[WindowFrame]) -> f64 {
    (frames[frames.len() - 1].time_s - frames[0].time_s) / (frames.len() - 1) as f64
}

/// How far the skew of frames may differ from that of their keyframes, with an unknown readout
/// time: the largest difference, pixels, and the sum of squares.
fn skew_px(camera: &Camera, frames: &[WindowFrame]) -> (f64, f64) {
    let rates = |index: usize| -> Option<PoseRates> {
        let before = &frames[index.saturating_sub(1)];
        let after = frames.get(index + 1).unwrap_or(&frames[index]);
        let step_s = after.time_s - before.time_s;
        (step_s > 0.0).then(|| (after.pose - before.pose) / step_s)
    };
    let number: HashMap<u64, usize> =
        frames.iter().enumerate().map(|(index, frame)| (frame.time_s.to_bits(), index)).collect();
    let skew = |(index, frame): (usize, &WindowFrame)| {
        let (keyframe_s, _) = frame.keyframe?;
        let change = rates(index)? - rates(*number.get(&keyframe_s.to_bits())?)?;
        let height_m = frame.pose[3];
        let heights = PoseRates::from_fn(|i, _| change[i] / unit(i, height_m));
        Some(0.5 * Readout::UNKNOWN_S * camera.focal_px().0 * heights.norm())
    };
    frames
        .iter()
        .enumerate()
        .filter_map(skew)
        .fold((0.0, 0.0), |(most, sum), skew_px| (f64::max(most, skew_px), sum + skew_px * skew_px))
}

//! The profile likelihood of the readout time: the beginning of a recording is tracked with several
//! readout times, and that which leaves the smallest residuals is right.
//! Derivation: `docs/math/rolling-shutter.md`.
//!
//! Over uneven ground slopes look like the skew of an image, so that neither the rows of single
//! frames nor pairs of views determine the readout time. Elevations, slopes and keyframes of a
//! whole drive together do.

use crate::geometry::GroundPose;
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;

/// Readout times that were tried, each with the mean log residual of the frames in motion.
#[derive(Debug, Clone)]
pub struct ReadoutProfile {
    /// Frames that are tracked with each.
    frames: u64,
    /// The longest readout time that is possible, seconds.
    longest_s: f64,
    /// Sorted by readout time.
    tried: Vec<(f64, f64)>,
    /// Weights of the frames, from the first trial on.
    weights: Vec<f64>,
}

/// The readout time decides over distances after a path of this many heights; before, there is
/// little to tell readout times apart by.
const PATH_HEIGHTS: f64 = 12.0;

/// Largest standard deviation of a known readout time, seconds: at 0.5 m/s over a view of 0.5 m it
/// makes distances uncertain by 0.1 %. It needs no profile.
pub const KNOWN_READOUT_S: f64 = 1e-3;

/// A shutter is taken to roll if that lowers the mean log residual by this. Measured over gravel,
/// undulations and shaken grass (`docs/math/rolling-shutter.md`): 0.6 to 1.9 with a readout of
/// 20 ms, at most 0.04 with a global shutter.
const LEAST_GAIN: f64 = 0.1;

/// By this much the mean log residual changes by chance: half of the most that a global shutter has
/// gained over such ground by a readout time that it does not have.
const CHANCE_GAIN: f64 = 0.02;

/// Frames are seldom longer apart than a readout takes where they are this far apart, seconds.
const LONGEST_FRAME_S: f64 = 1.0 / 30.0;

/// In place of zero, so that frames are fitted with the same unknowns as with the others, seconds.
const ALMOST_GLOBAL_S: f64 = 1e-4;

/// Frames whose skew differs from their keyframe's by less than this, pixels, even with the longest
/// readout time, contain little information about it: at a constant velocity it cannot be
/// distinguished from another height of the ground.
/// Chosen on drives that are shown in `docs/math/rolling-shutter.md`.
const NOTICEABLE_PX: f64 = 0.5;

/// Number of frames that must differ by more. Not derived; chosen.
const LEAST_WEIGHT: f64 = 5.0;

/// Distances between readout times that are tried, first and at last, parts of the longest.
const COARSE: f64 = 0.25;
const FINE: f64 = 0.125;

/// Longest readout time that is tried, a part of the time between frames.
const LONGEST: f64 = 0.95;

impl ReadoutProfile {
    fn new(frames: u64, frame_s: f64) -> Self {
        Self { frames, longest_s: frame_s.min(LONGEST_FRAME_S), tried: Vec::new(), weights: Vec::new() }
    }

    /// The readout time to try next, seconds; `None` when the profile is complete.
    pub fn next_s(&self) -> Option<f64> {
        if self.is_blind() {
            return None;
        }
        let (coarse_s, fine_s) = (COARSE * self.longest_s, FINE * self.longest_s);
        let first = [ALMOST_GLOBAL_S, coarse_s, 2.0 * coarse_s];
        if let Some(next) = first.into_iter().find(|&readout_s| !self.has(readout_s)) {
            return Some(next);
        }
        let (best_s, _) = self.best();
        let longer_s = best_s + coarse_s;
        let is_longest = self.tried.last().is_some_and(|(longest_s, _)| *longest_s == best_s);
        if !self.rolls() {
            None
        } else if is_longest && longer_s < LONGEST * self.longest_s {
            Some(longer_s)
        } else {
            let near = [best_s - fine_s, best_s + fine_s];
            near.into_iter().find(|&near_s| near_s < LONGEST * self.longest_s && !self.has(near_s))
        }
    }

    /// Standard deviation of a readout time of which nothing is known, seconds.
    pub fn unknown_s(&self) -> f64 {
        0.5 * self.longest_s
    }

    fn has(&self, readout_s: f64) -> bool {
        self.tried.iter().any(|(tried_s, _)| (tried_s - readout_s).abs() < 1e-9)
    }

    /// Takes the trial of the readout time that was to be tried. The first one determines the
    /// weight of each frame in all of them.
    pub fn take(&mut self, trial: ReadoutTrial) {
        let log_residual = trial.mean_log_residual();
        self.weights = trial.weights;
        self.add(log_residual);
    }

    /// Whether the first trial showed that too few frames would tell readout times apart.
    fn is_blind(&self) -> bool {
        !self.tried.is_empty() && self.weights.iter().sum::<f64>() < LEAST_WEIGHT
    }

    fn add(&mut self, log_residual: f64) {
        if let Some(readout_s) = self.next_s() {
            self.tried.push((readout_s, log_residual));
            self.tried.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
    }

    fn best(&self) -> (f64, f64) {
        self.tried.iter().copied().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or_default()
    }

    fn rolls(&self) -> bool {
        let global = self.tried.first().map_or(0.0, |(_, log_residual)| *log_residual);
        global - self.best().1 > LEAST_GAIN
    }

    /// The readout time with the least residual, by the parabola through the best and its
    /// neighbours, and its standard deviation, seconds: zero where a global shutter explains the
    /// recording about as well, with a deviation that covers the vertex.
    pub fn measured(&self) -> (f64, f64) {
        let rolls = self.rolls();
        let best = self.tried.iter().position(|tried| rolls && *tried == self.best()).unwrap_or(0);
        let middle = best.clamp(1, self.tried.len().saturating_sub(2).max(1));
        let Some(&[(a, of_a), (b, of_b), (c, of_c)]) = self.tried.get(middle - 1..middle + 2) else {
            return (0.0, self.unknown_s());
        };
        let (before, after) = ((of_b - of_a) / (b - a), (of_c - of_b) / (c - b));
        let half_curvature = (after - before) / (c - a);
        let vertex_s = 0.5 * (a + b) - 0.5 * before / half_curvature;
        let is_convex = half_curvature > 0.0;
        let readout_s = match rolls {
            true if is_convex => vertex_s.clamp(a, c),
            true => self.best().0,
            false => 0.0,
        };
        let deviation_s = if is_convex { (CHANCE_GAIN / half_curvature).sqrt() } else { f64::INFINITY };
        // A vertex that is not believed may be right all the same.
        let disbelieved_s = if rolls { 0.0 } else { vertex_s };
        (readout_s, deviation_s.hypot(disbelieved_s).min(self.unknown_s()))
    }
}

/// Recognises a recording over uneven ground whose readout time remains unknown.
#[derive(Debug, Clone, Default)]
pub struct UnknownReadout {
    path: MovingFrames,
    first_s: Option<f64>,
    last_s: f64,
    frames: u64,
    is_unknown: bool,
    is_uneven: bool,
    /// Whether it was unknown while the ground was seen to be uneven.
    was_unknown: bool,
}

impl UnknownReadout {
    /// Takes the next frame. Returns the empty profile that is to be filled once the path is long
    /// enough for it.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<ReadoutProfile> {
        self.first_s.get_or_insert(frame.time_s);
        self.last_s = frame.time_s;
        self.frames += 1;
        self.path.add(frame, 1.0);
        let readout = odometry.readout().filter(|_| odometry.readout_matters());
        self.is_uneven |= odometry.sees_relief();
        let is_unknown = readout.is_some_and(|readout| readout.variance_s2 > KNOWN_READOUT_S.powi(2));
        self.was_unknown |= is_unknown && odometry.sees_relief();
        // What rows show of a rolling shutter over uneven ground is not believed, whatever
        // deviation they state.
        let rolls = readout.is_some_and(|readout| readout.mean_s != 0.0);
        self.is_unknown = is_unknown || (self.was_unknown && rolls);
        if self.path.heights > PATH_HEIGHTS { self.at_end() } else { None }
    }

    /// The same at the end of the recording, however short.
    pub fn at_end(&self) -> Option<ReadoutProfile> {
        let duration_s = self.last_s - self.first_s?;
        let frame_s = duration_s / self.frames.saturating_sub(1).max(1) as f64;
        (self.is_unknown && self.is_uneven && frame_s > 0.0)
            .then(|| ReadoutProfile::new(self.frames, frame_s))
    }
}

/// The residuals of the frames with one readout time.
#[derive(Debug, Clone)]
pub struct ReadoutTrial {
    frames_left: u64,
    longest_s: f64,
    /// Whether no trial before has determined the weights.
    is_first: bool,
    /// Weights of the frames.
    weights: Vec<f64>,
    frames: usize,
    moving: MovingFrames,
}

impl ReadoutTrial {
    /// Of the next readout time of a profile.
    pub fn of(profile: &ReadoutProfile) -> Self {
        Self {
            frames_left: profile.frames,
            longest_s: profile.longest_s,
            is_first: profile.tried.is_empty(),
            weights: profile.weights.clone(),
            frames: 0,
            moving: MovingFrames::default(),
        }
    }

    /// Takes the next frame; true after the last one of the trial.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> bool {
        if self.is_first {
            let squared = odometry.skew_since_keyframe_px(self.longest_s).powi(2);
            self.weights.push(squared / (squared + NOTICEABLE_PX * NOTICEABLE_PX));
        }
        self.moving.add(frame, self.weights.get(self.frames).copied().unwrap_or_default());
        self.frames += 1;
        self.frames_left = self.frames_left.saturating_sub(1);
        self.frames_left == 0
    }

    /// The mean log residual of the frames so far, each with its weight.
    fn mean_log_residual(&self) -> f64 {
        self.moving.log_residuals / self.moving.weight.max(f64::MIN_POSITIVE)
    }
}

/// Frames in motion, and those in which the ground was lost.
#[derive(Debug, Clone, Default)]
struct MovingFrames {
    last: Option<GroundPose>,
    heights: f64,
    weight: f64,
    log_residuals: f64,
}

/// Steps below this, parts of the height and radians, are those of a camera at rest.
const LEAST_STEP: f64 = 1e-3;

/// Residual of a frame in which the ground was lost, pixels: about the largest of an inlier.
const LOST_PX: f64 = 1.0;

/// Residuals below this, pixels, differ by the noise of the image alone.
const LEAST_RESIDUAL_PX: f64 = 5e-3;

impl MovingFrames {
    fn add(&mut self, frame: &FrameEstimate, weight: f64) {
        let pose = frame.ground_pose();
        let step = pose.zip(self.last).map(|(to, from)| {
            let moved = (to.x_m - from.x_m).hypot(to.y_m - from.y_m) / to.height_m;
            (moved, (to.heading_rad - from.heading_rad).abs())
        });
        let residual_px = match step {
            Some((moved, turned)) if moved + turned > LEAST_STEP => {
                Some(frame.residual_px.max(LEAST_RESIDUAL_PX))
            }
            None if frame.estimate.is_none() => Some(LOST_PX),
            _ => None,
        };
        if let Some(residual_px) = residual_px {
            self.weight += weight;
            self.log_residuals += weight * residual_px.ln();
        }
        self.heights += step.map_or(0.0, |(moved, _)| moved);
        self.last = pose;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The readout time that a profile finds where residuals are those of `log_residual`, and the
    /// number of trials.
    fn found(log_residual: impl Fn(f64) -> f64) -> ((f64, f64), usize) {
        let mut profile = ReadoutProfile::new(200, 1.0 / 30.0);
        profile.weights = vec![1.0; 200];
        while let Some(readout_s) = profile.next_s() {
            profile.add(log_residual(1e3 * readout_s));
        }
        (profile.measured(), profile.tried.len())
    }

    #[test]
    fn the_readout_time_with_the_least_residual_is_found() {
        for true_ms in [5.0, 12.0, 20.0, 27.0] {
            let (found, trials) = found(|ms| 1e-2 * (ms - true_ms) * (ms - true_ms) - 3.0);
            let off_ms = 1e3 * found.0 - true_ms;
            assert!(off_ms.abs() < 1.0 && trials <= 7, "{true_ms}: {found:?} after {trials}");
            assert!(found.1 < 2e-3, "{found:?}");
        }
    }

    #[test]
    fn a_gain_by_chance_is_no_rolling_shutter() {
        let (found, trials) = found(|ms| if ms > 8.0 && ms < 9.0 { -3.02 } else { -3.0 + 1e-4 * ms * ms });
        assert_eq!((found.0, trials), (0.0, 3));
        assert!(found.1 > 1e-3, "{found:?}");
    }

    #[test]
    fn the_deviation_of_a_global_shutter_covers_a_vertex_that_gains_too_little() {
        let (found, _) = found(|ms| 1e-3 * (ms - 5.0) * (ms - 5.0) - 3.0);
        assert!(found.0 == 0.0 && found.1 > 5e-3, "{found:?}");
    }
}

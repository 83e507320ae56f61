//! How fast the camera moved while its images were read out: derivatives of the poses by time.

use crate::keyframe::KeyframeId;
use crate::motion::PoseRates;
use crate::trajectory::FrameEstimate;
use nalgebra::Vector6;
use std::collections::{HashMap, VecDeque};

/// A pose, its rates and its accelerations.
#[derive(Debug, Clone, Copy)]
pub struct Moving {
    pub pose: Vector6<f64>,
    pub rates: PoseRates,
    pub accelerations: PoseRates,
}

/// Poses that an interpolating polynomial goes through. Of a vibration of 7 Hz at 30 frames a
/// second its derivative keeps 95 %; the central difference of three poses keeps 68 %.
const POSES: usize = 7;

/// Poses about the first and last ones of a part: a higher polynomial has wild derivatives there.
const POSES_AT_ENDS: usize = 3;

/// Rates of the last frames and of every keyframe.
#[derive(Debug, Clone, Default)]
pub struct RateHistory {
    frames: u64,
    /// Frame count, time and pose of the last frames without a gap.
    poses: VecDeque<(u64, f64, Vector6<f64>)>,
    /// Frames whose rates are known, as many as [`POSES`].
    moving: VecDeque<(u64, Moving)>,
    /// The frame count of every keyframe.
    made: HashMap<KeyframeId, u64>,
    keyframes: HashMap<KeyframeId, Moving>,
}

impl RateHistory {
    /// Takes a frame, which was measured against a keyframe. Gives its count.
    pub fn push(&mut self, frame: &FrameEstimate, keyframe: Option<KeyframeId>) -> u64 {
        self.frames += 1;
        let count = self.frames;
        let Some(estimate) = &frame.estimate else {
            self.poses.clear();
            return count;
        };
        let pose = estimate.measured_pose().to_vector();
        if self.poses.back().is_some_and(|(_, time_s, _)| frame.time_s <= *time_s) {
            self.poses.clear();
        }
        self.poses.push_back((count, frame.time_s, pose));
        if let Some(keyframe) = keyframe {
            // The first frame measured against a keyframe follows it, except the very first, which
            // is measured against itself.
            let made = if self.made.is_empty() { count } else { count - 1 };
            self.made.entry(keyframe).or_insert(made);
        }
        if self.poses.len() == POSES {
            let first = self.moving.back().is_none_or(|(last, _)| *last + 1 < self.poses[POSES / 2].0);
            for index in if first { 0 } else { POSES / 2 }..=POSES / 2 {
                self.differentiate(index);
            }
            self.poses.pop_front();
        }
        count
    }

    /// How the camera moved in a frame; `None` where they are not known, or not any more.
    pub fn of_frame(&self, count: u64) -> Option<Moving> {
        self.moving.iter().find(|(of, _)| *of == count).map(|(_, moving)| *moving)
    }

    /// Whether the rates of a frame are known, or never will be.
    pub fn is_decided(&self, count: u64) -> bool {
        self.poses.front().is_none_or(|(first, ..)| *first > count) || self.of_frame(count).is_some()
    }

    /// How the camera moved in a keyframe.
    pub fn of_keyframe(&self, keyframe: KeyframeId) -> Option<Moving> {
        self.keyframes.get(&keyframe).copied()
    }

    fn differentiate(&mut self, index: usize) {
        let nodes = if index + POSES_AT_ENDS / 2 < POSES / 2 { POSES_AT_ENDS } else { POSES };
        let from = index.saturating_sub(nodes / 2).min(POSES - nodes);
        let times: Vec<f64> = self.poses.range(from..from + nodes).map(|(_, time_s, _)| *time_s).collect();
        let (count, _, pose) = self.poses[index];
        let poses = || self.poses.range(from..from + nodes).map(|(_, _, pose)| pose);
        let slope =
            |at: usize| -> PoseRates { poses().zip(derivative(&times, at)).map(|(p, w)| p * w).sum() };
        // The slopes are values of a polynomial, too.
        let accelerations =
            derivative(&times, index - from).iter().enumerate().map(|(k, w)| slope(k) * *w).sum();
        let moving = Moving { pose, rates: slope(index - from), accelerations };
        for keyframe in self.made.iter().filter(|(_, made)| **made == count).map(|(id, _)| *id) {
            self.keyframes.insert(keyframe, moving);
        }
        self.moving.push_back((count, moving));
        while self.moving.len() > POSES {
            self.moving.pop_front();
        }
    }
}

/// Weights of values at some times in the derivative, at one of those times, of the polynomial
/// through all of them (Lagrange).
fn derivative(times: &[f64], at: usize) -> Vec<f64> {
    let t = |i: usize| times[i];
    let others = |i: usize| (0..times.len()).filter(move |&k| k != i);
    let weight = |i: usize| match i == at {
        true => others(at).map(|k| 1.0 / (t(at) - t(k))).sum(),
        false => {
            let product: f64 =
                others(i).filter(|&k| k != at).map(|k| (t(at) - t(k)) / (t(i) - t(k))).product();
            product / (t(i) - t(at))
        }
    };
    (0..times.len()).map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivative_of_a_polynomial_is_exact() {
        let times = [0.0, 0.1, 0.25, 0.3, 0.5, 0.55, 0.7];
        let cubic = |t: f64| 1.0 - 2.0 * t + 3.0 * t * t - 4.0 * t * t * t;
        for at in 0..times.len() {
            let t = times[at];
            let found: f64 = derivative(&times, at).iter().zip(&times).map(|(w, &t)| w * cubic(t)).sum();
            assert!((found - (-2.0 + 6.0 * t - 12.0 * t * t)).abs() < 1e-9, "{at}: {found}");
        }
    }
}

//! Bundle adjustment of pairs of views: common unknowns are the tilt and the lens; each pair has a
//! planar motion of its own.

mod lens;
mod pair;
mod variation;
mod system;

use super::Group;
use crate::camera::{Camera, Rig};
use crate::geometry::GroundPose;
use crate::numerics::{Combined, Part, combine_with, inverse};
pub use lens::LensUnknowns;
use nalgebra::{SVector, Vector2};
use pair::SolvedPair;
use std::ops::AddAssign;
use system::System;
use variation::{KeyframeVariation, PairVariation};

/// The solution and the normal equations of each keyframe: the tilt and `N` − 2 distortion
/// parameters.
pub struct Solved<const N: usize> {
    pub roll_rad: f64,
    pub pitch_rad: f64,
    /// The change of each distortion parameter.
    pub lens_change: Vec<f64>,
    pub parts: Vec<Part<N>>,
    /// What is known of them without any keyframe.
    pub prior: Part<N>,
    pub pairs: usize,
    pub rms_px: f64,
}

/// Largest number of Gauss–Newton iterations; from 10° off, six are needed.
const MAX_ITERATIONS: usize = 30;

/// Convergence threshold of a step, radians or distortion parameters: a thousandth of the standard
/// deviation.
const CONVERGED: f64 = 1e-8;

/// Iterations with robust weights; after them the remaining inliers have weight 1, so that the last
/// iterations are plain least squares.
const ROBUST_ITERATIONS: usize = 15;

/// A camera tilted further than this is not accepted as a mount (`Rig::validated`).
const MAX_TILT_RAD: f64 = 1.3;

/// A pair with fewer inliers is not used.
const MIN_INLIERS: f64 = 12.0;

/// Roll and pitch are the first common unknowns.
pub const TILT: usize = 2;
/// Number of common unknowns without the lens.
pub const LENS_START: usize = TILT;

pub fn solve<'a, const N: usize>(
    (camera, lens_change): (&Camera, &[f64]),
    groups: impl ExactSizeIterator<Item = &'a Group>,
    start: &Rig,
) -> Option<Solved<N>> {
    let mut lens = LensUnknowns::new(camera, N.saturating_sub(LENS_START))?;
    lens.add_change(lens_change)?;
    let mut bundle = PairBundle::<N>::begin(lens, groups, start)?;
    for iteration in 0..MAX_ITERATIONS {
        let step = bundle.step(iteration)?;
        if iteration > ROBUST_ITERATIONS && step.norm() < CONVERGED {
            break;
        }
    }
    Some(bundle.solved())
}

/// All unknowns.
struct PairBundle<'a, const N: usize> {
    tilt: Vector2<f64>,
    lens: LensUnknowns,
    pairs: Vec<SolvedPair<'a>>,
    pair_variation: PairVariation,
    /// Tilt of each keyframe against the mount.
    keyframe_tilts: Vec<Vector2<f64>>,
    keyframe_variation: KeyframeVariation,
}

impl<'a, const N: usize> PairBundle<'a, N> {
    fn begin(
        lens: LensUnknowns,
        groups: impl ExactSizeIterator<Item = &'a Group>,
        start: &Rig,
    ) -> Option<Self> {
        let tilt = Vector2::new(start.roll_rad, start.pitch_rad);
        let keyframe_tilts = vec![Vector2::zeros(); groups.len()];
        let pairs = groups
            .enumerate()
            .flat_map(|(group, pairs)| pairs.pairs.iter().map(move |pair| (group, pair)))
            .filter_map(|(group, pair)| SolvedPair::begin(&lens, group, pair, &first_pose(&tilt)))
            .collect();
        Some(Self {
            tilt,
            lens,
            pairs,
            pair_variation: PairVariation::default(),
            keyframe_tilts,
            keyframe_variation: KeyframeVariation::default(),
        })
    }

    /// The pose of the first view of a pair.
    fn first_pose(&self, pair: &SolvedPair<'_>) -> GroundPose {
        first_pose(&(self.tilt + self.keyframe_tilts[pair.group]))
    }

    fn systems(&self) -> Vec<System<N>> {
        let system = |pair: &SolvedPair<'_>| {
            System::new(&self.lens, pair, &self.first_pose(pair), &self.pair_variation.variance)
        };
        self.pairs.iter().map(system).collect()
    }

    /// Normal equations of each keyframe at the present estimate.
    fn parts(&self, systems: &[System<N>]) -> Vec<Part<N>> {
        let mut parts = vec![Part::default(); self.keyframe_tilts.len()];
        for (pair, system) in self.pairs.iter().zip(systems) {
            if let Some(reduced) = system.reduced() {
                parts[pair.group] += reduced;
            }
        }
        parts
    }

    /// One Gauss–Newton step; `None` if it has no valid result.
    fn step(&mut self, iteration: usize) -> Option<SVector<f64, N>> {
        let systems = self.systems();
        let parts = self.parts(&systems);
        let mut all = self.lens.prior();
        for (part, keyframe_tilt) in parts.iter().zip(&self.keyframe_tilts) {
            all += self.keyframe_variation.marginalised(part, keyframe_tilt)?.reduced;
        }
        let step = inverse(&all.information)? * all.slope;
        self.tilt += step.fixed_rows::<TILT>(0);
        if self.tilt.iter().any(|angle| angle.is_nan() || angle.abs() >= MAX_TILT_RAD) {
            return None;
        }
        self.lens.add_change(&step.as_slice()[LENS_START..])?;
        let mut steps = Vec::with_capacity(parts.len());
        let mut variances = Vec::with_capacity(parts.len());
        for (part, keyframe_tilt) in parts.iter().zip(&mut self.keyframe_tilts) {
            let marginal = self.keyframe_variation.marginalised(part, keyframe_tilt)?;
            let own = marginal.step(part, &step);
            *keyframe_tilt += own;
            let mut together = step;
            together.fixed_rows_mut::<TILT>(0).add_assign(&own);
            steps.push(together);
            variances.push(marginal.covariance.diagonal());
        }
        let poses: Vec<GroundPose> = self.pairs.iter().map(|pair| self.first_pose(pair)).collect();
        for ((pair, system), pose) in self.pairs.iter_mut().zip(&systems).zip(&poses) {
            if let Some(step) = system.movement_step(&steps[pair.group]) {
                pair.movement += step;
            }
            if N > LENS_START {
                pair.update_rays(&self.lens);
            }
            pair.reweight(self.lens.camera(), pose, iteration);
        }
        // The first steps are long; their residuals say nothing about the mount's variation.
        if iteration >= 2 {
            self.pair_variation.update(&self.pairs, &systems);
            self.keyframe_variation.update(&self.keyframe_tilts, &variances);
        }
        Some(step)
    }

    fn solved(self) -> Solved<N> {
        let mut parts = vec![Part::default(); self.keyframe_tilts.len()];
        let (mut squares, mut kept, mut pairs) = (0.0, 0.0, 0);
        for (pair, system) in self.pairs.iter().zip(&self.systems()) {
            let weight: f64 = pair.weights.iter().sum();
            let Some(reduced) = system.reduced().filter(|_| weight >= MIN_INLIERS) else { continue };
            // The equations are about the tilt of the keyframe, which differs from that of the
            // mount.
            parts[pair.group] += reduced.about(&-self.keyframe_tilts[pair.group]);
            squares += pair.coordinates() * pair.variance_px2;
            kept += weight;
            pairs += 1;
        }
        parts.retain(|part| part.information.trace() > 0.0);
        Solved {
            roll_rad: self.tilt[0],
            pitch_rad: self.tilt[1],
            lens_change: self.lens.change().to_vec(),
            parts,
            prior: self.lens.prior(),
            pairs,
            rms_px: (squares / f64::max(kept, 1.0)).sqrt(),
        }
    }
}

impl<const N: usize> Part<N> {
    /// The same equations about a point with another tilt, shifted by this much.
    fn about(self, further: &Vector2<f64>) -> Self {
        let slope = self.slope - self.information.fixed_columns::<TILT>(0) * further;
        Self { slope, ..self }
    }
}

impl<const N: usize> Solved<N> {
    /// All keyframes together. `None` if they and the prior do not determine every unknown.
    pub fn combined(&self) -> Option<Combined<N>> {
        combine_with(&self.parts, &self.prior)
    }

    /// The same equations with all but the first `M` common unknowns held at their given values.
    pub fn restricted<const M: usize>(&self) -> Solved<M> {
        let given = SVector::from_fn(|k, _| k.checked_sub(LENS_START).map_or(0.0, |k| -self.lens_change[k]));
        Solved {
            roll_rad: self.roll_rad,
            pitch_rad: self.pitch_rad,
            lens_change: self.lens_change[..M - LENS_START].to_vec(),
            parts: self.parts.iter().map(|part| part.with_known::<M>(&given)).collect(),
            prior: self.prior.with_known::<M>(&given),
            pairs: self.pairs,
            rms_px: self.rms_px,
        }
    }
}

/// Pose of a first view; its height is the unit of length.
pub fn first_pose(tilt: &Vector2<f64>) -> GroundPose {
    GroundPose { roll_rad: tilt[0], pitch_rad: tilt[1], ..GroundPose::level(1.0) }
}

//! The fit of one lens model: bundle adjustment, outlier rejection and cross-validation.

use super::bundle::{
    BoardCorrespondence, Bundle, BundleState, BundleUnknowns, adjust, residuals, robust_noise_px,
};
use super::config::{CalibrationConfig, LensModel};
use super::lens::{Lens, free_numbers};
use super::start::{self, coefficient_priors, translated};
use super::zhang::mirrored_pose;
use nalgebra::Isometry3;
use odograph::numerics::median;

/// A point is an outlier if its residual exceeds both this many standard deviations and this many
/// pixels.
const WRONG_DEVIATIONS: f64 = 8.0;
const WRONG_PX: f64 = 1.0;
/// Maximum share of points rejected as outliers.
const MAX_WRONG: f64 = 0.03;
/// A view is an outlier if its noise exceeds the median noise of all views by this factor.
const WRONG_VIEW: f64 = 3.0;

/// Maximum number of steps of a bundle adjustment. From a reasonable initial state it takes five to
/// ten.
const STEPS: usize = 60;

/// A lens model fitted to a subset of the views.
#[derive(Debug, Clone)]
pub struct LensFit {
    pub model: LensModel,
    /// Indices of the views in the fit, in the order of the poses in `state`.
    pub views: Vec<usize>,
    pub state: BundleState,
    pub unknowns: BundleUnknowns,
    pub noise_px: f64,
}

/// The correspondences of some of the views.
pub fn chosen<'a>(sights: &'a [Vec<BoardCorrespondence>], views: &[usize]) -> Vec<&'a [BoardCorrespondence]> {
    views.iter().map(|&view| sights[view].as_slice()).collect()
}

impl LensFit {
    /// Fits a model, initialised with the lens and the poses from `start`.
    pub fn new(
        sights: &[Vec<BoardCorrespondence>],
        views: &[usize],
        poses: &[Isometry3<f64>],
        lens: &Lens,
        model: LensModel,
        config: &CalibrationConfig,
        size: (usize, usize),
    ) -> Self {
        let chosen_views = chosen(sights, views);
        let (width, height) = (size.0 as f64, size.1 as f64);
        let middle = ((width - 1.0) / 2.0, (height - 1.0) / 2.0);
        let centred = config.centred.then_some(middle);
        let lens = translated(&chosen_views, lens, poses, model, config.square_pixels, centred);
        let state = BundleState { lens, shape: [0.0; 5], poses: poses.to_vec() };
        let mut priors = vec![(2, middle.0, width), (3, middle.1, width)];
        priors.extend(coefficient_priors(model));
        let free = free_numbers(model, config.square_pixels, config.centred, model.coefficients());
        let unknowns = BundleUnknowns { lens: free, shape: false, poses: true, priors };
        let mut fit = Self { model, views: views.to_vec(), state, unknowns, noise_px: 1.0 };
        fit.adjust(sights);
        if fit.turn_mirrored(sights) {
            fit.adjust(sights);
        }
        if !config.flat_board {
            fit.unknowns.shape = true;
            fit.adjust(sights);
        }
        fit
    }

    /// Bundle adjustment from the current state.
    pub fn adjust(&mut self, sights: &[Vec<BoardCorrespondence>]) {
        let views = chosen(sights, &self.views);
        self.noise_px = adjust(&views, &mut self.state, &self.unknowns, STEPS);
    }

    /// Drops all views that are not in `views`, which is sorted in ascending order.
    pub fn keep(&mut self, views: &[usize]) {
        let stays: Vec<usize> =
            (0..self.views.len()).filter(|&at| views.binary_search(&self.views[at]).is_ok()).collect();
        self.state.poses = stays.iter().map(|&at| self.state.poses[at]).collect();
        self.views = stays.iter().map(|&at| self.views[at]).collect();
    }

    /// Extends the fit to all of `views` that are not rejected. The poses of new views are
    /// initialised with the lens from `start` and refined with the fitted lens.
    pub fn extend(
        &mut self,
        views: &[usize],
        sights: &[Vec<BoardCorrespondence>],
        start: &Lens,
        reasons: &mut [Option<String>],
    ) {
        let (mut all, mut poses) = (Vec::new(), Vec::new());
        for &view in views {
            if reasons[view].is_some() {
                continue;
            }
            let known = self.views.iter().position(|&other| other == view).map(|at| self.state.poses[at]);
            let pose = known.or_else(|| self.refined(&sights[view], start::pose(start, &sights[view])?));
            match pose {
                Some(pose) => {
                    all.push(view);
                    poses.push(pose);
                }
                None => reasons[view] = Some("no pose of the board fits its points".to_owned()),
            }
        }
        (self.views, self.state.poses) = (all, poses);
    }

    /// Pose of a view, refined with the fitted lens; `None` if its points do not determine a pose.
    pub fn pose(&self, sights: &[BoardCorrespondence], start: &Lens) -> Option<Isometry3<f64>> {
        if super::sights::fault(sights).is_some() {
            return None;
        }
        self.refined(sights, start::pose(start, sights)?)
    }

    fn refined(&self, sights: &[BoardCorrespondence], pose: Isometry3<f64>) -> Option<Isometry3<f64>> {
        let mut one = self.state.with_pose(pose);
        adjust(&[sights], &mut one, &BundleUnknowns::poses_only(), 20);
        let pose = better_mirrored(sights, &one, self.noise_px).unwrap_or(one.poses[0]);
        pose.translation.vector.iter().all(|number| number.is_finite()).then_some(pose)
    }

    /// Resolves the two-fold ambiguity of planar poses: switches views with a large residual to the
    /// mirrored pose if that fits better. Returns whether any view changed.
    fn turn_mirrored(&mut self, sights: &[Vec<BoardCorrespondence>]) -> bool {
        let mut turned = false;
        for at in 0..self.views.len() {
            let view = &sights[self.views[at]];
            let one = self.state.with_pose(self.state.poses[at]);
            if robust_noise_px(&[view], &one, 6) > 1.5 * self.noise_px
                && let Some(pose) = better_mirrored(view, &one, self.noise_px)
            {
                self.state.poses[at] = pose;
                turned = true;
            }
        }
        turned
    }

    fn squares(&self, sights: &[BoardCorrespondence], pose: &Isometry3<f64>) -> (f64, f64) {
        let off = residuals(&self.state.lens, &self.state.shape, pose, sights);
        off.flatten().fold((0.0, 0.0), |(sum, count), (dx, dy)| (sum + dx * dx + dy * dy, count + 1.0))
    }

    /// RMS reprojection error over all views of the fit, pixels.
    pub fn rms_px(&self, sights: &[Vec<BoardCorrespondence>]) -> f64 {
        let all = self.views.iter().zip(&self.state.poses);
        let (sum, count) = all
            .map(|(&view, pose)| self.squares(&sights[view], pose))
            .fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        (sum / count).sqrt()
    }

    /// Rejects outlier views and outlier points, with a new bundle adjustment after each round,
    /// until none remain. Outlier points are removed from `sights`. At most a third of the views is
    /// rejected; the reason is written to `reasons`.
    pub fn leave_out_wrong(
        &mut self,
        sights: &mut [Vec<BoardCorrespondence>],
        reasons: &mut [Option<String>],
    ) {
        let most = self.views.len() / 3;
        let mut left_out = 0;
        for _ in 0..6 {
            let noises: Vec<f64> = (0..self.views.len())
                .map(|at| {
                    let one = self.state.with_pose(self.state.poses[at]);
                    robust_noise_px(&[&sights[self.views[at]]], &one, 6)
                })
                .collect();
            let usual_px = median(&mut noises.clone()).unwrap_or(self.noise_px);
            let mut changed = false;
            let mut kept = Vec::new();
            for (at, &noise_px) in noises.iter().enumerate() {
                let view = self.views[at];
                let behind = self.state.poses[at].translation.vector.z.abs() > 1e4;
                let wrong = (noise_px > WRONG_VIEW * usual_px && noise_px > 0.05) || behind;
                if wrong && left_out < most && self.views.len() - left_out > 3 {
                    left_out += 1;
                    reasons[view] = Some(format!(
                        "its points are typically {:.2} px off, those of the other views {:.2} px: \
                         blurred, moved, bent, or wrongly identified points",
                        noise_px * std::f64::consts::SQRT_2,
                        usual_px * std::f64::consts::SQRT_2
                    ));
                    changed = true;
                } else {
                    kept.push(at);
                }
            }
            self.state.poses = kept.iter().map(|&at| self.state.poses[at]).collect();
            self.views = kept.iter().map(|&at| self.views[at]).collect();
            if !changed {
                changed = self.leave_out_points(sights);
            }
            if !changed {
                break;
            }
            self.adjust(sights);
        }
    }

    /// Rejects outlier points if they are few. Many outliers indicate a wrong lens model instead.
    /// Returns whether any point was removed.
    fn leave_out_points(&self, sights: &mut [Vec<BoardCorrespondence>]) -> bool {
        let far_px = (WRONG_DEVIATIONS * self.noise_px).max(WRONG_PX);
        let mut changed = false;
        let (mut far, mut all) = (0, 0);
        for (&view, pose) in self.views.iter().zip(&self.state.poses) {
            let off = residuals(&self.state.lens, &self.state.shape, pose, &sights[view]);
            far += off.filter(|off| off.is_none_or(|(dx, dy)| dx.hypot(dy) >= far_px)).count();
            all += sights[view].len();
        }
        if far as f64 > MAX_WRONG * all as f64 {
            return false;
        }
        for (&view, pose) in self.views.iter().zip(&self.state.poses) {
            let off: Vec<_> = residuals(&self.state.lens, &self.state.shape, pose, &sights[view]).collect();
            let belongs = |off: &Option<(f64, f64)>| off.is_some_and(|(dx, dy)| dx.hypot(dy) < far_px);
            let good = off.iter().filter(|off| belongs(off)).count();
            if good < off.len() && good >= 4.max(off.len() * 2 / 3) {
                let mut next = off.iter();
                sights[view].retain(|_| next.next().is_some_and(belongs));
                changed = true;
            }
        }
        changed
    }

    /// Cross-validation with five folds, or leave-one-out with fewer than ten views. The camera is
    /// fitted to the other folds; for each held-out view only the pose is estimated.
    pub fn hold_out(&self, sights: &[Vec<BoardCorrespondence>]) -> HoldOut {
        let count = self.views.len();
        let parts = if count < 10 { count } else { 5 };
        let mut out = HoldOut { views: vec![f64::INFINITY; count], rms_px: f64::INFINITY };
        if count < 4 {
            return out;
        }
        let (mut sum, mut points) = (0.0, 0.0);
        for part in 0..parts {
            let (held, others): (Vec<usize>, Vec<usize>) = (0..count).partition(|at| at % parts == part);
            let views: Vec<&[BoardCorrespondence]> =
                others.iter().map(|&at| sights[self.views[at]].as_slice()).collect();
            let mut state = self.state.clone();
            state.poses = others.iter().map(|&at| self.state.poses[at]).collect();
            Bundle { views: &views, unknowns: &self.unknowns, noise_px: self.noise_px }
                .minimise(&mut state, 12);
            for at in held {
                let view = sights[self.views[at]].as_slice();
                let mut one = state.with_pose(self.state.poses[at]);
                let poses_only = BundleUnknowns::poses_only();
                Bundle { views: &[view], unknowns: &poses_only, noise_px: self.noise_px }
                    .minimise(&mut one, 12);
                let limit = (4.0 * self.noise_px).powi(2);
                let (mut all, mut bounded, mut number) = (0.0, 0.0, 0.0);
                for (dx, dy) in residuals(&one.lens, &one.shape, &one.poses[0], view).flatten() {
                    let square = dx * dx + dy * dy;
                    all += square;
                    bounded += square.min(limit);
                    number += 1.0;
                }
                sum += all;
                points += number;
                out.views[at] = bounded / number;
            }
        }
        out.rms_px = (sum / points).sqrt();
        out
    }
}

/// Result of the cross-validation.
#[derive(Debug, Clone)]
pub struct HoldOut {
    /// Mean square residual of each view, px², with outliers clipped.
    pub views: Vec<f64>,
    pub rms_px: f64,
}

/// The mirrored pose of a single view, refined, if it fits significantly better (two-fold ambiguity
/// of planar poses).
pub fn better_mirrored(
    sights: &[BoardCorrespondence],
    state: &BundleState,
    noise_px: f64,
) -> Option<Isometry3<f64>> {
    let count = sights.len().max(1) as f64;
    let middle =
        sights.iter().fold((0.0, 0.0), |m, s| (m.0 + s.on_board.0 / count, m.1 + s.on_board.1 / count));
    let poses_only = BundleUnknowns::poses_only();
    let bundle = Bundle { views: &[sights], unknowns: &poses_only, noise_px };
    let mut here = state.clone();
    let cost_here = bundle.minimise(&mut here, 20);
    let mut there = here.with_pose(mirrored_pose(&here.poses[0], middle)?);
    (bundle.minimise(&mut there, 20) < cost_here * 0.999).then(|| there.poses[0])
}

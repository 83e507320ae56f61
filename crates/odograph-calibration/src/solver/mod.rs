//! Calibration solver: estimates a camera from views of a board.
//!
//! `start` computes an initial camera and initial poses for any lens. `bundle` is the bundle
//! adjustment. `fit` rejects outliers and runs the cross-validation of one lens model. `choice`
//! selects the lens model. `quality` and `verdict` assess the result.

mod bundle;
mod choice;
mod config;
mod fit;
mod lens;
mod quality;
mod result;
mod sights;
mod start;
mod verdict;
mod zhang;

pub use config::{CalibrationConfig, LensModel};
pub use result::{
    BendEvidence, BoardShape, CalibratedView, Calibration, ModelComparison, Parameter, Verdict,
};

use super::{Board, BoardView};
use bundle::{BoardCorrespondence, Bundle, listed_residuals};
use choice::Tried;
use fit::{LensFit, chosen};
use nalgebra::Isometry3;
use odograph::error::{Error, Result};
use quality::{ErrorMap, covariance};

/// Maximum number of points for the comparison of lens models and for the final fit; the run time
/// is proportional to them.
const COMPARED_POINTS: usize = 20_000;
const MAX_POINTS: usize = 500_000;

/// Estimates the camera from `views` of `board`.
///
/// After an initialisation similar to Zhang's, lens and poses are refined together in a bundle
/// adjustment with a robust loss (Z. Zhang, "A flexible new technique for camera calibration",
/// 2000). If the configuration names no lens model, the one is selected whose rays are surest over
/// the whole image.
/// Outlier views are rejected and reported with a reason. Points beyond 90° from the optical axis
/// are used, although a [`Camera`](odograph::camera::Camera) only has rays below 90°.
///
/// Fails, with advice in the message, if the views do not determine a camera: fewer than three
/// usable views, all views alike, different image sizes, or mirrored views. Also fails on NaN
/// coordinates, on positions far outside the image, and on point indices that are duplicated or not
/// on the board.
pub fn calibrate(board: &Board, views: &[BoardView], config: &CalibrationConfig) -> Result<Calibration> {
    let (size, gathered) = sights::gather(board, views)?;
    let mut reasons: Vec<Option<String>> =
        gathered.iter().map(|sights| sights.as_ref().err().cloned()).collect();
    let mut sights: Vec<Vec<BoardCorrespondence>> =
        gathered.into_iter().map(std::result::Result::unwrap_or_default).collect();
    let given: Vec<usize> = sights.iter().map(Vec::len).collect();
    let usable: Vec<usize> = (0..sights.len()).filter(|&view| reasons[view].is_none()).collect();

    let usable = evenly(&usable, &sights, MAX_POINTS);
    for (view, reason) in reasons.iter_mut().enumerate() {
        if reason.is_none() && usable.binary_search(&view).is_err() {
            *reason = Some("more views than are needed".to_owned());
        }
    }
    let compared = evenly(&usable, &sights, COMPARED_POINTS);
    let (start_lens, poses) = start::start(&chosen(&sights, &compared), size).ok_or_else(|| {
        Error::input(
            "no camera fits the views; check that the board's count and kind are right, and take views with more of it and more tilt",
        )
    })?;
    let (mut posed, mut known_poses) = (Vec::new(), Vec::new());
    for (&view, pose) in compared.iter().zip(poses) {
        match pose {
            Some(pose) => {
                posed.push(view);
                known_poses.push(pose);
            }
            None => reasons[view] = Some("no pose of the board fits its points".to_owned()),
        }
    }
    let (compared, poses) = (posed, known_poses);

    let models: Vec<LensModel> = match config.model {
        Some(model) => vec![model],
        None => LensModel::NAMED.map(|(_, model)| model).to_vec(),
    };
    let fit_model = |model, sights: &[Vec<BoardCorrespondence>]| {
        LensFit::new(sights, &compared, &poses, &start_lens, model, config, size)
    };
    let mut fits: Vec<LensFit> = models.iter().map(|&model| fit_model(model, &sights)).collect();
    // The best-fitting model decides which points and views are outliers; they are rejected for all
    // models.
    let best = fits.iter_mut().min_by(|a, b| a.noise_px.total_cmp(&b.noise_px));
    let Some(best) = best else { return Err(Error::usage("no lens model to try")) };
    best.leave_out_wrong(&mut sights, &mut reasons);
    let (kept, best_model) = (best.views.clone(), best.model);
    for fit in fits.iter_mut().filter(|fit| fit.model != best_model) {
        fit.keep(&kept);
        fit.adjust(&sights);
    }
    let mut tried: Vec<Tried> = fits.into_iter().filter_map(|fit| Tried::new(fit, &sights, size)).collect();
    let taken = choice::choose(&mut tried).ok_or_else(|| {
        Error::input("the views do not determine a camera; take more, with more tilt and all over the image")
    })?;
    let hold_out_rms_px = tried[taken].hold_out.rms_px;
    let mut candidates: Vec<ModelComparison> = tried.iter().map(|one| one.candidate.clone()).collect();
    candidates.sort_by_key(|candidate| candidate.model.coefficients());
    let mut fit = tried[taken].fit.clone();
    if usable.len() > compared.len() {
        fit.extend(&usable, &sights, &start_lens, &mut reasons);
        fit.adjust(&sights);
        fit.leave_out_wrong(&mut sights, &mut reasons);
    }
    let outcome = SolverOutcome { fit, sights, reasons, given, candidates, hold_out_rms_px, start_lens };
    outcome.calibration(config, size)
}

/// Selects views evenly spaced in the order of `views`, with at most `most` points in total but at
/// least three views.
fn evenly(views: &[usize], sights: &[Vec<BoardCorrespondence>], most: usize) -> Vec<usize> {
    let points: usize = views.iter().map(|&view| sights[view].len()).sum();
    if points <= most {
        return views.to_vec();
    }
    let kept =
        ((views.len() as f64 * most as f64 / points as f64) as usize).clamp(3.min(views.len()), views.len());
    (0..kept).map(|i| views[i * views.len() / kept]).collect()
}

/// The fitted model and everything else that goes into the [`Calibration`].
struct SolverOutcome {
    fit: LensFit,
    sights: Vec<Vec<BoardCorrespondence>>,
    reasons: Vec<Option<String>>,
    given: Vec<usize>,
    candidates: Vec<ModelComparison>,
    hold_out_rms_px: f64,
    start_lens: lens::Lens,
}

impl SolverOutcome {
    fn calibration(self, config: &CalibrationConfig, size: (usize, usize)) -> Result<Calibration> {
        let Self { fit, sights, .. } = &self;
        let lens = &fit.state.lens;
        let camera = lens.camera(size).map_err(|error| error.at("the views do not determine a camera"))?;
        let covariance = covariance(fit, sights);
        let error_map = ErrorMap::new(&camera, lens, &fit.unknowns.lens, covariance.clone());
        let mut names: Vec<(&'static str, f64)> =
            fit.unknowns.lens.iter().map(|free| (free.name, lens.numbers[free.at])).collect();
        let [bend_x, bend_xy, bend_y, stretch, shear] = fit.state.shape;
        let board_shape =
            fit.unknowns.shape.then_some(BoardShape { bend_x, bend_xy, bend_y, stretch, shear });
        if fit.unknowns.shape {
            let shape_names = ["bend_x", "bend_xy", "bend_y", "stretch", "shear"];
            names.extend(shape_names.into_iter().zip(fit.state.shape));
        }
        let parameters = names
            .iter()
            .enumerate()
            .map(|(i, &(name, value))| Parameter { name, value, deviation: covariance[(i, i)].sqrt() })
            .collect();
        let mut calibration = Calibration {
            camera,
            model: fit.model,
            parameters,
            covariance,
            noise_px: fit.noise_px,
            rms_px: fit.rms_px(sights),
            hold_out_rms_px: self.hold_out_rms_px,
            views: self.views(),
            candidates: self.candidates.clone(),
            board_shape,
            bend: if config.flat_board { self.bend() } else { None },
            verdict: Verdict::Good,
            reasons: Vec::new(),
            error_map,
        };
        let views = chosen(sights, &fit.views);
        let evidence = verdict::Evidence { views: &views, distinct: sights::distinct(&views, size) };
        (calibration.verdict, calibration.reasons) = verdict::judge(&calibration, &evidence);
        Ok(calibration)
    }

    /// All views with pose and residuals. The poses of unused views are estimated with the final
    /// camera.
    fn views(&self) -> Vec<CalibratedView> {
        let state = &self.fit.state;
        let mut place = vec![None; self.sights.len()];
        for (at, &view) in self.fit.views.iter().enumerate() {
            place[view] = Some(at);
        }
        let mut views = Vec::with_capacity(self.sights.len());
        for (number, sights) in self.sights.iter().enumerate() {
            let used = place[number].is_some();
            let mut why_not = self.reasons[number].clone();
            let left_out = self.given[number].saturating_sub(sights.len());
            if used && left_out > 0 {
                why_not = Some(format!("{left_out} of its points lie far off and were left out"));
            }
            let known = place[number].map(|at| state.poses[at]);
            let pose = known.or_else(|| self.fit.pose(sights, &self.start_lens));
            let (residuals, squares) =
                pose.map_or_else(Default::default, |pose| listed_residuals(state, &pose, sights));
            views.push(CalibratedView {
                camera_from_board: pose.unwrap_or_else(Isometry3::identity),
                // NaN without residuals.
                rms_px: (squares / residuals.len() as f64).sqrt(),
                residuals,
                used,
                why_not,
            });
        }
        views
    }

    /// What estimating the board shape too would gain. `None` if that is insignificant, or for too
    /// few views or too many points.
    fn bend(&self) -> Option<BendEvidence> {
        let points: usize = self.fit.views.iter().map(|&view| self.sights[view].len()).sum();
        if points > COMPARED_POINTS || self.fit.views.len() < 5 {
            return None;
        }
        let mut bent = self.fit.clone();
        bent.unknowns.shape = true;
        let views = chosen(&self.sights, &bent.views);
        let noise_px = self.fit.noise_px;
        Bundle { views: &views, unknowns: &bent.unknowns, noise_px }.minimise(&mut bent.state, 10);
        let (before_px, after_px) = (self.fit.rms_px(&self.sights), bent.rms_px(&self.sights));
        let gain = 1.0 - after_px / before_px;
        let depth_m = bent.state.shape[..3].iter().fold(0.0f64, |deepest, z| deepest.max(z.abs()));
        (gain > 0.1 && before_px > 0.1).then_some(BendEvidence { gain, depth_m })
    }
}

#[cfg(test)]
mod tests;

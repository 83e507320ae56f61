//! Nuisance parameters of a frame's fit: height and tilt of the keyframe, skew of a rolling
//! shutter, shape of the ground, elevations of the points. Derivation: `docs/math/frame-pose.md`.

use super::elevation::{Parallax, along_ray};
use super::ground_shape::ShapeEstimate;
use super::normal_equations::{NormalEquations, POSE, Row, SHAPE, WITH_KEYFRAME, WITH_SHAPE, WITH_SKEW};
use super::residual::{Axes, Residual, ground_by_pose};
use super::{KeyframeError, Observation, Observations, PoseRates, ShutterEstimate, ShutterPrior};
use crate::camera::Camera;
use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3, Vector6};

/// Nuisance parameters of the fit: height and tilt of the keyframe that defines the ground points,
/// the skew of a rolling shutter, and the shape of uneven ground. All are whitened: in units of
/// their prior standard deviation.
#[derive(Debug)]
pub struct Nuisance<'a> {
    pub observations: Observations<'a>,
    keyframe_axes: Axes,
    /// Mean elevation of the points, metres.
    level_m: f64,
    /// Root of the covariance of the keyframe's height, roll and pitch: zero where they are known.
    keyframe_root: Matrix3<f64>,
    skew_sigma: PoseRates,
    /// Root of the covariance of the shape that the points share.
    shape_root: Matrix6<f64>,
    /// Number of unknowns of the fit, with those of the pose.
    pub count: usize,
    /// Estimates, whitened.
    values: [f64; WITH_SHAPE - POSE],
}

/// A keyframe error that displaces no point by more than this is not estimated, pixels. Not
/// derived; chosen equal to the least noise that a fit assumes.
const NEGLIGIBLE_SHIFT_PX: f64 = 0.01;

impl<'a> Nuisance<'a> {
    pub fn new(camera: &Camera, observations: Observations<'a>) -> Self {
        let Observations { keyframe_pose, keyframe_covariance, shutter, .. } = observations;
        let px_per_unit = Vector3::new(1.0 / keyframe_pose.height_m, 1.0, 1.0) * camera.focal_px().0;
        let is_known =
            (0..3).all(|i| keyframe_covariance[(i, i)].sqrt() * px_per_unit[i] < NEGLIGIBLE_SHIFT_PX);
        let keyframe_root = if is_known { Matrix3::zeros() } else { semidefinite_root(keyframe_covariance) };
        let skew_sigma = shutter
            .map_or(PoseRates::zeros(), |(prior, assumed)| prior.skew_sigma(&assumed).map(|s| s.max(1e-12)));
        let count = match shutter {
            Some((prior, _)) if prior.applies && observations.shape.is_some() => WITH_SHAPE,
            Some((prior, _)) if prior.applies => WITH_SKEW,
            _ if is_known => POSE,
            _ => WITH_KEYFRAME,
        };
        let values = [0.0; WITH_SHAPE - POSE];
        let shape_covariance = observations.shape.map_or(Matrix6::zeros(), |shape| *shape.covariance());
        let shape_root = semidefinite_root(&shape_covariance);
        let elevations = observations.seen.iter().map(|seen| seen.elevation.mean_m);
        Self {
            observations,
            keyframe_axes: Axes::new(keyframe_pose),
            level_m: elevations.sum::<f64>() / observations.seen.len().max(1) as f64,
            keyframe_root,
            skew_sigma,
            shape_root,
            count,
            values,
        }
    }

    /// Adds the effect of the nuisance parameters to a residual, and its derivatives by the
    /// keyframe.
    pub fn complete(&self, observation: &Observation, residual: &mut Residual) {
        if self.count == POSE {
            return;
        }
        let [x_by_pose, y_by_pose, z_by_pose] = self.point_by_keyframe(observation);
        let (keyframe, skew) = self.values[..WITH_SKEW - POSE].split_at(WITH_KEYFRAME - POSE);
        for k in 0..2 {
            let row = &residual.by_pose[k];
            let by_rig = Vector3::from_fn(|i, _| {
                -row[0] * x_by_pose[3 + i] - row[1] * y_by_pose[3 + i] - row[3] * z_by_pose[3 + i]
            });
            let by_keyframe = self.keyframe_root.tr_mul(&by_rig);
            residual.error[k] += by_keyframe.iter().zip(keyframe).map(|(by, value)| by * value).sum::<f64>();
            let by_skew = row.iter().zip(&self.skew_sigma).zip(skew);
            residual.error[k] += observation.row_fraction
                * by_skew.map(|((by, sigma), value)| by * sigma * value).sum::<f64>();
            residual.error[k] += self.corrected_by_elevation(observation, row)
                * (observation.elevation.mean_m - observation.corrected_at_m);
            residual.by_keyframe[k] = by_keyframe.into();
        }
        let error = nalgebra::Vector2::from(residual.error);
        residual.distance_px =
            observation.whitening.try_inverse().map_or(error, |inverse| inverse * error).norm();
    }

    /// Derivative of a residual by the elevation for which its pixel was corrected to a global
    /// shutter: rows are exposed at other positions, and a higher point is shifted more. `row` is
    /// the derivative by the pose.
    fn corrected_by_elevation(&self, observation: &Observation, row: &[f64; POSE]) -> f64 {
        let Some((prior, assumed)) = self.observations.shutter else { return 0.0 };
        let depth_m = observation.centre_of_projection.z - observation.elevation.mean_m;
        let by_rates = [0, 1, 3].map(|i| row[i] * assumed[i]).iter().sum::<f64>();
        observation.row_fraction * prior.readout.mean_s * by_rates / depth_m
    }

    /// Derivative of a point by the pose of the keyframe. Elevations were measured in metres of the
    /// keyframe's height over the ground: where that is off they are off by the same factor.
    fn point_by_keyframe(&self, observation: &Observation) -> [[f64; POSE]; 3] {
        let pose = self.observations.keyframe_pose;
        let [mut x, mut y] = ground_by_pose(observation, pose, &self.keyframe_axes);
        let height_m = pose.height_m - self.level_m;
        x[3] = (observation.ground.x_m - pose.x_m) / height_m;
        y[3] = (observation.ground.y_m - pose.y_m) / height_m;
        let mut z = [0.0; POSE];
        z[3] = (observation.elevation.mean_m - self.level_m) / height_m;
        [x, y, z]
    }

    /// Eliminates the elevation of the point (Schur complement): the residual has less weight along
    /// its parallax. Derivation: `docs/math/elevation.md`.
    pub fn eliminate_elevation(&self, observation: &Observation, residual: &mut Residual, noise_px2: f64) {
        let Observation { ground, elevation, centre_of_projection: centre, .. } = observation;
        // As its elevation changes the point stays on the ray of the keyframe.
        let depth_m = centre.z - elevation.mean_m;
        let (x, y) = ((centre.x - ground.x_m) / depth_m, (centre.y - ground.y_m) / depth_m);
        let by_elevation = residual
            .by_pose
            .map(|row| self.corrected_by_elevation(observation, &row) - (row[0] * x + row[1] * y + row[3]));
        residual.by_elevation = by_elevation;
        let parallax = Parallax::new(residual.error, by_elevation);
        residual.parallax = parallax;
        let variance_m2 = elevation.variance_m2;
        if variance_m2 <= 0.0 {
            return;
        }
        let remaining_px = parallax.remaining_px(variance_m2, noise_px2);
        residual.distance_px *= remaining_px / residual.length().max(1e-12);
        let whiten = parallax.whitener(variance_m2, noise_px2);
        let [first, second] = &mut residual.error;
        whiten(first, second);
        let [first, second] = &mut residual.by_pose;
        first.iter_mut().zip(second).for_each(|(first, second)| whiten(first, second));
        let [first, second] = &mut residual.by_keyframe;
        first.iter_mut().zip(second).for_each(|(first, second)| whiten(first, second));
        let [first, second] = &mut residual.by_elevation;
        whiten(first, second);
    }

    /// An observation of ground of the estimated shape; `None` without a shape.
    pub fn shaped(&self, observation: &Observation) -> Option<Observation> {
        let Observations { shape, .. } = self.observations;
        let Observation { ground, mut elevation, centre_of_projection, .. } = *observation;
        let before_m = elevation.mean_m;
        elevation.mean_m += shape?.at(ground, &self.shape());
        let ground = along_ray(&centre_of_projection, ground, before_m, elevation.mean_m);
        Some(Observation { ground, elevation, ..*observation })
    }

    /// Coefficients of the shape.
    fn shape(&self) -> Vector6<f64> {
        self.shape_root * Vector6::from_row_slice(&self.values[WITH_SKEW - POSE..])
    }

    /// What is known of the shape after the fit.
    pub fn shape_estimate(&self, equations: &NormalEquations, scale_px: f64) -> Option<ShapeEstimate> {
        let shape = self.observations.shape?;
        let factor = equations.factor()?;
        let columns: [Row; SHAPE] = std::array::from_fn(|i| factor.column(WITH_SKEW + i));
        let whitened = Matrix6::from_fn(|i, k| columns[i][WITH_SKEW + k] * scale_px * scale_px);
        let covariance = self.shape_root * whitened * self.shape_root.transpose();
        Some(ShapeEstimate { coefficients: self.shape(), shape: shape.with_covariance(covariance) })
    }

    /// Derivatives of coordinate `k` of a residual by the first `count` unknowns.
    pub fn row(&self, observation: &Observation, residual: &Residual, k: usize, count: usize) -> Row {
        let mut row = [0.0; WITH_SHAPE];
        row[..POSE].copy_from_slice(&residual.by_pose[k]);
        row[POSE..WITH_KEYFRAME].copy_from_slice(&residual.by_keyframe[k]);
        if count >= WITH_SKEW {
            for i in 0..POSE {
                row[WITH_KEYFRAME + i] = observation.row_fraction * self.skew_sigma[i] * row[i];
            }
        }
        if let (WITH_SHAPE, Some(shape)) = (count, self.observations.shape) {
            let by_shape =
                self.shape_root.tr_mul(&shape.basis(observation.ground)) * residual.by_elevation[k];
            row[WITH_SKEW..].copy_from_slice(by_shape.as_slice());
        }
        row
    }

    /// Normal equations of the tracks, without priors, for the first `count` unknowns.
    pub fn equations(&self, residuals: &[Residual], weights: &[f64], count: usize) -> NormalEquations {
        let mut equations = NormalEquations::new(count);
        for ((observation, residual), &weight) in self.observations.seen.iter().zip(residuals).zip(weights) {
            if weight > 0.0 {
                for (k, &error) in residual.error.iter().enumerate() {
                    equations.add(&self.row(observation, residual, k, count), error, weight);
                }
            }
        }
        equations
    }

    /// Adds the priors of the nuisance parameters.
    pub fn add_priors(&self, equations: &mut NormalEquations, scale_px: f64) {
        for i in POSE..equations.count() {
            equations.add_prior(i, self.values[i - POSE], scale_px * scale_px);
        }
    }

    /// Residuals after a step of all unknowns, by their derivatives.
    pub fn errors_after(&self, step: &Row, residuals: &[Residual], errors: &mut [[f64; 2]]) {
        for ((observation, residual), errors) in self.observations.seen.iter().zip(residuals).zip(errors) {
            for (k, error) in errors.iter_mut().enumerate() {
                let row = self.row(observation, residual, k, self.count);
                *error = residual.error[k] - row.iter().zip(step).map(|(by, step)| by * step).sum::<f64>();
            }
        }
    }

    pub fn advance(&mut self, step: &Row) {
        self.values.iter_mut().zip(&step[POSE..self.count]).for_each(|(value, step)| *value -= step);
    }

    /// Estimated error of the keyframe's height, roll and pitch. `None` where these are known.
    pub fn keyframe_error(&self, equations: &NormalEquations, scale_px: f64) -> Option<KeyframeError> {
        let root = &self.keyframe_root;
        if *root == Matrix3::zeros() || equations.count() == POSE {
            return None;
        }
        let factor = equations.factor()?;
        let columns = [0, 1, 2].map(|i| factor.column(POSE + i));
        let whitened = Matrix3::from_fn(|i, k| columns[i][POSE + k] * scale_px * scale_px);
        let mean = root * Vector3::from_fn(|i, _| self.values[i]);
        Some(KeyframeError { mean, covariance: root * whitened * root.transpose() })
    }

    /// Estimate of the shutter's skew. `equations` include the priors.
    pub fn shutter(
        &self,
        equations: &NormalEquations,
        prior: &ShutterPrior,
        assumed: PoseRates,
        scale_px: f64,
    ) -> Option<ShutterEstimate> {
        let factor = equations.factor()?;
        // A skew that is not part of the fit is estimated by one Gauss–Newton step from its end.
        let (inverse, step) = (factor.inverse(), factor.solve(equations.slope()));
        let (noise_px2, sigma) = (scale_px * scale_px, &self.skew_sigma);
        let mut evidence = prior.readout.mean_s * assumed;
        let mut evidence_variance = PoseRates::repeat(f64::INFINITY);
        for i in 0..6 {
            let at = WITH_KEYFRAME + i;
            let difference = sigma[i] * (self.values[at - POSE] - step[at]);
            let posterior = 1.0 / inverse[at][at];
            // Below a thousandth of the posterior information the difference is rounding error.
            let likelihood = posterior - noise_px2;
            if likelihood > 1e-3 * posterior {
                evidence[i] += difference * posterior / likelihood;
                evidence_variance[i] = sigma[i] * sigma[i] * noise_px2 / likelihood;
            }
        }
        let mut without = *equations;
        (WITH_KEYFRAME..WITH_SKEW).for_each(|i| without.hold(i));
        let without = without.factor()?;
        let mut pose_by_expected_skew = Matrix6::zeros();
        for i in 0..6 {
            let at = WITH_KEYFRAME + i;
            // An error of the prior mean biases the skew, and the skew the pose; a skew left out of
            // the fit biases the pose in full.
            let column = if prior.applies {
                inverse[at].map(|entry| entry * noise_px2)
            } else {
                without.solve(&std::array::from_fn(|k| {
                    if (WITH_KEYFRAME..WITH_SKEW).contains(&k) { 0.0 } else { -equations.entry(k, at) }
                }))
            };
            (0..6).for_each(|k| pose_by_expected_skew[(k, i)] = column[k] / sigma[i]);
        }
        Some(ShutterEstimate {
            expected_rates: assumed,
            evidence,
            evidence_variance,
            pose_by_expected_skew,
            pose_by_keyframe_skew: Matrix6::zeros(),
        })
    }

    /// Derivative of the gradient of the fit by the pose of the keyframe: one row for each number
    /// of that pose. Each point takes the fraction `share` of the change.
    pub fn slopes_by_keyframe(
        &self,
        residuals: &[Residual],
        weights: &[f64],
        count: usize,
        share: impl Fn(&Observation) -> f64,
    ) -> [Row; POSE] {
        let mut slopes = [[0.0; WITH_SHAPE]; POSE];
        let Observations { seen, .. } = self.observations;
        for ((observation, residual), &weight) in seen.iter().zip(residuals).zip(weights) {
            if weight <= 0.0 {
                continue;
            }
            let [x_by_pose, y_by_pose, z_by_pose] = self.point_by_keyframe(observation);
            let weight = weight * share(observation);
            for k in 0..2 {
                let row = self.row(observation, residual, k, count);
                // A displacement of the point is the opposite displacement of the camera.
                let change: [f64; 6] = std::array::from_fn(|n| {
                    row[0] * x_by_pose[n] + row[1] * y_by_pose[n] + row[3] * z_by_pose[n]
                });
                for (slope, change) in slopes.iter_mut().zip(change) {
                    let weighted = weight * change;
                    slope.iter_mut().zip(&row).take(count).for_each(|(sum, by)| *sum += weighted * by);
                }
            }
        }
        slopes
    }
}

/// Cholesky factor of a positive semi-definite matrix; zeros on its diagonal are allowed.
fn semidefinite_root<const N: usize>(covariance: &SMatrix<f64, N, N>) -> SMatrix<f64, N, N> {
    let mut root = SMatrix::zeros();
    for i in 0..N {
        for k in 0..=i {
            let left = covariance[(i, k)] - (0..k).map(|m| root[(i, m)] * root[(k, m)]).sum::<f64>();
            root[(i, k)] = match i == k {
                true => left.max(0.0).sqrt(),
                false if root[(k, k)] > 0.0 => left / root[(k, k)],
                false => 0.0,
            };
        }
    }
    root
}

//! Gauss–Newton on the re-projection errors of the tracks of a window.

use super::frames::{WindowFrame, unit};
use super::spline::{Basis, SUPPORT, Spline, State};
use super::track::{KEYFRAME, LOCAL, READOUT, TrackResidual};
use crate::camera::Camera;
use crate::motion::{PoseRates, Readout};
use crate::numerics::{Loss, normal_sigma};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// How a frame's keyframe is known.
pub enum Reference {
    /// It is in the window.
    Inside(Basis),
    /// It is not, and its motion was measured before.
    Before(State),
}

/// Standard deviation of the poses by the odometry, heights or radians: it only holds what no track
/// determines.
const LOOSE: f64 = 0.05;

/// Standard deviation of the pose that fixes the gauge, heights or radians.
const EXACT: f64 = 1e-6;

/// Weights of control points in the jerk, times the cube of an interval.
const THIRD_DIFFERENCE: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];

/// Residuals count in full up to this number of standard deviations.
const ROBUST: Loss = Loss::Huber(2.0);

/// Least standard deviation of a track, pixels.
const LEAST_NOISE_PX: f64 = 0.005;

/// A readout time that is known is not estimated: its standard deviation, seconds.
const FIXED_S: f64 = 1e-9;

/// Elevations of the corners of a window above the plane, in heights: normal, with a common
/// variance that is estimated with them.
pub struct Elevations {
    /// For each track of each frame, the number of its corner.
    corners: Vec<Vec<usize>>,
    expected: Vec<f64>,
    heights: Vec<f64>,
    variance: f64,
}

/// Standard deviation of elevations at first, heights, and the least one: a smooth floor.
const ELEVATION: f64 = 0.02;
const LEAST_ELEVATION: f64 = 1e-4;

impl Elevations {
    /// Of corners with these elevations, as far as they are known.
    pub fn new(corners: Vec<Vec<usize>>, expected: Vec<f64>) -> Self {
        Self { corners, heights: expected.clone(), expected, variance: ELEVATION * ELEVATION }
    }

    /// Changes them after the control points have changed, and estimates their variance by the
    /// number of elevations that the tracks determine (D. MacKay, as above).
    fn update(&mut self, couplings: &[Coupling], change: &DVector<f64>) {
        let (mut squares, mut determined) = (0.0, 0.0);
        for ((height, expected), coupling) in self.heights.iter_mut().zip(&self.expected).zip(couplings) {
            *height += (coupling.slope - coupling.by_controls.dot(change)) / coupling.information;
            squares += (*height - expected).powi(2);
            determined += 1.0 - 1.0 / (coupling.information * self.variance);
        }
        let variance = squares / f64::max(determined, 1.0);
        self.variance = variance.max(LEAST_ELEVATION * LEAST_ELEVATION);
    }
}

/// The normal equations of one elevation.
struct Coupling {
    information: f64,
    slope: f64,
    /// With the control points and the readout time.
    by_controls: DVector<f64>,
}

/// Normal equations of the tracks of one frame.
struct LocalEquations {
    matrix: Box<[[f64; LOCAL]; LOCAL]>,
    vector: [f64; LOCAL],
}

/// The normal equations of control points and readout time; of the matrix, which is symmetric, the
/// lower triangle.
struct NormalEquations {
    matrix: DMatrix<f64>,
    vector: DVector<f64>,
    couplings: Vec<Coupling>,
}

/// An iteration.
pub struct Step {
    /// The Cholesky factor of the normal equations.
    pub normal: Cholesky<f64, Dyn>,
    /// Mahalanobis norm of the change of control points and readout time.
    pub change: f64,
}

/// Gauss–Newton on a window.
pub struct Adjusting<'a> {
    pub camera: &'a Camera,
    /// The readout time as it is expected, and as it is estimated, seconds.
    pub readout: Readout,
    pub readout_s: f64,
    pub frames: &'a [WindowFrame],
    pub references: Vec<Option<Reference>>,
    pub height_m: f64,
    pub spline: Spline,
    /// `None` over a plane.
    pub elevations: Option<Elevations>,
}

impl Adjusting<'_> {
    /// One iteration, with the jerk of the greatest evidence (empirical Bayes: D. MacKay, *Bayesian
    /// interpolation*, 1992).
    pub fn step(&mut self, jerks: &[f64]) -> Option<Step> {
        let NormalEquations { matrix, vector, couplings } = self.normal_equations();
        let solve = |&jerk: &f64| {
            let (mut with_jerk, mut gradient) = (matrix.clone(), vector.clone());
            self.add_jerk(&mut with_jerk, &mut gradient, jerk);
            let factor = with_jerk.cholesky()?;
            let change = factor.solve(&gradient);
            let control = self.changed(&change);
            let mut product = vector.clone();
            product.sygemv(1.0, &matrix, &change, -2.0);
            let cost = change.dot(&product)
                + self.jerks(&control).map(|jerks| jerks.norm_squared()).sum::<f64>() / (jerk * jerk);
            let log_determinant = 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
            let numbers = 6 * (control.len() - THIRD_DIFFERENCE.len() + 1);
            let log_evidence = -0.5 * (cost + log_determinant) - numbers as f64 * jerk.ln();
            log_evidence.is_finite().then_some((log_evidence, factor, control, change))
        };
        let best = jerks.iter().filter_map(solve).max_by(|a, b| a.0.total_cmp(&b.0));
        let (_, normal, control, change) = best?;
        self.spline.control = control;
        self.readout_s += change[change.len() - 1];
        if let Some(elevations) = &mut self.elevations {
            elevations.update(&couplings, &change);
        }
        let change = normal.l().tr_mul(&change).norm();
        Some(Step { normal, change })
    }

    /// Standard deviation of the tracks, pixels.
    pub fn sigma_px(&self) -> f64 {
        sigma_px(&self.all_residuals())
    }

    fn all_residuals(&self) -> Vec<Vec<(usize, TrackResidual)>> {
        (0..self.frames.len()).map(|index| self.residuals(index)).collect()
    }

    /// The normal equations of all but the jerk; elevations are eliminated (Schur complement).
    fn normal_equations(&self) -> NormalEquations {
        let size = 6 * self.spline.control.len() + 1;
        let (mut matrix, mut vector) = (DMatrix::zeros(size, size), DVector::zeros(size));
        let mut couplings = self.no_couplings(size);
        let residuals = self.all_residuals();
        let sigma_px = sigma_px(&residuals);
        for (index, residuals) in residuals.iter().enumerate() {
            let Some(reference) = &self.references[index] else { continue };
            let basis = self.spline.basis(self.frames[index].time_s);
            let parts = parts(&basis, reference);
            add_local(&mut matrix, &mut vector, &local_equations(residuals, sigma_px), &parts);
            if !couplings.is_empty() {
                residuals.iter().for_each(|(corner, track)| couplings[*corner].add(track, sigma_px, &parts));
            }
        }
        couplings.iter().for_each(|coupling| coupling.eliminate(&mut matrix, &mut vector));
        self.add_poses(&mut matrix, &mut vector);
        let information = 1.0 / self.readout.variance_s2.max(FIXED_S * FIXED_S);
        matrix[(size - 1, size - 1)] += information;
        vector[size - 1] += information * (self.readout.mean_s - self.readout_s);
        NormalEquations { matrix, vector, couplings }
    }

    /// The elevations as they are expected.
    fn no_couplings(&self, size: usize) -> Vec<Coupling> {
        let Some(elevations) = &self.elevations else { return Vec::new() };
        let prior = |(height, expected): (&f64, &f64)| Coupling {
            information: 1.0 / elevations.variance,
            slope: (expected - height) / elevations.variance,
            by_controls: DVector::zeros(size),
        };
        elevations.heights.iter().zip(&elevations.expected).map(prior).collect()
    }

    /// The control points after a change in heights and radians.
    fn changed(&self, change: &DVector<f64>) -> Vec<PoseRates> {
        let changed = |(k, control): (usize, &PoseRates)| {
            control + PoseRates::from_fn(|i, _| unit(i, self.height_m) * change[6 * k + i])
        };
        self.spline.control.iter().enumerate().map(changed).collect()
    }

    /// The jerk in each interval, heights and radians per second³.
    fn jerks<'b>(&self, control: &'b [PoseRates]) -> impl Iterator<Item = PoseRates> + 'b {
        let (cube_s3, height_m) = (self.spline.step_s().powi(3), self.height_m);
        control.windows(THIRD_DIFFERENCE.len()).map(move |near| {
            let difference: PoseRates = near.iter().zip(THIRD_DIFFERENCE).map(|(c, weight)| c * weight).sum();
            PoseRates::from_fn(|i, _| difference[i] / (unit(i, height_m) * cube_s3))
        })
    }

    /// Adds what is known of the jerk.
    fn add_jerk(&self, matrix: &mut DMatrix<f64>, vector: &mut DVector<f64>, sigma: f64) {
        let weights = THIRD_DIFFERENCE.map(|weight| weight / self.spline.step_s().powi(3));
        for (first, jerk) in self.jerks(&self.spline.control).enumerate() {
            add_prior(matrix, vector, first, &weights, &-jerk, sigma);
        }
    }

    /// The residuals of a frame's tracks, with the numbers of their corners.
    fn residuals(&self, index: usize) -> Vec<(usize, TrackResidual)> {
        let (frame, reference) = (&self.frames[index], &self.references[index]);
        let keyframe = match reference {
            Some(Reference::Inside(basis)) => self.spline.at(basis),
            Some(Reference::Before(state)) => *state,
            None => return Vec::new(),
        };
        let states = [&self.spline.at(&self.spline.basis(frame.time_s)), &keyframe];
        let residual = |(number, track)| {
            let corner = self.elevations.as_ref().map_or(0, |all| all.corners[index][number]);
            let height = self.elevations.as_ref().map_or(0.0, |all| all.heights[corner]);
            let residual =
                TrackResidual::new(self.camera, track, self.readout_s, states, (height, self.height_m));
            Some((corner, residual?))
        };
        frame.tracks.iter().enumerate().filter_map(residual).collect()
    }

    /// Adds the gauge, the pose of the first keyframe as the odometry has it, and that the other
    /// poses are near those of the odometry.
    fn add_poses(&self, matrix: &mut DMatrix<f64>, vector: &mut DVector<f64>) {
        // A keyframe before the window fixes the gauge by itself.
        let is_fixed = self.references.iter().flatten().any(|known| matches!(known, Reference::Before(_)));
        let is_keyframe =
            |at: f64| self.frames.iter().any(|frame| frame.keyframe.is_some_and(|(time_s, _)| time_s == at));
        let fixed = self.frames.iter().position(|frame| !is_fixed && is_keyframe(frame.time_s));
        for (index, frame) in self.frames.iter().enumerate() {
            let basis = self.spline.basis(frame.time_s);
            let [pose, ..] = self.spline.at(&basis);
            let sigma = if fixed == Some(index) { EXACT } else { LOOSE };
            let error = PoseRates::from_fn(|i, _| (frame.pose[i] - pose[i]) / unit(i, self.height_m));
            add_prior(matrix, vector, basis.first, &basis.weights[0], &error, sigma);
        }
    }
}

/// Adds that a weighted sum of control points is off by `error`, give or take `sigma`, in heights
/// and radians.
fn add_prior(
    matrix: &mut DMatrix<f64>,
    vector: &mut DVector<f64>,
    first: usize,
    weights: &[f64],
    error: &PoseRates,
    sigma: f64,
) {
    for (k, weight) in weights.iter().map(|weight| weight / (sigma * sigma)).enumerate() {
        for i in 0..6 {
            let at = 6 * (first + k) + i;
            vector[at] += weight * error[i];
            for (l, other) in weights.iter().enumerate() {
                matrix[(6 * (first + l) + i, at)] += weight * other;
            }
        }
    }
}

/// The standard deviation of residuals, pixels.
fn sigma_px(residuals: &[Vec<(usize, TrackResidual)>]) -> f64 {
    let errors: Vec<f64> = residuals.iter().flatten().flat_map(|(_, track)| track.error).collect();
    normal_sigma(&errors).max(LEAST_NOISE_PX)
}

/// Where the numbers of [`LocalEquations`] come from: the first number of a control point, the
/// first of the local numbers, and the weight of the former in the latter.
type Part = (usize, usize, f64);

fn parts(basis: &Basis, reference: &Reference) -> Vec<Part> {
    let part = |basis: &Basis, offset: usize| {
        let (first, weights) = (basis.first, basis.weights);
        (0..3).flat_map(move |order| {
            (0..SUPPORT).map(move |k| (6 * (first + k), offset + 6 * order, weights[order][k]))
        })
    };
    let mut parts: Vec<Part> = part(basis, 0).collect();
    if let Reference::Inside(basis) = reference {
        parts.extend(part(basis, KEYFRAME));
    }
    parts
}

/// Adds the normal equations of a frame to those of the control points.
fn add_local(matrix: &mut DMatrix<f64>, vector: &mut DVector<f64>, local: &LocalEquations, parts: &[Part]) {
    let readout = vector.len() - 1;
    vector[readout] += local.vector[READOUT];
    matrix[(readout, readout)] += local.matrix[READOUT][READOUT];
    for &(to, from, weight) in parts {
        for i in 0..6 {
            vector[to + i] += weight * local.vector[from + i];
            matrix[(readout, to + i)] += weight * local.matrix[from + i][READOUT];
        }
        for &(other_to, other_from, other) in parts.iter().filter(|(other_to, ..)| *other_to >= to) {
            for i in 0..6 {
                for k in 0..6 {
                    matrix[(other_to + k, to + i)] += weight * other * local.matrix[from + i][other_from + k];
                }
            }
        }
    }
}

/// The robust weight of a track, pixels⁻².
fn weight(track: &TrackResidual, sigma_px: f64) -> f64 {
    let square = (track.error[0].powi(2) + track.error[1].powi(2)) / (sigma_px * sigma_px);
    ROBUST.weight_of_square(square) / (sigma_px * sigma_px)
}

/// The normal equations of the tracks of a frame, with robust weights.
fn local_equations(residuals: &[(usize, TrackResidual)], sigma_px: f64) -> LocalEquations {
    let mut local = LocalEquations { matrix: Box::new([[0.0; LOCAL]; LOCAL]), vector: [0.0; LOCAL] };
    for (_, track) in residuals {
        let weight = weight(track, sigma_px);
        for (row, error) in track.rows.iter().zip(&track.error) {
            for i in 0..LOCAL {
                let weighted = weight * row[i];
                local.vector[i] -= weighted * error;
                let entries = local.matrix[i][..=i].iter_mut().zip(row);
                entries.for_each(|(entry, other)| *entry += weighted * other);
            }
        }
    }
    for i in 0..LOCAL {
        (0..i).for_each(|k| local.matrix[k][i] = local.matrix[i][k]);
    }
    local
}

impl Coupling {
    /// Adds a track of the corner.
    fn add(&mut self, track: &TrackResidual, sigma_px: f64, parts: &[Part]) {
        let weight = weight(track, sigma_px);
        let mut local = [0.0; LOCAL];
        for ((row, error), by_elevation) in track.rows.iter().zip(&track.error).zip(&track.by_elevation) {
            let weighted = weight * by_elevation;
            self.information += weighted * by_elevation;
            self.slope -= weighted * error;
            local.iter_mut().zip(row).for_each(|(entry, other)| *entry += weighted * other);
        }
        for &(to, from, weight) in parts {
            for i in 0..6 {
                self.by_controls[to + i] += weight * local[from + i];
            }
        }
        let readout = self.by_controls.len() - 1;
        self.by_controls[readout] += local[READOUT];
    }

    /// Eliminates the elevation from the normal equations (Schur complement).
    fn eliminate(&self, matrix: &mut DMatrix<f64>, vector: &mut DVector<f64>) {
        let coupled: Vec<(usize, f64)> =
            self.by_controls.iter().copied().enumerate().filter(|(_, value)| *value != 0.0).collect();
        for (number, &(i, value)) in coupled.iter().enumerate() {
            let scaled = value / self.information;
            vector[i] -= scaled * self.slope;
            let mut column = matrix.column_mut(i);
            coupled[number..].iter().for_each(|&(k, other)| column[k] -= scaled * other);
        }
    }
}

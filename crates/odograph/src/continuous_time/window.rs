//! The adjustment of a window of frames: a spline of poses by Gauss–Newton on the re-projection
//! errors of all tracks, each seen from the poses of its rows.

use super::spline::{Basis, SUPPORT, Spline};
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel, Ray};
use crate::motion::{
    Axes, Elevation, ImageMotion, MeasuredMotion, Observation, PoseRates, Readout, RollingShutter,
    ground_by_pose, residual,
};
use crate::numerics::{Loss, median, normal_sigma};
use crate::odometry::TrackView;
use crate::odometry::tracking::track_whitenings;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix2, Vector3};

/// A frame of a window.
#[derive(Debug, Clone)]
pub struct WindowFrame {
    pub time_s: f64,
    /// The pose by the odometry.
    pose: PoseRates,
    /// Time of the keyframe that the frame was measured against, and its pose.
    keyframe: Option<(f64, PoseRates)>,
    tracks: Vec<WindowTrack>,
}

/// A corner of a keyframe and where it is in a frame.
#[derive(Debug, Clone, Copy)]
struct WindowTrack {
    corner: Pixel,
    pixel: Pixel,
    whitening: Matrix2<f64>,
    elevation: Elevation,
}

impl WindowFrame {
    /// With at most this number of tracks, evenly chosen.
    pub fn new(
        (time_s, pose): (f64, PoseRates),
        keyframe: Option<(f64, PoseRates)>,
        tracks: &[TrackView],
        most: usize,
    ) -> Self {
        let agreeing: Vec<&TrackView> =
            tracks.iter().filter(|track| track.inlier && keyframe.is_some()).collect();
        let every = agreeing.len().div_ceil(most).max(1);
        let chosen: Vec<&TrackView> = agreeing.into_iter().step_by(every).collect();
        let track = |(track, whitening): (&&TrackView, Matrix2<f64>)| {
            let TrackView { corner, pixel, elevation, .. } = **track;
            WindowTrack { corner, pixel, whitening, elevation }
        };
        let tracks = chosen.iter().zip(track_whitenings(&chosen)).map(track).collect();
        Self { time_s, pose, keyframe, tracks }
    }
}

/// Intervals of the spline from one frame to the next. One cannot follow a vibration of 8 to 12 Hz
/// at 30 frames a second: all frames of two such drives adjusted together are off by 0.12 and 0.14
/// % of each metre, with 1.5 by 0.017 and 0.018, with 2 by 0.022 and 0.029.
const INTERVALS_PER_FRAME: f64 = 1.5;

/// Standard deviations of the jerk, heights or radians per second³: from a camera that is shaken
/// hard to a cart in a bend. The evidence chooses one of them.
const JERKS: [f64; 4] = [400.0, 80.0, 16.0, 3.2];

/// Weights of control points in the jerk, times the cube of an interval.
const THIRD_DIFFERENCE: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];

/// Standard deviation of the poses by the odometry, heights or radians: it only holds what no track
/// determines.
const LOOSE: f64 = 0.05;

/// Standard deviation of the pose that fixes the gauge, heights or radians.
const EXACT: f64 = 1e-6;

/// Iterations of Gauss–Newton. Six change the error of fifteen shaken drives by 4 % at most.
const ITERATIONS: usize = 3;

/// Residuals count in full up to this number of standard deviations.
const ROBUST: Loss = Loss::Huber(2.0);

/// Least standard deviation of a track, pixels.
const LEAST_NOISE_PX: f64 = 0.005;

/// A readout time that is known is not estimated: its standard deviation, seconds.
const FIXED_S: f64 = 1e-9;

/// Rates with a larger standard deviation than this, heights or radians per second, are not used:
/// prediction is as good. Not derived; chosen: it is off by some 0.1 where a camera is shaken.
const MAX_RATE_DEVIATION: f64 = 0.1;

/// Fewer frames, and fewer tracks in all, do not determine a motion.
const LEAST_FRAMES: usize = 4;
const LEAST_TRACKS: usize = 100;

/// Numbers that determine the poses of the rows of a frame and of its keyframe: pose, rate and
/// acceleration of both, and the readout time.
const LOCAL: usize = 37;
const KEYFRAME: usize = 18;
const READOUT: usize = 36;

/// Normal equations of the tracks of one frame.
struct LocalEquations {
    matrix: Box<[[f64; LOCAL]; LOCAL]>,
    vector: [f64; LOCAL],
}

/// An adjusted window.
pub struct Window<'a> {
    frames: &'a [WindowFrame],
    spline: Spline,
    normal: Cholesky<f64, Dyn>,
    height_m: f64,
    /// The readout time, seconds.
    pub readout_s: f64,
}

/// The motion of a camera at some time: pose, rates and accelerations.
type State = [PoseRates; 3];

/// How a frame's keyframe is known.
enum Reference {
    /// It is in the window.
    Inside(Basis),
    /// It is not, and its motion was measured before.
    Before(State),
}

impl<'a> Window<'a> {
    /// Adjusts the frames, with the readout time as it is expected. `None` where they determine no
    /// motion.
    pub fn adjusted(
        camera: &Camera,
        readout: Readout,
        frames: &'a [WindowFrame],
        measured: &MeasuredMotion,
    ) -> Option<Self> {
        let (first, last) = (frames.first()?, frames.last()?);
        let mut steps: Vec<f64> = frames.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).collect();
        let step_s = median(&mut steps)? / INTERVALS_PER_FRAME;
        if frames.len() < LEAST_FRAMES || last.time_s - first.time_s > 4.0 * step_s * frames.len() as f64 {
            return None;
        }
        let spline = Spline::new(first.time_s, last.time_s, step_s, |time_s| interpolated(frames, time_s));
        let references = references(frames, &spline, measured);
        let tracks: usize = frames
            .iter()
            .zip(&references)
            .filter(|(_, known)| known.is_some())
            .map(|(frame, _)| frame.tracks.len())
            .sum();
        if tracks < LEAST_TRACKS {
            return None;
        }
        let mut adjusting = Adjusting {
            camera,
            readout,
            readout_s: readout.mean_s,
            frames,
            references,
            height_m: first.pose[3],
            spline,
        };
        for _ in 1..ITERATIONS {
            adjusting.step(&JERKS[..1])?;
        }
        let normal = adjusting.step(&JERKS)?;
        let Adjusting { spline, height_m, readout_s, .. } = adjusting;
        Some(Self { frames, spline, normal, height_m, readout_s })
    }

    /// The variance of the readout time, seconds².
    pub fn readout_variance_s2(&self) -> f64 {
        let last = self.normal.l_dirty().nrows() - 1;
        self.normal.l_dirty()[(last, last)].powi(-2)
    }

    /// The motion within a frame; `None` where it is hardly known.
    pub fn motion(&self, index: usize) -> Option<ImageMotion> {
        let frame = &self.frames[index];
        let basis = self.spline.basis(frame.time_s);
        let [_, rates, accelerations] = self.spline.at(&basis);
        let mut selected = DMatrix::zeros(6 * self.spline.control.len() + 1, 6);
        for (k, weight) in basis.weights[1].iter().enumerate() {
            for i in 0..6 {
                selected[(6 * (basis.first + k) + i, i)] = *weight;
            }
        }
        let half = self.normal.l_dirty().solve_lower_triangular(&selected)?;
        let rate_variance =
            PoseRates::from_fn(|i, _| unit(i, self.height_m).powi(2) * half.column(i).norm_squared());
        let is_known = (0..6).all(|i| rate_variance[i].sqrt() < MAX_RATE_DEVIATION * unit(i, self.height_m));
        is_known.then_some(ImageMotion { time_s: frame.time_s, rates, rate_variance, accelerations })
    }
}

/// The unit of a number of the pose: a height, or a radian.
fn unit(index: usize, height_m: f64) -> f64 {
    if matches!(index, 0 | 1 | 3) { height_m } else { 1.0 }
}

/// The pose between two frames, or beyond the first or the last one.
fn interpolated(frames: &[WindowFrame], time_s: f64) -> PoseRates {
    let next = frames.partition_point(|frame| frame.time_s < time_s).clamp(1, frames.len() - 1);
    let (a, b) = (&frames[next - 1], &frames[next]);
    a.pose.lerp(&b.pose, (time_s - a.time_s) / (b.time_s - a.time_s))
}

/// How the keyframe of each frame is known: of those before the window only the first, because the
/// odometry may put two of them at places that do not fit.
fn references(frames: &[WindowFrame], spline: &Spline, measured: &MeasuredMotion) -> Vec<Option<Reference>> {
    let begin_s = frames[0].time_s;
    let before_s = frames
        .iter()
        .filter_map(|frame| frame.keyframe)
        .map(|(time_s, _)| time_s)
        .find(|time_s| *time_s < begin_s);
    let reference = |frame: &WindowFrame| {
        let (time_s, pose) = frame.keyframe?;
        if time_s >= begin_s {
            return Some(Reference::Inside(spline.basis(time_s)));
        }
        let motion = measured.at(time_s).filter(|_| before_s == Some(time_s))?;
        Some(Reference::Before([pose, motion.rates, motion.accelerations]))
    };
    frames.iter().map(reference).collect()
}

/// Gauss–Newton on a window.
struct Adjusting<'a> {
    camera: &'a Camera,
    /// The readout time as it is expected, and as it is estimated, seconds.
    readout: Readout,
    readout_s: f64,
    frames: &'a [WindowFrame],
    references: Vec<Option<Reference>>,
    height_m: f64,
    spline: Spline,
}

impl Adjusting<'_> {
    /// One iteration, with the jerk of the greatest evidence (empirical Bayes: D. MacKay, *Bayesian
    /// interpolation*, 1992). Returns the Cholesky factor of the normal equations.
    fn step(&mut self, jerks: &[f64]) -> Option<Cholesky<f64, Dyn>> {
        let (matrix, vector) = self.normal_equations();
        let solve = |&jerk: &f64| {
            let (mut with_jerk, mut gradient) = (matrix.clone(), vector.clone());
            self.add_jerk(&mut with_jerk, &mut gradient, jerk);
            let factor = with_jerk.cholesky()?;
            let change = factor.solve(&gradient);
            let control = self.changed(&change);
            let cost = change.dot(&(&matrix * &change)) - 2.0 * vector.dot(&change)
                + self.jerks(&control).map(|jerks| jerks.norm_squared()).sum::<f64>() / (jerk * jerk);
            let log_determinant = 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
            let numbers = 6 * (control.len() - THIRD_DIFFERENCE.len() + 1);
            let log_evidence = -0.5 * (cost + log_determinant) - numbers as f64 * jerk.ln();
            log_evidence.is_finite().then(|| (log_evidence, factor, control, change[change.len() - 1]))
        };
        let best = jerks.iter().filter_map(solve).max_by(|a, b| a.0.total_cmp(&b.0));
        let (_, factor, control, readout_change_s) = best?;
        self.spline.control = control;
        self.readout_s += readout_change_s;
        Some(factor)
    }

    /// The normal equations of all but the jerk.
    fn normal_equations(&self) -> (DMatrix<f64>, DVector<f64>) {
        let size = 6 * self.spline.control.len() + 1;
        let (mut matrix, mut vector) = (DMatrix::zeros(size, size), DVector::zeros(size));
        let residuals: Vec<Vec<TrackResidual>> =
            (0..self.frames.len()).map(|index| self.residuals(index)).collect();
        let errors: Vec<f64> = residuals.iter().flatten().flat_map(|track| track.error).collect();
        let sigma_px = normal_sigma(&errors).max(LEAST_NOISE_PX);
        for (index, residuals) in residuals.iter().enumerate() {
            let Some(reference) = &self.references[index] else { continue };
            let local = local_equations(residuals, sigma_px);
            let basis = self.spline.basis(self.frames[index].time_s);
            self.add(&mut matrix, &mut vector, &local, &basis, reference);
        }
        self.add_poses(&mut matrix, &mut vector);
        let information = 1.0 / self.readout.variance_s2.max(FIXED_S * FIXED_S);
        matrix[(size - 1, size - 1)] += information;
        vector[size - 1] += information * (self.readout.mean_s - self.readout_s);
        (matrix, vector)
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

    /// The residuals of a frame's tracks.
    fn residuals(&self, index: usize) -> Vec<TrackResidual> {
        let (frame, reference) = (&self.frames[index], &self.references[index]);
        let keyframe = match reference {
            Some(Reference::Inside(basis)) => self.spline.at(basis),
            Some(Reference::Before(state)) => *state,
            None => return Vec::new(),
        };
        let state = self.spline.at(&self.spline.basis(frame.time_s));
        let residual = |track: &WindowTrack| {
            TrackResidual::new(self.camera, track, self.readout_s, [&state, &keyframe], self.height_m)
        };
        frame.tracks.iter().filter_map(residual).collect()
    }

    /// Adds the normal equations of a frame to those of the control points.
    fn add(
        &self,
        matrix: &mut DMatrix<f64>,
        vector: &mut DVector<f64>,
        local: &LocalEquations,
        basis: &Basis,
        reference: &Reference,
    ) {
        let part = |basis: &Basis, offset: usize| {
            let (first, weights) = (basis.first, basis.weights);
            (0..3).flat_map(move |order| {
                (0..SUPPORT).map(move |k| (6 * (first + k), offset + 6 * order, weights[order][k]))
            })
        };
        let mut parts: Vec<(usize, usize, f64)> = part(basis, 0).collect();
        if let Reference::Inside(basis) = reference {
            parts.extend(part(basis, KEYFRAME));
        }
        let readout = vector.len() - 1;
        vector[readout] += local.vector[READOUT];
        matrix[(readout, readout)] += local.matrix[READOUT][READOUT];
        for &(to, from, weight) in &parts {
            for i in 0..6 {
                vector[to + i] += weight * local.vector[from + i];
                matrix[(to + i, readout)] += weight * local.matrix[from + i][READOUT];
                matrix[(readout, to + i)] += weight * local.matrix[from + i][READOUT];
            }
            for &(other_to, other_from, other) in &parts {
                for i in 0..6 {
                    for k in 0..6 {
                        matrix[(other_to + k, to + i)] +=
                            weight * other * local.matrix[from + i][other_from + k];
                    }
                }
            }
        }
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

/// The re-projection error of a track, whitened, pixels, and its derivatives by [`LOCAL`] numbers.
struct TrackResidual {
    error: [f64; 2],
    /// Derivative by the elevation, in standard deviations of its prior.
    by_elevation: [f64; 2],
    rows: [[f64; LOCAL]; 2],
}

impl TrackResidual {
    /// Of a track in rows of its frame and of its keyframe, which move as `states` say.
    fn new(
        camera: &Camera,
        track: &WindowTrack,
        readout_s: f64,
        states: [&State; 2],
        height_m: f64,
    ) -> Option<Self> {
        let shutter = RollingShutter::new(camera, readout_s, PoseRates::zeros());
        let at = |[pose, rates, accelerations]: &State, y: f64| {
            let (rates, accelerations) = (*rates, *accelerations);
            RollingShutter { rates, accelerations, ..shutter }.pose_at(&GroundPose::from_vector(pose), y)
        };
        let (pose, keyframe) = (at(states[0], track.pixel.y), at(states[1], track.corner.y));
        let ray: Ray = camera.ray_from_pixel(track.corner)?;
        let at_elevation = |elevation: Elevation| {
            Some(Observation {
                ground: GroundPose { height_m: keyframe.height_m - elevation.mean_m, ..keyframe }
                    .ground_from_ray(ray)?,
                elevation,
                pixel: track.pixel,
                whitening: track.whitening,
                row_fraction: 0.0,
                keyframe_row_fraction: 0.0,
                centre_of_projection: Vector3::zeros(),
                corrected_at_m: 0.0,
            })
        };
        let axes = Axes::new(&pose);
        let observation = at_elevation(track.elevation)?;
        let seen = residual(camera, &observation, &pose, &axes)?;
        let mut by_elevation = [0.0; 2];
        if track.elevation.variance_m2 > 0.0 {
            let step_m = 1e-4 * height_m;
            let higher = Elevation { mean_m: track.elevation.mean_m + step_m, ..track.elevation };
            let moved = residual(camera, &at_elevation(higher)?, &pose, &axes)?;
            let deviation_m = track.elevation.variance_m2.sqrt();
            by_elevation = [0, 1].map(|k| deviation_m * (moved.error[k] - seen.error[k]) / step_m);
        }
        let ground = ground_by_pose(&observation, &keyframe, &Axes::new(&keyframe));
        let mut rows = [[0.0; LOCAL]; 2];
        for (row, by_pose) in rows.iter_mut().zip(&seen.by_pose) {
            for i in 0..6 {
                // The ground moves against the camera.
                let by_keyframe = -by_pose[0] * ground[0][i] - by_pose[1] * ground[1][i];
                let both = [(by_pose[i], track.pixel.y), (by_keyframe, track.corner.y)];
                for (part, (derivative, y)) in both.into_iter().enumerate() {
                    let time_s = shutter.row_time_s(y);
                    let [_, rates, accelerations] = states[part];
                    let rate = rates[i] + time_s * accelerations[i];
                    row[READOUT] += derivative * rate * shutter.row_fraction(y);
                    for (order, factor) in [1.0, time_s, 0.5 * time_s * time_s].into_iter().enumerate() {
                        row[part * KEYFRAME + 6 * order + i] = factor * derivative * unit(i, height_m);
                    }
                }
            }
        }
        Some(Self { error: seen.error, rows, by_elevation })
    }
}

/// The normal equations of the tracks of a frame, with robust weights.
fn local_equations(residuals: &[TrackResidual], sigma_px: f64) -> LocalEquations {
    let mut local = LocalEquations { matrix: Box::new([[0.0; LOCAL]; LOCAL]), vector: [0.0; LOCAL] };
    for TrackResidual { error, rows, by_elevation } in residuals {
        let square = (error[0] * error[0] + error[1] * error[1]) / (sigma_px * sigma_px);
        let weight = ROBUST.weight_of_square(square) / (sigma_px * sigma_px);
        // The elevation is eliminated (Schur complement): along the parallax a track has less
        // weight.
        let along = by_elevation[0] * by_elevation[0] + by_elevation[1] * by_elevation[1];
        let schur = 1.0 / (sigma_px * sigma_px + along);
        let mut add = |row: &[f64; LOCAL], error: f64, weight: f64| {
            for i in 0..LOCAL {
                let weighted = weight * row[i];
                local.vector[i] -= weighted * error;
                local.matrix[i].iter_mut().zip(row).for_each(|(entry, other)| *entry += weighted * other);
            }
        };
        rows.iter().zip(error).for_each(|(row, error)| add(row, *error, weight));
        if along > 0.0 {
            let component = |x: f64, y: f64| by_elevation[0] * x + by_elevation[1] * y;
            let row = std::array::from_fn(|i| component(rows[0][i], rows[1][i]));
            add(&row, component(error[0], error[1]), -weight * schur);
        }
    }
    local
}

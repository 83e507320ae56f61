//! Bundle adjustment of lens, board shape and poses by Levenberg–Marquardt with a robust loss.
//!
//! The pose of a view only affects the points of that view, so the poses are eliminated view by
//! view with the Schur complement (B. Triggs et al., "Bundle adjustment: a modern synthesis", 2000,
//! section 6.1). Time and memory are linear in the number of views.

use super::lens::{Free, Lens};
use nalgebra::{
    Isometry3, Matrix3, Matrix6, SMatrix, SVector, Translation3, UnitQuaternion, Vector3, Vector6,
};
use odograph::numerics::{Loss, robust_variance};

/// Maximum number of shared unknowns: those of the lens and of the board shape.
pub const SHARED: usize = 17;
const ROW: usize = 6 + SHARED;
/// Number of groups of four in a padded Jacobian row, for SIMD.
const FOURS: usize = ROW.div_ceil(4);

pub type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
pub type SharedVector = SVector<f64, SHARED>;

/// A correspondence of a board point and its detected pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardCorrespondence {
    pub index: usize,
    /// Position on the board, metres.
    pub on_board: (f64, f64),
    /// Position relative to the middle of the board, normalised to −1 … 1.
    pub relative: (f64, f64),
    /// y coordinate relative to the middle of the board, metres.
    pub down_m: f64,
    pub pixel: (f64, f64),
}

/// The estimated state. `shape` has the order of [`super::result::BoardShape`].
#[derive(Debug, Clone)]
pub struct BundleState {
    pub lens: Lens,
    pub shape: [f64; 5],
    pub poses: Vec<Isometry3<f64>>,
}

impl BundleState {
    /// The same lens and board with the pose of a single view.
    pub fn with_pose(&self, pose: Isometry3<f64>) -> Self {
        Self { lens: self.lens, shape: self.shape, poses: vec![pose] }
    }
}

/// The subset of a [`BundleState`] that is optimised.
#[derive(Debug, Clone)]
pub struct BundleUnknowns {
    pub lens: Vec<Free>,
    pub shape: bool,
    pub poses: bool,
    /// Gaussian priors on lens parameters: index, mean, standard deviation. They are so wide that
    /// they only matter for parameters that the views do not constrain.
    pub priors: Vec<(usize, f64, f64)>,
}

impl BundleUnknowns {
    pub fn poses_only() -> Self {
        Self { lens: Vec::new(), shape: false, poses: true, priors: Vec::new() }
    }

    pub fn shared(&self) -> usize {
        self.lens.len() + if self.shape { 5 } else { 0 }
    }
}

/// Threshold k of the robust loss, in standard deviations. For a residual of s standard deviations,
/// the loss is quadratic up to k and `k² (1/2 + ln(s / k))` beyond, with weight `(k / s)²`. With
/// Gaussian noise 1.1 % of the points lie beyond k.
const BEND: f64 = 3.0;
/// Convergence threshold on the decrease of the loss per step.
const MIN_GAIN: f64 = 1e-4;
/// Residual assumed for a point without a valid projection, pixels.
const NOWHERE_PX: f64 = 1e4;

/// Robust loss and weight of a residual; `square` is its squared length in standard deviations.
fn loss(square: f64) -> (f64, f64) {
    let loss = Loss::Logarithmic(BEND);
    (0.5 * loss.of_square(square), loss.weight_of_square(square))
}

/// Whether a residual of this many standard deviations is an inlier, with weight 1.
pub fn counts_in_full(deviations: f64) -> bool {
    deviations <= BEND
}

/// Position of a point on the deformed board, in the board frame, metres.
pub fn place(sight: &BoardCorrespondence, shape: &[f64; 5]) -> Vector3<f64> {
    let (u, v) = sight.relative;
    Vector3::new(
        sight.on_board.0 + shape[4] * sight.down_m,
        sight.on_board.1 + shape[3] * sight.down_m,
        shape[0] * u * u + shape[1] * u * v + shape[2] * v * v,
    )
}

/// JᵀWJ and JᵀWr of one view. `rows` holds the upper triangle, rounded outwards to groups of four.
struct ViewProducts {
    rows: [[[f64; 4]; FOURS]; ROW],
    right: [f64; ROW],
}

impl ViewProducts {
    fn at(&self, i: usize, j: usize) -> f64 {
        self.rows[i][j / 4][j % 4]
    }
}

/// Blocks of the normal equations for one view: pose, pose and shared unknowns, right-hand side.
struct ViewBlock {
    own: Matrix6<f64>,
    across: SMatrix<f64, 6, SHARED>,
    right: Vector6<f64>,
}

/// The normal equations of all views.
struct BundleNormalEquations {
    views: Vec<ViewBlock>,
    shared: SharedMatrix,
    right: SharedVector,
    cost: f64,
}

/// A bundle adjustment problem. `noise_px` scales the residuals in the robust loss.
pub struct Bundle<'a> {
    pub views: &'a [&'a [BoardCorrespondence]],
    pub unknowns: &'a BundleUnknowns,
    pub noise_px: f64,
}

impl Bundle<'_> {
    fn prior_cost(&self, state: &BundleState) -> f64 {
        let off = |&(at, about, deviation): &(usize, f64, f64)| (state.lens.numbers[at] - about) / deviation;
        self.unknowns.priors.iter().map(|prior| 0.5 * off(prior).powi(2)).sum()
    }

    fn cost(&self, state: &BundleState) -> f64 {
        let inverse = 1.0 / (self.noise_px * self.noise_px);
        let mut cost = self.prior_cost(state);
        for (sights, pose) in self.views.iter().zip(&state.poses) {
            cost += residuals(&state.lens, &state.shape, pose, sights)
                .map(|off| match off {
                    Some((dx, dy)) => loss((dx * dx + dy * dy) * inverse).0,
                    None => loss(NOWHERE_PX * NOWHERE_PX * inverse).0,
                })
                .sum::<f64>();
        }
        cost
    }

    /// The normal equations linearised at a state. Residuals are detected minus predicted.
    fn linearise(&self, state: &BundleState) -> BundleNormalEquations {
        let shared_count = self.unknowns.shared();
        let mut normal = BundleNormalEquations {
            views: Vec::with_capacity(self.views.len()),
            shared: SharedMatrix::zeros(),
            right: SharedVector::zeros(),
            cost: self.prior_cost(state),
        };
        for (sights, pose) in self.views.iter().zip(&state.poses) {
            let mut products = ViewProducts { rows: [[[0.0; 4]; FOURS]; ROW], right: [0.0; ROW] };
            normal.cost += self.add_view(state, pose, sights, shared_count, &mut products);
            let mut block = ViewBlock {
                own: Matrix6::zeros(),
                across: SMatrix::zeros(),
                right: Vector6::from_fn(|i, _| products.right[i]),
            };
            for i in 0..6 {
                for j in i..6 {
                    block.own[(i, j)] = products.at(i, j);
                    block.own[(j, i)] = products.at(i, j);
                }
                for j in 0..shared_count {
                    block.across[(i, j)] = products.at(i, 6 + j);
                }
            }
            for i in 0..shared_count {
                normal.right[i] += products.right[6 + i];
                for j in i..shared_count {
                    normal.shared[(i, j)] += products.at(6 + i, 6 + j);
                }
            }
            normal.views.push(block);
        }
        normal.shared.fill_lower_triangle_with_upper_triangle();
        for &(at, about, deviation) in &self.unknowns.priors {
            if let Some(column) = self.unknowns.lens.iter().position(|free| free.at == at) {
                let information = 1.0 / (deviation * deviation);
                normal.shared[(column, column)] += information;
                normal.right[column] -= (state.lens.numbers[at] - about) * information;
            }
        }
        // Identity rows for unused unknowns keep the matrix invertible.
        for i in shared_count..SHARED {
            normal.shared[(i, i)] = 1.0;
        }
        normal
    }

    /// Accumulates JᵀWJ and JᵀWr of one view; pose unknowns come before the shared ones. Returns
    /// the loss.
    fn add_view(
        &self,
        state: &BundleState,
        pose: &Isometry3<f64>,
        sights: &[BoardCorrespondence],
        shared_count: usize,
        products: &mut ViewProducts,
    ) -> f64 {
        let inverse = 1.0 / (self.noise_px * self.noise_px);
        let rotation: Matrix3<f64> = *pose.rotation.to_rotation_matrix().matrix();
        let lens_count = self.unknowns.lens.len();
        let mut cost = 0.0;
        for sight in sights {
            let turned = rotation * place(sight, &state.shape);
            let Some(projection) = state.lens.project(&(turned + pose.translation.vector)) else {
                cost += loss(NOWHERE_PX * NOWHERE_PX * inverse).0;
                continue;
            };
            let off = [sight.pixel.0 - projection.pixel[0], sight.pixel.1 - projection.pixel[1]];
            let (lost, weight) = loss((off[0] * off[0] + off[1] * off[1]) * inverse);
            cost += lost;
            let mut rows = [[0.0; 4 * FOURS]; 2];
            for (axis, row) in rows.iter_mut().enumerate() {
                let by = projection.by_point.row(axis);
                let (a, b, c) = (by[0], by[1], by[2]);
                if self.unknowns.poses {
                    // by · (ω × turned) = (turned × by) · ω
                    row[0] = turned.y * c - turned.z * b;
                    row[1] = turned.z * a - turned.x * c;
                    row[2] = turned.x * b - turned.y * a;
                    (row[3], row[4], row[5]) = (a, b, c);
                }
                let numbers = &projection.by_numbers[axis];
                for (value, free) in row[6..].iter_mut().zip(&self.unknowns.lens) {
                    *value = numbers[free.at] + free.also.map_or(0.0, |also| numbers[also]);
                }
                if self.unknowns.shape {
                    let along = |column: usize| {
                        a * rotation[(0, column)] + b * rotation[(1, column)] + c * rotation[(2, column)]
                    };
                    let (u, v) = sight.relative;
                    let (x, y, z) = (along(0), along(1), along(2));
                    let by_shape = [z * u * u, z * u * v, z * v * v, y * sight.down_m, x * sight.down_m];
                    row[6 + lens_count..6 + lens_count + 5].copy_from_slice(&by_shape);
                }
            }
            let weight = weight * inverse;
            let count = 6 + shared_count;
            let [first, second] = &rows;
            let (first_fours, second_fours) = (first.as_chunks::<4>().0, second.as_chunks::<4>().0);
            let fours = count.div_ceil(4);
            for i in 0..count {
                let (a, b) = (weight * first[i], weight * second[i]);
                let from = i / 4;
                let target = products.rows[i][from..fours].iter_mut();
                let pairs = first_fours[from..fours].iter().zip(&second_fours[from..fours]);
                for (sum, (x, y)) in target.zip(pairs) {
                    for k in 0..4 {
                        sum[k] += a * x[k] + b * y[k];
                    }
                }
                products.right[i] += a * off[0] + b * off[1];
            }
        }
        if !self.unknowns.poses {
            for i in 0..6 {
                products.rows[i][i / 4][i % 4] = 1.0;
            }
        }
        cost
    }

    /// Levenberg–Marquardt with scaled diagonal (D. Marquardt, 1963), at most `most` steps. Returns
    /// the loss.
    pub fn minimise(&self, state: &mut BundleState, most: usize) -> f64 {
        let mut damping = 1e-4;
        let mut normal = self.linearise(state);
        for _ in 0..most {
            let mut gained = None;
            while damping < 1e12 {
                let next =
                    normal.step(damping).and_then(|(shared, poses)| self.moved(state, &shared, &poses));
                if let Some(next) = next {
                    let cost = self.cost(&next);
                    if cost < normal.cost {
                        gained = Some(normal.cost - cost);
                        *state = next;
                        damping = (damping * 0.1).max(1e-12);
                        break;
                    }
                    // The cost only differs by rounding: the state is at the minimum.
                    if cost - normal.cost <= 1e-12 * normal.cost {
                        break;
                    }
                }
                damping *= 10.0;
            }
            let Some(gained) = gained else { break };
            // Two residual components of pure noise have an expected loss of 1, so a decrease this
            // small moves the estimate by about a hundredth of a standard deviation.
            if gained < MIN_GAIN + 1e-12 * normal.cost {
                return normal.cost - gained;
            }
            normal = self.linearise(state);
        }
        normal.cost
    }

    /// The state after a step; `None` if the lens parameters become invalid.
    fn moved(
        &self,
        state: &BundleState,
        shared: &SharedVector,
        poses: &[Vector6<f64>],
    ) -> Option<BundleState> {
        let mut next = state.clone();
        for (free, step) in self.unknowns.lens.iter().zip(shared.iter()) {
            next.lens.numbers[free.at] += step;
            if let Some(also) = free.also {
                next.lens.numbers[also] += step;
            }
        }
        if self.unknowns.shape {
            let count = self.unknowns.lens.len();
            next.shape.iter_mut().zip(shared.iter().skip(count)).for_each(|(number, step)| *number += step);
        }
        if self.unknowns.poses {
            for (pose, step) in next.poses.iter_mut().zip(poses) {
                *pose = moved_pose(pose, step);
            }
        }
        next.lens.possible().then_some(next)
    }

    /// Information matrix of the shared unknowns with the poses marginalised out, in units of the
    /// noise. Unused unknowns have 1 on the diagonal.
    pub fn information(&self, state: &BundleState) -> Option<SharedMatrix> {
        self.linearise(state).reduced(0.0).map(|(information, ..)| information)
    }
}

/// The pose after a perturbation (ω, δ) in the camera frame: rotation about the camera axes, then
/// translation.
pub fn moved_pose(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
    let shift = Vector3::new(step[3], step[4], step[5]);
    let mut rotation = turn * pose.rotation;
    rotation.renormalize();
    Isometry3::from_parts(Translation3::from(pose.translation.vector + shift), rotation)
}

type Eliminated = (Matrix6<f64>, SMatrix<f64, 6, SHARED>, Vector6<f64>);

impl BundleNormalEquations {
    /// The reduced (Schur complement) equations of the shared unknowns. For back substitution also
    /// returns, for each view, the inverse pose block times the pose–shared block and times the
    /// right-hand side.
    fn reduced(&self, damping: f64) -> Option<(SharedMatrix, SharedVector, Vec<Eliminated>)> {
        let mut shared = self.shared;
        let mut right = self.right;
        for i in 0..SHARED {
            shared[(i, i)] *= 1.0 + damping;
        }
        let mut eliminated = Vec::with_capacity(self.views.len());
        for view in &self.views {
            let mut own = view.own;
            for i in 0..6 {
                own[(i, i)] = own[(i, i)] * (1.0 + damping) + 1e-300;
            }
            let factor = own.cholesky()?;
            let across = factor.solve(&view.across);
            let alone = factor.solve(&view.right);
            shared -= view.across.tr_mul(&across);
            right -= view.across.tr_mul(&alone);
            eliminated.push((own, across, alone));
        }
        Some((shared, right, eliminated))
    }

    /// The step of the shared unknowns and, by back substitution, of each pose.
    fn step(&self, damping: f64) -> Option<(SharedVector, Vec<Vector6<f64>>)> {
        let (matrix, right, eliminated) = self.reduced(damping)?;
        let shared = scaled_solve(&matrix, &right)?;
        let poses = eliminated.iter().map(|(_, across, alone)| alone - across * shared).collect();
        Some((shared, poses))
    }
}

/// Cholesky solution with diagonal preconditioning to a unit diagonal: coefficients and pixels
/// differ by many orders of magnitude.
fn scaled_solve(matrix: &SharedMatrix, right: &SharedVector) -> Option<SharedVector> {
    let scale = matrix.diagonal().map(|d| 1.0 / d.max(1e-300).sqrt());
    let scaled = SharedMatrix::from_fn(|i, j| matrix[(i, j)] * scale[i] * scale[j]);
    let solution = scaled.cholesky()?.solve(&right.component_mul(&scale));
    let solution = solution.component_mul(&scale);
    solution.iter().all(|number| number.is_finite()).then_some(solution)
}

/// Residual of each point in x and y, detected minus predicted, pixels; `None` for points without a
/// valid projection.
pub fn residuals<'a>(
    lens: &'a Lens,
    shape: &'a [f64; 5],
    pose: &Isometry3<f64>,
    sights: &'a [BoardCorrespondence],
) -> impl Iterator<Item = Option<(f64, f64)>> + use<'a> {
    let rotation: Matrix3<f64> = *pose.rotation.to_rotation_matrix().matrix();
    let shift = pose.translation.vector;
    sights.iter().map(move |sight| {
        let [x, y] = lens.pixel(&(rotation * place(sight, shape) + shift))?;
        Some((sight.pixel.0 - x, sight.pixel.1 - y))
    })
}

/// Index and residual in x and y of each point of a view that has a valid projection, pixels, and
/// the sum of their squares.
pub fn listed_residuals(
    state: &BundleState,
    pose: &Isometry3<f64>,
    sights: &[BoardCorrespondence],
) -> (Vec<(usize, f64, f64)>, f64) {
    let off = residuals(&state.lens, &state.shape, pose, sights);
    let listed: Vec<(usize, f64, f64)> =
        sights.iter().zip(off).filter_map(|(s, off)| off.map(|(dx, dy)| (s.index, dx, dy))).collect();
    let squares = listed.iter().map(|(_, dx, dy)| dx * dx + dy * dy).sum();
    (listed, squares)
}

/// Robust estimate of the detection noise per axis, pixels. It is the median residual length over
/// √(2 ln 2), as for Gaussian noise, corrected for the degrees of freedom of `unknowns` estimated
/// parameters.
pub fn robust_noise_px(views: &[&[BoardCorrespondence]], state: &BundleState, unknowns: usize) -> f64 {
    let mut squares: Vec<f64> = Vec::new();
    for (sights, pose) in views.iter().zip(&state.poses) {
        let off = residuals(&state.lens, &state.shape, pose, sights);
        squares.extend(off.map(|off| off.map_or(NOWHERE_PX * NOWHERE_PX, |(dx, dy)| dx * dx + dy * dy)));
    }
    let numbers = 2.0 * squares.len() as f64;
    let freedom = (numbers - unknowns as f64).max(0.1 * numbers) / numbers;
    let variance = robust_variance::<2>(&mut squares);
    variance.map_or(0.0, |variance| (variance / freedom).sqrt()).max(MIN_NOISE_PX)
}

/// Lower bound of the noise, pixels; exact synthetic points would otherwise have a scale of zero.
pub const MIN_NOISE_PX: f64 = 1e-3;

/// Alternates minimisation and estimation of the noise until the noise changes by less than 5 %, at
/// most six times. Returns the noise, pixels.
pub fn adjust(
    views: &[&[BoardCorrespondence]],
    state: &mut BundleState,
    unknowns: &BundleUnknowns,
    most: usize,
) -> f64 {
    let count = unknowns.shared() + if unknowns.poses { 6 * views.len() } else { 0 };
    let mut noise_px = robust_noise_px(views, state, count);
    for _ in 0..6 {
        Bundle { views, unknowns, noise_px }.minimise(state, most);
        let now_px = robust_noise_px(views, state, count);
        let settled = (now_px / noise_px - 1.0).abs() < 0.05;
        noise_px = now_px;
        if settled {
            break;
        }
    }
    noise_px
}

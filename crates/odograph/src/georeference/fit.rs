//! The estimate: a first one by random sampling, then iteratively reweighted least squares
//! (`docs/math/georeference.md`).

use super::{AntennaPosition, GnssFix};
use crate::geometry::{GroundPoint, Sim2};
use crate::motion::Random;
use crate::numerics::{Loss, robust_variance, variance_of_mean_factor};
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};
use std::f64::consts::PI;

/// The unknowns: direction of the map's x, counter-clockwise from east; east and north of the
/// path's middle; the receiver's time less the camera's; logarithm of the scale; the antenna ahead
/// and to the left of where it was taken to be.
pub const HEADING: usize = 0;
pub const EAST: usize = 1;
const NORTH: usize = 2;
pub const CLOCK: usize = 3;
pub const SCALE: usize = 4;
pub const ANTENNA: usize = 5;
const UNKNOWNS: usize = 7;

/// Covariance or information of the unknowns.
pub type Unknowns = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// Which unknowns are estimated beside the placement and the clock.
#[derive(Debug, Clone, Copy, Default)]
struct Freedom {
    scale: bool,
    antenna: bool,
}

impl Freedom {
    fn unknowns(self) -> f64 {
        4.0 + f64::from(u8::from(self.scale)) + 2.0 * f64::from(u8::from(self.antenna))
    }
}

/// A fix with the path at its time.
#[derive(Debug, Clone, Copy)]
pub struct FixPair {
    /// Number of the fix.
    pub fix: usize,
    /// The antenna in the map.
    pub position_m: Vector2<f64>,
    velocity_m_s: Vector2<f64>,
    /// Directions ahead and to the left in the map.
    axes: Matrix2<f64>,
    path_covariance_m2: Matrix2<f64>,
    /// The fix in the tangent plane.
    in_plane_m: Vector2<f64>,
    pub covariance_m2: Matrix2<f64>,
}

/// Path and fixes.
pub struct Pairing<'a> {
    pub path: &'a [AntennaPosition],
    pub fixes: &'a [GnssFix],
    /// The fixes in the tangent plane, metres.
    pub in_plane: &'a [Vector2<f64>],
}

impl Pairing<'_> {
    /// The fixes at whose times there is a path, if the receiver's clock is ahead by `offset_s`.
    pub fn at(&self, offset_s: f64) -> Vec<FixPair> {
        (0..self.fixes.len()).filter_map(|fix| self.pair(fix, offset_s)).collect()
    }

    fn pair(&self, fix: usize, offset_s: f64) -> Option<FixPair> {
        let time_s = self.fixes[fix].time_s - offset_s;
        let next = self.path.partition_point(|at| at.time_s <= time_s).min(self.path.len().checked_sub(1)?);
        let (before, after) = (&self.path[next.checked_sub(1)?], &self.path[next]);
        let step_s = after.time_s - before.time_s;
        let within = (before.time_s..=after.time_s).contains(&time_s);
        let is_step = step_s > 0.0 && step_s <= AntennaPosition::LONGEST_STEP_S;
        if !within || !is_step || before.segment != after.segment {
            return None;
        }
        let velocity_m_s = (after.position_m - before.position_m) / step_s;
        Some(FixPair {
            fix,
            position_m: before.position_m + velocity_m_s * (time_s - before.time_s),
            velocity_m_s,
            axes: rotation(after.heading_rad),
            path_covariance_m2: after.covariance_m2,
            in_plane_m: self.in_plane[fix],
            covariance_m2: self.fixes[fix].covariance_m2,
        })
    }
}

/// Values of the unknowns.
#[derive(Debug, Clone, Copy)]
struct PlacementModel {
    heading_rad: f64,
    middle_in_plane_m: Vector2<f64>,
    offset_s: f64,
    scale: f64,
    antenna_m: Vector2<f64>,
}

fn rotation(angle_rad: f64) -> Matrix2<f64> {
    let (sin, cos) = angle_rad.sin_cos();
    Matrix2::new(cos, -sin, sin, cos)
}

impl PlacementModel {
    fn rotation(&self) -> Matrix2<f64> {
        rotation(self.heading_rad)
    }

    fn residual(&self, pair: &FixPair, middle_m: Vector2<f64>) -> Vector2<f64> {
        let position_m = pair.position_m + pair.axes * self.antenna_m;
        let arm = self.scale * (self.rotation() * (position_m - middle_m));
        pair.in_plane_m - self.middle_in_plane_m - arm
    }

    /// Covariance of the residual.
    fn covariance(&self, pair: &FixPair) -> Matrix2<f64> {
        let turned = self.scale * self.rotation();
        pair.covariance_m2 + turned * pair.path_covariance_m2 * turned.transpose()
    }
}

/// The estimate.
pub struct Fitted {
    /// From the map to the tangent plane.
    pub pose: Sim2,
    pub offset_s: f64,
    pub middle_m: Vector2<f64>,
    /// The antenna ahead and to the left of where it was taken to be, if the fixes show that.
    pub antenna_m: Option<Vector2<f64>>,
    pub covariance: Unknowns,
    pub used: Vec<FixPair>,
    /// Robust variance of the residuals of all fixes in units of the stated one.
    pub spread: f64,
}

impl Fitted {
    /// A fix less where the path has it, metres east and north.
    pub fn residual(&self, pair: &FixPair) -> Vector2<f64> {
        let position_m = pair.position_m + pair.axes * self.antenna_m.unwrap_or_default();
        let there = self.pose.apply(GroundPoint::new(position_m.x, position_m.y));
        pair.in_plane_m - Vector2::new(there.x_m, there.y_m)
    }
}

/// Residuals beyond this many standard deviations are outliers; of normal ones, one in ten
/// thousand.
const GATE_SQUARED: f64 = 18.4;
/// Standard deviations up to which a residual counts nearly in full.
const LOSS: Loss = Loss::Cauchy(3.0);
/// Reduction of the squared residuals by which a scale, or another place of the antenna, is
/// significant: noise reaches it in one of two million recordings for the scale (one unknown), and
/// in one of 270,000 for the antenna (two).
const SHOWN: f64 = 25.0;
/// Standard deviation of a scale: of a height measured with a tape.
const SCALE_SIGMA: f64 = 0.03;
/// Standard deviation of the place of an antenna that is not stated, metres: a robot is about as
/// large.
const ANTENNA_SIGMA_M: f64 = 0.5;

/// The estimate; `None` if no fix falls on the path. The place of the antenna is estimated if
/// `may_be_elsewhere`.
pub fn fit(pairing: &Pairing<'_>, clock_sigma_s: f64, may_be_elsewhere: bool) -> Option<Fitted> {
    let (start, middle_m) = sampled(pairing, clock_sigma_s)?;
    let solver = Solver { pairing, middle_m, clock_sigma_s };
    let (mut free, mut solution) = (Freedom::default(), solver.solve(start, Freedom::default(), None)?);
    // The freedom that explains most comes first: an antenna beside the camera looks like a scale
    // on a path that turns to one side.
    for _ in 0..2 {
        let freer = [Freedom { antenna: true, ..free }, Freedom { scale: true, ..free }];
        let is_open =
            |next: &Freedom| next.unknowns() > free.unknowns() && (may_be_elsewhere || !next.antenna);
        let tried = freer.into_iter().filter(is_open).filter_map(|next| {
            let found = solver.solve(solution.model, next, None)?;
            Some((solution.gain_of(&found, middle_m), next, found))
        });
        match tried.max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((gain, next, found)) if gain > SHOWN => (free, solution) = (next, found),
            _ => break,
        }
    }
    let spread = solution.spread;
    // Without the outliers, until these stay the same.
    let mut used: Vec<bool> = Vec::new();
    for _ in 0..ROUNDS {
        let variance = solution.variance;
        let mut now = vec![false; pairing.fixes.len()];
        for pair in pairing.at(solution.model.offset_s) {
            now[pair.fix] = squared(&solution.model, &pair, middle_m)? <= GATE_SQUARED * variance;
        }
        if now == used || now.iter().filter(|used| **used).count() < super::FEWEST {
            break;
        }
        used = now;
        solution = Solution { variance, ..solver.solve(solution.model, free, Some(&used))? };
    }
    let freedom = (2.0 * solution.pairs.len() as f64 - free.unknowns()).max(1.0);
    let variance = solution.squares.iter().sum::<f64>() / freedom;
    // Residuals that are smaller than stated may be so by chance.
    let mut information = solution.information / (variance * solution.correlation(middle_m)).max(1.0);
    solver.add_priors(&mut information, free);
    let mut covariance = information.cholesky()?.inverse();
    if !free.scale {
        covariance.row_mut(SCALE).fill(0.0);
        covariance.column_mut(SCALE).fill(0.0);
    }
    let model = solution.model;
    let origin = model.middle_in_plane_m - model.scale * (model.rotation() * middle_m);
    let pose = Sim2 { x_m: origin.x, y_m: origin.y, heading_rad: model.heading_rad, scale: model.scale };
    let antenna_m = free.antenna.then_some(model.antenna_m);
    let (offset_s, used) = (model.offset_s, solution.pairs);
    Some(Fitted { pose, offset_s, middle_m, antenna_m, covariance, used, spread })
}

/// Most rounds of rejecting outliers.
const ROUNDS: usize = 10;

/// The squared residual of a pair in its standard deviations.
fn squared(model: &PlacementModel, pair: &FixPair, middle_m: Vector2<f64>) -> Option<f64> {
    let residual = model.residual(pair, middle_m);
    Some(residual.dot(&(model.covariance(pair).try_inverse()? * residual)))
}

struct Solver<'a> {
    pairing: &'a Pairing<'a>,
    middle_m: Vector2<f64>,
    clock_sigma_s: f64,
}

/// A minimum.
struct Solution {
    model: PlacementModel,
    pairs: Vec<FixPair>,
    /// The squared residual of each pair.
    squares: Vec<f64>,
    /// Robust variance of the residuals in units of the stated one, and the same if it is above 1.
    spread: f64,
    variance: f64,
    /// Of the pairs alone, with the stated variance.
    information: Unknowns,
}

/// Most iterations, and the change of an unknown in standard deviations at which they end.
const ITERATIONS: usize = 60;
const CONVERGED: f64 = 1e-4;

impl Solver<'_> {
    /// Gauss–Newton with Cauchy's loss on all pairs, or by least squares on the `chosen` fixes.
    fn solve(&self, start: PlacementModel, free: Freedom, chosen: Option<&[bool]>) -> Option<Solution> {
        let mut model = start;
        for iteration in 0.. {
            let mut pairs = self.pairing.at(model.offset_s);
            pairs.retain(|pair| chosen.is_none_or(|chosen| chosen[pair.fix]));
            let squares: Option<Vec<f64>> =
                pairs.iter().map(|pair| squared(&model, pair, self.middle_m)).collect();
            let squares = squares?;
            let spread = robust_variance::<2>(&mut squares.clone())?;
            let variance = spread.max(1.0);
            let (mut information, mut push) = (Unknowns::zeros(), SVector::<f64, UNKNOWNS>::zeros());
            for (pair, square) in pairs.iter().zip(&squares) {
                let weight = match chosen {
                    Some(_) => 1.0,
                    None => LOSS.weight_of_square(square / variance),
                };
                let jacobian = self.jacobian(&model, pair, free);
                let weighted = jacobian.transpose() * model.covariance(pair).try_inverse()? * weight;
                information += weighted * jacobian;
                push += weighted * model.residual(pair, self.middle_m);
            }
            if iteration == ITERATIONS {
                return Some(Solution { model, pairs, squares, spread, variance, information });
            }
            let mut with_priors = information / variance;
            let mut push = push / variance;
            self.add_priors(&mut with_priors, free);
            push[CLOCK] -= model.offset_s / self.clock_sigma_s.powi(2);
            if free.scale {
                push[SCALE] -= model.scale.ln() / SCALE_SIGMA.powi(2);
            }
            if free.antenna {
                push[ANTENNA] -= model.antenna_m.x / ANTENNA_SIGMA_M.powi(2);
                push[ANTENNA + 1] -= model.antenna_m.y / ANTENNA_SIGMA_M.powi(2);
            }
            let change = with_priors.cholesky()?.solve(&push);
            if !change.iter().all(|value| value.is_finite()) {
                return None;
            }
            if change.dot(&(with_priors * change)) < CONVERGED * CONVERGED {
                return Some(Solution { model, pairs, squares, spread, variance, information });
            }
            model.heading_rad += change[HEADING].clamp(-0.5, 0.5);
            model.middle_in_plane_m += Vector2::new(change[EAST], change[NORTH]);
            // No further than the deviation in one step: the path is linear only nearby.
            model.offset_s += change[CLOCK].clamp(-self.clock_sigma_s, self.clock_sigma_s);
            model.scale *= change[SCALE].clamp(-0.1, 0.1).exp();
            model.antenna_m += Vector2::new(change[ANTENNA], change[ANTENNA + 1]);
        }
        None
    }

    /// Derivative of where the path has a fix.
    fn jacobian(&self, model: &PlacementModel, pair: &FixPair, free: Freedom) -> SMatrix<f64, 2, UNKNOWNS> {
        let turned = model.scale * model.rotation();
        let arm = turned * (pair.position_m + pair.axes * model.antenna_m - self.middle_m);
        let by_clock = -(turned * pair.velocity_m_s);
        let by_scale = if free.scale { arm } else { Vector2::zeros() };
        let by_antenna = if free.antenna { turned * pair.axes } else { Matrix2::zeros() };
        SMatrix::from_columns(&[
            Vector2::new(-arm.y, arm.x),
            Vector2::x(),
            Vector2::y(),
            by_clock,
            by_scale,
            by_antenna.column(0).into_owned(),
            by_antenna.column(1).into_owned(),
        ])
    }

    /// Nothing is known of the direction, which keeps the matrix regular where the path has no
    /// extent.
    fn add_priors(&self, information: &mut Unknowns, free: Freedom) {
        let prior = |is_free: bool, sigma: f64| if is_free { 1.0 / (sigma * sigma) } else { 1.0 };
        information[(HEADING, HEADING)] += 1.0 / (PI * PI);
        information[(CLOCK, CLOCK)] += 1.0 / self.clock_sigma_s.powi(2);
        information[(SCALE, SCALE)] += prior(free.scale, SCALE_SIGMA);
        for k in [ANTENNA, ANTENNA + 1] {
            information[(k, k)] += prior(free.antenna, ANTENNA_SIGMA_M);
        }
    }
}

impl Solution {
    /// By how much a freer one lowers the robust cost.
    fn gain_of(&self, freer: &Self, middle_m: Vector2<f64>) -> f64 {
        let cost = |of: &Self| of.squares.iter().map(|s| LOSS.of_square(s / freer.variance)).sum::<f64>();
        let correlated = (freer.spread / freer.variance * freer.correlation(middle_m)).max(1.0);
        (cost(self) - cost(freer)) / correlated
    }

    /// The [`variance_of_mean_factor`] of the residuals.
    fn correlation(&self, middle_m: Vector2<f64>) -> f64 {
        let reach = GATE_SQUARED * self.variance;
        let whitened: Vec<Vector2<f64>> = self
            .pairs
            .iter()
            .zip(&self.squares)
            .filter(|(_, square)| **square <= reach)
            .filter_map(|(pair, _)| {
                let factor = self.model.covariance(pair).cholesky()?;
                factor.l().solve_lower_triangular(&self.model.residual(pair, middle_m))
            })
            .collect();
        variance_of_mean_factor(&whitened)
    }
}

/// Samples, and fixes that judge them.
const SAMPLES: usize = 400;
const JUDGES: usize = 400;
/// Squared residual in standard deviations from which a fix counts as an outlier of a sample.
const SAMPLE_GATE_SQUARED: f64 = 16.0;
/// Error of the path as a fraction of the distance from its middle, for samples only: scale and
/// bends.
const PATH_TOLERANCE: f64 = 0.02;
/// Offset of the clocks that a sample tolerates, seconds; larger ones are searched in these steps.
const CLOCK_TOLERANCE_S: f64 = 0.2;
const CLOCK_STEP_S: f64 = 0.1;

/// The best of the placements by two random fixes, and the middle of the path at the fixes (M. A.
/// Fischler and R. C. Bolles, 1981; the cost is MSAC's, P. H. S. Torr and A. Zisserman, 2000).
fn sampled(pairing: &Pairing<'_>, clock_sigma_s: f64) -> Option<(PlacementModel, Vector2<f64>)> {
    let steps = if clock_sigma_s <= CLOCK_TOLERANCE_S {
        0
    } else {
        (3.0 * clock_sigma_s / CLOCK_STEP_S).ceil() as i64
    };
    let tolerated_s = if steps == 0 { clock_sigma_s } else { CLOCK_STEP_S };
    let mut best: Option<(f64, PlacementModel, Vector2<f64>)> = None;
    for step in -steps..=steps {
        let offset_s = step as f64 * CLOCK_STEP_S;
        let pairs = pairing.at(offset_s);
        let Some(middle_m) = middle(&pairs) else { continue };
        let judges: Vec<FixPair> = pairs.iter().step_by(pairs.len().div_ceil(JUDGES)).copied().collect();
        let missing = (pairing.fixes.len() - pairs.len()) as f64 / pairs.len() as f64;
        let own = (offset_s / clock_sigma_s).powi(2) + SAMPLE_GATE_SQUARED * missing * judges.len() as f64;
        let mut random = Random::new(0);
        for _ in 0..SAMPLES {
            let [a, b] = [(); 2].map(|()| &judges[random.below(judges.len())]);
            let (in_map, on_earth) = (b.position_m - a.position_m, b.in_plane_m - a.in_plane_m);
            let heading_rad = if in_map.norm() > 0.0 {
                on_earth.y.atan2(on_earth.x) - in_map.y.atan2(in_map.x)
            } else {
                0.0
            };
            let mut model = PlacementModel {
                heading_rad,
                middle_in_plane_m: Vector2::zeros(),
                offset_s,
                scale: 1.0,
                antenna_m: Vector2::zeros(),
            };
            model.middle_in_plane_m = 0.5 * (model.residual(a, middle_m) + model.residual(b, middle_m));
            let cost =
                own + judges.iter().map(|pair| sample_cost(&model, pair, middle_m, tolerated_s)).sum::<f64>();
            if best.as_ref().is_none_or(|(least, ..)| cost < *least) {
                best = Some((cost, model, middle_m));
            }
        }
    }
    best.map(|(_, model, middle_m)| (model, middle_m))
}

fn sample_cost(model: &PlacementModel, pair: &FixPair, middle_m: Vector2<f64>, tolerated_s: f64) -> f64 {
    let by_clock = model.rotation() * pair.velocity_m_s * tolerated_s;
    let bends_m2 = (PATH_TOLERANCE * (pair.position_m - middle_m).norm()).powi(2);
    let covariance =
        model.covariance(pair) + by_clock * by_clock.transpose() + Matrix2::identity() * bends_m2;
    let residual = model.residual(pair, middle_m);
    covariance.try_inverse().map_or(SAMPLE_GATE_SQUARED, |information| {
        residual.dot(&(information * residual)).min(SAMPLE_GATE_SQUARED)
    })
}

fn middle(pairs: &[FixPair]) -> Option<Vector2<f64>> {
    (!pairs.is_empty()).then(|| pairs.iter().map(|p| p.position_m).sum::<Vector2<f64>>() / pairs.len() as f64)
}

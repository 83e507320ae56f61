//! Levenberg–Marquardt on all keyframes, or on rigid pieces of the map.

use super::absolute::{LinearizedPoint, PlacementScale};
use super::edge::{Linearized, Weighted};
use super::normal_equations::{GraphNormalEquations, PlacementVariances};
use super::pieces::{MAX_PIECES, Pieces};
use super::{Heights, PoseGraph};
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{GroundPoint, PlaneTransform, Sim2};
use crate::keyframe::{EdgeKind, MapEdge};
use crate::numerics::{Loss, robust_variance};
use nalgebra::{DVector, Matrix4, Vector2};

/// Significance test of the mount's rotation: freeing it must reduce the sum of squared residuals
/// by this. Noise does so in four of a million graphs (chi-square, two degrees of freedom).
const MOUNT_SHOWN: f64 = 25.0;

/// Largest rotation of the mount, in standard deviations of its prior. A larger one occurs by
/// chance in three of ten thousand mounts (two degrees of freedom).
const MAX_TURN: f64 = 4.0;

/// Standard deviation of the mount's rotation while fixed, rad/m: bends a kilometre by half a
/// millimetre.
const HELD_TURN_SIGMA: f64 = 1e-9;

/// Scales of the robust losses, in standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LossScales {
    /// Of loops.
    pub loops: f64,
    /// Of absolute edges.
    pub points: f64,
}

/// The unknowns and their normal equations.
pub(super) struct Descent {
    pieces: Pieces,
    equations: GraphNormalEquations,
    /// Whether the mount's rotation is among the unknowns.
    with_mount: bool,
}

impl PoseGraph {
    /// Optimises all keyframes in at most `steps` steps. The first keyframe of every connected
    /// component is fixed.
    pub fn optimize(&mut self, steps: usize) {
        let Some(mut descent) = self.descent(Pieces::single(self), true) else { return };
        let mut scales = self.loss_scales();
        let mut left = steps;
        // The second round has the loss scale that fits the residuals of the first, if there are
        // steps left; the third frees the mount's rotation.
        for round in 0..3 {
            left -= self.descend(&mut descent, scales, left);
            let last = round == 2 || left == 0;
            if round > 0 || last {
                let is_asked = !self.mount_turns && self.is_worth_asking();
                let is_freed = is_asked && self.shows_turn(&mut descent, scales);
                self.mount_turns |= is_freed;
                if last || !is_freed {
                    break;
                }
            }
            scales = self.loss_scales();
        }
        if !self.mount_turns {
            self.turn_per_m = Vector2::zeros(); // but for rounding it is
        }
    }

    /// Approximately optimises in a time that hardly grows with the graph: first the whole of it as
    /// rigid segments, then the keyframes around `loops`, the new edges, individually; both in at
    /// most `steps` steps. A small graph is optimised completely.
    pub fn relax(&mut self, loops: &[MapEdge], steps: usize) {
        if self.nodes.len() <= MAX_PIECES {
            self.optimize(steps);
            return;
        }
        let scales = self.loss_scales();
        if let Some(mut whole) = self.descent(Pieces::stretches(self), true) {
            self.descend(&mut whole, scales, steps);
            if !self.mount_turns && self.is_worth_asking() && self.shows_turn(&mut whole, scales) {
                self.mount_turns = true;
                self.descend(&mut whole, scales, steps);
            }
        }
        let ends = loops.iter().flat_map(|edge| [edge.from, edge.to]);
        let ends: Vec<usize> = ends.filter_map(|id| self.index.get(&id).copied()).collect();
        if let Some(mut near) = self.descent(Pieces::near(self, &ends), false) {
            self.descend(&mut near, scales, steps);
        }
    }

    /// Whether there are 10 % more loops than at the last test: it costs as much as the
    /// optimisation itself.
    fn is_worth_asking(&mut self) -> bool {
        let loops = self.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop).count();
        let worth = 10 * loops > 11 * self.asked_of_loops;
        if worth {
            self.asked_of_loops = loops;
        }
        worth
    }

    /// Whether a rotation of the mount that is within its prior explains the loops significantly
    /// better. What needs a larger one has another cause: ground that undulates, or a wrong loop.
    pub(super) fn shows_turn(&self, descent: &mut Descent, scales: LossScales) -> bool {
        let mut explained = |turn_sigma: f64| {
            self.fill(descent, scales, turn_sigma);
            let change = descent.equations.solve(0.0)?;
            let turn = self.turn_per_m + descent.equations.of_mount(&change);
            Some((descent.equations.explained(&change), turn.norm()))
        };
        let (held, free) = (explained(HELD_TURN_SIGMA), explained(self.turn_sigma));
        let significant = |((held, _), (free, turn)): ((f64, f64), (f64, f64))| {
            free - held > MOUNT_SHOWN && turn < MAX_TURN * self.turn_sigma
        };
        held.zip(free).is_some_and(significant)
    }

    /// Levenberg–Marquardt; returns the number of steps.
    pub(super) fn descend(&mut self, descent: &mut Descent, scales: LossScales, steps: usize) -> usize {
        let mut cost = self.cost(descent, scales);
        let mut damping = 0.0;
        for taken in 0..steps {
            self.fill(descent, scales, self.turn_sigma());
            loop {
                let Some(change) = descent.equations.solve(damping) else {
                    damping = next_damping(damping);
                    if damping > MAX_DAMPING {
                        return taken;
                    }
                    continue;
                };
                let (nodes, turn_per_m) = (self.nodes.clone(), self.turn_per_m);
                let placement = self.survey.as_ref().map(|survey| survey.placement);
                self.step(descent, &change);
                let found = self.cost(descent, scales);
                if found.is_finite() && found <= cost * (1.0 + 1e-12) {
                    let gained = cost - found;
                    cost = found;
                    damping *= 0.1;
                    if gained <= MIN_GAIN * (1.0 + found) {
                        return taken + 1;
                    }
                    break;
                }
                (self.nodes, self.turn_per_m) = (nodes, turn_per_m);
                if let Some((survey, placement)) = self.survey.as_mut().zip(placement) {
                    survey.placement = placement;
                }
                damping = next_damping(damping);
                if damping > MAX_DAMPING {
                    // No step reduces the cost: converged to rounding.
                    return taken + 1;
                }
            }
        }
        steps
    }

    /// Normalised residual squared of an edge.
    fn squared(&self, edge: &Weighted) -> f64 {
        edge.squared(&self.nodes[edge.from], &self.nodes[edge.to], self.turn_per_m)
    }

    /// Cost: half the weighted squared residuals of the edges that can change, with Cauchy's loss
    /// for loops.
    pub(super) fn cost(&self, descent: &Descent, scales: LossScales) -> f64 {
        let of = |edge: &Weighted| {
            let squared = self.squared(edge);
            0.5 * loss_of(edge.kind, scales).map_or(squared, |loss| loss.of_square(squared))
        };
        let mount = 0.5 * self.turn_per_m.norm_squared() / self.turn_sigma().powi(2);
        let cost = descent.pieces.edges().iter().map(|&edge| of(&self.edges[edge])).sum::<f64>() + mount;
        let Some(survey) = &self.survey else { return cost };
        let loss = Loss::Cauchy(scales.points);
        let squares = survey.used().map(|edge| edge.squared(&self.nodes[edge.node], &survey.placement));
        cost + squares.map(|square| 0.5 * loss.of_square(square)).sum::<f64>() + survey.prior_cost()
    }

    /// Scales of the losses of loops and absolute edges: three times their robust scale, at least
    /// three.
    pub(super) fn loss_scales(&self) -> LossScales {
        let loops = self.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop);
        let mut squares: Vec<f64> = loops.map(|edge| self.squared(edge)).collect();
        let loops = 3.0 * robust_variance::<3>(&mut squares).map_or(1.0, |variance| variance.sqrt().max(1.0));
        LossScales { loops, points: self.loss_scale_of_points() }
    }

    /// Prepares the normal equations of these pieces; `None` if nothing is free.
    pub(super) fn descent(&self, pieces: Pieces, with_mount: bool) -> Option<Descent> {
        let mut unknown: Vec<Option<usize>> = vec![None; self.nodes.len()];
        let mut count = 0;
        for node in 0..self.nodes.len() {
            let leader = pieces.leader(node);
            if leader != node {
                unknown[node] = unknown[leader];
            } else if !pieces.is_held(node) {
                unknown[node] = Some(count);
                count += 1;
            }
        }
        if count == 0 {
            return None;
        }
        let ties = pieces.edges().iter().map(|&edge| {
            let edge = &self.edges[edge];
            (unknown[edge.from], unknown[edge.to], with_mount && edge.bends())
        });
        let size = if self.heights == Heights::Held { 3 } else { 4 };
        let points: Option<Vec<Option<usize>>> =
            self.survey.as_ref().map(|survey| survey.edges.iter().map(|edge| unknown[edge.node]).collect());
        let equations = GraphNormalEquations::new(size, count, ties, points.as_deref(), unknown.clone())?;
        Some(Descent { pieces, equations, with_mount })
    }

    pub(super) fn turn_sigma(&self) -> f64 {
        if self.mount_turns { self.turn_sigma } else { HELD_TURN_SIGMA }
    }

    pub(super) fn fill(&self, descent: &mut Descent, scales: LossScales, turn_sigma: f64) {
        let Descent { pieces, equations, with_mount } = descent;
        equations.clear();
        for edge in pieces.edges().iter().map(|&edge| &self.edges[edge]) {
            let linear: Linearized =
                edge.linearized(&self.nodes[edge.from], &self.nodes[edge.to], self.turn_per_m);
            let weight = loss_of(edge.kind, scales)
                .map_or(1.0, |loss| loss.weight_of_square(linear.misses.norm_squared()));
            let (bend_from, bend_to) = (pieces.bend(edge.from), pieces.bend(edge.to));
            let linear = Linearized {
                by_mount: linear.by_mount + linear.by_from * bend_from + linear.by_to * bend_to,
                by_from: linear.by_from * self.by_piece(pieces, edge.from),
                by_to: linear.by_to * self.by_piece(pieces, edge.to),
                ..linear
            };
            equations.add(edge, &linear, weight, *with_mount && edge.bends());
        }
        if *with_mount {
            equations.hold_mount(self.turn_per_m, turn_sigma);
        } else {
            equations.hold_mount(Vector2::zeros(), HELD_TURN_SIGMA);
        }
        let Some(survey) = &self.survey else { return };
        let loss = Loss::Cauchy(scales.points);
        for edge in survey.used() {
            let linear = edge.linearized(&self.nodes[edge.node], &survey.placement);
            let weight = loss.weight_of_square(linear.misses.norm_squared());
            let by_node = linear.by_node * self.by_piece(pieces, edge.node);
            equations.add_point(edge.node, &LinearizedPoint { by_node, ..linear }, weight);
        }
        let is_known = survey.scale == PlacementScale::Adopted;
        equations.hold_placement(survey.placement.scale.ln(), survey.scale_sigma(), is_known);
    }

    /// Variances of the placement at the current poses; `None` without absolute edges.
    pub(super) fn placement_variances(&self, descent: &mut Descent) -> Option<PlacementVariances> {
        self.fill(descent, self.loss_scales(), self.turn_sigma());
        descent.equations.placement_variances()
    }

    /// Jacobian of a keyframe with respect to its piece's pose.
    fn by_piece(&self, pieces: &Pieces, node: usize) -> Matrix4<f64> {
        let (own, leader) = (&self.nodes[node].pose, &self.nodes[pieces.leader(node)].pose);
        Sim2::lever_arm(own.x_m - leader.x_m, own.y_m - leader.y_m)
    }

    fn step(&mut self, descent: &Descent, change: &DVector<f64>) {
        let Descent { pieces, equations, .. } = descent;
        let turned = equations.of_mount(change);
        // In reverse order: the leader of a piece, its first keyframe, moves after those that
        // rotate about it.
        for node in (0..self.nodes.len()).rev() {
            let Some(change) = equations.of_node(change, node) else { continue };
            let leader = self.nodes[pieces.leader(node)].pose;
            let pose = &mut self.nodes[node].pose;
            let arm = GroundPoint::new(pose.x_m - leader.x_m, pose.y_m - leader.y_m);
            let change = Sim2::from_vector(&change);
            let moved = change.apply(arm);
            let bent = pieces.bend(node) * turned;
            pose.x_m += moved.x_m - arm.x_m + bent[X];
            pose.y_m += moved.y_m - arm.y_m + bent[Y];
            pose.heading_rad += change.heading_rad + bent[HEADING];
            pose.height_m *= change.scale;
        }
        self.turn_per_m += turned;
        if let Some((survey, change)) = self.survey.as_mut().zip(equations.of_placement(change)) {
            let change = Sim2::from_vector(&change);
            survey.placement.x_m += change.x_m;
            survey.placement.y_m += change.y_m;
            survey.placement.heading_rad += change.heading_rad;
            survey.placement.scale *= change.scale;
        }
    }

    /// Covariance of (x, y, heading, ln height) of every keyframe in order of insertion, relative
    /// to the first of its connected component or, where that was adopted, in the survey frame: the
    /// inverse of the normal equations, scaled by the reduced chi-square of the edges where that
    /// exceeds 1.
    pub fn covariances(&self) -> Vec<Matrix4<f64>> {
        let none = || vec![Matrix4::zeros(); self.nodes.len()];
        let Some(mut descent) = self.descent(Pieces::single(self), true) else { return none() };
        let scales = self.loss_scales();
        self.fill(&mut descent, scales, self.turn_sigma());
        let cost = self.cost(&descent, scales);
        let equations = &mut descent.equations;
        let Some(blocks) = equations.marginals() else { return none() };
        let numbers = if self.heights == Heights::Held { 3.0 } else { 4.0 };
        let points = self.survey.as_ref().map_or(0.0, |survey| 2.0 * survey.used().count() as f64);
        let redundant = numbers * (self.edges.len() as f64 - equations.unknowns() as f64) + points;
        let excess = if redundant >= 1.0 { (2.0 * cost / redundant).max(1.0) } else { 1.0 };
        let of = |at: usize| equations.block_of(at).map_or(Matrix4::zeros(), |block| blocks[block] * excess);
        (0..self.nodes.len()).map(of).collect()
    }
}

/// Robust loss of an edge: a loop may be wrong, and across a gap the camera may have been moved
/// anywhere. Odometry has a quadratic loss.
fn loss_of(kind: EdgeKind, scales: LossScales) -> Option<Loss> {
    match kind {
        EdgeKind::Odometry => None,
        EdgeKind::Gap => Some(Loss::Cauchy(3.0)),
        EdgeKind::Loop => Some(Loss::Cauchy(scales.loops)),
    }
}

/// Convergence: a step that reduces the cost by a smaller share (of the cost plus 1) is the last.
/// Smaller takes more steps, which move keyframes by less than their standard deviations.
const MIN_GAIN: f64 = 1e-7;

/// Largest Levenberg–Marquardt damping, relative to the diagonal; the optimisation ends where even
/// steps this short do not reduce the cost.
const MAX_DAMPING: f64 = 1e6;

fn next_damping(damping: f64) -> f64 {
    if damping < 1e-7 { 1e-6 } else { 10.0 * damping }
}

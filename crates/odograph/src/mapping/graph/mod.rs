//! The pose graph: where every keyframe must be so that all that was measured between them agrees as well as it can.
//!
//! A keyframe over a plane has four numbers: x, y, heading and the logarithm of its height. Every [`MapEdge`] says how one keyframe sees
//! another; the poses are those with the least weighted squares of what the edges miss (F. Lu and E. Milios, "Globally consistent range
//! scan alignment for environment mapping", 1997), found by Levenberg–Marquardt on sparse normal equations. Where the rig holds the height
//! fixed, or the recording shows that it does, heights stay as they are and three numbers are left.
//!
//! Two things differ from the textbook:
//!
//! * **A mount that is a little off** turns every movement by the same angle per metre: a roll of ε at height h by about ε/2h. That is no
//!   noise that averages away, it bends the whole path. So the turn per metre ahead and per metre to the left are unknowns of the graph too,
//!   with a prior; loops tell them, and the path between the loops is straightened also where nothing was seen twice. They are held at none until
//!   the loops show them beyond doubt: freed for nothing they turn the noise of a loop into a bend of the whole path.
//! * **A loop may be wrong.** Loops have Cauchy's loss, whose scale is what the loops themselves show: wide while the path is still bent, and
//!   narrow once it fits (graduated non-convexity; H. Yang et al., 2020).

mod edge;
mod marginals;
mod normal_equations;
mod parts;
mod reach;

pub use reach::{Reach, Reached};

use super::ground_map::{EdgeKind, KeyframeId, MapEdge};
use super::plane_motion::seen_from;
use crate::geometry::GroundPose;
use edge::{Linearized, Weighted};
use nalgebra::{DVector, Matrix4, Vector2, Vector4};
use normal_equations::NormalEquations;
use std::collections::BTreeMap;

/// Whether keyframes may change their heights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heights {
    /// They are what odometry has: the rig holds them.
    Held,
    /// They drift as position does: the motions are of Sim(2).
    Free,
}

/// Standard deviation of the turn per metre that a mount a little off makes, in units of a radian over the height: half of a tilt of 0.6°.
const TURN_OF_MOUNT: f64 = 0.005;

/// Keyframes, and what ties them.
#[derive(Debug, Clone)]
pub struct PoseGraph {
    heights: Heights,
    nodes: Vec<Node>,
    index: BTreeMap<KeyframeId, usize>,
    edges: Vec<Weighted>,
    /// For each node, the edges at it.
    edges_at: Vec<Vec<usize>>,
    /// Turn per metre ahead and per metre to the left, radians, that the mount makes.
    turn_per_m: Vector2<f64>,
    /// Standard deviation of those two where they are free.
    turn_sigma: f64,
    /// Whether the loops have shown that there is such a turn.
    mount_turns: bool,
    /// How many loops there were when they were last asked whether they show it.
    asked_of_loops: usize,
}

/// What freeing the mount's turn must explain before it is freed: the squares of the misses, in variances, that it takes away. Chance takes away
/// as much in four of a million graphs (chi-square, two degrees of freedom).
const MOUNT_SHOWN: f64 = 25.0;

/// Standard deviation of the turn while it is held, radians per metre: bends a kilometre by half a millimetre.
const HELD_TURN_SIGMA: f64 = 1e-9;

/// A keyframe in the graph.
#[derive(Debug, Clone)]
struct Node {
    id: KeyframeId,
    /// Roll and pitch are never changed.
    pose: GroundPose,
    /// Height at which its motions were measured.
    measured_at_m: f64,
}

impl Node {
    /// How many of the present metres one measured metre is.
    fn scale(&self) -> f64 {
        self.pose.height_m / self.measured_at_m
    }
}

/// How an optimisation went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Optimization {
    /// Steps taken.
    pub steps: usize,
    /// Half the weighted squares before and after, with the loss of the end.
    pub cost: (f64, f64),
    /// Whether the last step changed nothing worth mentioning.
    pub converged: bool,
}

impl PoseGraph {
    /// A graph without keyframes. `height_m` is about how high the camera is: a mount that is off turns the more the lower it is.
    pub fn new(heights: Heights, height_m: f64) -> Self {
        Self {
            heights,
            nodes: Vec::new(),
            index: BTreeMap::new(),
            edges: Vec::new(),
            edges_at: Vec::new(),
            turn_per_m: Vector2::zeros(),
            turn_sigma: TURN_OF_MOUNT / height_m,
            mount_turns: false,
            asked_of_loops: 0,
        }
    }

    /// Takes back what the loops were thought to show of the mount's turn: the next optimisation judges it anew.
    pub fn doubt_mount(&mut self) {
        self.mount_turns = false;
        self.asked_of_loops = 0;
        self.turn_per_m = Vector2::zeros();
    }

    /// Adds a keyframe at `pose`, whose motions were measured at the height `measured_at_m`. One that is there already is moved there.
    pub fn insert(&mut self, id: KeyframeId, pose: GroundPose, measured_at_m: f64) {
        if let Some(&at) = self.index.get(&id) {
            self.nodes[at].pose = pose;
            return;
        }
        self.index.insert(id, self.nodes.len());
        self.nodes.push(Node { id, pose, measured_at_m });
        self.edges_at.push(Vec::new());
    }

    /// Adds an edge. One whose keyframes are not both there, or whose covariance is none, is left out; says whether it was taken.
    pub fn tie(&mut self, edge: &MapEdge) -> bool {
        let (Some(&from), Some(&to)) = (self.index.get(&edge.from), self.index.get(&edge.to)) else {
            return false;
        };
        let Some(weighted) = Weighted::new(from, to, edge, self.heights).filter(|_| from != to) else {
            return false;
        };
        self.edges_at[from].push(self.edges.len());
        self.edges_at[to].push(self.edges.len());
        self.edges.push(weighted);
        true
    }

    /// How many loops tie two keyframes to each other, whichever of them saw the other.
    pub fn loops_between(&self, one: KeyframeId, other: KeyframeId) -> usize {
        let [Some(&one), Some(&other)] = [one, other].map(|id| self.index.get(&id)) else { return 0 };
        let edges = self.edges_at[one].iter().map(|&edge| &self.edges[edge]);
        edges.filter(|edge| edge.kind == EdgeKind::Loop && edge.other(one) == other).count()
    }

    /// How many keyframes there are.
    pub fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    /// Where a keyframe is.
    pub fn pose(&self, id: KeyframeId) -> Option<GroundPose> {
        self.index.get(&id).map(|&at| self.nodes[at].pose)
    }

    /// All keyframes with their poses, in the order in which they came.
    pub fn poses(&self) -> impl Iterator<Item = (KeyframeId, GroundPose)> {
        self.nodes.iter().map(|node| (node.id, node.pose))
    }

    /// The turn per metre ahead and per metre to the left that the loops have shown the mount to make, radians.
    pub fn turn_per_m(&self) -> (f64, f64) {
        (self.turn_per_m[0], self.turn_per_m[1])
    }

    /// What an edge misses by in units of its own standard deviation, squared, with the poses as they are; `None` where it is not in the graph's reach.
    pub fn misfit(&self, edge: &MapEdge) -> Option<f64> {
        let (from, to) = (*self.index.get(&edge.from)?, *self.index.get(&edge.to)?);
        let weighted = Weighted::new(from, to, edge, self.heights)?;
        Some(weighted.linearized(&self.nodes[from], &self.nodes[to], self.turn_per_m).squared())
    }

    /// Where one keyframe is as another sees it, metres as measured at the height of that one.
    pub fn seen(&self, from: KeyframeId, to: KeyframeId) -> Option<Vector4<f64>> {
        let (a, b) = (&self.nodes[*self.index.get(&from)?], &self.nodes[*self.index.get(&to)?]);
        let mut motion = seen_from(&a.pose, &b.pose);
        motion[0] /= a.scale();
        motion[1] /= a.scale();
        Some(motion)
    }

    /// Moves the keyframes to where the edges agree best, in at most `steps` steps. The first keyframe of every connected part stays.
    pub fn optimize(&mut self, steps: usize) -> Optimization {
        let mut outcome = Optimization { steps: 0, cost: (0.0, 0.0), converged: true };
        let Some(mut equations) = self.equations() else { return outcome };
        let mut reach = self.loop_reach();
        outcome.cost.0 = self.cost(reach);
        // A second round with the loss that fits what the first left of the loops, where there is time for one, and a third where the mount turns.
        for round in 0..3 {
            let left = steps - outcome.steps;
            let (taken, after, converged) = self.descend(&mut equations, reach, left, self.cost(reach));
            outcome.steps += taken;
            (outcome.cost.1, outcome.converged) = (after, converged);
            let last = round == 2 || outcome.steps >= steps;
            if (round > 0 || last) && !self.mount_turns {
                self.mount_turns = self.is_worth_asking() && self.shows_turn(&mut equations, reach);
                if last || !self.mount_turns {
                    break;
                }
            } else if round > 0 || last {
                break;
            }
            reach = self.loop_reach();
        }
        if !self.mount_turns {
            self.turn_per_m = Vector2::zeros(); // but for rounding it is
        }
        outcome
    }

    /// Whether there are a tenth more loops than when they were last asked: it takes as long as the optimisation itself.
    fn is_worth_asking(&mut self) -> bool {
        let loops = self.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop).count();
        let worth = 10 * loops > 11 * self.asked_of_loops;
        if worth {
            self.asked_of_loops = loops;
        }
        worth
    }

    /// Whether the loops would be explained far better by a mount that turns.
    fn shows_turn(&self, equations: &mut NormalEquations, reach: f64) -> bool {
        let mut explained = |turn_sigma: f64| {
            self.fill(equations, reach, turn_sigma);
            let change = equations.solve(0.0)?;
            Some(equations.explained(&change))
        };
        let (held, free) = (explained(HELD_TURN_SIGMA), explained(self.turn_sigma));
        held.zip(free).is_some_and(|(held, free)| free - held > MOUNT_SHOWN)
    }

    /// Levenberg–Marquardt; gives the steps taken, the cost at the end, and whether it is the least.
    fn descend(
        &mut self,
        equations: &mut NormalEquations,
        reach: f64,
        steps: usize,
        mut cost: f64,
    ) -> (usize, f64, bool) {
        let mut damping = 0.0;
        for taken in 0..steps {
            self.fill(equations, reach, self.turn_sigma());
            loop {
                let Some(change) = equations.solve(damping) else {
                    damping = next_damping(damping);
                    if damping > MOST_DAMPING {
                        return (taken, cost, false);
                    }
                    continue;
                };
                let (nodes, turn_per_m) = (self.nodes.clone(), self.turn_per_m);
                self.step(equations, &change);
                let found = self.cost(reach);
                if found.is_finite() && found <= cost * (1.0 + 1e-12) {
                    let gained = cost - found;
                    cost = found;
                    damping *= 0.1;
                    if gained <= LEAST_GAIN * (1.0 + found) {
                        return (taken + 1, cost, true);
                    }
                    break;
                }
                (self.nodes, self.turn_per_m) = (nodes, turn_per_m);
                damping = next_damping(damping);
                if damping > MOST_DAMPING {
                    // No way leads down: this is the bottom, as far as numbers can tell.
                    return (taken + 1, cost, true);
                }
            }
        }
        (steps, cost, false)
    }

    /// Half the weighted squares, loops with Cauchy's loss.
    fn cost(&self, reach: f64) -> f64 {
        let of = |edge: &Weighted| {
            let squared =
                edge.linearized(&self.nodes[edge.from], &self.nodes[edge.to], self.turn_per_m).squared();
            0.5 * reach_of(edge.kind, reach).map_or(squared, |reach| loss(squared, reach))
        };
        let mount = 0.5 * self.turn_per_m.norm_squared() / self.turn_sigma().powi(2);
        self.edges.iter().map(of).sum::<f64>() + mount
    }

    /// Beyond so many standard deviations loops count less: three times what they usually miss by, and never less than three.
    fn loop_reach(&self) -> f64 {
        let loops = self.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop);
        let mut squares: Vec<f64> = loops
            .map(|edge| {
                edge.linearized(&self.nodes[edge.from], &self.nodes[edge.to], self.turn_per_m).squared()
            })
            .collect();
        if squares.is_empty() {
            return 3.0;
        }
        let middle = squares.len() / 2;
        let (_, median, _) = squares.select_nth_unstable_by(middle, f64::total_cmp);
        // The median of a chi-square of three degrees of freedom is 2.37.
        3.0 * (*median / 2.37).sqrt().max(1.0)
    }

    /// The normal equations' pattern; `None` where nothing can move.
    fn equations(&self) -> Option<NormalEquations> {
        let held = self.first_of_each_part();
        let mut unknown = vec![None; self.nodes.len()];
        let mut count = 0;
        for (at, slot) in unknown.iter_mut().enumerate() {
            if !held[at] {
                *slot = Some(count);
                count += 1;
            }
        }
        if count == 0 {
            return None;
        }
        let ties = self.edges.iter().map(|edge| (unknown[edge.from], unknown[edge.to], edge.bends()));
        let size = if self.heights == Heights::Held { 3 } else { 4 };
        NormalEquations::new(size, count, ties, unknown.clone())
    }

    fn turn_sigma(&self) -> f64 {
        if self.mount_turns { self.turn_sigma } else { HELD_TURN_SIGMA }
    }

    fn fill(&self, equations: &mut NormalEquations, reach: f64, turn_sigma: f64) {
        equations.clear();
        for edge in &self.edges {
            let linear: Linearized =
                edge.linearized(&self.nodes[edge.from], &self.nodes[edge.to], self.turn_per_m);
            let weight = reach_of(edge.kind, reach)
                .map_or(1.0, |reach| 1.0 / (1.0 + linear.squared() / (reach * reach)));
            equations.add(edge, &linear, weight);
        }
        equations.hold_mount(self.turn_per_m, turn_sigma);
    }

    fn step(&mut self, equations: &NormalEquations, change: &DVector<f64>) {
        for (at, node) in self.nodes.iter_mut().enumerate() {
            let Some(change) = equations.of_node(change, at) else { continue };
            node.pose.x_m += change[0];
            node.pose.y_m += change[1];
            node.pose.heading_rad += change[2];
            node.pose.height_m *= change[3].exp();
        }
        self.turn_per_m += equations.of_mount(change);
    }

    /// Covariance of (x, y, heading, ln height) of every keyframe in the order in which they came, against the first of its part: the inverse of the
    /// normal equations there, with the noise that the edges turned out to have where that is more than they claim.
    pub fn covariances(&self) -> Vec<Matrix4<f64>> {
        let none = || vec![Matrix4::zeros(); self.nodes.len()];
        let Some(mut equations) = self.equations() else { return none() };
        let reach = self.loop_reach();
        self.fill(&mut equations, reach, self.turn_sigma());
        let Some(blocks) = equations.marginals() else { return none() };
        let numbers = if self.heights == Heights::Held { 3.0 } else { 4.0 };
        let redundant = numbers * (self.edges.len() as f64 - equations.unknowns() as f64);
        let excess = if redundant >= 1.0 { (2.0 * self.cost(reach) / redundant).max(1.0) } else { 1.0 };
        let of = |at: usize| equations.block_of(at).map_or(Matrix4::zeros(), |block| blocks[block] * excess);
        (0..self.nodes.len()).map(of).collect()
    }
}

/// Beyond so many standard deviations an edge counts less: a loop may be wrong, and over a gap the camera may have been carried anywhere.
/// What was measured step by step always counts in full.
fn reach_of(kind: EdgeKind, of_loops: f64) -> Option<f64> {
    match kind {
        EdgeKind::Odometry => None,
        EdgeKind::Gap => Some(3.0),
        EdgeKind::Loop => Some(of_loops),
    }
}

/// Cauchy's loss of a squared residual.
fn loss(squared: f64, reach: f64) -> f64 {
    reach * reach * (squared / (reach * reach)).ln_1p()
}

/// A step that gains less, as a part of the cost and of one, is the last.
const LEAST_GAIN: f64 = 1e-7;

const MOST_DAMPING: f64 = 1e6;

fn next_damping(damping: f64) -> f64 {
    if damping < 1e-7 { 1e-6 } else { 10.0 * damping }
}

#[cfg(test)]
mod tests;

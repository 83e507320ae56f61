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

mod descent;
mod edge;
mod marginals;
mod normal_equations;
mod parts;
mod pieces;
mod reach;

pub use descent::Optimization;
pub use reach::{Reach, Reached};

use super::ground_map::{EdgeKind, KeyframeId, MapEdge};
use crate::geometry::{GroundPose, PlaneTransform, Sim2, wrap_angle};
use edge::Weighted;
use nalgebra::{Vector2, Vector4};
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

    /// From its measured metres to the world.
    fn world_from_node(&self) -> Sim2 {
        Sim2 { scale: self.scale(), ..Sim2::rigid(&self.pose.se2()) }
    }

    /// Where another node is as this one sees it, metres as measured at the height of this one.
    fn seen(&self, other: &Self) -> Vector4<f64> {
        let seen = self.world_from_node().between(&other.world_from_node());
        let ln_heights = (other.pose.height_m / self.pose.height_m).ln();
        Vector4::new(seen.x_m, seen.y_m, wrap_angle(seen.heading_rad), ln_heights)
    }
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
        Some(weighted.squared(&self.nodes[from], &self.nodes[to], self.turn_per_m))
    }

    /// Where one keyframe is as another sees it, metres as measured at the height of that one.
    pub fn seen(&self, from: KeyframeId, to: KeyframeId) -> Option<Vector4<f64>> {
        let (a, b) = (&self.nodes[*self.index.get(&from)?], &self.nodes[*self.index.get(&to)?]);
        Some(a.seen(b))
    }
}

#[cfg(test)]
mod tests;

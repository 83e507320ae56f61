//! Rigid pieces of the map, for optimisation in bounded time.
//!
//! After a loop closure the whole map moves first, as rigid segments of the path: a coarse-grid
//! correction with the segments as the grid (A. Brandt, "Multi-level adaptive solutions to
//! boundary-value problems", 1977; for pose graphs G. Grisetti et al., "Hierarchical optimization
//! on manifolds for online 2D and 3D mapping", 2010). So a correction is distributed over the whole
//! map while the number of unknowns stays bounded. Then the keyframes around the loop move
//! individually, with the others fixed.
//!
//! Segments are rigid except for the mount's rotation, which stays an unknown and bends a segment
//! as it would bend its edges.

use super::PoseGraph;
use super::edge::Weighted;
use crate::geometry::{PlaneTransform, Sim2};
use crate::keyframe::EdgeKind;
use nalgebra::Matrix4x2;
use std::collections::VecDeque;

/// Number of keyframes around a loop that move individually: more spread its correction better and
/// take longer.
const NEAR: usize = 150;

/// Approximate number of segments, besides one for every gap in the path. With 2500 keyframes on a
/// grid, an optimisation of 300 segments takes 4 ms where two steps of the whole graph took 160 to
/// 190, and ends 0.2 mm from the optimum.
const STRETCHES: usize = 300;

/// Up to this number of keyframes the whole graph is optimised: it then takes no longer than
/// segments do.
pub(super) const MAX_PIECES: usize = 300;

/// A graph divided into rigid pieces.
pub(super) struct Pieces {
    /// For each keyframe the first one of its piece, about which the piece rotates.
    leader: Vec<usize>,
    /// For each keyframe whether it is fixed.
    held: Vec<bool>,
    /// For each keyframe the Jacobian of its pose within the piece with respect to the mount's
    /// rotation per metre, in world axes.
    bends: Vec<Matrix4x2<f64>>,
    /// The edges that can change.
    edges: Vec<usize>,
}

impl Pieces {
    /// Every keyframe individually.
    pub fn single(graph: &PoseGraph) -> Self {
        Self::alone(graph, graph.first_of_each_part(), (0..graph.edges.len()).collect())
    }

    fn alone(graph: &PoseGraph, held: Vec<bool>, edges: Vec<usize>) -> Self {
        let bends = vec![Matrix4x2::zeros(); graph.nodes.len()];
        Self { leader: (0..graph.nodes.len()).collect(), held, bends, edges }
    }

    /// All keyframes in segments.
    pub fn stretches(graph: &PoseGraph) -> Self {
        let held = graph.first_of_each_part();
        let length = graph.nodes.len().div_ceil(STRETCHES);
        // The boundaries shift every time, so that in time every edge can bend.
        let shift = graph.edges.len();
        let mut leader: Vec<usize> = Vec::with_capacity(graph.nodes.len());
        let mut bends: Vec<Matrix4x2<f64>> = Vec::with_capacity(graph.nodes.len());
        for node in 0..graph.nodes.len() {
            let before = node.checked_sub(1);
            let begins = (node + shift).is_multiple_of(length);
            let joins = before.filter(|&before| !begins && !held[node] && !held[before]);
            let joined = joins.and_then(|before| Some((before, graph.link(before, node)?)));
            leader.push(joined.map_or(node, |(before, _)| leader[before]));
            bends.push(
                joined.map_or(Matrix4x2::zeros(), |(before, edge)| {
                    graph.bent_along(&bends[before], before, edge)
                }),
            );
        }
        let between = |edge: &usize| leader[graph.edges[*edge].from] != leader[graph.edges[*edge].to];
        let edges = (0..graph.edges.len()).filter(between).collect();
        Self { leader, held, bends, edges }
    }

    /// The keyframes near `ends` individually, with the others fixed.
    pub fn near(graph: &PoseGraph, ends: &[usize]) -> Self {
        let mut held = graph.first_of_each_part();
        let near = graph.near(ends, NEAR);
        held.iter_mut().zip(&near).for_each(|(held, near)| *held |= !near);
        let at_free = |node: &usize| !held[*node];
        let nodes = (0..graph.nodes.len()).filter(at_free);
        let mut edges: Vec<usize> = nodes.flat_map(|node| graph.edges_at[node].iter().copied()).collect();
        edges.sort_unstable();
        edges.dedup();
        Self::alone(graph, held, edges)
    }

    /// Whether a keyframe is fixed.
    pub fn is_held(&self, node: usize) -> bool {
        self.held[node]
    }

    /// The first keyframe of the piece that a keyframe belongs to.
    pub fn leader(&self, node: usize) -> usize {
        self.leader[node]
    }

    /// Jacobian of a keyframe within its piece with respect to the mount's rotation per metre.
    pub fn bend(&self, node: usize) -> &Matrix4x2<f64> {
        &self.bends[node]
    }

    /// The edges that can change.
    pub fn edges(&self) -> &[usize] {
        &self.edges
    }
}

impl PoseGraph {
    /// For each keyframe, whether it is among the `most` that are the fewest edges away from
    /// `ends`.
    fn near(&self, ends: &[usize], most: usize) -> Vec<bool> {
        let mut near = vec![false; self.nodes.len()];
        let mut open: VecDeque<usize> = ends.iter().copied().collect();
        let mut count = 0;
        while let Some(at) = open.pop_front().filter(|_| count < most) {
            if std::mem::replace(&mut near[at], true) {
                continue;
            }
            count += 1;
            open.extend(self.edges_at[at].iter().map(|&edge| self.edges[edge].other(at)));
        }
        near
    }

    /// The odometry edge between two keyframes.
    fn link(&self, before: usize, node: usize) -> Option<&Weighted> {
        let edges = self.edges_at[node].iter().map(|&edge| &self.edges[edge]);
        edges.into_iter().find(|edge| edge.kind == EdgeKind::Odometry && edge.other(node) == before)
    }

    /// The Jacobian with respect to the mount's rotation at the other end of an edge, from that at
    /// this end.
    fn bent_along(&self, bend: &Matrix4x2<f64>, node: usize, edge: &Weighted) -> Matrix4x2<f64> {
        let (here, there) = (&self.nodes[node].pose, &self.nodes[edge.other(node)].pose);
        let from = &self.nodes[edge.from];
        let own = from.world_from_node().product_by_right() * edge.by_mount();
        let arm = Sim2::lever_arm(there.x_m - here.x_m, there.y_m - here.y_m);
        if edge.from == node { arm * bend + own } else { arm * (bend - own) }
    }
}

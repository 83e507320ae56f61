//! Relative pose and covariance of keyframes along the most certain path through the graph.
//!
//! The covariance along a single path is never smaller than that of the whole graph, so this is
//! conservative (E. Olson, "Robust and efficient robotic mapping", 2008, §3.4, Dijkstra
//! projection).

use super::PoseGraph;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{PlaneTransform, Sim2, propagated};
use crate::keyframe::{EdgeKind, KeyframeId};
use nalgebra::{Matrix4, Matrix4x2, Vector4};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// A keyframe relative to another.
#[derive(Debug, Clone, PartialEq)]
pub struct Reached {
    /// Its number.
    pub id: KeyframeId,
    /// Its motion, as [`PoseGraph::seen`].
    pub motion: Vector4<f64>,
    /// Covariance of the motion, including an uncalibrated mount tilt.
    pub covariance: Matrix4<f64>,
    /// Number of edges between them.
    pub edges: usize,
    /// Whether one of the edges is a gap.
    pub across_gap: bool,
}

/// Dijkstra search from one keyframe, the most certain first. Reached keyframes are remembered.
#[derive(Debug)]
pub struct Reach<'a> {
    graph: &'a PoseGraph,
    root: usize,
    open: BinaryHeap<OpenPath>,
    paths: Vec<GraphPath>,
    /// For each reached keyframe, its path.
    path_to: Vec<Option<u32>>,
}

/// A path through the graph.
#[derive(Debug, Clone)]
struct GraphPath {
    node: usize,
    /// Covariance of its end in world axes, without the mount's part.
    noise: Matrix4<f64>,
    /// Jacobian of its end with respect to the mount's rotation per metre.
    by_mount: Matrix4x2<f64>,
    edges: usize,
    across_gap: bool,
}

/// A path that may be the most certain to its end.
#[derive(Debug, Clone)]
struct OpenPath {
    /// Variance of the position of its end, metres², with that of the heading at a lever arm.
    variance_m2: f64,
    node: usize,
    path: u32,
}

impl PartialEq for OpenPath {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for OpenPath {}
impl PartialOrd for OpenPath {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for OpenPath {
    fn cmp(&self, other: &Self) -> Ordering {
        // The heap returns the greatest first.
        other.variance_m2.total_cmp(&self.variance_m2).then(other.node.cmp(&self.node))
    }
}

impl PoseGraph {
    /// Searches from a keyframe, itself first; `None` if it is not in the graph.
    pub fn reach(&self, from: KeyframeId) -> Option<Reach<'_>> {
        let root = *self.index.get(&from)?;
        let none = (Matrix4::zeros(), Matrix4x2::zeros());
        let start = GraphPath { node: root, noise: none.0, by_mount: none.1, edges: 0, across_gap: false };
        // Every edge is followed at most once.
        let mut paths = Vec::with_capacity(self.edges.len() + 1);
        paths.push(start);
        Some(Reach {
            graph: self,
            root,
            open: BinaryHeap::from([OpenPath { variance_m2: 0.0, node: root, path: 0 }]),
            paths,
            path_to: vec![None; self.nodes.len()],
        })
    }
}

impl Reach<'_> {
    /// The relative pose of a keyframe; `None` if nothing connects it.
    pub fn to(&mut self, id: KeyframeId) -> Option<Reached> {
        let node = *self.graph.index.get(&id)?;
        while self.path_to[node].is_none() {
            self.further()?;
        }
        self.reached(node)
    }

    /// Reaches the next keyframe and returns its number; [`Reach::to`] has the rest.
    pub fn further(&mut self) -> Option<KeyframeId> {
        let OpenPath { node, path, .. } = loop {
            let open = self.open.pop()?;
            if self.path_to[open.node].is_none() {
                break open;
            }
        };
        self.path_to[node] = Some(path);
        for &edge in &self.graph.edges_at[node] {
            let other = self.graph.edges[edge].other(node);
            if self.path_to[other].is_none() {
                let (further, variance_m2) = self.along(&self.paths[path as usize], edge);
                self.open.push(OpenPath { variance_m2, node: other, path: self.paths.len() as u32 });
                self.paths.push(further);
            }
        }
        Some(self.graph.nodes[node].id)
    }

    fn reached(&self, node: usize) -> Option<Reached> {
        let path = &self.paths[self.path_to[node]? as usize];
        let root = &self.graph.nodes[self.root];
        let whole = path.noise + path.by_mount * path.by_mount.transpose() * self.graph.turn_sigma.powi(2);
        let id = self.graph.nodes[node].id;
        Some(Reached {
            id,
            motion: self.graph.seen(root.id, id)?,
            covariance: propagated(&root.world_from_node().between_by_to(), &whole),
            edges: path.edges,
            across_gap: path.across_gap,
        })
    }

    /// The path extended by an edge, and its uncertainty.
    fn along(&self, path: &GraphPath, edge: usize) -> (GraphPath, f64) {
        let graph = self.graph;
        let edge = &graph.edges[edge];
        let (here, there) = (&graph.nodes[path.node].pose, &graph.nodes[edge.other(path.node)].pose);
        let from = &graph.nodes[edge.from];
        let by_motion = from.world_from_node().product_by_right();
        let own = propagated(&by_motion, &edge.covariance);
        let own_by_mount = by_motion * edge.by_mount();
        let (mut noise, mut by_mount) = (path.noise, path.by_mount);
        let back = edge.from != path.node;
        if back {
            // Followed backwards: the motion's error moves the near end, with the opposite sign.
            noise += own;
            by_mount -= own_by_mount;
        }
        // Propagates the error here to the far end: a rotation here moves it sideways, a scale
        // error radially.
        let arm = Sim2::lever_arm(there.x_m - here.x_m, there.y_m - here.y_m);
        noise = propagated(&arm, &noise);
        by_mount = arm * by_mount;
        if !back {
            noise += own;
            by_mount += own_by_mount;
        }
        let variance = |i: usize| noise[(i, i)] + graph.turn_sigma.powi(2) * by_mount.row(i).norm_squared();
        // Position, and heading at a lever arm of the camera's height, about the size of the view.
        let variance_m2 = variance(X) + variance(Y) + variance(HEADING) * here.height_m.powi(2);
        let across_gap = path.across_gap || edge.kind == EdgeKind::Gap;
        let node = edge.other(path.node);
        (GraphPath { node, noise, by_mount, edges: path.edges + 1, across_gap }, variance_m2)
    }
}

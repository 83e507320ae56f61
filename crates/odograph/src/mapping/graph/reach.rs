//! How well one keyframe knows where another is: along the surest way through the graph.
//!
//! The covariance along a single way is never smaller than that of the whole graph, so what is judged by it is judged with care (E. Olson,
//! "Robust and efficient robotic mapping", 2008, §3.4, Dijkstra projection).

use super::PoseGraph;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{PlaneTransform, Sim2, propagated};
use crate::mapping::ground_map::{EdgeKind, KeyframeId};
use nalgebra::{Matrix4, Matrix4x2, Vector4};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// A keyframe as another knows it.
#[derive(Debug, Clone, PartialEq)]
pub struct Reached {
    /// Which.
    pub id: KeyframeId,
    /// Where it is, as [`PoseGraph::seen`].
    pub motion: Vector4<f64>,
    /// Covariance of that, with what a mount that is off may do.
    pub covariance: Matrix4<f64>,
    /// So many edges lie between.
    pub edges: usize,
    /// Whether one of them is a gap.
    pub across_gap: bool,
}

/// The keyframes from one of them, the surest first. What has been reached stays known.
#[derive(Debug)]
pub struct Reach<'a> {
    graph: &'a PoseGraph,
    root: usize,
    open: BinaryHeap<Open>,
    ways: Vec<Way>,
    /// For each keyframe that has been reached, its way.
    way_to: Vec<Option<u32>>,
}

/// A way through the graph.
#[derive(Debug, Clone)]
struct Way {
    node: usize,
    /// In the world's axes.
    noise: Matrix4<f64>,
    /// Change with the turns per metre of the mount.
    by_mount: Matrix4x2<f64>,
    edges: usize,
    across_gap: bool,
}

/// A way that may be the surest to where it leads.
#[derive(Debug, Clone)]
struct Open {
    doubt: f64,
    node: usize,
    way: u32,
}

impl PartialEq for Open {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for Open {}
impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Open {
    fn cmp(&self, other: &Self) -> Ordering {
        // The heap gives the greatest first.
        other.doubt.total_cmp(&self.doubt).then(other.node.cmp(&self.node))
    }
}

impl PoseGraph {
    /// The keyframes that are connected with one, the surest first, itself before all; none where it is not there.
    pub fn reach(&self, from: KeyframeId) -> Option<Reach<'_>> {
        let root = *self.index.get(&from)?;
        let none = (Matrix4::zeros(), Matrix4x2::zeros());
        let start = Way { node: root, noise: none.0, by_mount: none.1, edges: 0, across_gap: false };
        // Every edge is gone along once at most.
        let mut ways = Vec::with_capacity(self.edges.len() + 1);
        ways.push(start);
        Some(Reach {
            graph: self,
            root,
            open: BinaryHeap::from([Open { doubt: 0.0, node: root, way: 0 }]),
            ways,
            way_to: vec![None; self.nodes.len()],
        })
    }
}

impl Reach<'_> {
    /// A keyframe, whether it has been reached before or not; `None` where nothing connects it.
    pub fn to(&mut self, id: KeyframeId) -> Option<Reached> {
        let node = *self.graph.index.get(&id)?;
        while self.way_to[node].is_none() {
            self.further()?;
        }
        self.reached(node)
    }

    /// Reaches the next keyframe, and says which; what else is known of it tells [`Reach::to`].
    pub fn further(&mut self) -> Option<KeyframeId> {
        let Open { node, way, .. } = loop {
            let open = self.open.pop()?;
            if self.way_to[open.node].is_none() {
                break open;
            }
        };
        self.way_to[node] = Some(way);
        for &edge in &self.graph.edges_at[node] {
            let other = self.graph.edges[edge].other(node);
            if self.way_to[other].is_none() {
                let (further, doubt) = self.along(&self.ways[way as usize], edge);
                self.open.push(Open { doubt, node: other, way: self.ways.len() as u32 });
                self.ways.push(further);
            }
        }
        Some(self.graph.nodes[node].id)
    }

    fn reached(&self, node: usize) -> Option<Reached> {
        let way = &self.ways[self.way_to[node]? as usize];
        let root = &self.graph.nodes[self.root];
        let whole = way.noise + way.by_mount * way.by_mount.transpose() * self.graph.turn_sigma.powi(2);
        let id = self.graph.nodes[node].id;
        Some(Reached {
            id,
            motion: self.graph.seen(root.id, id)?,
            covariance: propagated(&root.world_from_node().between_by_to(), &whole),
            edges: way.edges,
            across_gap: way.across_gap,
        })
    }

    /// The way on to the keyframe at the other end of an edge, and how much doubt is left there.
    fn along(&self, way: &Way, edge: usize) -> (Way, f64) {
        let graph = self.graph;
        let edge = &graph.edges[edge];
        let (here, there) = (&graph.nodes[way.node].pose, &graph.nodes[edge.other(way.node)].pose);
        let from = &graph.nodes[edge.from];
        let by_motion = from.world_from_node().product_by_right();
        let own = propagated(&by_motion, &edge.covariance);
        let own_by_mount = by_motion * edge.by_mount();
        let (mut noise, mut by_mount) = (way.noise, way.by_mount);
        let back = edge.from != way.node;
        if back {
            // Seen from the other end: what the motion is off moves the near end the other way.
            noise += own;
            by_mount -= own_by_mount;
        }
        // A turn of what is here swings what is there about it, and a greater height moves it away.
        let arm = Sim2::lever_arm(there.x_m - here.x_m, there.y_m - here.y_m);
        noise = propagated(&arm, &noise);
        by_mount = arm * by_mount;
        if !back {
            noise += own;
            by_mount += own_by_mount;
        }
        let variance = |i: usize| noise[(i, i)] + graph.turn_sigma.powi(2) * by_mount.row(i).norm_squared();
        // Position, and heading over the height of the camera, that is over about what an image shows.
        let doubt = variance(X) + variance(Y) + variance(HEADING) * here.height_m.powi(2);
        let across_gap = way.across_gap || edge.kind == EdgeKind::Gap;
        let node = edge.other(way.node);
        (Way { node, noise, by_mount, edges: way.edges + 1, across_gap }, doubt)
    }
}

impl Iterator for Reach<'_> {
    type Item = Reached;

    fn next(&mut self) -> Option<Reached> {
        let id = self.further()?;
        self.to(id)
    }
}

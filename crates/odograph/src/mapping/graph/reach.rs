//! How well one keyframe knows where another is: along the surest way through the graph.
//!
//! The covariance along a single way is never smaller than that of the whole graph, so what is judged by it is judged with care (E. Olson,
//! "Robust and efficient robotic mapping", 2008, §3.4, Dijkstra projection).

use super::PoseGraph;
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

/// The keyframes from one of them, the surest first.
#[derive(Debug)]
pub struct Reach<'a> {
    graph: &'a PoseGraph,
    root: usize,
    open: BinaryHeap<Entry>,
    closed: Vec<bool>,
}

#[derive(Debug, Clone)]
struct Entry {
    doubt: f64,
    node: usize,
    /// In the world's axes.
    noise: Matrix4<f64>,
    /// Change with the turns per metre of the mount.
    by_mount: Matrix4x2<f64>,
    edges: usize,
    across_gap: bool,
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for Entry {}
impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        // The heap gives the greatest first.
        other.doubt.total_cmp(&self.doubt).then(other.node.cmp(&self.node))
    }
}

impl PoseGraph {
    /// The keyframes that are connected with one, the surest first, itself before all; none where it is not there.
    pub fn reach(&self, from: KeyframeId) -> Option<Reach<'_>> {
        let root = *self.index.get(&from)?;
        let start = Entry {
            doubt: 0.0,
            node: root,
            noise: Matrix4::zeros(),
            by_mount: Matrix4x2::zeros(),
            edges: 0,
            across_gap: false,
        };
        Some(Reach {
            graph: self,
            root,
            open: BinaryHeap::from([start]),
            closed: vec![false; self.nodes.len()],
        })
    }
}

impl Reach<'_> {
    /// The entry of the keyframe at the other end of an edge.
    fn along(&self, entry: &Entry, edge: usize) -> Entry {
        let graph = self.graph;
        let edge = &graph.edges[edge];
        let (here, there) = (&graph.nodes[entry.node].pose, &graph.nodes[edge.other(entry.node)].pose);
        let (dx, dy) = (there.x_m - here.x_m, there.y_m - here.y_m);
        // A turn of what is here swings what is there about it, and a greater height moves it away.
        let mut swing = Matrix4::identity();
        (swing[(0, 2)], swing[(0, 3)], swing[(1, 2)], swing[(1, 3)]) = (-dy, dx, dx, dy);
        let from = &graph.nodes[edge.from];
        let (sin, cos) = from.pose.heading_rad.sin_cos();
        let scale = from.scale();
        let mut turn = Matrix4::identity();
        (turn[(0, 0)], turn[(0, 1)]) = (scale * cos, -scale * sin);
        (turn[(1, 0)], turn[(1, 1)]) = (scale * sin, scale * cos);
        if edge.from != entry.node {
            // Seen from the other end: what the motion is off moves the near end the other way.
            let mut back = -Matrix4::identity();
            (back[(0, 2)], back[(0, 3)], back[(1, 2)], back[(1, 3)]) = (dy, -dx, -dx, -dy);
            turn = back * turn;
        }
        let noise = swing * entry.noise * swing.transpose() + turn * edge.covariance * turn.transpose();
        let by_mount = swing * entry.by_mount + turn * edge.by_mount();
        let sigma2 = graph.turn_sigma.powi(2);
        let whole = noise + by_mount * by_mount.transpose() * sigma2;
        let across_gap = entry.across_gap || edge.kind == EdgeKind::Gap;
        // Position, and heading over the height of the camera, that is over about what an image shows.
        let doubt = whole[(0, 0)] + whole[(1, 1)] + whole[(2, 2)] * here.height_m.powi(2);
        Entry { doubt, node: edge.other(entry.node), noise, by_mount, edges: entry.edges + 1, across_gap }
    }
}

impl Iterator for Reach<'_> {
    type Item = Reached;

    fn next(&mut self) -> Option<Reached> {
        let entry = loop {
            let entry = self.open.pop()?;
            if !self.closed[entry.node] {
                break entry;
            }
        };
        self.closed[entry.node] = true;
        for &edge in &self.graph.edges_at[entry.node] {
            if !self.closed[self.graph.edges[edge].other(entry.node)] {
                let next = self.along(&entry, edge);
                self.open.push(next);
            }
        }
        let root = &self.graph.nodes[self.root];
        let (sin, cos) = root.pose.heading_rad.sin_cos();
        let per = 1.0 / root.scale();
        let mut turn = Matrix4::identity();
        (turn[(0, 0)], turn[(0, 1)], turn[(1, 0)], turn[(1, 1)]) =
            (per * cos, per * sin, -per * sin, per * cos);
        let whole = entry.noise + entry.by_mount * entry.by_mount.transpose() * self.graph.turn_sigma.powi(2);
        let id = self.graph.nodes[entry.node].id;
        Some(Reached {
            id,
            motion: self.graph.seen(root.id, id)?,
            covariance: turn * whole * turn.transpose(),
            edges: entry.edges,
            across_gap: entry.across_gap,
        })
    }
}

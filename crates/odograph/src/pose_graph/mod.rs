//! The pose graph: least-squares estimate of all keyframe poses from their relative measurements.
//!
//! A keyframe over a plane has four unknowns: x, y, heading and the logarithm of its height. A
//! [`MapEdge`] is the measured pose of one keyframe in the frame of another; the poses minimise the
//! weighted squared residuals of the edges (F. Lu and E. Milios, "Globally consistent range scan
//! alignment for environment mapping", 1997), by Levenberg–Marquardt on sparse normal equations. If
//! the rig holds the height, or the recording shows that it is constant, heights are fixed and
//! three unknowns remain.
//!
//! Three things differ from the textbook:
//!
//! * **A small uncalibrated mount tilt** rotates every motion by the same angle per metre: a roll
//!   of ε at height h by about ε/2h. That is a systematic error that bends the whole path. So the
//!   rotations per metre forward and per metre to the left are unknowns too, with a prior; loop
//!   closures make them observable and so also straighten the path between them. They are fixed at
//!   zero until the loops show them significantly: freed too early, they turn the noise of a loop
//!   into a bend of the whole path.
//! * **A loop closure may be wrong.** Loops have Cauchy's loss, with a scale from the loops' own
//!   residuals: wide while the path is still bent, and narrow once it fits (graduated
//!   non-convexity; H. Yang et al., 2020).
//! * **Absolute edges** tie points of keyframes to known places of a survey frame: surveyed
//!   markers, or positions of a satellite receiver. The placement of the graph in that frame is
//!   estimated with the poses; a place that contradicts the others is left out.
//!
//! Derivation: `docs/math/pose-graph.md`.

mod absolute;
mod descent;
mod edge;
mod marginals;
mod normal_equations;
mod parts;
mod pieces;
mod placement;
mod reach;

pub use absolute::AbsoluteEdge;
pub use placement::{AbsoluteUse, Placed, Unplaceable};
pub use reach::{Reach, Reached};

use crate::geometry::{GroundPose, PlaneTransform, Sim2, wrap_angle};
use crate::keyframe::{EdgeKind, KeyframeId, MapEdge};
use absolute::Survey;
use edge::Weighted;
use nalgebra::{Vector2, Vector4};
use std::collections::BTreeMap;

/// Whether the heights of keyframes are unknowns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heights {
    /// Fixed to odometry's: the rig holds them.
    Held,
    /// Free: scale drifts, and motions are in Sim(2).
    Free,
}

/// Prior standard deviation of the mount's rotation per metre, in units of 1 rad over the height:
/// half a tilt of 0.6°.
const TURN_OF_MOUNT: f64 = 0.005;

/// Keyframes and edges.
#[derive(Debug, Clone)]
pub struct PoseGraph {
    heights: Heights,
    nodes: Vec<Node>,
    index: BTreeMap<KeyframeId, usize>,
    edges: Vec<Weighted>,
    /// For each node, its edges.
    edges_at: Vec<Vec<usize>>,
    /// Rotation per metre forward and per metre to the left due to the mount's tilt, radians.
    turn_per_m: Vector2<f64>,
    /// Their prior standard deviation when free.
    turn_sigma: f64,
    /// Whether the loops have shown them significantly.
    mount_turns: bool,
    /// Number of loops when that was last tested.
    asked_of_loops: usize,
    /// Absolute edges, and the placement that they give.
    survey: Option<Survey>,
}

/// A keyframe.
#[derive(Debug, Clone)]
struct Node {
    id: KeyframeId,
    /// Roll and pitch are not estimated here.
    pose: GroundPose,
    /// Height at which its motions were measured, metres.
    measured_at_m: f64,
}

impl Node {
    /// Length in the map of a metre as measured: the scale drift.
    fn scale(&self) -> f64 {
        self.pose.height_m / self.measured_at_m
    }

    /// The transform from its measured metres to the world.
    fn world_from_node(&self) -> Sim2 {
        Sim2 { scale: self.scale(), ..Sim2::rigid(&self.pose.se2()) }
    }

    /// The motion of another node in this one's frame, metres as measured at this one's height.
    fn seen(&self, other: &Self) -> Vector4<f64> {
        let seen = self.world_from_node().between(&other.world_from_node());
        let ln_heights = (other.pose.height_m / self.pose.height_m).ln();
        Vector4::new(seen.x_m, seen.y_m, wrap_angle(seen.heading_rad), ln_heights)
    }
}

impl PoseGraph {
    /// An empty graph. `height_m` is the approximate height of the camera: the lower it is, the
    /// more a tilt rotates the motions.
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
            survey: None,
        }
    }

    /// Resets the estimate of the mount's rotation: the next optimisation tests it again.
    pub fn reset_mount(&mut self) {
        self.mount_turns = false;
        self.asked_of_loops = 0;
        self.turn_per_m = Vector2::zeros();
    }

    /// Adds a keyframe at `pose`, whose motions were measured at the height `measured_at_m`; moves
    /// it if it is there already.
    pub fn insert(&mut self, id: KeyframeId, pose: GroundPose, measured_at_m: f64) {
        if let Some(&at) = self.index.get(&id) {
            self.nodes[at].pose = pose;
            return;
        }
        self.index.insert(id, self.nodes.len());
        self.nodes.push(Node { id, pose, measured_at_m });
        self.edges_at.push(Vec::new());
    }

    /// Adds an edge. Returns `false`, without adding it, if a keyframe is missing or the covariance
    /// is not positive definite.
    pub fn add_edge(&mut self, edge: &MapEdge) -> bool {
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

    /// Number of loop edges between two keyframes, in either direction.
    pub fn loops_between(&self, one: KeyframeId, other: KeyframeId) -> usize {
        let [Some(&one), Some(&other)] = [one, other].map(|id| self.index.get(&id)) else { return 0 };
        let edges = self.edges_at[one].iter().map(|&edge| &self.edges[edge]);
        edges.filter(|edge| edge.kind == EdgeKind::Loop && edge.other(one) == other).count()
    }

    /// Pose of a keyframe.
    pub fn pose(&self, id: KeyframeId) -> Option<GroundPose> {
        self.index.get(&id).map(|&at| self.nodes[at].pose)
    }

    /// All keyframes with their poses, in order of insertion.
    pub fn poses(&self) -> impl Iterator<Item = (KeyframeId, GroundPose)> {
        self.nodes.iter().map(|node| (node.id, node.pose))
    }

    /// The mount's rotation per metre forward and per metre to the left as estimated from the
    /// loops, radians.
    pub fn turn_per_m(&self) -> (f64, f64) {
        (self.turn_per_m[0], self.turn_per_m[1])
    }

    /// Normalised residual squared of an edge at the current poses; `None` if its keyframes are not
    /// in the graph.
    pub fn misfit(&self, edge: &MapEdge) -> Option<f64> {
        let (from, to) = (*self.index.get(&edge.from)?, *self.index.get(&edge.to)?);
        let weighted = Weighted::new(from, to, edge, self.heights)?;
        Some(weighted.squared(&self.nodes[from], &self.nodes[to], self.turn_per_m))
    }

    /// The motion of `to` in the frame of `from`, metres as measured at the height of `from`.
    pub fn seen(&self, from: KeyframeId, to: KeyframeId) -> Option<Vector4<f64>> {
        let (a, b) = (&self.nodes[*self.index.get(&from)?], &self.nodes[*self.index.get(&to)?]);
        Some(a.seen(b))
    }
}

#[cfg(test)]
mod tests;

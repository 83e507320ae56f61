//! The connected components of the graph.

use super::{Heights, PoseGraph};
use crate::geometry::GroundPose;
use crate::keyframe::{EdgeKind, KeyframeId};

impl PoseGraph {
    /// Moves a keyframe, and all that is connected to it by measurements, so that it is at `pose`;
    /// returns `false`, without moving anything, if `fixed` is among them. Parts of a map that a
    /// recognition connects so come near each other before they are optimised.
    pub fn move_component(&mut self, keyframe: KeyframeId, pose: &GroundPose, fixed: KeyframeId) -> bool {
        let (Some(&start), Some(&fixed)) = (self.index.get(&keyframe), self.index.get(&fixed)) else {
            return false;
        };
        if start == fixed {
            return false;
        }
        let mut part = vec![false; self.nodes.len()];
        part[start] = true;
        let mut open = vec![start];
        while let Some(at) = open.pop() {
            for edge in self.edges_at[at].iter().map(|&edge| &self.edges[edge]) {
                let other = edge.other(at);
                if edge.kind != EdgeKind::Gap && !part[other] {
                    if other == fixed {
                        return false;
                    }
                    part[other] = true;
                    open.push(other);
                }
            }
        }
        let before = self.nodes[start].pose;
        let height_m = match self.heights {
            Heights::Held => before.height_m,
            Heights::Free => pose.height_m,
        };
        let moved = before.similarity_to(&GroundPose { height_m, ..*pose });
        for (node, _) in self.nodes.iter_mut().zip(part).filter(|(_, part)| *part) {
            node.pose = moved.apply_to_pose(&node.pose);
        }
        true
    }

    /// Whether measurements or gaps connect two keyframes.
    pub fn are_connected(&self, a: KeyframeId, b: KeyframeId) -> bool {
        self.reach(a).is_some_and(|mut reach| reach.to(b).is_some())
    }

    /// For every keyframe, whether it is the first of its connected component and nothing else
    /// holds that.
    pub(super) fn first_of_each_part(&self) -> Vec<bool> {
        let by_survey = self.held_by_survey();
        let mut first = vec![false; self.nodes.len()];
        let mut seen = vec![false; self.nodes.len()];
        let mut open = Vec::new();
        for start in 0..self.nodes.len() {
            if seen[start] {
                continue;
            }
            first[start] = true;
            seen[start] = true;
            open.push(start);
            while let Some(at) = open.pop() {
                first[start] &= by_survey.as_ref().is_none_or(|held| !held[at]);
                for &edge in &self.edges_at[at] {
                    let other = self.edges[edge].other(at);
                    if !seen[other] {
                        seen[other] = true;
                        open.push(other);
                    }
                }
            }
        }
        first
    }
}

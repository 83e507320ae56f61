//! Sensor fusion in the map: the fused path replaces the odometry frame before the loops are
//! optimised.

use super::Mapper;
use crate::geometry::pose_index::{X, Y};
use crate::geometry::{GroundPose, Sim2};
use crate::keyframe::relative_pose::relative_motion;
use crate::keyframe::{EdgeKind, KeyframeId};
use crate::odometry::FrameReference;
use crate::trajectory::FrameEstimate;
use std::collections::BTreeMap;

impl Mapper {
    /// Replaces the odometry frame by the fused one: `fused` are the frames `raw` after sensor
    /// fusion. Keyframes move with the frames measured against them; odometry and gap edges are
    /// recomputed; loop edges keep what was measured, in the new scale. The references are
    /// transformed too. Keyframes of earlier sessions stay where they are. To be called once,
    /// before [`Mapper::finish`].
    pub fn apply_fusion(
        &mut self,
        raw: &[FrameEstimate],
        fused: &[FrameEstimate],
        references: &mut [Option<FrameReference>],
    ) {
        let mut moves: BTreeMap<KeyframeId, Sim2> = BTreeMap::new();
        for ((raw, fused), reference) in raw.iter().zip(fused).zip(references.iter_mut()) {
            let (Some(from), Some(to), Some(reference)) = (&raw.estimate, &fused.estimate, reference) else {
                continue;
            };
            let moved = from.measured_pose().similarity_to(&to.measured_pose());
            moves.entry(reference.keyframe).or_insert(moved);
            if let Some((id, pose)) = &mut reference.next {
                // A keyframe made from this frame moves with it; one that was revisited moves as
                // before.
                let by = *moves.entry(*id).or_insert(moved);
                *pose = by.apply_to_pose(pose);
            }
        }
        let before: BTreeMap<KeyframeId, GroundPose> =
            self.map.keyframes.iter().map(|keyframe| (keyframe.id, keyframe.odometry_pose)).collect();
        for (id, moved) in &moves {
            let Some(keyframe) = self.of_run_mut(*id) else { continue };
            let map_from_odometry = keyframe.map_from_odometry();
            keyframe.odometry_pose = moved.apply_to_pose(&keyframe.odometry_pose);
            keyframe.pose = map_from_odometry.apply_to_pose(&keyframe.odometry_pose);
        }
        let now: BTreeMap<KeyframeId, GroundPose> =
            self.map.keyframes.iter().map(|keyframe| (keyframe.id, keyframe.odometry_pose)).collect();
        let first = self.first_keyframe();
        for edge in self.map.edges.iter_mut().filter(|edge| edge.from >= first) {
            let (Some(from), Some(to), Some(was)) =
                (now.get(&edge.from), now.get(&edge.to), before.get(&edge.from))
            else {
                continue;
            };
            if edge.kind == EdgeKind::Loop {
                let scale = from.height_m / was.height_m;
                edge.motion[X] *= scale;
                edge.motion[Y] *= scale;
            } else {
                edge.motion = relative_motion(from, to);
            }
        }
        self.rescale_sightings(|id| match (now.get(&id), before.get(&id)) {
            (Some(now), Some(was)) => now.height_m / was.height_m,
            _ => 1.0,
        });
        self.rebuild();
    }
}

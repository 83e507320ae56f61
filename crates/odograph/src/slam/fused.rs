//! Other sensors in the map: the path that they have set right is what the loops then pull at.

use super::Mapper;
use super::correction::measured;
use crate::geometry::pose_index::{X, Y};
use crate::geometry::{GroundPose, Sim2};
use crate::mapping::plane_motion::seen_from;
use crate::mapping::{EdgeKind, KeyframeId};
use crate::odometry::FrameReference;
use crate::trajectory::FrameEstimate;
use std::collections::BTreeMap;

impl Mapper {
    /// Takes over the odometry frame as other sensors have set it right: `fused` are the frames `raw` thereafter. Keyframes move with the frames
    /// measured against them, odometry and gap edges follow, and loops keep what was seen, in the new scale. The references are brought into the
    /// new frame too. To be called once, before [`Mapper::finish`].
    pub fn take_over(
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
            let moved = measured(from).similarity_to(&measured(to));
            moves.entry(reference.keyframe).or_insert(moved);
            if let Some((id, pose)) = &mut reference.next {
                // A keyframe that this frame became lies with it; one that was taken up again where it always lay.
                let by = *moves.entry(*id).or_insert(moved);
                *pose = by.apply_to_pose(pose);
            }
        }
        let before: BTreeMap<KeyframeId, GroundPose> =
            self.map.keyframes.iter().map(|keyframe| (keyframe.id, keyframe.odometry_pose)).collect();
        for keyframe in &mut self.map.keyframes {
            if let Some(moved) = moves.get(&keyframe.id) {
                keyframe.odometry_pose = moved.apply_to_pose(&keyframe.odometry_pose);
                keyframe.pose = moved.apply_to_pose(&keyframe.pose);
            }
        }
        let now: BTreeMap<KeyframeId, GroundPose> =
            self.map.keyframes.iter().map(|keyframe| (keyframe.id, keyframe.odometry_pose)).collect();
        for edge in &mut self.map.edges {
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
                edge.motion = seen_from(from, to);
            }
        }
        self.rebuild();
    }
}

//! Transforms frames into the map frame.
//!
//! A frame keeps its measured pose relative to its keyframe, wherever the map moves that. Between
//! one keyframe and the next the correction changes a little; it is interpolated over the frames
//! between, so the path has no steps.

use super::Mapper;
use crate::geometry::pose_index::HEIGHT;
use crate::geometry::{GroundPose, PlaneTransform, Se2, Sim2, propagated, wrap_angle};
use crate::ground_map::MapKeyframe;
use crate::keyframe::KeyframeId;
use crate::odometry::FrameReference;
use crate::trajectory::{FrameEstimate, PoseEstimate};
use nalgebra::Matrix6;

/// The frames in the map frame, from those in the odometry frame and the keyframes they were
/// measured against. Unchanged without loop closures.
pub fn map_frames(
    mapper: &Mapper,
    frames: &[FrameEstimate],
    references: &[Option<FrameReference>],
) -> Vec<FrameEstimate> {
    let mut spans = KeyframeSpans::default();
    for (frame, reference) in frames.iter().zip(references) {
        spans.push(frame, reference.as_ref());
    }
    let mut correction = spans.correction(mapper);
    frames.iter().map(|frame| correction.next(frame.clone())).collect()
}

/// The frames of a recording grouped by the keyframe they were measured against, without losses
/// between them. The end of a group must be known before its frames are corrected; for frames that
/// are not in memory at once, this makes two passes: here and in [`MapFrameCorrection`].
#[derive(Debug, Default)]
pub struct KeyframeSpans {
    /// In order; frames without a reference are in none.
    spans: Vec<KeyframeSpan>,
    /// Whether the next frame may belong to the last one.
    open: bool,
    frames: usize,
}

#[derive(Debug)]
struct KeyframeSpan {
    first: usize,
    count: usize,
    keyframe: KeyframeId,
    /// The next keyframe, the last frame's pose measured against it, and its pose measured here.
    end: Option<(KeyframeId, GroundPose, GroundPose)>,
}

impl KeyframeSpans {
    /// Adds the next frame, in the odometry frame, and its reference.
    pub fn push(&mut self, frame: &FrameEstimate, reference: Option<&FrameReference>) {
        let index = self.frames;
        self.frames += 1;
        let Some(&FrameReference { keyframe, next }) = reference else {
            self.open = false;
            return;
        };
        let end =
            next.zip(frame.estimate.as_ref()).map(|((id, pose), known)| (id, pose, known.measured_pose()));
        match self.spans.last_mut().filter(|span| self.open && span.keyframe == keyframe) {
            Some(span) => {
                span.count += 1;
                span.end = end;
            }
            None => self.spans.push(KeyframeSpan { first: index, count: 1, keyframe, end }),
        }
        self.open = next.is_none();
    }

    /// The second pass over the same frames.
    pub fn correction<'a>(&'a self, mapper: &'a Mapper) -> MapFrameCorrection<'a> {
        MapFrameCorrection { mapper, rest: &self.spans, index: 0, group: None, turned_rad: None }
    }
}

/// Transforms frames into the map frame, one after the other.
#[derive(Debug)]
pub struct MapFrameCorrection<'a> {
    mapper: &'a Mapper,
    /// The groups from the next frame on.
    rest: &'a [KeyframeSpan],
    index: usize,
    /// The correction of the first of them; `None` until it is needed.
    group: Option<GroupCorrection<'a>>,
    /// By how much the last frame was turned, radians, whole turns included.
    turned_rad: Option<f64>,
}

/// The correction of a group of frames.
#[derive(Debug, Clone, Copy)]
struct GroupCorrection<'a> {
    /// The keyframe; `None` where it is not in the map.
    here: Option<&'a MapKeyframe>,
    end: Option<Sim2>,
}

impl<'a> MapFrameCorrection<'a> {
    /// The next frame in the map frame.
    pub fn next(&mut self, mut frame: FrameEstimate) -> FrameEstimate {
        let index = self.index;
        self.index += 1;
        let Some(span) = self.rest.first().filter(|span| span.first <= index && self.mapper.is_corrected())
        else {
            return frame;
        };
        let group = *self.group.get_or_insert_with(|| GroupCorrection::new(self.mapper, span));
        if let (Some(known), Some(here)) = (&mut frame.estimate, group.here) {
            // The last frame of a group is where the next keyframe has it.
            let share = (index - span.first + 1) as f64 / span.count as f64;
            let before_rad = known.pose.heading_rad;
            corrected(known, &here.map_from_odometry(), group.end.as_ref().map(|end| (end, share)), here);
            // Keyframes are in the map but for whole turns, which add up along the path.
            let turned_rad = known.pose.heading_rad - before_rad;
            let nearest_rad = self.turned_rad.map_or(turned_rad, |last| last + wrap_angle(turned_rad - last));
            known.pose.heading_rad += nearest_rad - turned_rad;
            known.measured.heading_rad += nearest_rad - turned_rad;
            self.turned_rad = Some(nearest_rad);
        }
        if index + 1 == span.first + span.count {
            (self.rest, self.group) = (&self.rest[1..], None);
        }
        frame
    }
}

impl<'a> GroupCorrection<'a> {
    fn new(mapper: &'a Mapper, span: &KeyframeSpan) -> Self {
        let here = mapper.of_run(span.keyframe);
        let end = span.end.and_then(|(next, in_next, measured)| {
            let to = mapper.of_run(next)?.map_from_odometry().apply_to_pose(&in_next);
            Some(measured.similarity_to(&to))
        });
        Self { here, end }
    }
}

/// Corrects a frame: interpolates between the corrections of its own and of the next keyframe.
fn corrected(known: &mut PoseEstimate, begin: &Sim2, end: Option<(&Sim2, f64)>, keyframe: &MapKeyframe) {
    let blend = |pose: &GroundPose| {
        let here = begin.apply_to_pose(pose);
        end.map_or(here, |(end, share)| here.interpolated(&end.apply_to_pose(pose), share))
    };
    let pose = blend(&known.pose);
    let plane = blend(&known.measured_pose());
    let turn_rad = plane.heading_rad - known.measured.heading_rad;
    let turned = Sim2::about_origin(turn_rad, pose.height_m / known.pose.height_m);
    let own = propagated(&Se2::rotation(turn_rad).product_by_right(), &known.measured.covariance);
    let velocity = &mut known.velocity;
    (velocity.x_m_s, velocity.y_m_s) = turned.rotate(velocity.x_m_s, velocity.y_m_s);
    known.pose = pose;
    (known.measured.x_m, known.measured.y_m) = (plane.x_m, plane.y_m);
    known.measured.heading_rad = plane.heading_rad;
    known.measured.covariance = own;
    known.covariance = propagated_from(keyframe, &pose, &known.covariance);
    let with_own = known.covariance.fixed_view::<3, 3>(0, 0) + own;
    known.covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&with_own);
}

/// Propagates the keyframe's covariance to a pose measured against it. Height and tilt keep
/// odometry's variances.
fn propagated_from(keyframe: &MapKeyframe, pose: &GroundPose, odometry: &Matrix6<f64>) -> Matrix6<f64> {
    let mut covariance = propagated(&keyframe.pose.lever_arm_to(pose), &keyframe.covariance);
    // Without the keyframe's correlations, which do not belong to odometry's variances.
    for i in HEIGHT..6 {
        covariance.row_mut(i).fill(0.0);
        covariance.column_mut(i).fill(0.0);
        covariance[(i, i)] = odometry[(i, i)];
    }
    covariance
}

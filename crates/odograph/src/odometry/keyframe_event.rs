//! What happens to the keyframes while frames are taken: the values that a map is made of.

use super::Odometry;
use super::keyframe::Keyframe;
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::image::GrayImage;
use crate::keyframe::relative_pose::{motion_covariance, relative_motion};
use crate::keyframe::{EdgeKind, GroundInView, KeyframeId, MapEdge};
use crate::motion::global_image;
use nalgebra::Matrix6;
use std::sync::Arc;

/// Something that happened to the keyframes.
#[derive(Debug, Clone, PartialEq)]
pub enum KeyframeEvent {
    /// A frame became a keyframe.
    Made(Box<NewKeyframe>),
    /// The camera came back to one of the last keyframes, which was measured again: a loop.
    Revisited(MapEdge),
}

/// A frame that became a keyframe.
#[derive(Debug, Clone, PartialEq)]
pub struct NewKeyframe {
    /// Its number in this run, from 0.
    pub id: KeyframeId,
    /// Which of the frames that the pipeline took it was, from 0.
    pub frame: u64,
    /// Its time, seconds.
    pub time_s: f64,
    /// Number of gaps before it.
    pub segment: usize,
    /// Where odometry puts it.
    pub pose: GroundPose,
    /// Covariance of the pose against the start of the run, (x, y, heading, height, roll, pitch).
    pub covariance: Matrix6<f64>,
    /// Its part by systematic errors: those of the readout time, the mount and the scale, which are
    /// the same all along the path, so that loops agree with a path that has them.
    pub systematic: Matrix6<f64>,
    /// Pose relative to the keyframe it was measured against or, after a gap, to the last one;
    /// `None` for the first.
    pub tie: Option<MapEdge>,
    /// What it shows, as a global shutter would have.
    pub image: GrayImage,
    /// What of it is known not to be ground.
    pub mask: Option<Arc<ImageMask>>,
    /// The ground that it shows; `None` where that is the plane z = 0, or not known.
    pub ground: Option<GroundInView>,
}

/// What the last frame was measured against.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameReference {
    /// The keyframe it was measured against; itself where it is the first of all.
    pub keyframe: KeyframeId,
    /// If the reference changes with this frame: the new one, and this frame's pose measured
    /// against it.
    pub next: Option<(KeyframeId, GroundPose)>,
}

/// How a keyframe is tied to the one before it.
#[derive(Debug)]
pub(super) struct Before {
    pub id: KeyframeId,
    pub pose: GroundPose,
    /// The new keyframe's pose as measured against it.
    pub frame: GroundPose,
    /// Of the new keyframe's pose given the one before, in the world's axes.
    pub covariance: Matrix6<f64>,
    pub kind: EdgeKind,
}

impl Odometry {
    /// Records keyframe events for [`Odometry::take_keyframe_events`], which must then be called
    /// after every frame.
    pub fn record_keyframes(&mut self) {
        self.events.get_or_insert_default();
    }

    /// Keyframe events since the last call, in order; none without [`Odometry::record_keyframes`].
    pub fn take_keyframe_events(&mut self) -> Vec<KeyframeEvent> {
        self.events.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// What the last frame was measured against; `None` where it was lost.
    pub fn reference(&self) -> Option<FrameReference> {
        self.reference
    }

    /// The number of a new keyframe.
    pub(super) fn next_id(&mut self) -> KeyframeId {
        self.keyframes += 1;
        KeyframeId(self.keyframes - 1)
    }

    /// Takes a keyframe into use: gives it its number, and records the event.
    pub(super) fn number(
        &mut self,
        keyframe: &mut Keyframe,
        (frame, time_s): (u64, f64),
        before: Option<Before>,
    ) {
        let id = match keyframe.id {
            Some(id) => id,
            None => self.next_id(),
        };
        keyframe.id = Some(id);
        let scale = self.scale_covariance(&keyframe.pose);
        let Some(events) = &mut self.events else { return };
        let tie = before.map(|before| MapEdge {
            from: before.id,
            to: id,
            kind: before.kind,
            motion: relative_motion(&before.pose, &before.frame),
            covariance: motion_covariance(&before.pose, &before.frame, &before.covariance),
        });
        let systematic = self.learned.readout_covariance(&keyframe.by_readout)
            + self.learned.mount_covariance(&keyframe.by_mount_tilt)
            + scale;
        events.push(KeyframeEvent::Made(Box::new(NewKeyframe {
            id,
            frame,
            time_s,
            segment: self.segment,
            pose: keyframe.pose,
            covariance: keyframe.covariance + keyframe.model_covariance + systematic,
            systematic,
            tie,
            image: self.resolution.enlarged(global_image(
                &self.camera,
                keyframe.pyramid.base(),
                &keyframe.pose,
                &keyframe.shutter,
            )),
            mask: keyframe.mask.as_ref().map(|mask| self.resolution.enlarged_mask(mask)),
            ground: keyframe.ground_in_view(&self.camera),
        })));
    }

    /// Records that a frame was measured against both the present keyframe and an older one.
    pub(super) fn record_revisit(
        &mut self,
        old: &Keyframe,
        by_present: (&GroundPose, &Matrix6<f64>),
        by_old: (&GroundPose, &Matrix6<f64>),
    ) {
        let (Some(events), Some(present)) = (&mut self.events, &self.keyframe) else { return };
        let (Some(from), Some(to)) = (present.id, old.id) else { return };
        // Where the old one is if the frame is where the present one has it.
        let frame_in_old = relative_motion(by_old.0, &old.pose);
        let moved = crate::keyframe::relative_pose::compose(by_present.0, &frame_in_old, 1.0);
        // Both measurements of the frame; an error of the heading turns the old one about the
        // frame.
        let mut adjoint = Matrix6::identity();
        let (dx, dy) = (old.pose.x_m - by_old.0.x_m, old.pose.y_m - by_old.0.y_m);
        (adjoint[(0, 2)], adjoint[(1, 2)]) = (-dy, dx);
        let covariance = adjoint * (by_present.1 + by_old.1) * adjoint.transpose();
        events.push(KeyframeEvent::Revisited(MapEdge {
            from,
            to,
            kind: EdgeKind::Loop,
            motion: relative_motion(&present.pose, &moved),
            covariance: motion_covariance(&present.pose, &moved, &covariance),
        }));
    }
}

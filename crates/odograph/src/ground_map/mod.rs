//! The map of the ground: its keyframes, the edges between them and the images.
//!
//! Plain values, and the traits through which the images are loaded and stored. The map file
//! implements these.

mod images;

pub use images::{KeyframeImage, KeyframeImages, KeyframeStore, MemoryImages};

use crate::camera::{Camera, Rig};
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPose, Sim2};
use crate::keyframe::{KeyframeId, MapEdge};
use crate::place_recognition::Signature;
use nalgebra::Matrix6;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A frame whose image is part of the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapKeyframe {
    /// Its number.
    pub id: KeyframeId,
    /// The session it comes from, from 0.
    pub session: u32,
    /// Number of gaps before it in its session.
    pub segment: usize,
    /// Number of its frame in the source.
    pub frame: u64,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Pose in the odometry frame of its session, which never jumps.
    pub odometry_pose: GroundPose,
    /// Pose in the map frame, after loop closure.
    pub pose: GroundPose,
    /// Covariance of `pose`: (x, y, heading, height, roll, pitch), metres and radians.
    pub covariance: Matrix6<f64>,
    /// Appearance for place recognition.
    pub signature: Signature,
}

impl MapKeyframe {
    /// The transform of poses near it from the odometry frame to the map frame.
    pub fn map_from_odometry(&self) -> Sim2 {
        self.odometry_pose.similarity_to(&self.pose)
    }
}

/// A camera and its mount at the start of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct MountedCamera {
    /// The camera.
    pub camera: Camera,
    /// Its mount.
    pub rig: Rig,
}

/// A map without its images: enough to localize in it.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundMap {
    /// The camera of every session without an entry in `other_cameras`.
    pub camera: Camera,
    /// Its mount at the start of the first session.
    pub rig: Rig,
    /// The sessions that were made with another camera or mount, by session number.
    pub other_cameras: BTreeMap<u32, MountedCamera>,
    /// Masks of pixels that do not show ground, by session, where there are any.
    pub masks: BTreeMap<u32, Arc<ImageMask>>,
    /// The keyframes in order of their numbers; a thinned map lacks some numbers.
    pub keyframes: Vec<MapKeyframe>,
    /// The edges in order of their creation.
    pub edges: Vec<MapEdge>,
}

impl GroundMap {
    /// The camera that the keyframes of a session were taken with.
    pub fn camera_of(&self, session: u32) -> &Camera {
        self.other_cameras.get(&session).map_or(&self.camera, |other| &other.camera)
    }

    /// The mount of a session's camera at its start.
    pub fn rig_of(&self, session: u32) -> &Rig {
        self.other_cameras.get(&session).map_or(&self.rig, |other| &other.rig)
    }

    /// The mask that a new image of a camera most likely needs: that of the newest session with
    /// this camera.
    pub fn newest_mask_of(&self, camera: &Camera) -> Option<&Arc<ImageMask>> {
        let has_it = |keyframe: &&MapKeyframe| self.camera_of(keyframe.session) == camera;
        self.masks.get(&self.keyframes.iter().rev().find(has_it)?.session)
    }

    /// Whether all keyframes were taken with the same camera; mounts may differ.
    pub fn has_one_camera(&self) -> bool {
        self.other_cameras.values().all(|other| other.camera == self.camera)
    }
}

//! Simultaneous localization and mapping: odometry, and a map whose loop closures correct its
//! drift.
//!
//! There are two frames of reference (as in ROS's REP-105). In the **odometry frame** poses are
//! available at once and never jump, but drift. In the **map frame** every place has one pose,
//! which changes when a loop closure corrects it. The map never feeds back into odometry: odometry
//! gives the same poses with and without a map, and mapping may run behind it in its own thread.
//!
//! Derivation: `docs/math/loop-closure.md`.

mod backoff;
mod session_scale;
mod mapper;
mod antenna;
mod closing;
mod correction;
mod fusion;
mod landmarks;
mod localization;
mod merge;
mod fleet;

pub use antenna::{AntennaFix, DriftCorrection};
pub use correction::{KeyframeSpans, MapFrameCorrection, map_frames};
pub use fleet::{FleetMapper, OdometryPlacement};
pub use landmarks::{ControlUse, Landmark, Surveyed};
pub use localization::Located;
pub use mapper::Mapper;
pub use merge::{Merged, merge, optimize};
pub use session_scale::SessionScale;

use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::geometry::GroundPose;
use crate::ground_map::KeyframeStore;
use crate::image::GrayImage;
use crate::loop_closure::LoopClosureConfig;
use crate::odometry::{FrameReference, Odometry, OdometryConfig};
use crate::trajectory::FrameEstimate;

/// One frame in both frames of reference.
#[derive(Debug, Clone)]
pub struct SlamFrame {
    /// In the odometry frame.
    pub odometry: FrameEstimate,
    /// The keyframe it was measured against.
    pub reference: Option<FrameReference>,
    /// Its pose in the map frame as known now; `None` for a lost frame.
    pub map_pose: Option<GroundPose>,
}

/// Odometry and mapping, one after the other in the same thread.
pub struct Slam {
    odometry: Odometry,
    mapper: Mapper,
    images: Box<dyn KeyframeStore>,
}

impl Slam {
    /// A system for one recording; `images` stores the keyframes' images. Fails for an invalid rig
    /// or parameter.
    pub fn new(
        camera: Camera,
        rig: Rig,
        odometry: OdometryConfig,
        config: LoopClosureConfig,
        images: Box<dyn KeyframeStore>,
    ) -> Result<Self> {
        let mapper = Mapper::new(&camera, rig, &odometry, config);
        let mut odometry = Odometry::new(camera, rig, odometry)?;
        odometry.record_keyframes();
        Ok(Self { odometry, mapper, images })
    }

    /// Processes the next frame. Fails if the image size is not the camera's, the time is not
    /// finite, or a keyframe's image cannot be stored or loaded.
    pub fn process(&mut self, image: GrayImage, time_s: f64) -> Result<SlamFrame> {
        let odometry = self.odometry.process(image, time_s)?;
        for event in self.odometry.take_keyframe_events() {
            self.mapper.take(event, None, self.images.as_mut())?;
        }
        let reference = self.odometry.reference();
        let known = odometry.estimate.as_ref().map(|known| known.pose);
        let map_pose =
            reference.zip(known).and_then(|(reference, pose)| self.mapper.in_map(reference.keyframe, &pose));
        Ok(SlamFrame { odometry, reference, map_pose })
    }

    /// Ends the recording and optimises the whole graph. Returns the map and the images.
    pub fn finish(mut self) -> (Mapper, Box<dyn KeyframeStore>) {
        self.mapper.finish();
        (self.mapper, self.images)
    }
}

#[cfg(test)]
mod tests;

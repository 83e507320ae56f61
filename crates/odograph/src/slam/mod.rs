//! Simultaneous localization and mapping: odometry, and a map whose loop closures correct its
//! drift.
//!
//! There are two frames of reference (as in ROS's REP-105). In the **odometry frame** poses are
//! available at once and never jump, but drift. In the **map frame** every place has one pose,
//! which changes when a loop closure corrects it. The map never feeds back into odometry: odometry
//! gives the same poses with and without a map, and mapping may run behind it in its own thread.

mod candidates;
mod closing;
mod closure;
mod correction;
mod fused;
mod images;
mod locate;
mod mapper;
mod merge;
mod recognition;

pub use closure::LoopClosure;
pub use correction::{Straightening, Stretches, map_frames};
pub use images::{KeyframeStore, MemoryImages};
pub use locate::Located;
pub use mapper::Mapper;
pub use merge::{Merged, merge, optimize};

use crate::camera::{Camera, Rig};
use crate::error::{Error, Result};
use crate::geometry::GroundPose;
use crate::image::GrayImage;
use crate::odometry::{FrameReference, Odometry, OdometryConfig};
use crate::trajectory::FrameEstimate;
use serde::{Deserialize, Serialize};

/// When a loop closure is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SlamConfig {
    /// Whether to search for loop closures.
    pub loops: bool,
    /// Maximum number of older keyframes that a new one is compared with.
    pub comparisons: usize,
    /// Minimum number of edges between two keyframes for a loop closure: with fewer, odometry has
    /// them well enough.
    pub least_edges: usize,
    /// Minimum overlap of two keyframes, as a share of the new one's view.
    pub least_overlap: f64,
    /// Minimum share of the corners in the overlap that must be matched.
    pub least_presence: f64,
    /// Number of agreeing matches on different ground, 1 or 2, that joins parts of a map whose
    /// relative pose is unknown or ambiguous. 1 is enough to localize a camera; a map that is kept
    /// needs 2.
    pub sightings: usize,
}

impl Default for SlamConfig {
    fn default() -> Self {
        Self {
            loops: true,
            comparisons: 2,
            least_edges: 4,
            least_overlap: 0.35,
            least_presence: 0.5,
            sightings: 2,
        }
    }
}

impl SlamConfig {
    /// The same parameters if all are in range. Fails with the name and the value of one that is
    /// not.
    pub fn validated(self) -> Result<Self> {
        for (name, share) in [("least_overlap", self.least_overlap), ("least_presence", self.least_presence)]
        {
            if !(0.1..=1.0).contains(&share) {
                return Err(Error::usage(format!("slam.{name} is {share}; it must lie between 0.1 and 1")));
            }
        }
        for (name, number, range) in [
            ("comparisons", self.comparisons, 1..=1000),
            ("least_edges", self.least_edges, 2..=1000),
            ("sightings", self.sightings, 1..=2),
        ] {
            if !range.contains(&number) {
                let (least, most) = range.into_inner();
                return Err(Error::usage(format!(
                    "slam.{name} is {number}; it must lie between {least} and {most}"
                )));
            }
        }
        Ok(self)
    }
}

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
        config: SlamConfig,
        images: Box<dyn KeyframeStore>,
    ) -> Result<Self> {
        let mapper = Mapper::new(&camera, rig, &odometry, config);
        let mut odometry = Odometry::new(camera, rig, odometry)?;
        odometry.tell_keyframes();
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

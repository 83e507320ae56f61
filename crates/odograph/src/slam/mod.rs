//! The whole system: odometry, and a map that pulls its path straight where ground is seen again.
//!
//! There are two frames of reference (as in ROS's REP-105). In the **odometry frame** poses come at once and never jump, but drift. In the **map
//! frame** every place has one pose, which changes when a loop shows where it really is. The map never feeds back into odometry: what odometry
//! gives is the same with a map and without, and the mapping may run behind, on a thread of its own.

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

/// When a place counts as seen again.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SlamConfig {
    /// Whether loops are looked for at all.
    pub loops: bool,
    /// A keyframe is compared with at most so many older ones.
    pub comparisons: usize,
    /// Keyframes that fewer edges than this lie between know each other well enough.
    pub least_edges: usize,
    /// The part of a keyframe that must be in view of another.
    pub least_overlap: f64,
    /// The part of the corners in view that must be found again.
    pub least_presence: f64,
    /// So many sightings of different ground, one or two, must agree before parts of a map that nothing sure connects are tied. One is for
    /// saying where a camera is; for a map that is kept, two.
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
    /// The same parameters, when each lies where it makes sense. Fails, naming the parameter and its value, where one does not.
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
    /// As odometry has it.
    pub odometry: FrameEstimate,
    /// What it was measured against.
    pub reference: Option<FrameReference>,
    /// Where it is in the map as known now; `None` where the frame was lost.
    pub map_pose: Option<GroundPose>,
}

/// Odometry with a map, one after the other on the same thread.
pub struct Slam {
    odometry: Odometry,
    mapper: Mapper,
    images: Box<dyn KeyframeStore>,
}

impl Slam {
    /// A system for one recording, which keeps the images of its map in `images`. Fails where the rig or a parameter cannot be.
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

    /// Takes the next frame. Fails where the image has not the size the camera is calibrated for, its time is not a number, or a keyframe's image
    /// cannot be kept or read.
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

    /// Ends the recording: the whole graph is optimised. Gives the map, and the images.
    pub fn finish(mut self) -> (Mapper, Box<dyn KeyframeStore>) {
        self.mapper.finish();
        (self.mapper, self.images)
    }
}

#[cfg(test)]
mod tests;

//! What the frames so far taught about those to come.

use crate::geometry::GroundPose;
use crate::motion::RigWander;

/// What is learned on the way.
#[derive(Debug, Clone)]
pub struct Learned {
    /// How much height and tilt are seen to move.
    pub wander: RigWander,
    /// The part of the corners in view that agreed in the last frames: below 1 where not everything in view is ground, or where corners are noise.
    presence: Option<f64>,
}

/// Weight of the newest frame in the usual presence: about the last five count.
const PRESENCE_RATE: f64 = 0.2;

/// What is expected before any frame was measured.
const UNKNOWN_PRESENCE: f64 = 0.5;

/// Where this part of the corners in view agrees, all that can be found are taken to be: a few always miss.
const ALL_PRESENT: f64 = 0.75;

impl Learned {
    /// Nothing yet, of a camera that begins here.
    pub fn new(first: &GroundPose) -> Self {
        Self { wander: RigWander::new(first), presence: None }
    }

    /// A frame was measured, and this part of the corners in view agreed.
    pub fn saw(&mut self, presence: f64) {
        let usual = self.presence.get_or_insert(presence);
        *usual += PRESENCE_RATE * (presence - *usual);
    }

    /// The part of the corners in view that usually agrees, 0 to 1.
    pub fn usual_presence(&self) -> f64 {
        self.presence.unwrap_or(UNKNOWN_PRESENCE)
    }

    /// The part of a keyframe's corners that can be expected to be found again, 0 to 1. On plain tiles in noise most of what looks like a corner is
    /// noise: a keyframe is not used up, nor a search in vain, because those do not come back.
    pub fn findable(&self) -> f64 {
        self.presence.map_or(1.0, |usual| (usual / ALL_PRESENT).min(1.0))
    }
}

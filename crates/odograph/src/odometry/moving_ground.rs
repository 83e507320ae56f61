//! Ground that moves by itself, such as grass and leaves in wind: outliers that neither the motion
//! of the camera nor an elevation explains, frame after frame.

use crate::geometry::GroundPoint;

/// A corner moves by itself where it strayed in this many frames and in more than half of all.
const STRAYS: u32 = 3;

/// Fewer points that move by themselves are tracking errors.
const MIN_MOVING: usize = 10;

/// A smaller fraction of the corners that moves does no harm, and may be tracking errors.
const MIN_MOVING_SHARE: f64 = 0.1;

/// Ground moves as the majority of the known points within this distance does, a fraction of the
/// height: a tuft of grass. Chosen on one rendering, seen again on three other seeds.
const TUFT: f64 = 0.12;

/// Points further away than this are forgotten at the next keyframe, a fraction of the height.
const MEMORY: f64 = 3.0;

/// How often a corner was found, and how often it strayed: neither the motion nor an elevation
/// explained where it was.
#[derive(Debug, Clone, Copy, Default)]
pub struct StrayCount {
    found: u32,
    strays: u32,
}

impl StrayCount {
    /// Counts a frame in which the corner was found.
    pub fn add(&mut self, strays: bool) {
        self.found += 1;
        self.strays += u32::from(strays);
    }

    /// Whether the corner moves by itself.
    pub fn moves(self) -> bool {
        self.strays >= STRAYS && 2 * self.strays > self.found
    }

    /// Whether it was found and never strayed.
    pub fn is_still(self) -> bool {
        self.found > 0 && self.strays == 0
    }
}

/// Points of the ground that move by themselves, and others that do not.
#[derive(Debug, Clone, Default)]
pub struct MovingGround {
    moving: Vec<GroundPoint>,
    still: Vec<GroundPoint>,
}

impl MovingGround {
    /// Whether most of the known points near a point move; `height_m` is that of the camera.
    pub fn contains(&self, point: &GroundPoint, height_m: f64) -> bool {
        let near = |points: &[GroundPoint]| {
            points.iter().filter(|other| point.distance(**other) < TUFT * height_m).count()
        };
        self.moving.len() >= MIN_MOVING && near(&self.moving) > near(&self.still)
    }

    /// Whether `moving` of `corners` corners are enough to be dropped; once some were, all are.
    pub fn accepts(&self, moving: usize, corners: usize) -> bool {
        !self.moving.is_empty() || moving as f64 >= MIN_MOVING_SHARE * corners as f64
    }

    /// Adds points that move by themselves.
    pub fn extend(&mut self, moving: impl Iterator<Item = GroundPoint>) {
        self.moving.extend(moving);
    }

    /// What the next keyframe is to know: the moving points about `centre`, and beside them the
    /// points that are `still`. Nothing where too few move.
    pub fn next(&self, centre: GroundPoint, height_m: f64, still: impl Iterator<Item = GroundPoint>) -> Self {
        if self.moving.len() < MIN_MOVING {
            return Self::default();
        }
        let near = |point: &&GroundPoint| centre.distance(**point) < MEMORY * height_m;
        Self { moving: self.moving.iter().filter(near).copied().collect(), still: still.collect() }
    }
}

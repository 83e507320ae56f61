//! Messages between robots and site, as JSON.

use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph_map::SessionOrigin;
use serde::{Deserialize, Serialize};

/// Largest body of a request with records, bytes.
pub const MAX_BODY: usize = 16 << 20;
/// Longest description of a session, bytes.
pub const MAX_DESCRIPTION: usize = 16 << 10;

/// A session as its robot describes it before the first record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionDescription {
    /// Name of the robot.
    pub robot: String,
    /// Key of the session.
    pub key: String,
    /// Source of the run.
    pub source: String,
    /// The camera.
    pub camera: Camera,
    /// Its mount at the start.
    pub rig: Rig,
}

impl SessionDescription {
    /// Robot and key. Fails if they are no name and no key.
    pub fn origin(&self) -> Result<SessionOrigin> {
        SessionOrigin { robot: self.robot.clone(), key: self.key.clone() }.validated()
    }

    /// Checks everything. Fails with what is wrong.
    pub fn validated(self) -> Result<Self> {
        self.origin()?;
        self.rig.validated()?;
        let pixels = self.camera.width().saturating_mul(self.camera.height());
        if pixels > 64 << 20 || self.rig.height_m > 1e6 {
            return Err(Error::input("the camera is not one that a robot has over the ground"));
        }
        Ok(self)
    }
}

/// State of a robot at the site.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RobotState {
    /// Its records are part of the map.
    #[default]
    Active,
    /// The same whatever its scale is, by the decision of a person.
    Trusted,
    /// Its scale differs from the map's: its records are kept, but are not part of the map.
    Quarantined,
    /// A person has removed its records from the map; they are kept.
    Withdrawn,
}

impl RobotState {
    /// As it is written.
    pub fn name(self) -> &'static str {
        match self {
            Self::Active => "active",
            Self::Trusted => "trusted",
            Self::Quarantined => "quarantined",
            Self::Withdrawn => "withdrawn",
        }
    }

    /// Whether the robot's records are part of the map.
    pub fn is_merged(self) -> bool {
        matches!(self, Self::Active | Self::Trusted)
    }

    /// The state with a name.
    pub fn named(name: &str) -> Option<Self> {
        let all = [Self::Active, Self::Trusted, Self::Quarantined, Self::Withdrawn];
        all.into_iter().find(|state| state.name() == name)
    }
}

/// Where the odometry frame of a robot's session lies in the map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapFromOdom {
    /// Translation along x of the map, metres.
    pub x_m: f64,
    /// Translation along y of the map, metres.
    pub y_m: f64,
    /// Rotation, radians.
    pub heading_rad: f64,
    /// Metres of the map over metres of the odometry frame.
    pub scale: f64,
    /// Covariance of x, y and heading of the keyframe in the map, against the map's first keyframe,
    /// metres and radians: an upper bound.
    pub covariance: [[f64; 3]; 3],
    /// Number of the keyframe at which it holds.
    pub keyframe: u64,
}

/// Answer of the site to a robot.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SiteStatus {
    /// Number of the last record of the session that is on the site's disk.
    pub acknowledged: Option<u64>,
    /// Whether the session has ended.
    pub ended: bool,
    /// Version of the map: it increases with every change.
    pub version: u64,
    /// What the site makes of the robot.
    pub state: RobotState,
    /// Why it is not part of the map.
    pub reason: Option<String>,
    /// Where the odometry frame lies; `None` until the session is recognised in the map.
    pub map_from_odom: Option<MapFromOdom>,
}

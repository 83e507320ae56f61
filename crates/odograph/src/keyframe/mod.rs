//! Values about keyframes that odometry, the pose graph and the map share: their numbers, the edges
//! between them, and relative poses.

mod edge;
pub mod relative_pose;

pub use edge::{EdgeKind, KeyframeId, MapEdge};

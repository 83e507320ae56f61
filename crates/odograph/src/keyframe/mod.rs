//! Values about keyframes that odometry, the pose graph and the map share: their numbers, the edges
//! between them, relative poses, and the ground in view.

mod edge;
mod ground_in_view;
pub mod relative_pose;

pub use edge::{EdgeKind, KeyframeId, MapEdge};
pub use ground_in_view::GroundInView;

//! Poses: `geometry_msgs/PoseStamped`, `PoseWithCovarianceStamped`, `TransformStamped`, and that of
//! `nav_msgs/Odometry`.

use crate::bag::cursor::MessageCursor;
use crate::bag::recording::Topic;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// The pose of a message; `None` if it is cut off or not rigid.
pub(crate) fn read(topic: &Topic, data: &[u8]) -> Option<Isometry3<f64>> {
    let mut message = MessageCursor::new(data, &topic.serialization)?;
    message.header()?;
    if matches!(topic.plain_type().as_str(), "nav_msgs/Odometry" | "geometry_msgs/TransformStamped") {
        let _child = message.string()?;
    }
    rigid(message.doubles()?)
}

/// A position and a quaternion (x, y, z, w) as a pose; `None` if they are none.
pub(super) fn rigid(numbers: [f64; 7]) -> Option<Isometry3<f64>> {
    let [x, y, z, i, j, k, w] = numbers;
    let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), 1e-3)?;
    let is_finite = numbers.iter().all(|number| number.is_finite());
    is_finite.then(|| Isometry3::from_parts(Translation3::new(x, y, z), rotation))
}

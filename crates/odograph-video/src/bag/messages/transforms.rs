//! Transforms: `tf2_msgs/TFMessage` on `/tf_static` and `/tf`.

use super::pose::rigid;
use crate::bag::cursor::{MessageCursor, Serialization};
use crate::bag::recording::Topic;
use nalgebra::Isometry3;
use std::borrow::Cow;

/// Whether a topic has the static transforms, of a robot with or without a name.
pub(crate) fn is_static(topic: &Topic) -> bool {
    has_transforms(topic) && topic.name.rsplit('/').next() == Some("tf_static")
}

/// Whether a topic has transforms that change.
pub(crate) fn is_moving(topic: &Topic) -> bool {
    has_transforms(topic) && !is_static(topic)
}

fn has_transforms(topic: &Topic) -> bool {
    matches!(topic.plain_type().as_str(), "tf2_msgs/TFMessage" | "tf/tfMessage")
        && matches!(topic.serialization, Serialization::Cdr | Serialization::Ros1)
}

/// A transform between two frames of a robot.
pub(crate) struct Transform<'a> {
    /// When it held, nanoseconds.
    pub stamp_ns: i64,
    pub child: Cow<'a, str>,
    pub parent: Cow<'a, str>,
    /// The child's pose in the parent.
    pub pose: Isometry3<f64>,
}

/// Most transforms in a message.
const MOST: u32 = 10_000;

/// Takes each transform of a message. Those that are not rigid are left out; ends where the message
/// is damaged.
pub(crate) fn each(topic: &Topic, data: &[u8], mut take: impl FnMut(Transform<'_>)) {
    let _ = read(topic, data, &mut take);
}

fn read(topic: &Topic, data: &[u8], take: &mut dyn FnMut(Transform<'_>)) -> Option<()> {
    let mut message = MessageCursor::new(data, &topic.serialization)?;
    for _ in 0..message.u32()?.min(MOST) {
        let header = message.header()?;
        let child = message.string()?;
        if let Some(pose) = rigid(message.doubles()?) {
            take(Transform { stamp_ns: header.stamp_ns, child, parent: header.frame, pose });
        }
    }
    Some(())
}

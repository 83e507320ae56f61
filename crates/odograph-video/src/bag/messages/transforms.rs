//! Static transforms: `tf2_msgs/TFMessage` on `/tf_static`.

use crate::bag::cursor::{MessageCursor, Serialization};
use crate::bag::recording::Topic;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// Whether a topic has the static transforms, of a robot with or without a name.
pub(crate) fn is_static(topic: &Topic) -> bool {
    topic.plain_type() == "tf2_msgs/TFMessage"
        && topic.name.rsplit('/').next() == Some("tf_static")
        && matches!(topic.serialization, Serialization::Cdr | Serialization::Ros1)
}

/// Most transforms in a message.
const MOST: u32 = 10_000;

/// Takes each transform of a message: child, parent and the child's pose in it. Those that are not
/// rigid are left out; ends where the message is damaged.
pub(crate) fn each(topic: &Topic, data: &[u8], mut take: impl FnMut(&str, &str, Isometry3<f64>)) {
    let _ = read(topic, data, &mut take);
}

fn read(topic: &Topic, data: &[u8], take: &mut dyn FnMut(&str, &str, Isometry3<f64>)) -> Option<()> {
    let mut message = MessageCursor::new(data, &topic.serialization)?;
    for _ in 0..message.u32()?.min(MOST) {
        let parent = message.header()?.frame;
        let child = message.string()?;
        let [x, y, z, i, j, k, w] = message.doubles()?;
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), 1e-3);
        if let Some(rotation) = rotation.filter(|_| [x, y, z, i, j, k, w].iter().all(|v| v.is_finite())) {
            take(&child, &parent, Isometry3::from_parts(Translation3::new(x, y, z), rotation));
        }
    }
    Some(())
}

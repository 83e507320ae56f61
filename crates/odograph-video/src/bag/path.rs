//! A path from elsewhere, such as of a motion capture system, from a topic.

use super::messages::{Role, pose, seconds, transforms};
use super::recording::{MessageReader, Topic};
use super::sensors::{at_path, each};
use super::topics::is_named;
use odograph::error::{Error, Result};
use odograph::trajectory::{StampedPose, Trajectory};
use std::path::Path;

/// Reads a path from a topic of a robot recording: `geometry_msgs/PoseStamped`,
/// `PoseWithCovarianceStamped` or `TransformStamped`, `nav_msgs/Odometry`, or of
/// `tf2_msgs/TFMessage` the transforms to `base_link`, or to `base_footprint` where there are none.
///
/// Times are those in the messages, as those of the frames. A message without a pose is left out.
/// The warnings, one sentence each, are of the times and the recording.
///
/// # Errors
/// If the path is not a robot recording or cannot be read, the topic is missing or of another type,
/// or it has no pose.
pub fn recorded_path(path: impl AsRef<Path>, topic: &str) -> Result<(Trajectory, Vec<String>)> {
    let path = path.as_ref();
    let (poses, warnings) = read(path, topic).map_err(|error| error.at(path.display()))?;
    Ok((Trajectory { poses }, at_path(path, warnings)))
}

fn read(path: &Path, name: &str) -> Result<(Vec<StampedPose>, Vec<String>)> {
    let moving = super::open(path)?.and_then(|recording| {
        let fits = |topic: &&Topic| transforms::is_moving(topic) && is_named(topic, name);
        let topic = recording.topics().iter().find(fits).cloned();
        topic.map(|topic| (recording, topic))
    });
    let (mut poses, warnings) = match moving {
        Some((mut recording, topic)) => (of_robot(recording.as_mut(), &topic)?, recording.take_warnings()),
        None => {
            let mut poses = Vec::new();
            let kind = "geometry_msgs/PoseStamped, nav_msgs/Odometry or tf2_msgs/TFMessage";
            let fits = |topic: &Topic| matches!(Role::of(topic), Role::Pose | Role::Wheel);
            let warnings = each(path, name, "path", (&fits, kind), |topic, time_s, data| {
                let pose = pose::read(topic, data);
                poses.extend(pose.map(|world_from_camera| StampedPose { time_s, world_from_camera }));
            })?;
            (poses, warnings)
        }
    };
    if poses.is_empty() {
        return Err(Error::input(format!("the topic {name} has no pose that a path could be compared with")));
    }
    poses.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    poses.dedup_by(|later, before| later.time_s <= before.time_s);
    Ok((poses, warnings))
}

/// The poses of the robot in the parent of its frame.
fn of_robot(recording: &mut dyn MessageReader, topic: &Topic) -> Result<Vec<StampedPose>> {
    recording.rewind()?;
    recording.select(&|other| other.is(topic));
    let [mut base, mut footprint] = [Vec::new(), Vec::new()];
    while recording.advance()? {
        transforms::each(topic, recording.message().data, |transform| {
            let pose = StampedPose { time_s: seconds(transform.stamp_ns), world_from_camera: transform.pose };
            match transform.child.rsplit('/').next() {
                Some("base_link") => base.push(pose),
                Some("base_footprint") => footprint.push(pose),
                _ => {}
            }
        });
    }
    Ok(if base.is_empty() { footprint } else { base })
}

//! How the camera is mounted on the robot, from the static transforms of a recording
//! (`/tf_static`), with the frames of ROS REP-105.

use super::messages::{frame_id, transforms};
use super::recording::{MessageReader, Topic};
use super::topics;
use nalgebra::Isometry3;
use odograph::camera::{LeverArm, Rig};
use odograph::error::Result;
use odograph::geometry::GroundPose;
use std::collections::BTreeMap;
use std::path::Path;

/// Where a camera is on the robot, as a recording has it.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedMount {
    /// Name of the camera's frame: that of its images.
    pub camera_frame: String,
    /// Pose of the camera (its optical frame) in `base_link`.
    pub base_from_camera: Isometry3<f64>,
    /// Height of the camera over `base_footprint`, which is on the ground, metres.
    pub height_m: Option<f64>,
}

impl RecordedMount {
    /// The rig, at a height above the ground, metres.
    ///
    /// # Errors
    /// If the camera does not look at the ground from there ([`Rig::validated`]).
    pub fn rig(&self, height_m: f64) -> Result<Rig> {
        let on_robot = GroundPose::from_world_from_camera(&self.base_from_camera);
        let GroundPose { x_m, y_m, height_m: z_m, heading_rad, roll_rad, pitch_rad } = on_robot;
        let lever_arm = Some(LeverArm { x_m, y_m, z_m });
        Rig { height_m, roll_rad, pitch_rad, yaw_rad: heading_rad, lever_arm }.validated()
    }
}

/// The mount of the camera whose images a run follows in a robot recording: those of `topic`, or of
/// the only topic with images. `None` if its static transforms do not connect the frame of the
/// images with `base_link`.
///
/// # Errors
/// If the path is not a robot recording or cannot be read, or the topic is not one with images.
pub fn recorded_mount(path: impl AsRef<Path>, topic: Option<&str>) -> Result<Option<RecordedMount>> {
    let path = path.as_ref();
    topics::open_with_frames(path, topic)
        .and_then(|(mut recording, images)| mount_of(recording.as_mut(), &images))
        .map_err(|error| error.at(path.display()))
}

/// Transforms that are published once come with the first messages: more of them are not looked at.
const MAX_MESSAGES: usize = 1000;

fn mount_of(recording: &mut dyn MessageReader, images: &Topic) -> Result<Option<RecordedMount>> {
    if !recording.topics().iter().any(transforms::is_static) {
        return Ok(None);
    }
    recording.rewind()?;
    recording.select(&|topic| transforms::is_static(topic) || topic.is(images));
    let (mut tree, mut camera_frame) = (Tree::default(), None);
    for _ in 0..MAX_MESSAGES {
        if !recording.advance()? {
            break;
        }
        let message = recording.message();
        let topic = &recording.topics()[message.topic];
        if topic.is(images) {
            camera_frame.get_or_insert_with(|| frame_id(topic, message.data));
        } else {
            transforms::each(topic, message.data, |child, parent, transform| {
                tree.insert(child, parent, transform);
            });
        }
    }
    let camera_frame = camera_frame.unwrap_or_default();
    let found = tree.base_from_camera(&camera_frame);
    Ok(found.map(|(base_from_camera, height_m)| RecordedMount { camera_frame, base_from_camera, height_m }))
}

/// Frames and their poses in their parents.
#[derive(Debug, Default)]
pub(super) struct Tree(BTreeMap<String, (String, Isometry3<f64>)>);

/// Most frames of a robot; more are not kept.
const MAX_FRAMES: usize = 10_000;
/// Most frames from a camera to the root of the tree: more are a circle.
const MAX_PARENTS: usize = 200;

/// A frame's name without the slash that the first tf put before it.
fn bare(name: &str) -> &str {
    name.strip_prefix('/').unwrap_or(name)
}

/// Whether a frame has a name of REP-105, with or without that of its robot before it.
fn is_called(frame: &str, name: &str) -> bool {
    frame.rsplit('/').next() == Some(name)
}

impl Tree {
    pub fn insert(&mut self, child: &str, parent: &str, parent_from_child: Isometry3<f64>) {
        if self.0.len() < MAX_FRAMES || self.0.contains_key(bare(child)) {
            self.0.insert(bare(child).to_owned(), (bare(parent).to_owned(), parent_from_child));
        }
    }

    /// A frame and its ancestors, each with the pose of the frame in it.
    fn ancestors(&self, frame: &str) -> Vec<(String, Isometry3<f64>)> {
        let mut line = vec![(bare(frame).to_owned(), Isometry3::identity())];
        while let Some((last, from_frame)) = line.last()
            && line.len() <= MAX_PARENTS
            && let Some((parent, parent_from_child)) = self.0.get(last)
        {
            let next = (parent.clone(), parent_from_child * from_frame);
            line.push(next);
        }
        line
    }

    /// Pose of a camera in `base_link`, and its height over `base_footprint`, which is the parent
    /// or a child of `base_link`.
    pub fn base_from_camera(&self, camera: &str) -> Option<(Isometry3<f64>, Option<f64>)> {
        let above = self.ancestors(camera);
        let (base, base_from_camera) = above.iter().find(|(name, _)| is_called(name, "base_link"))?;
        let is_footprint = |name: &str| is_called(name, "base_footprint");
        let below = above.iter().find(|(name, _)| is_footprint(name)).map(|(_, pose)| *pose);
        let beside = || {
            let (_, (_, base_from_footprint)) =
                self.0.iter().find(|(child, (parent, _))| is_footprint(child) && parent == base)?;
            Some(base_from_footprint.inverse() * base_from_camera)
        };
        let height_m = below.or_else(beside).map(|pose| pose.translation.z);
        Some((*base_from_camera, height_m.filter(|height_m| *height_m > 0.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector3, vector};

    fn at(x: f64, y: f64, z: f64) -> Isometry3<f64> {
        Isometry3::translation(x, y, z)
    }

    fn tree(transforms: &[(&str, &str, Isometry3<f64>)]) -> Tree {
        let mut tree = Tree::default();
        transforms.iter().for_each(|(child, parent, pose)| tree.insert(child, parent, *pose));
        tree
    }

    #[test]
    fn poses_are_chained_and_the_footprint_is_on_the_ground() {
        let turned = Isometry3::new(vector![0.0, 0.0, 0.1], Vector3::z() * std::f64::consts::FRAC_PI_2);
        let chain = [("mast", "/base_link", at(0.3, 0.0, 0.5)), ("/camera", "mast", turned)];
        let (pose, height_m) = tree(&chain).base_from_camera("camera").unwrap();
        assert_eq!((pose.translation.vector, height_m), (vector![0.3, 0.0, 0.6], None));
        for footprint in [
            ("base_link", "base_footprint", at(0.0, 0.0, 0.2)),
            ("base_footprint", "base_link", at(0.0, 0.0, -0.2)),
        ] {
            let whole = tree(&[chain[0], chain[1], footprint]);
            assert!((whole.base_from_camera("camera").unwrap().1.unwrap() - 0.8).abs() < 1e-12);
        }
        let named = tree(&[("r1/camera", "r1/base_link", at(0.1, 0.0, 0.0))]);
        assert!(named.base_from_camera("r1/camera").is_some());
    }

    #[test]
    fn circles_and_missing_frames_have_no_base_link() {
        let circle = tree(&[("camera", "mast", at(1.0, 0.0, 0.0)), ("mast", "camera", at(1.0, 0.0, 0.0))]);
        assert!(circle.base_from_camera("camera").is_none());
        assert!(circle.base_from_camera("").is_none());
    }

    #[test]
    fn a_camera_that_looks_down_is_a_rig() {
        let rig = Rig {
            roll_rad: 0.02,
            pitch_rad: -0.3,
            yaw_rad: 1.5,
            lever_arm: Some(LeverArm { x_m: 0.3, y_m: -0.1, z_m: 0.6 }),
            ..Rig::level(0.8)
        };
        let base_from_camera = rig.base_from_camera().unwrap();
        let mount = RecordedMount { camera_frame: "camera".into(), base_from_camera, height_m: None };
        let found = mount.rig(0.8).unwrap();
        assert_eq!(found.lever_arm, rig.lever_arm);
        for (a, b) in
            [(found.roll_rad, rig.roll_rad), (found.pitch_rad, rig.pitch_rad), (found.yaw_rad, rig.yaw_rad)]
        {
            assert!((a - b).abs() < 1e-12);
        }
        let ahead = RecordedMount { base_from_camera: at(0.3, 0.0, 0.6), ..mount };
        assert!(ahead.rig(0.8).is_err(), "x forward, z up is no optical frame");
    }
}

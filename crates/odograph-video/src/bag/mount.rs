//! How the camera and the antenna of a satellite receiver are mounted on the robot, from the static
//! transforms of a recording (`/tf_static`), with the frames of ROS REP-105.

use super::messages::{Role, frame_id, transforms};
use super::recording::{MessageReader, Topic};
use super::topics::{self, is_named};
use nalgebra::Isometry3;
use odograph::camera::{LeverArm, Rig};
use odograph::error::{Error, Result};
use odograph::geometry::GroundPose;
use std::collections::{BTreeMap, BTreeSet};
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

/// What the static transforms of a recording say of its camera.
#[derive(Debug, Clone, PartialEq)]
pub enum RecordedTransforms {
    /// Where it is on the robot.
    Mount(RecordedMount),
    /// They do not connect it with `base_link`.
    Apart {
        /// Name of the camera's frame; empty if its images name none.
        camera_frame: String,
        /// Names of the frames that are connected.
        frames: Vec<String>,
    },
}

/// What the static transforms of a robot recording say of the camera whose images a run follows:
/// those of `topic`, or of the only topic with images. `None` without such transforms.
///
/// # Errors
/// If the path is not a robot recording or cannot be read, or the topic is not one with images.
pub fn recorded_mount(path: impl AsRef<Path>, topic: Option<&str>) -> Result<Option<RecordedTransforms>> {
    let path = path.as_ref();
    topics::open_with_frames(path, topic)
        .and_then(|(mut recording, images)| mount_of(recording.as_mut(), &images))
        .map_err(|error| error.at(path.display()))
}

fn mount_of(recording: &mut dyn MessageReader, images: &Topic) -> Result<Option<RecordedTransforms>> {
    let (tree, camera_frame) = tree_and_frame(recording, images)?;
    if tree.0.is_empty() {
        return Ok(None);
    }
    Ok(Some(match tree.base_from_camera(&camera_frame) {
        Some((base_from_camera, height_m)) => {
            RecordedTransforms::Mount(RecordedMount { camera_frame, base_from_camera, height_m })
        }
        None => RecordedTransforms::Apart {
            camera_frame,
            frames: tree.names().into_iter().map(str::to_owned).collect(),
        },
    }))
}

/// The frame of the satellite receiver whose positions are on a topic of a robot recording, and
/// where its antenna is in `base_link` by the static transforms; `None` if they do not say so.
///
/// # Errors
/// If the path is not a robot recording or cannot be read.
pub fn recorded_antenna(path: impl AsRef<Path>, topic: &str) -> Result<Option<(String, LeverArm)>> {
    let path = path.as_ref();
    let find = || {
        let Some(mut recording) = super::open(path)? else { return Ok(None) };
        let fits = |other: &&Topic| Role::of(other) == Role::Gnss && is_named(other, topic);
        let Some(fixes) = recording.topics().iter().find(fits).cloned() else { return Ok(None) };
        let (tree, frame) = tree_and_frame(recording.as_mut(), &fixes)?;
        Ok(tree.base_from(&frame).map(|pose| {
            let t = pose.translation.vector;
            (frame, LeverArm { x_m: t.x, y_m: t.y, z_m: t.z })
        }))
    };
    find().map_err(|error: Error| error.at(path.display()))
}

/// Transforms that are published once come with the first messages: more of them are not looked at.
const MAX_MESSAGES: usize = 1000;

/// The static transforms of a recording, and the frame of the messages on a topic.
fn tree_and_frame(recording: &mut dyn MessageReader, of: &Topic) -> Result<(Tree, String)> {
    let (mut tree, mut frame) = (Tree::default(), None);
    if !recording.topics().iter().any(transforms::is_static) {
        return Ok((tree, String::new()));
    }
    recording.rewind()?;
    recording.select(&|topic| transforms::is_static(topic) || topic.is(of));
    for _ in 0..MAX_MESSAGES {
        if !recording.advance()? {
            break;
        }
        let message = recording.message();
        let topic = &recording.topics()[message.topic];
        if topic.is(of) {
            frame.get_or_insert_with(|| frame_id(topic, message.data));
        } else {
            transforms::each(topic, message.data, |transform| {
                tree.insert(&transform.child, &transform.parent, transform.pose);
            });
        }
    }
    Ok((tree, frame.unwrap_or_default()))
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

    /// Names of all frames.
    fn names(&self) -> BTreeSet<&str> {
        self.0.iter().flat_map(|(child, (parent, _))| [child.as_str(), parent.as_str()]).collect()
    }

    /// Pose of one frame in another: over the nearest frame that both descend from.
    fn pose_in(&self, of: &str, frame: &str) -> Option<Isometry3<f64>> {
        let above = self.ancestors(frame);
        self.ancestors(of).iter().find_map(|(name, from_of)| {
            let (_, from_frame) = above.iter().find(|(other, _)| other == name)?;
            Some(from_of.inverse() * from_frame)
        })
    }

    /// Pose of a frame in one with a name of REP-105, of the same robot if there are several.
    fn pose_in_named(&self, of: &str, frame: &str) -> Option<Isometry3<f64>> {
        let robot = |name: &str| bare(name).rsplit_once('/').map(|(robot, _)| robot.to_owned());
        let mut named: Vec<&str> = self.names().into_iter().filter(|name| is_called(name, of)).collect();
        named.sort_by_key(|name| robot(name) != robot(frame));
        named.into_iter().find_map(|name| self.pose_in(name, frame))
    }

    /// Pose of a frame in `base_link`.
    pub fn base_from(&self, frame: &str) -> Option<Isometry3<f64>> {
        self.pose_in_named("base_link", frame)
    }

    /// Pose of a camera in `base_link`, and its height over `base_footprint`.
    pub fn base_from_camera(&self, camera: &str) -> Option<(Isometry3<f64>, Option<f64>)> {
        let base_from_camera = self.base_from(camera)?;
        let height_m = self.pose_in_named("base_footprint", camera).map(|pose| pose.translation.z);
        Some((base_from_camera, height_m.filter(|height_m| *height_m > 0.0)))
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
        let named = tree(&[
            ("r1/camera", "r1/base_link", at(0.1, 0.0, 0.0)),
            ("r1/base_link", "hall", at(5.0, 0.0, 0.0)),
            ("a/base_link", "hall", at(7.0, 0.0, 0.0)),
        ]);
        assert_eq!(named.base_from("r1/camera"), Some(at(0.1, 0.0, 0.0)));
        // The camera beside the robot in the tree, or above it.
        let beside = tree(&[
            ("base_link", "base_footprint", at(0.0, 0.0, 0.2)),
            ("mast", "base_footprint", at(0.5, 0.0, 0.9)),
            ("camera", "mast", at(0.0, 0.1, 0.0)),
        ]);
        let (pose, height_m) = beside.base_from_camera("camera").unwrap();
        assert!((pose.translation.vector - vector![0.5, 0.1, 0.7]).norm() < 1e-12 && height_m == Some(0.9));
        let above = tree(&[("base_link", "camera", at(-0.5, 0.0, -0.9))]);
        assert_eq!(above.base_from("camera"), Some(at(0.5, 0.0, 0.9)));
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

//! The frame whose poses are written: the camera, or the robot that carries it.
//!
//! Everything is estimated for the camera. With T_wc its pose and T_cb the constant pose of
//! `base_link` in the camera ([`Rig::base_from_camera`]), the pose of the robot is T_wc T_cb; its
//! covariance is propagated through the adjoint of T_cb, here in the numbers of [`GroundPose`]
//! (`docs/math/frames.md`).

use crate::camera::Rig;
use crate::geometry::pose_index::{HEADING, HEIGHT, PITCH, ROLL, X, Y};
use crate::geometry::{GroundPose, PlaneTransform, Se2, propagated, wrap_angle};
use crate::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate, StampedPose, Velocity};
use nalgebra::{Isometry3, Matrix3, Matrix6};
use std::borrow::Cow;

/// The frame whose poses are written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PoseFrame {
    /// The camera's optical frame: x right, y down, z along the optical axis.
    Camera,
    /// The robot.
    BaseLink(BaseLink),
}

/// The robot's frame `base_link` (ROS REP-105): x forward, y left, z up.
///
/// Its poses are given as [`GroundPose`]s in which heading, roll and pitch are those of the robot,
/// and the height is that of `base_link` above the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BaseLink {
    base_from_camera: Isometry3<f64>,
    camera_from_base: Isometry3<f64>,
    yaw_rad: f64,
}

impl BaseLink {
    /// That of a camera whose rig has a lever arm.
    pub fn of(rig: &Rig) -> Option<Self> {
        let base_from_camera = rig.base_from_camera()?;
        Some(Self { base_from_camera, camera_from_base: base_from_camera.inverse(), yaw_rad: rig.yaw_rad })
    }

    /// Pose of the camera on the robot.
    pub fn base_from_camera(&self) -> &Isometry3<f64> {
        &self.base_from_camera
    }

    /// The robot's pose at a pose of its camera. Whole turns of the heading are kept.
    pub fn pose(&self, camera: &GroundPose) -> GroundPose {
        let base = GroundPose::from_world_from_body(&(camera.world_from_camera() * self.camera_from_base));
        let level_rad = camera.heading_rad - self.yaw_rad;
        GroundPose { heading_rad: level_rad + wrap_angle(base.heading_rad - level_rad), ..base }
    }

    /// The robot's pose and its covariance, from those of the camera, both of (x, y, heading,
    /// height, roll, pitch).
    pub fn pose_with_covariance(
        &self,
        camera: &GroundPose,
        covariance: &Matrix6<f64>,
    ) -> (GroundPose, Matrix6<f64>) {
        let base = self.pose(camera);
        (base, propagated(&jacobian(camera, &base), covariance))
    }

    /// The robot's velocity; roll and pitch are taken as constant.
    fn velocity(camera: &GroundPose, base: &GroundPose, velocity: &Velocity) -> Velocity {
        let (dx_m, dy_m) = (base.x_m - camera.x_m, base.y_m - camera.y_m);
        let rate = velocity.heading_rad_s;
        Velocity {
            x_m_s: velocity.x_m_s - rate * dy_m,
            y_m_s: velocity.y_m_s + rate * dx_m,
            heading_rad_s: rate,
        }
    }

    /// Pose, velocity and covariance of (x, y, heading) of the robot, from those of the camera at a
    /// tilt and height that are taken as exact.
    pub fn in_plane(
        &self,
        camera: &GroundPose,
        velocity: &Velocity,
        covariance: &Matrix3<f64>,
    ) -> (GroundPose, Velocity, Matrix3<f64>) {
        let base = self.pose(camera);
        let arm = Se2::lever_arm(base.x_m - camera.x_m, base.y_m - camera.y_m);
        (base, Self::velocity(camera, &base, velocity), propagated(&arm, covariance))
    }

    fn estimate(&self, known: &PoseEstimate) -> PoseEstimate {
        let PoseEstimate { pose, velocity, covariance, measured } = known;
        let PlaneMeasurement { x_m, y_m, heading_rad, covariance: own } = *measured;
        let (at, _, own) = self.in_plane(&GroundPose { x_m, y_m, heading_rad, ..*pose }, velocity, &own);
        let (base, covariance) = self.pose_with_covariance(pose, covariance);
        PoseEstimate {
            pose: base,
            velocity: Self::velocity(pose, &base, velocity),
            covariance,
            measured: PlaneMeasurement {
                x_m: at.x_m,
                y_m: at.y_m,
                heading_rad: at.heading_rad,
                covariance: own,
            },
        }
    }
}

/// How the numbers of the robot's pose change with those of its camera's.
///
/// A rotation by the vector φ (world axes) turns both and moves the robot by φ × d, d from the
/// camera to the robot; φ is E times the change of the angles, with E the axes of
/// [`GroundPose::rotation_axes`].
fn jacobian(camera: &GroundPose, base: &GroundPose) -> Matrix6<f64> {
    const POSITION: [usize; 3] = [X, Y, HEIGHT];
    const ANGLES: [usize; 3] = [HEADING, ROLL, PITCH];
    let turned = camera.rotation_axes();
    let arm = base.position() - camera.position();
    let moved = -(arm.cross_matrix() * turned);
    // Singular only where the robot stands on its nose.
    let angles = base.rotation_axes().try_inverse().map_or_else(Matrix3::identity, |axes| axes * turned);
    let mut jacobian = Matrix6::identity();
    for row in 0..3 {
        for column in 0..3 {
            jacobian[(POSITION[row], ANGLES[column])] = moved[(row, column)];
            jacobian[(ANGLES[row], ANGLES[column])] = angles[(row, column)];
        }
    }
    jacobian
}

impl PoseFrame {
    /// A frame of the camera's path as one of this frame's path.
    pub fn frame<'a>(&self, camera: &'a FrameEstimate) -> Cow<'a, FrameEstimate> {
        match self {
            Self::Camera => Cow::Borrowed(camera),
            Self::BaseLink(base) => Cow::Owned(FrameEstimate {
                estimate: camera.estimate.as_ref().map(|known| base.estimate(known)),
                ..camera.clone()
            }),
        }
    }

    /// The rigid transform of a pose of this frame: `world_from_camera` or `world_from_base_link`.
    pub fn world_from_frame(&self, pose: &GroundPose) -> Isometry3<f64> {
        match self {
            Self::Camera => pose.world_from_camera(),
            Self::BaseLink(_) => pose.world_from_body(),
        }
    }

    /// The stamped pose of this frame at a frame of the camera's path; `None` if that has no pose.
    pub fn stamped(&self, camera: &FrameEstimate) -> Option<StampedPose> {
        let pose = self.frame(camera).estimate.as_ref()?.pose;
        Some(StampedPose { time_s: camera.time_s, world_from_camera: self.world_from_frame(&pose) })
    }

    /// Its name as ROS REP-105 has it; that of the camera is not fixed there.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Camera => "camera",
            Self::BaseLink(_) => "base_link",
        }
    }
}

/// The frame of a whole path. Where the mount became known better on the way, each pose of the
/// robot has the rig by which its camera was tracked (`docs/math/frames.md`).
#[derive(Debug, Clone, PartialEq)]
pub struct PoseFrames {
    first: PoseFrame,
    /// The first frame of each later stretch, ascending.
    later: Vec<(u64, PoseFrame)>,
}

impl From<PoseFrame> for PoseFrames {
    fn from(first: PoseFrame) -> Self {
        Self { first, later: Vec::new() }
    }
}

impl PoseFrames {
    /// That of the carrier: `base_link`, where the rig has a lever arm, otherwise the camera.
    pub fn of_carrier(rig: &Rig) -> Self {
        BaseLink::of(rig).map_or(PoseFrame::Camera, PoseFrame::BaseLink).into()
    }

    /// The rig is another from a frame on, which is later than those of earlier calls.
    pub fn recalibrate(&mut self, frame: u64, rig: &Rig) {
        if let (PoseFrame::BaseLink(_), Some(base)) = (self.first, BaseLink::of(rig)) {
            self.later.push((frame, PoseFrame::BaseLink(base)));
        }
    }

    /// That of the pose at a frame.
    pub fn at(&self, frame: u64) -> &PoseFrame {
        let stretches = self.later.partition_point(|&(first, _)| first <= frame);
        stretches.checked_sub(1).map_or(&self.first, |last| &self.later[last].1)
    }

    /// That of the end of the path, with the rig that is known best.
    pub fn last(&self) -> &PoseFrame {
        self.at(u64::MAX)
    }

    /// A frame of the camera's path as one of this frame's path.
    pub fn frame<'a>(&self, camera: &'a FrameEstimate) -> Cow<'a, FrameEstimate> {
        self.at(camera.frame).frame(camera)
    }

    /// The stamped pose of this frame at a frame of the camera's path; `None` if that has no pose.
    pub fn stamped(&self, camera: &FrameEstimate) -> Option<StampedPose> {
        self.at(camera.frame).stamped(camera)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{CalibrationDeviations, Camera, LeverArm};
    use crate::odometry::{Odometry, OdometryConfig};
    use crate::simulation::{Effects, Path, PathKind, Simulation, SimulationConfig, Texture};
    use nalgebra::Vector3;
    use proptest::prelude::*;

    prop_compose! {
        fn poses()(x_m in -5.0..5.0, y_m in -5.0..5.0, heading_rad in -9.0..9.0, height_m in 0.1..3.0,
                   roll_rad in -0.6..0.6, pitch_rad in -0.6..0.6) -> GroundPose {
            GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
        }
    }

    prop_compose! {
        fn rigs()(x_m in -1.0..1.0, y_m in -1.0..1.0, z_m in -1.0..1.0, yaw_rad in -4.0..4.0,
                  roll_rad in -0.4..0.4, pitch_rad in -0.4..0.4) -> Rig {
            let lever_arm = Some(LeverArm { x_m, y_m, z_m });
            Rig { roll_rad, pitch_rad, yaw_rad, lever_arm, ..Rig::level(0.8) }
        }
    }

    proptest! {
        #[test]
        fn the_camera_is_at_its_lever_arm(pose in poses(), rig in rigs()) {
            let base = BaseLink::of(&rig).unwrap();
            let there = base.pose(&pose).world_from_body() * base.base_from_camera();
            prop_assert!((there.to_homogeneous() - pose.world_from_camera().to_homogeneous()).amax() < 1e-9);
            let arm = rig.lever_arm.unwrap();
            let t = base.base_from_camera().translation;
            prop_assert_eq!((t.x, t.y, t.z), (arm.x_m, arm.y_m, arm.z_m));
        }

        #[test]
        fn a_robot_is_level_while_its_camera_is_as_mounted(rig in rigs(), heading_rad in -9.0..9.0) {
            let camera = GroundPose { heading_rad, ..rig.first_pose() };
            let base = BaseLink::of(&rig).unwrap().pose(&camera);
            prop_assert!(base.roll_rad.abs() < 1e-9 && base.pitch_rad.abs() < 1e-9, "{:?}", base);
            prop_assert!((base.heading_rad - (heading_rad - rig.yaw_rad)).abs() < 1e-9);
            prop_assert!((base.height_m - (0.8 - rig.lever_arm.unwrap().z_m)).abs() < 1e-9);
        }

        #[test]
        fn the_jacobian_is_that_of_the_pose(pose in poses(), rig in rigs()) {
            let base = BaseLink::of(&rig).unwrap();
            let analytic = jacobian(&pose, &base.pose(&pose));
            // Where the robot's pitch is near a right angle its Euler angles are not defined.
            prop_assume!(base.pose(&pose).pitch_rad.abs() < 1.2);
            let step = 1e-6;
            for column in 0..6 {
                let moved = |by: f64| {
                    let mut numbers = pose.to_vector();
                    numbers[column] += by;
                    base.pose(&GroundPose::from_vector(&numbers)).to_vector()
                };
                let numeric = (moved(step) - moved(-step)) / (2.0 * step);
                for row in 0..6 {
                    let difference = numeric[row] - analytic[(row, column)];
                    prop_assert!(difference.abs() < 1e-6, "{row} {column}: {difference}");
                }
            }
        }
    }

    #[test]
    fn an_uncertain_heading_moves_the_robot_across_its_lever_arm() {
        let lever_arm = Some(LeverArm { x_m: 0.3, y_m: 0.0, z_m: 0.5 });
        let base = BaseLink::of(&Rig { lever_arm, ..Rig::level(0.5) }).unwrap();
        let mut covariance = Matrix6::zeros();
        covariance[(HEADING, HEADING)] = 1e-4;
        let (pose, covariance) = base.pose_with_covariance(&GroundPose::level(0.5), &covariance);
        assert!((pose.x_m + 0.3).abs() < 1e-12 && pose.height_m.abs() < 1e-12);
        assert!((covariance[(Y, Y)] - 0.09e-4).abs() < 1e-12 && covariance[(X, X)].abs() < 1e-12);
        assert!((covariance[(Y, HEADING)] + 0.3e-4).abs() < 1e-12);
        // A camera that circles about the robot: the robot turns on the spot.
        let velocity = Velocity { x_m_s: 0.0, y_m_s: 0.15, heading_rad_s: 0.5 };
        let turning = BaseLink::velocity(&GroundPose::level(0.5), &pose, &velocity);
        assert!(turning.speed_m_s() < 1e-12 && turning.heading_rad_s == 0.5);
    }

    /// Normalised error squared of (x, y, heading).
    fn nees(known: &PoseEstimate, truth: &GroundPose) -> f64 {
        let off = Vector3::new(
            known.pose.x_m - truth.x_m,
            known.pose.y_m - truth.y_m,
            known.pose.heading_rad - truth.heading_rad,
        );
        let covariance: Matrix3<f64> = known.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        off.dot(&(covariance.try_inverse().unwrap() * off))
    }

    #[test]
    fn a_turning_robot_is_where_its_covariance_says() {
        let lever_arm = Some(LeverArm { x_m: 0.3, y_m: -0.1, z_m: 0.6 });
        let rig = Rig { yaw_rad: 1.2, roll_rad: 0.03, pitch_rad: -0.05, lever_arm, ..Rig::level(0.75) };
        let base = BaseLink::of(&rig).unwrap();
        let camera = Camera::from_field_of_view((240, 180), (0.96, 0.72), rig.height_m).unwrap();
        let camera = camera.with_readout_s(Some(0.0)).unwrap();
        let (mut camera_nees, mut robot_nees, seeds) = (0.0, 0.0, 12);
        for seed in 0..seeds {
            let config = SimulationConfig {
                camera: camera.clone(),
                rig,
                texture: Texture::Asphalt,
                path: Path::new(PathKind::FigureEight { length_m: 1.2, laps: 1.0 }, 0.5, 1.0, true).unwrap(),
                effects: Effects { noise_gray: 8.0, ..Effects::default() },
                fps: 20.0,
                duration_s: Some(3.0),
                colored: false,
                seed,
            };
            let simulation = Simulation::new(config).unwrap();
            // The rig is known exactly: an error of its tilt moves robot and camera apart.
            let exact = CalibrationDeviations { scale: 0.0, roll_rad: Some(0.0), pitch_rad: Some(0.0) };
            let odometry = Odometry::new(camera.clone(), rig, OdometryConfig::default()).unwrap();
            let (mut odometry, mut last) = (odometry.with_deviations(&exact), None);
            for frame in simulation.frames() {
                let seen = odometry.process(frame.image, frame.time_s).unwrap();
                let placed = PoseFrame::BaseLink(base).frame(&seen).into_owned();
                let robot = placed.estimate.as_ref().expect("a pose");
                let truth = base.pose(&frame.truth);
                let off_m = (robot.pose.x_m - truth.x_m).hypot(robot.pose.y_m - truth.y_m);
                assert!(off_m < 5e-3, "{off_m}");
                last = Some((seen, placed, frame.truth));
            }
            let (seen, placed, truth) = last.unwrap();
            camera_nees += nees(&seen.estimate.unwrap(), &truth) / f64::from(seeds as u32);
            robot_nees += nees(&placed.estimate.unwrap(), &base.pose(&truth)) / f64::from(seeds as u32);
        }
        // The mean of twelve values of chi square with three degrees of freedom: 3, one standard
        // deviation 0.7. A rigid motion leaves it as it is.
        assert!((1.0..5.5).contains(&robot_nees), "{robot_nees}");
        assert!((robot_nees / camera_nees - 1.0).abs() < 0.05, "{robot_nees} {camera_nees}");
    }
}

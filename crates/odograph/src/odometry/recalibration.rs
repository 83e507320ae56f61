//! A camera that becomes known better while it is followed: mount tilt, lens, readout time
//! (docs/math/calibration-errors.md).

use super::Odometry;
use super::learned::Learned;
use super::recovery::Recovery;
use crate::camera::{CalibrationDeviations, Camera, Rig};
use crate::error::{Error, Result};
use crate::fixed_pattern::FixedPattern;
use crate::geometry::GroundPose;
use crate::geometry::pose_index::ROLL;
use crate::image::GrayImage;
use crate::motion::PoseRates;
use nalgebra::{Matrix2, Matrix6, Matrix6x2, Vector2, Vector6};

impl Odometry {
    /// The calibration has these deviations, which the covariance of every pose includes.
    pub fn with_deviations(mut self, deviations: &CalibrationDeviations) -> Self {
        self.deviations = *deviations;
        let CalibrationDeviations { roll_rad, pitch_rad, .. } = *deviations;
        self.learned.rig_prior.set_mount_tilt_deviations([roll_rad, pitch_rad]);
        self
    }

    /// Covariance of a pose from the deviation of the scale: all of the path since its start, and
    /// the height, is too long or too short in the same proportion.
    pub(super) fn scale_covariance(&self, pose: &GroundPose) -> Matrix6<f64> {
        let start = &self.first_pose;
        let by_scale = Vector6::new(pose.x_m - start.x_m, pose.y_m - start.y_m, 0.0, pose.height_m, 0.0, 0.0);
        by_scale * by_scale.transpose() * self.deviations.scale.powi(2)
    }

    /// Continues with a better calibration of the same camera. Earlier poses stay; the corners of
    /// the present keyframe are projected onto the ground again.
    ///
    /// The pose is continuous if this is called right after a frame that became a keyframe
    /// ([`crate::trajectory::FrameEstimate::keyframe`]). With `rig`, height and tilt of the camera
    /// are the rig's from here on, and the matrix is the covariance of (roll, pitch), radians²;
    /// without, they stay as measured.
    ///
    /// # Errors
    ///
    /// Where the camera has another image size, or the rig is not possible.
    pub fn recalibrate(&mut self, camera: Camera, rig: Option<(&Rig, Matrix2<f64>)>) -> Result<()> {
        let (known, given) = (self.resolution.full_camera(), &camera);
        if (known.width(), known.height()) != (given.width(), given.height()) {
            return Err(Error::input(format!(
                "the calibration is for {}x{} pixels but the images have {}x{}",
                given.width(),
                given.height(),
                known.width(),
                known.height()
            )));
        }
        let camera = self.resolution.recalibrate(camera);
        let mount = rig.map(|(rig, _)| rig.validated().map(|rig| rig.first_pose())).transpose()?;
        if let Some(mount) = mount {
            self.first_pose = mount;
        }
        let before = (self.learned.rig_prior.mount(), self.learned.assumed_readout_s());
        let mut fresh = Learned::with_rolling_shutter(&self.first_pose, &camera, self.config.motion.model);
        if let Some((_, covariance)) = rig {
            fresh.rig_prior.set_mount_tilt_covariance(&covariance);
        }
        self.learned.recalibrate(fresh, mount.is_some());
        self.charge_errors(before, mount.is_some());
        let readout_s = self.learned.shutter().map(|shutter| shutter.readout().mean_s);
        if let Some(keyframe) = &mut self.keyframe {
            keyframe.recalibrate(&camera, mount.as_ref(), readout_s);
        }
        if let (Some(mount), Some(last)) = (&mount, &mut self.last) {
            last.pose = last.pose.with_mount_of(mount);
        }
        self.memory.recalibrate(mount.as_ref());
        self.recovery = Recovery::new(&camera);
        self.camera = camera;
        Ok(())
    }

    /// Tracks the frames since the first keyframe again, with a camera that has become known: the
    /// pose changes to what it would be had the camera been known from the beginning. Returns
    /// whether it did; not where that would lose a frame or make another keyframe, or where more
    /// than the camera was learned since.
    ///
    /// # Errors
    ///
    /// As [`Odometry::process`].
    pub fn track_again<'a>(
        &mut self,
        camera: &Camera,
        frames: impl IntoIterator<Item = &'a (GrayImage, f64)>,
    ) -> Result<bool> {
        if self.segment > 0 || self.resolution.is_reduced() || self.correction().is_some() {
            return Ok(false);
        }
        let again = Self::starting_at(self.first_pose, camera.clone(), self.resolution.config());
        let mut again = again.with_deviations(&self.deviations);
        if let Some(mask) = self.mask() {
            again = again.with_fixed(&mask);
        }
        for (image, time_s) in frames {
            let is_first = again.frames == 0;
            let frame = again.process(image.clone(), *time_s)?;
            if frame.estimate.is_none() || frame.keyframe != is_first {
                return Ok(false);
            }
        }
        // Later keyframes than the first stay in the map, and have had their numbers.
        (again.frames, again.keyframes) = (self.frames, self.keyframes);
        again.first_time_s = self.first_time_s;
        again.fixed = std::mem::replace(&mut self.fixed, FixedPattern::new((0, 0)));
        again.events = self.events.take();
        *self = again;
        Ok(true)
    }

    /// Adds the effect of the previous calibration on x, y and heading of the present keyframe to
    /// its covariance; the path itself stays.
    fn charge_errors(&mut self, (mount, readout_s): ([f64; 3], f64), with_mount: bool) {
        let [_, roll_rad, pitch_rad] = self.learned.rig_prior.mount();
        let off_rad = Vector2::new(roll_rad - mount[1], pitch_rad - mount[2]);
        let tilt_errors = self.learned.rig_prior.mount_tilt_errors() + off_rad * off_rad.transpose();
        let off_s = self.learned.assumed_readout_s() - readout_s;
        let readout_errors_s2 = self.learned.readout_errors_s2() + off_s * off_s;
        let Some(keyframe) = &mut self.keyframe else { return };
        let by_readout = keyframe.by_readout.fixed_rows::<3>(0);
        let mut errors = by_readout * by_readout.transpose() * readout_errors_s2;
        keyframe.by_readout = PoseRates::zeros();
        if with_mount {
            let by_tilt = keyframe.by_mount_tilt.fixed_rows::<3>(0);
            errors += by_tilt * tilt_errors * by_tilt.transpose();
            keyframe.by_mount_tilt = Matrix6x2::zeros();
            keyframe.by_mount_tilt.fixed_rows_mut::<2>(ROLL).fill_with_identity();
            self.by_mount_tilt = keyframe.by_mount_tilt;
        }
        let mut placed = keyframe.covariance.fixed_view_mut::<3, 3>(0, 0);
        placed += errors;
    }
}

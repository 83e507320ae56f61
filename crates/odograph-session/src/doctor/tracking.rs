//! How the tracker follows the stretches: displacements, losses, copies, tilt, readout time.

use super::appearance::Sharpness;
use crate::plan::RunPlan;
use crate::stillness::{self, at_rest_px};
use odograph::camera::{Camera, PosedCamera, Rig};
use odograph::continuous_time::ReadoutEstimation;
use odograph::error::Result;
use odograph::fixed_pattern::NonuniformityCorrection;
use odograph::geometry::{GroundPose, Pixel, length};
use odograph::motion::{MotionModel, Readout};
use odograph::mounting::{CalibrationMonitor, CalibrationUpdate};
use odograph::numerics::median;
use odograph::odometry::{EarlierPass, Odometry, TrackView};
use odograph::trajectory::{FrameEstimate, LossReason, TrackStatus};
use odograph_video::Frame;

/// The displacement of the ground between two frames, in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Of the point in the middle of the image, pixels.
    pub middle_px: (f64, f64),
    /// The largest of the points looked at, pixels.
    pub most_px: f64,
    /// The time between the frames, seconds.
    pub time_s: f64,
    /// The sharpness of the second frame, where it was looked at.
    sharpness: Option<Sharpness>,
}

impl Step {
    fn px(&self) -> f64 {
        length(self.middle_px.0, self.middle_px.1)
    }
}

/// What tracking has shown in all stretches.
#[derive(Debug)]
pub struct Tracking {
    camera: Camera,
    pub steps: Vec<Step>,
    /// Frames that were tracked or lost.
    pub frames: usize,
    pub lost: Vec<LossReason>,
    pub copies: usize,
    /// Of each frame with a pose, the displacement since the first one of its stretch, pixels;
    /// infinite where it is not known.
    shifts_px: Vec<f64>,
    residuals_px: Vec<f64>,
    /// Frames that were lost to corners that stand still in the image.
    stood_still: usize,
    /// Fraction of the tracks that are inliers, of each tracked frame.
    agreeing: Vec<f64>,
    /// The calibration that differs from the given one, of the most pairs of views.
    pub found: Option<CalibrationUpdate>,
    /// The best known readout time and its standard deviation, seconds.
    pub readout_s: Option<(f64, f64)>,
    /// Root mean square of a pattern that the camera adds to its images, gray levels.
    pub pattern_gray: Option<f64>,
}

impl Tracking {
    pub fn new(plan: &RunPlan) -> Self {
        Self {
            camera: plan.camera.clone(),
            steps: Vec::new(),
            frames: 0,
            lost: Vec::new(),
            copies: 0,
            shifts_px: Vec::new(),
            residuals_px: Vec::new(),
            stood_still: 0,
            agreeing: Vec::new(),
            found: None,
            readout_s: None,
            pattern_gray: None,
        }
    }

    /// A quantile of the displacement of the middle between frames, pixels; `None` without any.
    pub fn step_px(&self, quantile: f64) -> Option<f64> {
        let mut steps_px: Vec<f64> = self.steps.iter().map(Step::px).collect();
        steps_px.sort_by(f64::total_cmp);
        let index = (quantile * steps_px.len() as f64) as usize;
        steps_px.get(index.min(steps_px.len().checked_sub(1)?)).copied()
    }

    /// The largest displacement within a stretch, pixels, where nothing moves in any of them, as a
    /// run judges it; `None` where something moves, or too few frames have a pose.
    pub fn at_rest_px(&self) -> Option<f64> {
        let posed = self.shifts_px.len();
        let seen = (posed + self.stood_still) as f64;
        let most_px = self.shifts_px.iter().copied().fold(0.0, f64::max);
        let is_known = posed >= 2 && seen >= stillness::MIN_SHARE * self.frames as f64;
        (is_known && most_px <= at_rest_px(&mut self.residuals_px.clone())).then_some(most_px)
    }

    /// The largest fraction of the image by which the ground moved between two frames.
    pub fn largest_share(&self, (width, height): (usize, usize)) -> Option<f64> {
        let share = |step: &Step| {
            let (x, y) = step.middle_px;
            (x.abs() / width as f64).max(y.abs() / height as f64)
        };
        self.steps.iter().map(share).max_by(f64::total_cmp)
    }

    /// Median fraction of the tracks that agree on the motion.
    pub fn agreeing(&self) -> Option<f64> {
        median(&mut self.agreeing.clone())
    }

    /// Sharpness along the motion over that across it in the faster half of the moving frames, and
    /// the median step of those frames, pixels. `None` if too few frames move.
    pub fn sharpness_along_motion(&self) -> Option<(f64, f64)> {
        let looked: Vec<(&Step, Sharpness)> =
            self.steps.iter().filter_map(|step| Some((step, step.sharpness?))).collect();
        let usual_px = median(&mut looked.iter().map(|(step, _)| step.px()).collect::<Vec<_>>())?;
        let fast_px = usual_px.max(MOVING_PX);
        let fast: Vec<_> = looked.iter().filter(|(step, _)| step.px() >= fast_px).collect();
        if fast.len() < LEAST_FAST {
            return None;
        }
        let mut ratios: Vec<f64> =
            fast.iter().filter_map(|(step, sharpness)| sharpness.along(step.middle_px)).collect();
        let step_px = median(&mut fast.iter().map(|(step, _)| step.px()).collect::<Vec<_>>())?;
        Some((median(&mut ratios)?, step_px))
    }
}

/// Frames that move less than this are not looked at for blur, pixels.
const MOVING_PX: f64 = 2.0;

/// Number of frames that determine the sharpness along the motion.
const LEAST_FAST: usize = 3;

/// A stretch of consecutive frames, tracked.
pub struct Stretch {
    odometry: Odometry,
    monitor: Option<CalibrationMonitor>,
    found: Option<CalibrationUpdate>,
    /// While the readout time is unknown.
    shutter: Option<ReadoutEstimation>,
    readout: Option<Readout>,
    last: Option<(GroundPose, f64)>,
    /// Its first pose.
    first: Option<(usize, GroundPose)>,
}

impl Stretch {
    /// Begins a stretch.
    pub fn new(plan: &RunPlan) -> Result<Self> {
        let free = plan.odometry.motion.model == MotionModel::Auto;
        let rig: &Rig = &plan.rig;
        Ok(Self {
            odometry: plan.odometry()?,
            monitor: free.then(|| CalibrationMonitor::new(&plan.camera, rig)),
            found: None,
            shutter: ReadoutEstimation::new(&plan.camera),
            readout: None,
            last: None,
            first: None,
        })
    }

    /// Follows the next frame.
    pub fn follow(
        &mut self,
        frame: Frame,
        sharpness: Option<Sharpness>,
        into: &mut Tracking,
    ) -> Result<FrameEstimate> {
        let time_s = frame.time_s;
        let estimate = self.odometry.process(frame.gray, time_s)?;
        into.frames += 1;
        if let TrackStatus::Lost { reason } = estimate.status {
            into.lost.push(reason);
        }
        if estimate.estimate.is_some() && estimate.tracks == 0 {
            into.copies += 1;
        }
        if estimate.tracks > 0 {
            into.agreeing.push(estimate.inliers as f64 / estimate.tracks as f64);
        }
        let now = estimate.ground_pose();
        if let (Some(now), Some((before, before_s))) = (now, self.last)
            && let Some((middle_px, most_px)) = displacement(&into.camera, before, now)
        {
            into.steps.push(Step { middle_px, most_px, time_s: time_s - before_s, sharpness });
        }
        self.last = now.map(|pose| (pose, time_s));
        into.stood_still += usize::from(stillness::stands_still(&estimate));
        if let Some(now) = now {
            let (segment, first) = *self.first.get_or_insert((estimate.segment, now));
            // What was lost in between may have moved.
            let shift = displacement(&into.camera, first, now).filter(|_| segment == estimate.segment);
            into.shifts_px.push(shift.map_or(f64::INFINITY, |(_, most_px)| most_px));
            into.residuals_px.push(estimate.residual_px);
        }
        if self.readout.is_none()
            && let Some(shutter) = &mut self.shutter
        {
            self.readout = shutter.watch(&estimate, &self.odometry);
        }
        if self.found.is_none()
            && let Some(monitor) = &mut self.monitor
        {
            self.found = monitor.watch(&estimate, &self.odometry);
        }
        Ok(estimate)
    }

    /// The corners in the frame that was followed last.
    pub fn tracks(&self) -> &[TrackView] {
        self.odometry.tracks()
    }

    /// The pattern that the camera adds to its images, once it is known.
    pub fn pattern(&self) -> Option<EarlierPass> {
        self.odometry.found_pattern()
    }

    /// Ends the stretch: its calibration is kept.
    pub fn end(self, into: &mut Tracking) {
        let found = self.found.or_else(|| self.monitor.and_then(|monitor| monitor.at_end()));
        if let Some(found) = found
            && into.found.as_ref().is_none_or(|known| known.pairs < found.pairs)
        {
            into.found = Some(found);
        }
        into.pattern_gray =
            self.odometry.correction().map(NonuniformityCorrection::rms_gray).or(into.pattern_gray);
        let estimated = self.readout.or_else(|| self.shutter.and_then(|shutter| shutter.at_end()));
        let assumed = self.odometry.readout().filter(|_| self.odometry.readout_matters());
        if let Some(readout) = estimated.or(assumed) {
            let deviation_s = readout.variance_s2.sqrt();
            if into.readout_s.is_none_or(|(_, known_s)| deviation_s < known_s) {
                into.readout_s = Some((readout.mean_s, deviation_s));
            }
        }
    }
}

/// How far the ground moves in the image from one pose to another: the point in the middle, and the
/// largest displacement of the middle and four points halfway to the corners; pixels.
fn displacement(camera: &Camera, from: GroundPose, to: GroundPose) -> Option<((f64, f64), f64)> {
    let (before, now) = (PosedCamera::new(camera, from), PosedCamera::new(camera, to));
    let (width, height) = (camera.width() as f64, camera.height() as f64);
    let moved = |x: f64, y: f64| {
        let pixel = Pixel::new(x * width, y * height);
        let seen = now.see(before.ground(camera.ray_from_pixel(pixel)?)?.point)?.pixel;
        Some((seen.x - pixel.x, seen.y - pixel.y))
    };
    let middle = moved(0.5, 0.5)?;
    let beside = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)];
    let others = beside.iter().filter_map(|(x, y)| moved(*x, *y));
    let most = others.map(|(x, y)| length(x, y)).fold(length(middle.0, middle.1), f64::max);
    Some((middle, most))
}

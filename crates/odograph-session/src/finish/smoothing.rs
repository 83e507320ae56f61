//! The smoothed path and the carrier's path.

use crate::folder::OutputFolder;
use crate::kept_frames::KeptFrames;
use crate::plan::RunPlan;
use odograph::camera::Rig;
use odograph::drawing::ReckonedStretch;
use odograph::error::Result;
use odograph::filter::fusion::Reckoned;
use odograph::filter::{Carrier, PoseSource, SmoothedFrame, SmoothedPath, Smoother};
use odograph::formats::trajectory_file::{SMOOTHED_HEADER, smoothed_line};
use odograph::geometry::GroundPoint;
use odograph::pose_frame::PoseFrames;

/// Computes the smoothed path and the carrier's path from a few numbers per frame, and writes
/// them frame by frame. Returns the stretches that other sensors have given.
pub fn write_smoothed(
    frames: &mut KeptFrames,
    reckoned: &Reckoned,
    plan: &RunPlan,
    recalibrated: &[(u64, Rig)],
    pose_frames: &PoseFrames,
    folder: &mut OutputFolder,
) -> Result<Vec<ReckonedStretch>> {
    let mut smoother = Smoother::for_frames(frames.count());
    frames.each(|frame, _| {
        smoother.push(frame);
        Ok(())
    })?;
    let path = smoother.smoothed(&plan.odometry.filter);
    let mut smoothed = FrameSmoother { frames, path: &path, reckoned };
    let mut reckoned = ReckonedStretches::default();
    folder.write_lines("trajectory-smoothed.csv", SMOOTHED_HEADER, |put| {
        smoothed.each(|frame| {
            let written = frame.seen_as(pose_frames.at(frame.frame));
            reckoned.push(&written);
            put(&smoothed_line(&written))
        })
    })?;
    let mut carrier = Carrier::for_frames(&plan.rig, smoothed.frames.count());
    recalibrated.iter().for_each(|(frame, rig)| carrier.recalibrate(*frame, rig));
    folder.write_tum("trajectory-smoothed.tum", pose_frames.last(), |put| {
        let mut before_s = f64::NEG_INFINITY;
        smoothed.each(|frame| {
            carrier.push(frame);
            // Of frames with equal times the first is used.
            let later = frame.time_s > before_s;
            before_s = before_s.max(frame.time_s);
            if !later {
                return Ok(());
            }
            let pose_frame = pose_frames.at(frame.frame);
            put(&frame.seen_as(pose_frame).stamped(pose_frame))
        })
    })?;
    drop(path);
    let carrier_frame = *carrier.of().last();
    let mut carrier = carrier.path();
    folder.write_tum("carrier.tum", &carrier_frame, |put| carrier.try_for_each(|pose| put(&pose)))?;
    Ok(reckoned.stretches)
}

/// The stretches of the path that are by other sensors.
#[derive(Default)]
struct ReckonedStretches {
    stretches: Vec<ReckonedStretch>,
    /// Whether the last frame belongs to one.
    open: bool,
}

impl ReckonedStretches {
    /// Takes the next frame of the path.
    fn push(&mut self, frame: &SmoothedFrame) {
        let by_sensors = frame.source == PoseSource::Sensors;
        if by_sensors && !self.open {
            let (from_s, to_s) = (frame.time_s, frame.time_s);
            self.stretches.push(ReckonedStretch { from_s, to_s, points: Vec::new() });
        }
        if by_sensors && let Some(stretch) = self.stretches.last_mut() {
            stretch.to_s = frame.time_s;
            stretch.points.push(GroundPoint::new(frame.pose.x_m, frame.pose.y_m));
        }
        self.open = by_sensors;
    }
}

/// A smoothed path, its gaps filled from the sensors, along the frames.
struct FrameSmoother<'a> {
    frames: &'a mut KeptFrames,
    path: &'a SmoothedPath,
    reckoned: &'a Reckoned,
}

impl FrameSmoother<'_> {
    /// Visits every frame of the path. Fails if frames cannot be read back, or if `take` fails.
    fn each(&mut self, mut take: impl FnMut(&SmoothedFrame) -> Result<()>) -> Result<()> {
        let (mut walk, mut merge) = (self.path.walk(), self.reckoned.merge());
        let mut taken = Ok(());
        let mut take = |frame: SmoothedFrame, taken: &mut Result<()>| {
            if taken.is_ok() {
                *taken = take(&frame);
            }
        };
        self.frames.each(|frame, _| {
            walk.next(frame, &mut |smoothed| {
                merge.next(smoothed, &mut |smoothed| take(smoothed, &mut taken));
            });
            std::mem::replace(&mut taken, Ok(()))
        })?;
        merge.end(&mut |smoothed| take(smoothed, &mut taken));
        taken
    }
}

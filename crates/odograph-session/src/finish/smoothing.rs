//! The smoothed path and the carrier's path.

use crate::folder::OutputFolder;
use crate::kept_frames::KeptFrames;
use crate::plan::RunPlan;
use odograph::camera::Rig;
use odograph::error::Result;
use odograph::filter::fusion::Reckoned;
use odograph::filter::{Carrier, SmoothedFrame, SmoothedPath, Smoother};
use odograph::formats::trajectory_file::{SMOOTHED_HEADER, smoothed_line};
use odograph::pose_frame::PoseFrames;

/// Computes the smoothed path and the carrier's path from a few numbers per frame, and writes
/// them frame by frame.
pub fn write_smoothed(
    frames: &mut KeptFrames,
    reckoned: &Reckoned,
    plan: &RunPlan,
    recalibrated: &[(u64, Rig)],
    pose_frames: &PoseFrames,
    folder: &mut OutputFolder,
) -> Result<()> {
    let mut smoother = Smoother::for_frames(frames.count());
    frames.each(|frame, _| {
        smoother.push(frame);
        Ok(())
    })?;
    let path = smoother.smoothed(&plan.odometry.filter);
    let mut smoothed = FrameSmoother { frames, path: &path, reckoned };
    folder.write_lines("trajectory-smoothed.csv", SMOOTHED_HEADER, |put| {
        smoothed.each(|frame| put(&smoothed_line(&frame.seen_as(pose_frames.at(frame.frame)))))
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
    folder.write_tum("carrier.tum", &carrier_frame, |put| carrier.try_for_each(|pose| put(&pose)))
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

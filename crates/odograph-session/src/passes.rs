//! Self-calibration in passes over a recording: what ends a pass, and the examination before the
//! only pass of a run that continues a map.

use crate::observer::Observer;
use crate::plan::RunPlan;
use odograph::error::Result;
use odograph::motion::MotionModel;
use odograph::self_calibration::{CameraDifference, CameraMonitor, MultiPassCalibration};
use odograph::trajectory::FrameEstimate;

/// Number of pairs of views at the beginning of a recording that are examined before a map is
/// continued: more show a smaller difference, but these frames are tracked twice.
const EXAMINED_PAIRS: usize = 32;
/// Why an observer sees the beginning twice.
const EXAMINING: &str = "examining the beginning";

/// The camera of the plan. What cannot be read again is tracked once; nothing is calibrated where
/// the plan fixes the motion model.
pub fn calibration_of(plan: &RunPlan) -> MultiPassCalibration {
    let readable_again = plan.source.is_readable_again();
    let mut calibration = MultiPassCalibration::new(plan.camera.clone(), plan.rig);
    calibration.images.clone_from(&plan.images);
    let model = plan.odometry.motion.model;
    calibration.calibrates = readable_again && model == MotionModel::Auto;
    calibration.measures_shutter = readable_again && matches!(model, MotionModel::Auto | MotionModel::Free);
    calibration.corrects_images = readable_again;
    calibration
}

/// Replaces the camera of the plan by the assumed one.
pub fn assume(plan: &mut RunPlan, calibration: &MultiPassCalibration) {
    plan.camera = calibration.camera.clone();
    plan.rig = calibration.rig;
    plan.images.clone_from(&calibration.images);
}

/// A continued map keeps what a run adds, so the beginning of the recording is examined before the
/// run, which then is a single pass. The lens is the map's.
pub fn examine_beginning(
    plan: &mut RunPlan,
    calibration: &mut MultiPassCalibration,
    observer: &dyn Observer,
) -> Result<()> {
    calibration.lens_is_known = true;
    while calibration.calibrates || calibration.measures_shutter {
        match difference_at_beginning(plan, calibration.monitor(), observer)? {
            Some(difference) => calibration.apply(difference),
            None => (calibration.calibrates, calibration.measures_shutter) = (false, false),
        }
        assume(plan, calibration);
    }
    calibration.corrects_images = false;
    Ok(())
}

fn difference_at_beginning(
    plan: &RunPlan,
    mut monitor: CameraMonitor,
    observer: &dyn Observer,
) -> Result<Option<CameraDifference>> {
    let mut source = plan.source.open()?;
    let mut odometry = plan.odometry()?;
    let pose_frame = plan.pose_frame()?;
    observer.tracking_again(EXAMINING);
    // The examination ends with the views that it needs, which no number of frames says.
    observer.tracking_begins(None);
    while let Some(frame) = source.next_frame()? {
        let estimate = odometry.process(frame.gray, frame.time_s)?;
        let estimate = FrameEstimate { frame: frame.number, ..estimate };
        observer.frame(&pose_frame.frame(&estimate));
        let difference = monitor.watch(&estimate, &odometry);
        if difference.is_some() || monitor.pairs() >= EXAMINED_PAIRS || observer.is_stop_asked() {
            return Ok(difference);
        }
    }
    Ok(monitor.at_end(&odometry))
}

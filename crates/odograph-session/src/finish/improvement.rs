//! The path after sensor fusion, loop closure and the satellite receiver.

use crate::earth::{self, Antenna, GnssRecord};
use crate::kept_frames::KeptFrames;
use crate::marker_statistics::MarkerStatistics;
use crate::observer::Observer;
use crate::pipeline::Tracked;
use crate::plan::RunPlan;
use crate::statistics::LoopStatistics;
use crate::wheel_scale;
use odograph::camera::Rig;
use odograph::error::Result;
use odograph::filter::fusion::{self, Reckoned, SensorReport, Sensors};
use odograph::pose_frame::PoseFrames;
use odograph::slam::DriftCorrection;
use odograph::trajectory::FrameSummary;
use std::path::Path;

/// The frames after sensor fusion and loop closure.
pub struct Improved {
    /// The final frames; `None` if they equal the odometry's.
    pub corrected: Option<KeptFrames>,
    /// Frames without a measured pose, as dead-reckoned from the sensors.
    pub reckoned: Reckoned,
    pub sensors: Vec<SensorReport>,
    pub loops: LoopStatistics,
    pub markers: Option<MarkerStatistics>,
    /// The antenna of a satellite receiver.
    pub antenna: Antenna,
    /// What it changed of the map.
    pub bent: Option<DriftCorrection>,
}

impl Improved {
    /// Fuses other sensors first; loop closures then correct the fused path.
    pub fn new(
        tracked: &mut Tracked,
        plan: &RunPlan,
        sensors: &Sensors,
        gnss: Option<&GnssRecord>,
        folder: &Path,
    ) -> Result<Self> {
        let (mut fused, mut reckoned, mut reports) = (None, Reckoned::default(), Vec::new());
        if *sensors != Sensors::default() {
            // Sensor fusion needs the whole recording in memory; no other step does.
            let (raw, mut references) = tracked.frames.all()?;
            let fusion = fusion::fuse(&raw, sensors);
            if fusion.moved {
                tracked.mapping.apply_fusion(&raw, &fusion.frames, &mut references);
                let mut kept = KeptFrames::new(folder);
                fusion.frames.into_iter().zip(references).for_each(|(f, reference)| kept.push(f, reference));
                fused = Some(kept);
            }
            (reckoned, reports) = (fusion.reckoned, fusion.reports);
        }
        let frames = fused.as_mut().unwrap_or(&mut tracked.frames);
        tracked.mapping.finish();
        let moves = !reckoned.is_empty();
        let mut corrected = tracked.mapping.correct_frames(frames, moves, folder)?;
        let (mut bent, mut antenna) = (None, Antenna::stated(plan));
        if let Some(gnss) = gnss {
            let carrier = carrier_frames(plan, &tracked.recalibrated);
            let placed = corrected.frames.as_mut().unwrap_or(&mut *frames);
            antenna = gnss.locate(antenna, &earth::antenna_path(placed, &carrier, &antenna)?);
            let path = earth::antenna_path(placed, &carrier, &antenna)?;
            let measured = earth::measured_path(frames, &carrier, &antenna)?;
            bent = gnss
                .antenna_fixes(&path, &measured)
                .and_then(|(fixes, found)| tracked.mapping.correct_drift(&fixes, &found));
            if bent.is_some() {
                corrected = tracked.mapping.correct_frames(frames, moves, folder)?;
            }
        }
        let reckoned = reckoned.moved_with(&corrected.moves);
        let loops = tracked.mapping.statistics(&corrected);
        tracked.warnings.extend(tracked.mapping.warning());
        tracked.warnings.extend(tracked.mapping.scale_warning());
        tracked.warnings.extend(plan.sensors.warnings(&reports));
        tracked.warnings.extend(wheel_scale::warning(&reports));
        let markers = tracked.mapping.marker_statistics().map(|(statistics, warnings)| {
            tracked.warnings.extend(warnings);
            statistics
        });
        Ok(Self {
            corrected: corrected.frames.or(fused),
            reckoned,
            sensors: reports,
            loops,
            markers,
            antenna,
            bent,
        })
    }

    /// Gives the final frames as poses of `pose_frames` to the observer.
    pub fn observe(
        &mut self,
        tracked: &mut Tracked,
        pose_frames: &PoseFrames,
        observer: &dyn Observer,
    ) -> Result<()> {
        let frames = self.corrected.as_mut().unwrap_or(&mut tracked.frames);
        frames.each(|frame, _| {
            observer.final_frame(&pose_frames.frame(frame), pose_frames.at(frame.frame));
            Ok(())
        })
    }

    /// Their summaries as the path of `pose_frames`, for drawings.
    pub fn summaries(
        &mut self,
        tracked: &mut Tracked,
        pose_frames: &PoseFrames,
    ) -> Result<Vec<FrameSummary>> {
        let frames = self.corrected.as_mut().unwrap_or(&mut tracked.frames);
        let mut summaries = Vec::with_capacity(frames.count());
        frames.each(|frame, _| {
            summaries.push(FrameSummary::from(&*pose_frames.frame(frame)));
            Ok(())
        })?;
        Ok(summaries)
    }
}

/// The poses of the carrier along the path, whose rig may have been recalibrated at some frames.
pub fn carrier_frames(plan: &RunPlan, recalibrated: &[(u64, Rig)]) -> PoseFrames {
    let mut carrier = PoseFrames::of_carrier(&plan.rig);
    recalibrated.iter().for_each(|(frame, rig)| carrier.recalibrate(*frame, rig));
    carrier
}

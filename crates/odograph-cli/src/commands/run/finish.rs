//! The end of a run: what was tracked is improved by what came after it, written, and drawn. The trajectories come first: they are what cannot be had
//! again without the recording. Whatever else fails is told in the end, when all the rest is there.

use super::found::FoundLens;
use super::mapping::LoopStatistics;
use super::pipeline::Tracked;
use super::{OutputArguments, OutputFolder, RunPlan, RunReport, Statistics};
use super::{map, reference, tilt};
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorReport, Sensors};
use odograph::filter::{SmoothedFrame, carrier_path, fusion};
use odograph::formats::{camera_file, trajectory_file};
use odograph::mapping::Mosaic;
use std::time::Instant;

/// Improves what was tracked and writes everything into the folder.
pub fn finish(
    plan: &RunPlan,
    description: &str,
    mut tracked: Tracked,
    sensors: &Sensors,
    folder: &mut OutputFolder,
    arguments: &OutputArguments,
    started: Instant,
) -> Result<RunReport> {
    enough(plan, &mut tracked, arguments)?;
    let mut run = Finishing { failure: ended_early(&mut tracked), plan, tracked, folder };
    run.tell_camera();
    let at_once = trajectory_file::tum_from_frames(&run.tracked.frames);
    let Improved { path, sensors, loops } = run.improve(sensors);
    run.write_paths(at_once, path)?;
    run.draw(description, &sensors, arguments.threads())?;
    run.end(&sensors, loops, started)
}

/// The camera file with the lens as it was found, where not as told.
const FOUND_CAMERA: &str = "camera-found.yaml";

/// A run that is being finished.
struct Finishing<'a> {
    plan: &'a RunPlan,
    tracked: Tracked,
    folder: &'a mut OutputFolder,
    /// What ended the recording early, or the first thing that could not be made.
    failure: Option<Error>,
}

/// What other sensors, loops and the smoother made of the frames.
struct Improved {
    path: Vec<SmoothedFrame>,
    sensors: Vec<SensorReport>,
    loops: LoopStatistics,
}

/// Fails where there is no movement to be told.
fn enough(plan: &RunPlan, tracked: &mut Tracked, arguments: &OutputArguments) -> Result<()> {
    if tracked.frames.len() >= arguments.least_frames || tracked.interrupted {
        return Ok(());
    }
    let too_few = if tracked.frames.is_empty() { "no frame" } else { "only one frame" };
    Err(tracked.failure.take().unwrap_or_else(|| {
        Error::input(format!(
            "{} has {too_few} in the chosen range; a movement needs at least two",
            plan.source.path
        ))
    }))
}

/// What ended the recording or its map early, with a warning of each.
fn ended_early(tracked: &mut Tracked) -> Option<Error> {
    let recording = tracked.failure.take();
    tracked.warnings.extend(recording.as_ref().map(|error| format!("the recording ended early: {error}")));
    let map = tracked.unmapped.take();
    tracked.warnings.extend(map.as_ref().map(|error| format!("the map ended early: {error}")));
    recording.or(map)
}

impl Finishing<'_> {
    fn warn(&mut self, warning: impl IntoIterator<Item = String>) {
        self.tracked.warnings.extend(warning);
    }

    /// Something beside the trajectories could not be made: the run goes on, and fails in the end.
    fn fail(&mut self, what: &str, error: Error) {
        self.warn([format!("{what}: {error}")]);
        self.failure.get_or_insert(error);
    }

    /// How the camera sits and its lens bends, where not as was told.
    fn tell_camera(&mut self) {
        let told = match &self.tracked.mount {
            Some(found) => Some(found.sentence()),
            None => tilt::untold(&self.tracked.frames, &self.plan.rig, self.plan.odometry.motion.model),
        };
        self.warn(told);
        let bends = self.tracked.lens.as_ref().map(FoundLens::sentence);
        self.warn(bends);
    }

    /// What other sensors tell comes first; loops then pull at the path that they have set right; the smoother last.
    fn improve(&mut self, sensors: &Sensors) -> Improved {
        let tracked = &mut self.tracked;
        let fused = fusion::fuse(&tracked.frames, sensors);
        // An hour has hundreds of thousands of frames: they are not kept twice longer than needed.
        let (raw, references) =
            (std::mem::take(&mut tracked.frames), std::mem::take(&mut tracked.references));
        let straight = tracked.mapping.straighten(raw, &fused, references);
        let loops = tracked.mapping.statistics(&fused.frames, &straight);
        tracked.warnings.extend(tracked.mapping.warning());
        let fused = fused.laid(straight);
        let path = fused.smooth(&self.plan.odometry.filter);
        tracked.warnings.extend(self.plan.sensors.warnings(&fused.reports));
        tracked.frames = fused.frames;
        Improved { path, sensors: fused.reports, loops }
    }

    /// The trajectories, the map's keyframes, and the paths that are made of the frames; of an hour they are a hundred megabytes, which the pictures
    /// then have.
    fn write_paths(&mut self, at_once: String, path: Vec<SmoothedFrame>) -> Result<()> {
        self.folder.write_trajectories(&self.tracked.frames, &self.plan.text()?)?;
        match self.tracked.lens {
            Some(_) => self.folder.write(FOUND_CAMERA, camera_file::write(&self.plan.camera).as_bytes())?,
            None => self.folder.remove(FOUND_CAMERA)?,
        }
        self.folder.write("odometry.tum", at_once.as_bytes())?;
        drop(at_once);
        // Only now the map, which may not fit on its disk any more: the trajectories are there all the same, and so is all that follows.
        if let Err(error) = self.tracked.mapping.save(&self.tracked.frames) {
            self.fail("the map is not where the trajectories are", error);
        }
        self.folder.write("trajectory-smoothed.csv", trajectory_file::csv_from_smoothed(&path).as_bytes())?;
        let smoothed = SmoothedFrame::trajectory(&path);
        self.folder.write("trajectory-smoothed.tum", trajectory_file::write_tum(&smoothed).as_bytes())?;
        let carrier = carrier_path(&path, &self.plan.rig);
        self.folder.write("carrier.tum", trajectory_file::write_tum(&carrier).as_bytes())
    }

    /// The mosaic, the map and the page.
    fn draw(&mut self, description: &str, sensors: &[SensorReport], threads: usize) -> Result<()> {
        let tracked = &mut self.tracked;
        let laid = tracked.views.lay(&self.plan.camera, &tracked.frames, &mut tracked.mapping, threads);
        let mosaic = laid.unwrap_or_else(|error| {
            self.fail("there is no picture of the ground", error);
            Mosaic::new(Default::default())
        });
        let compared = match (&self.plan.reference, reference::read(self.plan)?) {
            (Some(path), Some(read)) => reference::compared(path, &read, &self.tracked.frames)
                .map_err(|error| self.warn([format!("the path cannot be compared: {error}")]))
                .ok(),
            _ => None,
        };
        let loops = self.tracked.mapping.loops();
        let tracked = &mut self.tracked;
        let shown = map::Shown {
            description,
            frames: &tracked.frames,
            loops: &loops,
            mosaic: &mosaic,
            sensors,
            reference: compared.as_ref(),
        };
        let drawn = map::write(self.plan, &shown, &mut tracked.mapping, self.folder, threads)?;
        tracked.warnings.extend(match &drawn.ground {
            Ok(warning) => warning.clone(),
            Err(error) => Some(format!("the map has no new picture of the ground: {error}")),
        });
        map::write_page(self.plan, &shown, &drawn, &tracked.warnings, self.folder)?;
        if let Err(error) = drawn.ground {
            self.failure.get_or_insert(error);
        }
        Ok(())
    }

    /// Closes the map and writes the statistics, last of all.
    fn end(mut self, sensors: &[SensorReport], loops: LoopStatistics, started: Instant) -> Result<RunReport> {
        let closed = self.tracked.mapping.close();
        let statistics = Statistics::new(&self.tracked, self.plan.budget, sensors, loops, started.elapsed());
        self.folder.finish(&statistics)?;
        match self.failure.or(closed.err()) {
            Some(error) => Err(error),
            None => Ok(RunReport {
                statistics,
                recognised: self.tracked.mapping.warning().is_none(),
                warnings: self.tracked.warnings,
                folder: self.folder.path().to_owned(),
            }),
        }
    }
}

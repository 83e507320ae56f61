//! A run over a recording: opened, followed, finished.

use crate::builder::RunBuilder;
use crate::earth::GnssRecord;
use crate::finish::{Ending, finish};
use crate::folder::OutputFolder;
use crate::found::{FoundLens, FoundMount};
use crate::observer::Observer;
use crate::outcome::RunOutcome;
use crate::output::{RunOutput, explained};
use crate::overlay_video::OverlayVideo;
use crate::passes::{assume, calibration_of, examine_beginning};
use crate::pipeline::{self, Tracked};
use crate::plan::RunPlan;
use crate::recalibrated_odometry::RecalibratedOdometry;
use crate::reference::ReferencePath;
use crate::report::RunReporter;
use odograph::error::{Error, Result};
use odograph::self_calibration::MultiPassCalibration;
use odograph_map::{MapFile, UnfinishedSession};
use odograph_video::{Source, SourceInfo, TemporaryFolder};
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

impl RunBuilder {
    /// Makes everything ready: reads what the options name, opens the source, makes the folder and
    /// claims the map that is to be written.
    ///
    /// # Errors
    /// If an option contradicts another, if something cannot be read, if results are there already
    /// that may not be overwritten, or if another program writes there.
    pub fn open(&self, observer: &dyn Observer) -> Result<Run> {
        self.output.check_bag()?;
        let results = self.output.folder.as_deref();
        if let Some(video) = &self.output.video {
            OverlayVideo::check(video, results, self.output.force)?;
        }
        self.check_separate(
            [&self.output.bag, &self.output.video].into_iter().flatten().map(PathBuf::as_path),
        )?;
        let (path, temporary) = self.output.place()?;
        let same =
            |a: &Path, b: &Path| fs::canonicalize(a).is_ok_and(|a| fs::canonicalize(b).is_ok_and(|b| a == b));
        if same(Path::new(&self.source.path), &path) {
            let shown = path.display();
            return Err(Error::usage(match path.is_dir() {
                true => format!("{shown} is the folder of the recording; its results need another one (-o)"),
                false => format!("{shown} is the recording itself; its results need a folder (-o)"),
            }));
        }
        // Results go beside their recording: a source that is not there would become their folder.
        if Path::new(&self.source.path) == path && !path.exists() {
            self.source.open()?;
        }
        // What a killed run has left is not touched before its source can be read.
        let resumed = match &self.resumed {
            Some(plan) => Some((plan.as_ref().clone(), plan.source.open()?)),
            None => None,
        };
        let folder =
            OutputFolder::new(&path, &self.output).map_err(|error| explained(error, temporary.as_ref()))?;
        let (plan, source) = if let Some(resumed) = resumed {
            resumed
        } else if self.repeats {
            let plan = RunPlan::read(Path::new(&self.source.path))?;
            let source = plan.source.open()?;
            (plan, source)
        } else {
            self.plan_over(observer, |plan| {
                let source = plan.open()?;
                let size = (source.info().width, source.info().height);
                self.question_pixels(size, observer);
                Ok((source, size))
            })?
        };
        let half = self.output.resumed.as_ref().and_then(|resumed| resumed.half.as_ref());
        if let (Some(half), Some(map)) = (half, self.output.map.path())
            && let Some(claim) = folder.claim_on(map)
        {
            half.remove(claim)?;
        }
        self.tell_unfinished(observer)?;
        Ok(Run {
            plan,
            source,
            folder,
            output: self.output.clone(),
            reporter: self.reporter.clone(),
            temporary,
        })
    }

    /// Notes the sessions of killed runs in a map that this run adds to.
    fn tell_unfinished(&self, observer: &dyn Observer) -> Result<()> {
        let map = &self.output.map;
        let Some(path) = map.path().filter(|path| !map.is_read_only() && MapFile::is_there(path)) else {
            return Ok(());
        };
        for session in MapFile::open_read_only(path)?.unfinished_sessions()? {
            let UnfinishedSession { id, source, keyframes } = session;
            let shown = path.display();
            observer.note(&format!(
                "session {id} of {shown} ({source}) did not end; its keyframes, {keyframes}, are used like the others \
                 (odograph map repair {shown} --drop-unfinished writes the map without them)"
            ));
        }
        Ok(())
    }

    /// Opens the run and follows its source to the end: [`RunBuilder::open`], then [`Run::follow`].
    ///
    /// # Errors
    /// What both fail with.
    pub fn run(&self, observer: &dyn Observer) -> Result<RunOutcome> {
        self.open(observer)?.follow(observer)
    }
}

/// A prepared run. Dropped before it begins it leaves no files.
pub struct Run {
    plan: RunPlan,
    source: Source,
    folder: OutputFolder,
    output: RunOutput,
    reporter: Option<Arc<dyn RunReporter>>,
    /// The last field, so that the folder is removed after all else is closed.
    temporary: Option<TemporaryFolder>,
}

impl fmt::Debug for Run {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Run").field("plan", &self.plan).field("folder", &self.folder).finish_non_exhaustive()
    }
}

impl Run {
    /// Everything that determines the result.
    pub fn plan(&self) -> &RunPlan {
        &self.plan
    }

    /// Description of the source.
    pub fn source(&self) -> &SourceInfo {
        self.source.info()
    }

    /// The output folder.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Follows the source to its end and writes everything into the folder.
    ///
    /// # Errors
    /// If the source has no frame, or results cannot be written. What ends the recording early,
    /// such as a damaged file, is an error only after all that was computed has been written.
    pub fn follow(mut self, observer: &dyn Observer) -> Result<RunOutcome> {
        // Removed after all else is closed.
        let temporary = self.temporary.take();
        self.followed(observer).map_err(|error| explained(error, temporary.as_ref()))
    }

    fn followed(self, observer: &dyn Observer) -> Result<RunOutcome> {
        let Self { mut plan, source, mut folder, output, reporter, .. } = self;
        let started = Instant::now();
        let mut warnings = Vec::new();
        let sensors = plan.sensors.read(&plan.source.path, &mut warnings)?;
        let gnss = GnssRecord::read(&plan.sensors, &plan.source.path, &mut warnings)?;
        // Unreadable inputs are reported before tracking.
        let reference = ReferencePath::read(&plan, &mut warnings)?;
        let description = source.info().description.clone();
        let mut tracked = track(&mut plan, source, &mut folder, &output, reporter.as_deref(), observer)?;
        // Of damage every topic that is read tells.
        for warning in warnings {
            if !tracked.warnings.contains(&warning) {
                tracked.warnings.push(warning);
            }
        }
        let ending = Ending {
            description: &description,
            sensors: &sensors,
            gnss: gnss.as_ref(),
            reference: reference.as_ref(),
            output: &output,
            reporter: reporter.as_deref(),
            observer,
            started,
        };
        finish(&plan, tracked, &mut folder, &ending)
    }
}

/// Tracks the whole source. Starts again with a corrected plan if mount, lens, readout time or
/// fixed pattern are found to differ from it.
fn track(
    plan: &mut RunPlan,
    source: Source,
    folder: &mut OutputFolder,
    output: &RunOutput,
    reporter: Option<&dyn RunReporter>,
    observer: &dyn Observer,
) -> Result<Tracked> {
    folder.begin(plan, output)?;
    plan.take_lens_of(output.map.path())?;
    let (given_camera, given_rig) = (plan.camera.clone(), plan.rig);
    let mut calibration = calibration_of(plan);
    let lens_is_known = output.map.path().is_some_and(MapFile::is_there);
    if lens_is_known {
        examine_beginning(plan, &mut calibration, observer)?;
    }
    let once = !plan.source.is_readable_again();
    let mut source = Some(source);
    let tracked = calibration.track(|camera| {
        assume(plan, camera);
        let odometry = match once {
            true => RecalibratedOdometry::online(plan, lens_is_known)?,
            false => RecalibratedOdometry::fixed(plan)?,
        };
        let source = match source.take() {
            Some(source) => source,
            None => {
                observer.tracking_again(&why_again(camera));
                folder.begin_again()?;
                plan.source.open()?
            }
        };
        pipeline::track(plan, source, folder, output, reporter, odometry, camera.monitor(), observer)
    })?;
    if once {
        return Ok(tracked);
    }
    let found = calibration.found();
    let (mount, lens) = (FoundMount::of(&given_rig, found), FoundLens::of(&given_camera, found));
    Ok(Tracked { mount, lens, ..tracked })
}

/// Why a recording is tracked again.
fn why_again(camera: &MultiPassCalibration) -> String {
    match camera.found_readout() {
        _ if camera.images.motion.is_some() => {
            "again, with the motion within the images as measured".to_owned()
        }
        Some(readout) if readout.mean_s == 0.0 => "again, with a global shutter".to_owned(),
        None if camera.images.halvings > 0 => {
            "again, at a coarser resolution: single pixels are noise".to_owned()
        }
        None if camera.images.fixed.is_some() => "again, without what moves along with the camera".to_owned(),
        _ => "again, with the camera as found".to_owned(),
    }
}

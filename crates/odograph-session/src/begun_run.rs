//! What is run, written down while it runs, so that a killed run can be run again.
//!
//! From its first frame to its last file a run keeps `run.toml.part` in its folder: its plan as it
//! began, and which map it continues. A run is deterministic: from its first frame on it gives
//! again what the killed run would have given.

use crate::files;
use crate::output::{MapUse, RunOutput};
use crate::plan::RunPlan;
use crate::plan_paths::check_name;
use odograph::error::{Error, Result};
use odograph_map::{MapFile, SessionOrigin};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A run as it began.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct BegunRun {
    /// The map that it continues, an absolute path; `None` for a new one in the folder.
    pub map: Option<PathBuf>,
    /// Whether the map is to have the run only where it is recognised in it.
    #[serde(default)]
    pub only_recognised: bool,
    /// The session that it adds to that map; `None` where the map is new.
    pub session: Option<u32>,
    /// The source as it was typed, which is the name of that session.
    pub source: String,
    /// Name of the robot.
    pub robot: Option<String>,
    /// Key of its session, so that a site has the run once.
    pub key: Option<String>,
    /// The bag of ROS 2 that it writes, an absolute path.
    pub bag: Option<PathBuf>,
    /// The overlay video that it writes, an absolute path.
    pub video: Option<PathBuf>,
    pub plan: RunPlan,
}

/// Where a run in a folder writes down how it began.
pub(crate) fn begun_file(folder: &Path) -> PathBuf {
    files::beside(&folder.join("run.toml"))
}

/// Writes down that a run begins. Nothing is written of a run that cannot be run again: over
/// standard input, a pipe or a stream.
pub(crate) fn begin(
    folder: &Path,
    plan: &RunPlan,
    output: &RunOutput,
    origin: Option<&SessionOrigin>,
) -> Result<()> {
    if output.folder.is_none() || output.map.is_read_only() || !plan.source.is_readable_again() {
        return Ok(());
    }
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let map = output.map.path();
    let session = match map.filter(|map| MapFile::is_there(map)) {
        Some(map) => {
            let sessions = MapFile::open_read_only(map)?.sessions()?;
            Some(sessions.last().map_or(0, |last| last.id + 1))
        }
        None => None,
    };
    let begun = BegunRun {
        map: map.map(absolute),
        only_recognised: matches!(output.map, MapUse::Extend(_)),
        session,
        source: output.source_name(&plan.source.path),
        robot: output.robot.clone(),
        key: origin.map(|origin| origin.key.clone()),
        bag: output.bag.as_deref().map(absolute),
        video: output.video.as_deref().map(absolute),
        plan: plan.seen_from(folder),
    };
    begun.check_names()?;
    let text = toml::to_string(&begun).map_err(|error| {
        Error::output(format!("the parameters cannot be written down: {error}")).caused_by(error)
    })?;
    let path = begun_file(folder);
    std::fs::write(&path, text).map_err(|error| files::cannot_be_written(&path, error))
}

/// Removes what [`begin`] has written.
pub(crate) fn end(folder: &Path) {
    let _ = std::fs::remove_file(begun_file(folder));
}

/// Whether a run has begun in a folder that has put a session into a map elsewhere.
pub(crate) fn has_half_session(folder: &Path) -> bool {
    BegunRun::read(folder).is_ok_and(|begun| begun.map.is_some())
}

impl BegunRun {
    /// Fails if TOML cannot hold the name of a file.
    fn check_names(&self) -> Result<()> {
        let mut own = [&self.map, &self.bag, &self.video].into_iter().flatten();
        own.try_for_each(|path| check_name(path)).and_then(|()| self.plan.check_names())
    }

    /// Reads what a run in this folder has written down.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = begun_file(folder);
        let begun: Self = toml::from_str(&files::read_text(&path)?).map_err(|error| {
            let why = error.message().replace('\n', ", ");
            Error::input(format!("{} is not what a run has left: {why}", path.display())).caused_by(error)
        })?;
        let plan = begun.plan.validated(&path)?.brought_from(folder);
        Ok(Self { plan, ..begun })
    }
}

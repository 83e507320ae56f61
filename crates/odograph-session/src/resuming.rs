//! Runs that begin again where they were killed.

use crate::begun_run::{BegunRun, begun_file};
use crate::builder::RunBuilder;
use crate::half_session::HalfSession;
use crate::output::{MapUse, ResumedSession};
use crate::unfinished::UnfinishedRun;
use odograph::error::{Error, Result};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::sync::Arc;

impl RunBuilder {
    /// The run that has begun in a folder and did not end, from its first frame and into the same
    /// folder, whose content it replaces.
    ///
    /// # Errors
    /// If the run in the folder is complete or goes on, or if the folder does not say what was run.
    pub fn resuming(folder: impl AsRef<Path>) -> Result<Self> {
        let folder = folder.as_ref();
        let shown = folder.display();
        let refused = |why: &str| Error::usage(format!("{shown} {why}"));
        if !folder.is_dir() {
            return Err(refused("is not the folder of a run"));
        }
        let Some(unfinished) = UnfinishedRun::in_folder(folder) else {
            return Err(match folder.join("stats.json").exists() {
                true => {
                    let plan = folder.join("run.toml");
                    let repeat = format!("odograph run {} repeats it into another folder", plan.display());
                    let state = match was_interrupted(folder) {
                        true => "has a run that was interrupted, which cannot be continued",
                        false => "has a run that is complete",
                    };
                    refused(&format!("{state}; {repeat}"))
                }
                false => refused("has no run that was begun; give the folder of a run that was killed"),
            });
        };
        if unfinished.goes_on {
            return Err(refused("has a run that goes on; wait until that has ended"));
        }
        if !begun_file(folder).is_file() {
            return Err(refused(
                "does not say how its run began (a live run, and one over standard input, cannot be run again); \
                 odograph view shows what it has",
            ));
        }
        let BegunRun { map, only_recognised, session, source, robot, key, bag, video, plan } =
            BegunRun::read(folder)?;
        let mut run = Self::over(plan.source.clone()).folder(folder).overwriting(true);
        let mut half = None;
        if let Some(map) = map {
            let left = HalfSession { session, source: source.clone() };
            left.is_in(&map)?;
            half = Some(left);
            run.output.map = match only_recognised {
                true => MapUse::Extend(map),
                false => MapUse::Continue(map),
            };
        }
        run.output.resumed = Some(ResumedSession { source, key, half });
        run.output.robot = robot;
        run.output.bag = bag;
        run.output.video = video;
        run.resumed = Some(Arc::new(plan));
        Ok(run)
    }
}

/// Whether the run that ended in a folder was ended early. A live run has no other end.
fn was_interrupted(folder: &Path) -> bool {
    let text = fs::read(folder.join("stats.json")).unwrap_or_default();
    let statistics: Value = serde_json::from_slice(&text).unwrap_or_default();
    statistics["interrupted"] == true && statistics["live"].is_null()
}

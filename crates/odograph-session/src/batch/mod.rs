//! Many recordings, processed by any number of workers on any number of machines that share a
//! folder: each recording by one worker at a time, and not again once it is done.
//!
//! The results folder has a folder `.batch` with the [manifest], a file for each attempt
//! at a recording, and a [lease](worker) of each worker. A recording is run in a folder of its own,
//! `NAME.part-N`, whose files are moved to their place at the end: a worker that was believed dead
//! and wakes up disturbs nobody.

mod hash;
mod inputs;
mod manifest;
mod recordings;
mod results;
mod shard;
mod worker;

pub use inputs::{Inputs, parameters};
pub use manifest::{Attempt, Ended, RunStatus};
pub use recordings::{Recording, Search};
pub use results::{RecordingResult, csv};
pub use shard::Shard;

use crate::builder::RunBuilder;
use crate::folder;
use crate::outcome::RunOutcome;
use manifest::Manifest;
use odograph::error::{Error, Result};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use worker::{Watch, Worker};

/// What to do with recordings that were run before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BatchOptions {
    /// Whether what is done is skipped and what is not is finished; otherwise results that are
    /// there are refused.
    pub resumes: bool,
    /// Whether all results may be overwritten.
    pub overwrites: bool,
    /// How often a recording is begun again that failed or whose worker was killed.
    pub retries: u32,
}

/// What remains to be done for a recording.
#[derive(Debug)]
pub enum Turn {
    /// It is to be run, into [`Batch::part_folder`]; then [`Batch::end`].
    Run(Box<Attempt>),
    /// Nothing: it was run before, or by another worker.
    Ended(Box<Ended>),
    /// Another worker runs it.
    Busy,
}

/// What follows the end of an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    /// Nothing.
    Finished,
    /// It failed and is to be begun again.
    Retry,
    /// Another worker has taken it over, and this attempt does not count.
    TakenOver,
}

/// How far all workers are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BatchProgress {
    /// Recordings that are done.
    pub done: usize,
    /// Recordings that failed.
    pub failed: usize,
    /// Recordings that are being run.
    pub running: usize,
    /// All recordings.
    pub of: usize,
}

/// A call over many recordings, which shares its results folder with other workers.
#[derive(Debug)]
pub struct Batch {
    results: PathBuf,
    options: BatchOptions,
    /// Hash of the options of its runs.
    parameters: String,
    manifest: Manifest,
    worker: Worker,
    watch: Mutex<Watch>,
    /// The last attempts of earlier calls.
    earlier: BTreeMap<String, Arc<Attempt>>,
}

impl Batch {
    /// Joins the workers of a results folder, which is made. `run` has the options of all its runs.
    ///
    /// # Errors
    /// If a file that the options name cannot be read, or nothing can be written in the folder.
    pub fn join(results: &Path, run: &RunBuilder, options: BatchOptions) -> Result<Self> {
        let parameters = parameters(run)?;
        let manifest = Manifest::in_folder(results.join(BATCH).join("attempts"))?;
        let leases = results.join(BATCH).join("workers");
        let worker = Worker::in_folder(&leases)?;
        let earlier = manifest.last()?;
        let watch = Mutex::new(Watch::over(leases));
        Ok(Self { results: results.to_owned(), options, parameters, manifest, worker, watch, earlier })
    }

    /// What remains to be done for a recording.
    ///
    /// # Errors
    /// If results are in its place that may not be overwritten, or an attempt cannot be recorded.
    pub fn turn(&self, recording: &Recording) -> Result<Turn> {
        let Recording { source, name } = recording;
        let attempts = self.manifest.of(name);
        let last = attempts.last().map(Arc::as_ref);
        if last.is_some_and(|last| self.goes_on(last)) {
            return Ok(Turn::Busy);
        }
        let earlier = last.filter(|last| last.source == *source).map(|last| &last.inputs);
        let inputs = Inputs::of(source, &self.parameters, earlier);
        let known_end = last.and_then(|last| self.known_end(last, &attempts, &inputs));
        let is_given_up = last.is_some_and(|last| last.ended.is_none());
        if let (Some(ended), false) = (&known_end, is_given_up) {
            return Ok(Turn::Ended(Box::new(ended.clone())));
        }
        self.check_place(recording, last, &inputs)?;
        let attempt = Attempt {
            name: name.clone(),
            source: source.clone(),
            number: last.map_or(0, |last| last.number) + 1,
            worker: self.worker.name().to_owned(),
            inputs,
            ended: known_end,
        };
        if !self.manifest.begin(&attempt)? {
            return Ok(Turn::Busy);
        }
        // What was given up is on record.
        if let Some(ended) = attempt.ended {
            return Ok(Turn::Ended(Box::new(ended)));
        }
        for killed in attempts {
            let _ = fs::remove_dir_all(self.part_folder(&killed));
        }
        Ok(Turn::Run(Box::new(attempt)))
    }

    /// Where an attempt is run.
    pub fn part_folder(&self, attempt: &Attempt) -> PathBuf {
        self.results.join(format!("{}.part-{}", attempt.name, attempt.number))
    }

    /// Ends an attempt: moves its results to their place and records how it ended.
    ///
    /// # Errors
    /// If that cannot be written.
    pub fn end(&self, mut attempt: Attempt, run: &RunBuilder, result: &Result<RunOutcome>) -> Result<Next> {
        let part = self.part_folder(&attempt);
        if self.manifest.is_taken_over(&attempt) {
            let _ = fs::remove_dir_all(part);
            return Ok(Next::TakenOver);
        }
        let moved = folder::move_results(&part, &self.results.join(&attempt.name), run.camera_path());
        let ended = moved.as_ref().map_or_else(Ended::failed, |()| Ended::of(result));
        let is_retried = ended.how == RunStatus::Failed
            && self.failures(&self.manifest.of(&attempt.name), &attempt.inputs) <= self.options.retries;
        attempt.ended = Some(ended);
        self.manifest.end(&attempt)?;
        moved?;
        Ok(if is_retried { Next::Retry } else { Next::Finished })
    }

    /// How far all workers are with these recordings and all others in the folder.
    ///
    /// # Errors
    /// If the manifest cannot be read.
    pub fn progress(&self, recordings: &[Recording]) -> Result<BatchProgress> {
        let last = self.manifest.last()?;
        let unknown = recordings.iter().filter(|recording| !last.contains_key(&recording.name)).count();
        let mut progress = BatchProgress { of: last.len() + unknown, ..BatchProgress::default() };
        let own = Inputs::of("", &self.parameters, None);
        for attempt in last.values().filter(|attempt| attempt.inputs.are_options_same(&own)) {
            match &attempt.ended {
                None => progress.running += 1,
                Some(ended) if ended.how.is_complete() => progress.done += 1,
                Some(ended) if ended.how.is_failure() => progress.failed += 1,
                Some(_) => {}
            }
        }
        Ok(progress)
    }

    /// Whether an earlier call had no success with a recording: such ones are tried last.
    pub fn failed_earlier(&self, recording: &Recording) -> bool {
        let ended = self.earlier.get(&recording.name).map(|attempt| attempt.ended.as_ref());
        ended.is_some_and(|ended| ended.is_none_or(|ended| ended.how.is_failure()))
    }

    /// Writes what `files` makes of the results of these recordings and of all others in the
    /// folder: names with bytes. Where workers end at once, the last files have the results of all.
    ///
    /// # Errors
    /// If the manifest cannot be read, or a file not be written.
    pub fn write_results(
        &self,
        recordings: &[Recording],
        files: impl Fn(&[RecordingResult]) -> Vec<(&'static str, Vec<u8>)>,
    ) -> Result<()> {
        let mut written = None;
        loop {
            let last = self.manifest.last()?;
            let is_seen = written.as_ref() == Some(&last);
            // Whoever ends later writes later.
            if is_seen || written.is_some() && last.values().any(|attempt| self.goes_on(attempt)) {
                return Ok(());
            }
            for (name, bytes) in files(&results::of(recordings, &last)) {
                manifest::replace(&self.results.join(name), &bytes)?;
            }
            written = Some(last);
        }
    }

    /// Leaves the folder as if nothing had been run in it.
    pub fn discard(self) {
        drop(self.worker);
        let _ = fs::remove_dir_all(self.results.join(BATCH));
    }

    fn goes_on(&self, attempt: &Attempt) -> bool {
        let mut watch = self.watch.lock().unwrap_or_else(PoisonError::into_inner);
        attempt.ended.is_none() && !watch.has_ended(&attempt.worker)
    }

    /// How a recording ended, if it is not to be run: it is done, or has failed often enough.
    fn known_end(&self, last: &Attempt, attempts: &[Arc<Attempt>], inputs: &Inputs) -> Option<Ended> {
        let in_this_call = self.is_in_this_call(last);
        if !last.inputs.are_same(inputs) || !(in_this_call || self.options.resumes) {
            return None;
        }
        let failures = self.failures(attempts, inputs);
        match &last.ended {
            Some(ended) if ended.how.is_complete() => {
                self.results.join(&last.name).join("stats.json").exists().then(|| ended.clone())
            }
            Some(ended) if ended.how == RunStatus::Refused => in_this_call.then(|| ended.clone()),
            Some(ended) if ended.how == RunStatus::Failed => {
                (failures > self.options.retries).then(|| ended.clone())
            }
            Some(_) => None,
            None => (failures > self.options.retries).then(|| {
                let times = if failures == 1 { "once".to_owned() } else { format!("{failures} times") };
                let sentence = format!("its worker was killed {times}, perhaps for lack of memory");
                Ended::failed(&Error::input(sentence).at(&last.source))
            }),
        }
    }

    fn is_in_this_call(&self, attempt: &Attempt) -> bool {
        attempt.number > self.earlier.get(&attempt.name).map_or(0, |earlier| earlier.number)
    }

    /// How many attempts with these inputs have failed, or were killed, since this call began.
    fn failures(&self, attempts: &[Arc<Attempt>], inputs: &Inputs) -> u32 {
        let here = attempts.iter().filter(|attempt| self.is_in_this_call(attempt));
        let failed = here.filter(|attempt| {
            let ended = attempt.ended.as_ref();
            attempt.inputs.are_same(inputs) && ended.is_none_or(|ended| ended.how.is_failure())
        });
        u32::try_from(failed.count()).unwrap_or(u32::MAX)
    }

    /// Refuses to replace results that are not known to be those of this recording.
    fn check_place(&self, recording: &Recording, last: Option<&Attempt>, inputs: &Inputs) -> Result<()> {
        let place = self.results.join(&recording.name);
        let Some(last) = last.filter(|last| self.options.resumes || self.is_in_this_call(last)) else {
            let free = folder::check_free(&place, self.options.overwrites);
            return free.map_err(|error| match self.options.resumes {
                true => error,
                false => Error::usage(format!(
                    "{} has results; --resume keeps those that are done, --force overwrites them",
                    place.display()
                )),
            });
        };
        let is_another = last.source != recording.source && last.inputs.recording != inputs.recording;
        if is_another && !self.options.overwrites && place.exists() {
            return Err(Error::usage(format!(
                "{} has the results of {}; choose another folder, or --force to overwrite it",
                place.display(),
                last.source
            )));
        }
        Ok(())
    }
}

/// The folder of manifest and leases within that of the results.
const BATCH: &str = ".batch";

#[cfg(test)]
mod tests;

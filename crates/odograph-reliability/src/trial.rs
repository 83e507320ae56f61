//! One kill of a command, and the checks after it.

use crate::leftovers::{damage, files, is_passing};
use crate::moment::{EndingSignal, Moment};
use crate::program::{INTERRUPTED, Program, signal, wait};
use crate::victims::{Inputs, Keyframes, Victim};
use odograph::error::{Error, Result};
use odograph_live::TrackRecord;
use odograph_map::MapFile;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Output};
use std::time::{Duration, Instant};

/// What a kill showed.
#[derive(Debug)]
pub struct TrialReport {
    pub moment: Moment,
    /// Whether the command had ended before the signal.
    pub ended_before: bool,
    pub maps: u64,
    pub keyframes: u64,
    pub frames: u64,
    pub files: u64,
    pub ran_again: bool,
    /// The checks that failed, one sentence each.
    pub failures: Vec<String>,
}

/// A command that is killed once.
#[derive(Debug)]
pub struct Trial<'a> {
    victim: &'a Victim,
    program: &'a Program,
    inputs: &'a Inputs,
    moment: Moment,
}

/// The time that a command takes if nobody kills it: the longest of three.
pub fn duration(victim: &Victim, program: &Program, inputs: &Inputs) -> Result<Duration> {
    let moment = Moment { after: Duration::ZERO, signal: EndingSignal::Kill, watched: false };
    let trial = Trial::new(victim, program, inputs, moment);
    let mut longest = Duration::ZERO;
    for _ in 0..3 {
        trial.prepare()?;
        let begun = Instant::now();
        let done = trial.complete(&trial.folder(), victim.arguments)?;
        longest = longest.max(begun.elapsed());
        if !done.status.success() {
            return Err(Error::input(format!("{}: {}", victim.name, String::from_utf8_lossy(&done.stderr))));
        }
    }
    Ok(longest)
}

impl<'a> Trial<'a> {
    pub fn new(victim: &'a Victim, program: &'a Program, inputs: &'a Inputs, moment: Moment) -> Self {
        Self { victim, program, inputs, moment }
    }

    /// The folder of the command.
    pub fn folder(&self) -> PathBuf {
        self.inputs.trials()
    }

    /// Keeps the folder beside the others.
    pub fn keep(&self, number: u64) -> Result<()> {
        let name = format!("{}-{number}", self.victim.name.replace(' ', "-"));
        fs::rename(self.folder(), self.folder().with_file_name(name)).map_err(cannot)
    }

    fn map(&self) -> PathBuf {
        self.folder().join(self.victim.map)
    }

    fn arguments(&self, of: &str) -> String {
        of.replace("IN/", &format!("{}/", self.inputs.path("").display()))
    }

    /// Runs a form of the command to its end, with its client.
    fn complete(&self, folder: &Path, arguments: &str) -> Result<Output> {
        let client = self.victim.client.map(|client| self.arguments(client));
        self.program.run_with(folder, &self.arguments(arguments), client.as_deref())
    }

    fn prepare(&self) -> Result<()> {
        let folder = self.folder();
        if folder.exists() {
            fs::remove_dir_all(&folder).map_err(cannot)?;
        }
        fs::create_dir(&folder).map_err(cannot)?;
        for (from, to) in self.victim.copies {
            fs::copy(self.inputs.path(from), folder.join(to)).map_err(cannot)?;
        }
        Ok(())
    }

    /// Starts the command, ends it, and checks what it left.
    pub fn run(&self) -> Result<TrialReport> {
        self.prepare()?;
        let before = keyframes(&self.map());
        let mut child = self.program.start(&self.folder(), &self.arguments(self.victim.arguments))?;
        let client = self.victim.client.map(|client| self.arguments(client));
        let client = client.map(|client| self.program.start(&self.folder(), &client)).transpose()?;
        std::thread::sleep(self.moment.after);
        // What another process can see now must be there afterwards.
        let seen = if self.moment.watched { keyframes(&self.map()) } else { None };
        let frames = self.frames();
        let ended_before = child.try_wait().map_err(cannot)?.is_some();
        signal(&mut child, self.moment.signal);
        let status = wait(&mut child)?;
        if let Some(mut client) = client {
            signal(&mut client, EndingSignal::Kill);
            wait(&mut client)?;
        }
        let mut said = String::new();
        child.stderr.take().map(|mut stderr| stderr.read_to_string(&mut said)).transpose().map_err(cannot)?;
        let mut report = TrialReport {
            moment: self.moment,
            ended_before,
            maps: 0,
            keyframes: 0,
            frames: 0,
            files: 0,
            ran_again: false,
            failures: Vec::new(),
        };
        self.check_end(status, &said, &mut report);
        self.check_files(&mut report);
        self.check_map(before, seen, &mut report)?;
        self.check_frames(frames, status, &mut report);
        self.check_again(&mut report)?;
        Ok(report)
    }

    /// The number of frames that are on disk.
    fn frames(&self) -> u64 {
        if !self.victim.is_run {
            return 0;
        }
        let lines = |name: &str| fs::read_to_string(self.folder().join("out").join(name)).ok();
        let text = lines("trajectory.csv").or_else(|| lines("trajectory.csv.part"));
        text.map_or(0, |text| text.matches('\n').count().saturating_sub(1) as u64)
    }

    /// It ends in time, without a panic, and with a documented exit code.
    fn check_end(&self, status: Option<ExitStatus>, said: &str, report: &mut TrialReport) {
        let Some(status) = status else {
            report.failures.push("it did not end after the signal".to_owned());
            return;
        };
        if said.contains("panicked") {
            report.failures.push(format!("it panicked: {said}"));
        }
        // Before its handler is installed, a signal ends the program without a code.
        let expected = match status.code() {
            None => true,
            Some(code) => code == 0 || (code == INTERRUPTED && self.moment.signal != EndingSignal::Kill),
        };
        if !expected {
            report.failures.push(format!("it ended with {status}: {said}"));
        }
    }

    /// No file is half-written under its final name.
    fn check_files(&self, report: &mut TrialReport) {
        for path in files(&self.folder()).iter().filter(|path| !is_passing(path)) {
            report.files += 1;
            report.failures.extend(damage(path));
        }
    }

    /// The map opens, is not damaged, and has the keyframes that it must have.
    fn check_map(&self, before: Option<u64>, seen: Option<u64>, report: &mut TrialReport) -> Result<()> {
        let path = self.map();
        if !MapFile::is_there(&path) {
            if before.or(seen).is_some() {
                report.failures.push("the map is gone".to_owned());
            }
            return Ok(());
        }
        report.maps += 1;
        let check = format!("map info {} --check", path.display());
        let checked = self.program.run(&self.folder(), &check)?;
        if !checked.status.success() {
            report.failures.push(format!("damaged: {}", String::from_utf8_lossy(&checked.stderr)));
            return Ok(());
        }
        let now = keyframes(&path).unwrap_or(0);
        match self.victim.keyframes {
            Keyframes::Grow => {
                let least = before.max(seen).unwrap_or(0);
                report.keyframes += least;
                if now < least {
                    report.failures.push(format!("{now} keyframes are left of {least}"));
                }
            }
            Keyframes::BeforeOrAfter => {
                let after = self.after()?;
                report.keyframes += before.unwrap_or(0);
                if Some(now) != before && now != after {
                    report.failures.push(format!("{now} keyframes, not {before:?} or {after}"));
                }
            }
        }
        Ok(())
    }

    /// The number of keyframes after the command, run on a copy to its end.
    fn after(&self) -> Result<u64> {
        let folder = self.inputs.path("after").join(self.victim.name.replace(' ', "-"));
        let map = folder.join(self.victim.map);
        if !folder.exists() {
            fs::create_dir_all(&folder).map_err(cannot)?;
            for (from, to) in self.victim.copies {
                fs::copy(self.inputs.path(from), folder.join(to)).map_err(cannot)?;
            }
            self.complete(&folder, self.victim.arguments)?;
        }
        keyframes(&map).ok_or_else(|| Error::input(format!("{} wrote no map", self.victim.name)))
    }

    /// The trajectory has the frames that were on disk, and after SIGTERM or SIGINT the results are
    /// complete.
    fn check_frames(&self, least: u64, status: Option<ExitStatus>, report: &mut TrialReport) {
        if !self.victim.is_run {
            return;
        }
        let out = self.folder().join("out");
        let heeded = status.and_then(|status| status.code());
        let complete = heeded == Some(0) || (heeded == Some(INTERRUPTED) && self.frames() > 0);
        if complete {
            if !out.join("stats.json").exists() {
                report.failures.push("it ended orderly without stats.json".to_owned());
            }
            let left = files(&self.folder());
            let left = left.iter().filter(|path| is_passing(path));
            report.failures.extend(left.map(|path| format!("{} is left", path.display())));
        }
        let whole = out.join("trajectory.csv");
        let path = if whole.exists() { whole } else { out.join("trajectory.csv.part") };
        let text = fs::read_to_string(&path).unwrap_or_default();
        if text.is_empty() && least == 0 {
            return;
        }
        report.frames += least;
        match TrackRecord::from_csv(&text) {
            Ok(records) if (records.len() as u64) < least => {
                report.failures.push(format!("{} frames are left of {least}", records.len()));
            }
            Ok(_) => {}
            // A header that is cut off, before any frame.
            Err(_) if least == 0 && !text.contains('\n') => {}
            Err(error) => report.failures.push(format!("the trajectory cannot be read: {error}")),
        }
    }

    /// The command can be run again, and then all is as it should be.
    fn check_again(&self, report: &mut TrialReport) -> Result<()> {
        let again = self.victim.again.unwrap_or(self.victim.arguments);
        let done = self.complete(&self.folder(), again)?;
        if !done.status.success() {
            let said = String::from_utf8_lossy(&done.stderr);
            report.failures.push(format!("it cannot be run again: {} {said}", done.status));
            return Ok(());
        }
        report.ran_again = true;
        let check = format!("map info {} --check", self.map().display());
        let checked = self.program.run(&self.folder(), &check)?;
        if !checked.status.success() {
            let said = String::from_utf8_lossy(&checked.stderr);
            report.failures.push(format!("damaged after it was run again: {said}"));
            return Ok(());
        }
        // A short run says that it renders none, and a site does when it has nothing else to do.
        let renders = !self.victim.is_run && self.victim.client.is_none();
        let shift_m = MapFile::open_read_only(&self.map())?.mosaic_shift_m()?;
        if let Some(shift_m) = shift_m.filter(|_| renders) {
            report.failures.push(format!("the mosaic is off by {shift_m} m for ever"));
        }
        // What the map's writer leaves beside it is gone. (A killed run that is not replaced keeps
        // its own folder as it was.)
        let beside = |path: &&PathBuf| path.parent() == self.map().parent() && is_passing(path);
        let left = files(&self.folder());
        report
            .failures
            .extend(left.iter().filter(beside).map(|path| format!("{} is left for ever", path.display())));
        Ok(())
    }
}

/// The number of keyframes in a map, as another process sees it; `None` if there is no map.
fn keyframes(path: &Path) -> Option<u64> {
    let map = MapFile::open_read_only(path).ok()?;
    Some(map.map().ok()?.keyframes.len() as u64)
}

fn cannot(error: std::io::Error) -> Error {
    Error::output(format!("the folder of a trial cannot be used: {error}"))
}

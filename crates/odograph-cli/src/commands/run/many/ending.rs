//! How several recordings ended: printed, and as the exit code.

use super::super::RunArguments;
use super::super::summary::tell_warnings;
use crate::{Outcome, console, interrupt};
use odograph::error::{Error, ErrorKind, Result};
use odograph_session::batch::{Ended, Recording, RunStatus};
use odograph_session::{RunEnd, RunOutcome, RunStatistics};
use serde::Serialize;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// How one of them ended.
pub enum End {
    Followed(Box<RunOutcome>),
    /// By another call, to its end.
    Earlier(Box<Ended>),
    Failed(Error),
    /// The program was asked to end before its turn.
    NotBegun,
}

impl End {
    /// Whether there are results of it.
    pub fn has_results(&self) -> bool {
        matches!(self, Self::Followed(_) | Self::Earlier(_))
    }

    fn is_done(&self) -> bool {
        match self {
            Self::Followed(outcome) => outcome.end == RunEnd::Completed,
            Self::Earlier(ended) => ended.how == RunStatus::Done,
            Self::Failed(_) | Self::NotBegun => false,
        }
    }
}

/// One of several recordings in `--json`.
#[derive(Serialize)]
struct RecordingJson<'a> {
    source: &'a str,
    folder: PathBuf,
    error: Option<String>,
    statistics: Option<StatisticsJson<'a>>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum StatisticsJson<'a> {
    Now(&'a RunStatistics),
    Earlier(&'a Value),
}

/// Prints how each ended.
pub fn print_summary(
    recordings: &[&Recording],
    ends: &[End],
    arguments: &RunArguments,
    results: &Path,
) -> Result<()> {
    if arguments.output.json {
        let shown: Vec<RecordingJson<'_>> = recordings
            .iter()
            .zip(ends)
            .map(|(recording, end)| RecordingJson {
                source: &recording.source,
                folder: results.join(&recording.name),
                error: match end {
                    End::Followed(_) | End::Earlier(_) => None,
                    End::Failed(error) => Some(error.to_string()),
                    End::NotBegun => Some(NOT_BEGUN.to_owned()),
                },
                statistics: match end {
                    End::Followed(report) => Some(StatisticsJson::Now(&report.statistics)),
                    End::Earlier(ended) => ended.statistics.as_ref().map(StatisticsJson::Earlier),
                    End::Failed(_) | End::NotBegun => None,
                },
            })
            .collect();
        return console::print_json("the statistics", &shown);
    }
    if arguments.output.quiet {
        return Ok(());
    }
    let names: Vec<String> = recordings.iter().map(|recording| console::name(&recording.name)).collect();
    let widest = names.iter().map(|name| name.chars().count()).max().unwrap_or(0);
    for ((recording, name), end) in recordings.iter().zip(&names).zip(ends) {
        if let End::Followed(report) = end {
            tell_warnings(report, &format!("{}: ", recording.source));
        }
        console::print(&format!("{name:widest$}  {}\n", sentence(end)))?;
    }
    let followed = ends.iter().filter(|end| end.has_results()).count();
    console::print(&format!(
        "{followed} of {} recordings followed, in {}\n",
        ends.len(),
        console::name(results)
    ))?;
    let page = results.join("results.html");
    if page.exists() { console::print(&format!("Look at {}\n", console::name(page))) } else { Ok(()) }
}

const NOT_BEGUN: &str = "not begun: the program was asked to end";

fn sentence(end: &End) -> String {
    match end {
        End::Followed(report) => {
            let RunStatistics { distance_m, duration_s, frames_with_pose, frames, .. } = report.statistics;
            format!(
                "{distance_m:.2} m in {duration_s:.1} s; {frames_with_pose} of {frames} frames with a pose"
            )
        }
        End::Earlier(ended) => {
            let figure = |name: &str| ended.statistics.as_ref().and_then(|all| all.get(name)?.as_f64());
            let [distance_m, duration_s, with_pose, frames] =
                ["distance_m", "duration_s", "frames_with_pose", "frames"]
                    .map(|name| figure(name).unwrap_or(0.0));
            format!(
                "{distance_m:.2} m in {duration_s:.1} s; {with_pose} of {frames} frames with a pose; run before"
            )
        }
        End::Failed(_) => "failed; see above".to_owned(),
        End::NotBegun => NOT_BEGUN.to_owned(),
    }
}

/// The outcome of the call is the worst one: bad input, then wrong usage, then failed tracking.
pub fn worst(ends: &[End]) -> Result<Outcome> {
    let failed = |kind: fn(ErrorKind) -> bool| {
        ends.iter().filter(|end| matches!(end, End::Failed(error) if kind(error.kind()))).count()
    };
    let (usage, other) = (failed(|kind| kind == ErrorKind::Usage), failed(|kind| kind != ErrorKind::Usage));
    let sentence = || format!("{} of {} recordings could not be followed", usage + other, ends.len());
    match (other, usage) {
        (0, 0) => {}
        (0, _) => return Err(Error::usage(sentence())),
        _ => return Err(Error::input(sentence())),
    }
    if interrupt::asked() {
        return Ok(Outcome::Interrupted);
    }
    Ok(if ends.iter().all(End::is_done) { Outcome::Done } else { Outcome::TrackingFailed })
}

//! Several recordings in one call: each has a folder of its own and the same result as alone; as
//! many run concurrently as there are cores.

use super::summary::tell_warnings;
use super::{ConsoleObserver, Progress, RunArguments};
use crate::{Outcome, console, files, interrupt};
use odograph::error::{Error, ErrorKind, Result};
use odograph_session::{RunEnd, RunOutcome, RunStatistics};
use serde::Serialize;
use std::collections::HashSet;
use std::num::NonZero;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

/// Extensions of video files that are searched for in a folder of recordings.
const VIDEO_EXTENSIONS: [&str; 15] = [
    "mp4", "m4v", "mov", "mkv", "webm", "avi", "y4m", "264", "h264", "avc", "265", "h265", "hevc", "mpg",
    "ts",
];
/// Extensions of images: a folder with any of them is one recording, a sequence of images.
const PICTURE_EXTENSIONS: [&str; 8] = ["png", "jpg", "jpeg", "tif", "tiff", "pgm", "ppm", "pnm"];

/// One of several recordings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListedRecording {
    source: String,
    /// Name of its output folder.
    name: String,
}

/// The recordings of a call with more than one source or with a folder of videos; `None` for a
/// single one.
pub fn recordings(arguments: &RunArguments) -> Result<Option<Vec<ListedRecording>>> {
    let given = || arguments.source.iter().chain(&arguments.more);
    let mut sources = Vec::new();
    for source in given() {
        match videos_in(Path::new(source)) {
            videos if videos.is_empty() => sources.push(source.clone()),
            videos => sources.extend(videos.iter().map(|path| path.display().to_string())),
        }
    }
    if arguments.more.is_empty() && sources == [arguments.source()] {
        return Ok(None);
    }
    if let Some(map) = &arguments.output.map {
        return Err(Error::usage(format!(
            "--map {} is one map, and several recordings would write it at once; follow them one after the other",
            map.display()
        )));
    }
    if let Some(single) = given().find(|source| source.as_str() == "-" || source.ends_with(".toml")) {
        return Err(Error::usage(format!("{single} is run by itself, not among other recordings")));
    }
    for (ending, option) in [(".yaml", "--camera"), (".yml", "--camera"), (".gpkg", "--map")] {
        if let Some(other) = given().find(|source| source.ends_with(ending) && Path::new(source).is_file()) {
            return Err(Error::usage(format!("{other} is no recording; give it with {option}")));
        }
    }
    let one_alone = [
        ("--timestamps", arguments.timestamps.is_some()),
        ("--gyro, --heading, --wheel, --range or a topic of them", !arguments.sensors.files().is_empty()),
        ("--reference", arguments.reference.is_some()),
        ("--progress json", arguments.progress == Progress::Json),
        ("--bag-out", arguments.bag_out.is_some()),
        ("--site", arguments.site.site.is_some()),
    ];
    if let Some((option, _)) = one_alone.iter().find(|(_, given)| *given) {
        return Err(Error::usage(format!("{option} belongs to one recording; run it by itself")));
    }
    Ok(Some(named(sources)))
}

/// The videos in a folder without pictures, in the order of their names; none for anything else.
fn videos_in(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let files: Vec<PathBuf> =
        entries.flatten().map(|entry| entry.path()).filter(|path| path.is_file()).collect();
    let ends_like = |path: &Path, extensions: &[&str]| {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let hidden = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
        !hidden && extensions.contains(&extension.as_str())
    };
    if files.iter().any(|path| ends_like(path, &PICTURE_EXTENSIONS)) {
        return Vec::new();
    }
    let mut videos: Vec<PathBuf> =
        files.into_iter().filter(|path| ends_like(path, &VIDEO_EXTENSIONS)).collect();
    videos.sort();
    videos
}

/// Names each folder after its recording, without the ending; equal names get a number from the
/// second on.
fn named(sources: Vec<String>) -> Vec<ListedRecording> {
    let mut taken = HashSet::new();
    let name = |source: &String| {
        let path = Path::new(source);
        let own = if path.is_dir() { path.file_name() } else { path.file_stem() };
        let own = own.map_or_else(|| "recording".to_owned(), |name| name.to_string_lossy().into_owned());
        let numbered = (2..).map(|number| format!("{own}-{number}"));
        let free = std::iter::once(own.clone()).chain(numbered).find(|name| taken.insert(name.clone()));
        free.unwrap_or(own)
    };
    let names: Vec<String> = sources.iter().map(name).collect();
    sources.into_iter().zip(names).map(|(source, name)| ListedRecording { source, name }).collect()
}

/// How one of them ended.
enum End {
    Followed(Box<RunOutcome>),
    Failed(Error),
    /// The program was asked to end before its turn.
    NotBegun,
}

/// Runs all recordings and prints how each ended. A failure does not stop the others.
pub fn run(recordings: &[ListedRecording], arguments: &RunArguments, folder: &Path) -> Result<Outcome> {
    files::check_output_folder(folder)?;
    // It is removed where no recording can be followed.
    let _made = files::MadeFolders::new(folder)?;
    let cores = arguments
        .output
        .threads
        .map_or_else(|| thread::available_parallelism().map_or(1, NonZero::get), usize::from);
    let workers = cores.min(recordings.len());
    let share = cores / workers;
    // The longest first, so that no core works alone at the end; the results do not depend on the
    // order.
    let mut order: Vec<usize> = (0..recordings.len()).collect();
    let bytes = |index: usize| std::fs::metadata(&recordings[index].source).map_or(0, |file| file.len());
    order.sort_by_key(|&index| std::cmp::Reverse(bytes(index)));
    let next = AtomicUsize::new(0);
    let ends: Vec<Mutex<End>> = recordings.iter().map(|_| Mutex::new(End::NotBegun)).collect();
    let work = || {
        while let Some(&index) = order.get(next.fetch_add(1, Ordering::Relaxed)) {
            if interrupt::asked() {
                break;
            }
            let recording = &recordings[index];
            let end = match one(recording, arguments, folder, share) {
                Ok(report) => End::Followed(Box::new(report)),
                Err(error) => End::Failed(error),
            };
            if let End::Failed(error) = &end {
                let place = format!("{}: ", recording.source);
                // Most errors name the recording themselves.
                let place = if error.to_string().starts_with(&place) { "" } else { &place };
                console::failure(place, error);
            }
            if let Ok(mut place) = ends[index].lock() {
                *place = end;
            }
        }
    };
    thread::scope(|scope| (0..workers).for_each(|_| drop(scope.spawn(work))));
    let ends: Vec<End> = ends.into_iter().map(|end| end.into_inner().unwrap_or(End::NotBegun)).collect();
    print_summary(recordings, &ends, arguments, folder)?;
    worst(&ends)
}

/// Runs one recording as it would run alone, but without output.
fn one(
    recording: &ListedRecording,
    arguments: &RunArguments,
    folder: &Path,
    threads: usize,
) -> Result<RunOutcome> {
    let alone = arguments.builder(&recording.source, &folder.join(&recording.name))?.threads(threads);
    let run = || alone.run(&ConsoleObserver::new(true));
    catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|_| {
        Err(Error::input("following it ended unexpectedly; please report this recording"))
    })
}

/// One of several recordings in `--json`.
#[derive(Serialize)]
struct RecordingJson<'a> {
    source: &'a str,
    folder: PathBuf,
    error: Option<String>,
    statistics: Option<&'a RunStatistics>,
}

fn print_summary(
    recordings: &[ListedRecording],
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
                    End::Followed(_) => None,
                    End::Failed(error) => Some(error.to_string()),
                    End::NotBegun => Some(NOT_BEGUN.to_owned()),
                },
                statistics: match end {
                    End::Followed(report) => Some(&report.statistics),
                    _ => None,
                },
            })
            .collect();
        let text = serde_json::to_string_pretty(&shown)
            .map_err(|error| Error::output(format!("the statistics cannot be written as JSON: {error}")))?;
        return console::print(&(text + "\n"));
    }
    if arguments.output.quiet {
        return Ok(());
    }
    let names: Vec<String> = recordings.iter().map(|recording| console::name(&recording.name)).collect();
    let widest = names.iter().map(|name| name.chars().count()).max().unwrap_or(0);
    for ((recording, name), end) in recordings.iter().zip(&names).zip(ends) {
        let shown = match end {
            End::Followed(report) => {
                let statistics = &report.statistics;
                tell_warnings(report, &format!("{}: ", recording.source));
                format!(
                    "{:.2} m in {:.1} s; {} of {} frames with a pose",
                    statistics.distance_m,
                    statistics.duration_s,
                    statistics.frames_with_pose,
                    statistics.frames
                )
            }
            End::Failed(_) => "failed; see above".to_owned(),
            End::NotBegun => NOT_BEGUN.to_owned(),
        };
        console::print(&format!("{name:widest$}  {shown}\n"))?;
    }
    let followed = ends.iter().filter(|end| matches!(end, End::Followed(_))).count();
    let folder = console::name(results);
    console::print(&format!("{followed} of {} recordings followed, in {folder}\n", ends.len()))
}

const NOT_BEGUN: &str = "not begun: the program was asked to end";

/// The outcome of the call is the worst one: bad input, then wrong usage, then failed tracking.
fn worst(ends: &[End]) -> Result<Outcome> {
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
    let done = |end: &End| matches!(end, End::Followed(report) if report.end == RunEnd::Completed);
    Ok(if ends.iter().all(done) { Outcome::Done } else { Outcome::TrackingFailed })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_of_one_name_have_folders_of_their_own() {
        let sources = ["a/drive.mp4", "b/drive.mkv", "b/other.mp4", "c/drive.mp4"].map(str::to_owned);
        let names: Vec<String> =
            named(sources.to_vec()).into_iter().map(|recording| recording.name).collect();
        assert_eq!(names, ["drive", "drive-2", "other", "drive-3"]);
    }
}

//! `odograph localize`: finds a camera in an existing map.

use super::frame_selection::FrameTimes;
use super::run::{
    CameraSetup, ConsoleObserver, LogArguments, Motion, PoseFrameName, ProfileChoice, tell_warnings,
};
use crate::{Outcome, console};
use odograph::error::Result;
use odograph::formats::decimal::Rounded;
use odograph_map::MapFile;
use odograph_report::HtmlReporter;
use odograph_session::{
    AlikePlace, MapUse, PoseInMap, ResemblanceVerdict, RunBuilder, RunEnd, RunOutcome, RunStatistics,
    SourcePlan,
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Find where a picture or a recording was taken in a map.
///
/// The camera may look anywhere over the mapped ground, at any heading; nothing needs to be known
/// of where it is. Prints its last position in the frame of the map, with one standard deviation.
/// If that is not certain, the possible places are listed with their probabilities. The map file is
/// only read, unless --extend is given.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct LocalizeArguments {
    /// A picture, a video, a folder of pictures, or `-` for Y4M on standard input.
    ///
    /// It must be of a camera that the map was made with.
    #[arg(value_name = "SOURCE")]
    pub source: String,
    /// The map.
    #[arg(help_heading = "Map", long, value_name = "FILE")]
    pub map: PathBuf,
    /// Extend the map by what the recording shows. Without this it is only read.
    ///
    /// A map is extended where two sightings of different ground agree. Otherwise it stays as it
    /// is, and the place is looked up as without this option.
    #[arg(help_heading = "Map", long)]
    pub extend: bool,
    /// Only read the map; this is the default.
    #[arg(long, hide = true, conflicts_with = "extend")]
    pub read_only: bool,
    /// Rig file (TOML), if the camera is mounted differently from when the map was created.
    #[arg(help_heading = "Map", long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    #[command(flatten)]
    pub chosen: ProfileChoice,
    /// Frame whose place is printed. [default: the robot's if the map's rig has x_m, y_m, z_m]
    #[arg(help_heading = "Results", long, value_name = "FRAME")]
    pub frame: Option<PoseFrameName>,
    /// What may change between frames.
    #[arg(help_heading = "Map", long, value_name = "MODEL", default_value = "auto")]
    pub motion: Motion,
    #[command(flatten)]
    pub times: FrameTimes,
    /// Take at most this many frames.
    #[arg(help_heading = "Recording", long, value_name = "N")]
    pub max_frames: Option<u64>,
    /// Folder for all the files of a run. [default: only the place is printed]
    #[arg(help_heading = "Results", short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    pub force: bool,
    /// Threads to use; the results are the same for any number. [default: as many as help]
    #[arg(help_heading = "Results", long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Say nothing but errors.
    #[arg(help_heading = "Results", short, long)]
    pub quiet: bool,
    /// Print the place as JSON.
    #[arg(help_heading = "Results", long)]
    pub json: bool,
    #[command(flatten)]
    pub log: LogArguments,
}

const EXAMPLES: &str = "\
Examples:
  odograph localize photo.jpg --map hall.gpkg
  odograph localize tuesday.mp4 --map hall.gpkg -o tuesday/
  odograph localize tuesday.mp4 --map hall.gpkg --extend -o tuesday/

Ends with 0 when the place was found, 2 on wrong usage, 3 on bad input, 4 when it was not recognised \
(the message says whether the ground was never mapped, or why that is unknown).";

/// Runs the command.
pub fn localize(arguments: LocalizeArguments) -> Result<Outcome> {
    // An unreadable map is reported before any output is created.
    drop(MapFile::open_read_only(&arguments.map)?);
    let source = SourcePlan {
        timestamps: arguments.times.timestamps.clone(),
        fps: arguments.times.fps,
        max_frames: arguments.max_frames,
        ..SourcePlan::new(&arguments.source)
    };
    let observer = ConsoleObserver::new(arguments.quiet).with_log(arguments.log);
    let extends = arguments.extend && !is_one_picture(&source)?;
    let mut report = followed(&arguments, source.clone(), extends, arguments.force, &observer)?;
    let is_extended = extends && report.place.is_some();
    let is_interrupted = report.end == RunEnd::Interrupted;
    let is_read_again = source.is_readable_again();
    if extends && !is_extended && !is_interrupted && is_read_again {
        // One sighting does not extend a map, and is enough for a place.
        report = followed(&arguments, source.clone(), false, true, &observer)?;
    }
    print_result(&arguments, &report)?;
    if arguments.extend && !is_extended && !is_interrupted && !arguments.quiet {
        tell_not_extended(&arguments.map, is_read_again);
    }
    Ok(match (report.place, Outcome::from(report.end)) {
        (_, Outcome::Interrupted) => Outcome::Interrupted,
        (Some(_), outcome) => outcome,
        (None, _) => Outcome::TrackingFailed,
    })
}

/// Looks for the recording in the map, and extends the map if `extends`.
fn followed(
    arguments: &LocalizeArguments,
    source: SourcePlan,
    extends: bool,
    overwrites: bool,
    observer: &ConsoleObserver,
) -> Result<RunOutcome> {
    let run = RunBuilder::localizing(source, &arguments.map)
        .motion(arguments.motion.into())
        .overwriting(overwrites)
        .reporter(HtmlReporter);
    let run = if extends { run.map(MapUse::Extend(arguments.map.clone())) } else { run };
    // The camera is that of the map; a profile adds the mount.
    let setup = CameraSetup { rig: arguments.rig.clone(), ..CameraSetup::default() };
    let setup = setup.or_of_profile(arguments.chosen.profile.as_deref())?;
    let run = CameraSetup { camera: None, field_of_view: None, ..setup }.of_run(run);
    let run = arguments.frame.into_iter().fold(run, |run, frame| run.frame(frame.into()));
    let run = arguments.output.iter().fold(run, RunBuilder::folder);
    let run = arguments.threads.iter().fold(run, |run, threads| run.threads(usize::from(*threads)));
    let run = run.open(observer)?;
    observer.log_plan(run.plan(), run.source());
    let report = run.follow(observer)?;
    observer.log_times(&report.statistics);
    Ok(report)
}

/// Whether a source has a single picture. A map is extended where two sightings of different ground
/// agree, of which one picture can have only one.
fn is_one_picture(source: &SourcePlan) -> Result<bool> {
    if source.max_frames == Some(1) {
        return Ok(true);
    }
    Ok(source.is_readable_again() && source.open()?.info().frame_count == Some(1))
}

/// Says that a map that was to be extended was not, and why.
fn tell_not_extended(map: &Path, is_read_again: bool) {
    // A file is followed a second time for its place alone.
    let place = match is_read_again {
        true => "",
        false => "; for a place alone one sighting is enough, send it again without --extend",
    };
    console::warn(&format!(
        "{} was not extended: that needs two sightings of different ground that agree; extend it with a recording \
         that drives on over mapped ground{place}",
        console::name(map)
    ));
}

/// What was found, as JSON.
#[derive(Serialize)]
struct LocalizationJson<'a> {
    recognised: bool,
    /// `found`, or the reason why not.
    verdict: &'static str,
    place: Option<PoseInMap>,
    /// The source of the nearest keyframe's session.
    session_source: Option<String>,
    /// The possible places if no place is certain; the most probable first.
    alike: &'a [AlikePlace],
    statistics: &'a RunStatistics,
}

fn print_result(arguments: &LocalizeArguments, report: &RunOutcome) -> Result<()> {
    let sessions = MapFile::open_read_only(&arguments.map)?.sessions()?;
    let source = |place: &PoseInMap| {
        let session = sessions.iter().find(|session| session.id == place.session)?;
        Some(session.source.clone())
    };
    let alike = report.resemblance.as_ref().map_or(&[][..], |resemblance| &resemblance.places);
    let verdict = report.resemblance.as_ref().map_or(ResemblanceVerdict::TooFewFeatures, |one| one.verdict);
    if arguments.json {
        let json = LocalizationJson {
            recognised: report.place.is_some(),
            verdict: report.place.map_or(verdict.name(), |_| "found"),
            place: report.place,
            session_source: report.place.as_ref().and_then(source),
            alike,
            statistics: &report.statistics,
        };
        console::print_json("the place", &json)?;
    } else if let Some(place) = report.place.filter(|_| !arguments.quiet) {
        console::print(&sentence(&place, source(&place), report.statistics.frames))?;
        if let Some(folder) = &arguments.output {
            console::print(&format!("Look at {}\n", console::name(folder.join("report.html"))))?;
        }
    } else if !arguments.quiet {
        alike.iter().try_for_each(|place| console::print(&alike_line(place)))?;
    }
    if !arguments.quiet {
        tell_warnings(report, "");
    }
    if report.place.is_none() && report.end == RunEnd::Interrupted {
        console::error(&format!(
            "interrupted before {} was found in the map",
            console::source(&arguments.source)
        ));
    } else if report.place.is_none() {
        let source = console::source(&arguments.source);
        let other_scale = report.resemblance.as_ref().and_then(|resemblance| resemblance.other_scale);
        console::error(&match other_scale {
            Some(scale) => {
                format!("not found: {source} resembles nothing in {}; {scale}", console::name(&arguments.map))
            }
            None => verdict.sentence(&source, &arguments.map, alike.len()),
        });
    }
    Ok(())
}

/// A place where the camera may be.
fn alike_line(place: &AlikePlace) -> String {
    let percent = match 100.0 * place.probability {
        most if most >= 99.0 => ">99".to_owned(),
        least if least < 1.0 => " <1".to_owned(),
        other => format!("{other:3.0}"),
    };
    format!(
        "perhaps {percent} %: x {:.3} m, y {:.3} m, heading {:.1}°; keyframe {} of session {}\n",
        Rounded(place.x_m),
        Rounded(place.y_m),
        Rounded(place.heading_deg),
        place.keyframe,
        place.session,
    )
}

/// A standard deviation with this many decimals, or as many as show that it is not zero.
fn deviation(value: f64, decimals: usize) -> String {
    let is_zero = |text: &str| text.bytes().all(|byte| matches!(byte, b'0' | b'.'));
    let mut texts = (decimals..decimals + 6).map(|decimals| format!("{value:.decimals$}"));
    texts.find(|text| !is_zero(text)).unwrap_or_else(|| format!("{value:.decimals$}"))
}

/// Decimals of a position with this standard deviation, metres.
fn decimals(deviation_m: f64) -> usize {
    if deviation_m < 5e-5 { 6 } else { 4 }
}

fn sentence(place: &PoseInMap, source: Option<String>, frames: u64) -> String {
    let at = match frames {
        1 => String::new(),
        _ => format!("at frame {} ({:.2} s): ", place.frame, place.time_s),
    };
    let source = source.map_or(String::new(), |source| format!(" ({})", console::source(&source)));
    format!(
        "{at}x {:.*} m ± {} mm, y {:.*} m ± {} mm, heading {:.2}° ± {}° (one standard deviation)\n\
         nearest: keyframe {}, {:.3} m away, of session {}{source}\n",
        decimals(place.sd_x_m),
        Rounded(place.x_m),
        deviation(1e3 * place.sd_x_m, 1),
        decimals(place.sd_y_m),
        Rounded(place.y_m),
        deviation(1e3 * place.sd_y_m, 1),
        Rounded(place.heading_deg),
        deviation(place.sd_heading_deg, 2),
        place.keyframe,
        place.keyframe_distance_m,
        place.session,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_deviation_is_not_zero() {
        let texts = [0.14, 0.04, 0.0032, 0.0].map(|value| deviation(value, 1));
        assert_eq!(texts, ["0.1", "0.04", "0.003", "0.0"]);
    }
}

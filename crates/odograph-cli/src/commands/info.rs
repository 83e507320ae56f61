//! `odograph info`: what is in a recording, and what it can be used for.

use super::run::{CameraSetup, ProfileChoice};
use crate::console::quoted;
use crate::{Outcome, console, files};
use odograph::camera::Camera;
use odograph::error::Result;
use odograph::formats::camera_file;
use odograph_video::{Contents, RecordedCamera, RecordedTransforms, Stream, StreamUse};
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Show what a recording contains, and what it can be used for.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct InfoArguments {
    /// A video, a folder of pictures, a picture, or a robot recording (MCAP, ROS bag).
    #[arg(value_name = "FILE")]
    file: String,
    /// Camera file, to check whether it fits.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    #[command(flatten)]
    chosen: ProfileChoice,
    /// Print JSON to standard output.
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph info drive.mcap
  odograph info drive.mp4 --camera camera.yaml --json";

/// A recording as `--json` prints it.
#[derive(Serialize)]
struct InfoJson<'a> {
    file: &'a str,
    format: &'a str,
    streams: Vec<StreamJson<'a>>,
    warnings: &'a [String],
}

#[derive(Serialize)]
struct StreamJson<'a> {
    topic: Option<&'a str>,
    #[serde(rename = "type")]
    kind: &'a str,
    encoding: &'a str,
    width: Option<usize>,
    height: Option<usize>,
    count: u64,
    first_s: Option<f64>,
    last_s: Option<f64>,
    duration_s: Option<f64>,
    rate_hz: Option<f64>,
    gaps: Vec<GapJson>,
    /// Options of `odograph run` that use it; `None` for what cannot be used.
    option: Option<String>,
    /// The topic that describes the camera, and the camera in it.
    camera_topic: Option<&'a str>,
    camera: Option<&'a Camera>,
    /// Whether the given camera file fits the images; `None` where none is given, or no images are.
    camera_fits: Option<bool>,
}

#[derive(Serialize)]
struct GapJson {
    after_s: f64,
    length_s: f64,
}

/// Whether a camera file is for the images of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
enum CameraFit {
    Fits,
    /// Width and height that it is for, pixels.
    OtherSize(usize, usize),
}

/// Runs the command.
pub fn info(arguments: InfoArguments) -> Result<Outcome> {
    let setup = CameraSetup { camera: arguments.camera.clone(), ..CameraSetup::default() };
    let camera = setup.or_of_profile(arguments.chosen.profile.as_deref())?.camera;
    let camera_text = camera.as_deref().map(files::read_text).transpose()?;
    odograph_session::check_recording(Path::new(&arguments.file))?;
    let contents = odograph_video::inspect(&arguments.file)?;
    let fit = |stream: &Stream| -> Result<Option<CameraFit>> {
        let (Some(text), Some(path)) = (&camera_text, &camera) else { return Ok(None) };
        let StreamUse::Frames(_) = stream.usable_as else { return Ok(None) };
        let camera = camera_file::parse(text, stream.size).map_err(|error| error.at(path.display()))?;
        let calibrated = (camera.width(), camera.height());
        Ok(stream.size.map(|size| match size == calibrated {
            true => CameraFit::Fits,
            false => CameraFit::OtherSize(calibrated.0, calibrated.1),
        }))
    };
    let fits = contents.streams.iter().map(fit).collect::<Result<Vec<_>>>()?;
    if arguments.json {
        print_json(&arguments.file, &contents, &fits)?;
    } else {
        let given = arguments.camera.as_deref().filter(|_| fits.contains(&Some(CameraFit::Fits)));
        let profile = arguments.chosen.profile.as_deref();
        console::print(&text((&arguments.file, given, profile), &contents, &fits))?;
        contents.warnings.iter().for_each(|warning| console::warn(&format!("{}: {warning}", arguments.file)));
    }
    Ok(Outcome::Done)
}

/// The options of `odograph run` that use a stream.
fn option(stream: &Stream) -> Option<String> {
    let topic = stream.topic.as_deref().unwrap_or_default();
    let usable = stream.count > 0;
    match stream.usable_as {
        StreamUse::Frames(_) if stream.topic.is_none() => Some(String::new()),
        StreamUse::Frames(_) => Some(format!("--topic {topic}")),
        StreamUse::Gyro => Some(format!("--gyro-topic {topic}")),
        StreamUse::Wheel => Some(format!("--wheel-topic {topic}")),
        StreamUse::Range => Some(format!("--range-topic {topic}")),
        StreamUse::Gnss => Some(format!("--gnss-topic {topic}")),
        StreamUse::Path => Some(format!("--reference-topic {topic}")),
        StreamUse::OtherImages | StreamUse::CameraInfo | StreamUse::Nothing => None,
    }
    .filter(|_| usable)
}

/// The camera of frames as the recording describes it.
fn recorded(stream: &Stream) -> Option<&RecordedCamera> {
    match &stream.usable_as {
        StreamUse::Frames(recorded) => recorded.as_ref(),
        _ => None,
    }
}

/// Whether that camera is for images of the size that they have.
fn is_of_size(stream: &Stream, recorded: &RecordedCamera) -> bool {
    stream.size.is_none_or(|size| size == (recorded.camera.width(), recorded.camera.height()))
}

/// Whether a robot recording has the height of the camera with these images.
fn has_height(file: &str, topic: Option<&str>) -> bool {
    let mount = topic.map(|topic| odograph_video::recorded_mount(file, Some(topic)));
    matches!(mount, Some(Ok(Some(RecordedTransforms::Mount(mount)))) if mount.height_m.is_some())
}

fn print_json(file: &str, contents: &Contents, fits: &[Option<CameraFit>]) -> Result<()> {
    let streams = contents.streams.iter().zip(fits).map(|(stream, camera_fits)| StreamJson {
        topic: stream.topic.as_deref(),
        kind: &stream.kind,
        encoding: &stream.encoding,
        width: stream.size.map(|size| size.0),
        height: stream.size.map(|size| size.1),
        count: stream.count,
        first_s: stream.span_s.map(|span| span.0),
        last_s: stream.span_s.map(|span| span.1),
        duration_s: stream.span_s.map(|span| span.1 - span.0),
        rate_hz: stream.rate_hz,
        gaps: stream
            .gaps
            .iter()
            .map(|gap| GapJson { after_s: gap.after_s, length_s: gap.length_s })
            .collect(),
        option: option(stream),
        camera_topic: recorded(stream).map(|recorded| recorded.topic.as_str()),
        camera: recorded(stream).map(|recorded| &recorded.camera),
        camera_fits: camera_fits.map(|fit| fit == CameraFit::Fits),
    });
    let json =
        InfoJson { file, format: &contents.format, streams: streams.collect(), warnings: &contents.warnings };
    console::print_json("the contents", &json)
}

/// The contents for people: a line for each stream, and what it is good for below it.
fn text(
    (file, camera, profile): (&str, Option<&Path>, Option<&str>),
    contents: &Contents,
    fits: &[Option<CameraFit>],
) -> String {
    let mut text = String::new();
    let shown = console::name(file);
    let is_recording = contents.streams.iter().any(|stream| stream.topic.is_some());
    let _ = match contents.streams.len() {
        1 if is_recording => writeln!(text, "{shown}: {}, 1 topic", contents.format),
        count if count != 1 => writeln!(text, "{shown}: {}, {count} topics", contents.format),
        _ => writeln!(text, "{shown}"),
    };
    for (stream, fits) in contents.streams.iter().zip(fits) {
        let topic = stream.topic.as_ref().map(|topic| format!("{topic}  ")).unwrap_or_default();
        let _ = writeln!(text, "{}", console::name(format!("{topic}{}", figures(stream).join(", "))));
        for line in notes((file, camera, profile), stream, *fits) {
            let _ = writeln!(text, "    {}", console::name(line));
        }
    }
    text
}

fn figures(stream: &Stream) -> Vec<String> {
    let mut figures = vec![stream.kind.clone()];
    match (stream.size, stream.encoding.as_str()) {
        (Some((width, height)), encoding) => {
            figures.push(format!("{width}x{height} {encoding}").trim().to_owned())
        }
        (None, "") => {}
        (None, encoding) => figures.push(encoding.to_owned()),
    }
    let frames = matches!(stream.usable_as, StreamUse::Frames(_) | StreamUse::OtherImages);
    let unit = match (frames, stream.count) {
        (true, 1) => "frame",
        (true, _) => "frames",
        (false, 1) => "message",
        (false, _) => "messages",
    };
    figures.push(format!("{} {unit}", stream.count));
    figures.extend(stream.span_s.map(|(first_s, last_s)| format!("{:.2} s", last_s - first_s)));
    figures.extend(stream.rate_hz.map(|rate_hz| format!("{rate_hz:.2} Hz")));
    figures
}

fn notes(
    (file, camera, profile): (&str, Option<&Path>, Option<&str>),
    stream: &Stream,
    fits: Option<CameraFit>,
) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(longest) = stream.gaps.iter().max_by(|a, b| a.length_s.total_cmp(&b.length_s)) {
        notes.push(format!(
            "{} of {:.2} s, {:.2} s after the first",
            match stream.gaps.len() {
                1 => "a gap".to_owned(),
                gaps => format!("{gaps} gaps; the longest is"),
            },
            longest.length_s,
            longest.after_s
        ));
    }
    let given = option(stream);
    match (&stream.usable_as, given) {
        (StreamUse::Frames(_), Some(option)) => {
            let topic = stream.topic.as_deref();
            let height = if has_height(file, topic) { "" } else { " --height LENGTH" };
            let missing = match (profile, camera) {
                (Some(profile), _) => format!(" --profile {profile}"),
                (None, Some(camera)) => format!(" --camera {}{height}", quoted(camera)),
                (None, None) if recorded(stream).is_some_and(|camera| is_of_size(stream, camera)) => {
                    height.to_owned()
                }
                (None, None) => format!(" --camera FILE{height}"),
            };
            let file = quoted(Path::new(file));
            notes.push(if stream.count == 1 && topic.is_none() {
                format!("odograph localize {file} --map FILE")
            } else {
                let option = if option.is_empty() { option } else { format!(" {option}") };
                format!("odograph run {file}{option}{missing}")
            });
            match (recorded(stream), stream.topic.is_some()) {
                (Some(other), _) if !is_of_size(stream, other) => notes.push(format!(
                    "the camera in {} is for images of {}x{}; --camera gives its own",
                    other.topic,
                    other.camera.width(),
                    other.camera.height()
                )),
                (Some(RecordedCamera { topic, rectified, .. }), _) => {
                    let rectified = if *rectified { ", as rectified images" } else { "" };
                    notes.push(format!("its camera is in {topic}{rectified}"));
                }
                (None, true) => notes
                    .push("the recording has no camera of it that can be used; --camera gives it".to_owned()),
                (None, false) => {}
            }
        }
        (StreamUse::OtherImages, _) => notes.push(
            "images of depth, or of an encoding that is not read; a run needs gray or colour".to_owned(),
        ),
        (StreamUse::CameraInfo, _) => notes.push("a camera".to_owned()),
        (
            StreamUse::Gyro | StreamUse::Wheel | StreamUse::Range | StreamUse::Gnss | StreamUse::Path,
            Some(option),
        ) => {
            notes.push(format!("odograph run … {option}"));
        }
        _ => {}
    }
    notes.extend(fits.map(|fit| match fit {
        CameraFit::Fits => "the camera file fits".to_owned(),
        CameraFit::OtherSize(width, height) => format!("the camera file is for images of {width}x{height}"),
    }));
    notes
}

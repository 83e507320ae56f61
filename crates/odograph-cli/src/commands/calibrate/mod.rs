//! `odograph calibrate`: computes a camera file from views of a board, and a report on its quality.

mod focal_length;
mod input;
mod live;
mod output;
mod search;
mod summary;

use super::live::{CaptureArguments, ServeArguments};
use crate::{Outcome, console, files, interrupt};
use input::Input;
use odograph::error::{Error, Result};
use odograph_calibration::selection::{Guidance, SelectionConfig, Sighting};
use odograph_calibration::{
    Board, BoardView, Calibration, CalibrationConfig, LensModel, Verdict, nothing_found, seen_instead,
};
use odograph_video::SourceOptions;
use output::CalibrationOutput;
use search::BoardSearch;
use std::fmt::Display;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Calibrate a camera with pictures or a video of a board.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct CalibrateArguments {
    /// A video, a folder of pictures, pictures, or `-` for Y4M on standard input.
    ///
    /// With --live a camera, as `odograph live` takes it.
    #[arg(value_name = "SOURCE", required = true)]
    sources: Vec<String>,
    /// The board, such as chessboard:9x6:25mm (inner corners, side of a square).
    ///
    /// Also charuco:8x11:20mm, aprilgrid:6x6:88mm, circles:7x5:20mm and
    /// asymmetric-circles:4x11:20mm.
    #[arg(help_heading = "Board and lens", short, long, value_name = "BOARD")]
    board: String,
    /// The camera file to write (OpenCV YAML).
    ///
    /// [default: beside the first source, with its name: board-camera.yaml for board.mp4; with
    /// --live, camera.yaml in the working folder]
    #[arg(help_heading = "Results", short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Folder for the report. [default: beside the camera file, its name with -report]
    #[arg(help_heading = "Results", long, value_name = "FOLDER")]
    report: Option<PathBuf>,
    /// Calibrate with a camera while it films, and end when the result is good.
    ///
    /// The page (--serve) says what to show next.
    #[arg(help_heading = "Source", long)]
    live: bool,
    #[command(flatten)]
    serve: ServeArguments,
    #[command(flatten)]
    capture: CaptureArguments,
    /// Lens model; auto takes the one whose rays are surest over the whole image.
    #[arg(help_heading = "Board and lens", long, value_name = "MODEL", default_value = "auto")]
    model: LensModelOption,
    /// Assume square pixels: one focal length for both directions.
    #[arg(help_heading = "Board and lens", long)]
    square_pixels: bool,
    /// Fix the principal point at the image centre.
    #[arg(help_heading = "Board and lens", long)]
    centred: bool,
    /// Also estimate a slight bend of the board and a stretch of its print.
    #[arg(help_heading = "Board and lens", long)]
    bent_board: bool,
    /// Topic with the images, where a robot recording (MCAP, ROS bag) has several.
    #[arg(help_heading = "Recording", long, value_name = "NAME")]
    topic: Option<String>,
    /// Look at every n-th frame only.
    #[arg(help_heading = "Recording", long, value_name = "N", default_value_t = 1)]
    every: u64,
    /// Begin this many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    start: Option<f64>,
    /// End this many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    end: Option<f64>,
    /// Calibrate with at most this many views: the most informative ones.
    #[arg(help_heading = "Recording", long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u16).range(3..=500))]
    max_views: u16,
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    force: bool,
    /// Threads to use; the results are the same for any number.
    ///
    /// [default: as many as the machine has]
    #[arg(help_heading = "Results", long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Say nothing but errors and warnings.
    #[arg(help_heading = "Results", short, long)]
    quiet: bool,
    /// Print the figures as JSON to standard output instead of a summary.
    #[arg(help_heading = "Results", long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph calibrate board.mp4 --board chessboard:9x6:25mm -o camera.yaml
  odograph calibrate pictures/ --board charuco:8x11:20mm -o camera.yaml
  odograph calibrate --live /dev/video0 --serve --board charuco:8x11:20mm -o camera.yaml
  odograph calibrate left*.jpg --board chessboard:9x6:25mm --model brown5 -o left.yaml

Ends with 0 when the calibration is good or usable, 2 on wrong usage, 3 on bad input, 4 when it had better be done again (the \
files have been written and say why).";

/// The lens models by their names on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum LensModelOption {
    /// The one whose rays are surest over the whole image.
    Auto,
    /// No distortion.
    Pinhole,
    /// Brown–Conrady with k1, k2, p1, p2.
    Brown4,
    /// Brown–Conrady with k1, k2, p1, p2, k3: OpenCV's default.
    Brown5,
    /// Brown–Conrady, rational: k1 to k6, p1, p2.
    Brown8,
    /// Kannala–Brandt: OpenCV's fisheye, ROS's and Kalibr's equidistant.
    Fisheye,
    /// For very wide lenses.
    DoubleSphere,
}

impl LensModelOption {
    fn lens(self) -> Option<LensModel> {
        match self {
            Self::Auto => None,
            Self::Pinhole => Some(LensModel::Pinhole),
            Self::Brown4 => Some(LensModel::BrownConrady4),
            Self::Brown5 => Some(LensModel::BrownConrady5),
            Self::Brown8 => Some(LensModel::BrownConrady8),
            Self::Fisheye => Some(LensModel::KannalaBrandt4),
            Self::DoubleSphere => Some(LensModel::DoubleSphere),
        }
    }
}

/// A calibration with what it was made from.
struct CalibrationResult {
    board: Board,
    search: BoardSearch,
    /// Numbers and names of the views that were given to the calibration, in its order.
    names: Vec<(u64, String)>,
    views: Vec<BoardView>,
    guidance: Guidance,
    calibration: Calibration,
    /// The same with the bend of the board estimated, if the views show that it was bent.
    bent: Option<Calibration>,
    /// For people: what was read.
    description: String,
    /// How long finding the board and calibrating took.
    times: [Duration; 2],
}

/// Runs the command.
pub fn calibrate(arguments: CalibrateArguments) -> Result<Outcome> {
    let board: Board = arguments.board.parse()?;
    let output =
        CalibrationOutput::new(&arguments.camera_file(), arguments.report.as_deref(), arguments.force)?;
    let selection =
        SelectionConfig { most_views: usize::from(arguments.max_views), ..SelectionConfig::default() };
    if live::is_asked(&arguments)? {
        return live::calibrate(&arguments, board, &output, selection);
    }
    let options = SourceOptions {
        start_s: arguments.start,
        end_s: arguments.end,
        every: arguments.every,
        topic: arguments.topic.clone(),
        ..SourceOptions::default()
    };
    let started = Instant::now();
    let mut input = Input::open(&arguments.sources, &options)?;
    let search = search::search(&mut input, &board, selection, arguments.threads, arguments.quiet)?;
    let source = SearchedSource { description: input.description, searched: started.elapsed() };
    let mut calibrated = conclude(&arguments, board, search, selection, source)?;
    calibrated.search.warn_of_another_board(&board);
    if interrupt::asked() {
        let search = &mut calibrated.search;
        search
            .warnings
            .push(format!("interrupted: only the first {} frames were looked at", search.found.looked_at));
    }
    output.write(&calibrated)?;
    print_summary(&arguments, &calibrated, &output)
}

/// What was searched, and how long that took.
struct SearchedSource {
    description: String,
    searched: Duration,
}

impl CalibrateArguments {
    /// The camera file to write.
    fn camera_file(&self) -> PathBuf {
        let source = self.sources.first().map_or("-", String::as_str);
        match &self.output {
            Some(file) => file.clone(),
            None if self.live || source == "-" => files::free_beside("camera", ".yaml"),
            None => files::free_beside(source, "-camera.yaml"),
        }
    }

    fn config(&self) -> CalibrationConfig {
        CalibrationConfig {
            model: self.model.lens(),
            square_pixels: self.square_pixels,
            centred: self.centred,
            flat_board: !self.bent_board,
        }
    }
}

/// Calibrates with what a search has found.
fn conclude(
    arguments: &CalibrateArguments,
    board: Board,
    search: BoardSearch,
    selection: SelectionConfig,
    source: SearchedSource,
) -> Result<CalibrationResult> {
    let SearchedSource { description, searched } = source;
    let began = Instant::now();
    let (guidance, chosen) = choose(&search, selection.most_views, &board, &description)?;
    let (names, views): (Vec<_>, Vec<_>) = chosen
        .into_iter()
        .map(|sighting| ((sighting.number, search.names[&sighting.number].clone()), sighting.view.clone()))
        .unzip();
    let calibration = odograph_calibration::calibrate(&board, &views, &arguments.config())
        .map_err(|error| error.at(&description))?;
    // What nobody asked for may fail.
    let bent = calibration.bend.and_then(|_| {
        let config = CalibrationConfig { flat_board: false, ..arguments.config() };
        odograph_calibration::calibrate(&board, &views, &config).ok()
    });
    let times = [searched, began.elapsed()];
    Ok(CalibrationResult { board, search, names, views, guidance, calibration, bent, description, times })
}

/// Prints the result; returns the outcome.
fn print_summary(
    arguments: &CalibrateArguments,
    calibrated: &CalibrationResult,
    output: &CalibrationOutput,
) -> Result<Outcome> {
    calibrated.search.warnings.iter().for_each(|warning| console::warn(warning));
    if arguments.json {
        console::print(&summary::json(calibrated, output))?;
    } else if !arguments.quiet {
        console::print(&summary::text(calibrated, output))?;
    }
    Ok(match calibrated.calibration.verdict {
        Verdict::DoItAgain => Outcome::NotToBeTrusted,
        _ => Outcome::Done,
    })
}

/// The views to calibrate with: all images, if there are not too many; otherwise the most
/// informative ones.
fn choose<'a>(
    search: &'a BoardSearch,
    most_views: usize,
    board: &Board,
    place: &str,
) -> Result<(Guidance, Vec<&'a Sighting>)> {
    if search.found.with_board == 0 {
        let found = &search.found;
        let mostly = found.reasons.first().map(|(reason, count)| (reason as &dyn Display, *count));
        let pictures = !found.pictures_without.is_empty();
        let instead = seen_instead(board, &search.without.images);
        return Err(nothing_found(board, found.looked_at, pictures, mostly, instead.as_ref()).at(place));
    }
    search.selector.enough().map_err(|error| {
        // The few views may be a mistake: another board resembles a part of this one.
        let few = 2 * search.found.with_board < search.found.looked_at;
        let instead = few.then(|| seen_instead(board, &search.without.images)).flatten();
        match instead {
            Some(instead) => Error::input(format!("{error}; of the others, {instead}")).at(place),
            None => error.at(place),
        }
    })?;
    let guidance = search.selector.guidance();
    let all = search.pictures.len() <= most_views && !search.pictures.is_empty();
    let chosen = if all { search.pictures.iter().collect() } else { search.selector.chosen() };
    Ok((guidance, chosen))
}

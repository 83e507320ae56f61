//! `odograph evaluate`: the error of an estimated trajectory.

mod figures;
mod table;

use crate::{Outcome, console, files, lengths};
use clap::ValueEnum;
use odograph::error::{Error, Result};
use odograph::evaluation::{Alignment, Delta, Evaluation, EvaluationOptions, evaluate as measure};
use odograph::formats::trajectory_file::{TrajectoryFormat, parse_times};
use odograph_report::evaluation_plot;
use odograph_session::{LoadedTrajectory, read_trajectory, read_trajectory_text};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Compare a trajectory with the truth
///
/// Prints absolute and relative errors, and the drift over each metre.
#[derive(clap::Args)]
#[command(
    after_help = "The definitions are those of evo, so that figures can be compared; see docs/evaluation.md.\n\nExamples:\n  \
                  odograph evaluate drive/trajectory.tum truth.tum\n  \
                  odograph evaluate drive/trajectory.tum truth.tum --plot errors.svg"
)]
pub struct EvaluateArguments {
    /// The trajectory to judge (TUM or KITTI)
    estimate: PathBuf,
    /// The true trajectory (TUM or KITTI)
    truth: PathBuf,
    /// How the estimate is aligned before it is compared
    #[arg(long, value_enum, default_value = "se3")]
    align: Align,
    /// Do not compare poses further apart in time than this
    #[arg(long, value_name = "SECONDS", default_value_t = EvaluationOptions::default().max_time_difference_s)]
    max_time_difference: f64,
    /// Format of both files [default: recognised by the number of columns]
    #[arg(long, value_enum)]
    format: Option<EvaluatedFormat>,
    /// Times of the poses of KITTI files, a number of seconds a line
    ///
    /// [default: the number of the pose]
    #[arg(long, value_name = "FILE")]
    times: Option<PathBuf>,
    /// Segments of the relative errors: lengths (1m, 50cm) or poses (10f); several with commas
    #[arg(long, value_name = "LENGTH", value_delimiter = ',', default_value = "1f,1m")]
    delta: Vec<DeltaArgument>,
    /// Start a segment at every pose, not only at the end of the one before
    #[arg(long)]
    all_pairs: bool,
    /// Segment lengths for the drift; several with commas
    ///
    /// [default: 1, 10, 100, … up to the length of the path]
    #[arg(long, value_name = "LENGTH", value_parser = lengths::metres, value_delimiter = ',')]
    segments: Vec<f64>,
    /// Draw the paths and the errors over time into this SVG file
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Overwrite the plot if it exists
    #[arg(long)]
    force: bool,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Print no table
    #[arg(long, short)]
    quiet: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Align {
    /// not at all: both are in the same world
    None,
    /// the first poses onto each other
    Origin,
    /// turn about z and shift in x and y
    Se2,
    /// rotation and translation
    Se3,
    /// rotation, translation and scale
    Sim3,
}

impl From<Align> for Alignment {
    fn from(align: Align) -> Self {
        match align {
            Align::None => Self::None,
            Align::Origin => Self::Origin,
            Align::Se2 => Self::Se2,
            Align::Se3 => Self::Se3,
            Align::Sim3 => Self::Sim3,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum EvaluatedFormat {
    /// time x y z qx qy qz qw
    Tum,
    /// 3x4 matrices
    Kitti,
}

impl From<EvaluatedFormat> for TrajectoryFormat {
    fn from(format: EvaluatedFormat) -> Self {
        match format {
            EvaluatedFormat::Tum => Self::Tum,
            EvaluatedFormat::Kitti => Self::Kitti,
        }
    }
}

#[derive(Clone, Copy)]
struct DeltaArgument(Delta);

impl FromStr for DeltaArgument {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let bad = || format!("{text:?} is not a stretch; write a length as 1m or a count of poses as 10f");
        if let Some(length_m) = lengths::with_unit(text).ok().filter(|length_m| *length_m > 0.0) {
            return Ok(Self(Delta::Metres(length_m)));
        }
        let frames = text.strip_suffix('f').ok_or_else(bad)?;
        let count = frames.trim().parse::<usize>().ok().filter(|&count| count > 0).ok_or_else(bad)?;
        Ok(Self(Delta::Frames(count)))
    }
}

/// Runs the command.
pub fn evaluate(arguments: EvaluateArguments) -> Result<Outcome> {
    if let Some(path) = &arguments.plot {
        check_plot(path, arguments.force)?;
    }
    let times_s = match &arguments.times {
        Some(path) => {
            Some(parse_times(&read_trajectory_text(path)?).map_err(|error| error.at(path.display()))?)
        }
        None => None,
    };
    let format = arguments.format.map(TrajectoryFormat::from);
    let mut estimate = read_trajectory(&arguments.estimate, format, times_s.as_deref())?;
    let mut truth = read_trajectory(&arguments.truth, format, times_s.as_deref())?;
    if times_s.is_some() {
        let has_times = |path: &Path| read_trajectory(path, format, None).map(|loaded| loaded.timed);
        if has_times(&arguments.estimate)? && has_times(&arguments.truth)? {
            return Err(Error::usage(format!(
                "--times is for KITTI files; {} and {} have times of their own",
                arguments.estimate.display(),
                arguments.truth.display()
            )));
        }
    }
    if !(estimate.timed && truth.timed) && estimate.trajectory.poses.len() != truth.trajectory.poses.len() {
        return Err(Error::input(format!(
            "{} has {} poses and {} has {}; without times only files of the same length can be compared (give --times)",
            arguments.estimate.display(),
            estimate.trajectory.poses.len(),
            arguments.truth.display(),
            truth.trajectory.poses.len()
        )));
    }
    LoadedTrajectory::number_unless_timed(&mut estimate, &mut truth);
    let options = EvaluationOptions {
        max_time_difference_s: arguments.max_time_difference,
        alignment: arguments.align.into(),
        deltas: arguments.delta.iter().map(|delta| delta.0).collect(),
        all_pairs: arguments.all_pairs,
        segment_lengths_m: arguments.segments.clone(),
    };
    let evaluation = measure(&estimate.trajectory, &truth.trajectory, &options)?;
    if evaluation.pairs.len() == 1 && options.alignment != Alignment::None {
        return Err(Error::input(format!(
            "only one pose of {} and {} can be compared, and alignment {} leaves it no error; check that both use the \
             same clock, allow a larger --max-time-difference, or give --align none if both are in the same world",
            arguments.estimate.display(),
            arguments.truth.display(),
            options.alignment
        )));
    }
    let figures = [
        evaluation.absolute.translation.rmse,
        evaluation.absolute.rotation.rmse,
        evaluation.truth_length_m,
        evaluation.estimate_length_m,
        evaluation.final_position_error_m,
    ];
    if figures.iter().any(|figure| !figure.is_finite()) {
        return Err(Error::input(format!(
            "{} or {} has positions too far away to be compared",
            arguments.estimate.display(),
            arguments.truth.display()
        )));
    }
    if let Some(path) = &arguments.plot {
        let title = format!("{} against {}", name(&arguments.estimate), name(&arguments.truth));
        let _made = files::MadeFolders::of_file(path)?;
        files::write(path, evaluation_plot::svg(&title, &evaluation, &truth.trajectory).as_bytes())?;
    }
    // The ground of KITTI's poses is not x and y, and a scale of 0 has left no length.
    let has_ground = estimate.timed && truth.timed && evaluation.alignment.scale > 0.0;
    let over_ground_m = has_ground.then(|| compared_over_ground_m(&evaluation));
    print_result(&arguments, &options, &evaluation, over_ground_m)?;
    Ok(Outcome::Done)
}

fn print_result(
    arguments: &EvaluateArguments,
    options: &EvaluationOptions,
    evaluation: &Evaluation,
    over_ground_m: Option<[f64; 2]>,
) -> Result<()> {
    let (estimate, truth) = (&arguments.estimate, &arguments.truth);
    if arguments.json {
        return figures::print_json(estimate, truth, options, evaluation);
    }
    match arguments.quiet {
        true => Ok(()),
        false => console::print(&table::text(estimate, truth, options, evaluation, over_ground_m)),
    }
}

/// Length of a path over the ground (x and y), metres: what `odograph run` calls its distance.
pub fn over_ground_m(places_m: impl IntoIterator<Item = [f64; 2]>) -> f64 {
    let places_m: Vec<_> = places_m.into_iter().collect();
    let steps_m = places_m.windows(2).map(|two| (two[1][0] - two[0][0]).hypot(two[1][1] - two[0][1]));
    // A fold: the sum of no numbers is −0.
    steps_m.fold(0.0, |a, b| a + b)
}

/// Lengths over the ground of truth and estimate through the compared poses, metres; that of the
/// estimate without the scale of the alignment, in its own world, whose z axis is up.
fn compared_over_ground_m(evaluation: &Evaluation) -> [f64; 2] {
    let estimate_from_truth = evaluation.alignment.truth_from_estimate.inverse();
    let pairs = &evaluation.pairs;
    [
        over_ground_m(pairs.iter().map(|pair| [pair.truth.translation.x, pair.truth.translation.y])),
        over_ground_m(pairs.iter().map(|pair| {
            let place = (estimate_from_truth * pair.estimate).translation;
            [place.x / evaluation.alignment.scale, place.y / evaluation.alignment.scale]
        })),
    ]
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn check_plot(path: &Path, force: bool) -> Result<()> {
    if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("svg")) {
        return Err(Error::usage(format!("{} is not an .svg; the plot is written as SVG", path.display())));
    }
    files::check_output_file(path, force)
}

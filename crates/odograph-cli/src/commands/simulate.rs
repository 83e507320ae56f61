//! `odograph simulate`: renders a recording with exact ground truth.

mod board;
mod drive;
mod output;
mod photographs;
mod scene;
mod without_effect;
pub(super) mod y4m;

use crate::Outcome;
use crate::lengths::{self, Height};
use clap::ValueEnum;
use odograph::error::Result;
use odograph_calibration::Board;
use serde::Serialize;
use std::path::PathBuf;

/// Render a recording over a floor, or of a board, with exact truth
///
/// Writes the frames, the truth, the camera file and the rig file.
///
/// The same options always write the same bytes. Without options: a square of 2 m without turning,
/// over asphalt, seen from 0.9 m.
#[derive(clap::Args, Debug)]
#[command(after_help = EXAMPLES)]
pub struct SimulateArguments {
    /// Folder to write to
    ///
    /// [default: simulation, with a number if that exists]
    #[arg(help_heading = "Results", short, long, value_name = "FOLDER")]
    output: Option<PathBuf>,
    /// Instead of a drive: this board, such as chessboard:9x6:25mm, held to the camera for 30 s
    ///
    /// Writes board.avi and the true camera.yaml, to try `odograph calibrate` without a board. The
    /// boards are those of `odograph board --help`.
    #[arg(long, value_name = "BOARD", conflicts_with_all = board::ONLY_FOR_DRIVES, help_heading = "Board")]
    board: Option<Board>,
    /// Ground: asphalt, carpet, tiles, bricks, grass, concrete, bare, or a photograph
    ///
    /// A photograph of a floor is a PNG or JPEG. Given twice, patches of the second lie in the
    /// first.
    #[arg(long, value_name = "NAME|FILE", default_value = "asphalt", help_heading = "Ground and way")]
    texture: Vec<String>,
    /// Width of the ground that a photograph shows, metres; one for each photograph [default: 2]
    #[arg(long, value_name = "LENGTH", value_parser = lengths::metres, help_heading = "Ground and way")]
    photo_width: Vec<f64>,
    /// How a photograph covers the plane: mirror (the default), repeat or scatter
    ///
    /// mirror is seamless, repeat is for photographs whose edges fit, scatter for asphalt and
    /// grass: nothing repeats.
    #[arg(long, value_name = "HOW", help_heading = "Ground and way")]
    tiling: Vec<TilingName>,
    /// Shape of the path
    #[arg(long, value_name = "NAME", value_enum, default_value = "square", help_heading = "Ground and way")]
    path: PathName,
    /// Length of the path, of a side, of a lane or of the eight, metres or with a unit
    ///
    /// Of a straight or a walk in all, of an eight from tip to tip.
    #[arg(long, value_name = "LENGTH", value_parser = lengths::metres, help_heading = "Ground and way")]
    length: Option<f64>,
    /// Speed over ground, metres per second [default: 0.5]
    #[arg(long, value_name = "M/S", help_heading = "Ground and way")]
    speed: Option<f64>,
    /// Rate of turning on the spot or about a point, degrees per second [default: 30]
    #[arg(long, value_name = "DEGREES/S", help_heading = "Ground and way")]
    turn_rate: Option<f64>,
    /// Turns about the pivot, or laps of the eight
    #[arg(long, value_name = "TURNS", allow_negative_numbers = true, help_heading = "Ground and way")]
    turns: Option<f64>,
    /// Number of lanes [default: 4]
    #[arg(long, value_name = "COUNT", help_heading = "Ground and way")]
    lanes: Option<u32>,
    /// Distance between lanes, metres [default: 0.6]
    #[arg(long, value_name = "LENGTH", value_parser = lengths::metres, help_heading = "Ground and way")]
    spacing: Option<f64>,
    /// Stones of this height and depth, millimetres, and their distance, centimetres
    ///
    /// [default distance: 3 cm] Both take units: 8mm:3cm.
    #[arg(long, value_name = "MM[:SCALE_CM]", value_parser = scene::parse_mm_cm, help_heading = "Ground and way")]
    relief: Option<scene::PairOption>,
    /// Undulation by this many centimetres, and its wavelength, metres
    ///
    /// [default wavelength: 2 m] Both take units: 5cm:2m.
    #[arg(long, value_name = "CM[:WAVELENGTH_M]", value_parser = scene::parse_cm_m, help_heading = "Ground and way")]
    undulation: Option<scene::PairOption>,
    /// A step across the path, centimetres (negative: down), and its x, metres
    ///
    /// [default x: 1 m] Both take units: 5cm:1m.
    #[arg(
        long,
        value_name = "CM[:AT_M]",
        value_parser = scene::parse_cm_m,
        allow_hyphen_values = true,
        help_heading = "Ground and way"
    )]
    kerb: Option<scene::PairOption>,
    /// An incline in percent (negative: down), and the x where it begins, metres
    ///
    /// [default x: 1 m]
    #[arg(
        long,
        value_name = "PERCENT[:AT_M]",
        value_parser = scene::parse_pair,
        allow_hyphen_values = true,
        help_heading = "Ground and way"
    )]
    ramp: Option<scene::PairOption>,
    /// The camera follows undulation, kerb and ramp on wheels 0.5 m apart
    ///
    /// Otherwise it keeps its height and stays upright.
    #[arg(long, help_heading = "Ground and way")]
    ride: bool,
    /// Grass in the wind: amplitude in pixels, and the share of the ground that moves
    ///
    /// [default share: 0.3]
    #[arg(long, value_name = "PX[:SHARE]", value_parser = scene::parse_pair, help_heading = "Ground and way")]
    sway: Option<scene::PairOption>,
    /// Markers along the path: family, dictionary, side and distance
    ///
    /// Such as apriltag:36h11:80mm:10m. markers.csv has their true places.
    #[arg(long, value_name = "FAMILY:SIZE:SPACING", value_parser = scene::parse_markers, help_heading = "Ground and way")]
    markers: Option<scene::MarkersOption>,
    /// Record this many seconds instead of to the end of the path
    ///
    /// Before and after the path the camera stands still.
    #[arg(long, value_name = "SECONDS", help_heading = "Ground and way")]
    duration: Option<f64>,
    /// Be at full speed in the first and the last frame instead of starting and ending at rest
    #[arg(long, help_heading = "Ground and way")]
    rolling: bool,

    /// Camera file; without it a camera of 65° with mild barrel distortion
    #[arg(long, value_name = "FILE", help_heading = "Camera")]
    camera: Option<PathBuf>,
    /// Image size in pixels, without a camera file
    #[arg(long, value_name = "WxH", value_parser = scene::parse_size, help_heading = "Camera")]
    size: Option<(usize, usize)>,
    /// Height of the camera above the ground, metres
    #[arg(
        long,
        value_name = "LENGTH",
        value_parser = lengths::height,
        default_value = "0.9",
        allow_negative_numbers = true,
        help_heading = "Camera"
    )]
    height: Height,
    /// Roll against straight down, degrees
    #[arg(
        long,
        value_name = "DEGREES",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Camera"
    )]
    roll: f64,
    /// Pitch against straight down, degrees
    #[arg(
        long,
        value_name = "DEGREES",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Camera"
    )]
    pitch: f64,
    /// Yaw: top of the image against forward, degrees counter-clockwise
    #[arg(
        long,
        value_name = "DEGREES",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Camera"
    )]
    yaw: f64,
    /// Frames per second
    #[arg(
        long,
        value_name = "HZ",
        default_value_t = 30.0,
        allow_negative_numbers = true,
        help_heading = "Camera"
    )]
    fps: f64,

    /// Noise of the sensor, standard deviation in gray levels
    #[arg(
        long,
        value_name = "GRAY",
        default_value_t = 2.0,
        allow_negative_numbers = true,
        help_heading = "Effects"
    )]
    noise: f64,
    /// Exposure time that blurs what moves, seconds
    #[arg(
        long,
        value_name = "SECONDS",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Effects"
    )]
    blur: f64,
    /// Vignetting: darkening of the image corners, 0 to 1
    #[arg(
        long,
        value_name = "SHARE",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Effects"
    )]
    vignetting: f64,
    /// Vibration in millimetres, degrees and hertz
    ///
    /// [default: 0.1 degrees for each millimetre, and 8 Hz]
    #[arg(long, value_name = "MM[:DEG[:HZ]]", value_parser = scene::parse_vibration, help_heading = "Effects")]
    vibration: Option<scene::VibrationOption>,
    /// Darkness of the carrier's shadow, which stands still in the image, 0 to 1
    #[arg(long, value_name = "SHARE", num_args = 0..=1, default_missing_value = "0.45", help_heading = "Effects")]
    shadow: Option<f64>,
    /// Darkness of shadows that lie on the ground, 0 to 1
    #[arg(long, value_name = "SHARE", num_args = 0..=1, default_missing_value = "0.45", help_heading = "Effects")]
    ground_shadow: Option<f64>,
    /// Things cross the view every four seconds, with this speed over ground, metres per second
    #[arg(long, value_name = "M/S", num_args = 0..=1, default_missing_value = "0.5", help_heading = "Effects")]
    object: Option<f64>,
    /// The height varies by this many percent to either side
    #[arg(long, value_name = "PERCENT", help_heading = "Effects")]
    height_change: Option<f64>,
    /// Roll and pitch vary by this many degrees to either side
    #[arg(long, value_name = "DEGREES", help_heading = "Effects")]
    tilt_change: Option<f64>,
    /// The light drifts by this share to either side, and flickers by a quarter of it
    #[arg(long, value_name = "SHARE", num_args = 0..=1, default_missing_value = "0.2", help_heading = "Effects")]
    lighting: Option<f64>,
    /// The exposure jumps every three seconds, by up to this share
    #[arg(long, value_name = "SHARE", num_args = 0..=1, default_missing_value = "0.3", help_heading = "Effects")]
    exposure_jumps: Option<f64>,
    /// The lens is covered from one time to another, seconds; may be given more than once
    #[arg(long, value_name = "FROM:TO", value_parser = scene::parse_blackout, help_heading = "Effects")]
    blackout: Vec<odograph_simulation::Blackout>,
    /// Rolling shutter: time from the first row to the last, milliseconds
    ///
    /// A timestamp is that of the middle row.
    #[arg(
        long,
        value_name = "MS",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Effects"
    )]
    readout_ms: f64,
    /// Write the readout time into camera.yaml; otherwise it is not stated
    #[arg(long, help_heading = "Effects")]
    tell_readout: bool,
    /// The focal length varies by this many percent to either side, with a period in seconds
    ///
    /// [default time: 5 s]
    #[arg(long, value_name = "PERCENT[:SECONDS]", value_parser = scene::parse_pair, help_heading = "Effects")]
    breathing: Option<scene::PairOption>,
    /// A bumper covers this share of the image from its bottom edge and stands still in it
    #[arg(long, value_name = "SHARE", num_args = 0..=1, default_missing_value = "0.15", help_heading = "Effects")]
    bumper: Option<f64>,
    /// Number of dark specks on the lens
    #[arg(long, value_name = "COUNT", num_args = 0..=1, default_missing_value = "6", help_heading = "Effects")]
    dirt: Option<u32>,
    /// The carrier's own lamp gives this share of the light, 0 to 1
    ///
    /// A bright spot with a highlight, and darkness around it.
    #[arg(long, value_name = "STRENGTH", num_args = 0..=1, default_missing_value = "0.7", help_heading = "Effects")]
    lamp: Option<f64>,
    /// Share of frames that are dropped at random, 0 to below 1
    #[arg(
        long,
        value_name = "SHARE",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Effects"
    )]
    dropped: f64,
    /// Frames are early or late by this standard deviation, milliseconds
    ///
    /// Their timestamps say so.
    #[arg(
        long,
        value_name = "MS",
        default_value_t = 0.0,
        allow_negative_numbers = true,
        help_heading = "Effects"
    )]
    jitter: f64,
    /// Seed of the random numbers
    #[arg(long, value_name = "NUMBER", default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=i64::MAX as u64), help_heading = "Effects")]
    seed: u64,

    /// Write readings of gyroscope, compass, wheel and range finder
    ///
    /// gyro.csv, heading.csv, wheel.csv and range.csv.
    #[arg(long, help_heading = "Other sensors")]
    sensors: bool,

    /// png: a folder of pictures; y4m: uncompressed video; mjpeg: an AVI of JPEG pictures
    ///
    /// [default: png; with --board mjpeg]
    #[arg(help_heading = "Results", long, value_enum)]
    format: Option<FormatName>,
    /// Colour instead of gray
    #[arg(help_heading = "Results", long)]
    color: bool,
    /// Overwrite what an earlier run has written
    #[arg(help_heading = "Results", long)]
    force: bool,
    /// Say nothing
    #[arg(help_heading = "Results", short, long)]
    quiet: bool,
    /// Threads to use; the results are the same for any number
    ///
    /// [default: as many as the machine has]
    #[arg(help_heading = "Results", long, value_name = "COUNT")]
    threads: Option<std::num::NonZeroUsize>,
}

const EXAMPLES: &str = "\
Examples:
  odograph simulate --path eight --texture carpet -o sim
  odograph simulate --board chessboard:9x6:25mm -o board
  odograph simulate --board charuco:8x11:20mm --format png --fps 1 -o board";

/// The shapes of paths by name.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum PathName {
    /// Stand still
    Still,
    /// Straight ahead
    Straight,
    /// A square without turning, as in the paper
    Square,
    /// A square with turns on the spot at its corners
    SquareTurns,
    /// One turn about the ground point that the top left corner of the image sees (the paper's
    /// figure 14a)
    Pivot,
    /// Five turns about that point
    Spin,
    /// A figure of eight
    Eight,
    /// Up and down a field
    Lanes,
    /// A smooth random walk
    Walk,
}

/// How a photograph covers the plane.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum TilingName {
    Mirror,
    Repeat,
    Scatter,
}

/// Format of the frames.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum FormatName {
    Png,
    Y4m,
    Mjpeg,
}

impl FormatName {
    /// The name of the frames in their folder; videos have this name.
    fn file_name(self, video: &str) -> String {
        match self {
            Self::Png => "frames".to_owned(),
            Self::Y4m => format!("{video}.y4m"),
            Self::Mjpeg => format!("{video}.avi"),
        }
    }
}

/// Runs the command.
pub fn simulate(arguments: SimulateArguments) -> Result<Outcome> {
    match &arguments.board {
        Some(shown) => board::simulate(&arguments, shown),
        None => drive::simulate(&arguments),
    }
}

//! Roll and pitch, and with a known distance the height, from a recording of driving.

use super::{CAMERA_UNKNOWN, GroundArguments, RigMeasurement, read_camera};
use crate::commands::run::ConsoleObserver;
use crate::lengths::Typed;
use crate::{console, interrupt};
use indicatif::ProgressStyle;
use odograph::camera::{Camera, Rig};
use odograph::camera::{CameraUncertainty, MeasuredRig, RigDeviations};
use odograph::error::{Error, Result};
use odograph::geometry::GroundPose;
use odograph::image::RgbImage;
use odograph::mounting::{DrivenTilt, DrivingConfig, LensMeasurement, Observability, TiltMeasurement};
use odograph::odometry::{Odometry, OdometryConfig};
use odograph_session::{open_recording, read_rig};

/// One pass over the recording.
struct CalibrationPass {
    driven: DrivenTilt,
    found: TiltMeasurement,
    /// The lens, if it was found to differ from the camera file.
    lens: Option<LensMeasurement>,
    frame: RgbImage,
    warnings: Vec<String>,
    /// Length of the path from each frame to the next, metres at the assumed height.
    length_by_frames_m: f64,
}

/// Error of the initial tilt, in degrees, above which the recording is tracked again: the predicted
/// shapes of patches depend on the tilt.
const AGAIN_DEG: f64 = 0.1;

pub fn measure(arguments: &GroundArguments) -> Result<RigMeasurement> {
    let [path] = arguments.sources.as_slice() else {
        return Err(Error::usage(
            "give one recording of driving, or --board BOARD for pictures of a board on the floor",
        ));
    };
    if path == "-" {
        return Err(Error::usage(
            "a recording of driving is read twice and cannot come from standard input; give a file",
        ));
    }
    let given_m = assumed_height_m(arguments)?;
    let begin = match &arguments.rig {
        Some(path) => read_rig(path, &ConsoleObserver::new(arguments.quiet))?,
        None => Rig::level(1.0),
    };
    let rig = Rig { height_m: given_m, ..begin }.validated()?;
    let size = {
        let source = open_recording(path, &arguments.source_options())?;
        (source.info().width, source.info().height)
    };
    let (camera, uncertainty) = read_camera(&arguments.camera, arguments.source(), size)?;
    let (pass, lens_off_px) = follow_until_converged(arguments, path, camera, uncertainty.as_ref(), rig)?;
    let found = &pass.found;
    if let Observability::Partial { worst, deviation_rad } = found.observability {
        return Err(Error::input(not_revealed(path, worst, deviation_rad)));
    }
    let (height_m, height_deviation_m) = match arguments.distance {
        None => (given_m, None),
        Some(distance) => by_distance(path, &pass, distance)?,
    };
    let mut warnings = pass.warnings;
    warnings.extend(uncertainty.is_none().then(|| CAMERA_UNKNOWN.to_owned()));
    warnings.extend(lens_off_px.map(|off_px| {
        format!(
            "the lens differs from {}, by {off_px:.1} px at the edge of the image: the tilt is that with \
             the lens estimated from the recording, which odograph run estimates too; odograph calibrate \
             measures it",
            arguments.camera.display()
        )
    }));
    let lost = pass.driven.lost_fraction();
    if lost > 0.0 {
        warnings.push(format!("{:.1} % of the frames could not be tracked", 100.0 * lost));
    }
    Ok(RigMeasurement {
        rig: MeasuredRig {
            rig: Rig { height_m, roll_rad: found.roll_rad, pitch_rad: found.pitch_rad, ..begin },
            deviations: RigDeviations {
                height_m: height_deviation_m,
                roll_rad: Some(found.covariance[(0, 0)].sqrt()),
                pitch_rad: Some(found.covariance[(1, 1)].sqrt()),
                ..RigDeviations::default()
            },
        },
        summary: summary(found),
        warnings,
        frame: pass.frame,
        points: Vec::new(),
        forward_known: false,
    })
}

/// The height over ground at which the recording is tracked: 1 m where a distance scales the path.
fn assumed_height_m(arguments: &GroundArguments) -> Result<f64> {
    match (arguments.height, arguments.distance) {
        (Some(height), _) => {
            if !arguments.quiet {
                height.question();
            }
            Ok(height.metres)
        }
        (None, Some(distance)) if distance.metres.is_finite() && distance.metres > 0.0 => Ok(1.0),
        (None, Some(Typed { metres: distance_m, .. })) => Err(Error::usage(format!(
            "a distance of {distance_m} m is not usable; it must be a positive number of metres"
        ))),
        (None, None) => Err(Error::usage(
            "driving alone does not determine the height; give --height LENGTH, or --distance LENGTH as driven in the recording, or \
             --board BOARD for pictures of a board on the floor",
        )),
    }
}

/// The last pass, with the lens if it was found to differ, and by how much that is at the edge of
/// the image, pixels.
fn follow_until_converged(
    arguments: &GroundArguments,
    path: &str,
    mut camera: Camera,
    uncertainty: Option<&CameraUncertainty>,
    mut rig: Rig,
) -> Result<(CalibrationPass, Option<f64>)> {
    let mut pass = follow(arguments, path, &camera, uncertainty, rig, 1)?;
    let mut lens_off_px = None;
    for number in 0..MAX_PASSES {
        let off_rad = (pass.found.roll_rad - rig.roll_rad).hypot(pass.found.pitch_rad - rig.pitch_rad);
        if let Some(lens) = pass.lens.take().filter(|_| lens_off_px.is_none()) {
            lens_off_px = Some(lens.off_px);
            camera = lens.camera;
        } else if off_rad < AGAIN_DEG.to_radians() {
            break;
        }
        rig = Rig { roll_rad: pass.found.roll_rad, pitch_rad: pass.found.pitch_rad, ..rig };
        pass = follow(arguments, path, &camera, uncertainty, rig, number + 2)?;
    }
    Ok((pass, lens_off_px))
}

/// Number of further passes: then the lens is known, and the tilt has converged to a hundredth of
/// the tolerance.
const MAX_PASSES: usize = 3;

/// Tracks the whole recording and solves for its tilt.
fn follow(
    arguments: &GroundArguments,
    path: &str,
    camera: &Camera,
    uncertainty: Option<&CameraUncertainty>,
    rig: Rig,
    number: usize,
) -> Result<CalibrationPass> {
    let mut source = open_recording(path, &arguments.source_options())?;
    let mut odometry = Odometry::new(camera.clone(), rig, OdometryConfig::default())?;
    let mut driven = DrivenTilt::new(camera, DrivingConfig::default());
    let doing = format!("pass {number} of at most {}: ", MAX_PASSES + 1);
    let progress = console::progress(&doing, source.info().frame_count, arguments.quiet);
    let mut last = None;
    let (mut before, mut length_by_frames_m) = (None::<GroundPose>, 0.0);
    while let Some(frame) = source.next_frame()? {
        if interrupt::asked() {
            return Err(Error::usage("interrupted; nothing was written"));
        }
        if last.is_none() {
            last = Some(frame.rgb());
        }
        let estimate = odometry.process(frame.gray, frame.time_s)?;
        driven.watch(&estimate, &odometry);
        if let Some(pose) = estimate.estimate.map(|estimate| estimate.pose) {
            let from = before.replace(pose).unwrap_or(pose);
            length_by_frames_m += pose.distance_m(&from);
        }
        progress.inc(1);
    }
    progress.set_style(ProgressStyle::default_spinner());
    progress.set_message("solving for the tilt");
    let frame = last.ok_or_else(|| Error::input(format!("{path} has no frame in the chosen range")))?;
    let found = driven.solve(&rig, uncertainty).map_err(|error| error.at(path))?;
    let lens = driven.self_calibration(&rig, None).ok().and_then(|calibration| calibration.lens);
    let lens = lens.map(|(lens, _)| lens).filter(LensMeasurement::is_significant);
    progress.finish_and_clear();
    Ok(CalibrationPass { driven, found, lens, frame, warnings: source.take_warnings(), length_by_frames_m })
}

fn not_revealed(path: &str, worst: [f64; 2], deviation_rad: f64) -> String {
    let [roll, pitch] = worst.map(f64::abs);
    let which = if roll > 2.0 * pitch {
        "the roll"
    } else if pitch > 2.0 * roll {
        "the pitch"
    } else {
        "roll and pitch together"
    };
    format!(
        "{path}: the motion does not determine {which} (only to ± {:.1}°); drive at least 5 m over \
         well-textured flat floor, with turns to both sides",
        deviation_rad.to_degrees()
    )
}

/// The height from the length of the path, and its standard deviation.
///
/// The length of a path depends on its sampling: measured from frame to frame it contains the
/// vibration of the mount, along chords of a twentieth of the height it cuts the curves. The driven
/// distance lies between; the mean is used, with half of the difference as its standard deviation.
fn by_distance(path: &str, pass: &CalibrationPass, distance: Typed) -> Result<(f64, Option<f64>)> {
    let (by_chords, deviation) = pass.driven.path_length_m().ok_or_else(|| {
        Error::input(format!(
            "{path}: tracking was lost, so the length of the path is not known; give --height, or \
             --start and --end around a part without a break"
        ))
    })?;
    let between = (pass.length_by_frames_m - by_chords).max(0.0);
    let length = by_chords + 0.5 * between;
    if length < MIN_HEIGHTS {
        return Err(Error::input(format!(
            "{path}: the camera moved by only {length:.2} times its height; --distance needs at least \
             {MIN_HEIGHTS:.0} times"
        )));
    }
    let height_m = distance.metres / length;
    let relative =
        (deviation / length).hypot(0.5 * between / length).hypot(distance.rounding_m / distance.metres);
    Ok((height_m, Some(height_m * relative)))
}

/// Shortest path from which the height is estimated, in heights.
const MIN_HEIGHTS: f64 = 2.0;

fn summary(found: &TiltMeasurement) -> String {
    format!(
        "\n{} pairs of views from {} keyframes, rms {:.3} px\nfrom keyframe to keyframe, beyond the noise: roll {:.3}°, pitch {:.3}°\n",
        found.pairs,
        found.keyframes,
        found.rms_px,
        found.scatter_rad[0].to_degrees(),
        found.scatter_rad[1].to_degrees()
    )
}

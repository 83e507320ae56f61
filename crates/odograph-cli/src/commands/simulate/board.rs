//! `odograph simulate --board`: a recording of a calibration board with the exact camera file.

use super::output::{Picture, Recording, SimulationOutput};
use super::{FormatName, SimulateArguments, scene};
use crate::{Outcome, console};
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::formats::camera_file;
use odograph::formats::trajectory_file::write_tum;
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_calibration::Board;
use odograph_simulation::{BoardEffects, BoardRecording, BoardScene, Effects};
use serde::Serialize;

/// Default duration, seconds: what the guide asks of a person.
const DURATION_S: f64 = 30.0;

/// Options of a drive, which a board in front of a camera does not have.
pub const ONLY_FOR_DRIVES: [&str; 42] = [
    "texture",
    "photo_width",
    "tiling",
    "path",
    "length",
    "speed",
    "turn_rate",
    "turns",
    "lanes",
    "spacing",
    "relief",
    "undulation",
    "kerb",
    "ramp",
    "ride",
    "sway",
    "markers",
    "rolling",
    "height",
    "roll",
    "pitch",
    "yaw",
    "blur",
    "vibration",
    "shadow",
    "ground_shadow",
    "object",
    "height_change",
    "tilt_change",
    "lighting",
    "exposure_jumps",
    "blackout",
    "readout_ms",
    "tell_readout",
    "breathing",
    "bumper",
    "dirt",
    "lamp",
    "dropped",
    "jitter",
    "sensors",
    "color",
];

/// Everything as used, for `simulation.toml`.
#[derive(Serialize)]
struct Parameters {
    board: String,
    duration_s: f64,
    fps: f64,
    seed: u64,
    size_px: [usize; 2],
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<String>,
    noise_gray: f64,
    vignetting: f64,
}

/// A board and a camera, as frames.
struct RecordedBoard {
    recording: BoardRecording,
    fps: f64,
}

impl Recording for RecordedBoard {
    fn video_name(&self) -> &'static str {
        "board"
    }

    fn camera(&self) -> &Camera {
        self.recording.scene().camera()
    }

    fn fps(&self) -> f64 {
        self.fps
    }

    fn colored(&self) -> bool {
        false
    }

    fn times_s(&self) -> &[f64] {
        self.recording.times_s()
    }

    fn frame(&self, number: usize) -> Option<Picture> {
        Some(Picture { gray: self.recording.frame(number)?, color: None })
    }
}

/// Renders a board.
pub fn simulate(arguments: &SimulateArguments, board: &Board) -> Result<Outcome> {
    let camera = scene::camera(arguments)?;
    let effects =
        Effects { noise_gray: arguments.noise, vignetting: arguments.vignetting, ..Effects::default() }
            .validated()?;
    let parameters = Parameters {
        board: board.to_string(),
        duration_s: arguments.duration.unwrap_or(DURATION_S),
        fps: arguments.fps,
        seed: arguments.seed,
        size_px: [camera.width(), camera.height()],
        camera: arguments.camera.as_ref().map(|file| file.display().to_string()),
        noise_gray: effects.noise_gray,
        vignetting: effects.vignetting,
    };
    let effects = BoardEffects {
        vignetting: effects.vignetting,
        ..BoardEffects::camera_like(effects.noise_gray, arguments.seed)
    };
    let board_scene = BoardScene::new(board, &camera, arguments.seed);
    let recording =
        BoardRecording::new(board_scene, effects, arguments.fps, parameters.duration_s, arguments.seed)?;
    let recorded = RecordedBoard { recording, fps: arguments.fps };
    let format = arguments.format.unwrap_or(FormatName::Mjpeg);
    let output = SimulationOutput::prepared(arguments, format, recorded.times_s().len())?;
    output.write(&recorded, || {
        let poses = recorded.times_s().iter().map(|&time_s| StampedPose {
            time_s,
            world_from_camera: recorded.recording.camera_from_board(time_s).inverse(),
        });
        let parameters = toml::to_string(&parameters)
            .map_err(|error| Error::output(format!("the parameters cannot be written as TOML: {error}")))?;
        Ok(vec![
            ("truth.tum", write_tum(&Trajectory { poses: poses.collect() })),
            ("camera.yaml", camera_file::write(&camera)),
            ("simulation.toml", parameters),
        ])
    })?;
    if !arguments.quiet {
        let last_s = recorded.times_s().last().copied().unwrap_or(0.0);
        let video = output.folder().join(format.file_name(recorded.video_name()));
        console::print(&format!(
            "{}: {} frames, {last_s:.2} s of {board}; its camera.yaml is the true camera\n\
             Next: odograph calibrate {} --board {board}\n",
            console::name(output.folder()),
            recorded.times_s().len(),
            console::name(&video),
        ))?;
    }
    Ok(Outcome::Done)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Args;

    #[test]
    fn every_option_applies_to_a_board_or_is_refused_with_it() {
        let applies = [
            "output",
            "board",
            "duration",
            "camera",
            "size",
            "fps",
            "noise",
            "vignetting",
            "seed",
            "format",
            "force",
            "quiet",
            "threads",
        ];
        let refused = |id: &str| ONLY_FOR_DRIVES.contains(&id);
        let command = SimulateArguments::augment_args(clap::Command::new("simulate"));
        for argument in command.get_arguments() {
            let id = argument.get_id().as_str();
            assert!(applies.contains(&id) != refused(id), "{id}");
        }
    }
}

//! The program `odograph`: one video camera in, a metric trajectory and map out.

mod commands;
mod console;
mod files;
mod interrupt;
mod lengths;
mod report;

use clap::{Parser, Subcommand};
use odograph::error::{ErrorKind, Result};
use std::process::ExitCode;

/// One video camera in, a metric trajectory and map out.
#[derive(Parser)]
#[command(name = "odograph", version, about, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
#[allow(clippy::large_enum_variant)] // there is one of it
enum Command {
    Demo(commands::demo::DemoArguments),
    Run(commands::run::RunArguments),
    Live(commands::live::LiveArguments),
    View(commands::view::ViewArguments),
    Cameras(commands::cameras::CamerasArguments),
    Localize(commands::localize::LocalizeArguments),
    Simulate(commands::simulate::SimulateArguments),
    Evaluate(commands::evaluate::EvaluateArguments),
    Board(commands::board::BoardArguments),
    Undistort(commands::undistort::UndistortArguments),
    Calibrate(commands::calibrate::CalibrateArguments),
    Camera(commands::camera::CameraArguments),
    Ground(commands::ground::GroundArguments),
    Map(commands::map::MapArguments),
}

/// How a command that did not fail ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// All was done.
    Done,
    /// The camera's movement could not be measured for so much of the recording that the result is not what was asked for;
    /// what there is has been written.
    TrackingFailed,
    /// Ctrl-C or SIGTERM ended it before its end; what there is has been written.
    Interrupted,
    /// The camera was calibrated, but had better not be used; what there is has been written.
    NotToBeTrusted,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    interrupt::listen();
    let outcome: Result<Outcome> = match arguments.command {
        Command::Demo(arguments) => commands::demo::demo(arguments),
        Command::Run(arguments) => commands::run::run(arguments),
        Command::Live(arguments) => commands::live::live(arguments),
        Command::View(arguments) => commands::view::view(arguments),
        Command::Cameras(arguments) => commands::cameras::cameras(arguments),
        Command::Localize(arguments) => commands::localize::localize(arguments),
        Command::Simulate(arguments) => commands::simulate::simulate(arguments),
        Command::Evaluate(arguments) => commands::evaluate::evaluate(arguments),
        Command::Board(arguments) => commands::board::board(arguments),
        Command::Undistort(arguments) => commands::undistort::undistort(arguments),
        Command::Calibrate(arguments) => commands::calibrate::calibrate(arguments),
        Command::Camera(arguments) => commands::camera::camera(arguments),
        Command::Ground(arguments) => commands::ground::ground(arguments),
        Command::Map(arguments) => commands::map::map(arguments),
    };
    match outcome {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::TrackingFailed | Outcome::NotToBeTrusted) => ExitCode::from(4),
        Ok(Outcome::Interrupted) => ExitCode::from(interrupt::EXIT_CODE),
        Err(error) => {
            console::error(&error.to_string());
            ExitCode::from(match error.kind() {
                _ if interrupt::asked() => interrupt::EXIT_CODE,
                ErrorKind::Usage => 2,
                _ => 3,
            })
        }
    }
}

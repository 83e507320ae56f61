//! The program `odograph`: one video camera in, a metric trajectory and map out.

mod address;
mod browser;
mod commands;
mod console;
mod files;
mod interrupt;
mod lengths;
mod named_outputs;
mod numbered_pictures;
mod negative_values;
mod profiles;
mod qr_code;
mod tips;
mod wrong_number;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use odograph::error::{ErrorKind, Result};
use odograph_report as report;
use odograph_session::RunEnd;
use std::io::{self, Write};
use std::process::ExitCode;

/// One video camera in, a metric trajectory and map out.
#[derive(Parser)]
#[command(name = "odograph", version, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
#[allow(clippy::large_enum_variant)] // there is one of it
enum Command {
    Demo(commands::demo::DemoArguments),
    Run(commands::run::RunArguments),
    Info(commands::info::InfoArguments),
    Doctor(commands::doctor::DoctorArguments),
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
    Site(commands::site::SiteArguments),
    Profile(commands::profile::ProfileArguments),
    Completions(commands::completions::CompletionsArguments),
}

/// The commands as the first help shows them: grouped by purpose.
const GROUPS: [(&str, &[&str]); 5] = [
    ("Follow a camera", &["demo", "info", "doctor", "run", "live", "view"]),
    ("Use maps", &["localize", "map", "site"]),
    ("Set up a camera", &["board", "calibrate", "ground", "camera", "cameras", "profile"]),
    ("Try and judge", &["simulate", "evaluate", "undistort"]),
    ("More", &["completions"]),
];

/// Narrowest terminal that help is wrapped for. Terminals without a size say 0.
const MIN_COLUMNS: usize = 20;

/// The width that help is wrapped at, where the environment states an impossible one.
fn width() -> Option<usize> {
    let stated: usize = std::env::var("COLUMNS").ok()?.parse().ok()?;
    (stated < MIN_COLUMNS).then_some(100)
}

/// The program's command with its commands grouped in the help.
fn command() -> clap::Command {
    let command = named_outputs::required(negative_values::allowed(Arguments::command()));
    let command = width().into_iter().fold(command, clap::Command::term_width);
    let mut groups = String::new();
    for (heading, names) in GROUPS {
        groups.push_str(&format!("{heading}:\n"));
        for inner in names.iter().filter_map(|name| command.find_subcommand(name)) {
            let about = inner.get_about().map(ToString::to_string).unwrap_or_default();
            groups.push_str(&format!("  {:<12} {about}\n", inner.get_name()));
        }
        groups.push('\n');
    }
    groups
        .push_str("`odograph COMMAND -h` lists a command's options on one line each, --help explains them.");
    command.help_template("{about}\n\n{usage-heading} {usage}{after-help}\n\n{options}\n").after_help(groups)
}

/// The outcome of a command that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Completed.
    Done,
    /// Tracking failed in most of the recording; the partial results have been written.
    TrackingFailed,
    /// Interrupted by Ctrl-C or SIGTERM; the partial results have been written.
    Interrupted,
    /// The calibration is not good enough to be used; the results have been written.
    NotToBeTrusted,
}

impl From<RunEnd> for Outcome {
    fn from(end: RunEnd) -> Self {
        match end {
            RunEnd::Completed => Self::Done,
            RunEnd::Interrupted => Self::Interrupted,
            RunEnd::TrackingFailed => Self::TrackingFailed,
        }
    }
}

fn main() -> ExitCode {
    let typed = negative_values::joined(std::env::args_os());
    let matches = match tips::one_hyphen(&command(), &typed) {
        Some(error) => Err(error),
        None => command().try_get_matches_from(&typed),
    };
    let arguments = match matches.and_then(|matches| Arguments::from_arg_matches(&matches)) {
        Ok(arguments) => arguments,
        Err(error) => {
            let error = wrong_number::in_words(error);
            return instead_of_arguments(&tips::with_tip(error, &command(), &typed));
        }
    };
    interrupt::listen();
    interrupt::outlive_file_size_limit();
    let outcome: Result<Outcome> = match arguments.command {
        Command::Demo(arguments) => commands::demo::demo(arguments),
        Command::Run(arguments) => commands::run::run(arguments),
        Command::Info(arguments) => commands::info::info(arguments),
        Command::Doctor(arguments) => commands::doctor::doctor(arguments),
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
        Command::Site(arguments) => commands::site::site(arguments),
        Command::Profile(arguments) => commands::profile::profile(arguments),
        Command::Completions(arguments) => commands::completions::completions(arguments),
    };
    match outcome {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::TrackingFailed | Outcome::NotToBeTrusted) => ExitCode::from(4),
        Ok(Outcome::Interrupted) => ExitCode::from(interrupt::EXIT_CODE),
        Err(error) => {
            console::failure("", &error);
            ExitCode::from(match error.kind() {
                _ if interrupt::asked() => interrupt::EXIT_CODE,
                ErrorKind::Usage => 2,
                _ => 3,
            })
        }
    }
}

/// Prints the help, the version, or what is wrong with the arguments.
fn instead_of_arguments(found: &clap::Error) -> ExitCode {
    let printed = found.print().and_then(|()| io::stdout().flush());
    match console::written(printed) {
        Err(error) if !found.use_stderr() => {
            console::failure("", &error);
            ExitCode::from(3)
        }
        _ => ExitCode::from(u8::try_from(found.exit_code()).unwrap_or(2)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_help_shows_every_command_in_a_line() {
        let help = command().render_help().to_string();
        for inner in Arguments::command().get_subcommands() {
            let name = inner.get_name();
            let line = help.lines().find(|line| line.trim_start().starts_with(&format!("{name} ")));
            assert!(line.is_some_and(|line| line.chars().count() <= 80), "{name}: {line:?}");
        }
    }

    #[test]
    fn examples_in_the_help_are_not_wrapped() {
        fn check(command: &clap::Command) {
            let after = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let wrapped = after.lines().find(|line| line.chars().count() > 100);
            assert!(wrapped.is_none_or(|line| !line.starts_with("  ")), "{wrapped:?}");
            command.get_subcommands().for_each(check);
        }
        check(&Arguments::command());
    }

    #[test]
    fn every_option_begins_with_one_short_line() {
        fn check(command: &clap::Command, name: &str) {
            for argument in command.get_arguments().filter(|argument| !argument.is_hide_set()) {
                let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
                let id = argument.get_id();
                assert!(!help.is_empty(), "{name} {id} has no help");
                assert!(help.chars().count() <= 100, "{name} {id}: {help}");
            }
            for inner in command.get_subcommands() {
                check(inner, &format!("{name} {}", inner.get_name()));
            }
        }
        check(&Arguments::command(), "odograph");
    }
}

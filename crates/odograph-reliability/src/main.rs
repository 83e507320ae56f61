//! Kills the program at random moments and checks what it leaves behind.
//!
//! `cargo run --release -p odograph-reliability -- --kills 300 --json bench/kills.json` starts each
//! command that writes a map or the folder of a run, ends it at a random moment by SIGKILL, SIGTERM
//! or SIGINT, and checks after each that no map is damaged, that nothing that was on disk before is
//! lost, that no file is half-written under its final name, and that the command can be run again.
//! It exits with 1 if any check fails, and keeps the folder of the failure.

#![allow(clippy::print_stdout, clippy::print_stderr)] // prints a report

mod figures;
mod leftovers;
mod moment;
mod program;
mod trial;
mod victims;

use clap::Parser;
use figures::KillFigures;
use moment::Moments;
use odograph::error::{Error, Result};
use program::Program;
use std::path::PathBuf;
use std::process::ExitCode;
use trial::Trial;

/// Kills the program at random moments and checks what it leaves behind.
#[derive(Debug, Parser)]
#[command(name = "kills", version)]
struct KillArguments {
    /// Only commands whose name contains one of these words.
    words: Vec<String>,
    /// Number of kills of each command.
    #[arg(long, default_value_t = 20)]
    kills: u64,
    /// Seed of the moments and signals. The moments are shares of the measured duration of a
    /// command, so that the same seed hits other instructions on another machine.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The program; by default `odograph` beside this one.
    #[arg(long)]
    program: Option<PathBuf>,
    /// Folder for the runs; one in memory makes them faster.
    #[arg(long)]
    folder: Option<PathBuf>,
    /// Writes the figures to this file.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    match run(&KillArguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("kills: {error}");
            ExitCode::from(2)
        }
    }
}

/// Kills every command; whether no check failed.
fn run(arguments: &KillArguments) -> Result<bool> {
    let program = Program::new(arguments.program.clone())?;
    let folder = match &arguments.folder {
        Some(folder) => tempfile::tempdir_in(folder),
        None => tempfile::tempdir(),
    };
    let mut folder = folder.map_err(|error| Error::output(format!("no folder can be made: {error}")))?;
    let inputs = victims::Inputs::prepare(&program, folder.path())?;
    let mut figures = KillFigures::new(arguments.seed);
    for victim in victims::victims() {
        let asked = |word: &String| victim.name.contains(word.as_str());
        if !arguments.words.is_empty() && !arguments.words.iter().any(asked) {
            continue;
        }
        let duration = trial::duration(&victim, &program, &inputs)?;
        let mut moments = Moments::new(arguments.seed, victim.name, duration);
        for number in 0..arguments.kills {
            let trial = Trial::new(&victim, &program, &inputs, moments.next());
            let report = trial.run()?;
            for failure in &report.failures {
                eprintln!("{}, number {number}: {failure}", victim.name);
            }
            let failed = !report.failures.is_empty();
            figures.add(victim.name, report);
            if failed {
                folder.disable_cleanup(true);
                eprintln!("kept: {}", trial.folder().display());
                trial.keep(number)?;
            }
        }
        if let Some(line) = figures.line(victim.name) {
            println!("{line}");
        }
        // After each command: hours of kills are not lost with the last one.
        if let Some(path) = &arguments.json {
            figures.write(path)?;
        }
    }
    Ok(figures.is_clean())
}

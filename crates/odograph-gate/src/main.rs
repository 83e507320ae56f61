//! The regression gate: measures a fixed set of recordings and compares the results with a stored
//! baseline.
//!
//! `cargo run --release -p odograph-gate [-- WORD…]` renders drives with exact ground truth, tracks
//! them and the real recordings in the same way as `odograph run`, and exits with 1 if a result is
//! worse than in `bench/baseline.json` by more than its tolerance (`figures.rs`). The recordings
//! are defined in `rows.rs`.

#![allow(clippy::print_stdout, clippy::print_stderr)] // prints a report

mod alterations;
mod arguments;
mod baseline;
mod clip;
mod compression;
mod export;
mod field;
mod figures;
mod following;
mod measuring;
mod processor;
mod recordings;
mod rendering;
mod report;
mod rows;
mod tables;

use arguments::GateArguments;
use baseline::{Baseline, Comparison, GateResults};
use clap::Parser;
use odograph::error::Result;
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments = GateArguments::parse();
    match run(&arguments) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("gate: {error}");
            ExitCode::from(2)
        }
    }
}

/// Runs the gate; whether it is passed.
fn run(arguments: &GateArguments) -> Result<bool> {
    if arguments.tables {
        return tables::rewrite(&arguments.baseline).map(|()| true);
    }
    if let Some(folder) = &arguments.export {
        return export::export(arguments, folder).map(|()| true);
    }
    let baseline = Baseline::read_or_empty(&arguments.baseline)?;
    let mut measured = measuring::measure(arguments);
    let comparison = compared(arguments, &baseline, &mut measured);
    println!("{}", report::table(&measured));
    if let Some(path) = &arguments.json {
        measured.write(path)?;
    }
    if arguments.update_baseline {
        baseline.updated(&measured).write(&arguments.baseline)?;
        println!("{} rows written to {}", measured.rows.len(), arguments.baseline.display());
        return Ok(measured.failed.is_empty());
    }
    println!("{}", report::comparison(&comparison, &measured));
    Ok(comparison.is_passed() && measured.failed.is_empty())
}

/// Compares with the baseline. Rows that are only slower are measured up to twice again.
fn compared(arguments: &GateArguments, baseline: &Baseline, measured: &mut GateResults) -> Comparison {
    let mut comparison = Comparison::new(baseline, measured);
    for _ in 0..2 {
        let slower = comparison.only_slower();
        if slower.is_empty() || arguments.update_baseline {
            break;
        }
        println!("only slower, measured again: {}", slower.join(", "));
        measuring::measure_times_again(arguments, measured, &slower);
        comparison = Comparison::new(baseline, measured);
    }
    comparison
}

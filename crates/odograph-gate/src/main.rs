//! The gate: measures a fixed set of recordings and compares the figures with a stored baseline.
//!
//! `cargo run --release -p odograph-gate [-- WORD…]` renders drives with exact truth, follows them
//! and the real recordings as `odograph run` would, and exits with 1 where a figure is worse than
//! in `bench/baseline.json` by more than its tolerance (`figures.rs`). The recordings are in
//! `rows.rs`.

#![allow(clippy::print_stdout, clippy::print_stderr)] // a program that reports

mod arguments;
mod baseline;
mod clip;
mod compression;
mod export;
mod figures;
mod following;
mod measuring;
mod processor;
mod recordings;
mod report;
mod rows;
mod tables;

use arguments::Arguments;
use baseline::{Baseline, Comparison};
use clap::Parser;
use odograph::error::Result;
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("gate: {error}");
            ExitCode::from(2)
        }
    }
}

/// Whether the gate is passed.
fn run(arguments: &Arguments) -> Result<bool> {
    if arguments.tables {
        return tables::rewrite(&arguments.baseline).map(|()| true);
    }
    if let Some(folder) = &arguments.export {
        return export::export(arguments, folder).map(|()| true);
    }
    let measured = measuring::measure(arguments);
    println!("{}", report::table(&measured));
    if let Some(path) = &arguments.json {
        measured.write(path)?;
    }
    if arguments.update_baseline {
        Baseline::read_or_empty(&arguments.baseline)?.updated(&measured).write(&arguments.baseline)?;
        println!("{} rows written to {}", measured.rows.len(), arguments.baseline.display());
        return Ok(measured.failed.is_empty());
    }
    let comparison = Comparison::new(&Baseline::read_or_empty(&arguments.baseline)?, &measured);
    println!("{}", report::comparison(&comparison, &measured));
    Ok(comparison.is_passed() && measured.failed.is_empty())
}

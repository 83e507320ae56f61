//! `odograph run` on unsuitable input: one sentence, the right exit code, no panic, no partial
//! files.

#![allow(clippy::unwrap_used)] // a test fails by panicking

#[path = "hostile/commands.rs"]
mod commands;
#[path = "hostile/inputs.rs"]
mod inputs;
#[path = "hostile/interruptions.rs"]
mod interruptions;
#[path = "hostile/outputs.rs"]
mod outputs;
#[path = "hostile/plans.rs"]
mod plans;
#[path = "hostile/recording.rs"]
mod recording;
#[path = "hostile/run_folder.rs"]
mod run_folder;

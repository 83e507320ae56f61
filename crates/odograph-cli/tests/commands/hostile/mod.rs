//! `odograph run` on unsuitable input: one sentence, the right exit code, no panic, no partial
//! files.

mod commands;
mod inputs;
mod interruptions;
mod mistaken;
#[cfg(target_os = "linux")]
mod output_options;
mod outputs;
mod plans;
pub mod recording;
pub mod run_folder;
#[cfg(target_os = "linux")]
mod temporary_files;

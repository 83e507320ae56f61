//! `odograph simulate`.

use crate::Outcome;
use odograph::error::Result;

/// TODO one line for the help.
#[derive(clap::Args)]
pub struct SimulateArguments {}

/// Runs the command.
pub fn simulate(_arguments: SimulateArguments) -> Result<Outcome> {
    Ok(Outcome::Done)
}

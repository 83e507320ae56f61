//! `odograph evaluate`.

use crate::Outcome;
use odograph::error::Result;

/// TODO one line for the help.
#[derive(clap::Args)]
pub struct EvaluateArguments {}

/// Runs the command.
pub fn evaluate(_arguments: EvaluateArguments) -> Result<Outcome> {
    Ok(Outcome::Done)
}

//! `odograph site token`: tokens of robots, made and revoked on the machine of the site.

use crate::{Outcome, console, files};
use odograph::error::Result;
use odograph_site::RobotTokens;
use serde_json::json;
use std::fmt::Write;
use std::path::PathBuf;

/// Make, list and revoke tokens of robots.
///
/// A robot with a token of its own is the only one that can send as that robot. A running site
/// heeds every change at once.
#[derive(Debug, clap::Args)]
pub struct TokenArguments {
    #[command(subcommand)]
    command: TokenCommand,
}

#[derive(Debug, clap::Subcommand)]
enum TokenCommand {
    Add(AddArguments),
    List(ListArguments),
    Revoke(RevokeArguments),
}

/// Make a token for a robot, and print it.
///
/// It is not shown again: the site keeps only its hash. Give it to the robot in a file, with
/// `--site-token FILE` of `live`, `run` and `site send`.
#[derive(Debug, clap::Args)]
#[command(after_help = ADD_EXAMPLES)]
struct AddArguments {
    /// The folder of the site.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    /// Name of the robot.
    #[arg(value_name = "ROBOT")]
    robot: String,
    /// Write the token to a file that only you can read, instead of printing it.
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
}

const ADD_EXAMPLES: &str = "\
Example:
  odograph site token add hall/ cart-7 -o cart-7.token";

/// List the robots that have a token, and those whose token is revoked.
#[derive(Debug, clap::Args)]
struct ListArguments {
    /// The folder of the site.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Revoke the token of a robot.
///
/// What the robot has sent stays in the map; `odograph site withdraw` takes it out.
#[derive(Debug, clap::Args)]
struct RevokeArguments {
    /// The folder of the site.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    /// Name of the robot.
    #[arg(value_name = "ROBOT")]
    robot: String,
}

/// Runs the command.
pub fn token(arguments: TokenArguments) -> Result<Outcome> {
    match arguments.command {
        TokenCommand::Add(arguments) => add(&arguments)?,
        TokenCommand::List(arguments) => {
            let robots = RobotTokens::in_folder(&arguments.folder).list()?;
            let mut text = String::new();
            for of in &robots {
                let state = if of.is_revoked { "revoked" } else { "valid" };
                let _ = writeln!(text, "{:<16} {state}", of.robot);
            }
            if arguments.json {
                let robot =
                    |of: &odograph_site::TokenOfRobot| json!({ "robot": of.robot, "revoked": of.is_revoked });
                text = format!("{:#}\n", json!({ "robots": robots.iter().map(robot).collect::<Vec<_>>() }));
            }
            console::print(&text)?;
        }
        TokenCommand::Revoke(arguments) => {
            RobotTokens::in_folder(&arguments.folder).revoke(&arguments.robot)?;
            console::print(&format!(
                "the token of {} is revoked; what it has sent stays, odograph site withdraw takes it out of the map\n",
                console::name(&arguments.robot)
            ))?;
        }
    }
    Ok(Outcome::Done)
}

fn add(arguments: &AddArguments) -> Result<()> {
    let tokens = RobotTokens::in_folder(&arguments.folder);
    let Some(out) = &arguments.out else {
        return console::print(&format!("{}\n", tokens.add(&arguments.robot)?));
    };
    // Nothing is made for a file that cannot be written.
    files::check_output_file(out, false)?;
    files::check_writable(out, 0)?;
    let token = tokens.add(&arguments.robot)?;
    files::write_private(out, format!("{token}\n").as_bytes()).inspect_err(|_| {
        // Nobody has it.
        let _ = tokens.revoke(&arguments.robot);
    })?;
    console::note(&format!(
        "the token of {} is in {}; give it to that robot alone, with --site-token",
        console::name(&arguments.robot),
        out.display()
    ));
    Ok(())
}

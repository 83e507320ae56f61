//! `odograph profile`: keeps a camera and its mount under a name.

use super::run::{CameraSetup, FieldOfView};
use crate::profiles::{self, Profile};
use crate::{Outcome, console, files};
use odograph::error::{Error, Result};
use std::fmt::Write;
use std::fs;
use std::path::PathBuf;

/// Keep a camera and its mount under a name, for --profile.
///
/// Profiles lie in the folder odograph/profiles of XDG_CONFIG_HOME, or of ~/.config. They name the
/// files by their absolute paths; the files themselves stay where they are.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct ProfileArguments {
    #[command(subcommand)]
    command: ProfileCommand,
}

const EXAMPLES: &str = "\
Examples:
  odograph profile save cart --camera camera.yaml --rig rig.toml
  odograph run drive.mp4 --profile cart
  odograph profile list";

#[derive(Debug, clap::Subcommand)]
enum ProfileCommand {
    Save(SaveArguments),
    /// List the profiles, one on a line.
    List,
    /// Show what a profile keeps, and its file.
    Show(NamedProfile),
    /// Remove a profile; the files that it names stay.
    Remove(NamedProfile),
}

/// Save a camera and its mount under a name.
#[derive(Debug, clap::Args)]
struct SaveArguments {
    /// Name of the profile.
    #[arg(value_name = "NAME")]
    name: String,
    #[command(flatten)]
    setup: CameraSetup,
    /// Replace a profile of this name.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, clap::Args)]
struct NamedProfile {
    /// Name of the profile.
    #[arg(value_name = "NAME")]
    name: String,
}

/// Runs the command.
pub fn profile(arguments: ProfileArguments) -> Result<Outcome> {
    match arguments.command {
        ProfileCommand::Save(arguments) => save(arguments)?,
        ProfileCommand::List => list()?,
        ProfileCommand::Show(NamedProfile { name }) => {
            let profile = profiles::read_unchecked(&name)?;
            let (path, text) = (profiles::file(&name)?, profiles::text(&profile)?);
            console::print(&format!("# {}\n{text}", console::name(path)))?;
        }
        ProfileCommand::Remove(NamedProfile { name }) => {
            profiles::read_unchecked(&name)?;
            let path = profiles::file(&name)?;
            fs::remove_file(&path)
                .map_err(|error| Error::output(format!("{} cannot be removed: {error}", path.display())))?;
        }
    }
    Ok(Outcome::Done)
}

fn save(SaveArguments { name, setup, force }: SaveArguments) -> Result<()> {
    let path = profiles::file(&name)?;
    if path.exists() && !force {
        return Err(Error::usage(format!("the profile {name} is already there; --force replaces it")));
    }
    setup.question(false);
    let profile = checked(setup)?;
    if profile == Profile::default() {
        return Err(Error::usage(
            "there is nothing to save; give --camera FILE and --height LENGTH or --rig FILE",
        ));
    }
    let text = profiles::text(&profile)?;
    let _made = files::MadeFolders::of_file(&path)?;
    files::write(&path, text.as_bytes())?;
    console::note(&format!("the profile {name} is in {}", path.display()));
    Ok(())
}

/// Size for a camera file that states none; a run takes that of its recording.
const SIZE_OF_RECORDING: (usize, usize) = (4096, 4096);

/// The profile of a setup whose files can be read.
fn checked(setup: CameraSetup) -> Result<Profile> {
    if let Some(path) = &setup.camera {
        odograph_session::parse_camera(path, &files::read_text(path)?, SIZE_OF_RECORDING)?;
    }
    if let Some(path) = &setup.rig {
        odograph_session::read_rig(path, &())?;
    }
    if let Some(path) = setup.mask.as_ref().filter(|path| !path.is_file()) {
        return Err(Error::input(format!("{} is no file", path.display())));
    }
    if let Some(height) = &setup.height {
        odograph::camera::Rig::level(height.metres).validated()?;
    }
    let absolute = |path: Option<PathBuf>| path.as_deref().map(profiles::absolute).transpose();
    Ok(Profile {
        camera: absolute(setup.camera)?,
        field_of_view_m: setup.field_of_view.map(|field: FieldOfView| (field.width_m, field.height_m)),
        rig: absolute(setup.rig)?,
        height_m: setup.height.map(|height| height.metres),
        readout_ms: setup.readout_ms,
        mask: absolute(setup.mask)?,
    })
}

fn list() -> Result<()> {
    let mut text = String::new();
    let names = profiles::names()?;
    for name in &names {
        // A damaged profile is listed, too.
        let description =
            profiles::read_unchecked(name).map_or_else(|_| "damaged".to_owned(), |one| summary(&one));
        let _ = writeln!(text, "{name}  {description}");
    }
    if names.is_empty() {
        console::note("there are no profiles; odograph profile save makes one");
    }
    console::print(&text)
}

/// A profile in a line.
fn summary(profile: &Profile) -> String {
    let Profile { camera, field_of_view_m, rig, height_m, readout_ms, mask } = profile;
    let file = |what: &str, path: &Option<PathBuf>| Some(format!("{what} {}", console::name(path.as_ref()?)));
    let parts = [
        file("camera", camera),
        field_of_view_m.map(|(width_m, height_m)| format!("field of view {width_m} m x {height_m} m")),
        file("rig", rig),
        height_m.map(|height_m| format!("height {height_m} m")),
        readout_ms.map(|readout_ms| format!("readout {readout_ms} ms")),
        file("mask", mask),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

//! `odograph map repair`: saves what can be read of a damaged map.

use super::mosaic;
use crate::{Outcome, console, files, interrupt};
use odograph::error::{Error, Result};
use odograph_map::{MapClaim, MapFile, Repair};
use std::fs;
use std::path::{Path, PathBuf};

/// Save what can be read of a damaged map, as a new map.
///
/// The damaged map is not changed. Keyframes without a valid pose or image are left out, and the
/// mosaic is rendered again.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct RepairArguments {
    /// The damaged map.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    /// The repaired map.
    ///
    /// [default: beside the damaged one: hall-repaired.gpkg for hall.gpkg]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite the repaired map if it exists.
    #[arg(long, requires = "output")]
    force: bool,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map repair hall.gpkg
  odograph map repair hall.gpkg -o hall-again.gpkg";

/// Runs the command.
pub fn repair(arguments: &RepairArguments) -> Result<Outcome> {
    let damaged = arguments.map.as_path();
    if arguments.output.is_none() && is_sound(damaged) {
        if !arguments.quiet {
            console::print(&format!("{}: no damage found; nothing was written\n", console::name(damaged)))?;
        }
        return Ok(Outcome::Done);
    }
    let output = match &arguments.output {
        Some(output) => output.clone(),
        None => files::free_beside(&damaged.to_string_lossy(), "-repaired.gpkg"),
    };
    files::check_output_file(&output, arguments.force)?;
    if fs::canonicalize(&output).is_ok_and(|output| fs::canonicalize(damaged).is_ok_and(|map| map == output))
    {
        return Err(Error::usage("the repaired map needs another name than the damaged one"));
    }
    let _made = files::MadeFolders::of_file(&output)?;
    let claim = MapClaim::on(&output)?;
    // An existing file is unchanged after a failure, and no partial map is left.
    let beside = files::beside(&output);
    MapFile::remove(&beside)?;
    let saved = saved(damaged, &beside, arguments.quiet).inspect_err(|_| {
        let _ = MapFile::remove(&beside);
    })?;
    MapFile::replace(&claim, &beside)?;
    if !arguments.quiet {
        let Repair { keyframes, keyframes_lost, edges, frames, .. } = saved;
        console::print(&format!(
            "{keyframes} keyframes saved, {keyframes_lost} known to be lost; {edges} edges, {frames} frames of paths\n{}\n",
            console::name(&output)
        ))?;
    }
    Ok(Outcome::Done)
}

/// Whether a map can be read and continued as it is.
fn is_sound(path: &Path) -> bool {
    MapFile::open(path).and_then(|mut file| file.check()).is_ok()
}

fn saved(damaged: &Path, to: &Path, quiet: bool) -> Result<Repair> {
    let saved = odograph_map::repair(damaged, to, &mut || !interrupt::asked())?;
    if let Some(resolution_m) = saved.mosaic {
        let mut file = MapFile::open(to)?;
        mosaic::rendered(&mut file, resolution_m, quiet)?;
        file.close()?;
    }
    Ok(saved)
}

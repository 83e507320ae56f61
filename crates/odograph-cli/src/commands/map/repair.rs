//! `odograph map repair`: saves what can be read of a damaged map.

use super::info::{pieces, stale};
use super::mosaic;
use crate::{Outcome, console, files, interrupt};
use odograph::error::{Error, Result};
use odograph_map::{MapClaim, MapFile, Repair, UnfinishedSession};
use std::fs;
use std::path::{Path, PathBuf};

/// Save what can be read of a damaged map, as a new map.
///
/// The damaged map is not changed. Keyframes without a valid pose or image are left out, and the
/// mosaic is rendered again. What a killed run has left in a map is no damage: --drop-unfinished
/// saves the map without it.
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
    /// Save a map without damage, without the sessions whose runs were killed.
    #[arg(long)]
    drop_unfinished: bool,
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
  odograph map repair hall.gpkg -o hall-again.gpkg
  odograph map repair hall.gpkg --drop-unfinished";

/// Runs the command.
pub fn repair(arguments: &RepairArguments) -> Result<Outcome> {
    let damaged = arguments.map.as_path();
    if MapClaim::is_held(damaged) {
        return Err(Error::input(format!(
            "{} is being written by another program; wait until that has ended",
            damaged.display()
        )));
    }
    let is_sound = (arguments.drop_unfinished || arguments.output.is_none()) && is_sound(damaged);
    let (mut unfinished, mut shift_m) = (Vec::new(), None);
    if is_sound {
        let file = MapFile::open_read_only(damaged)?;
        (unfinished, shift_m) = (file.unfinished_sessions()?, file.mosaic_shift_m()?);
    }
    if arguments.drop_unfinished && !is_sound {
        return Err(Error::input(format!(
            "{} is damaged; repair it first without --drop-unfinished",
            damaged.display()
        )));
    }
    if is_sound && (!arguments.drop_unfinished || unfinished.is_empty()) {
        if !arguments.quiet {
            console::print(&nothing_written(damaged, &unfinished, arguments.drop_unfinished))?;
            if let Some(shift_m) = shift_m {
                console::print(&format!("its mosaic is {}\n", stale(shift_m, damaged)))?;
            }
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
    let claim = MapClaim::on(&output).map_err(|error| elsewhere(error, arguments.output.is_none()))?;
    let said = super::replaced(&claim, &output, |beside| match arguments.drop_unfinished {
        true => without(damaged, &unfinished, beside),
        false => saved(damaged, beside, arguments.quiet),
    })?;
    if !arguments.quiet {
        console::print(&format!("{said}\n{}\n", console::name(&output)))?;
    }
    Ok(Outcome::Done)
}

/// Says that a map needs no repair, and what killed runs have left in it.
fn nothing_written(map: &Path, unfinished: &[UnfinishedSession], drops: bool) -> String {
    let shown = console::name(map);
    let found = if drops { "every session ended" } else { "no damage found" };
    let left = |UnfinishedSession { id, source, keyframes }: &UnfinishedSession| {
        format!(
            "session {id} ({}) did not end: its keyframes, {keyframes}, are sound and used; --drop-unfinished saves the \
             map without them\n",
            console::name(source)
        )
    };
    let left: String = unfinished.iter().map(left).collect();
    format!("{shown}: {found}; nothing was written\n{left}")
}

/// Saves a map without these sessions; returns what was left out.
fn without(map: &Path, sessions: &[UnfinishedSession], to: &Path) -> Result<String> {
    MapFile::open_read_only(map)?.copy_to(to)?;
    let mut file = MapFile::open(to)?;
    for session in sessions {
        file.remove_session(session.id)?;
    }
    let left = file.map()?;
    file.compact()?;
    file.close()?;
    let dropped: u64 = sessions.iter().map(|session| session.keyframes).sum();
    let pieces = match pieces(&left) {
        ..=1 => String::new(),
        pieces => format!(" in {pieces} pieces"),
    };
    let sessions = if sessions.len() == 1 { "a session" } else { "sessions" };
    Ok(format!(
        "{} keyframes saved{pieces}; {dropped} of {sessions} that did not end left out",
        left.keyframes.len()
    ))
}

/// Whether a map can be read and continued as it is; where nobody may write, whether it can be
/// read.
fn is_sound(path: &Path) -> bool {
    let opened = MapClaim::while_reading(path).and_then(|claim| match claim {
        Some(claim) => MapFile::open_claimed(claim),
        None => MapFile::open_read_only(path),
    });
    opened.and_then(|mut file| file.check()).is_ok()
}

/// The error of a repaired map that cannot be written where no option names its place.
fn elsewhere(error: Error, is_default: bool) -> Error {
    let sentence = error.to_string();
    match sentence.rsplit_once("; ") {
        Some((what, _)) if is_default => {
            Error::output(format!("{what}; give a place where you may write with -o FILE"))
        }
        _ => error,
    }
}

/// Saves what can be read of a damaged map; returns what was saved.
fn saved(damaged: &Path, to: &Path, quiet: bool) -> Result<String> {
    let saved = odograph_map::repair(damaged, to, &mut || !interrupt::asked())?;
    if let Some(resolution_m) = saved.mosaic {
        let mut file = MapFile::open(to)?;
        mosaic::rendered(&mut file, resolution_m, quiet)?;
        file.close()?;
    }
    let Repair { keyframes, keyframes_lost, edges, frames, .. } = saved;
    Ok(format!(
        "{keyframes} keyframes saved, {keyframes_lost} known to be lost; {edges} edges, {frames} frames of paths"
    ))
}

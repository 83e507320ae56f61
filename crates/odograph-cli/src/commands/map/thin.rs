//! `odograph map thin`: a map of bounded size.

use crate::{Outcome, console};
use odograph::error::{Error, Result};
use odograph_map::MapFile;
use std::path::{Path, PathBuf};

/// Remove redundant keyframes from a map.
///
/// Those whose ground others show too. Their edges are merged, so that the map stays connected.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct ThinArguments {
    /// The map; it is changed.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    /// How large the file may be, as 200MB, 1.5GB or 800kB.
    #[arg(long, value_name = "SIZE", value_parser = size, required_unless_present = "max_keyframes")]
    max_size: Option<u64>,
    /// How many keyframes there may be, one at least.
    #[arg(long, value_name = "N", conflicts_with = "max_size",
          value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..))]
    max_keyframes: Option<usize>,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map thin drive/map.gpkg --max-size 200MB
  odograph map thin drive/map.gpkg --max-keyframes 2000";

fn size(text: &str) -> std::result::Result<u64, String> {
    let digits = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let factor = match text[digits..].trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        _ => 0.0,
    };
    let size = text[..digits].parse().map_or(0.0, |number: f64| number * factor);
    if (1.0..1e15).contains(&size) {
        Ok(size as u64)
    } else {
        Err("give a size as 200MB, 1.5GB or 800kB".to_owned())
    }
}

/// Runs the command.
pub fn thin(arguments: &ThinArguments) -> Result<Outcome> {
    let mut file = MapFile::open(&arguments.map)?;
    let (before, _) = file.image_bytes()?;
    let ground_kept = match (arguments.max_keyframes, arguments.max_size) {
        (Some(most), _) => {
            let thinning = file.thin(most)?;
            file.compact()?;
            thinning.ground_kept
        }
        (None, Some(most)) => thin_to_size(&mut file, most)?,
        (None, None) => 1.0,
    };
    let (kept, _) = file.image_bytes()?;
    file.close()?;
    if !arguments.quiet {
        console::print(&format!(
            "{kept} of {before} keyframes kept, {:.1} % of the ground, {:.1} MB\n",
            100.0 * ground_kept,
            bytes(&arguments.map)? as f64 / 1e6
        ))?;
    }
    Ok(Outcome::Done)
}

/// Thins until the file is small enough; keyframes differ in size, so that this may take several
/// passes. The share of the ground that is kept is the product over the passes.
fn thin_to_size(file: &mut MapFile, most: u64) -> Result<f64> {
    let mut ground_kept = 1.0;
    file.compact()?;
    loop {
        let size = bytes(file.path())?;
        if size <= most {
            return Ok(ground_kept);
        }
        let (keyframes, images) = file.image_bytes()?;
        let rest = size - images.min(size);
        if keyframes == 0 || rest >= most {
            return Err(Error::input(format!(
                "{}: even without images the map has {rest} bytes (paths, mosaic and signatures); allow \
                 more than {most}, or render a coarser mosaic first",
                file.path().display()
            )));
        }
        let share = (most - rest) as f64 / images as f64;
        let fewer = ((keyframes as f64 * share) as u64).min(keyframes - 1);
        ground_kept *= file.thin(fewer as usize)?.ground_kept;
        file.compact()?;
    }
}

fn bytes(path: &Path) -> Result<u64> {
    std::fs::metadata(path)
        .map(|metadata| metadata.len())
        .map_err(|error| Error::input(format!("{} cannot be read: {error}", path.display())))
}

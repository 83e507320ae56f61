//! `odograph map thin`: a map of bounded size.

use crate::{Outcome, console};
use odograph::error::{Error, Result};
use odograph_map::{MapFile, MosaicLayer};
use std::path::{Path, PathBuf};

/// Remove redundant keyframes from a map.
///
/// Those whose ground others show too. Their edges are merged, so that the map stays connected.
/// With --max-size the mosaic is made coarser first, or left out: `odograph map mosaic` renders it
/// again from the keyframes.
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
    let mosaic_before = file.mosaic()?;
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
    let mosaic = file.mosaic()?;
    file.close()?;
    if !arguments.quiet {
        if let Some(reduced) = reduced(mosaic_before.as_ref(), mosaic.as_ref(), &arguments.map) {
            console::print(&format!("{reduced}\n"))?;
        }
        console::print(&format!(
            "{kept} of {before} keyframes kept, {:.1} % of the ground, {:.1} MB\n",
            100.0 * ground_kept,
            bytes(&arguments.map)? as f64 / 1e6
        ))?;
    }
    Ok(Outcome::Done)
}

/// Says what became of the mosaic; `None` where it is as before.
fn reduced(before: Option<&MosaicLayer>, after: Option<&MosaicLayer>, map: &Path) -> Option<String> {
    let before = before.filter(|before| after != Some(before))?;
    let path = console::name(map);
    Some(match after {
        Some(after) => format!(
            "the mosaic has pixels of {:.2} mm now instead of {:.2} mm; odograph map mosaic {path} renders it again",
            1e3 * after.resolution_m,
            1e3 * before.resolution_m
        ),
        None => format!("the mosaic was left out; odograph map mosaic {path} renders it again"),
    })
}

/// Largest share of the requested size that the mosaic may have where keyframes are removed: it can
/// be rendered again, and they cannot.
const MOSAIC_SHARE: f64 = 0.05;

/// Fails where neither images nor mosaic take the space that is too much.
fn check_possible(file: &MapFile, most: u64) -> Result<()> {
    let removable = file.image_bytes()?.1 + file.mosaic_bytes()?;
    match bytes(file.path())?.saturating_sub(removable) {
        rest if rest >= most => Err(too_small(file, rest, most)),
        _ => Ok(()),
    }
}

fn too_small(file: &MapFile, rest: u64, most: u64) -> Error {
    Error::input(format!(
        "{}: even without images the map has {rest} bytes (paths and signatures); allow more than {most}",
        file.path().display()
    ))
}

/// Makes the mosaic coarser until the file is small enough, or the mosaic is a small part of the
/// requested size, or gone.
fn coarsen_to_size(file: &mut MapFile, most: u64) -> Result<()> {
    file.compact()?;
    // A map that cannot be made that small stays as it is.
    check_possible(file, most)?;
    while bytes(file.path())? > most && file.mosaic_bytes()? as f64 > MOSAIC_SHARE * most as f64 {
        file.coarsen_mosaic()?;
        file.compact()?;
    }
    Ok(())
}

/// Thins until the file is small enough; keyframes differ in size, so that this may take several
/// passes. The share of the ground that is kept is the product over the passes.
fn thin_to_size(file: &mut MapFile, most: u64) -> Result<f64> {
    let mut ground_kept = 1.0;
    coarsen_to_size(file, most)?;
    loop {
        let size = bytes(file.path())?;
        if size <= most {
            return Ok(ground_kept);
        }
        let (keyframes, images) = file.image_bytes()?;
        let rest = size - images.min(size);
        if keyframes == 0 || rest >= most {
            return Err(too_small(file, rest, most));
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

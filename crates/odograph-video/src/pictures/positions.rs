//! Where the pictures of a folder were taken, as a satellite receiver.

use super::exif_data;
use super::folder::Listing;
use odograph::error::{Error, Result};
use odograph::georeference::GnssFix;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Bytes at the beginning of a picture within which its metadata are, with a preview.
const METADATA_BYTES: u64 = 1 << 20;

/// Reads the positions in the EXIF data of the JPEG pictures of a folder, in order of their times,
/// which are by the camera's clock, as those of the frames of a source that is that folder. Those
/// without a position and a time are left out; a warning says how many.
///
/// # Errors
/// If the folder or a picture cannot be read, or no picture has a position.
pub fn picture_fixes(folder: &Path) -> Result<(Vec<GnssFix>, Vec<String>)> {
    let read = || -> Result<(Vec<GnssFix>, usize)> {
        let pictures = Listing::read(folder)?.pictures;
        let mut fixes = Vec::new();
        for picture in &pictures {
            let mut head = Vec::new();
            File::open(picture).and_then(|file| file.take(METADATA_BYTES).read_to_end(&mut head)).map_err(
                |error| {
                    Error::input(format!("{} cannot be read: {error}", picture.display())).caused_by(error)
                },
            )?;
            fixes.extend(exif_data::fix(&head));
        }
        if fixes.is_empty() {
            return Err(Error::input(format!(
                "none of the {} pictures in this folder has a position and a time in its EXIF data; give JPEGs as the \
                 camera wrote them",
                pictures.len()
            )));
        }
        fixes.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        fixes.dedup_by(|later, before| later.time_s <= before.time_s);
        Ok((fixes, pictures.len()))
    };
    let (fixes, pictures) = read().map_err(|error| error.at(folder.display()))?;
    let without = pictures - fixes.len();
    let warning = format!(
        "{}: {without} of {pictures} pictures have no position, or no time of their own, in their EXIF data and were \
         left out",
        folder.display()
    );
    Ok((fixes, if without > 0 { vec![warning] } else { Vec::new() }))
}

//! Image folders: selection, order and capture times of the images.

use super::{decode, exif_data};
use crate::foreign_file::WHAT_TO_GIVE;
use crate::frame::Picture;
use crate::opened::{Frames, Opened};
use crate::source_options::SourceOptions;
use crate::timestamps::{Timestamps, time_from_name};
use odograph::error::{Error, Result};
use std::cmp::Ordering;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

const EXTENSIONS: [&str; 8] = ["png", "jpg", "jpeg", "tif", "tiff", "pgm", "ppm", "pnm"];
/// Extensions of the most usual videos, to name one where a folder of pictures was expected.
const VIDEO_EXTENSIONS: [&str; 7] = ["mp4", "mov", "mkv", "webm", "avi", "m4v", "y4m"];

/// Opens an image folder, including the layouts of EuRoC (`data.csv` beside `data/`) and TUM
/// (`rgb.txt` beside `rgb/`).
pub(crate) fn open_folder(folder: &Path, options: &SourceOptions) -> Result<Opened> {
    let listing = Listing::read(folder)?;
    if !listing.pictures.is_empty() {
        return open_pictures(listing.pictures, options.timestamps.as_deref(), options, true);
    }
    let layouts = [
        ("data.csv", "data"),
        ("cam0/data.csv", "cam0/data"),
        ("mav0/cam0/data.csv", "mav0/cam0/data"),
        ("rgb.txt", "rgb"),
    ];
    for (times, pictures) in layouts {
        let (times, pictures) = (folder.join(times), folder.join(pictures));
        if pictures.is_dir() {
            let inside = Listing::read(&pictures)?;
            if !inside.pictures.is_empty() {
                let times = options.timestamps.clone().or(times.is_file().then_some(times));
                return open_pictures(inside.pictures, times.as_deref(), options, true);
            }
        }
    }
    let subfolder =
        listing.folders.iter().find(|f| Listing::read(f).is_ok_and(|inside| !inside.pictures.is_empty()));
    Err(Error::input(match listing.other {
        _ if let Some(subfolder) = subfolder => {
            format!(
                "there are no pictures in this folder itself; give the folder {} that is in it",
                name_of(subfolder)
            )
        }
        Some(_) if let Some(video) = &listing.video => {
            format!("there are no pictures in this folder; give the video {video} that is in it")
        }
        None => format!("the folder is empty; {WHAT_TO_GIVE}"),
        Some(example) => {
            format!(
                "there are no pictures (PNG, JPEG, TIFF, PGM, PPM) in this folder, only other things such as {example}; {WHAT_TO_GIVE}"
            )
        }
    }))
}

/// Opens one image as a source with one frame.
pub(crate) fn open_picture(path: &Path, options: &SourceOptions) -> Result<Opened> {
    open_pictures(vec![path.to_path_buf()], options.timestamps.as_deref(), options, false)
}

pub(super) struct Listing {
    /// Images in natural order.
    pub pictures: Vec<PathBuf>,
    /// Subfolders in order of their names.
    folders: Vec<PathBuf>,
    /// A video in it.
    video: Option<String>,
    /// An example of another entry.
    other: Option<String>,
}

impl Listing {
    pub fn read(folder: &Path) -> Result<Self> {
        let unreadable = |error: std::io::Error| Error::input(format!("the folder cannot be read: {error}"));
        let mut listing = Self { pictures: Vec::new(), folders: Vec::new(), video: None, other: None };
        let mut others = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            let name = name_of(&path);
            let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
            // Names with a leading dot are metadata of other programs, such as the `._` files of
            // macOS.
            if EXTENSIONS.contains(&extension.as_str()) && !name.starts_with('.') && path.is_file() {
                listing.pictures.push(path);
            } else {
                if VIDEO_EXTENSIONS.contains(&extension.as_str()) && path.is_file() {
                    listing.video = listing.video.take().into_iter().chain([name.clone()]).min();
                }
                others.push(name);
                if path.is_dir() {
                    listing.folders.push(path);
                }
            }
        }
        listing.pictures.sort_by(|a, b| natural_order(&name_of(a), &name_of(b)));
        listing.folders.sort();
        listing.other = others.into_iter().min();
        Ok(listing)
    }
}

/// The last part of a path; empty if it has none.
pub(crate) fn name_of(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Natural sort order: compares runs of digits by their value, so that `2.png` precedes `10.png`.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a.as_bytes(), b.as_bytes());
    loop {
        match (left, right) {
            ([l, ..], [r, ..]) if l.is_ascii_digit() && r.is_ascii_digit() => {
                let (number, after) = digits(left);
                let (other, other_after) = digits(right);
                let order = number.len().cmp(&other.len()).then_with(|| number.cmp(other));
                if order.is_ne() {
                    return order;
                }
                (left, right) = (after, other_after);
            }
            ([l, after @ ..], [r, other_after @ ..]) => {
                if l != r {
                    return l.cmp(r);
                }
                (left, right) = (after, other_after);
            }
            // Tie-break for names that differ only in leading zeros.
            _ => return left.len().cmp(&right.len()).then_with(|| a.cmp(b)),
        }
    }
}

/// Splits off a run of digits, without its leading zeros.
fn digits(bytes: &[u8]) -> (&[u8], &[u8]) {
    let end = bytes.iter().position(|b| !b.is_ascii_digit()).unwrap_or(bytes.len());
    let (number, after) = bytes.split_at(end);
    let zeros = number.iter().take_while(|&&b| b == b'0').count();
    (&number[zeros..], after)
}

/// Opens images as a source. `named`: errors have the image's name, because the source is a folder.
fn open_pictures(
    pictures: Vec<PathBuf>,
    timestamps: Option<&Path>,
    options: &SourceOptions,
    named: bool,
) -> Result<Opened> {
    let mut warnings = Vec::new();
    let count = pictures.len();
    let (pictures, times) = match timestamps {
        Some(file) => {
            let (pictures, times) = by_file(pictures, file, &mut warnings)?;
            (pictures, Some(times))
        }
        None if options.fps.is_some() => (pictures, None),
        None => {
            let times = from_exif(&pictures, &mut warnings).or_else(|| from_names(&pictures));
            (pictures, times)
        }
    };
    let kind = pictures
        .first()
        .and_then(|p| p.extension())
        .map(|e| e.to_string_lossy().to_uppercase())
        .unwrap_or_default();
    Ok(Opened {
        frame_count: Some(pictures.len() as u64),
        frames_within: Some((pictures.len() as u64, pictures.len() as u64)),
        description: if count == 1 { format!("picture ({kind})") } else { format!("pictures ({kind})") },
        timestamps_used: timestamps.is_some(),
        // A single image needs no frame rate.
        times_known: times.is_some() || count == 1,
        frames_per_second: None,
        frames: Box::new(Pictures {
            pictures,
            times,
            next: 0,
            size: None,
            keep_color: options.color,
            named,
            warnings,
        }),
    })
}

/// The images named by a timestamps file, with their times; all images if the file has only times.
fn by_file(
    pictures: Vec<PathBuf>,
    file: &Path,
    warnings: &mut Vec<String>,
) -> Result<(Vec<PathBuf>, Vec<f64>)> {
    let place = file.display();
    match Timestamps::read(file)? {
        Timestamps::InOrder(times) if times.len() == pictures.len() => Ok((pictures, times)),
        Timestamps::InOrder(times) => Err(Error::input(format!(
            "{place} has {} times, but there are {} pictures; give a time for each picture",
            times.len(),
            pictures.len()
        ))),
        Timestamps::Named(named) => {
            let mut by_name: HashMap<String, PathBuf> = HashMap::new();
            for picture in &pictures {
                let stem = picture.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
                by_name.insert(stem, picture.clone());
            }
            for picture in &pictures {
                by_name.insert(name_of(picture), picture.clone());
            }
            let mut listed = Vec::with_capacity(named.len());
            let mut times = Vec::with_capacity(named.len());
            for (name, time_s) in named {
                let last = name.rsplit(['/', '\\']).next().unwrap_or(&name);
                let Some(picture) = by_name.get(last) else {
                    return Err(Error::input(format!(
                        "{place} names the picture {name}, which is not there"
                    )));
                };
                listed.push(picture.clone());
                times.push(time_s);
            }
            if listed.len() < pictures.len() {
                warnings.push(format!(
                    "{} of {} pictures have no time in {place} and were left out",
                    pictures.len() - listed.len(),
                    pictures.len()
                ));
            }
            Ok((listed, times))
        }
    }
}

fn increasing(times: &[f64]) -> bool {
    times.windows(2).all(|pair| pair[0] < pair[1])
}

/// Capture times from EXIF data; `None` unless every image has one and they increase.
fn from_exif(pictures: &[PathBuf], warnings: &mut Vec<String>) -> Option<Vec<f64>> {
    let times: Option<Vec<f64>> = pictures.iter().map(|picture| exif_data::time_of_file(picture)).collect();
    let times = times?;
    if !increasing(&times) {
        warnings.push(
            "the times in the pictures' EXIF data do not increase from picture to picture and were not used"
                .to_string(),
        );
        return None;
    }
    Some(times)
}

/// Times from file names; `None` unless every name is a time and they increase.
fn from_names(pictures: &[PathBuf]) -> Option<Vec<f64>> {
    let times: Option<Vec<f64>> =
        pictures.iter().map(|p| time_from_name(&p.file_stem()?.to_string_lossy())).collect();
    times.filter(|times| increasing(times))
}

struct Pictures {
    pictures: Vec<PathBuf>,
    times: Option<Vec<f64>>,
    next: usize,
    size: Option<(usize, usize)>,
    keep_color: bool,
    named: bool,
    warnings: Vec<String>,
}

impl Frames for Pictures {
    fn advance(&mut self) -> Result<Option<f64>> {
        if self.next >= self.pictures.len() {
            return Ok(None);
        }
        self.next += 1;
        let number = self.next - 1;
        Ok(Some(self.times.as_ref().and_then(|times| times.get(number)).copied().unwrap_or(number as f64)))
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        let path = self
            .next
            .checked_sub(1)
            .and_then(|at| self.pictures.get(at))
            .ok_or_else(|| Error::input("there is no picture here"))?;
        let picture = decode::picture(path, self.keep_color)
            .map_err(|error| if self.named { error.at(name_of(path)) } else { error })?;
        let (width, height) = (picture.gray.width(), picture.gray.height());
        let (first_width, first_height) = *self.size.get_or_insert((width, height));
        if (width, height) != (first_width, first_height) {
            return Err(Error::input(format!(
                "the picture {} has {width}x{height} pixels, the first has {first_width}x{first_height}; all must have the same size",
                name_of(path)
            )));
        }
        Ok(Some(picture))
    }

    fn name(&self) -> Option<String> {
        Some(name_of(self.pictures.get(self.next.checked_sub(1)?)?))
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn numbers_are_compared_as_numbers() {
        let mut names = ["b10.png", "b9.png", "a.png", "b009.png", "b9a.png", "B1.png"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["B1.png", "a.png", "b009.png", "b9.png", "b9a.png", "b10.png"]);
    }

    proptest! {
        #[test]
        fn natural_order_is_an_order(a in "[a0-2.]{0,6}", b in "[a0-2.]{0,6}", c in "[a0-2.]{0,6}") {
            prop_assert_eq!(natural_order(&a, &b), natural_order(&b, &a).reverse());
            prop_assert_eq!(natural_order(&a, &b).is_eq(), a == b);
            if natural_order(&a, &b).is_le() && natural_order(&b, &c).is_le() {
                prop_assert!(natural_order(&a, &c).is_le());
            }
        }
    }
}

//! Atomic writing and bounded reading of files: written under a temporary name and then renamed, so
//! that no half-written file is visible; read up to a limit of bytes.

use odograph::error::{Error, Result};
use odograph_video::read_regular_file;
pub use odograph_video::{
    png_from_gray, png_from_rgb, png_from_rgb_samples, png_from_rgba, png_from_rgba_bands, png_to_print,
};
use std::ffi::OsString;
use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Whether a file may be written at `path`, checked before any work: fails if a folder or device is
/// there, or a file that may not be overwritten.
pub fn check_output_file(path: &Path, force: bool) -> Result<()> {
    let shown = path.display();
    if path.is_dir() || path.as_os_str().as_encoded_bytes().ends_with(b"/") {
        return Err(Error::usage(format!("{shown} is a folder; give the name of a file")));
    }
    if path.exists() && !path.is_file() {
        return Err(Error::usage(format!("{shown} is a device or a pipe; give the name of a file")));
    }
    if path.exists() && !force {
        return Err(Error::usage(format!(
            "{shown} is already there; choose another name, or --force to overwrite it"
        )));
    }
    Ok(())
}

/// Whether results may be written into a folder at `path`, checked before any work: fails if there
/// is something else.
pub fn check_output_folder(path: &Path) -> Result<()> {
    match path.exists() && !path.is_dir() {
        true => Err(Error::usage(format!("{} is a file; the results need a folder", path.display()))),
        false => Ok(()),
    }
}

/// [`check_output_file`] for what is written after minutes of work: fails also if the folder is
/// missing or cannot be written into. `results` is the folder of the results, which is made.
pub(crate) fn check_output(path: &Path, results: Option<&Path>, force: bool) -> Result<()> {
    check_output_file(path, force)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    match folder.filter(|folder| !folder.is_dir()) {
        Some(folder) if results == Some(folder) => Ok(()),
        Some(folder) => Err(Error::usage(format!(
            "{} cannot be written: there is no folder {}; make it, or choose another",
            path.display(),
            folder.display()
        ))),
        None => check_writable(path, 0),
    }
}

/// Whether a file of this size, bytes, can be made beside `path`, to fail before minutes of work
/// and not after.
pub fn check_writable(path: &Path, size: usize) -> Result<()> {
    let beside = beside(path);
    match fs::OpenOptions::new().write(true).create_new(true).open(&beside) {
        Ok(mut file) => {
            let written = file.write_all(&vec![0; size]).and_then(|()| file.sync_data());
            let removed = fs::remove_file(&beside);
            written.and(removed).map_err(|error| cannot_be_written(path, error))
        }
        // What a killed run has left, which the file to come will replace.
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(cannot_be_written(path, error)),
    }
}

/// Writes a whole file under a temporary name and renames it. A failure leaves no file.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_by_way_of(&beside(path), path, bytes)
}

/// Writes a whole new file that only its owner can read and write. A failure leaves no file.
pub fn write_private(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(path).map_err(|error| cannot_be_written(path, error))?;
    file.write_all(bytes).and_then(|()| file.sync_data()).map_err(|error| {
        let _ = fs::remove_file(path);
        cannot_be_written(path, error)
    })
}

/// The error of a file that cannot be written.
pub(crate) fn cannot_be_written(path: &Path, error: io::Error) -> Error {
    Error::not_written(path.display(), error)
}

/// Writes a file that may exceed memory: `fill` writes it under a temporary name, then it is
/// renamed. A failure leaves no file.
pub fn write_with(path: &Path, fill: impl FnOnce(&mut BufWriter<fs::File>) -> Result<()>) -> Result<()> {
    fill_by_way_of(&beside(path), path, fill)
}

/// [`write`] under a temporary name that is given.
pub(crate) fn write_by_way_of(beside: &Path, path: &Path, bytes: &[u8]) -> Result<()> {
    fill_by_way_of(beside, path, |output| {
        output.write_all(bytes).map_err(|error| cannot_be_written(path, error))
    })
}

/// [`write_with`] under a temporary name that is given.
pub(crate) fn fill_by_way_of(
    beside: &Path,
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<fs::File>) -> Result<()>,
) -> Result<()> {
    let cannot = |error| cannot_be_written(path, error);
    let written = fs::File::create(beside).map_err(cannot).and_then(|file| {
        let mut output = BufWriter::with_capacity(1 << 20, file);
        fill(&mut output)?;
        output.flush().and_then(|()| output.get_ref().sync_data()).map_err(cannot)?;
        fs::rename(beside, path).map_err(cannot)
    });
    written.inspect_err(|_| {
        let _ = fs::remove_file(beside);
    })
}

/// Reads a text file made by a person: at most 16 MiB of UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    read_text_within(path, MAX_TEXT)
}

/// Makes a folder with those that it is in.
///
/// # Errors
/// If that is not possible; the message names what is in the way.
pub fn make_folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(|error| {
        let there = path.ancestors().find(|place| place.symlink_metadata().is_ok());
        match there.filter(|place| !place.is_dir()) {
            Some(link) if !link.exists() => {
                let why = format!("{} is a link that leads nowhere", link.display());
                Error::output(format!("{} cannot be made: {why}", path.display())).caused_by(error)
            }
            Some(file) => {
                let why = match file == path {
                    true => "there is a file of this name".to_owned(),
                    false => format!("{} is a file", file.display()),
                };
                Error::output(format!("the folder {} cannot be made: {why}; choose another", path.display()))
                    .caused_by(error)
            }
            None => Error::not_made(path.display(), error),
        }
    })
}

/// Folders that were made for results, the innermost first. Those that are still empty when this is
/// dropped are removed.
#[must_use = "the folders are removed again unless something is written into them first"]
#[derive(Debug, Default)]
pub struct MadeFolders(Vec<PathBuf>);

impl Drop for MadeFolders {
    fn drop(&mut self) {
        for folder in &self.0 {
            let _ = fs::remove_dir(folder);
        }
    }
}

/// Space that the results of a calibration need, bytes.
const SPACE: usize = 1 << 20;

impl MadeFolders {
    /// Makes a folder with those that it is in, as far as they are missing.
    ///
    /// # Errors
    /// If that is not possible; the message names what is in the way.
    pub fn new(folder: &Path) -> Result<Self> {
        if folder.as_os_str().is_empty() {
            return Ok(Self::default());
        }
        let missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
        let made = Self(folder.ancestors().take_while(missing).map(Path::to_owned).collect());
        make_folder(folder)?;
        Ok(made)
    }

    /// Whether any was made.
    pub fn is_any(&self) -> bool {
        !self.0.is_empty()
    }

    /// The folder that a file is to be written into, made where it is missing.
    ///
    /// # Errors
    /// As [`MadeFolders::new`].
    pub fn of_file(path: &Path) -> Result<Self> {
        Self::new(path.parent().unwrap_or(Path::new("")))
    }

    /// The same before minutes of work: fails if the file cannot be written there, or the disk is
    /// full.
    ///
    /// # Errors
    /// If it cannot.
    pub fn of_result(path: &Path) -> Result<Self> {
        let made = Self::of_file(path)?;
        check_writable(path, SPACE)?;
        Ok(made)
    }
}

/// Reads a text file of at most `most` bytes of UTF-8. A folder, pipe or device is refused.
pub fn read_text_within(path: &Path, most: u64) -> Result<String> {
    let bytes = read_regular_file(path, most).map_err(|error| {
        Error::input(match error.kind() {
            io::ErrorKind::FileTooLarge => {
                format!("{} is larger than {} MiB; it is not the file meant", path.display(), most >> 20)
            }
            _ => format!("{} cannot be read: {error}", path.display()),
        })
        .caused_by(error)
    })?;
    String::from_utf8(bytes).map_err(|error| {
        Error::input(format!(
            "{} is not a text file, as camera, rig, sensor and parameter files are; give another file",
            path.display()
        ))
        .caused_by(error)
    })
}

/// Largest size of camera, rig and parameter files, bytes.
const MAX_TEXT: u64 = 16 << 20;

/// The temporary name under which `path` is written.
pub fn beside(path: &Path) -> PathBuf {
    let mut name: OsString = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    path.with_file_name(name)
}

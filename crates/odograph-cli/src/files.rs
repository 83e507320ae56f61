//! Names of output files and folders; reading and writing is the library's.

pub use odograph_session::files::*;

use odograph::error::{Error, Result};
use std::fs;
use std::path::{Path, PathBuf};

/// Folders that were made for results, the innermost first. Those that are still empty when this is
/// dropped are removed.
#[must_use = "the folders are removed again unless something is written into them first"]
#[derive(Default)]
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
    pub fn of_file(path: &Path) -> Result<Self> {
        Self::new(path.parent().unwrap_or(Path::new("")))
    }

    /// The same before minutes of work: fails if the file cannot be written there, or the disk is
    /// full.
    pub fn of_result(path: &Path) -> Result<Self> {
        let made = Self::of_file(path)?;
        check_writable(path, SPACE)?;
        Ok(made)
    }
}

/// Whether results of these names may be written into `folder`, checked before any work: fails if
/// it is a file, or if one of them is there and may not be overwritten.
pub fn check_output_names(folder: &Path, names: &[&str], force: bool) -> Result<()> {
    check_output_folder(folder)?;
    match names.iter().map(|name| folder.join(name)).find(|path| path.exists() && !force) {
        Some(there) => Err(Error::usage(format!(
            "{} is already there; choose another folder, or --force to overwrite it",
            there.display()
        ))),
        None => Ok(()),
    }
}

/// Removes a file, or a folder with all that is in it, as far as that is possible.
pub fn remove(path: &Path) {
    let _ = match path.is_dir() {
        true => fs::remove_dir_all(path),
        false => fs::remove_file(path),
    };
}

/// Where results go that no option names: beside the input, with the input's name without its
/// ending, then `suffix` (such as `-rig.toml`). Results of standard input go into the working
/// folder. Where something of that name is there already, a number from 2 on is added.
pub fn free_beside(input: &str, suffix: &str) -> PathBuf {
    let input = Path::new(if input == "-" { "standard-input" } else { input });
    let name = if input.is_dir() { input.file_name() } else { input.file_stem() };
    let name = name.map_or_else(|| "odograph".to_owned(), |name| name.to_string_lossy().into_owned());
    let (suffix, ending) = suffix.find('.').map_or((suffix, ""), |dot| suffix.split_at(dot));
    let folder = input.parent().unwrap_or(Path::new(""));
    let named = |number: String| folder.join(format!("{name}{suffix}{number}{ending}"));
    let numbered = (2..).map(|number| named(format!("-{number}")));
    let mut names = std::iter::once(named(String::new())).chain(numbered);
    names.find(|path| !path.exists()).unwrap_or_else(|| named(String::new()))
}

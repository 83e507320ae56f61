//! Names of output files and folders; reading and writing is the library's.

pub use odograph_session::files::*;

use odograph::error::{Error, Result};
use std::fs;
use std::path::{Path, PathBuf};

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

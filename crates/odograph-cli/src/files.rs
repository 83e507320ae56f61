//! Names of output files and folders; reading and writing is the library's.

pub use odograph_session::files::*;

use odograph::error::Result;
use std::path::{Path, PathBuf};

/// Makes the folder that a file is to be written into, where it is missing.
pub fn make_folder_of(path: &Path) -> Result<()> {
    let folder = path.parent().unwrap_or(Path::new(""));
    if folder.as_os_str().is_empty() {
        return Ok(());
    }
    make_folder(folder)
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

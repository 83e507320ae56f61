//! The program, as the tests start it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Arc, Mutex, OnceLock};

/// Runs it in a folder; arguments are separated by spaces.
pub fn odograph(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.current_dir(folder).args(arguments.split_whitespace()).output().unwrap()
}

/// Runs it to a success. Returns its messages.
pub fn done(folder: &Path, arguments: &str) -> String {
    String::from_utf8_lossy(&succeeded(folder, arguments).stderr).into_owned()
}

/// Runs it to a success. Returns its standard output.
pub fn printed(folder: &Path, arguments: &str) -> String {
    String::from_utf8(succeeded(folder, arguments).stdout).unwrap()
}

fn succeeded(folder: &Path, arguments: &str) -> Output {
    let output = odograph(folder, arguments);
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

/// What a command left in its folder: paths and contents.
type FolderContent = Vec<(PathBuf, Vec<u8>)>;

/// What [`done`] makes of a folder, of a command that reads nothing. Tests that call the same one
/// get copies of its files: rendering takes longer than most of what is tested with it.
pub fn done_once(folder: &Path, arguments: &str) {
    static MADE: Mutex<BTreeMap<String, Arc<OnceLock<FolderContent>>>> = Mutex::new(BTreeMap::new());
    let made = Arc::clone(MADE.lock().unwrap().entry(arguments.to_owned()).or_default());
    let made = made.get_or_init(|| {
        let place = tempfile::tempdir().unwrap();
        done(place.path(), arguments);
        content(place.path(), Path::new(""))
    });
    for (name, bytes) in made {
        let file = folder.join(name);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, bytes).unwrap();
    }
}

fn content(folder: &Path, inside: &Path) -> FolderContent {
    let mut all = Vec::new();
    for entry in fs::read_dir(folder.join(inside)).unwrap() {
        let name = inside.join(entry.unwrap().file_name());
        if folder.join(&name).is_dir() {
            all.extend(content(folder, &name));
        } else {
            let bytes = fs::read(folder.join(&name)).unwrap();
            all.push((name, bytes));
        }
    }
    all
}

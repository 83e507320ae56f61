//! The program, as the tests start it.

use std::path::Path;
use std::process::{Command, Output};

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

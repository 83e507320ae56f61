//! Output: results on standard output, everything else on standard error.

use indicatif::{ProgressBar, ProgressStyle};
use odograph::error::{Error, Result};
use std::borrow::Cow;
use std::io::{self, Write};
use std::path::Path;

/// The text with control characters escaped: names and keys come from files of any origin.
fn harmless(text: &str) -> Cow<'_, str> {
    let acts = |c: char| c.is_control() && !matches!(c, '\n' | '\t');
    if !text.contains(acts) {
        return Cow::Borrowed(text);
    }
    let escaped = |c: char| if acts(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(escaped).collect())
}

/// Prints results. A closed pipe (`odograph … | head`) is not an error.
pub fn print(text: &str) -> Result<()> {
    let mut output = io::stdout().lock();
    match output.write_all(harmless(text).as_bytes()).and_then(|()| output.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Error::output(format!("standard output cannot be written: {error}")))
        }
        _ => Ok(()),
    }
}

/// Tells why the command failed, in the style of clap's own errors.
pub fn error(sentence: &str) {
    to_person("error", sentence);
}

/// Prints a warning about a result.
pub fn warn(sentence: &str) {
    to_person("warning", sentence);
}

/// Prints a note; nothing is wrong.
pub fn note(sentence: &str) {
    to_person("note", sentence);
}

/// Prints a line of the log, with the time since the program began.
pub fn log(since_start_s: f64, sentence: &str) {
    let _ = writeln!(io::stderr(), "[{since_start_s:8.3} s] {}", harmless(sentence));
}

/// Writes a line to standard error. A failure to write is ignored.
fn to_person(kind: &str, sentence: &str) {
    let _ = writeln!(io::stderr(), "{kind}: {}", harmless(sentence));
}

/// A path quoted for a shell.
pub fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+,:@".contains(c);
    if text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

/// A bar where the number of frames is known, a count where not; `doing` stands before it. Nothing
/// is shown where standard error is no terminal.
pub fn progress(doing: &str, frames: Option<u64>, quiet: bool) -> ProgressBar {
    if quiet {
        return ProgressBar::hidden();
    }
    let bar = frames.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    let counted = if frames.is_some() { "{bar:30} {pos}/{len} frames, {eta} left" } else { "{pos} frames" };
    if let Ok(style) = ProgressStyle::with_template(&format!("{{prefix}}{counted}")) {
        bar.set_style(style);
    }
    bar.set_prefix(doing.to_owned());
    bar
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(harmless("ä µ\t±\n"), "ä µ\t±\n");
        assert_eq!(harmless("a\u{1b}[2J\rb\u{9b}"), "a\\u{1b}[2J\\rb\\u{9b}");
    }

    #[test]
    fn what_is_printed_can_be_pasted() {
        for (path, expected) in [
            ("demo/drive.mp4", "demo/drive.mp4"),
            ("my demo/a", "'my demo/a'"),
            ("it's", "'it'\\''s'"),
            ("$x", "'$x'"),
        ] {
            assert_eq!(quoted(Path::new(path)), expected);
        }
    }
}

//! Output: results on standard output, everything else on standard error.

use indicatif::{ProgressBar, ProgressStyle};
use odograph::error::{Error, Result};
use serde::Serialize;
use std::borrow::Cow;
use std::ffi::OsStr;
use std::io::{self, IsTerminal, Write};
use std::path::Path;

/// Whether a terminal acts upon a character instead of showing it: control characters, and those
/// that change the direction or the line of what follows.
fn acts(c: char) -> bool {
    c.is_control() || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// The text with characters that act upon a terminal escaped as in JSON, except those in `kept`:
/// names and keys come from files of any origin.
fn escaped<'a>(text: &'a str, kept: &[char]) -> Cow<'a, str> {
    let is_escaped = |c: char| acts(c) && !kept.contains(&c);
    if !text.contains(is_escaped) {
        return Cow::Borrowed(text);
    }
    let shown = |c: char| match c {
        c if !is_escaped(c) => c.to_string(),
        '\n' => "\\n".to_owned(),
        '\r' => "\\r".to_owned(),
        '\t' => "\\t".to_owned(),
        c => format!("\\u{:04x}", u32::from(c)),
    };
    Cow::Owned(text.chars().map(shown).collect())
}

/// The name of a file or folder, or another text of any origin, as part of a line of results.
pub fn name(text: impl AsRef<OsStr>) -> String {
    escaped(&text.as_ref().to_string_lossy(), &[]).into_owned()
}

/// The name of a recording in a sentence.
pub fn source(typed: &str) -> String {
    if typed == "-" { "standard input".to_owned() } else { name(typed) }
}

/// Prints results, lines of text or JSON; names within text are those of [`name`]. A closed pipe
/// (`odograph … | head`) is not an error.
pub fn print(text: &str) -> Result<()> {
    let mut output = io::stdout().lock();
    written(output.write_all(escaped(text, &['\n', '\t']).as_bytes()).and_then(|()| output.flush()))
}

/// Prints a result as JSON; `what` names it in an error.
pub fn print_json(what: &str, result: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(result)
        .map_err(|error| Error::output(format!("{what} cannot be written as JSON: {error}")))?;
    print(&(text + "\n"))
}

/// The outcome of writing to standard output, where a closed pipe is not an error.
pub fn written(outcome: io::Result<()>) -> Result<()> {
    match outcome {
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

/// Tells an error with its list; `place` stands before it.
pub fn failure(place: &str, failure: &Error) {
    let (sentence, list) = failure.sentence_and_list();
    error(&format!("{place}{sentence}"));
    for line in list {
        let _ = writeln!(io::stderr(), "  {}", escaped(line, &[]));
    }
}

/// Prints a warning about a result.
pub fn warn(sentence: &str) {
    to_person("warning", sentence);
}

/// Draws something of the program's own on standard error, with the colours of a terminal, if that
/// is one.
pub fn draw_on_terminal(lines: impl FnOnce() -> Vec<String>) {
    let mut terminal = io::stderr().lock();
    if terminal.is_terminal() {
        for line in lines() {
            let _ = writeln!(terminal, "{line}");
        }
    }
}

/// Prints a note; nothing is wrong.
pub fn note(sentence: &str) {
    to_person("note", sentence);
}

/// Prints a line of the log, with the time since the program began.
pub fn log(since_start_s: f64, sentence: &str) {
    let _ = writeln!(io::stderr(), "[{since_start_s:8.3} s] {}", escaped(sentence, &[]));
}

/// Writes one line to standard error. A failure to write is ignored.
fn to_person(kind: &str, sentence: &str) {
    let _ = writeln!(io::stderr(), "{kind}: {}", escaped(sentence, &[]));
}

/// A path quoted for a shell.
pub fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+,:@".contains(c);
    if text.chars().all(plain) {
        text
    } else if text.contains(acts) {
        format!("$'{}'", escaped(&text.replace('\\', "\\\\").replace('\'', "\\'"), &[]))
    } else {
        format!("'{}'", text.replace('\'', "'\\''"))
    }
}

/// A bar where the number of frames is known, a count where not; `doing` stands before it. Nothing
/// is shown where standard error is no terminal.
pub fn progress(doing: &str, frames: Option<u64>, quiet: bool) -> ProgressBar {
    let templates = ["{prefix}{bar:30} {pos}/{len} frames, {eta} left", "{prefix}{pos} frames"];
    progress_as(templates, frames, quiet).with_prefix(doing.to_owned())
}

/// The same by templates of indicatif, for a bar and for a count.
pub fn progress_as([bar, count]: [&str; 2], frames: Option<u64>, quiet: bool) -> ProgressBar {
    if quiet {
        return ProgressBar::hidden();
    }
    let progress = frames.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    if let Ok(style) = ProgressStyle::with_template(if frames.is_some() { bar } else { count }) {
        progress.set_style(style);
    }
    progress
}

/// A bar of as many steps as its user sets, by a template of indicatif.
pub fn bar(template: &str, quiet: bool) -> ProgressBar {
    progress_as([template; 2], Some(0), quiet)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(escaped("ä µ\t±\n", &['\n', '\t']), "ä µ\t±\n");
        assert_eq!(escaped("a\u{1b}[2J\rb\u{9b}", &[]), "a\\u001b[2J\\rb\\u009b");
        assert_eq!(name("a\n\tb\u{202e}4pm"), "a\\n\\tb\\u202e4pm");
    }

    #[test]
    fn what_is_escaped_in_json_stays_json() {
        let name = "a\n\u{1b}\u{7f}\u{9b}\u{2028}\u{202e}";
        let json = serde_json::json!({ "file": name }).to_string();
        let printed = escaped(&json, &['\n', '\t']);
        assert!(!printed.contains(acts), "{printed:?}");
        let read: serde_json::Value = serde_json::from_str(&printed).unwrap();
        assert_eq!(read["file"], name);
    }

    #[test]
    fn what_is_printed_can_be_pasted() {
        for (path, expected) in [
            ("demo/drive.mp4", "demo/drive.mp4"),
            ("my demo/a", "'my demo/a'"),
            ("it's", "'it'\\''s'"),
            ("$x", "'$x'"),
            ("a\n'b\\c\u{1b}", "$'a\\n\\'b\\\\c\\u001b'"),
        ] {
            assert_eq!(quoted(Path::new(path)), expected);
        }
    }
}

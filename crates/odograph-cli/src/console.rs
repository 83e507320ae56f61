//! What the program says: results on standard output, everything else on standard error.

use odograph::error::{Error, Result};
use std::borrow::Cow;
use std::io::{self, Write};

/// The text without what a terminal would act upon: names and keys come from files that anybody may
/// have made.
fn harmless(text: &str) -> Cow<'_, str> {
    let acts = |c: char| c.is_control() && !matches!(c, '\n' | '\t');
    if !text.contains(acts) {
        return Cow::Borrowed(text);
    }
    let escaped = |c: char| if acts(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(escaped).collect())
}

/// Prints results. A reader that has gone (`odograph … | head`) wants no more of them and is no failure.
pub fn print(text: &str) -> Result<()> {
    let mut output = io::stdout().lock();
    match output.write_all(harmless(text).as_bytes()).and_then(|()| output.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Error::output(format!("standard output cannot be written: {error}")))
        }
        _ => Ok(()),
    }
}

/// Tells what went wrong. Where nobody can be told, there is nothing left to do.
pub fn complain(sentence: &str) {
    let _ = writeln!(io::stderr(), "odograph: {}", harmless(sentence));
}

/// Tells what a person should know about a result that is there.
pub fn warn(sentence: &str) {
    complain(&format!("warning: {sentence}"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_terminal_is_told_nothing_to_do() {
        assert_eq!(harmless("ä µ\t±\n"), "ä µ\t±\n");
        assert_eq!(harmless("a\u{1b}[2J\rb\u{9b}"), "a\\u{1b}[2J\\rb\\u{9b}");
    }
}

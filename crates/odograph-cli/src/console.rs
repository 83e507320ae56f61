//! What the program says: results on standard output, everything else on standard error.

use odograph::error::{Error, Result};
use std::io::{self, Write};

/// Prints results. A reader that has gone (`odograph … | head`) wants no more of them and is no failure.
pub fn print(text: &str) -> Result<()> {
    let mut output = io::stdout().lock();
    match output.write_all(text.as_bytes()).and_then(|()| output.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Error::output(format!("standard output cannot be written: {error}")))
        }
        _ => Ok(()),
    }
}

/// Tells what went wrong. Where nobody can be told, there is nothing left to do.
pub fn complain(sentence: &str) {
    let _ = writeln!(io::stderr(), "odograph: {sentence}");
}

/// Tells what a person should know about a result that is there.
pub fn warn(sentence: &str) {
    complain(&format!("warning: {sentence}"));
}

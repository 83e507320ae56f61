//! Ctrl-C or SIGTERM ends a run early: it writes its results and exits. A second one exits at once.

use odograph::error::{Error, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit code after an interrupt: 128 and the number of SIGINT, as in shells.
pub const EXIT_CODE: u8 = 130;

static ASKED: AtomicBool = AtomicBool::new(false);

/// Installs the handler. Without one, an interrupt ends the program as usual.
pub fn listen() {
    let _ = ctrlc::set_handler(|| {
        if ASKED.swap(true, Ordering::Relaxed) {
            std::process::exit(i32::from(EXIT_CODE));
        }
    });
}

/// Fails after an interrupt: for commands without partial results.
pub fn check() -> Result<()> {
    if asked() { Err(Error::output("interrupted; nothing was written")) } else { Ok(()) }
}

/// Whether the program was interrupted.
pub fn asked() -> bool {
    ASKED.load(Ordering::Relaxed)
}

//! Ctrl-C (and SIGTERM) asks a run to end; it then writes everything and ends by itself. A second one ends at once.

use odograph::error::{Error, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// What the program ends with when it was interrupted: 128 and the number of SIGINT, as shells have
/// it.
pub const EXIT_CODE: u8 = 130;

static ASKED: AtomicBool = AtomicBool::new(false);

/// Listens from now on. Where the system gives no way to listen, an interrupt ends the program as usual.
pub fn listen() {
    let _ = ctrlc::set_handler(|| {
        if ASKED.swap(true, Ordering::Relaxed) {
            std::process::exit(i32::from(EXIT_CODE));
        }
    });
}

/// Fails once the program was asked to end: for commands that have nothing to show before their
/// end.
pub fn check() -> Result<()> {
    if asked() { Err(Error::output("interrupted; nothing was written")) } else { Ok(()) }
}

/// Whether the program was asked to end.
pub fn asked() -> bool {
    ASKED.load(Ordering::Relaxed)
}

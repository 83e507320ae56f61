//! Ctrl-C or SIGTERM ends a run early: it writes its results and exits. A second one exits at once.

use crate::console;
use odograph::error::{Error, Result};
use odograph_video::TemporaryFolder;
use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Exit code after an interrupt: 128 and the number of SIGINT, as in shells.
pub const EXIT_CODE: u8 = 130;

static ASKED: AtomicBool = AtomicBool::new(false);

/// A signal this soon after the first is the same request: `timeout` and shells signal the program
/// and then its process group.
const SAME_REQUEST: Duration = Duration::from_millis(300);

/// If the program is still busy after this time, a note on the terminal says how to end it at once.
const PATIENCE: Duration = Duration::from_secs(3);

/// Installs the handler. Without one, an interrupt ends the program as usual.
pub fn listen() {
    let mut first: Option<Instant> = None;
    let _ = ctrlc::set_handler(move || match first {
        None => {
            first = Some(Instant::now());
            ASKED.store(true, Ordering::Relaxed);
            odograph_video::end_waiting();
            if std::io::stderr().is_terminal() {
                std::thread::spawn(|| {
                    std::thread::sleep(PATIENCE);
                    console::note("still ending; Ctrl-C again ends at once, without what is not written yet");
                });
            }
        }
        Some(first) if first.elapsed() > SAME_REQUEST => {
            TemporaryFolder::remove_all();
            std::process::exit(i32::from(EXIT_CODE))
        }
        Some(_) => {}
    });
}

/// Lets a write beyond the limit of a file's size (`ulimit -f`) fail like one to a full disk: its
/// signal would end the program without a word of which file it was.
pub fn outlive_file_size_limit() {
    #[cfg(unix)]
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, std::sync::Arc::default());
}

/// Fails after an interrupt: for commands without partial results.
pub fn check() -> Result<()> {
    if asked() { Err(Error::output("interrupted; nothing was written")) } else { Ok(()) }
}

/// Whether the program was interrupted.
pub fn asked() -> bool {
    ASKED.load(Ordering::Relaxed)
}

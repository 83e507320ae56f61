//! The browser of the person at this machine.

use crate::console;
use std::ffi::OsString;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Duration;

/// Time for a browser to start, or to turn out to be missing.
const STARTS_WITHIN: Duration = Duration::from_secs(3);

/// A browser that is being opened.
pub struct OpeningBrowser(Receiver<()>);

impl OpeningBrowser {
    /// Opens an address or a file, beside everything else: some browsers return when they are
    /// closed. Says so where there is none.
    pub fn at(place: impl Into<OsString>) -> Self {
        let place = place.into();
        let (ended, end) = channel();
        thread::spawn(move || {
            if let Err(error) = opener::open_browser(&place) {
                let why = error.to_string();
                console::warn(&format!(
                    "no browser could be opened ({}); open {} yourself",
                    why.lines().next().unwrap_or_default(),
                    console::name(&place)
                ));
            }
            let _ = ended.send(()); // nobody need wait
        });
        Self(end)
    }

    /// Waits until it is open, before the program ends.
    pub fn wait(self) {
        let _ = self.0.recv_timeout(STARTS_WITHIN);
    }
}

//! The thread that takes frames from a source.

use odograph::error::Error;
use odograph_live::capture::{Captured, LiveSource, Newest};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

/// Frames that wait for tracking: one that is next, and one for the time in which it is taken.
pub const FRAMES_WAITING: usize = 2;
/// How long to wait for a frame before looking at everything else.
pub const PATIENCE: Duration = Duration::from_millis(100);
/// How often the page hears how the run goes.
pub const STATUS_EVERY: Duration = Duration::from_millis(250);
/// A source that is asked to end is waited for so long; one that hangs in the system is left
/// behind.
pub const FAREWELL: Duration = Duration::from_secs(2);

/// What a source left when it ended.
#[derive(Debug, Default)]
pub struct Farewell {
    /// What a person should know of it, a sentence each.
    pub warnings: Vec<String>,
    /// What ended it early.
    pub failure: Option<Error>,
}

/// Takes frames from the source on a thread of its own, which ends with the queue or the source. It
/// is not joined: reading a pipe or a device may hang as long as its other end wills.
pub fn capture(
    mut source: Box<dyn LiveSource>,
    queue: Arc<Newest<(Captured, Duration)>>,
) -> mpsc::Receiver<Farewell> {
    let (ended, farewell) = mpsc::channel();
    thread::spawn(move || {
        let failure = loop {
            let begun = Instant::now();
            match source.next_frame() {
                Ok(Some(captured)) => {
                    if !queue.give((captured, begun.elapsed())) {
                        break None;
                    }
                }
                Ok(None) => break None,
                Err(error) => break Some(error),
            }
        };
        // Nobody may be waiting any more.
        let _ = ended.send(Farewell { warnings: source.take_warnings(), failure });
        queue.close();
    });
    farewell
}

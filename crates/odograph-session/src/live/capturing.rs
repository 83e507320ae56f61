//! The capture thread.

use odograph::error::Error;
use odograph::filter::fusion::Sensors;
use odograph_live::capture::{Captured, LiveSource, Newest};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

/// Length of the queue to tracking: the next frame, and one that arrives while it is taken.
pub const FRAMES_WAITING: usize = 2;
/// Longest wait for a frame before other work is done.
pub const PATIENCE: Duration = Duration::from_millis(100);
/// Interval of status updates of the page.
pub const STATUS_EVERY: Duration = Duration::from_millis(250);
/// Longest wait for a source to end; one that hangs in the system is abandoned.
pub const FAREWELL: Duration = Duration::from_secs(2);

/// State of a source at its end.
#[derive(Debug, Default)]
pub struct Farewell {
    /// Warnings, one sentence each.
    pub warnings: Vec<String>,
    /// The error that ended it early.
    pub failure: Option<Error>,
    /// Records of the other sensors that the source has.
    pub sensors: Sensors,
    /// Frames that the source had no time for.
    pub dropped: u64,
}

/// Captures frames on a thread, which ends with the queue or the source. It is not joined: reading
/// a pipe or a device may block indefinitely.
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
        // The receiver may be gone.
        let _ = ended.send(Farewell {
            warnings: source.take_warnings(),
            failure,
            sensors: source.take_sensors(),
            dropped: source.dropped(),
        });
        queue.close();
    });
    farewell
}

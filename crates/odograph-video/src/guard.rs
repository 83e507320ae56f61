//! Catches panics of third-party decoders.

use odograph::error::{Error, Result};
use std::cell::Cell;
use std::panic::{self, AssertUnwindSafe};
use std::sync::Once;

thread_local! {
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Calls a decoder and converts a panic to an [`Error`].
///
/// The decoder must not be used after an error. During the call the panic hook is silenced for this
/// thread, so that a damaged file does not print a backtrace of third-party code; other panics are
/// reported as usual.
pub(crate) fn guarded<T>(what: &str, call: impl FnOnce() -> T) -> Result<T> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let default_hook = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            if !GUARDED.with(Cell::get) {
                default_hook(info);
            }
        }));
    });
    let outer = GUARDED.with(|guarded| guarded.replace(true));
    let outcome = panic::catch_unwind(AssertUnwindSafe(call));
    GUARDED.with(|guarded| guarded.set(outer));
    outcome.map_err(|_| Error::input(format!("the {what} decoder gave up on damaged data")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error() {
        let error = guarded("test", || -> u8 { panic!("boom") }).unwrap_err();
        assert_eq!(error.to_string(), "the test decoder gave up on damaged data");
        assert_eq!(guarded("test", || 7).unwrap(), 7);
    }
}

//! Requests and responses of services.

use super::cdr::Cdr;

/// Response of `std_srvs/srv/Trigger`, whose request is empty.
pub fn trigger_response(success: bool, what: &str) -> Vec<u8> {
    let mut message = Cdr::new();
    message.bool(success);
    message.text(what);
    message.finished()
}

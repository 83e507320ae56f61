//! # odograph-site
//!
//! One map for a fleet.
//!
//! A [`Site`] owns a folder: the records that its robots have sent, and the map that is made of
//! them. A [`SiteServer`] takes the records over HTTP, acknowledges one when it is on disk, and
//! shows the map in a page. A robot's own map is its outbox: a [`SiteLink`] sends what is in it, in
//! order, from a thread that tracking never waits for. `docs/site.md` describes the protocol.
//!
//! The records are what counts. The map can be made of them again, and without those of a robot
//! that is withdrawn.

pub mod protocol;
mod record;
mod records;
mod fleet_map;
mod published;
mod merging;
mod site;
mod limits;
mod refusals;
mod tokens;
mod access;
#[cfg_attr(not(feature = "tls"), path = "no_encryption.rs")]
mod encryption;
mod server;
mod client;
mod link;

pub use client::{SiteAddress, SiteClient};
pub use encryption::{SiteIdentity, TrustedAuthorities};
pub use link::{LinkReport, SiteLink};
pub use protocol::SiteStatus;
pub use server::{DEFAULT_PORT, SiteServer};
pub use site::Site;
pub use tokens::{RobotTokens, TokenOfRobot};

/// Reads the body of a request as a description of a session and as records, for the fuzz target.
#[cfg(fuzzing)]
pub fn read_body(body: &[u8]) {
    if let Ok(description) = serde_json::from_slice::<protocol::SessionDescription>(body) {
        let _ = description.validated();
    }
    for bytes in record::Record::split(body).unwrap_or_default() {
        if let Ok(record) = record::Record::from_bytes(bytes) {
            assert!(record.to_bytes().is_ok(), "a record that was read can be written");
            record.head.edges.iter().for_each(|edge| assert!(edge.edge(|_| None).is_none()));
        }
    }
}

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
mod site;
mod server;
mod client;
mod link;

pub use client::{SiteAddress, SiteClient};
pub use link::{LinkReport, SiteLink};
pub use protocol::SiteStatus;
pub use server::{DEFAULT_PORT, SiteServer};
pub use site::Site;

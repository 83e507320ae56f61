//! # odograph-live
//!
//! Cameras and streams as they come, and the page in the browser that shows what becomes of them.
//!
//! [`capture`] gives frames from cameras, network streams and recordings at their own pace, and never waits for who is late. A [`Hub`] holds
//! what there is to see; a [`Server`] shows it to any number of browsers, none of which can slow down the tracking: each takes from the hub
//! what it can carry, and the hub keeps nothing for those that are slow. [`stream`] sends poses to other programs, [`foxglove`] keeps
//! a run for viewers of robots' recordings.
//!
//! Unlike the other libraries this one reads the clock and opens connections: that is what it is for. It prints nothing.

pub mod capture;
pub mod ground;
pub mod record;
mod shown;
pub mod hub;
mod view;
pub mod stream;
pub mod foxglove;
pub mod server;

pub use foxglove::McapFile;
pub use ground::{Ground, GroundPicture};
pub use hub::{Hub, Introduction, Mark, Phase, Status, View};
pub use record::TrackRecord;
pub use server::{Server, ServerOptions};

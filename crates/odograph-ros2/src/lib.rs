//! # odograph-ros2
//!
//! A door to ROS 2 without a ROS installation: images and other sensors from its topics into a live
//! run, and odometry, transforms, path, ground and diagnostics of the run to its topics;
//! services and parameters of the run.
//!
//! ROS 2 talks DDS; this crate does so with RustDDS, under the names, types and qualities of
//! service that ROS 2 gives to topics. Messages are read by `odograph-video`, as those of a
//! recording are, and made by `odograph-session`, as those of a bag are: here they are bytes.
//!
//! ```no_run
//! use odograph_ros2::{ImageOptions, Images, Node, PublisherOptions};
//! use odograph_ros2::{RunPublisher, Services, TopicName};
//! use odograph_session::RunBuilder;
//! use odograph_session::live::{LiveInput, LiveOptions};
//! use odograph_live::capture::Policy;
//!
//! let node = Node::join()?;
//! let topic: TopicName = "/camera/image_raw".parse()?;
//! let services = Services::announce(&node, "ros2:/camera/image_raw", false)?;
//! let mut images = Images::of(&node, ImageOptions::new(topic))?;
//! let run = RunBuilder::new("ros2:/camera/image_raw").camera(images.camera(&())?).height_m(0.9);
//! let options = LiveOptions { shown: true, mosaic: true, ..LiveOptions::default() };
//! let mut link = None;
//! let run = run.open_live_over(&options, &(), |_, watch| {
//!     let source = images.source(watch.clone(), &())?;
//!     link = Some(source.link());
//!     Ok(LiveInput { source: Box::new(source), policy: Policy::NewestWins })
//! })?;
//! let options = PublisherOptions::default();
//! let mut publisher = RunPublisher::new(&node, &options, link, services, &run)?;
//! run.follow(Some(&mut publisher), &())?;
//! # Ok::<(), odograph::error::Error>(())
//! ```
//!
//! Like `odograph-live`, this library reads the clock and opens network connections, and prints
//! nothing. The modules are listed in the order of their dependencies.

mod names;
mod payload;
mod node;
mod topic;
mod ground;
mod link;
mod sensors;
mod listening;
mod images;
mod path;
mod service;
mod parameters;
mod services;
mod publisher;

pub use images::{ImageOptions, ImageSource, Images};
pub use link::Link;
pub use names::TopicName;
pub use node::Node;
pub use publisher::{Part, PublisherOptions, RunPublisher};
pub use services::Services;

//! The program without ROS 2.

use super::super::LiveArguments;
use super::super::outputs::Outputs;
use super::SOURCE;
use odograph::error::{Error, Result};
use odograph_session::live::{LiveOptions, LiveRun};
use odograph_session::{Observer, RunBuilder, SensorFiles};

/// A run with ROS 2: uninhabited, as this program is built without it.
#[derive(Debug)]
pub enum Ros2Run {}

impl Ros2Run {
    /// Fails if ROS 2 is asked for.
    pub fn of(arguments: &LiveArguments, _: &SensorFiles) -> Result<Option<Self>> {
        let ros2 = &arguments.ros2;
        let asked = if arguments.source.starts_with(SOURCE) {
            Some(arguments.source.as_str())
        } else if ros2.ros2.is_some() {
            Some("--ros2")
        } else {
            ros2.topic_beside_images()
        };
        asked.map_or(Ok(None), |asked| {
            Err(Error::usage(format!(
                "{asked}: this program is built without ROS 2; `cargo install --locked --path crates/odograph-cli --features ros2` \
                 builds it with ROS 2"
            )))
        })
    }

    /// Opens the run.
    pub fn open(self, _: RunBuilder, _: &LiveOptions, _: &dyn Observer, _: &mut Outputs) -> Result<LiveRun> {
        match self {}
    }
}

//! Output of poses to other programs during a run.

use super::{LiveArguments, Print};
use crate::commands::site::RobotLink;
use crate::console;
use odograph::error::{Error, Result};
use odograph_live::stream::{Datagrams, json_line, json_line_in_map};
use odograph_session::live::{LiveFrame, PoseSink};

/// Outputs of poses besides folder and page.
pub struct Outputs {
    print: bool,
    /// Whether lines have the pose in the map.
    continues_map: bool,
    datagrams: Option<Datagrams>,
    site: Option<RobotLink>,
    /// Another receiver of poses: ROS 2.
    published: Option<Box<dyn PoseSink>>,
}

impl Outputs {
    pub fn new(arguments: &LiveArguments) -> Result<Self> {
        let datagrams = arguments.udp.as_deref().map(|address| {
            Datagrams::to(address).map_err(|error| {
                Error::usage(format!(
                    "poses cannot be sent to {address}: {error}; give HOST:PORT, such as 127.0.0.1:9000"
                ))
            })
        });
        Ok(Self {
            print: arguments.print == Some(Print::Poses),
            continues_map: arguments.map.is_some(),
            datagrams: datagrams.transpose()?,
            site: None,
            published: None,
        })
    }

    /// Tells the site from now on whether the robot is lost.
    pub fn tell_losses_to(&mut self, site: Option<RobotLink>) {
        self.site = site;
    }
}

#[cfg(feature = "ros2")]
impl Outputs {
    /// Gives the poses to a publisher as well.
    pub fn publish_with(&mut self, publisher: impl PoseSink + 'static) {
        self.published = Some(Box::new(publisher));
    }
}

impl PoseSink for Outputs {
    fn take(&mut self, frame: &LiveFrame<'_>) -> Result<()> {
        if let Some(site) = &self.site {
            site.set_lost(frame.estimate.estimate.is_none());
        }
        if let Some(published) = &mut self.published {
            published.take(frame)?;
        }
        if !self.print && self.datagrams.is_none() {
            return Ok(());
        }
        let LiveFrame { estimate, latency_ms, ref map_from_odometry, is_recognised, .. } = *frame;
        let line = match self.continues_map {
            true => json_line_in_map(estimate, Some(latency_ms), is_recognised.then_some(map_from_odometry)),
            false => json_line(estimate, Some(latency_ms)),
        } + "\n";
        if let Some(datagrams) = &self.datagrams {
            datagrams.send(&line);
        }
        if self.print { console::print(&line) } else { Ok(()) }
    }
}

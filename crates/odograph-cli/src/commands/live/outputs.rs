//! Output of poses to other programs during a run.

use super::{LiveArguments, Print};
use crate::commands::site::RobotLink;
use crate::console;
use odograph::error::{Error, Result};
use odograph::trajectory::FrameEstimate;
use odograph_live::stream::{Datagrams, json_line};
use odograph_session::live::PoseSink;

/// Outputs of poses besides folder and page.
pub struct Outputs {
    print: bool,
    datagrams: Option<Datagrams>,
    site: Option<RobotLink>,
}

impl Outputs {
    pub fn new(arguments: &LiveArguments) -> Result<Self> {
        let datagrams = arguments.udp.as_deref().map(|address| {
            Datagrams::to(address)
                .map_err(|error| Error::usage(format!("poses cannot be sent to {address}: {error}")))
        });
        Ok(Self {
            print: arguments.print == Some(Print::Poses),
            datagrams: datagrams.transpose()?,
            site: None,
        })
    }

    /// Tells the site from now on whether the robot is lost.
    pub fn tell_losses_to(&mut self, site: Option<RobotLink>) {
        self.site = site;
    }
}

impl PoseSink for Outputs {
    fn take(&mut self, frame: &FrameEstimate, latency_ms: f64) -> Result<()> {
        if let Some(site) = &self.site {
            site.set_lost(frame.estimate.is_none());
        }
        if !self.print && self.datagrams.is_none() {
            return Ok(());
        }
        let line = json_line(frame, Some(latency_ms)) + "\n";
        if let Some(datagrams) = &self.datagrams {
            datagrams.send(&line);
        }
        if self.print { console::print(&line) } else { Ok(()) }
    }
}

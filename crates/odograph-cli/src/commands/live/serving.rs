//! The page of a run: started with it, and kept after it while there are viewers.

use crate::browser::OpeningBrowser;
use crate::{address, console, interrupt, qr_code};
use odograph::error::{Error, Result};
use odograph_live::server::new_token;
use odograph_live::{Hub, Phase, Server, ServerOptions};
use odograph_session::RUN_FILES;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

/// Where the page is, and for whom.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ServeArguments {
    /// Serve a page for the browser, at a port or address of this machine.
    ///
    /// [with no address: 8080] 8080 and localhost:8080 are for this machine only, 0.0.0.0:8080 is
    /// for others, too.
    #[arg(help_heading = "Page", long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "8080", value_parser = address::parse)]
    pub serve: Option<SocketAddr>,
    /// Token that a browser must give to be let in.
    ///
    /// For addresses that others can reach there always is one; it is made up and printed, if not
    /// given.
    #[arg(help_heading = "Page", long, value_name = "TOKEN")]
    pub token: Option<String>,
    /// Open the page in the browser of this machine.
    #[arg(help_heading = "Page", long)]
    pub open: bool,
}

impl ServeArguments {
    /// Fails if an option of the page is given without a page to serve.
    pub fn check(&self) -> Result<()> {
        let given = [("--token", self.token.is_some()), ("--open", self.open)];
        match given.into_iter().find(|(_, is_given)| *is_given && self.serve.is_none()) {
            Some((option, _)) => Err(Error::usage(format!(
                "{option} is for the page, which only --serve offers; add --serve, or leave {option} away"
            ))),
            None => Ok(()),
        }
    }
}

/// What can be downloaded: files by their names, in a folder.
pub struct Offer {
    pub folder: PathBuf,
    pub files: Vec<String>,
}

impl Offer {
    /// All files of a run's folder.
    pub fn of_run(folder: &Path) -> Self {
        let files =
            RUN_FILES.iter().copied().chain(["marks.csv", "gnss-received.csv"]).map(str::to_owned).collect();
        Self { folder: folder.to_owned(), files }
    }
}

/// Time for which the page stays after the end for a viewer that reloads it.
const GRACE: Duration = Duration::from_secs(10);

/// The hub of a run, and the server if requested.
pub struct Serving {
    hub: Arc<Hub>,
    server: Option<Server>,
    /// Whether the page is to be opened in the browser.
    opens: bool,
}

impl Serving {
    /// Serves a hub.
    pub fn start(arguments: &ServeArguments, hub: Arc<Hub>, offer: Offer) -> Result<Self> {
        let Some(address) = arguments.serve else {
            return Ok(Self { hub, server: None, opens: false });
        };
        let token = match &arguments.token {
            Some(token)
                if token.len() < 8 || !token.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-') =>
            {
                return Err(Error::usage("a token has at least 8 letters, digits or hyphens"));
            }
            Some(token) => Some(token.clone()),
            None if address.ip().is_loopback() => None,
            None => Some(new_token()?),
        };
        let options = ServerOptions { token, folder: Some(offer.folder), files: offer.files };
        let server = Server::start(address, Arc::clone(&hub), options)?;
        Ok(Self { hub, server: Some(server), opens: arguments.open })
    }

    /// The hub.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    /// Prints the addresses of the page unless `quiet`, one per line, the first with `more` at its
    /// end; on a terminal, the first as a QR code if others can reach it. Opens the page if that is
    /// asked for.
    pub fn show_address(&self, more: &str, quiet: bool) {
        let Some(server) = &self.server else { return };
        let reachable = address::reachable(server.address());
        let urls = server.urls_at(&reachable);
        if let Some(url) = urls.last().filter(|_| self.opens) {
            OpeningBrowser::at(url);
        }
        for (number, url) in urls.iter().enumerate().filter(|_| !quiet) {
            console::note(&match number {
                0 => format!("look at {url}{more}"),
                _ => format!("or at {url}"),
            });
        }
        let is_for_others = reachable.first().is_some_and(|address| !address.ip().is_loopback());
        if let Some(url) = urls.first().filter(|_| is_for_others && !quiet) {
            console::draw_on_terminal(|| qr_code::lines(url).unwrap_or_default());
        }
    }

    /// Prints the state of the run.
    pub fn set_phase(&self, phase: Phase, failure: Option<&Error>) {
        let mut status = self.hub.status();
        status.phase = phase;
        if let Some(error) = failure {
            status.message = Some(error.to_string());
        }
        self.hub.set_status(status);
    }

    /// Waits while there are viewers, unless the program is asked to end.
    pub fn linger(&self, quiet: bool) {
        if interrupt::asked() || self.server.is_none() || self.hub.viewers() == 0 {
            return;
        }
        if !quiet {
            console::note("the page stays while it is open in a browser; Ctrl-C ends at once");
        }
        let mut last_seen = Instant::now();
        while !interrupt::asked() && last_seen.elapsed() < GRACE {
            if self.hub.viewers() > 0 {
                last_seen = Instant::now();
            }
            thread::sleep(Duration::from_millis(100));
        }
    }

    /// Waits until the program is asked to end.
    pub fn stay(&self) {
        while !interrupt::asked() {
            thread::sleep(Duration::from_millis(100));
        }
    }
}

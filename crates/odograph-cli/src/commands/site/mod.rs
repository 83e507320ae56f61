//! `odograph site`: one map for a fleet, and the link of a robot to it.

mod reached;
mod tokens;

use crate::{Outcome, address, console, files, interrupt};
use odograph::error::{Error, Result};
use odograph::formats::decimal::Rounded;
use odograph_live::server::listener::not_served;
use odograph_live::server::new_token;
use odograph_map::{MapFile, Session};
use odograph_site::{DEFAULT_PORT, LinkReport, Site, SiteIdentity, SiteLink, SiteServer, SiteStatus};
use reached::{GivenSite, ReachedSite, SiteCredentials};
use serde_json::{Value, json};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

/// Serve one map for a fleet, and manage its robots.
#[derive(Debug, clap::Args)]
pub struct SiteArguments {
    #[command(subcommand)]
    command: SiteCommand,
}

#[derive(Debug, clap::Subcommand)]
enum SiteCommand {
    Serve(ServeSiteArguments),
    Send(SendArguments),
    Robots(RobotsArguments),
    Withdraw(RobotArguments),
    Restore(RestoreArguments),
    Token(tokens::TokenArguments),
}

/// Serve the map of a fleet.
///
/// Robots send to it with `live` or `run` and --site. Ends with Ctrl-C; nothing that was
/// acknowledged is lost, however it ends.
#[derive(Debug, clap::Args)]
#[command(after_help = SERVE_EXAMPLES)]
struct ServeSiteArguments {
    /// The folder of the site: records.sqlite, map.gpkg and tokens.json. It is made where it is not
    /// there.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    /// Address to serve at.
    ///
    /// 8137 and 127.0.0.1:8137 are for this machine only, 0.0.0.0:8137 is for others, too.
    #[arg(long, value_name = "ADDRESS", value_parser = address::parse,
          default_value_t = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), DEFAULT_PORT))]
    listen: SocketAddr,
    /// Token of the site, for its page and for robots that have none of their own.
    ///
    /// For addresses that others can reach there always is one; it is made up and printed, if not
    /// given. `odograph site token` makes those of robots.
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// Certificate with which the site is served over HTTPS, as PEM.
    ///
    /// Those that it was signed with follow in the same file.
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    tls_certificate: Option<PathBuf>,
    /// Private key of that certificate, as PEM without a passphrase.
    #[arg(long, value_name = "FILE", requires = "tls_certificate")]
    tls_key: Option<PathBuf>,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const SERVE_EXAMPLES: &str = "\
Examples:
  odograph site serve hall/
  odograph site serve hall/ --listen 0.0.0.0:8137 --token 5f1c-hall-carts
  odograph site serve hall/ --listen 0.0.0.0:8137 --tls-certificate hall.pem --tls-key hall.key";

/// Send what a map has of a robot and the site has not.
///
/// After a run that ended before the site had everything.
#[derive(Debug, clap::Args)]
struct SendArguments {
    /// The map of the robot.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    #[command(flatten)]
    at: ReachedSite,
    /// Name of the robot, as in the run.
    #[arg(long, value_name = "NAME")]
    robot: String,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

/// List the robots of a site.
#[derive(Debug, clap::Args)]
struct RobotsArguments {
    #[command(flatten)]
    at: ReachedSite,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Take what a robot sent out of the map.
///
/// Its records are kept, and those that it goes on to send.
#[derive(Debug, clap::Args)]
struct RobotArguments {
    /// Name of the robot.
    #[arg(value_name = "ROBOT")]
    robot: String,
    #[command(flatten)]
    at: ReachedSite,
}

/// Put a robot that was withdrawn or quarantined into the map again.
#[derive(Debug, clap::Args)]
struct RestoreArguments {
    #[command(flatten)]
    of: RobotArguments,
    /// Whatever its metres are: never quarantine it.
    #[arg(long)]
    trust: bool,
}

/// Where a robot sends its map.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct SiteLinkArguments {
    /// Send the map to the site of a fleet, at the address that it printed.
    ///
    /// Nothing waits for the network: what the site has not, the map keeps. `odograph site send`
    /// sends the rest later.
    #[arg(help_heading = "Site", long, value_name = "URL")]
    pub site: Option<GivenSite>,
    /// Name of this robot, different from that of every other.
    #[arg(help_heading = "Site", long, value_name = "NAME")]
    pub robot: Option<String>,
    #[command(flatten)]
    credentials: SiteCredentials,
}

/// Time without an acknowledgement after which a run ends without the site.
const PATIENCE: Duration = Duration::from_secs(20);

impl SiteLinkArguments {
    /// Fails where a site is given and the robot that sends to it has no name, and where the token
    /// cannot be read.
    pub fn check(&self) -> Result<()> {
        match (&self.site, &self.robot) {
            (Some(site), Some(_)) => self.credentials.client(site).map(drop),
            (None, _) if self.credentials.are_any() => {
                Err(Error::usage("--site-token is of the site to which the map is sent: --site URL"))
            }
            (Some(_), None) => Err(Error::usage(
                "--site needs the name of this robot, different from that of every other: --robot NAME",
            )),
            _ => Ok(()),
        }
    }

    /// The same for the run that has begun in a folder, whose robot is the one it was begun with.
    pub fn of_resumed(&self, begun_with: Option<&str>, folder: &Path) -> Result<Self> {
        let (folder, site) = (folder.display(), self.site.clone());
        match (begun_with, &self.robot) {
            (Some(name), Some(other)) if name != other => Err(Error::usage(format!(
                "the run in {folder} was begun as robot {name}, not {other}; leave --robot away"
            ))),
            (None, _) if site.is_some() || self.robot.is_some() => Err(Error::usage(format!(
                "the run in {folder} was begun without the name of a robot, and a site cannot take its map; begin it \
                 anew with --site, --robot and --force"
            ))),
            (name, _) => {
                let arguments =
                    Self { site, robot: name.map(str::to_owned), credentials: self.credentials.clone() };
                arguments.check().map(|()| arguments)
            }
        }
    }

    /// Begins to send a map, where a site is given. What the site says last is in `site.json` of
    /// the folder.
    pub fn start(&self, map: &Path, folder: &Path, quiet: bool) -> Result<Option<RobotLink>> {
        let (Some(site), Some(robot)) = (&self.site, &self.robot) else { return Ok(None) };
        let path = folder.join("site.json");
        let mut problem = None;
        let listening = Box::new(move |report: &LinkReport| {
            if let Some(status) = &report.status {
                // Without it the run goes on as without a site.
                let _ = files::write(&path, json!(status).to_string().as_bytes());
            }
            if report.problem != problem {
                problem.clone_from(&report.problem);
                if let Some(problem) = problem.as_ref().filter(|_| !quiet) {
                    console::warn(&format!("{problem}; the map keeps what it has not"));
                }
            }
        });
        let link = SiteLink::start(map, robot, self.credentials.client(site)?, listening)?;
        let (map_shown, reached) = (console::quoted(map), self.credentials.shown(site)?);
        let command = format!("odograph site send {map_shown} {reached} --robot {robot}");
        Ok(Some(RobotLink { link: Arc::new(link), map: map.to_owned(), command }))
    }
}

/// The link of a run.
#[derive(Debug, Clone)]
pub struct RobotLink {
    link: Arc<SiteLink>,
    map: PathBuf,
    /// What sends the rest later.
    command: String,
}

impl RobotLink {
    /// Tells whether the robot is lost.
    pub fn set_lost(&self, lost: bool) {
        self.link.set_lost(lost);
    }

    /// Sends the rest, and says what became of it.
    pub fn finish(self, quiet: bool) {
        let Some(link) = Arc::into_inner(self.link) else { return };
        let report = link.finish(PATIENCE, &|| !interrupt::asked());
        // The run could not fold the log of the map while the link was reading.
        let mut log = self.map.clone().into_os_string();
        log.push("-wal");
        if Path::new(&log).exists() {
            let _ = MapFile::open(&self.map).and_then(MapFile::close);
        }
        if !report.complete {
            console::warn(&format!("the site has not everything yet; {} sends the rest", self.command));
        }
        if !quiet {
            tell(&report);
        }
    }
}

/// Says what became of a robot's records.
fn tell(report: &LinkReport) {
    let Some(status) = &report.status else { return };
    let taken = match report.acknowledged {
        0 if report.complete => "the site had all records already".to_owned(),
        1 => "the site took 1 record".to_owned(),
        records => format!("the site took {records} records"),
    };
    console::note(&match (status, status.map_from_odom) {
        (SiteStatus { reason: Some(reason), state, .. }, _) if !state.is_merged() => {
            format!("this robot is {} by the site: {reason}", state.name())
        }
        (_, Some(place)) => format!(
            "{taken}; its map from this odometry: x {:.3} m, y {:.3} m, heading {:.2}°, scale {:.4}",
            Rounded(place.x_m),
            Rounded(place.y_m),
            Rounded(place.heading_rad.to_degrees()),
            place.scale
        ),
        (_, None) => format!("{taken}; it has not recognised where they are yet"),
    });
}

/// Runs the command.
pub fn site(arguments: SiteArguments) -> Result<Outcome> {
    match arguments.command {
        SiteCommand::Token(arguments) => tokens::token(arguments),
        SiteCommand::Serve(arguments) => serve(&arguments),
        SiteCommand::Send(arguments) => send(&arguments),
        SiteCommand::Robots(arguments) => robots(&arguments),
        SiteCommand::Withdraw(arguments) => set_robot(
            &arguments,
            "withdraw",
            "is withdrawn: what it sent is taken out of the map and its records are kept; odograph site restore \
             puts it in again",
        ),
        SiteCommand::Restore(RestoreArguments { of, trust: false }) => {
            set_robot(&of, "restore", "is restored: its records are put into the map again")
        }
        SiteCommand::Restore(RestoreArguments { of, trust: true }) => {
            set_robot(&of, "trust", "is trusted: its records are put into the map, whatever its metres are")
        }
    }
}

/// Decides about a robot, and says what was `done`.
fn set_robot(arguments: &RobotArguments, action: &str, done: &str) -> Result<Outcome> {
    arguments.at.client()?.set_robot(&arguments.robot, action)?;
    console::print(&format!("{} {done}\n", console::name(&arguments.robot)))?;
    Ok(Outcome::Done)
}

fn serve(arguments: &ServeSiteArguments) -> Result<Outcome> {
    let token = match &arguments.token {
        Some(token) if token.len() < 8 || !token.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-') => {
            return Err(Error::usage("a token has at least 8 letters, digits or hyphens"));
        }
        Some(token) => Some(token.clone()),
        None if arguments.listen.ip().is_loopback() => None,
        None => Some(new_token()?),
    };
    let identity = match (&arguments.tls_certificate, &arguments.tls_key) {
        (Some(certificate), Some(key)) => Some(SiteIdentity::from_files(certificate, key)?),
        _ => None,
    };
    // Nothing is made for an address that cannot be served.
    drop(TcpListener::bind(arguments.listen).map_err(|error| not_served(arguments.listen, &error))?);
    files::check_output_folder(&arguments.folder)?;
    files::make_folder(&arguments.folder)?;
    let site = Arc::new(Site::open(&arguments.folder)?);
    let is_readable = identity.is_none() && !arguments.listen.ip().is_loopback();
    let server = match identity {
        Some(identity) => SiteServer::start_encrypted(arguments.listen, Arc::clone(&site), token, identity)?,
        None => SiteServer::start(arguments.listen, Arc::clone(&site), token)?,
    };
    if is_readable && !arguments.quiet {
        console::warn(
            "nothing is encrypted: whoever is on the network can read tokens and maps; give --tls-certificate and \
             --tls-key, or use a tunnel",
        );
    }
    if !arguments.quiet {
        console::note(&format!("the site is at {}; Ctrl-C ends it", server.url()));
    }
    let mut reported = None;
    while !interrupt::asked() {
        for refused in server.new_refusals() {
            console::warn(&refused);
        }
        let failure = site.failure();
        if failure != reported {
            match &failure {
                Some(failure) => console::warn(&format!(
                    "nothing is merged at the moment: {failure}; what robots send is kept"
                )),
                None => console::note("merging goes on"),
            }
            reported = failure;
        }
        thread::sleep(Duration::from_millis(100));
    }
    drop(server);
    site.close();
    match site.failure() {
        Some(failure) => Err(Error::output(format!(
            "not everything is merged: {failure}; the records are kept, and the site merges them when it is started \
             again"
        ))),
        None => Ok(Outcome::Done),
    }
}

fn send(arguments: &SendArguments) -> Result<Outcome> {
    let file = MapFile::open_read_only(&arguments.map)?;
    let named =
        |session: &Session| session.origin.as_ref().is_some_and(|origin| origin.robot == arguments.robot);
    if !file.sessions()?.iter().any(named) {
        return Err(Error::input(format!(
            "{} has no session of {}; a run has a robot with --robot",
            arguments.map.display(),
            arguments.robot
        )));
    }
    drop(file);
    let client = arguments.at.client()?;
    let link = SiteLink::start(&arguments.map, &arguments.robot, client, Box::new(|_| {}))?;
    let report = link.finish(PATIENCE, &|| !interrupt::asked());
    if !report.complete {
        let problem = report.problem.unwrap_or_else(|| "interrupted".to_owned());
        return Err(Error::input(format!("{problem}; the map keeps what the site has not")));
    }
    if !arguments.quiet {
        tell(&report);
    }
    Ok(Outcome::Done)
}

fn robots(arguments: &RobotsArguments) -> Result<Outcome> {
    let client = arguments.at.client()?;
    let state = client.state()?;
    let text = if arguments.json { format!("{state:#}\n") } else { list(&state) };
    console::print(&text)?;
    // Whoever reads the list must know that it is old.
    client.failure_in(&state).map_or(Ok(Outcome::Done), |failure| Err(Error::input(failure)))
}

/// A line for each session, and for each kind of request that was refused.
fn list(state: &Value) -> String {
    let mut text = String::new();
    for session in state["sessions"].as_array().into_iter().flatten() {
        let name = session["robot"].as_str().unwrap_or_default();
        let robot = &state["robots"][name];
        let recognised = if session["connected"] == json!(true) { "" } else { ", not recognised yet" };
        let condition = match robot["state"].as_str() {
            Some(state @ ("quarantined" | "withdrawn")) => {
                format!("{state}: {}", console::name(robot["reason"].as_str().unwrap_or_default()))
            }
            _ => {
                let doubt = session["doubt"].as_str().map_or(String::new(), |doubt| format!(": {doubt}"));
                format!("{}{recognised}{doubt}", session["condition"].as_str().unwrap_or_default())
            }
        };
        text += &format!(
            "{name:<16} {} of {} keyframes in the map, {} loops with others, {condition}\n",
            session["keyframes"], session["records"], session["loops"]
        );
    }
    for refusal in state["refusals"].as_array().into_iter().flatten() {
        let [from, why] =
            ["address", "reason"].map(|key| console::name(refusal[key].as_str().unwrap_or_default()));
        text += &format!(
            "refused {} times, last {} s ago, from {from}: {why}\n",
            refusal["count"], refusal["ago_s"]
        );
    }
    text
}

//! The site's web server: what robots send, what it answers, and the page.

use crate::access::{Caller, Denial, SiteAccess};
use crate::encryption::SiteIdentity;
use crate::limits::{Limits, Permit};
use crate::protocol::{MAX_BODY, MAX_DESCRIPTION, RobotState, SessionDescription, SiteStatus};
use crate::records::NotStored;
use crate::refusals::{Refusal, RefusalKind, Refusals};
use crate::site::{RequestRefusal, Site};
use odograph::error::{Error, Result};
use odograph_live::server::http::{self, Answer, HttpRefusal, Method, Request, RequestReader};
use odograph_live::server::listener::{Connection, Listener};
use odograph_map::SessionOrigin;
use odograph_video::png_from_rgba;
use serde_json::{Value, json};
use std::cell::RefCell;
use std::io;
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// The port of a site.
pub const DEFAULT_PORT: u16 = 8137;
/// Maximum number of connections; a robot needs one at a time.
const MAX_CONNECTIONS: usize = 64;
/// Maximum number of pixels of the mosaic on the page; a larger mosaic is shown coarser.
const MAX_PIXELS: usize = 4 << 20;

const JSON: &str = "application/json";
const NOT_FOUND: HttpRefusal = HttpRefusal(404, "Not Found");

/// The page's files: path, content type and content.
const PAGE: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/site.js", "text/javascript; charset=utf-8", include_str!("page/site.js")),
];

/// A running server of a site. It stops when dropped.
#[derive(Debug)]
pub struct SiteServer {
    listener: Listener,
    state: Arc<SiteServerState>,
    token: Option<String>,
}

/// What the threads of all connections share.
#[derive(Debug)]
struct SiteServerState {
    site: Arc<Site>,
    access: SiteAccess,
    identity: Option<SiteIdentity>,
    limits: Limits,
    refusals: Mutex<Refusals>,
}

impl SiteServer {
    /// Serves a site at an address; port 0 selects any free port. A request needs the token of a
    /// robot, as a bearer token, for the records of that robot, and otherwise the token of the
    /// site, as a bearer token, in the query or in the cookie that this sets. Without a token of
    /// the site only this machine is served.
    ///
    /// # Errors
    /// If the address is not available, or can be reached by others and there is no token.
    pub fn start(address: SocketAddr, site: Arc<Site>, token: Option<String>) -> Result<Self> {
        Self::start_as(address, site, token, None)
    }

    /// As [`SiteServer::start`], over HTTPS with this certificate.
    ///
    /// # Errors
    /// As [`SiteServer::start`].
    pub fn start_encrypted(
        address: SocketAddr,
        site: Arc<Site>,
        token: Option<String>,
        identity: SiteIdentity,
    ) -> Result<Self> {
        Self::start_as(address, site, token, Some(identity))
    }

    fn start_as(
        address: SocketAddr,
        site: Arc<Site>,
        token: Option<String>,
        identity: Option<SiteIdentity>,
    ) -> Result<Self> {
        let access = SiteAccess::new(site.folder(), token.clone());
        let refusals = Mutex::new(Refusals::new(Instant::now()));
        let state = Arc::new(SiteServerState { site, access, identity, limits: Limits::default(), refusals });
        let shared = Arc::clone(&state);
        let serve = move |connection: &Connection, stream: TcpStream| serve(&shared, connection, stream);
        let listener = Listener::start(address, token.is_some(), MAX_CONNECTIONS, serve)?;
        Ok(Self { listener, state, token })
    }

    /// The address on which it listens.
    pub fn address(&self) -> SocketAddr {
        self.listener.address()
    }

    /// The URL of the page and for robots, including the token if there is one.
    pub fn url(&self) -> String {
        let token = self.token.as_ref().map_or(String::new(), |token| format!("?token={token}"));
        let scheme = if self.state.identity.is_some() { "https" } else { "http" };
        format!("{scheme}://{}/{token}", self.address())
    }

    /// What was refused since the last call, as lines for a log: each refusal when it is new, and
    /// once a minute while it goes on. No token is in them.
    pub fn new_refusals(&self) -> Vec<String> {
        self.state.lock_refusals().new_lines(Instant::now())
    }
}

impl SiteServerState {
    fn lock_refusals(&self) -> MutexGuard<'_, Refusals> {
        self.refusals.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn refused(&self, refusal: &Refusal, from: IpAddr) {
        self.lock_refusals().add(refusal, from, Instant::now());
    }

    /// Who sends a request. Fails if whoever it is may not.
    fn allowed(&self, request: &Request) -> std::result::Result<Caller, Denial> {
        let caller = self.access.caller(request)?;
        match (request.method, robot_in(&request.path)) {
            (Method::Post, Some(robot)) => self.access.check_sender(&caller, robot)?,
            // Which robot's it is, is in the body.
            (Method::Post, None) if request.path == "/sessions" => {}
            _ => self.access.check_operator(&caller)?,
        }
        Ok(caller)
    }

    /// Decides about a request before its body is read. Returns how long that may be, and leave to
    /// have it in memory where it may be long.
    fn admit(&self, request: &Request) -> std::result::Result<(usize, Option<Permit>), Denial> {
        self.allowed(request)?;
        // What is no name of a robot has no records, either.
        let robot = robot_in(&request.path).filter(|robot| odograph_map::check_name(robot).is_ok());
        let most = if robot.is_some() { MAX_BODY } else { MAX_DESCRIPTION };
        let length = request.header("content-length").and_then(|length| length.parse().ok()).unwrap_or(0);
        if length > most {
            return Err(Denial::too_large(robot, most));
        }
        let Some(robot) = robot else { return Ok((most, None)) };
        let now = Instant::now();
        let flood = |reason| Denial::flood(robot, reason);
        self.limits.request(robot, now).map_err(flood)?;
        Ok((most, Some(self.limits.body(robot, length, now).map_err(flood)?)))
    }
}

/// The robot whose records a request has, by its path.
fn robot_in(path: &str) -> Option<&str> {
    Some(path.strip_prefix("/records/")?.split_once('/')?.0)
}

/// Serves one connection: requests in sequence.
fn serve(state: &SiteServerState, connection: &Connection, stream: TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let from = stream.peer_addr()?.ip();
    let mut reader = match &state.identity {
        Some(identity) => RequestReader::encrypted(stream, identity.accepted()?),
        None => RequestReader::new(stream),
    };
    // Until the request is answered.
    let permit = RefCell::new(None);
    let denied = RefCell::new(None);
    let admit = |request: &Request| match state.admit(request) {
        Ok((most, leave)) => {
            permit.replace(leave);
            connection.set_busy();
            Ok(most)
        }
        // Nothing of the body is read.
        Err(denial) => {
            state.refused(&denial.refusal, from);
            denied.replace(Some(denial.answer(request)));
            Err(HttpRefusal(denial.status, denial.phrase))
        }
    };
    while !connection.is_ended() {
        let request = match reader.next_admitted(&admit) {
            Ok(Some(request)) => request,
            Ok(None) => return Ok(()),
            Err(refusal) => {
                let answer = denied.take().unwrap_or_else(|| Answer::refusal(refusal));
                return http::refuse_with(reader.into_stream(), &answer);
            }
        };
        let answer = answer(state, &request, from);
        permit.take();
        answer.write(reader.stream(), &request)?;
        if !request.keep_alive {
            return Ok(());
        }
        connection.set_idle();
    }
    Ok(())
}

fn answer(state: &SiteServerState, request: &Request, from: IpAddr) -> Answer {
    let denied = |denial: &Denial| {
        state.refused(&denial.refusal, from);
        denial.answer(request)
    };
    // Again: the token may have been revoked while the body came.
    let caller = match state.allowed(request) {
        Ok(caller) => caller,
        Err(denial) => return denied(&denial),
    };
    match (caller, request.method, request.path.as_str()) {
        // Moves the token from the URL into a cookie.
        (Caller::Operator { sets_cookie: true }, Method::Get, "/") => {
            Answer::refusal(HttpRefusal(303, "See Other"))
                .with("Location", "/")
                .with("Set-Cookie", state.access.cookie(state.identity.is_some()))
        }
        (_, Method::Get | Method::Head, path) => get(state, path),
        (caller, Method::Post, path) => {
            post(state, request, path, &caller, from).unwrap_or_else(|denial| denied(&denial))
        }
    }
}

fn get(state: &SiteServerState, path: &str) -> Answer {
    if let Some((_, content_type, body)) = PAGE.iter().find(|(known, ..)| *known == path) {
        return Answer::ok(content_type, *body);
    }
    match path {
        "/state" => {
            let mut page = state.site.page();
            page["refusals"] = state.lock_refusals().page(Instant::now());
            Answer::ok(JSON, page.to_string())
        }
        "/mosaic.png" => mosaic(&state.site),
        _ => Answer::refusal(NOT_FOUND),
    }
}

/// The mosaic, with its placement in headers: metres of a pixel, and where the middle of its upper
/// left pixel is.
fn mosaic(site: &Site) -> Answer {
    let picture = match site.mosaic(MAX_PIXELS) {
        Ok(Some(picture)) => picture,
        Ok(None) => return Answer::nothing(),
        Err(_) => return Answer::refusal(NOT_FOUND),
    };
    let placement = picture.placement;
    match png_from_rgba(picture.width, picture.height, &picture.rgba) {
        Ok(bytes) => Answer::ok("image/png", bytes).with(
            "X-Placement",
            format!("{} {} {}", placement.metres_per_pixel, placement.x_m, placement.y_m),
        ),
        Err(_) => Answer::refusal(HttpRefusal(500, "Internal Server Error")),
    }
}

fn post(
    state: &SiteServerState,
    request: &Request,
    path: &str,
    caller: &Caller,
    from: IpAddr,
) -> std::result::Result<Answer, Denial> {
    let site = &state.site;
    if path == "/sessions" {
        let description = serde_json::from_slice::<SessionDescription>(&request.body)
            .map_err(|error| RequestRefusal::Malformed(Error::input(format!("the session: {error}"))))
            .and_then(|description| description.validated().map_err(RequestRefusal::Malformed));
        let description = match description {
            Ok(description) => description,
            Err(refusal) => return Ok(status(state, caller, None, from, Err(refusal))),
        };
        let robot = description.robot.clone();
        state.access.check_sender(caller, &robot)?;
        state.limits.request(&robot, Instant::now()).map_err(|reason| Denial::flood(&robot, reason))?;
        return Ok(status(state, caller, Some(&robot), from, site.describe(description)));
    }
    if let Some((robot, key)) = path.strip_prefix("/records/").and_then(|rest| rest.split_once('/')) {
        let origin = SessionOrigin { robot: robot.to_owned(), key: key.to_owned() };
        let lost = request.query_value("lost") == Some("true");
        let outcome = match origin.validated() {
            Ok(origin) => site.take(&origin, &request.body, lost),
            Err(error) => {
                return Ok(status(state, caller, None, from, Err(RequestRefusal::Malformed(error))));
            }
        };
        return Ok(status(state, caller, Some(robot), from, outcome));
    }
    Ok(decide(site, path))
}

/// Carries out what a person has decided about a robot.
fn decide(site: &Site, path: &str) -> Answer {
    if let Some((robot, action)) = path.strip_prefix("/robots/").and_then(|rest| rest.split_once('/')) {
        let state = match action {
            "withdraw" => RobotState::Withdrawn,
            "restore" => RobotState::Active,
            "trust" => RobotState::Trusted,
            _ => return Answer::refusal(NOT_FOUND),
        };
        return match site.set_robot(robot, state) {
            Ok(true) => {
                let answer = json!({ "robot": robot, "state": state, "failure": site.failure() });
                Answer::ok(JSON, answer.to_string())
            }
            Ok(false) => problem(404, "Not Found", "the site knows no robot of this name"),
            Err(error) => problem(503, "Service Unavailable", &error.to_string()),
        };
    }
    Answer::refusal(NOT_FOUND)
}

/// The answer to a request of a robot; what is refused as such is remembered.
fn status(
    state: &SiteServerState,
    caller: &Caller,
    robot: Option<&str>,
    from: IpAddr,
    outcome: std::result::Result<SiteStatus, RequestRefusal>,
) -> Answer {
    let robot = match caller {
        Caller::Robot(robot) => Some(robot.as_str()),
        Caller::Operator { .. } => robot,
    };
    let refused = |reason: &str| {
        let of_robot = robot.map_or(String::new(), |robot| format!("robot {robot}: "));
        let (kind, robot) = (RefusalKind::Content, robot.map(str::to_owned));
        state.refused(&Refusal { kind, robot, reason: format!("{of_robot}{reason}") }, from);
    };
    match outcome {
        Ok(status) => Answer::ok(JSON, json!(status).to_string()),
        Err(RequestRefusal::Malformed(error)) => {
            refused(&error.to_string());
            problem(422, "Unprocessable Content", &error.to_string())
        }
        Err(RequestRefusal::NotStored(NotStored::Unknown)) => {
            problem(404, "Not Found", "the session has not been described")
        }
        Err(RequestRefusal::NotStored(NotStored::OutOfOrder(last))) => conflict(&json!({
            "problem": "a record does not follow the last one that is stored",
            "acknowledged": last,
        })),
        Err(RequestRefusal::NotStored(NotStored::Conflict(number))) => {
            let what = format!(
                "record {number} is stored already and is another: does a second robot have the same name?"
            );
            refused(&what);
            conflict(&json!({ "problem": what, "differs": number }))
        }
        Err(RequestRefusal::NotStored(NotStored::Failed(error))) => {
            problem(503, "Service Unavailable", &error.to_string())
        }
    }
}

fn conflict(body: &Value) -> Answer {
    Answer { status: 409, reason: "Conflict", ..Answer::ok(JSON, body.to_string()) }
}

fn problem(status: u16, reason: &'static str, what: &str) -> Answer {
    Answer { status, reason, ..Answer::ok(JSON, json!({ "problem": what }).to_string()) }
}

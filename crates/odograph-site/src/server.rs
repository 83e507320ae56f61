//! The site's web server: what robots send, what it answers, and the page.

use crate::protocol::{MAX_BODY, MAX_DESCRIPTION, RobotState, SessionDescription, SiteStatus};
use crate::records::NotStored;
use crate::site::{RequestRefusal, Site};
use odograph::error::Result;
use odograph_live::server::access::{Access, AccessVerdict};
use odograph_live::server::http::{self, Answer, HttpRefusal, Method, Request, RequestReader};
use odograph_live::server::listener::{Connection, Listener};
use odograph_map::SessionOrigin;
use serde_json::{Value, json};
use std::io;
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;

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
    token: Option<String>,
}

/// What the threads of all connections share.
#[derive(Debug)]
struct SiteServerState {
    site: Arc<Site>,
    access: Access,
}

impl SiteServer {
    /// Serves a site at an address; port 0 selects any free port. With a token every request must
    /// have it, as a bearer token, in the query or in the cookie that this sets; without one only
    /// this machine is served.
    ///
    /// # Errors
    /// If the address is not available, or can be reached by others and there is no token.
    pub fn start(address: SocketAddr, site: Arc<Site>, token: Option<String>) -> Result<Self> {
        let state = SiteServerState { site, access: Access::new(token.clone()) };
        let serve = move |connection: &Connection, stream: TcpStream| serve(&state, connection, stream);
        let listener = Listener::start(address, token.is_some(), MAX_CONNECTIONS, serve)?;
        Ok(Self { listener, token })
    }

    /// The address on which it listens.
    pub fn address(&self) -> SocketAddr {
        self.listener.address()
    }

    /// The URL of the page and for robots, including the token if there is one.
    pub fn url(&self) -> String {
        let token = self.token.as_ref().map_or(String::new(), |token| format!("?token={token}"));
        format!("http://{}/{token}", self.address())
    }
}

/// Serves one connection: requests in sequence.
fn serve(state: &SiteServerState, connection: &Connection, stream: TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let mut reader = RequestReader::new(stream);
    let admit = |request: &Request| match state.access.judge(request) {
        // Nothing of a stranger's body is read.
        AccessVerdict::Denied => Err(HttpRefusal(403, "Forbidden")),
        _ => {
            connection.set_busy();
            Ok(if request.path.starts_with("/records/") { MAX_BODY } else { MAX_DESCRIPTION })
        }
    };
    while !connection.is_ended() {
        let request = match reader.next_admitted(&admit) {
            Ok(Some(request)) => request,
            Ok(None) => return Ok(()),
            Err(refusal) => return http::refuse(reader.into_stream(), refusal),
        };
        answer(state, &request).write(reader.stream(), &request)?;
        if !request.keep_alive {
            return Ok(());
        }
        connection.set_idle();
    }
    Ok(())
}

fn answer(state: &SiteServerState, request: &Request) -> Answer {
    let verdict = state.access.judge(request);
    match (verdict, request.method, request.path.as_str()) {
        (AccessVerdict::Denied, ..) => Answer::refusal(HttpRefusal(403, "Forbidden")),
        // Moves the token from the URL into a cookie.
        (AccessVerdict::AllowedWithCookie, Method::Get, "/") => {
            Answer::refusal(HttpRefusal(303, "See Other"))
                .with("Location", "/")
                .with("Set-Cookie", state.access.cookie())
        }
        (_, Method::Get | Method::Head, path) => get(&state.site, path),
        (_, Method::Post, path) => post(&state.site, request, path),
    }
}

fn get(site: &Site, path: &str) -> Answer {
    if let Some((_, content_type, body)) = PAGE.iter().find(|(known, ..)| *known == path) {
        return Answer::ok(content_type, *body);
    }
    match path {
        "/state" => Answer::ok(JSON, site.page().to_string()),
        "/mosaic.png" => mosaic(site),
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
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, picture.width as u32, picture.height as u32);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder.write_header().and_then(|mut writer| writer.write_image_data(&picture.rgba));
    match written {
        Ok(()) => {
            let placement = picture.placement;
            Answer::ok("image/png", bytes).with(
                "X-Placement",
                format!("{} {} {}", placement.metres_per_pixel, placement.x_m, placement.y_m),
            )
        }
        Err(_) => Answer::refusal(HttpRefusal(500, "Internal Server Error")),
    }
}

fn post(site: &Site, request: &Request, path: &str) -> Answer {
    if path == "/sessions" {
        return match serde_json::from_slice::<SessionDescription>(&request.body) {
            Ok(description) => status(site.describe(description)),
            Err(error) => problem(422, "Unprocessable Content", &format!("the session: {error}")),
        };
    }
    if let Some((robot, key)) = path.strip_prefix("/records/").and_then(|rest| rest.split_once('/')) {
        let origin = SessionOrigin { robot: robot.to_owned(), key: key.to_owned() };
        let lost = request.query_value("lost") == Some("true");
        return match origin.validated() {
            Ok(origin) => status(site.take(&origin, &request.body, lost)),
            Err(error) => status(Err(RequestRefusal::Malformed(error))),
        };
    }
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

fn status(outcome: std::result::Result<SiteStatus, RequestRefusal>) -> Answer {
    match outcome {
        Ok(status) => Answer::ok(JSON, json!(status).to_string()),
        Err(RequestRefusal::Malformed(error)) => problem(422, "Unprocessable Content", &error.to_string()),
        Err(RequestRefusal::NotStored(NotStored::Unknown)) => {
            problem(404, "Not Found", "the session has not been described")
        }
        Err(RequestRefusal::NotStored(NotStored::OutOfOrder(last))) => conflict(&json!({
            "problem": "a record does not follow the last one that is stored",
            "acknowledged": last,
        })),
        Err(RequestRefusal::NotStored(NotStored::Conflict(number))) => conflict(&json!({
            "problem": format!("record {number} is stored already and is another: does a second robot have the same name?"),
            "differs": number,
        })),
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

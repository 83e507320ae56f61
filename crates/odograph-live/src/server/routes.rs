//! The routes of the server.

use super::LiveServerState;
use super::access::AccessVerdict;
use super::archive::Archive;
use super::deadline::Deadlined;
use super::http::{ANSWER_PATIENCE, Answer, HttpRefusal, Method, Request, safe_in_header};
use crate::ground::tile_png;
use crate::shown::Phase;
use odograph::formats::track_record::TrackRecord;
use odograph::mosaic::MosaicSquare;
use serde_json::json;
use std::fs::File;
use std::io::{self, Read, Write};

/// What follows a response.
pub enum Next {
    /// Another request.
    Request,
    /// The connection has been upgraded to a WebSocket.
    Socket,
}

/// The page's files: path, content type and content. All of them are compiled into the program.
const PAGE: [(&str, &str, &str); 10] = [
    ("/", "text/html; charset=utf-8", include_str!("../page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("../page/style.css")),
    ("/icon.svg", "image/svg+xml", include_str!("../page/icon.svg")),
    // What browsers ask for that do not read the page's link to its icon.
    ("/favicon.ico", "image/svg+xml", include_str!("../page/icon.svg")),
    ("/app.js", "text/javascript; charset=utf-8", include_str!("../page/app.js")),
    ("/track.js", "text/javascript; charset=utf-8", include_str!("../page/track.js")),
    ("/map.js", "text/javascript; charset=utf-8", include_str!("../page/map.js")),
    ("/camera.js", "text/javascript; charset=utf-8", include_str!("../page/camera.js")),
    ("/calibration.js", "text/javascript; charset=utf-8", include_str!("../page/calibration.js")),
    ("/plots.js", "text/javascript; charset=utf-8", include_str!("../page/plots.js")),
];

const NOT_FOUND: HttpRefusal = HttpRefusal(404, "Not Found");
const JSON: &str = "application/json";

/// Answers a request.
pub fn answer(shared: &LiveServerState, request: &Request, stream: &mut Deadlined) -> io::Result<Next> {
    let verdict = shared.access.judge(request);
    let answer = match (verdict, request.method, request.path.as_str()) {
        (AccessVerdict::Denied, _, _) => Answer::refusal(HttpRefusal(403, "Forbidden")),
        // Moves the token from the URL into a cookie.
        (AccessVerdict::AllowedWithCookie, Method::Get, "/") => {
            Answer::refusal(HttpRefusal(303, "See Other"))
                .with("Location", "/")
                .with("Set-Cookie", shared.access.cookie())
        }
        (_, Method::Get, "/socket") => match upgrade(request) {
            Ok(head) => {
                stream.allow(ANSWER_PATIENCE);
                stream.write_all(head.as_bytes())?;
                return Ok(Next::Socket);
            }
            Err(refusal) => Answer::refusal(refusal),
        },
        (_, Method::Get | Method::Head, path) if path.starts_with("/files/") => {
            match file(shared, &path["/files/".len()..]) {
                Some((file, name)) => return send_file(file, name, request, stream).map(|()| Next::Request),
                None => Answer::refusal(NOT_FOUND),
            }
        }
        (_, Method::Get | Method::Head, "/report") => match report(shared) {
            Some((file, _)) => return send_report(file, request, stream).map(|()| Next::Request),
            None => Answer::refusal(NOT_FOUND),
        },
        (_, Method::Get | Method::Head, "/all.zip") => match archive(shared) {
            Some(archive) => return send_archive(&archive, request, stream).map(|()| Next::Request),
            None => Answer::refusal(NOT_FOUND),
        },
        (_, Method::Get | Method::Head, path) => get(shared, path),
        (_, Method::Post, path) => post(shared, request, path),
    };
    answer.write(stream, request)?;
    Ok(Next::Request)
}

fn get(shared: &LiveServerState, path: &str) -> Answer {
    if let Some((_, content_type, body)) = PAGE.iter().find(|(known, _, _)| *known == path) {
        return Answer::ok(content_type, *body);
    }
    let hub = &shared.hub;
    let found = match path {
        "/state" => {
            let state = json!({
                "introduction": hub.introduction(),
                "status": hub.status(),
                "fields": TrackRecord::FIELDS,
                "viewers": hub.viewers(),
            });
            Some(Answer::ok(JSON, state.to_string()))
        }
        "/files" => {
            let files = json!({
                "files": files(shared),
                "zip": archive(shared).map(|archive| archive.length()),
                "report": report(shared).is_some(),
            });
            Some(Answer::ok(JSON, files.to_string()))
        }
        "/marks" => Some(Answer::ok(JSON, json!(hub.marks_from(0)).to_string())),
        "/picture.jpg" => hub.view().map(|view| Answer::ok("image/jpeg", view.jpeg.clone())),
        _ => tile(path).map(|tile| match hub.ground().tile_rgba(tile) {
            Some(rgba) => tile_png(&rgba).map_or_else(Answer::nothing, |png| Answer::ok("image/png", png)),
            // Announced as the others: a loop closure has moved the ground elsewhere.
            None => Answer::nothing(),
        }),
    };
    found.unwrap_or_else(|| Answer::refusal(NOT_FOUND))
}

fn post(shared: &LiveServerState, request: &Request, path: &str) -> Answer {
    match path {
        "/mark" => match shared.hub.mark(&String::from_utf8_lossy(&request.body)) {
            Some((index, mark)) => Answer::ok(JSON, json!({ "index": index, "mark": mark }).to_string()),
            None => Answer::refusal(HttpRefusal(409, "Conflict")),
        },
        _ if path.starts_with("/mark/") => {
            let index = path["/mark/".len()..].parse().ok();
            let name = String::from_utf8_lossy(&request.body);
            match index.and_then(|index| shared.hub.rename_mark(index, &name)) {
                Some(mark) => Answer::ok(JSON, json!(mark).to_string()),
                None => Answer::refusal(HttpRefusal(409, "Conflict")),
            }
        }
        "/stop" => {
            shared.hub.ask_to_stop();
            Answer::ok(JSON, "{}")
        }
        _ => Answer::refusal(NOT_FOUND),
    }
}

/// Parses `/tiles/COLUMN/ROW.png`.
fn tile(path: &str) -> Option<MosaicSquare> {
    let (column, row) = path.strip_prefix("/tiles/")?.strip_suffix(".png")?.split_once('/')?;
    Some(MosaicSquare { column: column.parse().ok()?, row: row.parse().ok()? })
}

/// The downloadable files that exist, with their sizes in bytes.
fn files(shared: &LiveServerState) -> Vec<serde_json::Value> {
    let Some(folder) = &shared.options.folder else { return Vec::new() };
    let described = |name: &String| {
        let bytes = std::fs::metadata(folder.join(name)).ok()?.len();
        Some(json!({ "name": name, "bytes": bytes }))
    };
    shared.options.files.iter().filter_map(described).collect()
}

/// Opens a file of the run. The requested name must be equal to one of the list, so no part of the
/// request ever becomes part of a path.
fn file<'a>(shared: &'a LiveServerState, name: &str) -> Option<(File, &'a str)> {
    let known = shared.options.files.iter().find(|known| *known == name || encoded(known) == name)?;
    let file = File::open(shared.options.folder.as_ref()?.join(known)).ok()?;
    file.metadata().ok()?.is_file().then_some((file, known.as_str()))
}

fn send_file(file: File, name: &str, request: &Request, stream: &mut Deadlined) -> io::Result<()> {
    let content_type = match name.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("svg") => "image/svg+xml",
        Some("png") => "image/png",
        Some("json") => JSON,
        Some("gpkg") => "application/geopackage+sqlite3",
        _ => "text/plain; charset=utf-8",
    };
    let plain: String = name.rsplit('/').next().unwrap_or(name).chars().map(safe_in_header).collect();
    let answer =
        Answer::ok(content_type, []).with("Content-Disposition", format!("attachment; filename=\"{plain}\""));
    send_contents(file, &answer, request, stream)
}

/// Whether the files of the run are complete.
fn is_over(shared: &LiveServerState) -> bool {
    matches!(shared.hub.status().phase, Phase::Saved | Phase::Failed)
}

/// The report among the files.
fn report(shared: &LiveServerState) -> Option<(File, &str)> {
    let name = shared.options.files.iter().find(|name| name.rsplit('/').next() == Some("report.html"))?;
    file(shared, name).filter(|_| is_over(shared))
}

/// All files as one.
fn archive(shared: &LiveServerState) -> Option<Archive> {
    let folder = shared.options.folder.as_ref().filter(|_| is_over(shared))?;
    Archive::of(folder, &shared.options.files)
}

/// Sends the report to be looked at. It is self-contained, and in a sandbox it has an origin of its
/// own: it cannot act with that of this page.
fn send_report(file: File, request: &Request, stream: &mut Deadlined) -> io::Result<()> {
    const POLICY: &str = "sandbox allow-scripts allow-popups; default-src 'none'; img-src data:; \
                          style-src 'unsafe-inline'; script-src 'unsafe-inline'; frame-ancestors 'none'";
    let answer = Answer { policy: Some(POLICY), ..Answer::ok("text/html; charset=utf-8", []) };
    send_contents(file, &answer, request, stream)
}

fn send_archive(archive: &Archive, request: &Request, stream: &mut Deadlined) -> io::Result<()> {
    let answer = Answer::ok("application/zip", [])
        .with("Content-Disposition", format!("attachment; filename=\"{}.zip\"", archive.name()));
    stream.allow(ANSWER_PATIENCE);
    stream.write_all(answer.head(archive.length(), request.keep_alive).as_bytes())?;
    if request.method == Method::Head {
        return Ok(());
    }
    archive.write(&mut |bytes| {
        stream.allow(ANSWER_PATIENCE);
        stream.write_all(bytes)
    })
}

fn send_contents(
    mut file: File,
    answer: &Answer,
    request: &Request,
    stream: &mut Deadlined,
) -> io::Result<()> {
    let length = file.metadata()?.len();
    stream.allow(ANSWER_PATIENCE);
    stream.write_all(answer.head(length, request.keep_alive).as_bytes())?;
    if request.method == Method::Head {
        return Ok(());
    }
    let mut left = length;
    let mut piece = vec![0; 64 << 10];
    while left > 0 {
        let want = piece.len().min(usize::try_from(left).unwrap_or(usize::MAX));
        file.read_exact(&mut piece[..want])?;
        stream.allow(ANSWER_PATIENCE);
        stream.write_all(&piece[..want])?;
        left -= want as u64;
    }
    Ok(())
}

/// Percent-encodes a file name as the page requests it: the unreserved characters of ECMAScript's
/// `encodeURIComponent` and slashes stay (RFC 3986, section 2.1).
fn encoded(name: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.!~*'()/".contains(&byte);
    name.bytes().fold(String::new(), |mut text, byte| {
        match plain(byte) {
            true => text.push(char::from(byte)),
            false => text.push_str(&format!("%{byte:02X}")),
        }
        text
    })
}

/// The response that upgrades a connection to a WebSocket (RFC 6455, section 4.2.2).
fn upgrade(request: &Request) -> Result<String, HttpRefusal> {
    let asks = |name: &str, wanted: &str| {
        request
            .header(name)
            .is_some_and(|value| value.split(',').any(|part| part.trim().eq_ignore_ascii_case(wanted)))
    };
    let key = request.header("sec-websocket-key").filter(|key| key.len() == 24);
    let version = request.header("sec-websocket-version") == Some("13");
    match key {
        Some(key) if version && asks("upgrade", "websocket") && asks("connection", "upgrade") => {
            let accept = tungstenite::handshake::derive_accept_key(key.as_bytes());
            Ok(format!(
                "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
            ))
        }
        _ => Err(HttpRefusal(426, "Upgrade Required")),
    }
}

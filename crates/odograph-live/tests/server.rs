//! Tests of the server with slow, many, malicious and unauthorised clients: the tracking is never
//! blocked, and no files other than those of the run are served.

#![allow(clippy::unwrap_used)] // a test fails by panicking

use odograph::mosaic::Mosaic;
use odograph_live::server::MAX_CONNECTIONS;
use odograph_live::{Hub, Introduction, Server, ServerOptions, Status, TrackRecord, View};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Upper bound for the time of any response in these tests.
const PATIENCE: Duration = Duration::from_secs(20);

struct ServerFixture {
    hub: Arc<Hub>,
    server: Server,
    _folder: tempfile::TempDir,
}

/// A server of a folder with one public file, and secret files beside it and above it.
fn place(token: Option<&str>) -> ServerFixture {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    std::fs::create_dir(&run).unwrap();
    std::fs::write(run.join("stats.json"), "{\"frames\": 3}").unwrap();
    std::fs::write(run.join("secret.txt"), "secret").unwrap();
    std::fs::write(folder.path().join("stats.json"), "secret").unwrap();
    let introduction = Introduction {
        title: "drive".into(),
        source: "a drive".into(),
        width: 640,
        height: 480,
        height_m: 1.0,
        live: true,
        recovered: false,
        calibration: false,
    };
    let hub = Arc::new(Hub::new(introduction, Arc::new(Mutex::new(Mosaic::new(Default::default())))));
    let options = ServerOptions {
        token: token.map(str::to_owned),
        folder: Some(run),
        files: vec!["stats.json".into(), "trajectory.csv".into()],
    };
    let server = Server::start(([127, 0, 0, 1], 0).into(), Arc::clone(&hub), options).unwrap();
    ServerFixture { hub, server, _folder: folder }
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

/// Sends raw bytes and returns the whole response, which may be empty if the server closes the
/// connection.
fn raw(address: SocketAddr, request: &[u8]) -> String {
    let mut stream = connect(address);
    let _ = stream.write_all(request);
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

fn get(address: SocketAddr, path: &str, more: &str) -> String {
    raw(
        address,
        format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{more}\r\n").as_bytes(),
    )
}

fn status(answer: &str) -> &str {
    answer.split(' ').nth(1).unwrap_or("none")
}

#[test]
fn only_the_listed_files_of_the_run_are_served() {
    let place = place(None);
    let address = place.server.address();
    let answer = get(address, "/files/stats.json", "");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("{\"frames\": 3}"), "{answer}");
    for path in [
        "/files/secret.txt",
        "/files/../stats.json",
        "/files/..%2fstats.json",
        "/files/%2e%2e/stats.json",
        "/files/./stats.json",
        "/files//etc/passwd",
        "/files/..\\stats.json",
        "/files/",
        "/files/trajectory.csv",
        "/../../etc/passwd",
        "//etc/passwd",
        "/tiles/0/../../stats.json.png",
        "/tiles/99999999999999999999/0.png",
        "/run/stats.json",
    ] {
        let answer = get(address, path, "");
        assert_eq!(status(&answer), "404", "{path}: {answer}");
        assert!(!answer.contains("secret"), "{path}");
    }
    // The page is notified of tiles that have become empty, and asks for them.
    for path in ["/tiles/1/0.png", "/tiles/1/-9223372036854775808.png"] {
        let answer = get(address, path, "");
        assert!(status(&answer) == "204" && !answer.contains("Content-Length"), "{path}: {answer}");
    }
    assert_eq!(get(address, "/favicon.ico", ""), get(address, "/icon.svg", ""));
    // The only writing requests are to set a mark and to stop.
    for request in ["PUT /files/stats.json HTTP/1.1", "DELETE /files/stats.json HTTP/1.1"] {
        assert_eq!(status(&raw(address, format!("{request}\r\nHost: localhost\r\n\r\n").as_bytes())), "405");
    }
    let post = raw(address, b"POST /files/stats.json HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: 1\r\n\r\nx");
    assert_eq!(status(&post), "404");
}

#[test]
fn invalid_requests_are_refused_and_the_next_is_served() {
    let place = place(None);
    let address = place.server.address();
    let endless_head = [b"GET / HTTP/1.1\r\n".to_vec(), b"X: y\r\n".repeat(100_000)].concat();
    let endless_line = [b"GET /".to_vec(), b"a".repeat(1 << 20)].concat();
    let noise: Vec<u8> = (0..4096u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let large = b"POST /mark HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000000\r\n\r\n".to_vec();
    let socket = b"GET /socket HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".to_vec();
    for (request, wanted) in
        [(endless_head, "431"), (endless_line, "431"), (noise, "400"), (large, "413"), (socket, "426")]
    {
        // A server that refuses a request may close the connection before all of it has been sent;
        // then there may be no response.
        let answer = raw(address, &request);
        assert!(answer.is_empty() || status(&answer) == wanted, "{wanted}: {answer}");
    }
    assert_eq!(status(&get(address, "/", "")), "200");
}

#[test]
fn foreign_pages_cannot_send_requests_through_a_browser() {
    let place = place(None);
    let address = place.server.address();
    let foreign_name =
        raw(address, b"GET /state HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n");
    assert_eq!(status(&foreign_name), "403");
    let foreign_page = raw(
        address,
        b"POST /stop HTTP/1.1\r\nHost: localhost\r\nOrigin: http://evil.example\r\nConnection: close\r\nContent-Length: 0\r\n\r\n",
    );
    assert_eq!(status(&foreign_page), "403");
    assert!(!place.hub.stop_asked());
    let own = raw(
        address,
        b"POST /stop HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\nConnection: close\r\nContent-Length: 0\r\n\r\n",
    );
    assert_eq!(status(&own), "200");
    assert!(place.hub.stop_asked());
}

#[test]
fn a_port_of_another_program_is_named() {
    let place = place(None);
    let address = place.server.address();
    let second = Server::start(address, Arc::clone(&place.hub), ServerOptions::default());
    let refused = second.err().unwrap().to_string();
    let expected =
        format!("another program, perhaps another odograph, has port {}; give another", address.port());
    assert!(refused.contains(&expected), "{refused}");
}

#[test]
fn without_the_token_every_request_is_refused() {
    let place = place(Some("correct-token-123"));
    let address = place.server.address();
    assert!(place.server.url().ends_with("/?token=correct-token-123"));
    for more in [
        "",
        "Cookie: odograph=wrong\r\n",
        "Authorization: Bearer correct-token-12\r\n",
        "Cookie: odograph=\r\n",
    ] {
        for path in ["/", "/state", "/files/stats.json", "/socket", "/?token=wrong", "/app.js?token="] {
            assert_eq!(status(&get(address, path, more)), "403", "{path} {more}");
        }
    }
    let redirected = get(address, "/?token=correct-token-123", "");
    assert!(
        redirected.starts_with("HTTP/1.1 303") && redirected.contains("\r\nLocation: /\r\n"),
        "{redirected}"
    );
    assert!(redirected.contains("Set-Cookie: odograph=correct-token-123; Path=/; HttpOnly; SameSite=Strict"));
    assert_eq!(status(&get(address, "/state", "Cookie: odograph=correct-token-123\r\n")), "200");
    assert_eq!(status(&get(address, "/state", "Authorization: Bearer correct-token-123\r\n")), "200");
    let open = Server::start(([0, 0, 0, 0], 0).into(), Arc::clone(&place.hub), ServerOptions::default());
    assert!(open.unwrap_err().to_string().contains("needs a token"));
}

/// Opens a WebSocket as a browser does.
fn socket(address: SocketAddr) -> TcpStream {
    let mut stream = connect(address);
    let request = "GET /socket HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
                   Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n";
    stream.write_all(request.as_bytes()).unwrap();
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).unwrap();
    // The accept key of the example in RFC 6455, section 1.3.
    assert!(head.starts_with("HTTP/1.1 101") && head.contains("s3pPLMBiTxaQ9kYGzzhZRbK+xOo="), "{head}");
    stream
}

fn show_frames(hub: &Hub, frames: usize) {
    let mut values = [0.0; TrackRecord::LENGTH];
    for k in 0..frames {
        values[0] = k as f32;
        let record = hub.add_record(&TrackRecord { values });
        hub.show_view(View { record, jpeg: vec![0; 64 << 10], tracks: vec![[1; 5]; 300] });
    }
}

#[test]
fn a_hundred_unresponsive_clients_block_no_other() {
    let place = place(None);
    let address = place.server.address();
    // Idle clients, clients with half a request, and clients that open a WebSocket and never read.
    let mut silent: Vec<TcpStream> = (0..40).map(|_| connect(address)).collect();
    for stream in &mut silent[..20] {
        stream.write_all(b"GET / HTTP/1.1\r\nHost: loc").unwrap();
    }
    let deaf: Vec<TcpStream> = (0..60).map(|_| socket(address)).collect();
    let mut listener = socket(address);
    let until = Instant::now() + PATIENCE;
    while place.hub.viewers() < 61 && Instant::now() < until {
        std::thread::yield_now();
    }
    assert_eq!(place.hub.viewers(), 61);
    // 200 images of 64 KiB: far more than the system's socket buffers hold for a client that does
    // not read.
    let begun = Instant::now();
    for _ in 0..20 {
        show_frames(&place.hub, 10);
        place.hub.set_status(Status { captured: place.hub.marks_from(0).len() as u64, ..Status::default() });
    }
    // Writing to the hub takes microseconds. If it waited for a client it would take that client's
    // time limit of five seconds.
    assert!(begun.elapsed() < Duration::from_secs(3), "{:?}", begun.elapsed());
    // A client that reads receives all 200 records.
    let mut heard = Vec::new();
    let wanted = 200 * 4 * TrackRecord::LENGTH;
    let mut piece = vec![0; 1 << 16];
    while heard.len() < wanted {
        let read = listener.read(&mut piece).unwrap();
        assert!(read > 0);
        heard.extend_from_slice(&piece[..read]);
    }
    // And a new client is served.
    assert_eq!(status(&get(address, "/state", "")), "200");
    assert!(place.server.connections() <= MAX_CONNECTIONS);
    // All clients disconnect at once; their threads end.
    drop((silent, deaf, listener));
    let until = Instant::now() + PATIENCE;
    while place.server.connections() > 0 && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!((place.server.connections(), place.hub.viewers()), (0, 0));
}

#[test]
fn connections_beyond_the_limit_get_status_503() {
    let place = place(None);
    let address = place.server.address();
    let held: Vec<TcpStream> = (0..MAX_CONNECTIONS).map(|_| socket(address)).collect();
    let until = Instant::now() + PATIENCE;
    while place.server.connections() < MAX_CONNECTIONS && Instant::now() < until {
        std::thread::yield_now();
    }
    assert_eq!(status(&raw(address, b"")), "503");
    drop(held);
    let until = Instant::now() + PATIENCE;
    while place.server.connections() > 0 && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(status(&get(address, "/state", "")), "200");
}

#[test]
fn connections_without_a_request_make_room_for_others() {
    let place = place(None);
    let address = place.server.address();
    let _held: Vec<TcpStream> = (0..MAX_CONNECTIONS).map(|_| connect(address)).collect();
    assert_eq!(status(&get(address, "/state", "")), "200");
}

#[test]
fn the_page_loads_nothing_from_other_hosts() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/page");
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap();
        for line in text.lines().filter(|line| line.contains("://")) {
            let harmless = line.contains("www.w3.org/2000/svg") || line.contains("${location.host}");
            assert!(harmless, "{}: {line}", path.display());
        }
    }
}

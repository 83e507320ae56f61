//! The web server of the page: HTTP/1.1 and WebSocket for browsers on the local network, with one
//! thread per connection.
//!
//! All input is untrusted. Requests are limited in size and time, responses in time. There are at
//! most [`MOST_CONNECTIONS`] connections, and no thread holds a lock while it waits for its client,
//! so a client can only slow down itself.

mod access;
mod deadline;
mod http;
mod routes;
mod socket;

use crate::hub::Hub;
use access::Access;
pub use access::new_token;
use odograph::error::{Error, Result};
use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// Parses the header section of a request, for the fuzz target.
#[cfg(fuzzing)]
pub fn read_request(bytes: &[u8]) {
    http::read_head(bytes);
}

/// Maximum number of connections; further ones are refused immediately.
pub const MOST_CONNECTIONS: usize = 256;

/// Access token and downloadable files.
#[derive(Debug, Clone, Default)]
pub struct ServerOptions {
    /// The token that a client must present. With `None` every client is allowed, and the server's
    /// address must be a loopback address.
    pub token: Option<String>,
    /// The output folder of the run.
    pub folder: Option<PathBuf>,
    /// Names of the files in that folder that may be downloaded. All others are refused.
    pub files: Vec<String>,
}

/// A running server. It stops when dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    token: Option<String>,
    shared: Arc<ServerState>,
    acceptor: Option<JoinHandle<()>>,
}

/// State shared by the threads of all connections.
struct ServerState {
    hub: Arc<Hub>,
    access: Access,
    options: ServerOptions,
    connections: AtomicUsize,
    ended: AtomicBool,
}

impl std::fmt::Debug for ServerState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("connections", &self.connections).finish_non_exhaustive()
    }
}

impl Server {
    /// Starts the server. Port 0 selects any free port.
    ///
    /// # Errors
    /// If the address is not available, or if it is not a loopback address and there is no token.
    pub fn start(address: SocketAddr, hub: Arc<Hub>, options: ServerOptions) -> Result<Self> {
        if options.token.is_none() && !address.ip().is_loopback() {
            return Err(Error::usage(format!("{address} can be reached by others: that needs a token")));
        }
        let listener = TcpListener::bind(address)
            .map_err(|error| Error::usage(format!("the page cannot be served at {address}: {error}")))?;
        let bound = listener.local_addr().unwrap_or(address);
        let shared = Arc::new(ServerState {
            hub,
            access: Access::new(options.token.clone()),
            options: options.clone(),
            connections: AtomicUsize::new(0),
            ended: AtomicBool::new(false),
        });
        let acceptor = thread::Builder::new()
            .name("page".into())
            .spawn({
                let shared = Arc::clone(&shared);
                move || accept(&listener, &shared)
            })
            .map_err(|error| Error::output(format!("the page's thread cannot be started: {error}")))?;
        Ok(Self { address: bound, token: options.token, shared, acceptor: Some(acceptor) })
    }

    /// The address on which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The URL of the page, including the token if there is one.
    pub fn url(&self) -> String {
        url(self.address, self.token.as_deref())
    }

    /// The same at other addresses by which the server can be reached.
    pub fn urls_at(&self, addresses: &[SocketAddr]) -> Vec<String> {
        addresses.iter().map(|address| url(*address, self.token.as_deref())).collect()
    }

    /// Number of open connections.
    pub fn connections(&self) -> usize {
        self.shared.connections.load(Ordering::Relaxed)
    }
}

fn url(address: SocketAddr, token: Option<&str>) -> String {
    let token = token.map_or(String::new(), |token| format!("?token={token}"));
    format!("http://{address}/{token}")
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        self.shared.hub.close();
        // Wakes the thread that waits for connections.
        let mut own = self.address;
        if own.ip().is_unspecified() {
            own.set_ip(match own.ip() {
                IpAddr::V4(_) => IpAddr::from([127, 0, 0, 1]),
                IpAddr::V6(_) => IpAddr::from([0, 0, 0, 0, 0, 0, 0, 1]),
            });
        }
        let woken = TcpStream::connect_timeout(&own, Duration::from_secs(1)).is_ok();
        if let Some(acceptor) = self.acceptor.take().filter(|_| woken) {
            let _ = acceptor.join();
        }
    }
}

fn accept(listener: &TcpListener, shared: &Arc<ServerState>) {
    loop {
        let accepted = listener.accept();
        if shared.ended.load(Ordering::Relaxed) {
            return;
        }
        let Ok((stream, _)) = accepted else {
            // Mostly caused by a shortage of file descriptors, which is temporary.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        let Some(seat) = Seat::take(shared) else {
            routes::refuse_for_want_of_room(stream);
            continue;
        };
        // If no thread can be created the connection is closed, and the client may retry.
        let _ = thread::Builder::new()
            .name("page client".into())
            .stack_size(256 << 10)
            .spawn(move || drop(serve(&seat, stream)));
    }
}

/// One counted connection; releases its slot when dropped.
struct Seat(Arc<ServerState>);

impl Seat {
    fn take(shared: &Arc<ServerState>) -> Option<Self> {
        if shared.connections.fetch_add(1, Ordering::Relaxed) >= MOST_CONNECTIONS {
            shared.connections.fetch_sub(1, Ordering::Relaxed);
            return None;
        }
        Some(Self(Arc::clone(shared)))
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.0.connections.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Serves one connection: requests in sequence, until it becomes a WebSocket or ends.
fn serve(seat: &Seat, stream: TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let mut reader = http::RequestReader::new(stream);
    while !seat.0.ended.load(Ordering::Relaxed) {
        let request = match reader.next() {
            Ok(Some(request)) => request,
            Ok(None) => return Ok(()),
            Err(refusal) => return routes::refuse(reader.into_stream(), refusal),
        };
        match routes::answer(&seat.0, &request, reader.stream())? {
            routes::Next::Request if request.keep_alive => {}
            routes::Next::Request => return Ok(()),
            routes::Next::Socket => return socket::run(&seat.0.hub, reader.into_stream()),
        }
    }
    Ok(())
}

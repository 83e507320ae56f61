//! The web server of the page: HTTP/1.1 and WebSocket for browsers on the local network, with one
//! thread per connection.
//!
//! All input is untrusted. Requests are limited in size and time, responses in time. There are at
//! most [`MAX_CONNECTIONS`] connections, and no thread holds a lock while it waits for its client,
//! so a client can only slow down itself.

pub mod access;
mod archive;
pub mod deadline;
pub mod http;
pub mod listener;
mod routes;
mod socket;

use crate::hub::Hub;
use access::Access;
pub use access::new_token;
use listener::{Connection, Listener};
use odograph::error::Result;
use std::io;
use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;

/// Parses the header section of a request, for the fuzz target.
#[cfg(fuzzing)]
pub fn read_request(bytes: &[u8]) {
    http::read_head(bytes);
}

/// Maximum number of connections, each with a thread; further ones are refused immediately.
pub const MAX_CONNECTIONS: usize = 256;

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
    token: Option<String>,
    shared: Arc<LiveServerState>,
    listener: Listener,
}

/// State shared by the threads of all connections.
struct LiveServerState {
    hub: Arc<Hub>,
    access: Access,
    options: ServerOptions,
}

impl std::fmt::Debug for LiveServerState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LiveServerState").field("options", &self.options).finish_non_exhaustive()
    }
}

impl Server {
    /// Starts the server. Port 0 selects any free port.
    ///
    /// # Errors
    /// If the address is not available, or if it is not a loopback address and there is no token.
    pub fn start(address: SocketAddr, hub: Arc<Hub>, options: ServerOptions) -> Result<Self> {
        let token = options.token.clone();
        let shared = Arc::new(LiveServerState { hub, access: Access::new(token.clone()), options });
        let state = Arc::clone(&shared);
        let serve = move |connection: &Connection, stream: TcpStream| serve(&state, connection, stream);
        let listener = Listener::start(address, token.is_some(), MAX_CONNECTIONS, serve)?;
        Ok(Self { token, shared, listener })
    }

    /// The address on which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.listener.address()
    }

    /// The URL of the page, including the token if there is one.
    pub fn url(&self) -> String {
        url(self.address(), self.token.as_deref())
    }

    /// The same at other addresses by which the server can be reached.
    pub fn urls_at(&self, addresses: &[SocketAddr]) -> Vec<String> {
        addresses.iter().map(|address| url(*address, self.token.as_deref())).collect()
    }

    /// Number of open connections.
    pub fn connections(&self) -> usize {
        self.listener.connections()
    }
}

fn url(address: SocketAddr, token: Option<&str>) -> String {
    let token = token.map_or(String::new(), |token| format!("?token={token}"));
    format!("http://{address}/{token}")
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.hub.close();
    }
}

/// Serves one connection: requests in sequence, until it becomes a WebSocket or ends.
fn serve(shared: &LiveServerState, connection: &Connection, stream: TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let mut reader = http::RequestReader::new(stream);
    while !connection.is_ended() {
        let request = match reader.next() {
            Ok(Some(request)) => request,
            Ok(None) => return Ok(()),
            Err(refusal) => return http::refuse(reader.into_stream(), refusal),
        };
        connection.set_busy();
        match routes::answer(shared, &request, reader.stream())? {
            routes::Next::Request if request.keep_alive => connection.set_idle(),
            routes::Next::Request => return Ok(()),
            routes::Next::Socket => return socket::run(&shared.hub, reader.into_stream()),
        }
    }
    Ok(())
}

//! Accepts connections, each with a thread of its own, up to a limit.

use odograph::error::{Error, Result};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::net::Shutdown;
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// Stack of a connection's thread, bytes: small, so that every connection can have one.
const STACK: usize = 256 << 10;

/// A listening socket whose connections are served until it is dropped.
#[derive(Debug)]
pub struct Listener {
    address: SocketAddr,
    state: Arc<ListenerState>,
    acceptor: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct ListenerState {
    connections: AtomicUsize,
    ended: AtomicBool,
    /// The connections that have no request under way, by age: closed to make room.
    idle: Mutex<BTreeMap<u64, Arc<TcpStream>>>,
}

impl ListenerState {
    fn lock_idle(&self) -> MutexGuard<'_, BTreeMap<u64, Arc<TcpStream>>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Closes the connection that has been idle for longest. Returns whether there was one.
    fn close_an_idle_one(&self) -> bool {
        let oldest = self.lock_idle().pop_first();
        oldest.is_some_and(|(_, stream)| stream.shutdown(Shutdown::Both).is_ok())
    }
}

/// One counted connection; releases its slot when dropped.
#[derive(Debug)]
pub struct Connection {
    state: Arc<ListenerState>,
    number: u64,
    stream: Arc<TcpStream>,
}

impl Connection {
    /// Whether the listener has been dropped: the connection should end.
    pub fn is_ended(&self) -> bool {
        self.state.ended.load(Ordering::Relaxed)
    }

    /// Tells that a request is under way: the connection is not closed to make room for others.
    pub fn set_busy(&self) {
        self.state.lock_idle().remove(&self.number);
    }

    /// Tells that the connection waits for a request, as a new one does.
    pub fn set_idle(&self) {
        self.state.lock_idle().insert(self.number, Arc::clone(&self.stream));
    }
}

/// The error of an address at which no page can be served, in the words of the program.
pub fn not_served(address: SocketAddr, error: &io::Error) -> Error {
    let advice = "give another address or port";
    Error::usage(match error.kind() {
        io::ErrorKind::AddrInUse => format!(
            "the page cannot be served at {address}: another program, perhaps another odograph, has port {}; {advice}",
            address.port()
        ),
        _ => format!("the page cannot be served at {address}: {error}; {advice}"),
    })
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.set_busy();
        self.state.connections.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Listener {
    /// Listens at an address, port 0 for any free one, and calls `serve` for each connection in a
    /// thread of its own. Beyond `most` connections the oldest that has no request under way is
    /// closed for a further one, which is refused at once where there is none.
    ///
    /// # Errors
    /// If the address is not available, or if it can be reached by others without `protected`.
    pub fn start(
        address: SocketAddr,
        protected: bool,
        most: usize,
        serve: impl Fn(&Connection, TcpStream) -> io::Result<()> + Send + Sync + 'static,
    ) -> Result<Self> {
        if !protected && !address.ip().is_loopback() {
            return Err(Error::usage(format!("{address} can be reached by others: that needs a token")));
        }
        let listener = TcpListener::bind(address).map_err(|error| not_served(address, &error))?;
        let bound = listener.local_addr().unwrap_or(address);
        let state = Arc::new(ListenerState::default());
        let acceptor = thread::Builder::new()
            .name("page".into())
            .spawn({
                let (state, serve) = (Arc::clone(&state), Arc::new(serve));
                move || accept(&listener, &state, most, &serve)
            })
            .map_err(|error| Error::output(format!("the page's thread cannot be started: {error}")))?;
        Ok(Self { address: bound, state, acceptor: Some(acceptor) })
    }

    /// The address on which it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Number of open connections.
    pub fn connections(&self) -> usize {
        self.state.connections.load(Ordering::Relaxed)
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.state.ended.store(true, Ordering::Relaxed);
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

fn accept<S>(listener: &TcpListener, state: &Arc<ListenerState>, most: usize, serve: &Arc<S>)
where
    S: Fn(&Connection, TcpStream) -> io::Result<()> + Send + Sync + 'static,
{
    for number in 0.. {
        let accepted = listener.accept();
        if state.ended.load(Ordering::Relaxed) {
            return;
        }
        let opened = accepted.and_then(|(stream, _)| Ok((Arc::new(stream.try_clone()?), stream)));
        let Ok((handle, stream)) = opened else {
            // Mostly caused by a shortage of file descriptors, which is temporary.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        let before = state.connections.fetch_add(1, Ordering::Relaxed);
        let connection = Connection { state: Arc::clone(state), number, stream: handle };
        if before >= most && !state.close_an_idle_one() {
            refuse_for_want_of_room(stream);
            continue;
        }
        connection.set_idle();
        let serve = Arc::clone(serve);
        // If no thread can be created the connection is closed, and the client may retry.
        let _ = thread::Builder::new()
            .name("page client".into())
            .stack_size(STACK)
            .spawn(move || drop(serve(&connection, stream)));
    }
}

/// Refuses a connection because there are too many, without blocking.
fn refuse_for_want_of_room(mut stream: TcpStream) {
    let full = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nRetry-After: 5\r\nConnection: close\r\n\r\n";
    let _ = stream.set_nonblocking(true).and_then(|()| stream.write_all(full));
}

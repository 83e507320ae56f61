//! The WebSocket that pushes updates to a page. `docs/live.md` describes its messages.

use super::deadline::Deadlined;
use crate::hub::{Hub, News, View};
use serde_json::json;
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Error, Message, WebSocket};

/// First byte of a binary message: its kind.
const RECORDS: u8 = 1;
const VIEW: u8 = 2;
/// Maximum wait for news before checking whether the client is still connected.
const PATIENCE: Duration = Duration::from_millis(500);
/// A client that has not received its messages within this time is disconnected.
const SEND_PATIENCE: Duration = Duration::from_secs(5);
/// Read timeout for messages from the client, which has nothing to send except close frames.
const GLANCE: Duration = Duration::from_millis(1);

/// Sends updates to a client until it disconnects or the hub closes.
pub fn run(hub: &Arc<Hub>, mut stream: Deadlined) -> io::Result<()> {
    stream.read_for(GLANCE);
    let config = WebSocketConfig::default()
        .read_buffer_size(4 << 10)
        .max_message_size(Some(4 << 10))
        .max_frame_size(Some(4 << 10));
    let mut socket = WebSocket::from_raw_socket(stream, Role::Server, Some(config));
    let mut viewer = hub.look();
    let hello = json!({ "kind": "hello", "introduction": hub.introduction() }).to_string();
    if send(&mut socket, [Message::text(hello)]).is_err() {
        return Ok(());
    }
    loop {
        let news = viewer.news(PATIENCE);
        if send(&mut socket, messages(&news)).is_err() || gone(&mut socket) {
            return Ok(());
        }
        if hub.is_closing() {
            let _ = socket.close(None).and_then(|()| socket.flush());
            return Ok(());
        }
    }
}

fn send(socket: &mut WebSocket<Deadlined>, messages: impl IntoIterator<Item = Message>) -> Result<(), Error> {
    socket.get_mut().allow(SEND_PATIENCE);
    for message in messages {
        socket.write(message)?;
    }
    socket.flush()
}

/// Whether the client has closed the connection or violated the protocol.
fn gone(socket: &mut WebSocket<Deadlined>) -> bool {
    // Bounds the work per call for a client that sends without end; a page sends nothing.
    for _ in 0..8 {
        match socket.read() {
            Ok(Message::Close(_)) => return true,
            Ok(_) => {}
            Err(Error::Io(error)) => {
                return !matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut);
            }
            Err(_) => return true,
        }
    }
    false
}

fn messages(news: &News) -> Vec<Message> {
    let mut messages = Vec::new();
    if news.replaced {
        messages.push(Message::text(json!({ "kind": "replaced" }).to_string()));
    }
    if let Some((first, records)) = &news.records {
        let mut bytes = vec![RECORDS, 0, 0, 0];
        bytes.extend((*first as u32).to_le_bytes());
        bytes.extend(records.iter().flat_map(|value| value.to_le_bytes()));
        messages.push(Message::binary(bytes));
    }
    if let Some(view) = &news.view {
        messages.push(Message::binary(view_bytes(view)));
    }
    if let Some(status) = &news.status {
        messages.push(Message::text(json!({ "kind": "status", "status": status }).to_string()));
    }
    let (first, marks) = &news.marks;
    if !marks.is_empty() {
        messages.push(Message::text(json!({ "kind": "marks", "first": first, "marks": marks }).to_string()));
    }
    messages.extend(news.notices.iter().map(|notice| Message::text(&**notice)));
    if let Some((metres_per_pixel, tiles)) = &news.ground {
        let tiles: Vec<_> = tiles.iter().map(|tile| [tile.column, tile.row]).collect();
        let ground = json!({ "kind": "ground", "metres_per_pixel": metres_per_pixel, "tiles": tiles });
        messages.push(Message::text(ground.to_string()));
    }
    messages
}

/// Layout: kind, zero byte, number of tracks (u16), record index (u32), tracks, JPEG;
/// little-endian.
fn view_bytes(view: &View) -> Vec<u8> {
    let mut bytes = vec![VIEW, 0];
    bytes.extend((view.tracks.len() as u16).to_le_bytes());
    bytes.extend((view.record as u32).to_le_bytes());
    bytes.extend(view.tracks.iter().flatten().flat_map(|value| value.to_le_bytes()));
    bytes.extend_from_slice(&view.jpeg);
    bytes
}

//! `odograph calibrate --live` on frames that the test sends one by one, each after the previous
//! one has been processed.

use odograph::image::GrayImage;
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::thread::JoinHandle;
use tungstenite::{Message, WebSocket};

pub struct WatchedCamera {
    child: Child,
    frames: Option<ChildStdin>,
    socket: WebSocket<TcpStream>,
    errors: JoinHandle<String>,
    held: u64,
    outcome: Value,
    pub url: String,
}

impl WatchedCamera {
    /// Starts the program with a camera of the given size, and listens like a page.
    pub fn start(command: &mut Command, (width, height): (usize, usize)) -> Self {
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut frames = child.stdin.take().unwrap();
        let head = format!("YUV4MPEG2 W{width} H{height} F30:1 Ip A1:1 Cmono XCOLORRANGE=FULL\n");
        frames.write_all(head.as_bytes()).unwrap();
        // A stream is identified only by its first frame, here a black one.
        frames.write_all(b"FRAME\n").unwrap();
        frames.write_all(&vec![0; width * height]).unwrap();
        let mut outcome = BufReader::new(child.stderr.take().unwrap());
        let mut line = String::new();
        outcome.read_line(&mut line).unwrap();
        let url = line
            .split_whitespace()
            .find(|word| word.starts_with("http://"))
            .unwrap_or_else(|| panic!("{line}"));
        let url = url.to_owned();
        let errors = std::thread::spawn(move || {
            let mut rest = String::new();
            outcome.read_to_string(&mut rest).unwrap();
            rest
        });
        let host = url.trim_start_matches("http://").trim_end_matches('/');
        let stream = TcpStream::connect(host).unwrap();
        let (socket, _) = tungstenite::client(format!("ws://{host}/socket"), stream).unwrap();
        Self { child, frames: Some(frames), socket, errors, held: 1, outcome: Value::Null, url }
    }

    /// Sends a frame, waits until it has been processed, and returns the status.
    pub fn hold(&mut self, picture: &GrayImage) -> Value {
        assert!(self.give(picture), "it takes no frames any more");
        while self.outcome["looked_at"].as_u64() != Some(self.held) {
            self.next();
        }
        self.outcome.clone()
    }

    fn give(&mut self, picture: &GrayImage) -> bool {
        let frames = self.frames.as_mut().unwrap();
        self.held += 1;
        frames.write_all(b"FRAME\n").and_then(|()| frames.write_all(picture.samples())).is_ok()
    }

    /// Holds the board still for three frames; returns the last status received.
    pub fn hold_still(&mut self, picture: &GrayImage) -> Value {
        for _ in 0..3 {
            if self.outcome["verdict"].is_null() && self.give(picture) {
                while self.outcome["looked_at"].as_u64() != Some(self.held)
                    && self.outcome["verdict"].is_null()
                    && self.next()
                {}
            }
        }
        self.outcome.clone()
    }

    /// Holds the board until the guidance about missing views is available.
    pub fn guided(&mut self, picture: &GrayImage) -> Value {
        while self.hold(picture)["views"].as_u64().unwrap() < 3 {}
        self.outcome.clone()
    }

    /// Holds the board until there is a verdict.
    pub fn until_it_ends(&mut self, mut outcome: Value, picture: &GrayImage) -> Value {
        while outcome["verdict"].is_null() {
            outcome = self.hold_still(picture);
        }
        outcome
    }

    /// Reads a message; `false` if the program has ended.
    fn next(&mut self) -> bool {
        let Ok(message) = self.socket.read() else { return false };
        if let Message::Text(text) = message {
            let message: Value = serde_json::from_str(&text).unwrap();
            if message["kind"] == "calibration" {
                self.outcome = message["calibration"].clone();
            }
        }
        true
    }

    /// Waits until the program has ended, and returns its output.
    pub fn end(mut self) -> Output {
        self.frames = None;
        drop(self.socket);
        let mut stdout = Vec::new();
        self.child.stdout.take().unwrap().read_to_end(&mut stdout).unwrap();
        let status = self.child.wait().unwrap();
        Output { status, stdout, stderr: self.errors.join().unwrap().into_bytes() }
    }
}

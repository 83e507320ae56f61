//! A served site, and what a robot sends to it.

use crate::robots::Robot;
use odograph_map::{MapFile, Outbox, SessionOrigin};
use odograph_site::{Site, SiteServer};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;

/// The token of the site.
pub const TOKEN: &str = "0123-a-token";

/// A served site with its requests.
pub struct Served {
    pub site: Arc<Site>,
    pub server: SiteServer,
}

impl Served {
    pub fn new(folder: &Path) -> Self {
        let site = Arc::new(Site::open(folder).unwrap());
        let address = "127.0.0.1:0".parse().unwrap();
        let server = SiteServer::start(address, Arc::clone(&site), Some(TOKEN.to_owned())).unwrap();
        Self { site, server }
    }

    /// Sends a request, and returns status code and body of the answer.
    pub fn ask(&self, method: &str, path: &str, headers: &str, body: &[u8]) -> (u16, String) {
        let mut stream = TcpStream::connect(self.server.address()).unwrap();
        let length = body.len();
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n",
            self.server.address()
        );
        stream.write_all(head.as_bytes()).unwrap();
        // A server that refuses early may close before it has everything.
        let _ = stream.write_all(body);
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        let answer = String::from_utf8_lossy(&answer).into_owned();
        let status = answer.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
        (status, answer.split_once("\r\n\r\n").map_or(String::new(), |(_, body)| body.to_owned()))
    }

    pub fn post(&self, path: &str, body: &[u8]) -> (u16, Value) {
        self.post_with(TOKEN, path, body)
    }

    pub fn post_with(&self, token: &str, path: &str, body: &[u8]) -> (u16, Value) {
        let (status, body) = self.ask("POST", path, &bearer(token), body);
        (status, serde_json::from_str(&body).unwrap_or_default())
    }

    /// The status of a request that is sent until it is not one of too many.
    pub fn post_until_taken(&self, path: &str, body: &[u8]) -> u16 {
        let mut answers = std::iter::repeat_with(|| self.post(path, body).0);
        answers.find(|status| *status != 429).unwrap()
    }

    /// What the page shows.
    pub fn state(&self) -> Value {
        serde_json::from_str(&self.ask("GET", "/state", &bearer(TOKEN), b"").1).unwrap()
    }
}

/// The header with a token.
pub fn bearer(token: &str) -> String {
    format!("Authorization: Bearer {token}\r\n")
}

/// The records of a robot's map as a link sends them, and its description.
pub fn sent(folder: &Path) -> (SessionOrigin, Value, Vec<Vec<u8>>) {
    let robot = Robot { lane: ((0.0, 0.0), 0.0, 60), ..Robot::first() };
    let path = robot.drive(folder);
    let file = MapFile::open_read_only(&path).unwrap();
    let origin = file.sessions().unwrap()[0].origin.clone().unwrap();
    let description = json!({
        "robot": origin.robot, "key": origin.key, "source": "drive.mp4",
        "camera": file.camera(), "rig": file.rig(),
    });
    let mut outbox = Outbox::new(&file, &origin).unwrap();
    let mut records = Vec::new();
    let mut after = None;
    for record in outbox.next(&file, 100).unwrap() {
        let pose = record.keyframe.odometry_pose;
        let head = json!({
            "number": record.number, "after": after,
            "keyframe": {
                "frame": record.keyframe.frame, "segment": 0, "time_s": record.keyframe.time_s,
                "pose": [pose.x_m, pose.y_m, pose.heading_rad, pose.height_m, pose.roll_rad, pose.pitch_rad],
                "tilt_covariance": [0.0, 0.0, 0.0], "colored": record.image.colored,
                "luma_scale": record.image.luma_scale, "luma_offset": record.image.luma_offset,
            },
            "edges": [],
        });
        after = Some(record.number);
        records.push(framed(&head, &record.image.jpeg));
    }
    assert!(records.len() > 3);
    (origin, description, records)
}

/// The bytes of a record.
pub fn framed(head: &Value, image: &[u8]) -> Vec<u8> {
    let head = head.to_string().into_bytes();
    let mut bytes = (head.len() as u32).to_le_bytes().to_vec();
    bytes.extend(&head);
    bytes.extend((image.len() as u32).to_le_bytes());
    bytes.extend(image);
    bytes
}

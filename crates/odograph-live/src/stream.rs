//! Pose output for other programs.

use odograph::geometry::Sim2;
use odograph::trajectory::FrameEstimate;
use serde_json::{Value, json};
use std::io;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};

/// Formats a frame as one line of JSON; `docs/live.md` lists its fields.
pub fn json_line(frame: &FrameEstimate, latency_ms: Option<f64>) -> String {
    fields(frame, latency_ms).to_string()
}

/// As [`json_line`], with the pose in the map as `map_pose`: `null` without `map_from_odometry`, as
/// long as the place in the map is not known.
pub fn json_line_in_map(
    frame: &FrameEstimate,
    latency_ms: Option<f64>,
    map_from_odometry: Option<&Sim2>,
) -> String {
    let mut fields = fields(frame, latency_ms);
    let known = frame.estimate.as_ref().zip(map_from_odometry);
    fields["map_pose"] = known.map_or(Value::Null, |(known, map_from_odometry)| {
        let pose = map_from_odometry.apply_to_pose(&known.pose);
        json!({ "x_m": pose.x_m, "y_m": pose.y_m, "heading_rad": pose.heading_rad })
    });
    fields.to_string()
}

fn fields(frame: &FrameEstimate, latency_ms: Option<f64>) -> Value {
    let pose = frame.estimate.as_ref().map(|known| {
        let (pose, velocity) = (&known.pose, &known.velocity);
        let covariance: Vec<Vec<f64>> =
            (0..3).map(|row| (0..3).map(|column| known.covariance[(row, column)]).collect()).collect();
        json!({
            "x_m": pose.x_m,
            "y_m": pose.y_m,
            "heading_rad": pose.heading_rad,
            "height_m": pose.height_m,
            "roll_rad": pose.roll_rad,
            "pitch_rad": pose.pitch_rad,
            "velocity_x_m_s": velocity.x_m_s,
            "velocity_y_m_s": velocity.y_m_s,
            "heading_rate_rad_s": velocity.heading_rad_s,
            "covariance_x_y_heading": covariance,
        })
    });
    let mut fields = json!({
        "frame": frame.frame,
        "time_s": frame.time_s,
        "status": frame.status.to_string(),
        "segment": frame.segment,
        "tracks": frame.tracks,
        "inliers": frame.inliers,
        "residual_px": frame.residual_px,
        "latency_ms": latency_ms,
        "pose": pose,
    });
    if frame.is_reckoned() {
        fields["pose_from"] = "sensors".into();
    }
    fields
}

/// A UDP sender: one datagram a frame, each one JSON line. Delivery is not guaranteed.
#[derive(Debug)]
pub struct Datagrams {
    socket: UdpSocket,
    to: SocketAddr,
}

impl Datagrams {
    /// Creates a sender to `host:port`.
    ///
    /// # Errors
    /// If the address cannot be resolved or no socket can be opened.
    pub fn to(address: &str) -> io::Result<Self> {
        let to = address
            .to_socket_addrs()?
            .next()
            .ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, "no such address"))?;
        if to.port() == 0 {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "nobody can listen on port 0"));
        }
        let any = if to.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
        let socket = UdpSocket::bind(any)?;
        socket.set_nonblocking(true)?;
        Ok(Self { socket, to })
    }

    /// Sends a line. Lines that cannot be sent immediately are dropped.
    pub fn send(&self, line: &str) {
        let _ = self.socket.send_to(line.as_bytes(), self.to);
    }
}

//! Serialisation of ROS 2 messages: CDR (OMG DDSI-RTPS, section 10), little-endian.

use nalgebra::{Isometry3, Matrix6};

/// A message that is being serialised.
pub struct Cdr(Vec<u8>);

/// Bytes before the message: its representation, from behind which numbers are aligned.
const PREFIX: [u8; 4] = [0, 1, 0, 0];

impl Cdr {
    pub fn new() -> Self {
        Self(PREFIX.to_vec())
    }

    pub fn finished(self) -> Vec<u8> {
        self.0
    }

    fn align(&mut self, bytes: usize) {
        let length = self.0.len() - PREFIX.len();
        self.0.resize(PREFIX.len() + length.next_multiple_of(bytes), 0);
    }

    pub fn u8(&mut self, value: u8) {
        self.0.push(value);
    }

    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    pub fn bool(&mut self, value: bool) {
        self.u8(u8::from(value));
    }

    pub fn i64(&mut self, value: i64) {
        self.align(8);
        self.0.extend(value.to_le_bytes());
    }

    pub fn f32(&mut self, value: f32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    /// Bytes with their number before them.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.u32(u32::try_from(bytes.len()).unwrap_or(u32::MAX));
        self.0.extend(bytes);
    }

    pub fn doubles(&mut self, values: impl IntoIterator<Item = f64>) {
        self.align(8);
        values.into_iter().for_each(|value| self.0.extend(value.to_le_bytes()));
    }

    /// A string, whose terminating zero is counted.
    pub fn text(&mut self, text: &str) {
        self.u32(u32::try_from(text.len() + 1).unwrap_or(u32::MAX));
        self.0.extend(text.bytes());
        self.0.push(0);
    }

    /// `builtin_interfaces/Time`.
    pub fn time(&mut self, time_ns: u64) {
        self.u32((time_ns / 1_000_000_000) as u32);
        self.u32((time_ns % 1_000_000_000) as u32);
    }

    /// `std_msgs/Header`.
    pub fn header(&mut self, time_ns: u64, frame: &str) {
        self.time(time_ns);
        self.text(frame);
    }

    /// Position and quaternion, as in `geometry_msgs/Pose` and `geometry_msgs/Transform`.
    pub fn pose(&mut self, pose: &Isometry3<f64>) {
        self.doubles(pose.translation.vector.iter().copied());
        self.doubles(pose.rotation.coords.iter().copied());
    }

    /// A covariance in row order.
    pub fn covariance(&mut self, covariance: &Matrix6<f64>) {
        self.doubles(covariance.transpose().iter().copied());
    }
}

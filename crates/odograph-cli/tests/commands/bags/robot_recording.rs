//! Recordings of a robot, written message by message.

use crate::hostile::recording;
use odograph::geometry::EarthPosition;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

pub const FRAMES: usize = 40;
const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;

/// The time of a frame, nanoseconds.
pub fn time_ns(number: usize) -> u64 {
    1_700_000_000_000_000_000 + 33_333_333 * number as u64
}

/// A message in CDR, little-endian.
pub struct Cdr(pub Vec<u8>);

impl Cdr {
    pub fn new(time_ns: u64) -> Self {
        Self::of(time_ns, "camera")
    }

    /// A message with a header.
    pub fn of(time_ns: u64, frame: &str) -> Self {
        let mut cdr = Self(vec![0, 1, 0, 0]);
        cdr.u32((time_ns / 1_000_000_000) as u32);
        cdr.u32((time_ns % 1_000_000_000) as u32);
        cdr.text(frame);
        cdr
    }

    pub fn align(&mut self, bytes: usize) {
        self.0.resize(4 + (self.0.len() - 4).next_multiple_of(bytes), 0);
    }

    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    pub fn doubles(&mut self, values: &[f64]) {
        self.align(8);
        values.iter().for_each(|value| self.0.extend(value.to_le_bytes()));
    }

    pub fn bytes(&mut self, bytes: &[u8]) {
        self.u32(bytes.len() as u32);
        self.0.extend(bytes);
    }

    pub fn text(&mut self, text: &str) {
        self.bytes(format!("{text}\0").as_bytes());
    }
}

/// `sensor_msgs/msg/Image`
fn image(time_ns: u64, gray: &[u8]) -> Vec<u8> {
    let mut message = Cdr::new(time_ns);
    message.u32(HEIGHT);
    message.u32(WIDTH);
    message.text("mono8");
    message.0.push(0);
    message.u32(WIDTH);
    message.bytes(gray);
    message.0
}

/// `sensor_msgs/msg/Image` of depths in millimetres.
fn depth_image(time_ns: u64) -> Vec<u8> {
    let mut message = Cdr::new(time_ns);
    message.u32(HEIGHT);
    message.u32(WIDTH);
    message.text("16UC1");
    message.0.push(0);
    message.u32(2 * WIDTH);
    message.bytes(&vec![3; (2 * WIDTH * HEIGHT) as usize]);
    message.0
}

/// `sensor_msgs/msg/CameraInfo` of the camera in `recording::CAMERA`.
fn camera_info(time_ns: u64) -> Vec<u8> {
    let mut message = Cdr::new(time_ns);
    message.u32(HEIGHT);
    message.u32(WIDTH);
    message.text("plumb_bob");
    message.u32(5);
    message.doubles(&[0.0; 5]);
    message.doubles(&[300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]);
    message.doubles(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    message.doubles(&[300.0, 0.0, 159.5, 0.0, 0.0, 300.0, 119.5, 0.0, 0.0, 0.0, 1.0, 0.0]);
    (0..6).for_each(|_| message.u32(0));
    message.0.push(0);
    message.0
}

/// `sensor_msgs/msg/Range`
fn range(time_ns: u64) -> Vec<u8> {
    let mut message = Cdr::new(time_ns);
    message.0.push(1);
    message.align(4);
    [0.1f32, 0.1, 4.0, 1.0].iter().for_each(|value| message.0.extend(value.to_le_bytes()));
    message.0
}

/// `sensor_msgs/msg/NavSatFix` with a deviation of 2 cm; without a fix where there is no place.
fn fix(time_ns: u64, place: Option<EarthPosition>) -> Vec<u8> {
    let mut message = Cdr::of(time_ns, "gps");
    message.0.push(if place.is_some() { 2 } else { 255 });
    message.align(2);
    message.0.extend(1u16.to_le_bytes());
    let degrees =
        place.map_or([f64::NAN; 2], |p| [p.latitude_rad.to_degrees(), p.longitude_rad.to_degrees()]);
    message.doubles(&[degrees[0], degrees[1], 200.0]);
    message.doubles(&[4e-4, 0.0, 0.0, 0.0, 4e-4, 0.0, 0.0, 0.0, 1e-3]);
    message.0.push(2);
    message.0
}

/// The frames of a Y4M stream of `recording::y4m`.
fn views(frames: usize) -> Vec<Vec<u8>> {
    let stream = recording::y4m(frames);
    let header = stream.iter().position(|&byte| byte == b'\n').unwrap() + 1;
    stream[header..].chunks((WIDTH * HEIGHT) as usize + 6).map(|frame| frame[6..].to_vec()).collect()
}

/// `tf2_msgs/msg/TFMessage`: parent, child, position and quaternion of each transform.
pub fn transforms(time_ns: u64, all: &[(&str, &str, [f64; 7])]) -> Vec<u8> {
    let mut message = Cdr(vec![0, 1, 0, 0]);
    message.u32(all.len() as u32);
    for (parent, child, numbers) in all {
        message.u32((time_ns / 1_000_000_000) as u32);
        message.u32((time_ns % 1_000_000_000) as u32);
        message.text(parent);
        message.text(child);
        message.doubles(numbers);
    }
    message.0
}

/// A camera that looks straight down, as high as `z` on the robot.
pub fn looking_down(z: f64) -> [f64; 7] {
    let half = 0.5f64.sqrt();
    [0.3, 0.05, z, half, -half, 0.0, 0.0]
}

/// Writes an MCAP file with the images on each of the topics; those named depth have depths.
pub fn write(path: &Path, topics: &[&str]) {
    write_robot(path, topics, &[], &[]);
}

/// A topic with a message for each frame.
pub type Record<'a> = (&'a str, &'a str, Vec<Vec<u8>>);

/// The same with static transforms, and with positions of a satellite receiver at the frames.
pub fn write_robot(
    path: &Path,
    topics: &[&str],
    on_robot: &[(&str, &str, [f64; 7])],
    fixes: &[Option<EarthPosition>],
) {
    write_with(path, topics, on_robot, fixes, &[]);
}

/// The same with further topics.
pub fn write_with(
    path: &Path,
    topics: &[&str],
    on_robot: &[(&str, &str, [f64; 7])],
    fixes: &[Option<EarthPosition>],
    records: &[Record<'_>],
) {
    let file = std::io::BufWriter::new(fs::File::create(path).unwrap());
    let options = mcap::WriteOptions::new().compression(None).profile("ros2");
    let mut writer = options.create(file).unwrap();
    let mut channel = |name: &str, kind: &str| {
        let schema = writer.add_schema(kind, "ros2msg", b"").unwrap();
        writer.add_channel(schema, name, "cdr", &BTreeMap::new()).unwrap()
    };
    let infos = channel("/front/camera_info", "sensor_msgs/msg/CameraInfo");
    let ranges = channel("/sonar", "sensor_msgs/msg/Range");
    let robot = (!on_robot.is_empty()).then(|| channel("/tf_static", "tf2_msgs/msg/TFMessage"));
    let receiver = (!fixes.is_empty()).then(|| channel("/gnss/fix", "sensor_msgs/msg/NavSatFix"));
    let further: Vec<u16> = records.iter().map(|(name, kind, _)| channel(name, kind)).collect();
    let images: Vec<u16> = topics.iter().map(|name| channel(name, "sensor_msgs/msg/Image")).collect();
    for (number, view) in views(FRAMES).iter().enumerate() {
        let time_ns = time_ns(number);
        let mut put = |channel_id: u16, data: Vec<u8>| {
            // Recorded a while after it was taken.
            let (log_time, publish_time) = (time_ns + 7_654_321, time_ns);
            let header =
                mcap::records::MessageHeader { channel_id, sequence: number as u32, log_time, publish_time };
            writer.write_to_known_channel(&header, &Cow::from(data)).unwrap();
        };
        if let Some(robot) = robot.filter(|_| number == 0) {
            put(robot, transforms(time_ns, on_robot));
        }
        if let (Some(receiver), Some(place)) = (receiver, fixes.get(number)) {
            put(receiver, fix(time_ns, *place));
        }
        for (&channel, (_, _, messages)) in further.iter().zip(records) {
            put(channel, messages[number].clone());
        }
        put(infos, camera_info(time_ns));
        put(ranges, range(time_ns));
        for (&channel, name) in images.iter().zip(topics) {
            put(channel, if name.contains("depth") { depth_image(time_ns) } else { image(time_ns, view) });
        }
    }
    writer.finish().unwrap();
}

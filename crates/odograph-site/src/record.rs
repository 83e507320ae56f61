//! A record as it is sent and stored: the length of a head (4 bytes, little-endian), the head as
//! JSON, the length of an image (4 bytes), the image as JPEG.

use nalgebra::{Cholesky, Matrix2, Matrix4, Matrix6, SMatrix, Vector4};
use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::geometry::pose_index::{X, Y};
use odograph::geometry::{GroundPose, Pixel};
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use odograph_map::{OutgoingRecord, StoredImage, is_covariance};
use serde::{Deserialize, Serialize};

/// Longest head, bytes.
const MAX_HEAD: usize = 1 << 20;
/// Largest image, bytes.
const MAX_IMAGE: usize = 12 << 20;
/// Most edges of a record.
const MAX_EDGES: usize = 4096;
/// Largest accepted time, seconds, variance and number of an image: a time in nanoseconds is beyond
/// it.
const LARGEST: f64 = 1e12;
/// Largest accepted coordinate of a pose, metres: half the way around the Earth is twice as far.
const FARTHEST_M: f64 = 1e7;
/// Longest accepted motion between two keyframes, metres, whatever its covariance: at 30 m/s a
/// robot that is lost goes this far in five minutes.
const LONGEST_MOTION_M: f64 = 1e4;
/// Farthest ground from which a motion is measured, in heights of the camera: as far as the search
/// of a whole image looks.
const FARTHEST_IN_HEIGHTS: f64 = 3.0;
/// Standard deviations by which a motion may exceed what the views allow. Where a robot was lost,
/// it is the mean velocity, with half of it as deviation: the motion is at most two of them.
const MOST_DEVIATIONS: f64 = 3.0;
/// Sampled points along a side of an image.
const GRID: usize = 8;
/// Largest accepted heading, radians: 160,000 turns, of which double precision still tells 1e-10.
const MOST_TURNED_RAD: f64 = 1e6;
/// What a correlation may exceed that of a covariance by, for rounding.
const ROUNDING: f64 = 1e-6;

/// A record of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Everything but the image.
    pub head: RecordHead,
    /// The image of a keyframe; `None` for the end of a session.
    pub image: Option<StoredImage>,
}

/// Everything of a record but the image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordHead {
    /// Its number: that of its keyframe. The end of a session has the number after the last.
    pub number: u64,
    /// Number of the record before it; `None` of the first.
    pub after: Option<u64>,
    /// The keyframe; `None` at the end of the session.
    pub keyframe: Option<KeyframeHead>,
    /// Edges between keyframes of the session, none later than this one.
    pub edges: Vec<EdgeHead>,
}

/// A keyframe as odometry gave it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyframeHead {
    frame: u64,
    segment: usize,
    time_s: f64,
    /// x, y, heading, height, roll, pitch in the odometry frame.
    pose: [f64; 6],
    /// Covariance of roll and pitch: of roll, of both, of pitch.
    tilt_covariance: [f64; 3],
    colored: bool,
    luma_scale: f64,
    luma_offset: f64,
}

/// An edge between keyframes of the session, by their numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EdgeHead {
    from: u64,
    to: u64,
    #[serde(with = "EdgeKindName")]
    kind: EdgeKind,
    motion: [f64; 4],
    /// Upper triangle of the covariance, row by row.
    covariance: [f64; 10],
}

/// The kinds of edges as they are written.
#[derive(Serialize, Deserialize)]
#[serde(remote = "EdgeKind", rename_all = "lowercase")]
enum EdgeKindName {
    Odometry,
    Gap,
    Loop,
}

impl Record {
    /// The record of an outbox, after the one with the number `after`.
    pub fn new(record: OutgoingRecord, after: Option<u64>) -> Self {
        let OutgoingRecord { number, keyframe, edges, image } = record;
        let pose = &keyframe.odometry_pose;
        let head = KeyframeHead {
            frame: keyframe.frame,
            segment: keyframe.segment,
            time_s: keyframe.time_s,
            pose: [pose.x_m, pose.y_m, pose.heading_rad, pose.height_m, pose.roll_rad, pose.pitch_rad],
            tilt_covariance: [(4, 4), (4, 5), (5, 5)].map(|at| keyframe.covariance[at]),
            colored: image.colored,
            luma_scale: image.luma_scale,
            luma_offset: image.luma_offset,
        };
        let edges = edges.iter().map(EdgeHead::new).collect();
        Self { head: RecordHead { number, after, keyframe: Some(head), edges }, image: Some(image) }
    }

    /// The end of a session whose last record has the number `after`.
    pub fn end(after: Option<u64>, edges: &[MapEdge]) -> Self {
        let number = after.map_or(0, |after| after + 1);
        let edges = edges.iter().map(EdgeHead::new).collect();
        Self { head: RecordHead { number, after, keyframe: None, edges }, image: None }
    }

    /// The record as bytes. Fails if it is larger than a record may be.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let head = serde_json::to_vec(&self.head)
            .map_err(|error| Error::input(format!("a record cannot be written: {error}")))?;
        let image = self.image.as_ref().map_or(&[][..], |image| &image.jpeg);
        if head.len() > MAX_HEAD || image.len() > MAX_IMAGE || self.head.edges.len() > MAX_EDGES {
            return Err(Error::input(format!(
                "keyframe {} is larger than a record may be",
                self.head.number
            )));
        }
        let mut bytes = Vec::with_capacity(8 + head.len() + image.len());
        for part in [head.as_slice(), image] {
            bytes.extend((part.len() as u32).to_le_bytes());
            bytes.extend_from_slice(part);
        }
        Ok(bytes)
    }

    /// Splits a body into the bytes of its records. Fails if it is no sequence of records.
    pub fn split(mut body: &[u8]) -> Result<Vec<&[u8]>> {
        let mut records = Vec::new();
        while !body.is_empty() {
            let (head, rest) = part(body, MAX_HEAD)?;
            let (image, rest) = part(rest, MAX_IMAGE)?;
            let (record, _) = body.split_at(8 + head.len() + image.len());
            records.push(record);
            body = rest;
        }
        Ok(records)
    }

    /// Reads a record. Fails with the reason if it is not a valid record.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let (head, rest) = part(bytes, MAX_HEAD)?;
        let (image, rest) = part(rest, MAX_IMAGE)?;
        if !rest.is_empty() {
            return Err(malformed("is longer than it says"));
        }
        let head: RecordHead = serde_json::from_slice(head)
            .map_err(|error| malformed(&format!("has an invalid head: {error}")))?;
        let number = head.number;
        let sound = head.after.is_none_or(|after| after < number) && number < u64::MAX >> 2;
        if !sound || head.edges.len() > MAX_EDGES {
            return Err(malformed("has a number that it cannot have, or too many edges"));
        }
        let (last, is_end) = (number, head.keyframe.is_none());
        let known = |end: u64| if is_end { end < last } else { end <= last };
        if !head.edges.iter().all(|edge| edge.is_sound() && known(edge.from) && known(edge.to)) {
            return Err(malformed("has an edge that no robot measures"));
        }
        let image = match &head.keyframe {
            Some(keyframe) if !keyframe.is_sound() => {
                return Err(malformed("has a keyframe that no camera takes"));
            }
            Some(keyframe) => Some(StoredImage {
                colored: keyframe.colored,
                luma_scale: keyframe.luma_scale,
                luma_offset: keyframe.luma_offset,
                jpeg: image.to_vec(),
            }),
            None if image.is_empty() => None,
            None => return Err(malformed("has an image without a keyframe")),
        };
        Ok(Self { head, image })
    }
}

impl Record {
    /// Checks the motions of the edges. What is measured between two keyframes is ground that both
    /// show, so that a motion is no longer than twice the view, from below the camera to its far
    /// end; through keyframes that were removed from the robot's map, twice for each of them. A
    /// longer one is not measured, and its covariance says so. Fails if it does not.
    pub fn check_motions(&self, camera: &Camera, rig: &Rig) -> Result<()> {
        let pose = self.head.keyframe.as_ref().map_or(rig.first_pose(), KeyframeHead::pose);
        let view_m = 2.0 * reach_m(camera, &pose);
        for edge in &self.head.edges {
            let [x_m, y_m, _, log_height_ratio] = edge.motion;
            let length_m = x_m.hypot(y_m);
            let covariance = edge.covariance_matrix();
            let deviation_m = (covariance[(X, X)] + covariance[(Y, Y)]).sqrt();
            let views = edge.from.abs_diff(edge.to) as f64 * log_height_ratio.abs().exp();
            if length_m > views * view_m + MOST_DEVIATIONS * deviation_m {
                return Err(malformed(&format!(
                    "has a motion of {length_m:.1} m between keyframes {} and {}, certain to {deviation_m:.3} m, by a \
                     camera that sees {:.1} m",
                    edge.from,
                    edge.to,
                    0.5 * view_m
                )));
            }
        }
        Ok(())
    }
}

/// The farthest ground in view from below the camera, metres.
fn reach_m(camera: &Camera, pose: &GroundPose) -> f64 {
    let at = |k: usize, size: usize| k as f64 / GRID as f64 * (size as f64 - 1.0);
    let pixels = (0..=GRID).flat_map(|row| (0..=GRID).map(move |column| (column, row)));
    let farthest_m = FARTHEST_IN_HEIGHTS * pose.height_m;
    pixels
        .map(|(column, row)| Pixel::new(at(column, camera.width()), at(row, camera.height())))
        // What shows no ground looks beyond the horizon.
        .map(|pixel| camera.ray_from_pixel(pixel).and_then(|ray| pose.ground_from_ray(ray)))
        .map(|point| point.map_or(farthest_m, |point| (point.x_m - pose.x_m).hypot(point.y_m - pose.y_m)))
        .fold(0.0, f64::max)
        .min(farthest_m)
}

impl KeyframeHead {
    fn is_sound(&self) -> bool {
        let [x_m, y_m, heading_rad, height_m, roll, pitch] = self.pose;
        let [of_roll, both, of_pitch] = self.tilt_covariance;
        let numbers = self.tilt_covariance.iter().chain([&self.time_s, &self.luma_scale, &self.luma_offset]);
        numbers.into_iter().all(|value| value.abs() < LARGEST)
            && [x_m, y_m, height_m].iter().all(|value| value.abs() < FARTHEST_M)
            && heading_rad.abs() < MOST_TURNED_RAD
            && height_m > 0.0
            && roll.abs() < 1.6
            && pitch.abs() < 1.6
            && is_semidefinite(&Matrix2::new(of_roll, both, both, of_pitch))
            && self.segment < 1 << 40
            // The map counts with a sign.
            && i64::try_from(self.frame).is_ok()
    }

    /// Number of its frame, number of gaps before it, and its time, seconds.
    pub fn place_in_source(&self) -> (u64, usize, f64) {
        (self.frame, self.segment, self.time_s)
    }

    /// The pose in the odometry frame.
    pub fn pose(&self) -> GroundPose {
        let [x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad] = self.pose;
        GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
    }

    /// Covariance of the pose, of which only roll and pitch are known here.
    pub fn covariance(&self) -> Matrix6<f64> {
        let mut covariance = Matrix6::zeros();
        let [roll, both, pitch] = self.tilt_covariance;
        covariance[(4, 4)] = roll;
        (covariance[(4, 5)], covariance[(5, 4)]) = (both, both);
        covariance[(5, 5)] = pitch;
        covariance
    }
}

impl EdgeHead {
    fn new(edge: &MapEdge) -> Self {
        let mut covariance = [0.0; 10];
        for (value, (row, column)) in covariance.iter_mut().zip(triangle()) {
            *value = edge.covariance[(row, column)];
        }
        Self { from: edge.from.0, to: edge.to.0, kind: edge.kind, motion: edge.motion.into(), covariance }
    }

    fn is_sound(&self) -> bool {
        let [x_m, y_m, heading_rad, log_height_ratio] = self.motion;
        self.from != self.to
            && [x_m, y_m].iter().all(|value| value.abs() < LONGEST_MOTION_M)
            && heading_rad.abs() < MOST_TURNED_RAD
            && log_height_ratio.abs() < 10.0
            && self.covariance.iter().all(|value| value.abs() < LARGEST)
            && is_semidefinite(&self.covariance_matrix())
    }

    fn covariance_matrix(&self) -> Matrix4<f64> {
        let mut covariance = Matrix4::zeros();
        for ((row, column), value) in triangle().zip(self.covariance) {
            covariance[(row, column)] = value;
            covariance[(column, row)] = value;
        }
        covariance
    }

    /// The edge between the keyframes of a map; `None` where that lacks one of them.
    pub fn edge(&self, id: impl Fn(u64) -> Option<KeyframeId>) -> Option<MapEdge> {
        Some(MapEdge {
            from: id(self.from)?,
            to: id(self.to)?,
            kind: self.kind,
            motion: Vector4::from(self.motion),
            covariance: self.covariance_matrix(),
        })
    }
}

/// Rows and columns of the upper triangle of a 4 x 4 matrix.
fn triangle() -> impl Iterator<Item = (usize, usize)> {
    (0..4).flat_map(|row| (row..4).map(move |column| (row, column)))
}

/// Whether the map can store a covariance, and it is positive semidefinite but for rounding: its
/// correlations have a Cholesky decomposition.
fn is_semidefinite<const N: usize>(covariance: &SMatrix<f64, N, N>) -> bool {
    let correlation = SMatrix::<f64, N, N>::from_fn(|row, column| {
        let value = covariance[(row, column)];
        match (covariance[(row, row)] * covariance[(column, column)]).sqrt() {
            _ if row == column => 1.0 + ROUNDING,
            deviations if value == 0.0 || deviations > 0.0 => value / deviations.max(f64::MIN_POSITIVE),
            // What is certain varies with nothing.
            _ => f64::INFINITY,
        }
    });
    is_covariance(covariance) && Cholesky::new(correlation).is_some()
}

/// The part that bytes begin with, and the rest.
fn part(bytes: &[u8], most: usize) -> Result<(&[u8], &[u8])> {
    let cut = || malformed("is cut off");
    let (length, rest) = bytes.split_first_chunk::<4>().ok_or_else(cut)?;
    let length = u32::from_le_bytes(*length) as usize;
    if length > most {
        return Err(malformed("is too large"));
    }
    rest.split_at_checked(length).ok_or_else(cut)
}

fn malformed(what: &str) -> Error {
    Error::input(format!("a record {what}"))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    fn record(number: u64) -> Record {
        let keyframe = KeyframeHead {
            frame: 10 * number,
            segment: 0,
            time_s: 0.1,
            pose: [1.0, -2.0, 0.3, 1.2, 0.01, -0.02],
            tilt_covariance: [1e-6, 1e-7, 2e-6],
            colored: false,
            luma_scale: 1.0,
            luma_offset: 0.0,
        };
        let edge = MapEdge {
            from: KeyframeId(number - 1),
            to: KeyframeId(number),
            kind: EdgeKind::Odometry,
            motion: Vector4::new(0.2, 0.01, 0.02, 0.0),
            covariance: Matrix4::identity() * 1e-6,
        };
        let head = RecordHead {
            number,
            after: Some(number - 1),
            keyframe: Some(keyframe),
            edges: vec![EdgeHead::new(&edge)],
        };
        let image = StoredImage { colored: false, luma_scale: 1.0, luma_offset: 0.0, jpeg: vec![1, 2, 3] };
        Record { head, image: Some(image) }
    }

    #[test]
    fn records_are_read_back_from_a_body() {
        let records = [record(1), record(2), Record::end(Some(2), &[])];
        let body: Vec<u8> = records.iter().flat_map(|record| record.to_bytes().unwrap()).collect();
        let parts = Record::split(&body).unwrap();
        let back: Vec<Record> = parts.iter().map(|bytes| Record::from_bytes(bytes).unwrap()).collect();
        assert_eq!(back, records);
        let edge = back[1].head.edges[0].edge(|number| Some(KeyframeId(100 + number))).unwrap();
        assert_eq!((edge.from, edge.to), (KeyframeId(101), KeyframeId(102)));
        assert_eq!(edge.covariance, Matrix4::identity() * 1e-6);
    }

    #[test]
    fn a_motion_is_within_the_views_or_uncertain() {
        use odograph::camera::Distortion;
        let camera = Camera::new((320, 240), (250.0, 250.0), (159.5, 119.5), Distortion::None).unwrap();
        let is_refused = |change: &dyn Fn(&mut EdgeHead)| {
            let mut record = record(3);
            change(&mut record.head.edges[0]);
            record.check_motions(&camera, &Rig::level(1.2)).is_err()
        };
        // From 1.2 m the corners are 0.96 m away.
        assert!(!is_refused(&|edge| edge.motion[0] = 1.9));
        assert!(is_refused(&|edge| edge.motion[0] = 2.0));
        assert!(is_refused(&|edge| edge.motion[1] = -35.0));
        // Through two keyframes that were removed.
        assert!(!is_refused(&|edge| (edge.from, edge.motion[0]) = (0, 5.0)));
        assert!(is_refused(&|edge| (edge.from, edge.motion[0]) = (0, 6.0)));
        // A robot that was lost for twenty seconds at 1 m/s.
        let lost = |edge: &mut EdgeHead, deviation_m: f64| {
            (edge.kind, edge.motion[0]) = (EdgeKind::Gap, 20.0);
            (edge.covariance[0], edge.covariance[4]) = (deviation_m.powi(2), deviation_m.powi(2));
        };
        assert!(!is_refused(&|edge| lost(edge, 10.0)));
        assert!(is_refused(&|edge| lost(edge, 1.0)));
    }

    #[test]
    fn what_is_no_record_is_refused() {
        let good = record(3);
        let bytes = good.to_bytes().unwrap();
        for end in 1..bytes.len() {
            assert!(Record::split(&bytes[..end]).is_err(), "{end}");
        }
        assert!(Record::split(&u32::MAX.to_le_bytes()).is_err());
        let refused = |change: &dyn Fn(&mut Record)| {
            let mut record = good.clone();
            change(&mut record);
            Record::from_bytes(&record.to_bytes().unwrap()).is_err()
        };
        assert!(!refused(&|_| {}));
        assert!(refused(&|record| record.head.after = Some(3)));
        assert!(refused(&|record| record.head.edges[0].to = 4));
        assert!(refused(&|record| record.head.edges[0].from = 3));
        assert!(refused(&|record| record.head.edges[0].covariance[0] = -1.0));
        assert!(refused(&|record| record.head.edges[0].motion[1] = f64::NAN));
        assert!(refused(&|record| record.head.edges[0].motion[0] = -2e4));
        // Variances of 1e-6, and a correlation of 2.
        assert!(refused(&|record| record.head.edges[0].covariance[1] = 2e-6));
        assert!(!refused(&|record| record.head.edges[0].covariance[1] = 1e-6));
        // Three that each go against the other two, with correlations that two could have.
        assert!(refused(&|record| {
            let covariance = &mut record.head.edges[0].covariance;
            (covariance[1], covariance[2], covariance[5]) = (-0.9e-6, -0.9e-6, -0.9e-6);
        }));
        let with = |change: &dyn Fn(&mut KeyframeHead)| {
            refused(&|record| change(record.head.keyframe.as_mut().unwrap()))
        };
        assert!(with(&|keyframe| keyframe.frame = 1 << 63));
        assert!(!with(&|keyframe| keyframe.frame = (1 << 63) - 1));
        assert!(with(&|keyframe| keyframe.pose[0] = 1e8));
        for none in [[-1.0, 5.0, -1.0], [1e-6, 2e-6, 1e-6], [0.0, 1e-6, 1e-6]] {
            assert!(with(&|keyframe| keyframe.tilt_covariance = none), "{none:?}");
        }
        for some in [[0.0; 3], [0.0, 0.0, 1e-6], [1e-6, 1e-6, 1e-6]] {
            assert!(!with(&|keyframe| keyframe.tilt_covariance = some), "{some:?}");
        }
        assert!(refused(&|record| record.head.keyframe.as_mut().unwrap().pose[3] = 0.0));
        assert!(refused(&|record| record.head.keyframe.as_mut().unwrap().time_s = 1e300));
        assert!(refused(&|record| record.head.keyframe = None));
    }
}

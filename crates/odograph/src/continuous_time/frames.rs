//! Frames for the adjustment, as the odometry tracks them.

use crate::geometry::{GroundPose, Pixel};
use crate::keyframe::KeyframeId;
use crate::motion::{Elevation, PoseRates};
use crate::odometry::tracking::track_whitenings;
use crate::odometry::{FrameReference, Odometry, TrackView};
use crate::trajectory::FrameEstimate;
use nalgebra::Matrix2;
use std::collections::HashMap;

/// A frame of a window.
#[derive(Debug, Clone)]
pub struct WindowFrame {
    pub time_s: f64,
    /// The pose by the odometry.
    pub pose: PoseRates,
    /// Time of the keyframe that the frame was measured against, and its pose.
    pub keyframe: Option<(f64, PoseRates)>,
    /// Whether the odometry takes the ground to be uneven.
    pub is_uneven: bool,
    pub tracks: Vec<WindowTrack>,
}

/// A corner of a keyframe and where it is in a frame.
#[derive(Debug, Clone, Copy)]
pub struct WindowTrack {
    pub corner: Pixel,
    pub pixel: Pixel,
    pub whitening: Matrix2<f64>,
    /// The elevation of the corner as the odometry knows it, metres.
    pub elevation_m: f64,
}

impl WindowFrame {
    /// With at most this number of tracks, evenly chosen.
    pub fn new(
        (time_s, pose): (f64, PoseRates),
        keyframe: Option<(f64, PoseRates)>,
        tracks: &[TrackView],
        most: usize,
    ) -> Self {
        let mut chosen: Vec<&TrackView> =
            tracks.iter().filter(|track| track.inlier && keyframe.is_some()).collect();
        chosen.sort_by_key(|track| (scattered(track.corner), key(track.corner)));
        chosen.truncate(most);
        let track = |(track, whitening): (&&TrackView, Matrix2<f64>)| {
            let TrackView { corner, pixel, elevation, .. } = **track;
            WindowTrack { corner, pixel, whitening, elevation_m: elevation.mean_m }
        };
        let is_uneven = tracks.iter().any(|track| track.elevation != Elevation::FLAT);
        let tracks = chosen.iter().zip(track_whitenings(&chosen)).map(track).collect();
        Self { time_s, pose, keyframe, is_uneven, tracks }
    }
}

/// What a corner is recognised by.
pub fn key(corner: Pixel) -> (u64, u64) {
    (corner.x.to_bits(), corner.y.to_bits())
}

/// A number without order in the image (multiplicative hashing: D. Knuth, *The Art of Computer
/// Programming* 3, 6.4): those with the smallest ones are the same corners in each frame, and are
/// spread evenly.
fn scattered(corner: Pixel) -> u64 {
    const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;
    let (x, y) = key(corner);
    let mixed = (x.wrapping_mul(GOLDEN) ^ y).wrapping_mul(GOLDEN);
    (mixed ^ (mixed >> 32)).wrapping_mul(GOLDEN)
}

/// The unit of a number of the pose: a height, or a radian.
pub fn unit(index: usize, height_m: f64) -> f64 {
    if matches!(index, 0 | 1 | 3) { height_m } else { 1.0 }
}

/// Makes a [`WindowFrame`] of each frame.
#[derive(Debug, Clone)]
pub struct FrameReader {
    /// Tracks of a frame that are used.
    most_tracks: usize,
    /// Time and pose of every keyframe.
    keyframes: HashMap<KeyframeId, (f64, PoseRates)>,
    /// Frames without a pose since the last one with a pose.
    lost: usize,
}

/// After more frames than this without a pose, what comes is not tied to what was: a new segment
/// begins after three of them at the earliest.
const MOST_LOST: usize = 2;

/// What a frame is to the adjustment.
#[derive(Debug)]
pub enum Read {
    /// The next frame.
    Frame(WindowFrame),
    /// A frame without tracks: an image that repeats the one before it, or one that was lost.
    Untracked,
    /// A frame without a pose after others: what comes is not tied to what was.
    Gap,
}

impl FrameReader {
    /// With this number of tracks of each frame.
    pub fn new(most_tracks: usize) -> Self {
        Self { most_tracks, keyframes: HashMap::new(), lost: 0 }
    }

    /// Takes the next frame, the result of [`Odometry::process`], and its tracks.
    pub fn read(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Read {
        let (Some(estimate), Some(reference)) = (&frame.estimate, odometry.reference()) else {
            self.lost += 1;
            return if self.lost > MOST_LOST { Read::Gap } else { Read::Untracked };
        };
        self.lost = 0;
        if odometry.tracks().is_empty() {
            return Read::Untracked;
        }
        let GroundPose { height_m, roll_rad, pitch_rad, .. } = estimate.pose;
        let plane = &estimate.measured;
        let pose = PoseRates::new(plane.x_m, plane.y_m, plane.heading_rad, height_m, roll_rad, pitch_rad);
        Read::Frame(self.frame((frame.time_s, pose), reference, odometry.tracks()))
    }

    /// Of the time of a frame and its pose, what it was measured against, and its tracks.
    pub fn frame(
        &mut self,
        now: (f64, PoseRates),
        reference: FrameReference,
        tracks: &[TrackView],
    ) -> WindowFrame {
        let is_first = self.keyframes.is_empty();
        if is_first {
            self.keyframes.insert(reference.keyframe, now);
        }
        let keyframe = self.keyframes.get(&reference.keyframe).filter(|_| !is_first).copied();
        if let Some((next, _)) = reference.next {
            self.keyframes.entry(next).or_insert(now);
        }
        WindowFrame::new(now, keyframe, tracks, self.most_tracks)
    }
}

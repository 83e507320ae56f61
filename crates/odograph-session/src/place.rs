//! Pose of a camera in an existing map.

use odograph::geometry::wrap_angle;
use odograph::keyframe::KeyframeId;
use odograph::slam::Mapper;
use odograph::trajectory::FrameSummary;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Pose of a camera, or of the robot that carries it, at a frame, in the frame of an existing map,
/// with standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseInMap {
    /// Number of the frame in its source.
    pub frame: u64,
    /// Its time, seconds.
    pub time_s: f64,
    /// Position along x of the map, metres.
    pub x_m: f64,
    /// Position along y of the map, metres.
    pub y_m: f64,
    /// Heading, counter-clockwise from x of the map.
    pub heading_deg: f64,
    /// Standard deviation along x, metres.
    pub sd_x_m: f64,
    /// Standard deviation along y, metres.
    pub sd_y_m: f64,
    /// Standard deviation of the heading.
    pub sd_heading_deg: f64,
    /// The nearest keyframe of earlier sessions.
    pub keyframe: u64,
    /// Distance to it, metres.
    pub keyframe_distance_m: f64,
    /// Session of that keyframe.
    pub session: u32,
}

impl PoseInMap {
    /// Whether there are earlier sessions.
    pub(crate) fn can_be(mapper: &Mapper) -> bool {
        mapper.map().keyframes.iter().any(|keyframe| keyframe.session != mapper.session())
    }

    /// The place of the robot, whose frame this is.
    pub(crate) fn of(self, frame: &FrameSummary) -> Self {
        let Some(place) = frame.place else { return self };
        let [variance_x, _, variance_y] = place.position_covariance;
        Self {
            x_m: place.x_m,
            y_m: place.y_m,
            heading_deg: wrap_angle(place.heading_rad).to_degrees(),
            sd_x_m: variance_x.max(0.0).sqrt(),
            sd_y_m: variance_y.max(0.0).sqrt(),
            sd_heading_deg: place.heading_variance.max(0.0).sqrt().to_degrees(),
            ..self
        }
    }

    /// The last frame that measurements connect to keyframes of earlier sessions.
    pub(crate) fn last(frames: &[FrameSummary], mapper: &Mapper) -> Option<Self> {
        let map = mapper.map();
        // Keyframes of a segment are connected by measurements: one of them suffices.
        let own = map.keyframes.iter().filter(|keyframe| keyframe.session == mapper.session());
        let firsts: BTreeMap<usize, KeyframeId> = own.rev().map(|first| (first.segment, first.id)).collect();
        let tied: BTreeSet<usize> = firsts
            .into_iter()
            .filter(|(_, id)| mapper.is_tied_to_old(*id))
            .map(|(segment, _)| segment)
            .collect();
        let is_tied = |frame: &FrameSummary| tied.contains(&(frame.segment as usize));
        let frame = frames.iter().rev().find(|frame| frame.place.is_some() && is_tied(frame))?;
        let place = frame.place?;
        let distance_m = |x_m: f64, y_m: f64| (x_m - place.x_m).hypot(y_m - place.y_m);
        let old = map.keyframes.iter().filter(|keyframe| keyframe.session != mapper.session());
        let (keyframe_distance_m, nearest) = old
            .map(|keyframe| (distance_m(keyframe.pose.x_m, keyframe.pose.y_m), keyframe))
            .min_by(|a, b| a.0.total_cmp(&b.0))?;
        let there = Self {
            frame: frame.frame,
            time_s: frame.time_s,
            x_m: 0.0,
            y_m: 0.0,
            heading_deg: 0.0,
            sd_x_m: 0.0,
            sd_y_m: 0.0,
            sd_heading_deg: 0.0,
            keyframe: nearest.id.0,
            keyframe_distance_m,
            session: nearest.session,
        };
        Some(there.of(frame))
    }
}

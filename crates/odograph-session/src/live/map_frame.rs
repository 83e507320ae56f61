//! Path and mosaic of the page in the map frame.
//!
//! Odometry's own path never jumps: what is printed, sent and recorded stays as measured. The page
//! shows the map frame instead, in which a loop closure moves earlier poses.

use super::ground::{LiveGround, MosaicUpdate, PlacedKeyframe};
use super::map_graph::{map_graph, map_markers};
use crate::mapping::Mapping;
use odograph::geometry::Sim2;
use odograph::ground_map::{GroundMap, MapKeyframe};
use odograph::keyframe::EdgeKind;
use odograph_live::Hub;
use odograph_live::capture::{Newest, Taken};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// A correction in the page's format: scale times cosine and sine of the rotation in millionths,
/// the translation in tenths of a millimetre.
fn numbers(correction: &Sim2) -> [f64; 4] {
    let rounded = |value: f64, steps: f64| (value * steps).round() / steps;
    let (cos, sin) = correction.rotate(1.0, 0.0);
    [rounded(cos, 1e6), rounded(sin, 1e6), rounded(correction.x_m, 1e4), rounded(correction.y_m, 1e4)]
}

/// Shortest interval between updates of the whole path on the page, plus the same per thousand
/// keyframes, so that a long path does not take most of the time.
const SENT_EVERY: Duration = Duration::from_secs(1);
/// Largest share of a core for rendering again: each rendering is followed by a pause of nine times
/// its duration.
const REST: u32 = 9;

/// Watches the map for loops.
pub struct MapFrameUpdates<'a> {
    hub: &'a Hub,
    updates: &'a Newest<MosaicUpdate>,
    loops: usize,
    sent: Option<Instant>,
    /// Number of sightings of markers that the page shows.
    sightings: usize,
}

impl<'a> MapFrameUpdates<'a> {
    pub fn new(hub: &'a Hub, updates: &'a Newest<MosaicUpdate>) -> Self {
        Self { hub, updates, loops: 0, sent: None, sightings: 0 }
    }

    /// Publishes the markers if one was seen since the last call.
    pub fn publish_markers(&mut self, mapping: &Mapping) {
        let mapper = mapping.mapper();
        if mapper.marker_sightings() != self.sightings {
            self.sightings = mapper.marker_sightings();
            self.send_markers(mapping);
        }
    }

    fn send_markers(&self, mapping: &Mapping) {
        let landmarks = mapping.mapper().landmarks(None);
        self.hub.notify("markers", &map_markers(landmarks.into_iter().map(|at| (at.number, at.pose))));
    }

    /// Publishes the corrected poses if there was a loop closure since the last call.
    pub fn publish_if_closed(&mut self, mapping: &Mapping) {
        let mapper = mapping.mapper();
        let map = mapper.map();
        let interval = SENT_EVERY * (1 + map.keyframes.len() as u32 / 1000);
        if !mapper.is_corrected() || self.sent.is_some_and(|sent| sent.elapsed() < interval) {
            return;
        }
        let loops = map.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop).count();
        if loops == self.loops {
            return;
        }
        (self.loops, self.sent) = (loops, Some(Instant::now()));
        self.hub.notify("map", &map_message(map, mapper.session()));
        if self.sightings > 0 {
            self.send_markers(mapping);
        }
        let own = map.keyframes.iter().filter(|keyframe| keyframe.session == mapper.session());
        self.updates.give(MosaicUpdate {
            file: mapping.path().to_owned(),
            session: mapper.session(),
            keyframes: own.map(PlacedKeyframe::from).collect(),
        });
    }
}

/// The correction from the odometry frame to the map frame at the newest keyframe; `None` as long
/// as the two are the same.
pub fn newest_correction(mapping: &Mapping) -> Option<Sim2> {
    let mapper = mapping.mapper();
    let own = mapper.map().keyframes.iter().rfind(|keyframe| keyframe.session == mapper.session());
    own.filter(|_| mapper.is_corrected()).map(MapKeyframe::map_from_odometry)
}

/// Keyframes and loop closures, and the correction from the odometry frame to the map frame at each
/// keyframe of a session.
fn map_message(map: &GroundMap, session: u32) -> Value {
    let mut value = map_graph(map);
    let own = map.keyframes.iter().filter(|keyframe| keyframe.session == session);
    value["corrections"] =
        json!(own.flat_map(|keyframe| numbers(&keyframe.map_from_odometry())).collect::<Vec<_>>());
    value
}

/// Renders the mosaic again on request, with pauses, until the requests end.
pub fn render_again(queue: &Newest<MosaicUpdate>, ground: &LiveGround) {
    let (mut waiting, mut rest_until) = (None, Instant::now());
    loop {
        match queue.take(Duration::from_millis(200)) {
            Taken::Item(update) => waiting = Some(update),
            Taken::Nothing => {}
            Taken::End => return,
        }
        if Instant::now() >= rest_until
            && let Some(update) = waiting.take()
        {
            let begun = Instant::now();
            // If the file cannot be read the mosaic stays as it is.
            let _ = ground.render_again(&update);
            rest_until = Instant::now() + REST * begun.elapsed();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::geometry::{GroundPose, PlaneTransform};
    use odograph::keyframe::KeyframeId;

    #[test]
    fn a_correction_takes_its_keyframe_to_where_the_map_has_it_and_the_rest_with_it() {
        let odometry_pose = GroundPose { x_m: 3.0, y_m: -1.0, heading_rad: 0.4, ..GroundPose::level(1.2) };
        let pose = GroundPose { x_m: 2.9, y_m: -1.3, heading_rad: 0.9, ..GroundPose::level(1.26) };
        let keyframe = MapKeyframe {
            id: KeyframeId(0),
            session: 0,
            segment: 0,
            frame: 0,
            time_s: 0.0,
            odometry_pose,
            pose,
            covariance: nalgebra::Matrix6::zeros(),
            signature: Default::default(),
        };
        let correction = keyframe.map_from_odometry();
        let near = |a: &GroundPose, b: &GroundPose| {
            let differences =
                [a.x_m - b.x_m, a.y_m - b.y_m, a.heading_rad - b.heading_rad, a.height_m - b.height_m];
            differences.iter().all(|difference| difference.abs() < 1e-12)
        };
        assert!(near(&correction.apply_to_pose(&odometry_pose), &pose));
        // A frame one metre ahead of it stays one metre ahead, in the map's scale.
        let (sin, cos) = 0.4_f64.sin_cos();
        let ahead = GroundPose { x_m: 3.0 + cos, y_m: -1.0 + sin, ..odometry_pose };
        let moved = correction.apply_to_pose(&ahead);
        let (sin, cos) = 0.9_f64.sin_cos();
        assert!(
            near(&moved, &GroundPose { x_m: 2.9 + 1.05 * cos, y_m: -1.3 + 1.05 * sin, ..pose }),
            "{moved:?}"
        );
        assert_eq!(Sim2::IDENTITY.apply_to_pose(&ahead), ahead);
    }
}

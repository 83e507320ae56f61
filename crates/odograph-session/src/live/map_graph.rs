//! A map as the page draws it.

use odograph::geometry::{GroundPose, Se2};
use odograph::ground_map::GroundMap;
use odograph::keyframe::EdgeKind;
use serde_json::{Value, json};

/// Keyframes and loop closures; metres.
pub fn map_graph(map: &GroundMap) -> Value {
    let thousandths = |metres: f64| (1e3 * metres).round() / 1e3;
    let place = |pose: &GroundPose| [thousandths(pose.x_m), thousandths(pose.y_m)];
    let keyframes: Vec<[f64; 2]> = map.keyframes.iter().map(|keyframe| place(&keyframe.pose)).collect();
    let at = |id| map.keyframes.binary_search_by_key(&id, |keyframe| keyframe.id).ok();
    let loops = map.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop);
    let loops: Vec<[usize; 2]> = loops.filter_map(|edge| Some([at(edge.from)?, at(edge.to)?])).collect();
    json!({ "keyframes": keyframes, "loops": loops })
}

/// Markers on the ground, each as its place in the map, metres, and its number.
pub fn map_markers(markers: impl IntoIterator<Item = (u32, Se2)>) -> Value {
    let thousandths = |metres: f64| (1e3 * metres).round() / 1e3;
    let marker = |(number, pose): (u32, Se2)| json!([thousandths(pose.x_m), thousandths(pose.y_m), number]);
    markers.into_iter().map(marker).collect()
}

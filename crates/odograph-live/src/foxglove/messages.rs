//! Conversion of frames into Foxglove messages.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use nalgebra::Isometry3;
use odograph::geometry::pose_index::{X, Y};
use odograph::odometry::TrackView;
use odograph::trajectory::PoseEstimate;
use serde_json::{Value, json};

/// The odometry frame of reference, continuous and without jumps (`odom` in REP-105).
pub const WORLD: &str = "odom";
/// The camera frame: x right, y down, z forward along the optical axis.
pub const CAMERA: &str = "camera";

/// Scale of the 95 % ellipse of a bivariate normal distribution, in standard deviations.
const DEVIATIONS: f64 = 2.4477;

/// A timestamp as a Foxglove `time`.
pub fn time(nanoseconds: u64) -> Value {
    json!({ "sec": nanoseconds / 1_000_000_000, "nsec": nanoseconds % 1_000_000_000 })
}

fn vector(x: f64, y: f64, z: f64) -> Value {
    json!({ "x": x, "y": y, "z": z })
}

/// The quaternion of a rotation about the vertical axis.
fn turned(heading_rad: f64) -> Value {
    let (sin, cos) = (0.5 * heading_rad).sin_cos();
    json!({ "x": 0.0, "y": 0.0, "z": sin, "w": cos })
}

fn color(red: f64, green: f64, blue: f64, opacity: f64) -> Value {
    json!({ "r": red, "g": green, "b": blue, "a": opacity })
}

/// Position and orientation of a rigid transform.
fn placed(transform: &Isometry3<f64>) -> (Value, Value) {
    let (at, turn) = (transform.translation, transform.rotation);
    (vector(at.x, at.y, at.z), json!({ "x": turn.i, "y": turn.j, "z": turn.k, "w": turn.w }))
}

pub fn frame_transform(at: u64, parent: &str, child: &str, transform: &Isometry3<f64>) -> Value {
    let (translation, rotation) = placed(transform);
    json!({
        "timestamp": time(at), "parent_frame_id": parent, "child_frame_id": child, "translation": translation, "rotation": rotation,
    })
}

pub fn pose_in_frame(at: u64, pose: &Isometry3<f64>) -> Value {
    let (position, orientation) = placed(pose);
    json!({ "timestamp": time(at), "frame_id": WORLD, "pose": { "position": position, "orientation": orientation } })
}

pub fn compressed_image(at: u64, jpeg: &[u8]) -> Value {
    json!({ "timestamp": time(at), "frame_id": CAMERA, "data": BASE64.encode(jpeg), "format": "jpeg" })
}

/// The tracks on an image of `scale` times the camera's size: inliers and outliers in two colours.
pub fn image_annotations(at: u64, tracks: &[TrackView], scale: f64) -> Value {
    let points = |inlier: bool, color: Value| {
        // Foxglove's pixel origin is the corner of the first pixel, ours its centre.
        let place = |pixel: f64| tenths((pixel + 0.5) * scale);
        let points: Vec<Value> = tracks
            .iter()
            .filter(|track| track.inlier == inlier)
            .map(|track| json!({ "x": place(track.pixel.x), "y": place(track.pixel.y) }))
            .collect();
        json!({
            "timestamp": time(at), "type": 1, "points": points, "outline_color": color, "outline_colors": [], "fill_color": color,
            "thickness": 4.0, "metadata": [],
        })
    };
    let (agree, differ) = (color(0.15, 0.82, 0.54, 1.0), color(1.0, 0.35, 0.27, 1.0));
    json!({ "circles": [], "points": [points(true, agree), points(false, differ)], "texts": [] })
}

/// Rounds to tenths: of a pixel in images, of a millimetre in paths.
fn tenths(value: f64) -> f64 {
    (10.0 * value).round() / 10.0
}

pub fn log(at: u64, warning: bool, message: &str) -> Value {
    let level = if warning { 3 } else { 2 };
    json!({ "timestamp": time(at), "level": level, "message": message, "name": "odograph", "file": "", "line": 0 })
}

/// A scene with one entity, which stays until the next one with the same id.
fn scene(at: u64, id: &str, cylinders: Value, lines: Value) -> Value {
    json!({
        "deletions": [],
        "entities": [{
            "timestamp": time(at), "frame_id": WORLD, "id": id, "lifetime": { "sec": 0, "nsec": 0 }, "frame_locked": true, "metadata": [],
            "arrows": [], "cubes": [], "spheres": [], "cylinders": cylinders, "lines": lines, "triangles": [], "texts": [], "models": [],
        }],
    })
}

/// Deletes all entities of a topic.
pub fn cleared(at: u64) -> Value {
    json!({ "deletions": [{ "timestamp": time(at), "type": 1, "id": "" }], "entities": [] })
}

/// The 95 % error ellipse of the camera's position on the ground.
pub fn ellipse(at: u64, known: &PoseEstimate) -> Value {
    let covariance = known.covariance;
    let (a, b, d) = (covariance[(X, X)], covariance[(X, Y)], covariance[(Y, Y)]);
    let (middle, spread) = (0.5 * (a + d), (0.5 * (a - d)).hypot(b));
    let across = |variance: f64| 2.0 * DEVIATIONS * variance.max(0.0).sqrt();
    let along = 0.5 * (2.0 * b).atan2(a - d);
    let size = vector(across(middle + spread), across(middle - spread), 1e-3);
    let position = vector(known.pose.x_m, known.pose.y_m, 0.0);
    let cylinder = json!({
        "pose": { "position": position, "orientation": turned(along) }, "size": size, "bottom_scale": 1.0, "top_scale": 1.0,
        "color": color(0.04, 0.43, 0.41, 0.5),
    });
    scene(at, "ellipse", json!([cylinder]), json!([]))
}

/// The trajectory as lines, one per segment without a gap; coordinates in metres.
pub fn path(at: u64, stretches: &[Vec<[f64; 2]>]) -> Value {
    let place = |metres: f64| 1e-3 * tenths(1e3 * metres);
    let line = |stretch: &Vec<[f64; 2]>| {
        let points: Vec<Value> = stretch.iter().map(|[x, y]| vector(place(*x), place(*y), 0.0)).collect();
        json!({
            "type": 0, "pose": { "position": vector(0.0, 0.0, 0.0), "orientation": turned(0.0) }, "thickness": 3.0,
            "scale_invariant": true, "points": points, "color": color(0.04, 0.43, 0.41, 1.0), "colors": [], "indices": [],
        })
    };
    scene(at, "path", json!([]), stretches.iter().map(line).collect())
}

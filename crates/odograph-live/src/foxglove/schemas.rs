//! JSON Schemas of the Foxglove message types that are written here, with the fields listed at
//! <https://docs.foxglove.dev/docs/sdk/schemas>. Foxglove identifies a type by its name; other
//! readers use the fields.

use serde_json::{Map, Value, json};

/// A named message type.
pub struct Schema {
    pub name: &'static str,
    pub json: Value,
}

impl Schema {
    fn new(name: &'static str, fields: &[(&str, Value)]) -> Self {
        Self { name, json: object(name, fields) }
    }
}

/// An object whose fields are all required.
fn object(title: &str, fields: &[(&str, Value)]) -> Value {
    let names: Vec<&str> = fields.iter().map(|(name, _)| *name).collect();
    let properties: Map<String, Value> =
        fields.iter().map(|(name, schema)| ((*name).to_owned(), schema.clone())).collect();
    json!({ "type": "object", "title": title, "properties": properties, "required": names })
}

fn of_type(name: &str) -> Value {
    json!({ "type": name })
}

fn array(items: Value) -> Value {
    json!({ "type": "array", "items": items })
}

/// An object whose fields all have the same type.
fn alike(title: &str, names: &[&'static str], schema: &Value) -> Value {
    let fields: Vec<(&str, Value)> = names.iter().map(|name| (*name, schema.clone())).collect();
    object(title, &fields)
}

fn time() -> Value {
    alike("time", &["sec", "nsec"], &of_type("integer"))
}

fn duration() -> Value {
    alike("duration", &["sec", "nsec"], &of_type("integer"))
}

fn numbers(title: &str, names: &[&'static str]) -> Value {
    alike(title, names, &of_type("number"))
}

fn vector() -> Value {
    numbers("foxglove.Vector3", &["x", "y", "z"])
}

fn quaternion() -> Value {
    numbers("foxglove.Quaternion", &["x", "y", "z", "w"])
}

fn color() -> Value {
    numbers("foxglove.Color", &["r", "g", "b", "a"])
}

fn pose() -> Value {
    object("foxglove.Pose", &[("position", vector()), ("orientation", quaternion())])
}

fn pairs() -> Value {
    array(object("foxglove.KeyValuePair", &[("key", of_type("string")), ("value", of_type("string"))]))
}

pub fn frame_transform() -> Schema {
    Schema::new(
        "foxglove.FrameTransform",
        &[
            ("timestamp", time()),
            ("parent_frame_id", of_type("string")),
            ("child_frame_id", of_type("string")),
            ("translation", vector()),
            ("rotation", quaternion()),
        ],
    )
}

pub fn pose_in_frame() -> Schema {
    let fields = [("timestamp", time()), ("frame_id", of_type("string")), ("pose", pose())];
    Schema::new("foxglove.PoseInFrame", &fields)
}

pub fn compressed_image() -> Schema {
    Schema::new(
        "foxglove.CompressedImage",
        &[
            ("timestamp", time()),
            ("frame_id", of_type("string")),
            ("data", json!({ "type": "string", "contentEncoding": "base64" })),
            ("format", of_type("string")),
        ],
    )
}

pub fn image_annotations() -> Schema {
    let points = object(
        "foxglove.PointsAnnotation",
        &[
            ("timestamp", time()),
            ("type", of_type("integer")),
            ("points", array(numbers("foxglove.Point2", &["x", "y"]))),
            ("outline_color", color()),
            ("outline_colors", array(color())),
            ("fill_color", color()),
            ("thickness", of_type("number")),
            ("metadata", pairs()),
        ],
    );
    // Circles and texts are part of the type and always empty.
    let nothing = || array(of_type("object"));
    let fields = [("circles", nothing()), ("points", array(points)), ("texts", nothing())];
    Schema::new("foxglove.ImageAnnotations", &fields)
}

pub fn scene_update() -> Schema {
    let deletion = object(
        "foxglove.SceneEntityDeletion",
        &[("timestamp", time()), ("type", of_type("integer")), ("id", of_type("string"))],
    );
    let cylinder = object(
        "foxglove.CylinderPrimitive",
        &[
            ("pose", pose()),
            ("size", vector()),
            ("bottom_scale", of_type("number")),
            ("top_scale", of_type("number")),
            ("color", color()),
        ],
    );
    let line = object(
        "foxglove.LinePrimitive",
        &[
            ("type", of_type("integer")),
            ("pose", pose()),
            ("thickness", of_type("number")),
            ("scale_invariant", of_type("boolean")),
            ("points", array(numbers("foxglove.Point3", &["x", "y", "z"]))),
            ("color", color()),
            ("colors", array(color())),
            ("indices", array(of_type("integer"))),
        ],
    );
    let nothing = || array(of_type("object"));
    let entity = object(
        "foxglove.SceneEntity",
        &[
            ("timestamp", time()),
            ("frame_id", of_type("string")),
            ("id", of_type("string")),
            ("lifetime", duration()),
            ("frame_locked", of_type("boolean")),
            ("metadata", pairs()),
            ("arrows", nothing()),
            ("cubes", nothing()),
            ("spheres", nothing()),
            ("cylinders", array(cylinder)),
            ("lines", array(line)),
            ("triangles", nothing()),
            ("texts", nothing()),
            ("models", nothing()),
        ],
    );
    let fields = [("deletions", array(deletion)), ("entities", array(entity))];
    Schema::new("foxglove.SceneUpdate", &fields)
}

pub fn log() -> Schema {
    Schema::new(
        "foxglove.Log",
        &[
            ("timestamp", time()),
            ("level", of_type("integer")),
            ("message", of_type("string")),
            ("name", of_type("string")),
            ("file", of_type("string")),
            ("line", of_type("integer")),
        ],
    )
}

/// The fields of `--print poses`, so that each of them can be plotted.
pub fn frame() -> Schema {
    let number_or_nothing = || json!({ "type": ["number", "null"] });
    let pose = json!({
        "type": ["object", "null"],
        "properties": {
            "x_m": of_type("number"), "y_m": of_type("number"), "heading_rad": of_type("number"), "height_m": of_type("number"),
            "roll_rad": of_type("number"), "pitch_rad": of_type("number"), "velocity_x_m_s": of_type("number"),
            "velocity_y_m_s": of_type("number"), "heading_rate_rad_s": of_type("number"),
            "covariance_x_y_heading": array(array(of_type("number"))),
        },
    });
    Schema::new(
        "odograph.Frame",
        &[
            ("frame", of_type("integer")),
            ("time_s", of_type("number")),
            ("status", of_type("string")),
            ("segment", of_type("integer")),
            ("tracks", of_type("integer")),
            ("inliers", of_type("integer")),
            ("residual_px", of_type("number")),
            ("latency_ms", number_or_nothing()),
            ("pose", pose),
        ],
    )
}

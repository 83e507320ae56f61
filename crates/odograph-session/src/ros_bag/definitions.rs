//! The message definitions of ROS 2 that a bag contains for its readers.

/// A type with its definition, and those of the types in it.
pub struct Definition {
    pub name: &'static str,
    own: &'static str,
    parts: &'static [(&'static str, &'static str)],
}

const TIME: (&str, &str) = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
const HEADER: (&str, &str) = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n");
const POINT: (&str, &str) = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n");
const VECTOR: (&str, &str) = ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n");
const QUATERNION: (&str, &str) =
    ("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n");

/// `nav_msgs/msg/Odometry`
pub const ODOMETRY: Definition = Definition {
    name: "nav_msgs/msg/Odometry",
    own: "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
          geometry_msgs/TwistWithCovariance twist\n",
    parts: &[
        HEADER,
        TIME,
        ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"),
        ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
        POINT,
        QUATERNION,
        ("geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance\n"),
        ("geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"),
        VECTOR,
    ],
};

/// `tf2_msgs/msg/TFMessage`
pub const TRANSFORMS: Definition = Definition {
    name: "tf2_msgs/msg/TFMessage",
    own: "geometry_msgs/TransformStamped[] transforms\n",
    parts: &[
        (
            "geometry_msgs/TransformStamped",
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
        ),
        HEADER,
        TIME,
        ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"),
        VECTOR,
        QUATERNION,
    ],
};

/// `diagnostic_msgs/msg/DiagnosticArray`
pub const DIAGNOSTICS: Definition = Definition {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    own: "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
    parts: &[
        HEADER,
        TIME,
        (
            "diagnostic_msgs/DiagnosticStatus",
            "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n\
             string hardware_id\ndiagnostic_msgs/KeyValue[] values\n",
        ),
        ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
    ],
};

impl Definition {
    /// The text as MCAP has it (`ros2msg`): each type behind a line of 80 equality signs.
    pub fn text(&self) -> String {
        let part = |(name, text): &(&str, &str)| format!("{}\nMSG: {name}\n{text}", "=".repeat(80));
        self.own.to_owned() + &self.parts.iter().map(part).collect::<String>()
    }
}

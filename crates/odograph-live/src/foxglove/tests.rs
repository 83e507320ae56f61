#![allow(clippy::unwrap_used)] // a test fails by panicking

use super::*;
use nalgebra::{Matrix3, Matrix6};
use odograph::geometry::{GroundPose, Pixel};
use odograph::trajectory::{LossReason, PlaneMeasurement, PoseEstimate, Velocity};
use std::collections::BTreeMap;

/// Ten frames per second along x; the fifth is lost.
fn frame(number: u64) -> FrameEstimate {
    let pose = GroundPose { x_m: 0.02 * number as f64, y_m: 0.3, heading_rad: 0.4, ..GroundPose::level(1.2) };
    let mut covariance = Matrix6::zeros();
    covariance
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&Matrix3::new(4e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6));
    let measured = PlaneMeasurement::new(&pose, &covariance);
    let lost = number == 4;
    FrameEstimate {
        frame: number,
        time_s: 5.0 + 0.1 * number as f64,
        status: if lost { TrackStatus::Lost { reason: LossReason::Dark } } else { TrackStatus::Tracked },
        estimate: (!lost).then_some(PoseEstimate {
            pose,
            velocity: Velocity::default(),
            covariance,
            measured,
        }),
        tracks: 50,
        inliers: 40,
        residual_px: 0.1,
        keyframe: false,
        segment: usize::from(number > 4),
    }
}

fn picture() -> TrackedImage {
    let track = |x: f64, inlier| {
        let corner = Pixel::new(x, 4.0);
        TrackView { pixel: Pixel::new(x, 3.0), inlier, ..TrackView::exact(corner) }
    };
    TrackedImage { gray: GrayImage::new(16, 12), tracks: vec![track(2.0, true), track(7.0, false)] }
}

/// Reads all messages by topic and checks each against the schema of its channel. The file is
/// complete (`whole`) or was left by a killed process.
fn read(path: &Path, whole: bool) -> BTreeMap<String, Vec<(u64, Value)>> {
    let bytes = std::fs::read(path).unwrap();
    let mut messages: BTreeMap<String, Vec<(u64, Value)>> = BTreeMap::new();
    let options = if whole { Default::default() } else { mcap::read::Options::IgnoreEndMagic.into() };
    for message in mcap::MessageStream::new_with_options(&bytes, options).unwrap() {
        let Ok(message) = message else {
            assert!(!whole, "{message:?}");
            break;
        };
        let schema = message.channel.schema.as_ref().unwrap();
        assert_eq!(
            (schema.encoding.as_str(), message.channel.message_encoding.as_str()),
            ("jsonschema", "json")
        );
        let value: Value = serde_json::from_slice(&message.data).unwrap();
        let schema: Value = serde_json::from_slice(&schema.data).unwrap();
        conforms(&value, &schema, &message.channel.topic);
        messages.entry(message.channel.topic.clone()).or_default().push((message.log_time, value));
    }
    messages
}

/// Asserts that a value conforms to the subset of JSON Schema that is used here.
fn conforms(value: &Value, schema: &Value, place: &str) {
    let is = |name: &str| match name {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "integer" => value.is_u64() || value.is_i64(),
        "number" => value.is_number(),
        "boolean" => value.is_boolean(),
        "null" => value.is_null(),
        other => panic!("{place}: a type {other}"),
    };
    let fits = match &schema["type"] {
        Value::String(name) => is(name),
        names => names.as_array().unwrap().iter().any(|name| is(name.as_str().unwrap())),
    };
    assert!(fits, "{place}: {value} is no {}", schema["type"]);
    let required = schema["required"].as_array().into_iter().flatten();
    required.for_each(|name| {
        assert!(
            !value[name.as_str().unwrap()].is_null() || name == "latency_ms" || name == "pose",
            "{place}: no {name}"
        )
    });
    for (name, value) in value.as_object().into_iter().flatten() {
        let schema =
            schema["properties"].get(name).unwrap_or_else(|| panic!("{place}: {name} is not in the schema"));
        conforms(value, schema, &format!("{place}.{name}"));
    }
    for value in value.as_array().into_iter().flatten() {
        conforms(value, &schema["items"], place);
    }
}

#[test]
fn messages_read_back_conform_to_their_schemas() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut file = McapFile::create(&path, "a drive").unwrap();
    for number in 0..25 {
        let picture = (number % 5 == 0).then(picture);
        file.add(&frame(number), &PoseFrame::Camera, 3.5, picture.as_ref()).unwrap();
    }
    assert_eq!(file.frames(), 25);
    file.finish().unwrap();
    let messages = read(&path, true);
    let count = |topic: &str| messages[topic].len();
    assert_eq!(
        [count("/frame"), count("/pose"), count("/tf"), count("/camera"), count("/camera/tracks")],
        [25, 24, 24, 5, 5]
    );
    // Uncertainty: 24 poses and one deletion at the loss. Log: tracked, lost, tracked. Path: at 5,
    // 6 and 7 s, and at the end.
    assert_eq!([count("/uncertainty"), count("/log"), count("/path")], [25, 3, 4]);
    let (at, pose) = &messages["/pose"][10];
    assert_eq!(
        (*at, &pose["timestamp"]["sec"], &pose["timestamp"]["nsec"]),
        (6_100_000_000, &6.into(), &100_000_000.into())
    );
    let position = &pose["pose"]["position"];
    assert_eq!((position["x"].as_f64(), position["z"].as_f64()), (Some(0.22), Some(1.2)));
    // The camera looks down: its optical axis is the world's -z.
    let part = |name: &str| pose["pose"]["orientation"][name].as_f64().unwrap();
    let turn = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
        part("w"),
        part("x"),
        part("y"),
        part("z"),
    ));
    assert!((turn * nalgebra::Vector3::z() + nalgebra::Vector3::z()).norm() < 1e-12);
    // Standard deviations of 2 mm and 1 mm: the ellipse's axes are 2 · 2.4477 times these.
    let size = &messages["/uncertainty"][0].1["entities"][0]["cylinders"][0]["size"];
    assert!(
        (size["x"].as_f64().unwrap() - 9.791e-3).abs() < 1e-6
            && (size["y"].as_f64().unwrap() - 4.895e-3).abs() < 1e-6
    );
    assert_eq!(messages["/log"][1].1["message"], "lost:dark");
    let lines = &messages["/path"][3].1["entities"][0]["lines"];
    assert_eq!([0, 1].map(|k| lines[k]["points"].as_array().unwrap().len()), [4, 20]);
    assert_eq!(lines[1]["points"][19]["x"], 0.48);
    let jpeg = messages["/camera"][0].1["data"].as_str().unwrap();
    // Base64 of FF D8 FF, the first bytes of a JPEG file.
    assert!(jpeg.starts_with("/9j/"), "{jpeg}");
    let points = &messages["/camera/tracks"][0].1["points"];
    assert_eq!((&points[0]["points"][0]["x"], &points[1]["points"][0]["x"]), (&2.5.into(), &7.5.into()));
    let summary = mcap::Summary::read(&std::fs::read(&path).unwrap()).unwrap().unwrap();
    let metadata = summary.metadata_indexes.len();
    assert_eq!((summary.stats.unwrap().message_count, metadata), (25 + 24 + 24 + 5 + 5 + 25 + 3 + 4, 1));
}

#[test]
fn a_killed_writer_loses_only_the_last_second() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut file = McapFile::create(&path, "a drive").unwrap();
    (0..35).for_each(|number| file.add(&frame(number), &PoseFrame::Camera, 3.5, Some(&picture())).unwrap());
    // Neither finished nor dropped, as after a power failure.
    std::mem::forget(file);
    let kept = read(&path, false)["/frame"].len();
    assert_eq!(kept, 30);
    // And if the disk holds only a part of the last chunk, whose index takes a kilobyte.
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 4000]).unwrap();
    let kept = read(&path, false)["/frame"].len();
    assert!((20..30).contains(&kept), "{kept}");
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_is_an_error_not_a_panic() {
    let mut file = match McapFile::create(Path::new("/dev/full"), "a drive") {
        Ok(file) => file,
        Err(error) => return assert!(error.to_string().contains("/dev/full")),
    };
    let failed =
        (0..400).find_map(|number| file.add(&frame(number), &PoseFrame::Camera, 3.5, None).err()).unwrap();
    assert!(failed.to_string().contains("/dev/full cannot be written"), "{failed}");
    assert!(file.add(&frame(400), &PoseFrame::Camera, 3.5, None).is_err());
    drop(file);
}

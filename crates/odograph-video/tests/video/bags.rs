//! Small robot recordings of every kind (`data/bags/make.py`): their frames, cameras and sensors,
//! and what is left of them when they are damaged.

use odograph::camera::Distortion;
use odograph::filter::fusion::{Quantity, SensorKind};
use odograph_video::{
    Frame, SourceOptions, StreamUse, inspect, is_robot_recording, open, recorded_camera, recorded_sensor,
};
use std::fs;
use std::path::{Path, PathBuf};

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/bags").join(name)
}

const WIDTH: usize = 24;
const HEIGHT: usize = 16;

/// The image of a frame, as `make.py` draws it.
fn gray(number: usize) -> Vec<u8> {
    let level = |x: usize, y: usize| (x * 7 + y * 13 + number * 31 + x * y) as u8;
    (0..WIDTH * HEIGHT).map(|at| level(at % WIDTH, at / WIDTH)).collect()
}

/// The time of a frame, seconds.
fn time_s(number: usize) -> f64 {
    let time_ns = 1_700_000_000_123_456_789 + 33_333_333 * number as u64;
    (time_ns / 1_000_000_000) as f64 + (time_ns % 1_000_000_000) as f64 / 1e9
}

fn frames(path: &Path, options: &SourceOptions) -> (Vec<Frame>, Vec<String>) {
    let mut source = open(path, options).unwrap();
    let frames = std::iter::from_fn(|| source.next_frame().unwrap()).collect();
    (frames, source.take_warnings())
}

const DRIVES: [&str; 10] = [
    "drive.bag",
    "drive_bz2.bag",
    "drive_lz4.bag",
    "drive.mcap",
    "drive_lz4.mcap",
    "drive_zstd.mcap",
    "drive.db3",
    "drive_message.db3",
    "drive.db3.zstd",
    "split",
];

#[test]
fn every_kind_of_recording_has_the_same_frames_at_the_same_times() {
    for name in DRIVES {
        assert!(is_robot_recording(data(name)), "{name}");
        let source = open(data(name), &SourceOptions::default()).unwrap();
        let info = source.info();
        assert_eq!((info.width, info.height, info.frame_count), (WIDTH, HEIGHT, Some(6)), "{name}");
        assert!(info.description.contains("/camera/image_raw"), "{}", info.description);
        let (frames, warnings) = frames(&data(name), &SourceOptions::default());
        assert_eq!(warnings, [""; 0], "{name}");
        assert_eq!(frames.len(), 6, "{name}");
        for (number, frame) in frames.iter().enumerate() {
            assert_eq!(frame.time_s, time_s(number), "{name}");
            assert_eq!(frame.gray.samples(), gray(number), "{name} {number}");
        }
    }
}

#[test]
fn every_encoding_gives_the_same_gray() {
    for bag in ["encodings.mcap", "encodings.bag"] {
        for topic in [
            "mono8",
            "wide",
            "unsigned",
            "mono16",
            "mono16_big",
            "rgb8",
            "bgr8",
            "three",
            "rgba8",
            "bgra8",
            "uyvy",
            "yuyv",
            "nv12",
            "/png/compressed",
        ] {
            for color in [false, true] {
                let options = SourceOptions { topic: Some(topic.into()), color, ..Default::default() };
                let (frames, _) = frames(&data(bag), &options);
                assert_eq!(frames.len(), 1, "{bag} {topic}");
                assert_eq!(frames[0].gray.samples(), gray(0), "{bag} {topic}");
                assert_eq!(frames[0].rgb().pixel(0, 0).len(), 3);
            }
        }
        for topic in ["bayer_rggb8", "bayer_gbrg8", "/jpeg/compressed"] {
            let options = SourceOptions { topic: Some(topic.into()), ..Default::default() };
            let (frames, _) = frames(&data(bag), &options);
            assert_eq!(frames[0].gray.samples(), [77; WIDTH * HEIGHT], "{bag} {topic}");
        }
        let depth = SourceOptions { topic: Some("/depth".into()), ..Default::default() };
        let error = open(data(bag), &depth).unwrap_err().to_string();
        assert!(error.contains("\"32FC1\" are not read"), "{error}");
    }
}

#[test]
fn several_topics_with_images_are_listed() {
    let error = open(data("encodings.mcap"), &SourceOptions::default()).unwrap_err().to_string();
    for words in [
        "there are 17 topics with images; choose one with --topic NAME:",
        "\n  /mono8            24x16 mono8 ",
        "\n  /jpeg/compressed  24x16 jpeg ",
        "  1 image  sensor_msgs/CompressedImage\n",
    ] {
        assert!(error.contains(words), "{words}: {error}");
    }
    let wrong = SourceOptions { topic: Some("/imu".into()), ..Default::default() };
    let error = open(data("drive.mcap"), &wrong).unwrap_err().to_string();
    assert!(
        error.contains("no images on the topic /imu; /imu has 6 messages of the type sensor_msgs/msg/Imu; the topics with images are:\n  /camera/image_raw  24x16"),
        "{error}"
    );
    let named = SourceOptions { topic: Some("camera/image_raw".into()), ..Default::default() };
    assert!(open(data("drive.bag"), &named).is_ok());
    // A video has no topics.
    let clip = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/hevc.mp4");
    assert!(open(clip, &named).unwrap_err().to_string().contains("have topics"));
}

#[test]
fn without_stamps_the_times_of_recording_are_used_with_a_warning() {
    let (frames, warnings) = frames(&data("unstamped.mcap"), &SourceOptions::default());
    let times: Vec<f64> = frames.iter().map(|frame| frame.time_s).collect();
    assert_eq!(times, (0..6).map(time_s).collect::<Vec<_>>());
    assert!(warnings.len() == 1 && warnings[0].contains("on /image have no time stamp"), "{warnings:?}");
}

/// `drive.db3` with its messages changed: those of a topic, in the order in which they were
/// recorded.
fn changed(folder: &Path, topic: &str, change: impl Fn(&mut [Vec<u8>])) -> PathBuf {
    let path = folder.join("changed.db3");
    fs::copy(data("drive.db3"), &path).unwrap();
    let database = rusqlite::Connection::open(&path).unwrap();
    let of = "FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = ?1) ORDER BY rowid";
    let rows: Vec<(i64, Vec<u8>)> = database
        .prepare(&format!("SELECT rowid, data {of}"))
        .unwrap()
        .query_map([topic], |row| Ok((row.get(0)?, row.get(1)?)))
        .unwrap()
        .map(Result::unwrap)
        .collect();
    let (numbers, mut messages): (Vec<i64>, Vec<Vec<u8>>) = rows.into_iter().unzip();
    change(&mut messages);
    for (number, message) in numbers.iter().zip(messages) {
        database.execute("UPDATE messages SET data = ?2 WHERE rowid = ?1", (number, message)).unwrap();
    }
    path
}

/// Moves the time in the header of a message in CDR by whole seconds.
fn move_stamp(message: &mut [u8], seconds: i32) {
    let stamp = i32::from_le_bytes(message[4..8].try_into().unwrap());
    message[4..8].copy_from_slice(&(stamp + seconds).to_le_bytes());
}

/// `drive.db3` fifty times, a second later each, with each message of a topic of images changed
/// that has this number.
fn long(folder: &Path, change: impl Fn(usize, &mut Vec<u8>)) -> PathBuf {
    let path = folder.join("long.db3");
    fs::copy(data("drive.db3"), &path).unwrap();
    let database = rusqlite::Connection::open(&path).unwrap();
    let rows: Vec<(i64, i64, Vec<u8>)> = database
        .prepare("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid")
        .unwrap()
        .query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))
        .unwrap()
        .map(Result::unwrap)
        .collect();
    database.execute_batch("BEGIN").unwrap();
    let (images, mut number): (i64, usize) = (
        database
            .query_row("SELECT id FROM topics WHERE name = '/camera/image_raw'", [], |row| row.get(0))
            .unwrap(),
        0,
    );
    database.execute_batch("DELETE FROM messages").unwrap();
    for second in 0..50 {
        for (topic, log_ns, message) in &rows {
            let mut message = message.clone();
            move_stamp(&mut message, second);
            if *topic == images {
                change(number, &mut message);
                number += 1;
            }
            let insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
            let log_ns = log_ns + i64::from(second) * 1_000_000_000;
            database.execute(insert, (topic, log_ns, message)).unwrap();
        }
    }
    database.execute_batch("COMMIT").unwrap();
    drop(database);
    path
}

#[test]
fn a_wrong_stamp_costs_its_own_message_only() {
    let place = tempfile::tempdir().unwrap();
    for (wrong, seconds) in [(0, 1000), (2, 1000), (3, -1000)] {
        let others: Vec<f64> = (0..6).filter(|number| *number != wrong).map(time_s).collect();
        let words = "1 of the images on /camera/image_raw was left out, because its time does not fit";
        let change = |messages: &mut [Vec<u8>]| move_stamp(&mut messages[wrong], seconds);
        let path = changed(place.path(), "/camera/image_raw", change);
        let (frames, warnings) = frames(&path, &SourceOptions::default());
        assert_eq!(frames.iter().map(|frame| frame.time_s).collect::<Vec<_>>(), others, "{wrong} {seconds}");
        assert!(warnings.len() == 1 && warnings[0].contains(words), "{warnings:?}");
        // Other times are those of the frames as they were recorded.
        let (frames, _) = self::frames(&path, &SourceOptions { fps: Some(30.0), ..Default::default() });
        assert_eq!(frames.len(), 6);
        for (topic, kind) in [("/imu", SensorKind::Gyro), ("/odom", SensorKind::Wheel)] {
            let path = changed(place.path(), topic, change);
            let (record, warnings) = recorded_sensor(&path, topic, kind).unwrap();
            let times: Vec<f64> = record.unwrap().samples().map(|(time_s, _)| time_s).collect();
            assert_eq!(times, others, "{topic} {wrong} {seconds}");
            assert!(warnings.len() == 1 && warnings[0].contains("1 of the messages on"), "{warnings:?}");
        }
    }
}

#[test]
fn a_clock_that_was_set_loses_no_frame() {
    let place = tempfile::tempdir().unwrap();
    for (seconds, way) in [(-5, "back"), (5, "forward")] {
        let set = |messages: &mut [Vec<u8>]| messages[3..].iter_mut().for_each(|m| move_stamp(m, seconds));
        let path = changed(place.path(), "/camera/image_raw", set);
        let (frames, warnings) = frames(&path, &SourceOptions::default());
        assert_eq!(frames.len(), 6);
        for (number, frame) in frames.iter().enumerate() {
            // The times are exact to 2e-7 s, that of a double of this size.
            assert!((frame.time_s - time_s(number)).abs() < 1e-6, "{number}");
        }
        let words =
            format!("the clock of the images on /camera/image_raw was set {way} by 5.00 s, 0.07 s after");
        assert!(warnings.len() == 1 && warnings[0].contains(&words), "{warnings:?}");
    }
}

#[test]
fn images_that_were_recorded_out_of_order_are_sorted() {
    let place = tempfile::tempdir().unwrap();
    let path = changed(place.path(), "/camera/image_raw", |messages| messages.swap(2, 3));
    let (frames, warnings) = frames(&path, &SourceOptions::default());
    assert_eq!(warnings, [""; 0]);
    for (number, frame) in frames.iter().enumerate() {
        assert_eq!((frame.time_s, frame.gray.samples()), (time_s(number), &gray(number)[..]));
    }
}

#[test]
fn times_in_bursts_become_even() {
    let place = tempfile::tempdir().unwrap();
    let bursts = |number: usize, message: &mut Vec<u8>| {
        let time_ms = number / 5 * 5 * 40 + number % 5;
        message[4..8].copy_from_slice(&(1_700_000_000 + time_ms as u32 / 1000).to_le_bytes());
        message[8..12].copy_from_slice(&(time_ms as u32 % 1000 * 1_000_000).to_le_bytes());
    };
    let (read, warnings) = frames(&long(place.path(), bursts), &SourceOptions::default());
    assert_eq!(read.len(), 300);
    assert!(
        warnings.len() == 1 && warnings[0].contains("on /camera/image_raw come in bursts"),
        "{warnings:?}"
    );
    let steps = || read.windows(2).map(|pair| pair[1].time_s - pair[0].time_s);
    // While the period is learned a step is that of sixty frames a second; then as accurate as the
    // clock's own tests show.
    assert!(steps().all(|step_s| step_s > 5e-3), "{:?}", steps().collect::<Vec<_>>());
    assert!(steps().skip(60).all(|step_s| (0.028..0.056).contains(&step_s)));
}

#[test]
fn the_bits_in_use_are_full_scale() {
    let place = tempfile::tempdir().unwrap();
    // White from the third image on; before it the image has ten bits.
    let twelve = |number: usize, message: &mut Vec<u8>| {
        let gray = gray(number % 6);
        let samples = gray.iter().map(|&level| match number {
            0..2 => u16::from(level),
            _ => (u32::from(level) * 4095 / 255) as u16,
        });
        let samples: Vec<u8> = samples.flat_map(u16::to_le_bytes).collect();
        *message = mono16(&message[4..12], &samples);
    };
    let (read, warnings) = frames(&long(place.path(), twelve), &SourceOptions::default());
    assert_eq!(read[5].gray.samples(), gray(5));
    assert!(warnings.iter().any(|w| w.contains("have 12 of 16 bits in use")), "{warnings:?}");
}

/// `sensor_msgs/msg/Image` of 16 bits.
fn mono16(stamp: &[u8], samples: &[u8]) -> Vec<u8> {
    let mut message = [&[0, 1, 0, 0], stamp, &4u32.to_le_bytes(), b"cam\0"].concat();
    message.extend([HEIGHT as u32, WIDTH as u32, 7].iter().flat_map(|number| number.to_le_bytes()));
    message.extend(b"mono16\0\0");
    message.extend([2 * WIDTH as u32, samples.len() as u32].iter().flat_map(|number| number.to_le_bytes()));
    message.extend(samples);
    message
}

#[test]
fn a_sensor_without_measurements_or_stamps_says_so() {
    let place = tempfile::tempdir().unwrap();
    let cut = |messages: &mut [Vec<u8>]| messages[1..].iter_mut().for_each(|message| message.truncate(60));
    let (record, warnings) =
        recorded_sensor(changed(place.path(), "/imu", cut), "/imu", SensorKind::Gyro).unwrap();
    assert!(record.is_none());
    assert!(
        warnings.len() == 1 && warnings[0].contains("the topic /imu has 1 measurements and is not used"),
        "{warnings:?}"
    );
    let clear = |messages: &mut [Vec<u8>]| messages.iter_mut().for_each(|message| message[4..12].fill(0));
    let (record, warnings) =
        recorded_sensor(changed(place.path(), "/odom", clear), "/odom", SensorKind::Wheel).unwrap();
    assert_eq!(record.unwrap().samples().count(), 6);
    assert!(warnings.len() == 1 && warnings[0].contains("on /odom have no time stamp"), "{warnings:?}");
}

#[test]
fn videos_in_messages_are_decoded() {
    for (topic, clip) in [("/video", "hevc.h265"), ("/ffmpeg", "h264_interlaced.264")] {
        let clip = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(clip);
        let (expected, _) = frames(&clip, &SourceOptions::default());
        let options = SourceOptions { topic: Some(topic.into()), ..Default::default() };
        let (decoded, warnings) = frames(&data("video.mcap"), &options);
        assert_eq!(warnings, [""; 0]);
        assert_eq!(decoded.len(), expected.len());
        for (number, (frame, expected)) in decoded.iter().zip(&expected).enumerate() {
            assert_eq!(frame.gray.samples(), expected.gray.samples(), "{topic} {number}");
            assert_eq!(frame.time_s, time_s(number));
        }
    }
}

#[test]
fn the_camera_and_the_sensors_are_in_the_recording() {
    for name in DRIVES {
        let found = recorded_camera(data(name), None).unwrap().unwrap();
        assert_eq!((found.topic.as_str(), found.rectified), ("/camera/camera_info", false), "{name}");
        assert_eq!((found.camera.width(), found.camera.height()), (WIDTH, HEIGHT));
        assert_eq!((found.camera.focal_px(), found.camera.principal_px()), ((20.0, 21.0), (11.5, 7.5)));
        let distortion = Distortion::from_opencv(&[0.1, -0.05, 0.001, -0.002, 0.01]).unwrap();
        assert_eq!(found.camera.distortion(), &distortion);

        let samples = |topic, kind| match recorded_sensor(data(name), topic, kind).unwrap() {
            (Some(record), warnings) if warnings.is_empty() => record,
            other => panic!("{name} {topic}: {other:?}"),
        };
        let gyro = samples("/imu", SensorKind::Gyro);
        assert_eq!(gyro.quantity(), Quantity::TurnRates);
        assert_eq!(gyro.samples().nth(2), Some((time_s(2), vec![0.02, 0.02, -0.03])));
        let wheel = samples("/odom", SensorKind::Wheel);
        assert_eq!(wheel.samples().nth(1), Some((time_s(1), vec![0.6])));
        let range = samples("range", SensorKind::Range);
        assert_eq!(range.quantity(), Quantity::AxisDistance);
        assert_eq!(range.samples().nth(1), Some((time_s(1), vec![1.0])));
    }
    let error = recorded_sensor(data("drive.bag"), "/odom", SensorKind::Gyro).unwrap_err().to_string();
    assert!(
        error.contains("no topic /odom of the type sensor_msgs/Imu") && error.ends_with("/imu"),
        "{error}"
    );
    assert!(recorded_camera(data("encodings.mcap"), Some("/mono8")).unwrap().is_none());
}

#[test]
fn a_database_that_is_no_recording_is_refused() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("map.gpkg");
    let database = rusqlite::Connection::open(&path).unwrap();
    database
        .execute_batch(
            "CREATE TABLE keyframes(id); CREATE VIEW topics AS SELECT 1; CREATE TABLE messages(id)",
        )
        .unwrap();
    let error = open(&path, &SourceOptions::default()).unwrap_err().to_string();
    assert!(error.ends_with("an SQLite database and not a recording (a map is given with --map, and odograph map info shows it)"), "{error}");
}

#[test]
fn what_is_in_a_recording_is_listed() {
    for name in DRIVES {
        let contents = inspect(data(name)).unwrap();
        let uses: Vec<(&str, &StreamUse)> =
            contents.streams.iter().map(|s| (s.topic.as_deref().unwrap(), &s.usable_as)).collect();
        assert!(
            matches!(
                uses[..],
                [
                    ("/camera/camera_info", StreamUse::CameraInfo),
                    ("/camera/image_raw", StreamUse::Frames(Some(_))),
                    ("/imu", StreamUse::Gyro),
                    ("/odom", StreamUse::Wheel),
                    ("/range", StreamUse::Range)
                ]
            ),
            "{name}: {uses:?}"
        );
        let images = &contents.streams[1];
        assert_eq!(
            (images.count, images.size, images.encoding.as_str()),
            (6, Some((24, 16)), "mono8"),
            "{name}"
        );
        assert!((images.rate_hz.unwrap() - 30.0).abs() < 1e-3 && images.gaps.is_empty());
        assert_eq!(images.span_s, Some((time_s(0), time_s(5))));
    }
    let clip = inspect(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/h264_bframes.mp4")).unwrap();
    let [video] = &clip.streams[..] else { panic!("{clip:?}") };
    let (frames, _) = frames(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/h264_bframes.mp4"),
        &SourceOptions::default(),
    );
    assert_eq!(video.count, frames.len() as u64);
    assert_eq!(video.span_s, Some((frames[0].time_s, frames[frames.len() - 1].time_s)));
    assert_eq!(video.usable_as, StreamUse::Frames(None));
}

/// Number of frames that can be read from damaged bytes; 0 where it is refused. Whatever the
/// damage, neither a panic nor more than the recording ever had.
fn survivors(folder: &Path, name: &str, bytes: &[u8]) -> usize {
    let path = folder.join(name);
    fs::write(&path, bytes).unwrap();
    let options = SourceOptions { topic: Some("/camera/image_raw".into()), ..Default::default() };
    let Ok(mut source) = open(&path, &options) else { return 0 };
    let mut count = 0;
    while let Ok(Some(_)) = source.next_frame() {
        count += 1;
        assert!(count <= 6, "{name}");
    }
    let _ = source.take_warnings();
    let _ = recorded_camera(&path, Some("/camera/image_raw"));
    let _ = recorded_sensor(&path, "/imu", SensorKind::Gyro);
    count
}

#[test]
fn a_truncated_recording_is_read_up_to_the_cut() {
    let place = tempfile::tempdir().unwrap();
    for name in DRIVES.iter().filter(|name| **name != "split") {
        let whole = fs::read(data(name)).unwrap();
        let step = (whole.len() / 120).max(1);
        let counts: Vec<usize> =
            (0..=whole.len()).step_by(step).map(|end| survivors(place.path(), name, &whole[..end])).collect();
        // More bytes never give fewer frames, and all but the end gives some.
        assert!(counts.is_sorted(), "{name}: {counts:?}");
        // The first pages of a database are its tables, most of one as small as this.
        let most = if name.contains("db3") { counts.len() * 9 / 10 } else { counts.len() / 2 + 1 };
        // A block of these is read as a whole.
        let one_block = name.contains("lz4.mcap") || name.ends_with("zstd");
        assert!(counts[most] > 0 || one_block, "{name}: {counts:?}");
        let (frames, warnings) = {
            let cut = place.path().join(name);
            fs::write(&cut, &whole[..whole.len() * 3 / 4]).unwrap();
            match open(&cut, &SourceOptions::default()) {
                Ok(mut source) => {
                    let frames = std::iter::from_fn(|| source.next_frame().unwrap()).count();
                    (frames, source.take_warnings())
                }
                Err(_) => (0, Vec::new()),
            }
        };
        assert!(
            !(1..6).contains(&frames)
                || warnings.iter().any(|w| w.contains("cut off") || w.contains("no index")),
            "{name}: {warnings:?}"
        );
    }
}

#[test]
fn half_of_a_database_has_half_of_its_frames() {
    let place = tempfile::tempdir().unwrap();
    let path = long(place.path(), |_, _| ());
    let options = SourceOptions { topic: Some("/camera/image_raw".into()), ..Default::default() };
    assert_eq!(frames(&path, &options).0.len(), 300);
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let (read, warnings) = frames(&path, &options);
    // An index of the times lies between the messages, and the tables before them.
    assert!((100..200).contains(&read.len()), "{}", read.len());
    assert!(warnings.len() == 1 && warnings[0].contains("damaged or cut off"), "{warnings:?}");
}

#[test]
fn flipped_bytes_give_an_error_or_frames() {
    let place = tempfile::tempdir().unwrap();
    let mut random = 1u64;
    let mut next = move || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (random >> 33) as usize
    };
    for name in DRIVES.iter().filter(|name| **name != "split") {
        let whole = fs::read(data(name)).unwrap();
        for _ in 0..250 {
            let mut bytes = whole.clone();
            for _ in 0..1 + next() % 4 {
                let at = next() % bytes.len();
                bytes[at] = [0, 0xff, 0x7f, next() as u8][next() % 4];
            }
            survivors(place.path(), name, &bytes);
        }
    }
}

#[test]
fn a_bag_that_was_never_closed_is_read() {
    let place = tempfile::tempdir().unwrap();
    let whole = fs::read(data("drive.bag")).unwrap();
    // The recorder writes index_pos, and the lengths of the last chunk, when it closes the bag.
    let find = |part: &[u8]| whole.windows(part.len()).position(|window| window == part).unwrap();
    let mut bytes = whole.clone();
    let index = find(b"index_pos=") + 10;
    let end = u64::from_le_bytes(whole[index..index + 8].try_into().unwrap()) as usize;
    bytes[index..index + 8].fill(0);
    bytes.truncate(end);
    let path = place.path().join("drive.bag.active");
    fs::write(&path, &bytes).unwrap();
    let (read, warnings) = frames(&path, &SourceOptions::default());
    assert_eq!(read.len(), 6);
    assert!(warnings.len() == 1 && warnings[0].contains("no index"), "{warnings:?}");

    let last = bytes.windows(5).rposition(|window| window == b"size=").unwrap() + 5;
    bytes[last..last + 8].fill(0);
    fs::write(&path, &bytes).unwrap();
    let (read, _) = frames(&path, &SourceOptions::default());
    assert_eq!(read.len(), 6);
}

#[test]
fn a_folder_without_metadata_is_read_in_order() {
    let place = tempfile::tempdir().unwrap();
    for part in ["split_0.mcap", "split_1.mcap"] {
        fs::copy(data("split").join(part), place.path().join(part)).unwrap();
    }
    let (read, warnings) = frames(place.path(), &SourceOptions::default());
    assert_eq!((read.len(), warnings), (6, Vec::new()));
    // A part that is cut off before its first message is left out with a warning.
    fs::write(place.path().join("split_2.mcap"), b"\x89MCAP0\r\n").unwrap();
    fs::write(place.path().join("split_3.mcap"), fs::read(data("drive.db3")).unwrap().split_at(100).0)
        .unwrap();
    let (read, warnings) = frames(place.path(), &SourceOptions::default());
    assert_eq!(read.len(), 6);
    assert!(warnings.iter().any(|warning| warning.contains("split_3.mcap was left out")), "{warnings:?}");
}

#[test]
fn a_part_that_is_missing_or_not_named_is_reported() {
    let place = tempfile::tempdir().unwrap();
    for file in ["metadata.yaml", "split_1.mcap"] {
        fs::copy(data("split").join(file), place.path().join(file)).unwrap();
    }
    fs::copy(data("split/split_1.mcap"), place.path().join("split_2.mcap")).unwrap();
    let (read, warnings) = frames(place.path(), &SourceOptions::default());
    assert_eq!(read.len(), 3);
    for words in [
        "metadata.yaml names split_0.mcap, not in this folder",
        "metadata.yaml does not name split_2.mcap, left out",
    ] {
        assert!(warnings.iter().any(|warning| warning.contains(words)), "{words}: {warnings:?}");
    }
}

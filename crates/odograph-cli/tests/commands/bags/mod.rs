//! Robot recordings as a black box: a run over a recording is the run over its frames.

mod robot_recording;

use crate::hostile::recording;
use odograph::geometry::EarthPosition;
use odograph::georeference::Anchor;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

pub use robot_recording::write_robot;
use robot_recording::{Cdr, FRAMES, looking_down, time_ns, transforms, write, write_with};

fn odograph(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.current_dir(folder).args(arguments.split_whitespace()).output().unwrap()
}

fn done(folder: &Path, arguments: &str) -> (String, String) {
    let output = odograph(folder, arguments);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments}: {message}");
    (String::from_utf8(output.stdout).unwrap(), message)
}

#[test]
fn a_run_over_a_recording_is_the_run_over_its_frames() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    fs::write(here.join("drive.y4m"), recording::y4m(FRAMES)).unwrap();
    fs::write(here.join("camera.yaml"), recording::CAMERA).unwrap();
    let times: Vec<String> = (0..FRAMES).map(|number| time_ns(number).to_string()).collect();
    fs::write(here.join("times.txt"), times.join("\n")).unwrap();
    write(&here.join("drive.mcap"), &["/front/image_raw"]);
    write(&here.join("two.mcap"), &["/front/image_raw", "/front/image_rect"]);
    done(here, "run drive.y4m --timestamps times.txt --camera camera.yaml --height 1.0 -o frames --quiet");
    // The camera is that of the recording.
    done(here, "run drive.mcap --height 1.0 -o bag --quiet");
    done(here, "run two.mcap --topic /front/image_raw --height 1.0 -o chosen --quiet");
    let trajectory = fs::read_to_string(here.join("frames/trajectory.tum")).unwrap();
    assert_eq!(trajectory.lines().filter(|line| !line.starts_with('#')).count(), FRAMES);
    for folder in ["bag", "chosen"] {
        assert_eq!(
            fs::read_to_string(here.join(folder).join("trajectory.tum")).unwrap(),
            trajectory,
            "{folder}"
        );
    }
    // run.toml repeats it, from its own folder.
    done(here, "run chosen/run.toml -o again --quiet");
    assert_eq!(fs::read_to_string(here.join("again/trajectory.tum")).unwrap(), trajectory);

    // What is missing or too much is reported in one sentence.
    for (arguments, words) in [
        (
            "run two.mcap --height 1.0",
            "there are 2 topics with images; choose one with --topic NAME:\n  /front/image_raw   320x240 mono8  30.0 Hz  40 \
             images  sensor_msgs/Image\n  /front/image_rect  320x240 mono8",
        ),
        ("run drive.mcap", "the height of the camera above the ground is missing"),
        (
            "run drive.mcap --height 1.0 --gyro-topic /imu",
            "there is no topic /imu of the type sensor_msgs/Imu",
        ),
        ("run drive.y4m --topic /front --camera camera.yaml --height 1.0", "only robot recordings"),
        ("run drive.mcap --height 1.0 --range-topic /sonar --range range.csv", "cannot be used with"),
    ] {
        let output = odograph(here, &format!("{arguments} -o refused"));
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && message.contains(words), "{arguments}: {message}");
    }
    let (_, message) = done(here, "run drive.mcap --height 1.0 --range-topic /sonar -o ranged");
    assert!(!message.contains("error"), "{message}");
    let statistics = fs::read_to_string(here.join("ranged/stats.json")).unwrap();
    assert!(statistics.contains("\"sensors\""), "{statistics}");
}

/// Numbers of the lines of a TUM file.
fn poses(path: &Path) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(path).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.split(' ').map(|word| word.parse().unwrap()).collect()).collect()
}

#[test]
fn the_mount_is_taken_from_the_transforms_of_a_recording() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    let level = |z: f64| [0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0];
    let robot = [("base_footprint", "base_link", level(0.2)), ("base_link", "camera", looking_down(0.8))];
    write_robot(&here.join("robot.mcap"), &["/front/image_raw"], &robot, &[]);
    let (_, message) = done(here, "run robot.mcap -o robot");
    assert!(
        message.contains(
            "note: camera in base_link, from /tf_static: x 0.300 m, y 0.050 m, z 0.800 m, roll 0.0°, pitch 0.0°, \
             yaw 0.0°; height 1.000 m over base_footprint (--rig overrides)\n"
        ),
        "{message}"
    );
    // The height is in the recording, so that `info` asks for nothing.
    let (text, _) = done(here, "info robot.mcap");
    assert!(text.contains("    odograph run robot.mcap --topic /front/image_raw\n"), "{text}");
    done(here, "run robot.mcap --frame camera -o camera --quiet");
    let (robot_poses, camera) =
        (poses(&here.join("robot/trajectory.tum")), poses(&here.join("camera/trajectory.tum")));
    assert_eq!((robot_poses.len(), camera.len()), (FRAMES, FRAMES));
    for (robot, camera) in robot_poses.iter().zip(&camera) {
        // The floor moves without turning.
        assert!((robot[1] - camera[1] + 0.3).abs() < 2e-3 && (robot[2] - camera[2] + 0.05).abs() < 2e-3);
        assert!((robot[3] - 0.2).abs() < 2e-3 && robot[7] > 0.999, "{robot:?}");
    }
    // --height and --rig come before it.
    done(here, "run robot.mcap --height 2.0 -o high --quiet");
    let last = poses(&here.join("high/trajectory.tum")).pop().unwrap();
    assert!((last[3] - 1.2).abs() < 5e-3, "{last:?}");
    fs::write(here.join("rig.toml"), "height_m = 1.0").unwrap();
    let (_, message) = done(here, "run robot.mcap --rig rig.toml -o given");
    assert!(!message.contains("tf_static"), "{message}");

    // The frame of a camera that is not its optical frame looks ahead.
    let ahead = [("base_link", "camera", level(0.8))];
    write_robot(&here.join("ahead.mcap"), &["/front/image_raw"], &ahead, &[]);
    let (_, message) = done(here, "run ahead.mcap --height 1.0 -o ahead");
    assert!(message.contains("warning: the transforms of ahead.mcap are not used"), "{message}");
    let first = &poses(&here.join("ahead/trajectory.tum"))[0];
    assert!((first[3] - 1.0).abs() < 1e-6, "{first:?}");
}

#[test]
fn transforms_that_do_not_connect_are_noted() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    let robot = [("base_link", "camera_link", looking_down(0.8))];
    write_robot(&here.join("robot.mcap"), &["/front/image_raw"], &robot, &[]);
    let (_, message) = done(here, "run robot.mcap --height 1.0 -o robot");
    assert!(
        message.contains(
            "note: /tf_static (base_link, camera_link) does not connect the frame camera of the images with base_link; \
             poses are those of the camera\n"
        ),
        "{message}"
    );
    write(&here.join("two.mcap"), &["/front/image_raw", "/rear/image_raw"]);
    let output = odograph(here, "live two.mcap --height 1.0 -o live");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.code() == Some(2) && message.contains("can be chosen for odograph run, not for live"),
        "{message}"
    );
}

#[test]
fn the_antenna_is_where_the_transforms_put_it() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    let origin = EarthPosition::from_degrees(48.2082, 16.3738).unwrap();
    let fixes = [Some(origin); FRAMES];
    let robot = [
        ("base_link", "camera", looking_down(0.8)),
        ("base_link", "gps", [1.0, 0.5, 0.3, 0.0, 0.0, 0.0, 1.0]),
    ];
    let (_, message) = {
        write_robot(&here.join("robot.mcap"), &["/front/image_raw"], &robot, &fixes);
        done(here, "run robot.mcap --height 1.0 --gnss-topic /gnss/fix -o robot")
    };
    let words = "note: gps in base_link, from /tf_static: x 1.000 m, y 0.500 m, z 0.300 m (gnss_lever_arm_m";
    assert!(message.contains(words), "{message}");
    let plan = fs::read_to_string(here.join("robot/run.toml")).unwrap();
    assert!(plan.contains("[antenna]\nx_m = 1.0\ny_m = 0.5\n"), "{plan}");
    // That of a rig file comes before it.
    fs::write(
        here.join("rig.toml"),
        "height_m = 1.0\nx_m = 0.3\ny_m = 0.05\nz_m = 0.8\ngnss_lever_arm_m = [0.1, 0, 0]",
    )
    .unwrap();
    let (_, message) = done(here, "run robot.mcap --rig rig.toml --gnss-topic /gnss/fix -o given");
    assert!(!message.contains("gps in base_link"), "{message}");
}

/// A message in CDR that is read again.
struct Cdr2<'a>(&'a [u8], usize);

impl Cdr2<'_> {
    fn u32(&mut self) -> u32 {
        self.1 = 4 + (self.1 - 4).next_multiple_of(4) + 4;
        u32::from_le_bytes(self.0[self.1 - 4..self.1].try_into().unwrap())
    }

    fn text(&mut self) -> String {
        let length = self.u32() as usize;
        self.1 += length;
        String::from_utf8(self.0[self.1 - length..self.1 - 1].to_vec()).unwrap()
    }

    fn doubles(&mut self, count: usize) -> Vec<f64> {
        self.1 = 4 + (self.1 - 4).next_multiple_of(8);
        let bytes = &self.0[self.1..self.1 + 8 * count];
        self.1 += 8 * count;
        bytes.chunks(8).map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap())).collect()
    }
}

#[test]
fn a_run_is_written_as_a_bag_of_ros_2() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    let robot = [("base_link", "camera", looking_down(0.8))];
    write_robot(&here.join("robot.mcap"), &["/front/image_raw"], &robot, &[]);
    done(here, "run robot.mcap --height 1.0 --bag-out poses.mcap -o robot --quiet");
    let odometry = poses(&here.join("robot/odometry.tum"));
    let log = fs::read(here.join("poses.mcap")).unwrap();
    let mut counts = BTreeMap::new();
    for message in mcap::MessageStream::new(&log).unwrap() {
        let message = message.unwrap();
        let channel = &message.channel;
        assert_eq!(channel.message_encoding, "cdr");
        assert_eq!(channel.schema.as_ref().unwrap().encoding, "ros2msg");
        let at = counts.entry(channel.topic.clone()).or_insert(0usize);
        let mut cdr = Cdr2(&message.data, 4);
        let count = if channel.topic.starts_with("/tf") { cdr.u32() } else { 1 };
        let stamp_ns = u64::from(cdr.u32()) * 1_000_000_000 + u64::from(cdr.u32());
        assert!(stamp_ns.abs_diff(time_ns(*at)) < 1000 && message.log_time == stamp_ns);
        match channel.topic.as_str() {
            "/odometry" => {
                assert_eq!((cdr.text().as_str(), cdr.text().as_str()), ("odom", "base_link"));
                let (pose, covariance) = (cdr.doubles(7), cdr.doubles(36));
                for (recorded, written) in pose.iter().zip(&odometry[*at][1..]) {
                    assert!((recorded - written).abs() < 1e-6, "{pose:?} {:?}", odometry[*at]);
                }
                let symmetric =
                    (0..36).all(|k| (covariance[k] - covariance[k % 6 * 6 + k / 6]).abs() < 1e-15);
                assert!(symmetric && (0..6).all(|k| covariance[7 * k] >= 0.0), "{covariance:?}");
                assert!(*at == 0 || covariance[0] > 0.0 && covariance[35] > 0.0);
                let (speed, turned) = (cdr.doubles(6), cdr.doubles(36));
                // Four pixels a frame upwards in the image, backwards and to the side not at all.
                assert!(*at < 5 || speed[0].hypot(speed[1]) > 0.3 && speed[5].abs() < 0.05, "{speed:?}");
                assert_eq!(turned[0], -1.0);
                assert_eq!(cdr.1, message.data.len());
            }
            "/tf" => {
                assert_eq!((count, cdr.text().as_str(), cdr.text().as_str()), (2, "map", "odom"));
            }
            "/tf_static" => {
                assert_eq!((count, cdr.text().as_str(), cdr.text().as_str()), (1, "base_link", "camera"));
                let (recorded, given) = (cdr.doubles(7), looking_down(0.8));
                // A quaternion and its negative are the same rotation.
                let sign = recorded[3].signum() * given[3].signum();
                for (k, (recorded, given)) in recorded.iter().zip(given).enumerate() {
                    let recorded = if k < 3 { *recorded } else { sign * recorded };
                    assert!((recorded - given).abs() < 1e-9, "{k}: {recorded} {given}");
                }
                assert!(channel.metadata["offered_qos_profiles"].contains("durability: 1"));
            }
            _ => {
                assert_eq!((cdr.text().as_str(), cdr.u32()), ("", 1));
                assert!(message.data.windows(7).any(|bytes| bytes == b"tracked"));
            }
        }
        *at += 1;
    }
    let expected = [("/diagnostics", FRAMES), ("/odometry", FRAMES), ("/tf", FRAMES), ("/tf_static", 1)];
    assert_eq!(counts, expected.map(|(topic, count)| (topic.to_owned(), count)).into());
    // Our own reader knows it.
    let (text, _) = done(here, "info poses.mcap");
    assert!(text.contains("/odometry  nav_msgs/msg/Odometry, 40 messages"), "{text}");
    // It is not overwritten unasked.
    let output = odograph(here, "run robot.mcap --height 1.0 --bag-out poses.mcap -o other");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && message.contains("poses.mcap is already there"), "{message}");
    assert!(!here.join("other").exists());
}

#[test]
fn info_tells_what_is_in_a_recording_and_what_for() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    write(&here.join("drive.mcap"), &["/front/image_raw"]);
    fs::write(here.join("drive.y4m"), recording::y4m(5)).unwrap();
    fs::write(here.join("camera.yaml"), recording::CAMERA).unwrap();
    recording::picture_folder(&here.join("frames"), 3, recording::PngPicture::gray8);
    let (text, _) = done(here, "info drive.mcap --camera camera.yaml");
    for words in [
        "drive.mcap: an MCAP file, 3 topics\n",
        "/front/image_raw  sensor_msgs/msg/Image, 320x240 mono8, 40 frames, 1.30 s, 30.00 Hz\n",
        "    odograph run drive.mcap --topic /front/image_raw --camera camera.yaml --height LENGTH\n",
        "    its camera is in /front/camera_info\n",
        "    the camera file fits\n",
        "    odograph run … --range-topic /sonar\n",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let (text, _) = done(here, "info drive.mcap");
    assert!(
        text.contains("    odograph run drive.mcap --topic /front/image_raw --height LENGTH\n"),
        "{text}"
    );
    let (json, _) = done(here, "info drive.mcap --json");
    let value: serde_json::Value = serde_json::from_str(&json).unwrap();
    let images = &value["streams"][1];
    assert_eq!((images["topic"].as_str(), images["count"].as_u64()), (Some("/front/image_raw"), Some(40)));
    assert_eq!(images["option"].as_str(), Some("--topic /front/image_raw"));
    assert_eq!(images["camera"]["fx"].as_f64(), Some(300.0));
    assert!((images["first_s"].as_f64().unwrap() - 1.7e9).abs() < 1e-6 && images["camera_fits"].is_null());

    let (text, _) = done(here, "info drive.y4m --camera camera.yaml");
    assert!(
        text.contains("320x240, 5 frames, 30.00 Hz\n") && text.contains("the camera file fits"),
        "{text}"
    );
    let (text, _) = done(here, "info frames");
    assert!(
        text.contains("320x240, 3 frames\n")
            && text.contains("    odograph run frames --camera FILE --height LENGTH\n"),
        "{text}"
    );
    let output = odograph(here, "info camera.yaml");
    assert_eq!(output.status.code(), Some(3));
}

#[test]
fn depth_beside_the_images_is_not_offered() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    write(&here.join("both.mcap"), &["/front/depth/image_raw", "/front/image_raw"]);
    let (text, _) = done(here, "info both.mcap");
    assert!(text.contains("320x240 16UC1, 40 frames"), "{text}");
    assert!(text.contains("    images of depth, or of an encoding that is not read"), "{text}");
    assert!(!text.contains("--topic /front/depth") && text.contains("--topic /front/image_raw"), "{text}");
    done(here, "run both.mcap --height 1.0 -o out --quiet");
    // Named, it is refused with the reason.
    let output = odograph(here, "run both.mcap --height 1.0 --topic /front/depth/image_raw -o other");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(3) && message.contains("\"16UC1\" are not read"), "{message}");
}

#[test]
fn the_fixes_of_a_recording_place_its_path_on_earth() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    write(&here.join("plain.mcap"), &["/front/image_raw"]);
    done(here, "run plain.mcap --height 1.0 -o plain --quiet");
    let origin = EarthPosition::from_degrees(48.2082, 16.3738).unwrap();
    let anchor = Anchor::at(origin, 0.4);
    let at = |pose: &Vec<f64>| Some(anchor.place(pose[1], pose[2]));
    let mut fixes: Vec<Option<EarthPosition>> =
        poses(&here.join("plain/trajectory.tum")).iter().map(at).collect();
    fixes[3] = None;
    write_robot(&here.join("drive.mcap"), &["/front/image_raw"], &[], &fixes);
    let (listed, _) = done(here, "info drive.mcap");
    assert!(listed.contains("--gnss-topic /gnss/fix"), "{listed}");
    done(here, "run drive.mcap --height 1.0 --gnss-topic /gnss/fix -o placed --quiet");
    let statistics = fs::read_to_string(here.join("placed/stats.json")).unwrap();
    let gnss = &serde_json::from_str::<serde_json::Value>(&statistics).unwrap()["gnss"];
    assert!(gnss["fixes"] == FRAMES - 1 && gnss["used"] == FRAMES - 1, "{gnss}");
    assert!((gnss["bearing_deg"].as_f64().unwrap() - 0.4f64.to_degrees()).abs() < 0.05, "{gnss}");
    assert!(gnss["rmse_m"].as_f64().unwrap() < 1e-3, "{gnss}");
    let output = odograph(here, "run drive.mcap --height 1.0 --gnss-topic /fix -o refused");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        message.contains("there is no topic /fix of the type sensor_msgs/NavSatFix for a satellite receiver"),
        "{message}"
    );
}

#[test]
fn a_path_on_a_topic_is_compared_with_that_of_the_run() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    write(&here.join("plain.mcap"), &["/front/image_raw"]);
    done(here, "run plain.mcap --height 1.0 -o plain --quiet");
    // The path of the run, ten times as large and turned by 90 degrees.
    let seen = poses(&here.join("plain/trajectory.tum"));
    let numbers: Vec<[f64; 7]> =
        seen.iter().map(|p| [-10.0 * p[2], 10.0 * p[1], 3.0, 0.0, 0.0, 0.0, 1.0]).collect();
    let stamped = |write: &dyn Fn(&mut Cdr, &[f64; 7])| {
        let message = |(number, pose): (usize, &[f64; 7])| {
            let mut message = Cdr::of(time_ns(number), "room");
            write(&mut message, pose);
            message.0
        };
        numbers.iter().enumerate().map(message).collect::<Vec<_>>()
    };
    let pose = stamped(&|message, pose| message.doubles(pose));
    let odometry = stamped(&|message, pose| {
        message.text("base_link");
        message.doubles(pose);
        message.doubles(&[0.0; 36 + 6 + 36]);
    });
    let elsewhere = [5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 1.0];
    let moving = numbers.iter().enumerate().map(|(number, pose)| {
        transforms(time_ns(number), &[("map", "odom", elsewhere), ("odom", "robot1/base_link", *pose)])
    });
    let records = [
        ("/room/pose", "geometry_msgs/msg/PoseStamped", pose),
        ("/odom", "nav_msgs/msg/Odometry", odometry),
        ("/tf", "tf2_msgs/msg/TFMessage", moving.collect()),
    ];
    write_with(&here.join("drive.mcap"), &["/front/image_raw"], &[], &[], &records);
    let (listed, _) = done(here, "info drive.mcap");
    assert!(listed.contains("--reference-topic /room/pose"), "{listed}");
    for topic in ["/room/pose", "odom", "/tf"] {
        let run =
            format!("run drive.mcap --height 1.0 --reference-topic {topic} -o compared --force --quiet");
        done(here, &run);
        let page = fs::read_to_string(here.join("compared/report.html")).unwrap();
        assert!(page.contains(&format!("Beside {topic}")), "{topic}");
        assert!(page.contains("scale of the alignment is 10.000"), "{topic}");
    }
    // run.toml repeats it, and it changes no result.
    done(here, "run compared/run.toml -o again --quiet");
    assert!(fs::read_to_string(here.join("again/report.html")).unwrap().contains("Beside /tf"));
    let [with, without] =
        ["again", "plain"].map(|of| fs::read(here.join(of).join("trajectory.tum")).unwrap());
    assert!(with == without);
    let output = odograph(here, "run drive.mcap --height 1.0 --reference-topic /sonar -o refused");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("there is no topic /sonar of the type geometry_msgs/PoseStamped"), "{message}");
    assert!(output.status.code() == Some(2) && !here.join("refused").exists(), "{message}");
}

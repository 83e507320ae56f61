//! Black-box tests of a satellite receiver: where a path is on Earth.

use super::program::{done, done_once, odograph};
use nalgebra::{Isometry3, Point3};
use odograph::camera::{LeverArm, Rig};
use odograph::formats::rig_file;
use odograph::formats::trajectory_file::parse_tum;
use odograph::geometry::EarthPosition;
use odograph::georeference::Anchor;
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_video::SourceOptions;
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::UdpSocket;
use std::path::Path;
use std::process::{Command, Stdio};

/// Numbers from −1 to 1.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / f64::from(1 << 30) - 1.0
    }
}

const ANTENNA: [f64; 3] = [-0.2, 0.1, 1.1];

/// A drive of 8 m in bends, its camera on a lever arm, and the true path of the robot.
struct Drive {
    place: tempfile::TempDir,
    truth: Trajectory,
    camera_from_base: Isometry3<f64>,
    anchor: Anchor,
}

impl Drive {
    fn new() -> Self {
        let place = tempfile::tempdir().unwrap();
        let here = place.path();
        done_once(
            here,
            "simulate -o sim --path eight --length 3 --speed 0.7 --fps 15 --size 320x240 --height 0.75 --yaw 30 \
             --seed 6 --quiet",
        );
        let rig = rig_file::parse(&fs::read_to_string(here.join("sim/rig.toml")).unwrap()).unwrap();
        let rig = Rig { lever_arm: Some(LeverArm { x_m: 0.3, y_m: 0.05, z_m: 0.6 }), ..rig };
        let armed = format!("{}gnss_lever_arm_m = {ANTENNA:?}\n", rig_file::write(&rig));
        fs::write(here.join("armed.toml"), armed).unwrap();
        let truth = parse_tum(&fs::read_to_string(here.join("sim/truth.tum")).unwrap()).unwrap();
        let origin = EarthPosition::from_degrees(-33.8568, 151.2153).unwrap();
        Self {
            truth,
            camera_from_base: rig.base_from_camera().unwrap().inverse(),
            anchor: Anchor::at(origin, 2.0),
            place,
        }
    }

    fn here(&self) -> &Path {
        self.place.path()
    }

    fn run(&self, arguments: &str) -> String {
        done(
            self.here(),
            &format!(
                "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --rig armed.toml {arguments}"
            ),
        )
    }

    /// Lines of a receiver with an error of 2 cm, five a second, every tenth a reflection.
    fn fixes(&self) -> Vec<(f64, EarthPosition)> {
        let mut noise = Noise(7);
        let antenna = Point3::from(ANTENNA);
        let mut fixes = Vec::new();
        for (number, pose) in self.truth.poses.iter().step_by(3).enumerate() {
            let there = pose.world_from_camera * self.camera_from_base * antenna;
            // Uniform: the deviation is half of a width of 3.5 of it.
            let [mut x, mut y] = [there.x, there.y].map(|value| value + 0.02 * 3f64.sqrt() * noise.next());
            if number % 10 == 4 {
                (x, y) = (x + 1.5, y - 0.7);
            }
            fixes.push((pose.time_s, self.anchor.place(x, y)));
        }
        fixes
    }

    fn csv(&self) -> String {
        let line = |(time_s, place): &(f64, EarthPosition)| {
            let (latitude, longitude) = (place.latitude_rad.to_degrees(), place.longitude_rad.to_degrees());
            format!("{time_s:.6},{latitude:.10},{longitude:.10},0.02\n")
        };
        "time_s,latitude_deg,longitude_deg,sigma_m\n".to_owned()
            + &self.fixes().iter().map(line).collect::<String>()
    }

    /// Root mean square distance of the written UTM coordinates from the true ones, metres.
    fn off_m(&self, folder: &str) -> f64 {
        let table = fs::read_to_string(self.here().join(folder).join("trajectory-utm.csv")).unwrap();
        let mut squares = Vec::new();
        for line in table.lines().skip(1) {
            let values: Vec<f64> = line.split(',').map(|value| value.parse().unwrap()).collect();
            let same = self.truth.poses.iter().find(|pose| (pose.time_s - values[1]).abs() < 1e-5).unwrap();
            let there = (same.world_from_camera * self.camera_from_base).translation;
            let (east, north) = self.anchor.utm(there.x, there.y);
            squares.push((values[4] - east).powi(2) + (values[5] - north).powi(2));
            assert_eq!(values[6], 32_756.0);
        }
        assert!(squares.len() > 100, "{}", squares.len());
        (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
    }

    fn statistics(&self, folder: &str) -> Value {
        let text = fs::read_to_string(self.here().join(folder).join("stats.json")).unwrap();
        serde_json::from_str(&text).unwrap()
    }
}

/// A sentence of NMEA with its checksum.
fn summed(body: &str) -> String {
    format!("${body}*{:02X}\r\n", body.bytes().fold(0, |sum, byte| sum ^ byte))
}

#[test]
fn rtk_puts_the_path_on_earth_within_a_centimetre() {
    let drive = Drive::new();
    let here = drive.here();
    fs::write(here.join("rtk.csv"), drive.csv()).unwrap();
    let message = drive.run("--gnss rtk.csv -o rtk");
    let off_m = drive.off_m("rtk");
    assert!(off_m < 0.01, "{off_m}");
    let gnss = &drive.statistics("rtk")["gnss"];
    let [fixes, used, rejected] = ["fixes", "used", "rejected"].map(|name| gnss[name].as_u64().unwrap());
    assert!(rejected == (fixes + 5) / 10 && used + rejected >= fixes - 1, "{gnss}");
    assert!(
        message.contains(&format!("{rejected} of {fixes} positions of rtk.csv contradict the path")),
        "{message}"
    );
    assert!((gnss["rmse_m"].as_f64().unwrap() - 0.028).abs() < 0.006, "{gnss}");
    assert!((gnss["bearing_deg"].as_f64().unwrap() - 2f64.to_degrees()).abs() < 0.5, "{gnss}");
    // A bias of all fixes cannot be known.
    assert!(gnss["sigma_east_m"].as_f64().unwrap() >= 0.02, "{gnss}");
    let text = fs::read_to_string(here.join("rtk/trajectory.geojson")).unwrap();
    let path: Value = serde_json::from_str(&text).unwrap();
    let first = &path["features"][0]["geometry"]["coordinates"][0];
    assert!((first[0].as_f64().unwrap() - 151.2153).abs() < 1e-4, "{first}");
    assert!((first[1].as_f64().unwrap() + 33.8568).abs() < 1e-4, "{first}");
    assert_eq!(&fs::read(here.join("rtk/mosaic-utm.tif")).unwrap()[..4], b"II+\0");
    // The path itself is what it is without the receiver, and run.toml repeats all of it.
    drive.run("-o plain --quiet");
    for name in ["trajectory.tum", "trajectory.csv", "carrier.tum"] {
        let [with, without] = ["rtk", "plain"].map(|folder| fs::read(here.join(folder).join(name)).unwrap());
        assert!(with == without, "{name}");
    }
    done(here, "run rtk/run.toml -o again --quiet");
    for name in ["trajectory-utm.csv", "trajectory.geojson", "mosaic-utm.tif"] {
        let [first, again] = ["rtk", "again"].map(|folder| fs::read(here.join(folder).join(name)).unwrap());
        assert!(first == again, "{name}");
    }
    // A run that replaces it without a receiver has no place on Earth.
    drive.run("-o rtk --force --quiet");
    assert!(!here.join("rtk/trajectory.geojson").exists() && !here.join("rtk/mosaic-utm.tif").exists());
}

#[test]
fn the_subtitles_of_a_drone_place_the_path_on_earth() {
    let drive = Drive::new();
    // The same frames, seen from 30 times as high.
    let span = |time_s: f64| format!("00:00:{time_s:06.3}").replace('.', ",");
    let cue = |pose: &StampedPose| {
        let there = 30.0 * pose.world_from_camera.translation.vector;
        let place = drive.anchor.place(there.x, there.y);
        let (latitude, longitude) = (place.latitude_rad.to_degrees(), place.longitude_rad.to_degrees());
        format!(
            "1\n{} --> {}\n<font size=\"28\">FrameCnt: 1, DiffTime: 33ms\n2026-05-04 10:12:33.380\n[iso: 100] \
             [latitude: {latitude:.6}] [longitude: {longitude:.6}] [rel_alt: 1.3 abs_alt: 180.5] </font>\n\n",
            span(pose.time_s),
            span(pose.time_s + 0.2)
        )
    };
    let cues: Vec<String> = drive.truth.poses.iter().step_by(3).map(cue).collect();
    fs::write(drive.here().join("DJI_0001.SRT"), cues.concat()).unwrap();
    done(
        drive.here(),
        "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --height 22.5 --gnss DJI_0001.SRT \
         -o drone --quiet",
    );
    let gnss = &drive.statistics("drone")["gnss"];
    assert!(gnss["fixes"] == cues.len() && gnss["used"].as_u64().unwrap() + 3 > cues.len() as u64, "{gnss}");
    assert!(gnss["rmse_m"].as_f64().unwrap() < 0.2, "{gnss}");
}

#[test]
fn positions_of_pictures_that_are_taken_one_by_one_are_used() {
    let drive = Drive::new();
    let here = drive.here();
    // The frames as pictures, one in two seconds.
    let slow: String = drive
        .csv()
        .lines()
        .map(|line| match line.split_once(',') {
            Some((time_s, rest)) if !time_s.starts_with('t') => {
                format!("{:.6},{rest}\n", 30.0 * time_s.parse::<f64>().unwrap())
            }
            _ => format!("{line}\n"),
        })
        .collect();
    fs::write(here.join("slow.csv"), slow).unwrap();
    done(
        here,
        "run sim/frames --fps 0.5 --camera sim/camera.yaml --rig armed.toml --gnss slow.csv -o slow --quiet",
    );
    let gnss = &drive.statistics("slow")["gnss"];
    let [fixes, used] = ["fixes", "used"].map(|name| gnss[name].as_f64().unwrap());
    assert!(used > 0.85 * fixes, "{gnss}");
}

#[test]
fn an_antenna_that_was_found_is_written_for_the_next_run() {
    let drive = Drive::new();
    let here = drive.here();
    fs::write(here.join("rtk.csv"), drive.csv()).unwrap();
    let armed = fs::read_to_string(here.join("armed.toml")).unwrap();
    let unknown: String =
        armed.lines().filter(|line| !line.starts_with("gnss")).map(|line| format!("{line}\n")).collect();
    fs::write(here.join("armed.toml"), unknown).unwrap();
    let message = drive.run("--gnss rtk.csv -o found");
    assert!(message.contains("is in rig-found.toml"), "{message}");
    let found = fs::read_to_string(here.join("found/rig-found.toml")).unwrap();
    let arm = rig_file::parse_antenna(&found).unwrap().unwrap();
    let stated = found.lines().find_map(|line| line.strip_prefix("gnss_lever_arm_deviation_m = ")).unwrap();
    let stated_m = stated.parse::<f64>().unwrap();
    assert!((0.001..0.05).contains(&stated_m), "{found}");
    assert!((arm.x_m - ANTENNA[0]).hypot(arm.y_m - ANTENNA[1]) < 4.0 * stated_m, "{found}");
    let again = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --gnss rtk.csv";
    let message = done(here, &format!("{again} --rig found/rig-found.toml -o found --force"));
    assert!(!message.contains("rig-found.toml"), "{message}");
    assert!(drive.off_m("found") < 0.02, "{}", drive.off_m("found"));
    // It was the input of this run and stays; another run removes it.
    assert_eq!(fs::read_to_string(here.join("found/rig-found.toml")).unwrap(), found);
    done(
        here,
        "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --height 0.75 -o found --force --quiet",
    );
    assert!(!here.join("found/rig-found.toml").exists());
}

#[test]
fn a_wrong_height_is_corrected_in_path_and_map() {
    let drive = Drive::new();
    let here = drive.here();
    fs::write(here.join("rtk.csv"), drive.csv()).unwrap();
    let armed = fs::read_to_string(here.join("armed.toml")).unwrap();
    assert!(armed.contains("height_m = 0.75"), "{armed}");
    fs::write(here.join("armed.toml"), armed.replace("height_m = 0.75", "height_m = 0.8")).unwrap();
    let message = drive.run("--gnss rtk.csv -o rtk");
    assert!(message.contains("path and map are corrected"), "{message}");
    let gnss = &drive.statistics("rtk")["gnss"];
    let scale = gnss["scale"].as_f64().unwrap();
    assert!((scale - 0.75 / 0.8).abs() < 0.01 && gnss["bent"] == true, "{gnss}");
    assert!(drive.off_m("rtk") < 0.02, "{}", drive.off_m("rtk"));
    // The trajectory has the true size, too.
    let found = parse_tum(&fs::read_to_string(here.join("rtk/trajectory.tum")).unwrap()).unwrap();
    let truth = Trajectory {
        poses: drive
            .truth
            .poses
            .iter()
            .map(|pose| odograph::trajectory::StampedPose {
                world_from_camera: pose.world_from_camera * drive.camera_from_base,
                ..*pose
            })
            .collect(),
    };
    // The robot's path begins at its own origin and heading; the diagonal of the eight is its size.
    let size = |of: &Trajectory| {
        let first = of.poses[0].world_from_camera.translation.vector;
        let off = of.poses.iter().map(|pose| (pose.world_from_camera.translation.vector - first).xy().norm());
        off.fold(0.0, f64::max)
    };
    assert!((size(&found) / size(&truth) - 1.0).abs() < 0.01, "{} {}", size(&found), size(&truth));
}

#[test]
fn sentences_with_the_time_of_day_are_aligned_by_the_start() {
    let drive = Drive::new();
    let text: String = drive
        .fixes()
        .iter()
        .map(|(time_s, place)| {
            // The recording begins at 10:12:33.4, and the person says 10:12:34.
            let of_day_s = time_s + 36_753.4;
            let (hours, minutes) = ((of_day_s / 3600.0) as u32, (of_day_s / 60.0) as u32 % 60);
            let degrees = |radians: f64| {
                let degrees = radians.to_degrees().abs();
                (degrees as u32, 60.0 * degrees.fract())
            };
            let (south, east) = (degrees(place.latitude_rad), degrees(place.longitude_rad));
            let time = format!("{hours:02}{minutes:02}{:06.3}", of_day_s % 60.0);
            let at = format!("{:02}{:010.7},S,{:03}{:010.7},E", south.0, south.1, east.0, east.1);
            summed(&format!("GNGGA,{time},{at},4,12,0.7,160.0,M,20.0,M,1.0,0001"))
                + &summed(&format!("GNRMC,{time},A,{at},0.5,90.0,040526,,,R"))
        })
        .collect();
    fs::write(drive.here().join("log.nmea"), text).unwrap();
    drive.run("--gnss log.nmea --gnss-start 2026-05-04T10:12:34Z -o nmea --quiet");
    let off_m = drive.off_m("nmea");
    assert!(off_m < 0.015, "{off_m}");
    let offset_s = drive.statistics("nmea")["gnss"]["clock_offset_s"].as_f64().unwrap();
    assert!((offset_s + 0.6).abs() < 0.03, "{offset_s}");
    let message = drive.run("--gnss log.nmea -o apart");
    assert!(
        message.contains("--gnss-start gives the time (UTC) at which the recording's time is 0"),
        "{message}"
    );
}

#[test]
fn live_places_a_path_by_a_file_as_run_does() {
    let drive = Drive::new();
    let here = drive.here();
    fs::write(here.join("rtk.csv"), drive.csv()).unwrap();
    // A run that had to find out that the shutter is global would begin again.
    let options =
        "sim/frames --fps 15 --camera sim/camera.yaml --rig armed.toml --readout-ms 0 --gnss rtk.csv --quiet";
    done(here, &format!("run {options} -o run"));
    done(here, &format!("live {options} -o live"));
    for name in ["trajectory-utm.csv", "trajectory.geojson", "mosaic-utm.tif", "trajectory.csv"] {
        let [run, live] = ["run", "live"].map(|folder| fs::read(here.join(folder).join(name)).unwrap());
        assert!(run == live, "{name}");
    }
    assert_eq!(drive.statistics("run")["gnss"], drive.statistics("live")["gnss"]);
    // Frames as fast as they can be tracked have no time at which a position arrives.
    let output = odograph(here, &format!("live {} -o bad", options.replace("rtk.csv", "udp:9")));
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && message.contains("give --realtime"), "{message}");
    assert!(!here.join("bad").exists());
}

/// A port for datagrams that is free, and not one of those that the system gives to programs that
/// ask for any: nothing else of these tests gets it before the program opens it.
fn port() -> u16 {
    let first = 20_000 + (std::process::id() % 10_000) as u16;
    (first..first + 100).find(|&port| UdpSocket::bind(("127.0.0.1", port)).is_ok()).unwrap()
}

#[test]
fn live_places_a_path_by_positions_as_they_come() {
    let drive = Drive::new();
    let fixes = drive.fixes();
    let port = port();
    let options = format!(
        "live - --camera sim/camera.yaml --rig armed.toml --gnss udp:{port} --print poses --quiet -o live"
    );
    let mut live = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .current_dir(drive.here())
        .args(options.split_whitespace())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
    let send = |text: &str| {
        receiver.send_to(text.as_bytes(), ("127.0.0.1", port)).unwrap();
    };
    let mut camera = live.stdin.take().unwrap();
    let mut poses = BufReader::new(live.stdout.take().unwrap()).lines();
    let mut next = fixes.iter().peekable();
    let mut frames =
        odograph_video::open(drive.here().join("sim/frames"), &SourceOptions::default()).unwrap();
    camera.write_all(b"YUV4MPEG2 W320 H240 F15:1 Cmono\n").unwrap();
    // Each frame is sent after the one before is tracked, so that a busy machine drops no frame.
    while let Some(image) = frames.next_frame().unwrap() {
        camera.write_all(&[b"FRAME\n", image.gray.samples()].concat()).unwrap();
        camera.flush().unwrap();
        let frame: Value = serde_json::from_str(&poses.next().unwrap().unwrap()).unwrap();
        assert_eq!(frame["frame"], image.number);
        if image.number == 0 {
            send("$GPGSV,1,1,00*79\r\ntime_s,latitude_deg,longitude_deg,sigma_m\r\n");
        }
        // Each position once the frame of its time is tracked: late, and by a clock of its own.
        while let Some((time_s, place)) =
            next.next_if(|(time_s, _)| *time_s <= frame["time_s"].as_f64().unwrap())
        {
            let (latitude, longitude) = (place.latitude_rad.to_degrees(), place.longitude_rad.to_degrees());
            send(&format!("{:.3},{latitude:.10},{longitude:.10},0.02\r\n", time_s + 5000.0));
        }
    }
    drop(camera);
    assert!(live.wait().unwrap().success());
    let gnss = &drive.statistics("live")["gnss"];
    assert!(gnss["fixes"].as_u64().unwrap() > fixes.len() as u64 / 2, "{gnss}");
    let off_m = drive.off_m("live");
    assert!(off_m < 0.03, "{off_m} m, {gnss}");
    // The positions are kept by the clock of the frames, so that the recording can be run again.
    drive.run("--gnss live/gnss-received.csv -o again");
    assert_eq!(drive.statistics("again")["gnss"]["fixes"], gnss["fixes"]);
    let off_m = drive.off_m("again");
    assert!(off_m < 0.03, "{off_m} m again");
}

#[test]
fn what_cannot_be_used_is_told_in_a_sentence() {
    let drive = Drive::new();
    let here = drive.here();
    let csv = drive.csv();
    let head = "time_s,latitude_deg,longitude_deg\n";
    // Refused before anything is tracked.
    for (name, text, words) in [
        (
            "nan.csv",
            format!("{head}0,nan,16\n"),
            "nan.csv: line 2: \"nan\" stands where a finite number belongs",
        ),
        ("pole.csv", format!("{head}0,91,16\n"), "pole.csv: line 2: latitude 91°, longitude 16° is no place"),
        (
            "back.csv",
            format!("{head}1,48,16\n0,48,16\n"),
            "back.csv: line 3: the time 0 s is not later than 1 s",
        ),
        ("none.nmea", "$GPGSV,1,1,00\n".to_owned(), "no position"),
        ("binary.gpx", "\u{1}\u{2}\u{3}".to_owned(), "it must name the columns"),
    ] {
        fs::write(here.join(name), text).unwrap();
        let output = odograph(
            here,
            &format!(
                "run sim/frames --fps 15 --camera sim/camera.yaml --rig armed.toml --gnss {name} -o out"
            ),
        );
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(message.contains(words) && output.status.code() == Some(3), "{name}: {message}");
        assert!(!here.join("out").exists());
    }
    fs::create_dir(here.join("stills")).unwrap();
    fs::write(here.join("stills/1.jpg"), "no picture").unwrap();
    let stills = odograph(
        here,
        "run sim/frames --fps 15 --camera sim/camera.yaml --rig armed.toml --gnss stills -o out",
    );
    let message = String::from_utf8_lossy(&stills.stderr).into_owned();
    assert!(message.contains("stills: none of the 1 pictures in this folder has a position"), "{message}");
    assert!(stills.status.code() == Some(3) && !here.join("out").exists(), "{message}");
    let noon = odograph(
        here,
        "run sim/frames --fps 15 --camera sim/camera.yaml --rig armed.toml --gnss-start noon -o out",
    );
    assert!(noon.status.code() == Some(2), "{noon:?}");
    // The path is written, and no place on Earth.
    let two: String = csv.lines().take(3).map(|line| format!("{line}\n")).collect();
    let same = csv.lines().nth(1).unwrap().split_once(',').unwrap().1.to_owned();
    let still: String = std::iter::once("time_s,latitude_deg,longitude_deg,sigma_m\n".to_owned())
        .chain(csv.lines().skip(1).map(|line| format!("{},{same}\n", line.split(',').next().unwrap())))
        .collect();
    for (name, text, words) in [
        ("two.csv", two, "the positions of two.csv are not used: only 2 of its positions fall on the path"),
        ("still.csv", still, "the positions of still.csv are not used: "),
    ] {
        fs::write(here.join(name), text).unwrap();
        let message = drive.run(&format!("--gnss {name} -o out --force --max-frames 60"));
        assert!(message.contains(words), "{name}: {message}");
        let gnss = &drive.statistics("out")["gnss"];
        assert!(gnss["used"] == 0 && gnss["reason"].is_string(), "{gnss}");
        assert!(here.join("out/trajectory.tum").exists() && !here.join("out/trajectory.geojson").exists());
    }
}

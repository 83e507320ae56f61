//! Other sensors whose readings come while a robot drives: what is printed through two seconds of
//! darkness.

use super::program::{LiveFolder, statistics};
use odograph::formats::trajectory_file::parse_tum;
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::UdpSocket;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Darkness of the drive, seconds.
const DARK_S: std::ops::Range<f64> = 6.0..8.0;
const FRAMES_PER_S: f64 = 20.0;

/// A figure of eight at half a metre per second, with the records of its sensors.
fn simulate(place: &LiveFolder) {
    let drive = "simulate -o sim --path eight --length 3 --speed 0.5 --duration 11 --fps 20 --blackout 6:8 --size 240x180 \
                 --height 0.75 --seed 4 --sensors --format y4m --quiet";
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    let done = command.current_dir(place.path("")).args(drive.split_whitespace()).status().unwrap();
    assert!(done.success());
}

/// The readings of a sensor: time and the line of CSV, and the header.
fn record(place: &LiveFolder, name: &str) -> (String, Vec<(f64, String)>) {
    let text = fs::read_to_string(place.path(&format!("sim/{name}.csv"))).unwrap();
    let mut lines = text.lines();
    let header = lines.next().unwrap().to_owned();
    let timed = |line: &str| (line.split(',').next().unwrap().parse().unwrap(), line.to_owned());
    (header, lines.map(timed).collect())
}

/// What a run printed, how it ended, and what it said.
struct Played {
    lines: Vec<Value>,
    said: String,
}

/// Times as fast as the drive was: a growing file is looked at ten times a second.
const HASTE: f64 = 2.0;

/// Gives the program the frames one by one, each after the pose of the one before and not before
/// its time, and the readings up to its time.
fn play(place: &LiveFolder, arguments: &str, mut send: impl FnMut(f64)) -> Played {
    let arguments = format!(
        "live - --camera sim/camera.yaml --rig sim/rig.toml --print poses -o out --force {arguments}"
    );
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.current_dir(place.path("")).args(arguments.split_whitespace());
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut frames = child.stdin.take().unwrap();
    let mut poses = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut messages = child.stderr.take().unwrap();
    let said = std::thread::spawn(move || {
        let mut said = String::new();
        messages.read_to_string(&mut said).unwrap();
        said
    });
    let video = fs::read(place.path("sim/sim.y4m")).unwrap();
    let head = video.iter().position(|byte| *byte == b'\n').unwrap() + 1;
    frames.write_all(&video[..head]).unwrap();
    let mut lines = Vec::new();
    let each = (video.len() - head) / (11.0 * FRAMES_PER_S) as usize;
    let begun = Instant::now();
    for (number, frame) in video[head..].chunks_exact(each).enumerate() {
        let at = Duration::from_secs_f64(number as f64 / (HASTE * FRAMES_PER_S));
        std::thread::sleep(at.saturating_sub(begun.elapsed()));
        frames.write_all(frame).unwrap();
        frames.flush().unwrap();
        lines.push(serde_json::from_str(&poses.next().unwrap().unwrap()).unwrap());
        send(number as f64 / FRAMES_PER_S);
    }
    drop(frames);
    assert!(child.wait().unwrap().success());
    Played { lines, said: said.join().unwrap() }
}

impl Played {
    /// Time, error and stated standard deviation of the position of each pose, metres.
    fn errors(&self, place: &LiveFolder) -> Vec<(f64, f64, f64)> {
        let truth = parse_tum(&fs::read_to_string(place.path("sim/truth.tum")).unwrap()).unwrap();
        let known = self.lines.iter().filter(|line| !line["pose"].is_null());
        known
            .map(|line| {
                let time_s = line["time_s"].as_f64().unwrap();
                let at = truth.poses.iter().find(|pose| (pose.time_s - time_s).abs() < 1e-3).unwrap();
                let place = at.world_from_camera.translation.vector;
                let number = |value: &Value| value.as_f64().unwrap();
                let pose = &line["pose"];
                let off_m = (number(&pose["x_m"]) - place.x).hypot(number(&pose["y_m"]) - place.y);
                let covariance = &pose["covariance_x_y_heading"];
                (time_s, off_m, (number(&covariance[0][0]) + number(&covariance[1][1])).sqrt())
            })
            .collect()
    }
}

/// Sends the readings up to a time that were not sent before.
fn up_to(readings: &mut std::iter::Peekable<std::vec::IntoIter<(f64, String)>>, time_s: f64) -> Vec<String> {
    let mut lines = Vec::new();
    while let Some((_, line)) = readings.next_if(|(at_s, _)| *at_s <= time_s) {
        lines.push(line);
    }
    lines
}

/// A reading as the program's own output speaks.
fn json(header: &str, line: &str) -> String {
    let named = header.split(',').zip(line.split(','));
    let fields: Vec<String> = named.map(|(name, value)| format!("\"{name}\":{value}")).collect();
    format!("{{{}}}", fields.join(","))
}

/// A port where nobody listens.
fn free_port() -> u16 {
    UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

#[test]
fn poses_are_printed_through_darkness_with_a_gyroscope_and_a_wheel() {
    let place = LiveFolder::new();
    simulate(&place);
    let (gyro_header, gyro) = record(&place, "gyro");
    let (wheel_header, wheel) = record(&place, "wheel");
    // The gyroscope in a file that grows, the wheel as datagrams.
    fs::write(place.path("gyro.csv"), format!("{gyro_header}\n")).unwrap();
    let mut growing = fs::OpenOptions::new().append(true).open(place.path("gyro.csv")).unwrap();
    let (port, socket) = (free_port(), UdpSocket::bind("127.0.0.1:0").unwrap());
    let (mut gyro, mut wheel) = (gyro.into_iter().peekable(), wheel.into_iter().peekable());
    let played = play(&place, &format!("--gyro gyro.csv --wheel udp:{port}"), |time_s| {
        for line in up_to(&mut gyro, time_s) {
            writeln!(growing, "{line}").unwrap();
        }
        for line in up_to(&mut wheel, time_s) {
            let _ = socket.send_to(json(&wheel_header, &line).as_bytes(), ("127.0.0.1", port));
        }
    });
    assert!(!played.said.contains("not used"), "{}", played.said);
    let dark = played.lines.iter().filter(|line| line["pose_from"] == "sensors");
    assert!(dark.clone().count() >= 38, "{} poses in the dark\n{}", dark.count(), played.said);
    for (time_s, off_m, sigma_m) in played.errors(&place) {
        let limit_m = if DARK_S.contains(&time_s) || time_s > DARK_S.end { 0.05 } else { 0.002 };
        assert!(off_m < limit_m && off_m < 4.0 * sigma_m + 2e-3, "{off_m} m ± {sigma_m} m at {time_s} s");
    }
    // What is written is what `run` writes of the records.
    let sensors = &statistics(&place.path("out"))["sensors"];
    assert!(sensors.as_array().unwrap().iter().all(|sensor| sensor["used"] == true), "{sensors}");
    let smoothed =
        parse_tum(&fs::read_to_string(place.path("out/trajectory-smoothed.tum")).unwrap()).unwrap();
    assert_eq!(smoothed.poses.len(), played.lines.len());
}

#[test]
fn garbage_a_second_sender_and_a_wheel_that_dies_are_survived() {
    let place = LiveFolder::new();
    simulate(&place);
    let (gyro_header, gyro) = record(&place, "gyro");
    let (wheel_header, wheel) = record(&place, "wheel");
    let port = free_port();
    let [socket, other] = [(), ()].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    let (mut gyro, mut wheel) = (gyro.into_iter().peekable(), wheel.into_iter().peekable());
    let mut count = 0;
    // Both sensors at one port.
    let played = play(&place, &format!("--gyro udp:{port} --wheel udp:{port}"), |time_s| {
        let send = |from: &UdpSocket, line: &[u8]| drop(from.send_to(line, ("127.0.0.1", port)));
        let mut lines =
            up_to(&mut gyro, time_s).iter().map(|line| json(&gyro_header, line)).collect::<Vec<_>>();
        // The wheel dies in the dark; the second sender stands still.
        let of_wheel = up_to(&mut wheel, time_s.min(6.3));
        lines.extend(of_wheel.iter().map(|line| json(&wheel_header, line)));
        // Datagrams may overtake each other.
        lines.reverse();
        for line in lines {
            send(&socket, line.as_bytes());
            count += 1;
            if count % 9 == 0 {
                send(
                    &socket,
                    [&b"{\"time_s\":"[..], b"\xff\xfe", b"1,2,3,4", b"{\"time_s\":1e999,\"speed_m_s\":1}"]
                        [count % 4],
                );
                send(&other, format!("{{\"time_s\":{time_s},\"speed_m_s\":0.0}}").as_bytes());
            }
        }
    });
    for part in ["has two senders", "has sent no reading since 6.", "left out, the first because"] {
        let lines: Vec<&str> = played.said.lines().filter(|line| line.contains(part)).collect();
        assert!(!lines.is_empty(), "{part}: {}", played.said);
    }
    let last_dark = played.lines.iter().rev().find(|line| line["pose_from"] == "sensors").unwrap();
    assert!((6.3..7.6).contains(&last_dark["time_s"].as_f64().unwrap()), "{last_dark}");
    // No pose is worse than it says.
    for (time_s, off_m, sigma_m) in played.errors(&place) {
        assert!(off_m < 4.0 * sigma_m + 2e-3, "{off_m} m ± {sigma_m} m at {time_s} s");
    }
}

#[test]
fn readings_as_they_come_need_frames_as_they_come() {
    let place = LiveFolder::new();
    for (arguments, part) in [
        ("drive.y4m --gyro udp:7001", "need frames as they come: give --realtime"),
        ("- --wheel -", "cannot both be on standard input"),
        ("- --wheel udp:99999", "give udp:PORT or udp:HOST:PORT"),
        ("- --wheel not-there.csv", "readings of the wheel cannot be read from not-there.csv"),
        ("- --wheel udp:7002 --gnss udp:7002", "give the satellite receiver a source of its own"),
    ] {
        let frame = "a".repeat(640 * 480);
        let video = format!("YUV4MPEG2 W640 H480 F30:1 Cmono\nFRAME\n{frame}");
        fs::write(place.path("drive.y4m"), video).unwrap();
        let ended = place.command("live", &format!("{arguments} -o out")).output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert!(!ended.status.success() && said.contains(part), "{arguments}: {said}");
    }
}

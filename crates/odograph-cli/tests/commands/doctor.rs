//! Black-box tests of `odograph doctor`: each finding appears where it should, and a clean
//! recording has none.

use crate::program::done_once;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const SIZE: (usize, usize) = (320, 240);

fn odograph(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph")).args(arguments).output().unwrap()
}

/// A rendered recording in a folder of its own.
struct Clip {
    folder: tempfile::TempDir,
    source: PathBuf,
}

impl Clip {
    /// Two seconds of an eight over asphalt, as one uncompressed video.
    fn new(options: &[&str]) -> Self {
        Self::of("sim.y4m", &[&["--format", "y4m"], options].concat())
    }

    /// The same as a folder of pictures with their times.
    fn of_pictures(options: &[&str]) -> Self {
        Self::of("frames", options)
    }

    fn of(source: &str, options: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut all = vec!["simulate", "-o", ".", "--force", "--tell-readout"];
        for (option, value) in
            [("--size", "320x240"), ("--duration", "2"), ("--path", "eight"), ("--speed", "0.3")]
        {
            let is_without_effect = option == "--speed" && options.contains(&"still");
            if !options.contains(&option) && !is_without_effect {
                all.extend([option, value]);
            }
        }
        all.extend(options);
        done_once(folder.path(), &all.join(" "));
        let source = folder.path().join(source);
        Self { folder, source }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    /// Changes the frames of the video, which is gray.
    fn frames(self, change: impl Fn(Vec<Vec<u8>>) -> Vec<Vec<u8>>) -> Self {
        let bytes = fs::read(&self.source).unwrap();
        let header = bytes.iter().position(|byte| *byte == b'\n').unwrap() + 1;
        let (frame, samples) = ("FRAME\n".len(), SIZE.0 * SIZE.1);
        let frames = bytes[header..].chunks_exact(frame + samples).map(|one| one[frame..].to_vec());
        let mut changed = bytes[..header].to_vec();
        for one in change(frames.collect()) {
            changed.extend(b"FRAME\n");
            changed.extend(one);
        }
        fs::write(&self.source, changed).unwrap();
        self
    }

    /// The result of `doctor` with the camera and the height of the clip.
    fn doctor(&self) -> Diagnosis {
        let camera = self.path("camera.yaml");
        self.doctor_with(&["--camera", &camera, "--height", "0.9"])
    }

    fn doctor_with(&self, options: &[&str]) -> Diagnosis {
        let source = self.source.display().to_string();
        let output = odograph(&[&["doctor", &source, "--json"], options].concat());
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        let json =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {message}"));
        Diagnosis { json, code: output.status.code().unwrap() }
    }
}

struct Diagnosis {
    json: Value,
    code: i32,
}

impl Diagnosis {
    fn finding(&self, topic: &str) -> &Value {
        let findings = self.json["findings"].as_array().unwrap();
        findings.iter().find(|one| one["topic"] == topic).unwrap_or_else(|| panic!("{topic}: {findings:#?}"))
    }

    /// Asserts the judgement of a topic, and that there is advice.
    fn assert(&self, topic: &str, judgement: &str) -> &Value {
        let finding = self.finding(topic);
        assert_eq!(finding["judgement"], judgement, "{finding:#}");
        assert!(finding["advice"].is_string(), "{finding:#}");
        let spoils = self.json["findings"].as_array().unwrap().iter().any(|one| one["judgement"] == "spoils");
        assert_eq!(self.code, if spoils { 4 } else { 0 });
        finding
    }
}

#[test]
fn a_clean_recording_has_no_findings() {
    for texture in ["asphalt", "carpet", "concrete", "bricks"] {
        let clip = Clip::new(&["--texture", texture]);
        let diagnosis = clip.doctor();
        let findings = diagnosis.json["findings"].as_array().unwrap();
        let bad: Vec<&Value> = findings.iter().filter(|one| one["judgement"] != "good").collect();
        assert!(bad.is_empty() && findings.len() >= 11, "{texture}: {bad:#?}");
        assert!(findings.iter().all(|one| one["advice"].is_null()), "{texture}");
        assert_eq!((diagnosis.code, &diagnosis.json["frames_looked_at"]), (0, &Value::from(61)), "{texture}");
    }
}

#[test]
fn a_page_shows_the_findings_and_the_frames_of_them() {
    let clip = Clip::new(&["--blackout", "1:1.5"]);
    let (source, page) = (clip.source.display().to_string(), clip.path("pages/drive.html"));
    let output = odograph(&["doctor", &source, "-o", &page]);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains(&format!("look at {page}")), "{message}");
    let html = fs::read_to_string(&page).unwrap();
    assert!(
        html.contains("agree on the motion of the ground.") && html.contains("Lost because of darkness.")
    );
    assert!(html.contains("The fastest frame: the ground has moved by"), "{html}");
    assert!(html.matches("src=\"data:image/jpeg").count() >= 3 && html.matches("<circle").count() > 50);
    // The same as on the terminal.
    for line in String::from_utf8_lossy(&output.stdout).lines().skip(2) {
        let measured = line.split(": ").nth(1).and_then(|rest| rest.split("; ").next()).unwrap();
        assert!(html.contains(measured), "{measured}");
    }
    for (name, said) in
        [(page.as_str(), "is already there"), ("page.pdf", "give it a name that ends with .html")]
    {
        let refused = odograph(&["doctor", &source, "-o", name]);
        let message = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(refused.status.code() == Some(2) && message.contains(said), "{message}");
        assert!(refused.stdout.is_empty(), "before the work");
    }
    assert!(odograph(&["doctor", &source, "-o", &page, "--force", "--quiet"]).stderr.is_empty());
}

#[test]
fn a_camera_file_that_is_missing_or_of_another_size_is_a_finding() {
    let clip = Clip::new(&[]);
    clip.doctor_with(&[]).assert("camera file", "limits");
    clip.doctor_with(&["--field-of-view", "1.2x0.9"]).assert("camera file", "limits");
    let exchanged = clip.doctor_with(&["--field-of-view", "0.9x1.2"]);
    let finding = exchanged.assert("camera file", "spoils");
    assert!(finding["measured"].as_str().unwrap().contains("1.2x0.9 makes them square"), "{finding}");
    let other = clip.path("other.yaml");
    let text = fs::read_to_string(clip.path("camera.yaml")).unwrap();
    fs::write(&other, text.replace("320", "640").replace("240", "480")).unwrap();
    let finding = clip.doctor_with(&["--camera", &other]);
    let finding = finding.assert("camera file", "spoils");
    assert!(finding["measured"].as_str().unwrap().contains("640x480"), "{finding}");
}

#[test]
fn without_a_camera_file_the_motion_is_that_of_the_image() {
    let clip = Clip::new(&["--path", "lanes", "--speed", "0.8", "--roll", "5", "--duration", "5"]);
    let (camera, rig) = (clip.path("camera.yaml"), clip.path("rig.toml"));
    let (known, unknown) = (clip.doctor_with(&["--camera", &camera, "--rig", &rig]), clip.doctor_with(&[]));
    for diagnosis in [&known, &unknown] {
        assert_eq!(diagnosis.finding("tracking")["value"], 0.0, "{:#}", diagnosis.json);
    }
    let overlap = |diagnosis: &Diagnosis| diagnosis.finding("overlap")["value"].as_f64().unwrap();
    assert!((overlap(&known) - overlap(&unknown)).abs() < 2.0, "{:#}", unknown.json);
    let shutter = unknown.finding("shutter")["measured"].as_str().unwrap();
    assert!(shutter.contains("the readout time is not known"), "{shutter}");
}

#[test]
fn light_that_is_too_strong_or_too_weak_is_a_finding() {
    let scaled = |by: f64, add: f64| {
        move |frames: Vec<Vec<u8>>| -> Vec<Vec<u8>> {
            let scaled = |sample: &u8| (by * f64::from(*sample) + add).clamp(0.0, 255.0) as u8;
            frames.iter().map(|frame| frame.iter().map(scaled).collect()).collect()
        }
    };
    let over = Clip::new(&[]).frames(scaled(1.6, 60.0)).doctor();
    let finding = over.finding("exposure");
    assert!(finding["judgement"] != "good" && finding["unit"] == "%", "{finding:#}");
    let under = Clip::new(&[]).frames(scaled(0.25, 0.0)).doctor();
    let finding = under.finding("exposure");
    assert!(finding["judgement"] != "good" && finding["unit"] == "gray levels", "{finding:#}");
}

#[test]
fn a_bare_floor_is_a_finding() {
    let bare = Clip::new(&["--texture", "bare"]).doctor();
    let finding = bare.assert("texture", "spoils");
    assert!(finding["advice"].as_str().unwrap().contains("light the ground from the side"), "{finding:#}");
}

#[test]
fn blur_and_little_overlap_at_high_speed_are_findings() {
    let blurred = Clip::new(&["--speed", "1.5", "--blur", "0.03", "--rolling", "--path", "walk"]).doctor();
    let finding = blurred.finding("motion blur");
    assert!(finding["judgement"] != "good", "{finding:#}");
    let fast = Clip::new(&["--speed", "9", "--path", "straight", "--length", "18", "--rolling"]).doctor();
    fast.finding("overlap").as_object().unwrap();
    assert!(fast.finding("overlap")["judgement"] != "good", "{:#}", fast.finding("overlap"));
}

#[test]
fn repeated_frames_are_a_finding() {
    let doubled = |frames: Vec<Vec<u8>>| frames.into_iter().flat_map(|one| [one.clone(), one]).collect();
    let diagnosis = Clip::new(&["--speed", "0.6", "--rolling"]).frames(doubled).doctor();
    diagnosis.assert("repeated frames", "spoils");
}

#[test]
fn gaps_and_jitter_of_the_times_are_findings() {
    let clip = Clip::of_pictures(&["--dropped", "0.15"]);
    let (camera, times) = (clip.path("camera.yaml"), clip.path("frames.txt"));
    let options = ["--camera", &camera, "--height", "0.9", "--timestamps", &times];
    let diagnosis = clip.doctor_with(&options);
    diagnosis.assert("gaps", "limits");
    let clip = Clip::of_pictures(&["--jitter", "10"]);
    let (camera, times) = (clip.path("camera.yaml"), clip.path("frames.txt"));
    let options = ["--camera", &camera, "--height", "0.9", "--timestamps", &times];
    clip.doctor_with(&options).assert("frame times", "limits");
}

#[test]
fn blocks_of_a_strong_compression_are_a_finding() {
    // Half of the contrast within blocks of 8x8 pixels is gone.
    let blocky = |frames: Vec<Vec<u8>>| -> Vec<Vec<u8>> {
        let smoothed = |frame: Vec<u8>| {
            let mean = |left: usize, top: usize| {
                let rows = (top..top + 8).map(|y| &frame[y * SIZE.0 + left..][..8]);
                rows.flatten().map(|sample| u32::from(*sample)).sum::<u32>() / 64
            };
            let at = |index: usize| {
                let (x, y) = (index % SIZE.0, index / SIZE.0);
                ((u32::from(frame[index]) + mean(x / 8 * 8, y / 8 * 8)) / 2) as u8
            };
            (0..frame.len()).map(at).collect()
        };
        frames.into_iter().map(smoothed).collect()
    };
    let finding = Clip::new(&[]).frames(blocky).doctor();
    assert!(finding.finding("compression")["judgement"] != "good", "{:#}", finding.finding("compression"));
}

#[test]
fn an_unknown_readout_time_is_a_finding() {
    let clip = Clip::new(&["--path", "straight", "--length", "2", "--rolling", "--speed", "0.6"]);
    let camera = clip.path("unknown.yaml");
    let text = fs::read_to_string(clip.path("camera.yaml")).unwrap();
    let kept: Vec<&str> = text.lines().filter(|line| !line.starts_with("readout_time_s")).collect();
    fs::write(&camera, kept.join("\n")).unwrap();
    clip.doctor_with(&["--camera", &camera, "--height", "0.9"]).assert("shutter", "limits");
    let message = clip.doctor_with(&["--camera", &camera, "--height", "0.9", "--readout-ms", "0"]);
    assert_eq!(message.finding("shutter")["judgement"], "good");
}

#[test]
fn a_bumper_in_view_is_a_finding_unless_it_is_masked() {
    let clip = Clip::new(&["--bumper", "0.2", "--duration", "4"]);
    let finding = clip.doctor();
    let finding = finding.assert("fixed in the image", "limits");
    assert!(finding["measured"].as_str().unwrap().contains("bottom"), "{finding}");
    let mask = clip.path("mask.pgm");
    let row = |y: usize| vec![if y < 176 { 255 } else { 0 }; SIZE.0];
    let samples: Vec<u8> = (0..SIZE.1).flat_map(row).collect();
    fs::write(&mask, [format!("P5\n{} {}\n255\n", SIZE.0, SIZE.1).as_bytes(), &samples].concat()).unwrap();
    let camera = clip.path("camera.yaml");
    let masked = clip.doctor_with(&["--camera", &camera, "--height", "0.9", "--mask", &mask]);
    assert_eq!(masked.finding("fixed in the image")["judgement"], "good");
}

#[test]
fn a_tilt_that_was_not_given_is_a_finding() {
    let clip = Clip::new(&["--roll", "3", "--speed", "0.8", "--rolling", "--duration", "3"]);
    let diagnosis = clip.doctor();
    let finding = diagnosis.assert("tilt", "limits");
    assert!((finding["value"].as_f64().unwrap() - 3.0).abs() < 0.3, "{finding}");
    let (camera, rig) = (clip.path("camera.yaml"), clip.path("rig.toml"));
    let given = clip.doctor_with(&["--camera", &camera, "--rig", &rig]);
    assert_eq!(given.finding("tilt")["judgement"], "good");
}

#[test]
fn findings_are_a_line_each_and_bad_input_is_an_error() {
    let clip = Clip::new(&[]);
    let source = clip.source.display().to_string();
    let output = odograph(&["doctor", &source]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.lines().nth(1).unwrap().starts_with("61 of 61 frames looked at"), "{text}");
    let first = text.lines().nth(2).unwrap();
    assert!(
        first.starts_with("limits  camera file: not given") && first.contains("; give --camera"),
        "{text}"
    );
    let quiet = String::from_utf8(odograph(&["doctor", &source, "--quiet"]).stdout).unwrap();
    assert!(quiet.lines().all(|line| line.starts_with("limits") || line.starts_with("spoils")), "{quiet}");
    assert_eq!(fs::read_dir(clip.folder.path()).unwrap().count(), 5, "doctor writes nothing");
    for (arguments, code) in [
        (vec!["doctor", "nowhere.mp4"], 3),
        (vec!["doctor", &source, "--height", "0"], 2),
        (vec!["doctor", &source, "--camera", "nowhere.yaml"], 3),
        (vec!["doctor"], 2),
    ] {
        let output = odograph(&arguments);
        assert_eq!(output.status.code(), Some(code), "{arguments:?}");
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
    assert!(Path::new(&source).exists());
}

#[test]
fn of_what_cannot_be_tracked_nothing_is_said_to_move_with_the_ground() {
    let black = Clip::new(&["--duration", "0.2"])
        .frames(|frames| frames.iter().take(1).map(|frame| vec![0; frame.len()]).collect());
    let diagnosis = black.doctor();
    let finding = diagnosis.assert("fixed in the image", "unknown");
    assert_eq!(finding["measured"], "not determined: no motion was tracked");
}

#[test]
fn a_recording_in_which_nothing_moves_is_a_finding() {
    let still = Clip::of_pictures(&["--path", "still"]);
    // What a camera file of unknown shutter leaves open.
    let camera = still.path("unknown.yaml");
    let text = fs::read_to_string(still.path("camera.yaml")).unwrap();
    let kept: Vec<&str> = text.lines().filter(|line| !line.starts_with("readout_time_s")).collect();
    fs::write(&camera, kept.join("\n")).unwrap();
    let diagnosis = still.doctor_with(&["--camera", &camera, "--height", "0.9"]);
    let finding = diagnosis.assert("motion", "spoils");
    assert!(finding["measured"].as_str().unwrap().contains("did not move in the 61 frames"), "{finding}");
    for topic in ["shutter", "tilt", "fixed in the image"] {
        let finding = diagnosis.assert(topic, "unknown");
        assert_eq!(finding["measured"], "not determined: nothing moves", "{topic}");
    }
    // Pictures have no times, unless they are given.
    let finding = diagnosis.assert("frame times", "unknown");
    assert!(finding["measured"].as_str().unwrap().starts_with("assumed, 30.00 frames/s"), "{finding}");
    let timed = still.doctor_with(&["--fps", "30", "--camera", &camera, "--height", "0.9"]);
    assert_eq!(timed.finding("frame times")["judgement"], "good");
    // The camera is not at rest in the frames looked at where it creeps.
    let creeps =
        Clip::new(&["--path", "straight", "--length", "2mm", "--speed", "0.01", "--duration", "1"]).doctor();
    let topics: Vec<&Value> =
        creeps.json["findings"].as_array().unwrap().iter().map(|one| &one["topic"]).collect();
    assert!(!topics.contains(&&Value::from("motion")), "{topics:?}");
}

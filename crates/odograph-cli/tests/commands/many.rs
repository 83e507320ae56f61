//! Several recordings in one call: the same bytes as in separate calls, and a failure does not stop
//! the others.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn odograph(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.current_dir(folder).args(arguments.split_whitespace()).output().unwrap()
}

fn done(folder: &Path, arguments: &str) {
    let output = odograph(folder, arguments);
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
}

/// A Y4M recording, cut after this many frames.
fn first_frames(recording: &Path, count: usize) -> Vec<u8> {
    let mut bytes = fs::read(recording).unwrap();
    let header = bytes.iter().position(|&byte| byte == b'\n').unwrap() + 1;
    let frame = bytes[header..].windows(5).skip(1).position(|word| word == b"FRAME").unwrap() + 1;
    bytes.truncate(header + count * frame);
    bytes
}

#[test]
fn a_folder_of_videos_gives_the_results_of_single_runs() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    fs::create_dir(here.join("videos")).unwrap();
    for (name, seed) in [("one", 1), ("two", 2)] {
        done(
            here,
            &format!(
                "simulate -o {name} --format y4m --path straight --length 0.5 --duration 1 --fps 20 --size 240x180 --height 0.75 --seed {seed} --quiet"
            ),
        );
        fs::rename(here.join(format!("{name}/sim.y4m")), here.join(format!("videos/{name}.y4m"))).unwrap();
    }
    let camera = "--camera one/camera.yaml --rig one/rig.toml";
    done(here, &format!("run videos/two.y4m {camera} -o alone --threads 1 --quiet"));
    let all = odograph(here, &format!("run videos {camera} -o all --threads 2"));
    let message = String::from_utf8_lossy(&all.stdout).into_owned();
    assert!(all.status.success() && message.contains("2 of 2 recordings followed"), "{message}");
    for name in ["trajectory.tum", "trajectory.csv", "mosaic.png", "map.svg", "report.html"] {
        let read = |folder: &str| fs::read(here.join(folder).join(name)).unwrap();
        assert!(read("alone") == read("all/two"), "{name} differs");
        assert!(read("all/one") != read("all/two"), "{name} is the same of different recordings");
    }

    // An invalid recording is reported, also in the exit code, and the other one is processed.
    fs::write(here.join("broken.mp4"), b"no video").unwrap();
    let some = odograph(here, &format!("run broken.mp4 videos/one.y4m {camera} -o some --json"));
    assert_eq!(some.status.code(), Some(3));
    let message = String::from_utf8_lossy(&some.stderr).into_owned();
    assert!(message.contains("broken.mp4") && message.contains("1 of 2 recordings"), "{message}");
    let figures: serde_json::Value = serde_json::from_slice(&some.stdout).unwrap();
    assert!(figures[0]["error"].is_string() && figures[1]["statistics"]["frames"] == 21, "{figures}");
    assert!(here.join("some/one/trajectory.tum").is_file() && !here.join("some/broken").exists());

    // An error that names its recording is printed as it is.
    fs::write(here.join("one.y4m"), first_frames(&here.join("videos/one.y4m"), 1)).unwrap();
    let short = odograph(here, &format!("run one.y4m broken.mp4 {camera} -o short --quiet"));
    let message = String::from_utf8_lossy(&short.stderr).into_owned();
    assert!(message.contains("error: one.y4m has only one frame; "), "{message}");

    // Where none can be followed there is no folder.
    let none = odograph(here, &format!("run broken.mp4 none.mp4 {camera} -o none"));
    assert_eq!((none.status.code(), here.join("none").exists()), (Some(3), false));
    let file = odograph(here, &format!("run videos {camera} -o broken.mp4"));
    assert_eq!(file.status.code(), Some(2), "{}", String::from_utf8_lossy(&file.stderr));

    // Options for a single recording are refused for several.
    let refused = odograph(here, &format!("run videos {camera} --timestamps times.txt -o refused"));
    assert_eq!(refused.status.code(), Some(2));
    assert!(!here.join("refused").exists());
}

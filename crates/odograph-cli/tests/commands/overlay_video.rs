//! `odograph run --video-out`.

use crate::program::{done, odograph};
use odograph_video::SourceOptions;
use std::fs;
use std::path::Path;

const RUN: &str = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --height 0.6 -q";

/// A drive of 0.6 m with darkness in it, 37 frames.
fn drive(place: &Path) {
    done(
        place,
        "simulate --texture carpet --path straight --length 0.6 --speed 0.5 --size 320x240 --height 0.6 --fps 20 \
         --duration 1.8 --blackout 0.8:1.0 -q -o sim",
    );
}

#[test]
fn the_overlay_video_plays_back_and_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    drive(place);
    done(place, &format!("{RUN} -o plain"));
    done(place, &format!("{RUN} --video-out drive.avi -o out"));
    done(place, &format!("{RUN} --video-out again.avi --threads 1 -o again"));
    for name in ["trajectory.csv", "trajectory.tum", "mosaic.png", "run.toml"] {
        let read = |run: &str| fs::read(place.join(run).join(name)).unwrap();
        assert!(read("plain") == read("out"), "{name} differs");
    }
    let bytes = fs::read(place.join("drive.avi")).unwrap();
    assert!(bytes == fs::read(place.join("again.avi")).unwrap(), "the same bytes for any number of threads");
    assert!(!place.join("drive.avi.part").exists());

    let table = fs::read_to_string(place.join("out/trajectory.csv")).unwrap();
    let lost: Vec<bool> = table.lines().skip(1).map(|line| line.contains("lost:")).collect();
    assert!(lost.contains(&true) && lost.contains(&false), "{table}");
    let options = SourceOptions { color: true, ..Default::default() };
    let mut video = odograph_video::open(place.join("drive.avi"), &options).unwrap();
    assert_eq!((video.info().width, video.info().height), (640, 480), "twice the size of the frames");
    let (mut frames, mut last_s) = (0, 0.0);
    while let Some(frame) = video.next_frame().unwrap() {
        // The status at the top is written in sky blue, or in orange where the frame is lost.
        let rgb = frame.rgb();
        let count = |strong: usize, weak: usize| {
            let top = rgb.samples()[..3 * 640 * 24].chunks_exact(3);
            top.filter(|pixel| i32::from(pixel[strong]) > i32::from(pixel[weak]) + 30).count()
        };
        let (blue, orange) = (count(2, 0), count(0, 2));
        let (most, least) = if lost[frames] { (orange, blue) } else { (blue, orange) };
        assert!(most > 100 && most > 3 * least, "frame {frames}: {blue} blue, {orange} orange");
        frames += 1;
        last_s = frame.time_s;
    }
    assert_eq!(frames, 37);
    assert!((last_s - 1.8_f64).abs() < 1e-6, "{last_s}");
}

#[test]
fn what_cannot_be_the_video_is_refused_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    drive(place);
    fs::write(place.join("there.avi"), "mine").unwrap();
    for (more, said) in [
        ("--video-out drive.mp4", "drive.mp4 cannot be the overlay video, which is Motion JPEG in AVI"),
        ("--video-out there.avi", "there.avi is already there"),
        ("--video-out none/drive.avi", "there is no folder none"),
    ] {
        let refused = odograph(place, &format!("{RUN} {more} -o out"));
        let message = String::from_utf8(refused.stderr).unwrap();
        assert!(refused.status.code() == Some(2) && message.contains(said), "{more}: {message}");
        assert_eq!(message.trim_end().lines().count(), 1, "{message}");
        assert!(!place.join("out").exists(), "{more}");
    }
    assert_eq!(fs::read_to_string(place.join("there.avi")).unwrap(), "mine");
}

#[test]
fn the_video_may_be_in_the_new_folder_of_the_results() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    drive(place);
    let run = |more: &str| odograph(place, &format!("{RUN} --video-out out/drive.avi {more}"));
    // A run that is refused leaves no folder.
    let refused = run("--reference none.tum -o out");
    assert!(!refused.status.success() && !place.join("out").exists());
    // Another folder is not made.
    let refused = run("-o other");
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("there is no folder out"));
    let done = run("--bag-out out/drive.mcap -o out/");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(place.join("out/drive.avi").is_file() && place.join("out/drive.mcap").is_file());
    let named = odograph(place, &format!("{RUN} --video-out new/map.png -o new"));
    assert!(named.status.code() == Some(2) && !place.join("new").exists());
}

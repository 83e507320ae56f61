//! Every recording that ever failed a fuzz target (`fuzz/regressions/TARGET`): frames or an error,
//! without a panic of our own code, which would become an error as well.

#![allow(clippy::unwrap_used)] // a test may panic

use odograph::filter::fusion::SensorKind;
use odograph_video::{Picture, SourceOptions, open};
use std::panic;
use std::path::Path;
use std::sync::Mutex;

const TARGETS: [&str; 9] =
    ["annex_b", "avi", "matroska", "mcap", "mp4", "pictures", "rosbag1", "rosbag2", "y4m"];

/// Places of panics of our own code.
static OWN: Mutex<Vec<String>> = Mutex::new(Vec::new());

fn note_panics() {
    // The crate's own hook is installed by the first call, and must be below this one.
    let _ = Picture::from_jpeg(&[], false);
    let hook = panic::take_hook();
    panic::set_hook(Box::new(move |info| {
        let place = info.location().map(ToString::to_string).unwrap_or_default();
        if place.contains("crates/odograph") {
            OWN.lock().unwrap().push(place);
        }
        hook(info);
    }));
}

/// As the targets do.
fn read(path: &Path) {
    let options = SourceOptions { max_frames: Some(4), color: true, ..SourceOptions::default() };
    if let Ok(mut source) = open(path, &options) {
        while let Ok(Some(frame)) = source.next_frame() {
            frame.rgb();
        }
        source.take_warnings();
    }
    let _ = odograph_video::inspect(path);
    let _ = odograph_video::recorded_camera(path, None);
    let _ = odograph_video::recorded_mount(path, None);
    let sensors = [("/imu", SensorKind::Gyro), ("/odom", SensorKind::Wheel), ("/range", SensorKind::Range)];
    for (topic, kind) in sensors {
        let _ = odograph_video::recorded_sensor(path, topic, kind);
    }
    let _ = odograph_video::recorded_fixes(path, "/fix");
}

#[test]
fn what_once_failed_is_read_or_refused() {
    note_panics();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/regressions");
    let mut count = 0;
    for target in TARGETS {
        let Ok(inputs) = std::fs::read_dir(folder.join(target)) else { continue };
        for input in inputs {
            let path = input.unwrap().path();
            read(&path);
            assert_eq!(*OWN.lock().unwrap(), [""; 0], "{}", path.display());
            count += 1;
        }
    }
    assert!(count > 0, "there are no inputs in {}", folder.display());
}

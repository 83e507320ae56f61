//! Kills a program at arbitrary moments while it writes a map: the map opens, is consistent, lacks
//! at most the last keyframe, and can be continued.
//!
//! The writer is this test binary, started with an environment variable that makes the ignored test
//! below write until it is killed.

use crate::ground;
use odograph::camera::Rig;
use odograph_map::{MapFile, PathFrame};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};

const FOLDER: &str = "ODOGRAPH_KILLED_TEST_FOLDER";
/// Number of times a writer is killed; the environment variable of this name overrides it.
const MOMENTS: u64 = 6;

/// Not a test: the program that is killed. Prints the id of each keyframe once it is in the map.
#[test]
#[ignore = "run by the other test, to be killed"]
fn writer() {
    let Some(folder) = std::env::var_os(FOLDER) else { return };
    let path = Path::new(&folder).join("map.gpkg");
    let mut map = if path.exists() {
        MapFile::open(&path).unwrap()
    } else {
        MapFile::create(&path, &ground::camera(), &Rig::level(0.5)).unwrap()
    };
    let session = map.begin_session("drive.mp4").unwrap();
    let image = ground::image(0);
    for turn in 0..1_000_000_u64 {
        let number = map.next_keyframe().unwrap().0;
        let edges = if number > 0 { vec![ground::edge_to(number)] } else { vec![] };
        map.add_keyframe(&ground::keyframe(number, session), &image, &edges).unwrap();
        writeln!(std::io::stdout(), "keyframe {number}").unwrap();
        // Occasional other writes of a run: it updates poses, writes the path and renders the
        // mosaic.
        if turn % 20 == 10 {
            let moved = (0..=number)
                .map(|k| (odograph::keyframe::KeyframeId(k), ground::pose(k), ground::covariance()));
            map.set_poses(&moved.collect::<Vec<_>>()).unwrap();
            let frame =
                |frame| PathFrame { frame, segment: 0, time_s: frame as f64, pose: ground::pose(frame) };
            map.set_path(session, &(0..number).map(frame).collect::<Vec<_>>()).unwrap();
            map.render_mosaic(Some(0.05), &mut |_| true).unwrap();
        }
    }
}

#[test]
fn a_map_survives_killing_its_writer() {
    let moments = std::env::var("MOMENTS").ok().and_then(|text| text.parse().ok()).unwrap_or(MOMENTS);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let mut killed_with_log = 0;
    for moment in 0..moments {
        let mut writer = Command::new(std::env::current_exe().unwrap())
            .args(["killed::writer", "--exact", "--ignored", "--nocapture"])
            .env(FOLDER, folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let said = BufReader::new(writer.stdout.take().unwrap()).lines();
        // Killed after some keyframes, at varying moments within the next one, depending on the
        // machine's speed.
        let mut last = None;
        let mut wait_for = 1 + (7 * moment + 3) % 23;
        for line in said {
            if let Some(number) = line.unwrap().strip_prefix("keyframe ") {
                last = Some(number.parse::<u64>().unwrap());
                wait_for -= 1;
                if wait_for == 0 {
                    (0..moment * 40_000).for_each(|k| {
                        std::hint::black_box(k);
                    });
                    writer.kill().unwrap();
                    break;
                }
            }
        }
        writer.wait().unwrap();
        let last = last.expect("the writer wrote something before it was killed");
        killed_with_log += u64::from(folder.path().join("map.gpkg-wal").exists());
        let mut map = MapFile::open(&path).unwrap();
        map.check().unwrap();
        let found = map.map().unwrap();
        let numbers: Vec<u64> = found.keyframes.iter().map(|keyframe| keyframe.id.0).collect();
        // Every reported keyframe is in the map. There may be more, written before the kill, but
        // none without its edge.
        assert!(numbers.last().is_some_and(|&there| there >= last), "{numbers:?} without {last}");
        assert!(numbers.iter().copied().eq(0..numbers.len() as u64));
        assert_eq!(found.edges.len() + 1, numbers.len());
        map.close().unwrap();
    }
    assert_eq!(killed_with_log, moments, "a writer that dies leaves its log");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

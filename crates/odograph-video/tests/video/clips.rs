//! Decodes every clip of the recordings and compares with ffmpeg: same frames, same luminance, same
//! timestamps.
//!
//! Needs the recordings (in `ODOGRAPH_DATA`, or `shared/data` beside the checkout) and `ffmpeg`
//! with `ffprobe`; skips without them. The table of `docs/decoding.md` is printed by
//! `cargo test --release -p odograph-video --test video clips -- --nocapture`.

use odograph_video::{SourceOptions, open};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

fn recordings() -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::var_os("ODOGRAPH_DATA").map_or_else(beside, PathBuf::from).join("video");
    if !folder.is_dir() {
        println!("skipped: data: there are no recordings in {}", folder.display());
        return None;
    }
    let there = |program: &str| Command::new(program).arg("-version").output().is_ok();
    if !(there("ffmpeg") && there("ffprobe")) {
        println!("skipped: ffmpeg: there is no ffmpeg with ffprobe to compare with");
        return None;
    }
    Some(folder)
}

fn ffprobe(clip: &Path, entries: &str) -> Vec<String> {
    let output = Command::new("ffprobe")
        .args(["-v", "error", "-select_streams", "v:0", "-of", "csv=p=0", "-show_entries", entries])
        .arg(clip)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.lines().map(|l| l.trim_matches(',').to_string()).filter(|l| !l.is_empty()).collect()
}

/// Result of comparing a clip.
#[derive(Default)]
struct ClipComparison {
    description: String,
    frames: usize,
    differing_samples: u64,
    largest_difference: u8,
    samples: u64,
}

/// Decodes a clip here and with ffmpeg; panics if the frames or their timestamps differ.
fn compare(clip: &Path) -> ClipComparison {
    let name = clip.file_name().unwrap().to_string_lossy().into_owned();
    let format = ffprobe(clip, "stream=pix_fmt").remove(0);
    // The luminance plane itself; an RGB source has none and is converted by ffmpeg on both sides.
    let filter = if format.starts_with("yuv") || format == "gray" {
        "extractplanes=y"
    } else {
        "format=yuv444p,extractplanes=y"
    };
    let mut ffmpeg = Command::new("ffmpeg")
        .args(["-v", "error", "-nostdin", "-i"])
        .arg(clip)
        .args([
            "-map",
            "0:v:0",
            "-fps_mode",
            "passthrough",
            "-vf",
            filter,
            "-f",
            "rawvideo",
            "-pix_fmt",
            "gray",
            "-",
        ])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut expected = ffmpeg.stdout.take().unwrap();
    let expected_times: Vec<Option<f64>> =
        ffprobe(clip, "frame=best_effort_timestamp_time").iter().map(|t| t.parse().ok()).collect();

    let mut source = open(clip, &SourceOptions::default()).unwrap_or_else(|error| panic!("{error}"));
    let mut result =
        ClipComparison { description: source.info().description.clone(), ..ClipComparison::default() };
    let mut plane = vec![0; source.info().width * source.info().height];
    while let Some(frame) = source.next_frame().unwrap_or_else(|error| panic!("{error}")) {
        expected.read_exact(&mut plane).unwrap_or_else(|_| panic!("{name}: more frames than ffmpeg gives"));
        for (ours, theirs) in frame.gray.samples().iter().zip(&plane) {
            let difference = ours.abs_diff(*theirs);
            result.differing_samples += u64::from(difference > 0);
            result.largest_difference = result.largest_difference.max(difference);
        }
        result.samples += plane.len() as u64;
        if let Some(Some(time_s)) = expected_times.get(result.frames) {
            assert!(
                (frame.time_s - time_s).abs() < 1e-6,
                "{name}: frame {}: {} s, {time_s} s",
                frame.number,
                frame.time_s
            );
        }
        result.frames += 1;
    }
    let mut rest = Vec::new();
    expected.read_to_end(&mut rest).unwrap();
    assert!(rest.is_empty(), "{name}: ffmpeg gives {} bytes more", rest.len());
    ffmpeg.wait().unwrap();
    assert_eq!(result.frames, expected_times.len(), "{name}");
    result
}

fn compare_folder(folder: &str) {
    let Some(recordings) = recordings() else { return };
    let mut clips: Vec<PathBuf> = std::fs::read_dir(recordings.join(folder))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e != "txt"))
        .collect();
    clips.sort();
    assert!(!clips.is_empty());
    for clip in clips {
        let name = clip.file_name().unwrap().to_string_lossy().into_owned();
        let result = compare(&clip);
        let agreement = match result.largest_difference {
            0 => "every sample equal".to_string(),
            most => format!(
                "{:.2} % of the samples differ, by {most} at most",
                100.0 * result.differing_samples as f64 / result.samples as f64
            ),
        };
        println!("| `{folder}/{name}` | {} | {} | {agreement} |", result.description, result.frames);
        // JPEG does not specify the last bits of the inverse transform; the other standards are
        // bit-exact.
        if result.description.starts_with("Motion JPEG") {
            assert!(
                result.largest_difference <= 3 && result.differing_samples * 20 < result.samples,
                "{name}"
            );
        } else {
            assert_eq!(result.largest_difference, 0, "{name}");
        }
    }
}

#[test]
fn all_codecs_agree_with_ffmpeg() {
    compare_folder("codecs");
}

#[test]
fn real_clips_agree_with_ffmpeg() {
    compare_folder("real");
}

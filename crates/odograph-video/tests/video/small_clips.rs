//! Every decoder and container on a clip of a few kilobytes, compared with ffmpeg.
//!
//! The clips were made with ffmpeg from its own test picture (`-f lavfi -i
//! testsrc2=size=80x48:rate=25 -frames:v 12`). The checksums are of the luminance planes that
//! ffmpeg 5.1 decodes (`-fps_mode passthrough -vf extractplanes=y -f rawvideo -pix_fmt gray`), the
//! times are those of ffprobe.

use odograph_video::{Frame, Source, SourceOptions, open};
use std::path::PathBuf;

fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn opened(name: &str, options: &SourceOptions) -> Source {
    open(path(name), options).unwrap()
}

fn all(source: &mut Source) -> Vec<Frame> {
    std::iter::from_fn(|| source.next_frame().unwrap()).collect()
}

/// FNV-1a hash of all luminance samples.
fn checksum(frames: &[Frame]) -> u64 {
    let samples = frames.iter().flat_map(|f| f.gray.samples());
    samples.fold(0xcbf2_9ce4_8422_2325, |hash, &s| (hash ^ u64::from(s)).wrapping_mul(0x100_0000_01b3))
}

fn times(frames: &[Frame]) -> Vec<i64> {
    frames.iter().map(|f| (f.time_s * 1000.0).round() as i64).collect()
}

fn every(milliseconds: i64, count: i64) -> Vec<i64> {
    (0..count).map(|n| n * milliseconds).collect()
}

#[test]
fn every_codec_and_container() {
    let at_25 = every(40, 12);
    let vfr = vec![0, 40, 80, 200, 240, 280, 360, 400, 440];
    let late = at_25.iter().map(|t| t + 80).collect();
    let clips: [(&str, &str, u64, Vec<i64>); 10] = [
        ("h264_bframes.mp4", "H.264 (High) in MP4, 80x48", 0x5b1a_067d_841c_528f, at_25.clone()),
        ("h264_fragmented.mp4", "H.264 (High) in MP4, 80x48", 0x5b1a_067d_841c_528f, late),
        // AVI has only decoding timestamps, which are assigned in presentation order.
        ("h264_bframes.avi", "H.264 (High) in AVI, 80x48", 0x5b1a_067d_841c_528f, at_25.clone()),
        ("h264_422.mkv", "H.264 (High 4:2:2) in Matroska, 80x48", 0xcda0_ef8e_6c6d_8428, at_25.clone()),
        ("h264_interlaced.264", "H.264 (High) in a raw stream, 80x48", 0x5a54_6a08_8141_ef3e, at_25.clone()),
        ("hevc.mp4", "H.265 (Main) in MP4, 80x48", 0xefb5_e431_d4ef_3ff0, at_25.clone()),
        ("hevc.h265", "H.265 (Main) in a raw stream, 80x48", 0xefb5_e431_d4ef_3ff0, at_25.clone()),
        ("vp9.webm", "VP9 in Matroska, 80x48", 0x3f20_7e6c_de39_4d95, at_25.clone()),
        ("vfr.mkv", "H.264 (High) in Matroska, 80x48", 0x54b6_5b99_8b65_d5aa, vfr),
        // Frames before the start of the edit list are decoded as references but not output.
        ("edited.mov", "H.264 (High) in MP4, 80x48", 0xb14b_156c_061f_83ef, every(40, 4)),
    ];
    for (name, description, sum, expected_times) in clips {
        let mut source = opened(name, &SourceOptions::default());
        assert_eq!(source.info().description, description, "{name}");
        let frames = all(&mut source);
        assert_eq!(times(&frames), expected_times, "{name}");
        assert_eq!(checksum(&frames), sum, "{name}");
        assert!(frames.iter().map(|f| f.number).eq(0..frames.len() as u64), "{name}");
        assert_eq!(source.take_warnings(), Vec::<String>::new(), "{name}");
    }
}

#[test]
fn motion_jpeg_agrees_up_to_rounding() {
    // The standard leaves the last bit of the inverse transform open (ITU-T T.81, annex A): only
    // the mean is compared.
    let frames = all(&mut opened("mjpeg.avi", &SourceOptions::default()));
    assert_eq!(times(&frames), every(40, 12));
    let sum: u64 = frames[0].gray.samples().iter().map(|&s| u64::from(s)).sum();
    assert!((sum as f64 / 3840.0 - 64.446).abs() < 0.05);
}

#[test]
fn a_rotated_video_is_output_upright() {
    let mut source = opened("h264_turned.mp4", &SourceOptions { color: true, ..SourceOptions::default() });
    assert_eq!((source.info().width, source.info().height), (48, 80));
    let frames = all(&mut source);
    assert_eq!(checksum(&frames), 0xe3ac_ca89_d65d_3463);
    let lying =
        all(&mut opened("h264_bframes.mp4", &SourceOptions { color: true, ..SourceOptions::default() }));
    // The display matrix of the clip is a clockwise quarter turn: the left column, reversed,
    // becomes the top row.
    let (upright, lying) = (frames[5].rgb(), lying[5].rgb());
    assert_eq!(upright.pixel(0, 0), lying.pixel(0, 47));
    assert_eq!(upright.pixel(47, 79), lying.pixel(79, 0));
}

#[test]
fn an_edit_list_of_very_many_parts_is_ignored() {
    // The index is behind the frames, so that their places stay.
    let mut bytes = std::fs::read(path("edited.mov")).unwrap();
    let place = |name: &[u8]| bytes.windows(4).position(|window| window == name).unwrap();
    let [moov, trak, edts, elst] = [&b"moov"[..], b"trak", b"edts", b"elst"].map(place);
    let number = |bytes: &[u8], at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
    let end = elst - 4 + number(&bytes, elst - 4) as usize;
    let more = 300;
    let part = bytes[end - 12..end].to_vec();
    bytes.splice(end..end, part.repeat(more));
    for at in [moov, trak, edts, elst] {
        let size = number(&bytes, at - 4) + 12 * more as u32;
        bytes[at - 4..at].copy_from_slice(&size.to_be_bytes());
    }
    let count = number(&bytes, elst + 8) + more as u32;
    bytes[elst + 8..elst + 12].copy_from_slice(&count.to_be_bytes());
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(&file, bytes).unwrap();
    let mut source = open(&file, &SourceOptions::default()).unwrap();
    // The edit list shows four of them.
    assert_eq!(all(&mut source).len(), 6);
    let warnings = source.take_warnings();
    assert!(warnings[0].contains("parts, more than 256, and was ignored"), "{warnings:?}");
}

#[test]
fn color_is_kept_only_on_request() {
    assert!(!opened("hevc.mp4", &SourceOptions::default()).next_frame().unwrap().unwrap().has_color());
    for name in ["h264_bframes.mp4", "h264_422.mkv", "hevc.mp4", "vp9.webm", "mjpeg.avi"] {
        let mut source = opened(name, &SourceOptions { color: true, ..SourceOptions::default() });
        let frame = source.next_frame().unwrap().unwrap();
        assert!(frame.has_color(), "{name}");
        let rgb = frame.rgb();
        // The test picture has saturated colours.
        let spread = |p: [u8; 3]| p.iter().max().unwrap() - p.iter().min().unwrap();
        assert!((0..48).any(|y| (0..80).any(|x| spread(rgb.pixel(x, y)) > 150)), "{name}");
    }
}

#[test]
fn frames_are_selected_by_start_end_stride_and_count() {
    let chosen = |options: SourceOptions| -> Vec<u64> {
        all(&mut opened("h264_bframes.mp4", &options)).iter().map(|f| f.number).collect()
    };
    let all_of_it = SourceOptions::default;
    assert_eq!(
        chosen(SourceOptions { start_s: Some(0.1), end_s: Some(0.3), ..all_of_it() }),
        [3, 4, 5, 6, 7]
    );
    assert_eq!(chosen(SourceOptions { every: 5, ..all_of_it() }), [0, 5, 10]);
    assert_eq!(
        chosen(SourceOptions { start_s: Some(0.1), every: 2, max_frames: Some(3), ..all_of_it() }),
        [3, 5, 7]
    );
    assert_eq!(chosen(SourceOptions { max_frames: Some(0), ..all_of_it() }), [0u64; 0]);
    // Start and end are relative to the first frame, also if the container's timestamps do not
    // start at zero.
    let mut late = opened("h264_fragmented.mp4", &SourceOptions { start_s: Some(0.4), ..all_of_it() });
    assert_eq!(times(&all(&mut late)), [480, 520]);
}

#[test]
fn a_rate_or_timestamps_file_overrides_the_container() {
    let mut source = opened("vfr.mkv", &SourceOptions { fps: Some(10.0), ..SourceOptions::default() });
    assert_eq!(times(&all(&mut source)), every(100, 9));

    let file = tempfile::NamedTempFile::new().unwrap();
    let listed: String = (0..9).map(|n| format!("{}.5\n", n * n)).collect();
    std::fs::write(&file, &listed).unwrap();
    let options = SourceOptions { timestamps: Some(file.path().to_path_buf()), ..SourceOptions::default() };
    let squares: Vec<i64> = (0..9).map(|n| 1000 * n * n + 500).collect();
    assert_eq!(times(&all(&mut opened("vfr.mkv", &options))), squares);

    std::fs::write(&file, "0\n1\n").unwrap();
    let mut source = opened("vfr.mkv", &options);
    let error = std::iter::from_fn(|| source.next_frame().transpose()).find_map(Result::err).unwrap();
    let said = format!(
        "{} has 2 times, but there are more frames; give a time for each frame",
        file.path().display()
    );
    assert!(error.to_string().ends_with(&said), "{error}");
}

#[test]
fn a_wrong_number_of_times_is_noticed_at_the_beginning() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let options = SourceOptions { timestamps: Some(file.path().to_path_buf()), ..SourceOptions::default() };
    let with_times = |name: &str, count: u32, options: &SourceOptions| {
        let listed: String = (0..count).map(|n| format!("{n}\n")).collect();
        std::fs::write(&file, listed).unwrap();
        open(path(name), options)
    };
    // Both have 12 frames.
    for name in ["h264_bframes.mp4", "h264_fragmented.mp4"] {
        for count in [5, 11, 14] {
            let said = format!(
                "{} has {count} times, but there are 12 frames; give a time for each frame",
                file.path().display()
            );
            let error = with_times(name, count, &options).unwrap_err();
            assert!(error.to_string().ends_with(&said), "{name}, {count}: {error}");
        }
        for count in [12, 13] {
            assert_eq!(all(&mut with_times(name, count, &options).unwrap()).len(), 12, "{name}, {count}");
        }
        // The first frames need no more times than they are.
        let first = SourceOptions { max_frames: Some(3), ..options.clone() };
        assert_eq!(all(&mut with_times(name, 5, &first).unwrap()).len(), 3);
        let first = SourceOptions { end_s: Some(2.5), ..options.clone() };
        assert_eq!(all(&mut with_times(name, 5, &first).unwrap()).len(), 3);
    }
    // Matroska does not state its number of frames: 9.
    let mut source = with_times("vfr.mkv", 12, &options).unwrap();
    assert_eq!(all(&mut source).len(), 9);
    let warnings = source.take_warnings();
    assert!(
        warnings.len() == 1 && warnings[0].contains("has 12 times, but there were 9 frames"),
        "{warnings:?}"
    );
    assert!(with_times("hevc.mp4", 12, &options).is_ok());
    assert!(with_times("hevc.mp4", 14, &options).is_err());
}

#[test]
fn invalid_options_are_rejected() {
    let wrong = [
        SourceOptions { every: 0, ..SourceOptions::default() },
        SourceOptions { fps: Some(f64::NAN), ..SourceOptions::default() },
        SourceOptions { fps: Some(0.0), ..SourceOptions::default() },
        SourceOptions { start_s: Some(-1.0), ..SourceOptions::default() },
        SourceOptions { start_s: Some(2.0), end_s: Some(1.0), ..SourceOptions::default() },
    ];
    for options in wrong {
        let error = open(path("vp9.webm"), &options).unwrap_err();
        assert_eq!(error.kind(), odograph::error::ErrorKind::Usage);
    }
}

#![no_main]

use odograph::formats::trajectory_file;
use odograph_live::TrackRecord;
use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|text: &str| {
    let _ = trajectory_file::guess_format(text);
    if let Ok(trajectory) = trajectory_file::parse_tum(text) {
        trajectory_file::write_tum(&trajectory);
    }
    let _ = trajectory_file::parse_kitti(text, None);
    let _ = trajectory_file::parse_times(text);
    let _ = TrackRecord::from_csv(text);
});

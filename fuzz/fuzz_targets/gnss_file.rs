#![no_main]

use odograph::formats::gnss_file;
use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|text: &str| {
    if let Ok(fixes) = gnss_file::parse(text) {
        gnss_file::write(&fixes);
    }
    let _ = gnss_file::parse_utc(text);
});

#![no_main]

use odograph::formats::control_file;
use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|text: &str| {
    if let Ok(points) = control_file::parse(text) {
        let written = control_file::write(&points);
        let again = control_file::parse(&written).expect("what was written can be read");
        assert_eq!(again.len(), points.len());
    }
});

#![no_main]

use odograph::formats::rig_file;
use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|text: &str| {
    if let Ok(rig) = rig_file::parse(text) {
        rig_file::parse(&rig_file::write(&rig)).expect("a written rig can be read");
    }
    let _ = rig_file::parse_measured(text);
    let _ = rig_file::parse_antenna(text);
});

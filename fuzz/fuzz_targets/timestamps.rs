#![no_main]

use odograph_video::SourceOptions;
use std::sync::LazyLock;

/// A recording of two frames of two by two pixels.
const RECORDING: &[u8] = b"YUV4MPEG2 W2 H2 F25:1 Cmono\nFRAME\n1234FRAME\n5678";

libfuzzer_sys::fuzz_target!(|text: &str| {
    static OPTIONS: LazyLock<SourceOptions> = LazyLock::new(|| {
        let timestamps = Some(odograph_fuzz::scratch("times.txt"));
        SourceOptions { timestamps, ..SourceOptions::default() }
    });
    if let Some(path) = &OPTIONS.timestamps {
        std::fs::write(path, text).expect("the file in memory can be written");
    }
    odograph_fuzz::decode_with("clip.y4m", RECORDING, &OPTIONS);
});

#![no_main]

use odograph::formats::camera_file::{parse, parse_uncertainty, write};
use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|text: &str| {
    if let Ok(camera) = parse(text, Some((640, 480))) {
        parse(&write(&camera), None).expect("a written camera can be read");
    }
    let _ = parse_uncertainty(text);
});

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| odograph_video::read_parameter_sets(bytes));

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| odograph_fuzz::decode("y4m", bytes));

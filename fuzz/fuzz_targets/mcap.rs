#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    odograph_fuzz::decode("mcap", bytes);
    odograph_fuzz::read_topics("mcap", bytes);
});

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    odograph_fuzz::decode("rosbag1", bytes);
    odograph_fuzz::read_topics("rosbag1", bytes);
});

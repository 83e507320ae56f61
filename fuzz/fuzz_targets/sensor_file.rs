#![no_main]

use odograph::filter::fusion::SensorKind;
use odograph::formats::sensor_file;
use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|text: &str| {
    for sensor in [SensorKind::Gyro, SensorKind::Heading, SensorKind::Wheel, SensorKind::Range] {
        let _ = sensor_file::parse(text, sensor);
    }
});

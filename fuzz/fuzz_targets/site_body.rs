#![no_main]

use odograph_fuzz as _; // bounds the memory

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| odograph_site::read_body(bytes));

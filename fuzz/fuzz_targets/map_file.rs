#![no_main]

use std::sync::LazyLock;

static MAP: LazyLock<Vec<u8>> = LazyLock::new(odograph_fuzz::small_map);

libfuzzer_sys::fuzz_target!(|changes: &[u8]| {
    odograph_fuzz::use_map(&odograph_fuzz::changed_map(&MAP, changes));
});

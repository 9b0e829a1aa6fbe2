#![no_main]

use std::path::Path;

use acies_drivers::link::recording::Recording;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let path = Path::new("a.rec");
    if let Ok(recording) = Recording::decode(bytes, path) {
        // What was read is written and read again.
        assert!(Recording::decode(&recording.encode(), path).is_ok());
    }
});

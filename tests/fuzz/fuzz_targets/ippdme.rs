#![no_main]

use acies_drivers::ippdme::line::{Decoder, LINE_MAX, response};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut decoder = Decoder::default();
    for part in bytes.chunks(97) {
        decoder.take(part, |line| {
            let _ = line.and_then(response);
        });
        assert!(decoder.held_bytes() <= LINE_MAX + 2);
    }
    if let Ok(text) = std::str::from_utf8(bytes) {
        let _ = response(&format!("00001 # {text}"));
        let _ = response(&format!("00001 ! Error({text}"));
    }
});

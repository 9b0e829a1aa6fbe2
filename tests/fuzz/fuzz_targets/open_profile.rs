#![no_main]

use std::time::Instant;

use acies_drivers::open_profile::{Decoder, Message, PAYLOAD_MAX, message};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut decoder = Decoder::default();
    let mut each = |frame: Result<_, _>| {
        if let Ok(Ok(Message::Profile(profile))) = frame.as_ref().map(message) {
            for has_encoder in [false, true] {
                let _ = profile.capture(has_encoder, Instant::now());
            }
        }
    };
    for part in bytes.chunks(97) {
        decoder.take(part, &mut each);
        assert!(decoder.held_bytes() <= PAYLOAD_MAX + 1024);
    }
    decoder.stalled(&mut each);
    assert_eq!(decoder.held_bytes(), 0);
});

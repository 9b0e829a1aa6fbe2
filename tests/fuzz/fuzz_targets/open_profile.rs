#![no_main]

use std::time::Instant;

use acies_drivers::error::DecodeError;
use acies_drivers::open_profile::{Decoder, Frame, Message, PAYLOAD_MAX, message};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut decoder = Decoder::default();
    for part in bytes.chunks(97) {
        decoder.take(part, convert);
        assert!(decoder.held_bytes() <= PAYLOAD_MAX + 1024);
    }
    decoder.stalled(convert);
    assert_eq!(decoder.held_bytes(), 0);
    // Chance does not pass a CRC: the messages are tried without it too.
    if let [kind, payload @ ..] = bytes {
        let payload = &payload[..payload.len().min(PAYLOAD_MAX)];
        convert(Ok(Frame {
            kind: *kind,
            id: 1,
            payload,
        }));
    }
});

/// Whatever comes out of the decoder is read and made a capture.
fn convert(frame: Result<Frame<'_>, DecodeError>) {
    if let Ok(Ok(Message::Profile(profile))) = frame.as_ref().map(message) {
        for has_encoder in [false, true] {
            let _ = profile.capture(has_encoder, Instant::now());
        }
    }
}

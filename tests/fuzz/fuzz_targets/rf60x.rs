#![no_main]

use std::time::{Duration, Instant};

use acies_drivers::point::Layout;
use acies_drivers::rf60x::{ANSWER_MAX, Decoder, Stream};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let [length, stream @ ..] = bytes else {
        return;
    };
    let mut decoder = Decoder::default();
    decoder.expect(usize::from(*length));
    let mut run = Stream::new(50.0, length % 2 == 0, Duration::from_millis(5), Layout::SINGLE);
    let mut at = Instant::now();
    for part in stream.chunks(5) {
        // Any pace: bytes that wait, and silence of a second.
        at += Duration::from_millis(4 * u64::from(part[0]));
        decoder.take(part, |answer, skipped| run.take(&answer, skipped, at));
        assert!(decoder.held_bytes() < ANSWER_MAX);
        while run.pop().is_some() {}
    }
    let losses = run.losses(decoder.skipped_bytes());
    assert!(losses.received <= stream.len() as u64 / 2);
    assert!(losses.skipped_bytes <= stream.len() as u64);
});

#![no_main]

use std::time::Instant;

use acies_drivers::optoncdt::{Decoder, Stream, TEXT_MAX};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut decoder = Decoder::default();
    for part in bytes.chunks(7) {
        decoder.take(part, |_| {});
        assert!(decoder.held_bytes() < TEXT_MAX);
    }
    // The first bytes choose the values of a measurement and the columns of a profile.
    let [values, columns, stream @ ..] = bytes else {
        return;
    };
    let outputs = match values % 3 {
        0 => "['distance']",
        1 => "['distance', 'counter']",
        _ => "['distance', 'counter', 'time-low', 'time-high', 'intensity']",
    };
    let table = format!(
        "address = 'a:1'\nrate_hz = 4000\noutputs = {outputs}\npitch_mm = 1\ncolumns = {}",
        columns / 32 + 1
    );
    let table = table.parse().expect("TOML");
    let mut run = Stream::new(table, 50.0).expect("a configuration");
    let now = Instant::now();
    let mut profiles = 0;
    for part in stream.chunks(11) {
        run.take(part, now);
        while run.pop().is_some() {
            profiles += 1;
        }
    }
    run.finish();
    assert!(profiles <= stream.len() / 3);
    assert!(run.losses().received <= stream.len() as u64 / 3);
});

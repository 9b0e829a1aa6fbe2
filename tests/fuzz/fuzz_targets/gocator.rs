#![no_main]

use acies_drivers::gocator::message::{Content, Decoder, MESSAGE_MAX, indicators, message, reply, sensor_info};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut decoder = Decoder::default();
    for part in bytes.chunks(97) {
        if decoder.take(part, read).is_err() {
            break;
        }
        assert!(decoder.held_bytes() <= MESSAGE_MAX + 97);
    }
    read(bytes);
    if let Ok(Some((reply, _))) = reply(bytes) {
        let _ = sensor_info(reply.payload);
    }
});

/// Whatever comes out of the decoder is read and made points.
fn read(bytes: &[u8]) {
    let Ok(message) = message(bytes) else { return };
    match message.content {
        Content::Profiles(profiles) => {
            assert!(profiles.count * profiles.width <= bytes.len());
            for index in 0..profiles.count {
                let (x, z) = profiles.points_mm(index);
                assert!(x.len() == z.len() && x.iter().all(|x| x.is_finite()));
            }
        }
        Content::Intensities(rows) => (0..rows.count).for_each(|index| assert!(rows.row(index).len() <= bytes.len())),
        Content::Stamps(stamps) => assert!(stamps.iter().count() <= bytes.len()),
        Content::Health(rows) => assert!(indicators(rows).count() <= bytes.len()),
        Content::Other(_) => {}
    }
}

#![no_main]

use acies_drivers::error::DecodeError;
use acies_drivers::link::usb::interfaces;
use acies_drivers::u3v_profiler::block::{Geometry, Order, chunks, leader, lines, pixel, points_mm, trailer};
use acies_drivers::u3v_profiler::gencp::ack;
use acies_drivers::u3v_profiler::genicam::{Features, Memory, Register};
use libfuzzer_sys::fuzz_target;

struct Zeros;

impl Memory for Zeros {
    type Error = DecodeError;
    fn integer(&mut self, _: &Register) -> Result<i64, DecodeError> {
        Ok(1)
    }
}

fuzz_target!(|bytes: &[u8]| {
    let _ = ack(bytes);
    let _ = trailer(bytes);
    assert!(interfaces(bytes).len() <= bytes.len());
    for order in [Order::Little, Order::Big] {
        if let Ok(found) = chunks(bytes, order) {
            assert_eq!(found.iter().map(|chunk| chunk.data.len() + 8).sum::<usize>(), bytes.len());
        }
    }
    if let Ok(leader) = leader(bytes)
        && let Ok(pixel) = pixel(leader.pixel_format)
        && let Ok(found) = lines(bytes, &leader, leader.height, pixel)
    {
        let geometry = Geometry { a_scale: 0.1, a_offset: 0.0, c_scale: 0.1, c_offset: 0.0, invalid: Some(0.0) };
        for line in found.take(100) {
            assert!(points_mm(line, pixel, &geometry, leader.x_offset).0.iter().all(|x| x.is_finite()));
        }
    }
    if let Ok(features) = Features::read(bytes) {
        for name in ["PixelFormat", "Scan3dCoordinateScale", "ChunkEncoderValue", "A"] {
            let _ = features.place(name, &mut Zeros);
        }
    }
});

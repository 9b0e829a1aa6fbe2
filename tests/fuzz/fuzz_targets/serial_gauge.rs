#![no_main]

use acies_drivers::serial_gauge::{Assembler, Dialect, LINE_MAX, line};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let dialects = [
        Dialect::HeidenhainNd,
        Dialect::Mitutoyo,
        Dialect::SylvacOptoRs,
        Dialect::KeyenceDlRs1a,
    ];
    let mut assembler = Assembler::default();
    for part in bytes.chunks(5) {
        assembler.take(part, |text| {
            for dialect in dialects {
                if let Ok(text) = &text {
                    let _ = line(dialect, text);
                }
            }
        });
        assert!(assembler.held_bytes() <= LINE_MAX);
    }
    if let Ok(text) = std::str::from_utf8(bytes) {
        for dialect in dialects {
            let _ = line(dialect, text);
        }
    }
});

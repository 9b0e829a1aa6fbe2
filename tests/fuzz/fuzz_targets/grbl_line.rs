#![no_main]

use acies_drivers::grbl_probe::{Assembler, line};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut assembler = Assembler::default();
    for part in bytes.chunks(5) {
        assembler.take(part, |_| {});
        assert!(assembler.held_bytes() <= 1024);
    }
    if let Ok(text) = std::str::from_utf8(bytes) {
        let _ = line(text);
    }
});

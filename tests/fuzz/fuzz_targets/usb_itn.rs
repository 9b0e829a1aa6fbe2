#![no_main]

use acies_drivers::usb_itn::reading;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(reading) = reading(bytes) {
        assert!(reading.value.is_finite());
    }
});

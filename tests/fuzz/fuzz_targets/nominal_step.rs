#![no_main]

use acies::nominal::Nominal;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(nominal) = Nominal::parse(bytes, "part.step") {
        assert!(!nominal.area_mm2().is_nan());
    }
});

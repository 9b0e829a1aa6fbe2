#![no_main]

use acies_drivers::ur_rtde::message::{Bad, HEADER, Package, package};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut rest = bytes;
    loop {
        let used = match package(rest) {
            Ok(Some((Package::Data(data), used))) => {
                assert!(!data.is_sound() || data.position_m.iter().all(|m| m.abs() < 100.0));
                used
            }
            Ok(Some((_, used))) | Err(Bad::Package(_, used)) => used,
            Ok(None) | Err(Bad::Framing(_)) => break,
        };
        assert!((HEADER..=rest.len()).contains(&used));
        rest = &rest[used..];
    }
});

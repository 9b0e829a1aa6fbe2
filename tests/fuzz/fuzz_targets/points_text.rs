#![no_main]

use std::path::Path;

use acies::points::{Unit, parse};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    for name in ["scan.xyz", "scan.pts", "scan.obj"] {
        if let Ok(read) = parse(Path::new(name), bytes, Unit::Micrometre) {
            assert!(read.cloud.positions.iter().all(|p| p.is_finite()));
        }
    }
});

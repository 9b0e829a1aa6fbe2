#![no_main]

use std::path::Path;

use acies::points::{Unit, parse};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(read) = parse(Path::new("scan.ply"), bytes, Unit::Inch) {
        assert!(read.cloud.positions.iter().all(|p| p.is_finite()));
        assert!(read.cloud.check_lattice().is_ok());
    }
});

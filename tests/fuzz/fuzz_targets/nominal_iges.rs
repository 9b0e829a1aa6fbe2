#![no_main]

use acies::nominal::Nominal;
use libfuzzer_sys::fuzz_target;

// The letter in column 73 of the first line makes it an IGES file.
fuzz_target!(|bytes: &[u8]| {
    let mut file = format!("{:<72}S      1\n", "fuzz").into_bytes();
    file.extend_from_slice(bytes);
    if let Ok(nominal) = Nominal::parse(&file, "part.igs") {
        assert!(!nominal.area_mm2().is_nan());
    }
});

#![no_main]

use std::path::Path;

use acies::store::ScanReader;
use crc::{CRC_32_ISCSI, Crc};
use libfuzzer_sys::fuzz_target;

/// Two views, so that what follows has something to belong to; a robot carries them where the last brace is left open for it.
const VIEW: &str = r#"{"device":"a","vendor":"","model":"","serial":"","firmware":"","rotation":[0,0,0,1],
"translation_mm":[0,0,0],"travel_mm_per_count":[0,0.01,0]"#;
const CARRIED: &str = r#","carried":true,"carrier":{"rotation":[0,0,0,1],"translation_mm":[1,2,3],"lag_s":0.001}"#;

/// Chunks with the right checksum, packed where they are to be: nothing else would get past the first look.
fn framed(bytes: &[u8]) -> Vec<u8> {
    let mut file = b"ACIESRAW\x01".to_vec();
    let mut chunk = |kind: u8, payload: &[u8]| {
        file.push(kind);
        file.extend((payload.len() as u32).to_le_bytes());
        file.extend(Crc::<u32>::new(&CRC_32_ISCSI).checksum(payload).to_le_bytes());
        file.extend(payload);
    };
    let carried = if bytes.first().is_some_and(|byte| byte & 1 == 1) { CARRIED } else { "" };
    for _ in 0..2 {
        chunk(0, format!("{VIEW}{carried}}}").as_bytes());
    }
    let mut rest = bytes.get(1..).unwrap_or_default();
    while let Some((&[kind, low, high], behind)) = rest.split_first_chunk() {
        let length = usize::from(u16::from_le_bytes([low, high])).min(behind.len());
        let (payload, next) = behind.split_at(length);
        match kind % 6 {
            kind @ (1 | 3 | 4) => {
                let packed = zstd::encode_all(payload, 1).expect("memory is read and written");
                chunk(kind, &packed);
            }
            kind => chunk(kind, payload),
        }
        rest = next;
    }
    file
}

fuzz_target!(|bytes: &[u8]| {
    let read = |bytes: &[u8]| {
        if let Ok(reader) = ScanReader::read(bytes, Path::new("1.raw")) {
            // Damaged or not: it ends, and no point is more than its profile has columns.
            if let Ok(cloud) = reader.into_cloud() {
                assert_eq!(cloud.positions.len(), cloud.origins.len());
            }
        }
    };
    read(bytes);
    read(&framed(bytes));
});

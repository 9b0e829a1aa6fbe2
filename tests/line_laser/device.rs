//! A profiler that is a recording: what it would have sent, encoded from `drivers/open-profile.md` alone, played to the driver.

use std::path::Path;
use std::time::Duration;

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Profiler};
use acies_drivers::link::recording::{Kind, Record, Recording};
use acies_drivers::link::replay::{Match, Replay};
use glam::DVec2;

/// Counts of 10 nm: a tenth of a percent of the noise of the best profilers.
pub const COUNT_MM: f64 = 10e-6;

const Z_OFFSET_MM: f64 = 100.0;
const RUN: u32 = 1;
const BOOT: u32 = 0x1234_5678;
/// The longest that the protocol knows, so that no KEEPALIVE falls due while one profile is taken.
const KEEPALIVE_MS: u32 = 10_000;

/// An open profiler of the driver `open-profile`, which will deliver one profile: a point or nothing for each column,
/// x and z in the plane of the sensor, mm.
pub fn profiler(columns: &[Option<DVec2>]) -> Box<dyn Profiler> {
    let file = recording(columns).encode();
    let recording = Recording::decode(&file, Path::new("one-profile.aciesrec")).unwrap();
    assert_eq!(recording.torn_at, None);
    let driver = ALL.iter().find(|d| d.name == "open-profile").unwrap();
    let table = format!(
        "address = 'replayed:7450'\nserial_number = 'L-7'\nkeepalive_s = {}",
        KEEPALIVE_MS / 1000
    );
    let setup = (driver.configure)(table.parse().unwrap()).unwrap();
    match setup.open(&Replay::new(recording, Match::Exact)) {
        Ok(Instrument::Profiler(profiler)) => profiler,
        Ok(_) => panic!("no profiler"),
        Err(error) => panic!("{error}"),
    }
}

/// What passes over the link when a run of one profile is taken: STOP, HELLO, START, STOP and what the device says to each.
fn recording(columns: &[Option<DVec2>]) -> Recording {
    let start = [RUN, 0, KEEPALIVE_MS].map(u32::to_le_bytes).concat();
    let started = [&[0; 2][..], &RUN.to_le_bytes(), &BOOT.to_le_bytes()].concat();
    let passed = [
        (Kind::ToDevice, frame(0x05, 1, &[])),
        (Kind::FromDevice, frame(0x85, 1, &stopped(0, 0))),
        (Kind::ToDevice, frame(0x01, 2, &[])),
        (Kind::FromDevice, frame(0x81, 2, &identity(columns.len()))),
        (Kind::ToDevice, frame(0x04, 3, &start)),
        (Kind::FromDevice, frame(0x84, 3, &started)),
        (Kind::FromDevice, frame(0x90, 0, &profile(columns))),
        (Kind::ToDevice, frame(0x05, 4, &[])),
        (Kind::FromDevice, frame(0x85, 4, &stopped(RUN, 1))),
    ];
    let record = |(i, (kind, bytes))| Record {
        kind,
        channel: 0,
        time: Duration::from_millis(i),
        bytes,
    };
    Recording {
        target: "a profile kept as text".into(),
        records: (0..).zip(passed).map(record).collect(),
        torn_at: None,
    }
}

/// One frame, section 2 of the document.
pub fn frame(kind: u8, id: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0xA5, 0x5A, 1, kind];
    bytes.extend(id.to_le_bytes());
    bytes.extend((payload.len() as u32).to_le_bytes());
    let check = crc_32c(&bytes);
    bytes.extend(check.to_le_bytes());
    bytes.extend(payload);
    let check = crc_32c(&bytes);
    bytes.extend(check.to_le_bytes());
    bytes
}

/// Castagnoli's CRC bit by bit, section 2: slow, and nothing in common with the driver's tables.
pub fn crc_32c(bytes: &[u8]) -> u32 {
    // 1EDC6F41 from the last bit to the first.
    const POLYNOMIAL: u32 = 0x1EDC_6F41_u32.reverse_bits();
    let mut remainder = u32::MAX;
    for byte in bytes {
        remainder ^= u32::from(*byte);
        for _ in 0..8 {
            let carry = remainder & 1;
            remainder = (remainder >> 1) ^ (carry * POLYNOMIAL);
        }
    }
    !remainder
}

/// STOPPED, asked for, section 3.
fn stopped(run: u32, sent: u32) -> Vec<u8> {
    let reason = [0; 2];
    let dropped = [0; 4];
    [
        &reason[..],
        &run.to_le_bytes(),
        &sent.to_le_bytes(),
        &dropped,
    ]
    .concat()
}

/// IDENTITY, section 4.
fn identity(columns: usize) -> Vec<u8> {
    const ENCODER_EXPLICIT_X_LASER_SWITCH: u32 = 0b1_0101;
    let [rate_mhz, near_um, far_um, width_um] = [10_000, 50_000, 250_000, 165_000];
    let mut bytes = [
        BOOT,
        columns as u32,
        rate_mhz,
        ENCODER_EXPLICIT_X_LASER_SWITCH,
        near_um,
        far_um,
        width_um,
        0,
    ]
    .map(u32::to_le_bytes)
    .concat();
    for text in ["home-built", "line laser", "L-7", "1"] {
        bytes.push(text.len() as u8);
        bytes.extend(text.as_bytes());
    }
    bytes
}

/// PROFILE with x and samples of 32 bits, at encoder count 0, section 6.
fn profile(columns: &[Option<DVec2>]) -> Vec<u8> {
    const NM_PER_COUNT: u32 = 10;
    const LASER_ON: u16 = 1;
    const EXPLICIT_X_32_BITS: u16 = 0b101;
    let nothing = i32::MIN;
    let mut bytes = Vec::new();
    bytes.extend(60u16.to_le_bytes());
    bytes.extend((columns.len() as u16).to_le_bytes());
    bytes.extend(RUN.to_le_bytes());
    bytes.extend(BOOT.to_le_bytes());
    bytes.extend(2_500_000u64.to_le_bytes());
    bytes.extend(0i64.to_le_bytes());
    bytes.extend(0u32.to_le_bytes());
    bytes.extend(LASER_ON.to_le_bytes());
    bytes.extend(EXPLICIT_X_32_BITS.to_le_bytes());
    bytes.extend(NM_PER_COUNT.to_le_bytes());
    bytes.extend(0i64.to_le_bytes());
    bytes.extend(NM_PER_COUNT.to_le_bytes());
    bytes.extend(((Z_OFFSET_MM * 1e6) as i64).to_le_bytes());
    assert_eq!(bytes.len(), 60);
    let count = |mm: f64| (mm / COUNT_MM).round() as i32;
    let z = |c: &Option<DVec2>| c.map_or(nothing, |p| count(p.y - Z_OFFSET_MM));
    let x = |c: &Option<DVec2>| c.map_or(0, |p| count(p.x));
    bytes.extend(columns.iter().flat_map(|c| z(c).to_le_bytes()));
    bytes.extend(columns.iter().flat_map(|c| x(c).to_le_bytes()));
    assert!(bytes.len() <= 65_536, "the protocol's longest payload");
    bytes
}

/// The frame `name` of the document's section 8.
fn example(name: &str) -> Vec<u8> {
    let document = Path::new(env!("CARGO_MANIFEST_DIR")).join("drivers/open-profile.md");
    let text = std::fs::read_to_string(document).unwrap();
    let (_, after) = text.split_once(&format!("- `{name}`:")).unwrap();
    let hex = after.split('`').nth(1).unwrap();
    hex.split(' ')
        .map(|byte| u8::from_str_radix(byte, 16).unwrap())
        .collect()
}

#[test]
fn frames_are_those_of_the_document() {
    assert_eq!(crc_32c(b"123456789"), 0xE306_9283);
    for (name, kind, id) in [
        ("hello", 0x01, 1),
        ("identity", 0x81, 1),
        ("profile-explicit", 0x90, 1),
        ("stop", 0x05, 6),
        ("stopped", 0x85, 6),
    ] {
        let bytes = example(name);
        let payload = &bytes[16..bytes.len() - 4];
        assert_eq!(frame(kind, id, payload), bytes, "{name}");
    }
}

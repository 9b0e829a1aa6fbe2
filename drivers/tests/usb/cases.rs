//! What every USB driver must do, whichever way leads to its device.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::capture::Profile;
use acies_drivers::device::{Instrument, Presence, Profiler, Setup};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use acies_drivers::link::recording::{Recorder, Recording};
use acies_drivers::link::replay::{Match, Replay};
use acies_simulators::demo_cell::DemoCell;
use acies_simulators::sensor::View;
use acies_simulators::u3v::{self, Misdeeds, Surface};
use acies_simulators::usb_itn::{self, Form, InputTool};

use crate::hesitant::Hesitant;
use crate::rig::{Device, Rig, SOON};

/// One case: the devices it is run with, one after the other.
pub struct Case {
    pub name: &'static str,
    pub devices: fn() -> Vec<Device>,
    pub run: fn(&dyn Rig, usize),
}

pub const CASES: &[Case] = &[
    Case {
        name: "every_line_is_the_scene",
        devices: scenes,
        run: every_line_is_the_scene,
    },
    Case {
        name: "losses_are_exact",
        devices: lossy,
        run: losses_are_exact,
    },
    Case {
        name: "a_stall_costs_no_block",
        devices: stalling,
        run: a_stall_costs_no_block,
    },
    Case {
        name: "slow_control_is_waited_for",
        devices: slow_control,
        run: slow_control_is_waited_for,
    },
    Case {
        name: "what_is_wrong_is_told",
        devices: wrong,
        run: what_is_wrong_is_told,
    },
    Case {
        name: "other_devices_are_refused",
        devices: sound,
        run: other_devices_are_refused,
    },
    Case {
        name: "unplugged_in_a_scan_and_back",
        devices: sound,
        run: unplugged_in_a_scan_and_back,
    },
    Case {
        name: "unplugged_while_it_is_opened",
        devices: examples,
        run: unplugged_while_it_is_opened,
    },
    Case {
        name: "the_laser_goes_off",
        devices: sound,
        run: the_laser_goes_off,
    },
    Case {
        name: "blocks_of_several_lines",
        devices: several_lines,
        run: blocks_of_several_lines,
    },
    Case {
        name: "features_that_cannot_be_set",
        devices: sound,
        run: features_that_cannot_be_set,
    },
    Case {
        name: "the_example_cells_open",
        devices: examples,
        run: the_example_cells_open,
    },
    Case {
        name: "itn_reads_a_gauge",
        devices: gauges,
        run: itn_reads_a_gauge,
    },
    Case {
        name: "a_recording_plays_back_the_same",
        devices: recorded,
        run: a_recording_plays_back_the_same,
    },
    Case {
        name: "itn_losses_are_exact",
        devices: bad_gauges,
        run: itn_losses_are_exact,
    },
    Case {
        name: "counters_and_clocks_come_whole",
        devices: short_counters,
        run: counters_and_clocks_come_whole,
    },
    Case {
        name: "a_system_short_of_memory_gets_fewer_transfers",
        devices: large_blocks,
        run: a_system_short_of_memory_gets_fewer_transfers,
    },
    Case {
        name: "a_host_that_hesitates_loses_nothing_with_transfers_in_flight",
        devices: not_waiting,
        run: a_host_that_hesitates_loses_nothing_with_transfers_in_flight,
    },
    Case {
        name: "an_idle_device_is_asked",
        devices: examples,
        run: an_idle_device_is_asked,
    },
    Case {
        name: "itn_another_tool_is_not_taken_for_it",
        devices: one_gauge,
        run: itn_another_tool_is_not_taken_for_it,
    },
    Case {
        name: "itn_silence_is_told",
        devices: silent_gauge,
        run: itn_silence_is_told,
    },
    Case {
        name: "itn_refusal_and_unplugging",
        devices: stubborn_gauge,
        run: itn_refusal_and_unplugging,
    },
];

const SERIAL: &str = "SN-0042";

fn wave(misdeeds: Misdeeds) -> Device {
    Device::U3v(Box::new(u3v::Setup {
        misdeeds,
        ..u3v::Setup::new(SERIAL, Surface::Wave(320))
    }))
}

fn sound() -> Vec<Device> {
    vec![wave(Misdeeds::default())]
}

fn setup(driver: &str, table: &str) -> Box<dyn Setup> {
    let driver = ALL
        .iter()
        .find(|known| known.name == driver)
        .expect("a driver");
    let table = toml::from_str(table).expect("the test's TOML");
    (driver.configure)(table).unwrap_or_else(|mistakes| panic!("{mistakes:?}"))
}

fn text(error: &DeviceError) -> String {
    let mut text = error.to_string();
    let mut inner = std::error::Error::source(error);
    while let Some(source) = inner {
        text = format!("{text}: {source}");
        inner = source.source();
    }
    text
}

fn open_with(rig: &dyn Rig, driver: &str, table: &str) -> Result<Box<dyn Profiler>, DeviceError> {
    open_over(rig.links(), driver, table)
}

fn open_over(
    links: &dyn Links,
    driver: &str,
    table: &str,
) -> Result<Box<dyn Profiler>, DeviceError> {
    match setup(driver, table).open(links)? {
        Instrument::Profiler(profiler) => Ok(profiler),
        _ => panic!("no profiler"),
    }
}

fn open(rig: &dyn Rig, more: &str) -> Box<dyn Profiler> {
    let table = format!("usb_serial = '{SERIAL}'\nfirst_block = 0\n{more}");
    open_with(rig, "u3v-profiler", &table).unwrap_or_else(|error| panic!("{}", text(&error)))
}

fn scan(profiler: &mut dyn Profiler, n: usize) -> Result<Vec<Profile>, DeviceError> {
    profiler.start()?;
    let mut profiles = Vec::new();
    while profiles.len() < n {
        let profile = profiler.next(Instant::now() + SOON)?;
        profiles.push(profile.expect("a profile in time"));
    }
    profiles.extend(profiler.stop()?);
    Ok(profiles)
}

// ---- USB3 Vision ------------------------------------------------------------------------------------------------------

fn view() -> View {
    DemoCell::new(5).sensors[0].view.clone()
}

fn scenes() -> Vec<Device> {
    [
        (false, false, false),
        (true, false, true),
        (false, true, false),
    ]
    .map(|(zipped, big_chunks, leader_50)| {
        Device::U3v(Box::new(u3v::Setup {
            zipped,
            big_chunks,
            blocks: 60,
            misdeeds: Misdeeds {
                leader_50,
                ..Misdeeds::default()
            },
            ..u3v::Setup::new(SERIAL, Surface::View(Box::new(view())))
        }))
    })
    .to_vec()
}

fn every_line_is_the_scene(rig: &dyn Rig, variant: usize) {
    let order = if variant == 2 { "big" } else { "little" };
    let view = view();
    for format in ["Coord3D_ABC32f", "Coord3D_C16"] {
        let features = format!("features = [['PixelFormat', '{format}'], ['ExposureTime', 250.5]]");
        let mut profiler = open(
            rig,
            &format!("{features}\nchunk_order = '{order}'\nserial_number = '{SERIAL}'"),
        );
        let identity = profiler.identity().clone();
        assert_eq!(
            (identity.vendor.as_str(), identity.serial.as_str()),
            ("Simulated Metrology", SERIAL)
        );
        let profiles = scan(profiler.as_mut(), 60).expect("a scan");
        assert_eq!(profiles.len(), 60);
        let mut seen = 0;
        for (index, profile) in profiles.iter().enumerate() {
            let truth = view.line(index as u32);
            assert_eq!(profile.sequence, index as u32);
            assert_eq!(profile.encoder, Some(truth.encoder));
            assert_eq!(
                profile.device_time_ns,
                1_000_000_007 + 200_000 * index as u64
            );
            assert_eq!(profile.x_mm.len(), truth.x_mm.len());
            for (i, (x, z)) in profile.x_mm.iter().zip(&profile.z_mm).enumerate() {
                assert!(x.is_finite());
                if format == "Coord3D_ABC32f" {
                    // A float of 250 mm has a last place of 15 nm.
                    assert!((x - truth.x_mm[i]).abs() < 2e-5, "{x} {}", truth.x_mm[i]);
                    assert!(
                        z.is_nan() == truth.z_mm[i].is_nan()
                            && (z.is_nan() || (z - truth.z_mm[i]).abs() < 2e-5)
                    );
                } else if !z.is_nan() {
                    seen += 1;
                    let on_line =
                        truth
                            .x_mm
                            .windows(2)
                            .zip(truth.z_mm.windows(2))
                            .any(|(xs, zs)| {
                                // Half a count of 2 um.
                                let between = |v: f64, pair: &[f64], e: f64| {
                                    v >= pair[0].min(pair[1]) - e && v <= pair[0].max(pair[1]) + e
                                };
                                between(*x, xs, 1e-9) && between(*z, zs, 0.001_001)
                            });
                    assert!(on_line, "line {index}: {x} {z}");
                }
            }
        }
        assert!(format == "Coord3D_ABC32f" || seen > 500, "{seen} points");
        assert_eq!(rig.number("laser"), 0);
    }
}

fn lossy() -> Vec<Device> {
    let one = |change: fn(&mut Misdeeds)| {
        let mut misdeeds = Misdeeds::default();
        change(&mut misdeeds);
        wave(misdeeds)
    };
    vec![
        one(|_| ()),
        one(|m| m.gap = 0.1),
        one(|m| m.short = 0.1),
        one(|m| m.no_leader = 0.1),
        one(|m| m.no_trailer = 0.1),
        one(|m| m.discarded = 0.1),
        one(|m| m.zero_packets = 0.5),
        wave(Misdeeds {
            gap: 0.05,
            short: 0.05,
            no_leader: 0.05,
            no_trailer: 0.05,
            discarded: 0.05,
            zero_packets: 0.1,
            ..Misdeeds::default()
        }),
    ]
}

fn losses_are_exact(rig: &dyn Rig, _: usize) {
    let mut profiler = open(rig, "");
    let profiles = scan(profiler.as_mut(), 500).expect("a scan");
    let truth = rig.truth();
    let sent: BTreeSet<u64> = truth["sent"]
        .split(',')
        .map(|n| n.parse().expect("a number"))
        .collect();
    let received: Vec<u64> = profiles.iter().map(|p| p.sequence.into()).collect();
    assert!(received.is_sorted_by(|a, b| a < b), "in order, none twice");
    assert_eq!(received.iter().copied().collect::<BTreeSet<_>>(), sent);
    let losses = profiler.losses();
    assert_eq!(losses.received, received.len() as u64);
    let taken: u64 = truth["taken"].parse().expect("a number");
    let accounted = losses.received + losses.lost_on_link + losses.dropped_by_device;
    let last = received.last().copied().expect("a profile");
    // Of blocks behind the last sound one, those that were lost without a trace have no successor that tells.
    assert!(
        accounted > last && accounted <= taken,
        "{last} {accounted} {taken} {losses:?}"
    );
    let discarded: u64 = truth["discarded"].parse().expect("a number");
    assert_eq!(losses.dropped_by_device, discarded);
}

fn stalling() -> Vec<Device> {
    let at = |stall_at| {
        wave(Misdeeds {
            stall_at,
            ..Misdeeds::default()
        })
    };
    vec![
        at(Some(0)),
        at(Some(50)),
        wave(Misdeeds {
            stall_for_ever: true,
            ..Misdeeds::default()
        }),
    ]
}

fn a_stall_costs_no_block(rig: &dyn Rig, variant: usize) {
    let mut profiler = open(rig, "");
    if variant == 2 {
        let error = scan(profiler.as_mut(), 10).expect_err("a stall for ever");
        assert_eq!(
            text(&error),
            format!(
                "usb:{SERIAL}: cannot be used: the device refuses the transfer (stall); reopen it"
            )
        );
        return;
    }
    let profiles = scan(profiler.as_mut(), 200).expect("a scan");
    assert_eq!(profiler.losses().lost_on_link, 0);
    assert_eq!(profiles.len() as u64, rig.number("sent_count"));
}

fn slow_control() -> Vec<Device> {
    vec![
        wave(Misdeeds {
            pending_ms: Some(300),
            ..Misdeeds::default()
        }),
        wave(Misdeeds {
            stale_acks: true,
            ..Misdeeds::default()
        }),
        wave(Misdeeds {
            lose_acks: 2,
            ..Misdeeds::default()
        }),
    ]
}

fn slow_control_is_waited_for(rig: &dyn Rig, _: usize) {
    let mut profiler = open(rig, "");
    assert!(scan(profiler.as_mut(), 20).expect("a scan").len() >= 20);
}

fn wrong() -> Vec<Device> {
    vec![
        wave(Misdeeds {
            mute: true,
            ..Misdeeds::default()
        }),
        wave(Misdeeds {
            babble: true,
            ..Misdeeds::default()
        }),
        wave(Misdeeds {
            lying_file: Some(1 << 40),
            ..Misdeeds::default()
        }),
        wave(Misdeeds {
            lying_file: Some(1 << 20),
            ..Misdeeds::default()
        }),
        wave(Misdeeds {
            lying_file: Some(100),
            ..Misdeeds::default()
        }),
    ]
}

fn what_is_wrong_is_told(rig: &dyn Rig, variant: usize) {
    let error = open_with(rig, "u3v-profiler", "")
        .err()
        .expect("nothing that opens");
    let told = text(&error);
    let expected = [
        "usb:any: no answer within 1.5 s; check power and cable, then retry",
        "usb:any: 120 bytes came within 1.5 s, but no answer to ReadMem; check `driver` and `baud`",
        "usb:any: bad data from the device: size of the GenICam file of manifest is 1099511627776, allowed is 1 to 16777216 bytes",
        "usb:any: ReadMem is refused: invalid address (0x8003); check the configuration against the device's manual, then reopen it",
        "usb:any: bad data from the device: the line \"GenICam file: ",
    ][variant];
    match variant {
        0 | 1 => assert_eq!(told, expected),
        _ => assert!(told.starts_with(expected), "{told}"),
    }
}

fn other_devices_are_refused(rig: &dyn Rig, _: usize) {
    let told = |table: &str| {
        let error = open_with(rig, "u3v-profiler", table).err();
        text(&error.expect("nothing that opens"))
    };
    let absent = "cannot be used: nothing of this name is there; check cable, power and the name";
    assert_eq!(told("usb_serial = 'SN-1'"), format!("usb:SN-1: {absent}"));
    assert_eq!(
        told("usb_id = '1209:0004'"),
        format!("usb:1209:0004: {absent}")
    );
    assert_eq!(
        told("serial_number = 'ANOTHER'"),
        format!(
            "usb:any: answers as \"{SERIAL}\", the configuration expects \"ANOTHER\"; check which device is plugged in where"
        )
    );
    assert!(open_with(rig, "u3v-profiler", "usb_id = '1209:0003'").is_ok());
}

fn unplugged_in_a_scan_and_back(rig: &dyn Rig, _: usize) {
    let mut profiler = open(rig, "");
    profiler.start().expect("a start");
    assert!(
        profiler
            .next(Instant::now() + SOON)
            .expect("a link")
            .is_some()
    );
    rig.order("unplug");
    let unplugged = Instant::now();
    let error = loop {
        match profiler.next(Instant::now() + SOON) {
            Ok(profile) => assert!(profile.is_some(), "nobody noticed"),
            Err(error) => break error,
        }
    };
    assert!(unplugged.elapsed() < Duration::from_secs(10));
    assert!(error.may_pass());
    assert_eq!(
        text(&error),
        format!(
            "usb:{SERIAL}: cannot be used: it is gone: closed or unplugged; plug it in again and reopen"
        )
    );
    drop(profiler);
    let error = open_with(rig, "u3v-profiler", "")
        .err()
        .expect("nothing there");
    assert!(error.may_pass(), "{}", text(&error));
    rig.order("replug");
    let mut profiler = open(rig, "");
    let profiles = scan(profiler.as_mut(), 20).expect("a scan after plugging in again");
    assert_eq!(profiles[0].sequence, 0);
}

/// The cable is pulled after each number of transfers that opening takes; afterwards it opens all the same.
fn unplugged_while_it_is_opened(rig: &dyn Rig, variant: usize) {
    let driver = ["u3v-profiler", "usb-itn"][variant];
    let mut told = 0;
    for transfers in 0.. {
        let host = Hesitant::pulled_after(rig.links(), transfers);
        let Err(error) = open_over(&host, driver, "") else {
            break;
        };
        assert!(
            error.may_pass() && text(&error).ends_with("plug it in again and reopen"),
            "{transfers}: {}",
            text(&error)
        );
        told += 1;
    }
    assert!(told > 1, "{told}");
    let mut again = open_with(rig, driver, "").unwrap_or_else(|error| panic!("{}", text(&error)));
    assert!(scan(again.as_mut(), 2).is_ok());
}

fn the_laser_goes_off(rig: &dyn Rig, _: usize) {
    let mut profiler = open(rig, "");
    profiler.start().expect("a start");
    assert_eq!(rig.number("laser"), 1);
    profiler.stop().expect("a stop");
    assert_eq!(rig.number("laser"), 0, "after stop");
    profiler.start().expect("a start");
    drop(profiler);
    assert_eq!(rig.number("laser"), 0, "after drop");
    // A host that died left it on: the next one to open it switches it off.
    let mut profiler = open(rig, "");
    profiler.start().expect("a start");
    std::mem::forget(profiler);
    match open_with(rig, "u3v-profiler", "") {
        Ok(_again) => assert_eq!(rig.number("laser"), 0, "after reopening"),
        // A real kernel knows that the program that has it open lives: it is this one.
        Err(error) => assert!(
            text(&error).ends_with("another program has it open; close that program, then retry"),
            "{}",
            text(&error)
        ),
    }
}

fn several_lines() -> Vec<Device> {
    let device = |lines| {
        Device::U3v(Box::new(u3v::Setup {
            lines,
            blocks: 50,
            ..u3v::Setup::new(SERIAL, Surface::Wave(100))
        }))
    };
    vec![device(8), device(8)]
}

fn blocks_of_several_lines(rig: &dyn Rig, variant: usize) {
    let mut profiler = open(rig, ["encoder_step = 10", ""][variant]);
    let profiles = scan(profiler.as_mut(), 400).expect("a scan");
    assert_eq!(profiles.len(), 400);
    for (index, profile) in profiles.iter().enumerate() {
        assert_eq!(profile.sequence, index as u32);
        let known = variant == 0 || index % 8 == 0;
        assert_eq!(
            profile.encoder,
            known.then_some(10 * index as i64),
            "line {index}"
        );
    }
}

fn short_counters() -> Vec<Device> {
    // Forwards over the top of 32 bits, and with a stage that trembles below zero.
    [(u32::MAX - 999, 0), (0, 35), (u32::MAX - 999, 35)]
        .map(|(from, encoder_jitter)| {
            Device::U3v(Box::new(u3v::Setup {
                encoder_bytes: 4,
                encoder_from: from.into(),
                blocks: 300,
                misdeeds: Misdeeds {
                    encoder_jitter,
                    drift_ppm: 50,
                    ..Misdeeds::default()
                },
                ..u3v::Setup::new(SERIAL, Surface::Wave(100))
            }))
        })
        .to_vec()
}

/// An encoder of 32 bits that turns over makes no jump, and trembling and drift come as they are.
fn counters_and_clocks_come_whole(rig: &dyn Rig, variant: usize) {
    let mut profiler = open(rig, "");
    let profiles = scan(profiler.as_mut(), 300).expect("a scan");
    assert_eq!(profiles.len(), 300);
    let encoder = |profile: &Profile| profile.encoder.expect("an encoder");
    let first = encoder(&profiles[0]);
    let jitter = [0, 35, 35][variant];
    let mut beside = BTreeSet::new();
    for (index, profile) in (0_i64..).zip(&profiles) {
        let gone = encoder(profile) - first - 10 * index;
        assert!(gone.abs() <= 2 * jitter, "line {index}: {gone}");
        beside.insert(gone);
        // 50 ppm fast, and the chunk's 7 ns behind the block's.
        let since_ns = 200_000 * index as u64;
        let expected = 1_000_000_007 + since_ns + since_ns / 1_000_000 * 50;
        assert_eq!(profile.device_time_ns, expected);
    }
    assert_eq!(
        beside.len() as i64,
        2 * jitter + 1,
        "as it read, each number of the range"
    );
}

fn large_blocks() -> Vec<Device> {
    vec![Device::U3v(Box::new(u3v::Setup {
        lines: 400,
        blocks: 40,
        ..u3v::Setup::new(SERIAL, Surface::Wave(1000))
    }))]
}

/// The kernel bounds the bytes of all transfers: with room for one of 800 kB, not for two, everything comes all the same. With room for none
/// that is told.
fn a_system_short_of_memory_gets_fewer_transfers(rig: &dyn Rig, _: usize) {
    rig.order("memory 1200000");
    let mut profiler = open(rig, "encoder_step = 10");
    let profiles = scan(profiler.as_mut(), 400 * 40).expect("a scan");
    assert_eq!(profiles.len(), 400 * 40);
    assert_eq!(profiler.losses().lost_on_link, 0);
    drop(profiler);
    if rig.order("memory 100000") == "no system" {
        return;
    }
    // Opening reads 1 MiB at once, to drain what is left: refused as well.
    let told = open_with(rig, "u3v-profiler", "")
        .and_then(|mut profiler| scan(profiler.as_mut(), 10))
        .expect_err("no memory");
    assert!(
        text(&told).contains("failed: Insufficient memory"),
        "{}",
        text(&told)
    );
}

fn not_waiting() -> Vec<Device> {
    let device = Device::U3v(Box::new(u3v::Setup {
        triggered: true,
        room_blocks: Some(ROOM),
        ..u3v::Setup::new(SERIAL, Surface::Wave(320))
    }));
    vec![device.clone(), device]
}

/// Blocks that the device keeps, and those that it exposes while its host is busy elsewhere.
const ROOM: usize = 2;
const MEANWHILE: u64 = 8;

/// A device that does not wait: what it exposes while the host is busy goes into the transfers that are in flight, all of it. With one transfer at a
/// time there is none, and all is lost but what the device has room for. Either way each lost block is counted.
fn a_host_that_hesitates_loses_nothing_with_transfers_in_flight(rig: &dyn Rig, variant: usize) {
    const ROUNDS: u64 = 5;
    let single = variant == 1;
    let host = Hesitant::new(rig.links(), single);
    let table = format!("usb_serial = '{SERIAL}'\nfirst_block = 0");
    let mut profiler =
        open_over(&host, "u3v-profiler", &table).unwrap_or_else(|error| panic!("{}", text(&error)));
    profiler.start().expect("a start");
    let mut taken = Vec::new();
    let mut take = |sent: u64| {
        while (taken.len() as u64) < sent {
            let profile = profiler.next(Instant::now() + SOON).expect("a link");
            taken.push(profile.expect("a profile in time").sequence);
        }
    };
    // By the first one the stream is read.
    rig.order("trigger 1");
    take(rig.number("sent_count"));
    for _ in 0..ROUNDS {
        let busy = host.busy();
        rig.order(&format!("trigger {MEANWHILE}"));
        drop(busy);
        take(rig.number("sent_count"));
    }
    // One more, by which the gap before it shows.
    rig.order("trigger 1");
    take(rig.number("sent_count"));
    let lost = match single || !rig.overlaps() {
        true => ROUNDS * (MEANWHILE - ROOM as u64),
        false => 0,
    };
    let losses = profiler.losses();
    assert_eq!((losses.lost_on_link, rig.number("overrun")), (lost, lost));
    assert_eq!(losses.received + lost, rig.number("taken"));
    assert!(taken.is_sorted_by(|a, b| a < b));
}

fn an_idle_device_is_asked(rig: &dyn Rig, variant: usize) {
    let opened = |rig| match variant {
        0 => open(rig, ""),
        _ => open_gauge(rig, "").unwrap_or_else(|error| panic!("{}", text(&error))),
    };
    let mut profiler = opened(rig);
    assert_eq!(profiler.check().ok(), Some(Presence::Answered));
    scan(profiler.as_mut(), 3).expect("a scan");
    assert_eq!(profiler.check().ok(), Some(Presence::Answered));
    rig.order("unplug");
    let error = profiler.check().expect_err("nothing there");
    assert!(error.may_pass(), "{}", text(&error));
    drop(profiler);
    rig.order("replug");
    assert_eq!(opened(rig).check().ok(), Some(Presence::Answered));
}

fn features_that_cannot_be_set(rig: &dyn Rig, _: usize) {
    let told = |features: &str| {
        let error = open_with(rig, "u3v-profiler", &format!("features = [{features}]")).err();
        text(&error.expect("nothing that opens"))
    };
    assert_eq!(
        told("['PixelFormat', 'Mono8']"),
        "usb:any: setting PixelFormat is refused: it has no value Word(\"Mono8\"); look the values up in the device's manual and change `features`"
    );
    assert!(told("['Nothing', 1]").contains("GenICam feature Nothing: no such feature"));
    assert!(told("['Derived', 1]").contains("a IntSwissKnife without a value that is understood"));
}

// ---- USB-ITN ----------------------------------------------------------------------------------------------------------

fn gauge(change: impl FnOnce(&mut InputTool)) -> Device {
    let mut tool = InputTool::new("70412345", vec![-1234, 0, 5, 123_456]);
    change(&mut tool);
    Device::Itn(tool)
}

fn gauges() -> Vec<Device> {
    vec![gauge(|_| ()), gauge(|tool| tool.form = Form::Nibbles)]
}

fn open_gauge(rig: &dyn Rig, more: &str) -> Result<Box<dyn Profiler>, DeviceError> {
    open_with(rig, "usb-itn", &format!("interval_s = 0.02\n{more}"))
}

fn itn_reads_a_gauge(rig: &dyn Rig, _: usize) {
    let mut profiler =
        open_gauge(rig, "invert = true").unwrap_or_else(|error| panic!("{}", text(&error)));
    assert_eq!(rig.number("raw"), 1);
    let profiles = scan(profiler.as_mut(), 8).expect("readings");
    for (index, profile) in profiles.iter().enumerate() {
        let expected = [1.234, 0.0, -0.005, -123.456][index % 4];
        assert!(
            (profile.z_mm[0] - expected).abs() < 1e-9,
            "{index}: {:?}",
            profile.z_mm
        );
        assert_eq!(
            (profile.sequence, profile.x_mm.as_slice()),
            (index as u32, &[0.0][..])
        );
    }
    assert_eq!(profiler.losses().received, rig.number("asked"));
    // The button sends a value that nobody asked for: it is no reading of the run.
    rig.order("press");
    profiler.start().expect("a start");
    while profiler.losses().rejected == 0 && profiler.losses().received < 100 {
        profiler.next(Instant::now() + SOON).expect("a link");
    }
    assert!(profiler.losses().received + profiler.losses().rejected > 0);
}

fn recorded() -> Vec<Device> {
    vec![
        wave(Misdeeds {
            gap: 0.05,
            ..Misdeeds::default()
        }),
        gauge(|_| ()),
    ]
}

fn a_recording_plays_back_the_same(rig: &dyn Rig, which: usize) {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("usb-recorded");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let (setup, n) = match which {
        0 => {
            let table = format!("usb_serial = '{SERIAL}'\nfirst_block = 0");
            (setup("u3v-profiler", &table), 100)
        }
        _ => (setup("usb-itn", "interval_s = 0.02"), 8),
    };
    let taken = |links: &dyn Links| {
        let mut profiler = match setup.open(links) {
            Ok(Instrument::Profiler(profiler)) => profiler,
            Ok(_) => panic!("no profiler"),
            Err(error) => panic!("{}", text(&error)),
        };
        profiler.start().expect("a start");
        let mut profiles = Vec::new();
        while profiles.len() < n {
            let profile = profiler.next(Instant::now() + SOON);
            let profile = profile.unwrap_or_else(|error| panic!("{}", text(&error)));
            profiles.push(profile.expect("a profile in time"));
        }
        // What is under way at the stop differs from time to time.
        let _ = profiler.stop();
        let identity = profiler.identity().clone();
        let kept = profiles
            .into_iter()
            .map(|p| (p.sequence, p.device_time_ns, p.x_mm, p.z_mm));
        (identity, kept.collect::<Vec<_>>())
    };
    let note = "device 7 of the test".to_owned();
    let recorder = Recorder::of_device(rig.links(), &folder, 1 << 28, vec![note.clone()]);
    let live = taken(&recorder);
    let mut files = std::fs::read_dir(&folder).expect("the folder");
    let file = files.next().expect("a recording").expect("an entry").path();
    assert!(files.next().is_none(), "one file for all endpoints");
    let recording = Recording::read(&file).expect("a recording");
    assert_eq!((recording.notes(), recording.torn_at), (vec![note], None));
    assert_eq!(
        Recording::decode(&recording.encode(), &file).expect("again"),
        recording
    );
    let replayed = taken(&Replay::new(
        recording,
        Match::Loose(Duration::from_millis(20)),
    ));
    assert_eq!(live, replayed);
}

fn bad_gauges() -> Vec<Device> {
    let with = |misdeeds| gauge(|tool| tool.misdeeds = misdeeds);
    vec![
        with(usb_itn::Misdeeds {
            mute_every: Some(3),
            ..usb_itn::Misdeeds::default()
        }),
        with(usb_itn::Misdeeds {
            garble_every: Some(3),
            ..usb_itn::Misdeeds::default()
        }),
        with(usb_itn::Misdeeds {
            stall_at: Some(2),
            ..usb_itn::Misdeeds::default()
        }),
    ]
}

fn itn_losses_are_exact(rig: &dyn Rig, _: usize) {
    let mut profiler = open_gauge(rig, "").unwrap_or_else(|error| panic!("{}", text(&error)));
    scan(profiler.as_mut(), 4).expect("readings");
    let losses = profiler.losses();
    assert_eq!(losses.lost_on_link, 1, "{losses:?}");
    assert_eq!(losses.received + losses.lost_on_link, rig.number("asked"));
}

fn stubborn_gauge() -> Vec<Device> {
    vec![gauge(|tool| tool.misdeeds.refuse = true), gauge(|_| ())]
}

fn itn_refusal_and_unplugging(rig: &dyn Rig, variant: usize) {
    if variant == 0 {
        let error = open_gauge(rig, "usb_serial = '70412345'")
            .err()
            .expect("a refusal");
        assert_eq!(
            text(&error),
            "usb:70412345: cannot be used: the device refuses the transfer (stall); reopen it"
        );
        return;
    }
    let mut profiler = open_gauge(rig, "").unwrap_or_else(|error| panic!("{}", text(&error)));
    profiler.start().expect("a start");
    rig.order("unplug");
    let error = loop {
        match profiler.next(Instant::now() + SOON) {
            Ok(_) => {}
            Err(error) => break error,
        }
    };
    assert!(text(&error).ends_with("it is gone: closed or unplugged; plug it in again and reopen"));
    rig.order("replug");
    assert!(open_gauge(rig, "").is_ok());
}

fn one_gauge() -> Vec<Device> {
    vec![gauge(|_| ())]
}

fn itn_another_tool_is_not_taken_for_it(rig: &dyn Rig, _: usize) {
    let mut profiler = open_gauge(rig, "usb_serial = '70412345'")
        .unwrap_or_else(|error| panic!("{}", text(&error)));
    scan(profiler.as_mut(), 2).expect("readings");
    rig.order("unplug");
    assert!(scan(profiler.as_mut(), 2).is_err());
    drop(profiler);
    rig.order("another");
    rig.order("replug");
    let error = open_gauge(rig, "usb_serial = '70412345'").err();
    assert_eq!(
        text(&error.expect("not this one")),
        "usb:70412345: cannot be used: nothing of this name is there; check cable, power and the name"
    );
    assert!(open_gauge(rig, "usb_serial = 'ANOTHER'").is_ok());
}

fn silent_gauge() -> Vec<Device> {
    vec![gauge(|tool| tool.misdeeds.mute_every = Some(1))]
}

fn itn_silence_is_told(rig: &dyn Rig, _: usize) {
    let mut profiler = open_gauge(rig, "").unwrap_or_else(|error| panic!("{}", text(&error)));
    let error = scan(profiler.as_mut(), 1).expect_err("silence");
    assert_eq!(
        text(&error),
        "usb:0fe7:4001: no answer within 6 s; check power and cable, then retry"
    );
    let losses = profiler.losses();
    assert_eq!((losses.received, losses.lost_on_link), (0, 3));
    assert_eq!(rig.number("asked"), 3);
}

// ---- Examples ---------------------------------------------------------------------------------------------------------

fn examples() -> Vec<Device> {
    vec![wave(Misdeeds::default()), gauge(|_| ())]
}

/// The example cells under configs/: each opens its device.
fn the_example_cells_open(rig: &dyn Rig, variant: usize) {
    let driver = ["u3v-profiler", "usb-itn"][variant];
    // In the program itself: a virtual machine has no such files.
    let read = [
        include_str!("../../../configs/u3v-profiler/cell.toml"),
        include_str!("../../../configs/usb-itn/cell.toml"),
    ][variant];
    let cell: toml::Table = read.parse().expect("TOML");
    let devices = cell["device"].as_array().expect("devices");
    let device = devices
        .iter()
        .find(|device| device["driver"].as_str() == Some(driver));
    let mut table = device
        .and_then(|device| device.as_table())
        .expect("its device")
        .clone();
    table.retain(|key, _| !["name", "driver", "calibration"].contains(&key));
    let mut profiler = open_with(rig, driver, &table.to_string())
        .unwrap_or_else(|error| panic!("{}", text(&error)));
    assert!(scan(profiler.as_mut(), 3).expect("a scan").len() >= 3);
}

//! Every driver against its simulated device, over a real pseudo-terminal: one suite over the table of drivers, then the faults
//! of each kind, with every loss held to the simulator's own log.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::capture::Profile;
use acies_drivers::device::{Instrument, Probe, Profiler, Setup};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::{Recorder, Recording};
use acies_drivers::link::replay::{Match, Replay};
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::grbl::SimulatedProbe;
use acies_simulators::open_profile::{Fate, SimulatedProfiler};
use acies_simulators::wire::Wire;

#[path = "drivers/accounts.rs"]
mod accounts;
#[path = "drivers/bench.rs"]
mod bench;
#[path = "drivers/conformance.rs"]
mod conformance;

use bench::{Bench, SOON, benches, by_port, open, port, text, touch};

// ---- The table --------------------------------------------------------------------------------------------------------

/// Drivers without a serial line: `drivers/tests/network` and `drivers/tests/usb` hold them to their simulators.
const ELSEWHERE: [&str; 5] = ["gocator", "ippdme", "u3v-profiler", "usb-itn", "ur-rtde"];

#[test]
fn the_table_of_drivers_is_sound() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("drivers/src");
    let mut names = BTreeSet::new();
    for driver in ALL {
        assert!(names.insert(driver.name), "{} stands twice", driver.name);
        let file = source.join(format!("{}.rs", driver.name.replace('-', "_")));
        assert!(
            file.is_file(),
            "{} has no file {}",
            driver.name,
            file.display()
        );
        assert!(!driver.summary.is_empty() && !driver.summary.ends_with('.'));
        let tried = ELSEWHERE.contains(&driver.name)
            || benches()
                .iter()
                .any(|bench| bench.driver.name == driver.name);
        assert!(
            tried,
            "driver {} has no simulator in tests/drivers/bench.rs",
            driver.name
        );
        let unknown = toml::Table::from_iter([("no_such_key".into(), toml::Value::Integer(1))]);
        let mistakes = (driver.configure)(unknown).expect_err("an unknown key and no link");
        let keys: Vec<&str> = mistakes
            .iter()
            .map(|mistake| mistake.key.as_str())
            .collect();
        assert_eq!(keys.last(), Some(&"no_such_key"), "{}", driver.name);
        // A USB device may be the only one of its kind.
        let by_kind = ["u3v-profiler", "usb-itn"].contains(&driver.name);
        assert!(
            by_kind || keys.len() > 1,
            "{}: no link, and no mistake",
            driver.name
        );
    }
}

// ---- Profilers --------------------------------------------------------------------------------------------------------

fn bench_of(name: &str) -> Bench {
    let found = benches().into_iter().find(|bench| bench.name == name);
    found.expect("a bench of that name")
}

fn profiler_bench() -> Bench {
    bench_of("open-profile")
}

fn simulated_profiler(faults: &str, test: &str) -> (SimulatedProfiler, Box<dyn Profiler>) {
    let mut options = DemoOptions::new(7);
    options.faults = faults.parse().expect("the test's faults");
    let port = port(test, "open-profile");
    let wire = Wire::pty(&port).expect("a pseudo-terminal");
    let device = DemoCell::with_options(options).start_profiler(0, wire);
    let setup = profiler_bench().setup(&by_port(&port), "");
    match open(&*setup, &Cable) {
        Instrument::Profiler(profiler) => (device.expect("a simulated device"), profiler),
        _ => panic!("no profiler"),
    }
}

/// Takes `n` profiles, then stops and takes those under way.
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

/// Scans over a bad line and holds every count to the simulator's log.
fn losses_are_exact(faults: &str, test: &str) {
    let (device, mut profiler) = simulated_profiler(faults, test);
    let profiles = scan(profiler.as_mut(), 150).expect("a scan");
    let losses = profiler.losses();
    let status = device.status();
    let truth = device.truth();
    let run = status.run.expect("a run");
    let whole: BTreeSet<u32> = truth
        .profiles
        .iter()
        .filter(|record| record.run == run)
        .filter(|record| matches!(record.fate, Fate::Sent | Fate::Duplicated))
        .filter_map(|record| record.sequence)
        .collect();
    let received: Vec<u32> = profiles.iter().map(|profile| profile.sequence).collect();
    assert!(received.is_sorted_by(|a, b| a < b), "in order, none twice");
    assert_eq!(
        received.iter().copied().collect::<BTreeSet<_>>(),
        whole,
        "{faults}"
    );
    assert_eq!(losses.received, received.len() as u64);
    assert_eq!(
        losses.received + losses.lost_on_link,
        status.sent.into(),
        "{faults}"
    );
    assert_eq!(losses.dropped_by_device, status.dropped.into(), "{faults}");
    assert_eq!(
        truth.count(run, Fate::DroppedInDevice) as u64,
        losses.dropped_by_device
    );
}

#[test]
fn a_sound_line_loses_nothing() {
    let (device, mut profiler) = simulated_profiler("", "sound");
    let profiles = scan(profiler.as_mut(), 200).expect("a scan");
    let losses = profiler.losses();
    assert_eq!(losses.received, profiles.len() as u64);
    assert_eq!(losses.received, device.status().sent.into());
    assert_eq!(
        (losses.lost_on_link, losses.rejected, losses.skipped_bytes),
        (0, 0, 0)
    );
    assert!(profiles.iter().all(|profile| profile.z_mm.len() == 64));
    assert!(
        profiles
            .windows(2)
            .all(|pair| pair[0].encoder < pair[1].encoder)
    );
}

#[test]
fn losses_on_a_bad_line_are_exact() {
    losses_are_exact("lose=0.0002,flip=0.00005,split", "bad-line");
}

#[test]
fn losses_under_every_fault_of_framing_are_exact() {
    losses_are_exact(
        "lie=0.02,babble=0.05,duplicate=0.03,split,truncated,encoder-jitter,clock-drift",
        "framing",
    );
}

#[test]
fn losses_of_device_and_link_are_told_apart() {
    losses_are_exact("drop=0.05,lose-frame=0.05,lumps", "apart");
}

#[test]
fn a_device_that_starts_anew_in_a_scan_is_told() {
    let (device, mut profiler) = simulated_profiler("reboot-after=50", "reboot");
    let error = scan(profiler.as_mut(), 200).expect_err("another boot");
    assert!(
        text(&error).contains("the device started anew (boot 0x"),
        "{}",
        text(&error)
    );
    assert!(!device.status().laser_on);
}

#[test]
fn a_device_that_falls_silent_in_a_scan_is_told() {
    let (device, mut profiler) = simulated_profiler("silent-after=50", "mute");
    let error = scan(profiler.as_mut(), 200).expect_err("silence");
    assert!(
        text(&error).ends_with("no answer within 0.6 s; check power and cable, then retry"),
        "{}",
        text(&error)
    );
    drop(profiler);
    assert!(device.wait_until(SOON, |status| !status.laser_on));
}

#[test]
fn the_same_device_over_tcp() {
    let address: SocketAddr = "127.0.0.1:0".parse().expect("an address");
    let wire = Wire::tcp(address).expect("a listener");
    let device = DemoCell::new(4).start_profiler(1, wire).expect("a device");
    let link = format!("address = {:?}", device.port());
    let Instrument::Profiler(mut profiler) = open(&*profiler_bench().setup(&link, ""), &Cable)
    else {
        panic!("no profiler");
    };
    let profiles = scan(profiler.as_mut(), 100).expect("a scan");
    assert_eq!(profiles.len(), device.status().sent as usize);
    drop(profiler);
    assert!(!device.status().laser_on);
}

#[test]
fn serial_sensors_over_tcp_as_behind_a_serial_server() {
    let setup = acies_simulators::rf60x::Setup {
        faults: "latency-lumps,split".parse().expect("the test's faults"),
        ..acies_simulators::rf60x::Setup::new(&[17_185], 4)
    };
    let address: SocketAddr = "127.0.0.1:0".parse().expect("an address");
    let wire = Wire::tcp(address).expect("a listener");
    let device = acies_simulators::rf60x::start(wire, setup).expect("a device");
    let link = format!("address = {:?}", device.port());
    let opened = open(&*bench_of("rf60x").setup(&link, ""), &Cable);
    let Instrument::Profiler(mut sensor) = opened else {
        panic!("no profiler");
    };
    let profiles = scan(sensor.as_mut(), 100).expect("a scan");
    assert_eq!(profiles.len(), device.truth().values.len());
    assert_eq!(sensor.losses().lost_on_link, 0);
    drop(sensor);
    assert!(!device.status().laser_on);
}

#[test]
fn a_recorded_scan_plays_back_to_the_same_profiles() {
    let port = port("recorded", "open-profile");
    let folder = port.parent().expect("a folder").join("recordings");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let wire = Wire::pty(&port).expect("a pseudo-terminal");
    let device = DemoCell::new(5).start_profiler(0, wire).expect("a device");
    let setup = profiler_bench().setup(&by_port(&port), "");
    let take = |links: &dyn Links| {
        let Instrument::Profiler(mut profiler) = open(&*setup, links) else {
            panic!("no profiler");
        };
        let profiles = scan(profiler.as_mut(), 100).expect("a scan");
        // What the host stamps is not the device's.
        let values = profiles
            .into_iter()
            .map(|p| format!("{:?}{:?}{:?}", p.encoder, p.x_mm, p.z_mm));
        (values.collect::<Vec<_>>(), profiler.losses())
    };
    let live = take(&Recorder::new(Cable, &folder, 1 << 30));
    drop(device);
    let files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .expect("the folder")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    assert_eq!(files.len(), 1);
    let recording = Recording::read(&files[0]).expect("a recording");
    assert_eq!(recording.torn_at, None);
    let replayed = take(&Replay::new(
        recording,
        Match::Loose(Duration::from_millis(50)),
    ));
    assert_eq!(live, replayed);
}

// ---- Probes -----------------------------------------------------------------------------------------------------------

fn simulated_probe(
    faults: &str,
    test: &str,
    more: &str,
) -> (DemoCell, SimulatedProbe, Box<dyn Setup>) {
    let mut options = DemoOptions::new(7);
    options.probe_faults = faults.parse().expect("the test's faults");
    let cell = DemoCell::with_options(options);
    let port = port(test, "grbl-probe");
    let wire = Wire::pty(&port).expect("a pseudo-terminal");
    let device = cell.start_probe(wire).expect("a simulated device");
    let setup = bench_of("grbl-probe").setup(&by_port(&port), more);
    (cell, device, setup)
}

fn probe(setup: &dyn Setup) -> Box<dyn Probe> {
    match open(setup, &Cable) {
        Instrument::Probe(probe) => probe,
        _ => panic!("no probe"),
    }
}

/// Half a unit of the controller's reports, which round to 0.001 mm, and the rounding of what reads them.
const REPORT_MM: f64 = 0.000_500_1;

#[test]
fn touches_are_those_that_the_controller_latched() {
    for (faults, test) in [
        ("", "touch"),
        ("damage-prb=2,split", "torn"),
        ("lumps", "lumps"),
    ] {
        let (cell, device, setup) = simulated_probe(faults, test, "");
        let mut probe = probe(&*setup);
        for which in 0..cell.touches.len() {
            let found = touch(probe.as_mut(), &cell, which).expect("a touch");
            let truth = device.truth().touches[which];
            for (found, latched) in found.into_iter().zip(truth.latched.to_array()) {
                assert!(
                    (found - latched).abs() <= REPORT_MM,
                    "{faults}: touch {which}"
                );
            }
        }
        assert_eq!(device.truth().touches.len(), cell.touches.len());
        assert_eq!(device.truth().crashes, 0, "{faults}: it goes over the part");
    }
}

#[test]
fn a_probe_that_meets_nothing_is_told_and_unlocked_where_configured() {
    let (cell, _device, setup) = simulated_probe("no-contact", "nothing", "unlock_on_open = true");
    for _ in 0..2 {
        let error = touch(probe(&*setup).as_mut(), &cell, 0).expect_err("nothing is there");
        assert!(
            text(&error).contains(": no contact between ["),
            "{}",
            text(&error)
        );
    }
}

#[test]
fn a_controller_that_resets_in_a_move_is_told() {
    let (cell, _device, setup) =
        simulated_probe("reset-in-move=1", "reset", "unlock_on_open = true");
    let mut first = probe(&*setup);
    let error = touch(first.as_mut(), &cell, 0).expect_err("a reset");
    assert!(
        text(&error).contains("the controller reset itself"),
        "{}",
        text(&error)
    );
    drop(first);
    touch(probe(&*setup).as_mut(), &cell, 0).expect("a touch after reopening");
}

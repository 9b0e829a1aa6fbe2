//! Every driver against its simulated device, over a real pseudo-terminal: one suite over the table of drivers, then the faults
//! of each kind, with every loss held to the simulator's own log.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::capture::Profile;
use acies_drivers::device::{Driver, Instrument, Probe, Profiler, Setup};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::{Recorder, Recording};
use acies_drivers::link::replay::{Match, Replay};
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::grbl::SimulatedProbe;
use acies_simulators::open_profile::{Fate, SimulatedProfiler};
use acies_simulators::wire::Wire;

/// Longest wait for something that must happen; long because the machine may be busy.
const SOON: Duration = Duration::from_secs(30);

/// A device at the other end of a wire.
enum Simulated {
    Profiler(SimulatedProfiler),
    Probe(SimulatedProbe),
}

impl Simulated {
    fn unplug(&self) {
        match self {
            Simulated::Profiler(device) => device.unplug(),
            Simulated::Probe(device) => device.unplug(),
        }
    }

    fn replug(&self) {
        match self {
            Simulated::Profiler(device) => device.replug(),
            Simulated::Probe(device) => device.replug(),
        }
    }

    /// No light comes out, now or within [`SOON`].
    fn goes_dark(&self) -> bool {
        match self {
            Simulated::Profiler(device) => device.wait_until(SOON, |status| !status.laser_on),
            Simulated::Probe(_) => true,
        }
    }
}

/// What the suite must know of one driver.
struct Bench {
    driver: &'static Driver,
    /// Keys beside the link.
    keys: &'static str,
    /// A key that another device's identity makes wrong.
    wrong: &'static str,
    simulate: fn(&DemoCell, Wire) -> std::io::Result<Simulated>,
}

fn bench(driver: &'static Driver) -> Bench {
    match driver.name {
        "open-profile" => Bench {
            driver,
            keys: "columns = 64\nkeepalive_s = 0.2",
            wrong: "serial_number = 'ANOTHER'",
            simulate: |cell, wire| cell.start_profiler(0, wire).map(Simulated::Profiler),
        },
        "grbl-probe" => Bench {
            driver,
            keys: "safe_z_mm = 150\nfeed_mm_min = 300",
            wrong: "build_info = 'ANOTHER'",
            simulate: |cell, wire| cell.start_probe(wire).map(Simulated::Probe),
        },
        other => {
            panic!("driver {other} has no simulator here: add one to simulators/ and to this list")
        }
    }
}

/// Drivers without a serial line: `drivers/tests/network` and `drivers/tests/usb` hold them to their simulators.
const NOT_SERIAL: [&str; 4] = ["gocator", "ippdme", "u3v-profiler", "usb-itn"];

fn benches() -> Vec<Bench> {
    let serial = |driver: &&Driver| !NOT_SERIAL.contains(&driver.name);
    ALL.iter().filter(serial).map(bench).collect()
}

/// Where a simulated port appears: a path of this test's own.
fn port(test: &str, driver: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("drivers")
        .join(test);
    std::fs::create_dir_all(&folder).expect("a folder");
    folder.join(driver)
}

impl Bench {
    fn setup(&self, link: &str, more: &str) -> Box<dyn Setup> {
        let table = format!("{link}\n{}\n{more}", self.keys);
        let table = toml::from_str(&table).expect("the test's TOML");
        (self.driver.configure)(table).unwrap_or_else(|mistakes| panic!("{mistakes:?}"))
    }

    fn start(&self, cell: &DemoCell, port: &Path) -> Simulated {
        let wire = Wire::pty(port).expect("a pseudo-terminal");
        (self.simulate)(cell, wire).expect("a simulated device")
    }
}

fn by_port(port: &Path) -> String {
    format!("port = {:?}", port.display().to_string())
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

fn refusal(setup: &dyn Setup) -> String {
    match setup.open(&Cable) {
        Ok(_) => panic!("it opened"),
        Err(error) => text(&error),
    }
}

fn open(setup: &dyn Setup, links: &dyn Links) -> Instrument {
    match setup.open(links) {
        Ok(instrument) => instrument,
        Err(error) => panic!("{}", text(&error)),
    }
}

/// Opens what was just plugged in again: the port may take a moment to appear.
fn reopen(setup: &dyn Setup) -> Instrument {
    let deadline = Instant::now() + SOON;
    loop {
        match setup.open(&Cable) {
            Ok(instrument) => return instrument,
            Err(error) if error.may_pass() && Instant::now() < deadline => {
                std::thread::yield_now();
            }
            Err(error) => panic!("{}", text(&error)),
        }
    }
}

/// Does once what the instrument is for.
fn work(instrument: &mut Instrument, cell: &DemoCell) -> Result<(), DeviceError> {
    match instrument {
        Instrument::Profiler(profiler) => {
            profiler.start()?;
            profiler.next(Instant::now() + SOON)?;
            profiler.stop().map(drop)
        }
        Instrument::Probe(probe) => touch(probe.as_mut(), cell, 0).map(drop),
    }
}

fn touch(probe: &mut dyn Probe, cell: &DemoCell, which: usize) -> Result<[f64; 3], DeviceError> {
    let way = &cell.touches[which];
    let touch = probe.touch(way.start.to_array(), way.target.to_array(), SOON)?;
    Ok(touch.tip_centre_mm)
}

// ---- The table --------------------------------------------------------------------------------------------------------

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

// ---- Every driver -----------------------------------------------------------------------------------------------------

#[test]
fn each_opens_its_device_and_works() {
    let cell = DemoCell::new(1);
    for bench in benches() {
        let port = port("works", bench.driver.name);
        let _device = bench.start(&cell, &port);
        let setup = bench.setup(&by_port(&port), "");
        let claims: Vec<String> = setup.claims().iter().map(ToString::to_string).collect();
        assert_eq!(claims, [format!("port {}", port.display())]);
        let mut instrument = open(&*setup, &Cable);
        let identity = match &instrument {
            Instrument::Profiler(profiler) => profiler.identity(),
            Instrument::Probe(probe) => probe.identity(),
        };
        assert!(!identity.vendor.is_empty() && !identity.firmware.is_empty());
        work(&mut instrument, &cell).expect("work");
        assert!(
            refusal(&*setup)
                .ends_with("another program has it open; close that program, then retry"),
            "a second opening"
        );
    }
}

#[test]
fn each_refuses_another_device_than_its_own() {
    let cell = DemoCell::new(1);
    for bench in benches() {
        let port = port("another", bench.driver.name);
        let _device = bench.start(&cell, &port);
        let text = refusal(&*bench.setup(&by_port(&port), bench.wrong));
        assert!(
            text.contains("the configuration expects \"ANOTHER\""),
            "{}: {text}",
            bench.driver.name
        );
    }
}

#[test]
fn each_says_that_nothing_is_plugged_in() {
    for bench in benches() {
        let port = port("absent", bench.driver.name);
        assert_eq!(
            refusal(&*bench.setup(&by_port(&port), "")),
            format!(
                "{}: cannot be used: nothing of this name is there; check cable, power and the name",
                port.display()
            )
        );
    }
}

#[test]
fn each_says_that_its_device_is_silent() {
    let mut options = DemoOptions::new(1);
    options.faults.silent_after = Some(0);
    options.probe_faults.silent_after = Some(0);
    let cell = DemoCell::with_options(options);
    for bench in benches() {
        let port = port("silent", bench.driver.name);
        let _device = bench.start(&cell, &port);
        let text = refusal(&*bench.setup(&by_port(&port), ""));
        assert!(
            text.ends_with("no answer within 3 s; check power and cable, then retry"),
            "{}: {text}",
            bench.driver.name
        );
    }
}

#[test]
fn each_survives_unplugging_in_the_middle_of_its_work() {
    let cell = DemoCell::new(2);
    for bench in benches() {
        let port = port("unplugged", bench.driver.name);
        let device = bench.start(&cell, &port);
        let setup = bench.setup(&by_port(&port), "");
        let mut instrument = open(&*setup, &Cable);
        if let Instrument::Profiler(profiler) = &mut instrument {
            profiler.start().expect("a start");
        }
        device.unplug();
        let deadline = Instant::now() + SOON;
        let error = loop {
            assert!(
                Instant::now() < deadline,
                "{}: nobody noticed",
                bench.driver.name
            );
            let worked = match &mut instrument {
                Instrument::Profiler(profiler) => profiler.next(deadline).map(drop),
                Instrument::Probe(probe) => touch(probe.as_mut(), &cell, 0).map(drop),
            };
            if let Err(error) = worked {
                break error;
            }
        };
        assert!(error.may_pass());
        assert!(
            text(&error).ends_with("it is gone: closed or unplugged; plug it in again and reopen"),
            "{}",
            text(&error)
        );
        drop(instrument);
        device.replug();
        work(&mut reopen(&*setup), &cell).expect("work after plugging in again");
        assert!(device.goes_dark());
    }
}

#[test]
fn each_leaves_the_laser_off_after_stop_and_after_drop() {
    let cell = DemoCell::new(3);
    for bench in benches() {
        let port = port("dark", bench.driver.name);
        let device = bench.start(&cell, &port);
        let setup = bench.setup(&by_port(&port), "");
        let mut instrument = open(&*setup, &Cable);
        work(&mut instrument, &cell).expect("work");
        assert!(device.goes_dark(), "{} after stop", bench.driver.name);
        if let (Instrument::Profiler(profiler), Simulated::Profiler(device)) =
            (&mut instrument, &device)
        {
            profiler.start().expect("a start");
            assert!(device.status().laser_on, "{}", bench.driver.name);
        }
        drop(instrument);
        if let Simulated::Profiler(device) = &device {
            assert!(
                !device.status().laser_on,
                "{} after drop",
                bench.driver.name
            );
        }
    }
}

// ---- Profilers --------------------------------------------------------------------------------------------------------

fn profiler_bench() -> Bench {
    let driver = ALL.iter().find(|driver| driver.name == "open-profile");
    bench(driver.expect("the driver"))
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
        Instrument::Probe(_) => panic!("a probe"),
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
    losses_are_exact("lie=0.02,babble=0.05,duplicate=0.03,split", "framing");
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
    let driver = ALL.iter().find(|driver| driver.name == "grbl-probe");
    let setup = bench(driver.expect("the driver")).setup(&by_port(&port), more);
    (cell, device, setup)
}

fn probe(setup: &dyn Setup) -> Box<dyn Probe> {
    match open(setup, &Cable) {
        Instrument::Probe(probe) => probe,
        Instrument::Profiler(_) => panic!("a profiler"),
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

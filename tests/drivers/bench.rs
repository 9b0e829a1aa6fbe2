//! The table of the suite: every driver with the simulated devices that it is tried on. A new driver is a new entry in
//! [`benches`].

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::device::{Driver, Instrument, Probe, Setup};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::gauge::{self, Dialect};
use acies_simulators::grbl::SimulatedProbe;
use acies_simulators::open_profile::SimulatedProfiler;
use acies_simulators::point::SimulatedSensor;
use acies_simulators::wire::Wire;
use acies_simulators::{optoncdt, rf60x};

/// Longest wait for something that must happen; long because the machine may be busy.
pub const SOON: Duration = Duration::from_secs(30);

/// A device at the other end of a wire.
pub enum Simulated {
    Profiler(SimulatedProfiler),
    Probe(SimulatedProbe),
    Sensor(SimulatedSensor),
}

impl Simulated {
    pub fn unplug(&self) {
        match self {
            Simulated::Profiler(device) => device.unplug(),
            Simulated::Probe(device) => device.unplug(),
            Simulated::Sensor(device) => device.unplug(),
        }
    }

    pub fn replug(&self) {
        match self {
            Simulated::Profiler(device) => device.replug(),
            Simulated::Probe(device) => device.replug(),
            Simulated::Sensor(device) => device.replug(),
        }
    }

    /// Whether light comes out; nothing for a device without a laser.
    pub fn laser_on(&self) -> Option<bool> {
        match self {
            Simulated::Profiler(device) => Some(device.status().laser_on),
            Simulated::Probe(_) => None,
            Simulated::Sensor(device) => Some(device.status().laser_on),
        }
    }

    /// No light comes out, now or within `patience`.
    pub fn goes_dark(&self, patience: Duration) -> bool {
        match self {
            Simulated::Profiler(device) => device.wait_until(patience, |status| !status.laser_on),
            Simulated::Probe(_) => true,
            Simulated::Sensor(device) => device.wait_until(patience, |status| !status.laser_on),
        }
    }
}

/// What the suite must know of one driver and one kind of device.
pub struct Bench {
    /// Of the kind of device, for paths and messages.
    pub name: &'static str,
    pub driver: &'static Driver,
    /// Keys beside the link.
    pub keys: &'static str,
    /// A key that another device's identity makes wrong, and what the error then expects; nothing where the device tells none.
    pub wrong: Option<(&'static str, &'static str)>,
    /// What is told when the device starts anew in its work; nothing where its protocol cannot show it.
    pub restart: Option<&'static str>,
    /// The laser of a host that was killed goes off by itself. Otherwise the next host switches it off.
    pub keeps_alive: bool,
    /// It has a laser that the driver switches.
    pub laser: bool,
    simulate: fn(&DemoCell, Wire) -> std::io::Result<Simulated>,
}

fn driver(name: &str) -> &'static Driver {
    let found = ALL.iter().find(|driver| driver.name == name);
    found.unwrap_or_else(|| panic!("no driver {name}"))
}

fn gauge(
    dialect: Dialect,
    channels: usize,
    cell: &DemoCell,
    wire: Wire,
) -> std::io::Result<Simulated> {
    let setup = gauge::Setup {
        channels,
        faults: cell.options.faults.clone(),
        ..gauge::Setup::new(dialect, cell.options.seed)
    };
    gauge::start(wire, setup).map(Simulated::Sensor)
}

/// Every kind of device; each driver has one at least.
pub fn benches() -> Vec<Bench> {
    let laser = |name, keys, wrong, restart, simulate| Bench {
        name,
        driver: driver(name),
        keys,
        wrong: Some(wrong),
        restart: Some(restart),
        keeps_alive: false,
        laser: true,
        simulate,
    };
    let of_gauge = |name, keys, simulate| Bench {
        name,
        driver: driver("serial-gauge"),
        keys,
        wrong: None,
        restart: None,
        keeps_alive: false,
        laser: false,
        simulate,
    };
    vec![
        Bench {
            keeps_alive: true,
            ..laser(
                "open-profile",
                "columns = 64\nkeepalive_s = 0.2",
                ("serial_number = 'ANOTHER'", "\"ANOTHER\""),
                "the device started anew",
                |cell, wire| cell.start_profiler(0, wire).map(Simulated::Profiler),
            )
        },
        Bench {
            laser: false,
            ..laser(
                "grbl-probe",
                "safe_z_mm = 150\nfeed_mm_min = 300",
                ("build_info = 'ANOTHER'", "\"ANOTHER\""),
                "the controller reset itself",
                |cell, wire| cell.start_probe(wire).map(Simulated::Probe),
            )
        },
        laser(
            "optoncdt",
            "laser_on = 'LASERPOW FULL'\nlaser_off = 'LASERPOW OFF'\nrate_hz = 4000",
            ("serial_number = 'ANOTHER'", "\"ANOTHER\""),
            "it answers, but sends no values any more",
            |cell, wire| {
                let mut setup = optoncdt::Setup::new("SIM-1420", cell.options.seed);
                setup.faults.clone_from(&cell.options.faults);
                optoncdt::start(wire, setup).map(Simulated::Sensor)
            },
        ),
        laser(
            "rf60x",
            "sampling_us = 1000",
            ("serial_numbers = [1]", "\"1\""),
            "it answers, but its stream has stopped",
            |cell, wire| {
                let mut setup = rf60x::Setup::new(&[17_185], cell.options.seed);
                setup.faults.clone_from(&cell.options.faults);
                rf60x::start(wire, setup).map(Simulated::Sensor)
            },
        ),
        Bench {
            name: "rf60x-bus",
            driver: driver("rf60x"),
            restart: None,
            ..laser(
                "rf60x",
                "addresses = [1, 2]\npitch_mm = 20\nrate_hz = 1000",
                ("serial_numbers = [17185, 1]", "\"1\""),
                "",
                |cell, wire| {
                    let mut setup = rf60x::Setup::new(&[17_185, 17_186], cell.options.seed);
                    setup.faults.clone_from(&cell.options.faults);
                    rf60x::start(wire, setup).map(Simulated::Sensor)
                },
            )
        },
        of_gauge(
            "heidenhain-nd",
            "dialect = 'heidenhain-nd'\nrate_hz = 1000",
            |cell, wire| gauge(Dialect::HeidenhainNd, 1, cell, wire),
        ),
        of_gauge(
            "mitutoyo",
            "dialect = 'mitutoyo'\nchannels = 2\npitch_mm = 5\nrate_hz = 1000",
            |cell, wire| gauge(Dialect::Mitutoyo, 2, cell, wire),
        ),
        Bench {
            wrong: Some(("serial_number = 'ANOTHER'", "\"ANOTHER\"")),
            restart: Some("the gauge was switched off and on"),
            ..of_gauge(
                "sylvac",
                "dialect = 'sylvac-opto-rs'\nwidth = 9\nrate_hz = 1000",
                |cell, wire| gauge(Dialect::Sylvac, 1, cell, wire),
            )
        },
        Bench {
            laser: true,
            wrong: Some(("channels = 3", "\"3 amplifiers\"")),
            ..of_gauge(
                "keyence",
                "dialect = 'keyence-dl-rs1a'\nlaser_stop = true\npitch_mm = 5\nrate_hz = 1000",
                |cell, wire| gauge(Dialect::Keyence, 2, cell, wire),
            )
        },
    ]
}

impl Bench {
    /// A checked configuration; `more` are further keys.
    pub fn setup(&self, link: &str, more: &str) -> Box<dyn Setup> {
        // Two amplifiers, unless a test says else.
        let channels = match self.name == "keyence" && !more.contains("channels") {
            true => "channels = 2",
            false => "",
        };
        let table = format!("{link}\n{}\n{channels}\n{more}", self.keys);
        let table = toml::from_str(&table).expect("the test's TOML");
        (self.driver.configure)(table).unwrap_or_else(|mistakes| panic!("{mistakes:?}"))
    }

    /// Starts the device on a pseudo-terminal of this test's own; the device, and the keys of its link.
    pub fn plug(&self, cell: &DemoCell, test: &str) -> (Simulated, String) {
        let port = port(test, self.name);
        let wire = Wire::pty(&port).expect("a pseudo-terminal");
        let device = (self.simulate)(cell, wire).expect("a simulated device");
        (device, by_port(&port))
    }
}

/// The demo's cell with these faults in all its devices.
pub fn cell(seed: u64, faults: &str) -> DemoCell {
    let mut options = DemoOptions::new(seed);
    options.faults = faults.parse().expect("the test's faults");
    options.probe_faults = options.faults.clone();
    DemoCell::with_options(options)
}

/// Where a simulated port appears: a path of this test's own.
pub fn port(test: &str, device: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("drivers")
        .join(test);
    std::fs::create_dir_all(&folder).expect("a folder");
    folder.join(device)
}

pub fn by_port(port: &Path) -> String {
    format!("port = {:?}", port.display().to_string())
}

/// The text of an error with its sources.
pub fn text(error: &DeviceError) -> String {
    let mut text = error.to_string();
    let mut inner = std::error::Error::source(error);
    while let Some(source) = inner {
        text = format!("{text}: {source}");
        inner = source.source();
    }
    text
}

/// The error of an opening that must fail.
pub fn refusal(setup: &dyn Setup) -> String {
    match setup.open(&Cable) {
        Ok(_) => panic!("it opened"),
        Err(error) => text(&error),
    }
}

pub fn open(setup: &dyn Setup, links: &dyn Links) -> Instrument {
    match setup.open(links) {
        Ok(instrument) => instrument,
        Err(error) => panic!("{}", text(&error)),
    }
}

/// Opens what was just plugged in again: the port may take a moment to appear.
pub fn reopen(setup: &dyn Setup) -> Instrument {
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
pub fn work(instrument: &mut Instrument, cell: &DemoCell) -> Result<(), DeviceError> {
    match instrument {
        Instrument::Profiler(profiler) => {
            profiler.start()?;
            profiler.next(Instant::now() + SOON)?;
            profiler.stop().map(drop)
        }
        Instrument::Probe(probe) => touch(probe.as_mut(), cell, 0).map(drop),
        Instrument::Robot(robot) => {
            robot.start()?;
            robot.next(Instant::now() + SOON)?;
            robot.stop().map(drop)
        }
    }
}

pub fn touch(
    probe: &mut dyn Probe,
    cell: &DemoCell,
    which: usize,
) -> Result<[f64; 3], DeviceError> {
    let way = &cell.touches[which];
    let touch = probe.touch(way.start.to_array(), way.target.to_array(), SOON)?;
    Ok(touch.tip_centre_mm)
}

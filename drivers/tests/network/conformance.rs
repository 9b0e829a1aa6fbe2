//! What every driver of a network device must do, whatever the device: one row of the table of conformance a test. `tests/drivers` has the same
//! for serial ports, `drivers/tests/usb` for USB.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Instant;

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Setup};
use acies_drivers::error::{DeviceError, LinkError};
use acies_drivers::link::cable::Cable;
use acies_drivers::link::{Link, Links, Target};
use acies_simulators::carried::Motion;
use acies_simulators::demo_cell::{DemoCell, TIP_RADIUS_MM};
use acies_simulators::gocator::{self, SimulatedGocator, Surface};
use acies_simulators::ippdme::{self, SimulatedCmm};
use acies_simulators::pose::Pose;
use acies_simulators::ur_rtde::{self, SimulatedRobot};
use acies_simulators::wire::Wire;
use glam::DVec3;

use crate::support::{SOON, setup, text};

/// A device, with the table that leads to it.
struct Bench {
    driver: &'static str,
    table: String,
    cell: DemoCell,
    _device: Box<dyn Send>,
}

fn benches() -> Vec<Bench> {
    let bench = |driver, table, device| Bench {
        driver,
        table,
        cell: DemoCell::new(3),
        _device: device,
    };
    let line = SimulatedGocator::start(gocator::Setup::new(13_434, Surface::Wave(64)));
    let line = line.expect("a simulated sensor");
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    let motion = Motion::straight(Pose::IDENTITY, DVec3::X * 100.0, 20.0);
    let robot = SimulatedRobot::start(wire, ur_rtde::Setup::new(Arc::new(motion), 3));
    let robot = robot.expect("a simulated robot");
    let cell = DemoCell::new(3);
    let cmm = SimulatedCmm::start(ippdme::Setup::new(
        Arc::clone(&cell.part.made),
        cell.machine_from_part,
        TIP_RADIUS_MM,
    ));
    let cmm = cmm.expect("a simulated machine");
    let cmm_table = format!(
        "address = '{}'\nreports = 'tip-centre'\nsafe_z_mm = 150",
        cmm.address()
    );
    vec![
        bench("gocator", line.keys(), Box::new(line)),
        bench(
            "ur-rtde",
            format!("address = '{}'", robot.port()),
            Box::new(robot),
        ),
        bench("ippdme", cmm_table, Box::new(cmm)),
    ]
}

impl Bench {
    fn setup(&self) -> Box<dyn Setup> {
        setup(self.driver, &self.table).unwrap_or_else(|mistakes| panic!("{mistakes:?}"))
    }

    fn open(&self, links: &dyn Links) -> Instrument {
        let opened = self.setup().open(links);
        opened.unwrap_or_else(|error| panic!("{}: {}", self.driver, text(&error)))
    }

    /// Opens it for the next host: a device with room for one may take a moment to see that the last one is gone.
    fn reopen(&self, links: &dyn Links) -> Instrument {
        let deadline = Instant::now() + SOON;
        loop {
            match self.setup().open(links) {
                Ok(instrument) => return instrument,
                Err(error) if error.may_pass() && Instant::now() < deadline => {
                    std::thread::yield_now();
                }
                Err(error) => panic!("{}: {}", self.driver, text(&error)),
            }
        }
    }

    /// Does once what the instrument is for.
    fn work(&self, instrument: &mut Instrument) -> Result<(), DeviceError> {
        match instrument {
            Instrument::Profiler(profiler) => {
                profiler.start()?;
                let came = profiler.next(Instant::now() + SOON)?;
                assert!(came.is_some(), "a profile in time");
                profiler.stop().map(drop)
            }
            Instrument::Robot(robot) => {
                robot.start()?;
                let came = robot.next(Instant::now() + SOON)?;
                assert!(came.is_some(), "a pose in time");
                robot.stop().map(drop)
            }
            Instrument::Probe(probe) => {
                let way = &self.cell.touches[0];
                let touched = probe.touch(way.start.to_array(), way.target.to_array(), SOON);
                touched.map(drop)
            }
        }
    }
}

const GONE: &str = "it is gone: closed or unplugged; plug it in again and reopen";

// ---- Links that are not as they should be -----------------------------------------------------------------------------

/// Hands out one byte a read, so that every message is cut at every place; and is cut at a write, or when it is told to.
struct Bad {
    drips: bool,
    /// Writes before the cable is pulled.
    writes: Arc<AtomicU32>,
}

struct BadLink {
    link: Arc<dyn Link>,
    drips: bool,
    writes: Arc<AtomicU32>,
}

impl Bad {
    fn dripping() -> Bad {
        Bad {
            drips: true,
            ..Bad::pulled_at(u32::MAX)
        }
    }

    fn pulled_at(write: u32) -> Bad {
        Bad {
            drips: false,
            writes: Arc::new(AtomicU32::new(write)),
        }
    }

    fn pull(&self) {
        self.writes.store(0, Ordering::Release);
    }
}

impl Links for Bad {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        Ok(Arc::new(BadLink {
            link: Cable.open(target)?,
            drips: self.drips,
            writes: Arc::clone(&self.writes),
        }))
    }
}

impl Link for BadLink {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        if self.writes.load(Ordering::Acquire) == 0 {
            return Err(LinkError::Gone);
        }
        let most = match self.drips {
            true => 1,
            false => buffer.len(),
        };
        self.link.read(&mut buffer[..most], deadline)
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        let left = |left: u32| left.checked_sub(1);
        let before = self
            .writes
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, left);
        match before {
            Ok(2..) => self.link.write(bytes, deadline),
            _ => Err(LinkError::Gone),
        }
    }
}

// ---- The rows ---------------------------------------------------------------------------------------------------------

#[test]
fn each_works_byte_by_byte() {
    for bench in benches() {
        let mut instrument = bench.open(&Bad::dripping());
        if let Err(error) = bench.work(&mut instrument) {
            panic!("{}: {}", bench.driver, text(&error));
        }
        let losses = match &instrument {
            Instrument::Profiler(profiler) => profiler.losses(),
            Instrument::Robot(robot) => robot.losses(),
            Instrument::Probe(_) => continue,
        };
        assert_eq!(
            (losses.lost_on_link, losses.rejected),
            (0, 0),
            "{}",
            bench.driver
        );
    }
}

#[test]
fn each_survives_unplugging_while_it_is_opened() {
    for bench in benches() {
        let setup = bench.setup();
        let mut told = 0;
        for write in 0..64 {
            let mut opened = match setup.open(&Bad::pulled_at(write)) {
                Ok(opened) => opened,
                Err(error) => {
                    assert!(
                        error.may_pass() && text(&error).ends_with(GONE),
                        "{} at write {write}: {}",
                        bench.driver,
                        text(&error)
                    );
                    told += 1;
                    continue;
                }
            };
            // Open by then: it shows in its work.
            let error = bench.work(&mut opened).err();
            drop(opened);
            match error {
                Some(error) => assert!(text(&error).ends_with(GONE), "{}", text(&error)),
                None => break,
            }
        }
        assert!(told > 1, "{}: {told} times", bench.driver);
        let mut again = bench.reopen(&Cable);
        if let Err(error) = bench.work(&mut again) {
            panic!("{}: afterwards: {}", bench.driver, text(&error));
        }
    }
}

#[test]
fn each_comes_back_after_its_cable_was_pulled_in_its_work() {
    for bench in benches() {
        let links = Bad::pulled_at(u32::MAX);
        let mut instrument = bench.open(&links);
        let begun = match &mut instrument {
            Instrument::Profiler(profiler) => profiler.start(),
            Instrument::Robot(robot) => robot.start(),
            Instrument::Probe(_) => Ok(()),
        };
        assert!(begun.is_ok(), "{}", bench.driver);
        links.pull();
        let deadline = Instant::now() + SOON;
        let error = loop {
            assert!(
                Instant::now() < deadline,
                "{}: nobody noticed",
                bench.driver
            );
            let worked = match &mut instrument {
                Instrument::Profiler(profiler) => profiler.next(deadline).map(drop),
                Instrument::Robot(robot) => robot.next(deadline).map(drop),
                Instrument::Probe(_) => bench.work(&mut instrument),
            };
            if let Err(error) = worked {
                break error;
            }
        };
        assert!(
            error.may_pass() && text(&error).ends_with(GONE),
            "{}: {}",
            bench.driver,
            text(&error)
        );
        drop(instrument);
        let mut again = bench.reopen(&Cable);
        if let Err(error) = bench.work(&mut again) {
            panic!("{}: plugged in again: {}", bench.driver, text(&error));
        }
    }
}

// ---- The table --------------------------------------------------------------------------------------------------------

use Entry::{Cannot, Held};

/// What stands behind a row of the table.
enum Entry {
    /// The test of this name.
    Held(&'static str),
    /// It cannot happen, and why.
    Cannot(&'static str),
}

const ROWS: [&str; 11] = [
    "identity",
    "another device is refused",
    "split at every byte",
    "garbage between messages",
    "bytes lost",
    "wrong baud or parity",
    "unplugged in its work, and back",
    "unplugged while it is opened",
    "started anew while it streams",
    "laser off after stop and drop",
    "laser off after its host died",
];

const TCP: Entry = Cannot("TCP loses no bytes");
const USB: Entry = Cannot("USB checks every packet and repeats it");
const NOT_SERIAL: Entry = Cannot("no serial line");
const NO_LASER: Entry = Cannot("no laser");
const IN_TRANSFERS: Entry = Cannot("a transfer comes whole; of cut ones `losses_are_exact` knows");

/// In the order of [`ROWS`]: the drivers that `tests/drivers` does not hold.
const TABLE: [(&str, [Entry; 11]); 5] = [
    (
        "gocator",
        [
            Held("each_example_opens_its_device"),
            Held("refusals_are_told"),
            Held("each_works_byte_by_byte"),
            Held("wrong_peers_are_told_apart"),
            TCP,
            NOT_SERIAL,
            Held("each_comes_back_after_its_cable_was_pulled_in_its_work"),
            Held("each_survives_unplugging_while_it_is_opened"),
            Held("whatever_ends_a_scan_is_told"),
            Held("the_laser_is_off_after_drop_and_for_a_host_that_died"),
            Held("the_laser_is_off_after_drop_and_for_a_host_that_died"),
        ],
    ),
    (
        "ippdme",
        [
            Held("each_example_opens_its_device"),
            Held("wrong_peers_are_told_apart"),
            Held("each_works_byte_by_byte"),
            Held("what_ends_a_touch_is_told"),
            TCP,
            NOT_SERIAL,
            Held("each_comes_back_after_its_cable_was_pulled_in_its_work"),
            Held("each_survives_unplugging_while_it_is_opened"),
            Cannot("it streams nothing"),
            NO_LASER,
            NO_LASER,
        ],
    ),
    (
        "ur-rtde",
        [
            Held("each_example_opens_its_device"),
            Held("refusals_are_told"),
            Held("each_works_byte_by_byte"),
            Held("refusals_are_told"),
            TCP,
            NOT_SERIAL,
            Held("each_comes_back_after_its_cable_was_pulled_in_its_work"),
            Held("each_survives_unplugging_while_it_is_opened"),
            Held("each_end_of_a_run_has_its_own_error"),
            NO_LASER,
            NO_LASER,
        ],
    ),
    (
        "u3v-profiler",
        [
            Held("the_example_cells_open"),
            Held("other_devices_are_refused"),
            IN_TRANSFERS,
            Held("what_is_wrong_is_told"),
            USB,
            NOT_SERIAL,
            Held("unplugged_in_a_scan_and_back"),
            Held("unplugged_while_it_is_opened"),
            Held("unplugged_in_a_scan_and_back"),
            Held("the_laser_goes_off"),
            Held("the_laser_goes_off"),
        ],
    ),
    (
        "usb-itn",
        [
            Held("the_example_cells_open"),
            Held("itn_another_tool_is_not_taken_for_it"),
            IN_TRANSFERS,
            Held("itn_losses_are_exact"),
            USB,
            NOT_SERIAL,
            Held("itn_refusal_and_unplugging"),
            Held("unplugged_while_it_is_opened"),
            Cannot("it streams nothing"),
            NO_LASER,
            NO_LASER,
        ],
    ),
];

#[test]
fn every_row_of_every_driver_is_held_or_cannot_happen() {
    let tests = concat!(
        include_str!("conformance.rs"),
        include_str!("configs.rs"),
        include_str!("gocator.rs"),
        include_str!("ippdme.rs"),
        include_str!("ur_rtde.rs"),
        include_str!("../usb/cases.rs"),
    );
    for (driver, entries) in &TABLE {
        assert!(ALL.iter().any(|known| known.name == *driver), "{driver}");
        for (row, entry) in ROWS.iter().zip(entries) {
            match entry {
                Held(test) => assert!(
                    tests.contains(&format!("fn {test}(")),
                    "{driver}, {row}: there is no test {test}"
                ),
                Cannot(why) => assert!(!why.is_empty(), "{driver}, {row}"),
            }
        }
    }
}

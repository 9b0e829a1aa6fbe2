//! What every driver must do with every kind of its devices, over a real pseudo-terminal: one row of the table of conformance
//! a test, all devices in each.

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use acies_drivers::device::{Instrument, Presence};
use acies_drivers::error::{DeviceError, LinkError};
use acies_drivers::link::cable::Cable;
use acies_drivers::link::{Link, Links, Target};
use acies_simulators::demo_cell::DemoCell;

use super::bench::{
    Bench, SOON, Simulated, benches, by_port, cell, open, port, refusal, reopen, text, touch, work,
};

/// Works until something is told; the error.
fn work_until_told(instrument: &mut Instrument, cell: &DemoCell, bench: &Bench) -> DeviceError {
    let deadline = Instant::now() + SOON;
    loop {
        assert!(
            Instant::now() < deadline,
            "{}: nothing was told",
            bench.name
        );
        let worked = match instrument {
            Instrument::Profiler(profiler) => profiler.next(deadline).map(drop),
            Instrument::Probe(probe) => touch(probe.as_mut(), cell, 0).map(drop),
            Instrument::Robot(robot) => robot.next(deadline).map(drop),
        };
        if let Err(error) = worked {
            return error;
        }
    }
}

fn begin(instrument: &mut Instrument) {
    let begun = match instrument {
        Instrument::Profiler(profiler) => profiler.start(),
        Instrument::Robot(robot) => robot.start(),
        Instrument::Probe(_) => Ok(()),
    };
    if let Err(error) = begun {
        panic!("{}", text(&error));
    }
}

// ---- Identity ---------------------------------------------------------------------------------------------------------

#[test]
fn each_opens_its_device_and_works() {
    let cell = cell(1, "");
    for bench in benches() {
        let (_device, link) = bench.plug(&cell, "works");
        let setup = bench.setup(&link, "");
        let claims: Vec<String> = setup.claims().iter().map(ToString::to_string).collect();
        let port = port("works", bench.name);
        assert_eq!(claims, [format!("port {}", port.display())]);
        let mut instrument = open(&*setup, &Cable);
        let identity = instrument.identity();
        assert!(!identity.vendor.is_empty() && !identity.model.is_empty());
        // A device that can be told from another one says more.
        let told = !identity.serial.is_empty() || !identity.firmware.is_empty();
        assert!(
            told || bench.driver.name == "serial-gauge",
            "{}",
            bench.name
        );
        if let Err(error) = work(&mut instrument, &cell) {
            panic!("{}: {}", bench.name, text(&error));
        }
        assert!(
            refusal(&*setup)
                .ends_with("another program has it open; close that program, then retry"),
            "a second opening"
        );
    }
}

#[test]
fn each_refuses_another_device_than_its_own() {
    let cell = cell(1, "");
    for bench in benches() {
        let (_device, link) = bench.plug(&cell, "another");
        let Some((wrong, expected)) = bench.wrong else {
            // A display that does not say who it is, is at least no display of another kind.
            let other = bench
                .keys
                .replace(bench.name, "keyence-dl-rs1a")
                .replace("channels = 2\npitch_mm = 5\n", "");
            let table = toml::from_str(&format!("{link}\n{other}")).expect("TOML");
            let setup = (bench.driver.configure)(table).expect("a configuration");
            let told = refusal(&*setup);
            let ends = [
                "but no answer to the question for a reading; check `driver` and `baud`",
                "no answer within 3 s; check power and cable, then retry",
            ];
            assert!(ends.iter().any(|end| told.ends_with(end)), "{told}");
            continue;
        };
        let told = refusal(&*bench.setup(&link, wrong));
        assert!(
            told.contains(&format!("the configuration expects {expected}")),
            "{}: {told}",
            bench.name
        );
    }
}

#[test]
fn each_says_that_nothing_is_plugged_in() {
    for bench in benches() {
        let port = port("absent", bench.name);
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
    let cell = cell(1, "silent-after=0");
    all_at_once(|bench| {
        let (_device, link) = bench.plug(&cell, "silent");
        let told = refusal(&*bench.setup(&link, ""));
        assert!(
            told.ends_with("no answer within 3 s; check power and cable, then retry"),
            "{}: {told}",
            bench.name
        );
    });
}

/// Tries all devices side by side, where each only waits.
fn all_at_once(each: impl Fn(Bench) + Sync) {
    std::thread::scope(|scope| {
        for bench in benches() {
            scope.spawn(|| each(bench));
        }
    });
}

/// An idle device is asked, and a pulled plug shows. It is never lit by that, and works afterwards.
#[test]
fn each_says_whether_its_idle_device_is_there() {
    let cell = cell(1, "");
    for bench in benches() {
        let (device, link) = bench.plug(&cell, "check");
        let setup = bench.setup(&link, "");
        let mut instrument = open(&*setup, &Cable);
        for _ in 0..3 {
            let found = instrument.check();
            assert_eq!(found.ok(), Some(Presence::Answered), "{}", bench.name);
            assert!(device.laser_on() != Some(true) || !bench.laser);
        }
        begin(&mut instrument);
        if let Instrument::Profiler(profiler) = &mut instrument {
            let told = profiler.check().map_err(|error| text(&error));
            let end = "check needs the run to be stopped: a device that streams is there";
            assert!(
                told.is_err_and(|told| told.ends_with(end)),
                "{}",
                bench.name
            );
            if let Err(error) = profiler.stop() {
                panic!("{}: {}", bench.name, text(&error));
            }
        }
        let worked = work(&mut instrument, &cell);
        assert!(worked.is_ok(), "{}: after a check", bench.name);
        assert_eq!(instrument.check().ok(), Some(Presence::Answered));
        device.unplug();
        let deadline = Instant::now() + SOON;
        let error = loop {
            match instrument.check() {
                Ok(_) => assert!(Instant::now() < deadline, "{}: nobody noticed", bench.name),
                Err(error) => break error,
            }
        };
        assert!(
            error.may_pass() && text(&error).ends_with(GONE),
            "{}",
            text(&error)
        );
    }
}

// ---- A line that is not as it should be -------------------------------------------------------------------------------

/// Hands out one byte a read, so that every message is cut at every place.
struct Dripping;

struct Drip(Arc<dyn Link>);

impl Links for Dripping {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        Ok(Arc::new(Drip(Cable.open(target)?)))
    }
}

impl Link for Drip {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let one = buffer.len().min(1);
        self.0.read(&mut buffer[..one], deadline)
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        self.0.write(bytes, deadline)
    }
}

#[test]
fn each_works_byte_by_byte() {
    let cell = cell(2, "");
    for bench in benches() {
        let (_device, link) = bench.plug(&cell, "bytes");
        let mut instrument = open(&*bench.setup(&link, ""), &Dripping);
        if let Err(error) = work(&mut instrument, &cell) {
            panic!("{}: {}", bench.name, text(&error));
        }
        if let Instrument::Profiler(profiler) = &instrument {
            let losses = profiler.losses();
            assert_eq!(
                (losses.lost_on_link, losses.rejected),
                (0, 0),
                "{}",
                bench.name
            );
        }
    }
}

/// Works over a bad line: opening may be tried again, and what is delivered is a value that was sent.
fn works_over(faults: &str, test: &str) {
    for bench in benches() {
        let cell = cell(5, faults);
        let (device, link) = bench.plug(&cell, test);
        let setup = bench.setup(&link, "");
        let mut instrument = reopen(&*setup);
        let Instrument::Profiler(profiler) = &mut instrument else {
            // A line of text without a check that lost a digit may be another command: what counts is that nothing hangs.
            let _ = work(&mut instrument, &cell);
            continue;
        };
        if profiler.start().is_err() {
            // A command was damaged too often, and that was told. The laser is off, or goes off with the instrument.
            drop(instrument);
            assert!(device.goes_dark(SOON) || !bench.laser, "{}", bench.name);
            continue;
        }
        let mut seen = Vec::new();
        let deadline = Instant::now() + SOON;
        while seen.len() < 300 && Instant::now() < deadline {
            match profiler.next(Instant::now() + Duration::from_secs(1)) {
                Ok(Some(profile)) => seen.extend(profile.z_mm),
                Ok(None) => {}
                Err(error) => {
                    // Told, and not a number that nobody sent.
                    assert!(!text(&error).is_empty());
                    break;
                }
            }
        }
        let Simulated::Sensor(sensor) = &device else {
            continue;
        };
        let mm = |code: i64| match bench.driver.name {
            "optoncdt" => (102.0 * code as f64 / 65_520.0 - 1.0) / 100.0 * 50.0,
            "rf60x" => code as f64 * 50.0 / 16_384.0,
            _ => code as f64 / 1000.0,
        };
        let mut sent: Vec<f64> = sensor.truth().values.iter().map(|v| mm(v.code)).collect();
        if bench.name == "keyence" {
            // The log has the first amplifier; the second looks 50 readings ahead.
            let second: Vec<f64> = (0..=400).map(|i| f64::from(i) * 0.1 - 20.0).collect();
            sent.extend(second);
        }
        // Rounding of the wire's unit, half of the coarsest.
        let known = |z: f64| z.is_nan() || sent.iter().any(|s| (s - z).abs() < 6e-4);
        let unknown: Vec<&f64> = seen.iter().filter(|&&z| !known(z)).collect();
        assert!(
            unknown.is_empty(),
            "{}: {unknown:?} were never sent",
            bench.name
        );
    }
}

#[test]
fn each_works_with_rubbish_between_messages() {
    works_over("babble=0.05", "rubbish");
}

#[test]
fn each_works_when_bytes_are_lost() {
    works_over("lose=0.0005,split", "loss");
}

#[test]
fn each_tells_of_a_line_at_another_speed_or_parity() {
    for faults in ["baud=1200", "wrong-parity"] {
        all_at_once(|bench| {
            let (_device, link) = bench.plug(&cell(6, faults), "line");
            let told = refusal(&*bench.setup(&link, ""));
            let ends = [
                "check `driver` and `baud`",
                "check power and cable, then retry",
            ];
            assert!(
                ends.iter().any(|end| told.ends_with(end)),
                "{} {faults}: {told}",
                bench.name
            );
        });
    }
}

// ---- Plugs ------------------------------------------------------------------------------------------------------------

const GONE: &str = "it is gone: closed or unplugged; plug it in again and reopen";

#[test]
fn each_survives_unplugging_in_the_middle_of_its_work() {
    let cell = cell(2, "");
    for bench in benches() {
        let (device, link) = bench.plug(&cell, "unplugged");
        let setup = bench.setup(&link, "");
        let mut instrument = open(&*setup, &Cable);
        begin(&mut instrument);
        device.unplug();
        let error = work_until_told(&mut instrument, &cell, &bench);
        assert!(error.may_pass());
        assert!(text(&error).ends_with(GONE), "{}", text(&error));
        drop(instrument);
        device.replug();
        let mut again = reopen(&*setup);
        if let Err(error) = work(&mut again, &cell) {
            panic!("{}: after plugging in again: {}", bench.name, text(&error));
        }
        assert!(device.goes_dark(SOON) || !bench.laser, "{}", bench.name);
    }
}

/// Pulls the plug at one of the driver's writes, and lets the write go on.
struct Pulling<'a> {
    device: &'a Simulated,
    at_write: u32,
}

struct Pulled {
    link: Arc<dyn Link>,
    left: AtomicU32,
    pull: Arc<AtomicU32>,
}

impl Links for Pulling<'_> {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        let link = Cable.open(target)?;
        if self.at_write == 0 {
            self.device.unplug();
        }
        Ok(Arc::new(Pulled {
            link,
            left: AtomicU32::new(self.at_write),
            pull: Arc::new(AtomicU32::new(0)),
        }))
    }
}

impl Link for Pulled {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        match self.pull.load(Ordering::Acquire) {
            0 => self.link.read(buffer, deadline),
            _ => Err(LinkError::Gone),
        }
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        if self.left.load(Ordering::Acquire) > 0 && self.left.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.pull.store(1, Ordering::Release);
        }
        match self.pull.load(Ordering::Acquire) {
            0 => self.link.write(bytes, deadline),
            _ => Err(LinkError::Gone),
        }
    }
}

#[test]
fn each_survives_unplugging_while_it_is_opened() {
    let cell = cell(3, "");
    for bench in benches() {
        let (device, link) = bench.plug(&cell, "opening");
        let setup = bench.setup(&link, "");
        // 0: the cable of the device itself; from 1 on, at each of the first writes.
        for at_write in 0..=3 {
            let device = &device;
            let began = Instant::now();
            let told = match setup.open(&Pulling { device, at_write }) {
                // A gauge that is asked little may be open by then.
                Ok(Instrument::Profiler(mut profiler)) if at_write > 1 => {
                    let begun = profiler.start();
                    let mut instrument = Instrument::Profiler(profiler);
                    let told = |_| work_until_told(&mut instrument, &cell, &bench);
                    text(&begun.map_or_else(|error| error, told))
                }
                Ok(_) => panic!("{}: it opened", bench.name),
                Err(error) => {
                    assert!(error.may_pass(), "{}", text(&error));
                    text(&error)
                }
            };
            assert!(told.ends_with(GONE), "{} at {at_write}: {told}", bench.name);
            assert!(began.elapsed() < SOON);
            device.replug();
            drop(reopen(&*setup));
        }
        let mut again = reopen(&*setup);
        assert!(work(&mut again, &cell).is_ok(), "{}", bench.name);
    }
}

#[test]
fn each_tells_when_its_device_starts_anew() {
    for bench in benches() {
        let Some(expected) = bench.restart else {
            continue;
        };
        let cell = cell(4, "reboot-after=50,reset-in-move=1");
        let (device, link) = bench.plug(&cell, "anew");
        let unlock = match bench.driver.name {
            "grbl-probe" => "unlock_on_open = true",
            _ => "",
        };
        let setup = bench.setup(&link, unlock);
        let mut instrument = open(&*setup, &Cable);
        begin(&mut instrument);
        let error = work_until_told(&mut instrument, &cell, &bench);
        let told = text(&error);
        assert!(told.contains(expected), "{}: {told}", bench.name);
        drop(instrument);
        let mut again = reopen(&*setup);
        if let Err(error) = work(&mut again, &cell) {
            panic!("{}: after its restart: {}", bench.name, text(&error));
        }
        assert!(device.goes_dark(SOON) || !bench.laser, "{}", bench.name);
    }
}

#[test]
fn each_quiets_a_device_that_was_left_streaming() {
    for bench in benches() {
        let cell = cell(4, "autostart");
        let (device, link) = bench.plug(&cell, "left");
        let mut instrument = open(&*bench.setup(&link, ""), &Cable);
        if bench.laser {
            assert!(device.goes_dark(SOON), "{}", bench.name);
        }
        if let Err(error) = work(&mut instrument, &cell) {
            panic!("{}: {}", bench.name, text(&error));
        }
    }
}

// ---- Light ------------------------------------------------------------------------------------------------------------

#[test]
fn each_leaves_the_laser_off_after_stop_and_after_drop() {
    let cell = cell(3, "");
    for bench in benches() {
        let (device, link) = bench.plug(&cell, "dark");
        let setup = bench.setup(&link, "");
        let mut instrument = open(&*setup, &Cable);
        if let Err(error) = work(&mut instrument, &cell) {
            panic!("{}: {}", bench.name, text(&error));
        }
        if !bench.laser {
            continue;
        }
        assert_eq!(device.laser_on(), Some(false), "{} after stop", bench.name);
        begin(&mut instrument);
        assert_eq!(device.laser_on(), Some(true), "{}", bench.name);
        drop(instrument);
        assert_eq!(device.laser_on(), Some(false), "{} after drop", bench.name);
    }
}

/// What the child is told to open, where this test is its own child.
const CHILD: &str = "ACIES_TEST_CHILD";
/// What the child says when its laser is on.
const BEGUN: &str = "begun";

#[test]
fn each_laser_goes_off_after_its_host_was_killed() {
    if let Ok(order) = std::env::var(CHILD) {
        return be_killed(&order);
    }
    let cell = cell(3, "");
    for bench in benches().into_iter().filter(|bench| bench.laser) {
        let (device, link) = bench.plug(&cell, "killed");
        let own = std::env::current_exe().expect("this program");
        let mut child = Command::new(own)
            .args([
                "--exact",
                "conformance::each_laser_goes_off_after_its_host_was_killed",
            ])
            .env(CHILD, format!("{}\n{link}", bench.name))
            .stdout(Stdio::piped())
            .spawn()
            .expect("a child");
        let said = BufReader::new(child.stdout.take().expect("its output"));
        let begun = said
            .lines()
            .map_while(Result::ok)
            .any(|line| line.contains(BEGUN));
        assert!(begun, "{}: the child did not begin", bench.name);
        assert_eq!(device.laser_on(), Some(true), "{}", bench.name);
        child.kill().expect("a kill");
        child.wait().expect("its end");
        if bench.keeps_alive {
            assert!(device.goes_dark(SOON), "{}: by itself", bench.name);
        }
        let instrument = reopen(&*bench.setup(&link, ""));
        assert!(device.goes_dark(SOON), "{}: by the next host", bench.name);
        drop(instrument);
    }
}

/// Opens what it is told, begins, and takes values until it is killed.
fn be_killed(order: &str) {
    let (name, link) = order.split_once('\n').expect("a name and a link");
    let bench = benches().into_iter().find(|bench| bench.name == name);
    let mut instrument = open(&*bench.expect("a bench").setup(link, ""), &Cable);
    begin(&mut instrument);
    let mut out = std::io::stdout();
    writeln!(out, "{BEGUN}")
        .and_then(|()| out.flush())
        .expect("somebody listens");
    let deadline = Instant::now() + 2 * SOON;
    while Instant::now() < deadline {
        if let Instrument::Profiler(profiler) = &mut instrument
            && profiler.next(deadline).is_err()
        {
            return;
        }
    }
}

//! The daemon: every trigger gets one answer, a failed device is a state and never the end, what is announced is stored.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use acies::cell::{
    Command, Daemon, DaemonOptions, DeviceState, Handle, Mode, Refusal, Snapshot, State,
};
use acies::config::Cell;
use acies::inspect::{Request, Start, inspect};
use acies::report::Report;
use acies::report::wire::Status;
use acies::store::{History, Inspection, Order, Phase, ScanReader, Store};
use acies_drivers::capture::{Profile, Touch};
use acies_drivers::device::{
    Claim, Identity, Instrument, Losses, Presence, Probe, Profiler, Setup,
};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::DemoCell;

/// Nothing here takes longer than seconds; a test that waits for this long has failed.
const LONG: Duration = Duration::from_secs(120);

/// Profiles of one scan.
const PROFILES: u32 = 12;

/// What happens to a device, decided by the test.
#[derive(Debug, Default)]
struct Fate {
    absent: AtomicBool,
    /// How often it was pulled and plugged in again: what was opened before is dead.
    pulled: AtomicU32,
    /// The run is lost at this profile, once; 0 = never.
    lost_at: AtomicU32,
    /// The driver panics at this profile, once; 0 = never.
    panics_at: AtomicU32,
    opened: AtomicU32,
    /// Runs wait in their middle while this is set.
    held: Mutex<bool>,
    released: Condvar,
    waiting: Mutex<u32>,
    arrived: Condvar,
}

impl Fate {
    fn hold(&self) {
        *self.held.lock().unwrap() = true;
    }

    fn release(&self) {
        *self.held.lock().unwrap() = false;
        self.released.notify_all();
    }

    /// Returns when a run has come to its middle, `count` times in all.
    fn wait_for_middle(&self, count: u32) {
        let waiting = self.waiting.lock().unwrap();
        let (_count, timeout) = self
            .arrived
            .wait_timeout_while(waiting, LONG, |n| *n < count)
            .unwrap();
        assert!(!timeout.timed_out(), "no run came to its middle");
    }

    fn middle(&self, deadline: Instant) -> bool {
        let held = self.held.lock().unwrap();
        let left = deadline.saturating_duration_since(Instant::now());
        let (held, _) = self
            .released
            .wait_timeout_while(held, left, |held| *held)
            .unwrap();
        !*held
    }
}

#[derive(Debug)]
struct Played {
    name: &'static str,
    fate: Arc<Fate>,
    probe: bool,
}

impl Setup for Played {
    fn claims(&self) -> Vec<Claim> {
        Vec::new()
    }

    fn open(&self, _: &dyn Links) -> Result<Instrument, DeviceError> {
        if self.fate.absent.load(Ordering::Acquire) {
            return Err(gone(self.name));
        }
        self.fate.opened.fetch_add(1, Ordering::AcqRel);
        let identity = Identity {
            vendor: "test".to_owned(),
            model: "played".to_owned(),
            serial: self.name.to_owned(),
            firmware: String::new(),
        };
        let device = Device {
            identity,
            fate: self.fate.clone(),
            pulled: self.fate.pulled.load(Ordering::Acquire),
            name: self.name,
            sent: 0,
            counted: false,
        };
        Ok(if self.probe {
            Instrument::Probe(Box::new(device))
        } else {
            Instrument::Profiler(Box::new(device))
        })
    }
}

fn gone(name: &str) -> DeviceError {
    DeviceError::Silent {
        port: name.to_owned(),
        deadline_s: 0.5,
    }
}

struct Device {
    identity: Identity,
    fate: Arc<Fate>,
    pulled: u32,
    name: &'static str,
    sent: u32,
    counted: bool,
}

impl Device {
    fn alive(&self) -> Result<(), DeviceError> {
        match self.pulled == self.fate.pulled.load(Ordering::Acquire) {
            true => Ok(()),
            false => Err(gone(self.name)),
        }
    }
}

impl Profiler for Device {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        self.alive()?;
        (self.sent, self.counted) = (0, false);
        Ok(())
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        if self.sent == PROFILES / 2 {
            if !self.counted {
                self.counted = true;
                *self.fate.waiting.lock().unwrap() += 1;
                self.fate.arrived.notify_all();
            }
            if !self.fate.middle(deadline) {
                return Ok(None);
            }
        }
        let now = self.sent + 1;
        let takes = |fate: &AtomicU32| {
            fate.compare_exchange(now, 0, Ordering::AcqRel, Ordering::Acquire)
                .is_ok()
        };
        if takes(&self.fate.lost_at) {
            return Err(gone(self.name));
        }
        assert!(
            !takes(&self.fate.panics_at),
            "a driver with a fault, as the test wants it"
        );
        self.sent += 1;
        let columns = 2;
        Ok(Some(Profile {
            sequence: self.sent - 1,
            boot: 1,
            device_time_ns: u64::from(self.sent),
            encoder: Some(i64::from(self.sent) * 500),
            host_time: Instant::now(),
            dropped: 0,
            saturated: false,
            x_mm: (0..columns).map(|i| f64::from(i) - 12.0).collect(),
            z_mm: (0..columns)
                .map(|i| 150.0 + f64::from(i % 3) * 0.01)
                .collect(),
            intensity: Vec::new(),
        }))
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        Ok(Vec::new())
    }

    fn losses(&self) -> Losses {
        Losses {
            received: u64::from(self.sent),
            ..Losses::default()
        }
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        self.alive().map(|()| Presence::Answered)
    }
}

impl Probe for Device {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn touch(
        &mut self,
        start_mm: [f64; 3],
        target_mm: [f64; 3],
        _: Duration,
    ) -> Result<Touch, DeviceError> {
        let (start, target) = (glam::DVec3::from(start_mm), glam::DVec3::from(target_mm));
        Ok(Touch {
            tip_centre_mm: (0.5 * (start + target)).to_array(),
            direction: (target - start).normalize().to_array(),
            host_time: Instant::now(),
        })
    }

    fn scan_line(
        &mut self,
        _: [f64; 3],
        _: [f64; 3],
        _: [f64; 3],
        _: f64,
        _: Duration,
    ) -> Result<Vec<Touch>, DeviceError> {
        Ok(Vec::new())
    }
}

/// A cell of two played profilers and a played probe in a folder of its own.
struct Bench {
    folder: PathBuf,
    left: Arc<Fate>,
    right: Arc<Fate>,
    daemon: Option<Daemon>,
    handle: Handle,
    runtime: tokio::runtime::Runtime,
}

impl Bench {
    fn new(name: &str) -> Self {
        Self::with(name, |_, _| {})
    }

    fn with(name: &str, change: impl FnOnce(&Fate, &Fate)) -> Self {
        let folder = std::env::temp_dir().join(format!("acies-cell-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("a folder");
        for file in ["cell.toml", "recipe.toml", "part.step"] {
            let from = Path::new(env!("CARGO_MANIFEST_DIR"))
                .join("configs/demo")
                .join(file);
            fs::copy(from, folder.join(file)).expect("the demo's file");
        }
        let (left, right) = (Arc::new(Fate::default()), Arc::new(Fate::default()));
        change(&left, &right);
        let (daemon, handle) = start(&folder, &left, &right);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .expect("a runtime");
        Self {
            folder,
            left,
            right,
            daemon: Some(daemon),
            handle,
            runtime,
        }
    }

    /// Ends the daemon and starts it again on the same store.
    fn restart(&mut self) {
        self.daemon = None;
        let (daemon, handle) = start(&self.folder, &self.left, &self.right);
        (self.daemon, self.handle) = (Some(daemon), handle);
    }

    fn until(&self, what: &str, is_so: impl Fn(&Snapshot) -> bool) -> Snapshot {
        let mut follow = self.handle.follow();
        let waited = self.runtime.block_on(async {
            let wait = follow.wait_for(|snapshot| is_so(snapshot));
            tokio::time::timeout(LONG, wait)
                .await
                .map(|found| found.map(|s| Snapshot::clone(&s)))
        });
        match waited {
            Ok(found) => found.expect("a daemon that runs"),
            Err(_) => panic!("{what}: never so, but {:#?}", self.handle.snapshot()),
        }
    }

    fn ready(&self) -> Snapshot {
        self.until("ready", |snapshot| snapshot.state == State::Ready)
    }

    fn start(&self, serial: &str) -> Result<Inspection, (Refusal, Option<Box<Inspection>>)> {
        self.start_as(serial, None, Mode::Single)
    }

    fn start_as(
        &self,
        serial: &str,
        key: Option<&str>,
        mode: Mode,
    ) -> Result<Inspection, (Refusal, Option<Box<Inspection>>)> {
        let order = Order {
            part_serial: serial.to_owned(),
            ..Order::default()
        };
        let key = key.map(str::to_owned);
        self.runtime
            .block_on(self.handle.start(order, "anna", key, mode))
            .map(|(inspection, _)| inspection)
    }

    fn command(&self, command: Command) {
        self.runtime
            .block_on(self.handle.command(command, "berta"))
            .expect("taken");
    }

    /// Waits until the inspection has ended, and says how.
    fn ended(&self, id: i64) -> Inspection {
        self.until("ended", |snapshot| {
            let under_way = snapshot
                .acquiring
                .iter()
                .chain(&snapshot.computing)
                .chain(&snapshot.queue);
            !under_way.into_iter().any(|job| job.id == id)
        });
        self.handle
            .store()
            .inspection(id)
            .expect("it is in the history")
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.left.release();
        self.right.release();
        self.daemon = None;
        let _ = fs::remove_dir_all(&self.folder);
    }
}

fn start(folder: &Path, left: &Arc<Fate>, right: &Arc<Fate>) -> (Daemon, Handle) {
    let mut cell = Cell::read(&folder.join("cell.toml")).expect("the demo's cell");
    let played = |name, fate: &Arc<Fate>, probe| {
        let fate = fate.clone();
        Box::new(Played { name, fate, probe })
    };
    cell.profilers[0].setup = played("left", left, false);
    cell.profilers[1].setup = played("right", right, false);
    cell.probes[0].setup = played("probe", &Arc::new(Fate::default()), true);
    cell.plan.end_count = i64::from(PROFILES) * 500;
    let store = Arc::new(Store::open(&folder.join("store")).expect("a store"));
    let options = DaemonOptions {
        queue_limit: 2,
        ..DaemonOptions::default()
    };
    let daemon = Daemon::start(Arc::new(cell), store, Arc::new(Cable), options).expect("a daemon");
    let handle = daemon.handle();
    (daemon, handle)
}

#[test]
fn a_trigger_ends_in_a_result_that_is_stored_with_its_raw_data() {
    let bench = Bench::new("result");
    bench.ready();
    let asked = bench.start("A-1").expect("taken");
    assert_eq!(asked.phase, Phase::Queued);
    let ended = bench.ended(asked.id);
    assert_eq!(ended.phase, Phase::Done, "{}", ended.reason);
    // Two strips of a plane are no part: an honest cell does not decide.
    assert_eq!(ended.verdict, Some(Status::NotDecidable));
    assert!(ended.requested <= ended.started.clone().expect("begun"));
    assert!(ended.acquired.expect("acquired") <= ended.ended.expect("ended"));
    let store = bench.handle.store();
    let report: Report =
        serde_json::from_str(&store.report_json(asked.id).expect("a report")).expect("JSON");
    assert_eq!(
        (report.part.as_str(), report.verdict),
        ("A-1", Status::NotDecidable)
    );
    assert_eq!(report.scan.points as i64, ended.points.expect("points"));
    bench.until("raw data noted", |_| store.scan_path(asked.id).is_ok());
    let reader = ScanReader::open(&store.scan_path(asked.id).expect("raw data")).expect("a scan");
    assert_eq!(
        reader.into_cloud().expect("points").len(),
        report.scan.points
    );
}

#[test]
fn a_cell_without_devices_starts_says_why_and_goes_on_when_they_come() {
    let bench = Bench::with("absent", |left, _| {
        left.absent.store(true, Ordering::Release)
    });
    let snapshot = bench.until("failed", |snapshot| snapshot.state == State::Error);
    assert!(
        snapshot
            .cause
            .starts_with("device \"left\": left: no answer"),
        "{}",
        snapshot.cause
    );
    assert!(
        snapshot.cause.contains("check power and cable"),
        "{}",
        snapshot.cause
    );
    assert!(!snapshot.accepts && !snapshot.advice.is_empty());
    let (refusal, kept) = bench.start("A-1").expect_err("not ready");
    assert!(matches!(refusal, Refusal::NotReady { .. }));
    let kept = kept.expect("the refusal is kept");
    assert_eq!(kept.phase, Phase::Refused);
    assert!(kept.reason.contains("left"), "{}", kept.reason);
    bench.left.absent.store(false, Ordering::Release);
    bench.command(Command::Reset);
    bench.ready();
    let id = bench.start("A-1").expect("taken now").id;
    assert_eq!(bench.ended(id).phase, Phase::Done);
}

#[test]
fn parts_wait_in_order_up_to_a_limit() {
    let bench = Bench::new("queue");
    bench.ready();
    bench.left.hold();
    let ids: Vec<i64> = ["A", "B", "C"]
        .map(|serial| bench.start(serial).expect("taken").id)
        .to_vec();
    bench.until("the first is at work", |snapshot| {
        snapshot
            .acquiring
            .as_ref()
            .is_some_and(|job| job.id == ids[0])
    });
    let (refusal, _) = bench.start("D").expect_err("two wait already");
    assert_eq!(refusal, Refusal::QueueFull { limit: 2 });
    let (refusal, kept) = bench.start("  ").expect_err("a part without a name");
    assert!(kept.is_some());
    assert!(matches!(
        refusal,
        Refusal::QueueFull { .. } | Refusal::NoSerial
    ));
    bench.left.release();
    let ended: Vec<Inspection> = ids.iter().map(|id| bench.ended(*id)).collect();
    assert!(
        ended
            .iter()
            .all(|inspection| inspection.phase == Phase::Done)
    );
    assert!(ended.is_sorted_by_key(|inspection| inspection.started.clone()));
    let refusals = History {
        limit: Some(500),
        ..History::default()
    };
    let all = bench
        .handle
        .store()
        .history(&refusals)
        .expect("the history");
    let refused = all.iter().filter(|i| i.phase == Phase::Refused).count();
    assert_eq!((all.len(), refused), (5, 2), "one answer for each trigger");
}

#[test]
fn a_part_without_a_serial_number_is_refused() {
    let bench = Bench::new("serial");
    bench.ready();
    let (refusal, kept) = bench.start("  ").expect_err("a part without a name");
    assert_eq!(refusal, Refusal::NoSerial);
    assert_eq!(kept.map(|kept| kept.phase), Some(Phase::Refused));
}

#[test]
fn a_repeated_trigger_is_one_inspection() {
    let bench = Bench::new("repeated");
    bench.ready();
    let first = bench
        .start_as("A", Some("key"), Mode::Single)
        .expect("taken");
    let again = bench
        .start_as("A", Some("key"), Mode::Single)
        .expect("known");
    assert_eq!(first.id, again.id);
    bench.ended(first.id);
    let later = bench
        .start_as("A", Some("key"), Mode::Single)
        .expect("known");
    assert_eq!((later.id, later.phase), (first.id, Phase::Done));
}

#[test]
fn stop_finishes_the_part_and_abort_drops_it() {
    let bench = Bench::new("stop");
    bench.ready();
    bench.left.hold();
    let finished = bench.start("A").expect("taken").id;
    let waiting = bench.start("B").expect("taken").id;
    bench.left.wait_for_middle(1);
    bench.command(Command::Stop);
    let waited = bench.ended(waiting);
    assert_eq!(
        (waited.phase, waited.reason.as_str()),
        (Phase::Aborted, "stopped by berta")
    );
    bench.left.release();
    assert_eq!(bench.ended(finished).phase, Phase::Done);

    bench.left.hold();
    let dropped = bench.start("C").expect("taken").id;
    bench.left.wait_for_middle(2);
    bench.command(Command::Abort);
    let dropped = bench.ended(dropped);
    assert_eq!(dropped.phase, Phase::Aborted);
    assert!(
        dropped.reason.starts_with("aborted while scanning"),
        "{}",
        dropped.reason
    );
    let store = bench.handle.store();
    bench.until("raw data noted", |_| store.scan_path(dropped.id).is_ok());
    assert_eq!(
        store.inspection(dropped.id).expect("it").scan_whole,
        Some(false),
        "the raw data are kept"
    );
    bench.left.release();
    bench.ready();
}

#[test]
fn a_halted_cell_takes_nothing_until_it_is_reset() {
    let bench = Bench::new("halt");
    bench.ready();
    bench.command(Command::Halt);
    let snapshot = bench.until("halted", |snapshot| snapshot.state == State::Halted);
    assert_eq!(snapshot.cause, "halted by berta");
    assert!(bench.start("A").is_err());
    bench.command(Command::Reset);
    bench.ready();
}

#[test]
fn a_device_lost_in_mid_scan_aborts_the_part_and_comes_back_by_itself() {
    let bench = Bench::new("lost");
    bench.ready();
    for round in 0..3 {
        bench
            .right
            .lost_at
            .store(PROFILES / 2 + 3, Ordering::Release);
        let id = bench.start(&format!("A-{round}")).expect("taken").id;
        let aborted = bench.ended(id);
        assert_eq!(aborted.phase, Phase::Aborted);
        assert!(
            aborted
                .reason
                .starts_with("device \"right\" was lost during the scan: right: no answer"),
            "{}",
            aborted.reason
        );
        bench.ready();
        let id = bench.start(&format!("B-{round}")).expect("taken").id;
        assert_eq!(bench.ended(id).phase, Phase::Done);
    }
    assert!(bench.right.opened.load(Ordering::Acquire) >= 4);
}

#[test]
fn a_device_pulled_and_plugged_in_between_two_parts_costs_none() {
    let bench = Bench::new("pulled");
    bench.ready();
    for round in 0..3 {
        bench.left.pulled.fetch_add(1, Ordering::AcqRel);
        let id = bench.start(&format!("A-{round}")).expect("taken").id;
        assert_eq!(bench.ended(id).phase, Phase::Done);
    }
    assert!(bench.left.opened.load(Ordering::Acquire) >= 4);
    // Pulled, and not back.
    bench.left.absent.store(true, Ordering::Release);
    bench.left.pulled.fetch_add(1, Ordering::AcqRel);
    let id = bench.start("B").expect("nobody has noticed yet").id;
    let aborted = bench.ended(id);
    assert_eq!(aborted.phase, Phase::Aborted);
    assert!(
        (aborted.reason).starts_with("device \"left\" went away just now: left: no answer"),
        "{}",
        aborted.reason
    );
    bench.until("failed", |snapshot| snapshot.state == State::Error);
    bench.left.absent.store(false, Ordering::Release);
    bench.command(Command::Reset);
    bench.ready();
    let id = bench.start("C").expect("taken").id;
    assert_eq!(bench.ended(id).phase, Phase::Done);
}

#[test]
fn a_fault_of_the_program_ends_one_part_and_not_the_daemon() {
    let bench = Bench::new("panic");
    bench.ready();
    bench.left.panics_at.store(5, Ordering::Release);
    let id = bench.start("A").expect("taken").id;
    let aborted = bench.ended(id);
    assert_eq!(aborted.phase, Phase::Aborted);
    assert!(
        aborted.reason.contains("a fault of the program"),
        "{}",
        aborted.reason
    );
    bench.ready();
    let id = bench.start("B").expect("taken").id;
    assert_eq!(bench.ended(id).phase, Phase::Done);
}

#[test]
fn continuous_mode_goes_on_until_it_is_stopped() {
    let bench = Bench::new("continuous");
    bench.ready();
    let first = bench
        .start_as("A", None, Mode::Continuous)
        .expect("taken")
        .id;
    bench.until("the third part", |snapshot| {
        snapshot
            .acquiring
            .as_ref()
            .is_some_and(|job| job.id >= first + 2)
    });
    assert_eq!(bench.handle.snapshot().state, State::ContinuousExecution);
    bench.command(Command::Stop);
    bench.ready();
    let all = bench
        .handle
        .store()
        .history(&History::default())
        .expect("the history");
    let serials: Vec<&str> = all
        .iter()
        .rev()
        .take(3)
        .map(|i| i.part_serial.as_str())
        .collect();
    assert_eq!(serials, ["A", "A-2", "A-3"]);
}

#[test]
fn a_wrong_recipe_leaves_the_last_good_one_active() {
    let mut bench = Bench::new("recipe");
    let good = bench.ready().recipe.expect("the configured one");
    let file = bench.folder.join("recipe.toml");
    let text = fs::read_to_string(&file).expect("the recipe");
    fs::write(&file, format!("{text}\nnonsense = 3\n")).expect("spoiled");
    bench.handle.reload().expect("the store is well");
    let snapshot = bench.until("said", |snapshot| !snapshot.recipe_problem.is_empty());
    assert!(
        snapshot.recipe_problem.contains("nonsense"),
        "{}",
        snapshot.recipe_problem
    );
    assert_eq!(snapshot.recipe.expect("still there").id, good.id);
    bench.restart();
    let snapshot = bench.ready();
    assert_eq!(snapshot.recipe.expect("still there").sha256, good.sha256);
    fs::write(&file, format!("{text}\n# wider\n")).expect("mended");
    bench.handle.reload().expect("reloaded");
    let snapshot = bench.until("active", |snapshot| {
        snapshot.recipe.as_ref().is_some_and(|r| r.version == 2)
    });
    assert_eq!(snapshot.recipe_problem, "");
    let newest = bench
        .handle
        .store()
        .audit_log(None, 1)
        .expect("the audit log")
        .remove(0);
    assert_eq!(
        (newest.person.as_str(), newest.action.as_str()),
        ("configuration", "recipe.activate")
    );
    fs::write(&file, &text).expect("as it was at first");
    bench.handle.reload().expect("reloaded");
    bench.until("the first again", |snapshot| {
        snapshot
            .recipe
            .as_ref()
            .is_some_and(|recipe| recipe.id == good.id)
    });
}

#[test]
fn devices_are_busy_while_they_work() {
    let bench = Bench::new("busy");
    bench.ready();
    bench.left.hold();
    let id = bench.start("A").expect("taken").id;
    bench.left.wait_for_middle(1);
    let snapshot = bench.until("scanning", |s| {
        s.acquiring
            .as_ref()
            .is_some_and(|job| job.step == "scanning")
    });
    assert_eq!(snapshot.state, State::SingleExecution);
    assert!(
        snapshot
            .devices
            .iter()
            .all(|device| device.state == DeviceState::Busy)
    );
    assert!(snapshot.accepts, "a trigger may wait");
    bench.left.release();
    bench.ended(id);
    let snapshot = bench.ready();
    // A view is read until the others have come to their end too.
    assert!(snapshot.devices[0].received >= u64::from(PROFILES));
}

#[test]
fn a_daemon_that_ends_in_mid_scan_leaves_an_aborted_part() {
    let mut bench = Bench::new("ends");
    bench.ready();
    bench.left.hold();
    let id = bench.start("A").expect("taken").id;
    bench.left.wait_for_middle(1);
    bench.restart();
    bench.left.release();
    let inspection = bench
        .handle
        .store()
        .inspection(id)
        .expect("it is in the history");
    assert_eq!(inspection.phase, Phase::Aborted);
    assert_eq!(inspection.scan_whole, Some(false));
}

#[test]
fn what_was_measured_during_the_scan_is_what_is_measured_after_it() {
    let folder = std::env::temp_dir().join(format!("acies-meanwhile-{}", std::process::id()));
    fs::create_dir_all(folder.join("dev")).unwrap();
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    for file in ["cell.toml", "recipe.toml", "part.step"] {
        fs::copy(configs.join(file), folder.join(file)).unwrap();
    }
    // Stations of a given length: their number does not hang on the last digit of the spacing.
    let recipe = fs::read_to_string(folder.join("recipe.toml")).unwrap();
    let recipe = format!("station_step_mm = 2.0\n{recipe}");
    fs::write(folder.join("recipe.toml"), recipe).unwrap();
    let playing = DemoCell::new(5).start(&folder.join("dev")).unwrap();
    let cell = Cell::read(&folder.join("cell.toml")).unwrap();
    let outcome = acies::cell::run(&cell, &Cable, &mut |_| {}).unwrap();
    drop(playing);
    let meanwhile = &outcome.inspection;
    let start = Start::Rough(cell.machine_from_part.inverse());
    let request = Request {
        touches: &outcome.touches,
        ..Request::new(&outcome.part.recipe, start)
    };
    let afterwards = inspect(&outcome.scan.cloud, &outcome.part.nominal, &request);
    assert_eq!(meanwhile.verdict, afterwards.verdict);
    assert_eq!(meanwhile.alignment.status, afterwards.alignment.status);
    let (mut compared, mut unequal, mut squares) = (0, 0, 0.0);
    for (a, b) in meanwhile.edges.iter().zip(&afterwards.edges) {
        assert_eq!(a.stations.len(), b.stations.len());
        for (a, b) in a.stations.iter().zip(&b.stations) {
            let (Some(a), Some(b)) = (&a.measured, &b.measured) else {
                // The same verge decides beside a corner whether any point is left.
                unequal += u32::from(a.measured.is_some() != b.measured.is_some());
                continue;
            };
            compared += 1;
            for i in 0..2 {
                // Poses and noise come from other choices of the same points. A station whose transition zone ends on the verge of
                // what noise hides may then be cut elsewhere; both values stay within their uncertainties.
                let apart = (a.d_mm[i] - b.d_mm[i]).abs() / a.u_d_mm[i].max(b.u_d_mm[i]);
                assert!(apart < 3.0, "{a:?} {b:?}");
                squares += apart * apart;
            }
        }
    }
    assert!(compared > 200, "{compared}");
    let rms = (squares / f64::from(2 * compared)).sqrt();
    assert!(50 * unequal < compared, "{unequal} of {compared}");
    assert!(rms < 0.3, "{rms} of the standard uncertainty");
    fs::remove_dir_all(&folder).unwrap();
}

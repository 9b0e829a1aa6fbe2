//! What the benches of the cell share: the demo's cell with its simulated devices in this process, a daemon, and what that takes.

#![allow(dead_code)] // no bench needs all of it

use std::any::Any;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use acies::cell::{Daemon, DaemonOptions, Handle, Mode, Refusal, Snapshot, State};
use acies::config::Cell;
use acies::store::{Inspection, Order, Store};
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::DemoCell;
use acies_simulators::wire::Wire;

/// The program's allocator: memory is looked at as it is there.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Longer than anything here may take.
const LONG: Duration = Duration::from_secs(120);

/// A new folder with the demo's files, the cell's text changed by `change`.
pub fn files(name: &str, change: impl FnOnce(String) -> String) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("acies-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    files_in(&folder, change);
    folder
}

/// The demo's files in `folder`, which may be there already.
pub fn files_in(folder: &Path, change: impl FnOnce(String) -> String) {
    std::fs::create_dir_all(folder.join("dev")).expect("a folder");
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    for file in ["recipe.toml", "part.step"] {
        std::fs::copy(configs.join(file), folder.join(file)).expect("the demo's file");
    }
    let text = std::fs::read_to_string(configs.join("cell.toml")).expect("the demo's cell");
    std::fs::write(folder.join("cell.toml"), change(text)).expect("the cell's file");
}

/// The demo's cell with profiles 0.8 mm apart of 500 columns, so that a part is measured in a fraction of a second.
pub fn coarse(text: String) -> String {
    let profiles = "encoder_step = 400\ncolumns = 500\nrate_hz = 12.0";
    let text = text.replace("encoder_step = 200", profiles);
    // Where the last profile stands now.
    text.replace("end_count = 47200", "end_count = 46800")
}

/// A daemon on the cell in `folder`, and a client of it.
pub struct Running {
    pub handle: Handle,
    runtime: tokio::runtime::Runtime,
    _daemon: Daemon,
}

impl Running {
    pub fn start(folder: &Path) -> Self {
        let cell = Cell::read(&folder.join("cell.toml")).expect("the cell");
        let store = Arc::new(Store::open(&cell.service.store).expect("the store"));
        let options = DaemonOptions {
            simulated: true,
            retention: cell.service.retention,
            ..DaemonOptions::default()
        };
        let daemon = Daemon::start(Arc::new(cell), store, Arc::new(Cable), options);
        let daemon = daemon.expect("a daemon");
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .expect("a runtime");
        Self {
            handle: daemon.handle(),
            runtime,
            _daemon: daemon,
        }
    }

    /// Waits until the cell is so.
    pub fn until(&self, what: &str, is_so: impl Fn(&Snapshot) -> bool) {
        let mut follow = self.handle.follow();
        let waited = self.runtime.block_on(async {
            let wait = follow.wait_for(|snapshot| is_so(snapshot));
            let waited = tokio::time::timeout(LONG, wait).await;
            waited.map(|found| found.map(|_| ()))
        });
        let snapshot = || self.handle.snapshot();
        assert!(waited.is_ok(), "{what} did not come: {:#?}", snapshot());
    }

    /// An inspection as the history has it.
    pub fn inspection(&self, id: i64) -> Inspection {
        let found = self.handle.store().inspection(id);
        found.expect("in the history")
    }

    /// Starts a part as soon as the cell is ready; gives the number of its inspection.
    pub fn start_part(&self, serial: &str) -> i64 {
        loop {
            self.until("ready", |snapshot| snapshot.state == State::Ready);
            let order = Order {
                part_serial: serial.to_owned(),
                ..Order::default()
            };
            let started = self.handle.start(order, "bench", None, Mode::Single);
            // A device that went away while nobody needed it may be found out just now.
            match self.runtime.block_on(started) {
                Ok((inspection, _)) => return inspection.id,
                Err((refusal, _)) => {
                    assert!(matches!(refusal, Refusal::NotReady { .. }), "{refusal}");
                }
            }
        }
    }
}

/// Whether an inspection has ended, in whatever way.
pub fn ended(snapshot: &Snapshot, id: i64) -> bool {
    !acquiring(snapshot, id) && !snapshot.computing.iter().any(|job| job.id == id)
}

/// Whether the devices still work for an inspection, or it waits for them.
pub fn acquiring(snapshot: &Snapshot, id: i64) -> bool {
    let jobs = snapshot.acquiring.iter().chain(&snapshot.queue);
    jobs.into_iter().any(|job| job.id == id)
}

/// The demo's devices, each under a pseudo-terminal, as long as they are plugged in.
pub struct Played {
    ports: [PathBuf; 3],
    devices: [Option<Box<dyn Any>>; 3],
}

impl Played {
    pub fn new(demo: &DemoCell, folder: &Path) -> Self {
        let mut played = Self {
            ports: DemoCell::ports(&folder.join("dev")),
            devices: [None, None, None],
        };
        for device in 0..3 {
            played.plug(demo, device);
        }
        played
    }

    pub fn unplug(&mut self, device: usize) {
        self.devices[device] = None;
    }

    pub fn plug(&mut self, demo: &DemoCell, device: usize) {
        let wire = Wire::pty(&self.ports[device]).expect("a pseudo-terminal");
        self.devices[device] = Some(match device {
            2 => Box::new(demo.start_probe(wire).expect("the probe")),
            which => Box::new(demo.start_profiler(which, wire).expect("a profiler")),
        });
    }
}

/// What this process takes, simulators included.
#[derive(Debug, Clone, Copy)]
pub struct Taken {
    pub resident_kb: u64,
    pub files: usize,
    pub threads: u64,
}

impl Taken {
    pub fn now() -> Self {
        let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        let value = |key: &str| {
            let line = status.lines().find(|line| line.starts_with(key));
            let word = line.and_then(|line| line.split_whitespace().nth(1));
            word.and_then(|word| word.parse().ok()).unwrap_or(0)
        };
        Self {
            resident_kb: value("VmRSS:"),
            files: std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count),
            threads: value("Threads:"),
        }
    }
}

impl std::fmt::Display for Taken {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Taken {
            resident_kb,
            files,
            threads,
        } = self;
        write!(
            f,
            "{resident_kb} kB resident, {files} files, {threads} threads"
        )
    }
}

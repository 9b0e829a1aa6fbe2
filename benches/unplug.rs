//! `cargo bench --bench unplug [-- ROUNDS]`: each of the demo's simulated devices is unplugged in mid-job and plugged in again, so many
//! times; the daemon runs on. Counts how the inspections ended, and looks at the daemon's memory and open files.
//!
//! A device is unplugged by taking its pseudo-terminal away, and returns under the same name. The probe is done within milliseconds
//! here: where it goes after its last touch the part is measured.

#![allow(clippy::print_stdout)] // what a bench is for

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use acies::cell::{Daemon, DaemonOptions, Mode, Refusal, Snapshot, State};
use acies::config::Cell;
use acies::store::{Order, Phase, Store};
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::wire::Wire;

/// Longer than anything here may take.
const LONG: Duration = Duration::from_secs(60);

fn main() {
    let rounds: u32 = std::env::args()
        .filter_map(|a| a.parse().ok())
        .next()
        .unwrap_or(100);
    let folder = std::env::temp_dir().join(format!("acies-unplug-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(folder.join("dev")).expect("a folder");
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    for file in ["cell.toml", "recipe.toml", "part.step"] {
        std::fs::copy(configs.join(file), folder.join(file)).expect("the demo's file");
    }
    let demo = DemoCell::with_options(DemoOptions::new(1));
    let ports = DemoCell::ports(&folder.join("dev"));
    let mut played = Played::new(&demo, ports);
    let cell = Cell::read(&folder.join("cell.toml")).expect("the cell");
    let store = Arc::new(Store::open(&folder.join("store")).expect("the store"));
    let options = DaemonOptions {
        simulated: true,
        ..DaemonOptions::default()
    };
    let daemon = Daemon::start(Arc::new(cell), store, Arc::new(Cable), options).expect("a daemon");
    let handle = daemon.handle();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .expect("a runtime");
    let until = |what: &str, is_so: &dyn Fn(&Snapshot) -> bool| {
        let mut follow = handle.follow();
        let waited = runtime.block_on(async {
            tokio::time::timeout(LONG, follow.wait_for(|s| is_so(s)))
                .await
                .map(|found| found.map(|_| ()))
        });
        assert!(
            waited.is_ok(),
            "{what}: not within a minute: {:#?}",
            handle.snapshot()
        );
    };
    let measure = |serial: String| {
        loop {
            until("ready", &|s| s.state == State::Ready);
            let order = Order {
                part_serial: serial.clone(),
                ..Order::default()
            };
            // A device that went away while nobody needed it may be found out just now.
            match runtime.block_on(handle.start(order, "bench", None, Mode::Single)) {
                Ok((inspection, _)) => return inspection.id,
                Err((refusal, _)) => {
                    assert!(matches!(refusal, Refusal::NotReady { .. }), "{refusal}")
                }
            }
        }
    };
    until("ready", &|s| s.state == State::Ready);
    let first = measure("first".to_owned());
    until("measured", &|s| ended(s, first));
    println!("start: {}", process());
    for (device, name) in ["left", "right", "probe"].into_iter().enumerate() {
        let (mut aborted, mut other, mut named) = (0, 0, 0);
        let mut back: Vec<f64> = Vec::new();
        for round in 0..rounds {
            let id = measure(format!("{name}-{round}"));
            let step = if device == 2 { "touching" } else { "scanning" };
            until("at work", &|s| {
                ended(s, id)
                    || s.acquiring.as_ref().is_some_and(|job| {
                        job.id == id && job.step == step && (device == 2 || job.share > 0.1)
                    })
            });
            played.unplug(device);
            until("ended", &|s| ended(s, id));
            let inspection = handle.store().inspection(id).expect("in the history");
            match inspection.phase {
                Phase::Aborted => aborted += 1,
                _ => other += 1,
            }
            named += u32::from(inspection.reason.contains(&format!("{name:?}")));
            played.plug(&demo, device);
            let began = Instant::now();
            until("ready again", &|s| s.state == State::Ready);
            back.push(began.elapsed().as_secs_f64());
        }
        back.sort_by(f64::total_cmp);
        println!(
            "{name}: {rounds} times unplugged: {aborted} aborted ({named} name it), {other} otherwise; ready {:.2} s after it came back (median), {:.2} s (worst); {}",
            back[back.len() / 2],
            back[back.len() - 1],
            process()
        );
    }
    let last = measure("last".to_owned());
    until("measured", &|s| ended(s, last));
    let inspection = handle.store().inspection(last).expect("in the history");
    println!(
        "afterwards a part is measured: {:?} {:?}",
        inspection.phase, inspection.verdict
    );
    drop((handle, daemon));
    let _ = std::fs::remove_dir_all(&folder);
}

fn ended(snapshot: &Snapshot, id: i64) -> bool {
    let under_way = snapshot
        .acquiring
        .iter()
        .chain(&snapshot.computing)
        .chain(&snapshot.queue);
    !under_way.into_iter().any(|job| job.id == id)
}

/// Resident memory, open files and threads of this process, simulators included.
fn process() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let value = |key: &str| {
        let line = status.lines().find(|line| line.starts_with(key));
        line.and_then(|line| line.split_whitespace().nth(1))
            .unwrap_or("?")
            .to_owned()
    };
    let files = std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
    format!(
        "{} kB resident, {files} files, {} threads",
        value("VmRSS:"),
        value("Threads:")
    )
}

/// The simulated devices that are plugged in.
struct Played {
    ports: [PathBuf; 3],
    devices: [Option<Box<dyn std::any::Any>>; 3],
}

impl Played {
    fn new(demo: &DemoCell, ports: [PathBuf; 3]) -> Self {
        let mut played = Self {
            ports,
            devices: [None, None, None],
        };
        for device in 0..3 {
            played.plug(demo, device);
        }
        played
    }

    fn unplug(&mut self, device: usize) {
        self.devices[device] = None;
    }

    fn plug(&mut self, demo: &DemoCell, device: usize) {
        let wire = Wire::pty(&self.ports[device]).expect("a pseudo-terminal");
        self.devices[device] = Some(match device {
            2 => Box::new(demo.start_probe(wire).expect("the probe")),
            which => Box::new(demo.start_profiler(which, wire).expect("a profiler")),
        });
    }
}

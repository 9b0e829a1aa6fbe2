//! `cargo bench --bench latency [-- ROUNDS]`: the demo's part scanned in real time, 2,000,000 points in about 10 s; time from the last
//! profile to the committed verdict, and what the daemon takes of the processor meanwhile. `-- stages` gives one run's seconds by stage,
//! `-- page` serves the page besides and opens it in two browsers (Chromium, headless) on the same machine.
//!
//! Simulated devices run in the same process on the same cores; their share is in the processor time shown, that of browsers is not.

#![allow(clippy::print_stdout)] // what a bench is for

use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use acies::cell::{self, Daemon, DaemonOptions, Handle, Mode, Snapshot, State};
use acies::config::{Cell, Service};
use acies::store::{Order, Store};
use acies::web;
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::grbl::SimulatedProbe;
use acies_simulators::open_profile::SimulatedProfiler;
use acies_simulators::wire::Wire;

/// Points of a profile.
const COLUMNS: u32 = 3200;
/// Encoder counts between profiles, of 0.002 mm: 0.124 mm, four times what lies between two points of a profile.
const STEP: &str = "62";
/// Profiles a second: the 760 of a scan take 10 s.
const RATE: &str = "76.0";
/// Longer than anything here may take.
const LONG: Duration = Duration::from_secs(120);

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let rounds = arguments.iter().find_map(|a| a.parse().ok()).unwrap_or(50);
    let folder = std::env::temp_dir().join(format!("acies-latency-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    let stages = arguments.iter().any(|a| a == "stages");
    let (playing, cell) = set_up(&folder, !stages);
    if stages {
        by_stage(&cell);
    } else {
        let page = arguments.iter().any(|a| a == "page");
        in_the_daemon(cell, &folder, rounds, page);
    }
    drop(playing);
    let _ = std::fs::remove_dir_all(&folder);
}

/// The demo's cell with finer profiles.
fn set_up(folder: &Path, paced: bool) -> (([SimulatedProfiler; 2], SimulatedProbe), Cell) {
    std::fs::create_dir_all(folder.join("dev")).expect("a folder");
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    for file in ["recipe.toml", "part.step"] {
        std::fs::copy(configs.join(file), folder.join(file)).expect("the demo's file");
    }
    let text = std::fs::read_to_string(configs.join("cell.toml")).expect("the demo's cell");
    let finer = format!("encoder_step = {STEP}\ncolumns = {COLUMNS}\nrate_hz = {RATE}");
    let mut text = text.replace("encoder_step = 200", &finer);
    let path: PathBuf = folder.join("cell.toml");
    let mut demo = DemoCell::with_options(DemoOptions {
        paced,
        ..DemoOptions::new(1)
    });
    for sensor in &mut demo.sensors {
        sensor.view.columns = COLUMNS;
    }
    // Twenty megabytes in ten seconds are more than serial lines are made for.
    let mut profiler = |which: usize, port: &str| {
        let wire = Wire::tcp(SocketAddr::from(([127, 0, 0, 1], 0))).expect("a port");
        let address = format!("address = {:?}", wire.name());
        text = text.replace(&format!("port = \"./dev/{port}\""), &address);
        demo.start_profiler(which, wire).expect("a profiler")
    };
    let profilers = [profiler(0, "ttyLEFT"), profiler(1, "ttyRIGHT")];
    let wire = Wire::pty(&folder.join("dev/ttyPROBE")).expect("a pseudo-terminal");
    // Touches in real time would only lengthen what comes before the scan.
    demo.options.paced = false;
    let probe = demo.start_probe(wire).expect("a probe");
    std::fs::write(&path, text).expect("the cell's file");
    ((profilers, probe), Cell::read(&path).expect("the cell"))
}

fn by_stage(cell: &Cell) {
    let outcome = cell::run(cell, &Cable, &mut |_| {}).expect("an inspection");
    println!(
        "{} points, {:.2} s from the last profile to the verdict",
        outcome.scan.cloud.len(),
        outcome.verdict_seconds
    );
    for (stage, seconds) in &outcome.inspection.seconds {
        println!("    {stage:<32} {seconds:>7.3} s");
    }
}

/// Browsers that have the page open.
struct Browsers(Vec<Child>);

impl Drop for Browsers {
    fn drop(&mut self) {
        for browser in &mut self.0 {
            let _ = browser.kill();
            let _ = browser.wait();
        }
    }
}

/// Serves the page until this program ends, and opens it twice.
fn opened(handle: Handle, service: Service, folder: &Path) -> Browsers {
    let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let address = listener.local_addr().expect("it is bound");
    listener
        .set_nonblocking(true)
        .expect("sockets can be set so");
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .expect("a runtime");
        runtime.block_on(async move {
            let listener = tokio::net::TcpListener::from_std(listener)?;
            web::serve_cell(listener, handle, service, std::future::pending()).await
        })
    });
    let browser = |number: usize| {
        Command::new("chromium")
            .args(["--headless=new", "--no-sandbox", "--disable-gpu"])
            .args(["--remote-debugging-port=0", "--window-size=1280,900"])
            .arg(format!(
                "--user-data-dir={}",
                folder.join(format!("browser{number}")).display()
            ))
            .arg(format!("http://{address}/"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("chromium")
    };
    Browsers((0..2).map(browser).collect())
}

fn in_the_daemon(cell: Cell, folder: &Path, rounds: usize, page: bool) {
    let service = cell.service.clone();
    let store = Arc::new(Store::open(&folder.join("store")).expect("the store"));
    let options = DaemonOptions {
        simulated: true,
        ..DaemonOptions::default()
    };
    let daemon = Daemon::start(Arc::new(cell), store, Arc::new(Cable), options).expect("a daemon");
    let handle = daemon.handle();
    let _browsers = page.then(|| opened(daemon.handle(), service, folder));
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
        assert!(waited.is_ok(), "{what}: {:#?}", handle.snapshot());
    };
    let mut seconds: Vec<f64> = Vec::new();
    for round in 0..rounds {
        until("ready", &|s| s.state == State::Ready);
        let order = Order {
            part_serial: format!("part {round}"),
            ..Order::default()
        };
        let started = runtime.block_on(handle.start(order, "bench", None, Mode::Single));
        let id = started.expect("a start").0.id;
        let at_work = |s: &Snapshot| {
            let jobs = s.acquiring.iter().chain(&s.queue);
            jobs.into_iter().any(|job| job.id == id)
        };
        let (began, busy) = (Instant::now(), processor_seconds());
        until("acquired", &|s| !at_work(s));
        let acquired = Instant::now();
        let scan = (acquired - began).as_secs_f64();
        let busy = processor_seconds() - busy;
        until("concluded", &|s| {
            s.last.as_ref().is_some_and(|last| last.id == id)
        });
        let latency = acquired.elapsed().as_secs_f64();
        let kept = handle.store().inspection(id).expect("in the history");
        if round == 0 {
            println!(
                "{:?} points, {:?}, scan {scan:.2} s",
                kept.points, kept.verdict
            );
        }
        println!(
            "    {round}: {latency:.3} s ({:.3} to the values, the rest report and store), {:.1} % of the scan, processor {:.2} cores during the scan",
            kept.verdict_seconds.unwrap_or(f64::NAN),
            100.0 * latency / scan,
            busy / scan
        );
        seconds.push(latency);
    }
    let last = handle.snapshot().last.as_ref().map(|last| last.id);
    let report = last.and_then(|id| handle.store().report_json(id).ok());
    let report: Option<serde_json::Value> = report.and_then(|r| serde_json::from_str(&r).ok());
    println!(
        "    the last one by stage, s: {}",
        report.map_or("?".to_owned(), |r| r["seconds"].to_string())
    );
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let most = status.lines().find(|line| line.starts_with("VmHWM"));
    println!(
        "    memory at most, simulators included: {}",
        most.unwrap_or("?")
    );
    seconds.sort_by(f64::total_cmp);
    println!(
        "{rounds} rounds: verdict {:.3} s after the last profile (median), {:.3} s (worst)",
        seconds[seconds.len() / 2],
        seconds[seconds.len() - 1]
    );
}

/// Processor time that this process has used, s.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after = stat.rsplit(')').next().unwrap_or_default();
    let ticks = |at: usize| -> f64 {
        let field = after.split_whitespace().nth(at);
        field.and_then(|f| f.parse().ok()).unwrap_or(0.0)
    };
    // Fields 14 and 15 of proc(5), in ticks of a hundredth of a second.
    (ticks(11) + ticks(12)) / 100.0
}

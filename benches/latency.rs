//! `cargo bench --bench latency [-- ROUNDS]`: the demo's part scanned in real time, 2,000,000 points in about 10 s; time from the last
//! profile to the committed verdict, and what the daemon takes of the processor meanwhile. `-- stages` gives one run's seconds by stage,
//! `-- page` serves the page besides and opens it in two browsers (Chromium, headless) on the same machine.
//!
//! Simulated devices run in the same process on the same cores; their share is in the processor time shown, that of browsers is not.

#![allow(clippy::print_stdout)] // what a bench is for

#[path = "cell/demo.rs"]
mod demo;
#[path = "cell/sockets.rs"]
mod sockets;

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use acies::cell::{self, Handle};
use acies::config::{Cell, Service};
use acies::web;
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::{DemoCell, DemoOptions};

use demo::{Running, acquiring};
use sockets::Devices;

/// Points of a profile.
const COLUMNS: u32 = 3200;
/// Encoder counts between profiles, of 0.002 mm: 0.124 mm, four times what lies between two points of a profile.
const STEP: &str = "62";
/// Profiles a second: the 760 of a scan take 10 s.
const RATE: &str = "76.0";

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let rounds: usize = arguments.iter().find_map(|a| a.parse().ok()).unwrap_or(50);
    let rounds = rounds.max(1);
    let stages = arguments.iter().any(|a| a == "stages");
    let (playing, folder) = set_up(!stages);
    if stages {
        let cell = Cell::read(&folder.join("cell.toml")).expect("the cell");
        by_stage(&cell);
    } else {
        let page = arguments.iter().any(|a| a == "page");
        in_the_daemon(&folder, rounds, page);
    }
    drop(playing);
    let _ = std::fs::remove_dir_all(&folder);
}

/// The demo's cell with finer profiles.
fn set_up(paced: bool) -> (Devices, PathBuf) {
    let folder = demo::files("latency", |text| {
        let finer = format!("encoder_step = {STEP}\ncolumns = {COLUMNS}\nrate_hz = {RATE}");
        text.replace("encoder_step = 200", &finer)
    });
    let mut cell = DemoCell::with_options(DemoOptions {
        paced,
        ..DemoOptions::new(1)
    });
    for sensor in &mut cell.sensors {
        sensor.view.columns = COLUMNS;
    }
    (sockets::play(cell, &folder), folder)
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

fn in_the_daemon(folder: &Path, rounds: usize, page: bool) {
    let running = Running::start(folder);
    let cell = Cell::read(&folder.join("cell.toml")).expect("the cell");
    let handle = running.handle.clone();
    let _browsers = page.then(|| opened(handle.clone(), cell.service, folder));
    let mut seconds: Vec<f64> = Vec::new();
    // In the first round the simulators compute, on all cores, what they send in the others: it is not counted.
    for round in 0..=rounds {
        let id = running.start_part(&format!("part {round}"));
        let (began, busy) = (Instant::now(), processor_seconds());
        running.until("acquired", |s| !acquiring(s, id));
        let acquired = Instant::now();
        let scan = (acquired - began).as_secs_f64();
        let busy = processor_seconds() - busy;
        running.until("concluded", |s| {
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
            "    {round}{}: {latency:.3} s ({:.3} to the values, the rest report and store), {:.1} % of the scan, processor {:.2} cores during the scan",
            if round == 0 { " (not counted)" } else { "" },
            kept.verdict_seconds.unwrap_or(f64::NAN),
            100.0 * latency / scan,
            busy / scan
        );
        if round > 0 {
            seconds.push(latency);
        }
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

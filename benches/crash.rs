//! `cargo bench --bench crash [-- KILLS]`: a daemon that inspects without pause is killed at random moments (SIGKILL), and started
//! again on the same store. Counts announced results that are lost, half files and unfinished inspections, and the time until the
//! cell is ready again. 100 kills where nothing is said.
//!
//! The daemon is this program again, with the demo's simulated devices; it prints the number of each result when it is announced.

#![allow(clippy::print_stdout)] // what a bench is for

#[path = "cell/demo.rs"]
mod demo;

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use acies::cell::Mode;
use acies::report::Report;
use acies::store::{History, Order, Phase, ScanReader, Store};
use acies_simulators::demo_cell::{DemoCell, DemoOptions};

use demo::Running;

/// Where the daemon is told its folder.
const FOLDER: &str = "ACIES_CRASH_FOLDER";

fn main() {
    if let Some(folder) = std::env::var_os(FOLDER) {
        daemon(Path::new(&folder));
        return;
    }
    let kills = std::env::args()
        .filter_map(|a| a.parse().ok())
        .next()
        .unwrap_or(100);
    let folder = std::env::temp_dir().join(format!("acies-crash-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let mut seen = Seen::default();
    let mut random = 1_u64;
    for kill in 0..kills {
        // A step of SplitMix64: fixed moments, spread over start-up, scan, computing and commit.
        random = random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (random ^ (random >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let after = Duration::from_millis((mixed >> 40) % 10_000);
        one(&folder, after, &mut seen);
        if (kill + 1) % 20 == 0 {
            println!("{} kills: {seen:?}", kill + 1);
        }
    }
    seen.ready_s.sort_by(f64::total_cmp);
    let of = |share: f64| {
        seen.ready_s
            .get(((seen.ready_s.len() as f64 - 1.0) * share) as usize)
            .copied()
    };
    println!(
        "kills {kills}: announced {}, lost {}, half files {}, unfinished {}, unreadable scans {}; ready again after {:.2?} s (median), {:.2?} s (worst)",
        seen.announced,
        seen.lost,
        seen.half_files,
        seen.unfinished,
        seen.unreadable,
        of(0.5),
        of(1.0)
    );
    let _ = std::fs::remove_dir_all(&folder);
}

/// What was counted.
#[derive(Debug, Default)]
struct Seen {
    announced: usize,
    lost: usize,
    half_files: usize,
    unfinished: usize,
    unreadable: usize,
    aborted: usize,
    ready_s: Vec<f64>,
}

/// Starts the daemon, kills it, and looks at what it left.
fn one(folder: &Path, after: Duration, seen: &mut Seen) {
    let program = std::env::current_exe().expect("this program");
    let began = Instant::now();
    let mut child = Command::new(program)
        .env(FOLDER, folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("the daemon");
    let lines = BufReader::new(child.stdout.take().expect("its output")).lines();
    let announced = Arc::new(Mutex::new((None, Vec::<i64>::new())));
    let noted = announced.clone();
    let reader = std::thread::spawn(move || {
        for line in lines.map_while(Result::ok) {
            let mut noted = noted.lock().expect("no panic while noting");
            match line.parse() {
                Ok(id) => noted.1.push(id),
                Err(_) => noted.0 = Some(began.elapsed().as_secs_f64()),
            }
        }
    });
    std::thread::sleep(after);
    child.kill().expect("killed");
    child.wait().expect("its end");
    reader.join().expect("the reader");
    let (ready_s, ids) = announced.lock().expect("no panic while noting").clone();
    seen.ready_s.extend(ready_s);
    let Ok(store) = Store::open(&folder.join("store")) else {
        // Killed before it had made its store.
        return;
    };
    // What the next start does.
    store.recover("killed", SystemTime::now()).expect("mended");
    seen.announced += ids.len();
    let whole = |id: &i64| {
        let done = store.inspection(*id).is_ok_and(|i| i.phase == Phase::Done);
        let report = store.report_json(*id).ok();
        done && report.is_some_and(|json| serde_json::from_str::<Report>(&json).is_ok())
    };
    seen.lost += ids.iter().filter(|id| !whole(id)).count();
    let files: Vec<PathBuf> = std::fs::read_dir(folder.join("store/scans"))
        .expect("the scans")
        .map(|entry| entry.expect("a file").path())
        .collect();
    let raw = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "raw");
    seen.half_files += files.iter().filter(|path| !raw(path)).count();
    let newest = History {
        limit: Some(50),
        ..History::default()
    };
    for inspection in store.history(&newest).expect("the history") {
        let ended = matches!(
            inspection.phase,
            Phase::Done | Phase::Aborted | Phase::Refused
        );
        seen.unfinished += usize::from(!ended);
        seen.aborted +=
            usize::from(inspection.phase == Phase::Aborted && inspection.reason == "killed");
        if inspection.scan_bytes.is_some() {
            let path = store.scan_path(inspection.id).expect("its file");
            let read = ScanReader::open(&path).and_then(ScanReader::into_cloud);
            seen.unreadable += usize::from(read.is_err());
        }
    }
    // The disk of the machine that runs this is not to fill up.
    let rule = acies::store::Retention {
        scans_at_most: 50_000_000,
        ..Default::default()
    };
    store.sweep(&rule, SystemTime::now()).expect("swept");
}

/// Inspects without pause until it is killed.
fn daemon(folder: &Path) {
    // Several parts between two kills.
    demo::files_in(folder, demo::coarse);
    let _playing = DemoCell::with_options(DemoOptions::new(1))
        .start(&folder.join("dev"))
        .expect("the devices");
    let running = Running::start(folder);
    let handle = &running.handle;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .expect("a runtime");
    runtime.block_on(async {
        let mut follow = handle.follow();
        follow
            .wait_for(|snapshot| snapshot.accepts)
            .await
            .expect("ready");
        say("ready");
        let order = Order {
            part_serial: "KILL".to_owned(),
            ..Order::default()
        };
        handle
            .start(order, "bench", None, Mode::Continuous)
            .await
            .expect("started");
        let mut last = handle
            .snapshot()
            .last
            .as_ref()
            .map(|inspection| inspection.id);
        while follow.changed().await.is_ok() {
            let snapshot = follow.borrow_and_update().clone();
            let Some(ended) = snapshot
                .last
                .as_ref()
                .filter(|ended| ended.phase == Phase::Done)
            else {
                continue;
            };
            if last != Some(ended.id) {
                last = Some(ended.id);
                say(&ended.id.to_string());
            }
        }
    });
}

fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}")
        .and_then(|()| out.flush())
        .expect("the parent listens");
}

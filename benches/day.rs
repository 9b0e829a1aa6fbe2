//! `cargo bench --bench day [-- HOURS [INSPECTIONS]]`: a day of a cell at the pace of this machine: parts one after another, counted
//! by the time that they would take on a real cell, into a store that holds a million inspections already. 24 hours and 1,000,000
//! where nothing is said.
//!
//! What is assumed: a real cell takes for one part the time of the scan, from the first profile to the last by the profilers' own
//! clocks (9.8 s here), and 50 s to load and clamp it and to touch it six times. The simulated devices do not wait; their stamps go by
//! their own rate. Profiles are 0.8 mm apart and have 500 columns, so that a part is measured in a fraction of a second; everything else is the demo's
//! cell. In turn for an eighth of the time each the parts are faulty (the demo's defects: not OK) and good (its OK), and between the
//! eighths all devices are unplugged and come back. Raw data beyond 200 MB are removed by the retention rule. The simulators run in
//! the same process: its memory and files include theirs.

#![allow(clippy::print_stdout)] // what a bench is for

#[path = "cell/demo.rs"]
mod demo;
#[path = "cell/history.rs"]
mod history;

use std::path::Path;
use std::time::{Duration, Instant};

use acies::cell::DeviceState;
use acies::report::wire::Status;
use acies::store::{History, Inspection, Phase, ScanReader, Store};
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::demo_part::Defects;

use demo::{Played, Running, Taken, acquiring, ended};

/// Loading and clamping, s, and six touches: a probe that goes up between them, 100 mm a minute towards the part.
const HANDLING_S: f64 = 20.0 + 30.0;
/// In so many parts the day is divided.
const SHIFTS: u32 = 8;
/// How often something is written down, in hours of the cell.
const LOOK_EVERY_H: f64 = 0.25;

fn main() {
    let numbers: Vec<f64> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let hours = numbers.first().copied().unwrap_or(24.0);
    let stored = numbers.get(1).map_or(1_000_000, |count| *count as i64);
    let folder = demo::files("day", |text| {
        let text = demo::coarse(text);
        text.replace("[part]\n", "[service]\nkeep_scans_gb = 0.2\n\n[part]\n")
    });
    drop(Store::open(&folder.join("store")).expect("a store"));
    history::fill(&folder.join("store/acies.db"), stored, false);
    println!("{stored} inspections stored, {} MB", database_mb(&folder));

    let [faulty, good] = [Defects::demo(), Defects::none()].map(|defects| {
        DemoCell::with_options(DemoOptions {
            defects,
            ..DemoOptions::new(1)
        })
    });
    let mut played = Played::new(&faulty, &folder);
    let running = Running::start(&folder);
    let mut day = Day::default();
    let began = Instant::now();
    for shift in 0..SHIFTS {
        let (made, expected) = match shift % 2 {
            0 => (&faulty, Status::NotOk),
            _ => (&good, Status::Ok),
        };
        if shift > 0 {
            (0..3).for_each(|device| played.unplug(device));
            running.until("gone", |snapshot| {
                let mut devices = snapshot.devices.iter();
                devices.all(|device| device.state == DeviceState::Failed)
            });
            (0..3).for_each(|device| played.plug(made, device));
        }
        let until_h = hours * f64::from(shift + 1) / f64::from(SHIFTS);
        day.shift(&running, &folder, until_h, expected);
    }
    day.tell(began.elapsed());
    println!(
        "afterwards: {}, database {} MB",
        Taken::now(),
        database_mb(&folder)
    );
    ask_history(&running, stored);
    drop((running, played));
    let _ = std::fs::remove_dir_all(&folder);
}

/// What was counted.
#[derive(Default)]
struct Day {
    hours: f64,
    parts: u64,
    right: u64,
    aborted: u64,
    wrong: Vec<String>,
    /// Hours of the cell, and memory then, kB.
    memory: Vec<(f64, f64)>,
    files: Vec<usize>,
}

impl Day {
    /// Measures parts until the cell's clock stands at `until_h`; the next one is scanned while the last is computed.
    fn shift(&mut self, running: &Running, folder: &Path, until_h: f64, expected: Status) {
        let mut before: Option<i64> = None;
        while self.hours < until_h {
            let id = running.start_part(&format!("DAY-{}", self.parts));
            running.until("acquired", |snapshot| !acquiring(snapshot, id));
            if let Some(before) = before.replace(id) {
                running.until("concluded", |snapshot| ended(snapshot, before));
                self.note(running, before, expected);
            }
            self.look(folder);
        }
        if let Some(last) = before {
            running.until("concluded", |snapshot| ended(snapshot, last));
            self.note(running, last, expected);
        }
    }

    fn note(&mut self, running: &Running, id: i64, expected: Status) {
        let store = running.handle.store();
        let inspection = running.inspection(id);
        if inspection.phase == Phase::Aborted {
            // Nothing was measured; on a real cell the part would be put in again.
            self.aborted += 1;
            println!("    aborted: {}", inspection.reason);
            return;
        }
        self.parts += 1;
        self.hours += (scan_s(store, &inspection) + HANDLING_S) / 3600.0;
        if inspection.verdict == Some(expected) {
            self.right += 1;
        } else {
            let Inspection {
                verdict, reason, ..
            } = inspection;
            self.wrong.push(format!(
                "{id}: {verdict:?}, expected {expected:?}: {reason}"
            ));
        }
    }

    fn look(&mut self, folder: &Path) {
        if self.hours < LOOK_EVERY_H * self.memory.len() as f64 {
            return;
        }
        let taken = Taken::now();
        self.memory.push((self.hours, taken.resident_kb as f64));
        self.files.push(taken.files);
        let (hours, parts, size) = (self.hours, self.parts, database_mb(folder));
        println!("    {hours:5.2} h: {parts} parts, {taken}, database {size} MB");
    }

    fn tell(&self, took: Duration) {
        println!(
            "{:.2} h of the cell in {:.1} min: {} parts measured, {} with the right verdict, {} aborted",
            self.hours,
            took.as_secs_f64() / 60.0,
            self.parts,
            self.right,
            self.aborted
        );
        for wrong in self.wrong.iter().take(20) {
            println!("    {wrong}");
        }
        let second: Vec<(f64, f64)> = self.memory[self.memory.len() / 2..].to_vec();
        println!(
            "memory in the second half: {:+.1} kB an hour over {} looks; files {:?} to {:?}",
            slope(&second),
            second.len(),
            self.files.iter().min(),
            self.files.iter().max()
        );
    }
}

/// Slope of the line of least squares.
fn slope(points: &[(f64, f64)]) -> f64 {
    let count = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|point| point.0), mean(|point| point.1));
    let together: f64 = points
        .iter()
        .map(|point| (point.0 - x) * (point.1 - y))
        .sum();
    together
        / points
            .iter()
            .map(|point| (point.0 - x).powi(2))
            .sum::<f64>()
}

/// From the first profile to the last by the devices' own clocks, s: the longest of the views.
fn scan_s(store: &Store, inspection: &Inspection) -> f64 {
    let path = store.scan_path(inspection.id).expect("raw data");
    let mut reader = ScanReader::open(&path).expect("a scan");
    let mut spans = vec![(u64::MAX, 0); reader.views().len()];
    while let Some((view, profiles)) = reader.profiles().expect("profiles") {
        for profile in profiles {
            let (first, last) = &mut spans[view];
            *first = profile.device_time_ns.min(*first);
            *last = profile.device_time_ns.max(*last);
        }
    }
    let span = |(first, last): (u64, u64)| last.saturating_sub(first) as f64 * 1e-9;
    spans.into_iter().map(span).fold(0.0, f64::max)
}

/// Database and log ahead of it, MB.
fn database_mb(folder: &Path) -> u64 {
    let size =
        |name: &str| std::fs::metadata(folder.join("store").join(name)).map_or(0, |m| m.len());
    (size("acies.db") + size("acies.db-wal")) / 1_000_000
}

/// How long questions take now.
fn ask_history(running: &Running, stored: i64) {
    let store = running.handle.store();
    let any = History::default;
    let page = |history: History| drop(store.history(&history).expect("a page"));
    let questions: [(&str, &dyn Fn()); 5] = [
        ("newest page", &|| page(any())),
        ("page in the middle", &|| {
            page(History {
                before: Some(stored / 2),
                ..any()
            });
        }),
        ("one part", &|| {
            page(History {
                part_serial: Some(format!("P-{}", stored / 3)),
                ..any()
            });
        }),
        ("trend of 500", &|| {
            drop(store.trend("e7.d1", 500, false).expect("a trend"))
        }),
        ("usage", &|| {
            store.usage().expect("usage");
        }),
    ];
    history::ask(&questions, 50);
}

//! `cargo bench --bench unplug [-- ROUNDS]`: each of the demo's simulated devices is unplugged in mid-job and plugged in again, so many
//! times; the daemon runs on. Counts how the inspections ended, and looks at the daemon's memory and open files.
//!
//! A device is unplugged by taking its pseudo-terminal away, and returns under the same name. The probe is done within milliseconds
//! here: where it goes after its last touch the part is measured.

#![allow(clippy::print_stdout)] // what a bench is for

#[path = "cell/demo.rs"]
mod demo;

use std::time::Instant;

use acies::cell::State;
use acies::store::Phase;
use acies_simulators::demo_cell::{DemoCell, DemoOptions};

use demo::{Played, Running, Taken, ended};

fn main() {
    let rounds: u32 = std::env::args()
        .filter_map(|a| a.parse().ok())
        .next()
        .unwrap_or(100);
    let folder = demo::files("unplug", |text| text);
    let demo = DemoCell::with_options(DemoOptions::new(1));
    let mut played = Played::new(&demo, &folder);
    let running = Running::start(&folder);
    let first = running.start_part("first");
    running.until("measured", |s| ended(s, first));
    println!("start: {}", Taken::now());
    for (device, name) in ["left", "right", "probe"].into_iter().enumerate() {
        let (mut aborted, mut other, mut named) = (0, 0, 0);
        let mut back: Vec<f64> = Vec::new();
        for round in 0..rounds {
            let id = running.start_part(&format!("{name}-{round}"));
            let step = if device == 2 { "touching" } else { "scanning" };
            running.until("at work", |s| {
                ended(s, id)
                    || s.acquiring.as_ref().is_some_and(|job| {
                        job.id == id && job.step == step && (device == 2 || job.share > 0.1)
                    })
            });
            played.unplug(device);
            running.until("ended", |s| ended(s, id));
            let inspection = running.inspection(id);
            match inspection.phase {
                Phase::Aborted => aborted += 1,
                _ => other += 1,
            }
            if inspection.reason.contains(&format!("{name:?}")) {
                named += 1;
            } else {
                println!(
                    "    {name}-{round}: {:?}: {}",
                    inspection.phase, inspection.reason
                );
            }
            played.plug(&demo, device);
            let began = Instant::now();
            running.until("ready again", |s| s.state == State::Ready);
            back.push(began.elapsed().as_secs_f64());
        }
        back.sort_by(f64::total_cmp);
        println!(
            "{name}: {rounds} times unplugged: {aborted} aborted ({named} name it), {other} otherwise; ready {:.2} s after it came back (median), {:.2} s (worst); {}",
            back[back.len() / 2],
            back[back.len() - 1],
            Taken::now()
        );
    }
    let last = running.start_part("last");
    running.until("measured", |s| ended(s, last));
    let inspection = running.inspection(last);
    println!(
        "afterwards a part is measured: {:?} {:?}",
        inspection.phase, inspection.verdict
    );
    drop((running, played));
    let _ = std::fs::remove_dir_all(&folder);
}

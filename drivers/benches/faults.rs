//! The 25 fault cases on every serial sensor: what was counted against what was injected, and what each driver did.
//!
//! `cargo bench -p acies-drivers --bench faults`: accounts over 1000 seeds of a minute of device time each, then every case over a real
//! pseudo-terminal against every kind of device. `-- 100` takes 100 seeds; `-- accounts` or `-- carriers` one table alone; `-- mitutoyo`
//! one device of the first. Of a case that is inexact the first seed is shown.

#![allow(clippy::print_stdout)]

use std::time::{Duration, Instant};

use acies_drivers::device::Instrument;
use acies_drivers::link::cable::Cable;
use acies_simulators::faults::CASES;
use acies_simulators::gauge::Dialect;
use rayon::prelude::*;

#[allow(dead_code)]
#[path = "../../tests/drivers/accounts.rs"]
mod accounts;
#[allow(dead_code)]
#[path = "../../tests/drivers/bench.rs"]
mod bench;

use accounts::Account;
use bench::{Bench, Simulated, benches, cell, text, touch};

type Run = fn(&str, u64, Duration) -> Account;

/// Devices of the first table.
const DEVICES: [(&str, Run); 6] = [
    ("optoncdt", accounts::optoncdt),
    ("rf60x", accounts::rf60x),
    ("heidenhain-nd", |f, s, t| {
        accounts::gauge(Dialect::HeidenhainNd, f, s, t)
    }),
    ("mitutoyo", |f, s, t| {
        accounts::gauge(Dialect::Mitutoyo, f, s, t)
    }),
    ("sylvac", |f, s, t| {
        accounts::gauge(Dialect::Sylvac, f, s, t)
    }),
    ("keyence", |f, s, t| {
        accounts::gauge(Dialect::Keyence, f, s, t)
    }),
];

/// Cases that leave a stream to account for; the others end it, or are another carrier's.
const STREAMS: [&str; 14] = [
    "",
    "byte-loss",
    "bursts",
    "latency-lumps",
    "interleaved-reply",
    "sentinels",
    "counter-wrap",
    "dropped-triggers",
    "truncated",
    "late-reply",
    "overrun-flag",
    "unasked-lines",
    "clock-drift",
    "byte-loss,bursts,unasked-lines,sentinels,truncated",
];

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let seeds = words
        .iter()
        .find_map(|word| word.parse().ok())
        .unwrap_or(1000);
    let only = |name: &str| words.iter().any(|word| word == name);
    let wanted = |device: &str| {
        let named = |(name, _): &(&str, Run)| only(name);
        !DEVICES.iter().any(named) || only(device)
    };
    if !only("carriers") {
        print_accounts(seeds, wanted);
    }
    if !only("accounts") && !DEVICES.iter().any(|(name, _)| only(name)) {
        print_carriers();
    }
}

fn print_accounts(seeds: u64, wanted: impl Fn(&str) -> bool) {
    println!("Accounts: {seeds} seeds of 60 s of device time each, sums over all seeds");
    println!(
        "{:<14} {:<52} {:>11} {:>9} {:>9} {:>7} {:>6} {:>8} {:>7}",
        "device", "case", "values", "injected", "counted", "doubted", "wrong", "inexact", "s"
    );
    for (device, run) in DEVICES.into_iter().filter(|(name, _)| wanted(name)) {
        for case in STREAMS {
            let began = Instant::now();
            let minute = Duration::from_secs(60);
            let (all, inexact, example) = (0..seeds)
                .into_par_iter()
                .map(|seed| {
                    let one = run(case, seed, minute);
                    match one.is_exact() {
                        true => (one, 0, None),
                        false => (one, 1, Some((seed, one))),
                    }
                })
                .reduce(Default::default, |a, b| {
                    (a.0.plus(b.0), a.1 + b.1, a.2.or(b.2))
                });
            println!(
                "{:<14} {:<52} {:>11} {:>9} {:>9} {:>7} {:>6} {:>8} {:>7.1}",
                device,
                if case.is_empty() { "none" } else { case },
                all.sent,
                all.injected,
                all.counted,
                all.doubted,
                all.wrong,
                inexact,
                began.elapsed().as_secs_f64()
            );
            if let Some((seed, one)) = example {
                println!("  seed {seed}: {one:?}");
            }
        }
    }
}

/// What the driver did in one case: `works`, or what it told.
fn outcome(bench: &Bench, case: &str) -> String {
    let cell = cell(11, case);
    let (device, link) = bench.plug(&cell, "faults");
    let setup = bench.setup(&link, "");
    let mut instrument = match setup.open(&Cable) {
        Ok(instrument) => instrument,
        Err(error) => return format!("open: {}", short(&text(&error))),
    };
    let told = match &mut instrument {
        Instrument::Probe(probe) => (0..2)
            .find_map(|which| touch(probe.as_mut(), &cell, which).err())
            .map(|error| short(&text(&error))),
        Instrument::Robot(_) => None,
        Instrument::Profiler(profiler) => {
            let mut told = profiler.start().err();
            let until = Instant::now() + Duration::from_secs(3);
            let mut n = 0;
            while told.is_none() && n < 200 && Instant::now() < until {
                match profiler.next(until) {
                    Ok(profile) => n += u32::from(profile.is_some()),
                    Err(error) => told = Some(error),
                }
            }
            let stopped = profiler.stop().err();
            told.or(stopped).map(|error| short(&text(&error)))
        }
    };
    let account = match &instrument {
        Instrument::Profiler(profiler) => {
            let l = profiler.losses();
            format!(
                "got {}, lost {}, dropped {}, rejected {}",
                l.received, l.lost_on_link, l.dropped_by_device, l.rejected
            )
        }
        Instrument::Probe(_) | Instrument::Robot(_) => "touched".into(),
    };
    drop(instrument);
    // A damaged last command leaves a sensor without a keep-alive lit until somebody opens it again; pulled out, it is dark.
    let dark = match &device {
        Simulated::Probe(_) => true,
        _ => !bench.laser || device.goes_dark(Duration::from_secs(2)),
    };
    let light = if dark { "" } else { "; STILL LIT" };
    match told {
        None => format!("works: {account}{light}"),
        Some(told) => format!("{told} ({account}){light}"),
    }
}

fn short(told: &str) -> String {
    let told = told.rsplit_once("/faults/").map_or(told, |(_, tail)| tail);
    let told = told.split_once(": ").map_or(told, |(_, tail)| tail);
    told.chars().take(90).collect()
}

fn print_carriers() {
    println!(
        "\nCarriers: each case over a pseudo-terminal, opened, run for 200 values or 3 s, stopped, dropped"
    );
    for case in CASES {
        println!("{:>2} {}", case.number, case.name);
        let benches = benches();
        let outcomes: Vec<(&str, String)> = std::thread::scope(|scope| {
            let running: Vec<_> = benches
                .iter()
                .map(|bench| (bench.name, scope.spawn(|| outcome(bench, case.name))))
                .collect();
            running
                .into_iter()
                .map(|(name, thread)| (name, thread.join().unwrap_or_else(|_| "PANIC".into())))
                .collect()
        });
        for (name, outcome) in outcomes {
            println!("   {name:<14} {outcome}");
        }
    }
}

//! A history as long as that of a cell that has worked for years.

use std::path::Path;
use std::time::{Duration, Instant};

/// Writes `count` inspections into the database at `path`, twenty characteristics each, as the store writes them but in one
/// transaction: making a million durable commits would take hours and tell nothing about questions. `scans` says whether they
/// have raw data.
pub fn fill(path: &Path, count: i64, scans: bool) {
    let mut database = rusqlite::Connection::open(path).expect("the database");
    database
        .execute_batch("PRAGMA synchronous = OFF; PRAGMA cache_size = -400000;")
        .expect("settings");
    let transaction = database.transaction().expect("a transaction");
    {
        for number in 1..=20 {
            let name = format!("e{number}.d1");
            transaction
                .execute(
                    "INSERT INTO characteristics (id, name, unit) VALUES (?1, ?2, 'mm')",
                    (number, name),
                )
                .expect("a name");
        }
        let mut inspection = transaction
            .prepare(
                "INSERT INTO inspections (phase, part_serial, order_number, purpose, operator, requested_ms, started_ms, acquired_ms,
                 ended_ms, verdict, reason, points, scan_seconds, verdict_seconds, scan_file, scan_bytes, scan_whole)
                 VALUES ('done', ?1, ?2, 'series', 'anna', ?3, ?3, ?3, ?3, ?4, 'all values lie within their limits', 2000000, 10.0, 0.5, ?5, ?6, ?7)",
            )
            .expect("a statement");
        let mut measured = transaction
            .prepare("INSERT INTO measured VALUES (?1, ?2, ?3, 0.001, -0.05, 0.05, 'ok')")
            .expect("a statement");
        for id in 1..=count {
            let verdict = match id % 20 {
                0 => "not_ok",
                1 => "not_decidable",
                _ => "ok",
            };
            let order = format!("O-{}", id / 500);
            inspection
                .execute((
                    format!("P-{id}"),
                    order,
                    1_700_000_000_000 + id * 30_000,
                    verdict,
                    scans.then(|| format!("{id:08}.raw")),
                    scans.then_some(20_000_000),
                    scans.then_some(1),
                ))
                .expect("a row");
            for characteristic in 1..=20 {
                measured
                    .execute((characteristic, id, (id % 97) as f64 * 1e-3))
                    .expect("a value");
            }
        }
    }
    transaction.commit().expect("committed");
}

/// Asks every question `times` times, and prints how long it took.
pub fn ask(questions: &[(&str, &dyn Fn())], times: usize) {
    for (name, question) in questions {
        let mut took: Vec<Duration> = (0..times)
            .map(|_| {
                let began = Instant::now();
                question();
                began.elapsed()
            })
            .collect();
        took.sort();
        let (median, worst) = (took[times / 2], took[times - 1]);
        println!("{name:<28} median {median:>9.2?}  worst {worst:>9.2?}");
    }
}

//! `cargo bench --bench store [-- INSPECTIONS]`: how long questions to the history take when a million inspections are stored.

#![allow(clippy::print_stdout)] // what a bench is for

#[path = "cell/history.rs"]
mod history;

use std::time::{Duration, Instant, SystemTime};

use acies::report::wire::Status;
use acies::store::{Audit, History, Order, Store};

fn main() {
    let count: i64 = std::env::args()
        .filter_map(|a| a.parse().ok())
        .next()
        .unwrap_or(1_000_000);
    let folder = std::env::temp_dir().join(format!("acies-history-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    let store = Store::open(&folder).expect("a store");
    history::fill(&folder.join("acies.db"), count, true);
    let size = std::fs::metadata(folder.join("acies.db")).map_or(0, |m| m.len());
    println!(
        "{count} inspections, {} MB, {:.0} bytes each",
        size / 1_000_000,
        size as f64 / count as f64
    );
    let any = History::default;
    let questions: [(&str, &dyn Fn()); 10] = [
        ("newest page", &|| {
            drop(store.history(&any()).expect("a page"))
        }),
        ("page in the middle", &|| {
            drop(
                store
                    .history(&History {
                        before: Some(count / 2),
                        ..any()
                    })
                    .expect("a page"),
            );
        }),
        ("one part", &|| {
            let part_serial = Some(format!("P-{}", count / 3));
            drop(
                store
                    .history(&History {
                        part_serial,
                        ..any()
                    })
                    .expect("a page"),
            );
        }),
        ("not OK, the oldest", &|| {
            let history = History {
                verdict: Some(Status::NotOk),
                before: Some(count / 10),
                ..any()
            };
            drop(store.history(&history).expect("a page"));
        }),
        ("an order that is not there", &|| {
            let order_number = Some("none".to_owned());
            drop(
                store
                    .history(&History {
                        order_number,
                        ..any()
                    })
                    .expect("a page"),
            );
        }),
        ("parts that begin with P-77", &|| {
            let serial_prefix = Some("P-77".to_owned());
            drop(
                store
                    .history(&History {
                        serial_prefix,
                        ..any()
                    })
                    .expect("a page"),
            );
        }),
        ("parts that begin with P", &|| {
            let serial_prefix = Some("P".to_owned());
            drop(
                store
                    .history(&History {
                        serial_prefix,
                        ..any()
                    })
                    .expect("a page"),
            );
        }),
        ("trend of 500", &|| {
            drop(store.trend("e7.d1", 500, false).expect("a trend"))
        }),
        ("usage", &|| {
            store.usage().expect("usage");
        }),
        ("one inspection", &|| {
            drop(store.inspection(count / 2).expect("it"))
        }),
    ];
    history::ask(&questions, 200);
    let mut commits: Vec<Duration> = (0..200)
        .map(|number| {
            let began = Instant::now();
            let order = Order {
                part_serial: format!("N-{number}"),
                ..Order::default()
            };
            store
                .queue(
                    &acies::store::Trigger {
                        order: &order,
                        operator: "bench",
                        key: None,
                        simulated: true,
                    },
                    SystemTime::now(),
                )
                .expect("queued");
            began.elapsed()
        })
        .collect();
    commits.sort();
    println!(
        "{:<28} median {:>9.2?}  worst {:>9.2?}",
        "a durable commit", commits[100], commits[199]
    );
    let entry = Audit {
        person: "bench",
        action: "bench",
        subject: "",
        old: "",
        new: "",
        why: "",
    };
    store.audit(&entry, SystemTime::now()).expect("written");
    let _ = std::fs::remove_dir_all(&folder);
}

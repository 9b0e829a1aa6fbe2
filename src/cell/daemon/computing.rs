//! The thread that computes results beside the loop.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::SystemTime;

use super::{DaemonOptions, Event};
use crate::cell::devices::chain;
use crate::cell::job::{Acquired, conclude, report_of};
use crate::config::Cell;
use crate::store::{Finished, Inspection, Store};

/// What the computing thread is given.
pub(super) struct Work {
    pub(super) job: i64,
    pub(super) part_name: String,
    pub(super) acquired: Acquired,
    pub(super) findings: Vec<String>,
    pub(super) created: SystemTime,
}

/// The one thread that computes results; the kernel itself uses all cores.
pub(super) fn start_computing(
    cell: &Arc<Cell>,
    store: &Arc<Store>,
    events: &Sender<Event>,
    options: &DaemonOptions,
) -> (Sender<Work>, Option<JoinHandle<()>>) {
    let (sender, receiver) = channel::<Work>();
    let (cell, store, events) = (cell.clone(), store.clone(), events.clone());
    let simulated = options.simulated;
    let thread = thread::Builder::new()
        .name("computing".to_owned())
        .spawn(move || {
            for work in receiver {
                let job = work.job;
                // A panic ends one job, never the daemon.
                let result =
                    catch_unwind(AssertUnwindSafe(|| compute(&cell, &store, work, simulated)));
                let result = result.unwrap_or_else(|_| {
                    Err(
                        "a fault of the program; its log has the place: please report it"
                            .to_owned(),
                    )
                });
                let result = result.map(Box::new);
                let _ = events.send(Event::Concluded { job, result });
            }
        });
    (sender, thread.ok())
}

fn compute(cell: &Cell, store: &Store, work: Work, simulated: bool) -> Result<Inspection, String> {
    let mut outcome = conclude(cell, work.acquired, work.created);
    outcome.inspection.findings.extend(work.findings);
    let mut report = report_of(&outcome, &work.part_name, work.created, None);
    report.simulated = simulated;
    let finished = Finished {
        report: &report,
        scan_seconds: outcome.scan_seconds,
        verdict_seconds: outcome.verdict_seconds,
    };
    store
        .finish(work.job, &finished, SystemTime::now())
        .map_err(|error| chain(&error))
}

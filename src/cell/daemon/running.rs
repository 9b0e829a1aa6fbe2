//! The daemon's one loop, and what follows from what is so: the state, its cause, whether a trigger is taken.

use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use super::computing::Work;
use super::jobs::Job;
use super::{Command, DaemonOptions, Event, Refusal, Started};
use crate::cell::devices::{News, Supervisor, chain, name_of};
use crate::cell::feed::Publisher;
use crate::cell::job::Part;
use crate::cell::live::Live;
use crate::cell::state::{Circumstances, Mode};
use crate::cell::status::{DeviceState, DeviceStatus, Snapshot};
use crate::config::Cell;
use crate::store::{Order, Phase, Store, StoreError, StoreLock, Trigger};

/// How often the loop looks after what no event tells it.
const TICK: Duration = Duration::from_secs(1);
/// How often raw data are swept and the disk is looked at.
const SWEEP_EVERY: Duration = Duration::from_secs(60);

/// The loop and all it knows.
pub(super) struct Running {
    pub(super) cell: Arc<Cell>,
    pub(super) store: Arc<Store>,
    pub(super) options: DaemonOptions,
    pub(super) live: Arc<Live>,
    pub(super) events: Sender<Event>,
    pub(super) supervisors: Arc<Vec<Supervisor>>,
    pub(super) part: Option<Arc<Part>>,
    pub(super) halted: Option<String>,
    pub(super) fault: Option<String>,
    /// The order that goes on, and how many parts it has begun.
    pub(super) continuous: Option<(Order, String, u64)>,
    pub(super) acquiring: Option<(Job, Arc<AtomicBool>)>,
    pub(super) queue: VecDeque<Job>,
    pub(super) computing: Vec<Job>,
    pub(super) work: Option<Sender<Work>>,
    pub(super) swept: Option<Instant>,
    pub(super) _lock: StoreLock,
    pub(super) ending: bool,
    pub(super) snapshot: Snapshot,
    pub(super) publisher: Publisher,
}

impl Running {
    pub(super) fn run(&mut self, received: &Receiver<Event>, beat: &Mutex<Instant>) {
        loop {
            self.upkeep();
            self.settle();
            *beat.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
            if self.ending && self.acquiring.is_none() && self.computing.is_empty() {
                return;
            }
            match received.recv_timeout(TICK) {
                Ok(event) => self.handle(event),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// Begins what can begin and publishes what is so: who asked for something sees it in the next snapshot.
    fn settle(&mut self) {
        self.begin_next();
        self.publish();
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Device { index, news } => self.device(index, news),
            Event::Start {
                order,
                operator,
                key,
                mode,
                answer,
            } => {
                let started = self.start(order, &operator, key.as_deref(), mode);
                self.settle();
                // Who asked may have gone away; the inspection is in the history.
                let _ = answer.send(started);
            }
            Event::Command {
                command,
                person,
                answer,
            } => {
                let done = self.command(command, &person);
                self.settle();
                let _ = answer.send(done);
            }
            Event::Part { part, version } => {
                self.part = Some(part);
                self.snapshot.recipe = Some(version);
                self.snapshot.recipe_problem.clear();
            }
            Event::RecipeProblem(problem) => self.snapshot.recipe_problem = problem,
            Event::Step { job, step } => self.step(job, step),
            Event::Acquired { job, result } => self.acquired(job, result),
            Event::Kept { job, kept } => self.kept(job, kept),
            Event::Concluded { job, result } => self.concluded(job, result),
            Event::End => {
                self.ending = true;
                self.drop_waiting("the daemon ended");
                self.give_up();
            }
        }
    }

    fn device(&mut self, index: usize, news: News) {
        let Some(device) = self.snapshot.devices.get_mut(index) else {
            return;
        };
        device.since = now_text();
        match news {
            News::Ready(identity) => {
                device.state = DeviceState::Ready;
                device.opened += 1;
                device.error.clear();
                let words = [
                    &identity.vendor,
                    &identity.model,
                    &identity.serial,
                    &identity.firmware,
                ];
                let words = words.iter().filter(|word| !word.is_empty());
                let text = words
                    .map(|word| word.as_str())
                    .collect::<Vec<_>>()
                    .join(" ");
                tracing::info!(device = device.name, identity = text, "device ready");
                device.identity = Some(text);
            }
            News::Failed(error) => {
                if device.error != error {
                    tracing::warn!(device = device.name, error, "device failed");
                }
                device.state = DeviceState::Failed;
                device.failures += 1;
                device.error = error;
            }
        }
    }

    fn circumstances(&self) -> Circumstances {
        let count = |state| {
            self.snapshot
                .devices
                .iter()
                .filter(|d| d.state == state)
                .count()
        };
        Circumstances {
            halted: self.halted.is_some(),
            connecting: count(DeviceState::Connecting),
            failed: count(DeviceState::Failed),
            fault: self.fault.is_some(),
            prepared: self.part.is_some(),
            acquiring: self.acquiring.is_some(),
            mode: self.snapshot.mode,
        }
    }

    /// Why the cell is not ready, and what to do.
    pub(super) fn cause(&self) -> (String, String) {
        let failed = self
            .snapshot
            .devices
            .iter()
            .find(|d| d.state == DeviceState::Failed);
        if let Some(by) = &self.halted {
            return (
                format!("halted by {by}"),
                "press Reset when work may go on".to_owned(),
            );
        }
        if let Some(fault) = &self.fault {
            return (fault.clone(), "mend that, then press Reset".to_owned());
        }
        if let Some(device) = failed {
            return (
                format!("device {:?}: {}", device.name, device.error),
                "it is tried again by itself; Reset tries it at once".to_owned(),
            );
        }
        if self
            .snapshot
            .devices
            .iter()
            .any(|d| d.state == DeviceState::Connecting)
        {
            return ("the devices are being opened".to_owned(), "wait".to_owned());
        }
        if self.part.is_none() {
            let problem = &self.snapshot.recipe_problem;
            let cause = format!("no part to compare with: {problem}");
            return (
                cause,
                "activate a recipe, or mend the configured one and reload".to_owned(),
            );
        }
        (String::new(), String::new())
    }

    /// Whether a trigger would be taken, be it into the queue.
    fn admits(&self) -> Result<(), Refusal> {
        if self.ending {
            return Err(Refusal::Ending);
        }
        let (cause, advice) = self.cause();
        if !cause.is_empty() {
            return Err(Refusal::NotReady { cause, advice });
        }
        let limit = self.options.queue_limit;
        let waits = self.acquiring.is_some() || !self.queue.is_empty();
        if waits && self.queue.len() >= limit {
            return Err(Refusal::QueueFull { limit });
        }
        Ok(())
    }

    fn start(
        &mut self,
        mut order: Order,
        operator: &str,
        key: Option<&str>,
        mode: Mode,
    ) -> Started {
        let mut admitted = self.admits();
        if order.part_serial.trim().is_empty() {
            admitted = admitted.and(Err(Refusal::NoSerial));
        }
        if let Some(first) = order.remeasure_of
            && let Err(StoreError::Missing { .. }) = self.store.inspection(first)
        {
            admitted = admitted.and(Err(Refusal::NothingToRepeat { first }));
            // The refusal is kept, and cannot refer to what is not there.
            order.remeasure_of = None;
        }
        let now = SystemTime::now();
        let trigger = Trigger {
            order: &order,
            operator,
            key,
            simulated: self.options.simulated,
        };
        let failed = |error: StoreError| (Refusal::Store(chain(&error)), None);
        if let Err(refusal) = admitted {
            let kept = self.store.refuse(&trigger, &refusal.to_string(), now);
            return match kept {
                // The trigger was repeated, and taken the first time.
                Ok(known) if known.phase != Phase::Refused => Ok((known, false)),
                Ok(refused) => Err((refusal, Some(Box::new(refused)))),
                Err(_) => Err((refusal, None)),
            };
        }
        let (inspection, new) = self.store.queue(&trigger, now).map_err(failed)?;
        if !new {
            return Ok((inspection, false));
        }
        if mode == Mode::Continuous {
            self.snapshot.mode = Mode::Continuous;
            self.continuous = Some((order, operator.to_owned(), 1));
        }
        self.queue.push_back(Job::new(&inspection));
        Ok((inspection, true))
    }

    fn command(&mut self, command: Command, person: &str) -> Result<(), Refusal> {
        tracing::info!(?command, person, "command");
        match command {
            Command::Stop => {
                self.drop_waiting(&format!("stopped by {person}"));
            }
            Command::Abort => {
                self.drop_waiting(&format!("aborted by {person}"));
                self.give_up();
            }
            Command::Halt => {
                self.drop_waiting(&format!("halted by {person}"));
                self.give_up();
                self.halted = Some(person.to_owned());
            }
            Command::Reset => {
                self.halted = None;
                self.fault = None;
                if let Err(error) = self.store.check() {
                    self.fault = Some(chain(&error));
                }
                for supervisor in self.supervisors.iter() {
                    supervisor.retry();
                }
            }
        }
        Ok(())
    }

    /// Sweeps raw data, looks at the disk and at calibrations, now and then.
    fn upkeep(&mut self) {
        if self
            .swept
            .is_some_and(|swept| swept.elapsed() < SWEEP_EVERY)
            || self.acquiring.is_some()
        {
            return;
        }
        self.swept = Some(Instant::now());
        let now = SystemTime::now();
        match self.store.sweep(&self.options.retention, now) {
            Ok(swept) if swept.scans > 0 => {
                tracing::info!(
                    scans = swept.scans,
                    bytes = swept.bytes,
                    "raw data removed by the retention rule"
                );
            }
            Ok(_) => {}
            Err(error) => tracing::error!(error = chain(&error), "retention"),
        }
        self.look_at_disk();
        for index in 0..self.snapshot.devices.len() {
            let fresh = device_status(&self.cell, index, now);
            self.snapshot.devices[index].calibration_due = fresh.calibration_due;
        }
    }

    pub(super) fn look_at_disk(&mut self) {
        match self.store.usage() {
            Ok(usage) => self.snapshot.storage = Some(usage),
            Err(error) => self.fault = Some(chain(&error)),
        }
    }

    fn publish(&mut self) {
        let snapshot = &mut self.snapshot;
        snapshot.acquiring = self.acquiring.as_ref().map(|(job, _)| job.status.clone());
        snapshot.computing = self
            .computing
            .iter()
            .map(|job| job.status.clone())
            .collect();
        snapshot.queue = self.queue.iter().map(|job| job.status.clone()).collect();
        let state = self.circumstances().state();
        let (cause, advice) = self.cause();
        let accepts = self.admits().is_ok();
        let snapshot = &mut self.snapshot;
        (snapshot.state, snapshot.state_number) = (state, state.number());
        (snapshot.cause, snapshot.advice, snapshot.accepts) = (cause, advice, accepts);
        let before = self.publisher.last();
        snapshot.sequence = before.sequence;
        if *before != *snapshot {
            snapshot.sequence += 1;
            self.publisher.tell(snapshot.clone());
        }
    }
}

/// A device before anything is known of it but its configuration.
pub(super) fn device_status(cell: &Cell, index: usize, now: SystemTime) -> DeviceStatus {
    let profilers = cell.profilers.iter().map(|p| ("profiler", p.calibrated));
    let probes = cell.probes.iter().map(|p| ("probe", p.calibrated));
    let mut all = profilers.chain(probes);
    let (kind, calibrated) = all.nth(index).unwrap_or(("robot", None));
    let text = |time: SystemTime| humantime::format_rfc3339_seconds(time).to_string();
    let until = calibrated.and_then(|c| c.valid.map(|valid| c.date + valid));
    DeviceStatus {
        name: name_of(cell, index).to_owned(),
        kind: kind.to_owned(),
        state: DeviceState::Connecting,
        identity: None,
        error: String::new(),
        since: now_text(),
        opened: 0,
        failures: 0,
        received: 0,
        lost: 0,
        calibrated: calibrated.map(|c| text(c.date)),
        calibrated_until: until.map(text),
        calibration_due: calibrated.is_some_and(|c| c.overdue(now).is_some()),
    }
}

fn now_text() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

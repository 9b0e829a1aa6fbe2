//! The daemon's one loop: everything that happens comes in as an [`Event`], one after the other.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime};

use acies_drivers::device::Instrument;
use acies_drivers::link::Links;
use tokio::sync::{oneshot, watch};

use super::acquisition::{Acquisition, acquire_for};
use super::devices::{self, News, Supervisor, chain, name_of};
use super::job::{Acquired, Part, Step, conclude, report_of};
use super::live::Live;
use super::recipes;
use super::state::{Circumstances, Mode};
use super::status::{DeviceState, DeviceStatus, JobStatus, Snapshot};
use super::{CellError, State};
use crate::config::Cell;
use crate::store::{
    Finished, Inspection, Order, Phase, RecipeVersion, Retention, Store, StoreError, StoreLock,
    Trigger,
};

/// How often the loop looks after what no event tells it.
const TICK: Duration = Duration::from_secs(1);
/// How often raw data are swept and the disk is looked at.
const SWEEP_EVERY: Duration = Duration::from_secs(60);
/// Results that may be computing while the devices already work for the next part.
const COMPUTING_MAX: usize = 2;

/// What the daemon is told once.
#[derive(Debug, Clone)]
pub struct DaemonOptions {
    /// How many triggers may wait.
    pub queue_limit: usize,
    /// Which raw data are kept.
    pub retention: Retention,
    /// Whether the instruments are simulated: their results never count in the statistics.
    pub simulated: bool,
}

impl Default for DaemonOptions {
    fn default() -> Self {
        Self {
            queue_limit: 8,
            retention: Retention::default(),
            simulated: false,
        }
    }
}

/// What somebody may ask of the cell beside a start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// End regularly: the part under way is finished, those that wait are not begun.
    Stop,
    /// Drop the part under way too.
    Abort,
    /// Take the cell out of operation, aborting what runs.
    Halt,
    /// Put it back, clear faults, try every device at once.
    Reset,
}

/// Why a trigger or a command was not taken.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The cell is not ready.
    #[error("the cell is not ready: {cause}")]
    NotReady {
        /// Why.
        cause: String,
        /// What to do.
        advice: String,
    },
    /// Too many wait already.
    #[error("{limit} parts wait already; start this one when one of them is done")]
    QueueFull {
        /// How many may.
        limit: usize,
    },
    /// A part without a name.
    #[error(
        "the part has no serial number; type or scan one, a result without it belongs to no part"
    )]
    NoSerial,
    /// The store.
    #[error("{0}")]
    Store(String),
    /// The daemon is ending.
    #[error("the daemon is ending; start the part again when it is back")]
    Ending,
}

/// What a trigger gets: the inspection it became and whether that is new, or the refusal, which is kept as an inspection too
/// where the store can.
pub type Started = Result<(Inspection, bool), (Refusal, Option<Box<Inspection>>)>;

/// Everything that can happen.
pub(super) enum Event {
    /// A device came or went.
    Device { index: usize, news: News },
    /// A trigger.
    Start {
        order: Order,
        operator: String,
        key: Option<String>,
        mode: Mode,
        answer: oneshot::Sender<Started>,
    },
    /// Something else that somebody asks.
    Command {
        command: Command,
        person: String,
        answer: oneshot::Sender<Result<(), Refusal>>,
    },
    /// What parts are judged by has changed.
    Part {
        part: Arc<Part>,
        version: RecipeVersion,
    },
    /// A recipe was to be activated and cannot be.
    RecipeProblem(String),
    /// A job goes on.
    Step { job: i64, step: Step },
    /// The devices are done with a job, and have been given back.
    Acquired {
        job: i64,
        result: Result<Box<Acquired>, CellError>,
    },
    /// The raw data of a job are on the disk, or are not.
    Kept {
        job: i64,
        kept: Result<(u64, bool), String>,
    },
    /// A job has ended; its result is committed.
    Concluded {
        job: i64,
        result: Result<Inspection, String>,
    },
    /// The end.
    End,
}

/// A job that waits or runs.
struct Job {
    status: JobStatus,
    findings: Vec<String>,
}

/// What the computing thread is given.
struct Work {
    job: i64,
    part_name: String,
    acquired: Acquired,
    findings: Vec<String>,
    created: SystemTime,
}

/// A running daemon. Dropping it ends what runs: the acquisition is given up, results under way are still committed.
pub struct Daemon {
    handle: Handle,
    thread: Option<JoinHandle<()>>,
}

/// Speaks to a running daemon; any number of threads may hold one.
#[derive(Clone)]
pub struct Handle {
    events: Sender<Event>,
    snapshots: watch::Receiver<Arc<Snapshot>>,
    store: Arc<Store>,
    live: Arc<Live>,
    beat: Arc<Mutex<Instant>>,
    cell: Arc<Cell>,
}

impl Daemon {
    /// Starts the cell: mends what a crash left, takes the configured recipe, begins to open the devices.
    ///
    /// It starts without any device and without a part that can be read: both are states with a cause.
    ///
    /// # Errors
    /// [`CellError::Store`] where the store cannot be used.
    pub fn start(
        cell: Arc<Cell>,
        store: Arc<Store>,
        links: Arc<dyn Links + Send + Sync>,
        options: DaemonOptions,
    ) -> Result<Self, CellError> {
        let now = SystemTime::now();
        let lock = store.lock()?;
        let reason = "the daemon ended before it was done; raw data up to there are kept, measure the part again";
        for inspection in store.recover(reason, now)? {
            tracing::warn!(
                inspection = inspection.id,
                part = inspection.part_serial,
                "aborted: the daemon had ended"
            );
        }
        let (events, received) = channel();
        let prepared = recipes::prepare(&cell, &store, now)?;
        let last = store.history(&crate::store::History {
            limit: Some(1),
            ..Default::default()
        })?;
        let devices = (0..devices::count(&cell))
            .map(|index| device_status(&cell, index, now))
            .collect();
        let live = Arc::new(Live::default());
        let snapshot = Snapshot {
            sequence: 0,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            cell: cell.name.clone(),
            simulated: options.simulated,
            state: State::Preoperational,
            state_number: State::Preoperational.number(),
            mode: Mode::Single,
            cause: String::new(),
            advice: String::new(),
            accepts: false,
            recipe: prepared.active.as_ref().map(|(_, version)| version.clone()),
            recipe_problem: prepared.problem,
            devices,
            acquiring: None,
            computing: Vec::new(),
            queue: Vec::new(),
            queue_limit: options.queue_limit,
            last: last.into_iter().next(),
            storage: None,
            started: humantime::format_rfc3339_millis(now).to_string(),
        };
        let (publisher, snapshots) = watch::channel(Arc::new(snapshot.clone()));
        let beat = Arc::new(Mutex::new(Instant::now()));
        let handle = Handle {
            events: events.clone(),
            snapshots,
            store: store.clone(),
            live: live.clone(),
            beat: beat.clone(),
            cell: cell.clone(),
        };
        let (work, computing) = start_computing(&cell, &store, &events, &options);
        let supervisors = (0..snapshot.devices.len())
            .filter_map(|index| supervise(&cell, index, &links, &events))
            .collect();
        let mut running = Running {
            cell,
            store,
            options,
            live,
            events,
            supervisors: Arc::new(supervisors),
            part: prepared.active.map(|(part, _)| part),
            halted: None,
            fault: None,
            continuous: None,
            acquiring: None,
            queue: VecDeque::new(),
            computing: Vec::new(),
            work: Some(work),
            swept: None,
            _lock: lock,
            ending: false,
            snapshot,
            publisher,
        };
        let thread = thread::Builder::new()
            .name("cell".to_owned())
            .spawn(move || {
                running.run(&received, &beat);
                drop(running);
                // It ends by itself when nobody sends it work any more.
                let _ = computing.map(JoinHandle::join);
            })
            .map_err(|source| {
                CellError::Store(StoreError::File {
                    path: "the cell's thread".into(),
                    source,
                })
            })?;
        Ok(Self {
            handle,
            thread: Some(thread),
        })
    }

    /// Speaks to it.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // The loop may have ended already.
        let _ = self.handle.events.send(Event::End);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Handle {
    /// What is so now.
    pub fn snapshot(&self) -> Arc<Snapshot> {
        self.snapshots.borrow().clone()
    }

    /// Follows what is so.
    pub fn follow(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.snapshots.clone()
    }

    /// The store.
    pub fn store(&self) -> &Arc<Store> {
        &self.store
    }

    /// The scan as it grows.
    pub fn live(&self) -> &Live {
        &self.live
    }

    /// Triggers an inspection. The same `key` gives the same inspection again.
    ///
    /// # Errors
    /// The refusal, and the inspection that keeps it.
    pub async fn start(
        &self,
        order: Order,
        operator: &str,
        key: Option<String>,
        mode: Mode,
    ) -> Started {
        let (answer, answered) = oneshot::channel();
        let event = Event::Start {
            order,
            operator: operator.to_owned(),
            key,
            mode,
            answer,
        };
        if self.events.send(event).is_err() {
            return Err((Refusal::Ending, None));
        }
        answered.await.unwrap_or(Err((Refusal::Ending, None)))
    }

    /// Asks something else of the cell.
    ///
    /// # Errors
    /// Why it is not done.
    pub async fn command(&self, command: Command, person: &str) -> Result<(), Refusal> {
        let (answer, answered) = oneshot::channel();
        let event = Event::Command {
            command,
            person: person.to_owned(),
            answer,
        };
        if self.events.send(event).is_err() {
            return Err(Refusal::Ending);
        }
        answered.await.unwrap_or(Err(Refusal::Ending))
    }

    /// Judges parts by another version from the next one on. Reads the nominal, which takes up to seconds.
    ///
    /// # Errors
    /// [`CellError`]: the version cannot be read; the active one stays.
    pub fn activate_recipe(
        &self,
        id: i64,
        person: &str,
        why: &str,
    ) -> Result<RecipeVersion, CellError> {
        let content = self.store.recipe(id)?;
        let part = match recipes::load(&content) {
            Ok(part) => part,
            Err(error) => {
                // The loop may have ended.
                let _ = self.events.send(Event::RecipeProblem(chain(&error)));
                return Err(error);
            }
        };
        let version = self
            .store
            .activate_recipe(id, person, why, SystemTime::now())?;
        let _ = self.events.send(Event::Part {
            part: Arc::new(part),
            version: version.clone(),
        });
        Ok(version)
    }

    /// Reads the configured recipe and nominal again, and activates them where they have changed and can be read.
    ///
    /// # Errors
    /// [`CellError`]; the active version stays.
    pub fn reload(&self) -> Result<(), CellError> {
        let prepared = recipes::prepare(&self.cell, &self.store, SystemTime::now())?;
        if let Some((part, version)) = prepared.active {
            let _ = self.events.send(Event::Part { part, version });
        }
        let _ = self.events.send(Event::RecipeProblem(prepared.problem));
        Ok(())
    }

    /// How long ago the loop last went round: a watchdog barks when that is too long.
    pub fn last_beat(&self) -> Duration {
        self.beat
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .elapsed()
    }
}

/// The loop and all it knows.
struct Running {
    cell: Arc<Cell>,
    store: Arc<Store>,
    options: DaemonOptions,
    live: Arc<Live>,
    events: Sender<Event>,
    supervisors: Arc<Vec<Supervisor>>,
    part: Option<Arc<Part>>,
    halted: Option<String>,
    fault: Option<String>,
    /// The order that goes on, and how many parts it has begun.
    continuous: Option<(Order, String, u64)>,
    acquiring: Option<(Job, Arc<AtomicBool>)>,
    queue: VecDeque<Job>,
    computing: Vec<Job>,
    work: Option<Sender<Work>>,
    swept: Option<Instant>,
    _lock: StoreLock,
    ending: bool,
    snapshot: Snapshot,
    publisher: watch::Sender<Arc<Snapshot>>,
}

impl Running {
    fn run(&mut self, received: &Receiver<Event>, beat: &Mutex<Instant>) {
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
    fn cause(&self) -> (String, String) {
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

    fn start(&mut self, order: Order, operator: &str, key: Option<&str>, mode: Mode) -> Started {
        let mut admitted = self.admits();
        if order.part_serial.trim().is_empty() {
            admitted = admitted.and(Err(Refusal::NoSerial));
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

    /// Ends the continuous mode and what waits.
    fn drop_waiting(&mut self, reason: &str) {
        self.continuous = None;
        if self.acquiring.is_none() {
            self.snapshot.mode = Mode::Single;
        }
        for job in std::mem::take(&mut self.queue) {
            self.abort(job.status.id, reason);
        }
    }

    /// Gives the acquisition under way up.
    fn give_up(&mut self) {
        if let Some((_, abort)) = &self.acquiring {
            abort.store(true, Ordering::Release);
        }
    }

    fn abort(&mut self, job: i64, reason: &str) {
        match self.store.abort(job, reason, SystemTime::now()) {
            Ok(inspection) => self.snapshot.last = Some(inspection),
            Err(error) => self.fault = Some(chain(&error)),
        }
    }

    /// Begins the next job where the devices are free and results do not pile up.
    fn begin_next(&mut self) {
        let computing = self.computing.len();
        if self.acquiring.is_some() || computing >= COMPUTING_MAX || self.ending {
            return;
        }
        if !self.cause().0.is_empty() {
            if !self.queue.is_empty() {
                let cause = self.cause().0;
                self.drop_waiting(&format!("not begun: {cause}"));
            }
            return;
        }
        self.continue_order();
        let (Some(part), Some(mut job)) = (self.part.clone(), self.queue.pop_front()) else {
            self.snapshot.mode = Mode::Single;
            return;
        };
        let id = job.status.id;
        let scan_file = format!("{id:08}.raw");
        let recipe = self.snapshot.recipe.as_ref().map(|recipe| recipe.id);
        if let Err(error) = self.store.begin(id, recipe, &scan_file, SystemTime::now()) {
            self.fault = Some(chain(&error));
            self.abort(id, &chain(&error));
            return;
        }
        job.status.step = "touching".to_owned();
        let abort = Arc::new(AtomicBool::new(false));
        let acquisition = Acquisition {
            job: id,
            cell: self.cell.clone(),
            part,
            supervisors: self.supervisors.clone(),
            live: self.live.clone(),
            events: self.events.clone(),
            abort: abort.clone(),
            scan_path: self.store.folder().join("scans").join(scan_file),
        };
        for device in &mut self.snapshot.devices {
            device.state = DeviceState::Busy;
        }
        self.acquiring = Some((job, abort));
        let begun = thread::Builder::new()
            .name(format!("acquisition {id}"))
            .spawn(move || acquire_for(acquisition));
        if let Err(error) = begun {
            let result = Err(CellError::GivenUp {
                reason: format!("no thread could be started: {error}"),
            });
            self.acquired(id, result);
        }
    }

    /// In continuous mode the next part follows by itself.
    fn continue_order(&mut self) {
        if !self.queue.is_empty() {
            return;
        }
        let Some((order, operator, count)) = &mut self.continuous else {
            return;
        };
        *count += 1;
        let next = Order {
            part_serial: format!("{}-{count}", order.part_serial),
            ..order.clone()
        };
        let trigger = Trigger {
            order: &next,
            operator,
            key: None,
            simulated: self.options.simulated,
        };
        match self.store.queue(&trigger, SystemTime::now()) {
            Ok((inspection, _)) => self.queue.push_back(Job::new(&inspection)),
            Err(error) => self.fault = Some(chain(&error)),
        }
    }

    fn step(&mut self, id: i64, step: Step) {
        let Some((job, _)) = self
            .acquiring
            .as_mut()
            .filter(|(job, _)| job.status.id == id)
        else {
            return;
        };
        let status = &mut job.status;
        match step {
            Step::Opening { .. } | Step::Inspecting => {}
            Step::Touching { done, of } => {
                status.step = "touching".to_owned();
                status.touches = Some([done, of]);
            }
            Step::Scanning { profiles, share } => {
                status.step = "scanning".to_owned();
                (status.profiles, status.share) = (profiles, share);
            }
            Step::Lost { device, error } => {
                let finding = format!("{device}: {error}");
                status.findings.push(finding.clone());
                job.findings.push(finding);
                if let Some(device) = self.snapshot.devices.iter_mut().find(|d| d.name == device) {
                    device.error = error;
                }
            }
        }
    }

    fn acquired(&mut self, id: i64, result: Result<Box<Acquired>, CellError>) {
        let Some((mut job, _)) = self.acquiring.take() else {
            return;
        };
        for device in &mut self.snapshot.devices {
            // A device that was lost says so itself in a moment; until then it is not ready.
            if device.state == DeviceState::Busy {
                let lost = !device.error.is_empty();
                device.state = if lost {
                    DeviceState::Connecting
                } else {
                    DeviceState::Ready
                };
            }
        }
        let failed = result.is_err();
        match result {
            Ok(acquired) => {
                self.count(&acquired);
                let now = SystemTime::now();
                if let Err(error) = self
                    .store
                    .acquired(id, acquired.scan.cloud.len() as u64, now)
                {
                    self.fault = Some(chain(&error));
                }
                job.status.step = "inspecting".to_owned();
                job.status.share = 1.0;
                let work = Work {
                    job: id,
                    part_name: job.status.part_serial.clone(),
                    acquired: *acquired,
                    findings: std::mem::take(&mut job.findings),
                    created: now,
                };
                let sent = self
                    .work
                    .as_ref()
                    .is_some_and(|sender| sender.send(work).is_ok());
                if sent {
                    self.computing.push(job);
                } else {
                    self.abort(id, "the computing thread is gone; restart the daemon");
                }
            }
            Err(error) => self.abort(id, &chain(&error)),
        }
        if failed {
            // Part after part without anybody watching ends with the first one that fails.
            self.drop_waiting("the part before could not be measured");
        }
    }

    fn count(&mut self, acquired: &Acquired) {
        for view in &acquired.scan.views {
            if let Some(device) = self
                .snapshot
                .devices
                .iter_mut()
                .find(|d| d.name == view.device)
            {
                device.received += view.losses.received;
                device.lost += view.losses.lost_on_link + view.losses.dropped_by_device;
            }
        }
    }

    fn kept(&mut self, job: i64, kept: Result<(u64, bool), String>) {
        let noted = match kept {
            Ok((0, _)) => self.store.forget_scan(job),
            Ok((bytes, whole)) => self.store.scan_kept(job, bytes, whole),
            Err(error) => {
                tracing::error!(inspection = job, error, "raw data not kept");
                Ok(())
            }
        };
        if let Err(error) = noted {
            self.fault = Some(chain(&error));
        }
        self.look_at_disk();
    }

    fn concluded(&mut self, id: i64, result: Result<Inspection, String>) {
        self.computing.retain(|job| job.status.id != id);
        self.look_at_disk();
        match result {
            Ok(inspection) => {
                tracing::info!(
                    inspection = id,
                    part = inspection.part_serial,
                    verdict = ?inspection.verdict,
                    reason = inspection.reason,
                    "inspected"
                );
                self.snapshot.last = Some(inspection);
            }
            Err(reason) => {
                tracing::error!(inspection = id, reason, "no result");
                self.abort(id, &reason);
            }
        }
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

    fn look_at_disk(&mut self) {
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
        let before = self.publisher.borrow().clone();
        snapshot.sequence = before.sequence;
        if *before != *snapshot {
            snapshot.sequence += 1;
            self.publisher.send_replace(Arc::new(snapshot.clone()));
        }
    }
}

impl Job {
    fn new(inspection: &Inspection) -> Self {
        Self {
            status: JobStatus {
                id: inspection.id,
                part_serial: inspection.part_serial.clone(),
                order_number: inspection.order_number.clone(),
                step: "waiting".to_owned(),
                touches: None,
                profiles: 0,
                share: 0.0,
                findings: Vec::new(),
            },
            findings: Vec::new(),
        }
    }
}

fn supervise(
    cell: &Arc<Cell>,
    index: usize,
    links: &Arc<dyn Links + Send + Sync>,
    events: &Sender<Event>,
) -> Option<Supervisor> {
    let told = events.clone();
    let tell = move |news| {
        // The loop may have ended; then nobody wants to know.
        let _ = told.send(Event::Device { index, news });
    };
    match Supervisor::start(cell, index, links, tell) {
        Ok(supervisor) => Some(supervisor),
        Err(error) => {
            let news = News::Failed(format!("no thread could be started: {error}"));
            let _ = events.send(Event::Device { index, news });
            None
        }
    }
}

/// The one thread that computes results; the kernel itself uses all cores.
fn start_computing(
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

fn device_status(cell: &Cell, index: usize, now: SystemTime) -> DeviceStatus {
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

/// An instrument that a job had, back to the thread that looks after it.
pub(super) fn give_back(supervisors: &[Supervisor], index: usize, instrument: Option<Instrument>) {
    if let Some(supervisor) = supervisors.get(index) {
        supervisor.give_back(instrument);
    }
}

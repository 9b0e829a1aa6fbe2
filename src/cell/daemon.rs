//! The running cell as others see it: [`Daemon`] holds it, [`Handle`] speaks to it. Everything that happens comes to its one loop as an
//! [`Event`], one after the other.

mod computing;
mod jobs;
mod running;

use std::collections::VecDeque;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime};

use acies_drivers::device::Instrument;
use acies_drivers::link::Links;
use tokio::sync::{oneshot, watch};

use super::devices::{self, News, Supervisor, chain};
use super::feed::{Feed, feed};
use super::job::{Acquired, Part, Step};
use super::live::Live;
use super::recipes;
use super::state::Mode;
use super::status::Snapshot;
use super::{CellError, State};
use crate::config::Cell;
use crate::store::{Inspection, Order, RecipeVersion, Retention, Store, StoreError};
use computing::start_computing;
use running::{Running, device_status};

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
    /// The inspection that is to be repeated is not there.
    #[error("inspection {first} is to be repeated, but it is not in the history")]
    NothingToRepeat {
        /// Its number, as given.
        first: i64,
    },
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
        result: Result<Box<Inspection>, String>,
    },
    /// The end.
    End,
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
    told: Feed,
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
        let (publisher, told) = feed(snapshot.clone());
        let beat = Arc::new(Mutex::new(Instant::now()));
        let handle = Handle {
            events: events.clone(),
            told,
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
        self.told.newest().borrow().clone()
    }

    /// Follows what is so.
    pub fn follow(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.told.newest()
    }

    /// Every snapshot after the one with number `sequence`, oldest first; `None` where that was too long ago, or never.
    pub fn since(&self, sequence: u64) -> Option<Vec<Arc<Snapshot>>> {
        self.told.since(sequence)
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

/// An instrument that a job had, back to the thread that looks after it.
pub(super) fn give_back(supervisors: &[Supervisor], index: usize, instrument: Option<Instrument>) {
    if let Some(supervisor) = supervisors.get(index) {
        supervisor.give_back(instrument);
    }
}

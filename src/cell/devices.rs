//! One thread a device: it opens the device, tries again for ever where it cannot, and lends the open device to a job.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use acies_drivers::device::{Identity, Instrument, Presence, Setup};
use acies_drivers::link::Links;

pub(super) use crate::acquire::chain;
use crate::config::Cell;

/// First wait after a failure; doubled up to [`WAIT_MAX`] while it goes on failing.
const WAIT_FIRST: Duration = Duration::from_millis(250);
/// Longest wait between two tries: an operator who plugs a cable in looks at the screen for about as long.
const WAIT_MAX: Duration = Duration::from_secs(5);
/// How often an idle device is asked whether it is still there.
const CHECK_EVERY: Duration = Duration::from_secs(5);

/// What a device's thread tells.
#[derive(Debug)]
pub(super) enum News {
    /// Open, and the one that was asked for.
    Ready(Identity),
    /// Not there, or not the one that was asked for.
    Failed(String),
}

/// The open device for a job, or why there is none.
pub(super) type Lent = Result<Instrument, String>;

/// What a device's thread is asked.
enum Request {
    Lend(Sender<Lent>),
    Return(Option<Instrument>),
    Retry,
}

/// Looks after one device. Dropping it closes the device.
pub(super) struct Supervisor {
    requests: Option<Sender<Request>>,
    thread: Option<JoinHandle<()>>,
}

impl Supervisor {
    /// Begins to open device `index` of `cell`: profilers first, then probes. `tell` is called from the device's thread.
    pub(super) fn start(
        cell: &Arc<Cell>,
        index: usize,
        links: &Arc<dyn Links + Send + Sync>,
        tell: impl Fn(News) + Send + 'static,
    ) -> std::io::Result<Self> {
        let (requests, received) = channel();
        let (cell, links) = (cell.clone(), links.clone());
        let name = format!("device {}", name_of(&cell, index));
        let thread = thread::Builder::new().name(name).spawn(move || {
            look_after(setup_of(&cell, index), &*links, &received, &tell);
        })?;
        Ok(Self {
            requests: Some(requests),
            thread: Some(thread),
        })
    }

    /// Asks for the device, for a job. It is asked whether it is still there, and opened anew where it does not say so: it may have been unplugged and
    /// plugged in again since it was last heard. What comes on the channel is the device or why there is none; nothing comes where the cell ends.
    pub(super) fn lend(&self) -> Receiver<Lent> {
        let (answer, answered) = channel();
        self.ask(Request::Lend(answer));
        answered
    }

    /// Gives the device back; `None` for one that was lost: it is opened anew.
    pub(super) fn give_back(&self, instrument: Option<Instrument>) {
        self.ask(Request::Return(instrument));
    }

    /// Tries at once instead of waiting.
    pub(super) fn retry(&self) {
        self.ask(Request::Retry);
    }

    fn ask(&self, request: Request) {
        if let Some(requests) = &self.requests {
            // The thread ends only after this sender is gone, or by a panic, which has been logged.
            let _ = requests.send(request);
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.requests = None;
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been logged by the runtime; there is nobody left to tell.
            let _ = thread.join();
        }
    }
}

/// Devices of a cell, in the order of their indices: profilers, probes, the robot.
pub(super) fn count(cell: &Cell) -> usize {
    cell.profilers.len() + cell.probes.len() + usize::from(cell.carrier.is_some())
}

/// The name of a cell's device by its index.
pub(super) fn name_of(cell: &Cell, index: usize) -> &str {
    named(cell, index).0
}

fn setup_of(cell: &Cell, index: usize) -> &dyn Setup {
    named(cell, index).1
}

fn named(cell: &Cell, index: usize) -> (&str, &dyn Setup) {
    let profilers = cell.profilers.iter().map(|p| (p.name.as_str(), &*p.setup));
    let probes = cell.probes.iter().map(|p| (p.name.as_str(), &*p.setup));
    let carrier = cell.carrier.iter().map(|c| (c.name.as_str(), &*c.setup));
    let mut all = profilers.chain(probes).chain(carrier);
    all.nth(index).expect("an index below the count")
}

fn look_after(
    setup: &dyn Setup,
    links: &dyn Links,
    requests: &Receiver<Request>,
    tell: &dyn Fn(News),
) {
    let mut wait = WAIT_FIRST;
    let mut told_ready = false;
    let mut wanted = None;
    loop {
        match setup.open(links) {
            Ok(instrument) => {
                wait = WAIT_FIRST;
                if !told_ready {
                    tell(News::Ready(instrument.identity().clone()));
                    told_ready = true;
                }
                match keep(instrument, wanted.take(), requests) {
                    Kept::Check(by) => wanted = by,
                    Kept::Lost => told_ready = false,
                    Kept::End => return,
                }
            }
            Err(error) => {
                told_ready = false;
                let error = chain(&error);
                if let Some(answer) = wanted.take() {
                    // Nobody may be waiting any more.
                    let _ = answer.send(Err(error.clone()));
                }
                tell(News::Failed(error.clone()));
                if !pause(wait, &error, requests) {
                    return;
                }
                wait = (2 * wait).min(WAIT_MAX);
            }
        }
    }
}

/// How the time with an open device ended.
enum Kept {
    /// It should be opened anew, to see whether it is still there: it did not say so itself. Then it is lent to who waits for it.
    Check(Option<Sender<Lent>>),
    /// It is gone.
    Lost,
    /// The cell ends.
    End,
}

/// Keeps an open device until it is to be opened anew, was lost, or the cell ends; lends it meanwhile, at first to `wanted`.
fn keep(
    instrument: Instrument,
    wanted: Option<Sender<Lent>>,
    requests: &Receiver<Request>,
) -> Kept {
    let mut held = Some(instrument);
    if let Some(answer) = wanted {
        held = hand_over(held, &answer);
    }
    loop {
        // A device that is lent comes back in the end: the job that has it returns it, or says that it is lost.
        let request = match &held {
            Some(_) => requests.recv_timeout(CHECK_EVERY),
            None => requests.recv().map_err(RecvTimeoutError::from),
        };
        match request {
            Ok(Request::Lend(answer)) => match held.as_mut().map(Instrument::check) {
                Some(Err(_)) => return Kept::Check(Some(answer)),
                // Where it knows no such question the job sees what is there.
                _ => held = hand_over(held, &answer),
            },
            Ok(Request::Return(Some(instrument))) => held = Some(instrument),
            Ok(Request::Return(None)) => return Kept::Lost,
            Ok(Request::Retry) => {}
            Err(RecvTimeoutError::Timeout) => match held.as_mut().map(Instrument::check) {
                Some(Ok(Presence::Answered)) => {}
                // Opening it anew tells, and says why where it is gone.
                _ => return Kept::Check(None),
            },
            Err(RecvTimeoutError::Disconnected) => return Kept::End,
        }
    }
}

/// Sends a device to who asked for it; back where nobody waits any more.
fn hand_over(held: Option<Instrument>, answer: &Sender<Lent>) -> Option<Instrument> {
    let lent = held.ok_or_else(|| "another job has it".to_owned());
    answer.send(lent).err().and_then(|unsent| unsent.0.ok())
}

/// Waits for the next try after a `failure`; false where the cell ends.
fn pause(wait: Duration, failure: &str, requests: &Receiver<Request>) -> bool {
    let until = std::time::Instant::now() + wait;
    loop {
        let left = until.saturating_duration_since(std::time::Instant::now());
        match requests.recv_timeout(left) {
            Ok(Request::Lend(answer)) => {
                // Nobody may be waiting any more.
                let _ = answer.send(Err(failure.to_owned()));
            }
            Ok(Request::Return(_)) => {}
            Ok(Request::Retry) | Err(RecvTimeoutError::Timeout) => return true,
            Err(RecvTimeoutError::Disconnected) => return false,
        }
    }
}

//! The part of a job that the devices do: borrowed, used, given back.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use acies_drivers::capture::{Pose, Profile};
use acies_drivers::device::Instrument;
use glam::DVec3;

use super::CellError;
use super::daemon::{Event, give_back};
use super::devices::{self, Lent, Supervisor, chain, name_of};
use super::job::{
    Acquired, Instruments, JobWatch, Part, Step, acquire, as_carrier, as_probe, as_profiler,
    step_of,
};
use super::live::Live;
use super::meanwhile::Show;
use crate::acquire::{Profiling, ScanEvent, ScanWatch};
use crate::config::Cell;
use crate::store::{ScanFileError, ScanWriter, StoredCarrier, StoredView};

/// How often progress is told.
const TELL_EVERY: Duration = Duration::from_millis(250);

/// What an acquisition needs.
pub(super) struct Acquisition {
    pub job: i64,
    pub cell: Arc<Cell>,
    pub part: Arc<Part>,
    pub supervisors: Arc<Vec<Supervisor>>,
    pub live: Arc<Live>,
    pub events: Sender<Event>,
    pub abort: Arc<AtomicBool>,
    pub scan_path: PathBuf,
}

/// Runs an acquisition to its end, whatever that is; every device is given back before the loop is told.
pub(super) fn acquire_for(acquisition: Acquisition) {
    let job = acquisition.job;
    let events = acquisition.events.clone();
    let mut writer = None;
    let result = catch_unwind(AssertUnwindSafe(|| work(&acquisition, &mut writer)));
    let result = result.unwrap_or_else(|_| {
        // The devices went with it and are opened anew.
        for index in 0..acquisition.supervisors.len() {
            give_back(&acquisition.supervisors, index, None);
        }
        Err(CellError::GivenUp {
            reason: "a fault of the program; its log has the place: please report it".to_owned(),
        })
    });
    let whole = result.is_ok();
    // The loop may have ended; its channel is then gone, and the next start mends the rest.
    let _ = events.send(Event::Acquired {
        job,
        result: result.map(Box::new),
    });
    let kept = match writer {
        Some(Ok(writer)) => writer
            .finish(whole)
            .map(|bytes| (bytes, whole))
            .map_err(|error| chain(&error)),
        Some(Err(error)) => Err(error),
        None => return,
    };
    let _ = events.send(Event::Kept { job, kept });
}

/// The raw data's file, or why it is lost.
type Writer = Option<Result<ScanWriter, String>>;

fn work(acquisition: &Acquisition, writer: &mut Writer) -> Result<Acquired, CellError> {
    let mut instruments = borrow(acquisition)?;
    let plan = acquisition.cell.carrier.as_ref().map(|config| config.plan);
    let carrier = plan.map(|plan| StoredCarrier {
        machine_from_base: plan.machine_from_base,
        lag_s: plan.lag_s,
    });
    let views: Vec<StoredView> = instruments
        .profilers
        .iter()
        .map(|profiling| StoredView {
            device: profiling.name.clone(),
            identity: profiling.profiler.identity().clone(),
            calibration: profiling.calibration,
            carried: carrier.is_some(),
            carrier,
        })
        .collect();
    let names: Vec<String> = views.iter().map(|view| view.device.clone()).collect();
    acquisition.live.begin(acquisition.job, &names);
    *writer =
        Some(ScanWriter::create(&acquisition.scan_path, &views).map_err(|error| chain(&error)));
    let mut follower = Follower {
        acquisition,
        writer,
        told: None,
        lost: Vec::new(),
    };
    let part = &acquisition.part;
    let result = acquire(&acquisition.cell, part, &mut instruments, &mut follower);
    let lost = std::mem::take(&mut follower.lost);
    let failed_probe = match &result {
        Err(CellError::Touch { device, .. }) => Some(device.clone()),
        _ => None,
    };
    let is_lost = |name: &str| {
        lost.iter().any(|(device, _)| device == name) || failed_probe.as_deref() == Some(name)
    };
    return_all(acquisition, instruments, &is_lost);
    let acquired = result?;
    if let Some((device, error)) = lost.first() {
        return Err(CellError::GivenUp {
            reason: format!("device {device:?} was lost during the scan: {error}"),
        });
    }
    if acquisition.abort.load(Ordering::Acquire) {
        return Err(CellError::GivenUp {
            reason: "aborted while scanning; the raw data up to there are kept".to_owned(),
        });
    }
    Ok(acquired)
}

/// Every device of the cell.
fn borrow(acquisition: &Acquisition) -> Result<Instruments, CellError> {
    let cell = &acquisition.cell;
    // All of them look at once whether their device is still there.
    let asked: Vec<_> = acquisition
        .supervisors
        .iter()
        .map(Supervisor::lend)
        .collect();
    let answers = asked.into_iter().map(|answered| match answered.recv() {
        Ok(lent) => lent,
        Err(_) => Err("the cell ends".to_owned()),
    });
    let answers: Vec<Lent> = answers.collect();
    let whys = answers.iter().map(|lent| lent.as_ref().err().cloned());
    let missing = whys.enumerate().find_map(|(i, why)| Some((i, why?)));
    if let Some((missing, why)) = missing {
        for (index, lent) in answers.into_iter().enumerate() {
            if let Ok(instrument) = lent {
                give_back(&acquisition.supervisors, index, Some(instrument));
            }
        }
        let name = name_of(cell, missing);
        return Err(CellError::GivenUp {
            reason: format!("device {name:?} went away just now: {why}"),
        });
    }
    let mut lent: Vec<Instrument> = answers.into_iter().flatten().collect();
    let mut probes = lent.split_off(cell.profilers.len().min(lent.len()));
    let robot = probes.split_off(cell.probes.len().min(probes.len()));
    let mut instruments = Instruments {
        carrier: None,
        profilers: Vec::new(),
        probes: Vec::new(),
    };
    for (config, instrument) in cell.profilers.iter().zip(lent) {
        instruments.profilers.push(Profiling {
            name: config.name.clone(),
            profiler: as_profiler(&config.name, instrument)?,
            calibration: config.calibration,
        });
    }
    for (config, instrument) in cell.probes.iter().zip(probes) {
        let probe = as_probe(&config.name, instrument)?;
        instruments.probes.push((config.name.clone(), probe));
    }
    for (config, instrument) in cell.carrier.iter().zip(robot) {
        instruments.carrier = Some(as_carrier(config, instrument)?);
    }
    Ok(instruments)
}

fn return_all(acquisition: &Acquisition, instruments: Instruments, is_lost: &dyn Fn(&str) -> bool) {
    let cell = &acquisition.cell;
    let mut profilers = instruments.profilers.into_iter();
    for (index, config) in cell.profilers.iter().enumerate() {
        // After a scan that did not start there are none.
        let profiler = profilers.next().filter(|_| !is_lost(&config.name));
        let instrument = profiler.map(|profiling| Instrument::Profiler(profiling.profiler));
        give_back(&acquisition.supervisors, index, instrument);
    }
    for (index, (name, probe)) in instruments.probes.into_iter().enumerate() {
        let instrument = (!is_lost(&name)).then_some(Instrument::Probe(probe));
        give_back(
            &acquisition.supervisors,
            cell.profilers.len() + index,
            instrument,
        );
    }
    if let Some(carrier) = instruments.carrier {
        let instrument = (!is_lost(&carrier.name)).then_some(Instrument::Robot(carrier.robot));
        give_back(
            &acquisition.supervisors,
            devices::count(cell) - 1,
            instrument,
        );
    }
}

/// Tells the loop, shows the points, keeps the raw data.
struct Follower<'a> {
    acquisition: &'a Acquisition,
    writer: &'a mut Writer,
    told: Option<Instant>,
    lost: Vec<(String, String)>,
}

impl Follower<'_> {
    /// Writes into the raw data's file, as long as that can be written.
    fn keep(&mut self, write: impl FnOnce(&mut ScanWriter) -> Result<(), ScanFileError>) {
        if let Some(Ok(writer)) = self.writer
            && let Err(error) = write(writer)
        {
            *self.writer = Some(Err(chain(&error)));
        }
    }
}

impl ScanWatch for Follower<'_> {
    fn event(&mut self, event: ScanEvent) {
        if let ScanEvent::Lost { device, error } = &event {
            self.lost.push((device.clone(), error.clone()));
            // Half a part is no part: the others need not go on.
            self.acquisition.abort.store(true, Ordering::Release);
        } else if self.told.is_some_and(|told| told.elapsed() < TELL_EVERY) {
            return;
        } else {
            self.told = Some(Instant::now());
        }
        self.step(step_of(event));
    }

    fn profile(&mut self, view: usize, profile: &Profile, points: &[DVec3]) {
        self.acquisition.live.push(view, profile, points);
        self.keep(|writer| writer.push(view, profile));
    }

    fn pose(&mut self, pose: &Pose) {
        self.keep(|writer| writer.push_pose(pose));
    }

    fn aborted(&mut self) -> bool {
        self.acquisition.abort.load(Ordering::Acquire)
    }
}

impl JobWatch for Follower<'_> {
    fn step(&mut self, step: Step) {
        let _ = self.acquisition.events.send(Event::Step {
            job: self.acquisition.job,
            step,
        });
    }

    fn show(&mut self) -> Option<Show> {
        let (live, job) = (self.acquisition.live.clone(), self.acquisition.job);
        Some(Box::new(move |edges| live.measured(job, edges)))
    }
}

//! A line-laser profiler that speaks the open-profile protocol, version 1, played from the protocol's document.
//!
//! Where the document leaves a choice, this device chooses: a START with another run number ends a run that is under way without
//! a STOPPED; pulling the cable takes its power, so that it is another boot afterwards; the clock of an unpaced device is that of
//! its exposures, so that the same seed gives the same bytes.

mod device;
mod feed;
mod frame;
mod message;
#[cfg(test)]
mod tests;

use std::io;
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use crate::faults::{DamageCount, Faults};
use crate::sensor::View;
use crate::wire::{Runner, Wire, lock};

use device::Device;

/// What the device says it is, and how it plays.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// Serial number.
    pub serial: String,
    /// Seed of boot numbers and faults; the noise has the view's own.
    pub seed: u64,
    /// Real time between profiles as the rate says; otherwise as fast as the host takes them.
    pub paced: bool,
    /// Samples of 32 bits, otherwise 16.
    pub wide: bool,
    /// x and z per count, nm.
    pub scale_nm: u32,
    /// What goes wrong.
    pub faults: Faults,
}

impl Setup {
    /// A faultless device, unpaced, 16-bit samples of 2 um.
    pub fn new(serial: &str, seed: u64) -> Setup {
        Setup {
            serial: serial.to_owned(),
            seed,
            paced: false,
            wide: false,
            scale_nm: 2000,
            faults: Faults::default(),
        }
    }
}

/// What became of one profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// Went out whole.
    Sent,
    /// Went out twice, whole.
    Duplicated,
    /// Went out with wrong or missing bytes, or a wrong length.
    Damaged,
    /// Has a sequence number and never went out.
    LostOnLink,
    /// Was taken and not sent; the device's own count says so.
    DroppedInDevice,
    /// Was waiting when the link went.
    Unsent,
}

/// One profile in the side log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record {
    /// Run it belongs to.
    pub run: u32,
    /// Which exposure of the run, from 0.
    pub index: u32,
    /// Sequence number, where it got one.
    pub sequence: Option<u32>,
    /// What became of it.
    pub fate: Fate,
}

/// The exact side log: everything that was taken, and what became of it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Truth {
    /// Every profile since the device was made, in order of exposure (the first million).
    pub profiles: Vec<Record>,
    /// Bytes lost, changed and invented.
    pub bytes: DamageCount,
}

impl Truth {
    /// Profiles of a run with one fate.
    pub fn count(&self, run: u32, fate: Fate) -> usize {
        let of_run = self.profiles.iter().filter(|p| p.run == run);
        of_run.filter(|p| p.fate == fate).count()
    }
}

/// The device as seen from outside the wire.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Status {
    /// Whether light comes out.
    pub laser_on: bool,
    /// Whether a run is under way.
    pub streaming: bool,
    /// Number of the last run, where there was one since the start.
    pub run: Option<u32>,
    /// Profiles sent in it.
    pub sent: u32,
    /// Profiles dropped in it.
    pub dropped: u32,
    /// Boot number.
    pub boot: u32,
    /// Starts since it was made.
    pub boots: u32,
    /// Commands answered since it was made.
    pub answered: u64,
    /// Whether the cable is in.
    pub plugged: bool,
}

/// A running simulated profiler; dropping it takes its port away.
#[derive(Debug)]
pub struct SimulatedProfiler {
    runner: Runner,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
pub(crate) struct Shared {
    state: Mutex<(Status, Truth)>,
    changed: Condvar,
}

impl Shared {
    pub(crate) fn update(&self, change: impl FnOnce(&mut Status, &mut Truth)) {
        let mut state = lock(&self.state);
        let (status, truth) = &mut *state;
        change(status, truth);
        self.changed.notify_all();
    }
}

impl SimulatedProfiler {
    /// Starts a device that looks through `view`.
    ///
    /// # Errors
    /// When the system gives no thread or event.
    pub fn start(wire: Wire, view: View, setup: Setup) -> io::Result<SimulatedProfiler> {
        let shared = Arc::new(Shared::default());
        let (faults, seed) = (setup.faults.clone(), setup.seed);
        let seen = shared.clone();
        let runner = Runner::start(wire, &faults, seed, |waker| {
            Device::new(view, setup, seen, waker)
        })?;
        Ok(SimulatedProfiler { runner, shared })
    }

    /// Where a host finds it: the path of the port, or `address:port`.
    pub fn port(&self) -> &str {
        self.runner.name()
    }

    /// What it does now.
    pub fn status(&self) -> Status {
        lock(&self.shared.state).0.clone()
    }

    /// Everything it did.
    pub fn truth(&self) -> Truth {
        lock(&self.shared.state).1.clone()
    }

    /// Waits until the status is as wanted; false when `patience` is over before.
    pub fn wait_until(&self, patience: Duration, wanted: impl Fn(&Status) -> bool) -> bool {
        let until = Instant::now() + patience;
        let mut state = lock(&self.shared.state);
        while !wanted(&state.0) {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            let waited = self.shared.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(|e| e.into_inner()).0;
        }
        true
    }

    /// Pulls the cable out, as soon as what was sent is read (or half a second is over).
    pub fn unplug(&self) {
        self.runner.plug(false);
    }

    /// Puts it back in.
    pub fn replug(&self) {
        self.runner.plug(true);
    }
}

//! Sensors of single points on a serial line: what their simulations share beside the protocols.
//!
//! Values follow a slow ramp up and down the range, so that every value is known from its number alone. Each value has a
//! record in the side log: what was meant, and what became of it on the way.

use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::faults::{BadLine, DamageCount, Faults};
use crate::wire::{Model, Outbox, Runner, Wire, lock};

/// Records kept in the side log.
const LOGGED: usize = 1_000_000;

/// The device as seen from outside the wire.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Status {
    /// Whether light comes out.
    pub laser_on: bool,
    /// Whether it sends values unasked.
    pub streaming: bool,
    /// Whether the cable is in.
    pub plugged: bool,
    /// Starts since it was made.
    pub starts: u32,
    /// Commands answered or obeyed since it was made.
    pub answered: u64,
}

/// What became of one value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// Went out whole.
    Sent,
    /// Went out with wrong or missing bytes.
    Damaged,
    /// Was measured and not sent: triggered too fast.
    DroppedInDevice,
    /// Was waiting when the link went, or found no room.
    Unsent,
}

/// One value in the side log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record {
    /// The device's own number of it, as sent: it wraps where the device's does.
    pub number: u32,
    /// What was sent, in the protocol's unit.
    pub code: i64,
    /// What became of it.
    pub fate: Fate,
}

/// The exact side log.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Truth {
    /// Every value that was to be sent since the device was made, in order (the first million).
    pub values: Vec<Record>,
    /// Bytes lost, changed and invented.
    pub bytes: DamageCount,
}

impl Truth {
    /// Values with one fate.
    pub fn count(&self, fate: Fate) -> u64 {
        self.values.iter().filter(|v| v.fate == fate).count() as u64
    }
}

/// State and side log, shared with whoever watches from outside.
#[derive(Debug, Default)]
pub struct Shared {
    state: Mutex<(Status, Truth)>,
    changed: Condvar,
}

impl Shared {
    pub(crate) fn update<T>(&self, change: impl FnOnce(&mut Status, &mut Truth) -> T) -> T {
        let mut state = lock(&self.state);
        let (status, truth) = &mut *state;
        let answer = change(status, truth);
        self.changed.notify_all();
        answer
    }

    /// What it does now.
    pub fn status(&self) -> Status {
        lock(&self.state).0.clone()
    }

    /// Everything it sent.
    pub fn truth(&self) -> Truth {
        lock(&self.state).1.clone()
    }

    /// What `look` makes of everything it sent, without a copy.
    pub fn look<T>(&self, look: impl FnOnce(&Truth) -> T) -> T {
        look(&lock(&self.state).1)
    }
}

/// A running simulated sensor; dropping it takes its port away.
#[derive(Debug)]
pub struct SimulatedSensor {
    runner: Runner,
    shared: Arc<Shared>,
}

impl SimulatedSensor {
    pub(crate) fn start<M: Model>(
        wire: Wire,
        faults: &Faults,
        seed: u64,
        model: impl FnOnce(Arc<Shared>, Instant) -> M,
    ) -> io::Result<SimulatedSensor> {
        let shared = Arc::new(Shared::default());
        let seen = shared.clone();
        let runner = Runner::start(wire, faults, seed, |_| model(seen, Instant::now()))?;
        Ok(SimulatedSensor { runner, shared })
    }

    /// Where a host finds it: the path of the port, or `address:port`.
    pub fn port(&self) -> &str {
        self.runner.name()
    }

    /// What it does now.
    pub fn status(&self) -> Status {
        self.shared.status()
    }

    /// Everything it sent.
    pub fn truth(&self) -> Truth {
        self.shared.truth()
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

    /// Pulls the cable out, as soon as what was sent is read.
    pub fn unplug(&self) {
        self.runner.plug(false);
    }

    /// Puts it back in.
    pub fn replug(&self) {
        self.runner.plug(true);
    }
}

/// Up from `low` to `high` in `steps`, and down again, for ever.
pub(crate) fn ramp(number: u64, low: i64, high: i64, steps: u64) -> i64 {
    let place = number % (2 * steps);
    let up = if place < steps {
        place
    } else {
        2 * steps - place
    };
    low + (high - low) * up as i64 / steps as i64
}

/// The mouth and the ill luck of a device.
#[derive(Debug)]
pub(crate) struct Core {
    pub faults: Faults,
    pub shared: Arc<Shared>,
    line: BadLine,
    chance: ChaCha8Rng,
    /// Answers that wait for their time.
    late: VecDeque<(Instant, Vec<u8>)>,
    commands: u32,
    values: u32,
    pub silent: bool,
    pub unplug: bool,
    pub reboot: bool,
}

impl Core {
    pub fn new(faults: &Faults, seed: u64, shared: Arc<Shared>) -> Core {
        let mut chance = ChaCha8Rng::seed_from_u64(seed);
        chance.set_stream(u64::MAX - 2);
        Core {
            faults: faults.clone(),
            shared,
            line: BadLine::new(faults, seed),
            chance,
            late: VecDeque::new(),
            commands: 0,
            values: 0,
            silent: faults.silent_after == Some(0),
            unplug: false,
            reboot: false,
        }
    }

    pub fn happens(&mut self, p: f64) -> bool {
        p > 0.0 && self.chance.random_bool(p)
    }

    pub fn draw(&mut self, below: usize) -> usize {
        self.chance.random_range(0..below)
    }

    /// Counts a command; true where this one is to be refused.
    pub fn refuses(&mut self) -> bool {
        self.commands += 1;
        self.shared.update(|status, _| status.answered += 1);
        self.faults.refuse == Some(self.commands)
    }

    /// Sends bytes that are no value; true when they did not arrive whole.
    pub fn say(&mut self, bytes: &[u8], out: &mut Outbox) -> bool {
        if self.silent {
            return true;
        }
        let mut carried = Vec::with_capacity(bytes.len());
        let damaged = self.line.carry(bytes, &mut carried);
        out.push(&carried);
        damaged
    }

    /// Sends an answer after the time that the device takes for it, and later still where the faults say so.
    pub fn answer(&mut self, bytes: &[u8], after: Duration, now: Instant) {
        let due = now + after + self.faults.late.unwrap_or_default();
        self.late.push_back((due, bytes.to_vec()));
    }

    /// Sends the answers whose time has come; when the next one is due.
    pub fn due(&mut self, now: Instant, out: &mut Outbox) -> Option<Instant> {
        while let Some((due, _)) = self.late.front() {
            if *due > now {
                return Some(*due);
            }
            if let Some((_, bytes)) = self.late.pop_front() {
                self.say(&bytes, out);
            }
        }
        None
    }

    /// Forgets what it was about to say.
    pub fn hush(&mut self) {
        self.late.clear();
    }

    /// Sends the bytes of one value in parts, with something in between where given, and logs what became of it.
    pub fn value(&mut self, record: Record, parts: [&[u8]; 2], between: &[u8], out: &mut Outbox) {
        if self.happens(self.faults.drop) {
            self.log(record, Fate::DroppedInDevice, out);
        } else if !self.silent {
            let first = self.say(parts[0], out);
            self.say(between, out);
            let damaged = self.say(parts[1], out) || first;
            let fate = if damaged { Fate::Damaged } else { Fate::Sent };
            self.log(record, fate, out);
        }
        self.values = self.values.saturating_add(1);
        let at = |n: Option<u32>| n == Some(self.values);
        self.silent |= at(self.faults.silent_after);
        self.unplug |= at(self.faults.unplug_after);
        self.reboot |= at(self.faults.reboot_after);
    }

    pub fn log(&mut self, record: Record, fate: Fate, out: &mut Outbox) {
        let bytes = self.line.count;
        let place = self.shared.update(|_, truth| {
            truth.bytes = bytes;
            (truth.values.len() < LOGGED).then(|| {
                truth.values.push(Record { fate, ..record });
                truth.values.len() - 1
            })
        });
        if let Some(place) = place {
            out.mark(place as u32);
        }
    }

    /// The link went; the values with these places did not go out.
    pub fn detached(&mut self, unplugged: bool, unsent: &[u32]) {
        self.hush();
        self.unplug = false;
        self.shared.update(|status, truth| {
            for &place in unsent {
                truth.values[place as usize].fate = Fate::Unsent;
            }
            status.plugged &= !unplugged;
        });
    }
}

//! Simulated USB devices: what a device does with transfers ([`Model`]), the socket it is plugged into ([`Socket`]), and how an unmodified program gets
//! at it ([`preload`]), or a whole kernel ([`redir`]). A test may also call the socket itself, in the same process.

pub mod preload;
pub mod redir;

use std::collections::BTreeSet;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use crate::wire::lock;

/// What a transfer comes to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// Bytes for the host: one whole transfer, or as much of it as the host asked for.
    Data(Vec<u8>),
    /// As many bytes of the host were taken.
    Accepted(usize),
    /// The endpoint halts.
    Stall,
    /// Nothing yet.
    Nak,
}

/// What a device is and does.
pub trait Model: Send {
    /// Device descriptor, 18 bytes.
    fn device_descriptor(&self) -> Vec<u8>;
    /// Configuration descriptor with all that belongs to it.
    fn configuration_descriptor(&self) -> Vec<u8>;
    /// String descriptors, from 1.
    fn strings(&self) -> Vec<String>;
    /// A request on the control endpoint that is none of the standard's for descriptors.
    fn control(&mut self, setup: [u8; 8], data: &[u8]) -> Outcome;
    /// A transfer of the host to an endpoint.
    fn output(&mut self, endpoint: u8, data: &[u8]) -> Outcome;
    /// The host asks an endpoint for at most so many bytes.
    fn input(&mut self, endpoint: u8, most: usize) -> Outcome;
    /// The host's program closed the device, or was killed.
    fn closed(&mut self) {}
    /// It was plugged in, and has power for the first time or again.
    fn powered(&mut self) {}
}

/// What a transfer in this process came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Passed {
    /// Bytes of the device.
    Bytes(Vec<u8>),
    /// As many bytes of the host were taken.
    Taken(usize),
    /// The endpoint is halted.
    Stall,
    /// Nothing passed in time.
    Late,
    /// It is not plugged in.
    Gone,
}

pub(crate) struct Plugged<M> {
    pub model: M,
    pub halted: BTreeSet<u8>,
    pub present: bool,
}

impl<M: Model> Plugged<M> {
    fn halting(&mut self, endpoint: u8, outcome: Outcome) -> Outcome {
        if outcome == Outcome::Stall {
            self.halted.insert(endpoint);
        }
        outcome
    }

    pub fn input(&mut self, endpoint: u8, most: usize) -> Outcome {
        if self.halted.contains(&endpoint) {
            return Outcome::Stall;
        }
        let outcome = self.model.input(endpoint, most);
        self.halting(endpoint, outcome)
    }

    pub fn output(&mut self, endpoint: u8, data: &[u8]) -> Outcome {
        if self.halted.contains(&endpoint) {
            return Outcome::Stall;
        }
        let outcome = self.model.output(endpoint, data);
        self.halting(endpoint, outcome)
    }

    pub fn control(&mut self, setup: [u8; 8], data: &[u8]) -> Outcome {
        let length = usize::from(u16::from_le_bytes([setup[6], setup[7]]));
        let cut = |mut bytes: Vec<u8>| {
            bytes.truncate(length);
            Outcome::Data(bytes)
        };
        match (setup[0], setup[1], setup[3]) {
            (0x80, 6, 1) => cut(self.model.device_descriptor()),
            (0x80, 6, 2) => cut(self.model.configuration_descriptor()),
            (0x80, 6, 3) if setup[2] == 0 => cut(vec![4, 3, 9, 4]),
            (0x80, 6, 3) => match self.model.strings().get(usize::from(setup[2]) - 1) {
                Some(text) => cut(string_descriptor(text)),
                None => Outcome::Stall,
            },
            _ => self.model.control(setup, data),
        }
    }
}

fn string_descriptor(text: &str) -> Vec<u8> {
    let mut bytes = vec![0, 3];
    bytes.extend(text.encode_utf16().take(126).flat_map(u16::to_le_bytes));
    bytes[0] = bytes.len() as u8;
    bytes
}

struct Inside<M> {
    plugged: Mutex<Plugged<M>>,
    changed: Condvar,
}

/// A socket with a device in it.
pub struct Socket<M> {
    inside: Arc<Inside<M>>,
}

impl<M> Clone for Socket<M> {
    fn clone(&self) -> Socket<M> {
        Socket {
            inside: Arc::clone(&self.inside),
        }
    }
}

/// How often a transfer that waits is offered to the device again: devices that keep time are not asked by anybody else.
pub(crate) const TICK: Duration = Duration::from_millis(1);

impl<M: Model> Socket<M> {
    /// Plugs a device in.
    pub fn new(mut model: M) -> Socket<M> {
        model.powered();
        Socket {
            inside: Arc::new(Inside {
                plugged: Mutex::new(Plugged {
                    model,
                    halted: BTreeSet::new(),
                    present: true,
                }),
                changed: Condvar::new(),
            }),
        }
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, Plugged<M>> {
        lock(&self.inside.plugged)
    }

    pub(crate) fn wake(&self) {
        self.inside.changed.notify_all();
    }

    /// Looks at the device, or changes it.
    pub fn with<R>(&self, look: impl FnOnce(&mut M) -> R) -> R {
        let answer = look(&mut self.lock().model);
        self.wake();
        answer
    }

    /// Waits until the device is as wanted; false when `patience` is over before.
    pub fn wait_until(&self, patience: Duration, wanted: impl Fn(&M) -> bool) -> bool {
        let until = Instant::now() + patience;
        let mut plugged = self.lock();
        while !wanted(&plugged.model) {
            if Instant::now() >= until {
                return false;
            }
            plugged = self.pause(plugged, until);
        }
        true
    }

    fn pause<'a>(
        &'a self,
        plugged: MutexGuard<'a, Plugged<M>>,
        until: Instant,
    ) -> MutexGuard<'a, Plugged<M>> {
        let left = until.saturating_duration_since(Instant::now()).min(TICK);
        let waited = self.inside.changed.wait_timeout(plugged, left);
        waited.unwrap_or_else(|e| e.into_inner()).0
    }

    /// Pulls it out.
    pub fn unplug(&self) {
        self.lock().present = false;
        self.wake();
    }

    /// Puts it back in: it starts anew.
    pub fn replug(&self) {
        let mut plugged = self.lock();
        plugged.present = true;
        plugged.halted.clear();
        plugged.model.powered();
        drop(plugged);
        self.wake();
    }

    /// Whether it is plugged in.
    pub fn present(&self) -> bool {
        self.lock().present
    }

    /// A request on the control endpoint.
    pub fn control(&self, setup: [u8; 8], data: &[u8]) -> Passed {
        let mut plugged = self.lock();
        if !plugged.present {
            return Passed::Gone;
        }
        let outcome = plugged.control(setup, data);
        drop(plugged);
        self.wake();
        passed(outcome)
    }

    /// A transfer to an endpoint.
    pub fn output(&self, endpoint: u8, data: &[u8]) -> Passed {
        let mut plugged = self.lock();
        if !plugged.present {
            return Passed::Gone;
        }
        let outcome = plugged.output(endpoint, data);
        drop(plugged);
        self.wake();
        passed(outcome)
    }

    /// A transfer from an endpoint.
    pub fn input(&self, endpoint: u8, most: usize, deadline: Instant) -> Passed {
        let mut plugged = self.lock();
        loop {
            if !plugged.present {
                return Passed::Gone;
            }
            match plugged.input(endpoint, most) {
                Outcome::Nak if Instant::now() >= deadline => return Passed::Late,
                Outcome::Nak => plugged = self.pause(plugged, deadline),
                outcome => {
                    drop(plugged);
                    self.wake();
                    return passed(outcome);
                }
            }
        }
    }

    /// Ends a stall.
    pub fn clear_halt(&self, endpoint: u8) {
        self.lock().halted.remove(&endpoint);
        self.wake();
    }

    /// The program that had it open closed it.
    pub fn close(&self) {
        self.lock().model.closed();
        self.wake();
    }

    /// The configuration descriptor.
    pub fn configuration(&self) -> Vec<u8> {
        self.lock().model.configuration_descriptor()
    }

    /// Vendor and product number, and the serial number.
    pub fn names(&self) -> (u16, u16, String) {
        let plugged = self.lock();
        let device = plugged.model.device_descriptor();
        let number = |at: usize| u16::from_le_bytes([device[at], device[at + 1]]);
        let serial = plugged.model.strings().into_iter().nth(2);
        (number(8), number(10), serial.unwrap_or_default())
    }
}

fn passed(outcome: Outcome) -> Passed {
    match outcome {
        Outcome::Data(bytes) => Passed::Bytes(bytes),
        Outcome::Accepted(n) => Passed::Taken(n),
        Outcome::Stall => Passed::Stall,
        Outcome::Nak => Passed::Late,
    }
}

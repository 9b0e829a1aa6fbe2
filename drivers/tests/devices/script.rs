//! A link whose other end is a function of the test's.

use std::collections::VecDeque;
use std::error::Error;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use acies_drivers::device::{Instrument, Setup};
use acies_drivers::error::{DeviceError, LinkError};
use acies_drivers::link::{Link, Links, Target};

/// Longest wait of a test for something that must happen; long because the machine may be busy.
pub const SOON: Duration = Duration::from_secs(20);

/// What the device does with what the host wrote: its answer.
pub trait Device: Send {
    /// Takes one write of the host.
    fn hear(&mut self, written: &[u8]) -> Vec<u8>;
    /// Sends unasked, once at every read that finds nothing; paced by the link.
    fn idle(&mut self) -> Vec<u8> {
        Vec::new()
    }
}

/// A link to a scripted device. Every opening leads to the same one.
pub struct Scripted<D> {
    state: Mutex<State<D>>,
    changed: Condvar,
}

pub struct State<D> {
    pub device: D,
    pub written: Vec<Vec<u8>>,
    to_host: VecDeque<u8>,
    gone: bool,
}

impl<D: Device> Scripted<D> {
    pub fn new(device: D) -> Arc<Scripted<D>> {
        Arc::new(Scripted {
            state: Mutex::new(State {
                device,
                written: Vec::new(),
                to_host: VecDeque::new(),
                gone: false,
            }),
            changed: Condvar::new(),
        })
    }

    pub fn lock(&self) -> MutexGuard<'_, State<D>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends bytes unasked.
    pub fn send(&self, bytes: &[u8]) {
        self.lock().to_host.extend(bytes);
        self.changed.notify_all();
    }

    /// Pulls the plug; bytes under way still arrive.
    pub fn unplug(&self) {
        self.lock().gone = true;
        self.changed.notify_all();
    }

    /// Bytes that the host has not read yet.
    pub fn unread(&self) -> usize {
        self.lock().to_host.len()
    }

    /// Waits until the host has made `happened` true.
    pub fn wait_until(&self, happened: impl Fn(&State<D>) -> bool) {
        let deadline = Instant::now() + SOON;
        let mut state = self.lock();
        while !happened(&state) {
            let left = deadline.saturating_duration_since(Instant::now());
            assert!(!left.is_zero(), "it did not happen within {SOON:?}");
            let waited = self.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// The link that [`Scripted`] opens.
struct End<D>(Arc<Scripted<D>>);

/// What a driver opens links with.
pub struct Wire<D>(pub Arc<Scripted<D>>);

impl<D: Device + 'static> Links for Wire<D> {
    fn open(&self, _: &Target) -> Result<Arc<dyn Link>, LinkError> {
        if self.0.lock().gone {
            return Err(LinkError::NotFound);
        }
        Ok(Arc::new(End(Arc::clone(&self.0))))
    }
}

impl<D: Device> Link for End<D> {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let mut state = self.0.lock();
        loop {
            let n = buffer.len().min(state.to_host.len());
            if n > 0 {
                for (slot, byte) in buffer.iter_mut().zip(state.to_host.drain(..n)) {
                    *slot = byte;
                }
                self.0.changed.notify_all();
                return Ok(n);
            }
            if state.gone {
                return Err(LinkError::Gone);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(0);
            }
            let wait = left.min(Duration::from_millis(5));
            let waited = self.0.changed.wait_timeout(state, wait);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
            let unasked = state.device.idle();
            state.to_host.extend(unasked);
        }
    }

    fn write(&self, bytes: &[u8], _: Instant) -> Result<(), LinkError> {
        let mut state = self.0.lock();
        if state.gone {
            return Err(LinkError::Gone);
        }
        state.written.push(bytes.to_vec());
        let answer = state.device.hear(bytes);
        state.to_host.extend(answer);
        self.0.changed.notify_all();
        Ok(())
    }
}

/// The setup of driver `name` from a table in TOML.
pub fn setup(name: &str, table: &str) -> Box<dyn Setup> {
    let driver = acies_drivers::ALL.iter().find(|driver| driver.name == name);
    let table = toml::from_str(table).expect("the test's TOML");
    (driver.expect("a driver of that name").configure)(table).expect("the test's configuration")
}

/// The mistakes that driver `name` finds in a table in TOML.
pub fn mistakes(name: &str, table: &str) -> Vec<String> {
    let driver = acies_drivers::ALL.iter().find(|driver| driver.name == name);
    let table = toml::from_str(table).expect("the test's TOML");
    let mistakes = (driver.expect("a driver of that name").configure)(table);
    let mistakes = mistakes.err().unwrap_or_default();
    mistakes.iter().map(ToString::to_string).collect()
}

/// The text of an error with its sources.
pub fn text(error: &DeviceError) -> String {
    let mut text = error.to_string();
    let mut inner = error.source();
    while let Some(source) = inner {
        text = format!("{text}: {source}");
        inner = source.source();
    }
    text
}

/// The text of the error of an opening that must fail.
pub fn refusal(opened: Result<Instrument, DeviceError>) -> String {
    match opened {
        Ok(_) => panic!("it opened"),
        Err(error) => text(&error),
    }
}

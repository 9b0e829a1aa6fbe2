//! A host whose reading thread is kept from its work for a while, as by a busy machine: with the transfers in flight that its way of reading has; and
//! one whose cable is pulled after so many transfers.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use acies_drivers::error::LinkError;
use acies_drivers::link::usb::{OneByOne, Request, UsbInterface, UsbLink, UsbStream, UsbTarget};
use acies_drivers::link::{Link, Links, Target};

/// Longest wait for the reading thread to come to a stand; long because the machine may be busy.
const SOON: Duration = Duration::from_secs(30);

/// Links to such a host.
pub struct Hesitant<'a> {
    links: &'a dyn Links,
    gate: Arc<Gate>,
    /// Streams have one transfer in flight at a time.
    single: bool,
    /// Transfers before the cable is pulled.
    left: Arc<AtomicU32>,
}

#[derive(Default)]
struct Gate {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    shut: bool,
    /// The reading thread stands before it.
    waits: bool,
}

/// The reading thread does nothing until this is dropped.
pub struct Busy<'a>(&'a Gate);

impl<'a> Hesitant<'a> {
    pub fn new(links: &'a dyn Links, single: bool) -> Hesitant<'a> {
        Hesitant {
            links,
            gate: Arc::default(),
            single,
            left: Arc::new(AtomicU32::new(u32::MAX)),
        }
    }

    /// Whose cable is pulled after so many transfers.
    pub fn pulled_after(links: &'a dyn Links, transfers: u32) -> Hesitant<'a> {
        Hesitant {
            left: Arc::new(AtomicU32::new(transfers)),
            ..Hesitant::new(links, false)
        }
    }

    /// Keeps the reading thread from its next transfer; when this returns it stands still.
    pub fn busy(&self) -> Busy<'_> {
        let mut state = self.gate.lock();
        state.shut = true;
        let busy = Busy(&self.gate);
        let waited = self
            .gate
            .changed
            .wait_timeout_while(state, SOON, |state| !state.waits);
        assert!(waited.expect("no panic").0.waits, "no stream is read");
        busy
    }
}

impl Drop for Busy<'_> {
    fn drop(&mut self) {
        self.0.lock().shut = false;
        self.0.changed.notify_all();
    }
}

impl Gate {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no panic")
    }

    fn pass(&self) {
        let mut state = self.lock();
        while state.shut {
            state.waits = true;
            self.changed.notify_all();
            state = self.changed.wait(state).expect("no panic");
        }
        state.waits = false;
    }
}

impl Links for Hesitant<'_> {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        self.links.open(target)
    }

    fn open_usb(&self, target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
        Ok(Arc::new(Hesitating {
            link: self.links.open_usb(target)?,
            gate: Arc::clone(&self.gate),
            single: self.single,
            left: Arc::clone(&self.left),
        }))
    }
}

struct Hesitating {
    link: Arc<dyn UsbLink>,
    gate: Arc<Gate>,
    single: bool,
    left: Arc<AtomicU32>,
}

impl Hesitating {
    /// One transfer more, where the cable is in.
    fn plugged(&self) -> Result<&dyn UsbLink, LinkError> {
        let fewer = |left: u32| left.checked_sub(1);
        let before = self
            .left
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, fewer);
        match before {
            Ok(_) => Ok(self.link.as_ref()),
            Err(_) => Err(LinkError::Gone),
        }
    }
}

type Passed = Result<Option<usize>, LinkError>;

impl UsbLink for Hesitating {
    fn interfaces(&self) -> &[UsbInterface] {
        self.link.interfaces()
    }

    fn claim(&self, interface: u8) -> Result<(), LinkError> {
        self.link.claim(interface)
    }

    fn control_in(&self, request: Request, buffer: &mut [u8], deadline: Instant) -> Passed {
        self.plugged()?.control_in(request, buffer, deadline)
    }

    fn control_out(&self, request: Request, bytes: &[u8], deadline: Instant) -> Passed {
        self.plugged()?.control_out(request, bytes, deadline)
    }

    fn read(&self, endpoint: u8, buffer: &mut [u8], deadline: Instant) -> Passed {
        self.plugged()?.read(endpoint, buffer, deadline)
    }

    fn write(&self, endpoint: u8, bytes: &[u8], deadline: Instant) -> Passed {
        self.plugged()?.write(endpoint, bytes, deadline)
    }

    fn stream(
        &self,
        endpoint: u8,
        transfers: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError> {
        let stream = match self.single {
            true => Box::new(OneByOne::new(self.link.as_ref(), endpoint, bytes)),
            false => self.link.stream(endpoint, transfers, bytes)?,
        };
        Ok(Box::new(HesitatingStream {
            stream,
            gate: &self.gate,
        }))
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), LinkError> {
        self.link.clear_halt(endpoint)
    }
}

struct HesitatingStream<'a> {
    stream: Box<dyn UsbStream + 'a>,
    gate: &'a Gate,
}

impl UsbStream for HesitatingStream<'_> {
    fn next(&mut self, deadline: Instant) -> Result<Option<&[u8]>, LinkError> {
        self.gate.pass();
        self.stream.next(deadline)
    }
}

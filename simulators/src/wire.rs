//! One event loop for every simulated device: bytes in, bytes out, plugged and unplugged, over a pseudo-terminal or TCP.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::event::{EventfdFlags, eventfd};

use crate::faults::Faults;
use crate::pty::{PtyDevice, wait};

/// Interval of lumps, that of a common USB converter's latency timer.
const LUMP: Duration = Duration::from_millis(16);

/// How long an unplugging waits for what was sent to be read.
const DRAIN: Duration = Duration::from_millis(500);

/// What a device is attached by.
#[derive(Debug)]
pub enum Wire {
    /// A pseudo-terminal.
    Pty(PtyDevice),
    /// A listening socket with at most one host.
    Tcp(TcpWire),
}

/// A listening socket with at most one host; a second one is closed at once.
#[derive(Debug)]
pub struct TcpWire {
    address: SocketAddr,
    listener: Option<TcpListener>,
    host: Option<TcpStream>,
}

impl Wire {
    /// A pseudo-terminal under this link.
    ///
    /// # Errors
    /// Those of [`PtyDevice::plug`].
    pub fn pty(link: &Path) -> io::Result<Wire> {
        PtyDevice::plug(link).map(Wire::Pty)
    }

    /// A listener at this address; port 0 takes any that is free.
    ///
    /// # Errors
    /// When it cannot listen there.
    pub fn tcp(address: SocketAddr) -> io::Result<Wire> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Wire::Tcp(TcpWire {
            address: listener.local_addr()?,
            listener: Some(listener),
            host: None,
        }))
    }

    /// Where a host finds it: the link's path, or the address.
    pub fn name(&self) -> String {
        match self {
            Wire::Pty(pty) => pty.link().display().to_string(),
            Wire::Tcp(tcp) => tcp.address.to_string(),
        }
    }

    fn is_plugged(&self) -> bool {
        match self {
            Wire::Pty(pty) => pty.is_plugged(),
            Wire::Tcp(tcp) => tcp.listener.is_some(),
        }
    }

    fn has_host(&self) -> bool {
        match self {
            Wire::Pty(pty) => pty.is_plugged(),
            Wire::Tcp(tcp) => tcp.host.is_some(),
        }
    }

    fn unplug(&mut self) {
        match self {
            Wire::Pty(pty) => {
                pty.unplug(DRAIN);
            }
            Wire::Tcp(tcp) => {
                tcp.listener = None;
                tcp.host = None;
            }
        }
    }

    fn replug(&mut self) -> io::Result<()> {
        match self {
            Wire::Pty(pty) => pty.replug(),
            Wire::Tcp(tcp) if tcp.listener.is_some() => Ok(()),
            Wire::Tcp(tcp) => {
                let listener = TcpListener::bind(tcp.address)?;
                listener.set_nonblocking(true)?;
                tcp.listener = Some(listener);
                Ok(())
            }
        }
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        match self {
            Wire::Pty(pty) => pty.fd(),
            Wire::Tcp(tcp) => match (&tcp.host, &tcp.listener) {
                (Some(host), _) => Some(host.as_fd()),
                (None, Some(listener)) => Some(listener.as_fd()),
                (None, None) => None,
            },
        }
    }

    /// What came; an end of the connection is an error.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Wire::Pty(pty) => pty.read(buffer),
            Wire::Tcp(tcp) => match &mut tcp.host {
                None => Ok(0),
                Some(host) => match host.read(buffer) {
                    Ok(0) => Err(io::ErrorKind::ConnectionReset.into()),
                    other => not_yet_is_zero(other),
                },
            },
        }
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Wire::Pty(pty) => pty.write(bytes),
            Wire::Tcp(tcp) => match &mut tcp.host {
                None => Err(io::ErrorKind::NotConnected.into()),
                Some(host) => not_yet_is_zero(host.write(bytes)),
            },
        }
    }

    /// Takes a waiting host in, or sends it away when there is one; true when a new one is in.
    fn accept(&mut self) -> bool {
        let Wire::Tcp(tcp) = self else { return false };
        let Some(listener) = &tcp.listener else {
            return false;
        };
        let mut fresh = false;
        while let Ok((stream, _)) = listener.accept() {
            if tcp.host.is_none()
                && stream.set_nonblocking(true).is_ok()
                && stream.set_nodelay(true).is_ok()
            {
                tcp.host = Some(stream);
                fresh = true;
            }
        }
        fresh
    }

    fn hang_up(&mut self) {
        if let Wire::Tcp(tcp) = self {
            tcp.host = None;
        }
    }
}

fn not_yet_is_zero(result: io::Result<usize>) -> io::Result<usize> {
    match result {
        Err(e)
            if matches!(
                e.kind(),
                io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
            ) =>
        {
            Ok(0)
        }
        other => other,
    }
}

/// Bytes on their way out, with marks where records end.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    bytes: VecDeque<u8>,
    marks: VecDeque<(u64, u32)>,
    queued: u64,
}

impl Outbox {
    pub fn len(&self) -> usize {
        self.bytes.len()
    }

    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend(bytes);
        self.queued += bytes.len() as u64;
    }

    /// The record with this number ends here.
    pub fn mark(&mut self, record: u32) {
        self.marks.push_back((self.queued, record));
    }

    fn sent(&mut self, n: usize) {
        self.bytes.drain(..n);
        let gone = self.queued - self.bytes.len() as u64;
        while self.marks.front().is_some_and(|m| m.0 <= gone) {
            self.marks.pop_front();
        }
    }

    /// Throws everything away and says which records were not sent whole.
    fn clear(&mut self) -> Vec<u32> {
        self.bytes.clear();
        self.marks.drain(..).map(|m| m.1).collect()
    }
}

/// What a device wants next.
pub(crate) enum Next {
    /// To be called when bytes come, or room, or a wake.
    Wait,
    /// To be called at this time at the latest.
    At(Instant),
    /// To be pulled out once what is queued has gone.
    Unplug,
}

/// A device behind the event loop.
pub(crate) trait Model: Send + 'static {
    /// A host is there (at a pseudo-terminal: it is plugged in).
    fn attached(&mut self, out: &mut Outbox);
    /// The host has gone, or the cable was pulled; the records did not go out.
    fn detached(&mut self, unplugged: bool, unsent: &[u32]);
    /// Bytes came.
    fn take(&mut self, bytes: &[u8], now: Instant, out: &mut Outbox);
    /// Time passed, or there is room.
    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next;
}

/// Wakes an event loop from another thread.
#[derive(Debug, Clone)]
pub(crate) struct Waker(Arc<OwnedFd>);

impl Waker {
    fn new() -> io::Result<Waker> {
        let fd = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Waker(Arc::new(fd)))
    }

    pub fn wake(&self) {
        // a full counter is awake already
        let _ = rustix::io::write(&*self.0, &1_u64.to_ne_bytes());
    }

    fn clear(&self) {
        let _ = rustix::io::read(&*self.0, &mut [0; 8]);
    }
}

/// Runs a device; dropping it ends the device and takes its port away.
#[derive(Debug)]
pub(crate) struct Runner {
    name: String,
    waker: Waker,
    requests: Arc<Requests>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Requests {
    end: AtomicBool,
    plug: Mutex<Option<bool>>,
}

impl Runner {
    /// Starts the loop; the model is made with the waker of its loop.
    pub fn start<M: Model>(
        wire: Wire,
        faults: &Faults,
        seed: u64,
        model: impl FnOnce(Waker) -> M,
    ) -> io::Result<Runner> {
        let waker = Waker::new()?;
        let requests = Arc::new(Requests::default());
        let name = wire.name();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(u64::MAX - 1);
        let mut serving = Serving {
            wire,
            model: model(waker.clone()),
            out: Outbox::default(),
            waker: waker.clone(),
            requests: requests.clone(),
            lumps: faults.lumps,
            split: faults.split,
            baud: faults.baud,
            wrong_parity: faults.wrong_parity,
            rng,
            replug_after: faults.replug,
            replug_at: None,
            next_lump: Instant::now(),
        };
        let thread = std::thread::Builder::new()
            .name(format!("simulator {name}"))
            .spawn(move || serving.run())?;
        Ok(Runner {
            name,
            waker,
            requests,
            thread: Some(thread),
        })
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// Asks for the cable to be put in or pulled out.
    pub fn plug(&self, plugged: bool) {
        *lock(&self.requests.plug) = Some(plugged);
        self.waker.wake();
    }
}

impl Drop for Runner {
    fn drop(&mut self) {
        self.requests.end.store(true, Ordering::Release);
        self.waker.wake();
        if let Some(thread) = self.thread.take() {
            // a panic of the device has already been shown by its thread
            let _ = thread.join();
        }
    }
}

/// A mutex whose holder panicked still holds valid data here: plain values, written whole.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A device without a wire, in a time of its own: bytes in, bytes out, as fast as they can be computed.
///
/// The same model as behind a [`Wire`], so that a minute of device time takes milliseconds and is the same every time.
pub struct Desk {
    model: Box<dyn Model>,
    out: Outbox,
    lumps: bool,
    began: Instant,
    now: Duration,
    pulled: bool,
}

impl std::fmt::Debug for Desk {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Desk")
            .field("now", &self.now)
            .finish_non_exhaustive()
    }
}

impl Desk {
    pub(crate) fn new<M: Model>(faults: &Faults, model: impl FnOnce(Instant) -> M) -> Desk {
        let began = Instant::now();
        let mut desk = Desk {
            model: Box::new(model(began)),
            out: Outbox::default(),
            lumps: faults.lumps,
            began,
            now: Duration::ZERO,
            pulled: false,
        };
        desk.model.attached(&mut desk.out);
        desk
    }

    /// Device time that has passed.
    pub fn now(&self) -> Duration {
        self.now
    }

    /// Whether the device had its cable pulled.
    pub fn is_unplugged(&self) -> bool {
        self.pulled
    }

    /// The host writes.
    pub fn write(&mut self, bytes: &[u8]) {
        if !self.pulled {
            self.model.take(bytes, self.began + self.now, &mut self.out);
        }
    }

    /// Lets time pass until `until`, or until something has come; what came, and `None` where nothing did.
    ///
    /// In lumps where the faults say so: what was sent arrives at the next multiple of their interval.
    pub fn read(&mut self, until: Duration) -> Option<Vec<u8>> {
        while !self.pulled {
            let next = self.model.step(self.began + self.now, &mut self.out);
            let tick = LUMP.as_nanos();
            let waits = self.lumps && !self.now.as_nanos().is_multiple_of(tick);
            if self.out.len() > 0 && !waits {
                let bytes: Vec<u8> = self.out.bytes.iter().copied().collect();
                self.out.sent(bytes.len());
                return Some(bytes);
            }
            if matches!(next, Next::Unplug) && self.out.len() == 0 {
                self.pulled = true;
                self.model.detached(true, &[]);
                break;
            }
            if self.now >= until {
                break;
            }
            let due = match next {
                Next::At(due) => due.saturating_duration_since(self.began),
                Next::Wait | Next::Unplug => until,
            };
            let mut to = due.clamp(self.now, until);
            if waits && self.out.len() > 0 {
                let lump = (self.now.as_nanos() / tick + 1) * tick;
                to = to.min(Duration::from_nanos(lump as u64)).max(self.now);
            }
            if to == self.now && due <= self.now {
                // the device has more to do at this very moment
                continue;
            }
            self.now = to;
        }
        None
    }
}

struct Serving<M> {
    wire: Wire,
    model: M,
    out: Outbox,
    waker: Waker,
    requests: Arc<Requests>,
    lumps: bool,
    split: bool,
    baud: Option<u32>,
    wrong_parity: bool,
    rng: ChaCha8Rng,
    replug_after: Option<Duration>,
    replug_at: Option<Instant>,
    next_lump: Instant,
}

impl<M: Model> Serving<M> {
    fn run(&mut self) {
        if matches!(self.wire, Wire::Pty(_)) {
            self.model.attached(&mut self.out);
        }
        while !self.requests.end.load(Ordering::Acquire) {
            self.plug_as_asked();
            let connected = self.receive() && self.send();
            if !connected && self.wire.has_host() {
                self.wire.hang_up();
                self.detach(false);
                continue;
            }
            // After the last host was seen to be gone, where it is.
            if self.wire.accept() {
                self.model.attached(&mut self.out);
            }
            let timeout = match self.model.step(Instant::now(), &mut self.out) {
                Next::Unplug if self.out.len() == 0 && self.wire.is_plugged() => {
                    self.pull_out();
                    self.replug_at = self.replug_after.map(|after| Instant::now() + after);
                    continue;
                }
                Next::At(due) => due.saturating_duration_since(Instant::now()),
                Next::Wait | Next::Unplug => Duration::from_millis(100),
            };
            self.wait(timeout);
        }
        self.detach(true);
    }

    fn wait(&mut self, timeout: Duration) {
        let now = Instant::now();
        let mut timeout = timeout.min(Duration::from_millis(100));
        let mut write = self.out.len() > 0 && self.wire.has_host();
        if self.lumps && write {
            timeout = timeout.min(self.next_lump.saturating_duration_since(now));
            write = self.next_lump <= now;
        }
        if let Some(due) = self.replug_at {
            timeout = timeout.min(due.saturating_duration_since(now));
        }
        if let Wire::Pty(pty) = &self.wire {
            pty.release_exclusive();
        }
        wait(self.wire.fd(), write, &self.waker.0, timeout);
        self.waker.clear();
    }

    fn plug_as_asked(&mut self) {
        let due = self.replug_at.is_some_and(|due| due <= Instant::now());
        let asked = lock(&self.requests.plug).take();
        if asked == Some(false) && self.wire.is_plugged() {
            self.pull_out();
        } else if (asked == Some(true) || due) && !self.wire.is_plugged() {
            self.replug_at = None;
            match self.wire.replug() {
                Ok(()) if matches!(self.wire, Wire::Pty(_)) => self.model.attached(&mut self.out),
                Ok(()) => {}
                Err(error) => {
                    tracing::warn!(device = self.wire.name(), %error, "cannot be plugged in again");
                }
            }
        }
    }

    fn pull_out(&mut self) {
        self.wire.unplug();
        self.detach(true);
    }

    fn detach(&mut self, unplugged: bool) {
        let unsent = self.out.clear();
        self.model.detached(unplugged, &unsent);
    }

    fn receive(&mut self) -> bool {
        let mut buffer = [0; 4096];
        loop {
            match self.wire.read(&mut buffer) {
                Ok(0) => return true,
                // a byte with a parity error is no byte
                Ok(_) if self.wrong_parity => {}
                Ok(n) => self.model.take(&buffer[..n], Instant::now(), &mut self.out),
                Err(_) => return false,
            }
        }
    }

    /// Whether the host's port runs at another speed than the line.
    fn garbled(&self) -> bool {
        match (&self.wire, self.baud) {
            (Wire::Pty(pty), Some(baud)) => pty.baud().is_some_and(|set| set != baud),
            _ => false,
        }
    }

    /// Sends what goes, in lumps or pieces where asked.
    fn send(&mut self) -> bool {
        if self.lumps && self.out.len() > 0 {
            let now = Instant::now();
            if now < self.next_lump {
                return true;
            }
            self.next_lump = now + LUMP;
        }
        let garbled = self.garbled();
        while self.out.len() > 0 && self.wire.has_host() {
            let (front, _) = self.out.bytes.as_slices();
            let most = if self.split {
                self.rng.random_range(1..=200)
            } else {
                front.len()
            };
            let piece = &front[..front.len().min(most)];
            let written = if self.wrong_parity {
                self.wire.write(&vec![0; piece.len()])
            } else if garbled {
                let mut rubbish = vec![0; piece.len()];
                self.rng.fill_bytes(&mut rubbish);
                self.wire.write(&rubbish)
            } else {
                self.wire.write(piece)
            };
            match written {
                Ok(0) => break,
                Ok(n) => self.out.sent(n),
                Err(_) => return false,
            }
        }
        true
    }
}

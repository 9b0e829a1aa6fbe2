//! A simulated device for a real kernel: the usbredir protocol, as QEMU's `usb-redir` device speaks it over a socket. The guest's kernel sees the
//! device behind a host controller like any other.
//!
//! Protocol: usbredir 0.7, all numbers little-endian; of its capabilities: device version, packet sizes, ids of 64 bits, bulk lengths of 32.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::Shutdown;
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::{Model, Outcome, Socket, TICK};
use crate::wire::lock;

const CAPABILITIES: u32 = 1 << 1 | 1 << 4 | 1 << 5 | 1 << 6;
/// Longest message that is taken: the largest transfer, and its head.
const MESSAGE_MAX: usize = 8 << 20;

/// Kinds of messages.
mod kind {
    pub const HELLO: u32 = 0;
    pub const CONNECT: u32 = 1;
    pub const DISCONNECT: u32 = 2;
    pub const RESET: u32 = 3;
    pub const INTERFACES: u32 = 4;
    pub const ENDPOINTS: u32 = 5;
    pub const SET_CONFIGURATION: u32 = 6;
    pub const GET_CONFIGURATION: u32 = 7;
    pub const CONFIGURATION: u32 = 8;
    pub const SET_ALTERNATE: u32 = 9;
    pub const GET_ALTERNATE: u32 = 10;
    pub const ALTERNATE: u32 = 11;
    pub const START_INTERRUPT: u32 = 15;
    pub const STOP_INTERRUPT: u32 = 16;
    pub const INTERRUPT_STATUS: u32 = 17;
    pub const CANCEL: u32 = 21;
    pub const CONTROL: u32 = 100;
    pub const BULK: u32 = 101;
    pub const INTERRUPT: u32 = 103;
}

/// What became of a transfer.
mod status {
    pub const SUCCESS: u8 = 0;
    pub const CANCELLED: u8 = 1;
    pub const STALL: u8 = 4;
    pub const BABBLE: u8 = 6;
}

/// A bulk transfer from the device that waits.
struct Waiting {
    id: u64,
    endpoint: u8,
    length: usize,
    head: [u8; 10],
}

struct State {
    waiting: VecDeque<Waiting>,
    /// Interrupt endpoints that are asked.
    polled: Vec<u8>,
    next_id: u64,
    configured: bool,
    over: bool,
}

struct Shared<M> {
    socket: Socket<M>,
    state: Mutex<State>,
    changed: Condvar,
    peer: Mutex<UnixStream>,
}

/// A device that is plugged into a virtual machine; dropping it pulls it out.
pub struct Redirected<M: Model + 'static> {
    shared: Arc<Shared<M>>,
    threads: Vec<JoinHandle<()>>,
}

impl<M: Model + 'static> Redirected<M> {
    /// Plugs the device of a socket into the virtual machine at the other end of the stream.
    ///
    /// # Errors
    /// A peer that is none, or whose capabilities are fewer.
    pub fn start(mut peer: UnixStream, socket: Socket<M>) -> io::Result<Redirected<M>> {
        let mut hello = vec![0; 64];
        hello[..16].copy_from_slice(b"acies-simulators");
        hello.extend(CAPABILITIES.to_le_bytes());
        // The first message has an id of 32 bits: capabilities are not known yet.
        let mut head = kind::HELLO.to_le_bytes().to_vec();
        head.extend((hello.len() as u32).to_le_bytes());
        head.extend([0; 4]);
        peer.write_all(&[head, hello].concat())?;
        let mut theirs = [0; 12];
        peer.read_exact(&mut theirs)?;
        let mut hello = vec![0; u32_at(&theirs, 4).min(1024) as usize];
        peer.read_exact(&mut hello)?;
        if hello.len() < 68 || u32_at(&hello, 64) & CAPABILITIES != CAPABILITIES {
            return Err(io::Error::new(
                ErrorKind::Unsupported,
                "the virtual machine's usbredir is too old",
            ));
        }
        let shared = Arc::new(Shared {
            socket,
            state: Mutex::new(State {
                waiting: VecDeque::new(),
                polled: Vec::new(),
                next_id: 0,
                configured: false,
                over: false,
            }),
            changed: Condvar::new(),
            peer: Mutex::new(peer.try_clone()?),
        });
        shared.introduce()?;
        let (takes, offers) = (Arc::clone(&shared), Arc::clone(&shared));
        let spawn = |run: Box<dyn FnOnce() + Send>| {
            std::thread::Builder::new()
                .name("usb-redir".into())
                .spawn(run)
        };
        Ok(Redirected {
            threads: vec![
                spawn(Box::new(move || {
                    let _ = takes.take(peer);
                    takes.end();
                }))?,
                spawn(Box::new(move || offers.tick()))?,
            ],
            shared,
        })
    }

    /// Offers what waits to the device at once; otherwise that happens every millisecond.
    pub fn offer(&self) {
        // A peer that is gone takes nothing, and the thread that reads from it ends.
        let _ = self.shared.offer();
    }

    /// Waits until the guest's kernel has set the device up; false when `patience` is over before.
    pub fn wait_until_configured(&self, patience: Duration) -> bool {
        let until = Instant::now() + patience;
        let mut state = self.shared.lock();
        while !state.configured && Instant::now() < until {
            let left = until.saturating_duration_since(Instant::now());
            let waited = self.shared.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(|e| e.into_inner()).0;
        }
        state.configured
    }
}

impl<M: Model + 'static> Drop for Redirected<M> {
    fn drop(&mut self) {
        let _ = self.shared.send(kind::DISCONNECT, 0, &[]);
        let _ = lock(&self.shared.peer).shutdown(Shutdown::Both);
        self.shared.end();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    let four = bytes.get(at..at + 4).and_then(|b| b.try_into().ok());
    four.map_or(0, u32::from_le_bytes)
}

/// Place of an endpoint in the lists of 32.
fn place(endpoint: u8) -> usize {
    usize::from((endpoint & 0x80) >> 3 | endpoint & 15)
}

impl<M: Model + 'static> Shared<M> {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn end(&self) {
        self.lock().over = true;
        self.changed.notify_all();
    }

    fn send(&self, kind: u32, id: u64, parts: &[&[u8]]) -> io::Result<()> {
        let length: usize = parts.iter().map(|part| part.len()).sum();
        let mut bytes = kind.to_le_bytes().to_vec();
        bytes.extend((length as u32).to_le_bytes());
        bytes.extend(id.to_le_bytes());
        parts.iter().for_each(|part| bytes.extend_from_slice(part));
        lock(&self.peer).write_all(&bytes)
    }

    /// Endpoints, interfaces, and the device itself.
    fn introduce(&self) -> io::Result<()> {
        let (device, configuration) = {
            let plugged = self.socket.lock();
            (
                plugged.model.device_descriptor(),
                plugged.model.configuration_descriptor(),
            )
        };
        let (mut kinds, mut intervals, mut sizes) = ([255; 32], [0; 32], [0_u16; 32]);
        for control in [0, 16] {
            kinds[control] = 0;
            sizes[control] = if device[7] == 9 {
                512
            } else {
                device[7].into()
            };
        }
        let mut interfaces: [Vec<u8>; 4] = Default::default();
        let mut rest = &configuration[..];
        while let [length, of, ..] = *rest {
            match of {
                4 => {
                    for (list, at) in interfaces.iter_mut().zip([2, 5, 6, 7]) {
                        list.push(rest[at]);
                    }
                }
                5 => {
                    let at = place(rest[2]);
                    kinds[at] = rest[3] & 3;
                    intervals[at] = rest[6];
                    sizes[at] = u16::from_le_bytes([rest[4], rest[5]]);
                }
                _ => {}
            }
            rest = &rest[usize::from(length.max(2)).min(rest.len())..];
        }
        let sizes: Vec<u8> = sizes.iter().flat_map(|size| size.to_le_bytes()).collect();
        self.send(kind::ENDPOINTS, 0, &[&kinds, &intervals, &[0; 32], &sizes])?;
        let count = (interfaces[0].len() as u32).to_le_bytes();
        let lists = interfaces.map(|mut list| {
            list.resize(32, 0);
            list
        });
        self.send(
            kind::INTERFACES,
            0,
            &[&count, &lists[0], &lists[1], &lists[2], &lists[3]],
        )?;
        // Speed: 3 is super, 2 high.
        let speed = if device[3] >= 3 { 3 } else { 2 };
        let class = [speed, device[4], device[5], device[6]];
        self.send(kind::CONNECT, 0, &[&class, &device[8..14]])
    }

    /// Takes messages until the peer closes.
    fn take(&self, mut peer: UnixStream) -> io::Result<()> {
        loop {
            let mut head = [0; 16];
            peer.read_exact(&mut head)?;
            let (kind, length) = (u32_at(&head, 0), u32_at(&head, 4) as usize);
            let id = u64::from(u32_at(&head, 8)) | u64::from(u32_at(&head, 12)) << 32;
            if length > MESSAGE_MAX {
                return Err(ErrorKind::InvalidData.into());
            }
            let mut body = vec![0; length];
            peer.read_exact(&mut body)?;
            self.message(kind, id, &body)?;
        }
    }

    fn message(&self, kind: u32, id: u64, body: &[u8]) -> io::Result<()> {
        let at = |place: usize| body.get(place).copied().unwrap_or(0);
        match kind {
            kind::RESET => {
                let mut state = self.lock();
                state.waiting.clear();
                state.polled.clear();
            }
            kind::SET_CONFIGURATION => {
                self.send(kind::CONFIGURATION, id, &[&[status::SUCCESS, at(0)]])?;
                self.lock().configured = true;
                self.changed.notify_all();
            }
            kind::GET_CONFIGURATION => {
                self.send(kind::CONFIGURATION, id, &[&[status::SUCCESS, 1]])?;
            }
            kind::SET_ALTERNATE => {
                self.send(kind::ALTERNATE, id, &[&[status::SUCCESS, at(0), at(1)]])?;
            }
            kind::GET_ALTERNATE => {
                self.send(kind::ALTERNATE, id, &[&[status::SUCCESS, at(0), 0]])?;
            }
            kind::START_INTERRUPT => {
                self.lock().polled.push(at(0));
                self.send(kind::INTERRUPT_STATUS, id, &[&[status::SUCCESS, at(0)]])?;
            }
            kind::STOP_INTERRUPT => {
                self.lock().polled.retain(|endpoint| *endpoint != at(0));
                self.send(kind::INTERRUPT_STATUS, id, &[&[status::SUCCESS, at(0)]])?;
            }
            kind::CANCEL => {
                let mut state = self.lock();
                let place = state.waiting.iter().position(|one| one.id == id);
                if let Some(one) = place.and_then(|place| state.waiting.remove(place)) {
                    self.finish(one, status::CANCELLED, &[])?;
                }
            }
            kind::CONTROL if body.len() >= 10 => self.control(id, body)?,
            kind::BULK if body.len() >= 10 => self.bulk(id, body)?,
            _ => {}
        }
        self.offer()
    }

    fn control(&self, id: u64, body: &[u8]) -> io::Result<()> {
        let setup = [
            body[2], body[1], body[4], body[5], body[6], body[7], body[8], body[9],
        ];
        let outcome = match (setup[0], setup[1]) {
            // CLEAR_FEATURE of an endpoint: its halt.
            (0x02, 1) => {
                self.socket.clear_halt(setup[4]);
                Outcome::Accepted(0)
            }
            // GET_STATUS.
            (0x80..=0x82, 0) => Outcome::Data(vec![0, 0]),
            _ => self.socket.lock().control(setup, &body[10..]),
        };
        self.socket.wake();
        let (status, data) = match outcome {
            Outcome::Data(data) => (status::SUCCESS, data),
            Outcome::Accepted(_) => (status::SUCCESS, Vec::new()),
            Outcome::Stall | Outcome::Nak => (status::STALL, Vec::new()),
        };
        let passed = match setup[0] & 0x80 {
            0 if status == status::SUCCESS => body.len() - 10,
            _ => data.len(),
        };
        let mut head = body[..10].to_vec();
        head[3] = status;
        head[8..10].copy_from_slice(&(passed as u16).to_le_bytes());
        self.send(kind::CONTROL, id, &[&head, &data])
    }

    fn bulk(&self, id: u64, body: &[u8]) -> io::Result<()> {
        let (head, data) = body.split_at(10);
        let one = Waiting {
            id,
            endpoint: head[0],
            length: usize::from(u16::from_le_bytes([head[2], head[3]]))
                | usize::from(u16::from_le_bytes([head[8], head[9]])) << 16,
            head: head.try_into().unwrap_or_default(),
        };
        if one.endpoint & 0x80 != 0 {
            self.lock().waiting.push_back(one);
            return Ok(());
        }
        let outcome = self.socket.lock().output(one.endpoint, data);
        self.socket.wake();
        match outcome {
            Outcome::Stall => self.finish(one, status::STALL, &[]),
            _ => self.finish(one, status::SUCCESS, &[]),
        }
    }

    /// Answers a bulk transfer.
    fn finish(&self, one: Waiting, status: u8, data: &[u8]) -> io::Result<()> {
        let output = one.endpoint & 0x80 == 0 && status == status::SUCCESS;
        let n = if output { one.length } else { data.len() };
        let mut head = one.head;
        head[1] = status;
        head[2..4].copy_from_slice(&(n as u16).to_le_bytes());
        head[8..10].copy_from_slice(&((n >> 16) as u16).to_le_bytes());
        self.send(kind::BULK, one.id, &[&head, data])
    }

    /// Offers what waits to the device, the first of each endpoint first.
    fn offer(&self) -> io::Result<()> {
        let mut state = self.lock();
        if !self.socket.present() {
            return Ok(());
        }
        let mut blocked = Vec::new();
        let mut at = 0;
        while at < state.waiting.len() {
            let (endpoint, length) = (state.waiting[at].endpoint, state.waiting[at].length);
            let outcome = match blocked.contains(&endpoint) {
                true => Outcome::Nak,
                false => self.socket.lock().input(endpoint, length),
            };
            if outcome == Outcome::Nak {
                blocked.push(endpoint);
                at += 1;
                continue;
            }
            let Some(one) = state.waiting.remove(at) else {
                break;
            };
            match outcome {
                Outcome::Data(data) if data.len() > length => {
                    self.finish(one, status::BABBLE, &data[..length])?;
                }
                Outcome::Data(data) => self.finish(one, status::SUCCESS, &data)?,
                _ => {
                    self.finish(one, status::STALL, &[])?;
                    blocked.push(endpoint);
                }
            }
        }
        for endpoint in state.polled.clone() {
            loop {
                let outcome = self.socket.lock().input(endpoint, 64);
                match outcome {
                    Outcome::Data(data) => {
                        let [low, high] = (data.len() as u16).to_le_bytes();
                        let head = [endpoint, status::SUCCESS, low, high];
                        self.send(kind::INTERRUPT, state.next_id, &[&head, &data])?;
                        state.next_id += 1;
                    }
                    Outcome::Stall => {
                        state.polled.retain(|polled| *polled != endpoint);
                        self.send(kind::INTERRUPT_STATUS, 0, &[&[status::STALL, endpoint]])?;
                        break;
                    }
                    Outcome::Accepted(_) | Outcome::Nak => break,
                }
            }
        }
        Ok(())
    }

    fn tick(&self) {
        let mut state = self.lock();
        while !state.over {
            drop(state);
            if self.offer().is_err() {
                return;
            }
            let waited = self.changed.wait_timeout(self.lock(), TICK);
            state = waited.unwrap_or_else(|e| e.into_inner()).0;
        }
    }
}

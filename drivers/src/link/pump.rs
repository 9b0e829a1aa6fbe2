//! A thread that always reads, so that a stream is not lost while the caller is busy.
//!
//! A serial port holds a few kilobytes, which is some tens of milliseconds of a fast sensor. What was read waits here, bounded by
//! [`QUEUE_BYTES`]; when that is full the thread stops reading, the line loses, and the sensor's counter shows it.
//!
//! Sensors without a keep-alive would leave their laser on for a caller that hangs. A run is therefore begun with the bytes
//! that end it: when nobody has asked for values for [`PATIENCE`], the thread sends them by itself.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::{Link, Links, Target};
use crate::error::{DeviceError, LinkError};

/// How long the caller may stay away from a run, as for every streaming driver here.
const PATIENCE: Duration = Duration::from_secs(10);

/// Most bytes that wait: three minutes of a full line at 921600 Bd.
const QUEUE_BYTES: usize = 16 << 20;

/// Longest wait in one read, so that the end of the thread is seen.
const SLICE: Duration = Duration::from_millis(50);

/// Longest time that writing a command may take.
const WRITE: Duration = Duration::from_secs(1);

/// Bytes, and when the last of them came.
pub(crate) type Chunk = (Instant, Vec<u8>);

/// An open link that is read by a thread of its own.
pub(crate) struct Pump {
    port: String,
    link: Arc<dyn Link>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    inbox: Mutex<Inbox>,
    arrived: Condvar,
    taken: Condvar,
}

struct Inbox {
    chunks: VecDeque<Chunk>,
    bytes: usize,
    heard_bytes: u64,
    /// Why nothing more will come; asked again, the link is simply gone.
    over: Option<Option<LinkError>>,
    waiting: bool,
    asked: Instant,
    farewell: Option<Vec<u8>>,
    left_alone: bool,
    quit: bool,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Pump {
    /// Opens the link and begins to read.
    pub fn open(links: &dyn Links, target: &Target) -> Result<Pump, DeviceError> {
        let port = target.to_string();
        let failed = |source| DeviceError::Link {
            port: port.clone(),
            source,
        };
        let link = links.open(target).map_err(failed)?;
        let shared = Arc::new(Shared {
            inbox: Mutex::new(Inbox {
                chunks: VecDeque::new(),
                bytes: 0,
                heard_bytes: 0,
                over: None,
                waiting: false,
                asked: Instant::now(),
                farewell: None,
                left_alone: false,
                quit: false,
            }),
            arrived: Condvar::new(),
            taken: Condvar::new(),
        });
        let (reads, tells) = (Arc::clone(&link), Arc::clone(&shared));
        let thread = std::thread::Builder::new()
            .name(format!("reads {port}"))
            .spawn(move || run(&reads, &tells))
            .map_err(|source| {
                failed(LinkError::Io {
                    action: "starting its thread",
                    source,
                })
            })?;
        Ok(Pump {
            port,
            link,
            shared,
            thread: Some(thread),
        })
    }

    /// Where the link leads, for errors.
    pub fn port(&self) -> &str {
        &self.port
    }

    /// Bytes that came since the link was opened.
    pub fn heard_bytes(&self) -> u64 {
        self.shared.lock().heard_bytes
    }

    /// Writes all of `bytes`.
    pub fn write(&self, bytes: &[u8]) -> Result<(), DeviceError> {
        self.link
            .write(bytes, Instant::now() + WRITE)
            .map_err(|source| DeviceError::Link {
                port: self.port.clone(),
                source,
            })
    }

    /// The oldest bytes that were not taken, waiting for them until `deadline`; `None` when it passed.
    pub fn read(&self, deadline: Instant) -> Result<Option<Chunk>, DeviceError> {
        let mut inbox = self.shared.lock();
        inbox.waiting = true;
        let answer = loop {
            if let Some(chunk) = inbox.chunks.pop_front() {
                inbox.bytes -= chunk.1.len();
                break Ok(Some(chunk));
            }
            if let Some(over) = &mut inbox.over {
                break Err(DeviceError::Link {
                    port: self.port.clone(),
                    source: over.take().unwrap_or(LinkError::Gone),
                });
            }
            if inbox.left_alone {
                break Err(DeviceError::Ended {
                    port: self.port.clone(),
                    reason: "nobody asked for its values for 10 s, so this program stopped it",
                    remedy: "start again",
                });
            }
            let left = super::left(deadline);
            if left.is_zero() {
                break Ok(None);
            }
            let waited = self.shared.arrived.wait_timeout(inbox, left);
            inbox = waited.unwrap_or_else(PoisonError::into_inner).0;
        };
        inbox.waiting = false;
        inbox.asked = Instant::now();
        self.shared.taken.notify_all();
        answer
    }

    /// A run begins, and these bytes end it; or it is over.
    pub fn guard(&self, farewell: Option<Vec<u8>>) {
        let mut inbox = self.shared.lock();
        inbox.farewell = farewell;
        inbox.left_alone = false;
        inbox.asked = Instant::now();
    }
}

impl Drop for Pump {
    fn drop(&mut self) {
        self.shared.lock().quit = true;
        self.shared.taken.notify_all();
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has said so already.
            let _ = thread.join();
        }
    }
}

fn run(link: &Arc<dyn Link>, shared: &Shared) {
    let mut buffer = vec![0; 64 << 10];
    loop {
        let inbox = shared.lock();
        if inbox.quit || inbox.over.is_some() {
            return;
        }
        if inbox.bytes > QUEUE_BYTES {
            // Someone takes bytes, or the thread is to end.
            drop(shared.taken.wait_timeout(inbox, SLICE));
        } else {
            drop(inbox);
            let read = link.read(&mut buffer, Instant::now() + SLICE);
            let came = link.received();
            let mut inbox = shared.lock();
            match read {
                Ok(0) => {}
                Ok(n) => {
                    inbox.bytes += n;
                    inbox.heard_bytes += n as u64;
                    inbox.chunks.push_back((came, buffer[..n].to_vec()));
                    shared.arrived.notify_all();
                }
                Err(error) => {
                    inbox.over = Some(Some(error));
                    shared.arrived.notify_all();
                }
            }
        }
        let farewell = {
            let mut inbox = shared.lock();
            let alone = !inbox.waiting && inbox.asked.elapsed() > PATIENCE;
            let farewell = inbox.farewell.take_if(|_| alone);
            inbox.left_alone |= farewell.is_some();
            farewell
        };
        if let Some(bytes) = farewell {
            tracing::warn!("nobody takes values: the run is stopped");
            if let Err(error) = link.write(&bytes, Instant::now() + WRITE) {
                shared.lock().over = Some(Some(error));
                shared.arrived.notify_all();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Remembers what is written; zeros come without end.
    #[derive(Default)]
    struct Zeros(Mutex<Vec<u8>>);

    impl Link for Zeros {
        fn read(&self, buffer: &mut [u8], _: Instant) -> Result<usize, LinkError> {
            Ok(buffer.len())
        }

        fn write(&self, bytes: &[u8], _: Instant) -> Result<(), LinkError> {
            self.0
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .extend(bytes);
            Ok(())
        }
    }

    struct To(Arc<Zeros>);

    impl Links for To {
        fn open(&self, _: &Target) -> Result<Arc<dyn Link>, LinkError> {
            Ok(Arc::clone(&self.0) as _)
        }
    }

    #[test]
    fn the_queue_is_bounded_and_a_run_left_alone_is_stopped() {
        let zeros = Arc::new(Zeros::default());
        let target = Target::Tcp {
            address: "nowhere:1".into(),
        };
        let pump = Pump::open(&To(Arc::clone(&zeros)), &target).expect("a link");
        pump.guard(Some(b"stop".to_vec()));
        {
            let mut inbox = pump.shared.lock();
            let long_ago = Instant::now().checked_sub(PATIENCE + SLICE);
            inbox.asked = long_ago.expect("a clock that began before");
        }
        let deadline = Instant::now() + Duration::from_secs(20);
        loop {
            let inbox = pump.shared.lock();
            if inbox.left_alone && inbox.bytes > QUEUE_BYTES {
                break;
            }
            assert!(Instant::now() < deadline, "neither full nor stopped");
            drop(pump.shared.arrived.wait_timeout(inbox, SLICE));
        }
        while !zeros.0.lock().expect("no panic").ends_with(b"stop") {
            assert!(Instant::now() < deadline, "not written");
            std::thread::yield_now();
        }
        assert!(pump.shared.lock().bytes <= QUEUE_BYTES + (64 << 10));
        loop {
            match pump.read(deadline) {
                Ok(_) => assert!(Instant::now() < deadline),
                Err(error) => {
                    assert!(error.to_string().contains("nobody asked"), "{error}");
                    break;
                }
            }
            // The zeros never end: what waits is taken away at once.
            let mut inbox = pump.shared.lock();
            inbox.bytes = QUEUE_BYTES + 1;
            inbox.chunks.clear();
        }
    }
}

//! The threads of one open sensor: one takes profiles from the data channel, one health and keeps the control channel alive.
//!
//! The queue is bounded by [`QUEUE_BYTES`]. When it is full the thread stops reading; the sensor then drops whole frames, and the gap in
//! the frame index is counted.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::message::{self, Content, Decoder, Stamp};
use crate::capture::Profile;
use crate::device::Losses;
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::Link;

/// Most bytes of profiles that wait for the caller: 3 s of 1,280 points at 1 kHz.
const QUEUE_BYTES: usize = 64 << 20;
/// Longest wait in one read.
pub(super) const SLICE: Duration = Duration::from_millis(50);
/// Read at once.
const CHUNK: usize = 256 << 10;
/// Most bytes of captures in one group, whatever the sensor says: more is no frame of a profile sensor.
const GROUP_BYTES: usize = 64 << 20;

/// What profiles are read with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reading {
    /// Camera or sensor whose profiles are taken.
    pub source: u8,
    /// Index of a run's first frame, where it is known.
    pub first_frame: Option<u64>,
    /// z is turned over.
    pub flip_z: bool,
    /// Health indicator that counts dropped triggers.
    pub drops_indicator: u32,
}

/// Why nothing more will come.
#[derive(Debug)]
pub(super) enum Over {
    Link(Option<LinkError>),
    Decode(DecodeError),
    Clock,
    Error(Option<DeviceError>),
}

impl Over {
    pub fn error(&mut self, port: &str) -> DeviceError {
        let port = port.to_owned();
        match self {
            Over::Link(source) => DeviceError::Link {
                port,
                source: source.take().unwrap_or(LinkError::Gone),
            },
            Over::Decode(source) => DeviceError::Decode {
                port,
                source: source.clone(),
            },
            Over::Clock => DeviceError::Ended {
                port,
                reason: "its clock went back: it started anew",
                remedy: "check its supply, then reopen it",
            },
            Over::Error(error) => error.take().unwrap_or(DeviceError::Link {
                port,
                source: LinkError::Gone,
            }),
        }
    }
}

/// A profile that lacks its stamp.
struct Half {
    x_mm: Vec<f64>,
    z_mm: Vec<f64>,
    intensity: Vec<u16>,
}

/// What came of a frame before its last message.
#[derive(Default)]
struct Group {
    stamps: Vec<Stamp>,
    halves: Vec<Half>,
    intensities: Vec<Vec<u16>>,
    bytes: usize,
    /// A message of it could not be read.
    damaged: bool,
}

/// What came from the sensor and was not taken yet.
pub(super) struct Inbox {
    pub profiles: VecDeque<Profile>,
    queued_bytes: usize,
    pub losses: Losses,
    pub running: bool,
    /// Index of the frame that comes next where nothing is lost, and of the run's first.
    expected: Option<u64>,
    base: u64,
    last_time_us: Option<u64>,
    /// Dropped triggers by the sensor's count: last value, and that at the start of the run.
    pub drops: Option<i64>,
    pub drops_at_start: Option<i64>,
    pub heard: Instant,
    pub over: Option<Over>,
    pub stopping: bool,
    pub quit: bool,
}

/// What threads and caller share.
pub(super) struct Shared {
    inbox: Mutex<Inbox>,
    pub arrived: Condvar,
    pub taken: Condvar,
}

impl Shared {
    pub fn new() -> Shared {
        Shared {
            inbox: Mutex::new(Inbox {
                profiles: VecDeque::new(),
                queued_bytes: 0,
                losses: Losses::default(),
                running: false,
                expected: None,
                base: 0,
                last_time_us: None,
                drops: None,
                drops_at_start: None,
                heard: Instant::now(),
                over: None,
                stopping: false,
                quit: false,
            }),
            arrived: Condvar::new(),
            taken: Condvar::new(),
        }
    }

    pub fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn wait<'a>(
        &self,
        inbox: MutexGuard<'a, Inbox>,
        deadline: Instant,
    ) -> MutexGuard<'a, Inbox> {
        let wait = deadline.saturating_duration_since(Instant::now());
        let waited = self.arrived.wait_timeout(inbox, wait);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Notes why it is over, where nothing was noted before.
    pub fn end(&self, over: Over) {
        self.lock().over.get_or_insert(over);
        self.arrived.notify_all();
        self.taken.notify_all();
    }
}

impl Inbox {
    /// Makes ready for a new run.
    pub fn begin(&mut self, reading: &Reading) {
        self.profiles.clear();
        self.queued_bytes = 0;
        self.losses = Losses::default();
        self.expected = reading.first_frame;
        self.base = reading.first_frame.unwrap_or(0);
        self.last_time_us = None;
        self.drops_at_start = self.drops;
        self.stopping = false;
        self.running = true;
    }

    pub fn pop(&mut self) -> Option<Profile> {
        let profile = self.profiles.pop_front()?;
        self.queued_bytes -= size(&profile);
        Some(profile)
    }

    fn full(&self) -> bool {
        let limit = if self.stopping { 4 } else { 1 } * QUEUE_BYTES;
        self.queued_bytes > limit
    }

    fn accept(&mut self, half: Half, stamp: &Stamp, host_time: Instant) {
        if !self.running {
            return;
        }
        let expected = match self.expected {
            Some(expected) => expected,
            None => {
                self.base = stamp.frame_index;
                stamp.frame_index
            }
        };
        if stamp.frame_index < expected {
            // It came before: a frame index never goes back within a run.
            self.losses.rejected += 1;
            return;
        }
        if self
            .last_time_us
            .is_some_and(|last| stamp.timestamp_us < last)
        {
            self.over.get_or_insert(Over::Clock);
            return;
        }
        self.last_time_us = Some(stamp.timestamp_us);
        self.losses.lost_on_link += stamp.frame_index - expected;
        self.expected = Some(stamp.frame_index.saturating_add(1));
        self.losses.received += 1;
        let profile = Profile {
            sequence: stamp.frame_index.wrapping_sub(self.base) as u32,
            boot: 0,
            device_time_ns: stamp.timestamp_us.saturating_mul(1000),
            encoder: Some(stamp.encoder),
            host_time,
            dropped: self.losses.dropped_by_device.min(u32::MAX.into()) as u32,
            saturated: false,
            x_mm: half.x_mm,
            z_mm: half.z_mm,
            intensity: half.intensity,
        };
        self.queued_bytes += size(&profile);
        self.profiles.push_back(profile);
    }

    fn note_drops(&mut self, value: i64) {
        // A count that went down was reset by the sensor at the start of the run.
        if self.drops_at_start.is_none_or(|start| value < start) {
            self.drops_at_start = Some(match self.drops_at_start {
                None => value,
                Some(_) => 0,
            });
        }
        self.drops = Some(value);
        if self.running {
            let since = value - self.drops_at_start.unwrap_or(value);
            self.losses.dropped_by_device = since.max(0) as u64;
        }
    }
}

fn size(profile: &Profile) -> usize {
    let numbers = profile.x_mm.len() + profile.z_mm.len();
    size_of::<Profile>() + 8 * numbers + 2 * profile.intensity.len()
}

impl Group {
    /// Takes one message; true where it ends the frame.
    fn take(&mut self, bytes: &[u8], reading: &Reading) -> bool {
        let message = match message::message(bytes) {
            Ok(message) => message,
            Err(error) => {
                tracing::debug!(%error, "rejected a message");
                self.damaged = true;
                return message::is_last(bytes);
            }
        };
        match message.content {
            Content::Stamps(stamps) => self.stamps.extend(stamps.iter()),
            Content::Profiles(profiles) if profiles.source == reading.source => {
                for index in 0..profiles.count {
                    let (x_mm, mut z_mm) = profiles.points_mm(index);
                    if reading.flip_z {
                        z_mm.iter_mut().for_each(|z| *z = -*z);
                    }
                    self.bytes += 16 * x_mm.len();
                    self.halves.push(Half {
                        x_mm,
                        z_mm,
                        intensity: Vec::new(),
                    });
                }
            }
            Content::Intensities(rows) if rows.source == reading.source => {
                for index in 0..rows.count {
                    let row = rows.row(index).iter().map(|&b| u16::from(b)).collect();
                    self.bytes += 2 * rows.width;
                    self.intensities.push(row);
                }
            }
            _ => {}
        }
        self.bytes += bytes.len() / 64;
        message.last
    }

    /// Joins profiles, stamps and intensities of the frame; what does not fit together is rejected.
    fn close(&mut self, inbox: &mut Inbox, host_time: Instant) {
        let group = std::mem::take(self);
        if group.damaged || group.stamps.len() != group.halves.len() {
            // Frames of other messages alone have a stamp and nothing that we take.
            let lost = group.damaged || !group.halves.is_empty();
            inbox.losses.rejected += u64::from(lost && inbox.running);
            return;
        }
        let mut intensities = group.intensities.into_iter();
        for (mut half, stamp) in group.halves.into_iter().zip(&group.stamps) {
            half.intensity = intensities
                .next()
                .filter(|row| row.len() == half.x_mm.len())
                .unwrap_or_default();
            inbox.accept(half, stamp, host_time);
        }
    }
}

/// Runs the thread of the data channel until the caller wants it to end or nothing more will come.
pub(super) fn take_data(link: &Arc<dyn Link>, shared: &Shared, reading: &Reading) {
    let mut decoder = Decoder::default();
    let mut group = Group::default();
    let mut ready: Vec<Group> = Vec::new();
    let mut chunk = vec![0; CHUNK];
    loop {
        let inbox = shared.lock();
        if inbox.quit || inbox.over.is_some() {
            return;
        }
        if inbox.full() {
            drop(shared.taken.wait_timeout(inbox, SLICE));
            continue;
        }
        drop(inbox);
        let n = match link.read(&mut chunk, Instant::now() + SLICE) {
            Ok(0) => continue,
            Ok(n) => n,
            Err(error) => return shared.end(Over::Link(Some(error))),
        };
        let (now, came) = (Instant::now(), link.received());
        // Points are computed without the lock, so that the caller may take others meanwhile.
        let taken = decoder.take(&chunk[..n], |bytes| {
            if group.take(bytes, reading) {
                ready.push(std::mem::take(&mut group));
            }
        });
        let mut inbox = shared.lock();
        inbox.heard = now;
        for mut group in ready.drain(..) {
            group.close(&mut inbox, came);
        }
        let overgrown = group.bytes > GROUP_BYTES;
        drop(inbox);
        shared.arrived.notify_all();
        if let Err(error) = taken {
            return shared.end(Over::Decode(error));
        }
        if overgrown {
            return shared.end(Over::Decode(DecodeError::TooLong {
                claimed: group.bytes as u64,
                limit: GROUP_BYTES,
            }));
        }
    }
}

/// Takes what the health channel has: dropped triggers.
pub(super) fn take_health(
    bytes: &[u8],
    decoder: &mut Decoder,
    shared: &Shared,
    reading: &Reading,
) -> Result<(), DecodeError> {
    decoder.take(bytes, |bytes| {
        let Ok(message) = message::message(bytes) else {
            return;
        };
        if let Content::Health(rows) = message.content {
            let drops = message::indicators(rows)
                .filter(|indicator| indicator.id == reading.drops_indicator)
                .map(|indicator| indicator.value)
                .reduce(i64::saturating_add);
            if let Some(value) = drops {
                shared.lock().note_drops(value);
                shared.arrived.notify_all();
            }
        }
    })
}

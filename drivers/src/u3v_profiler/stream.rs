//! The thread that takes blocks from the stream endpoint, and what it shares with the caller.
//!
//! The queue is bounded by [`QUEUE_BYTES`]; when it is full the thread stops reading, the device drops blocks, and the gap of their numbers is counted.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::block::{self, Geometry, Leader, Order, PAYLOAD_MAX, Pixel, Trailer};
use super::genicam::Register;
use crate::capture::Profile;
use crate::device::Losses;
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::usb::UsbLink;

/// Most bytes of profiles that wait for the caller.
const QUEUE_BYTES: usize = 64 << 20;
/// Bytes of all transfers in flight: half of what Linux lets wait.
const IN_FLIGHT_BYTES: usize = 8 << 20;
/// Most transfers in flight.
const IN_FLIGHT_MAX: usize = 32;
/// Longest wait in one read.
const SLICE: Duration = Duration::from_millis(100);
/// Stalls without a block between them after which the stream is given up.
const STALLS_MAX: u32 = 8;
/// Data discarded, data overrun: the device says that it could not keep up.
const DISCARDED: [u16; 2] = [0xA100, 0xA101];

/// What blocks are read with.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Reading {
    pub endpoint: u8,
    pub geometry: Geometry,
    pub order: Order,
    pub encoder: Option<Register>,
    pub time: Option<Register>,
    /// Encoder counts from line to line of a block.
    pub encoder_step: Option<i64>,
    /// Number of a run's first block, where it is known.
    pub first_block: Option<u64>,
    /// Largest leader, trailer and transfer of a payload, bytes.
    pub leader_max: usize,
    pub trailer_max: usize,
    pub transfer: usize,
}

/// Why nothing more will come.
#[derive(Debug)]
pub(super) enum Over {
    Link(Option<LinkError>),
    Decode(DecodeError),
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
        }
    }
}

/// What came from the device and was not taken yet.
pub(super) struct Inbox {
    pub profiles: VecDeque<Profile>,
    queued_bytes: usize,
    pub losses: Losses,
    pub running: bool,
    pub stopping: bool,
    expected: Option<u64>,
    base: u64,
    pub heard: Instant,
    pub over: Option<Over>,
    pub quit: bool,
}

/// What thread and caller share.
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
                stopping: false,
                expected: None,
                base: 0,
                heard: Instant::now(),
                over: None,
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
}

impl Inbox {
    pub fn begin(&mut self, first_block: Option<u64>) {
        self.profiles.clear();
        self.queued_bytes = 0;
        self.losses = Losses::default();
        self.expected = first_block;
        self.base = first_block.unwrap_or(0);
        self.stopping = false;
        self.running = true;
        self.heard = Instant::now();
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

    /// Moves on to behind block `id`: those before it that did not come are lost. False for one that came before.
    fn reach(&mut self, id: u64) -> bool {
        let expected = *self.expected.get_or_insert_with(|| {
            self.base = id;
            id
        });
        if id < expected {
            self.losses.rejected += 1;
            return false;
        }
        self.losses.lost_on_link += id - expected;
        self.expected = Some(id.saturating_add(1));
        true
    }

    /// A block of which the device or the link lost something.
    fn spoilt(&mut self, id: u64, by_device: bool) {
        if !self.running || !self.reach(id) {
            return;
        }
        self.losses.rejected += 1;
        match by_device {
            true => self.losses.dropped_by_device += 1,
            false => self.losses.lost_on_link += 1,
        }
    }

    fn accept(&mut self, id: u64, profiles: Vec<Profile>) {
        if !self.running || !self.reach(id) {
            return;
        }
        let lines = profiles.len() as u64;
        for (line, mut profile) in profiles.into_iter().enumerate() {
            let block = id.wrapping_sub(self.base);
            profile.sequence = block.wrapping_mul(lines).wrapping_add(line as u64) as u32;
            profile.dropped = self.losses.dropped_by_device.min(u32::MAX.into()) as u32;
            self.losses.received += 1;
            self.queued_bytes += size(&profile);
            self.profiles.push_back(profile);
        }
    }
}

fn size(profile: &Profile) -> usize {
    size_of::<Profile>() + 8 * (profile.x_mm.len() + profile.z_mm.len())
}

/// The profiles of a whole block.
///
/// # Errors
/// A payload that is not what leader and trailer say.
pub(super) fn profiles(
    leader: &Leader,
    trailer: &Trailer,
    payload: &[u8],
    reading: &Reading,
    wraps: &mut Wraps,
    host_time: Instant,
) -> Result<Vec<Profile>, DecodeError> {
    let valid = usize::try_from(trailer.valid_payload).unwrap_or(usize::MAX);
    let payload = payload.get(..valid).ok_or(DecodeError::TooShort {
        message: "payload",
        found: payload.len(),
        needed: valid,
    })?;
    let pixel = block::pixel(leader.pixel_format)?;
    let chunks = match leader.has_chunks {
        true => block::chunks(payload, reading.order)?,
        false => Vec::new(),
    };
    let image = match chunks.last() {
        Some(first) => first.data,
        None => payload,
    };
    let value = |register: Option<Register>| {
        let register = register?;
        let chunk = chunks
            .iter()
            .find(|chunk| Some(chunk.id) == register.chunk)?;
        let from = usize::try_from(register.address).ok()?;
        let bytes = chunk.data.get(from..from.checked_add(register.length)?)?;
        Some(register.integer(bytes))
    };
    let encoder = value(reading.encoder).map(|counts| match reading.encoder {
        Some(register) => wraps.whole(counts, register.width()),
        None => counts,
    });
    let time = value(reading.time).map_or(leader.timestamp_ns, |time| time as u64);
    let height = trailer.height.unwrap_or(leader.height).min(leader.height);
    let lines = block::lines(image, leader, height, pixel)?;
    Ok(lines
        .enumerate()
        .map(|(index, line)| {
            let (x_mm, z_mm) = block::points_mm(line, pixel, &reading.geometry, leader.x_offset);
            // Without a step only the line that the encoder was latched for has a place.
            let step = match (index, reading.encoder_step) {
                (0, _) => Some(0),
                (_, step) => step.map(|step| step.wrapping_mul(index as i64)),
            };
            Profile {
                sequence: 0,
                boot: 0,
                device_time_ns: time,
                encoder: encoder
                    .zip(step)
                    .map(|(value, step)| value.wrapping_add(step)),
                host_time,
                dropped: 0,
                saturated: false,
                x_mm,
                z_mm,
                intensity: Vec::new(),
            }
        })
        .collect())
}

/// A counter of a few bits, made whole: it is believed to have gone the shorter way round since it was seen last.
#[derive(Debug, Default)]
pub(super) struct Wraps(Option<i64>);

impl Wraps {
    fn whole(&mut self, counts: i64, bits: u32) -> i64 {
        let whole = match self.0 {
            Some(last) if bits < 64 => {
                let shift = 64 - bits;
                let step = counts.wrapping_sub(last) << shift >> shift;
                last.wrapping_add(step)
            }
            _ => counts,
        };
        self.0 = Some(whole);
        whole
    }
}

/// Reads blocks from transfers, whatever is missing between them.
struct Blocks {
    pixel: Option<(u32, Pixel)>,
    leader: Option<Leader>,
    payload: Vec<u8>,
    /// Bytes that the image of this leader has, where it says a size: a transfer that looks like a trailer before that is data.
    least: usize,
    overlong: bool,
}

/// What a transfer completed.
enum Step {
    Nothing,
    Block(Leader, Trailer),
    /// A block that is spoilt: its number, where it is known.
    Spoilt(Option<u64>),
}

impl Blocks {
    fn new() -> Blocks {
        Blocks {
            pixel: None,
            leader: None,
            payload: Vec::new(),
            least: 0,
            overlong: false,
        }
    }

    fn take(&mut self, bytes: &[u8]) -> Step {
        match self.leader {
            Some(leader) if block::is_trailer(bytes) && self.payload.len() >= self.least => {
                self.leader = None;
                match block::trailer(bytes) {
                    Ok(trailer) if trailer.block_id == leader.block_id && !self.overlong => {
                        Step::Block(leader, trailer)
                    }
                    _ => Step::Spoilt(Some(leader.block_id)),
                }
            }
            // The end of a block whose leader, or some of its payload, was lost.
            _ if block::is_trailer(bytes) && bytes.len() <= 64 => {
                let before = self.leader.take().map(|leader| leader.block_id);
                let id = block::trailer(bytes).ok().map(|trailer| trailer.block_id);
                Step::Spoilt(id.or(before))
            }
            Some(before) if block::is_leader(bytes) && block::leader(bytes).is_ok() => {
                self.begin(bytes);
                Step::Spoilt(Some(before.block_id))
            }
            Some(_) => {
                self.overlong |= self.payload.len() + bytes.len() > PAYLOAD_MAX;
                if !self.overlong {
                    self.payload.extend_from_slice(bytes);
                }
                Step::Nothing
            }
            None => {
                self.begin(bytes);
                Step::Nothing
            }
        }
    }

    fn begin(&mut self, bytes: &[u8]) {
        self.payload.clear();
        self.overlong = false;
        self.leader = block::leader(bytes).ok();
        let Some(leader) = self.leader else { return };
        if self
            .pixel
            .is_none_or(|(format, _)| format != leader.pixel_format)
        {
            self.pixel = block::pixel(leader.pixel_format)
                .ok()
                .map(|pixel| (leader.pixel_format, pixel));
        }
        // Of one line only: a trailer may say that fewer lines came than the leader promised.
        let line = self.pixel.map_or(0, |(_, pixel)| {
            pixel.bytes() * leader.width.min(1 << 20) as usize
        });
        self.least = line.min(PAYLOAD_MAX / 2);
    }
}

/// Transfers in flight for buffers of so many bytes.
fn in_flight(bytes: usize) -> usize {
    (IN_FLIGHT_BYTES / bytes.max(1)).clamp(2, IN_FLIGHT_MAX)
}

/// Runs the thread until the caller wants it to end or nothing more will come.
pub(super) fn run(link: &Arc<dyn UsbLink>, shared: &Shared, reading: &Reading) {
    if let Err(over) = read_blocks(link.as_ref(), shared, reading) {
        shared.lock().over.get_or_insert(over);
        shared.arrived.notify_all();
    }
}

fn read_blocks(link: &dyn UsbLink, shared: &Shared, reading: &Reading) -> Result<(), Over> {
    let mut blocks = Blocks::new();
    let size = reading
        .transfer
        .max(reading.leader_max)
        .max(reading.trailer_max);
    let gone = |error| Over::Link(Some(error));
    // While a run is on: a device that stands still has nothing to fill.
    let mut stream = None;
    let mut stalls = 0;
    let mut wraps = Wraps::default();
    loop {
        let inbox = shared.lock();
        if inbox.quit || inbox.over.is_some() {
            return Ok(());
        }
        let running = inbox.running;
        if running && inbox.full() || !running && stream.is_none() {
            drop(shared.taken.wait_timeout(inbox, SLICE));
            continue;
        }
        drop(inbox);
        if !running {
            stream = None;
            continue;
        }
        let reads = match &mut stream {
            Some(reads) => reads,
            none => {
                let opened = link.stream(reading.endpoint, in_flight(size), size);
                none.insert(opened.map_err(gone)?)
            }
        };
        let bytes = match reads.next(Instant::now() + SLICE) {
            Ok(None | Some([])) => continue,
            Ok(Some(bytes)) => bytes,
            Err(error @ (LinkError::Stalled | LinkError::Overflow)) => {
                stalls += 1;
                let id = blocks.leader.take().map(|leader| leader.block_id);
                spoil(shared, id, false);
                if matches!(error, LinkError::Stalled) {
                    link.clear_halt(reading.endpoint).map_err(gone)?;
                }
                match stalls <= STALLS_MAX {
                    true => continue,
                    false => return Err(gone(error)),
                }
            }
            Err(error) => return Err(gone(error)),
        };
        match blocks.take(bytes) {
            Step::Nothing => {}
            Step::Spoilt(id) => spoil(shared, id, false),
            Step::Block(leader, trailer) => {
                stalls = 0;
                let whole = (&leader, &trailer, &blocks.payload[..]);
                block(shared, reading, whole, &mut wraps, reads.received())?;
            }
        }
    }
}

/// Takes a block that came whole.
fn block(
    shared: &Shared,
    reading: &Reading,
    (leader, trailer, payload): (&Leader, &Trailer, &[u8]),
    wraps: &mut Wraps,
    came: Instant,
) -> Result<(), Over> {
    let id = leader.block_id;
    if trailer.status != 0 {
        spoil(shared, Some(id), DISCARDED.contains(&trailer.status));
        return Ok(());
    }
    match profiles(leader, trailer, payload, reading, wraps, came) {
        Ok(profiles) => {
            let mut inbox = shared.lock();
            inbox.heard = Instant::now();
            inbox.accept(id, profiles);
            drop(inbox);
            shared.arrived.notify_all();
        }
        Err(
            error @ DecodeError::Field {
                field: "pixel format",
                ..
            },
        ) => return Err(Over::Decode(error)),
        Err(error) => {
            tracing::debug!(%error, "rejected a block");
            spoil(shared, Some(id), false);
        }
    }
    Ok(())
}

fn spoil(shared: &Shared, id: Option<u64>, by_device: bool) {
    let mut inbox = shared.lock();
    inbox.heard = Instant::now();
    match id {
        Some(id) => inbox.spoilt(id, by_device),
        // Its number is not known: the gap before the next one counts it.
        None => inbox.losses.rejected += u64::from(inbox.running),
    }
    drop(inbox);
    shared.arrived.notify_all();
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(25),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_transfers_are_taken_within_bounds(
            transfers in prop::collection::vec((0_u8..4, prop::collection::vec(prop_oneof![Just(0_u8), Just(1), any::<u8>()], 0..200)), 0..40),
        ) {
            let shared = Shared::new();
            shared.lock().begin(None);
            let mut blocks = Blocks::new();
            let mut sum = 0;
            for (kind, mut bytes) in transfers {
                let magic: &[u8] = match kind { 0 => b"U3VL", 1 => b"U3VT", _ => b"" };
                if bytes.len() >= 4 && !magic.is_empty() {
                    bytes[..4].copy_from_slice(magic);
                }
                sum += bytes.len();
                match blocks.take(&bytes) {
                    Step::Spoilt(Some(id)) => shared.lock().spoilt(id, false),
                    Step::Block(leader, _) => { shared.lock().accept(leader.block_id, Vec::new()); }
                    _ => {}
                }
                prop_assert!(blocks.payload.len() <= sum);
            }
        }
    }
}

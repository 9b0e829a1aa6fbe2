//! Plays a recording back, as if the device were there.
//!
//! What the device sent after a command is not given out before the driver has written again, so that no answer comes
//! before its question. That holds across the links of one device: data wait for the command on another connection. How strictly the driver's own bytes are held to the recorded ones is [`Match`]'s choice.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::recording::{Kind, Record, Recording};
use super::usb::{self, OneByOne, Request, UsbInterface, UsbLink, UsbStream, UsbTarget};
use super::{Link, Links, Target, left};
use crate::error::LinkError;

/// How the driver's writes are held to the recorded ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// Every write must be the recorded one, byte for byte. For drivers that ask and wait.
    Exact,
    /// Any write passes. A recorded write that the driver does not repeat within this time is passed over: keep-alives come
    /// at other moments than they were recorded, and fewer of them, because a recording is played back faster.
    Loose(Duration),
}

/// How long bytes of one channel wait for a recorded write on another, as data do for the start that was asked for on a control connection.
/// Longer than any keep-alive's interval of ours, so that a start is never passed over while the caller still makes ready.
const OTHERS_WRITE: Duration = Duration::from_secs(3);

/// Recorded times are counted from so much ahead of now: nothing that is played back seems to be late, however slowly it goes.
const AHEAD: Duration = Duration::from_secs(3600);

/// Opens the links of a recording, each once. What came has the time at which it came then ([`Link::received`]), to the nanosecond, though it is
/// played back as fast as it is taken.
///
/// A link is found by its target's name, or else the next in the order of opening is taken: a
/// device may have another address than it had.
pub struct Replay {
    shared: Arc<Shared>,
}

struct Shared {
    matching: Match,
    /// The moment that the recording's times are counted from.
    began: Instant,
    written: Condvar,
    tape: Mutex<Tape>,
}

/// A recording, and how far it was played.
struct Tape {
    records: Vec<Record>,
    /// For each record, how many recorded writes lie before it.
    writes_before: Vec<usize>,
    /// The recorded writes.
    writes: Vec<Write>,
    openings: Vec<Opening>,
    channels: BTreeMap<u8, Cursor>,
    /// Writes of the driver, and recorded ones that were passed over.
    credit: usize,
}

/// A recorded write.
struct Write {
    /// Its index among the records.
    record: usize,
    /// The write before it on its channel.
    before: Option<usize>,
    /// The one before or behind it on its channel is the same.
    repeated: bool,
    /// The next that passed on its channel came from the device.
    answered: bool,
    passed_over: bool,
}

impl Write {
    /// Data on other channels need not wait for it: it is said again and again, and what it asks for comes on its own channel. A question that is
    /// answered elsewhere is none.
    fn is_keep_alive(&self) -> bool {
        self.repeated && self.answered
    }
}

/// A link that was opened when the recording was made.
struct Opening {
    channel: u8,
    name: String,
    interfaces: Option<Vec<UsbInterface>>,
    taken: bool,
}

/// Records of one channel that come from the device, and what was given out of them.
#[derive(Default)]
struct Cursor {
    records: VecDeque<usize>,
    byte: usize,
    /// Time of the last record that was given out.
    came: Duration,
}

impl Replay {
    /// Plays `recording` to those who open its links; for everyone after that it is [`LinkError::Busy`].
    pub fn new(recording: Recording, matching: Match) -> Replay {
        Replay::of_run(recording, matching, Instant::now())
    }

    /// As [`Replay::new`], for one of several devices of a run: with the same `began` for all, their times are by one clock as they were.
    pub fn of_run(recording: Recording, matching: Match, began: Instant) -> Replay {
        Replay {
            shared: Arc::new(Shared {
                matching,
                began: began + AHEAD,
                written: Condvar::new(),
                tape: Mutex::new(Tape::new(recording)),
            }),
        }
    }
}

impl Links for Replay {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        let opening = self.shared.lock().take(&target.to_string(), false)?;
        Ok(Arc::new(Played {
            shared: Arc::clone(&self.shared),
            channel: opening.0,
        }))
    }

    fn open_usb(&self, target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
        let (channel, interfaces) = self.shared.lock().take(&target.to_string(), true)?;
        let endpoints = interfaces.iter().flat_map(|i| &i.endpoints);
        Ok(Arc::new(PlayedUsb {
            shared: Arc::clone(&self.shared),
            channel,
            endpoints: endpoints.map(|e| e.address).collect(),
            interfaces,
        }))
    }
}

impl Tape {
    fn new(recording: Recording) -> Tape {
        let mut tape = Tape {
            records: recording.records,
            writes_before: Vec::new(),
            writes: Vec::new(),
            openings: Vec::new(),
            channels: BTreeMap::new(),
            credit: 0,
        };
        // The last write of each channel.
        let mut last: BTreeMap<u8, usize> = BTreeMap::new();
        for (i, record) in tape.records.iter().enumerate() {
            tape.writes_before.push(tape.writes.len());
            match record.kind {
                Kind::ToDevice => {
                    let before = last.insert(record.channel, tape.writes.len());
                    let repeated = before.is_some_and(|before| {
                        let before = &mut tape.writes[before];
                        let same = tape.records[before.record].bytes == record.bytes;
                        before.repeated |= same;
                        same
                    });
                    tape.writes.push(Write {
                        record: i,
                        before,
                        repeated,
                        answered: false,
                        passed_over: false,
                    });
                }
                Kind::Opened => tape.openings.push(Opening {
                    channel: record.channel,
                    name: String::from_utf8_lossy(&record.bytes).into_owned(),
                    interfaces: None,
                    taken: false,
                }),
                Kind::Configuration => {
                    if let Some(opening) = tape.openings.last_mut() {
                        opening.interfaces = Some(usb::interfaces(&record.bytes));
                    }
                }
                Kind::Note => {}
                Kind::FromDevice | Kind::Gone | Kind::Limit | Kind::Failed => {
                    if let Some(write) = last.get(&record.channel) {
                        tape.writes[*write].answered = true;
                    }
                    let cursor = tape.channels.entry(record.channel).or_default();
                    cursor.records.push_back(i);
                }
            }
        }
        if tape.openings.is_empty() {
            tape.openings.push(Opening {
                channel: 0,
                name: recording.target,
                interfaces: None,
                taken: false,
            });
        }
        tape
    }

    fn take(&mut self, name: &str, usb: bool) -> Result<(u8, Vec<UsbInterface>), LinkError> {
        let free = |opening: &Opening| !opening.taken && opening.interfaces.is_some() == usb;
        let named = |opening: &Opening| free(opening) && opening.name == name;
        let place = self.openings.iter().position(named);
        let place = place.or_else(|| self.openings.iter().position(free));
        let opening = &mut self.openings[place.ok_or(LinkError::Busy)?];
        opening.taken = true;
        Ok((
            opening.channel,
            opening.interfaces.clone().unwrap_or_default(),
        ))
    }

    /// The keep-alive that is next was not written by the driver. Of the answers to such ones only the last is kept, should one be asked for after all.
    fn pass_over(&mut self) {
        let write = &mut self.writes[self.credit];
        write.passed_over = true;
        let (record, before) = (write.record, write.before);
        self.credit += 1;
        let Some(before) = before.map(|before| &self.writes[before]) else {
            return;
        };
        if let Some(cursor) = self.channels.get_mut(&self.records[record].channel)
            && before.passed_over
        {
            // In order of the records, and near the front.
            let place = |of: usize| cursor.records.partition_point(|i| *i < of);
            let answers = place(before.record)..place(record);
            cursor.records.drain(answers);
        }
    }

    /// The driver wrote: the recorded write that this is, with the keep-alives before it that did not come.
    fn written(&mut self, channel: u8, bytes: &[u8]) {
        let is_this = |write: &Write| {
            let record = &self.records[write.record];
            record.channel == channel && record.bytes == bytes
        };
        let ahead = self.writes.get(self.credit..).unwrap_or_default();
        let this = ahead
            .iter()
            .position(|write| is_this(write) || !write.is_keep_alive());
        match this.map(|place| self.credit + place) {
            Some(place) if is_this(&self.writes[place]) => {
                while self.credit < place {
                    self.pass_over();
                }
                self.credit += 1;
            }
            // One more keep-alive than there were: no other command is taken for it.
            _ if self
                .writes
                .iter()
                .any(|write| write.is_keep_alive() && is_this(write)) => {}
            _ => self.credit += 1,
        }
    }

    /// Nothing is left that any channel could give.
    fn is_over(&self) -> bool {
        self.channels.values().all(|cursor| {
            let first = cursor.records.front();
            first.is_none_or(|i| matches!(self.records[*i].kind, Kind::Gone | Kind::Limit))
        })
    }
}

/// What a channel gives next.
enum Next {
    /// The record with this index.
    Record(usize),
    /// Nothing before the deadline.
    Nothing,
    Over,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Tape> {
        self.tape.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until the next record of `channel` may be given out: no answer comes before its question.
    fn next<'a>(
        &'a self,
        mut tape: MutexGuard<'a, Tape>,
        channel: u8,
        deadline: Instant,
    ) -> (MutexGuard<'a, Tape>, Next) {
        let began = Instant::now();
        loop {
            let first = tape.channels.get(&channel).and_then(|c| c.records.front());
            let patience_until = match first.copied() {
                Some(i) if tape.writes_before[i] <= tape.credit => {
                    return match tape.records[i].kind {
                        Kind::Gone | Kind::Limit => (tape, Next::Over),
                        _ => (tape, Next::Record(i)),
                    };
                }
                Some(i) => {
                    let awaited = &tape.writes[tape.credit];
                    let own = tape.records[awaited.record].channel == channel;
                    let kept_alive = awaited.is_keep_alive();
                    let patience = match self.matching {
                        Match::Exact => None,
                        Match::Loose(patience) if own || kept_alive => Some(patience),
                        Match::Loose(patience) => Some(patience.max(OTHERS_WRITE)),
                    };
                    let until = patience.map(|patience| began + patience);
                    if until.is_some_and(|until| Instant::now() >= until) {
                        // Up to here, or to the next one of another channel.
                        match (own, kept_alive) {
                            (false, true) => tape.pass_over(),
                            (true, _) => tape.credit += 1,
                            (false, false) => tape.credit = tape.writes_before[i],
                        }
                        self.written.notify_all();
                        continue;
                    }
                    until
                }
                None if tape.is_over() => return (tape, Next::Over),
                None => None,
            };
            if left(deadline).is_zero() {
                return (tape, Next::Nothing);
            }
            let wait = left(patience_until.map_or(deadline, |until| until.min(deadline)));
            // What other channels give out may be the last, and that wakes nobody.
            let wait = wait.min(Duration::from_millis(20));
            let waited = self.written.wait_timeout(tape, wait);
            tape = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn received(&self, channel: u8) -> Instant {
        let tape = self.lock();
        let came = tape.channels.get(&channel).map(|cursor| cursor.came);
        self.began + came.unwrap_or_default()
    }

    fn write(&self, channel: u8, bytes: &[u8]) -> Result<(), LinkError> {
        let mut tape = self.lock();
        if self.matching == Match::Exact {
            let at = tape.writes.get(tape.credit).ok_or(LinkError::Gone)?.record;
            let record = &tape.records[at];
            // What was recorded before it has been read.
            let cursor = tape.channels.get(&record.channel);
            let read = cursor.is_none_or(|c| c.records.front().is_none_or(|first| *first > at));
            if !read || record.bytes != bytes || record.channel != channel {
                return Err(LinkError::Departed {
                    found: hex(bytes),
                    recorded: hex(&record.bytes),
                    at_s: record.time.as_secs_f64(),
                });
            }
        }
        match self.matching {
            Match::Exact => tape.credit += 1,
            Match::Loose(_) => tape.written(channel, bytes),
        }
        self.written.notify_all();
        Ok(())
    }
}

struct Played {
    shared: Arc<Shared>,
    channel: u8,
}

impl Link for Played {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let mut tape = self.shared.lock();
        loop {
            let (mut held, next) = self.shared.next(tape, self.channel, deadline);
            let i = match next {
                Next::Record(i) => i,
                Next::Nothing => return Ok(0),
                Next::Over => return Err(LinkError::Gone),
            };
            let Tape {
                records, channels, ..
            } = &mut *held;
            let cursor = channels.entry(self.channel).or_default();
            let rest = records[i].bytes.get(cursor.byte..).unwrap_or_default();
            let n = rest.len().min(buffer.len());
            buffer[..n].copy_from_slice(&rest[..n]);
            cursor.byte += n;
            cursor.came = records[i].time;
            if n == rest.len() {
                cursor.records.pop_front();
                cursor.byte = 0;
            }
            if n > 0 {
                return Ok(n);
            }
            tape = held;
        }
    }

    fn received(&self) -> Instant {
        self.shared.received(self.channel)
    }

    fn write(&self, bytes: &[u8], _: Instant) -> Result<(), LinkError> {
        self.shared.write(self.channel, bytes)
    }
}

/// A USB device of a recording.
struct PlayedUsb {
    shared: Arc<Shared>,
    channel: u8,
    endpoints: Vec<u8>,
    interfaces: Vec<UsbInterface>,
}

impl PlayedUsb {
    /// The next transfer of a channel.
    fn transfer(
        &self,
        channel: u8,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let (mut tape, next) = self.shared.next(self.shared.lock(), channel, deadline);
        let i = match next {
            Next::Record(i) => i,
            Next::Nothing => return Ok(None),
            Next::Over => return Err(LinkError::Gone),
        };
        let came = tape.records[i].time;
        let cursor = tape.channels.entry(channel).or_default();
        cursor.records.pop_front();
        cursor.came = came;
        let record = &tape.records[i];
        match (record.kind, &record.bytes[..]) {
            (Kind::Failed, [2]) => Err(LinkError::Overflow),
            (Kind::Failed, _) => Err(LinkError::Stalled),
            (_, bytes) if bytes.len() > buffer.len() => Err(LinkError::Overflow),
            (_, bytes) => {
                buffer[..bytes.len()].copy_from_slice(bytes);
                Ok(Some(bytes.len()))
            }
        }
    }

    /// A transfer to the device, which may have failed when it was recorded.
    fn send(&self, channel: u8, bytes: &[u8], length: usize) -> Result<Option<usize>, LinkError> {
        self.shared.write(channel, bytes)?;
        let mut tape = self.shared.lock();
        let first = tape.channels.get(&channel).and_then(|c| c.records.front());
        let failed = first.copied().filter(|i| {
            tape.records[*i].kind == Kind::Failed && tape.writes_before[*i] == tape.credit
        });
        let Some(failed) = failed else {
            return Ok(Some(length));
        };
        tape.channels
            .entry(channel)
            .or_default()
            .records
            .pop_front();
        match tape.records[failed].bytes[..] {
            [2] => Err(LinkError::Overflow),
            _ => Err(LinkError::Stalled),
        }
    }

    fn channel_of(&self, endpoint: u8) -> u8 {
        usb::channel_of(&self.endpoints, self.channel, endpoint)
    }
}

impl UsbLink for PlayedUsb {
    fn interfaces(&self) -> &[UsbInterface] {
        &self.interfaces
    }

    fn claim(&self, _: u8) -> Result<(), LinkError> {
        Ok(())
    }

    fn control_in(
        &self,
        request: Request,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        self.shared
            .write(self.channel, &request.setup(buffer.len()))?;
        self.transfer(self.channel, buffer, deadline)
    }

    fn control_out(
        &self,
        request: Request,
        bytes: &[u8],
        _: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let mut setup = request.setup(bytes.len()).to_vec();
        setup.extend(bytes);
        self.send(self.channel, &setup, bytes.len())
    }

    fn read(
        &self,
        endpoint: u8,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        self.transfer(self.channel_of(endpoint), buffer, deadline)
    }

    fn received(&self, endpoint: u8) -> Instant {
        self.shared.received(self.channel_of(endpoint))
    }

    fn write(&self, endpoint: u8, bytes: &[u8], _: Instant) -> Result<Option<usize>, LinkError> {
        self.send(self.channel_of(endpoint), bytes, bytes.len())
    }

    fn stream(
        &self,
        endpoint: u8,
        _: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError> {
        Ok(Box::new(OneByOne::new(self, endpoint, bytes)))
    }

    fn clear_halt(&self, _: u8) -> Result<(), LinkError> {
        Ok(())
    }
}

/// The first bytes in hex, for people.
fn hex(bytes: &[u8]) -> String {
    const SHOWN: usize = 24;
    let mut text: Vec<String> = bytes
        .iter()
        .take(SHOWN)
        .map(|b| format!("{b:02x}"))
        .collect();
    if bytes.len() > SHOWN {
        text.push(format!("and {} more", bytes.len() - SHOWN));
    }
    text.join(" ")
}

//! Plays a recording back, as if the device were there.
//!
//! What the device sent after a command is not given out before the driver has written again, so that no answer comes
//! before its question. How strictly the driver's own bytes are held to the recorded ones is [`Match`]'s choice.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::recording::{Kind, Recording};
use super::{Link, Links, Target, left};
use crate::error::LinkError;

/// How the driver's writes are held to the recorded ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// Every write must be the recorded one, byte for byte. For drivers that ask and wait.
    Exact,
    /// Any write passes. A recorded write that the driver does not repeat within this time is passed over: keep-alives come
    /// at other moments than they were recorded.
    Loose(Duration),
}

/// Opens one link only: a recording's. The target is not looked at.
pub struct Replay {
    recording: Mutex<Option<Recording>>,
    matching: Match,
}

impl Replay {
    /// Plays `recording` to the first who opens a link; for everyone after that it is [`LinkError::Busy`].
    pub fn new(recording: Recording, matching: Match) -> Replay {
        Replay {
            recording: Mutex::new(Some(recording)),
            matching,
        }
    }
}

impl Links for Replay {
    fn open(&self, _: &Target) -> Result<Arc<dyn Link>, LinkError> {
        let mut slot = self
            .recording
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let recording = slot.take().ok_or(LinkError::Busy)?;
        Ok(Arc::new(Played {
            matching: self.matching,
            written: Condvar::new(),
            place: Mutex::new(Place {
                recording,
                record: 0,
                byte: 0,
                credit: 0,
            }),
        }))
    }
}

struct Played {
    matching: Match,
    written: Condvar,
    place: Mutex<Place>,
}

/// How far the recording was played.
struct Place {
    recording: Recording,
    /// The record that is next.
    record: usize,
    /// Bytes of it that were given out.
    byte: usize,
    /// Writes of the driver that no recorded write has used up.
    credit: usize,
}

impl Place {
    fn next_kind(&self) -> Option<Kind> {
        self.recording.records.get(self.record).map(|r| r.kind)
    }

    fn give(&mut self, buffer: &mut [u8]) -> usize {
        let rest = &self.recording.records[self.record].bytes[self.byte..];
        let n = rest.len().min(buffer.len());
        buffer[..n].copy_from_slice(&rest[..n]);
        self.byte += n;
        if n == rest.len() {
            self.record += 1;
            self.byte = 0;
        }
        n
    }

    /// The next recorded write, which a write of the driver is held to.
    fn recorded_write(&self) -> Option<usize> {
        let later = self.recording.records[self.record..].iter();
        later
            .enumerate()
            .find(|(_, record)| record.kind == Kind::ToDevice)
            .map(|(offset, _)| self.record + offset)
    }
}

impl Link for Played {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let mut place = self.place.lock().unwrap_or_else(PoisonError::into_inner);
        let patience = match self.matching {
            Match::Exact => None,
            Match::Loose(patience) => Some(Instant::now() + patience),
        };
        loop {
            match place.next_kind() {
                Some(Kind::FromDevice) => match place.give(buffer) {
                    0 => {}
                    n => return Ok(n),
                },
                Some(Kind::ToDevice) if place.credit > 0 => {
                    place.credit -= 1;
                    place.record += 1;
                }
                Some(Kind::ToDevice) if patience.is_some_and(|end| Instant::now() >= end) => {
                    place.record += 1;
                }
                Some(Kind::ToDevice) => {
                    let wait = left(patience.map_or(deadline, |end| end.min(deadline)));
                    if left(deadline).is_zero() {
                        return Ok(0);
                    }
                    place = self
                        .written
                        .wait_timeout(place, wait)
                        .unwrap_or_else(PoisonError::into_inner)
                        .0;
                }
                Some(Kind::Gone | Kind::Limit) | None => return Err(LinkError::Gone),
            }
        }
    }

    fn write(&self, bytes: &[u8], _: Instant) -> Result<(), LinkError> {
        let mut place = self.place.lock().unwrap_or_else(PoisonError::into_inner);
        if self.matching == Match::Exact {
            let at = place.recorded_write().ok_or(LinkError::Gone)?;
            let record = &place.recording.records[at];
            if place.credit > 0 || record.bytes != bytes {
                return Err(LinkError::Departed {
                    found: hex(bytes),
                    recorded: hex(&record.bytes),
                    at_s: record.time.as_secs_f64(),
                });
            }
        }
        place.credit += 1;
        self.written.notify_all();
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

//! The thread of one open device: it reads always, keeps the run alive, and counts what is lost.
//!
//! A thread, because the device must hear from us every few hundred milliseconds and its bytes must be taken although the
//! caller is busy for a second. It is no blank cheque for the laser: when the caller has not asked for a profile for
//! [`PATIENCE`], the keep-alives cease and the device ends the run by its own rule.
//!
//! The queue is bounded by [`QUEUE_BYTES`]. When it is full the thread stops reading; the device then drops by its own count,
//! or the serial line does by the sequence numbers. Either way the loss is counted.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::frame::{Decoder, Frame};
use super::message::{Message, RawProfile, Reply, Stopped, flag, message};
use super::{Command, ended_remedy, stop_reason};
use crate::capture::Profile;
use crate::device::Losses;
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::Link;

/// How long the caller may stay away before the run is left to end. A calculation between two profiles takes seconds at
/// worst; a caller that hung must not keep a laser on for minutes.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);

/// Most bytes of profiles that wait for the caller: 8 s of 640 columns at 900 Hz.
const QUEUE_BYTES: usize = 64 << 20;

/// Longest wait in one read, so that a run that starts, a keep-alive that falls due and the end of the thread are seen.
const SLICE: Duration = Duration::from_millis(50);

/// Silence within a frame after which it is given up, section 2 of the document.
const STALL: Duration = Duration::from_millis(250);

/// Most replies that nobody asked for yet.
const REPLIES: usize = 16;

/// KEEPALIVE, sent every half of their time, after which a device that says nothing counts as silent: the three periods
/// after which the device gives us up. Counted and not timed, so that a computer that slept does not accuse the device.
const UNANSWERED: u32 = 6;

/// Ids of KEEPALIVE have this bit, ids of all other commands do not.
const KEEPALIVE_ID: u32 = 1 << 31;

/// What thread and caller share.
pub(super) struct Shared {
    inbox: Mutex<Inbox>,
    /// Something came: a profile, a reply, the end.
    pub arrived: Condvar,
    /// The caller took something or wants something.
    pub taken: Condvar,
}

/// What came from the device and was not taken yet.
pub(super) struct Inbox {
    pub profiles: VecDeque<Profile>,
    queued_bytes: usize,
    pub replies: VecDeque<(u32, Reply)>,
    pub run: Option<Run>,
    pub losses: Losses,
    /// Bytes that came since the device was opened.
    pub heard_bytes: u64,
    /// When the last byte came.
    pub heard: Instant,
    /// Why nothing more will come.
    pub over: Option<Over>,
    /// The caller is inside a wait for a profile.
    pub waiting: bool,
    /// When the caller last asked for something.
    pub asked: Instant,
    /// STOP was sent: what is under way is taken in although the queue is full.
    pub stopping: bool,
    pub quit: bool,
    identity: Known,
    skipped_bytes: u64,
}

/// What the profiles are read with.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Known {
    pub boot: Option<u32>,
    pub has_encoder: bool,
}

/// A run that was started.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    pub number: u32,
    pub keepalive: Duration,
    next_keepalive: Instant,
    /// KEEPALIVE sent since the last byte was heard.
    unanswered: u32,
    /// The sequence number that comes next where nothing is lost.
    expected: u32,
    skipped_before: u64,
    pub stopped: Option<Stopped>,
}

/// Why nothing more will come.
#[derive(Debug)]
pub(super) enum Over {
    Link(Option<LinkError>),
    Silent(Duration),
    Restarted { found: u32, before: u32 },
}

impl Over {
    /// The error a caller gets; asked again, a link is simply gone.
    pub fn error(&mut self, port: &str) -> DeviceError {
        let port = port.to_owned();
        match self {
            Over::Link(source) => DeviceError::Link {
                port,
                source: source.take().unwrap_or(LinkError::Gone),
            },
            Over::Silent(deadline) => DeviceError::Silent {
                port,
                deadline_s: deadline.as_secs_f64(),
            },
            Over::Restarted { found, before } => DeviceError::Restarted {
                port,
                found: *found,
                before: *before,
            },
        }
    }
}

impl Shared {
    pub fn new() -> Shared {
        let now = Instant::now();
        Shared {
            inbox: Mutex::new(Inbox {
                profiles: VecDeque::new(),
                queued_bytes: 0,
                replies: VecDeque::new(),
                run: None,
                losses: Losses::default(),
                heard_bytes: 0,
                heard: now,
                over: None,
                waiting: false,
                asked: now,
                stopping: false,
                quit: false,
                identity: Known::default(),
                skipped_bytes: 0,
            }),
            arrived: Condvar::new(),
            taken: Condvar::new(),
        }
    }

    pub fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for something to arrive, until `deadline` at most.
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
    pub fn know(&mut self, known: Known) {
        self.identity = known;
    }

    /// Makes ready for the profiles of a new run.
    pub fn begin(&mut self, number: u32, keepalive: Duration) {
        if !self.profiles.is_empty() {
            let profiles = self.profiles.len();
            tracing::warn!(
                profiles,
                "profiles of the run before were not taken and are dropped"
            );
        }
        self.profiles.clear();
        self.queued_bytes = 0;
        self.losses = Losses::default();
        self.asked = Instant::now();
        self.run = Some(Run {
            number,
            keepalive,
            next_keepalive: Instant::now() + keepalive / 2,
            unanswered: 0,
            expected: 0,
            skipped_before: self.skipped_bytes,
            stopped: None,
        });
    }

    /// The oldest profile.
    pub fn pop(&mut self) -> Option<Profile> {
        let profile = self.profiles.pop_front()?;
        self.queued_bytes -= size(&profile);
        Some(profile)
    }

    fn heard_something(&mut self, bytes: usize) {
        self.heard = Instant::now();
        self.heard_bytes += bytes as u64;
        if let Some(run) = &mut self.run {
            run.unanswered = 0;
        }
    }

    /// No profile more fits in, for now.
    fn full(&self) -> bool {
        let limit = if self.stopping { 2 } else { 1 } * QUEUE_BYTES;
        self.queued_bytes > limit
    }

    /// The error of a run that the device ended by itself, but for a count that was reached.
    pub fn ended(&self, port: &str) -> Option<DeviceError> {
        let stopped = self.run?.stopped?;
        (stopped.reason > 1).then(|| DeviceError::Ended {
            port: port.to_owned(),
            reason: stop_reason(stopped.reason),
            remedy: ended_remedy(stopped.reason),
        })
    }

    fn accept(&mut self, frame: Result<Frame<'_>, DecodeError>, host_time: Instant) {
        let decoded = frame.and_then(|frame| Ok((frame.id, message(&frame)?)));
        match decoded {
            Ok((_, Message::Profile(raw))) => self.accept_profile(&raw, host_time),
            Ok((id, Message::Reply(reply))) => self.accept_reply(id, reply),
            Err(error) => {
                tracing::debug!(%error, "rejected a frame");
                self.losses.rejected += 1;
            }
        }
    }

    fn accept_profile(&mut self, raw: &RawProfile<'_>, host_time: Instant) {
        let Some(run) = &mut self.run else { return };
        if raw.run != run.number {
            return;
        }
        if let Some(before) = self.identity.boot.filter(|&boot| boot != raw.boot) {
            self.over.get_or_insert(Over::Restarted {
                found: raw.boot,
                before,
            });
            return;
        }
        let gap = raw.sequence.wrapping_sub(run.expected);
        if gap > u32::MAX / 2 {
            // It came before: a sequence number never goes back within a run.
            self.losses.rejected += 1;
            return;
        }
        run.expected = raw.sequence.wrapping_add(1);
        self.losses.lost_on_link += u64::from(gap);
        self.losses.received += 1;
        self.losses.dropped_by_device = raw.dropped.into();
        let profile = raw.capture(self.identity.has_encoder, host_time);
        self.queued_bytes += size(&profile);
        self.profiles.push_back(profile);
    }

    fn accept_reply(&mut self, id: u32, reply: Reply) {
        match reply {
            Reply::Stopped(stopped) => self.note_stopped(stopped),
            Reply::Alive { boot, flags } => {
                self.note_boot(boot);
                if flags & flag::TRIGGER_TOO_FAST != 0 {
                    tracing::warn!("the trigger comes faster than the device can follow");
                }
            }
            Reply::Started { boot, .. } => self.note_boot(boot),
            _ => {}
        }
        if id & KEEPALIVE_ID != 0 {
            return;
        }
        if self.replies.len() == REPLIES {
            self.replies.pop_front();
        }
        self.replies.push_back((id, reply));
    }

    fn note_boot(&mut self, found: u32) {
        if let Some(before) = self.identity.boot.filter(|&boot| boot != found) {
            self.over.get_or_insert(Over::Restarted { found, before });
        }
    }

    /// Takes the device's own count of the run as the last word on what was lost.
    fn note_stopped(&mut self, stopped: Stopped) {
        let Some(run) = &mut self.run else { return };
        if stopped.run != run.number || run.stopped.is_some() {
            return;
        }
        run.stopped = Some(stopped);
        let tail = stopped.sent.wrapping_sub(run.expected);
        if tail <= u32::MAX / 2 {
            self.losses.lost_on_link += u64::from(tail);
            run.expected = stopped.sent;
        }
        self.losses.dropped_by_device = stopped.dropped.into();
    }
}

fn size(profile: &Profile) -> usize {
    let numbers = profile.x_mm.len() + profile.z_mm.len();
    size_of::<Profile>() + 8 * numbers + 2 * profile.intensity.len()
}

/// Runs the thread until the caller wants it to end or nothing more will come.
pub(super) fn run(link: &Arc<dyn Link>, shared: &Shared) {
    let mut line = Line {
        link,
        decoder: Decoder::default(),
        chunk: vec![0; 64 << 10],
        keepalives: 0,
        started: Instant::now(),
    };
    loop {
        let inbox = shared.lock();
        if inbox.quit || inbox.over.is_some() {
            return;
        }
        if inbox.full() {
            let waited = shared.taken.wait_timeout(inbox, SLICE);
            // Nothing was heard because nobody listened.
            let mut inbox = waited.unwrap_or_else(PoisonError::into_inner).0;
            inbox.heard_something(0);
        } else {
            drop(inbox);
            line.read(shared);
        }
        line.keep_alive(shared);
    }
}

struct Line<'a> {
    link: &'a Arc<dyn Link>,
    decoder: Decoder,
    chunk: Vec<u8>,
    keepalives: u32,
    started: Instant,
}

impl Line<'_> {
    fn read(&mut self, shared: &Shared) {
        let read = self.link.read(&mut self.chunk, Instant::now() + SLICE);
        let (now, came) = (Instant::now(), self.link.received());
        let mut inbox = shared.lock();
        let inbox = &mut *inbox;
        match read {
            Ok(0) => {
                if now.saturating_duration_since(inbox.heard) >= STALL {
                    self.decoder.stalled(|frame| inbox.accept(frame, came));
                }
            }
            Ok(n) => {
                inbox.heard_something(n);
                self.decoder
                    .take(&self.chunk[..n], |frame| inbox.accept(frame, came));
            }
            Err(error) => inbox.over = Some(Over::Link(Some(error))),
        }
        inbox.skipped_bytes = self.decoder.skipped_bytes();
        if let Some(run) = &inbox.run {
            inbox.losses.skipped_bytes = inbox.skipped_bytes - run.skipped_before;
        }
        shared.arrived.notify_all();
    }

    /// Sends KEEPALIVE where it is due, and gives the device up where it stays silent all the same.
    fn keep_alive(&mut self, shared: &Shared) {
        let now = Instant::now();
        let mut inbox = shared.lock();
        let caller_there = inbox.waiting || now.saturating_duration_since(inbox.asked) < PATIENCE;
        let Some(run) = inbox.run.as_mut().filter(|run| run.stopped.is_none()) else {
            return;
        };
        let keepalive = run.keepalive;
        if now < run.next_keepalive {
            return;
        }
        // Twice as often as promised, so that a late thread keeps the promise.
        run.next_keepalive = now + keepalive / 2;
        if !caller_there {
            tracing::warn!("nobody takes profiles: the run is left to end by itself");
            return;
        }
        run.unanswered += 1;
        if run.unanswered > UNANSWERED {
            inbox.over = Some(Over::Silent(3 * keepalive));
            shared.arrived.notify_all();
            return;
        }
        drop(inbox);
        self.keepalives = self.keepalives.wrapping_add(1);
        let command = Command::Keepalive {
            host_time_ns: self.started.elapsed().as_nanos() as u64,
        };
        let frame = command.encode(self.keepalives | KEEPALIVE_ID);
        if let Err(error) = self.link.write(&frame, now + keepalive) {
            shared.lock().over = Some(Over::Link(Some(error)));
            shared.arrived.notify_all();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts what is written; nothing ever comes.
    #[derive(Default)]
    struct Quiet {
        written: Mutex<u32>,
    }

    impl Link for Quiet {
        fn read(&self, _: &mut [u8], _: Instant) -> Result<usize, LinkError> {
            Ok(0)
        }

        fn write(&self, _: &[u8], _: Instant) -> Result<(), LinkError> {
            *self.written.lock().unwrap_or_else(PoisonError::into_inner) += 1;
            Ok(())
        }
    }

    /// Lets a keep-alive fall due `times` times; the answer is how often one was written.
    fn keepalives(shared: &Shared, times: u32) -> u32 {
        let quiet = Arc::new(Quiet::default());
        let link: Arc<dyn Link> = Arc::clone(&quiet) as _;
        let mut line = Line {
            link: &link,
            decoder: Decoder::default(),
            chunk: vec![0; 64],
            keepalives: 0,
            started: Instant::now(),
        };
        for _ in 0..times {
            if let Some(run) = &mut shared.lock().run {
                run.next_keepalive = Instant::now();
            }
            line.keep_alive(shared);
        }
        let written = quiet.written.lock();
        *written.unwrap_or_else(PoisonError::into_inner)
    }

    fn running() -> Shared {
        let shared = Shared::new();
        shared.lock().begin(1, Duration::from_millis(500));
        shared
    }

    #[test]
    fn a_caller_that_stays_away_ends_the_keepalives() {
        let shared = running();
        assert_eq!(keepalives(&shared, 2), 2);
        let long_ago = Instant::now().checked_sub(PATIENCE);
        shared.lock().asked = long_ago.expect("a clock that began before");
        assert_eq!(keepalives(&shared, 2), 0);
        shared.lock().waiting = true;
        assert_eq!(keepalives(&shared, 2), 2, "inside `next` it is there");
    }

    #[test]
    fn keepalives_without_an_answer_end_as_silence() {
        let shared = running();
        assert_eq!(keepalives(&shared, UNANSWERED), UNANSWERED);
        assert!(shared.lock().over.is_none());
        assert_eq!(keepalives(&shared, 1), 0);
        let error = shared.lock().over.as_mut().map(|over| over.error("p"));
        assert_eq!(
            error.map(|error| error.to_string()).as_deref(),
            Some("p: no answer within 1.5 s; check power and cable, then retry")
        );
    }

    #[test]
    fn a_run_that_is_stopped_needs_no_keepalives() {
        let shared = running();
        shared.lock().note_stopped(Stopped {
            reason: 3,
            run: 1,
            sent: 0,
            dropped: 0,
        });
        assert_eq!(keepalives(&shared, 2), 0);
        let shared = Shared::new();
        assert_eq!(keepalives(&shared, 2), 0, "no run at all");
    }

    #[test]
    fn sequence_numbers_may_wrap() {
        let mut inbox = running();
        let inbox = inbox.inbox.get_mut().expect("no panic before");
        if let Some(run) = &mut inbox.run {
            run.expected = u32::MAX;
        }
        inbox.note_stopped(Stopped {
            reason: 0,
            run: 1,
            sent: 1,
            dropped: 0,
        });
        assert_eq!(inbox.losses.lost_on_link, 2);
    }
}

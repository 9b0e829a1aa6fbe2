//! A session with an I++ DME server: commands and what belongs to them, events at any time, and the state after an error.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::line::{Decoder, Item, Kind, Report, Tag, number, numbers_of, response};
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::Link;

/// How long an acknowledgement is waited for: a busy server delays it.
pub const ACK: Duration = Duration::from_secs(5);
/// Longest time of a command that moves nothing.
pub const SHORT: Duration = Duration::from_secs(10);
/// How long a move that was aborted may take to stand.
const ABORT: Duration = Duration::from_secs(5);
/// Most events that wait for the caller; older ones are dropped and counted.
const EVENTS: usize = 4096;
/// Most data lines of one command: a scan of ten million points.
const DATA_MAX: usize = 1 << 20;
/// Tag of ClearAllErrors, which may be sent while another command has failed.
const CLEAR: u32 = 99_990;

/// What came with a tag of its own, at any time.
#[derive(Debug, Clone, PartialEq)]
pub struct Event {
    /// Number of the event; 0 is the server's own.
    pub tag: u32,
    /// What it says.
    pub kind: Kind,
}

/// A session that was started.
pub struct Session {
    port: String,
    link: Arc<dyn Link>,
    decoder: Decoder,
    lines: VecDeque<Result<super::line::Response, DecodeError>>,
    last_tag: u32,
    last_event: u32,
    events: VecDeque<Event>,
    dropped_events: u64,
    rejected_lines: u64,
    /// The error after which the server takes nothing but ClearAllErrors.
    failed: Option<Report>,
    /// A command did not end: what is under way is not known.
    lost: bool,
}

/// How far one command got.
struct Pending {
    tag: u32,
    command: String,
    acked: bool,
    data: Vec<Vec<Item>>,
    /// When each of them was taken in.
    arrived: Vec<Instant>,
    report: Option<Report>,
}

impl Session {
    /// Starts a session over an open link.
    ///
    /// # Errors
    /// A server that does not answer as one, or has a session already.
    pub fn start(port: String, link: Arc<dyn Link>) -> Result<Session, DeviceError> {
        let mut session = Session {
            port,
            link,
            decoder: Decoder::default(),
            lines: VecDeque::new(),
            last_tag: 0,
            last_event: 0,
            events: VecDeque::new(),
            dropped_events: 0,
            rejected_lines: 0,
            failed: None,
            lost: false,
        };
        session.ask("StartSession()", SHORT)?;
        Ok(session)
    }

    /// Sends a command and waits for its end; the answer is its data lines.
    ///
    /// # Errors
    /// [`DeviceError::Refused`] for what the server reports as an error; after one of severity 2 or more it takes nothing until
    /// [`Session::clear`]. [`DeviceError::Overdue`] when it does not end within `patience`: it was then aborted.
    pub fn ask(
        &mut self,
        command: &str,
        patience: Duration,
    ) -> Result<Vec<Vec<Item>>, DeviceError> {
        self.ask_whole(command, patience)
            .map(|pending| pending.data)
    }

    fn ask_whole(&mut self, command: &str, patience: Duration) -> Result<Pending, DeviceError> {
        if self.lost || self.failed.is_some() {
            return Err(DeviceError::OutOfOrder {
                port: self.port.clone(),
                action: "a command after an error",
                needed: "somebody to look at the machine; then reopen it",
            });
        }
        self.last_tag = self.last_tag % 99_000 + 1;
        let pending = self.transact(self.last_tag, command, patience)?;
        match pending.report {
            Some(report) => Err(self.refused(&pending.command, &report)),
            None => Ok(pending),
        }
    }

    /// The error that the server waits to be cleared.
    pub fn failed(&self) -> Option<&Report> {
        self.failed.as_ref()
    }

    /// Clears all errors of the server.
    ///
    /// # Errors
    /// Whatever keeps the server from doing so.
    pub fn clear(&mut self) -> Result<(), DeviceError> {
        let pending = self.transact(CLEAR, "ClearAllErrors()", SHORT)?;
        if let Some(report) = pending.report {
            return Err(self.refused(&pending.command, &report));
        }
        self.failed = None;
        Ok(())
    }

    /// Starts reports of the position while moving, every `every_mm`; the answer is their tag.
    ///
    /// # Errors
    /// As [`Session::ask`].
    pub fn report_moves(&mut self, every_mm: f64) -> Result<u32, DeviceError> {
        self.last_event = self.last_event % 9_000 + 1;
        let event = self.last_event;
        let command = format!("OnMoveReportE(Dis({}), X(), Y(), Z())", decimal(every_mm));
        self.write(&format!("{} {command}\r\n", Tag::Event(event)))?;
        // Ack and end of an event command bear its tag and come in their order.
        let deadline = Instant::now() + SHORT;
        loop {
            let place = self
                .events
                .iter()
                .position(|e| e.tag == event && ends(&e.kind));
            if let Some(place) = place {
                let kind = self.events.remove(place).map(|event| event.kind);
                self.events
                    .retain(|e| e.tag != event || e.kind != Kind::Ack);
                return match kind {
                    Some(Kind::Error(report)) => Err(self.note(&command, report)),
                    _ => Ok(event),
                };
            }
            self.receive(deadline, "OnMoveReportE", true)?;
        }
    }

    /// Ends reports that [`Session::report_moves`] started.
    ///
    /// # Errors
    /// As [`Session::ask`].
    pub fn stop_reports(&mut self, tag: u32) -> Result<(), DeviceError> {
        self.ask(&format!("StopDaemon({})", Tag::Event(tag)), SHORT)
            .map(drop)
    }

    /// Everything that came with an event tag and was not taken yet.
    pub fn events(&mut self) -> impl Iterator<Item = Event> + '_ {
        self.events.drain(..)
    }

    /// Events dropped because nobody took them, and lines that could not be read.
    pub fn losses(&self) -> (u64, u64) {
        (self.dropped_events, self.rejected_lines)
    }

    /// Measures a point: approach, search along `-normal`, latch, retract. Answer: position, mm, and normal where the server says it.
    ///
    /// # Errors
    /// As [`Session::ask`]; an answer without X, Y and Z.
    pub fn point(
        &mut self,
        [x, y, z]: [f64; 3],
        [i, j, k]: [f64; 3],
        patience: Duration,
    ) -> Result<([f64; 3], Option<[f64; 3]>), DeviceError> {
        let [x, y, z, i, j, k] = [x, y, z, i, j, k].map(decimal);
        let command = format!("PtMeas(X({x}), Y({y}), Z({z}), IJK({i}, {j}, {k}))");
        let data = self.ask(&command, patience)?;
        let found = data.iter().find_map(|items| {
            let one = |name| numbers_of::<1>(items, name).map(|[n]| n);
            Some((
                [one("X")?, one("Y")?, one("Z")?],
                numbers_of::<3>(items, "IJK"),
            ))
        });
        found.ok_or_else(|| self.no_result())
    }

    /// The position, mm, in the active coordinate system.
    ///
    /// # Errors
    /// As [`Session::ask`].
    pub fn position(&mut self) -> Result<[f64; 3], DeviceError> {
        let data = self.ask("Get(X(), Y(), Z())", SHORT)?;
        let found = data.iter().find_map(|items| {
            let one = |name| numbers_of::<1>(items, name).map(|[n]| n);
            Some([one("X")?, one("Y")?, one("Z")?])
        });
        found.ok_or_else(|| self.no_result())
    }

    /// Scans from `start` to `end`, mm, along a line on a surface with the outward `normal`, a point every `step_mm`.
    ///
    /// `order` says at which place of three numbers X, Y and Z stand: servers differ. Q is left out of the report. With each point comes the
    /// time at which its line arrived.
    ///
    /// # Errors
    /// As [`Session::ask`]; a line whose numbers are no whole number of points.
    pub fn scan_line(
        &mut self,
        start: [f64; 3],
        end: [f64; 3],
        normal: [f64; 3],
        step_mm: f64,
        order: [usize; 3],
        patience: Duration,
    ) -> Result<Vec<([f64; 3], Instant)>, DeviceError> {
        self.ask("OnScanReport(X(), Y(), Z())", SHORT)?;
        let numbers: Vec<String> = [start, end, normal]
            .iter()
            .flatten()
            .chain([&step_mm])
            .map(|n| decimal(*n))
            .collect();
        let scan = self.ask_whole(&format!("ScanOnLine({})", numbers.join(",")), patience)?;
        let mut points = Vec::new();
        for (items, at) in scan.data.iter().zip(&scan.arrived) {
            let numbers: Vec<f64> = items.iter().filter_map(number).collect();
            if numbers.len() != items.len() || !numbers.len().is_multiple_of(3) {
                return Err(self.decode(DecodeError::Field {
                    message: "ScanOnLine",
                    field: "count of numbers",
                    found: items.len() as u64,
                    allowed: "three for each point; another count is another scan report",
                }));
            }
            let placed = numbers.chunks_exact(3).map(|p| order.map(|place| p[place]));
            points.extend(placed.map(|point| (point, *at)));
        }
        Ok(points)
    }

    // ---- One command --------------------------------------------------------------------------------------------------

    fn transact(
        &mut self,
        tag: u32,
        command: &str,
        patience: Duration,
    ) -> Result<Pending, DeviceError> {
        let mut pending = Pending {
            tag,
            command: command.to_owned(),
            acked: false,
            data: Vec::new(),
            arrived: Vec::new(),
            report: None,
        };
        self.write(&format!("{} {command}\r\n", Tag::Command(tag)))?;
        let mut deadline = Instant::now() + ACK;
        let (mut moving, mut aborted) = (false, false);
        loop {
            while let Some(line) = self.lines.pop_front() {
                if self.take(line, &mut pending)? {
                    return self.ended(pending, aborted, patience);
                }
                if pending.acked && !moving {
                    moving = true;
                    deadline = Instant::now() + patience;
                }
            }
            let heard = self.receive(deadline, name_of(command), !pending.acked)?;
            if !heard && !aborted {
                // It moves on and does not end: what cannot be waited for must not go on.
                aborted = true;
                self.last_event = self.last_event % 9_000 + 1;
                self.write(&format!("{} AbortE()\r\n", Tag::Event(self.last_event)))?;
                deadline = Instant::now() + ABORT;
            } else if !heard {
                self.lost = true;
                return Err(self.overdue(patience));
            }
        }
    }

    fn ended(
        &mut self,
        pending: Pending,
        aborted: bool,
        patience: Duration,
    ) -> Result<Pending, DeviceError> {
        if let Some(report) = pending
            .report
            .as_ref()
            .filter(|report| report.severity >= 2)
        {
            self.failed = Some(report.clone());
        }
        match aborted {
            true => Err(self.overdue(patience)),
            false => Ok(pending),
        }
    }

    /// Takes one line; true when it ends the pending command.
    fn take(
        &mut self,
        line: Result<super::line::Response, DecodeError>,
        pending: &mut Pending,
    ) -> Result<bool, DeviceError> {
        let line = match line {
            Ok(line) => line,
            Err(source) => {
                self.rejected_lines += 1;
                return Err(self.decode(source));
            }
        };
        match (line.tag, line.kind) {
            (Tag::Command(tag), kind) if tag == pending.tag => match kind {
                Kind::Ack => pending.acked = true,
                Kind::Complete => return Ok(true),
                Kind::Data(items) => {
                    if pending.data.len() == DATA_MAX {
                        return Err(self.decode(DecodeError::TooLong {
                            claimed: DATA_MAX as u64 + 1,
                            limit: DATA_MAX,
                        }));
                    }
                    pending.data.push(items);
                    pending.arrived.push(self.link.received());
                }
                Kind::Error(report) => {
                    // An error may stand in place of the acknowledgement, and the end still follows.
                    pending.acked = true;
                    pending.report.get_or_insert(report);
                }
            },
            // The server could not read the tag itself: nothing else will come of this command.
            (Tag::Event(0), Kind::Error(report)) if report.severity >= 2 => {
                self.failed = Some(report.clone());
                return Err(self.refused(&pending.command, &report));
            }
            (Tag::Event(tag), kind) => self.event(tag, kind),
            // What is left of a command before.
            (Tag::Command(_), _) => {}
        }
        Ok(false)
    }

    fn event(&mut self, tag: u32, kind: Kind) {
        if self.events.len() == EVENTS {
            self.events.pop_front();
            self.dropped_events += 1;
        }
        self.events.push_back(Event { tag, kind });
    }

    /// Reads once. False when the deadline passed; an error instead where that means silence.
    fn receive(
        &mut self,
        deadline: Instant,
        command: &'static str,
        silence_is_error: bool,
    ) -> Result<bool, DeviceError> {
        let mut chunk = [0; 16 << 10];
        let n = self
            .link
            .read(&mut chunk, deadline)
            .map_err(|source| self.gone(source))?;
        if n == 0 {
            if !silence_is_error {
                return Ok(false);
            }
            self.lost = true;
            let port = self.port.clone();
            let deadline_s = ACK.as_secs_f64();
            return Err(match self.decoder.held_bytes() as u64 {
                0 => DeviceError::Silent { port, deadline_s },
                bytes => DeviceError::Babble {
                    port,
                    bytes,
                    command,
                    deadline_s,
                },
            });
        }
        let lines = &mut self.lines;
        self.decoder
            .take(&chunk[..n], |line| lines.push_back(line.and_then(response)));
        // Outside a command only events can come.
        let events = self.lines.iter().all(|line| {
            matches!(line, Ok(response) if matches!(response.tag, Tag::Event(tag) if tag != 0))
        });
        if events {
            while let Some(Ok(line)) = self.lines.pop_front() {
                if let Tag::Event(tag) = line.tag {
                    self.event(tag, line.kind);
                }
            }
        }
        Ok(true)
    }

    fn write(&mut self, line: &str) -> Result<(), DeviceError> {
        self.link
            .write(line.as_bytes(), Instant::now() + ACK)
            .map_err(|source| self.gone(source))
    }

    // ---- Errors -------------------------------------------------------------------------------------------------------

    fn note(&mut self, command: &str, report: Report) -> DeviceError {
        let error = self.refused(command, &report);
        if report.severity >= 2 {
            self.failed = Some(report);
        }
        error
    }

    fn refused(&self, command: &str, report: &Report) -> DeviceError {
        DeviceError::Refused {
            port: self.port.clone(),
            command: name_of(command).to_owned(),
            reason: format!(
                "error {:04}, severity {}, {:?} ({:?})",
                report.number, report.severity, report.text, report.cause
            ),
            remedy: remedy(report),
        }
    }

    fn overdue(&self, patience: Duration) -> DeviceError {
        DeviceError::Overdue {
            port: self.port.clone(),
            deadline_s: patience.as_secs_f64(),
        }
    }

    fn no_result(&self) -> DeviceError {
        DeviceError::NoResult {
            port: self.port.clone(),
        }
    }

    fn decode(&self, source: DecodeError) -> DeviceError {
        DeviceError::Decode {
            port: self.port.clone(),
            source,
        }
    }

    fn gone(&self, source: LinkError) -> DeviceError {
        DeviceError::Link {
            port: self.port.clone(),
            source,
        }
    }
}

impl Drop for Session {
    /// Ends the session, so that the server listens to the next client; what it answers is not waited for long.
    fn drop(&mut self) {
        self.last_tag = self.last_tag % 99_000 + 1;
        let line = format!("{} EndSession()\r\n", Tag::Command(self.last_tag));
        if self.write(&line).is_ok() {
            let deadline = Instant::now() + Duration::from_secs(1);
            while self
                .receive(deadline, "EndSession", false)
                .is_ok_and(|heard| heard)
            {
                let ended = |line: &Result<super::line::Response, DecodeError>| matches!(line, Ok(line) if line.kind == Kind::Complete && line.tag == Tag::Command(self.last_tag));
                if self.lines.iter().any(ended) {
                    return;
                }
                self.lines.clear();
            }
        }
    }
}

fn ends(kind: &Kind) -> bool {
    matches!(kind, Kind::Complete | Kind::Error(_))
}

/// A number as the specification allows: decimal, at most 16 digits.
fn decimal(number: f64) -> String {
    format!("{number:.7}")
}

/// The method of a command.
fn name_of(command: &str) -> &'static str {
    const NAMES: [&str; 16] = [
        "StartSession",
        "EndSession",
        "ClearAllErrors",
        "GoTo",
        "PtMeas",
        "Get",
        "SetProp",
        "IsHomed",
        "Home",
        "ScanOnLine",
        "OnScanReport",
        "OnPtMeasReport",
        "OnMoveReportE",
        "SetCoordSystem",
        "ChangeTool",
        "StopDaemon",
    ];
    let method = command.split('(').next().unwrap_or_default();
    NAMES
        .into_iter()
        .find(|name| *name == method)
        .unwrap_or("a command")
}

fn remedy(report: &Report) -> &'static str {
    match report.number {
        8 | 508 => "end the other client's session, then reopen it",
        514 => "reopen it",
        1003 | 1006 => "check that the part lies there and the probe is sound",
        1008 | 2500..=2502 => "check the points against the machine's volume",
        1501..=1503 | 2000 => "load and qualify the tool, then reopen it",
        500 => "release the emergency stop, then reopen it",
        _ => "look at the server's console; reopen it when the machine is ready",
    }
}

//! Touch probes on a GRBL-style controller, over a serial port or a network bridge to one.
//!
//! Manual: Grbl 1.1, *Grbl Interface Basics*; grblHAL keeps to it. Quirks: opening the port may reset the board through DTR;
//! probe results come as `[PRB:...]` before `ok`, in machine axes and in inches where `$13=1`; status reports may fall in
//! between and damage a line, so a damaged result is asked for again with `$#`; positions in G-code are work positions, so
//! the work offset is read at opening and taken off; after an alarm everything is locked until `$X` or `$H`.
//!
//! What counts is the position that the controller latched at contact, never a position asked for afterwards.
//!
//! # Configuration
//!
//! Only the link is needed. Places are in machine axes, mm.
//!
//! ```toml
//! port = "/dev/ttyUSB0"         # or one of the next three in its place
//! # usb_serial = "A50285BI"     # serial number of the USB converter: the same after plugging in again
//! # usb_id = "1a86:7523"        # vendor and product of a converter without one
//! # address = "10.0.0.6:23"     # TCP, as of a network bridge
//! baud = 115200                 # serial ports only
//! build_info = "probe 7"        # text that `$I=` wrote into the controller: another one is refused
//! feed_mm_min = 100.0           # of probing moves
//! rapid = true                  # to the start with G0; otherwise with G1 at the feed above
//! safe_z_mm = 150.0             # the way to a start goes up to this, across, and down; straight where not given
//! retract_mm = 2.0              # back from the contact, never behind the start
//! limits_min_mm = [0.0, 0.0, -80.0] # box that starts and targets must lie in
//! limits_max_mm = [300.0, 200.0, 160.0]
//! unlock_on_open = false        # send $X at opening, where an alarm has locked the machine
//! ```

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::capture::Touch;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Presence, Probe, Setup, same,
};
use crate::error::{DeviceError, LinkError};
use crate::link::{Link, Links, Target};
use crate::settings::Keys;

mod line;

pub use line::{Assembler, Line, Probe as ProbeLine, line};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "grbl-probe",
    summary: "touch probes on a GRBL or grblHAL controller: serial port or TCP",
    configure,
};

const BAUD: u32 = 115_200;
/// How long a board's boot loader and start may take after the port was opened.
const BOOT: Duration = Duration::from_millis(2500);
/// How long one answer is waited for that needs no motion.
const REPLY: Duration = Duration::from_secs(1);
/// How often a question is sent before the controller counts as silent.
const TRIES: u32 = 3;
/// How long lines that follow an alarm are waited for: a result and `ok`, at 9600 Bd.
const SETTLE: Duration = Duration::from_millis(150);
/// Longest time a retraction may take.
const RETRACT: Duration = Duration::from_secs(30);
/// How far a contact may lie off the way that was commanded, mm: a step of a coarse machine, with its report in inches.
const OFF_WAY_MM: f64 = 0.1;
const MM_PER_INCH: f64 = 25.4;

/// Realtime characters, taken at once although a command runs.
const FEED_HOLD: &[u8] = b"!";
const SOFT_RESET: &[u8] = b"\x18";

// ---- Settings ---------------------------------------------------------------------------------------------------------

/// A checked table of this driver.
#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    /// The text that `$I=` wrote into the controller, which it must have.
    build_info: Option<String>,
    motion: Motion,
    unlock_on_open: bool,
}

/// How the machine is moved.
#[derive(Debug, Clone, Copy)]
struct Motion {
    feed_mm_min: f64,
    /// To the start of a touch with G0; otherwise with G1 at the probing feed.
    rapid: bool,
    /// Machine z above everything: the way to a start goes up to it, across, and down.
    safe_z_mm: Option<f64>,
    /// How far the tip goes back after contact.
    retract_mm: f64,
    /// Least and most of each axis that a touch may ask for.
    limits_mm: Option<[[f64; 3]; 2]>,
}

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let target = keys.target(BAUD);
    let build_info = keys.text("build_info");
    let limits_mm = limits(&mut keys);
    let motion = Motion {
        feed_mm_min: keys.number("feed_mm_min", 1.0..=5000.0).unwrap_or(100.0),
        rapid: keys.flag("rapid").unwrap_or(true),
        safe_z_mm: safe_z(&mut keys, limits_mm),
        retract_mm: keys.number("retract_mm", 0.0..=100.0).unwrap_or(2.0),
        limits_mm,
    };
    let unlock_on_open = keys.flag("unlock_on_open").unwrap_or(false);
    keys.finish()?;
    let Some(target) = target else {
        // Without a mistake there is a target: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        target,
        build_info,
        motion,
        unlock_on_open,
    }))
}

fn safe_z(keys: &mut Keys, limits_mm: Option<[[f64; 3]; 2]>) -> Option<f64> {
    let z_mm = keys.number("safe_z_mm", -1e4..=1e4)?;
    if let Some([least, most]) = limits_mm
        && !(least[2]..=most[2]).contains(&z_mm)
    {
        let expected = format!("{} to {}, the limits of z", least[2], most[2]);
        keys.wrong("safe_z_mm", z_mm, &expected);
    }
    Some(z_mm)
}

fn limits(keys: &mut Keys) -> Option<[[f64; 3]; 2]> {
    let least = keys.vector("limits_min_mm");
    let most = keys.vector("limits_max_mm");
    match (least, most) {
        (Some(least), Some(most)) => {
            if (0..3).any(|axis| least[axis] >= most[axis]) {
                let found = format!("{most:?}");
                keys.wrong(
                    "limits_max_mm",
                    found,
                    "more than limits_min_mm on every axis",
                );
            }
            Some([least, most])
        }
        (None, None) => None,
        (Some(_), None) => {
            keys.wrong("limits_min_mm", "given", "limits_max_mm beside it");
            None
        }
        (None, Some(_)) => {
            keys.wrong("limits_max_mm", "given", "limits_min_mm beside it");
            None
        }
    }
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let port = self.target.to_string();
        let link = links
            .open(&self.target)
            .map_err(|source| DeviceError::Link {
                port: port.clone(),
                source,
            })?;
        let mut controller = Controller {
            port,
            link,
            assembler: Assembler::default(),
            heard_bytes: 0,
            moving: false,
        };
        controller.reset()?;
        let identity = controller.identify(self.build_info.as_deref())?;
        let frame = controller.prepare(self.unlock_on_open)?;
        Ok(Instrument::Probe(Box::new(GrblProbe {
            controller,
            identity,
            frame,
            motion: self.motion,
        })))
    }
}

// ---- Controller: commands and lines -----------------------------------------------------------------------------------

/// The controller at the other end: one command at a time, each answered.
struct Controller {
    port: String,
    link: Arc<dyn Link>,
    assembler: Assembler,
    heard_bytes: u64,
    /// A motion was commanded and its end not seen.
    moving: bool,
}

/// How a command was answered.
enum Outcome {
    Done,
    Error(u32),
    Alarm(u32),
    /// Nothing final came in time.
    Late,
}

/// An event within the answer to a command: a line, or one that could not be read.
type Event<'a> = Result<Line<'a>, crate::error::DecodeError>;

impl Controller {
    fn link_error(&self, source: LinkError) -> DeviceError {
        DeviceError::Link {
            port: self.port.clone(),
            source,
        }
    }

    fn write(&self, bytes: &[u8]) -> Result<(), DeviceError> {
        self.link
            .write(bytes, Instant::now() + REPLY)
            .map_err(|source| self.link_error(source))
    }

    /// Reads lines until `deadline`, or until `each` returns a value.
    fn read<T>(
        &mut self,
        deadline: Instant,
        mut each: impl FnMut(Event<'_>) -> Option<T>,
    ) -> Result<Option<T>, DeviceError> {
        let mut buffer = [0; 1024];
        let mut answer = None;
        loop {
            let n = self
                .link
                .read(&mut buffer, deadline)
                .map_err(|source| self.link_error(source))?;
            self.heard_bytes += n as u64;
            self.assembler.take(&buffer[..n], |line| {
                if let Err(error) = &line {
                    tracing::debug!(%error, "damaged line");
                }
                if answer.is_none() {
                    answer = each(line);
                }
            });
            // A line behind the one that ended the answer belongs to nothing that was asked.
            if answer.is_some() || n == 0 && Instant::now() >= deadline {
                return Ok(answer);
            }
            // One that never pauses must not hold us here.
            if Instant::now() >= deadline + REPLY {
                return Ok(None);
            }
        }
    }

    /// Sends one line and reads what comes until it is answered. What lay there before answers nothing.
    fn command(
        &mut self,
        text: &str,
        deadline: Instant,
        mut each: impl FnMut(&Event<'_>),
    ) -> Result<Outcome, DeviceError> {
        self.drain()?;
        self.write(format!("{text}\n").as_bytes())?;
        let outcome = self.read(deadline, |line| {
            each(&line);
            match line {
                Ok(Line::Ok) => Some(Ok(Outcome::Done)),
                Ok(Line::Error(code)) => Some(Ok(Outcome::Error(code))),
                Ok(Line::Alarm(code)) => Some(Ok(Outcome::Alarm(code))),
                Ok(Line::Banner(_)) => Some(Err(())),
                _ => None,
            }
        })?;
        match outcome {
            Some(Ok(outcome)) => Ok(outcome),
            Some(Err(())) => Err(DeviceError::ControllerReset {
                port: self.port.clone(),
            }),
            None => Ok(Outcome::Late),
        }
    }

    /// Sends one line that needs no motion, again where it is not answered.
    fn ask(
        &mut self,
        text: &'static str,
        mut each: impl FnMut(&Event<'_>),
    ) -> Result<(), DeviceError> {
        let heard_before = self.heard_bytes;
        for attempt in 0..TRIES {
            match self.command(text, Instant::now() + REPLY, &mut each)? {
                Outcome::Late => {}
                outcome => {
                    if attempt > 0 {
                        // The answer to the attempt before may still come, and must not answer the next command.
                        self.settle()?;
                    }
                    return self.checked(text, outcome);
                }
            }
        }
        let deadline_s = (REPLY * TRIES).as_secs_f64();
        let port = self.port.clone();
        Err(match self.heard_bytes - heard_before {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: text,
                deadline_s,
            },
        })
    }

    /// The error that an outcome means, but for [`Outcome::Late`], which the caller knows more of.
    fn checked(&self, command: &str, outcome: Outcome) -> Result<(), DeviceError> {
        let port = self.port.clone();
        match outcome {
            Outcome::Done | Outcome::Late => Ok(()),
            Outcome::Error(code) => Err(DeviceError::Refused {
                port,
                command: command.into(),
                reason: format!("error {code}, {}", line::error(code)),
                remedy: line::error_remedy(code),
            }),
            Outcome::Alarm(code) => {
                let (meaning, remedy) = line::alarm(code);
                Err(DeviceError::Alarm {
                    port,
                    code,
                    meaning,
                    remedy,
                })
            }
        }
    }

    /// Ends whatever ran before and waits for the start-up message; a controller that shows none may be fine.
    fn reset(&mut self) -> Result<(), DeviceError> {
        // What lies there may be the message of an earlier start.
        self.read(Instant::now(), |_| None::<()>)?;
        self.write(SOFT_RESET)?;
        let banner = self.read(Instant::now() + BOOT, |line| {
            matches!(line, Ok(Line::Banner(_))).then_some(())
        })?;
        if banner.is_none() {
            tracing::info!(port = self.port, "no start-up message; going on without");
        }
        // Start-up lines may follow, and a second message where opening the port had reset the board already.
        self.settle()
    }

    /// Takes in what comes within [`SETTLE`].
    fn settle(&mut self) -> Result<(), DeviceError> {
        self.read(Instant::now() + SETTLE, |_| None::<()>)?;
        Ok(())
    }

    /// Takes in what lies there unasked.
    fn drain(&mut self) -> Result<(), DeviceError> {
        let reset = self.read(Instant::now(), |line| {
            matches!(line, Ok(Line::Banner(_))).then_some(())
        })?;
        match reset {
            None => Ok(()),
            Some(()) => Err(DeviceError::ControllerReset {
                port: self.port.clone(),
            }),
        }
    }

    fn identify(&mut self, expected: Option<&str>) -> Result<Identity, DeviceError> {
        let mut found = None;
        self.ask("$I", |line| {
            if let Ok(Line::Version(version, owner)) = line {
                found = Some(((*version).to_owned(), (*owner).to_owned()));
            }
        })?;
        let (firmware, owner) = found.unwrap_or_default();
        if let Some(expected) = expected.filter(|text| *text != owner) {
            return Err(DeviceError::WrongDevice {
                port: self.port.clone(),
                found: owner,
                expected: expected.into(),
            });
        }
        Ok(Identity {
            vendor: "Grbl".into(),
            model: "touch probe".into(),
            serial: owner,
            firmware,
        })
    }

    /// Sets units and coordinates, and learns in which unit and from where the controller counts.
    fn prepare(&mut self, unlock: bool) -> Result<Frame, DeviceError> {
        if unlock {
            self.ask("$X", |_| {})?;
        }
        let mut inches = false;
        self.ask("$$", |line| {
            if let Ok(Line::Setting(13, value)) = line {
                inches = *value == "1";
            }
        })?;
        self.ask("G21 G90 G94", |_| {})?;
        let mut system = "G54".to_owned();
        self.ask("$G", |line| {
            if let Ok(Line::ParserState(words)) = line {
                let is_system =
                    |word: &&str| matches!(*word, "G54" | "G55" | "G56" | "G57" | "G58" | "G59");
                system = words.split(' ').find(is_system).unwrap_or("G54").into();
            }
        })?;
        let mut work_offset = [0.0; 3];
        self.ask("$#", |line| match line {
            Ok(Line::Offset(name, offset)) if *name == system || *name == "G92" => {
                for axis in 0..3 {
                    work_offset[axis] += offset[axis];
                }
            }
            Ok(Line::ToolLength(length)) => work_offset[2] += length,
            _ => {}
        })?;
        let mm_per_unit = if inches { MM_PER_INCH } else { 1.0 };
        Ok(Frame {
            mm_per_unit,
            work_offset_mm: work_offset.map(|x| x * mm_per_unit),
        })
    }
}

/// How the controller's numbers become mm in machine axes, and back.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Frame {
    /// mm per unit of its reports.
    mm_per_unit: f64,
    /// Machine position minus work position.
    work_offset_mm: [f64; 3],
}

impl Frame {
    /// G-code words of a place in machine axes.
    fn words(&self, machine_mm: [f64; 3]) -> String {
        let [x, y, z] = self.work_mm(machine_mm);
        format!("X{x:.4} Y{y:.4} Z{z:.4}")
    }

    fn work_mm(&self, machine_mm: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|axis| machine_mm[axis] - self.work_offset_mm[axis])
    }

    fn machine_mm(&self, reported: [f64; 3]) -> [f64; 3] {
        reported.map(|x| x * self.mm_per_unit)
    }
}

// ---- Probe ------------------------------------------------------------------------------------------------------------

struct GrblProbe {
    controller: Controller,
    identity: Identity,
    frame: Frame,
    motion: Motion,
}

/// By when something must have ended.
#[derive(Debug, Clone, Copy)]
struct Limit {
    began: Instant,
    timeout: Duration,
}

impl Limit {
    fn from_now(timeout: Duration) -> Limit {
        Limit {
            began: Instant::now(),
            timeout,
        }
    }
}

/// One touch as asked for.
#[derive(Debug, Clone, Copy)]
struct Way {
    start_mm: [f64; 3],
    target_mm: [f64; 3],
    direction: [f64; 3],
    length_mm: f64,
}

impl GrblProbe {
    /// The way, when it has a direction and stays in the box.
    fn way(&self, start_mm: [f64; 3], target_mm: [f64; 3]) -> Result<Way, DeviceError> {
        let refuse = |asked_mm, allowed: String| DeviceError::Move {
            port: self.controller.port.clone(),
            asked_mm,
            allowed,
        };
        for asked in [start_mm, target_mm] {
            if !asked.iter().all(|x| x.is_finite()) {
                return Err(refuse(asked, "finite numbers".into()));
            }
            if let Some([least, most]) = self.motion.limits_mm
                && (0..3).any(|axis| !(least[axis]..=most[axis]).contains(&asked[axis]))
            {
                return Err(refuse(asked, format!("{least:?} to {most:?} mm")));
            }
        }
        let way = [0, 1, 2].map(|axis| target_mm[axis] - start_mm[axis]);
        let length_mm = way.iter().map(|x| x * x).sum::<f64>().sqrt();
        if length_mm < OFF_WAY_MM {
            let allowed = format!("{OFF_WAY_MM} mm or more from the start");
            return Err(refuse(target_mm, allowed));
        }
        Ok(Way {
            start_mm,
            target_mm,
            direction: way.map(|x| x / length_mm),
            length_mm,
        })
    }

    /// Sends a motion; where it does not end in time the machine is held.
    fn motion(
        &mut self,
        text: &str,
        limit: Limit,
        each: impl FnMut(&Event<'_>),
    ) -> Result<Outcome, DeviceError> {
        self.controller.moving = true;
        let deadline = limit.began + limit.timeout;
        match self.controller.command(text, deadline, each)? {
            Outcome::Late => {
                self.controller.write(FEED_HOLD)?;
                Err(DeviceError::Overdue {
                    port: self.controller.port.clone(),
                    deadline_s: limit.timeout.as_secs_f64(),
                })
            }
            outcome => {
                self.controller.moving = false;
                if matches!(outcome, Outcome::Alarm(_)) {
                    self.controller.settle()?;
                }
                Ok(outcome)
            }
        }
    }

    /// Moves towards the target until contact: the position that the controller latched.
    fn probe(&mut self, way: &Way, limit: Limit) -> Result<[f64; 3], DeviceError> {
        let words = self.frame.words(way.target_mm);
        let text = format!("G38.2 {words} F{:.1}", self.motion.feed_mm_min);
        let mut latched = None;
        let outcome = self.motion(&text, limit, |line| match line {
            Ok(Line::Probe(probe)) => latched = Some(*probe),
            // A line was damaged: it may have been the result.
            Err(_) => latched = None,
            _ => {}
        })?;
        match outcome {
            Outcome::Alarm(5) => return Err(self.no_contact(way)),
            other => self.controller.checked("G38.2", other)?,
        }
        if latched.is_none() {
            self.controller.ask("$#", |line| {
                if let Ok(Line::Probe(probe)) = line {
                    latched = Some(*probe);
                }
            })?;
        }
        match latched {
            Some(probe) if probe.contact => self.on_way(way, probe.position),
            Some(_) => Err(self.no_contact(way)),
            None => Err(DeviceError::NoResult {
                port: self.controller.port.clone(),
            }),
        }
    }

    fn no_contact(&self, way: &Way) -> DeviceError {
        DeviceError::NoContact {
            port: self.controller.port.clone(),
            start_mm: way.start_mm,
            target_mm: way.target_mm,
        }
    }

    /// The contact in mm, when it lies on the way that was commanded; a result of another move does not.
    fn on_way(&self, way: &Way, reported: [f64; 3]) -> Result<[f64; 3], DeviceError> {
        let contact_mm = self.frame.machine_mm(reported);
        let from_start = [0, 1, 2].map(|axis| contact_mm[axis] - way.start_mm[axis]);
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let along = dot(from_start, way.direction).clamp(0.0, way.length_mm);
        let across = [0, 1, 2].map(|axis| from_start[axis] - along * way.direction[axis]);
        let off_mm = dot(across, across).sqrt();
        if off_mm > OFF_WAY_MM {
            return Err(DeviceError::OffWay {
                port: self.controller.port.clone(),
                contact_mm,
                off_mm,
            });
        }
        Ok(contact_mm)
    }

    /// Moves back from the contact, at most to the start.
    fn retract(&mut self, way: &Way, contact_mm: [f64; 3]) -> Result<(), DeviceError> {
        let from_start: f64 = (0..3)
            .map(|axis| (contact_mm[axis] - way.start_mm[axis]) * way.direction[axis])
            .sum();
        let back_mm = self.motion.retract_mm.min(from_start.max(0.0));
        if back_mm == 0.0 {
            return Ok(());
        }
        let to = [0, 1, 2].map(|axis| contact_mm[axis] - back_mm * way.direction[axis]);
        let text = self.travel(&self.frame.words(to));
        let outcome = self.motion(&text, Limit::from_now(RETRACT), |_| {})?;
        self.controller.checked(&text[..2], outcome)
    }

    /// Goes to the start: straight, or over the safe height where one is set.
    fn go_to(&mut self, start_mm: [f64; 3], limit: Limit) -> Result<(), DeviceError> {
        let [x, y, z] = self.frame.work_mm(start_mm);
        let legs = match self.motion.safe_z_mm {
            None => vec![self.frame.words(start_mm)],
            Some(safe_z_mm) => {
                let high_mm = safe_z_mm.max(start_mm[2]);
                let high = self.frame.work_mm([0.0, 0.0, high_mm])[2];
                let up = format!("Z{high:.4}");
                vec![up, format!("X{x:.4} Y{y:.4}"), format!("Z{z:.4}")]
            }
        };
        for leg in legs {
            let text = self.travel(&leg);
            let outcome = self.motion(&text, limit, |_| {})?;
            self.controller.checked(&text[..2], outcome)?;
        }
        Ok(())
    }

    fn travel(&self, words: &str) -> String {
        if self.motion.rapid {
            format!("G0 {words}")
        } else {
            format!("G1 {words} F{:.1}", self.motion.feed_mm_min)
        }
    }
}

impl Probe for GrblProbe {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Ends `retract_mm` back from the contact, but never behind the start.
    fn touch(
        &mut self,
        start_mm: [f64; 3],
        target_mm: [f64; 3],
        timeout: Duration,
    ) -> Result<Touch, DeviceError> {
        let way = self.way(start_mm, target_mm)?;
        if self.controller.moving {
            return Err(DeviceError::OutOfOrder {
                port: self.controller.port.clone(),
                action: "touch",
                needed: "the machine to be looked at and reopened, since a move did not end",
            });
        }
        let limit = Limit::from_now(timeout);
        self.go_to(start_mm, limit)?;
        let tip_centre_mm = self.probe(&way, limit)?;
        let host_time = Instant::now();
        self.retract(&way, tip_centre_mm)?;
        Ok(Touch {
            tip_centre_mm,
            direction: way.direction,
            host_time,
        })
    }

    fn scan_line(
        &mut self,
        _: [f64; 3],
        _: [f64; 3],
        _: [f64; 3],
        _: f64,
        _: Duration,
    ) -> Result<Vec<Touch>, DeviceError> {
        Err(DeviceError::Lacks {
            port: self.controller.port.clone(),
            capability: "scanning along a line",
            key: "driver",
        })
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        let now = self.controller.identify(None)?;
        same(&self.controller.port, &self.identity.serial, &now.serial)
    }
}

impl Drop for GrblProbe {
    /// Holds a move whose end was not seen.
    fn drop(&mut self) {
        if self.controller.moving {
            // There is nobody left to tell.
            let _ = self.controller.write(FEED_HOLD);
        }
    }
}

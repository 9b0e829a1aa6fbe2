//! The contract of a driver: find, configure and open are three acts; an open instrument is a profiler, a probe or a robot.

use std::fmt;
use std::time::{Duration, Instant};

use crate::capture::{Pose, Profile, Touch};

/// One family of instruments, before any of them is opened.
pub struct Driver {
    /// The word after `driver =` in a cell's configuration; equals the file name, with `-` for `_`.
    pub name: &'static str,
    /// What it is, for people.
    pub summary: &'static str,
    /// Checks one `[[device]]` table without its `name` and `driver`. No effects; all mistakes at once.
    pub configure: fn(toml::Table) -> Configured,
}

/// A checked configuration, or everything wrong with it.
pub type Configured = Result<Box<dyn Setup>, Vec<Mistake>>;

/// Something wrong in a configuration table.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key}: {found}, expected {expected}")]
pub struct Mistake {
    /// The key, or the keys joined by dots.
    pub key: String,
    /// What was seen.
    pub found: String,
    /// What is allowed.
    pub expected: String,
}

/// A thing that one device must have for itself, so that clashes show before anything opens.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Claim {
    /// A serial port, by path or by the serial number of its USB converter.
    Port(String),
    /// A TCP address.
    Address(String),
}

impl fmt::Display for Claim {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Claim::Port(port) => write!(f, "port {port}"),
            Claim::Address(address) => write!(f, "address {address}"),
        }
    }
}

/// A checked device configuration, ready to open.
pub trait Setup: Send + Sync + fmt::Debug {
    /// What the device must have for itself.
    fn claims(&self) -> Vec<Claim>;
    /// Opens the link, checks the identity, leaves the laser off and the stream stopped.
    ///
    /// # Errors
    /// Whatever keeps the device from answering as the one that was configured.
    fn open(&self, links: &dyn crate::link::Links)
    -> Result<Instrument, crate::error::DeviceError>;
}

/// An open instrument. Dropping it stops the stream and switches the laser off.
pub enum Instrument {
    /// Streams profiles.
    Profiler(Box<dyn Profiler>),
    /// Touches where it is told.
    Probe(Box<dyn Probe>),
    /// Says where its tool is; nothing here moves it.
    Robot(Box<dyn Robot>),
}

impl Instrument {
    /// Who it says it is.
    pub fn identity(&self) -> &Identity {
        match self {
            Instrument::Profiler(profiler) => profiler.identity(),
            Instrument::Probe(probe) => probe.identity(),
            Instrument::Robot(robot) => robot.identity(),
        }
    }

    /// Asks it whether it is there, while it stands still: [`Profiler::check`].
    ///
    /// # Errors
    /// As [`Profiler::check`].
    pub fn check(&mut self) -> Result<Presence, crate::error::DeviceError> {
        match self {
            Instrument::Profiler(profiler) => profiler.check(),
            Instrument::Probe(probe) => probe.check(),
            Instrument::Robot(robot) => robot.check(),
        }
    }

    /// The word for its kind.
    pub fn kind(&self) -> &'static str {
        match self {
            Instrument::Profiler(_) => "profiler",
            Instrument::Probe(_) => "probe",
            Instrument::Robot(_) => "robot",
        }
    }
}

/// What a check found out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Presence {
    /// It answered, as itself.
    Answered,
    /// Its protocol has no question for this: only opening it anew tells.
    Unknown,
}

/// Who an instrument says it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Maker, as read from the device.
    pub vendor: String,
    /// Model, as read.
    pub model: String,
    /// Serial number, as read; empty where the device has none.
    pub serial: String,
    /// Firmware, as read.
    pub firmware: String,
}

/// The answer of a check in which a device named itself: the same as before, or an error.
pub(crate) fn same(
    port: &str,
    before: &str,
    now: &str,
) -> Result<Presence, crate::error::DeviceError> {
    match before == now {
        true => Ok(Presence::Answered),
        false => Err(crate::error::DeviceError::WrongDevice {
            port: port.to_owned(),
            found: now.to_owned(),
            expected: before.to_owned(),
        }),
    }
}

/// The error of a check while a run is on.
pub(crate) fn checked_in_a_run(port: &str) -> crate::error::DeviceError {
    crate::error::DeviceError::OutOfOrder {
        port: port.to_owned(),
        action: "check",
        needed: "the run to be stopped: a device that streams is there",
    }
}

/// What was lost on the way, since the run started. Nothing is lost silently.
///
/// An instrument of single points counts its values here, whether or not several make one profile. One whose stream has no end
/// mark knows nothing of what was lost behind the last value that came.
///
/// After [`Profiler::stop`], `received + lost_on_link` is the number of profiles that the device sent. `rejected` and
/// `skipped_bytes` tell why some of them are missing, and are no further losses.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Losses {
    /// Profiles received whole.
    pub received: u64,
    /// Profiles missing by sequence number: lost on the link.
    pub lost_on_link: u64,
    /// Profiles the device dropped by its own count.
    pub dropped_by_device: u64,
    /// Frames or lines thrown away because a check failed.
    pub rejected: u64,
    /// Bytes thrown away in search of the next frame.
    pub skipped_bytes: u64,
}

/// An open line-laser profiler.
pub trait Profiler: Send {
    /// Who it says it is.
    fn identity(&self) -> &Identity;
    /// Starts a run: laser on, sequence from 0.
    ///
    /// # Errors
    /// When the device refuses or does not answer; the laser is then off.
    fn start(&mut self) -> Result<(), crate::error::DeviceError>;
    /// Waits for the next profile until `deadline`; `None` when it passed.
    ///
    /// A caller that stays away for longer than the driver says lets the run end, so that a laser does not stay on for nobody.
    ///
    /// # Errors
    /// When the device is gone or ended the run by itself, after the last profile that came; reopening is the caller's decision.
    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, crate::error::DeviceError>;
    /// Ends the run: laser off. Profiles still under way are returned, so that nothing sent is lost.
    ///
    /// # Errors
    /// When the device does not confirm; it then stops by its own keep-alive. Profiles that came are then left to
    /// [`Profiler::next`].
    fn stop(&mut self) -> Result<Vec<Profile>, crate::error::DeviceError>;
    /// What was lost since [`Profiler::start`].
    fn losses(&self) -> Losses;
    /// Asks an open device that stands still whether it is there, and the same as when it was opened: one question, without light,
    /// motion or a change of settings. Where the protocol has none, the answer is [`Presence::Unknown`].
    ///
    /// # Errors
    /// That it is gone, silent or another one: drop it and open anew. [`crate::error::DeviceError::OutOfOrder`] while a run is on, which
    /// tells by itself.
    fn check(&mut self) -> Result<Presence, crate::error::DeviceError> {
        Ok(Presence::Unknown)
    }
}

/// An open touch probe on a controller that moves it.
pub trait Probe: Send {
    /// Who it says it is.
    fn identity(&self) -> &Identity;
    /// Moves to `start_mm` without touching, then towards `target_mm` until contact. Machine axes, mm.
    ///
    /// # Errors
    /// No contact before `target_mm`, an alarm, or a device that is gone; the error says what to do.
    fn touch(
        &mut self,
        start_mm: [f64; 3],
        target_mm: [f64; 3],
        timeout: Duration,
    ) -> Result<Touch, crate::error::DeviceError>;
    /// Scans from `start_mm` to `end_mm` along a line on a surface with the outward `normal`, a point every `step_mm`, in the order of the
    /// scan. Machine axes, mm. Each point has the time at which it arrived: controllers tell none of their own.
    ///
    /// # Errors
    /// As [`Probe::touch`]; [`crate::error::DeviceError::Lacks`] where the probe cannot scan.
    fn scan_line(
        &mut self,
        start_mm: [f64; 3],
        end_mm: [f64; 3],
        normal: [f64; 3],
        step_mm: f64,
        timeout: Duration,
    ) -> Result<Vec<Touch>, crate::error::DeviceError>;
    /// As [`Profiler::check`].
    ///
    /// # Errors
    /// As [`Profiler::check`].
    fn check(&mut self) -> Result<Presence, crate::error::DeviceError> {
        Ok(Presence::Unknown)
    }
}

/// An open robot that carries a profiler: a stream of poses.
pub trait Robot: Send {
    /// Who it says it is.
    fn identity(&self) -> &Identity;
    /// Starts the stream. The robot's motion is its own program's business.
    ///
    /// # Errors
    /// When the robot refuses or does not answer.
    fn start(&mut self) -> Result<(), crate::error::DeviceError>;
    /// Waits for the next pose until `deadline`; `None` when it passed.
    ///
    /// # Errors
    /// When the robot is gone or its stream ended by itself.
    fn next(&mut self, deadline: Instant) -> Result<Option<Pose>, crate::error::DeviceError>;
    /// Ends the stream. Poses still under way are returned.
    ///
    /// # Errors
    /// When the robot does not confirm.
    fn stop(&mut self) -> Result<Vec<Pose>, crate::error::DeviceError>;
    /// Poses lost since [`Robot::start`], by the robot's own time.
    fn losses(&self) -> Losses;
    /// As [`Profiler::check`].
    ///
    /// # Errors
    /// As [`Profiler::check`].
    fn check(&mut self) -> Result<Presence, crate::error::DeviceError> {
        Ok(Presence::Unknown)
    }
}

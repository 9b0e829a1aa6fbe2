//! Profilers that speak the open-profile protocol, over a serial port, USB-CDC or TCP.
//!
//! Manual: `drivers/open-profile.md`, version 1. Quirks: none known; a device that was streaming for a host that died is
//! stopped before it is asked anything.
//!
//! # Configuration
//!
//! Only the link is needed; what is not given stays as the device has it.
//!
//! ```toml
//! port = "/dev/ttyACM0"         # or one of the next three in its place
//! # usb_serial = "A50285BI"     # serial number of the USB converter: the same after plugging in again
//! # usb_id = "0403:6001"        # vendor and product of a converter without one
//! # address = "10.0.0.5:7450"   # TCP
//! baud = 921600                 # serial ports only
//! serial_number = "P-0042"      # of the profiler: another one is refused
//! trigger = "encoder"           # "time", "encoder" or "external"
//! encoder_step = 20             # counts between profiles, by the encoder
//! columns = 640                 # points in a profile
//! rate_hz = 500.0               # profiles a second
//! exposure_us = 200.0           # of one profile
//! laser_power_percent = 100.0   # of full power
//! keepalive_s = 0.5             # 0.1 to 10; the laser of a host that died is off after three times this
//! ```

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::capture::Profile;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Presence, Profiler, Setup,
    checked_in_a_run, same,
};
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::{Link, Links, Target};
use crate::settings::Keys;

mod frame;
mod message;
mod stream;

pub use frame::{Decoder, Frame, PAYLOAD_MAX};
pub use message::{Command, Key, Message, RawProfile, Reply, Stopped, Value, message};

use message::status_text;
use stream::{Known, Shared};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "open-profile",
    summary: "line-laser profilers with the open-profile protocol: serial port, USB-CDC or TCP",
    configure,
};

/// How long one reply is waited for, section 3 of the document.
const REPLY: Duration = Duration::from_secs(1);
/// How often a command is sent before the device counts as silent.
const TRIES: u32 = 3;
/// Longest time that a device may take to send what it had queued when it was stopped.
const EMPTYING: Duration = Duration::from_secs(30);
/// Default of the document, section 1.
const BAUD: u32 = 921_600;
/// Half a second: the laser of a host that died is off after 1.5 s.
const KEEPALIVE_S: f64 = 0.5;
/// Part by which a device may round a rate, an exposure or a power.
const ROUNDING: f64 = 0.01;

// ---- Settings ---------------------------------------------------------------------------------------------------------

/// A checked table of this driver.
#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    /// The serial number that the device must have.
    serial_number: Option<String>,
    /// What is set at opening, in order.
    wanted: Vec<Wanted>,
    keepalive: Duration,
}

/// One setting of the device.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Wanted {
    name: &'static str,
    key: Key,
    /// In the device's unit.
    value: i64,
    /// The device may round it.
    rounds: bool,
}

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let target = keys.target(BAUD);
    let serial_number = keys.text("serial_number");
    let wanted = wanted(&mut keys);
    let keepalive_s = keys
        .number("keepalive_s", 0.1..=10.0)
        .unwrap_or(KEEPALIVE_S);
    keys.finish()?;
    let Some(target) = target else {
        // Without a mistake there is a target: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        target,
        serial_number,
        wanted,
        keepalive: Duration::from_secs_f64(keepalive_s),
    }))
}

/// Trigger words and their numbers, section 5 of the document.
const TRIGGERS: [(&str, i64); 3] = [("time", 0), ("encoder", 1), ("external", 2)];
const BY_ENCODER: i64 = 1;

/// What the table wants set. Mode before rate, because limits of the one may depend on the other.
fn wanted(keys: &mut Keys) -> Vec<Wanted> {
    let trigger = keys.choice("trigger", &TRIGGERS);
    let step = keys.integer("encoder_step", 1..=i64::from(i32::MAX));
    if step.is_some() && trigger != Some(BY_ENCODER) {
        keys.wrong("encoder_step", "given", "trigger = \"encoder\" beside it");
    }
    if step.is_none() && trigger == Some(BY_ENCODER) {
        keys.wrong("trigger", "\"encoder\"", "encoder_step beside it");
    }
    let columns = keys.integer("columns", 1..=32_768);
    let scaled = |value: Option<f64>, factor: f64| value.map(|v| (v * factor).round() as i64);
    let rate = scaled(keys.number("rate_hz", 0.001..=1e6), 1e3);
    let exposure = scaled(keys.number("exposure_us", 0.001..=1e7), 1e3);
    let power = scaled(keys.number("laser_power_percent", 0.0..=100.0), 10.0);
    [
        ("trigger", Key::Trigger, trigger, false),
        ("encoder_step", Key::EncoderStep, step, false),
        ("columns", Key::Columns, columns, false),
        ("rate_hz", Key::Rate, rate, true),
        ("exposure_us", Key::Exposure, exposure, true),
        ("laser_power_percent", Key::LaserPower, power, true),
    ]
    .into_iter()
    .filter_map(|(name, key, value, rounds)| {
        Some(Wanted {
            name,
            key,
            value: value?,
            rounds,
        })
    })
    .collect()
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
        let mut device = OpenProfile::new(port, link, self.keepalive)?;
        device.introduce(self.serial_number.as_deref())?;
        for wanted in &self.wanted {
            device.set(wanted)?;
        }
        Ok(Instrument::Profiler(Box::new(device)))
    }
}

// ---- Device -----------------------------------------------------------------------------------------------------------

/// An open device. Its thread reads; commands are written from the caller's.
struct OpenProfile {
    port: String,
    link: Arc<dyn Link>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    identity: Identity,
    keepalive: Duration,
    has_encoder: bool,
    last_id: u32,
    last_run: u32,
}

impl OpenProfile {
    fn new(
        port: String,
        link: Arc<dyn Link>,
        keepalive: Duration,
    ) -> Result<OpenProfile, DeviceError> {
        let shared = Arc::new(Shared::new());
        let thread = {
            let (link, shared) = (Arc::clone(&link), Arc::clone(&shared));
            std::thread::Builder::new()
                .name("open-profile".into())
                .spawn(move || stream::run(&link, &shared))
        };
        let thread = thread.map_err(|source| DeviceError::Link {
            port: port.clone(),
            source: LinkError::Io {
                action: "starting its thread",
                source,
            },
        })?;
        Ok(OpenProfile {
            port,
            link,
            shared,
            thread: Some(thread),
            identity: Identity {
                vendor: String::new(),
                model: String::new(),
                serial: String::new(),
                firmware: String::new(),
            },
            keepalive,
            has_encoder: false,
            last_id: 0,
            last_run: 0,
        })
    }

    /// Stops what a host before us may have left running, and learns who the device is.
    fn introduce(&mut self, expected_serial: Option<&str>) -> Result<(), DeviceError> {
        if let Reply::Stopped(stopped) = self.ask(Command::Stop)? {
            self.last_run = stopped.run;
        }
        let Reply::Identity(identity) = self.ask(Command::Hello)? else {
            return Err(self.unexpected(Command::Hello));
        };
        if let Some(expected) = expected_serial.filter(|serial| *serial != identity.serial) {
            return Err(DeviceError::WrongDevice {
                port: self.port.clone(),
                found: identity.serial,
                expected: expected.into(),
            });
        }
        self.has_encoder = identity.has_encoder();
        if !identity.has_laser_switch() {
            tracing::warn!(port = self.port, "this device cannot switch its laser off");
        }
        self.shared.lock().know(Known {
            boot: Some(identity.boot),
            has_encoder: self.has_encoder,
        });
        self.identity = Identity {
            vendor: identity.vendor,
            model: identity.model,
            serial: identity.serial,
            firmware: identity.firmware,
        };
        Ok(())
    }

    /// Sets one value and checks what the device really took.
    fn set(&mut self, wanted: &Wanted) -> Result<(), DeviceError> {
        let by_encoder = wanted.key == Key::Trigger && wanted.value == BY_ENCODER;
        if by_encoder && !self.has_encoder {
            return Err(DeviceError::Lacks {
                port: self.port.clone(),
                capability: "encoder",
                key: wanted.name,
            });
        }
        let command = Command::Set {
            key: wanted.key,
            value: wanted.value,
        };
        let Reply::Value(taken) = self.ask(command)? else {
            return Err(self.unexpected(command));
        };
        let off = (taken.value.saturating_sub(wanted.value)).unsigned_abs() as f64;
        let allowed = if wanted.rounds {
            wanted.value.unsigned_abs() as f64 * ROUNDING
        } else {
            0.0
        };
        let reason = match taken.status {
            0 if taken.key == wanted.key as u16 && off <= allowed => return Ok(()),
            0 => "it rounds too far",
            status => status_text(status),
        };
        Err(DeviceError::Setting {
            port: self.port.clone(),
            key: wanted.name,
            wanted: wanted.value,
            reason,
            actual: taken.value,
            minimum: taken.minimum,
            maximum: taken.maximum,
        })
    }

    /// Sends a command until it is answered, and returns the answer; REFUSED is an error.
    fn ask(&mut self, command: Command) -> Result<Reply, DeviceError> {
        let heard_before = self.shared.lock().heard_bytes;
        let first = self.last_id + 1;
        let began = Instant::now();
        for _ in 0..TRIES {
            self.last_id += 1;
            let frame = command.encode(self.last_id);
            self.link
                .write(&frame, Instant::now() + REPLY)
                .map_err(|source| DeviceError::Link {
                    port: self.port.clone(),
                    source,
                })?;
            if let Some(reply) = self.reply(first, command, began)? {
                return Ok(reply);
            }
        }
        let deadline_s = began.elapsed().as_secs_f64().round();
        let port = self.port.clone();
        Err(match self.shared.lock().heard_bytes - heard_before {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: command.name(),
                deadline_s,
            },
        })
    }

    /// Waits for the reply to one of the ids since `first`. STOP waits on while the device still sends profiles of the run.
    fn reply(
        &self,
        first: u32,
        command: Command,
        began: Instant,
    ) -> Result<Option<Reply>, DeviceError> {
        let sent = Instant::now();
        let mut inbox = self.shared.lock();
        loop {
            if let Some((_, reply)) = take_reply(&mut inbox.replies, first, self.last_id) {
                return self.accepted(command, reply).map(Some);
            }
            if let Some(over) = &mut inbox.over {
                return Err(over.error(&self.port));
            }
            let emptying = command == Command::Stop && began.elapsed() < EMPTYING;
            let since = match &inbox.run {
                Some(_) if emptying => inbox.heard.max(sent),
                _ => sent,
            };
            let deadline = since + REPLY;
            if Instant::now() >= deadline {
                return Ok(None);
            }
            inbox = self.shared.wait(inbox, deadline);
        }
    }

    fn accepted(&self, command: Command, reply: Reply) -> Result<Reply, DeviceError> {
        let Reply::Refused { status, text } = reply else {
            return Ok(reply);
        };
        let reason = match text.as_str() {
            "" => status_text(status).to_owned(),
            text => format!("{}, {text:?}", status_text(status)),
        };
        Err(DeviceError::Refused {
            port: self.port.clone(),
            command: command.name().into(),
            reason,
            remedy: status_remedy(status),
        })
    }

    /// The error for a reply of another kind than the command's.
    fn unexpected(&self, command: Command) -> DeviceError {
        DeviceError::Decode {
            port: self.port.clone(),
            source: DecodeError::WrongReply {
                command: command.name(),
            },
        }
    }

    fn start_run(&mut self, run: u32) -> Result<(), DeviceError> {
        let command = Command::Start {
            run,
            count: 0,
            // Within 100 and 10,000 by the range of `keepalive_s`.
            keepalive_ms: self.keepalive.as_millis() as u32,
        };
        match self.ask(command)? {
            Reply::Started { status: 0, .. } => Ok(()),
            Reply::Started { status, .. } => Err(DeviceError::Refused {
                port: self.port.clone(),
                command: command.name().into(),
                reason: status_text(status).into(),
                remedy: status_remedy(status),
            }),
            _ => Err(self.unexpected(command)),
        }
    }
}

/// Takes the reply to one of the ids `first..=last` out, and forgets those before it.
fn take_reply(
    replies: &mut std::collections::VecDeque<(u32, Reply)>,
    first: u32,
    last: u32,
) -> Option<(u32, Reply)> {
    while let Some((id, reply)) = replies.pop_front() {
        if (first..=last).contains(&id) {
            return Some((id, reply));
        }
    }
    None
}

impl Profiler for OpenProfile {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        let run = self.shared.lock().run;
        if run.is_some_and(|run| run.stopped.is_none()) {
            return Err(DeviceError::OutOfOrder {
                port: self.port.clone(),
                action: "start",
                needed: "the run before to be stopped",
            });
        }
        self.last_run = self.last_run.wrapping_add(1).max(1);
        self.shared.lock().begin(self.last_run, self.keepalive);
        let started = self.start_run(self.last_run);
        if started.is_err() {
            // The reply may be what was lost, so the laser may be on.
            let _ = self.ask(Command::Stop);
            self.shared.lock().run = None;
        }
        started
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        let mut inbox = self.shared.lock();
        inbox.waiting = true;
        let answer = loop {
            if let Some(profile) = inbox.pop() {
                break Ok(Some(profile));
            }
            if let Some(over) = &mut inbox.over {
                break Err(over.error(&self.port));
            }
            if let Some(error) = inbox.ended(&self.port) {
                break Err(error);
            }
            if inbox.run.is_none() {
                break Err(DeviceError::OutOfOrder {
                    port: self.port.clone(),
                    action: "next",
                    needed: "a run that was started",
                });
            }
            if Instant::now() >= deadline {
                break Ok(None);
            }
            inbox = self.shared.wait(inbox, deadline);
        };
        inbox.waiting = false;
        inbox.asked = Instant::now();
        self.shared.taken.notify_all();
        answer
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        {
            let mut inbox = self.shared.lock();
            if inbox.run.is_none() {
                return Ok(Vec::new());
            }
            inbox.stopping = true;
            self.shared.taken.notify_all();
        }
        let stopped = self.ask(Command::Stop);
        let mut inbox = self.shared.lock();
        inbox.stopping = false;
        let confirmed = inbox.run.is_some_and(|run| run.stopped.is_some());
        inbox.run = None;
        match stopped {
            Ok(_) if confirmed => Ok(std::iter::from_fn(|| inbox.pop()).collect()),
            Ok(_) => Err(self.unexpected(Command::Stop)),
            Err(error) => Err(error),
        }
    }

    fn losses(&self) -> Losses {
        self.shared.lock().losses
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        let run = self.shared.lock().run;
        if run.is_some_and(|run| run.stopped.is_none()) {
            return Err(checked_in_a_run(&self.port));
        }
        let Reply::Identity(identity) = self.ask(Command::Hello)? else {
            return Err(self.unexpected(Command::Hello));
        };
        same(&self.port, &self.identity.serial, &identity.serial)
    }
}

impl Drop for OpenProfile {
    /// Switches the laser off: the wait for the answer is short, the device's own keep-alive does the rest.
    fn drop(&mut self) {
        let frame = Command::Stop.encode(self.last_id + 1);
        self.shared.lock().stopping = true;
        if self.link.write(&frame, Instant::now() + REPLY).is_ok() {
            let deadline = Instant::now() + REPLY;
            let mut inbox = self.shared.lock();
            let (first, last) = (self.last_id + 1, self.last_id + 1);
            while inbox.over.is_none()
                && take_reply(&mut inbox.replies, first, last).is_none()
                && Instant::now() < deadline
            {
                inbox = self.shared.wait(inbox, deadline);
            }
        }
        self.shared.lock().quit = true;
        self.shared.taken.notify_all();
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has said so already.
            let _ = thread.join();
        }
    }
}

/// What the reason of STOPPED means, section 7 of the document.
fn stop_reason(reason: u16) -> &'static str {
    match reason {
        0 => "asked for",
        1 => "count reached",
        2 => "it did not hear from this program in time",
        3 => "the interlock was opened",
        4 => "hardware fault",
        5 => "it lost the link",
        _ => "a reason this program does not know",
    }
}

fn ended_remedy(reason: u16) -> &'static str {
    match reason {
        2 => "check whether this computer is overloaded, then start again",
        3 => "close the interlock, then start again",
        4 => "switch the device off and on; if it comes back, have it repaired",
        5 => "check the cable, then reopen it",
        _ => "start again",
    }
}

/// What a person can do about a refused command.
fn status_remedy(status: u16) -> &'static str {
    match status {
        4 => "stop the run first",
        5 | 6 => "update the device's firmware or this program",
        7 => "close the interlock, then start again",
        8 => "switch the device off and on; if it comes back, have it repaired",
        _ => "check the configuration",
    }
}

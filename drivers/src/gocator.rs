//! LMI Gocator line profile sensors, 2100, 2300 and 2500 series, over TCP.
//!
//! Manual: Gocator Line Profile Sensors, firmware 4 to 6, chapter Protocols, "Gocator Protocol". Quirks: the attributes of a profile message
//! have 32 or 40 bytes in different chapters, so that the size field decides; a stamp says 56 bytes and lists 52. The frame index counts
//! what the sensor took, so that a frame which the sensor could not send and one lost on the way are one gap; triggers that came
//! too fast have no index and are counted by the health channel. A sensor that loses its host goes on with its laser on: the protocol has
//! no rule against it, its safety input has.
//!
//! # Configuration
//!
//! ```toml
//! address = "192.168.1.10"   # control channel, port 3190 unless it says another
//! data_port = 3196
//! health_port = 3194         # 0: dropped triggers are not counted
//! serial_number = 13434      # of the sensor: another one is refused
//! source = "top"             # whose profiles: "top", "bottom", "top-left", "top-right"
//! flip_z = false             # turns z over, where the sensor is set up with z towards itself
//! first_frame = 0            # index of a run's first frame; without it the first that comes is the first
//! protocol_version = 1       # major version that is expected
//! drops_indicator = 21010    # health indicator of dropped triggers
//! keepalive_s = 1.0          # 0.1 to 60; the sensor closes a connection that is silent for three times this
//! ```

use std::sync::{Arc, Mutex, PoisonError};
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

pub mod message;
mod stream;

use message::{command_name, id, status_remedy, status_text};
use stream::{Over, Reading, SLICE, Shared};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "gocator",
    summary: "LMI Gocator 2100, 2300 and 2500 line profilers: TCP",
    configure,
};

/// Ports of the manual.
const CONTROL_PORT: u16 = 3190;
const HEALTH_PORT: i64 = 3194;
const DATA_PORT: i64 = 3196;
/// The manual's "Trigger Drops".
const TRIGGER_DROPS: i64 = 21_010;
/// How long a reply is waited for.
const REPLY: Duration = Duration::from_secs(3);
/// Start takes up to a few seconds while the sensor prepares its laser.
const REPLY_TO_START: Duration = Duration::from_secs(10);
/// Silence after which everything that was under way has come.
const QUIET: Duration = Duration::from_millis(200);
/// Longest time for what is under way when the sensor is stopped.
const EMPTYING: Duration = Duration::from_secs(30);
/// How long the first health message is waited for.
const FIRST_HEALTH: Duration = Duration::from_secs(2);
/// Replies to others that are passed over before the right one.
const STRAY: u32 = 16;

// ---- Settings ---------------------------------------------------------------------------------------------------------

/// A checked table of this driver.
#[derive(Debug, Clone)]
struct Settings {
    host: String,
    ports: [u16; 3],
    serial_number: Option<u32>,
    version: u8,
    keepalive: Duration,
    reading: Reading,
}

const SOURCES: [(&str, u8); 4] = [("top", 0), ("bottom", 1), ("top-left", 2), ("top-right", 3)];

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let address = keys.host_and_port("address", CONTROL_PORT);
    // The ranges below fit their types.
    let data = keys.integer("data_port", 1..=65_535).unwrap_or(DATA_PORT) as u16;
    let health = keys
        .integer("health_port", 0..=65_535)
        .unwrap_or(HEALTH_PORT) as u16;
    let serial_number = keys.integer("serial_number", 0..=u32::MAX.into());
    let reading = Reading {
        source: keys.choice("source", &SOURCES).unwrap_or(0),
        first_frame: keys
            .integer("first_frame", 0..=i64::MAX)
            .map(|index| index as u64),
        flip_z: keys.flag("flip_z").unwrap_or(false),
        drops_indicator: keys
            .integer("drops_indicator", 0..=u32::MAX.into())
            .unwrap_or(TRIGGER_DROPS) as u32,
    };
    let version = keys.integer("protocol_version", 0..=255).unwrap_or(1) as u8;
    let keepalive_s = keys.number("keepalive_s", 0.1..=60.0).unwrap_or(1.0);
    keys.finish()?;
    let Some((host, control)) = address else {
        // Without a mistake there is an address: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        host,
        ports: [control, data, health],
        serial_number: serial_number.map(|number| number as u32),
        version,
        keepalive: Duration::from_secs_f64(keepalive_s),
        reading,
    }))
}

impl Settings {
    fn target(&self, port: u16) -> Target {
        Target::Tcp {
            address: format!("{}:{port}", self.host),
        }
    }
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target(self.ports[0]).claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let open = |port: u16| {
            let target = self.target(port);
            links.open(&target).map_err(|source| DeviceError::Link {
                port: target.to_string(),
                source,
            })
        };
        let [control, data, health] = self.ports;
        let mut control = Control {
            port: self.target(control).to_string(),
            link: open(control)?,
            held: Vec::new(),
        };
        control.check_version(self.version)?;
        // A host before us may have left it running.
        control.ask(id::STOP, &[])?;
        let identity = control.introduce(self.serial_number)?;
        let data = open(data)?;
        let health = match health {
            0 => None,
            port => Some(open(port)?),
        };
        let device = Gocator::start_threads(control, data, health, self, identity)?;
        Ok(Instrument::Profiler(Box::new(device)))
    }
}

// ---- Control channel --------------------------------------------------------------------------------------------------

/// The control channel: one command at a time.
struct Control {
    port: String,
    link: Arc<dyn Link>,
    held: Vec<u8>,
}

impl Control {
    /// Sends a command and returns the payload of its reply; a status other than "done" is an error.
    fn ask(&mut self, id: u16, payload: &[u8]) -> Result<Vec<u8>, DeviceError> {
        let patience = if id == id::START {
            REPLY_TO_START
        } else {
            REPLY
        };
        let deadline = Instant::now() + patience;
        self.link
            .write(&message::command(id, payload), deadline)
            .map_err(|source| self.gone(source))?;
        let mut heard = 0;
        let mut strays = 0;
        let mut chunk = [0; 4096];
        loop {
            let found = message::reply(&self.held).map_err(|source| DeviceError::Decode {
                port: self.port.clone(),
                source,
            })?;
            if let Some((reply, used)) = found {
                let (answers, status) = (reply.id == id, reply.status);
                let payload = reply.payload.to_vec();
                self.held.drain(..used);
                if answers {
                    return self.accepted(id, status, payload);
                }
                strays += 1;
                if strays > STRAY {
                    return Err(DeviceError::Decode {
                        port: self.port.clone(),
                        source: DecodeError::WrongReply {
                            command: command_name(id),
                        },
                    });
                }
                continue;
            }
            let n = self
                .link
                .read(&mut chunk, deadline)
                .map_err(|source| self.gone(source))?;
            if n == 0 {
                return Err(self.unanswered(id, heard, patience));
            }
            heard += n as u64;
            self.held.extend_from_slice(&chunk[..n]);
        }
    }

    fn accepted(&self, id: u16, status: i32, payload: Vec<u8>) -> Result<Vec<u8>, DeviceError> {
        if status == 1 {
            return Ok(payload);
        }
        Err(DeviceError::Refused {
            port: self.port.clone(),
            command: command_name(id).into(),
            reason: format!("{} ({status})", status_text(status)),
            remedy: status_remedy(status),
        })
    }

    fn unanswered(&self, id: u16, bytes: u64, patience: Duration) -> DeviceError {
        let port = self.port.clone();
        let deadline_s = patience.as_secs_f64();
        match bytes {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: command_name(id),
                deadline_s,
            },
        }
    }

    fn gone(&self, source: LinkError) -> DeviceError {
        DeviceError::Link {
            port: self.port.clone(),
            source,
        }
    }

    fn check_version(&mut self, known: u8) -> Result<(), DeviceError> {
        let payload = self.ask(id::PROTOCOL_VERSION, &[])?;
        match payload.first() {
            Some(&found) if found == known => Ok(()),
            Some(&found) => Err(DeviceError::Decode {
                port: self.port.clone(),
                source: DecodeError::Version { found, known },
            }),
            None => Err(DeviceError::Decode {
                port: self.port.clone(),
                source: DecodeError::TooShort {
                    message: command_name(id::PROTOCOL_VERSION),
                    found: 0,
                    needed: 2,
                },
            }),
        }
    }

    fn introduce(&mut self, expected: Option<u32>) -> Result<Identity, DeviceError> {
        let payload = self.ask(id::SYSTEM_INFO, &[])?;
        let info = message::sensor_info(&payload).map_err(|source| DeviceError::Decode {
            port: self.port.clone(),
            source,
        })?;
        if let Some(expected) = expected.filter(|serial| *serial != info.device_id) {
            return Err(DeviceError::WrongDevice {
                port: self.port.clone(),
                found: info.device_id.to_string(),
                expected: expected.to_string(),
            });
        }
        let [a, b, c, d] = info.firmware;
        Ok(Identity {
            vendor: "LMI Technologies".into(),
            model: info.model,
            serial: info.device_id.to_string(),
            firmware: format!("{a}.{b}.{c}.{d}"),
        })
    }
}

// ---- Device -----------------------------------------------------------------------------------------------------------

/// An open sensor.
struct Gocator {
    port: String,
    control: Arc<Mutex<Control>>,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
    identity: Identity,
    reading: Reading,
    has_health: bool,
}

impl Gocator {
    fn start_threads(
        control: Control,
        data: Arc<dyn Link>,
        health: Option<Arc<dyn Link>>,
        settings: &Settings,
        identity: Identity,
    ) -> Result<Gocator, DeviceError> {
        let mut device = Gocator {
            port: control.port.clone(),
            control: Arc::new(Mutex::new(control)),
            shared: Arc::new(Shared::new()),
            threads: Vec::new(),
            identity,
            reading: settings.reading,
            has_health: health.is_some(),
        };
        let (shared, reading) = (Arc::clone(&device.shared), device.reading);
        device.spawn("gocator-data", move || {
            stream::take_data(&data, &shared, &reading);
        })?;
        let keeper = Keeper {
            control: Arc::clone(&device.control),
            health,
            shared: Arc::clone(&device.shared),
            reading,
            keepalive: settings.keepalive,
        };
        device.spawn("gocator-health", move || keeper.run())?;
        Ok(device)
    }

    fn spawn(
        &mut self,
        name: &str,
        run: impl FnOnce() + Send + 'static,
    ) -> Result<(), DeviceError> {
        let thread = std::thread::Builder::new().name(name.into()).spawn(run);
        let thread = thread.map_err(|source| DeviceError::Link {
            port: self.port.clone(),
            source: LinkError::Io {
                action: "starting its thread",
                source,
            },
        })?;
        self.threads.push(thread);
        Ok(())
    }

    fn ask(&self, id: u16) -> Result<Vec<u8>, DeviceError> {
        let mut control = self.control.lock().unwrap_or_else(PoisonError::into_inner);
        control.ask(id, &[])
    }

    fn out_of_order(&self, action: &'static str, needed: &'static str) -> DeviceError {
        DeviceError::OutOfOrder {
            port: self.port.clone(),
            action,
            needed,
        }
    }
}

impl Profiler for Gocator {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        {
            let mut inbox = self.shared.lock();
            if inbox.running {
                return Err(self.out_of_order("start", "the run before to be stopped"));
            }
            // Dropped triggers count from the value before the run, which comes about once a second.
            let patience = Instant::now() + FIRST_HEALTH;
            while self.has_health && inbox.drops.is_none() && Instant::now() < patience {
                inbox = self.shared.wait(inbox, patience);
            }
            inbox.begin(&self.reading);
        }
        let started = self.ask(id::START);
        if started.is_err() {
            // The reply may be what was lost, so the laser may be on.
            let _ = self.ask(id::STOP);
            self.shared.lock().running = false;
        }
        started.map(drop)
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        let mut inbox = self.shared.lock();
        loop {
            if let Some(profile) = inbox.pop() {
                self.shared.taken.notify_all();
                return Ok(Some(profile));
            }
            if let Some(over) = &mut inbox.over {
                return Err(over.error(&self.port));
            }
            if !inbox.running {
                return Err(self.out_of_order("next", "a run that was started"));
            }
            if Instant::now() >= deadline {
                return Ok(None);
            }
            inbox = self.shared.wait(inbox, deadline);
        }
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        {
            let mut inbox = self.shared.lock();
            if !inbox.running {
                return Ok(Vec::new());
            }
            inbox.stopping = true;
        }
        self.shared.taken.notify_all();
        if let Err(error) = self.ask(id::STOP) {
            self.shared.lock().running = false;
            return Err(error);
        }
        let stopped = Instant::now();
        let mut inbox = self.shared.lock();
        // The protocol says no last frame: what is under way has come when nothing comes for a while.
        while inbox.over.is_none() && stopped.elapsed() < EMPTYING {
            let quiet_at = inbox.heard.max(stopped) + QUIET;
            if Instant::now() >= quiet_at {
                break;
            }
            inbox = self.shared.wait(inbox, quiet_at);
        }
        inbox.running = false;
        inbox.stopping = false;
        Ok(std::iter::from_fn(|| inbox.pop()).collect())
    }

    fn losses(&self) -> Losses {
        self.shared.lock().losses
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        {
            let mut inbox = self.shared.lock();
            if let Some(over) = &mut inbox.over {
                return Err(over.error(&self.port));
            }
            if inbox.running {
                return Err(checked_in_a_run(&self.port));
            }
        }
        let mut control = self.control.lock().unwrap_or_else(PoisonError::into_inner);
        let now = control.introduce(None)?;
        same(&self.port, &self.identity.serial, &now.serial)
    }
}

impl Drop for Gocator {
    /// Switches the laser off, then ends the threads.
    fn drop(&mut self) {
        let over = self.shared.lock().over.is_some();
        let stopped = if over {
            Ok(Vec::new())
        } else {
            self.ask(id::STOP)
        };
        if let Err(error) = stopped {
            tracing::warn!(port = self.port, %error, "not confirmed that the laser is off");
        }
        self.shared.lock().quit = true;
        self.shared.taken.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has said so already.
            let _ = thread.join();
        }
    }
}

/// Takes health and sends pings.
struct Keeper {
    control: Arc<Mutex<Control>>,
    health: Option<Arc<dyn Link>>,
    shared: Arc<Shared>,
    reading: Reading,
    keepalive: Duration,
}

impl Keeper {
    fn run(mut self) {
        let mut decoder = message::Decoder::default();
        let mut chunk = [0; 16 << 10];
        // The sensor begins to watch for pings with the first one. That comes behind the start of a run at once, so that a recording's
        // order of commands is the same when it is played back.
        let mut next_ping = Instant::now() + self.keepalive;
        loop {
            let inbox = self.shared.lock();
            if inbox.quit || inbox.over.is_some() {
                return;
            }
            match &self.health {
                Some(link) => {
                    drop(inbox);
                    let read = link.read(&mut chunk, Instant::now() + SLICE);
                    let taken = read.map(|n| {
                        stream::take_health(&chunk[..n], &mut decoder, &self.shared, &self.reading)
                    });
                    if !matches!(taken, Ok(Ok(()))) {
                        tracing::warn!(
                            "the health channel ended: dropped triggers are not counted any more"
                        );
                        self.health = None;
                    }
                }
                None => drop(self.shared.taken.wait_timeout(inbox, SLICE)),
            }
            if Instant::now() >= next_ping {
                next_ping = Instant::now() + self.keepalive;
                if let Err(error) = self.ping() {
                    return self.shared.end(Over::Error(Some(error)));
                }
            }
        }
    }

    /// Tells the sensor that we live; it closes the connection where it does not hear that for three times the interval.
    fn ping(&self) -> Result<(), DeviceError> {
        let timeout_us = 3 * self.keepalive.as_micros() as u64;
        let mut control = self.control.lock().unwrap_or_else(PoisonError::into_inner);
        control.ask(id::PING, &timeout_us.to_le_bytes()).map(drop)
    }
}

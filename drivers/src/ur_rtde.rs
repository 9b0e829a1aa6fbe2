//! Robots of Universal Robots, CB3, e-Series and later, over RTDE: where the tool is, by the robot's own clock.
//!
//! Manual: Real-Time Data Exchange (RTDE) Guide, protocol version 2. Quirks: the interface sends up to 500 outputs a second (125 with a
//! CB3), but skips some when the controller is busy and says nothing of it, so that losses are told by the steps of the time stamp alone;
//! the pose is that of the tool's centre point as the robot's program has set it, m and axis-angle, in the base frame. Nothing is sent that
//! could move the robot.
//!
//! # Configuration
//!
//! ```toml
//! address = "192.168.1.30"   # port 30004 unless it says another
//! rate_hz = 500              # 1 to 500; without it 500, or 125 where the controller's version is 3
//! major_version = 5          # of the controller's software: another one is refused
//! ```

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::capture::Pose;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Presence, Robot, Setup,
    checked_in_a_run,
};
use crate::error::{DecodeError, DeviceError};
use crate::link::pump::Pump;
use crate::link::{self, Links, Target};
use crate::settings::Keys;

pub mod message;

use message::{Bad, Data, Package, RECIPE, Text, kind};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "ur-rtde",
    summary: "Universal Robots CB3, e-Series and later, poses of the tool: TCP",
    configure,
};

/// Port of the guide.
const PORT: u16 = 30_004;
/// How long an answer is waited for.
const REPLY: Duration = Duration::from_secs(3);
/// A stream that is silent for this long is gone: even at 1 Hz something comes in it.
const SILENCE: Duration = Duration::from_secs(3);
/// Rates of the two generations, Hz.
const RATE_HZ: f64 = 500.0;
const RATE_CB3_HZ: f64 = 125.0;

/// A checked table of this driver.
#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    rate_hz: Option<f64>,
    major_version: Option<u32>,
}

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let address = keys.host_and_port("address", PORT);
    let rate_hz = keys.number("rate_hz", 1.0..=500.0);
    // The range fits.
    let major_version = keys
        .integer("major_version", 3..=100)
        .map(|major| major as u32);
    keys.finish()?;
    let Some((host, port)) = address else {
        // Without a mistake there is an address: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        target: Target::Tcp {
            address: format!("{host}:{port}"),
        },
        rate_hz,
        major_version,
    }))
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let mut session = Session {
            pump: Pump::open(links, &self.target)?,
            held: Vec::new(),
            heard: Instant::now(),
            told: None,
        };
        session.speak_version_2()?;
        let version = session.control_version()?;
        let [major, minor, bugfix, build] = version;
        if let Some(expected) = self.major_version.filter(|expected| *expected != major) {
            return Err(DeviceError::WrongDevice {
                port: session.port(),
                found: format!("controller version {major}.{minor}"),
                expected: format!("version {expected}"),
            });
        }
        let usual = if major <= 3 { RATE_CB3_HZ } else { RATE_HZ };
        let rate_hz = self.rate_hz.unwrap_or(usual);
        let recipe = session.agree_on_outputs(rate_hz)?;
        Ok(Instrument::Robot(Box::new(UrRobot {
            session,
            identity: Identity {
                vendor: "Universal Robots".into(),
                model: if major <= 3 {
                    "CB3"
                } else {
                    "e-Series or later"
                }
                .into(),
                serial: String::new(),
                firmware: format!("{major}.{minor}.{bugfix}.{build}"),
            },
            recipe,
            cycle_s: 1.0 / rate_hz,
            run: None,
            losses: Losses::default(),
            waiting: VecDeque::new(),
        })))
    }
}

// ---- Session ----------------------------------------------------------------------------------------------------------

/// The connection: one request at a time, and what comes in between.
struct Session {
    pump: Pump,
    held: Vec<u8>,
    /// When the last bytes came.
    heard: Instant,
    /// The last warning or error of the controller.
    told: Option<Text>,
}

/// What came: a package, one that could not be read, or nothing in time.
enum Came {
    Package(Package),
    Unreadable(DecodeError),
    Nothing,
}

impl Session {
    fn port(&self) -> String {
        self.pump.port().to_owned()
    }

    fn bad(&self, source: DecodeError) -> DeviceError {
        DeviceError::Decode {
            port: self.port(),
            source,
        }
    }

    fn next(&mut self, deadline: Instant) -> Result<Came, DeviceError> {
        loop {
            match message::package(&self.held) {
                Ok(Some((package, used))) => {
                    self.held.drain(..used);
                    if let Package::Text(text) = package {
                        self.hear(text);
                        continue;
                    }
                    return Ok(Came::Package(package));
                }
                Err(Bad::Package(error, used)) => {
                    self.held.drain(..used);
                    return Ok(Came::Unreadable(error));
                }
                Err(Bad::Framing(error)) => return Err(self.bad(error)),
                Ok(None) => {}
            }
            let Some((at, bytes)) = self.pump.read(deadline)? else {
                return Ok(Came::Nothing);
            };
            self.heard = at;
            self.held.extend(bytes);
        }
    }

    fn hear(&mut self, text: Text) {
        let Text {
            message,
            source,
            level,
        } = &text;
        if *level <= 2 {
            tracing::warn!(port = self.pump.port(), level, source, "{message}");
            self.told = Some(text);
        } else {
            tracing::info!(port = self.pump.port(), source, "{message}");
        }
    }

    /// Sends a request and waits for what `answer` takes for its answer; data that come meanwhile go to `beside`.
    fn ask<T>(
        &mut self,
        request: &[u8],
        command: &'static str,
        answer: impl Fn(Package) -> Result<T, Package>,
        beside: &mut dyn FnMut(Result<Data, DecodeError>, Instant),
    ) -> Result<T, DeviceError> {
        let before = self.pump.heard_bytes();
        self.pump.write(request)?;
        let deadline = Instant::now() + REPLY;
        while !link::left(deadline).is_zero() {
            match self.next(deadline)? {
                Came::Nothing => break,
                Came::Unreadable(error) => beside(Err(error), self.heard),
                Came::Package(package) => match answer(package) {
                    Ok(answer) => return Ok(answer),
                    Err(Package::Data(data)) => beside(Ok(data), self.heard),
                    // Late answers to what a host before us asked.
                    Err(_) => {}
                },
            }
        }
        let (port, deadline_s) = (self.port(), REPLY.as_secs_f64());
        Err(match self.pump.heard_bytes() - before {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command,
                deadline_s,
            },
        })
    }

    fn refused(&self, command: &'static str, reason: &str, remedy: &'static str) -> DeviceError {
        let told = self.told.as_ref();
        let told = told.map_or_else(String::new, |text| format!("; it says {:?}", text.message));
        DeviceError::Refused {
            port: self.port(),
            command: command.into(),
            reason: format!("{reason}{told}"),
            remedy,
        }
    }

    fn speak_version_2(&mut self) -> Result<(), DeviceError> {
        const COMMAND: &str = "RTDE_REQUEST_PROTOCOL_VERSION";
        let accepted = self.ask(
            &message::protocol_version_2(),
            COMMAND,
            |package| match package {
                Package::ProtocolVersion(accepted) => Ok(accepted),
                other => Err(other),
            },
            &mut |_, _| {},
        )?;
        match accepted {
            true => Ok(()),
            false => Err(self.refused(
                COMMAND,
                "version 2 is not spoken",
                "update the robot's software to 3.4 or later",
            )),
        }
    }

    fn control_version(&mut self) -> Result<[u32; 4], DeviceError> {
        self.ask(
            &message::request(kind::CONTROL_VERSION, &[]),
            "RTDE_GET_URCONTROL_VERSION",
            |package| match package {
                Package::ControlVersion(version) => Ok(version),
                other => Err(other),
            },
            &mut |_, _| {},
        )
    }

    /// The number of our list of outputs.
    fn agree_on_outputs(&mut self, rate_hz: f64) -> Result<u8, DeviceError> {
        const COMMAND: &str = "RTDE_CONTROL_PACKAGE_SETUP_OUTPUTS";
        let outputs = self.ask(
            &message::setup_outputs(rate_hz),
            COMMAND,
            |package| match package {
                Package::Outputs(outputs) => Ok(outputs),
                other => Err(other),
            },
            &mut |_, _| {},
        )?;
        if outputs.types == RECIPE.map(|(_, of_type)| of_type) {
            return Ok(outputs.recipe);
        }
        let [timestamp, pose] = RECIPE;
        let reason = format!(
            "{} and {} are {}, expected {} and {}",
            timestamp.0,
            pose.0,
            outputs.types.join(" and "),
            timestamp.1,
            pose.1
        );
        Err(self.refused(COMMAND, &reason, "update the robot's software"))
    }
}

// ---- Device -----------------------------------------------------------------------------------------------------------

/// An open robot.
struct UrRobot {
    session: Session,
    identity: Identity,
    recipe: u8,
    cycle_s: f64,
    /// Under way, with the last time stamp where one came.
    run: Option<Option<f64>>,
    losses: Losses,
    waiting: VecDeque<Pose>,
}

/// Files away what came of a run.
struct Account<'a> {
    recipe: u8,
    cycle_s: f64,
    last: &'a mut Option<f64>,
    losses: &'a mut Losses,
    waiting: &'a mut VecDeque<Pose>,
}

impl Account<'_> {
    /// # Errors
    /// A clock that went back: the controller was started anew.
    fn take(&mut self, came: Result<Data, DecodeError>, host_time: Instant) -> Result<(), ()> {
        let sound = came
            .ok()
            .filter(|data| data.recipe == self.recipe && data.is_sound());
        let Some(data) = sound else {
            self.losses.rejected += 1;
            return Ok(());
        };
        if let Some(last) = *self.last {
            let cycles = ((data.timestamp_s - last) / self.cycle_s).round();
            if cycles < 0.0 {
                return Err(());
            }
            // The clock of a controller that is late stands for a cycle: the same time twice is the same pose.
            if cycles == 0.0 {
                self.losses.rejected += 1;
                return Ok(());
            }
            self.losses.lost_on_link += cycles as u64 - 1;
        }
        *self.last = Some(data.timestamp_s);
        self.losses.received += 1;
        self.waiting.push_back(Pose {
            device_time_s: data.timestamp_s,
            position_mm: data.position_m.map(|m| 1e3 * m),
            rotation: data.rotation,
            host_time,
        });
        Ok(())
    }
}

impl UrRobot {
    fn out_of_order(&self, action: &'static str, needed: &'static str) -> DeviceError {
        DeviceError::OutOfOrder {
            port: self.session.port(),
            action,
            needed,
        }
    }

    fn restarted(&mut self) -> DeviceError {
        self.run = None;
        DeviceError::Ended {
            port: self.session.port(),
            reason: "its clock went back: the controller was started anew",
            remedy: "reopen it, then scan again",
        }
    }

    /// Asks for start or pause; data that come before the answer are kept.
    fn switch(&mut self, on: bool) -> Result<(), DeviceError> {
        let (request, command) = match on {
            true => (kind::START, "RTDE_CONTROL_PACKAGE_START"),
            false => (kind::PAUSE, "RTDE_CONTROL_PACKAGE_PAUSE"),
        };
        let mut last = self.run.flatten();
        let mut went_back = false;
        let mut account = Account {
            recipe: self.recipe,
            cycle_s: self.cycle_s,
            last: &mut last,
            losses: &mut self.losses,
            waiting: &mut self.waiting,
        };
        let accepted = self.session.ask(
            &message::request(request, &[]),
            command,
            |package| match package {
                Package::Started(accepted) if on => Ok(accepted),
                Package::Paused(accepted) if !on => Ok(accepted),
                other => Err(other),
            },
            &mut |came, at| went_back |= account.take(came, at).is_err(),
        )?;
        self.run = self.run.map(|_| last);
        if went_back {
            return Err(self.restarted());
        }
        match accepted {
            true => Ok(()),
            false => Err(self.session.refused(
                command,
                "the controller says no",
                "look at the robot's log",
            )),
        }
    }
}

impl Robot for UrRobot {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if self.run.is_some() {
            return Err(self.out_of_order("start", "the run before to be stopped"));
        }
        self.losses = Losses::default();
        self.waiting.clear();
        self.session.told = None;
        // Nothing here can hurt anybody: a stream that nobody takes is paused all the same, so that it is not sent for ever.
        let farewell = message::request(kind::PAUSE, &[]);
        self.session.pump.guard(Some(farewell));
        self.run = Some(None);
        let started = self.switch(true);
        if started.is_err() {
            self.run = None;
            self.session.pump.guard(None);
        }
        started
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Pose>, DeviceError> {
        loop {
            if let Some(pose) = self.waiting.pop_front() {
                return Ok(Some(pose));
            }
            let Some(mut last) = self.run else {
                return Err(self.out_of_order("next", "a run that was started"));
            };
            let silent_at = self.session.heard + SILENCE;
            let came = match self.session.next(deadline.min(silent_at))? {
                Came::Nothing if Instant::now() >= silent_at => {
                    self.run = None;
                    return Err(DeviceError::Silent {
                        port: self.session.port(),
                        deadline_s: SILENCE.as_secs_f64(),
                    });
                }
                Came::Nothing => return Ok(None),
                Came::Unreadable(error) => Err(error),
                Came::Package(Package::Data(data)) => Ok(data),
                Came::Package(Package::Paused(_)) => {
                    self.run = None;
                    return Err(DeviceError::Ended {
                        port: self.session.port(),
                        reason: "it paused its outputs",
                        remedy: "start again",
                    });
                }
                Came::Package(_) => continue,
            };
            let mut account = Account {
                recipe: self.recipe,
                cycle_s: self.cycle_s,
                last: &mut last,
                losses: &mut self.losses,
                waiting: &mut self.waiting,
            };
            let taken = account.take(came, self.session.heard);
            self.run = Some(last);
            if taken.is_err() {
                return Err(self.restarted());
            }
        }
    }

    fn stop(&mut self) -> Result<Vec<Pose>, DeviceError> {
        if self.run.is_some() {
            let stopped = self.switch(false);
            self.session.pump.guard(None);
            self.run = None;
            stopped?;
        }
        Ok(self.waiting.drain(..).collect())
    }

    fn losses(&self) -> Losses {
        self.losses
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        if self.run.is_some() {
            return Err(checked_in_a_run(&self.session.port()));
        }
        // It has no serial number to compare: an answer is all there is.
        self.session.control_version().map(|_| Presence::Answered)
    }
}

impl Drop for UrRobot {
    fn drop(&mut self) {
        if self.run.is_some() {
            // The connection closes next, which ends the stream too.
            let _ = self.session.pump.write(&message::request(kind::PAUSE, &[]));
        }
    }
}

//! Mitutoyo gauges on a USB input tool USB-ITN (0fe7:4001), read raw instead of as a keyboard: control requests and an interrupt endpoint.
//!
//! Manual: none of the maker's is public for this mode; the requests are those of a community driver ("Mitutoyo Digimatic SPC I/O for Linux"). Quirks: the tool
//! starts as a keyboard that types its digits into whatever window has the focus, until it is switched over; the button on the gauge sends values unasked
//! in every mode. A reading is a text with a point or the nibbles of the Digimatic frame in hex.
//!
//! A gauge has one coordinate: each reading is a profile of one column at x = 0, without an encoder.
//!
//! # Configuration
//!
//! ```toml
//! usb_serial = "70412345"   # of the tool; without it, the only tool
//! interval_s = 0.1          # from reading to reading, 0.02 to 60
//! unit = "mm"               # of texts, "mm" or "inch"; nibbles say it themselves
//! invert = false            # z grows against the gauge's numbers
//! ```

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::capture::Profile;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Presence, Profiler, Setup,
    checked_in_a_run,
};
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::Links;
use crate::link::usb::{Request, UsbLink, UsbTarget};
use crate::settings::Keys;

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "usb-itn",
    summary: "Mitutoyo gauges on a USB-ITN input tool: USB",
    configure,
};

/// Vendor and product number.
const ID: (u16, u16) = (0x0FE7, 0x4001);
/// Interrupt endpoint of the readings.
const READINGS: u8 = 0x81;
/// Switches from keyboard to raw.
const SWITCH: Request = Request {
    kind: 0x40,
    request: 1,
    value: 0xA5A5,
    index: 0,
};
/// Asks whether it is switched: one byte.
const STATE: Request = Request {
    kind: 0xC0,
    request: 2,
    value: 0,
    index: 0,
};
/// Asks for a reading, with `1` and CR.
const ASK: Request = Request {
    kind: 0x40,
    request: 3,
    value: 0,
    index: 0,
};
/// How long a control request and a reading are waited for.
const CONTROL: Duration = Duration::from_secs(1);
const READING: Duration = Duration::from_secs(2);
/// Readings in a row that did not come, after which a gauge is silent.
const MISSED: u32 = 3;
const MM_PER_INCH: f64 = 25.4;

// ---- Settings ---------------------------------------------------------------------------------------------------------

#[derive(Debug, Clone)]
struct Settings {
    target: UsbTarget,
    interval: Duration,
    text_mm: f64,
    invert: bool,
}

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let serial = keys.text("usb_serial");
    let interval_s = keys.number("interval_s", 0.02..=60.0).unwrap_or(0.1);
    let unit = keys.choice("unit", &[("mm", 1.0), ("inch", MM_PER_INCH)]);
    let invert = keys.flag("invert").unwrap_or(false);
    keys.finish()?;
    Ok(Box::new(Settings {
        target: UsbTarget {
            id: Some(ID),
            serial,
            interface: None,
        },
        interval: Duration::from_secs_f64(interval_s),
        text_mm: unit.unwrap_or(1.0),
        invert,
    }))
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let port = self.target.to_string();
        let gone = |source| DeviceError::Link {
            port: port.clone(),
            source,
        };
        let link = links.open_usb(&self.target).map_err(gone)?;
        link.claim(0).map_err(gone)?;
        let deadline = Instant::now() + CONTROL;
        let switched = link.control_out(SWITCH, &[], deadline).map_err(gone)?;
        let state = link
            .control_in(STATE, &mut [0; 1], deadline)
            .map_err(gone)?;
        if switched.is_none() || state.is_none() {
            return Err(DeviceError::Silent {
                port,
                deadline_s: CONTROL.as_secs_f64(),
            });
        }
        Ok(Instrument::Profiler(Box::new(UsbItn {
            port: port.clone(),
            link,
            identity: Identity {
                vendor: "Mitutoyo".into(),
                model: "USB-ITN".into(),
                serial: self.target.serial.clone().unwrap_or_default(),
                firmware: String::new(),
            },
            settings: self.clone(),
            run: None,
            losses: Losses::default(),
        })))
    }
}

// ---- Messages ---------------------------------------------------------------------------------------------------------

/// A reading as the gauge sent it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// The number.
    pub value: f64,
    /// What it is in, where the gauge says it: mm a unit.
    pub unit_mm: Option<f64>,
}

/// Reads one transfer of the interrupt endpoint: zeros behind the text do not count.
///
/// # Errors
/// Neither a text as `01A-001.2340` nor the 13 hex digits of the Digimatic frame.
pub fn reading(bytes: &[u8]) -> Result<Reading, DecodeError> {
    let text = bytes
        .iter()
        .take(64)
        .take_while(|b| **b != 0 && **b != b'\r');
    let text: Vec<u8> = text.copied().collect();
    as_text(&text)
        .map(|value| Reading {
            value,
            unit_mm: None,
        })
        .or_else(|| as_nibbles(&text))
        .ok_or_else(|| DecodeError::Line {
            line: String::from_utf8_lossy(&text).into_owned(),
        })
}

/// `0CA`, a sign, digits with a point.
fn as_text(text: &[u8]) -> Option<f64> {
    let [b'0', b'1'..=b'9', b'A', sign @ (b'+' | b'-'), number @ ..] = text else {
        return None;
    };
    let plain = number.iter().all(|b| b.is_ascii_digit() || *b == b'.');
    let value: f64 = std::str::from_utf8(number)
        .ok()
        .filter(|_| plain)?
        .parse()
        .ok()?;
    Some(if *sign == b'-' { -value } else { value })
}

/// Four F, sign (0 or 8), six digits, places behind the point, unit (0 mm, 1 inch).
fn as_nibbles(text: &[u8]) -> Option<Reading> {
    let digits: Option<Vec<u32>> = text.iter().map(|b| char::from(*b).to_digit(16)).collect();
    let digits = digits.filter(|d| d.len() == 13)?;
    let sign = match digits[4] {
        0 => 1.0,
        8 => -1.0,
        _ => return None,
    };
    let number = &digits[5..11];
    let places = digits[11];
    if digits[..4] != [15; 4] || number.iter().any(|d| *d > 9) || places > 5 {
        return None;
    }
    let whole = number.iter().fold(0_u32, |sum, digit| 10 * sum + digit);
    let unit_mm = match digits[12] {
        0 => 1.0,
        1 => MM_PER_INCH,
        _ => return None,
    };
    Some(Reading {
        value: sign * f64::from(whole) / 10_f64.powi(places as i32),
        unit_mm: Some(unit_mm),
    })
}

// ---- Device -----------------------------------------------------------------------------------------------------------

/// An open tool. Readings are asked for when the caller wants one: there is nothing to keep alive.
struct UsbItn {
    port: String,
    link: Arc<dyn UsbLink>,
    identity: Identity,
    settings: Settings,
    run: Option<Run>,
    losses: Losses,
}

/// A run that was started.
#[derive(Clone, Copy)]
struct Run {
    next: Instant,
    /// Readings asked for.
    asked: u32,
    /// One is asked for and has not come; until when it is waited for.
    pending: Option<Instant>,
    /// How many before it did not come.
    missed: u32,
}

impl UsbItn {
    fn gone(&self, source: LinkError) -> DeviceError {
        DeviceError::Link {
            port: self.port.clone(),
            source,
        }
    }

    /// Takes what comes on the interrupt endpoint until `deadline`.
    fn receive(&mut self, deadline: Instant) -> Result<Option<Reading>, DeviceError> {
        let mut buffer = [0; 64];
        let read = match self.link.read(READINGS, &mut buffer, deadline) {
            Err(LinkError::Stalled) => {
                self.losses.rejected += 1;
                self.link
                    .clear_halt(READINGS)
                    .map_err(|source| self.gone(source))?;
                return Ok(None);
            }
            read => read.map_err(|source| self.gone(source))?,
        };
        match read.map(|n| reading(&buffer[..n])) {
            Some(Ok(reading)) => Ok(Some(reading)),
            Some(Err(error)) => {
                tracing::debug!(%error, "rejected a reading");
                self.losses.rejected += 1;
                Ok(None)
            }
            None => Ok(None),
        }
    }

    fn ask(&self) -> Result<(), DeviceError> {
        let deadline = Instant::now() + CONTROL;
        let asked = self.link.control_out(ASK, b"1\r", deadline);
        match asked.map_err(|source| self.gone(source))? {
            Some(_) => Ok(()),
            None => Err(DeviceError::Silent {
                port: self.port.clone(),
                deadline_s: CONTROL.as_secs_f64(),
            }),
        }
    }

    fn profile(&mut self, reading: Reading, run: &Run) -> Profile {
        let unit_mm = reading.unit_mm.unwrap_or(self.settings.text_mm);
        let sign = if self.settings.invert { -1.0 } else { 1.0 };
        self.losses.received += 1;
        Profile {
            sequence: run.asked - 1,
            boot: 0,
            // It has no clock.
            device_time_ns: 0,
            encoder: None,
            host_time: self.link.received(READINGS),
            dropped: 0,
            saturated: false,
            x_mm: vec![0.0],
            z_mm: vec![sign * reading.value * unit_mm],
            intensity: Vec::new(),
        }
    }
}

impl Profiler for UsbItn {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if self.run.is_some() {
            return Err(DeviceError::OutOfOrder {
                port: self.port.clone(),
                action: "start",
                needed: "the run before to be stopped",
            });
        }
        self.losses = Losses::default();
        let now = Instant::now();
        self.run = Some(Run {
            next: now,
            asked: 0,
            pending: None,
            missed: 0,
        });
        Ok(())
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        let Some(mut run) = self.run else {
            return Err(DeviceError::OutOfOrder {
                port: self.port.clone(),
                action: "next",
                needed: "a run that was started",
            });
        };
        loop {
            let until = match run.pending {
                Some(until) => until,
                None => run.next,
            };
            // Between readings what comes is the button's, and no reading of this run.
            let found = self.receive(until.min(deadline))?;
            let now = Instant::now();
            match (found, run.pending) {
                (Some(reading), Some(_)) => {
                    run.pending = None;
                    run.missed = 0;
                    self.run = Some(run);
                    return Ok(Some(self.profile(reading, &run)));
                }
                (Some(_), None) => self.losses.rejected += 1,
                (None, Some(until)) if now >= until => {
                    self.losses.lost_on_link += 1;
                    run.pending = None;
                    run.missed += 1;
                    if run.missed >= MISSED {
                        self.run = Some(run);
                        return Err(DeviceError::Silent {
                            port: self.port.clone(),
                            deadline_s: (READING * MISSED).as_secs_f64(),
                        });
                    }
                }
                (None, None) if now >= run.next => {
                    self.ask()?;
                    run.asked += 1;
                    run.pending = Some(now + READING);
                    run.next = now + self.settings.interval;
                }
                _ => {}
            }
            self.run = Some(run);
            if now >= deadline {
                return Ok(None);
            }
        }
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        let Some(run) = self.run.take() else {
            return Ok(Vec::new());
        };
        let mut last = Vec::new();
        if let Some(until) = run.pending {
            let found = self.receive(until)?;
            self.losses.lost_on_link += u64::from(found.is_none());
            last.extend(found.map(|reading| self.profile(reading, &run)));
        }
        Ok(last)
    }

    fn losses(&self) -> Losses {
        self.losses
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        if self.run.is_some() {
            return Err(checked_in_a_run(&self.port));
        }
        let deadline = Instant::now() + CONTROL;
        let state = self.link.control_in(STATE, &mut [0; 1], deadline);
        match state.map_err(|source| self.gone(source))? {
            Some(_) => Ok(Presence::Answered),
            None => Err(DeviceError::Silent {
                port: self.port.clone(),
                deadline_s: CONTROL.as_secs_f64(),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    #[test]
    fn both_forms_of_a_reading() {
        let mut bytes = b"01A-001.2340\r".to_vec();
        assert_eq!(
            reading(&bytes),
            Ok(Reading {
                value: -1.234,
                unit_mm: None
            })
        );
        bytes.resize(64, 0);
        assert_eq!(reading(&bytes).map(|r| r.value), Ok(-1.234));
        let nibbles = |text: &[u8]| reading(text).map(|r| (r.value, r.unit_mm));
        assert_eq!(nibbles(b"FFFF800123430"), Ok((-1.234, Some(1.0))));
        assert_eq!(nibbles(b"FFFF000050041"), Ok((0.05, Some(25.4))));
        for wrong in [
            &b""[..],
            b"01B+1",
            b"01A+",
            b"01A+1.2.3",
            b"01A+nan",
            b"FFFF80012343",
            b"FFFE000123430",
            b"FFFF100123430",
            b"FFFF00012A430",
            b"911",
        ] {
            assert!(reading(wrong).is_err(), "{wrong:?}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(26),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(prop_oneof![Just(b'F'), Just(b'0'), any::<u8>()], 0..100)) {
            if let Ok(found) = reading(&bytes) {
                prop_assert!(found.value.is_finite());
            }
        }
    }
}

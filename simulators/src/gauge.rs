//! Gauges and displays that send a line of text for each reading: Heidenhain ND, Mitutoyo MUX, Sylvac Opto-RS, Keyence DL-RS1A.
//!
//! Manuals: Heidenhain ND 221B/231B/281B (RS-232 interface), Mitutoyo QM-Height and the MUX-10 format, Sylvac Opto-RS, Keyence
//! DL-RS1A. Where they leave a choice, this device chooses: the ND takes 5 ms for an answer; the Sylvac echoes what it is sent
//! and answers `ID?` with its kind and number; writing 1 to data number 050 of the Keyence stops the laser.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::faults::Faults;
use crate::point::{Core, Fate, Record, Shared, SimulatedSensor, ramp};
use crate::wire::{Desk, Model, Next, Outbox, Wire};

/// Which of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dialect {
    /// Ctrl-B asks, 17 characters answer.
    HeidenhainNd,
    /// `1` and carriage return ask, `01A+001.2340` answers.
    Mitutoyo,
    /// `?` asks, `+012.3456` answers.
    Sylvac,
    /// `M0` asks for all amplifiers.
    Keyence,
}

/// What the gauge is.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// Which of them.
    pub dialect: Dialect,
    /// Channels of a multiplexer, amplifiers of a Keyence; 1 for the others.
    pub channels: usize,
    /// Who it says it is, where it can.
    pub serial: String,
    /// It counts in inches.
    pub inches: bool,
    /// Of the faults.
    pub seed: u64,
    /// What goes wrong.
    pub faults: Faults,
}

impl Setup {
    /// A faultless gauge of one channel in mm.
    pub fn new(dialect: Dialect, seed: u64) -> Setup {
        Setup {
            dialect,
            channels: 1,
            serial: "4711".to_owned(),
            inches: false,
            seed,
            faults: Faults::default(),
        }
    }
}

/// Starts a gauge on a wire.
///
/// # Errors
/// When the system gives no thread or event.
pub fn start(wire: Wire, setup: Setup) -> io::Result<SimulatedSensor> {
    let (faults, seed) = (setup.faults.clone(), setup.seed);
    SimulatedSensor::start(wire, &faults, seed, |shared, now| {
        Gauge::new(setup, shared, now)
    })
}

/// A gauge without a wire, and its side log.
pub fn desk(setup: Setup) -> (Desk, Arc<Shared>) {
    let shared = Arc::new(Shared::default());
    let seen = shared.clone();
    let faults = setup.faults.clone();
    let desk = Desk::new(&faults, |now| Gauge::new(setup, seen, now));
    (desk, shared)
}

const STX: u8 = 0x02;
const ENQ: u8 = 0x05;
const ACK: u8 = 0x06;
const NAK: u8 = 0x15;
const XON: u8 = 0x11;
const XOFF: u8 = 0x13;
/// Code in the side log where a word stood in the place of the (first) value.
pub const NO_VALUE: i64 = i64::MIN;
/// Characters that an ND takes before it is full.
const ND_BUFFER: usize = 100;

#[derive(Debug)]
struct Gauge {
    setup: Setup,
    core: Core,
    line: Vec<u8>,
    /// Readings so far.
    readings: u64,
    laser: bool,
    held: bool,
}

/// The ND's 17 characters.
fn nd_line(value: f64, digits: usize, inches: bool, fault: bool) -> String {
    let sign = if value < 0.0 { '-' } else { '+' };
    let unit = match (fault, inches) {
        (true, _) => '?',
        (false, true) => '"',
        (false, false) => ' ',
    };
    format!("{sign}{:>10.digits$} {unit}=A\r\n", value.abs())
}

impl Gauge {
    fn new(setup: Setup, shared: Arc<Shared>, now: Instant) -> Gauge {
        let core = Core::new(&setup.faults, setup.seed, shared);
        let mut gauge = Gauge {
            setup,
            core,
            line: Vec::new(),
            readings: 0,
            laser: true,
            held: false,
        };
        gauge.power_on(now);
        gauge
    }

    fn power_on(&mut self, now: Instant) {
        self.line.clear();
        self.core.hush();
        self.laser = true;
        self.held = false;
        self.core.shared.update(|status, _| status.starts += 1);
        self.publish();
        if self.setup.dialect == Dialect::Sylvac {
            self.core.answer(b"SY235\r", Duration::ZERO, now);
        }
    }

    /// Only the Keyence has a laser.
    fn publish(&self) {
        let laser = self.laser && self.setup.dialect == Dialect::Keyence && !self.core.silent;
        self.core.shared.update(|status, _| status.laser_on = laser);
    }

    /// What a channel shows, in units of 0.001 mm.
    fn reading(&self, channel: usize) -> i64 {
        ramp(self.readings + 50 * channel as u64, -20_000, 20_000, 400)
    }

    /// A value as the device writes it, or a word in its place; and whether it is a word.
    fn value(&mut self, channel: usize) -> (String, bool) {
        let faults = &self.core.faults;
        let (sentinel, overrun) = (faults.sentinel, faults.overrun);
        let mm = self.reading(channel) as f64 / 1000.0;
        let value = if self.setup.inches { mm / 25.4 } else { mm };
        let absent = self.core.happens(sentinel);
        let over = self.core.happens(overrun);
        let dark = self.setup.dialect == Dialect::Keyence && !self.laser;
        let text = match self.setup.dialect {
            Dialect::HeidenhainNd => {
                let digits = if self.setup.inches { 5 } else { 4 };
                nd_line(value, digits, self.setup.inches, absent || over)
            }
            Dialect::Mitutoyo if absent || over => "911\r".to_owned(),
            Dialect::Mitutoyo => format!("{:02}A{value:+09.4}\r", channel + 1),
            Dialect::Sylvac if absent => "ERR0\r".to_owned(),
            Dialect::Sylvac if over => "OV\r".to_owned(),
            Dialect::Sylvac => format!("{value:+09.4}\r"),
            Dialect::Keyence if absent => "+EE.EEE".to_owned(),
            Dialect::Keyence if over || !self.laser => "-99.998".to_owned(),
            Dialect::Keyence => format!("{value:+07.3}"),
        };
        (text, absent || over || dark)
    }

    /// Answers a question for one reading, of one channel or of all.
    fn measure(&mut self, channel: usize, before: &str, now: Instant, out: &mut Outbox) {
        let mut record = Record {
            number: self.readings as u32,
            code: self.reading(channel),
            fate: Fate::Sent,
        };
        let (mut text, word) = match self.setup.dialect {
            Dialect::Keyence => {
                let values = (0..self.setup.channels).map(|c| self.value(c));
                let (values, words): (Vec<String>, Vec<bool>) = values.unzip();
                (format!("M0,{}\r\n", values.join(",")), words[0])
            }
            _ => self.value(channel),
        };
        if word {
            record.code = NO_VALUE;
        }
        text.insert_str(0, before);
        self.readings += 1;
        let faults = self.core.faults.clone();
        if self.core.happens(faults.chatter) {
            // somebody pushed the button just before
            let unasked = match self.setup.dialect {
                Dialect::Keyence => "DR,+00.000\r\n".to_owned(),
                _ => text[before.len()..].to_owned(),
            };
            text.insert_str(0, &unasked);
        }
        if self.core.happens(faults.truncate) {
            text.truncate(text.len() / 2);
            self.core.say(text.as_bytes(), out);
            return self.core.log(record, Fate::Damaged, out);
        }
        if self.core.happens(faults.lose_frame) {
            return self.core.log(record, Fate::Damaged, out);
        }
        if faults.late.is_some() {
            self.core.answer(text.as_bytes(), Duration::ZERO, now);
            return self.core.log(record, Fate::Sent, out);
        }
        self.core.value(record, [text.as_bytes(), &[]], &[], out);
    }

    fn byte(&mut self, byte: u8, now: Instant, out: &mut Outbox) {
        if self.setup.dialect == Dialect::HeidenhainNd {
            match byte {
                STX => return self.nd_measure(now, out),
                ENQ => {
                    return self
                        .core
                        .answer(b"\x02             \r\n", Duration::ZERO, now);
                }
                XOFF => return self.held = true,
                XON => return self.held = false,
                _ => {}
            }
        }
        match byte {
            b'\n' if self.line.is_empty() => {}
            b'\r' | b'\n' => {
                let line = String::from_utf8_lossy(&self.line).into_owned();
                self.line.clear();
                self.command(&line, now, out);
            }
            _ if self.line.len() < ND_BUFFER => self.line.push(byte),
            _ => {}
        }
    }

    fn nd_measure(&mut self, now: Instant, out: &mut Outbox) {
        if self.core.refuses() {
            return self.core.answer(&[NAK], Duration::ZERO, now);
        }
        if !self.held {
            self.measure(0, "", now, out);
        }
    }

    fn command(&mut self, line: &str, now: Instant, out: &mut Outbox) {
        let refused = self.core.refuses();
        match self.setup.dialect {
            Dialect::HeidenhainNd => {
                let known = line.starts_with('T') && !refused;
                self.core
                    .answer(&[if known { ACK } else { NAK }], Duration::ZERO, now);
            }
            Dialect::Mitutoyo => {
                let channel = line.parse::<usize>().ok().filter(|_| !refused);
                let channel = channel.and_then(|c| c.checked_sub(1));
                match channel.filter(|&c| c < self.setup.channels) {
                    Some(channel) => self.measure(channel, "", now, out),
                    None => self.core.answer(b"912\r", Duration::ZERO, now),
                }
            }
            Dialect::Sylvac => self.sylvac(line, refused, now, out),
            Dialect::Keyence => self.keyence(line, refused, now, out),
        }
        self.publish();
    }

    fn sylvac(&mut self, line: &str, refused: bool, now: Instant, out: &mut Outbox) {
        let echo = format!("{line}\r");
        let answer = match line {
            _ if refused => "ERR1\r".to_owned(),
            "?" | "PRI" => return self.measure(0, &echo, now, out),
            "ID?" => format!("SY235 {}\r", self.setup.serial),
            "SET?" => "SET MM B1\r".to_owned(),
            "MM" => {
                self.setup.inches = false;
                String::new()
            }
            "IN" => {
                self.setup.inches = true;
                String::new()
            }
            "OUT0" | "OUT1" | "NOR" | "RST" | "KEY0" | "KEY1" => String::new(),
            _ => "ERR1\r".to_owned(),
        };
        self.core
            .answer((echo + &answer).as_bytes(), Duration::ZERO, now);
    }

    fn keyence(&mut self, line: &str, refused: bool, now: Instant, out: &mut Outbox) {
        let fields: Vec<&str> = line.split(',').collect();
        let amplifier = |id: &str| id.parse::<usize>().is_ok_and(|id| id < self.setup.channels);
        let answer = match fields.as_slice() {
            [name, ..] if refused => format!("ER,{name},22"),
            ["M0"] => return self.measure(0, "", now, out),
            ["MS"] => {
                let values: Vec<String> = (0..self.setup.channels)
                    .map(|c| format!("04,{}", self.value(c).0))
                    .collect();
                format!("MS,{}", values.join(","))
            }
            ["SR", id, "037" | "038"] if amplifier(id) => {
                let (value, _) = self.value(id.parse().unwrap_or_default());
                format!("{line},{value}")
            }
            ["SR", id, "050"] if amplifier(id) => format!("{line},{}", u8::from(!self.laser)),
            ["SW", id, "050", value] if amplifier(id) => {
                self.laser = *value == "0";
                format!("SW,{id},050")
            }
            ["AW", "050", value] => {
                self.laser = *value == "0";
                "AW,050".to_owned()
            }
            [name, ..] => format!("ER,{name},00"),
            [] => return,
        };
        self.core
            .answer(format!("{answer}\r\n").as_bytes(), Duration::ZERO, now);
    }
}

impl Model for Gauge {
    fn attached(&mut self, _: &mut Outbox) {
        self.core.shared.update(|status, _| status.plugged = true);
    }

    fn detached(&mut self, unplugged: bool, unsent: &[u32]) {
        self.core.detached(unplugged, unsent);
        if unplugged {
            if self.core.faults.other_identity {
                self.setup.serial.push('B');
            }
            self.power_on(Instant::now());
            self.core.shared.update(|status, _| status.laser_on = false);
        }
    }

    fn take(&mut self, bytes: &[u8], now: Instant, out: &mut Outbox) {
        for &byte in bytes {
            if !self.core.silent {
                self.byte(byte, now, out);
            }
        }
    }

    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next {
        if std::mem::take(&mut self.core.reboot) {
            self.power_on(now);
        }
        let next = self.core.due(now, out);
        if self.core.unplug {
            return Next::Unplug;
        }
        next.map_or(Next::Wait, Next::At)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nds_line_is_the_manuals() {
        let expected = [
            0x2D, 0x20, 0x20, 0x20, 0x20, 0x20, 0x20, 0x35, 0x2E, 0x32, 0x33, 0x20, 0x20, 0x3D,
            0x41, 0x0D, 0x0A,
        ];
        assert_eq!(nd_line(-5.23, 2, false, false).as_bytes(), expected);
        assert_eq!(nd_line(-5.23, 4, false, true), "-    5.2300 ?=A\r\n");
    }

    #[test]
    fn each_answers_its_question() {
        let ask = |dialect, question: &str| {
            let (mut desk, _) = desk(Setup::new(dialect, 1));
            let greeting = desk.read(Duration::ZERO);
            assert_eq!(greeting.is_some(), dialect == Dialect::Sylvac);
            desk.write(question.as_bytes());
            String::from_utf8(desk.read(Duration::from_secs(1)).unwrap()).unwrap()
        };
        assert_eq!(ask(Dialect::HeidenhainNd, "\x02"), "-   20.0000  =A\r\n");
        assert_eq!(ask(Dialect::Mitutoyo, "1\r"), "01A-020.0000\r");
        assert_eq!(ask(Dialect::Sylvac, "?\r"), "?\r-020.0000\r");
        assert_eq!(ask(Dialect::Keyence, "M0\r\n"), "M0,-20.000\r\n");
        assert_eq!(ask(Dialect::Keyence, "SW,07,050,1\r"), "ER,SW,00\r\n");
    }
}

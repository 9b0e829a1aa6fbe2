//! A laser distance sensor of the family optoNCDT 1220/1320/1420, played from its manual: 3-byte words over RS-422, and commands
//! in ASCII on the same pair of wires.
//!
//! Manual: optoNCDT 1420, sections on the RS-422 interface and on ASCII communication. Where the manual leaves a choice, this
//! device chooses: a reply is sent in one piece between two words; the laser is switched by LASERPOW; additional values are
//! called MEASCNT and TIMESTAMP, and follow the distance in that order; an unknown command is error E210.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::faults::Faults;
use crate::point::{Core, Fate, Record, Shared, SimulatedSensor, ramp};
use crate::wire::{Desk, Model, Next, Outbox, Wire};

/// What the sensor is.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// Serial number.
    pub serial: String,
    /// Measuring range, mm.
    pub range_mm: f64,
    /// Measurements a second.
    pub rate_hz: f64,
    /// Speed of the line, Bd; more values than it carries are replaced by a code.
    pub baud: u32,
    /// The measured value counter is sent.
    pub counter: bool,
    /// The time stamp is sent, in two values.
    pub timestamp: bool,
    /// Of the faults.
    pub seed: u64,
    /// What goes wrong.
    pub faults: Faults,
}

impl Setup {
    /// A 50 mm sensor at 4 kHz that sends distance and counter.
    pub fn new(serial: &str, seed: u64) -> Setup {
        Setup {
            serial: serial.to_owned(),
            range_mm: 50.0,
            rate_hz: 4000.0,
            baud: 921_600,
            counter: true,
            timestamp: false,
            seed,
            faults: Faults::default(),
        }
    }
}

/// Starts a sensor on a wire.
///
/// # Errors
/// When the system gives no thread or event.
pub fn start(wire: Wire, setup: Setup) -> io::Result<SimulatedSensor> {
    let (faults, seed) = (setup.faults.clone(), setup.seed);
    SimulatedSensor::start(wire, &faults, seed, |shared, now| {
        Sensor::new(setup, shared, now)
    })
}

/// A sensor without a wire, and its side log.
pub fn desk(setup: Setup) -> (Desk, Arc<Shared>) {
    let shared = Arc::new(Shared::default());
    let seen = shared.clone();
    let faults = setup.faults.clone();
    let desk = Desk::new(&faults, |now| Sensor::new(setup, seen, now));
    (desk, shared)
}

/// Codes in place of a distance.
const TOO_MUCH_DATA: u32 = 262_075;
const CODES: [u32; 6] = [262_076, 262_077, 262_078, 262_080, 262_081, 262_082];
const LASER_OFF: u32 = 262_082;
/// Codes of the measuring range.
const LOW: i64 = 643;
const HIGH: i64 = 64_877;
/// Measurements from one end of the ramp to the other.
const RAMP: u64 = 5000;
/// Most bytes that wait for the host before the line loses them.
const ROOM: usize = 64 * 1024;
const COUNTER: u32 = (1 << 18) - 1;

#[derive(Debug)]
struct Sensor {
    setup: Setup,
    core: Core,
    line: Vec<u8>,
    powered: Instant,
    /// The next measurement since power came.
    index: u64,
    /// Of these, the one that the counter calls 0.
    counter_zero: u64,
    /// Device time that the time stamp calls 0, in units of 10 us.
    time_zero: u64,
    output: bool,
    laser: bool,
    echo: bool,
    /// A reply that goes out between the next two words.
    reply: Vec<u8>,
}

/// One value of 18 bits in three bytes, low bits first.
fn word(first: bool, value: u32, swapped: bool) -> [u8; 3] {
    let six = |shift: u32| (value >> shift & 0x3F) as u8;
    let top = if first { 0x80 } else { 0xC0 };
    let mut bytes = [six(0), 0x40 | six(6), top | six(12)];
    if swapped {
        bytes.reverse();
    }
    bytes
}

impl Sensor {
    fn new(setup: Setup, shared: Arc<Shared>, now: Instant) -> Sensor {
        let core = Core::new(&setup.faults, setup.seed, shared);
        let mut sensor = Sensor {
            core,
            line: Vec::new(),
            powered: now,
            index: 0,
            counter_zero: 0,
            time_zero: 0,
            output: false,
            laser: true,
            echo: true,
            reply: Vec::new(),
            setup,
        };
        sensor.power_on(now);
        sensor
    }

    fn power_on(&mut self, now: Instant) {
        self.powered = now;
        self.index = 0;
        let near = self.core.faults.near_wrap;
        // at index 0 the counter reads what is added here
        let counter = if near { u64::from(COUNTER) - 100 } else { 0 };
        self.counter_zero = counter.wrapping_neg();
        let time = if near { u64::from(u32::MAX) - 0xFF } else { 0 };
        self.time_zero = time.wrapping_neg();
        self.output = self.core.faults.autostart;
        self.laser = true;
        self.line.clear();
        self.reply.clear();
        self.core.hush();
        self.core.shared.update(|status, _| status.starts += 1);
        self.publish();
    }

    fn publish(&self) {
        let (laser, output) = (self.laser && !self.core.silent, self.output);
        self.core.shared.update(|status, _| {
            status.laser_on = laser;
            status.streaming = output;
        });
    }

    /// Time from one measurement to the next, as a clock beside the sensor sees it.
    fn period(&self) -> Duration {
        let rate = self.setup.rate_hz * (1.0 + self.core.faults.drift_ppm * 1e-6);
        Duration::from_secs_f64(1.0 / rate)
    }

    fn due(&self) -> Instant {
        let after = self.index as f64 * self.period().as_secs_f64();
        self.powered + Duration::from_secs_f64(after)
    }

    fn values(&self) -> u32 {
        1 + u32::from(self.setup.counter) + 2 * u32::from(self.setup.timestamp)
    }

    /// Takes the next measurement and sends it.
    fn measure(&mut self, out: &mut Outbox) {
        let index = self.index;
        self.index += 1;
        if !self.output {
            return;
        }
        let faults = self.core.faults.clone();
        let bits_a_second = f64::from(self.values() * 30) * self.setup.rate_hz;
        let code =
            if bits_a_second > f64::from(self.setup.baud) || self.core.happens(faults.overrun) {
                TOO_MUCH_DATA
            } else if !self.laser {
                LASER_OFF
            } else if self.core.happens(faults.sentinel) {
                CODES[self.core.draw(CODES.len())]
            } else {
                ramp(index, LOW, HIGH, RAMP) as u32
            };
        let counter = index.wrapping_sub(self.counter_zero) as u32 & COUNTER;
        let record = Record {
            number: counter,
            code: code.into(),
            fate: Fate::Sent,
        };
        if out.len() > ROOM {
            return self.core.log(record, Fate::Unsent, out);
        }
        let swapped = faults.swap_bytes;
        let first = word(true, code, swapped);
        let mut further = Vec::with_capacity(9);
        if self.setup.counter {
            further.extend(word(false, counter, swapped));
        }
        if self.setup.timestamp {
            let time = (index as f64 / self.setup.rate_hz * 1e5) as u64;
            let time = time.wrapping_sub(self.time_zero);
            let (low, high) = (time as u32 & 0xFFFF, (time >> 16) as u32 & 0xFFFF);
            further.extend(word(false, low, swapped));
            further.extend(word(false, high, swapped));
        }
        let mut between = std::mem::take(&mut self.reply);
        if self.core.happens(faults.chatter) {
            between.extend(b"W320 Temperature\r\n->");
        }
        if self.core.happens(faults.truncate) {
            further.truncate(2);
            self.core.say(&first, out);
            self.core.say(&further, out);
            self.core.log(record, Fate::Damaged, out);
            return;
        }
        self.core.value(record, [&first, &further], &between, out);
        if self.core.silent {
            self.publish();
        }
    }

    fn command(&mut self, line: &str, now: Instant) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let Some((&name, rest)) = words.split_first() else {
            return self.reply("", now);
        };
        if self.core.refuses() {
            return self.reply("E202 Access denied\r\n", now);
        }
        let text = self.obey(&name.to_uppercase(), rest, now);
        self.publish();
        let text = match text {
            Ok(text) if text.is_empty() && self.echo => format!("{}\r\n", words.join(" ")),
            Ok(text) => text,
            Err(error) => format!("{error}\r\n"),
        };
        self.reply(&text, now);
    }

    /// Carries a command out; its answer, empty where the command itself is the answer.
    fn obey(&mut self, name: &str, rest: &[&str], now: Instant) -> Result<String, &'static str> {
        const BAD: &str = "E212 Command parameter not valid";
        match (name, rest) {
            ("GETINFO", []) => {
                let (serial, range) = (&self.setup.serial, self.setup.range_mm);
                return Ok(format!(
                    "GETINFO\r\nName: ILD1420-{range:.0}\r\nSerial: {serial}\r\nOption: 000\r\nArticle: 4120212\r\n\
                     Cable head: Wire\r\nMeasuring range: {range:.2}mm\r\nVersion: 001.010\r\nHardware-rev: 00\r\n\
                     Boot-version: 001.000\r\n"
                ));
            }
            ("GETOUTINFO_RS422", []) => {
                let mut text = "GETOUTINFO_RS422 DIST1".to_owned();
                if self.setup.counter {
                    text.push_str(" MEASCNT");
                }
                if self.setup.timestamp {
                    text.push_str(" TIMESTAMP_LO TIMESTAMP_HI");
                }
                return Ok(text + "\r\n");
            }
            ("OUTPUT", ["NONE"]) => self.output = false,
            ("OUTPUT", ["RS422"]) => {
                if !self.output {
                    let since = now.saturating_duration_since(self.powered).as_secs_f64();
                    self.index = (since / self.period().as_secs_f64()).ceil() as u64;
                }
                self.output = true;
            }
            ("LASERPOW", ["FULL"]) => self.laser = true,
            ("LASERPOW", ["OFF"]) => self.laser = false,
            ("OUTADD_RS422", list) => {
                self.setup.counter = list.contains(&"MEASCNT");
                self.setup.timestamp = list.contains(&"TIMESTAMP");
            }
            ("MEASRATE", [khz]) => {
                let khz: f64 = khz.parse().map_err(|_| BAD)?;
                let allowed = [0.25, 0.5, 1.0, 2.0, 4.0].contains(&khz);
                if !allowed {
                    return Err(BAD);
                }
                self.setup.rate_hz = khz * 1000.0;
                let since = now.saturating_duration_since(self.powered).as_secs_f64();
                let index = (since / self.period().as_secs_f64()).ceil() as u64;
                // the counter goes on from where it was
                self.counter_zero = self
                    .counter_zero
                    .wrapping_add(index.wrapping_sub(self.index));
                self.index = index;
            }
            ("RESETCNT", list) => {
                if list.is_empty() || list.contains(&"MEASCNT") {
                    self.counter_zero = self.index;
                }
                if list.is_empty() || list.contains(&"TIMESTAMP") {
                    self.time_zero = (self.index as f64 / self.setup.rate_hz * 1e5) as u64;
                }
            }
            ("ECHO", ["ON"]) => self.echo = true,
            ("ECHO", ["OFF"]) => self.echo = false,
            ("RESET", []) => self.power_on(now),
            (
                "HELP" | "LANGUAGE" | "TRIGGER" | "TRIGGERAT" | "TRIGGERCOUNT" | "OUTREDUCEDEVICE",
                _,
            ) => {}
            ("OUTPUT" | "LASERPOW" | "MEASRATE" | "ECHO", _) => return Err(BAD),
            _ => return Err("E210 Unknown command"),
        }
        Ok(String::new())
    }

    fn reply(&mut self, text: &str, now: Instant) {
        let text = format!("{text}->");
        if self.output && self.core.faults.late.is_none() {
            self.reply.extend(text.bytes());
        } else {
            self.core.answer(text.as_bytes(), Duration::ZERO, now);
        }
    }
}

impl Model for Sensor {
    fn attached(&mut self, _: &mut Outbox) {
        self.core.shared.update(|status, _| status.plugged = true);
    }

    fn detached(&mut self, unplugged: bool, unsent: &[u32]) {
        self.core.detached(unplugged, unsent);
        if unplugged {
            // its supply comes through the same plug
            if self.core.faults.other_identity {
                self.setup.serial.push_str("-B");
            }
            self.power_on(Instant::now());
            let idle = self.core.faults.autostart;
            self.core.shared.update(|status, _| {
                status.laser_on = false;
                status.streaming &= idle;
            });
        }
    }

    fn take(&mut self, bytes: &[u8], now: Instant, _: &mut Outbox) {
        for &byte in bytes {
            match byte {
                b'\r' | b'\n' if self.line.is_empty() => {}
                b'\r' | b'\n' => {
                    let line = String::from_utf8_lossy(&self.line).into_owned();
                    self.line.clear();
                    if !self.core.silent {
                        self.command(&line, now);
                    }
                }
                _ if self.line.len() < 256 => self.line.push(byte),
                _ => {}
            }
        }
    }

    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next {
        if std::mem::take(&mut self.core.reboot) {
            self.power_on(now);
        }
        if self.core.unplug {
            return Next::Unplug;
        }
        let answer = self.core.due(now, out);
        if self.output {
            // as many as a busy host gets at once, and at least the one that is due
            for _ in 0..64 {
                if self.due() > now || self.core.unplug || self.core.reboot {
                    break;
                }
                self.measure(out);
            }
            let due = self.due();
            return Next::At(answer.map_or(due, |answer| answer.min(due)));
        }
        answer.map_or(Next::Wait, Next::At)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_those_of_the_manual() {
        assert_eq!(word(true, 643, false), [0x03, 0x4A, 0x80]);
        assert_eq!(word(true, 32_760, false), [0x38, 0x7F, 0x87]);
        assert_eq!(word(false, 32_760, false), [0x38, 0x7F, 0xC7]);
        assert_eq!(word(true, 64_877, false), [0x2D, 0x75, 0x8F]);
        assert_eq!(word(true, TOO_MUCH_DATA, false), [0x3B, 0x7E, 0xBF]);
    }

    #[test]
    fn a_minute_of_device_time_is_as_many_words_as_the_rate_says() {
        let (mut desk, shared) = desk(Setup::new("S", 1));
        desk.write(b"OUTPUT RS422\r\n");
        let mut bytes = 0;
        while let Some(some) = desk.read(Duration::from_secs(60)) {
            bytes += some.len();
        }
        let values = shared.look(|truth| truth.values.len());
        // one more than in 60 s, since both ends count
        assert_eq!(values, 240_001);
        // the reply is between the first two words
        assert_eq!(bytes, 240_001 * 6 + "OUTPUT RS422\r\n->".len());
    }

    #[test]
    fn counter_and_time_begin_shortly_before_they_wrap() {
        let setup = Setup {
            faults: "near-wrap".parse().unwrap(),
            ..Setup::new("S", 1)
        };
        let (mut desk, shared) = desk(setup);
        desk.write(b"OUTPUT RS422\r\n");
        while desk.read(Duration::from_secs(1)).is_some() {}
        let numbers: Vec<u32> = shared.look(|t| t.values.iter().map(|v| v.number).collect());
        assert!(numbers[0] > 262_000, "{}", numbers[0]);
        assert!(numbers.contains(&0) && numbers.contains(&262_143));
    }

    #[test]
    fn commands_are_answered_with_a_prompt() {
        let (mut desk, _) = desk(Setup::new("15030002", 1));
        let mut ask = |text: &str| {
            desk.write(text.as_bytes());
            String::from_utf8(desk.read(Duration::ZERO).unwrap()).unwrap()
        };
        assert!(ask("GETINFO\r\n").contains("Serial: 15030002\r\n"));
        assert_eq!(ask("LASERPOW OFF\r\n"), "LASERPOW OFF\r\n->");
        assert_eq!(
            ask("MEASRATE 3\r"),
            "E212 Command parameter not valid\r\n->"
        );
        assert_eq!(ask("XYZ\n"), "E210 Unknown command\r\n->");
    }
}

//! A bus of laser distance sensors of the family RF60x (also sold as Acuity AR100), played from its manual: requests that begin
//! with the address, answers of one nibble a byte.
//!
//! Manual: Riftek RF602 and RF605, chapters on the serial protocol. Where the manual leaves a choice, this device chooses: a
//! sensor whose laser is off measures 0; the first answer after power has the counter 1; a request that it does not know is
//! no request, but ends a stream like any other.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::faults::Faults;
use crate::point::{Core, Fate, Record, Shared, SimulatedSensor, ramp};
use crate::wire::{Desk, Model, Next, Outbox, Wire};

/// One sensor on the bus.
#[derive(Debug, Clone, PartialEq)]
pub struct Member {
    /// 1 to 127.
    pub address: u8,
    /// Serial number.
    pub serial: u16,
    /// Base distance, mm.
    pub base_mm: u16,
    /// Range, mm.
    pub range_mm: u16,
}

/// What hangs on the bus.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// The sensors.
    pub members: Vec<Member>,
    /// Speed of the line, Bd.
    pub baud: u32,
    /// Of the faults.
    pub seed: u64,
    /// What goes wrong.
    pub faults: Faults,
}

impl Setup {
    /// As many 50 mm sensors as serial numbers, from address 1, at 460800 Bd.
    pub fn new(serials: &[u16], seed: u64) -> Setup {
        let member = |(address, &serial)| Member {
            address,
            serial,
            base_mm: 80,
            range_mm: 50,
        };
        Setup {
            members: (1..).zip(serials).map(member).collect(),
            baud: 460_800,
            seed,
            faults: Faults::default(),
        }
    }
}

/// Starts the bus on a wire.
///
/// # Errors
/// When the system gives no thread or event.
pub fn start(wire: Wire, setup: Setup) -> io::Result<SimulatedSensor> {
    let (faults, seed) = (setup.faults.clone(), setup.seed);
    SimulatedSensor::start(wire, &faults, seed, |shared, now| {
        Bus::new(setup, shared, now)
    })
}

/// The bus without a wire, and its side log.
pub fn desk(setup: Setup) -> (Desk, Arc<Shared>) {
    let shared = Arc::new(Shared::default());
    let seen = shared.clone();
    let faults = setup.faults.clone();
    let desk = Desk::new(&faults, |now| Bus::new(setup, seen, now));
    (desk, shared)
}

/// The whole range, in the unit of results.
const FULL: i64 = 0x4000;
const RAMP: u64 = 1000;
const ROOM: usize = 64 * 1024;
const LASER: usize = 0x00;
const PERIOD_LOW: usize = 0x08;
const PERIOD_HIGH: usize = 0x09;
const AUTOSTART: usize = 0x89;

#[derive(Debug)]
struct Sensor {
    member: Member,
    parameters: [u8; 256],
    flash: [u8; 256],
    counter: u8,
    latched: Option<u16>,
    /// Number of the last result that was sent, so that SB tells a new one.
    sent: Option<u64>,
    streaming: bool,
    next: Instant,
}

#[derive(Debug)]
struct Bus {
    setup: Setup,
    core: Core,
    sensors: Vec<Sensor>,
    powered: Instant,
    /// Address, code and message nibbles of a request under way.
    request: Vec<u8>,
}

fn defaults() -> [u8; 256] {
    let mut p = [0; 256];
    p[LASER] = 1;
    p[0x01] = 1;
    p[0x06] = 1;
    [p[PERIOD_LOW], p[PERIOD_HIGH]] = 5000_u16.to_le_bytes();
    p
}

/// Message bytes that follow a code.
fn message_bytes(code: u8) -> Option<usize> {
    Some(match code {
        1 | 5 | 6 | 7 | 8 => 0,
        2 | 4 => 1,
        3 => 2,
        _ => return None,
    })
}

impl Sensor {
    fn period(&self) -> Duration {
        let us = u16::from_le_bytes([self.parameters[PERIOD_LOW], self.parameters[PERIOD_HIGH]]);
        Duration::from_micros(us.max(1).into())
    }

    /// One answer: a nibble a byte, the low one first, under one counter.
    fn answer(&mut self, fresh: bool, payload: &[u8], swapped: bool) -> Vec<u8> {
        self.counter = (self.counter + 1) & 3;
        let top = 0x80 | u8::from(fresh) << 6 | self.counter << 4;
        let nibbles = payload.iter().flat_map(|&byte| {
            let [low, high] = [byte & 15, byte >> 4];
            if swapped { [high, low] } else { [low, high] }
        });
        nibbles.map(|nibble| top | nibble).collect()
    }
}

impl Bus {
    fn new(setup: Setup, shared: Arc<Shared>, now: Instant) -> Bus {
        let core = Core::new(&setup.faults, setup.seed, shared);
        let sensor = |member: &Member| Sensor {
            member: member.clone(),
            parameters: defaults(),
            flash: defaults(),
            counter: 0,
            latched: None,
            sent: None,
            streaming: false,
            next: now,
        };
        let mut bus = Bus {
            sensors: setup.members.iter().map(sensor).collect(),
            core,
            powered: now,
            request: Vec::new(),
            setup,
        };
        if bus.core.faults.autostart {
            for sensor in &mut bus.sensors {
                sensor.flash[AUTOSTART] = 1;
            }
        }
        bus.power_on(now);
        bus
    }

    fn power_on(&mut self, now: Instant) {
        self.powered = now;
        self.request.clear();
        self.core.hush();
        for sensor in &mut self.sensors {
            sensor.parameters = sensor.flash;
            sensor.counter = 0;
            sensor.latched = None;
            sensor.sent = None;
            sensor.streaming = sensor.parameters[AUTOSTART] == 1;
            sensor.next = now;
        }
        self.core.shared.update(|status, _| status.starts += 1);
        self.publish();
    }

    fn publish(&self) {
        let silent = self.core.silent;
        let laser = self.sensors.iter().any(|s| s.parameters[LASER] != 0) && !silent;
        let streaming = self.sensors.iter().any(|s| s.streaming);
        self.core.shared.update(|status, _| {
            status.laser_on = laser;
            status.streaming = streaming;
        });
    }

    /// Number and value of the result that a sensor has at a time.
    fn result(&mut self, which: usize, now: Instant) -> (u64, u16) {
        let sensor = &self.sensors[which];
        let age = now.saturating_duration_since(self.powered).as_nanos();
        let number = (age / sensor.period().as_nanos()) as u64;
        if let Some(latched) = sensor.latched {
            return (number, latched);
        }
        let faults = &self.core.faults;
        let (sentinel, overrun) = (faults.sentinel, faults.overrun);
        let lit = sensor.parameters[LASER] != 0;
        if !lit || self.core.happens(sentinel) || self.core.happens(overrun) {
            return (number, 0);
        }
        // every sensor of the bus sees something else; never 0, which means that nothing is there
        let shift = which as u64 * 100;
        (number, ramp(number + shift, 1, FULL, RAMP) as u16)
    }

    fn byte(&mut self, byte: u8, now: Instant, out: &mut Outbox) {
        if byte & 0x80 == 0 {
            self.request = vec![byte];
        } else if !self.request.is_empty() {
            self.request.push(byte & 0x0F);
        }
        let Some(&code) = self.request.get(1) else {
            return;
        };
        let Some(needed) = message_bytes(code) else {
            self.stop_streams();
            self.request.clear();
            return;
        };
        if self.request.len() < 2 + 2 * needed {
            return;
        }
        let request = std::mem::take(&mut self.request);
        let message: Vec<u8> = request[2..].chunks(2).map(|n| n[0] | n[1] << 4).collect();
        self.stop_streams();
        if self.core.silent {
            return;
        }
        let refused = self.core.refuses();
        for which in 0..self.sensors.len() {
            let address = self.sensors[which].member.address;
            if refused || (request[0] != 0 && request[0] != address) {
                continue;
            }
            if let Some((answer, record)) = self.obey(which, code, &message, now) {
                if request[0] == 0 {
                    continue;
                }
                match record {
                    Some(record) if self.core.faults.late.is_none() => {
                        self.core.value(record, [&answer, &[]], &[], out);
                    }
                    _ => self.core.answer(&answer, Duration::ZERO, now),
                }
            }
        }
        self.publish();
    }

    fn stop_streams(&mut self) {
        for sensor in &mut self.sensors {
            sensor.streaming = false;
        }
        self.publish();
    }

    /// Carries a request out; its answer, with a record where it is a result.
    fn obey(
        &mut self,
        which: usize,
        code: u8,
        message: &[u8],
        now: Instant,
    ) -> Option<(Vec<u8>, Option<Record>)> {
        let swapped = self.core.faults.swap_bytes;
        let (number, value) = match code {
            5 => {
                let lit = self.result(which, now).1;
                self.sensors[which].latched = Some(lit);
                return None;
            }
            6 => self.result(which, now),
            _ => (0, 0),
        };
        let sensor = &mut self.sensors[which];
        let payload = match (code, message) {
            (1, _) => {
                let m = &sensor.member;
                let mut payload = vec![0x3F, 0x90];
                for word in [m.serial, m.base_mm, m.range_mm] {
                    payload.extend(word.to_le_bytes());
                }
                payload
            }
            (2, &[parameter]) => vec![sensor.parameters[usize::from(parameter)]],
            (3, &[parameter, value]) => {
                sensor.parameters[usize::from(parameter)] = value;
                return None;
            }
            (4, &[0xAA]) => {
                sensor.flash = sensor.parameters;
                vec![0xAA]
            }
            (4, &[0x69]) => {
                sensor.parameters = defaults();
                vec![0x69]
            }
            (6, _) => {
                sensor.latched = None;
                let fresh = sensor.sent != Some(number);
                sensor.sent = Some(number);
                let record = Record {
                    number: number as u32,
                    code: value.into(),
                    fate: Fate::Sent,
                };
                let bytes = sensor.answer(fresh, &value.to_le_bytes(), swapped);
                return Some((bytes, Some(record)));
            }
            (7, _) => {
                sensor.streaming = true;
                let period = sensor.period();
                let age = now.saturating_duration_since(self.powered);
                let periods = age.as_nanos() / period.as_nanos() + 1;
                sensor.next =
                    self.powered + Duration::from_nanos((periods * period.as_nanos()) as u64);
                return None;
            }
            _ => return None,
        };
        Some((sensor.answer(false, &payload, swapped), None))
    }

    /// Time that one result takes on the line: four characters of 11 bits.
    fn on_line(&self) -> Duration {
        Duration::from_secs_f64(44.0 / f64::from(self.setup.baud))
    }

    /// Sends one result of a stream.
    fn burst(&mut self, which: usize, out: &mut Outbox) {
        let due = self.sensors[which].next;
        let (number, value) = self.result(which, due);
        let swapped = self.core.faults.swap_bytes;
        let apart = self.sensors[which].period().max(self.on_line());
        let sensor = &mut self.sensors[which];
        sensor.next += apart;
        let bytes = sensor.answer(true, &value.to_le_bytes(), swapped);
        let record = Record {
            number: number as u32,
            code: value.into(),
            fate: Fate::Sent,
        };
        if out.len() > ROOM {
            return self.core.log(record, Fate::Unsent, out);
        }
        let faults = self.core.faults.clone();
        if self.core.happens(faults.chatter) {
            // two nibbles of somebody else's answer, under another counter
            let stray = (bytes[0] & 0xF0 ^ 0x20) & 0xBF;
            self.core.say(&[stray | 5, stray | 10], out);
        }
        if self.core.happens(faults.truncate) {
            self.core.say(&bytes[..2], out);
            return self.core.log(record, Fate::Damaged, out);
        }
        let again = self.core.happens(faults.duplicate);
        self.core.value(record, [&bytes, &[]], &[], out);
        if again {
            self.core.say(&bytes, out);
        }
    }
}

impl Model for Bus {
    fn attached(&mut self, _: &mut Outbox) {
        self.core.shared.update(|status, _| status.plugged = true);
    }

    fn detached(&mut self, unplugged: bool, unsent: &[u32]) {
        self.core.detached(unplugged, unsent);
        if unplugged {
            if self.core.faults.other_identity {
                for sensor in &mut self.sensors {
                    sensor.member.serial ^= 0x0100;
                }
            }
            self.power_on(Instant::now());
            self.core.shared.update(|status, _| status.laser_on = false);
        }
    }

    fn take(&mut self, bytes: &[u8], now: Instant, out: &mut Outbox) {
        for &byte in bytes {
            self.byte(byte, now, out);
        }
    }

    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next {
        if std::mem::take(&mut self.core.reboot) {
            self.power_on(now);
        }
        if self.core.unplug {
            return Next::Unplug;
        }
        let mut next = self.core.due(now, out);
        for which in 0..self.sensors.len() {
            for _ in 0..64 {
                let sensor = &self.sensors[which];
                let stop = self.core.unplug || self.core.reboot || self.core.silent;
                if !sensor.streaming || sensor.next > now || stop {
                    break;
                }
                self.burst(which, out);
            }
            let sensor = &self.sensors[which];
            if sensor.streaming && !self.core.silent {
                next = Some(next.map_or(sensor.next, |due| due.min(sensor.next)));
            }
        }
        if self.core.silent {
            self.publish();
        }
        next.map_or(Next::Wait, Next::At)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(desk: &mut Desk, request: &[u8]) -> Vec<u8> {
        desk.write(request);
        desk.read(desk.now()).unwrap_or_default()
    }

    #[test]
    fn the_manuals_examples() {
        let mut setup = Setup::new(&[0x4321], 1);
        setup.members[0].base_mm = 0x0050;
        let (mut desk, _) = desk(setup);
        let identity = [
            0x9F, 0x93, 0x90, 0x99, 0x91, 0x92, 0x93, 0x94, 0x90, 0x95, 0x90, 0x90, 0x92, 0x93,
            0x90, 0x90,
        ];
        assert_eq!(ask(&mut desk, &[0x01, 0x81]), identity);
        assert_eq!(ask(&mut desk, &[0x01, 0x83, 0x82, 0x80, 0x84, 0x80]), []);
        assert_eq!(ask(&mut desk, &[0x01, 0x82, 0x82, 0x80]), [0xA4, 0xA0]);
        let result = ask(&mut desk, &[0x01, 0x86]);
        assert!(
            result.iter().all(|byte| byte & 0xF0 == 0xF0),
            "SB and counter 3: {result:x?}"
        );
        for request in [
            [0x01, 0x83, 0x89, 0x80, 0x80, 0x83],
            [0x01, 0x83, 0x88, 0x80, 0x89, 0x83],
        ] {
            assert_eq!(ask(&mut desk, &request), []);
        }
        assert_eq!(
            ask(&mut desk, &[0x01, 0x82, 0x89, 0x80]),
            [0x80, 0x83],
            "30h"
        );
    }

    #[test]
    fn any_request_ends_a_stream() {
        let (mut desk, shared) = desk(Setup::new(&[1, 2], 1));
        desk.write(&[0x01, 0x87]);
        let second = Duration::from_secs(1);
        while desk.read(second).is_some() {}
        // 5000 us apart
        assert_eq!(shared.look(|truth| truth.values.len()), 200);
        desk.write(&[0x02, 0x81]);
        assert_eq!(desk.read(second).unwrap().len(), 16);
        assert_eq!(desk.read(2 * second), None);
    }

    #[test]
    fn a_broadcast_latches_all_and_is_not_answered() {
        let (mut desk, _) = desk(Setup::new(&[1, 2], 1));
        assert_eq!(ask(&mut desk, &[0x00, 0x85]), []);
        let early = ask(&mut desk, &[0x01, 0x86]);
        let _ = desk.read(Duration::from_secs(1));
        let late = ask(&mut desk, &[0x02, 0x86]);
        let value = |b: &[u8]| b.iter().rev().fold(0, |v, n| v << 4 | u32::from(n & 15));
        // the second looks 100 results ahead of the first, at the same moment
        assert_eq!(value(&late) - value(&early), (0x3FFF * 100 / 1000) as u32);
    }
}

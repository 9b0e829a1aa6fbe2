//! Laser distance sensors of the family Riftek RF60x (RF602 to RF607), sold as Acuity AR100 and AR500 too, alone or several on
//! one RS-485 bus.
//!
//! Manuals: RF602 rev. 1.2.0 and RF605, chapters on the serial protocol; Acuity AR100 and AR500. Quirks: even parity (the AR500
//! has odd); no check and no length, only two bits that count the answers; writing is not answered and is read back here; any
//! request to any address ends a stream, so a sensor alone on its line streams, and several are latched together and asked in
//! turn; a sensor may stream since it was switched on.
//!
//! What the manuals at hand do not settle is a setting: whether a result of 0 means that nothing is there (`no_object`), the
//! speed beyond 460800 Bd, the parity.
//!
//! # Configuration
//!
//! ```toml
//! port = "/dev/ttyUSB0"         # or one of the next three in its place
//! # usb_serial = "A50285BI"     # serial number of the USB converter: the same after plugging in again
//! # usb_id = "0403:6001"        # vendor and product of a converter without one
//! # address = "10.0.0.7:4001"   # TCP, as of a serial server
//! baud = 9600                   # serial ports only
//! parity = "even"               # "even", "odd" or "none"
//! addresses = [1]               # of the sensors on the bus, 1 to 127
//! serial_numbers = [17185]      # of the sensors, in the same order: others are refused
//! sampling_us = 5000            # from one result to the next; as the sensor has it where not given
//! no_object = "zero"            # a result of 0 means that nothing is there; "none": it is a distance
//! switch_laser = true           # on at the start of a run, off at opening and at the end
//! columns = 1                   # values in a profile: more than 1 for one sensor that travels along x
//! # pitch_mm = 0.05             # from one value to the next along x, for several columns or several sensors
//! first_mm = 0.0                # x of the first value
//! encoder_step = 20             # encoder counts between results, where the encoder triggers the sensor
//! rate_hz = 50.0                # how often several sensors are asked
//! ```

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::capture::Profile;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Presence, Profiler, Setup,
    checked_in_a_run, same,
};
use crate::error::{DecodeError, DeviceError};
use crate::link::pump::Pump;
use crate::link::{Links, Parity, Target};
use crate::point::{Layout, Rows, Value};
use crate::settings::Keys;

mod burst;
mod count;

pub use burst::{ANSWER_MAX, Answer, Decoder};
pub use count::Count;

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "rf60x",
    summary: "laser distance sensors Riftek RF60x and Acuity AR100, alone or on an RS-485 bus",
    configure,
};

const BAUD: u32 = 9600;
/// How long one answer is waited for that a sensor gives at once.
const REPLY: Duration = Duration::from_secs(1);
/// How often a request is sent before the sensor counts as silent.
const TRIES: u32 = 3;
/// How long the bus must be quiet after a stream was stopped: what a USB converter holds back, twice.
const QUIET: Duration = Duration::from_millis(50);
/// Rounds without any answer, after which a bus is silent.
const MISSED_ROUNDS: u32 = 3;
/// Full range in the unit of results.
const FULL: u16 = 0x4000;

/// Request codes of the manual.
mod code {
    pub const IDENTIFY: u8 = 1;
    pub const READ: u8 = 2;
    pub const WRITE: u8 = 3;
    pub const LATCH: u8 = 5;
    pub const RESULT: u8 = 6;
    pub const START: u8 = 7;
    pub const STOP: u8 = 8;
}

/// Parameters of the manual.
mod parameter {
    pub const LASER: u8 = 0x00;
    pub const CONTROL: u8 = 0x02;
    pub const PERIOD_LOW: u8 = 0x08;
    pub const PERIOD_HIGH: u8 = 0x09;
}

/// A request: the address, the code, and the message in nibbles, low one first.
pub fn request(address: u8, code: u8, message: &[u8]) -> Vec<u8> {
    let nibbles = message.iter().flat_map(|byte| [byte & 15, byte >> 4]);
    let tail = nibbles.map(|nibble| 0x80 | nibble);
    [address & 0x7F, 0x80 | code & 15]
        .into_iter()
        .chain(tail)
        .collect()
}

// ---- Settings ---------------------------------------------------------------------------------------------------------

#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    addresses: Vec<u8>,
    serial_numbers: Option<Vec<u16>>,
    sampling_us: Option<u16>,
    zero_is_nothing: bool,
    switch_laser: bool,
    layout: Layout,
    /// Between rounds of several sensors.
    round: Duration,
}

fn configure(table: toml::Table) -> Configured {
    const PARITIES: [(&str, Parity); 3] = [
        ("even", Parity::Even),
        ("odd", Parity::Odd),
        ("none", Parity::None),
    ];
    let mut keys = Keys::new(table);
    let mut target = keys.target(BAUD);
    let parity = keys.choice("parity", &PARITIES).unwrap_or(Parity::Even);
    if let Some(Target::Serial { line, .. }) = &mut target {
        line.parity = parity;
    }
    let expected = "addresses of 1 to 127, each once, as in [1]";
    let addresses = keys.read("addresses", expected, |value| {
        let list = integers(value, 1..=127)?;
        let list: Vec<u8> = list.into_iter().map(|address| address as u8).collect();
        let single = list.iter().enumerate().all(|(i, a)| !list[..i].contains(a));
        (single && !list.is_empty()).then_some(list)
    });
    let addresses = addresses.unwrap_or_else(|| vec![1]);
    let n = addresses.len();
    let expected = format!("{n} whole numbers of 0 to 65535, one for each address");
    let serial_numbers = keys.read("serial_numbers", &expected, |value| {
        let list = integers(value, 0..=65_535)?;
        (list.len() == n).then(|| list.into_iter().map(|serial| serial as u16).collect())
    });
    let sampling_us = keys.integer("sampling_us", 10..=65_535);
    let zero_is_nothing = keys.choice("no_object", &[("zero", true), ("none", false)]);
    let switch_laser = keys.flag("switch_laser");
    let layout = layout(&mut keys, n);
    let rate_hz = keys.number("rate_hz", 0.01..=1000.0).unwrap_or(50.0);
    keys.finish()?;
    let Some(target) = target else {
        // Without a mistake there is a target: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        target,
        addresses,
        serial_numbers,
        // Within its range.
        sampling_us: sampling_us.map(|us| us as u16),
        zero_is_nothing: zero_is_nothing.unwrap_or(true),
        switch_laser: switch_laser.unwrap_or(true),
        layout,
        round: Duration::from_secs_f64(1.0 / rate_hz),
    }))
}

/// Several sensors are the columns of a profile, `pitch_mm` apart.
fn layout(keys: &mut Keys, sensors: usize) -> Layout {
    let layout = Layout::read(keys);
    if sensors == 1 {
        return layout;
    }
    if layout.columns != 1 {
        let expected = "none, where several sensors are the columns";
        keys.wrong("columns", layout.columns, expected);
    }
    if layout.pitch_mm == 0.0 {
        keys.wrong(
            "pitch_mm",
            "nothing",
            "the distance from sensor to sensor, mm",
        );
    }
    if layout.encoder_step.is_some() {
        keys.wrong(
            "encoder_step",
            "given",
            "none, where several sensors are asked",
        );
    }
    Layout {
        columns: sensors as u32,
        ..layout
    }
}

fn integers(value: &toml::Value, range: std::ops::RangeInclusive<i64>) -> Option<Vec<i64>> {
    let list = value.as_array()?.iter();
    list.map(|one| one.as_integer().filter(|one| range.contains(one)))
        .collect()
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let mut bus = Bus {
            pump: Pump::open(links, &self.target)?,
            decoder: Decoder::default(),
            identity: Identity {
                vendor: "Riftek".into(),
                model: String::new(),
                serial: String::new(),
                firmware: String::new(),
            },
            ranges_mm: Vec::new(),
            period: Duration::from_millis(5),
            by_time: true,
            run: None,
            account: Losses::default(),
            settings: self.clone(),
        };
        bus.introduce()?;
        Ok(Instrument::Profiler(Box::new(bus)))
    }
}

// ---- A stream ---------------------------------------------------------------------------------------------------------

/// The stream of one sensor: bytes to profiles. Pure but for the times that come with the bytes.
#[derive(Debug)]
pub struct Stream {
    range_mm: f64,
    zero_is_nothing: bool,
    period: Duration,
    count: Count,
    rows: Rows,
    damaged: u64,
    skipped_before: u64,
}

impl Stream {
    /// For a sensor with a range, whose results come by time, `period` apart.
    pub fn new(range_mm: f64, zero_is_nothing: bool, period: Duration, layout: Layout) -> Stream {
        Stream {
            range_mm,
            zero_is_nothing,
            period,
            count: Count::new(Some(period)),
            rows: Rows::new(layout),
            damaged: 0,
            skipped_before: 0,
        }
    }

    /// Takes one burst; `skipped_bytes` is what the decoder threw away so far.
    pub fn take(&mut self, answer: &Answer, skipped_bytes: u64, host_time: Instant) {
        let number = self.count.number(answer.counter, skipped_bytes, host_time);
        match distance_mm(
            answer.word(0).unwrap_or(u16::MAX),
            self.range_mm,
            self.zero_is_nothing,
        ) {
            Some(z_mm) => {
                let ns = self.period.as_nanos().saturating_mul(number.into());
                let value = Value {
                    z_mm,
                    intensity: None,
                    device_time_ns: u64::try_from(ns).unwrap_or(u64::MAX),
                    host_time,
                };
                self.rows.take(number, value);
            }
            None => self.damaged += 1,
        }
    }

    /// The oldest profile.
    pub fn pop(&mut self) -> Option<Profile> {
        self.rows.pop()
    }

    /// Ends the profile under way.
    pub fn finish(&mut self) {
        self.rows.finish();
    }

    /// By so many values [`Stream::losses`] may be wrong, either way: [`Count::unsure`].
    pub fn unsure(&self) -> u64 {
        self.count.unsure
    }

    /// What was lost; `skipped_bytes` is what the decoder threw away so far.
    pub fn losses(&self, skipped_bytes: u64) -> Losses {
        Losses {
            lost_on_link: self.count.lost + self.damaged,
            rejected: self.damaged,
            skipped_bytes: skipped_bytes - self.skipped_before,
            ..self.rows.losses
        }
    }
}

/// A result in mm: `NaN` where nothing is there, nothing where no sensor sends such a value.
fn distance_mm(result: u16, range_mm: f64, zero_is_nothing: bool) -> Option<f64> {
    match result {
        0 if zero_is_nothing => Some(f64::NAN),
        0..=FULL => Some(f64::from(result) * range_mm / f64::from(FULL)),
        _ => None,
    }
}

/// Several sensors, asked in rounds.
#[derive(Debug)]
struct Rounds {
    due: Instant,
    number: u64,
    rows: VecDeque<Profile>,
    missed: u32,
    losses: Losses,
}

enum Run {
    Stream(Box<Stream>, Instant),
    Rounds(Rounds),
}

// ---- Device -----------------------------------------------------------------------------------------------------------

struct Bus {
    pump: Pump,
    decoder: Decoder,
    identity: Identity,
    /// In the order of the addresses.
    ranges_mm: Vec<f64>,
    period: Duration,
    /// Results come by time, so that a stream does not pause.
    by_time: bool,
    run: Option<Run>,
    account: Losses,
    settings: Settings,
}

impl Bus {
    /// Ends what may stream, learns who is there, and sets them up.
    fn introduce(&mut self) -> Result<(), DeviceError> {
        self.hush()?;
        let mut serials = Vec::new();
        for (place, address) in self.settings.addresses.clone().into_iter().enumerate() {
            let answer = self.ask(address, code::IDENTIFY, &[], 8)?;
            let payload = answer.payload().to_vec();
            let word = |at| answer.word(at).unwrap_or(0);
            let (serial, range_mm) = (word(2), word(6));
            let expected = self
                .settings
                .serial_numbers
                .as_ref()
                .map(|list| list[place]);
            if let Some(expected) = expected.filter(|&expected| expected != serial) {
                return Err(DeviceError::WrongDevice {
                    port: format!("{}, address {address}", self.pump.port()),
                    found: serial.to_string(),
                    expected: expected.to_string(),
                });
            }
            if range_mm == 0 {
                return Err(self.bad(DecodeError::Field {
                    message: "identify",
                    field: "range",
                    found: 0,
                    allowed: "1 or more",
                }));
            }
            self.ranges_mm.push(range_mm.into());
            serials.push(serial.to_string());
            self.identity.model = format!("type {:02X}h, {range_mm} mm", payload[0]);
            self.identity.firmware = format!("{:02X}h", payload[1]);
        }
        self.identity.serial = serials.join(", ");
        for address in self.settings.addresses.clone() {
            if let Some(us) = self.settings.sampling_us {
                let [low, high] = us.to_le_bytes();
                // The high byte first, as in the manual's example.
                self.set(address, parameter::PERIOD_HIGH, high, "sampling_us")?;
                self.set(address, parameter::PERIOD_LOW, low, "sampling_us")?;
            }
            if self.settings.switch_laser {
                self.set(address, parameter::LASER, 0, "switch_laser")?;
            }
        }
        let first = self.settings.addresses[0];
        let low = self.get(first, parameter::PERIOD_LOW)?;
        let high = self.get(first, parameter::PERIOD_HIGH)?;
        let us = u16::from_le_bytes([low, high]).max(1);
        self.period = Duration::from_micros(us.into()).max(self.on_line());
        self.by_time = self.get(first, parameter::CONTROL)? & 1 == 0;
        Ok(())
    }

    /// What a result takes on a serial line: four characters of 11 bits. A sensor that measures faster sends no faster.
    fn on_line(&self) -> Duration {
        match &self.settings.target {
            Target::Serial { line, .. } => Duration::from_secs_f64(44.0 / f64::from(line.baud)),
            Target::Tcp { .. } => Duration::ZERO,
        }
    }

    fn bad(&self, source: DecodeError) -> DeviceError {
        DeviceError::Decode {
            port: self.pump.port().into(),
            source,
        }
    }

    /// Ends whatever streams, and waits until the bus is quiet.
    fn hush(&mut self) -> Result<(), DeviceError> {
        let began = Instant::now();
        loop {
            for &address in &self.settings.addresses {
                self.pump.write(&request(address, code::STOP, &[]))?;
            }
            let again = Instant::now() + REPLY / 4;
            let mut bytes = 0;
            loop {
                match self.pump.read(Instant::now() + QUIET)? {
                    None => return Ok(()),
                    Some((_, more)) => bytes += more.len() as u64,
                }
                if Instant::now() >= again {
                    break;
                }
            }
            if began.elapsed() >= REPLY * TRIES {
                return Err(DeviceError::Babble {
                    port: self.pump.port().into(),
                    bytes,
                    command: "stop stream",
                    deadline_s: (REPLY * TRIES).as_secs_f64(),
                });
            }
        }
    }

    /// Sends a request until it is answered.
    fn ask(
        &mut self,
        address: u8,
        code: u8,
        message: &[u8],
        payload_bytes: usize,
    ) -> Result<Answer, DeviceError> {
        let heard_before = self.pump.heard_bytes();
        for attempt in 0..TRIES {
            let deadline = Instant::now() + REPLY;
            if let Some(answer) = self.once(address, code, message, payload_bytes, deadline)? {
                if attempt > 0 {
                    // The answer to the attempt before may still come, and must answer nothing else.
                    while self.pump.read(Instant::now() + QUIET)?.is_some() {}
                }
                return Ok(answer);
            }
        }
        let port = format!("{}, address {address}", self.pump.port());
        let deadline_s = (REPLY * TRIES).as_secs_f64();
        Err(match self.pump.heard_bytes() - heard_before {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: match code {
                    code::IDENTIFY => "identify",
                    _ => "read parameter",
                },
                deadline_s,
            },
        })
    }

    fn once(
        &mut self,
        address: u8,
        code: u8,
        message: &[u8],
        payload_bytes: usize,
        deadline: Instant,
    ) -> Result<Option<Answer>, DeviceError> {
        while self.pump.read(Instant::now())?.is_some() {}
        self.decoder.expect(payload_bytes);
        self.pump.write(&request(address, code, message))?;
        let mut found = None;
        while found.is_none() {
            let Some((_, bytes)) = self.pump.read(deadline)? else {
                return Ok(None);
            };
            self.decoder
                .take(&bytes, |answer, _| found = found.or(Some(answer)));
            if Instant::now() >= deadline + REPLY {
                break;
            }
        }
        Ok(found)
    }

    fn get(&mut self, address: u8, parameter: u8) -> Result<u8, DeviceError> {
        let answer = self.ask(address, code::READ, &[parameter], 1)?;
        Ok(answer.payload()[0])
    }

    /// Writes a parameter and reads it back: writing itself is not answered.
    fn set(
        &mut self,
        address: u8,
        parameter: u8,
        value: u8,
        key: &'static str,
    ) -> Result<(), DeviceError> {
        let mut actual = value;
        for _ in 0..TRIES {
            self.pump
                .write(&request(address, code::WRITE, &[parameter, value]))?;
            actual = self.get(address, parameter)?;
            if actual == value {
                return Ok(());
            }
        }
        Err(DeviceError::Setting {
            port: format!("{}, address {address}", self.pump.port()),
            key,
            wanted: value.into(),
            reason: "it reads back otherwise",
            actual: actual.into(),
            minimum: 0,
            maximum: 255,
        })
    }

    fn lasers(&mut self, on: bool) -> Result<(), DeviceError> {
        if !self.settings.switch_laser {
            return Ok(());
        }
        for address in self.settings.addresses.clone() {
            self.set(address, parameter::LASER, on.into(), "switch_laser")?;
        }
        Ok(())
    }

    /// Ends the streams and switches the lasers off, without asking.
    fn farewell(&self) -> Vec<u8> {
        let addresses = self.settings.addresses.iter();
        let off = |&address: &u8| {
            let mut bytes = request(address, code::STOP, &[]);
            if self.settings.switch_laser {
                bytes.extend(request(address, code::WRITE, &[parameter::LASER, 0]));
            }
            bytes
        };
        addresses.flat_map(off).collect()
    }

    fn begin(&mut self) -> Result<Run, DeviceError> {
        self.lasers(true)?;
        if self.settings.addresses.len() > 1 {
            return Ok(Run::Rounds(Rounds {
                due: Instant::now(),
                number: 0,
                rows: VecDeque::new(),
                missed: 0,
                losses: Losses::default(),
            }));
        }
        self.decoder.expect(2);
        let mut stream = Stream::new(
            self.ranges_mm[0],
            self.settings.zero_is_nothing,
            self.period,
            self.settings.layout,
        );
        if !self.by_time {
            stream.count = Count::new(None);
        }
        stream.skipped_before = self.decoder.skipped_bytes();
        stream.count.begin(self.decoder.skipped_bytes());
        self.start_stream()?;
        Ok(Run::Stream(Box::new(stream), Instant::now()))
    }

    fn start_stream(&mut self) -> Result<(), DeviceError> {
        self.pump
            .write(&request(self.settings.addresses[0], code::START, &[]))
    }

    /// Reads of a stream until a profile is done or `deadline` passes.
    fn next_of_stream(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        let pause = (self.period * 5).max(REPLY);
        loop {
            let Some(Run::Stream(stream, heard)) = &mut self.run else {
                return Ok(None);
            };
            if let Some(profile) = stream.pop() {
                return Ok(Some(profile));
            }
            let ask_at = *heard + pause;
            match self.pump.read(deadline.min(ask_at))? {
                Some((at, bytes)) => {
                    self.decoder.take(&bytes, |answer, skipped| {
                        *heard = at;
                        stream.take(&answer, skipped, at);
                    });
                    self.account = stream.losses(self.decoder.skipped_bytes());
                }
                None if Instant::now() >= ask_at => self.paused()?,
                None => return Ok(None),
            }
        }
    }

    /// The stream has paused: asks who is there, which ends it, and begins it again where it may pause.
    fn paused(&mut self) -> Result<(), DeviceError> {
        let address = self.settings.addresses[0];
        self.ask(address, code::IDENTIFY, &[], 8)?;
        if self.by_time {
            return Err(DeviceError::Ended {
                port: self.pump.port().into(),
                reason: "it answers, but its stream has stopped: it was reset, or somebody else sent a request on the bus",
                remedy: "check its supply and that nobody else commands the bus, then start again",
            });
        }
        self.decoder.expect(2);
        self.start_stream()?;
        if let Some(Run::Stream(stream, heard)) = &mut self.run {
            *heard = Instant::now();
            stream.count.begin(self.decoder.skipped_bytes());
        }
        Ok(())
    }

    /// Asks all sensors once, when it is time.
    fn next_of_rounds(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        loop {
            let Some(Run::Rounds(rounds)) = &mut self.run else {
                return Ok(None);
            };
            if let Some(profile) = rounds.rows.pop_front() {
                return Ok(Some(profile));
            }
            let due = rounds.due;
            if due > deadline {
                // Nothing comes unasked; a cable that is pulled out does show.
                while self.pump.read(deadline)?.is_some() {}
                return Ok(None);
            }
            while self.pump.read(due)?.is_some() {}
            self.round()?;
        }
    }

    fn round(&mut self) -> Result<(), DeviceError> {
        let began = Instant::now();
        self.pump.write(&request(0, code::LATCH, &[]))?;
        let addresses = self.settings.addresses.clone();
        let mut z_mm = Vec::with_capacity(addresses.len());
        let mut losses = Losses::default();
        let skipped_before = self.decoder.skipped_bytes();
        for (address, range_mm) in addresses.iter().zip(self.ranges_mm.clone()) {
            let until = Instant::now() + REPLY / 2;
            let answer = self.once(*address, code::RESULT, &[], 2, until)?;
            let result = answer.and_then(|answer| answer.word(0));
            let zero = self.settings.zero_is_nothing;
            let mm = result.map(|result| distance_mm(result, range_mm, zero));
            losses.received += u64::from(matches!(mm, Some(Some(_))));
            losses.rejected += u64::from(matches!(mm, Some(None)));
            losses.lost_on_link += u64::from(!matches!(mm, Some(Some(_))));
            z_mm.push(mm.flatten().unwrap_or(f64::NAN));
        }
        let now = Instant::now();
        losses.skipped_bytes = self.decoder.skipped_bytes() - skipped_before;
        let Some(Run::Rounds(rounds)) = &mut self.run else {
            return Ok(());
        };
        rounds.missed = if losses.received > 0 {
            0
        } else {
            rounds.missed + 1
        };
        rounds.losses.received += losses.received;
        rounds.losses.rejected += losses.rejected;
        rounds.losses.lost_on_link += losses.lost_on_link;
        rounds.losses.skipped_bytes += losses.skipped_bytes;
        self.account = rounds.losses;
        if rounds.missed == MISSED_ROUNDS {
            return Err(DeviceError::Silent {
                port: self.pump.port().into(),
                deadline_s: now
                    .saturating_duration_since(rounds.due)
                    .as_secs_f64()
                    .ceil(),
            });
        }
        let layout = self.settings.layout;
        let x = |i: u32| layout.first_mm + f64::from(i) * layout.pitch_mm;
        rounds.rows.push_back(Profile {
            // Wraps as every sequence number does.
            sequence: rounds.number as u32,
            boot: 0,
            device_time_ns: 0,
            encoder: None,
            host_time: now,
            dropped: 0,
            saturated: false,
            x_mm: (0..layout.columns).map(x).collect(),
            z_mm,
            intensity: Vec::new(),
        });
        rounds.number += 1;
        rounds.due = began + self.settings.round;
        Ok(())
    }
}

impl Profiler for Bus {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if self.run.is_some() {
            return Err(DeviceError::OutOfOrder {
                port: self.pump.port().into(),
                action: "start",
                needed: "the run before to be stopped",
            });
        }
        self.account = Losses::default();
        self.pump.guard(Some(self.farewell()));
        match self.begin() {
            Ok(run) => {
                self.run = Some(run);
                Ok(())
            }
            Err(error) => {
                self.pump.guard(None);
                // A laser may be on; where nothing passes any more there is nobody to tell.
                let _ = self.pump.write(&self.farewell());
                Err(error)
            }
        }
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        match &self.run {
            Some(Run::Stream(..)) => self.next_of_stream(deadline),
            Some(Run::Rounds(_)) => self.next_of_rounds(deadline),
            None => Err(DeviceError::OutOfOrder {
                port: self.pump.port().into(),
                action: "next",
                needed: "a run that was started",
            }),
        }
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        self.pump.guard(None);
        let mut profiles = Vec::new();
        match self.run.take() {
            None => return Ok(profiles),
            Some(Run::Rounds(rounds)) => profiles.extend(rounds.rows),
            Some(Run::Stream(mut stream, _)) => {
                self.pump
                    .write(&request(self.settings.addresses[0], code::STOP, &[]))?;
                let until = Instant::now() + REPLY;
                while let Some((at, bytes)) = self.pump.read(Instant::now() + QUIET)? {
                    self.decoder
                        .take(&bytes, |answer, skipped| stream.take(&answer, skipped, at));
                    if Instant::now() >= until {
                        break;
                    }
                }
                stream.finish();
                if stream.unsure() > 0 {
                    let (port, unsure) = (self.pump.port(), stream.unsure());
                    tracing::warn!(
                        port,
                        unsure,
                        "so many values may be lost that are not counted, or not lost that are"
                    );
                }
                self.account = stream.losses(self.decoder.skipped_bytes());
                profiles.extend(std::iter::from_fn(|| stream.pop()));
                self.hush()?;
            }
        }
        self.lasers(false)?;
        Ok(profiles)
    }

    fn losses(&self) -> Losses {
        self.account
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        if self.run.is_some() {
            return Err(checked_in_a_run(self.pump.port()));
        }
        let mut serials = Vec::new();
        for address in self.settings.addresses.clone() {
            let answer = self.ask(address, code::IDENTIFY, &[], 8)?;
            serials.push(answer.word(2).unwrap_or(0).to_string());
        }
        same(self.pump.port(), &self.identity.serial, &serials.join(", "))
    }
}

impl Drop for Bus {
    /// Stops the stream and switches the lasers off; a parameter read back says that it was heard.
    fn drop(&mut self) {
        self.pump.guard(None);
        if self.pump.write(&self.farewell()).is_ok() {
            let address = self.settings.addresses[self.settings.addresses.len() - 1];
            let deadline = Instant::now() + REPLY / 4;
            let _ = self.once(address, code::READ, &[parameter::LASER], 1, deadline);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn golden_requests() {
        assert_eq!(request(1, code::IDENTIFY, &[]), [0x01, 0x81]);
        assert_eq!(request(1, code::READ, &[2]), [0x01, 0x82, 0x82, 0x80]);
        assert_eq!(request(1, code::RESULT, &[]), [0x01, 0x86]);
        assert_eq!(
            request(1, code::WRITE, &[2, 1]),
            [0x01, 0x83, 0x82, 0x80, 0x81, 0x80]
        );
        assert_eq!(
            request(1, code::WRITE, &[9, 0x30]),
            [0x01, 0x83, 0x89, 0x80, 0x80, 0x83]
        );
        assert_eq!(
            request(1, code::WRITE, &[8, 0x39]),
            [0x01, 0x83, 0x88, 0x80, 0x89, 0x83]
        );
    }

    #[test]
    fn results_are_parts_of_the_range() {
        // The manual's example: 677 of a range of 50 mm, printed to 0.001 mm.
        let mm = distance_mm(677, 50.0, true).expect("a distance");
        assert!((mm - 2.066).abs() < 5e-4, "{mm}");
        assert_eq!(distance_mm(FULL, 50.0, true), Some(50.0));
        assert!(distance_mm(0, 50.0, true).is_some_and(f64::is_nan));
        assert_eq!(distance_mm(0, 50.0, false), Some(0.0));
        assert_eq!(distance_mm(FULL + 1, 50.0, true), None);
    }
}

//! Laser distance sensors of the family Micro-Epsilon optoNCDT with an RS-422 interface.
//!
//! Manuals: optoNCDT 1320/1420 (RS-422 and ASCII communication), 1900 and 2300 for their scales, IF2030 for the 1900. Quirks:
//! values come in words of three bytes without a check, so that only the order of the bytes and the counter tell damage;
//! replies come in between; the line may be too slow for all values, which the sensor then says in place of a distance; a sensor
//! has no keep-alive, so this program switches it off where nobody takes its values.
//!
//! What the manuals at hand do not settle is a setting: the names of commands that choose additional values or switch the laser
//! go into `commands`, `laser_on` and `laser_off`, and the order of the values into `outputs`. Losses can only be counted where
//! the sensor sends its counter.
//!
//! # Configuration
//!
//! ```toml
//! port = "/dev/ttyUSB0"         # or one of the next three in its place
//! # usb_serial = "A50285BI"     # serial number of the USB converter: the same after plugging in again
//! # usb_id = "0403:6001"        # vendor and product of a converter without one
//! # address = "10.0.0.7:4001"   # TCP, as of a serial server
//! baud = 921600                 # serial ports only
//! serial_number = "15030002"    # of the sensor: another one is refused
//! scale = "ild1420"             # "ild1420" (and 1220, 1320), "ild1900" or "ild2300": how values become mm
//! mastered = false              # distances count from a master value in the middle of the range ("ild1420" only)
//! range_mm = 50.0               # measuring range; as the sensor says where not given
//! outputs = ["distance", "counter"] # values of a measurement, as GETOUTINFO_RS422 lists them; also "time-low",
//!                               # "time-high", "intensity", "other"
//! rate_hz = 4000.0              # measurements a second, where they come by time
//! commands = ["OUTADD_RS422 MEASCNT"] # sent at opening, after OUTPUT NONE
//! laser_on = "LASERPOW FULL"    # sent at the start of a run
//! laser_off = "LASERPOW OFF"    # sent at opening and at the end
//! columns = 1                   # values in a profile: more than 1 for a sensor that travels along x
//! # pitch_mm = 0.05             # from one value to the next along x, for several columns
//! first_mm = 0.0                # x of the first value
//! encoder_step = 20             # encoder counts between values, where the encoder triggers the sensor
//! ```

use std::time::{Duration, Instant};

use crate::capture::Profile;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Mistake, Presence, Profiler, Setup,
    checked_in_a_run, same,
};
use crate::error::{DecodeError, DeviceError};
use crate::link::pump::{Chunk, Pump};
use crate::link::{Links, Target};
use crate::point::{Layout, Rows, Sequencer, Value};
use crate::settings::Keys;

mod stream;

pub use stream::{Assembly, Decoder, Item, TEXT_MAX, Word};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "optoncdt",
    summary: "laser distance sensors Micro-Epsilon optoNCDT over RS-422",
    configure,
};

const BAUD: u32 = 921_600;
/// How long one reply is waited for.
const REPLY: Duration = Duration::from_secs(1);
/// How often a command is sent before the sensor counts as silent.
const TRIES: u32 = 3;
/// How long a reply without the command's name is held back for one with it.
const BETTER: Duration = Duration::from_millis(100);
/// How long a stream may pause before the sensor is asked whether it is still there.
const PAUSE: Duration = Duration::from_secs(1);
/// Bits of the measured value counter.
const COUNTER_BITS: u32 = 18;
/// Bytes of a stream that are waited out at the end of a run: what a USB converter holds back.
const TAIL: Duration = Duration::from_millis(50);

// ---- Settings ---------------------------------------------------------------------------------------------------------

/// How values become mm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// ILD1220, 1320, 1420: 16 bits, and codes of 18.
    Ild1420,
    /// The same, counted from a master value.
    Ild1420Mastered,
    /// ILD1900: 18 bits.
    Ild1900,
    /// ILD2300: 16 bits.
    Ild2300,
}

/// What one value of a measurement is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Output {
    Distance,
    Counter,
    TimeLow,
    TimeHigh,
    Intensity,
    Other,
}

const OUTPUTS: [(&str, Output); 6] = [
    ("distance", Output::Distance),
    ("counter", Output::Counter),
    ("time-low", Output::TimeLow),
    ("time-high", Output::TimeHigh),
    ("intensity", Output::Intensity),
    ("other", Output::Other),
];

#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    serial_number: Option<String>,
    scale: Scale,
    range_mm: Option<f64>,
    outputs: Vec<Output>,
    rate_hz: Option<f64>,
    commands: Vec<String>,
    laser_on: Option<String>,
    laser_off: Option<String>,
    layout: Layout,
}

fn configure(table: toml::Table) -> Configured {
    Ok(Box::new(settings(table)?))
}

fn settings(table: toml::Table) -> Result<Settings, Vec<Mistake>> {
    const SCALES: [(&str, Scale); 3] = [
        ("ild1420", Scale::Ild1420),
        ("ild1900", Scale::Ild1900),
        ("ild2300", Scale::Ild2300),
    ];
    let mut keys = Keys::new(table);
    let target = keys.target(BAUD);
    let serial_number = keys.text("serial_number");
    let mut scale = keys.choice("scale", &SCALES).unwrap_or(Scale::Ild1420);
    if keys.flag("mastered") == Some(true) {
        match scale {
            Scale::Ild1420 => scale = Scale::Ild1420Mastered,
            _ => keys.wrong("mastered", "true", "false, for this scale"),
        }
    }
    let settings = Settings {
        target: Target::Tcp {
            address: String::new(),
        },
        serial_number,
        scale,
        range_mm: keys.number("range_mm", 0.1..=10_000.0),
        outputs: outputs(&mut keys),
        rate_hz: keys.number("rate_hz", 0.1..=100_000.0),
        commands: commands(&mut keys),
        laser_on: keys.text("laser_on"),
        laser_off: keys.text("laser_off"),
        layout: Layout::read(&mut keys),
    };
    keys.finish()?;
    match target {
        Some(target) => Ok(Settings { target, ..settings }),
        // Without a mistake there is a target: `finish` has returned otherwise.
        None => Err(Vec::new()),
    }
}

fn outputs(keys: &mut Keys) -> Vec<Output> {
    let expected = "words of distance, counter, time-low, time-high, intensity, other: distance once, at most 7, the others \
                    at most once";
    let read = keys.read("outputs", expected, |value| {
        let words = value.as_array()?.iter().map(|word| {
            let word = word.as_str()?;
            OUTPUTS.iter().find(|(name, _)| *name == word).map(|o| o.1)
        });
        let list: Vec<Output> = words.collect::<Option<_>>()?;
        let times = |one: Output| list.iter().filter(|&&o| o == one).count();
        let single = OUTPUTS
            .iter()
            .all(|&(_, o)| o == Output::Other || times(o) <= 1);
        (list.len() <= 7 && single && times(Output::Distance) == 1).then_some(list)
    });
    read.unwrap_or_else(|| vec![Output::Distance, Output::Counter])
}

fn commands(keys: &mut Keys) -> Vec<String> {
    let expected = "commands of the sensor, each a line of ASCII";
    let read = keys.read("commands", expected, |value| {
        let lines = value.as_array()?.iter().map(|line| {
            let line = line.as_str()?.trim();
            let printable = |b: u8| (0x20..0x7F).contains(&b);
            (!line.is_empty() && line.bytes().all(printable)).then(|| line.to_owned())
        });
        lines.collect::<Option<Vec<String>>>()
    });
    read.unwrap_or_default()
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let mut sensor = Sensor {
            pump: Pump::open(links, &self.target)?,
            decoder: Decoder::default(),
            identity: Identity {
                vendor: "Micro-Epsilon".into(),
                model: String::new(),
                serial: String::new(),
                firmware: String::new(),
            },
            range_mm: 0.0,
            run: None,
            account: Losses::default(),
            settings: self.clone(),
        };
        sensor.introduce()?;
        Ok(Instrument::Profiler(Box::new(sensor)))
    }
}

// ---- Values to mm -----------------------------------------------------------------------------------------------------

/// What a distance value says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distance {
    /// A distance from the start of the range, or from the master value.
    Mm(f64),
    /// Nothing that could be measured, and why.
    Absent(&'static str),
    /// The value was not sent: too many for the speed of the line.
    TooMuchData,
    /// No sensor sends this: it was damaged on the way.
    Impossible,
}

impl Scale {
    /// What `value` says in a range of `range_mm`; manual 1420, section on distance values and errors.
    pub fn distance(self, value: u32, range_mm: f64) -> Distance {
        let x = f64::from(value);
        let mm = |part: f64| Distance::Mm(part * range_mm);
        match (self, value) {
            (Scale::Ild1420 | Scale::Ild1420Mastered, 0..=642) => {
                Distance::Absent("before the range")
            }
            (Scale::Ild1420, 643..=64_877) => mm((102.0 * x / 65_520.0 - 1.0) / 100.0),
            (Scale::Ild1420Mastered, 643..=64_877) => mm((102.0 * x / 65_520.0 - 51.0) / 100.0),
            (Scale::Ild1420 | Scale::Ild1420Mastered, 64_878..=65_520) => {
                Distance::Absent("behind the range")
            }
            (Scale::Ild1900, 0..=230_604) => mm((x - 98_232.0) / 65_536.0),
            (Scale::Ild2300, 0..=65_519) => mm(x * 1.02 / 65_520.0 - 0.01),
            (_, 262_075) => Distance::TooMuchData,
            (_, 262_076) => Distance::Absent("no peak"),
            (_, 262_077) => Distance::Absent("peak before the range"),
            (_, 262_078) => Distance::Absent("peak behind the range"),
            (_, 262_080) => Distance::Absent("it cannot be calculated"),
            (_, 262_081) => Distance::Absent("peak too wide"),
            (_, 262_082) => Distance::Absent("laser off"),
            _ => Distance::Impossible,
        }
    }
}

/// One measurement, before it is believed.
#[derive(Debug, Clone, Copy)]
struct Measured {
    distance: Distance,
    time: Option<u32>,
    intensity: Option<u16>,
    host_time: Instant,
}

/// A time stamp of 32 bits in 10 us, unwrapped: it turns over after 11 h 55 min.
#[derive(Debug, Default)]
struct Clock {
    last: Option<u32>,
    turns_10us: u64,
}

impl Clock {
    fn unwrap_ns(&mut self, time: u32) -> u64 {
        if self.last.is_some_and(|last| time < last) {
            self.turns_10us += 1 << 32;
        }
        self.last = Some(time);
        (self.turns_10us + u64::from(time)) * 10_000
    }
}

// ---- A run ------------------------------------------------------------------------------------------------------------

/// The stream of one run: words to profiles. Pure but for the times that come with the bytes.
struct Run {
    scale: Scale,
    range_mm: f64,
    outputs: Vec<Output>,
    rate_hz: Option<f64>,
    assembly: Assembly,
    sequencer: Sequencer<Measured>,
    /// Numbers of a run begin here; at 0 where the counter was reset.
    zero: Option<u64>,
    /// Without a counter, the number of the next measurement.
    counted: u64,
    clock: Clock,
    damaged: u64,
    rows: Rows,
    /// When the last word came, and when the sensor was last asked whether it is there.
    heard: Instant,
}

impl Run {
    fn new(settings: &Settings, range_mm: f64) -> Run {
        Run {
            scale: settings.scale,
            range_mm,
            outputs: settings.outputs.clone(),
            rate_hz: settings.rate_hz,
            assembly: Assembly::new(settings.outputs.len()),
            sequencer: Sequencer::new(COUNTER_BITS, settings.rate_hz),
            zero: settings.layout.encoder_step.map(|_| 0),
            counted: 0,
            clock: Clock::default(),
            damaged: 0,
            rows: Rows::new(settings.layout),
            heard: Instant::now(),
        }
    }

    fn word(&mut self, word: Word, host_time: Instant) {
        self.heard = host_time;
        let Some(values) = self.assembly.take(word) else {
            return;
        };
        let of = |output: Output| {
            let place = self.outputs.iter().position(|&o| o == output)?;
            values.get(place).copied()
        };
        let time =
            of(Output::TimeLow).map(|low| of(Output::TimeHigh).unwrap_or(0) << 16 | low & 0xFFFF);
        let counter = of(Output::Counter);
        let measured = Measured {
            distance: self
                .scale
                .distance(of(Output::Distance).unwrap_or(0), self.range_mm),
            time,
            // 16 bits by the manual; more were damaged, and brightness is not worth a measurement.
            intensity: of(Output::Intensity).map(|i| i.min(0xFFFF) as u16),
            host_time,
        };
        if measured.distance == Distance::Impossible {
            self.damaged += 1;
            return;
        }
        // A value that was held and the one that confirms it.
        let mut believed = [None; 2];
        match counter {
            Some(counter) => {
                let mut places = believed.iter_mut();
                self.sequencer
                    .take(counter, host_time, measured, |number, measured| {
                        if let Some(place) = places.next() {
                            *place = Some((number, measured));
                        }
                    });
            }
            None => {
                believed[0] = Some((self.counted, measured));
                self.counted += 1;
            }
        }
        for (number, measured) in believed.into_iter().flatten() {
            self.believe(number, measured);
        }
    }

    fn believe(&mut self, number: u64, measured: Measured) {
        let zero = *self.zero.get_or_insert(number);
        let number = number.saturating_sub(zero);
        let z_mm = match measured.distance {
            Distance::Mm(mm) => mm,
            Distance::TooMuchData => {
                self.rows.losses.dropped_by_device += 1;
                f64::NAN
            }
            Distance::Absent(_) | Distance::Impossible => f64::NAN,
        };
        let device_time_ns = match (measured.time, self.rate_hz) {
            (Some(time), _) => self.clock.unwrap_ns(time),
            (None, Some(rate)) => (number as f64 / rate * 1e9) as u64,
            (None, None) => 0,
        };
        let value = Value {
            z_mm,
            intensity: measured.intensity,
            device_time_ns,
            host_time: measured.host_time,
        };
        self.rows.take(number, value);
    }

    fn finish(&mut self) {
        let mut believed = Vec::new();
        self.sequencer.finish(|n, m| believed.push((n, m)));
        for (number, measured) in believed {
            self.believe(number, measured);
        }
        self.rows.finish();
    }

    fn losses(&self, skipped_bytes: u64) -> Losses {
        Losses {
            lost_on_link: self.sequencer.lost,
            rejected: self.assembly.rejected + self.sequencer.rejected + self.damaged,
            skipped_bytes,
            ..self.rows.losses
        }
    }
}

/// The stream alone, without commands: bytes to profiles, for whoever has a recording of it.
pub struct Stream {
    decoder: Decoder,
    run: Run,
}

impl Stream {
    /// A stream as the driver configured by `table` reads it, from a sensor with this range.
    ///
    /// # Errors
    /// The mistakes of the table.
    pub fn new(table: toml::Table, range_mm: f64) -> Result<Stream, Vec<Mistake>> {
        let settings = settings(table)?;
        Ok(Stream {
            decoder: Decoder::default(),
            run: Run::new(&settings, range_mm),
        })
    }

    /// Takes bytes that came at a time.
    pub fn take(&mut self, bytes: &[u8], at: Instant) {
        let run = &mut self.run;
        self.decoder.take(bytes, |item| {
            if let Item::Word(word) = item {
                run.word(word, at);
            }
        });
    }

    /// The oldest profile.
    pub fn pop(&mut self) -> Option<Profile> {
        self.run.rows.pop()
    }

    /// The end of the stream.
    pub fn finish(&mut self) {
        self.run.finish();
    }

    /// What was lost.
    pub fn losses(&self) -> Losses {
        self.run.losses(self.decoder.skipped_bytes())
    }

    /// Measurements that were thrown away because they may have been put together from two, or from rubbish.
    pub fn doubted(&self) -> u64 {
        self.run.assembly.doubted + self.decoder.doubted()
    }
}

// ---- Device -----------------------------------------------------------------------------------------------------------

struct Sensor {
    pump: Pump,
    decoder: Decoder,
    identity: Identity,
    range_mm: f64,
    run: Option<Running>,
    account: Losses,
    settings: Settings,
}

struct Running {
    run: Run,
    skipped_before: u64,
}

impl Sensor {
    /// Stops what a host before us may have left running, learns who it is, and sets it up.
    fn introduce(&mut self) -> Result<(), DeviceError> {
        // Ends a line that a host before us may have begun; its answer is none of ours.
        self.pump.write(b"\r\n")?;
        let first = self.command("OUTPUT NONE");
        if matches!(first, Err(DeviceError::Refused { .. })) {
            self.command("OUTPUT NONE")?;
        }
        first.or_else(|error| match error {
            DeviceError::Refused { .. } => Ok(String::new()),
            other => Err(other),
        })?;
        let info = self.command("GETINFO")?;
        let field = |name: &str| field(&info, name);
        let (Some(model), Some(serial)) = (field("Name:"), field("Serial:")) else {
            return Err(self.bad(DecodeError::WrongReply { command: "GETINFO" }));
        };
        if let Some(expected) = self.settings.serial_number.clone().filter(|s| *s != serial) {
            return Err(DeviceError::WrongDevice {
                port: self.pump.port().into(),
                found: serial,
                expected,
            });
        }
        let stated = field("Measuring range:");
        let stated = stated.and_then(|text| text.trim_end_matches("mm").trim().parse::<f64>().ok());
        let range_mm = match (
            stated.filter(|mm| mm.is_finite() && *mm > 0.0),
            self.settings.range_mm,
        ) {
            (Some(stated), Some(wanted)) if (stated - wanted).abs() > 1e-3 => {
                return Err(DeviceError::WrongDevice {
                    port: self.pump.port().into(),
                    found: format!("{stated} mm range"),
                    expected: format!("{wanted} mm range"),
                });
            }
            (_, Some(wanted)) => wanted,
            (Some(stated), None) => stated,
            (None, None) => {
                return Err(DeviceError::Lacks {
                    port: self.pump.port().into(),
                    capability: "measuring range in its GETINFO",
                    key: "range_mm",
                });
            }
        };
        self.range_mm = range_mm;
        self.identity.model = model;
        self.identity.serial = serial;
        self.identity.firmware = field("Version:").unwrap_or_default();
        match self.settings.laser_off.clone() {
            Some(off) => self.command(&off).map(drop)?,
            None => tracing::warn!(
                port = self.pump.port(),
                "no `laser_off`: the laser stays on between runs"
            ),
        }
        for command in self.settings.commands.clone() {
            self.command(&command)?;
        }
        Ok(())
    }

    fn bad(&self, source: DecodeError) -> DeviceError {
        DeviceError::Decode {
            port: self.pump.port().into(),
            source,
        }
    }

    /// Sends a command until it is answered; the answer without the prompt. Measurements that come meanwhile are taken.
    fn command(&mut self, text: &str) -> Result<String, DeviceError> {
        let heard_before = self.pump.heard_bytes();
        for _ in 0..TRIES {
            self.pump.write(format!("{text}\r\n").as_bytes())?;
            if let Some(reply) = self.reply(text)? {
                return self.accepted(text, reply);
            }
        }
        let port = self.pump.port().into();
        let deadline_s = (REPLY * TRIES).as_secs_f64();
        Err(match self.pump.heard_bytes() - heard_before {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: match text {
                    "OUTPUT NONE" => "OUTPUT NONE",
                    _ => "a command",
                },
                deadline_s,
            },
        })
    }

    /// Waits for the reply to a command: one that bears its name or an error, or else the last one that bears none.
    fn reply(&mut self, command: &str) -> Result<Option<String>, DeviceError> {
        let name = command.split_whitespace().next().unwrap_or_default();
        let mut deadline = Instant::now() + REPLY;
        let mut nameless: Option<String> = None;
        loop {
            let Some(chunk) = self.pump.read(deadline)? else {
                return Ok(nameless);
            };
            for reply in self.digest(&chunk) {
                if reply.contains(name) || error_line(&reply).is_some() {
                    return Ok(Some(reply));
                }
                nameless = Some(reply);
                deadline = deadline.min(Instant::now() + BETTER);
            }
            // A stream that never pauses must not hold us here.
            if Instant::now() >= deadline {
                return Ok(nameless);
            }
        }
    }

    fn accepted(&self, command: &str, reply: String) -> Result<String, DeviceError> {
        match error_line(&reply) {
            None => Ok(reply),
            Some(error) => Err(DeviceError::Refused {
                port: self.pump.port().into(),
                command: command.into(),
                reason: error.to_owned(),
                remedy: "look the number up in the sensor's manual; a sensor that is locked wants LOGIN in `commands` first",
            }),
        }
    }

    /// Takes bytes in: words to the run, replies to the caller.
    fn digest(&mut self, (at, bytes): &Chunk) -> Vec<String> {
        let mut replies = Vec::new();
        let run = &mut self.run;
        self.decoder.take(bytes, |item| match item {
            Item::Word(word) => {
                if let Some(running) = run {
                    running.run.word(word, *at);
                }
            }
            Item::Reply(text) => replies.push(String::from_utf8_lossy(text).into_owned()),
        });
        self.tally();
        replies
    }

    fn tally(&mut self) {
        if let Some(running) = &self.run {
            let skipped = self.decoder.skipped_bytes() - running.skipped_before;
            self.account = running.run.losses(skipped);
        }
    }

    /// Whatever makes the run senseless to go on with.
    fn broken(&self) -> Option<DeviceError> {
        let run = &self.run.as_ref()?.run;
        if run.sequencer.restarted {
            return Some(DeviceError::Ended {
                port: self.pump.port().into(),
                reason: "its counter began anew: the sensor was reset or lost its supply",
                remedy: "check its supply, then reopen it",
            });
        }
        let found = run.assembly.misfit()?;
        Some(self.bad(DecodeError::Field {
            message: "measurement",
            field: "number of values",
            found: found as u64,
            allowed: "as many as `outputs` has; compare it with GETOUTINFO_RS422",
        }))
    }

    /// A stream that came by time has paused: asks the sensor, and tells why.
    fn paused(&mut self) -> Result<(), DeviceError> {
        self.command("GETINFO")?;
        let Some(running) = &mut self.run else {
            return Ok(());
        };
        // By a trigger it may pause for as long as it likes.
        let by_time =
            self.settings.rate_hz.is_some() && self.settings.layout.encoder_step.is_none();
        let quiet = running.run.heard.elapsed() >= PAUSE;
        if by_time && quiet {
            return Err(DeviceError::Ended {
                port: self.pump.port().into(),
                reason: "it answers, but sends no values any more: it was reset, or its output was switched off",
                remedy: "check its supply and that nobody else commands it, then reopen it",
            });
        }
        if quiet {
            running.run.heard = Instant::now();
        }
        Ok(())
    }

    fn farewell(&self) -> Vec<u8> {
        let off = self.settings.laser_off.iter().map(String::as_str);
        let lines = ["OUTPUT NONE"].into_iter().chain(off);
        lines
            .flat_map(|line| format!("{line}\r\n").into_bytes())
            .collect()
    }

    fn begin(&mut self) -> Result<(), DeviceError> {
        if let Some(on) = self.settings.laser_on.clone() {
            self.command(&on)?;
        }
        if self.settings.layout.encoder_step.is_some() {
            self.command("RESETCNT")?;
        }
        self.run = Some(Running {
            run: Run::new(&self.settings, self.range_mm),
            skipped_before: self.decoder.skipped_bytes(),
        });
        self.command("OUTPUT RS422").map(drop)
    }
}

/// The value of a line of GETINFO.
fn field(info: &str, name: &str) -> Option<String> {
    let line = info.lines().find_map(|line| line.split_once(name));
    line.map(|(_, value)| value.trim().to_owned())
}

/// The line of a reply that begins with E and three digits.
fn error_line(reply: &str) -> Option<&str> {
    reply.lines().map(str::trim).find(|line| {
        let bytes = line.as_bytes();
        bytes.len() >= 4 && bytes[0] == b'E' && bytes[1..4].iter().all(u8::is_ascii_digit)
    })
}

impl Profiler for Sensor {
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
        let begun = self.begin();
        if begun.is_err() {
            self.run = None;
            self.pump.guard(None);
            // The laser may be on; where nothing passes any more there is nobody to tell.
            let _ = self.pump.write(&self.farewell());
        }
        begun
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        loop {
            let Some(running) = &mut self.run else {
                return Err(DeviceError::OutOfOrder {
                    port: self.pump.port().into(),
                    action: "next",
                    needed: "a run that was started",
                });
            };
            if let Some(profile) = running.run.rows.pop() {
                return Ok(Some(profile));
            }
            if let Some(error) = self.broken() {
                return Err(error);
            }
            let ask_at = running_heard(&self.run) + PAUSE;
            match self.pump.read(deadline.min(ask_at))? {
                Some(chunk) => drop(self.digest(&chunk)),
                None if Instant::now() >= ask_at => self.paused()?,
                None => return Ok(None),
            }
        }
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        if self.run.is_none() {
            return Ok(Vec::new());
        }
        self.pump.guard(None);
        let mut stopped = self.command("OUTPUT NONE").map(drop);
        if stopped.is_ok() {
            // The converter may hold back what the sensor sent before it obeyed.
            while let Ok(Some(chunk)) = self.pump.read(Instant::now() + TAIL) {
                self.digest(&chunk);
            }
            if let Some(off) = self.settings.laser_off.clone() {
                stopped = self.command(&off).map(drop);
            }
        }
        if let Some(running) = &mut self.run {
            running.run.finish();
        }
        self.tally();
        stopped?;
        let run = self.run.take();
        let rows = run.map(|running| running.run.rows);
        Ok(rows.map_or_else(Vec::new, |mut rows| {
            std::iter::from_fn(|| rows.pop()).collect()
        }))
    }

    fn losses(&self) -> Losses {
        self.account
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        if self.run.is_some() {
            return Err(checked_in_a_run(self.pump.port()));
        }
        let info = self.command("GETINFO")?;
        let serial = field(&info, "Serial:").unwrap_or_default();
        same(self.pump.port(), &self.identity.serial, &serial)
    }
}

fn running_heard(run: &Option<Running>) -> Instant {
    run.as_ref()
        .map_or_else(Instant::now, |running| running.run.heard)
}

impl Drop for Sensor {
    /// Stops the stream and switches the laser off.
    fn drop(&mut self) {
        self.pump.guard(None);
        if self.pump.write(&self.farewell()).is_ok() {
            // Waits until both are obeyed, so that who opens it next finds it quiet.
            let last = self.settings.laser_off.clone();
            let _ = self.reply(last.as_deref().unwrap_or("OUTPUT NONE"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_the_manuals() {
        let close = |found, expected: f64| match found {
            // The formula's own rounding at the ends of the range is 1e-5 of it.
            Distance::Mm(mm) => assert!((mm - expected).abs() < 1e-3, "{mm} for {expected}"),
            other => panic!("{other:?}"),
        };
        close(Scale::Ild1420.distance(643, 50.0), 0.0);
        close(Scale::Ild1420.distance(32_760, 50.0), 25.0);
        close(Scale::Ild1420.distance(64_877, 50.0), 50.0);
        close(Scale::Ild1420Mastered.distance(32_760, 50.0), 0.0);
        close(Scale::Ild1900.distance(98_232, 10.0), 0.0);
        close(Scale::Ild1900.distance(163_768, 10.0), 10.0);
        assert_eq!(
            Scale::Ild1420.distance(262_082, 50.0),
            Distance::Absent("laser off")
        );
        assert_eq!(
            Scale::Ild1420.distance(262_075, 50.0),
            Distance::TooMuchData
        );
        assert_eq!(Scale::Ild1420.distance(262_079, 50.0), Distance::Impossible);
        assert_eq!(Scale::Ild1420.distance(70_000, 50.0), Distance::Impossible);
    }

    #[test]
    fn the_clock_turns_over_after_eleven_hours_and_fifty_five_minutes() {
        let mut clock = Clock::default();
        assert_eq!(clock.unwrap_ns(u32::MAX), 42_949_672_950_000);
        assert_eq!(clock.unwrap_ns(25), 42_949_672_960_000 + 250_000);
    }

    #[test]
    fn errors_stand_on_a_line_of_their_own() {
        assert_eq!(
            error_line("LOGIN x\r\nE202 Access denied\r\n"),
            Some("E202 Access denied")
        );
        assert_eq!(error_line("W320 Temperature\r\n"), None);
        assert_eq!(error_line("ECHO ON\r\n"), None);
    }
}

//! Length gauges and displays that send a line of text for each reading: Heidenhain ND, Mitutoyo, Sylvac, Keyence.
//!
//! Manuals: Heidenhain ND 221B/231B/281B and ND 522; Mitutoyo QM-Height and the MUX-10 format as multiplexers document it;
//! Sylvac Opto-RS; Keyence DL-RS1A. Quirks: none of the lines has a check, so each is held to its exact form; a button on the
//! gauge sends a line unasked; a Sylvac repeats what it is sent; a Keyence amplifier shows a special number until it has settled.
//!
//! Every reading is a profile: one column for each channel. Readings are asked for, and only one that is asked for is taken; a
//! question without a sound answer is a loss. What the manuals at hand do not settle is a setting: the question itself and the
//! format of the line. The data lines of a simplex Opto-RS cable, which ask by DTR, are not served.
//!
//! # Configuration
//!
//! ```toml
//! dialect = "heidenhain-nd"     # "heidenhain-nd", "mitutoyo", "sylvac-opto-rs" or "keyence-dl-rs1a"
//! port = "/dev/ttyUSB0"         # or one of the next three in its place
//! # usb_serial = "A50285BI"     # serial number of the USB converter: the same after plugging in again
//! # usb_id = "0403:6001"        # vendor and product of a converter without one
//! # address = "10.0.0.7:4001"   # TCP, as of a serial server
//! baud = 9600                   # serial ports only; these four are the dialect's own where not given
//! data_bits = 7                 # 7 or 8
//! parity = "even"               # "even", "odd" or "none"
//! stop_bits = 2                 # 1 or 2
//! # serial_number = "4711"      # of the gauge, for a dialect that tells it ("sylvac-opto-rs")
//! channels = 1                  # of a multiplexer, or amplifiers
//! # pitch_mm = 10.0             # from one channel to the next along x, for several
//! first_mm = 0.0                # x of the first
//! # unit = "mm"                 # "mm" or "inch", for a dialect whose lines do not tell it
//! # width = 9                   # characters of a reading, where the gauge always sends as many ("sylvac-opto-rs"): only then is a
//!                               # lost digit noticed
//! # question = "\u0002"         # what asks for a reading, where it is not the dialect's own
//! rate_hz = 10.0                # how often it is asked
//! reply_s = 0.5                 # how long an answer is waited for
//! # laser_stop = true           # write data number 050 at start and end ("keyence-dl-rs1a")
//! ```

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::capture::Profile;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Presence, Profiler, Setup,
    checked_in_a_run, same,
};
use crate::error::{DecodeError, DeviceError};
use crate::link::{DataBits, Line as LineFormat, Link, Links, Parity, StopBits, Target};
use crate::settings::Keys;

mod line;

pub use line::{Assembler, Dialect, LINE_MAX, Line, Reading, line};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "serial-gauge",
    summary: "length gauges and displays that send lines of text: Heidenhain ND, Mitutoyo, Sylvac, Keyence",
    configure,
};

/// How long one answer is waited for at opening.
const REPLY: Duration = Duration::from_secs(1);
/// How often a question is asked at opening before the gauge counts as silent.
const TRIES: u32 = 3;
/// Questions in a row without a sound answer, after which a gauge is silent.
const MISSED: u32 = 5;
const MM_PER_INCH: f64 = 25.4;

// ---- Settings ---------------------------------------------------------------------------------------------------------

#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    dialect: Dialect,
    serial_number: Option<String>,
    channels: usize,
    pitch_mm: f64,
    first_mm: f64,
    mm_per_unit: f64,
    width: Option<usize>,
    question: Option<String>,
    every: Duration,
    reply: Duration,
    laser_stop: bool,
}

impl Dialect {
    /// Word in the configuration, name for people.
    fn names(self) -> (&'static str, [&'static str; 2]) {
        match self {
            Dialect::HeidenhainNd => ("heidenhain-nd", ["Heidenhain", "ND"]),
            Dialect::Mitutoyo => ("mitutoyo", ["Mitutoyo", "MUX"]),
            Dialect::SylvacOptoRs => ("sylvac-opto-rs", ["Sylvac", "Opto-RS"]),
            Dialect::KeyenceDlRs1a => ("keyence-dl-rs1a", ["Keyence", "DL-RS1A"]),
        }
    }

    /// The line as the manuals have it from the factory.
    fn format(self) -> LineFormat {
        let seven_e_two = |baud| LineFormat {
            baud,
            data_bits: DataBits::Seven,
            parity: Parity::Even,
            stop_bits: StopBits::Two,
        };
        match self {
            Dialect::HeidenhainNd => seven_e_two(9600),
            Dialect::SylvacOptoRs => seven_e_two(4800),
            Dialect::Mitutoyo | Dialect::KeyenceDlRs1a => LineFormat::eight_n_one(9600),
        }
    }

    /// What asks for the reading of a channel, from 0.
    fn question(self, channel: usize) -> String {
        match self {
            // STX, Ctrl-B.
            Dialect::HeidenhainNd => "\x02".into(),
            Dialect::Mitutoyo => format!("{}\r", channel + 1),
            Dialect::SylvacOptoRs => "?\r".into(),
            Dialect::KeyenceDlRs1a => "M0\r\n".into(),
        }
    }

    /// How many questions a reading of all channels takes.
    fn questions(self, channels: usize) -> usize {
        match self {
            Dialect::Mitutoyo => channels,
            _ => 1,
        }
    }

    fn channels_max(self) -> i64 {
        match self {
            Dialect::HeidenhainNd | Dialect::SylvacOptoRs => 1,
            Dialect::Mitutoyo => 9,
            Dialect::KeyenceDlRs1a => 15,
        }
    }
}

const DIALECTS: [(&str, Dialect); 4] = [
    ("heidenhain-nd", Dialect::HeidenhainNd),
    ("mitutoyo", Dialect::Mitutoyo),
    ("sylvac-opto-rs", Dialect::SylvacOptoRs),
    ("keyence-dl-rs1a", Dialect::KeyenceDlRs1a),
];

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let dialect = dialect(&mut keys);
    let target = target(&mut keys, dialect);
    let serial_number = keys.text("serial_number");
    if serial_number.is_some() && dialect != Dialect::SylvacOptoRs {
        keys.wrong(
            "serial_number",
            "given",
            "none: this dialect does not tell it",
        );
    }
    let channels = keys
        .integer("channels", 1..=dialect.channels_max())
        .unwrap_or(1);
    let pitch = keys.number("pitch_mm", -10_000.0..=10_000.0);
    if channels > 1 && pitch.is_none_or(|pitch| pitch == 0.0) {
        keys.wrong("channels", channels, "pitch_mm beside it, not 0");
    }
    let first_mm = keys.number("first_mm", -10_000.0..=10_000.0).unwrap_or(0.0);
    let unit = keys.choice("unit", &[("mm", 1.0), ("inch", MM_PER_INCH)]);
    if unit.is_some() && dialect == Dialect::HeidenhainNd {
        keys.wrong("unit", "given", "none: its lines tell it");
    }
    let width = keys.integer("width", 3..=16);
    if width.is_some() && dialect != Dialect::SylvacOptoRs {
        keys.wrong(
            "width",
            "given",
            "none: the lines of this dialect have one width",
        );
    }
    let question = keys.text("question");
    let rate_hz = keys.number("rate_hz", 0.001..=1000.0).unwrap_or(10.0);
    let reply_s = keys.number("reply_s", 0.01..=60.0).unwrap_or(0.5);
    let laser_stop = keys.flag("laser_stop").unwrap_or(false);
    if laser_stop && dialect != Dialect::KeyenceDlRs1a {
        keys.wrong("laser_stop", "true", "false: only Keyence's have a laser");
    }
    keys.finish()?;
    let Some(target) = target else {
        // Without a mistake there is a target: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        target,
        dialect,
        serial_number,
        channels: channels as usize,
        pitch_mm: pitch.unwrap_or(0.0),
        first_mm,
        mm_per_unit: unit.unwrap_or(1.0),
        width: width.map(|width| width as usize),
        question,
        every: Duration::from_secs_f64(1.0 / rate_hz),
        reply: Duration::from_secs_f64(reply_s),
        laser_stop,
    }))
}

fn dialect(keys: &mut Keys) -> Dialect {
    keys.choice("dialect", &DIALECTS)
        .unwrap_or(Dialect::HeidenhainNd)
}

fn target(keys: &mut Keys, dialect: Dialect) -> Option<Target> {
    let format = dialect.format();
    let mut target = keys.target(format.baud);
    let data_bits =
        keys.choice_of_numbers("data_bits", &[(7, DataBits::Seven), (8, DataBits::Eight)]);
    let parities = [
        ("even", Parity::Even),
        ("odd", Parity::Odd),
        ("none", Parity::None),
    ];
    let parity = keys.choice("parity", &parities);
    let stop_bits = keys.choice_of_numbers("stop_bits", &[(1, StopBits::One), (2, StopBits::Two)]);
    if let Some(Target::Serial { line, .. }) = &mut target {
        line.data_bits = data_bits.unwrap_or(format.data_bits);
        line.parity = parity.unwrap_or(format.parity);
        line.stop_bits = stop_bits.unwrap_or(format.stop_bits);
    }
    target
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
        let [vendor, model] = self.dialect.names().1;
        let mut gauge = Gauge {
            port,
            link,
            assembler: Assembler::default(),
            identity: Identity {
                vendor: vendor.into(),
                model: model.into(),
                serial: String::new(),
                firmware: String::new(),
            },
            heard_bytes: 0,
            fresh: false,
            run: None,
            account: Losses::default(),
            settings: self.clone(),
        };
        gauge.introduce()?;
        gauge.fresh = false;
        Ok(Instrument::Profiler(Box::new(gauge)))
    }
}

// ---- Device -----------------------------------------------------------------------------------------------------------

struct Gauge {
    port: String,
    link: Arc<dyn Link>,
    assembler: Assembler,
    identity: Identity,
    heard_bytes: u64,
    /// It said that it has just been switched on.
    fresh: bool,
    run: Option<Run>,
    account: Losses,
    settings: Settings,
}

/// A run: questions asked in time.
struct Run {
    due: Instant,
    number: u32,
    missed: u32,
    heard_before: u64,
}

/// A number in a line of another width has lost a digit.
fn of_width(width: Option<usize>, text: &str, event: Event) -> Event {
    match (width, &event) {
        (Some(width), Ok(Line::One(_, Reading::Number { .. }))) if width != text.len() => {
            Err(DecodeError::Line { line: text.into() })
        }
        _ => event,
    }
}

/// A line, or why it is none.
type Event = Result<Line, DecodeError>;

impl Gauge {
    fn write(&self, text: &str) -> Result<(), DeviceError> {
        self.link
            .write(text.as_bytes(), Instant::now() + REPLY)
            .map_err(|source| DeviceError::Link {
                port: self.port.clone(),
                source,
            })
    }

    /// Reads lines until `deadline`, or until `each` returns a value.
    fn read<T>(
        &mut self,
        deadline: Instant,
        mut each: impl FnMut(&str, Event) -> Option<T>,
    ) -> Result<Option<T>, DeviceError> {
        let mut buffer = [0; 1024];
        let mut answer = None;
        loop {
            let n = self
                .link
                .read(&mut buffer, deadline)
                .map_err(|source| DeviceError::Link {
                    port: self.port.clone(),
                    source,
                })?;
            self.heard_bytes += n as u64;
            let dialect = self.settings.dialect;
            let (account, fresh) = (&mut self.account, &mut self.fresh);
            let width = self.settings.width;
            self.assembler.take(&buffer[..n], |text| {
                let (text, event) = match text {
                    Ok(text) => (text, of_width(width, text, line(dialect, text))),
                    Err(error) => ("", Err(error)),
                };
                *fresh |= event == Ok(Line::SwitchedOn);
                if answer.is_none() {
                    answer = each(text, event);
                } else {
                    // A line behind the answer belongs to nothing that was asked.
                    account.skipped_bytes += text.len() as u64;
                }
            });
            if answer.is_some() || n == 0 {
                return Ok(answer);
            }
            // One that never pauses must not hold us here.
            if Instant::now() >= deadline + REPLY {
                return Ok(None);
            }
        }
    }

    /// Takes in what comes unasked until `deadline`: a button, or the answer to a question that was given up.
    fn drain(&mut self, deadline: Instant) -> Result<(), DeviceError> {
        let mut skipped = 0;
        self.read(deadline, |text, _| {
            skipped += text.len() as u64;
            None::<()>
        })?;
        self.account.skipped_bytes += skipped;
        match self.run {
            Some(_) if self.fresh => Err(self.switched_on()),
            _ => Ok(()),
        }
    }

    fn switched_on(&self) -> DeviceError {
        DeviceError::Ended {
            port: self.port.clone(),
            reason: "the gauge was switched off and on, so that its zero may be lost",
            remedy: "check its supply, set its zero, then reopen it",
        }
    }

    /// Asks who it is where it can tell, and for one reading: that proves line, dialect and number of channels.
    fn introduce(&mut self) -> Result<(), DeviceError> {
        self.drain(Instant::now())?;
        if self.settings.dialect == Dialect::SylvacOptoRs {
            let text = self.settled("ID?\r", |text, event| match event {
                Ok(Line::Aside(_)) => Some(Ok(text.to_owned())),
                Ok(Line::Refused(reason)) => Some(Err(reason)),
                _ => None,
            })?;
            let serial = text
                .split_whitespace()
                .last()
                .unwrap_or_default()
                .to_owned();
            if let Some(expected) = self.settings.serial_number.clone().filter(|s| *s != serial) {
                return Err(DeviceError::WrongDevice {
                    port: self.port.clone(),
                    found: serial,
                    expected,
                });
            }
            self.identity.serial = serial;
            self.identity.model = text.split_whitespace().next().unwrap_or_default().into();
        }
        self.laser(false)?;
        for channel in 0..self.settings.dialect.questions(self.settings.channels) {
            let question = self.question(channel);
            let channels = self.settings.channels;
            let found = self.settled(&question, |_, event| match event {
                Ok(Line::Refused(reason)) => Some(Err(reason)),
                Ok(Line::One(..)) => Some(Ok(1)),
                Ok(Line::All(readings)) => Some(Ok(readings.len())),
                _ => None,
            })?;
            let of_all = self.settings.dialect == Dialect::KeyenceDlRs1a;
            if of_all && found != channels {
                return Err(DeviceError::WrongDevice {
                    port: self.port.clone(),
                    found: format!("{found} amplifiers"),
                    expected: format!("{channels} amplifiers"),
                });
            }
        }
        self.account = Losses::default();
        Ok(())
    }

    /// Asks until there is an answer; a refusal is an error.
    fn settled<T>(
        &mut self,
        question: &str,
        mut each: impl FnMut(&str, Event) -> Option<Result<T, String>>,
    ) -> Result<T, DeviceError> {
        let heard_before = self.heard_bytes;
        for _ in 0..TRIES {
            self.drain(Instant::now())?;
            self.assembler.forget();
            self.write(question)?;
            match self.read(Instant::now() + REPLY, &mut each)? {
                Some(Ok(answer)) => return Ok(answer),
                Some(Err(reason)) => {
                    return Err(DeviceError::Refused {
                        port: self.port.clone(),
                        command: question.trim().escape_default().to_string(),
                        reason,
                        remedy: "check `dialect`, `channels` and `question`",
                    });
                }
                None => {}
            }
        }
        Err(self.silent(heard_before, REPLY * TRIES))
    }

    fn silent(&self, heard_before: u64, waited: Duration) -> DeviceError {
        let port = self.port.clone();
        let deadline_s = waited.as_secs_f64();
        match self.heard_bytes - heard_before {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: "the question for a reading",
                deadline_s,
            },
        }
    }

    fn question(&self, channel: usize) -> String {
        let own = self.settings.question.clone();
        own.unwrap_or_else(|| self.settings.dialect.question(channel))
    }

    /// Switches the laser, where there is one to switch.
    fn laser(&mut self, on: bool) -> Result<(), DeviceError> {
        if !self.settings.laser_stop {
            return Ok(());
        }
        let question = format!("AW,050,{}\r\n", u8::from(!on));
        self.settled(&question, |text, event| match event {
            Ok(Line::Aside(_)) if text == "AW,050" => Some(Ok(())),
            Ok(Line::Refused(reason)) => Some(Err(reason)),
            _ => None,
        })
    }

    /// One reading of all channels: what was answered soundly, the rest not measured.
    fn measure(&mut self) -> Result<Profile, DeviceError> {
        let n = self.settings.channels;
        let mut z_mm = vec![f64::NAN; n];
        let mut answered = vec![false; n];
        for channel in 0..self.settings.dialect.questions(n) {
            self.drain(Instant::now())?;
            self.account.skipped_bytes += self.assembler.forget() as u64;
            let question = self.question(channel);
            self.write(&question)?;
            let deadline = Instant::now() + self.settings.reply;
            let mut rejected = 0;
            let answer = self.read(deadline, |text, event| match event {
                // A Sylvac repeats what it is sent.
                _ if text == question.trim_end() => None,
                Ok(Line::One(found, reading)) if found == channel => Some(vec![(channel, reading)]),
                // The error line names no channel.
                Ok(Line::One(0, reading @ Reading::Absent(_))) => Some(vec![(channel, reading)]),
                Ok(Line::All(readings)) if readings.len() == n => {
                    Some(readings.into_iter().enumerate().collect())
                }
                Ok(Line::SwitchedOn) => Some(Vec::new()),
                // Asked for something it could not do now: no value, and no need to wait.
                Ok(Line::Refused(_)) => Some(Vec::new()),
                Ok(Line::Aside(_)) => None,
                Ok(Line::One(..) | Line::All(_)) => {
                    rejected += 1;
                    None
                }
                Err(_) => {
                    rejected += 1;
                    None
                }
            })?;
            self.account.rejected += rejected;
            if self.fresh {
                return Err(self.switched_on());
            }
            for (channel, reading) in answer.unwrap_or_default() {
                answered[channel] = true;
                if let Reading::Number { value, inches } = reading {
                    let unit = if inches {
                        MM_PER_INCH
                    } else {
                        self.settings.mm_per_unit
                    };
                    z_mm[channel] = value * unit;
                }
            }
        }
        let received = answered.iter().filter(|&&a| a).count();
        self.account.received += received as u64;
        self.account.lost_on_link += (n - received) as u64;
        let settings = &self.settings;
        let Some(run) = &mut self.run else {
            return Err(self.not_started());
        };
        run.missed = if received > 0 { 0 } else { run.missed + 1 };
        if run.missed == MISSED {
            let before = run.heard_before;
            return Err(self.silent(before, settings.reply * MISSED));
        }
        if run.missed == 0 {
            run.heard_before = self.heard_bytes;
        }
        let sequence = run.number;
        run.number = run.number.wrapping_add(1);
        Ok(Profile {
            sequence,
            boot: 0,
            device_time_ns: 0,
            encoder: None,
            host_time: self.link.received(),
            dropped: 0,
            saturated: false,
            x_mm: (0..n)
                .map(|i| settings.first_mm + i as f64 * settings.pitch_mm)
                .collect(),
            z_mm,
            intensity: Vec::new(),
        })
    }

    fn not_started(&self) -> DeviceError {
        DeviceError::OutOfOrder {
            port: self.port.clone(),
            action: "next",
            needed: "a run that was started",
        }
    }
}

impl Profiler for Gauge {
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
        self.account = Losses::default();
        if let Err(error) = self.laser(true) {
            let _ = self.laser(false);
            return Err(error);
        }
        if self.fresh {
            return Err(self.switched_on());
        }
        self.run = Some(Run {
            due: Instant::now(),
            number: 0,
            missed: 0,
            heard_before: self.heard_bytes,
        });
        Ok(())
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        let Some(run) = &self.run else {
            return Err(self.not_started());
        };
        let due = run.due;
        // What comes unasked is a button; the end of the link shows here too.
        self.drain(due.min(deadline))?;
        if due > deadline {
            return Ok(None);
        }
        let every = self.settings.every;
        if let Some(run) = &mut self.run {
            // A gauge that is slower than the rate is asked as fast as it answers.
            run.due = (due + every).max(Instant::now());
        }
        self.measure().map(Some)
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        if self.run.take().is_some() {
            self.laser(false)?;
        }
        Ok(Vec::new())
    }

    fn losses(&self) -> Losses {
        self.account
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        if self.run.is_some() {
            return Err(checked_in_a_run(&self.port));
        }
        let (before, account) = (self.identity.serial.clone(), self.account);
        let introduced = self.introduce();
        self.account = account;
        introduced?;
        match self.fresh {
            true => Err(self.switched_on()),
            false => same(&self.port, &before, &self.identity.serial),
        }
    }
}

impl Drop for Gauge {
    /// Switches the laser off, where there is one to switch.
    fn drop(&mut self) {
        if self.settings.laser_stop && self.write("AW,050,1\r\n").is_ok() {
            let obeyed = |text: &str, _| (text == "AW,050").then_some(());
            let _ = self.read(Instant::now() + REPLY / 4, obeyed);
        }
    }
}

//! The account of every value: what a simulated sensor says it sent, over a minute of its own time, against what the driver says
//! it got and lost. No carrier, no waiting: the device's time runs as fast as it can be computed.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Losses};
use acies_drivers::error::LinkError;
use acies_drivers::link::{Link, Links, Target};
use acies_drivers::point::Layout;
use acies_drivers::{optoncdt, rf60x};
use acies_simulators::gauge::{self, Dialect};
use acies_simulators::point::{Fate, Record};
use acies_simulators::wire::Desk;

/// What came of one run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Account {
    /// Values that the device sent or meant to, from the first to the last that came.
    pub sent: u64,
    /// Of these, damaged or dropped by the simulator.
    pub injected: u64,
    /// Values that the driver delivered.
    pub received: u64,
    /// Values that the driver counts as lost.
    pub counted: u64,
    /// Values that the driver did not believe, by its own count: some of them damaged, some whole.
    pub doubted: u64,
    /// Values delivered that the simulator damaged, or never sent.
    pub wrong: u64,
    /// Values delivered as "nothing seen".
    pub absent: u64,
    /// Values that the device said were not sent.
    pub overrun: u64,
}

impl Account {
    /// Nothing wrong was delivered, and every loss is counted once.
    pub fn is_exact(&self) -> bool {
        let balanced = self.received + self.counted == self.sent;
        // What was doubted may have been damaged indeed.
        let explained = (self.injected..=self.injected + self.doubted).contains(&self.counted);
        self.wrong == 0 && balanced && explained
    }

    /// Both together.
    pub fn plus(self, other: Account) -> Account {
        Account {
            sent: self.sent + other.sent,
            injected: self.injected + other.injected,
            received: self.received + other.received,
            counted: self.counted + other.counted,
            doubted: self.doubted + other.doubted,
            wrong: self.wrong + other.wrong,
            absent: self.absent + other.absent,
            overrun: self.overrun + other.overrun,
        }
    }
}

/// Holds what was delivered, as places in the side log and mm, to the log.
fn account(
    log: &[Record],
    delivered: &[(usize, f64)],
    losses: Losses,
    mm: impl Fn(i64) -> f64,
    doubted: u64,
) -> Account {
    let (Some(first), Some(last)) = (delivered.first(), delivered.last()) else {
        return Account::default();
    };
    let within = log.get(first.0..=last.0).unwrap_or_default();
    // The unit of the wire, half of the coarsest.
    let same = |a: f64, b: f64| a.is_nan() && b.is_nan() || (a - b).abs() < 6e-4;
    let sound = |&(place, z): &(usize, f64)| {
        let record = log.get(place).filter(|record| record.fate == Fate::Sent);
        record.is_some_and(|record| {
            same(mm(record.code), z) || z.is_nan() && mm(record.code).is_finite()
        })
    };
    Account {
        sent: within.len() as u64,
        injected: within.iter().filter(|r| r.fate != Fate::Sent).count() as u64,
        received: losses.received,
        counted: losses.lost_on_link,
        doubted,
        wrong: delivered.iter().filter(|one| !sound(one)).count() as u64,
        absent: delivered.iter().filter(|(_, z)| z.is_nan()).count() as u64,
        overrun: losses.dropped_by_device,
    }
}

/// One run of an optoNCDT at 1 kHz with its counter.
pub fn optoncdt(faults: &str, seed: u64, time: Duration) -> Account {
    let mut setup = acies_simulators::optoncdt::Setup::new("S", seed);
    setup.rate_hz = 1000.0;
    setup.faults = faults.parse().expect("the test's faults");
    let (mut desk, shared) = acies_simulators::optoncdt::desk(setup);
    // One count a value: the encoder is the sensor's counter, unwrapped.
    let table = "address = 'a:1'\nrate_hz = 1000\nencoder_step = 1";
    let table = toml::from_str(table).expect("TOML");
    let mut stream = optoncdt::Stream::new(table, 50.0).expect("a configuration");
    let began = Instant::now();
    desk.write(b"OUTPUT RS422\r\n");
    let mut delivered = Vec::new();
    let mut take = |stream: &mut optoncdt::Stream| {
        while let Some(profile) = stream.pop() {
            delivered.push((profile.encoder.expect("an encoder"), profile.z_mm[0]));
        }
    };
    while let Some(bytes) = desk.read(time) {
        stream.take(&bytes, began + desk.now());
        take(&mut stream);
    }
    stream.finish();
    take(&mut stream);
    shared.look(|truth| {
        let first = truth.values.first().map_or(0, |v| i64::from(v.number));
        let places: Vec<(usize, f64)> = delivered
            .iter()
            .map(|&(number, z)| (usize::try_from(number - first).unwrap_or(usize::MAX - 1), z))
            .collect();
        let mm = |code: i64| match code {
            643..=64_877 => (102.0 * code as f64 / 65_520.0 - 1.0) / 100.0 * 50.0,
            _ => f64::NAN,
        };
        account(
            &truth.values,
            &places,
            stream.losses(),
            mm,
            stream.doubted(),
        )
    })
}

/// One run of an RF60x, 5 ms from result to result.
pub fn rf60x(faults: &str, seed: u64, time: Duration) -> Account {
    let mut setup = acies_simulators::rf60x::Setup::new(&[1], seed);
    setup.faults = faults.parse().expect("the test's faults");
    let (mut desk, shared) = acies_simulators::rf60x::desk(setup);
    let period = Duration::from_millis(5);
    let mut stream = rf60x::Stream::new(50.0, true, period, Layout::SINGLE);
    let mut decoder = rf60x::Decoder::default();
    decoder.expect(2);
    let began = Instant::now();
    desk.write(&rf60x::request(1, 7, &[]));
    let mut delivered = Vec::new();
    while let Some(bytes) = desk.read(time) {
        let at = began + desk.now();
        decoder.take(&bytes, |answer, skipped| stream.take(&answer, skipped, at));
        while let Some(profile) = stream.pop() {
            delivered.push((profile.sequence as usize, profile.z_mm[0]));
        }
    }
    shared.look(|truth| {
        // A burst that arrived whole is never missed, so the first one that did is number 0.
        let first = truth
            .values
            .iter()
            .position(|v| v.fate == Fate::Sent)
            .unwrap_or(0);
        let places: Vec<(usize, f64)> = delivered.iter().map(|&(n, z)| (n + first, z)).collect();
        let mm = |code: i64| match code {
            0 => f64::NAN,
            _ => code as f64 * 50.0 / 16_384.0,
        };
        account(
            &truth.values,
            &places,
            stream.losses(decoder.skipped_bytes()),
            mm,
            0,
        )
    })
}

/// A link to a desk: waiting for bytes lets the desk's time pass, not ours.
struct Across {
    desk: Mutex<Desk>,
    began: Instant,
    opened: Instant,
}

/// Links to a desk.
pub(crate) struct Open(Arc<Across>);

/// Links that lead to a desk, whatever the target.
pub(crate) fn across(desk: Desk) -> Open {
    let now = Instant::now();
    Open(Arc::new(Across {
        desk: Mutex::new(desk),
        began: now,
        opened: now,
    }))
}

impl Links for Open {
    fn open(&self, _: &Target) -> Result<Arc<dyn Link>, LinkError> {
        Ok(Arc::clone(&self.0) as _)
    }
}

impl Link for Across {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let mut desk = self.desk.lock().unwrap_or_else(PoisonError::into_inner);
        // The plan of a run lies ahead of the desk, or far ahead of our own clock where the desk is late. An answer is waited for
        // from our own now on, for a second at most.
        let planned = deadline.saturating_duration_since(self.began);
        let waited = deadline.saturating_duration_since(Instant::now());
        let until = match waited > Duration::from_secs(1) {
            true => planned.max(desk.now()),
            false => desk.now() + waited,
        };
        match desk.read(until) {
            Some(bytes) => {
                // An answer is shorter than any buffer here.
                buffer[..bytes.len()].copy_from_slice(&bytes);
                Ok(bytes.len())
            }
            None if desk.is_unplugged() => Err(LinkError::Gone),
            None => Ok(0),
        }
    }

    fn write(&self, bytes: &[u8], _: Instant) -> Result<(), LinkError> {
        self.desk
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .write(bytes);
        Ok(())
    }
}

/// One run of a gauge that is asked ten times a second, through its driver from the opening on.
pub fn gauge(dialect: Dialect, faults: &str, seed: u64, time: Duration) -> Account {
    let setup = gauge::Setup {
        faults: faults.parse().expect("the test's faults"),
        ..gauge::Setup::new(dialect, seed)
    };
    let (desk, shared) = gauge::desk(setup);
    let word = match dialect {
        Dialect::HeidenhainNd => "heidenhain-nd",
        Dialect::Mitutoyo => "mitutoyo",
        Dialect::Sylvac => "sylvac-opto-rs",
        Dialect::Keyence => "keyence-dl-rs1a",
    };
    let width = match dialect {
        Dialect::Sylvac => "width = 9",
        _ => "",
    };
    let table = format!("address = 'a:1'\ndialect = '{word}'\n{width}");
    let table = toml::from_str(&table).expect("TOML");
    let driver = ALL.iter().find(|driver| driver.name == "serial-gauge");
    let setup = (driver.expect("the driver").configure)(table).expect("a configuration");
    let links = across(desk);
    let across = Arc::clone(&links.0);
    let opened = setup.open(&links);
    let Ok(Instrument::Profiler(mut gauge)) = opened else {
        return Account::default();
    };
    let before = shared.look(|truth| truth.values.len());
    if gauge.start().is_err() {
        return Account::default();
    }
    // What came of each reading: its value, and whether there was an answer.
    let mut readings: Vec<(f64, bool)> = Vec::new();
    loop {
        let lost_before = gauge.losses().lost_on_link;
        let later = across.opened + 2 * time + Duration::from_secs(3600);
        let measured = gauge.next(later);
        let answered = gauge.losses().lost_on_link == lost_before;
        let Ok(Some(profile)) = measured else {
            // The reading that ends a run, as one too many without an answer, was asked for and is counted; it makes no profile.
            if !answered {
                readings.push((f64::NAN, false));
            }
            break;
        };
        readings.push((profile.z_mm[0], answered));
        let desk = across.desk.lock().unwrap_or_else(PoisonError::into_inner);
        if desk.now() >= time {
            break;
        }
    }
    let losses = gauge.losses();
    shared.look(|truth| account_of_readings(&truth.values[before..], &readings, losses))
}

/// Holds each reading of a gauge to the side log.
fn account_of_readings(log: &[Record], readings: &[(f64, bool)], losses: Losses) -> Account {
    let mut account = Account {
        sent: readings.len() as u64,
        received: losses.received,
        counted: losses.lost_on_link,
        overrun: losses.dropped_by_device,
        ..Account::default()
    };
    for (place, &(z, answered)) in readings.iter().enumerate() {
        let record = log.get(place);
        let truth = record.map_or(f64::NAN, |record| match record.code {
            gauge::NO_VALUE => f64::NAN,
            code => code as f64 / 1000.0,
        });
        // The unit of the wire, half of the coarsest.
        let same = (truth - z).abs() < 6e-4 || truth.is_nan() && z.is_nan();
        account.absent += u64::from(answered && z.is_nan());
        account.wrong += u64::from(answered && !same);
        // A lost carriage return before a line feed costs nothing, nor does a damaged answer behind the same line unasked: the value came,
        // and it is the right one. A question that was damaged has no record.
        let damaged = record.is_none_or(|record| record.fate != Fate::Sent);
        account.injected += u64::from(damaged && !(answered && same));
    }
    account
}

#[test]
fn every_value_of_the_serial_sensors_is_accounted_for() {
    let time = Duration::from_secs(10);
    let harmless = [
        "",
        "latency-lumps",
        "interleaved-reply",
        "counter-wrap",
        "clock-drift",
    ];
    let harmful = [
        "byte-loss",
        "bursts",
        "sentinels",
        "dropped-triggers",
        "truncated",
        "overrun-flag",
        "byte-loss,bursts,unasked-lines,sentinels,truncated",
    ];
    let [quiet, bad] = [&harmless[..], &harmful[..]].map(|cases| {
        let mut all = Account::default();
        for faults in cases {
            for seed in 0..4 {
                let one = optoncdt(faults, seed, time);
                assert!(
                    one.sent > 9000 && one.is_exact(),
                    "optoncdt {faults} {seed}: {one:?}"
                );
                all = all.plus(one);
                let one = rf60x(faults, seed, time);
                assert!(
                    one.sent > 1900 && one.is_exact(),
                    "rf60x {faults} {seed}: {one:?}"
                );
                all = all.plus(one);
            }
        }
        all
    });
    assert_eq!((quiet.counted, quiet.absent, quiet.overrun), (0, 0, 0));
    assert!(bad.counted > 0 && bad.absent > 0 && bad.overrun > 0);
}

/// Two bits count the bursts of an RF60x, so that a loss of four shows in their time and bytes only: five faults at once, in time and in the
/// lumps of a USB converter, over 600 minutes of device time each.
#[test]
fn every_value_of_a_two_bit_counter_is_accounted_for_over_600_seeds() {
    use rayon::prelude::*;
    let together = "byte-loss,bursts,unasked-lines,sentinels,truncated";
    let lumped = "byte-loss,bursts,unasked-lines,sentinels,truncated,latency-lumps";
    for faults in [together, lumped] {
        let inexact: Vec<(u64, Account)> = (0..600)
            .into_par_iter()
            .map(|seed| (seed, rf60x(faults, seed, Duration::from_secs(60))))
            .filter(|(_, one)| !one.is_exact() || one.counted < 100)
            .collect();
        let first = inexact.first();
        assert!(
            first.is_none(),
            "{faults}: {} of 600, {first:?}",
            inexact.len()
        );
    }
}

#[test]
fn every_reading_of_the_gauges_is_accounted_for() {
    let dialects = [
        Dialect::HeidenhainNd,
        Dialect::Mitutoyo,
        Dialect::Sylvac,
        Dialect::Keyence,
    ];
    for dialect in dialects {
        for faults in [
            "",
            "byte-loss",
            "sentinels",
            "truncated",
            "overrun-flag",
            "late-reply",
            "unasked-lines",
        ] {
            let one = gauge(dialect, faults, 3, Duration::from_secs(60));
            assert!(
                one.sent > 150 && one.is_exact(),
                "{dialect:?} {faults}: {one:?}"
            );
            let lossy = ["byte-loss", "truncated"].contains(&faults);
            assert_eq!(one.counted > 0, lossy, "{dialect:?} {faults}: {one:?}");
        }
    }
    // All at once, where a burst of zeros may also end the run: the reading that ended it is counted too.
    let together = "byte-loss,bursts,unasked-lines,sentinels,truncated";
    let mut all = Account::default();
    for (dialect, seed) in dialects
        .into_iter()
        .flat_map(|d| (0..20).map(move |seed| (d, seed)))
    {
        let one = gauge(dialect, together, seed, Duration::from_secs(60));
        assert!(one.is_exact(), "{dialect:?} {seed}: {one:?}");
        all = all.plus(one);
    }
    assert!(all.counted > 400 && all.absent > 400, "{all:?}");
}

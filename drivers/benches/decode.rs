//! How fast the decoders are, and whether a full line is kept up with.
//!
//! `cargo bench -p acies-drivers --bench decode`: each decoder alone, MB/s of one core; then an optoNCDT that fills 921600 Bd for 60 s over a
//! pseudo-terminal, simulator and driver on the same cores. `-- 5` takes 5 s.

#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::path::Path;
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::device::Instrument;
use acies_drivers::link::cable::Cable;
use acies_drivers::point::Layout;
use acies_drivers::{optoncdt, rf60x, serial_gauge};
use acies_simulators::wire::Wire;

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let seconds = words
        .iter()
        .find_map(|word| word.parse().ok())
        .unwrap_or(60);
    decoders();
    full_line(seconds);
}

/// Prints how many MB of `bytes` a second `decode` takes: the best of five passes of half a second.
fn rate(name: &str, bytes: &[u8], unit: &str, per_byte: f64, mut decode: impl FnMut(&[u8])) {
    let mut best = 0.0_f64;
    for _ in 0..5 {
        let began = Instant::now();
        let mut n = 0_usize;
        while began.elapsed() < Duration::from_millis(500) {
            // As a read of a serial port or a socket hands them out.
            bytes.chunks(4096).for_each(&mut decode);
            n += bytes.len();
        }
        best = best.max(n as f64 / began.elapsed().as_secs_f64());
    }
    let mb = best / 1e6;
    let units = best * per_byte / 1e6;
    println!("{name:<42} {mb:>8.1} MB/s {units:>8.2} M {unit}/s");
}

fn decoders() {
    let (mut desk, _) =
        acies_simulators::optoncdt::desk(acies_simulators::optoncdt::Setup::new("S", 1));
    desk.write(b"OUTPUT RS422\r\n");
    let mut words = Vec::new();
    // One turn of the counter, so that the stream goes on where it begins anew.
    while let Some(bytes) = desk.read(Duration::from_micros(65_535_900)) {
        words.extend(bytes);
    }
    let mut decoder = optoncdt::Decoder::default();
    let mut sum = 0_u64;
    rate("optoNCDT words", &words, "words", 1.0 / 3.0, |bytes| {
        decoder.take(bytes, |item| {
            if let optoncdt::Item::Word(word) = item {
                sum += u64::from(word.value);
            }
        });
    });
    let table = || toml::from_str("address = 'a:1'\nrate_hz = 4000").expect("TOML");
    let mut stream = optoncdt::Stream::new(table(), 50.0).expect("a configuration");
    let now = Instant::now();
    rate(
        "optoNCDT to profiles of 1 value",
        &words,
        "values",
        1.0 / 6.0,
        |bytes| {
            stream.take(bytes, now);
            while let Some(profile) = stream.pop() {
                sum += u64::from(black_box(profile).sequence);
            }
        },
    );
    let mut rows: toml::Table = table();
    rows.insert("columns".into(), 1000.into());
    rows.insert("pitch_mm".into(), 0.1.into());
    let mut stream = optoncdt::Stream::new(rows, 50.0).expect("a configuration");
    rate(
        "optoNCDT to profiles of 1000 values",
        &words,
        "values",
        1.0 / 6.0,
        |bytes| {
            stream.take(bytes, now);
            while let Some(profile) = stream.pop() {
                sum += u64::from(black_box(profile).sequence);
            }
        },
    );

    let (mut desk, _) = acies_simulators::rf60x::desk(acies_simulators::rf60x::Setup::new(&[1], 1));
    desk.write(&rf60x::request(1, 7, &[]));
    let mut bursts = Vec::new();
    while let Some(bytes) = desk.read(Duration::from_secs(600)) {
        bursts.extend(bytes);
    }
    let mut decoder = rf60x::Decoder::default();
    decoder.expect(2);
    let mut stream = rf60x::Stream::new(50.0, true, Duration::from_millis(5), Layout::SINGLE);
    rate(
        "RF60x to profiles of 1 value",
        &bursts,
        "values",
        0.25,
        |bytes| {
            decoder.take(bytes, |answer, skipped| stream.take(&answer, skipped, now));
            while let Some(profile) = stream.pop() {
                sum += u64::from(black_box(profile).sequence);
            }
        },
    );

    let lines = b"-      5.23  =A\r\n".repeat(10_000);
    let mut assembler = serial_gauge::Assembler::default();
    rate(
        "Heidenhain ND lines",
        &lines,
        "lines",
        1.0 / 17.0,
        |bytes| {
            assembler.take(bytes, |text| {
                let line = text
                    .and_then(|text| serial_gauge::line(serial_gauge::Dialect::HeidenhainNd, text));
                sum += u64::from(black_box(line).is_ok());
            });
        },
    );
    black_box(sum);
}

/// 15,300 measurements a second of two values: 918,000 of the 921,600 bits a second.
const FULL_HZ: f64 = 15_300.0;

fn full_line(seconds: u64) {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("devices");
    std::fs::create_dir_all(&folder).expect("a folder");
    let port = folder.join("ttyFULL");
    let setup = acies_simulators::optoncdt::Setup {
        rate_hz: FULL_HZ,
        ..acies_simulators::optoncdt::Setup::new("FULL", 1)
    };
    let wire = Wire::pty(&port).expect("a pseudo-terminal");
    let device = acies_simulators::optoncdt::start(wire, setup).expect("a device");
    let driver = ALL
        .iter()
        .find(|driver| driver.name == "optoncdt")
        .expect("the driver");
    let table = format!(
        "port = {:?}\nrate_hz = {FULL_HZ}",
        port.display().to_string()
    );
    let configured =
        (driver.configure)(toml::from_str(&table).expect("TOML")).expect("a configuration");
    let Ok(Instrument::Profiler(mut sensor)) = configured.open(&Cable) else {
        panic!("it does not open");
    };
    sensor.start().expect("a start");
    let began = Instant::now();
    let until = began + Duration::from_secs(seconds);
    let mut lag = Vec::new();
    while Instant::now() < until {
        if let Some(profile) = sensor.next(until).expect("a run") {
            lag.push(profile.host_time.elapsed());
        }
    }
    let took = began.elapsed().as_secs_f64();
    sensor.stop().expect("a stop");
    let losses = sensor.losses();
    let sent = device.truth().values.len();
    lag.sort();
    let (median, worst) = (lag[lag.len() / 2], lag[lag.len() - 1]);
    println!(
        "\n921600 Bd filled for {took:.0} s: sent {sent}, received {}, lost {}, rejected {}: {:.0} values/s, {:.1} kB/s",
        losses.received,
        losses.lost_on_link,
        losses.rejected,
        losses.received as f64 / took,
        losses.received as f64 * 6e-3 / took
    );
    println!("from the read of its last byte to the caller: median {median:?}, worst {worst:?}");
    assert_eq!(losses.received, sent as u64, "every value arrived");
}

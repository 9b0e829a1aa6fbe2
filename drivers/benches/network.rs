//! Speed of the network and USB drivers: decoding alone, and sustained reception from simulated devices on the same computer.
//!
//! `cargo bench -p acies-drivers --bench network` takes ten seconds a device, `ACIES_BENCH_SECONDS=60` as many as it says. The device is played by the same
//! computer, so that its share of the processor is in the figures. `-- decoding`, `tcp`, `usb` or `hesitating` runs one part alone.

use std::hint::black_box;
use std::io::Write;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Profiler};
use acies_drivers::gocator::message::{Content, Decoder, message};
use acies_drivers::ippdme::line;
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_drivers::u3v_profiler::block::{Geometry, pixel, points_mm};
use acies_simulators::gocator::{Form, Setup, SimulatedGocator, Surface};
use acies_simulators::u3v;
use acies_simulators::usb::Socket;
use acies_simulators::usb::preload::{Carrier, library};

#[allow(dead_code)] // the tests use more of it
#[path = "../tests/usb/hesitant.rs"]
mod hesitant;

use hesitant::Hesitant;

const COLUMNS: u32 = 1280;
const CHILD: &str = "ACIES_BENCH_USB";

fn say(text: &str) {
    let _ = writeln!(std::io::stdout(), "{text}");
}

/// Calls `work` for a second; the answer is what it did in a second, in millions, the best of five fifths.
fn rate(mut work: impl FnMut() -> usize) -> f64 {
    let mut best = 0.0_f64;
    for _ in 0..5 {
        let began = Instant::now();
        let mut done = 0;
        while began.elapsed() < Duration::from_millis(200) {
            done += work();
        }
        best = best.max(done as f64 / began.elapsed().as_secs_f64() / 1e6);
    }
    best
}

fn decoding() {
    for (name, kind, point) in [("uniform", 0x8006_u16, 2_usize), ("point cloud", 0x8005, 4)] {
        let mut bytes = (48 + COLUMNS * point as u32).to_le_bytes().to_vec();
        bytes.extend(kind.to_le_bytes());
        bytes.extend(40_u16.to_le_bytes());
        bytes.extend(1_u32.to_le_bytes());
        bytes.extend(COLUMNS.to_le_bytes());
        bytes.extend(20_000_u32.to_le_bytes());
        bytes.extend(3_000_u32.to_le_bytes());
        bytes.resize(48, 0);
        bytes.extend((0..COLUMNS as usize * point / 2).flat_map(|i| (i as i16).to_le_bytes()));
        let stream = bytes.repeat(50);
        let points = rate(|| {
            let mut n = 0;
            let taken = Decoder::default().take(&stream, |whole| {
                if let Ok(found) = message(whole)
                    && let Content::Profiles(profiles) = found.content
                {
                    n += black_box(profiles.points_mm(0)).0.len();
                }
            });
            taken.expect("sound messages");
            n
        });
        say(&format!(
            "decode gocator {name}: {points:.0} M points/s on one core"
        ));
    }
    let geometry = Geometry {
        a_scale: 0.05,
        a_offset: -10.0,
        c_scale: 0.002,
        c_offset: 0.0,
        invalid: Some(0.0),
    };
    for (name, format, bytes) in [("C16", 0x0110_00B8, 2), ("ABC32f", 0x0260_00C0, 12)] {
        let pixel = pixel(format).expect("a format");
        let line: Vec<u8> = (0..COLUMNS as usize * bytes)
            .map(|i| (i % 63) as u8)
            .collect();
        let points = rate(|| black_box(points_mm(&line, pixel, &geometry, 0)).0.len());
        say(&format!(
            "decode u3v-profiler Coord3D_{name}: {points:.0} M points/s on one core"
        ));
    }
    let text = "00080 # IJK(0.00000,0.00000,1.00000), X(3.06205), Y(-24.26795), Z(32.73005)";
    let lines = rate(|| usize::from(black_box(line::response(text)).is_ok()));
    say(&format!(
        "decode ippdme: {lines:.2} M lines of a point/s on one core"
    ));
}

fn seconds() -> u64 {
    let text = std::env::var("ACIES_BENCH_SECONDS").unwrap_or_default();
    text.parse().unwrap_or(10)
}

fn open(driver: &str, table: &str) -> Box<dyn Profiler> {
    open_over(&Cable, driver, table)
}

fn open_over(links: &dyn Links, driver: &str, table: &str) -> Box<dyn Profiler> {
    let driver = ALL
        .iter()
        .find(|known| known.name == driver)
        .expect("a driver");
    let table = toml::from_str(table).expect("the bench's TOML");
    let setup = (driver.configure)(table).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    match setup.open(links) {
        Ok(Instrument::Profiler(profiler)) => profiler,
        Ok(_) => panic!("no profiler"),
        Err(error) => panic!("{error}: {:?}", std::error::Error::source(&error)),
    }
}

/// Takes profiles for the time, and says how many.
fn sustain(name: &str, profiler: &mut dyn Profiler) {
    profiler.start().expect("a start");
    let began = Instant::now();
    let (mut profiles, mut points) = (0_u64, 0_u64);
    let mut late = Vec::new();
    while began.elapsed() < Duration::from_secs(seconds()) {
        let profile = profiler.next(Instant::now() + Duration::from_secs(10));
        let profile = profile.expect("a link").expect("a profile in time");
        profiles += 1;
        late.push(profile.host_time.elapsed());
        points += profile.z_mm.len() as u64;
    }
    let elapsed = began.elapsed().as_secs_f64();
    let rest = profiler.stop().expect("a stop").len() as u64;
    late.sort_unstable();
    let losses = profiler.losses();
    say(&format!(
        "{name}: {:.1} M points/s, {:.0} profiles/s of {COLUMNS} points, sustained for {elapsed:.0} s; lost {}, rejected {}, dropped {} of {}",
        points as f64 / elapsed / 1e6,
        profiles as f64 / elapsed,
        losses.lost_on_link,
        losses.rejected,
        losses.dropped_by_device,
        profiles + rest,
    ));
    say(&format!(
        "  from its last byte to the caller: median {:?}, worst {:?}",
        late[late.len() / 2],
        late[late.len() - 1]
    ));
    assert_eq!(
        losses.lost_on_link + losses.rejected + losses.dropped_by_device,
        0
    );
}

fn tcp() {
    for (name, form, intensity) in [
        ("gocator over TCP, uniform", Form::Uniform, false),
        (
            "gocator over TCP, point cloud with intensity",
            Form::PointCloud,
            true,
        ),
    ] {
        let device = SimulatedGocator::start(Setup {
            form,
            intensity,
            ..Setup::new(1, Surface::Wave(COLUMNS))
        });
        let device = device.expect("a simulated sensor");
        let mut profiler = open("gocator", &format!("{}\nfirst_frame = 0", device.keys()));
        sustain(name, profiler.as_mut());
    }
}

/// A device in a folder of its own, that programs see.
fn carried(setup: u3v::Setup, run: impl FnOnce(&Socket<u3v::Profiler>, &Carrier<u3v::Profiler>)) {
    let folder = std::env::temp_dir().join(format!("acies-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let socket = Socket::new(u3v::Profiler::new(setup));
    let carrier = Carrier::start(&folder, socket.clone()).expect("a carrier");
    run(&socket, &carrier);
    drop(carrier);
    let _ = std::fs::remove_dir_all(folder);
}

/// This program again, with the device attached; what it said.
fn child(carrier: &Carrier<u3v::Profiler>, order: &str) -> String {
    let output = Command::new(std::env::current_exe().expect("this program"))
        .envs(carrier.environment())
        .env(CHILD, order)
        .stderr(Stdio::inherit())
        .output()
        .expect("a child");
    assert!(output.status.success(), "{order}");
    String::from_utf8(output.stdout).expect("text")
}

fn usb() {
    for (lines, format) in [
        (1, "Coord3D_C16"),
        (64, "Coord3D_C16"),
        (64, "Coord3D_ABC32f"),
    ] {
        let setup = u3v::Setup {
            lines,
            ..u3v::Setup::new("SN-1", u3v::Surface::Wave(COLUMNS))
        };
        carried(setup, |_, carrier| {
            for way in ["overlapping", "single"] {
                say(child(carrier, &format!("{lines} {format} {way}")).trim_end());
            }
        });
    }
}

fn sustain_usb(lines: &str, format: &str, way: &str) {
    let table = format!("features = [['PixelFormat', '{format}']]\nfirst_block = 0");
    let host = Hesitant::new(&Cable, way == "single");
    let mut profiler = open_over(&host, "u3v-profiler", &table);
    let name = format!(
        "u3v-profiler over simulated USB, {format}, {lines} lines a block, {way} transfers"
    );
    sustain(&name, profiler.as_mut());
}

// ---- A device that does not wait --------------------------------------------------------------------------------------

/// Far below what the carrier takes on this machine when nobody hesitates: what is lost is lost by hesitating.
const BLOCKS_HZ: f64 = 200.0;
const BLOCK_LINES: u32 = 16;
const ROOM_BLOCKS: usize = 2;
/// From one hesitation to the next.
const EVERY: Duration = Duration::from_millis(200);

/// The host's reading thread is kept from its work again and again, and the device goes on: what is lost with one transfer at a time, what with
/// several in flight, and whether the driver counts what the device lost.
fn hesitating() {
    say(&format!(
        "u3v-profiler at {BLOCKS_HZ} blocks/s of {BLOCK_LINES} lines of {COLUMNS} points by its own clock, room for {ROOM_BLOCKS} blocks; every {EVERY:?} the host is busy elsewhere"
    ));
    for busy_ms in [0, 10, 25, 40] {
        for way in ["single", "overlapping"] {
            let setup = u3v::Setup {
                rate_hz: Some(BLOCKS_HZ),
                lines: BLOCK_LINES,
                room_blocks: Some(ROOM_BLOCKS),
                ..u3v::Setup::new("SN-1", u3v::Surface::Wave(COLUMNS))
            };
            carried(setup, |socket, carrier| {
                let said = child(carrier, &format!("{busy_ms} busy {way}"));
                let numbers: Vec<u64> = said
                    .split_whitespace()
                    .map(|word| word.parse().expect("a number"))
                    .collect();
                let [lines, lost, last_line] = numbers[..] else {
                    panic!("three numbers: {said}");
                };
                let per_block = u64::from(BLOCK_LINES);
                let (received, last) = (lines / per_block, last_line / per_block);
                let truth = socket.with(|device| device.truth());
                // What it lost behind the last one that came, nobody can know.
                let overrun = truth.overrun.iter().filter(|block| **block < last).count() as u64;
                say(&format!(
                    "  busy for {busy_ms} ms, {way:<11}: {received:>6} blocks received, {overrun:>5} lost by the device ({:.2} %), {lost:>5} counted by the driver",
                    100.0 * overrun as f64 / (received + overrun) as f64
                ));
                assert_eq!((lost, received + lost), (overrun, last + 1));
            });
        }
    }
}

/// The child's part: the lines received, the blocks lost, and the last line.
fn hesitate(busy: Duration, single: bool) {
    let host = Hesitant::new(&Cable, single);
    let mut profiler = open_over(&host, "u3v-profiler", "first_block = 0\nencoder_step = 10");
    profiler.start().expect("a start");
    let began = Instant::now();
    let mut last = 0;
    let mut next = EVERY;
    while began.elapsed() < Duration::from_secs(seconds()) {
        let profile = profiler.next(Instant::now() + Duration::from_secs(10));
        last = profile
            .expect("a link")
            .expect("a profile in time")
            .sequence;
        if began.elapsed() > next && !busy.is_zero() {
            let kept = host.busy();
            std::thread::sleep(busy);
            drop(kept);
            next = began.elapsed() + EVERY;
        }
    }
    let under_way = profiler.stop().expect("a stop");
    last = under_way.last().map_or(last, |profile| profile.sequence);
    let losses = profiler.losses();
    say(&format!(
        "{} {} {last}",
        losses.received, losses.lost_on_link
    ));
}

fn main() {
    if let Ok(child) = std::env::var(CHILD) {
        match *child.split(' ').collect::<Vec<&str>>() {
            [ms, "busy", way] => {
                let busy = Duration::from_millis(ms.parse().expect("milliseconds"));
                hesitate(busy, way == "single");
            }
            [lines, format, way] => sustain_usb(lines, format, way),
            _ => panic!("what: {child}"),
        }
        return;
    }
    // `cargo test` runs benches too, without this word.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    let only = |name: &str| {
        let words = std::env::args()
            .skip(1)
            .filter(|word| !word.starts_with('-'));
        let words: Vec<String> = words.collect();
        words.is_empty() || words.iter().any(|word| word == name)
    };
    if only("decoding") {
        decoding();
    }
    if only("tcp") {
        tcp();
    }
    if library().is_none() {
        say("USB over libusb: skipped, no libumockdev-preload.so.0 (Debian package umockdev)");
        return;
    }
    if only("usb") {
        usb();
    }
    if only("hesitating") {
        hesitating();
    }
}

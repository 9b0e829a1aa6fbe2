//! Speed of the network and USB drivers: decoding alone, and sustained reception from simulated devices on the same computer.
//!
//! `cargo bench -p acies-drivers --bench network` takes ten seconds a device, `ACIES_BENCH_SECONDS=60` as many as it says. The device is played by the same
//! computer, so that its share of the processor is in the figures.

use std::hint::black_box;
use std::io::Write;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Profiler};
use acies_drivers::error::LinkError;
use acies_drivers::gocator::message::{Content, Decoder, message};
use acies_drivers::ippdme::line;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::usb::{OneByOne, Request, UsbInterface, UsbLink, UsbStream, UsbTarget};
use acies_drivers::link::{Link, Links, Target};
use acies_drivers::u3v_profiler::block::{Geometry, pixel, points_mm};
use acies_simulators::gocator::{Form, Setup, SimulatedGocator, Surface};
use acies_simulators::u3v;
use acies_simulators::usb::Socket;
use acies_simulators::usb::preload::{Carrier, library};

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

/// Links whose USB streams have one transfer in flight, to compare with.
struct Single;

struct SingleLink(Arc<dyn UsbLink>);

impl Links for Single {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        Cable.open(target)
    }

    fn open_usb(&self, target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
        Ok(Arc::new(SingleLink(Cable.open_usb(target)?)))
    }
}

type Passed = Result<Option<usize>, LinkError>;

impl UsbLink for SingleLink {
    fn interfaces(&self) -> &[UsbInterface] {
        self.0.interfaces()
    }

    fn claim(&self, interface: u8) -> Result<(), LinkError> {
        self.0.claim(interface)
    }

    fn control_in(&self, request: Request, buffer: &mut [u8], deadline: Instant) -> Passed {
        self.0.control_in(request, buffer, deadline)
    }

    fn control_out(&self, request: Request, bytes: &[u8], deadline: Instant) -> Passed {
        self.0.control_out(request, bytes, deadline)
    }

    fn read(&self, endpoint: u8, buffer: &mut [u8], deadline: Instant) -> Passed {
        self.0.read(endpoint, buffer, deadline)
    }

    fn write(&self, endpoint: u8, bytes: &[u8], deadline: Instant) -> Passed {
        self.0.write(endpoint, bytes, deadline)
    }

    fn stream(
        &self,
        endpoint: u8,
        _: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError> {
        Ok(Box::new(OneByOne::new(self, endpoint, bytes)))
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), LinkError> {
        self.0.clear_halt(endpoint)
    }
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

fn usb() {
    if library().is_none() {
        say("USB over libusb: skipped, no libumockdev-preload.so.0 (Debian package umockdev)");
        return;
    }
    for (lines, format) in [
        (1, "Coord3D_C16"),
        (64, "Coord3D_C16"),
        (64, "Coord3D_ABC32f"),
    ] {
        let folder = std::env::temp_dir().join(format!(
            "acies-bench-{}-{lines}-{format}",
            std::process::id()
        ));
        std::fs::create_dir_all(&folder).expect("a folder");
        let device = u3v::Profiler::new(u3v::Setup {
            lines,
            ..u3v::Setup::new("SN-1", u3v::Surface::Wave(COLUMNS))
        });
        let carrier = Carrier::start(&folder, Socket::new(device)).expect("a carrier");
        for way in ["overlapping", "single"] {
            let status = Command::new(std::env::current_exe().expect("this program"))
                .envs(carrier.environment())
                .env(CHILD, format!("{lines} {format} {way}"))
                .status();
            assert!(status.is_ok_and(|status| status.success()), "the child");
        }
        drop(carrier);
        let _ = std::fs::remove_dir_all(folder);
    }
}

fn main() {
    if let Ok(child) = std::env::var(CHILD) {
        let mut words = child.split(' ');
        let (Some(lines), Some(format), Some(way)) = (words.next(), words.next(), words.next())
        else {
            panic!("lines, a format and a way: {child}");
        };
        let table = format!("features = [['PixelFormat', '{format}']]\nfirst_block = 0");
        let links: &dyn Links = if way == "single" { &Single } else { &Cable };
        let mut profiler = open_over(links, "u3v-profiler", &table);
        let name = format!(
            "u3v-profiler over simulated USB, {format}, {lines} lines a block, {way} transfers"
        );
        sustain(&name, profiler.as_mut());
        return;
    }
    // `cargo test` runs benches too, without this word.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    decoding();
    tcp();
    usb();
}

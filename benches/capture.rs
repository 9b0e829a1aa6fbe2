//! `cargo bench --bench capture [-- SECONDS]`: from the last byte of a profile to its points in the scan, by link: serial port (a pseudo-terminal), TCP,
//! USB (libusb, through umockdev). Median and worst of every profile of so many seconds (10), simulated devices on the same cores at a steady rate.
//!
//! Counted from the moment at which the read returned that brought the last byte ([`Profile::host_time`]) to the moment at which the assembled points
//! are there. What the system takes before that, from the device's write to the reader's waking, is measured beside it with bare messages.

#![allow(clippy::print_stdout)] // what a bench is for

use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};

use acies::acquire::{Calibration, Profiling, ScanEvent, ScanPlan, ScanWatch, scan};
use acies::geometry::RigidTransform;
use acies_drivers::ALL;
use acies_drivers::capture::Profile;
use acies_drivers::device::Instrument;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::{Line, Links, Port, Target};
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use acies_simulators::gocator::{self, Form, SimulatedGocator};
use acies_simulators::pty::PtyDevice;
use acies_simulators::u3v;
use acies_simulators::usb::Socket;
use acies_simulators::usb::preload::{Carrier, library};
use acies_simulators::wire::Wire;
use glam::DVec3;

/// Of this program where it is its own child, with the USB device attached.
const CHILD: &str = "ACIES_BENCH_USB";

fn main() {
    if let Ok(seconds) = std::env::var(CHILD) {
        let table =
            "first_block = 0\nencoder_step = 10\nfeatures = [['PixelFormat', 'Coord3D_C16']]";
        return into_the_scan("u3v-profiler", table, seconds.parse().expect("seconds"));
    }
    let seconds = std::env::args().find_map(|word| word.parse().ok());
    let seconds = seconds.unwrap_or(10.0);
    let folder = std::env::temp_dir().join(format!("acies-capture-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    link_alone("pseudo-terminal", over_pty(&folder.join("bare")), seconds);
    serial(&folder, seconds);
    link_alone("TCP, loopback", over_tcp(), seconds);
    tcp(seconds);
    usb(&folder, seconds);
    let _ = std::fs::remove_dir_all(folder);
}

// ---- Devices ----------------------------------------------------------------------------------------------------------

/// 320 points at 100 Hz: what 921,600 baud carry.
fn serial(folder: &Path, seconds: f64) {
    let mut cell = DemoCell::with_options(DemoOptions {
        paced: true,
        ..DemoOptions::new(1)
    });
    cell.sensors[0].view.columns = 320;
    cell.sensors[0].view.traverse.profiles = u32::MAX;
    let port = folder.join("ttyLINE");
    let wire = Wire::pty(&port).expect("a pseudo-terminal");
    let _device = cell.start_profiler(0, wire).expect("a device");
    let table = format!(
        "port = {:?}\ncolumns = 320\nrate_hz = 100\ntrigger = 'time'",
        port.display().to_string()
    );
    into_the_scan("open-profile", &table, seconds);
}

fn tcp(seconds: f64) {
    let device = SimulatedGocator::start(gocator::Setup {
        form: Form::Uniform,
        rate_hz: Some(1000.0),
        ..gocator::Setup::new(1, gocator::Surface::Wave(1280))
    });
    let device = device.expect("a simulated sensor");
    let table = format!("{}\nfirst_frame = 0", device.keys());
    into_the_scan("gocator", &table, seconds);
}

fn usb(folder: &Path, seconds: f64) {
    if library().is_none() {
        println!("USB over libusb: skipped, no libumockdev-preload.so.0 (Debian package umockdev)");
        return;
    }
    let device = u3v::Profiler::new(u3v::Setup {
        rate_hz: Some(200.0),
        ..u3v::Setup::new("SN-1", u3v::Surface::Wave(1280))
    });
    let folder: PathBuf = folder.join("usb");
    std::fs::create_dir_all(&folder).expect("a folder");
    let carrier = Carrier::start(&folder, Socket::new(device)).expect("a carrier");
    let status = Command::new(std::env::current_exe().expect("this program"))
        .envs(carrier.environment())
        .env(CHILD, seconds.to_string())
        .status();
    assert!(status.is_ok_and(|status| status.success()), "the child");
}

// ---- Into the scan ----------------------------------------------------------------------------------------------------

/// Takes the time of every profile, and ends the scan when its own is over.
struct Watch {
    until: Instant,
    late: Vec<Duration>,
    points: usize,
}

impl ScanWatch for Watch {
    fn event(&mut self, _: ScanEvent) {}

    fn profile(&mut self, _: usize, profile: &Profile, points: &[DVec3]) {
        self.late.push(profile.host_time.elapsed());
        self.points += points.len();
    }

    fn aborted(&mut self) -> bool {
        Instant::now() > self.until
    }
}

fn into_the_scan(driver: &str, table: &str, seconds: f64) {
    let known = ALL.iter().find(|known| known.name == driver);
    let table = toml::from_str(table).expect("TOML");
    let setup = (known.expect("the driver").configure)(table);
    let setup = setup.unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    let profiler = match setup.open(&Cable) {
        Ok(Instrument::Profiler(profiler)) => profiler,
        Ok(_) => panic!("no profiler"),
        Err(error) => panic!("{error}: {:?}", std::error::Error::source(&error)),
    };
    let profiling = Profiling {
        name: driver.to_owned(),
        profiler,
        calibration: Calibration {
            machine_from_sensor: RigidTransform::IDENTITY,
            travel_mm_per_count: DVec3::Y * 0.001,
        },
    };
    // It ends by the watch.
    let plan = ScanPlan {
        end_count: i64::MAX,
        silence: Duration::from_secs(10),
    };
    let mut watch = Watch {
        until: Instant::now() + Duration::from_secs_f64(seconds),
        late: Vec::new(),
        points: 0,
    };
    let (scan, _) = scan(vec![profiling], plan, &mut watch).expect("a scan");
    let view = &scan.views[0];
    let losses = view.losses;
    let (median, worst) = median_and_worst(&mut watch.late);
    println!(
        "{driver}: {} profiles, {} points in the scan ({} profiles without a place, {} lost); from its last byte to the scan: median {median:?}, worst {worst:?}",
        watch.late.len(),
        watch.points,
        view.unplaced,
        losses.lost_on_link + losses.dropped_by_device + losses.rejected,
    );
}

fn median_and_worst(late: &mut [Duration]) -> (Duration, Duration) {
    late.sort_unstable();
    (late[late.len() / 2], late[late.len() - 1])
}

// ---- The link alone ---------------------------------------------------------------------------------------------------

/// A target, and the end of the link at which a device would write.
type Bare = (Target, Box<dyn FnOnce() -> Box<dyn Write + Send> + Send>);

struct Pty(PtyDevice);

impl Write for Pty {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

fn over_pty(port: &Path) -> Bare {
    let device = PtyDevice::plug(port).expect("a pseudo-terminal");
    let target = Target::Serial {
        port: Port::Path(port.display().to_string()),
        line: Line::eight_n_one(921_600),
    };
    (target, Box::new(move || Box::new(Pty(device))))
}

fn over_tcp() -> Bare {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a socket");
    let address = listener.local_addr().expect("an address").to_string();
    let accept = move || -> Box<dyn Write + Send> {
        let (stream, _) = listener.accept().expect("a host");
        stream.set_nodelay(true).expect("a socket");
        Box::new(stream)
    };
    (Target::Tcp { address }, Box::new(accept))
}

/// A message of 700 bytes every 10 ms, from the end of its writing to the return of the read that brought its last byte.
fn link_alone(name: &str, (target, device): Bare, seconds: f64) {
    const BYTES: usize = 700;
    let (written, stamps) = sync_channel(1);
    let writer = std::thread::spawn(move || {
        let mut device = device();
        let until = Instant::now() + Duration::from_secs_f64(seconds);
        while Instant::now() < until {
            device.write_all(&[7; BYTES]).expect("a link");
            // The reader may be quicker than this thread.
            if written.send(Instant::now()).is_err() {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    });
    let link: Arc<_> = Cable.open(&target).expect("a link");
    let mut buffer = [0; BYTES];
    let mut late = Vec::new();
    let mut read = 0;
    // Until the device is gone.
    while let Ok(n) = link.read(&mut buffer, Instant::now() + Duration::from_millis(100)) {
        read += n;
        if read >= BYTES {
            let now = link.received();
            read -= BYTES;
            let sent = stamps.recv().expect("the writer");
            late.push(now.saturating_duration_since(sent));
        }
    }
    writer.join().expect("the device");
    let (median, worst) = median_and_worst(&mut late);
    println!(
        "{name}: {} messages, from the device's write to the reader: median {median:?}, worst {worst:?}",
        late.len()
    );
}

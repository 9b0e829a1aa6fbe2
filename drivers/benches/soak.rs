//! An hour of eight devices with faults every few seconds: does memory grow, does a file or thread stay behind, is every loss accounted for.
//!
//! `cargo bench -p acies-drivers --bench soak`: one hour of each device's own time, as fast as it can be played; `-- 5` plays five minutes.
//! The streaming sensors, the gauges and the robot have a time of their own; the line profilers come over a pseudo-terminal and over TCP as
//! fast as they are taken, and lose their link again and again. Each session is a device of its own seed, opened, run until its link is cut,
//! closed.
//!
//! Linux: memory, files and threads are read from `/proc/self`. The threads that stay are those of the simulators' pool, one a core.

#![allow(clippy::print_stdout)]

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Profiler, Setup};
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_simulators::carried::Motion;
use acies_simulators::gauge::Dialect;
use acies_simulators::gocator::{self, SimulatedGocator, Surface};
use acies_simulators::open_profile::{self, SimulatedProfiler};
use acies_simulators::pose::Pose;
use acies_simulators::scene::{self, Scene, Solid, Surfaces};
use acies_simulators::sensor::{Fan, Optics, Traverse, View};
use acies_simulators::ur_rtde;
use acies_simulators::wire::Wire;
use glam::DVec3;

#[allow(dead_code)]
#[path = "../../tests/drivers/accounts.rs"]
mod accounts;

use accounts::{Account, across};

/// Device time of one session, s, and what came of it.
type Session = fn(u64) -> (f64, Account);

/// Several a minute at the rates of these devices, and at the end of every session a cut link.
const DEVICES: [(&str, Session); 8] = [
    ("open-profile", open_profile_session),
    ("gocator", gocator_session),
    ("ur-rtde", robot_session),
    ("optoncdt", |seed| {
        let faults = "lose=0.0001,burst=0.0002,chatter=0.001,sentinel=0.001";
        (300.0, accounts::optoncdt(faults, seed, MINUTES_5))
    }),
    ("rf60x", |seed| {
        let faults = "lose=0.0001,burst=0.0002,sentinel=0.001,truncate=0.0005";
        (300.0, accounts::rf60x(faults, seed, MINUTES_5))
    }),
    ("heidenhain-nd", |seed| {
        (
            300.0,
            accounts::gauge(Dialect::HeidenhainNd, GAUGE, seed, MINUTES_5),
        )
    }),
    ("mitutoyo", |seed| {
        (
            300.0,
            accounts::gauge(Dialect::Mitutoyo, GAUGE, seed, MINUTES_5),
        )
    }),
    ("sylvac", |seed| {
        (
            300.0,
            accounts::gauge(Dialect::Sylvac, GAUGE, seed, MINUTES_5),
        )
    }),
];
const MINUTES_5: Duration = Duration::from_secs(300);
const GAUGE: &str = "lose=0.001,chatter=0.03,sentinel=0.02,truncate=0.01";
/// Longer than any wait of a driver.
const LONG: Duration = Duration::from_secs(20);

fn configured(driver: &str, table: &str) -> Box<dyn Setup> {
    let driver = ALL.iter().find(|known| known.name == driver);
    let table = toml::from_str(table).expect("TOML");
    (driver.expect("the driver").configure)(table).expect("a configuration")
}

fn profiler(setup: &dyn Setup) -> Box<dyn Profiler> {
    match setup.open(&Cable) {
        Ok(Instrument::Profiler(profiler)) => profiler,
        Ok(_) => panic!("no profiler"),
        Err(error) => panic!("{error}: {:?}", std::error::Error::source(&error)),
    }
}

/// Everything until the link is cut: sequence numbers.
fn until_cut(profiler: &mut dyn Profiler) -> Vec<u32> {
    profiler.start().expect("a start");
    let mut taken = Vec::new();
    while let Ok(Some(profile)) = profiler.next(Instant::now() + LONG) {
        taken.push(profile.sequence);
    }
    taken
}

/// Holds what came to what went out whole.
fn account(taken: &[u32], whole: &BTreeSet<u32>, received: u64, lost: u64) -> Account {
    let last = taken.last().copied().unwrap_or(0);
    let within = whole.range(..=last).count() as u64;
    Account {
        sent: u64::from(last) + 1,
        injected: u64::from(last) + 1 - within,
        received,
        counted: lost,
        wrong: taken.iter().filter(|n| !whole.contains(n)).count() as u64,
        ..Account::default()
    }
}

/// A hundred seconds at 500 Hz, cut at the end.
const PROFILES: u32 = 50_000;

fn open_profile_session(seed: u64) -> (f64, Account) {
    let folder = std::env::temp_dir().join(format!("acies-soak-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let port = folder.join("open-profile");
    let mut setup = open_profile::Setup::new("SOAK", seed);
    let faults = format!(
        "lose=0.000002,drop=0.0005,lose-frame=0.0005,lie=0.0002,duplicate=0.0005,unplug-after={PROFILES}"
    );
    setup.faults = faults.parse().expect("faults");
    let wire = Wire::pty(&port).expect("a pseudo-terminal");
    let device = SimulatedProfiler::start(wire, floor(), setup).expect("a device");
    let setup = configured(
        "open-profile",
        &format!("port = {:?}", port.display().to_string()),
    );
    let mut profiler = profiler(&*setup);
    let taken = until_cut(profiler.as_mut());
    let losses = profiler.losses();
    let truth = device.truth();
    let whole = |fate| {
        matches!(
            fate,
            open_profile::Fate::Sent | open_profile::Fate::Duplicated
        )
    };
    let sound = truth.profiles.iter().filter(|record| whole(record.fate));
    let sound: BTreeSet<u32> = sound.filter_map(|record| record.sequence).collect();
    let seconds = 0.002 * truth.profiles.len() as f64;
    (
        seconds,
        account(&taken, &sound, losses.received, losses.lost_on_link),
    )
}

/// A bare floor, a few columns: the computing is the simulator's, and not what is tried.
fn floor() -> View {
    let mut surfaces = Surfaces::default();
    let plane = scene::Surface::plane("floor", DVec3::ZERO, DVec3::Z);
    let solid = Solid::region(surfaces.add(plane));
    let down = Pose::turn_about(DVec3::ZERO, DVec3::X, std::f64::consts::PI);
    View {
        scene: Arc::new(Scene::new(surfaces, solid)),
        machine_from_scene: Pose::IDENTITY,
        machine_from_sensor: Pose::shift(DVec3::Z * 100.0).after(down),
        optics: Optics {
            near_mm: 60.0,
            far_mm: 140.0,
            width_mm: 40.0,
            fan: Fan::Parallel,
            camera_mm: DVec3::new(0.0, 100.0, 0.0),
            spot_mm: 0.0,
            blend_mm: 0.5,
            noise_mm: 0.01,
            drop_out: 0.0,
            incidence_limit_rad: 1.5,
            outliers: 0.0,
        },
        traverse: Traverse {
            axis: DVec3::Y,
            mm_per_count: 0.001,
            first_count: 0,
            step_counts: 10,
            profiles: 2 * PROFILES,
        },
        columns: 16,
        seed: 1,
    }
}

/// Frames of a session of the Gocator: 10 s, 0.2 ms apart.
const FRAMES: u64 = 50_000;

fn gocator_session(seed: u64) -> (f64, Account) {
    let setup = gocator::Setup {
        seed,
        misdeeds: gocator::Misdeeds {
            drop: 0.0001,
            lie: 0.0001,
            duplicate: 0.0001,
            cut_at: Some(FRAMES),
            ..gocator::Misdeeds::default()
        },
        ..gocator::Setup::new(13_434, Surface::Wave(16))
    };
    let device = SimulatedGocator::start(setup).expect("a sensor");
    let table = format!("{}\nfirst_frame = 0", device.keys());
    let mut profiler = profiler(&*configured("gocator", &table));
    let taken = until_cut(profiler.as_mut());
    let losses = profiler.losses();
    drop(profiler);
    let whole: BTreeSet<u32> = device.status().sent.iter().map(|&n| n as u32).collect();
    let account = account(&taken, &whole, losses.received, losses.lost_on_link);
    (2e-4 * FRAMES as f64, account)
}

/// Five minutes at 500 Hz, cut at the end.
const POSES: u32 = 150_000;

fn robot_session(seed: u64) -> (f64, Account) {
    let motion = Motion::straight(Pose::IDENTITY, DVec3::X * 1e5, 400.0);
    let mut setup = ur_rtde::Setup::new(Arc::new(motion), seed);
    let faults = format!(
        "drop=0.0005,truncate=0.0005,sentinel=0.0005,duplicate=0.0005,chatter=0.0005,unplug-after={POSES}"
    );
    setup.faults = faults.parse().expect("faults");
    let (desk, truth) = ur_rtde::desk(setup);
    let links: Box<dyn Links> = Box::new(across(desk));
    let Ok(Instrument::Robot(mut robot)) = configured("ur-rtde", "address = 'a:1'").open(&*links)
    else {
        panic!("no robot");
    };
    robot.start().expect("a start");
    let mut stamps = Vec::new();
    while let Ok(Some(pose)) = robot.next(Instant::now() + LONG) {
        stamps.push(pose.device_time_s);
    }
    let losses = robot.losses();
    let truth = truth.lock().expect("no panic").clone();
    // Stamps are whole cycles from the first on.
    let first = truth.cycles.first().map_or(0.0, |cycle| cycle.0);
    let number = |stamp: f64| ((stamp - first) / 0.002).round() as u32;
    let base = stamps.first().map_or(0, |stamp| number(*stamp));
    let taken: Vec<u32> = stamps.iter().map(|stamp| number(*stamp) - base).collect();
    let cycles = truth.cycles.iter().skip(base as usize).enumerate();
    let whole = cycles.filter(|(_, cycle)| cycle.1 == ur_rtde::Fate::Sent);
    let whole: BTreeSet<u32> = whole.map(|(n, _)| n as u32).collect();
    let account = account(&taken, &whole, losses.received, losses.lost_on_link);
    (0.002 * truth.cycles.len() as f64, account)
}

// ---- The process ------------------------------------------------------------------------------------------------------

/// Resident memory in kB, open files, threads.
fn process() -> [f64; 3] {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let field = |name: &str| -> f64 {
        let line = status.lines().find(|line| line.starts_with(name));
        let number = line.and_then(|line| line.split_whitespace().nth(1));
        number.and_then(|n| n.parse().ok()).unwrap_or(f64::NAN)
    };
    let files = std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
    [field("VmRSS:"), files as f64, field("Threads:")]
}

/// Slope of the least-squares line, y for x.
fn slope(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let (mx, my) = points
        .iter()
        .fold((0.0, 0.0), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
    let xy: f64 = points.iter().map(|p| (p.0 - mx) * (p.1 - my)).sum();
    let xx: f64 = points.iter().map(|p| (p.0 - mx).powi(2)).sum();
    xy / xx
}

/// Starts itself anew with one arena that gives back at once: what then stays in memory is kept by the program, not by its allocator.
fn with_a_frugal_allocator() -> bool {
    const ARENAS: &str = "MALLOC_ARENA_MAX";
    if std::env::var_os(ARENAS).is_some() {
        return false;
    }
    let Ok(program) = std::env::current_exe() else {
        return false;
    };
    let again = std::process::Command::new(program)
        .args(std::env::args_os().skip(1))
        .env(ARENAS, "1")
        .env("MALLOC_TRIM_THRESHOLD_", "65536")
        .env("MALLOC_MMAP_THRESHOLD_", "65536")
        .status();
    again.is_ok_and(|status| status.success())
}

fn main() {
    if with_a_frugal_allocator() {
        return;
    }
    let minutes: f64 = std::env::args()
        .find_map(|word| word.parse().ok())
        .unwrap_or(60.0);
    let goal_s = 60.0 * minutes;
    let began = Instant::now();
    // Microseconds of device time, all devices together.
    let played_us = AtomicU64::new(0);
    let over = AtomicBool::new(false);
    let behind = AtomicUsize::new(DEVICES.len());
    let before = process();
    println!("Eight devices, {minutes} minutes of device time each");
    println!(
        "{:>8} {:>12} {:>10} {:>6} {:>8}",
        "wall s", "device min", "memory kB", "files", "threads"
    );
    let hours = || played_us.load(Ordering::Relaxed) as f64 * 1e-6 / 3600.0 / DEVICES.len() as f64;
    let (accounts, samples) = std::thread::scope(|scope| {
        let playing: Vec<_> = DEVICES
            .iter()
            .map(|(name, session)| {
                let (played_us, behind) = (&played_us, &behind);
                scope.spawn(move || {
                    let (mut played_s, mut all, mut sessions, mut inexact) =
                        (0.0, Account::default(), 0, 0);
                    // Who is done plays on until all are, so that the load stays the same; the account takes it in.
                    let mut counted = false;
                    while behind.load(Ordering::Acquire) > 0 {
                        let (seconds, one) = session(1000 + sessions);
                        // A session that stood still would never end.
                        assert!(
                            seconds > 1.0,
                            "{name}: session {sessions} played {seconds} s"
                        );
                        played_s += seconds;
                        sessions += 1;
                        inexact += u64::from(!one.is_exact());
                        all = all.plus(one);
                        played_us.fetch_add((1e6 * seconds) as u64, Ordering::Relaxed);
                        if played_s >= goal_s && !std::mem::replace(&mut counted, true) {
                            behind.fetch_sub(1, Ordering::AcqRel);
                        }
                    }
                    (name, sessions, all, inexact, played_s / 3600.0)
                })
            })
            .collect();
        let sampler = scope.spawn(|| {
            let mut samples = Vec::new();
            while !over.load(Ordering::Acquire) {
                let [memory, files, threads] = process();
                samples.push((hours(), memory));
                println!(
                    "{:>8.0} {:>12.1} {memory:>10.0} {files:>6.0} {threads:>8.0}",
                    began.elapsed().as_secs_f64(),
                    60.0 * hours()
                );
                std::thread::park_timeout(Duration::from_secs(5));
            }
            samples
        });
        let accounts: Vec<_> = playing
            .into_iter()
            .map(|one| one.join().expect("no panic"))
            .collect();
        over.store(true, Ordering::Release);
        sampler.thread().unpark();
        (accounts, sampler.join().expect("no panic"))
    });
    println!(
        "{:<14} {:>8} {:>9} {:>11} {:>9} {:>9} {:>8} {:>6} {:>8}",
        "device",
        "hours",
        "sessions",
        "values",
        "injected",
        "counted",
        "doubted",
        "wrong",
        "inexact"
    );
    for (name, sessions, all, inexact, hours) in accounts {
        println!(
            "{name:<14} {hours:>8.1} {sessions:>9} {:>11} {:>9} {:>9} {:>8} {:>6} {inexact:>8}",
            all.sent, all.injected, all.counted, all.doubted, all.wrong
        );
    }
    let after = process();
    println!(
        "files {} before, {} after; threads {} before, {} after",
        before[1], after[1], before[2], after[2]
    );
    // The second half: in the first, buffers find their size.
    let settled: Vec<(f64, f64)> = samples.iter().skip(samples.len() / 2).copied().collect();
    let most = samples.iter().map(|sample| sample.1).fold(0.0, f64::max);
    println!(
        "memory {:.0} kB before, {most:.0} kB at most, {:.0} kB after; slope of the second half {:+.0} kB an hour of all eight, from {} samples",
        before[0],
        after[0],
        slope(&settled),
        settled.len()
    );
    let folder = std::env::temp_dir().join(format!("acies-soak-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(folder);
}

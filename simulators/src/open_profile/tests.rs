//! The device from the host's side of the wire, by the document: replies, runs, faults, and exact accounts of them.

use std::fs::File;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::fd::AsFd;
use std::path::PathBuf;

use glam::{DMat3, DVec3};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::frame::{Frame, Receiver, encode, u32_at};
use super::message as msg;
use super::*;
use crate::pose::Pose;
use crate::scene::{Scene, Solid, Surface, Surfaces};
use crate::sensor::{Fan, Optics, Traverse};

/// Longer than any answer takes on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

fn view(columns: u32, profiles: u32) -> View {
    let mut s = Surfaces::default();
    let floor = s.add(Surface::plane("floor", DVec3::ZERO, DVec3::Z));
    View {
        scene: Arc::new(Scene::new(s, Solid::region(floor))),
        machine_from_scene: Pose::IDENTITY,
        machine_from_sensor: Pose {
            rotation: DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z),
            translation: DVec3::Z * 100.0,
        },
        optics: Optics {
            near_mm: 60.0,
            far_mm: 140.0,
            width_mm: 90.0,
            fan: Fan::Diverging(-50.0),
            camera_mm: DVec3::new(0.0, 40.0, 0.0),
            spot_mm: 0.05,
            blend_mm: 0.5,
            noise_mm: 0.01,
            drop_out: 0.01,
            incidence_limit_rad: 1.5,
            outliers: 0.0,
        },
        traverse: Traverse {
            axis: DVec3::Y,
            mm_per_count: 0.01,
            first_count: -100,
            step_counts: 40,
            profiles,
        },
        columns,
        seed: 5,
    }
}

fn port(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("acies-sim-{}-{name}", std::process::id()))
}

fn device(name: &str, faults: &str, view: View) -> SimulatedProfiler {
    let setup = Setup {
        faults: faults.parse().unwrap(),
        ..Setup::new("P-0042", 9)
    };
    SimulatedProfiler::start(Wire::pty(&port(name)).unwrap(), view, setup).unwrap()
}

/// The other end, reading with the same framing rules.
struct Host<S> {
    stream: S,
    receiver: Receiver,
    raw: Vec<u8>,
}

impl Host<File> {
    fn open(device: &SimulatedProfiler) -> Host<File> {
        let file = File::options().read(true).write(true).open(device.port());
        Host::on(file.unwrap())
    }
}

impl<S: Read + Write + AsFd> Host<S> {
    fn on(stream: S) -> Host<S> {
        Host {
            stream,
            receiver: Receiver::default(),
            raw: Vec::new(),
        }
    }

    fn send(&mut self, kind: u8, id: u32, payload: &[u8]) {
        self.stream.write_all(&encode(kind, id, payload)).unwrap();
    }

    /// The next frame; `None` after `patience` without one, or when the line is cut.
    fn next(&mut self, patience: Duration) -> Option<Frame> {
        let until = Instant::now() + patience;
        loop {
            if let Some(frame) = self.receiver.next(Instant::now()) {
                return Some(frame);
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return None;
            }
            // wake up for an unfinished frame that is to be given up
            let left = left.min(Duration::from_millis(50));
            let timeout = Timespec {
                tv_sec: 0,
                tv_nsec: left.as_nanos() as i64,
            };
            let mut fds = [PollFd::new(&self.stream, PollFlags::IN)];
            if poll(&mut fds, Some(&timeout)).unwrap() == 0 {
                continue;
            }
            let mut buffer = [0; 8192];
            match self.stream.read(&mut buffer) {
                Ok(n) if n > 0 => {
                    self.raw.extend(&buffer[..n]);
                    self.receiver.take(&buffer[..n], Instant::now());
                }
                _ => return None,
            }
        }
    }

    fn ask(&mut self, kind: u8, id: u32, payload: &[u8]) -> Frame {
        self.send(kind, id, payload);
        loop {
            let frame = self.next(PATIENCE).expect("a reply");
            if frame.kind != msg::PROFILE && frame.id == id {
                return frame;
            }
        }
    }

    fn set(&mut self, key: u16, value: i64) -> (u16, i64) {
        let mut payload = key.to_le_bytes().to_vec();
        payload.extend(value.to_le_bytes());
        let reply = self.ask(msg::SET, 100 + u32::from(key), &payload);
        assert_eq!(reply.kind, msg::VALUE);
        let p = reply.payload;
        let value = i64::from_le_bytes(p[4..12].try_into().unwrap());
        (u16::from_le_bytes([p[0], p[1]]), value)
    }

    fn start(&mut self, run: u32, count: u32, keepalive_ms: u32) {
        let mut payload = run.to_le_bytes().to_vec();
        payload.extend(count.to_le_bytes());
        payload.extend(keepalive_ms.to_le_bytes());
        self.send(msg::START, 50, &payload);
    }

    /// Everything until STOPPED, or until the line is cut.
    fn until_stopped(&mut self) -> (Vec<Frame>, Option<Frame>) {
        let mut frames = Vec::new();
        while let Some(frame) = self.next(PATIENCE) {
            if frame.kind == msg::STOPPED {
                return (frames, Some(frame));
            }
            frames.push(frame);
        }
        (frames, None)
    }
}

fn sequences(frames: &[Frame]) -> Vec<u32> {
    let profiles = frames.iter().filter(|f| f.kind == msg::PROFILE);
    profiles.map(|f| f.id).collect()
}

/// Reason, run, sent, dropped.
fn stopped(frame: &Frame) -> [u32; 4] {
    let p = &frame.payload;
    let reason = u16::from_le_bytes([p[0], p[1]]);
    [reason.into(), u32_at(p, 2), u32_at(p, 6), u32_at(p, 10)]
}

#[test]
fn settings_are_taken_rounded_or_refused_with_their_value() {
    let device = device("settings", "", view(40, 10));
    let mut host = Host::open(&device);
    let identity = host.ask(msg::HELLO, 1, &[]);
    assert_eq!(identity.kind, msg::IDENTITY);
    assert_eq!(u32_at(&identity.payload, 0), device.status().boot);
    assert!(identity.payload.ends_with(b"\x06P-0042\x051.0.0"));
    assert_eq!(host.set(1, 250_000), (0, 250_000));
    assert_eq!(host.set(2, 12_345), (0, 12_000));
    assert_eq!(host.set(5, 41), (2, 40));
    assert_eq!(host.set(3, 2), (2, 1));
    assert_eq!(host.set(7, 1), (3, 36_500));
    assert_eq!(host.set(99, 1), (1, 0));
    host.start(1, 0, 5000);
    assert_eq!(host.next(PATIENCE).unwrap().kind, msg::STARTED);
    assert_eq!(host.set(1, 1000), (4, 250_000));
    let get = host.ask(msg::GET, 7, &1_u16.to_le_bytes());
    assert_eq!(get.payload[4..12], 250_000_i64.to_le_bytes());
}

#[test]
fn commands_that_cannot_be_obeyed_are_refused_with_a_reason() {
    let device = device("refused", "", view(40, 10));
    let mut host = Host::open(&device);
    let text = |f: &Frame| String::from_utf8(f.payload[4..].to_vec()).unwrap();
    let unknown = host.ask(0x42, 9, &[]);
    assert_eq!(
        (unknown.kind, unknown.payload[0], text(&unknown)),
        (msg::REFUSED, 5, "type 0x42?".into())
    );
    let short = host.ask(msg::SET, 10, &[1, 0]);
    assert_eq!(
        (short.payload[0], text(&short)),
        (6, "SET has 2 bytes, needs 10".into())
    );
    host.start(3, 0, 50);
    let started = host.next(PATIENCE).unwrap();
    assert_eq!((started.kind, started.payload[0]), (msg::STARTED, 2));
    assert!(!device.status().laser_on);
    // without any run STOP is answered as well
    assert_eq!(stopped(&host.ask(msg::STOP, 11, &[])), [0; 4]);
}

#[test]
fn a_run_starts_streams_and_stops_in_the_stated_order() {
    let device = device("run", "", view(40, 60));
    let mut host = Host::open(&device);
    assert!(!device.status().laser_on);
    host.start(7, 0, 10_000);
    let first = host.next(PATIENCE).unwrap();
    assert_eq!((first.kind, u32_at(&first.payload, 2)), (msg::STARTED, 7));
    assert!(device.status().laser_on);
    let mut frames: Vec<Frame> = (0..30).map(|_| host.next(PATIENCE).unwrap()).collect();
    // its reply may have been lost: the same START is answered and changes nothing
    host.start(7, 0, 10_000);
    host.send(msg::STOP, 51, &[]);
    let (rest, last) = host.until_stopped();
    let last = last.unwrap();
    frames.extend(rest);
    assert_eq!(frames.iter().filter(|f| f.kind == msg::STARTED).count(), 1);
    let n = sequences(&frames).len() as u32;
    assert_eq!(sequences(&frames), (0..n).collect::<Vec<u32>>());
    assert_eq!((last.id, stopped(&last)), (51, [0, 7, n, 0]));
    let status = device.status();
    assert!(!status.laser_on && !status.streaming);
    // after it, nothing but replies; STOP again tells the same numbers
    host.send(msg::STOP, 52, &[]);
    assert_eq!(stopped(&host.next(PATIENCE).unwrap()), [0, 7, n, 0]);
    let p = &frames[0].payload;
    assert_eq!(u32_at(p, 4), 7);
    assert_eq!(i64::from_le_bytes(p[20..28].try_into().unwrap()), -100);
}

#[test]
fn a_count_ends_the_run_by_itself() {
    let device = device("count", "", view(40, 60));
    let mut host = Host::open(&device);
    host.start(1, 25, 10_000);
    let (frames, last) = host.until_stopped();
    assert_eq!(sequences(&frames), (0..25).collect::<Vec<u32>>());
    let last = last.unwrap();
    assert_eq!((last.id, stopped(&last)), (0, [1, 1, 25, 0]));
    assert!(!device.status().laser_on);
}

#[test]
fn the_laser_goes_off_when_the_host_falls_silent() {
    let device = device("keepalive", "", view(40, 5));
    let mut host = Host::open(&device);
    let began = Instant::now();
    host.start(1, 0, 100);
    let (frames, last) = host.until_stopped();
    assert!(began.elapsed() >= Duration::from_millis(300));
    // the stage stands still after five; the laser stays on until the host is missed
    assert_eq!(sequences(&frames).len(), 5);
    assert_eq!(stopped(&last.unwrap()), [2, 1, 5, 0]);
    assert!(!device.status().laser_on);
    // any frame keeps it alive
    host.start(2, 0, 100);
    for id in 0..8 {
        let told = encode(msg::KEEPALIVE, id, &u64::from(id).to_le_bytes());
        host.stream.write_all(&told).unwrap();
        while host.next(Duration::from_millis(60)).is_some() {}
    }
    assert!(device.status().laser_on);
}

#[test]
fn a_device_that_starts_anew_has_another_boot_number_and_its_settings_are_gone() {
    let device = device("reboot", "reboot-after=10", view(40, 60));
    let mut host = Host::open(&device);
    let before = device.status().boot;
    assert_eq!(host.set(1, 100_000), (0, 100_000));
    host.start(1, 0, 10_000);
    assert!(device.wait_until(PATIENCE, |s| s.boots == 2));
    let status = device.status();
    assert_ne!(status.boot, before);
    assert!(!status.laser_on && !status.streaming && status.run.is_none());
    let alive = host.ask(msg::KEEPALIVE, 60, &[0; 8]);
    assert_eq!(u32_at(&alive.payload, 16), status.boot);
    let rate = host.ask(msg::GET, 61, &1_u16.to_le_bytes());
    assert_eq!(rate.payload[4..12], 500_000_i64.to_le_bytes());
    // the same run number starts a run, since there was none
    host.start(1, 3, 10_000);
    assert_eq!(stopped(&host.until_stopped().1.unwrap()), [1, 1, 3, 0]);
}

#[test]
fn the_cable_can_be_pulled_in_mid_scan_and_put_back() {
    let device = device("unplug", "unplug-after=20", view(40, 60));
    let mut host = Host::open(&device);
    host.start(1, 0, 10_000);
    // all that was sent is read before the line hangs up
    let (frames, last) = host.until_stopped();
    assert_eq!(sequences(&frames), (0..20).collect::<Vec<u32>>());
    assert_eq!(last, None);
    assert!(device.wait_until(PATIENCE, |s| !s.plugged));
    assert!(!device.status().laser_on);
    assert!(!std::path::Path::new(device.port()).exists());
    let truth = device.truth();
    assert_eq!((truth.profiles.len(), truth.count(1, Fate::Sent)), (20, 20));
    device.replug();
    assert!(device.wait_until(PATIENCE, |s| s.plugged));
    let mut host = Host::open(&device);
    host.start(2, 0, 10_000);
    let mut sequence = 0;
    while sequence < 39 {
        let frame = host.next(PATIENCE).unwrap();
        if frame.kind == msg::PROFILE {
            sequence = frame.id;
        }
    }
    assert_eq!(device.status().boots, 2);
    // and by hand
    device.unplug();
    assert!(device.wait_until(PATIENCE, |s| !s.plugged && !s.laser_on));
}

#[test]
fn the_cable_can_come_back_by_itself() {
    let device = device("replug", "unplug-after=5,replug-ms=30", view(40, 60));
    let mut host = Host::open(&device);
    host.start(1, 0, 10_000);
    assert_eq!(sequences(&host.until_stopped().0).len(), 5);
    assert!(device.wait_until(PATIENCE, |s| s.plugged && s.boots == 2));
    let mut host = Host::open(&device);
    assert_eq!(host.ask(msg::HELLO, 1, &[]).kind, msg::IDENTITY);
}

/// Runs all 300 profiles and accounts for every one.
fn account(name: &str, faults: &str) -> (Vec<u8>, Truth) {
    let device = device(name, faults, view(30, 300));
    let mut host = Host::open(&device);
    host.start(4, 300, 10_000);
    let mut frames = Vec::new();
    while device.status().run != Some(4) || device.status().streaming {
        // a START that was lost is sent again
        match host.next(Duration::from_millis(300)) {
            Some(frame) => frames.push(frame),
            None => host.start(4, 300, 10_000),
        }
    }
    while let Some(frame) = host.next(Duration::from_millis(400)) {
        frames.push(frame);
    }
    let truth = device.truth();
    assert_eq!(truth.profiles.len(), 300);
    let mut received = sequences(&frames);
    let copies = received.len();
    received.dedup();
    let good = |f: Fate| matches!(f, Fate::Sent | Fate::Duplicated);
    let sent: Vec<u32> = truth
        .profiles
        .iter()
        .filter(|p| good(p.fate))
        .map(|p| p.sequence.unwrap())
        .collect();
    assert_eq!(received, sent, "{faults}");
    let numbered = truth
        .profiles
        .iter()
        .filter(|p| p.sequence.is_some())
        .count();
    assert_eq!(numbered as u32, device.status().sent);
    let count = |fate| truth.count(4, fate);
    assert_eq!(count(Fate::DroppedInDevice) as u32, device.status().dropped);
    // sent = received + rejected + lost
    assert_eq!(
        numbered,
        received.len() + count(Fate::Damaged) + count(Fate::LostOnLink)
    );
    assert!(copies <= received.len() + count(Fate::Duplicated) + count(Fate::Sent));
    (host.raw, truth)
}

#[test]
fn every_profile_is_accounted_for_under_faults() {
    for (name, faults, fate) in [
        ("lose", "lose=3e-4", Fate::Damaged),
        ("flip", "flip=3e-4", Fate::Damaged),
        ("lie", "lie=0.03", Fate::Damaged),
        ("babble", "babble=0.2", Fate::Sent),
        ("drop", "drop=0.1", Fate::DroppedInDevice),
        ("gap", "lose-frame=0.1", Fate::LostOnLink),
        ("twice", "duplicate=0.1", Fate::Duplicated),
        ("pieces", "split,duplicate=0.02", Fate::Duplicated),
        ("lumps", "lumps,drop=0.02", Fate::DroppedInDevice),
        (
            "all",
            "lose=1e-4,flip=1e-4,lie=0.01,babble=0.05,drop=0.05,lose-frame=0.05,duplicate=0.05,split",
            Fate::Damaged,
        ),
    ] {
        let (_, truth) = account(name, faults);
        assert!(
            truth.count(4, fate) > 3,
            "{faults}: {}",
            truth.count(4, fate)
        );
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_the_same_faults() {
    let faults = "flip=1e-4,babble=0.1,drop=0.05,lose-frame=0.05,duplicate=0.1";
    let (bytes, truth) = account("same-1", faults);
    let (again, second) = account("same-2", faults);
    assert_eq!(truth, second);
    assert!(bytes == again, "{} and {} bytes", bytes.len(), again.len());
}

#[test]
fn a_silent_device_answers_nothing() {
    let device = device("silent", "silent-after=0", view(40, 10));
    let mut host = Host::open(&device);
    host.send(msg::HELLO, 1, &[]);
    assert_eq!(host.next(Duration::from_millis(150)), None);
}

#[test]
fn at_the_wrong_speed_all_is_rubbish() {
    use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
    let device = device("baud", "baud=921600", view(40, 10));
    let mut host = Host::open(&device);
    host.send(msg::HELLO, 1, &[]);
    assert_eq!(host.next(Duration::from_millis(150)), None);
    let mut termios = tcgetattr(&host.stream).unwrap();
    termios.set_speed(921_600).unwrap();
    tcsetattr(&host.stream, OptionalActions::Now, &termios).unwrap();
    // the device may still wait for the rest of what looked like a frame; a host asks again
    let answer = (0..20).find_map(|id| {
        host.send(msg::HELLO, id, &[]);
        host.next(Duration::from_secs(1))
    });
    assert_eq!(answer.unwrap().kind, msg::IDENTITY);
}

#[test]
fn the_encoder_can_jump() {
    let device = device("jump", "jump=10:1000", view(40, 20));
    let mut host = Host::open(&device);
    host.start(1, 20, 10_000);
    let (frames, _) = host.until_stopped();
    let encoders: Vec<i64> = frames
        .iter()
        .filter(|f| f.kind == msg::PROFILE)
        .map(|f| i64::from_le_bytes(f.payload[20..28].try_into().unwrap()))
        .collect();
    let expected: Vec<i64> = (0..20)
        .map(|i| -100 + 40 * i + if i < 10 { 0 } else { 1000 })
        .collect();
    assert_eq!(encoders, expected);
}

#[test]
fn a_paced_device_keeps_its_rate_and_drops_what_nobody_takes() {
    let setup = Setup {
        paced: true,
        ..Setup::new("P-1", 1)
    };
    let wire = Wire::pty(&port("paced")).unwrap();
    let device = SimulatedProfiler::start(wire, view(1000, 400), setup).unwrap();
    let mut host = Host::open(&device);
    // 50 profiles of 100 columns fit into the device's queue, so that none is dropped however slow this reader is
    assert_eq!(host.set(5, 100).0, 0);
    let began = Instant::now();
    host.start(1, 50, 10_000);
    let (frames, _) = host.until_stopped();
    assert_eq!(sequences(&frames).len(), 50);
    assert!(
        began.elapsed() >= Duration::from_millis(98),
        "{:?}",
        began.elapsed()
    );
    // of 1000 columns 64 KiB in the device and 20 in the line hold some 14; at 1 kHz the others are dropped, and counted
    assert_eq!(host.set(1, 1_000_000).0, 0);
    assert_eq!(host.set(5, 1000).0, 0);
    host.start(2, 100, 10_000);
    assert!(device.wait_until(PATIENCE, |s| s.run == Some(2) && !s.streaming));
    let (frames, last) = host.until_stopped();
    let [reason, _, sent, dropped] = stopped(&last.unwrap());
    assert_eq!((reason, sent + dropped), (1, 100));
    assert!(dropped > 50, "{dropped}");
    assert_eq!(sequences(&frames).len() as u32, sent);
}

#[test]
fn over_tcp_a_second_host_is_sent_away_and_a_closed_connection_ends_the_run() {
    let wire = Wire::tcp(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
    let device = SimulatedProfiler::start(wire, view(40, 10), Setup::new("P-2", 1)).unwrap();
    let mut host = Host::on(TcpStream::connect(device.port()).unwrap());
    assert_eq!(host.ask(msg::HELLO, 1, &[]).kind, msg::IDENTITY);
    let mut second = TcpStream::connect(device.port()).unwrap();
    second.set_read_timeout(Some(PATIENCE)).unwrap();
    assert_eq!(second.read(&mut [0; 8]).unwrap_or(0), 0);
    host.start(1, 0, 10_000);
    assert!(device.wait_until(PATIENCE, |s| s.laser_on));
    drop(host);
    assert!(device.wait_until(PATIENCE, |s| !s.laser_on && !s.streaming));
    // the device is the same, and answers the next host
    let mut host = Host::on(TcpStream::connect(device.port()).unwrap());
    assert_eq!(stopped(&host.ask(msg::STOP, 2, &[]))[0], 5);
    assert_eq!(device.status().boots, 1);
}

#[test]
fn a_traverse_kept_or_too_long_to_keep_gives_what_the_view_sees() {
    // 40 profiles are two and a half blocks; of 100,001 points each they are too many to keep
    for (columns, profiles) in [(7, 40), (100_001, 40_u32)] {
        let view = view(columns, profiles);
        let traversed = super::feed::Traversed::new(view.clone());
        for number in [2, 0, 2] {
            let block = traversed.block(number);
            let expected = if number == 2 { 8 } else { 16 };
            assert_eq!(block.len(), expected);
            let last = number * 16 + block.len() as u32 - 1;
            let seen = view.line(last).intensity;
            assert_eq!(block.last().map(|line| &line.intensity), Some(&seen));
        }
        assert!(traversed.is_of(&view));
    }
}

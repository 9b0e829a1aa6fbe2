//! The bytes of the simulated Gocator, field by field from the manual's tables, and its camera.

use std::f64::consts::TAU;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Form, Misdeeds, Setup, Surface};
use crate::sensor::Line;

/// "Invalid range": 0x8000.
const NOTHING: i16 = -32768;
/// x of a count of a point cloud, and z of a count, nm: 32,767 counts are 98 mm.
const FINE_NM: u32 = 3_000;

pub(super) enum Received {
    Bytes,
    Nothing,
    Gone,
}

/// Appends what is there.
pub(super) fn receive(mut stream: &TcpStream, held: &mut Vec<u8>) -> Received {
    let mut chunk = [0; 4096];
    match stream.read(&mut chunk) {
        Ok(0) => Received::Gone,
        Ok(n) => {
            held.extend_from_slice(&chunk[..n]);
            Received::Bytes
        }
        Err(error) if waits(&error) => Received::Nothing,
        Err(_) => Received::Gone,
    }
}

fn waits(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

/// The other end has closed.
pub(super) fn closed(stream: &TcpStream) -> bool {
    let _ = stream.set_nonblocking(true);
    let mut one = [0; 1];
    let peeked = stream.peek(&mut one);
    let _ = stream.set_nonblocking(false);
    match peeked {
        Ok(n) => n == 0,
        Err(error) => !waits(&error),
    }
}

/// Sends all, in pieces where asked; gives up when `over` says so.
pub(super) fn send(
    mut stream: &TcpStream,
    bytes: &[u8],
    pieces: Option<usize>,
    over: impl Fn() -> bool,
) -> io::Result<()> {
    for piece in bytes.chunks(pieces.unwrap_or(usize::MAX).max(1)) {
        let mut at = 0;
        while at < piece.len() {
            match stream.write(&piece[at..]) {
                Ok(n) => at += n,
                Err(error) if waits(&error) => {
                    if over() {
                        return Err(error);
                    }
                }
                Err(error) => return Err(error),
            }
        }
    }
    Ok(())
}

/// Takes a whole command off: length u32, id u16, payload.
pub(super) fn command(held: &mut Vec<u8>) -> Option<(u16, Vec<u8>)> {
    let length = u32::from_le_bytes(held.get(..4)?.try_into().ok()?) as usize;
    if length < 6 || held.len() < length {
        return None;
    }
    let command: Vec<u8> = held.drain(..length).collect();
    Some((
        u16::from_le_bytes([command[4], command[5]]),
        command[6..].to_vec(),
    ))
}

/// Length, id, status, payload.
pub(super) fn reply(id: u16, status: i32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = (10 + payload.len() as u32).to_le_bytes().to_vec();
    bytes.extend(id.to_le_bytes());
    bytes.extend(status.to_le_bytes());
    bytes.extend(payload);
    bytes
}

/// localInfo of Get System Info, and no remote sensors.
pub(super) fn system_info(serial: u32, running: bool) -> Vec<u8> {
    let mut info = serial.to_le_bytes().to_vec();
    info.extend([192, 168, 1, 10]);
    let mut name = b"Gocator 2330 (simulated)".to_vec();
    name.resize(32, 0);
    info.extend(name);
    info.extend([5, 2, 18, 3]);
    info.extend(i32::from(running).to_le_bytes());
    info.extend(0_i32.to_le_bytes()); // role: main
    info.extend(0_i32.to_le_bytes()); // no buddy
    info.extend(0_u32.to_le_bytes()); // remoteCount
    info
}

/// A message: size, control with the "last" bit, body.
fn message(kind: u16, last: bool, body: &[u8]) -> Vec<u8> {
    let mut bytes = (6 + body.len() as u32).to_le_bytes().to_vec();
    bytes.extend((kind | if last { 0x8000 } else { 0 }).to_le_bytes());
    bytes.extend(body);
    bytes
}

/// Health: id, instance, value of each indicator.
pub(super) fn health(indicators: &[(u32, u32, i64)]) -> Vec<u8> {
    let mut body = (indicators.len() as u32).to_le_bytes().to_vec();
    body.extend([0; 4]); // source and reserved
    for (id, instance, value) in indicators {
        body.extend(id.to_le_bytes());
        body.extend(instance.to_le_bytes());
        body.extend(value.to_le_bytes());
    }
    message(0, true, &body)
}

/// What was sent for one group.
pub(super) struct Shot {
    pub bytes: Vec<u8>,
    /// Indices of the frames that go out whole and well formed.
    pub whole: Vec<u64>,
    /// The connection closes after these bytes.
    pub cut: bool,
}

/// Takes frames and writes them down.
pub(super) struct Camera {
    rng: ChaCha8Rng,
    began: Instant,
    booted: Instant,
    /// A wave is computed once; a scene at every frame.
    waves: Vec<Rows>,
    clock_us: u64,
}

/// Data of one profile as they go out.
#[derive(Clone)]
struct Rows {
    points: Vec<u8>,
    intensity: Vec<u8>,
    encoder: i64,
    x_scale_nm: u32,
    x_offset_um: i32,
    z_offset_um: i32,
    width: u32,
}

const WAVES: u64 = 16;

impl Camera {
    pub fn new(setup: &Setup) -> Camera {
        let waves = match &setup.surface {
            Surface::Wave(columns) => (0..WAVES).map(|i| wave(*columns, i, setup.form)).collect(),
            Surface::View(_) | Surface::Carried(..) => Vec::new(),
        };
        Camera {
            rng: ChaCha8Rng::seed_from_u64(setup.seed),
            began: Instant::now(),
            booted: Instant::now(),
            waves,
            clock_us: 0,
        }
    }

    pub fn begin(&mut self, setup: &Setup, run: u64) {
        self.rng = ChaCha8Rng::seed_from_u64(setup.seed);
        self.rng.set_stream(run);
        self.began = Instant::now();
        self.clock_us = self.booted.elapsed().as_micros() as u64 + 1_000_000;
    }

    /// Waits for the time of frame `next`.
    pub fn pace(&self, setup: &Setup, next: u64, over: impl Fn() -> bool) {
        let Some(rate_hz) = setup.rate_hz else { return };
        let due = self.began + Duration::from_secs_f64(next as f64 / rate_hz);
        while !over() {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            std::thread::sleep(left.min(super::LOOK));
        }
    }

    /// The group of messages of frames `first` to `first + batch`.
    pub fn shoot(&mut self, setup: &Setup, first: u64, batch: u64) -> Shot {
        let misdeeds = &setup.misdeeds;
        let within = |at: Option<u64>| at.is_some_and(|at| (first..first + batch).contains(&at));
        let draw = |rng: &mut ChaCha8Rng, share: f64| share > 0.0 && rng.random::<f64>() < share;
        let dropped = draw(&mut self.rng, misdeeds.drop);
        let lied = draw(&mut self.rng, misdeeds.lie);
        let twice = draw(&mut self.rng, misdeeds.duplicate);
        let rows: Vec<Rows> = (first..first + batch)
            .map(|i| self.rows(setup, i))
            .collect();
        let period_us = period_us(setup);
        if within(misdeeds.clock_back_at) {
            self.clock_us = 0;
        }
        let clock = self.clock_us;
        let mut bytes = stamps(setup, first, clock, period_us, &rows);
        bytes.extend(profiles(setup, &rows, lied));
        if setup.intensity {
            bytes.extend(intensities(setup, &rows));
        }
        if misdeeds.bad_size_at.is_some_and(|at| first + batch > at) {
            bytes[..4].copy_from_slice(&u32::MAX.to_le_bytes());
        }
        let cut = within(misdeeds.cut_at);
        if cut {
            bytes.truncate(bytes.len() / 2);
        }
        let mut whole: Vec<u64> = (first..first + batch).collect();
        if dropped {
            bytes.clear();
        }
        if dropped || lied || cut {
            whole.clear();
        }
        if twice && !cut {
            bytes.extend_from_within(..);
        }
        Shot { bytes, whole, cut }
    }

    fn rows(&self, setup: &Setup, index: u64) -> Rows {
        match &setup.surface {
            Surface::Wave(_) => {
                let mut rows = self.waves[(index % WAVES) as usize].clone();
                rows.encoder = 10 * index as i64 + shake(setup.misdeeds.encoder_jitter, index);
                rows
            }
            Surface::View(view) => rows_of(&view.line(index as u32), setup.form),
            Surface::Carried(view, motion) => {
                let since_s = index as f64 * period_us(setup) * 1e-6;
                let machine_from_tool = motion.at(self.began + Duration::from_secs_f64(since_s));
                let machine_from_sensor = machine_from_tool.after(view.machine_from_sensor);
                rows_of(
                    &view.line_from(index as u32, machine_from_sensor),
                    setup.form,
                )
            }
        }
    }
}

/// Counts beside the truth, as of a stage that trembles at an edge of the encoder: another number for each frame, the same every time.
pub(crate) fn shake(most: u32, index: u64) -> i64 {
    let most = i64::from(most);
    // Steps of seven visit every number of a range that seven does not divide.
    (7 * index as i64).rem_euclid(2 * most + 1) - most
}

/// A reply as it goes out where replies go wrong.
pub fn spoilt(mut reply: Vec<u8>, misdeeds: &Misdeeds) -> Vec<u8> {
    let mut stray = Vec::new();
    for _ in 0..misdeeds.stray_replies {
        // To "Get System Info" of an older version of the protocol, which nobody asked for.
        stray.extend(self::reply(0x0002, 1, &[1, 2, 3]));
    }
    if misdeeds.swap_bytes && reply.len() >= 6 {
        reply[..4].reverse();
        reply[4..6].reverse();
    }
    stray.extend(reply);
    stray
}

/// From frame to frame.
fn period_us(setup: &Setup) -> f64 {
    setup.rate_hz.map_or(200.0, |hz| 1e6 / hz)
}

fn wave(columns: u32, phase: u64, form: Form) -> Rows {
    let line = Line {
        encoder: 0,
        x_mm: (0..columns).map(|i| f64::from(i) * 0.03 - 10.0).collect(),
        z_mm: (0..columns)
            .map(|i| 5.0 * (TAU * (f64::from(i) / 500.0 + phase as f64 / WAVES as f64)).sin())
            .collect(),
        intensity: vec![40_000; columns as usize],
        saturated: false,
    };
    rows_of(&line, form)
}

/// Rounds a line to counts; a uniform profile is sampled again at equal steps of x.
fn rows_of(line: &Line, form: Form) -> Rows {
    let seen = |i: usize| !line.z_mm[i].is_nan();
    let middle = {
        let (low, high) = line
            .z_mm
            .iter()
            .filter(|z| !z.is_nan())
            .fold((f64::MAX, f64::MIN), |(low, high), z| {
                (low.min(*z), high.max(*z))
            });
        if low > high { 0.0 } else { 0.5 * (low + high) }
    };
    let z_offset_um = (middle * 1e3).round() as i32;
    let z_count = |z: f64| {
        let counts = (z * 1e6 - f64::from(z_offset_um) * 1e3) / f64::from(FINE_NM);
        counts.round().clamp(-32_767.0, 32_767.0) as i16
    };
    let n = line.x_mm.len();
    let (first, last) = (
        line.x_mm.first().copied().unwrap_or(0.0),
        line.x_mm.last().copied().unwrap_or(0.0),
    );
    let mut rows = Rows {
        points: Vec::new(),
        intensity: line.intensity.iter().map(|i| (i >> 8) as u8).collect(),
        encoder: line.encoder,
        x_scale_nm: FINE_NM,
        x_offset_um: (0.5 * (first + last) * 1e3).round() as i32,
        z_offset_um,
        width: n as u32,
    };
    match form {
        Form::PointCloud => {
            for i in 0..n {
                let x =
                    (line.x_mm[i] * 1e6 - f64::from(rows.x_offset_um) * 1e3) / f64::from(FINE_NM);
                let (x, z) = match seen(i) {
                    true => (x.round() as i16, z_count(line.z_mm[i])),
                    false => (NOTHING, NOTHING),
                };
                rows.points.extend(x.to_le_bytes());
                rows.points.extend(z.to_le_bytes());
            }
        }
        Form::Uniform => {
            rows.x_offset_um = (first * 1e3).round() as i32;
            rows.x_scale_nm = ((last - first) * 1e6 / (n as f64 - 1.0).max(1.0))
                .round()
                .max(1.0) as u32;
            for z in resampled(line, &rows) {
                let z = if z.is_nan() { NOTHING } else { z_count(z) };
                rows.points.extend(z.to_le_bytes());
            }
        }
    }
    rows
}

fn resampled(line: &Line, rows: &Rows) -> Vec<f64> {
    resample(
        line,
        f64::from(rows.x_offset_um) * 1e-3,
        f64::from(rows.x_scale_nm) * 1e-6,
    )
}

/// z at equal steps from `origin`, mm, linear between neighbours that were both seen; one for each column of the line.
pub(crate) fn resample(line: &Line, origin: f64, step: f64) -> Vec<f64> {
    let n = line.x_mm.len();
    let mut at = 0;
    (0..n)
        .map(|i| {
            let x = origin + i as f64 * step;
            while at + 2 < n && line.x_mm[at + 1] < x {
                at += 1;
            }
            if n < 2 {
                return line.z_mm[0];
            }
            let (x0, x1) = (line.x_mm[at], line.x_mm[at + 1]);
            if !(x0..=x1).contains(&x) {
                return f64::NAN;
            }
            let t = (x - x0) / (x1 - x0);
            line.z_mm[at] * (1.0 - t) + line.z_mm[at + 1] * t
        })
        .collect()
}

fn stamps(setup: &Setup, first: u64, clock_us: u64, period_us: f64, rows: &[Rows]) -> Vec<u8> {
    let mut body = (rows.len() as u32).to_le_bytes().to_vec();
    body.extend(56_u16.to_le_bytes());
    body.extend([0, 0]); // source: main; reserved
    for (i, row) in rows.iter().enumerate() {
        let index = first + i as u64;
        body.extend(index.to_le_bytes());
        body.extend((clock_us + (index as f64 * period_us) as u64).to_le_bytes());
        body.extend(row.encoder.to_le_bytes());
        body.extend((-5_i64).to_le_bytes()); // encoder at the last index pulse
        body.extend(1_u64.to_le_bytes()); // digital input high
        body.extend(setup.serial.to_le_bytes());
        body.extend([0; 12]); // up to 56
    }
    message(1, false, &body)
}

fn profiles(setup: &Setup, rows: &[Rows], lied: bool) -> Vec<u8> {
    let row = &rows[0];
    let mut body = setup.attribute_size.to_le_bytes().to_vec();
    body.extend((rows.len() as u32).to_le_bytes());
    body.extend((row.width + u32::from(lied)).to_le_bytes());
    body.extend(row.x_scale_nm.to_le_bytes());
    body.extend(FINE_NM.to_le_bytes());
    body.extend(row.x_offset_um.to_le_bytes());
    body.extend(row.z_offset_um.to_le_bytes());
    body.push(0); // source: top
    body.extend(100_000_u32.to_le_bytes()); // exposure
    // The attributes begin at byte 8 of the message, which is byte 2 here.
    body.resize(2 + usize::from(setup.attribute_size), 0);
    for row in rows {
        body.extend(&row.points);
    }
    let kind = match setup.form {
        Form::PointCloud => 5,
        Form::Uniform => 6,
    };
    message(kind, !setup.intensity, &body)
}

fn intensities(setup: &Setup, rows: &[Rows]) -> Vec<u8> {
    let row = &rows[0];
    let mut body = setup.attribute_size.to_le_bytes().to_vec();
    body.extend((rows.len() as u32).to_le_bytes());
    body.extend(row.width.to_le_bytes());
    body.extend(row.x_scale_nm.to_le_bytes());
    body.extend(row.x_offset_um.to_le_bytes());
    body.push(0); // source: top
    body.extend(100_000_u32.to_le_bytes());
    body.resize(2 + usize::from(setup.attribute_size), 0);
    for row in rows {
        body.extend(&row.intensity);
    }
    message(7, true, &body)
}

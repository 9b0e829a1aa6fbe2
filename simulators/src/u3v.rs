//! A line profiler with USB3 Vision, played from the standard's register map and stream format: descriptors, bootstrap registers, a GenICam file (plain
//! or zipped), Coord3D lines with an encoder and a time chunk.
//!
//! Where the standard leaves a choice, this device chooses: blocks count from 0 at every start; lines come as fast as the host takes them unless a rate is
//! set or they are triggered; a device that was unplugged forgets all settings. With a memory of so many blocks it does not wait for its host: what finds
//! no room is lost, as in a real one.

mod registers;

use std::collections::VecDeque;
use std::f64::consts::TAU;
use std::time::Instant;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::sensor::View;
use crate::usb::{Model, Outcome};

use registers::Memory;

/// Pixel formats it has, by PFNC number.
pub const COORD3D_C16: u32 = 0x0110_00B8;
/// Three floats a pixel.
pub const COORD3D_ABC32F: u32 = 0x0260_00C0;

const CONTROL_IN: u8 = 0x81;
const CONTROL_OUT: u8 = 0x01;
const STREAM_IN: u8 = 0x82;

/// Column pitch and first column of C16, mm.
const PITCH_MM: f64 = 0.05;
/// A count of C16, and the middle of its range, mm.
const COUNT_MM: f64 = 0.002;

/// What it looks at.
#[derive(Debug, Clone)]
pub enum Surface {
    /// A scene.
    View(Box<View>),
    /// A sine across and along, of so many columns: cheap, for speed.
    Wave(u32),
}

/// What goes wrong. Shares are drawn for every block.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Misdeeds {
    /// Blocks that are taken and not sent.
    pub gap: f64,
    /// Blocks whose payload ends early, though the trailer says otherwise.
    pub short: f64,
    /// Blocks without their leader.
    pub no_leader: f64,
    /// Blocks without their trailer.
    pub no_trailer: f64,
    /// Blocks with the status "data discarded".
    pub discarded: f64,
    /// Packets of no bytes before a transfer.
    pub zero_packets: f64,
    /// The stream endpoint halts before this block.
    pub stall_at: Option<u64>,
    /// The stream endpoint halts again and again.
    pub stall_for_ever: bool,
    /// A pending acknowledgement of so many ms comes before every acknowledgement.
    pub pending_ms: Option<u16>,
    /// A late acknowledgement of another command comes before every one.
    pub stale_acks: bool,
    /// The first so many commands are not acknowledged.
    pub lose_acks: u32,
    /// Nothing is acknowledged.
    pub mute: bool,
    /// Rubbish comes instead of acknowledgements.
    pub babble: bool,
    /// The size field of leaders is 50.
    pub leader_50: bool,
    /// The GenICam file is said to be of so many bytes.
    pub lying_file: Option<u64>,
    /// The encoder reads up to so many counts beside the truth.
    pub encoder_jitter: u32,
    /// The device's clock runs fast by so many parts per million.
    pub drift_ppm: u32,
}

/// What the device is.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Serial number, in descriptor and register.
    pub serial: String,
    /// Of everything drawn.
    pub seed: u64,
    /// What it looks at.
    pub surface: Surface,
    /// Lines in a block.
    pub lines: u32,
    /// Bytes of the encoder's chunk: 4 or 8.
    pub encoder_bytes: usize,
    /// What the encoder adds to the scene's or the wave's counts.
    pub encoder_from: i64,
    /// Chunk ids and lengths are big-endian.
    pub big_chunks: bool,
    /// The GenICam file is zipped.
    pub zipped: bool,
    /// Blocks a second; without it as fast as they are taken.
    pub rate_hz: Option<f64>,
    /// Blocks are exposed at [`Profiler::trigger`], whatever the rate.
    pub triggered: bool,
    /// Room for so many blocks that the host has not taken; one that finds none is lost. Without a limit the device waits for the host. Only with a
    /// rate or triggers.
    pub room_blocks: Option<usize>,
    /// Blocks of a run: then the stage stands still.
    pub blocks: u64,
    /// What goes wrong.
    pub misdeeds: Misdeeds,
}

impl Setup {
    /// A device in good order.
    pub fn new(serial: &str, surface: Surface) -> Setup {
        Setup {
            serial: serial.to_owned(),
            seed: 1,
            surface,
            lines: 1,
            encoder_bytes: 8,
            encoder_from: 0,
            big_chunks: false,
            zipped: false,
            rate_hz: None,
            triggered: false,
            room_blocks: None,
            blocks: u64::MAX,
            misdeeds: Misdeeds::default(),
        }
    }
}

/// What it did in its last run.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Truth {
    /// Blocks that went out whole and sound, the first million.
    pub sent: Vec<u64>,
    /// Blocks that went out whole and sound.
    pub sent_count: u64,
    /// Blocks that it said it had discarded.
    pub discarded: u64,
    /// Blocks that were lost because the host had not taken those before them, the first million.
    pub overrun: Vec<u64>,
    /// The number of the next block.
    pub taken: u64,
    /// Commands that came.
    pub commands: u64,
    /// Starts of the acquisition.
    pub starts: u32,
}

/// The device.
pub struct Profiler {
    setup: Setup,
    memory: Memory,
    acks: VecDeque<Vec<u8>>,
    stream: VecDeque<Vec<u8>>,
    /// Transfers that are left of each block in `stream`.
    held: VecDeque<usize>,
    rng: ChaCha8Rng,
    acquiring: bool,
    began: Instant,
    next: u64,
    triggers: u64,
    waves: Vec<Vec<u8>>,
    truth: Truth,
}

impl Profiler {
    /// A device with this setup.
    pub fn new(setup: Setup) -> Profiler {
        Profiler {
            memory: Memory::new(&setup),
            rng: ChaCha8Rng::seed_from_u64(setup.seed),
            setup,
            acks: VecDeque::new(),
            stream: VecDeque::new(),
            held: VecDeque::new(),
            acquiring: false,
            began: Instant::now(),
            next: 0,
            triggers: 0,
            waves: Vec::new(),
            truth: Truth::default(),
        }
    }

    /// Light comes out.
    pub fn laser_on(&self) -> bool {
        self.acquiring
    }

    /// What it did.
    pub fn truth(&self) -> Truth {
        Truth {
            taken: self.next,
            ..self.truth.clone()
        }
    }

    /// One more block is exposed, whether the host has room or not.
    pub fn trigger(&mut self) {
        self.triggers += 1;
        self.expose();
    }

    /// Changes what goes wrong.
    pub fn misbehave(&mut self, misdeeds: Misdeeds) {
        self.setup.misdeeds = misdeeds;
    }

    fn start(&mut self) {
        self.acquiring = true;
        self.began = Instant::now();
        self.next = 0;
        self.triggers = 0;
        self.empty();
        self.rng = ChaCha8Rng::seed_from_u64(self.setup.seed);
        self.waves.clear();
        self.truth = Truth {
            commands: self.truth.commands,
            starts: self.truth.starts + 1,
            ..Truth::default()
        };
    }

    fn draw(&mut self, share: f64) -> bool {
        share > 0.0 && self.rng.random::<f64>() < share
    }

    // ---- Control ------------------------------------------------------------------------------------------------------

    fn command(&mut self, bytes: &[u8]) {
        self.truth.commands += 1;
        let misdeeds = self.setup.misdeeds.clone();
        if misdeeds.mute || bytes.len() < 12 || bytes[..4] != *b"U3VC" {
            return;
        }
        if misdeeds.babble {
            self.acks.push_back(vec![0x55; 40]);
            return;
        }
        if self.setup.misdeeds.lose_acks > 0 {
            self.setup.misdeeds.lose_acks -= 1;
            return;
        }
        let u16_at = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        let (command, id) = (u16_at(6), u16_at(10));
        if misdeeds.stale_acks {
            self.acks
                .push_back(acknowledge(0, 0x0801, id.wrapping_sub(1), &[0; 4]));
        }
        if let Some(ms) = misdeeds.pending_ms {
            let [low, high] = ms.to_le_bytes();
            self.acks
                .push_back(acknowledge(0, 0x0805, id, &[0, 0, low, high]));
        }
        let payload = &bytes[12..];
        let address = payload
            .get(..8)
            .and_then(|b| b.try_into().ok())
            .map_or(0, u64::from_le_bytes);
        let answer = match command {
            0x0800 if payload.len() == 12 => {
                let count = usize::from(u16::from_le_bytes([payload[10], payload[11]]));
                match self.memory.read(address, count) {
                    Some(data) => acknowledge(0, 0x0801, id, &data),
                    None => acknowledge(0x8003, 0x0801, id, &[]),
                }
            }
            0x0802 if payload.len() > 8 => {
                let data = &payload[8..];
                let written = (data.len() as u16).to_le_bytes();
                match self.memory.write(address, data) {
                    true => acknowledge(0, 0x0803, id, &[0, 0, written[0], written[1]]),
                    false => acknowledge(0x8004, 0x0803, id, &[]),
                }
            }
            _ => acknowledge(0x8001, command + 1, id, &[]),
        };
        self.acks.push_back(answer);
        if self.memory.take_start() {
            self.start();
        }
        if self.memory.take_stop() {
            self.acquiring = false;
        }
        if !self.memory.streaming() {
            self.empty();
        }
    }

    // ---- Stream -------------------------------------------------------------------------------------------------------

    fn empty(&mut self) {
        self.stream.clear();
        self.held.clear();
    }

    /// Whether the next block is to be exposed by now.
    fn is_due(&self) -> bool {
        let due = match (self.setup.triggered, self.setup.rate_hz) {
            (true, _) => self.next < self.triggers,
            (false, Some(hz)) => self.began.elapsed().as_secs_f64() >= self.next as f64 / hz,
            (false, None) => true,
        };
        due && self.acquiring && self.memory.streaming() && self.next < self.setup.blocks
    }

    /// Exposes what is due. Nothing leaves the device but by [`Model::input`], so that doing it then, for all the time before, is as good as at its time.
    fn expose(&mut self) {
        let Some(room) = self.setup.room_blocks else {
            // It waits for the host. A gap queues nothing, so that a few blocks may have to be taken.
            for _ in 0..64 {
                if !self.stream.is_empty() || !self.is_due() {
                    break;
                }
                self.shoot();
            }
            return;
        };
        while self.is_due() {
            if self.held.len() < room {
                self.shoot();
                continue;
            }
            if self.truth.overrun.len() < 1_000_000 {
                self.truth.overrun.push(self.next);
            }
            self.next += 1;
        }
    }

    /// The next transfer, at most so many bytes of it.
    fn hand_out(&mut self, most: usize) -> Option<Vec<u8>> {
        let mut bytes = self.stream.pop_front()?;
        if bytes.len() > most {
            self.stream.push_front(bytes.split_off(most));
        } else if let Some(left) = self.held.front_mut() {
            *left -= 1;
            if *left == 0 {
                self.held.pop_front();
            }
        }
        Some(bytes)
    }

    /// Queues the transfers of the next block.
    fn shoot(&mut self) {
        let before = self.stream.len();
        self.queue_block();
        let queued = self.stream.len() - before;
        if queued > 0 {
            self.held.push_back(queued);
        }
    }

    fn queue_block(&mut self) {
        let id = self.next;
        self.next += 1;
        let misdeeds = self.setup.misdeeds.clone();
        let gap = self.draw(misdeeds.gap);
        let short = self.draw(misdeeds.short);
        let no_leader = self.draw(misdeeds.no_leader);
        let no_trailer = self.draw(misdeeds.no_trailer);
        let discarded = self.draw(misdeeds.discarded);
        let zero = self.draw(misdeeds.zero_packets);
        if gap {
            return;
        }
        let since_ns = id * 200_000;
        let fast = since_ns / 1_000_000 * u64::from(misdeeds.drift_ppm);
        let time_ns = 1_000_000_000 + since_ns + fast;
        let payload = self.payload(id, time_ns);
        if zero {
            self.stream.push_back(Vec::new());
        }
        if !no_leader {
            self.stream.push_back(self.leader(id, time_ns));
        }
        let valid = payload.len();
        let cut = if short { valid / 2 } else { valid };
        self.stream.extend(self.memory.transfers(&payload[..cut]));
        if zero {
            self.stream.push_back(Vec::new());
        }
        if !no_trailer {
            let status = if discarded { 0xA100 } else { 0 };
            self.stream
                .push_back(self.trailer(id, status, valid as u64));
        }
        if discarded && !(short || no_leader || no_trailer) {
            self.truth.discarded += 1;
        } else if !(discarded || short || no_leader || no_trailer) {
            self.truth.sent_count += 1;
            if self.truth.sent.len() < 1_000_000 {
                self.truth.sent.push(id);
            }
        }
    }

    fn leader(&self, id: u64, time_ns: u64) -> Vec<u8> {
        let size = if self.setup.misdeeds.leader_50 {
            50_u16
        } else {
            52
        };
        let mut bytes = b"U3VL\0\0".to_vec();
        bytes.extend(size.to_le_bytes());
        bytes.extend(id.to_le_bytes());
        bytes.extend([0, 0, 0x01, 0x40]);
        bytes.extend(time_ns.to_le_bytes());
        bytes.extend(self.memory.pixel_format().to_le_bytes());
        bytes.extend(self.columns().to_le_bytes());
        bytes.extend(self.setup.lines.to_le_bytes());
        bytes.resize(52, 0);
        bytes
    }

    fn trailer(&self, id: u64, status: u16, valid: u64) -> Vec<u8> {
        let mut bytes = b"U3VT\0\0\x24\0".to_vec();
        bytes.extend(id.to_le_bytes());
        bytes.extend(status.to_le_bytes());
        bytes.extend([0, 0]);
        bytes.extend(valid.to_le_bytes());
        bytes.extend(self.setup.lines.to_le_bytes());
        bytes.extend(1_u32.to_le_bytes());
        bytes
    }

    fn columns(&self) -> u32 {
        columns(&self.setup)
    }

    fn payload(&mut self, id: u64, time_ns: u64) -> Vec<u8> {
        let lines = u64::from(self.setup.lines);
        let mut bytes = Vec::new();
        let mut encoder = 0;
        for line in id * lines..(id + 1) * lines {
            let counts = self.line(line, &mut bytes);
            if line == id * lines {
                encoder = counts;
            }
        }
        let image = bytes.len() as u32;
        self.chunk_tail(&mut bytes, 1, image);
        let shaken = encoder
            + self.setup.encoder_from
            + crate::gocator::shake(self.setup.misdeeds.encoder_jitter, id);
        let counts = shaken.to_le_bytes();
        let kept = self.setup.encoder_bytes;
        bytes.extend(&counts[..kept]);
        self.chunk_tail(&mut bytes, 0xE0, kept as u32);
        bytes.extend((time_ns + 7).to_le_bytes());
        self.chunk_tail(&mut bytes, 0xE1, 8);
        bytes
    }

    fn chunk_tail(&self, bytes: &mut Vec<u8>, id: u32, length: u32) {
        for number in [id, length] {
            match self.setup.big_chunks {
                true => bytes.extend(number.to_be_bytes()),
                false => bytes.extend(number.to_le_bytes()),
            }
        }
    }

    /// Appends one line; the answer is its encoder.
    fn line(&mut self, index: u64, bytes: &mut Vec<u8>) -> i64 {
        const PHASES: u64 = 16;
        let format = self.memory.pixel_format();
        match &self.setup.surface {
            Surface::View(view) => {
                let line = view.line(index as u32);
                let points = line.x_mm.iter().zip(&line.z_mm);
                if format == COORD3D_ABC32F {
                    for (x, z) in points {
                        bytes.extend((*x as f32).to_le_bytes());
                        bytes.extend(0_f32.to_le_bytes());
                        bytes.extend((*z as f32).to_le_bytes());
                    }
                } else {
                    let origin = -0.5 * PITCH_MM * f64::from(self.columns());
                    let z = crate::gocator::resample(&line, origin, PITCH_MM);
                    bytes.extend(z.into_iter().flat_map(|z| c16(z, view).to_le_bytes()));
                }
                line.encoder
            }
            Surface::Wave(columns) => {
                let columns = *columns;
                while self.waves.len() < PHASES as usize {
                    let phase = self.waves.len() as f64 / PHASES as f64;
                    self.waves.push(wave(columns, phase, format));
                }
                bytes.extend(&self.waves[(index % PHASES) as usize]);
                10 * index as i64
            }
        }
    }
}

fn columns(setup: &Setup) -> u32 {
    match &setup.surface {
        Surface::View(view) => view.columns,
        Surface::Wave(columns) => *columns,
    }
}

/// Middle of the range of C16, mm.
fn middle_mm(setup: &Setup) -> f64 {
    match &setup.surface {
        Surface::View(view) => 0.5 * (view.optics.near_mm + view.optics.far_mm),
        Surface::Wave(_) => 0.0,
    }
}

fn c16(z_mm: f64, view: &View) -> u16 {
    let middle = 0.5 * (view.optics.near_mm + view.optics.far_mm);
    count(z_mm - middle)
}

/// 0 is "nothing seen".
fn count(from_middle_mm: f64) -> u16 {
    match from_middle_mm.is_nan() {
        true => 0,
        false => (32_768.0 + from_middle_mm / COUNT_MM)
            .round()
            .clamp(1.0, 65_535.0) as u16,
    }
}

fn wave(columns: u32, phase: f64, format: u32) -> Vec<u8> {
    let z = |i: u32| 5.0 * (TAU * (f64::from(i) / 500.0 + phase)).sin();
    let pixels = 0..columns;
    match format {
        COORD3D_ABC32F => pixels
            .flat_map(|i| [f64::from(i) * PITCH_MM, 0.0, z(i)])
            .flat_map(|c| (c as f32).to_le_bytes())
            .collect(),
        _ => pixels.flat_map(|i| count(z(i)).to_le_bytes()).collect(),
    }
}

fn acknowledge(status: u16, command: u16, id: u16, payload: &[u8]) -> Vec<u8> {
    let mut bytes = b"U3VC".to_vec();
    for field in [status, command, payload.len() as u16, id] {
        bytes.extend(field.to_le_bytes());
    }
    bytes.extend(payload);
    bytes
}

impl Model for Profiler {
    fn device_descriptor(&self) -> Vec<u8> {
        vec![
            18, 1, 0, 3, 0xEF, 2, 1, 9, 0x09, 0x12, 0x03, 0x00, 0, 1, 1, 2, 3, 1,
        ]
    }

    fn configuration_descriptor(&self) -> Vec<u8> {
        let mut bytes = vec![9, 2, 0, 0, 2, 1, 0, 0x80, 50];
        bytes.extend([8, 11, 0, 2, 0xEF, 5, 0, 0]); // interface association
        bytes.extend([9, 4, 0, 0, 2, 0xEF, 5, 0, 0]); // control
        bytes.extend([
            20, 0x24, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 2, 0, 0, 0, 3, 0, 8,
        ]);
        bytes.extend([7, 5, CONTROL_IN, 2, 0, 4, 0]);
        bytes.extend([6, 0x30, 0, 0, 0, 0]);
        bytes.extend([7, 5, CONTROL_OUT, 2, 0, 4, 0]);
        bytes.extend([6, 0x30, 0, 0, 0, 0]);
        bytes.extend([9, 4, 1, 0, 1, 0xEF, 5, 2, 0]); // stream
        bytes.extend([7, 5, STREAM_IN, 2, 0, 4, 0]);
        bytes.extend([6, 0x30, 15, 0, 0, 0]);
        bytes[2] = bytes.len() as u8;
        bytes
    }

    fn strings(&self) -> Vec<String> {
        [
            "Simulated Metrology",
            "U3V line profiler",
            &self.setup.serial,
        ]
        .map(str::to_owned)
        .to_vec()
    }

    fn control(&mut self, setup: [u8; 8], _: &[u8]) -> Outcome {
        match (setup[0], setup[1]) {
            // SET_CONFIGURATION, SET_INTERFACE, CLEAR_FEATURE
            (0x00, 9) | (0x01, 11) | (0x02, 1) => Outcome::Accepted(0),
            _ => Outcome::Stall,
        }
    }

    fn output(&mut self, endpoint: u8, data: &[u8]) -> Outcome {
        if endpoint != CONTROL_OUT {
            return Outcome::Stall;
        }
        self.command(data);
        Outcome::Accepted(data.len())
    }

    fn input(&mut self, endpoint: u8, most: usize) -> Outcome {
        match endpoint {
            CONTROL_IN => self.acks.pop_front().map_or(Outcome::Nak, Outcome::Data),
            STREAM_IN => {
                let between = self.stream.is_empty();
                let stalls = &mut self.setup.misdeeds;
                let now = stalls.stall_for_ever || between && stalls.stall_at == Some(self.next);
                if self.acquiring && now {
                    stalls.stall_at = None;
                    return Outcome::Stall;
                }
                self.expose();
                self.hand_out(most).map_or(Outcome::Nak, Outcome::Data)
            }
            _ => Outcome::Stall,
        }
    }

    fn powered(&mut self) {
        self.acquiring = false;
        self.empty();
        self.acks.clear();
        self.memory = Memory::new(&self.setup);
    }
}

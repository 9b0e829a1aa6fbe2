//! A robot's RTDE interface, played from the guide (protocol version 2): one client, one list of outputs, the tool on a shared motion.
//!
//! Where the guide leaves a choice, this controller chooses: its clock stands at 1000 s when it is made; outputs are due at whole cycles
//! from the start on; a version other than 2, and a list with a name that it does not know, are answered and not taken.

use std::io;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::carried::Motion;
use crate::faults::{BadLine, Faults};
use crate::pose::Pose;
use crate::wire::{Desk, Model, Next, Outbox, Runner, Wire, lock};

/// What the controller says it is, and how it plays.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Major, minor, bugfix, build.
    pub version: [u32; 4],
    /// Seed of faults.
    pub seed: u64,
    /// Where the tool is.
    pub motion: Arc<Motion>,
    /// Sets the motion off so long after the outputs start; without it somebody else does.
    pub go_after: Option<Duration>,
    /// `lose-frame` and `drop` skip packages, as a busy controller does; `duplicate`, `truncate` (another length, framed well), `lie` (a
    /// size that is not), `sentinel` (NaN), `lose`, `flip`, `chatter` (text messages), `late-ms`, `drift-ppm`, `swap-bytes`, `refuse`,
    /// `silent-after`, `reboot-after` (the clock begins anew), `unplug-after`, `autostart`.
    pub faults: Faults,
}

impl Setup {
    /// A faultless e-Series that sets off 300 ms after the outputs start.
    pub fn new(motion: Arc<Motion>, seed: u64) -> Setup {
        Setup {
            version: [5, 12, 2, 1_101_373],
            seed,
            motion,
            go_after: Some(Duration::from_millis(300)),
            faults: Faults::default(),
        }
    }
}

/// What became of one cycle's output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// Went out whole.
    Sent,
    /// Went out with wrong or missing bytes.
    Damaged,
    /// The controller was busy.
    Skipped,
}

/// Everything that it did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Truth {
    /// Every cycle of the last run, in order (the first million): its time stamp and fate.
    pub cycles: Vec<(f64, Fate)>,
    /// Outputs are sent.
    pub running: bool,
    /// Requests answered.
    pub answered: u32,
}

/// A running controller; dropping it closes its port.
#[derive(Debug)]
pub struct SimulatedRobot {
    runner: Runner,
    truth: Arc<Mutex<Truth>>,
}

impl SimulatedRobot {
    /// Starts a controller at the end of `wire`.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(wire: Wire, setup: Setup) -> io::Result<SimulatedRobot> {
        let truth = Arc::new(Mutex::new(Truth::default()));
        let (faults, seed, seen) = (setup.faults.clone(), setup.seed, truth.clone());
        let runner = Runner::start(wire, &faults, seed, |_| {
            Controller::new(setup, seen, Instant::now())
        })?;
        Ok(SimulatedRobot { runner, truth })
    }

    /// Where a host finds it.
    pub fn port(&self) -> &str {
        self.runner.name()
    }

    /// Everything it did.
    pub fn truth(&self) -> Truth {
        lock(&self.truth).clone()
    }

    /// Pulls the cable out.
    pub fn unplug(&self) {
        self.runner.plug(false);
    }

    /// Puts it back in.
    pub fn replug(&self) {
        self.runner.plug(true);
    }
}

/// The same controller without a wire, in a time of its own, and what it did.
pub fn desk(setup: Setup) -> (Desk, Arc<Mutex<Truth>>) {
    let truth = Arc::new(Mutex::new(Truth::default()));
    let seen = truth.clone();
    let faults = setup.faults.clone();
    let desk = Desk::new(&faults, |now| Controller::new(setup, seen, now));
    (desk, truth)
}

/// Cycles kept in the log.
const LOGGED: usize = 1_000_000;
/// The clock when the controller is made, s.
const CLOCK_S: f64 = 1000.0;

struct Controller {
    setup: Setup,
    truth: Arc<Mutex<Truth>>,
    line: BadLine,
    chance: ChaCha8Rng,
    held: Vec<u8>,
    made: Instant,
    /// Rate and number of the list of outputs.
    outputs: Option<f64>,
    run: Option<Run>,
    requests: u32,
    life: u32,
    silent: bool,
    unplug: bool,
    late: Vec<(Instant, Vec<u8>)>,
}

#[derive(Clone, Copy)]
struct Run {
    began: Instant,
    cycle: Duration,
    next: u32,
}

impl Controller {
    fn new(setup: Setup, truth: Arc<Mutex<Truth>>, now: Instant) -> Controller {
        let mut chance = ChaCha8Rng::seed_from_u64(setup.seed);
        chance.set_stream(7);
        Controller {
            line: BadLine::new(&setup.faults, setup.seed),
            chance,
            held: Vec::new(),
            made: now,
            outputs: None,
            run: None,
            requests: 0,
            life: 0,
            silent: setup.faults.silent_after == Some(0),
            unplug: false,
            late: Vec::new(),
            setup,
            truth,
        }
    }

    fn clock_s(&self, at: Instant) -> f64 {
        let since = at.saturating_duration_since(self.made).as_secs_f64();
        CLOCK_S + since * (1.0 + 1e-6 * self.setup.faults.drift_ppm)
    }

    fn happens(&mut self, share: f64) -> bool {
        share > 0.0 && self.chance.random_bool(share)
    }

    /// Replies are never damaged: TCP damages nothing, and what a broken controller sends is played by its data.
    fn reply(&mut self, kind: u8, payload: &[u8], now: Instant, out: &mut Outbox) {
        if self.silent {
            return;
        }
        let bytes = package(kind, payload);
        match self.setup.faults.late {
            Some(late) => self.late.push((now + late, bytes)),
            None => out.push(&bytes),
        }
    }

    fn request(&mut self, kind: u8, payload: &[u8], now: Instant, out: &mut Outbox) {
        self.requests += 1;
        let refused = self.setup.faults.refuse == Some(self.requests);
        lock(&self.truth).answered += 1;
        match kind {
            b'V' => {
                let known = payload == [0, 2] && !refused;
                self.reply(b'V', &[known.into()], now, out);
            }
            b'v' => {
                let numbers = self.setup.version.map(u32::to_be_bytes);
                self.reply(b'v', &numbers.concat(), now, out);
            }
            b'O' => self.set_outputs(payload, refused, now, out),
            b'S' => {
                let ready = self.outputs.filter(|_| !refused);
                self.reply(b'S', &[ready.is_some().into()], now, out);
                if let Some(rate_hz) = ready {
                    self.start(rate_hz, now);
                }
            }
            b'P' => {
                self.pause();
                self.reply(b'P', &[1], now, out);
            }
            _ => {}
        }
    }

    fn set_outputs(&mut self, payload: &[u8], refused: bool, now: Instant, out: &mut Outbox) {
        let Some((rate, names)) = payload.split_first_chunk::<8>() else {
            return;
        };
        let types: Vec<&str> = String::from_utf8_lossy(names)
            .split(',')
            .map(|name| match name {
                "timestamp" => "DOUBLE",
                "actual_TCP_pose" if !refused => "VECTOR6D",
                _ => "NOT_FOUND",
            })
            .collect();
        let known = types == ["DOUBLE", "VECTOR6D"];
        let mut reply = vec![u8::from(known)];
        reply.extend(types.join(",").bytes());
        self.reply(b'O', &reply, now, out);
        let most = if self.setup.version[0] <= 3 {
            125.0
        } else {
            500.0
        };
        self.outputs = known.then(|| f64::from_be_bytes(*rate).clamp(1.0, most));
    }

    fn start(&mut self, rate_hz: f64, now: Instant) {
        self.run = Some(Run {
            began: now,
            cycle: Duration::from_secs_f64(1.0 / rate_hz),
            next: 0,
        });
        if let Some(after) = self.setup.go_after {
            self.setup.motion.go(now + after);
        }
        let mut truth = lock(&self.truth);
        truth.running = true;
        truth.cycles.clear();
    }

    fn pause(&mut self) {
        self.run = None;
        lock(&self.truth).running = false;
    }

    /// One cycle's output, or what the faults make of it.
    fn put_out(&mut self, due: Instant, out: &mut Outbox) {
        let faults = self.setup.faults.clone();
        let stamp = self.clock_s(due);
        let [skip, twice, cut, lie, nan, chatter] = [
            faults.drop.max(faults.lose_frame),
            faults.duplicate,
            faults.truncate,
            faults.lie,
            faults.sentinel,
            faults.chatter,
        ]
        .map(|share| self.happens(share));
        if chatter && !self.silent {
            out.push(&package(b'M', b"\x16Safety planes modified\x04RTDE\x02"));
        }
        let mut fate = Fate::Skipped;
        if !skip && !self.silent {
            let pose = self.setup.motion.at(due);
            let mut payload = data(stamp, &pose, faults.swap_bytes);
            if nan {
                payload[9..17].copy_from_slice(&f64::NAN.to_be_bytes());
            }
            if cut {
                payload.truncate(30);
            }
            let mut frame = package(b'U', &payload);
            if lie {
                frame[1] = frame[1].wrapping_add(13);
            }
            let mut bytes = Vec::new();
            let damaged = self.line.carry(&frame, &mut bytes) || cut || lie || nan;
            out.push(&bytes);
            if twice {
                out.push(&bytes);
            }
            fate = if damaged { Fate::Damaged } else { Fate::Sent };
        }
        let mut truth = lock(&self.truth);
        if truth.cycles.len() < LOGGED {
            truth.cycles.push((stamp, fate));
        }
        drop(truth);
        self.life = self.life.saturating_add(1);
        let at = |n: Option<u32>| n == Some(self.life);
        self.silent |= at(faults.silent_after);
        self.unplug |= at(faults.unplug_after);
        if at(faults.reboot_after) {
            self.made = due;
        }
    }
}

impl Model for Controller {
    fn attached(&mut self, _: &mut Outbox) {
        if self.setup.faults.autostart && self.run.is_none() {
            // Another client's outputs are still sent to whoever comes.
            self.start(125.0, Instant::now());
        }
    }

    fn detached(&mut self, unplugged: bool, _: &[u32]) {
        self.pause();
        self.outputs = None;
        self.held.clear();
        self.late.clear();
        self.unplug = false;
        if unplugged && self.setup.faults.other_identity {
            self.setup.version = [3, 15, 8, 106_339];
        }
    }

    fn take(&mut self, bytes: &[u8], now: Instant, out: &mut Outbox) {
        self.held.extend(bytes);
        while let [high, low, kind, ..] = self.held[..] {
            let size = usize::from(u16::from_be_bytes([high, low])).max(3);
            if self.held.len() < size {
                break;
            }
            let request: Vec<u8> = self.held.drain(..size).collect();
            if !self.silent {
                self.request(kind, &request[3..], now, out);
            }
        }
    }

    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next {
        if self.unplug {
            return Next::Unplug;
        }
        while let Some((due, _)) = self.late.first().filter(|(due, _)| *due <= now) {
            let _ = due;
            let (_, bytes) = self.late.remove(0);
            out.push(&bytes);
        }
        while let Some(run) = &mut self.run {
            let due = run.began + run.cycle * run.next;
            if due > now {
                break;
            }
            run.next += 1;
            self.put_out(due, out);
            if self.unplug {
                return Next::Unplug;
            }
        }
        let output = self.run.map(|run| run.began + run.cycle * run.next);
        let late = self.late.first().map(|(due, _)| *due);
        match output.into_iter().chain(late).min() {
            Some(due) => Next::At(due),
            None => Next::Wait,
        }
    }
}

/// Size of the whole, type, payload.
fn package(kind: u8, payload: &[u8]) -> Vec<u8> {
    let mut bytes = ((3 + payload.len()) as u16).to_be_bytes().to_vec();
    bytes.push(kind);
    bytes.extend(payload);
    bytes
}

/// Number of the list, time stamp, x y z in m, axis times angle.
fn data(stamp: f64, pose: &Pose, swapped: bool) -> Vec<u8> {
    let [x, y, z] = (pose.translation * 1e-3).to_array();
    let turn = DQuat::from_mat3(&pose.rotation);
    // The shorter way round.
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let axis: DVec3 = turn.to_scaled_axis();
    let mut bytes = vec![1];
    for number in [stamp, x, y, z, axis.x, axis.y, axis.z] {
        let mut of_number = number.to_be_bytes();
        if swapped {
            of_number.reverse();
        }
        bytes.extend(of_number);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes of the guide's example of a session, and what comes back.
    #[test]
    fn a_session_as_in_the_guide() {
        let motion = Arc::new(Motion::straight(
            Pose::shift(DVec3::new(100.0, -200.0, 300.0)),
            DVec3::X * 50.0,
            100.0,
        ));
        let (mut desk, truth) = desk(Setup::new(motion, 1));
        desk.write(&[0, 5, 86, 0, 2]);
        assert_eq!(desk.read(Duration::ZERO), Some(vec![0, 4, 86, 1]));
        desk.write(&[0, 5, 86, 0, 9]);
        assert_eq!(desk.read(Duration::ZERO), Some(vec![0, 4, 86, 0]));
        let mut setup = vec![0, 36, b'O'];
        setup.extend(100.0_f64.to_be_bytes());
        setup.extend(b"timestamp,actual_TCP_pose");
        desk.write(&setup);
        let types = desk.read(Duration::ZERO).expect("an answer");
        assert_eq!(&types[..], b"\x00\x13O\x01DOUBLE,VECTOR6D");
        desk.write(&[0, 3, b'S']);
        let first = desk.read(Duration::ZERO).expect("the start and a pose");
        assert_eq!(first[..4], [0, 4, b'S', 1]);
        let pose = &first[4..];
        assert_eq!(pose[..4], [0, 60, b'U', 1]);
        let number = |i: usize| f64::from_be_bytes(std::array::from_fn(|k| pose[4 + 8 * i + k]));
        assert_eq!([number(1), number(2), number(3)], [0.1, -0.2, 0.3]);
        let mut seen = 1;
        while let Some(bytes) = desk.read(Duration::from_secs(1)) {
            seen += bytes.len() / 60;
        }
        assert_eq!(seen, 101, "a pose every 10 ms of one second, both ends");
        assert_eq!(lock(&truth).cycles.len(), 101);
        desk.write(&[0, 3, b'P']);
        assert_eq!(desk.read(Duration::from_secs(2)), Some(vec![0, 4, b'P', 1]));
        assert_eq!(desk.read(Duration::from_secs(2)), None);
    }
}

//! The device: settings, runs, keep-alive, faults.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::feed::{Fed, Feed, Traversed};
use super::frame::{Frame, Receiver, VERSION, encode, encode_with_length, u32_at};
use super::message as msg;
use super::message::{Identity, ProfileHead, Reason, Scale, Status};
use super::{Fate, Record, Setup, Shared, Truth};
use crate::faults::BadLine;
use crate::sensor::{Line, View};
use crate::wire::{Model, Next, Outbox, Waker};

/// Bytes that may wait in the device.
const QUEUE: usize = 64 * 1024;
/// Records kept in the side log.
const LOGGED: usize = 1_000_000;
/// Time from power to readiness, ns.
const WARM_UP_NS: u64 = 1_500_000;

const RATE_MAX_MHZ: i64 = 2_000_000;
const TRIGGER_TIME: i64 = 0;
const TRIGGER_ENCODER: i64 = 1;

/// Settings of section 5, in the order of their keys.
#[derive(Debug, Clone, Copy)]
struct Settings {
    rate_mhz: i64,
    exposure_ns: i64,
    trigger: i64,
    encoder_step: i64,
    columns: i64,
    laser_power: i64,
}

/// A run under way.
#[derive(Debug)]
struct Run {
    feed: Feed,
    /// Exposures to take; `None`: until STOP.
    count: Option<u32>,
    keepalive: Duration,
    period: Duration,
    /// Device time of exposure 0, ns.
    began_ns: u64,
    /// Real time of exposure 0.
    began: Instant,
    exposures: u32,
    /// The next line was not computed in time.
    late: bool,
}

/// The last run, under way or over.
#[derive(Debug, Clone, Copy)]
struct Tally {
    run: u32,
    sent: u32,
    dropped: u32,
    reason: Reason,
}

#[derive(Debug)]
pub(super) struct Device {
    view: View,
    /// The traverse of the last run.
    traversed: Option<Arc<Traversed>>,
    setup: Setup,
    shared: Arc<Shared>,
    waker: Waker,
    receiver: Receiver,
    line: BadLine,
    /// Draws for whole profiles; boot numbers have a stream of their own.
    chance: ChaCha8Rng,
    boots: ChaCha8Rng,
    boot: u32,
    settings: Settings,
    run: Option<Run>,
    last: Option<Tally>,
    laser_on: bool,
    heard: Instant,
    /// Of the last exposure, or of the start.
    clock_ns: u64,
    powered: Instant,
    /// Profiles over the life of the device.
    life: u32,
    silent: bool,
    unplug: bool,
}

impl Device {
    pub fn new(view: View, setup: Setup, shared: Arc<Shared>, waker: Waker) -> Device {
        let stream = |n: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(setup.seed);
            rng.set_stream(u64::MAX - n);
            rng
        };
        let mut device = Device {
            receiver: Receiver::default(),
            line: BadLine::new(&setup.faults, setup.seed),
            chance: stream(2),
            boots: stream(3),
            boot: 0,
            settings: Settings {
                rate_mhz: 500_000,
                exposure_ns: 200_000,
                trigger: TRIGGER_ENCODER,
                encoder_step: view.traverse.step_counts,
                columns: i64::from(view.columns),
                laser_power: 1000,
            },
            run: None,
            last: None,
            laser_on: false,
            heard: Instant::now(),
            clock_ns: 0,
            powered: Instant::now(),
            life: 0,
            silent: setup.faults.silent_after == Some(0),
            unplug: false,
            traversed: None,
            view,
            setup,
            shared,
            waker,
        };
        device.power_on();
        device
    }

    /// A new start: nothing of the last one is left but the wear of the device.
    fn power_on(&mut self) {
        let before = self.boot;
        while self.boot == before {
            self.boot = self.boots.next_u32();
        }
        self.settings = Settings {
            rate_mhz: 500_000,
            exposure_ns: 200_000,
            trigger: TRIGGER_ENCODER,
            encoder_step: self.view.traverse.step_counts,
            columns: i64::from(self.view.columns),
            laser_power: 1000,
        };
        self.run = None;
        self.last = None;
        self.laser_on = false;
        self.receiver = Receiver::default();
        self.clock_ns = WARM_UP_NS;
        self.powered = Instant::now();
        let boot = self.boot;
        // Last, so that whoever sees another start sees it off.
        self.publish();
        self.shared.update(|status, _| {
            status.boot = boot;
            status.boots += 1;
        });
    }

    fn publish(&self) {
        let (laser_on, streaming) = (self.laser_on, self.run.is_some());
        let (last, bytes) = (self.last, self.line.count);
        self.shared.update(|status, truth| {
            status.laser_on = laser_on;
            status.streaming = streaming;
            status.run = last.map(|l| l.run);
            status.sent = last.map_or(0, |l| l.sent);
            status.dropped = last.map_or(0, |l| l.dropped);
            truth.bytes = bytes;
        });
    }

    fn identity(&self) -> Identity {
        let optics = &self.view.optics;
        let um = |mm: f64| (mm * 1000.0).round() as i32;
        Identity {
            boot: self.boot,
            columns_max: self.view.columns,
            rate_max_mhz: RATE_MAX_MHZ as u32,
            capabilities: msg::ENCODER | msg::INTENSITY | msg::EXPLICIT_X | msg::LASER_SWITCH,
            near_um: um(optics.near_mm),
            far_um: um(optics.far_mm),
            width_um: um(optics.width_mm) as u32,
            texts: ["Acies", "simulated", &self.setup.serial, "1.0.0"].map(str::to_owned),
        }
    }

    /// Device time, ns since the start.
    fn now_ns(&self) -> u64 {
        if self.setup.paced {
            self.clock_ns
                .max(WARM_UP_NS + self.powered.elapsed().as_nanos() as u64)
        } else {
            self.clock_ns
        }
    }

    fn send(&mut self, frame: &[u8], out: &mut Outbox) -> bool {
        let mut bytes = Vec::with_capacity(frame.len());
        let damaged = self.line.carry(frame, &mut bytes);
        out.push(&bytes);
        damaged
    }

    fn reply(&mut self, kind: u8, id: u32, payload: &[u8], out: &mut Outbox) {
        self.send(&encode(kind, id, payload), out);
        self.shared.update(|status, _| status.answered += 1);
    }

    fn command(&mut self, frame: &Frame, now: Instant, out: &mut Outbox) {
        self.heard = now;
        if self.silent {
            return;
        }
        let (name, least) = match frame.kind {
            msg::HELLO => ("HELLO", 0),
            msg::SET => ("SET", 10),
            msg::GET => ("GET", 2),
            msg::START => ("START", 12),
            msg::STOP => ("STOP", 0),
            msg::KEEPALIVE => ("KEEPALIVE", 8),
            _ => ("", 0),
        };
        let p = &frame.payload;
        let refusal = if frame.version != VERSION {
            let text = format!("version {}, this device speaks {VERSION}", frame.version);
            Some((Status::UnknownCommand, text))
        } else if name.is_empty() {
            Some((
                Status::UnknownCommand,
                format!("type 0x{:02x}?", frame.kind),
            ))
        } else if p.len() < least {
            let text = format!("{name} has {} bytes, needs {least}", p.len());
            Some((Status::TooShort, text))
        } else {
            None
        };
        if let Some((status, text)) = refusal {
            return self.reply(msg::REFUSED, frame.id, &msg::refused(status, &text), out);
        }
        let (kind, payload) = match frame.kind {
            msg::HELLO => (msg::IDENTITY, self.identity().payload()),
            msg::SET => {
                let value = i64::from_le_bytes(std::array::from_fn(|i| p[2 + i]));
                (msg::VALUE, self.set(u16_at(p), value))
            }
            msg::GET => (msg::VALUE, self.value(Status::Done, u16_at(p))),
            msg::START => {
                let [run, count, keepalive_ms] = [0, 4, 8].map(|at| u32_at(p, at));
                let status = self.start(run, count, keepalive_ms, now);
                (msg::STARTED, msg::started(status, run, self.boot))
            }
            msg::STOP => (msg::STOPPED, self.stop(Reason::Asked)),
            _ => {
                let host_ns = u64::from_le_bytes(std::array::from_fn(|i| p[i]));
                let alive = msg::alive(host_ns, self.now_ns(), self.boot, self.laser_on);
                (msg::ALIVE, alive)
            }
        };
        self.reply(kind, frame.id, &payload, out);
    }

    /// Value and limits of a setting.
    fn setting(&self, key: u16) -> Option<[i64; 3]> {
        let s = &self.settings;
        Some(match key {
            1 => [s.rate_mhz, 1000, RATE_MAX_MHZ],
            2 => [s.exposure_ns, 1000, 1_000_000],
            3 => [s.trigger, TRIGGER_TIME, TRIGGER_ENCODER],
            4 => [s.encoder_step, 1, 1_000_000],
            5 => [s.columns, 1, i64::from(self.view.columns)],
            6 => [s.laser_power, 0, 1000],
            7 => [36_500, 36_500, 36_500],
            _ => return None,
        })
    }

    fn value(&self, status: Status, key: u16) -> Vec<u8> {
        match self.setting(key) {
            Some(numbers) => msg::value(status, key, numbers),
            None => msg::value(Status::UnknownKey, key, [0; 3]),
        }
    }

    fn set(&mut self, key: u16, value: i64) -> Vec<u8> {
        let status = match self.setting(key) {
            None => Status::UnknownKey,
            Some(_) if key == 7 => Status::ReadOnly,
            Some(_) if self.run.is_some() => Status::NotWhileStreaming,
            Some([_, least, most]) if !(least..=most).contains(&value) => Status::OutOfRange,
            Some(_) => {
                let s = &mut self.settings;
                match key {
                    1 => s.rate_mhz = value,
                    // whole microseconds are what it can do
                    2 => s.exposure_ns = (value + 500) / 1000 * 1000,
                    3 => s.trigger = value,
                    4 => s.encoder_step = value,
                    5 => s.columns = value,
                    _ => s.laser_power = value,
                }
                Status::Done
            }
        };
        self.value(status, key)
    }

    fn start(&mut self, run: u32, count: u32, keepalive_ms: u32, now: Instant) -> Status {
        if self.last.is_some_and(|last| last.run == run) {
            return Status::Done;
        }
        if !(100..=10_000).contains(&keepalive_ms) {
            return Status::OutOfRange;
        }
        // a run that is still under way is abandoned: its feed must end before the next begins
        self.run = None;
        let began_ns = self.now_ns() + 1_000_000;
        let view = self.view_of_run();
        let traversed = match self.traversed.take() {
            Some(traversed) if traversed.is_of(&view) => traversed,
            _ => Arc::new(Traversed::new(view)),
        };
        self.traversed = Some(Arc::clone(&traversed));
        self.run = Some(Run {
            feed: Feed::start(traversed, self.waker.clone()),
            count: (count > 0).then_some(count),
            keepalive: Duration::from_millis(keepalive_ms.into()),
            period: Duration::from_nanos(1_000_000_000_000 / self.settings.rate_mhz as u64),
            began_ns,
            began: now,
            exposures: 0,
            late: false,
        });
        self.last = Some(Tally {
            run,
            sent: 0,
            dropped: 0,
            reason: Reason::Asked,
        });
        self.laser_on = true;
        self.publish();
        Status::Done
    }

    /// Every run is one traverse of the stage from its home, over the same travel whatever the step.
    fn view_of_run(&self) -> View {
        let mut view = self.view.clone();
        let s = &self.settings;
        let home = self.view.traverse;
        let travel = home.step_counts * i64::from(home.profiles);
        let step = match s.trigger {
            TRIGGER_ENCODER => s.encoder_step,
            // the stage moves one usual step at the usual 500 Hz
            _ => home.step_counts * 500_000 / s.rate_mhz,
        }
        .max(1);
        view.columns = s.columns as u32;
        view.traverse.step_counts = step;
        view.traverse.profiles = (travel / step).clamp(0, u32::MAX.into()) as u32;
        view
    }

    /// Ends the run if there is one; the payload of STOPPED.
    fn stop(&mut self, reason: Reason) -> Vec<u8> {
        if let (Some(_), Some(last)) = (self.run.take(), &mut self.last) {
            last.reason = reason;
        }
        self.laser_on = false;
        self.publish();
        match self.last {
            Some(l) => msg::stopped(l.reason, l.run, l.sent, l.dropped),
            None => msg::stopped(Reason::Asked, 0, 0, 0),
        }
    }

    fn stop_by_itself(&mut self, reason: Reason, out: &mut Outbox) {
        let payload = self.stop(reason);
        if !self.silent {
            self.send(&encode(msg::STOPPED, 0, &payload), out);
        }
    }

    /// Takes one exposure and sends it, or does to it what the faults say.
    fn expose(&mut self, line: &Line, out: &mut Outbox, full: bool) {
        let (Some(run), Some(last)) = (&mut self.run, &mut self.last) else {
            return;
        };
        let faults = &self.setup.faults;
        let index = run.exposures;
        run.exposures += 1;
        let since_ns = u64::from(index) * run.period.as_nanos() as u64;
        let fast_ns = (since_ns as f64 * faults.drift_ppm * 1e-6).round() as i64;
        let time_ns = (run.began_ns + since_ns).saturating_add_signed(fast_ns);
        self.clock_ns = time_ns;
        let mut happens = |p: f64| p > 0.0 && self.chance.random_bool(p);
        let (drop, lose, duplicate, lie, truncate) = (
            happens(faults.drop),
            happens(faults.lose_frame),
            happens(faults.duplicate),
            happens(faults.lie),
            happens(faults.truncate),
        );
        let jitter = i64::from(faults.jitter);
        let beside = match jitter {
            0 => 0,
            _ => self.chance.random_range(-jitter..=jitter),
        };
        let number = last.run;
        if drop || full {
            last.dropped += 1;
            self.log(number, index, None, Fate::DroppedInDevice);
            return self.after_profile();
        }
        let jump = faults.jump.filter(|(n, _)| self.life >= *n);
        let head = ProfileHead {
            run: last.run,
            boot: self.boot,
            time_ns,
            encoder: line
                .encoder
                .wrapping_add(jump.map_or(0, |(_, counts)| counts))
                .wrapping_add(beside),
            dropped: last.dropped,
            flags: 1 | u16::from(line.saturated) << 1,
            scale: self.scale(),
        };
        let last = self.last.as_mut().map(|l| {
            l.sent += 1;
            l.sent - 1
        });
        let sequence = last.unwrap_or_default();
        let payload = msg::profile(&head, line);
        let fate = self.put_out(sequence, &payload, [lose, duplicate, lie, truncate], out);
        if let Some(record) = self.log(number, index, Some(sequence), fate) {
            out.mark(record);
        }
        self.after_profile();
    }

    fn put_out(
        &mut self,
        sequence: u32,
        payload: &[u8],
        [lose, duplicate, lie, truncate]: [bool; 4],
        out: &mut Outbox,
    ) -> Fate {
        if lose || self.silent {
            return Fate::LostOnLink;
        }
        if lie {
            let stated = self.chance.random_range(0..=65_536);
            let stated = if stated == payload.len() as u32 {
                0
            } else {
                stated
            };
            let frame = encode_with_length(msg::PROFILE, sequence, payload, stated);
            self.send(&frame, out);
            return Fate::Damaged;
        }
        let frame = encode(msg::PROFILE, sequence, payload);
        if truncate {
            self.send(&frame[..frame.len() / 2], out);
            return Fate::Damaged;
        }
        let damaged = self.send(&frame, out);
        // a second copy makes good what the first one lost
        let again = duplicate.then(|| self.send(&frame, out));
        match (damaged, again) {
            (true, None | Some(true)) => Fate::Damaged,
            (false, Some(false)) => Fate::Duplicated,
            _ => Fate::Sent,
        }
    }

    fn scale(&self) -> Scale {
        let optics = &self.view.optics;
        let middle = 0.5 * (optics.near_mm + optics.far_mm);
        Scale {
            wide: self.setup.wide,
            explicit_x: true,
            intensity: true,
            x_scale_nm: self.setup.scale_nm,
            x_offset_nm: 0,
            z_scale_nm: self.setup.scale_nm,
            z_offset_nm: (middle * 1e6).round() as i64,
        }
    }

    fn log(&self, run: u32, index: u32, sequence: Option<u32>, fate: Fate) -> Option<u32> {
        let mut number = None;
        self.shared.update(|_, truth: &mut Truth| {
            if truth.profiles.len() < LOGGED {
                number = Some(truth.profiles.len() as u32);
                truth.profiles.push(Record {
                    run,
                    index,
                    sequence,
                    fate,
                });
            }
        });
        number
    }

    /// What happens after so many profiles.
    fn after_profile(&mut self) {
        self.life = self.life.saturating_add(1);
        let at = |n: Option<u32>| n == Some(self.life);
        if at(self.setup.faults.silent_after) {
            self.silent = true;
        }
        if at(self.setup.faults.unplug_after) {
            self.unplug = true;
        }
        if at(self.setup.faults.reboot_after) {
            self.power_on();
        } else {
            self.publish();
        }
    }

    /// Takes exposures as long as there is room and time.
    fn stream(&mut self, now: Instant, out: &mut Outbox) -> Next {
        loop {
            if self.unplug {
                return Next::Unplug;
            }
            let paced = self.setup.paced;
            let Some(run) = &mut self.run else {
                return Next::Wait;
            };
            if run.count.is_some_and(|count| run.exposures >= count) {
                self.stop_by_itself(Reason::CountReached, out);
                return Next::Wait;
            }
            let due = run.began + run.period * run.exposures;
            let full = out.len() >= QUEUE;
            if paced && due > now {
                return Next::At(due);
            }
            if full && !paced {
                return Next::Wait;
            }
            match run.feed.next() {
                Fed::NotYet => {
                    run.late = true;
                    return Next::Wait;
                }
                Fed::Over => return Next::Wait,
                Fed::Line(line) => {
                    if std::mem::take(&mut run.late) {
                        // the simulation was slow, not the device: its time stands still meanwhile
                        run.began += now.saturating_duration_since(due);
                    }
                    self.expose(&line, out, full);
                }
            }
            if paced {
                // what is due next is looked at after this one was sent
                return Next::At(now);
            }
        }
    }
}

fn u16_at(p: &[u8]) -> u16 {
    u16::from_le_bytes([p[0], p[1]])
}

impl Model for Device {
    fn attached(&mut self, _: &mut Outbox) {
        self.heard = Instant::now();
        self.shared.update(|status, _| status.plugged = true);
    }

    fn detached(&mut self, unplugged: bool, unsent: &[u32]) {
        self.stop(Reason::LinkLost);
        self.receiver = Receiver::default();
        self.shared.update(|status, truth| {
            for &record in unsent {
                let record = &mut truth.profiles[record as usize];
                if record.fate != Fate::LostOnLink {
                    record.fate = Fate::Unsent;
                }
            }
            status.plugged &= !unplugged;
        });
        if unplugged {
            self.unplug = false;
            self.power_on();
        }
    }

    fn take(&mut self, bytes: &[u8], now: Instant, out: &mut Outbox) {
        self.receiver.take(bytes, now);
        while let Some(frame) = self.receiver.next(now) {
            self.command(&frame, now, out);
        }
    }

    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next {
        while let Some(frame) = self.receiver.next(now) {
            self.command(&frame, now, out);
        }
        if let Some(run) = &self.run {
            let lapse = self.heard + run.keepalive * 3;
            if now >= lapse {
                self.stop_by_itself(Reason::KeepaliveLost, out);
            }
        }
        let lapse = self.run.as_ref().map(|run| self.heard + run.keepalive * 3);
        let next = self.stream(now, out);
        let due = match next {
            Next::Unplug => return Next::Unplug,
            Next::Wait => None,
            Next::At(due) => Some(due),
        };
        let lapse = lapse.filter(|_| self.run.is_some());
        let due = [due, lapse, self.receiver.deadline()]
            .into_iter()
            .flatten()
            .min();
        due.map_or(Next::Wait, Next::At)
    }
}

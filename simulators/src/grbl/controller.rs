//! The controller: lines and realtime characters in, answers out, one tip moved through a scene.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::gcode::{Block, GrblError, Modes, Motion, parse};
use super::{Setup, TrueTouch, Truth};
use crate::contact::Move;
use crate::faults::BadLine;
use crate::wire::{Model, Next, Outbox, lock};

/// Speed of G0, mm a minute.
const RAPID: f64 = 6000.0;
/// The tip runs on for this long after the trigger, s: whoever reads the position instead of the latch sees it.
const OVERRUN_S: f64 = 0.005;
/// Longest line, as in GRBL; also what bounds the memory.
const LONGEST_LINE: usize = 80;
/// Lines that wait for a move to end; more are refused as too long, as an overflowing buffer would make of them.
const WAITING: usize = 32;

#[derive(Debug)]
pub(super) struct Controller {
    setup: Setup,
    truth: Arc<Mutex<Truth>>,
    bad_line: BadLine,
    rng: ChaCha8Rng,
    line: Vec<u8>,
    waiting: VecDeque<String>,
    modes: Modes,
    position: DVec3,
    latched: (DVec3, bool),
    locked: bool,
    /// A move under way: when it ends, and what is said then.
    moving: Option<(Instant, Vec<String>)>,
    probings: u32,
    silent: bool,
}

impl Controller {
    pub fn new(setup: Setup, truth: Arc<Mutex<Truth>>) -> Controller {
        Controller {
            bad_line: BadLine::new(&setup.faults, setup.seed),
            rng: ChaCha8Rng::seed_from_u64(setup.seed),
            line: Vec::new(),
            waiting: VecDeque::new(),
            modes: Modes::default(),
            position: DVec3::Z * 200.0,
            latched: (DVec3::ZERO, false),
            locked: false,
            moving: None,
            probings: 0,
            silent: setup.faults.silent_after == Some(0),
            setup,
            truth,
        }
    }

    fn say(&mut self, text: &str, out: &mut Outbox) {
        if self.silent {
            return;
        }
        let mut bytes = Vec::new();
        self.bad_line
            .carry(format!("{text}\r\n").as_bytes(), &mut bytes);
        out.push(&bytes);
    }

    /// Start or reset: modes and queue are gone, the position is not.
    fn reset(&mut self, alarm: bool, out: &mut Outbox) {
        self.line.clear();
        self.waiting.clear();
        self.moving = None;
        self.modes = Modes::default();
        self.locked = alarm;
        lock(&self.truth).starts += 1;
        self.say("\r\nGrbl 1.1h ['$' for help]", out);
        if alarm {
            self.say("[MSG:'$H'|'$X' to unlock]", out);
        }
    }

    fn byte(&mut self, byte: u8, now: Instant, out: &mut Outbox) {
        match byte {
            b'?' => {
                let report = self.report();
                self.say(&report, out);
            }
            0x18 => {
                let in_move = self.moving.is_some();
                if in_move {
                    self.say("ALARM:3", out);
                }
                self.reset(in_move, out);
            }
            // hold and resume: nothing here takes long enough to be held
            b'!' | b'~' => {}
            b'\n' | b'\r' => self.end_of_line(now, out),
            _ if self.line.len() <= LONGEST_LINE => self.line.push(byte),
            _ => {}
        }
    }

    fn end_of_line(&mut self, now: Instant, out: &mut Outbox) {
        let line = std::mem::take(&mut self.line);
        if line.len() > LONGEST_LINE || self.waiting.len() >= WAITING {
            return self.answer(Err(GrblError::LineTooLong), out);
        }
        let text = String::from_utf8_lossy(&line).into_owned();
        self.waiting.push_back(text);
        self.run_waiting(now, out);
    }

    fn run_waiting(&mut self, now: Instant, out: &mut Outbox) {
        while self.moving.is_none() {
            let Some(line) = self.waiting.pop_front() else {
                return;
            };
            self.run(line.trim(), now, out);
        }
    }

    fn answer(&mut self, result: Result<(), GrblError>, out: &mut Outbox) {
        match result {
            Ok(()) => self.say("ok", out),
            Err(error) => self.say(&format!("error:{}", error as u8), out),
        }
    }

    fn run(&mut self, line: &str, now: Instant, out: &mut Outbox) {
        if line.starts_with('$') {
            let result = self.system(line, out);
            return self.answer(result, out);
        }
        if line.is_empty() {
            return self.answer(Ok(()), out);
        }
        if self.locked {
            return self.answer(Err(GrblError::Locked), out);
        }
        match parse(line, self.modes) {
            Ok(block) => self.obey(&block, now, out),
            Err(error) => self.answer(Err(error), out),
        }
    }

    fn system(&mut self, line: &str, out: &mut Outbox) -> Result<(), GrblError> {
        match line.to_ascii_uppercase().as_str() {
            "$" => self.say(
                "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]",
                out,
            ),
            "$$" => {
                for setting in [
                    "$0=10",
                    "$10=1",
                    "$13=0",
                    "$20=0",
                    "$21=0",
                    "$22=0",
                    "$110=6000.000",
                ] {
                    self.say(setting, out);
                }
            }
            "$#" => {
                let zero = triple(DVec3::ZERO);
                for name in [
                    "G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92",
                ] {
                    self.say(&format!("[{name}:{zero}]"), out);
                }
                self.say("[TLO:0.000]", out);
                let latch = self.latch();
                self.say(&latch, out);
            }
            "$I" => {
                self.say("[VER:1.1h.20190830:]", out);
                self.say("[OPT:V,15,128]", out);
            }
            "$G" => self.say("[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", out),
            "$X" => {
                if self.locked {
                    self.locked = false;
                    self.say("[MSG:Caution: Unlocked]", out);
                }
            }
            "$H" => return Err(GrblError::HomingNotEnabled),
            _ => return Err(GrblError::UnknownSystemCommand),
        }
        Ok(())
    }

    fn obey(&mut self, block: &Block, now: Instant, out: &mut Outbox) {
        let before = self.modes;
        self.modes = block.modes;
        let mut target = self.position;
        for (axis, word) in block.axes.iter().enumerate() {
            if let Some(word) = word {
                target[axis] = if block.modes.incremental {
                    target[axis] + word
                } else {
                    *word
                };
            }
        }
        if block.axes.iter().all(Option::is_none) {
            return self.answer(Ok(()), out);
        }
        match block.modes.motion {
            Motion::Probe { must_touch, away } => {
                // probing is not a mode that stays
                self.modes.motion = before.motion;
                if target == self.position {
                    return self.answer(Err(GrblError::InvalidTarget), out);
                }
                self.probe(target, must_touch, away, now, out);
            }
            Motion::Rapid | Motion::Feed => self.travel(target, now, out),
        }
    }

    fn ball(&self, from: DVec3, to: DVec3) -> Move {
        let scene_from_machine = self.setup.machine_from_scene.inverse();
        Move {
            from: scene_from_machine.point(from),
            to: scene_from_machine.point(to),
            radius: self.setup.tip_radius_mm,
        }
    }

    fn travel(&mut self, target: DVec3, now: Instant, out: &mut Outbox) {
        let ball = self.ball(self.position, target);
        // a move away from a face that was just probed starts in contact
        let met = ball.first_contact(&self.setup.scene);
        if met.is_some_and(|contact| contact.travel > 0.0) {
            lock(&self.truth).crashes += 1;
        }
        let feed = match self.modes.motion {
            Motion::Rapid => RAPID,
            _ => self.modes.feed,
        };
        let distance = self.position.distance(target);
        self.position = target;
        self.take_time(distance, feed, vec!["ok".to_owned()], now, out);
    }

    /// Answers now, or when the move would be over.
    fn take_time(
        &mut self,
        distance: f64,
        feed: f64,
        answers: Vec<String>,
        now: Instant,
        out: &mut Outbox,
    ) {
        if self.setup.paced {
            let time = Duration::from_secs_f64((60.0 * distance / feed).min(3600.0));
            self.moving = Some((now + time, answers));
        } else {
            answers.iter().for_each(|a| self.say(a, out));
        }
    }

    fn probe(
        &mut self,
        target: DVec3,
        must_touch: bool,
        away: bool,
        now: Instant,
        out: &mut Outbox,
    ) {
        self.probings += 1;
        let start = self.position;
        let direction = (target - start).normalize();
        let contact = if self.setup.faults.no_contact {
            None
        } else {
            self.ball(start, target).first_contact(&self.setup.scene)
        };
        let touching = !self.setup.faults.no_contact
            && self.ball(start, target).touches_at_start(&self.setup.scene);
        if touching != away {
            // for G38.2 and .3 it must not touch yet, for .4 and .5 it must
            self.locked = true;
            self.say("ALARM:4", out);
            return self.answer(Ok(()), out);
        }
        if self.setup.faults.reset_in_move == Some(self.probings) {
            self.position = start.midpoint(target);
            return self.reset(true, out);
        }
        let noise: f64 = self.rng.sample(StandardNormal);
        let triggered = if away {
            self.release(start, target).map(|travel| (travel, None))
        } else {
            contact.map(|c| (c.travel, Some(c.surface)))
        };
        let feed = self.modes.feed;
        let mut answers = Vec::new();
        let end = match triggered {
            Some((travel, surface)) => {
                let exact = start + direction * travel;
                let latched = exact + direction * (noise * self.setup.repeatability_mm);
                if let Some(surface) = surface {
                    lock(&self.truth).touches.push(TrueTouch {
                        contact: exact,
                        latched,
                        direction,
                        surface,
                    });
                }
                self.latched = (latched, true);
                latched + direction * (feed / 60.0 * OVERRUN_S)
            }
            None => {
                self.latched = (target, false);
                if must_touch {
                    self.locked = true;
                    answers.push("ALARM:5".to_owned());
                }
                target
            }
        };
        self.position = end;
        answers.push(self.probe_answer());
        answers.push("ok".to_owned());
        self.take_time(start.distance(end), feed, answers, now, out);
    }

    /// Travel until a touching tip is free, by bisection; nothing when it touches to the end.
    fn release(&self, start: DVec3, target: DVec3) -> Option<f64> {
        let length = start.distance(target);
        let direction = (target - start) / length;
        let touches = |travel: f64| {
            let here = start + direction * travel;
            let ball = self.ball(here, here + direction * 1e-3);
            ball.touches_at_start(&self.setup.scene)
        };
        if touches(length) {
            return None;
        }
        let (mut low, mut high) = (0.0, length);
        while high - low > 1e-7 {
            let middle = 0.5 * (low + high);
            if touches(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        Some(high)
    }

    fn latch(&self) -> String {
        let (at, found) = self.latched;
        format!("[PRB:{}:{}]", triple(at), u8::from(found))
    }

    fn probe_answer(&self) -> String {
        let whole = self.latch();
        if self.setup.faults.damage_prb != Some(self.probings) {
            return whole;
        }
        // a status report written into the middle of the line, as buffers that overlap do it
        let (front, back) = whole.split_at(whole.len() / 2);
        format!("{front}{}\r\n{back}", self.report())
    }

    fn report(&self) -> String {
        let state = match (self.locked, &self.moving) {
            (true, _) => "Alarm",
            (_, Some(_)) => "Run",
            (_, None) => "Idle",
        };
        format!("<{state}|MPos:{}|FS:0,0>", triple(self.position))
    }
}

/// Three coordinates as GRBL writes them.
fn triple(p: DVec3) -> String {
    format!("{:.3},{:.3},{:.3}", p.x, p.y, p.z)
}

impl Model for Controller {
    fn attached(&mut self, out: &mut Outbox) {
        let alarm = self.setup.faults.alarm;
        self.reset(alarm, out);
    }

    fn detached(&mut self, _: bool, _: &[u32]) {
        self.waiting.clear();
        self.line.clear();
        self.moving = None;
    }

    fn take(&mut self, bytes: &[u8], now: Instant, out: &mut Outbox) {
        for &byte in bytes {
            self.byte(byte, now, out);
        }
    }

    fn step(&mut self, now: Instant, out: &mut Outbox) -> Next {
        if let Some((due, _)) = self.moving {
            if now < due {
                return Next::At(due);
            }
            if let Some((_, answers)) = self.moving.take() {
                answers.iter().for_each(|a| self.say(a, out));
            }
            self.run_waiting(now, out);
        }
        match &self.moving {
            Some((due, _)) => Next::At(*due),
            None => Next::Wait,
        }
    }
}

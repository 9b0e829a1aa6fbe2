//! How a device misbehaves on request: parsed from text, drawn from a seed, and logged exactly.

use std::str::FromStr;
use std::time::Duration;

use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What goes wrong, and how often. All off by default. Counts of profiles are over the life of the device.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Faults {
    /// `lose=P`: each byte sent is lost with this probability.
    pub lose: f64,
    /// `flip=P`: one bit of each byte sent is turned over with this probability.
    pub flip: f64,
    /// `lie=P`: a profile's header states a wrong length, under a header check that is right.
    pub lie: f64,
    /// `babble=P`: before a frame, 1 to 64 random bytes.
    pub babble: f64,
    /// `drop=P`: the device takes a profile but does not send it, and counts it as dropped.
    pub drop: f64,
    /// `lose-frame=P`: a profile is sent and lost on the link: its sequence number is missing.
    pub lose_frame: f64,
    /// `duplicate=P`: a profile is sent twice.
    pub duplicate: f64,
    /// `jump=N:C`: from profile N on the encoder reads C counts more.
    pub jump: Option<(u32, i64)>,
    /// `silent-after=N`: after N profiles (0: from the start) nothing is sent or answered.
    pub silent_after: Option<u32>,
    /// `reboot-after=N`: after N profiles the device starts anew: no run, laser off, settings gone, another boot number.
    pub reboot_after: Option<u32>,
    /// `unplug-after=N`: after N profiles the cable is pulled (and the device, powered by it, is off).
    pub unplug_after: Option<u32>,
    /// `replug-ms=M`: it is put back after so long.
    pub replug: Option<Duration>,
    /// `lumps`: bytes arrive in lumps every 16 ms, as from a USB converter.
    pub lumps: bool,
    /// `split`: bytes arrive in random pieces.
    pub split: bool,
    /// `baud=N`: the line runs at N Bd: unless the host sets its port to that, all it reads and writes is rubbish (not over TCP).
    pub baud: Option<u32>,
    /// `no-contact`: the probe never triggers.
    pub no_contact: bool,
    /// `damage-prb=N`: the answer of the N-th probing move (from 1) is torn by a status report.
    pub damage_prb: Option<u32>,
    /// `alarm`: the controller starts locked.
    pub alarm: bool,
    /// `reset-in-move=N`: the controller resets in the N-th probing move (from 1).
    pub reset_in_move: Option<u32>,
    /// `burst=P`: each run of 62 bytes, a packet of a USB converter, arrives as zeros with this probability.
    pub burst: f64,
    /// `wrong-parity`: the device's parity is not the host's: all it sends is read as NUL, and it takes nothing in.
    pub wrong_parity: bool,
    /// `chatter=P`: before a message, the device says something nobody asked for.
    pub chatter: f64,
    /// `sentinel=P`: a code or word in place of a value.
    pub sentinel: f64,
    /// `overrun=P`: the device marks a measurement as overrun.
    pub overrun: f64,
    /// `near-wrap`: counters and clocks begin shortly before they wrap.
    pub near_wrap: bool,
    /// `jitter=C`: the encoder reads up to C counts beside the truth.
    pub jitter: u32,
    /// `reorder=P`: a packet is overtaken by the next one (packets only).
    pub reorder: f64,
    /// `truncate=P`: a message ends too early.
    pub truncate: f64,
    /// `swap-bytes`: numbers come in the other byte order.
    pub swap_bytes: bool,
    /// `stall=P`: a transfer ends with a stalled endpoint (USB only).
    pub stall: f64,
    /// `late-ms=M`: answers come so much later.
    pub late: Option<Duration>,
    /// `other-identity`: after it was plugged in again, it is another one of its kind.
    pub other_identity: bool,
    /// `autostart`: it streams, laser on, when it is found.
    pub autostart: bool,
    /// `no-memory`: the host refuses large transfers (USB only).
    pub no_memory: bool,
    /// `refuse=N`: the N-th command (from 1) is refused.
    pub refuse: Option<u32>,
    /// `drift-ppm=X`: the device's clock runs fast by so much.
    pub drift_ppm: f64,
}

/// One of the 25 ways in which devices fail, by a name that [`Faults`] reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Case {
    /// From 1.
    pub number: u8,
    /// As in a fault text.
    pub name: &'static str,
    /// The faults that it stands for.
    pub faults: &'static str,
}

const fn case(number: u8, name: &'static str, faults: &'static str) -> Case {
    Case {
        number,
        name,
        faults,
    }
}

/// All 25, in the order of the catalogue. The probabilities are high enough that a minute shows each many times.
pub const CASES: [Case; 25] = [
    case(1, "byte-loss", "lose=0.001"),
    case(2, "bursts", "burst=0.01"),
    case(3, "latency-lumps", "lumps"),
    case(4, "interleaved-reply", "chatter=0.01,split"),
    case(5, "wrong-line", "wrong-parity"),
    case(6, "sentinels", "sentinel=0.05"),
    case(7, "counter-wrap", "near-wrap"),
    case(8, "encoder-wrap", "jump=0:-2000"),
    case(9, "encoder-jitter", "jitter=2"),
    case(10, "dropped-triggers", "drop=0.01"),
    case(11, "duplicates", "duplicate=0.02,reorder=0.02"),
    case(12, "truncated", "truncate=0.01"),
    case(13, "length-lie", "lie=0.01"),
    case(14, "byte-order", "swap-bytes"),
    case(15, "usb-stall", "stall=0.001"),
    case(16, "late-reply", "late-ms=300"),
    case(17, "hot-unplug", "unplug-after=50"),
    case(
        18,
        "other-on-replug",
        "unplug-after=50,replug-ms=100,other-identity",
    ),
    case(19, "left-streaming", "autostart"),
    case(20, "overrun-flag", "overrun=0.01"),
    case(21, "host-memory", "no-memory"),
    case(22, "refused", "refuse=2"),
    case(23, "unasked-lines", "chatter=0.05"),
    case(24, "clock-drift", "drift-ppm=50"),
    case(25, "half-open", "silent-after=50"),
];

/// A fault text that cannot be read.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FaultError {
    /// No such fault.
    #[error("faults: no fault is called {name:?}, expected one of {known}; separate several by commas", known = NAMES.join(", "))]
    Unknown {
        /// What was written.
        name: String,
    },
    /// A value that does not fit.
    #[error("faults: {name} is {found:?}, expected {expected}")]
    Value {
        /// Which fault.
        name: String,
        /// What was written.
        found: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// The same fault twice.
    #[error("faults: {name} is given twice, expected once; remove one")]
    Twice {
        /// Which fault.
        name: String,
    },
}

const NAMES: [&str; 36] = [
    "lose=P",
    "flip=P",
    "lie=P",
    "babble=P",
    "drop=P",
    "lose-frame=P",
    "duplicate=P",
    "jump=N:COUNTS",
    "silent-after=N",
    "reboot-after=N",
    "unplug-after=N",
    "replug-ms=M",
    "lumps",
    "split",
    "baud=N",
    "no-contact",
    "damage-prb=N",
    "alarm",
    "reset-in-move=N",
    "burst=P",
    "wrong-parity",
    "chatter=P",
    "sentinel=P",
    "overrun=P",
    "near-wrap",
    "jitter=C",
    "reorder=P",
    "truncate=P",
    "swap-bytes",
    "stall=P",
    "late-ms=M",
    "other-identity",
    "autostart",
    "no-memory",
    "refuse=N",
    "drift-ppm=X",
];

impl FromStr for Faults {
    type Err = FaultError;

    /// Reads `name=value` or `name`, separated by commas; an empty text is no fault. The name of one of [`CASES`] stands for
    /// its faults.
    fn from_str(text: &str) -> Result<Faults, FaultError> {
        let mut faults = Faults::default();
        let mut seen = Vec::new();
        let items = text.split(',').map(str::trim).filter(|i| !i.is_empty());
        let spelt_out = |item: &'static str| item.split(',').collect::<Vec<&str>>();
        let items = items.flat_map(|item| {
            let case = CASES.iter().find(|case| case.name == item);
            case.map_or(vec![item], |case| spelt_out(case.faults))
        });
        for item in items {
            let (name, value) = item.split_once('=').unwrap_or((item, ""));
            if seen.contains(&name) {
                return Err(FaultError::Twice { name: name.into() });
            }
            seen.push(name);
            faults.set(name, value)?;
        }
        Ok(faults)
    }
}

impl Faults {
    fn set(&mut self, name: &str, value: &str) -> Result<(), FaultError> {
        let bad = |expected| FaultError::Value {
            name: name.into(),
            found: value.into(),
            expected,
        };
        let share = || {
            let p = value.parse::<f64>().ok();
            p.filter(|p| (0.0..=1.0).contains(p))
                .ok_or_else(|| bad("a probability from 0 to 1"))
        };
        let count = || value.parse::<u32>().map_err(|_| bad("a whole number"));
        let nothing = || match value {
            "" => Ok(true),
            _ => Err(bad("no value")),
        };
        match name {
            "lose" => self.lose = share()?,
            "flip" => self.flip = share()?,
            "lie" => self.lie = share()?,
            "babble" => self.babble = share()?,
            "drop" => self.drop = share()?,
            "lose-frame" => self.lose_frame = share()?,
            "duplicate" => self.duplicate = share()?,
            "jump" => {
                let pair = value
                    .split_once(':')
                    .and_then(|(n, c)| Some((n.parse().ok()?, c.parse().ok()?)));
                self.jump = Some(pair.ok_or_else(|| bad("N:COUNTS, two whole numbers"))?);
            }
            "silent-after" => self.silent_after = Some(count()?),
            "reboot-after" => self.reboot_after = Some(count()?),
            "unplug-after" => self.unplug_after = Some(count()?),
            "replug-ms" => self.replug = Some(Duration::from_millis(count()?.into())),
            "lumps" => self.lumps = nothing()?,
            "split" => self.split = nothing()?,
            "baud" => self.baud = Some(count()?),
            "no-contact" => self.no_contact = nothing()?,
            "damage-prb" => self.damage_prb = Some(count()?),
            "alarm" => self.alarm = nothing()?,
            "reset-in-move" => self.reset_in_move = Some(count()?),
            "burst" => self.burst = share()?,
            "wrong-parity" => self.wrong_parity = nothing()?,
            "chatter" => self.chatter = share()?,
            "sentinel" => self.sentinel = share()?,
            "overrun" => self.overrun = share()?,
            "near-wrap" => self.near_wrap = nothing()?,
            "jitter" => self.jitter = count()?,
            "reorder" => self.reorder = share()?,
            "truncate" => self.truncate = share()?,
            "swap-bytes" => self.swap_bytes = nothing()?,
            "stall" => self.stall = share()?,
            "late-ms" => self.late = Some(Duration::from_millis(count()?.into())),
            "other-identity" => self.other_identity = nothing()?,
            "autostart" => self.autostart = nothing()?,
            "no-memory" => self.no_memory = nothing()?,
            "refuse" => self.refuse = Some(count()?),
            "drift-ppm" => {
                let ppm = value.parse::<f64>().ok();
                let ppm = ppm.filter(|ppm| ppm.abs() <= 1e5);
                self.drift_ppm = ppm.ok_or_else(|| bad("parts per million, at most 100000"))?;
            }
            _ => return Err(FaultError::Unknown { name: name.into() }),
        }
        Ok(())
    }
}

/// What damage did to the bytes, in all.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DamageCount {
    /// Bytes that were to be sent.
    pub offered_bytes: u64,
    /// Of these, lost.
    pub lost_bytes: u64,
    /// Of these, with a bit wrong or all.
    pub flipped_bytes: u64,
    /// Bytes put in between that nobody sent.
    pub babbled_bytes: u64,
}

/// A bad line, seeded.
#[derive(Debug)]
pub(crate) struct BadLine {
    lose: f64,
    flip: f64,
    babble: f64,
    burst: f64,
    /// The run of [`PACKET`] bytes under way is one of zeros.
    zeros: bool,
    rng: ChaCha8Rng,
    pub count: DamageCount,
}

/// Data bytes in a packet of a full-speed USB converter.
const PACKET: u64 = 62;

impl BadLine {
    pub fn new(faults: &Faults, seed: u64) -> BadLine {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(u64::MAX);
        BadLine {
            lose: faults.lose,
            flip: faults.flip,
            babble: faults.babble,
            burst: faults.burst,
            zeros: false,
            rng,
            count: DamageCount::default(),
        }
    }

    /// What arrives of a frame; true when it is not the frame.
    pub fn carry(&mut self, frame: &[u8], out: &mut Vec<u8>) -> bool {
        let first = self.count.offered_bytes;
        self.count.offered_bytes += frame.len() as u64;
        if self.babble > 0.0 && self.rng.random_bool(self.babble) {
            let mut noise = vec![0; self.rng.random_range(1..=64)];
            self.rng.fill_bytes(&mut noise);
            self.count.babbled_bytes += noise.len() as u64;
            out.extend(noise);
        }
        if self.lose == 0.0 && self.flip == 0.0 && self.burst == 0.0 {
            out.extend_from_slice(frame);
            return false;
        }
        let before = (self.count.lost_bytes, self.count.flipped_bytes);
        for (place, &byte) in (first..).zip(frame) {
            if self.burst > 0.0 && place % PACKET == 0 {
                self.zeros = self.rng.random_bool(self.burst);
            }
            if self.zeros && byte != 0 {
                self.count.flipped_bytes += 1;
                out.push(0);
            } else if self.rng.random_bool(self.lose) {
                self.count.lost_bytes += 1;
            } else if self.rng.random_bool(self.flip) {
                self.count.flipped_bytes += 1;
                out.push(byte ^ 1 << self.rng.random_range(0..8));
            } else {
                out.push(byte);
            }
        }
        before != (self.count.lost_bytes, self.count.flipped_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn several_faults_are_read() {
        let faults: Faults = "drop=0.01, flip=1e-5,unplug-after=200,jump=7:-40,lumps"
            .parse()
            .unwrap();
        let expected = Faults {
            drop: 0.01,
            flip: 1e-5,
            unplug_after: Some(200),
            jump: Some((7, -40)),
            lumps: true,
            ..Faults::default()
        };
        assert_eq!(faults, expected);
        assert_eq!("".parse(), Ok(Faults::default()));
    }

    #[test]
    fn each_case_has_a_name_that_is_read_and_they_combine() {
        for (number, case) in (1..).zip(CASES) {
            assert_eq!(case.number, number);
            let by_name: Faults = case.name.parse().unwrap();
            let spelt_out: Faults = case.faults.parse().unwrap();
            assert_eq!(by_name, spelt_out, "{}", case.name);
            assert_ne!(by_name, Faults::default(), "{}", case.name);
        }
        let both: Faults = "byte-loss, hot-unplug".parse().unwrap();
        assert_eq!((both.lose, both.unplug_after), (0.001, Some(50)));
        let twice = "byte-loss,lose=0.1".parse::<Faults>();
        assert_eq!(
            twice,
            Err(FaultError::Twice {
                name: "lose".into()
            })
        );
    }

    #[test]
    fn bursts_are_whole_packets_of_zeros() {
        let faults: Faults = "burst=0.1".parse().unwrap();
        let mut line = BadLine::new(&faults, 5);
        let mut out = Vec::new();
        for _ in 0..620 {
            line.carry(&[7; 100], &mut out);
        }
        assert_eq!(out.len(), 62_000);
        let bad = out.chunks(62).filter(|packet| packet.contains(&0));
        let bad: Vec<&[u8]> = bad.collect();
        assert!(bad.iter().all(|packet| packet.iter().all(|&b| b == 0)));
        assert_eq!(line.count.flipped_bytes, 62 * bad.len() as u64);
        // expected 100, standard deviation 9.5
        assert!((60..=140).contains(&bad.len()), "{}", bad.len());
    }

    #[test]
    fn mistakes_say_what_was_seen_and_expected() {
        let error = |text: &str| text.parse::<Faults>().unwrap_err().to_string();
        assert_eq!(
            error("drop=1.5"),
            "faults: drop is \"1.5\", expected a probability from 0 to 1"
        );
        assert_eq!(
            error("flip=nan"),
            "faults: flip is \"nan\", expected a probability from 0 to 1"
        );
        assert_eq!(
            error("unplug-after=soon"),
            "faults: unplug-after is \"soon\", expected a whole number"
        );
        assert_eq!(
            error("jump=3"),
            "faults: jump is \"3\", expected N:COUNTS, two whole numbers"
        );
        assert_eq!(
            error("lumps=2"),
            "faults: lumps is \"2\", expected no value"
        );
        assert_eq!(
            error("lose=0.1,lose=0.2"),
            "faults: lose is given twice, expected once; remove one"
        );
        let unknown = error("explode");
        assert!(
            unknown.starts_with(
                "faults: no fault is called \"explode\", expected one of lose=P, flip=P"
            ),
            "{unknown}"
        );
    }

    #[test]
    fn a_bad_line_counts_exactly_what_it_does() {
        let faults = Faults {
            lose: 0.01,
            flip: 0.01,
            babble: 0.1,
            ..Faults::default()
        };
        let mut line = BadLine::new(&faults, 3);
        let mut out = Vec::new();
        let damaged = (0..500).filter(|_| line.carry(&[7; 40], &mut out)).count();
        let c = line.count;
        assert_eq!(
            out.len() as u64,
            c.offered_bytes - c.lost_bytes + c.babbled_bytes
        );
        // expected 500 (1 - 0.98^40) = 277, standard deviation 11
        assert!((230..=325).contains(&damaged), "{damaged}");
        let mut again = BadLine::new(&faults, 3);
        let mut second = Vec::new();
        (0..500).for_each(|_| {
            again.carry(&[7; 40], &mut second);
        });
        assert_eq!(out, second);
    }
}

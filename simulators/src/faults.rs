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
}

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

const NAMES: [&str; 19] = [
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
];

impl FromStr for Faults {
    type Err = FaultError;

    /// Reads `name=value` or `name`, separated by commas; an empty text is no fault.
    fn from_str(text: &str) -> Result<Faults, FaultError> {
        let mut faults = Faults::default();
        let mut seen = Vec::new();
        for item in text.split(',').map(str::trim).filter(|i| !i.is_empty()) {
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
    /// Of these, with one bit wrong.
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
    rng: ChaCha8Rng,
    pub count: DamageCount,
}

impl BadLine {
    pub fn new(faults: &Faults, seed: u64) -> BadLine {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(u64::MAX);
        BadLine {
            lose: faults.lose,
            flip: faults.flip,
            babble: faults.babble,
            rng,
            count: DamageCount::default(),
        }
    }

    /// What arrives of a frame; true when it is not the frame.
    pub fn carry(&mut self, frame: &[u8], out: &mut Vec<u8>) -> bool {
        self.count.offered_bytes += frame.len() as u64;
        if self.babble > 0.0 && self.rng.random_bool(self.babble) {
            let mut noise = vec![0; self.rng.random_range(1..=64)];
            self.rng.fill_bytes(&mut noise);
            self.count.babbled_bytes += noise.len() as u64;
            out.extend(noise);
        }
        if self.lose == 0.0 && self.flip == 0.0 {
            out.extend_from_slice(frame);
            return false;
        }
        let before = (self.count.lost_bytes, self.count.flipped_bytes);
        for &byte in frame {
            if self.rng.random_bool(self.lose) {
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

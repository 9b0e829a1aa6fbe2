//! The numbers of the bursts of a stream, by two bits that count them, by the bytes thrown away between them, and by the time at
//! which they came. Pure.
//!
//! Two bits say how many bursts are missing only up to a multiple of 4, a *turn*. Which multiple it is, two witnesses tell. A
//! sensor that measures by time sends a burst every period, and no burst comes before its time: that bounds the turns from
//! above, and the lateness that is usual on this link bounds them from below. The bytes thrown away, four a burst, decide what
//! the time leaves open. Where the time leaves several, or the two disagree, [`Count::unsure`] says by how much.

use std::time::{Duration, Instant};

/// Bursts of a turn.
const TURN: u64 = 4;
/// The sensor's clock may be wrong by so much; of the time since the last burst.
const DRIFT: f64 = 0.01;
/// How long the lateness of a moment counts as usual, s.
const MEMORY_S: f64 = 2.0;
/// How long every burst must be a turn late, with no other sign, before a turn is counted as lost, s. A host that was busy is
/// not late again with every burst.
const SETTLED_S: f64 = 0.25;

/// Numbers bursts.
#[derive(Debug, Default)]
pub struct Count {
    next: Option<(u8, u64)>,
    /// The counter may have gone on unseen.
    unknown: bool,
    skipped_at_last: u64,
    pace: Option<Pace>,
    /// Bursts missing between those that came.
    pub lost: u64,
    /// By so many `lost` may be wrong, either way: turns that no witness tells apart.
    pub unsure: u64,
}

/// When bursts come that come by time. Times are seconds since `began`.
#[derive(Debug)]
struct Pace {
    period_s: f64,
    began: Option<Instant>,
    /// When burst 0 would have come without any delay.
    zero_s: f64,
    last_s: f64,
    usual_s: f64,
    /// Since when every burst is late by a turn or more, and by how much the least late one.
    late: Option<(f64, f64)>,
}

impl Count {
    /// For bursts that come by time, so far apart; for those that come when they like without.
    pub fn new(period: Option<Duration>) -> Count {
        let pace = period
            .filter(|period| !period.is_zero())
            .map(|period| Pace {
                period_s: period.as_secs_f64(),
                began: None,
                zero_s: 0.0,
                last_s: 0.0,
                usual_s: 0.0,
                late: None,
            });
        Count {
            pace,
            ..Count::default()
        }
    }

    /// A stream begins, or begins again: its counter stands anywhere, and what was thrown away before says nothing of it.
    pub fn begin(&mut self, skipped_bytes: u64) {
        self.unknown = true;
        self.skipped_at_last = skipped_bytes;
    }

    /// The number of a burst, from 0, by its CNT, the bytes thrown away so far, and when it came.
    pub fn number(&mut self, counter: u8, skipped_bytes: u64, at: Instant) -> u64 {
        let skipped = skipped_bytes - self.skipped_at_last;
        self.skipped_at_last = skipped_bytes;
        let number = match self.next {
            Some((expected, next)) if !self.unknown => {
                let least = u64::from(counter.wrapping_sub(expected) & 3);
                let missing = match (least, skipped) {
                    (0, 0) => 0,
                    _ => self.missing(next, least, skipped, at),
                };
                let missing = missing + self.unseen(next + missing, at);
                self.lost += missing;
                next + missing
            }
            anywhere => {
                let number = anywhere.map_or(0, |(_, next)| next);
                if let Some(pace) = &mut self.pace {
                    pace.restart(number, at);
                }
                number
            }
        };
        self.unknown = false;
        self.next = Some(((counter + 1) & 3, number + 1));
        number
    }

    /// Bursts missing in a gap that shows: `least` by the counter, and some turns.
    fn missing(&mut self, next: u64, least: u64, skipped: u64, at: Instant) -> u64 {
        // The number of the form least + 4 k nearest to a quarter of the bytes.
        let by_bytes = (skipped + 8).saturating_sub(4 * least) / 16;
        let turns = match &self.pace {
            None => by_bytes,
            Some(pace) => {
                let (fewest, most) = pace.turns(next + least, at);
                let turns = by_bytes.clamp(fewest, most);
                self.unsure += TURN * (most - fewest + turns.abs_diff(by_bytes));
                turns
            }
        };
        least + TURN * turns
    }

    /// Bursts of whole turns that went without leaving a byte behind, once it is clear that they did.
    fn unseen(&mut self, number: u64, at: Instant) -> u64 {
        let turns = self.pace.as_mut().map_or(0, |pace| pace.take(number, at));
        self.unsure += TURN * turns;
        TURN * turns
    }
}

impl Pace {
    fn restart(&mut self, number: u64, at: Instant) {
        let began = *self.began.get_or_insert(at);
        self.last_s = at.saturating_duration_since(began).as_secs_f64();
        self.zero_s = self.last_s - number as f64 * self.period_s;
        self.late = None;
    }

    fn seconds(&self, at: Instant) -> f64 {
        let began = self.began.unwrap_or(at);
        at.saturating_duration_since(began).as_secs_f64()
    }

    /// Seconds that a burst is late which comes now and has this number.
    fn lateness(&self, number: u64, now_s: f64) -> f64 {
        now_s - number as f64 * self.period_s - self.zero_s
    }

    /// Half a burst, and what the sensor's clock may have gained or lost.
    fn slack(&self, now_s: f64) -> f64 {
        0.5 * self.period_s + DRIFT * (now_s - self.last_s)
    }

    /// Fewest and most turns missing before a burst that would have this number without.
    fn turns(&self, number: u64, at: Instant) -> (u64, u64) {
        let now_s = self.seconds(at);
        let (late, slack) = (self.lateness(number, now_s), self.slack(now_s));
        let turn = TURN as f64 * self.period_s;
        let most = ((late + slack) / turn).floor().max(0.0) as u64;
        let fewest = ((late - self.usual_s - slack) / turn).ceil().max(0.0) as u64;
        // Later than usual whatever is missing: the host was busy.
        if fewest > most {
            (0, most)
        } else {
            (fewest, most)
        }
    }

    /// Learns from a burst; the answer is the turns that are missing before it beside those that showed.
    fn take(&mut self, number: u64, at: Instant) -> u64 {
        let now_s = self.seconds(at);
        let (late, slack) = (self.lateness(number, now_s), self.slack(now_s));
        let turn = TURN as f64 * self.period_s;
        let since_last = now_s - self.last_s;
        self.last_s = now_s;
        let usual = self.usual_s;
        self.usual_s = late.max(usual * (1.0 - since_last / MEMORY_S).max(0.0));
        self.late = match self.late {
            Some((since, least)) if late >= turn - slack => Some((since, least.min(late))),
            // Whoever becomes slower little by little has lost nothing.
            None if late >= (usual + turn - slack).max(turn - slack) => Some((now_s, late)),
            _ => None,
        };
        match self.late {
            None => {
                self.zero_s += late.min(DRIFT * since_last);
                0
            }
            Some((since, least)) if now_s - since >= SETTLED_S => {
                self.late = None;
                self.usual_s = usual.min(turn);
                ((least + slack) / turn).floor().max(0.0) as u64
            }
            Some(_) => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Decoder;
    use super::*;

    const PERIOD: Duration = Duration::from_millis(5);

    /// A stream of bursts with value = number.
    fn stream(n: u16) -> Vec<u8> {
        let burst = |k: u16| {
            let top = 0xC0 | (k as u8 & 3) << 4;
            [0, 4, 8, 12].map(|shift| top | (k >> shift) as u8 & 15)
        };
        (0..n).flat_map(burst).collect()
    }

    /// Numbers and values of a stream of bytes, each with the time at which it came; and how many are unsure.
    fn numbered(bytes: &[(u8, Duration)], period: Option<Duration>) -> (Vec<(u64, u64)>, u64, u64) {
        let mut decoder = Decoder::default();
        decoder.expect(2);
        let mut count = Count::new(period);
        let mut found = Vec::new();
        let began = Instant::now();
        for &(byte, at) in bytes {
            decoder.take(&[byte], |answer, skipped| {
                let number = count.number(answer.counter, skipped, began + at);
                found.push((number, answer.word(0).unwrap_or(0).into()));
            });
        }
        (found, count.lost, count.unsure)
    }

    /// Bytes of bursts, each burst at its time and a delay.
    fn timed(n: u16, delay: impl Fn(u32) -> Duration) -> Vec<(u8, Duration)> {
        let of = |(place, byte): (usize, u8)| {
            let burst = place as u32 / 4;
            (byte, PERIOD * burst + delay(burst))
        };
        stream(n).into_iter().enumerate().map(of).collect()
    }

    fn at_once(bytes: &[u8]) -> Vec<(u8, Duration)> {
        bytes.iter().map(|&byte| (byte, Duration::ZERO)).collect()
    }

    #[test]
    fn a_lost_nibble_costs_its_burst_and_no_other() {
        let bytes = stream(12);
        for lost in 4..bytes.len() - 4 {
            let mut damaged = bytes.clone();
            damaged.remove(lost);
            let (found, lost, _) = numbered(&at_once(&damaged), None);
            assert_eq!((found.len(), lost), (11, 1));
            assert!(found.iter().all(|(n, value)| n == value), "{found:?}");
        }
    }

    #[test]
    fn many_bursts_of_rubbish_are_counted_by_their_bytes() {
        for (from, length) in [(8, 62), (9, 62), (11, 62), (17, 124), (4, 16), (5, 3)] {
            let mut bytes = stream(60);
            bytes[from..from + length].fill(0);
            let (found, ..) = numbered(&at_once(&bytes), None);
            assert!(found.iter().all(|(n, v)| n == v), "{from} {length}");
            let whole = 60 - (from + length).div_ceil(4) + from / 4;
            assert_eq!(found.len(), whole);
        }
    }

    /// What the bytes get wrong the time gets right: any stretch cut out, or with bytes of others put in its place, in time or in
    /// the lumps of a USB converter.
    #[test]
    fn the_time_tells_how_many_turns_are_missing() {
        let lumps = |burst: u32| {
            let ms = 5 * burst;
            Duration::from_millis((ms.div_ceil(16) * 16 - ms).into())
        };
        for (name, delays) in [("in time", false), ("in lumps", true)] {
            for cut in 1..100 {
                // A head of one burst and a tail of another with the same counter make a burst: nothing tells that at once.
                let joins = |stray| stray == 0 && matches!(cut % 16, 0 | 15);
                for stray in [0, 1, 30].into_iter().filter(|stray| !joins(*stray)) {
                    let delay = |burst| if delays { lumps(burst) } else { Duration::ZERO };
                    let mut bytes = timed(200, delay);
                    // Not whole bursts: something shows.
                    let from = 4 * 80 + 1;
                    let at = bytes[from].1;
                    let put_in = std::iter::repeat_n((0, at), stray);
                    bytes.splice(from..from + cut, put_in);
                    let (found, lost, unsure) = numbered(&bytes, Some(PERIOD));
                    let wrong = found.iter().find(|(n, value)| n != value);
                    assert_eq!(wrong, None, "{name}, {cut} cut out, {stray} stray");
                    assert_eq!(lost + found.len() as u64, 200);
                    // The bytes alone would have said something else by at most so much.
                    assert!(unsure <= (cut + stray) as u64 + 4, "{unsure}");
                }
            }
        }
    }

    /// Whole turns without a trace show in nothing but that everything is late from then on: counted late, and said to be unsure.
    #[test]
    fn whole_turns_without_a_trace_are_counted_once_they_are_sure() {
        for turns in 1..6 {
            let mut bytes = timed(400, |_| Duration::ZERO);
            bytes.drain(4 * 100..4 * 100 + 16 * turns);
            let (found, lost, unsure) = numbered(&bytes, Some(PERIOD));
            let missing = 4 * turns as u64;
            assert_eq!((lost, unsure), (missing, missing));
            assert_eq!(found.last(), Some(&(399, 399)));
        }
    }

    /// A host that was away for a while has lost nothing, and neither has a sensor that is slower than it says.
    #[test]
    fn late_bursts_are_not_lost_ones() {
        for away_ms in [10_u32, 21, 100, 400] {
            let away = |burst: u32| match burst {
                100.. if 5 * burst < 500 + away_ms => {
                    Duration::from_millis((500 + away_ms - 5 * burst).into())
                }
                _ => Duration::ZERO,
            };
            let (found, lost, unsure) = numbered(&timed(400, away), Some(PERIOD));
            assert_eq!((found.len(), lost, unsure), (400, 0, 0), "{away_ms} ms");
        }
        for per_mille in [-5_i32, 1, 5, 300] {
            let bytes: Vec<(u8, Duration)> = timed(4000, |_| Duration::ZERO)
                .into_iter()
                .map(|(byte, at)| (byte, at.mul_f64(1.0 + f64::from(per_mille) / 1000.0)))
                .collect();
            let (_, lost, unsure) = numbered(&bytes, Some(PERIOD));
            assert_eq!((lost, unsure), (0, 0), "{per_mille} per mille");
        }
    }
}

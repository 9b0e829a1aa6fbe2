//! Sensors of single points: what their drivers share. Numbered values become the columns of profiles.
//!
//! With `columns = 1` every value is a profile of its own: the sensor stands, the part passes. With more, the sensor travels
//! along x, one value every `pitch_mm`, and so many values in a row are one profile; a value that is missing is a column in
//! which nothing was seen. In either case [`Losses`] counts values.
//!
//! A counter of n bits wraps, and a line without a check may have turned one of its bits over. [`Sequencer`] therefore believes
//! a jump only when the value after it confirms it.

use std::collections::VecDeque;
use std::time::Instant;

use crate::capture::Profile;
use crate::device::Losses;
use crate::settings::Keys;

/// How values lie side by side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    /// Values in a profile.
    pub columns: u32,
    /// From one value to the next along x, mm.
    pub pitch_mm: f64,
    /// x of the first value, mm.
    pub first_mm: f64,
    /// Encoder counts from one value to the next, where the axis' encoder triggers the sensor.
    pub encoder_step: Option<i64>,
}

impl Layout {
    /// Every value a profile of its own, at x = 0.
    pub const SINGLE: Layout = Layout {
        columns: 1,
        pitch_mm: 0.0,
        first_mm: 0.0,
        encoder_step: None,
    };

    /// Reads `columns`, `pitch_mm`, `first_mm` and `encoder_step`.
    pub fn read(keys: &mut Keys) -> Layout {
        // The range fits.
        let columns = keys.integer("columns", 1..=65_536).unwrap_or(1) as u32;
        let pitch = keys.number("pitch_mm", -100.0..=100.0);
        let first_mm = keys.number("first_mm", -10_000.0..=10_000.0).unwrap_or(0.0);
        let encoder_step = keys.integer("encoder_step", -1_000_000..=1_000_000);
        if columns > 1 && pitch.is_none_or(|pitch| pitch == 0.0) {
            keys.wrong("columns", columns, "pitch_mm beside it, not 0");
        }
        if columns > 1 && encoder_step.is_some() {
            let expected = "none, where a profile has several values of its own";
            keys.wrong("encoder_step", "given", expected);
        }
        Layout {
            columns,
            pitch_mm: pitch.unwrap_or(0.0),
            first_mm,
            encoder_step,
        }
    }
}

/// One value of a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Value {
    /// mm; `NaN` where nothing was seen.
    pub z_mm: f64,
    /// Brightness, where the sensor sends it.
    pub intensity: Option<u16>,
    /// The sensor's own clock, ns; 0 where it has none.
    pub device_time_ns: u64,
    /// When it arrived.
    pub host_time: Instant,
}

/// Puts numbered values into profiles, and keeps the account.
#[derive(Debug)]
pub struct Rows {
    layout: Layout,
    row: Option<Profile>,
    done: VecDeque<Profile>,
    /// Values received, lost, dropped and rejected.
    pub losses: Losses,
}

impl Rows {
    /// Nothing received yet.
    pub fn new(layout: Layout) -> Rows {
        Rows {
            layout,
            row: None,
            done: VecDeque::new(),
            losses: Losses::default(),
        }
    }

    /// Takes value `number` of the run, from 0; numbers only grow.
    pub fn take(&mut self, number: u64, value: Value) {
        self.losses.received += 1;
        let columns = u64::from(self.layout.columns);
        // Wraps after four thousand million profiles, as every sequence number here.
        let sequence = (number / columns) as u32;
        if self
            .row
            .as_ref()
            .is_some_and(|row| row.sequence != sequence)
        {
            self.finish();
        }
        let layout = &self.layout;
        let dropped = u32::try_from(self.losses.dropped_by_device).unwrap_or(u32::MAX);
        let row = self.row.get_or_insert_with(|| {
            let n = layout.columns as usize;
            let x = |i: u32| layout.first_mm + f64::from(i) * layout.pitch_mm;
            let step = |step: i64| step.saturating_mul(i64::try_from(number).unwrap_or(i64::MAX));
            Profile {
                sequence,
                boot: 0,
                device_time_ns: value.device_time_ns,
                encoder: layout.encoder_step.map(step),
                host_time: value.host_time,
                dropped,
                saturated: false,
                x_mm: (0..layout.columns).map(x).collect(),
                z_mm: vec![f64::NAN; n],
                intensity: match value.intensity {
                    Some(_) => vec![0; n],
                    None => Vec::new(),
                },
            }
        });
        let column = (number % columns) as usize;
        row.z_mm[column] = value.z_mm;
        if let (Some(slot), Some(light)) = (row.intensity.get_mut(column), value.intensity) {
            *slot = light;
        }
        row.host_time = value.host_time;
        row.dropped = dropped;
        if column + 1 == layout.columns as usize {
            self.finish();
        }
    }

    /// Ends the row under way.
    pub fn finish(&mut self) {
        self.done.extend(self.row.take());
    }

    /// The oldest profile.
    pub fn pop(&mut self) -> Option<Profile> {
        self.done.pop_front()
    }
}

/// Gives values their numbers in the run by a counter of some bits, and tells jumps from damage.
#[derive(Debug)]
pub struct Sequencer<T> {
    period: u64,
    /// Values a second, where they come by time.
    rate_hz: Option<f64>,
    /// Number that comes next where nothing is lost; none before the first two.
    next: Option<u64>,
    /// When the last value came that was believed.
    last: Option<Instant>,
    /// Number of the first value, and when it came.
    first: Option<(u64, Instant)>,
    held: Option<(u64, Instant, T)>,
    /// Values missing between those that came.
    pub lost: u64,
    /// Values thrown away because their number fits nothing.
    pub rejected: u64,
    /// The counter went back: the sensor started anew.
    pub restarted: bool,
}

impl<T> Sequencer<T> {
    /// A counter of `bits` bits, 2 to 32.
    pub fn new(bits: u32, rate_hz: Option<f64>) -> Sequencer<T> {
        Sequencer {
            period: 1 << bits,
            rate_hz,
            next: None,
            last: None,
            first: None,
            held: None,
            lost: 0,
            rejected: 0,
            restarted: false,
        }
    }

    /// Takes a value with the counter as it came; `each` gets what is believed, with its number, in order.
    pub fn take(&mut self, raw: u32, at: Instant, item: T, mut each: impl FnMut(u64, T)) {
        let raw = u64::from(raw) % self.period;
        let Some((held, held_at, held_item)) = self.held.take() else {
            return self.judge(raw, at, item, &mut each);
        };
        let ahead = self.next.map_or(0, |next| self.ahead(held, next));
        let follows = self.ahead(raw, held + 1);
        let half = self.period / 2;
        if self.next.is_some() && follows == 0 && self.goes_back(ahead, held_at) {
            self.restarted = true;
            return;
        }
        if follows < half && !self.goes_back(ahead, held_at) {
            let next = self.next.unwrap_or(held);
            let gap = ahead + self.whole_periods(ahead, held_at);
            self.lost += gap;
            each(next + gap, held_item);
            self.next = Some(next + gap + 1);
            self.last = Some(held_at);
            self.first = self.first.or(Some((next + gap, held_at)));
        } else {
            self.rejected += 1;
            self.lost += u64::from(self.next.is_none());
        }
        self.judge(raw, at, item, &mut each);
    }

    /// Believes what follows in order, and holds everything else until the next value.
    fn judge(&mut self, raw: u64, at: Instant, item: T, each: &mut impl FnMut(u64, T)) {
        match self.next {
            Some(next) if self.ahead(raw, next) == 0 && self.whole_periods(0, at) == 0 => {
                each(next, item);
                self.next = Some(next + 1);
                self.last = Some(at);
            }
            _ => self.held = Some((raw, at, item)),
        }
    }

    /// The end of the run: what is held is believed where it lies ahead.
    pub fn finish(&mut self, mut each: impl FnMut(u64, T)) {
        let Some((held, at, item)) = self.held.take() else {
            return;
        };
        let next = self.next.unwrap_or(held);
        let ahead = self.ahead(held, next);
        if !self.goes_back(ahead, at) {
            let gap = ahead + self.whole_periods(ahead, at);
            self.lost += gap;
            each(next + gap, item);
            self.next = Some(next + gap + 1);
        } else {
            self.rejected += 1;
        }
    }

    fn ahead(&self, raw: u64, of: u64) -> u64 {
        (raw + self.period - of % self.period) % self.period
    }

    /// Values that should have come since the last one, by the clock of the host.
    fn expected_since(&self, at: Instant) -> Option<f64> {
        let since = at.saturating_duration_since(self.last?).as_secs_f64();
        Some(since * self.rate_hz?)
    }

    /// A jump back, or one ahead of what the whole run had time for: bytes may wait for a busy host, but never come early. A second
    /// is granted for those that waited before the first value was read.
    fn goes_back(&self, ahead: u64, at: Instant) -> bool {
        let half = self.period / 2;
        let (Some(expected), Some(rate)) = (self.expected_since(at), self.rate_hz) else {
            return ahead >= half;
        };
        if expected > half as f64 {
            // It may stand anywhere by now.
            return false;
        }
        let (Some(next), Some((first, began))) = (self.next, self.first) else {
            return ahead >= half;
        };
        let time_s = at.saturating_duration_since(began).as_secs_f64();
        let all = (next + ahead).saturating_sub(first) as f64;
        ahead >= half || all > (1.1 * time_s + 1.0) * rate
    }

    /// Values of whole turns of the counter that went by unseen.
    fn whole_periods(&self, ahead: u64, at: Instant) -> u64 {
        let expected = self.expected_since(at).unwrap_or(0.0);
        let turns = ((expected - ahead as f64) / self.period as f64).round();
        turns.max(0.0) as u64 * self.period
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// What comes of these counters, 1 ms apart: numbers, lost, rejected.
    fn numbers(bits: u32, raws: &[u32]) -> (Vec<u64>, u64, u64, bool) {
        let mut sequencer = Sequencer::new(bits, Some(1000.0));
        let began = Instant::now();
        let mut out = Vec::new();
        for (i, &raw) in raws.iter().enumerate() {
            let at = began + Duration::from_millis(i as u64);
            sequencer.take(raw, at, raw, |number, _| out.push(number));
        }
        sequencer.finish(|number, _| out.push(number));
        let Sequencer {
            lost,
            rejected,
            restarted,
            ..
        } = sequencer;
        (out, lost, rejected, restarted)
    }

    #[test]
    fn gaps_are_counted_and_wraps_are_none() {
        let found = numbers(18, &[262_142, 262_143, 0, 1, 4, 5]);
        let n = 262_142;
        assert_eq!(
            found,
            (vec![n, n + 1, n + 2, n + 3, n + 6, n + 7], 2, 0, false)
        );
    }

    #[test]
    fn one_number_with_a_bit_turned_over_is_damage_and_no_jump() {
        for bit in 0..18 {
            let found = numbers(18, &[8, 9, 10 ^ (1 << bit), 11, 12]);
            assert_eq!(found, (vec![8, 9, 11, 12], 1, 1, false), "bit {bit}");
        }
    }

    #[test]
    fn a_counter_that_begins_again_is_a_restart() {
        assert!(numbers(18, &[70_000, 70_001, 0, 1, 2]).3);
        assert!(
            numbers(18, &[200_000, 200_001, 0, 1]).3,
            "no time went by for 62143 lost"
        );
        assert!(!numbers(18, &[100, 101, 900, 901]).3);
    }

    #[test]
    fn a_gap_of_more_than_a_turn_is_counted_by_time() {
        let mut sequencer = Sequencer::new(4, Some(1000.0));
        let began = Instant::now();
        let mut out = Vec::new();
        for (ms, raw) in [(0, 0), (1, 1), (42, 42 % 16), (43, 43 % 16)] {
            let at = began + Duration::from_millis(ms);
            sequencer.take(raw, at, (), |number, ()| out.push(number));
        }
        assert_eq!((out, sequencer.lost), (vec![0, 1, 42, 43], 40));
    }

    #[test]
    fn values_make_rows_and_a_missing_one_stays_missing() {
        let layout = Layout {
            columns: 3,
            pitch_mm: 0.5,
            first_mm: 10.0,
            encoder_step: None,
        };
        let mut rows = Rows::new(layout);
        let value = |z_mm| Value {
            z_mm,
            intensity: None,
            device_time_ns: 7,
            host_time: Instant::now(),
        };
        for (number, z) in [(0, 1.0), (2, 3.0), (3, 4.0), (9, 5.0)] {
            rows.take(number, value(z));
        }
        rows.finish();
        let mut told = Vec::new();
        while let Some(row) = rows.pop() {
            assert_eq!(row.x_mm, [10.0, 10.5, 11.0]);
            told.push((row.sequence, format!("{:?}", row.z_mm)));
        }
        let expected = [
            (0, "[1.0, NaN, 3.0]"),
            (1, "[4.0, NaN, NaN]"),
            (3, "[5.0, NaN, NaN]"),
        ];
        assert_eq!(told, expected.map(|(n, z)| (n, z.to_owned())));
        assert_eq!(rows.losses.received, 4);
    }
}

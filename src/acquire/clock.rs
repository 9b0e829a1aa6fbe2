//! A device's clock against the host's: offset and drift, from receipts that are late by an unknown, never negative delay.
//!
//! The host sees each capture some time after the device stamped it: transmission, buffers, a busy scheduler. The line under all
//! receipts, which the least delayed ones touch, is therefore the relation of the clocks; a mean would follow the delays.

/// How a device's clock runs by the host's: `host = offset + rate * device`, both in seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockFit {
    /// Host time at device time 0, s, the least delay included.
    pub offset_s: f64,
    /// Host seconds a device second: 1 plus the drift.
    pub rate: f64,
    /// Largest and median receipt above the line, s: the delays beyond the least one.
    pub delay_s: [f64; 2],
}

impl ClockFit {
    /// Host time of a device time, s.
    pub fn host(&self, device_s: f64) -> f64 {
        self.offset_s + self.rate * device_s
    }

    /// Device time of a host time, s.
    pub fn device(&self, host_s: f64) -> f64 {
        (host_s - self.offset_s) / self.rate
    }

    /// Drift in parts per million: plus = the device's clock is slow.
    pub fn drift_ppm(&self) -> f64 {
        1e6 * (self.rate - 1.0)
    }
}

/// Crystals agree within a few hundred ppm; a faster drift is a wrong unit of time.
const RATE_MAX: f64 = 0.01;

/// The line under `receipts` (device time, host time; s) that is nearest to them on the average: an edge of their lower convex hull.
///
/// `None` for fewer than two device times, times that are no numbers, or clocks that run apart by more than a per cent.
pub fn fit_clock(receipts: &[(f64, f64)]) -> Option<ClockFit> {
    let mut sorted: Vec<(f64, f64)> = receipts
        .iter()
        .copied()
        .filter(|(d, h)| d.is_finite() && h.is_finite())
        .collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    sorted.dedup_by(|later, first| later.0 == first.0);
    let mean = sorted.iter().map(|r| r.0).sum::<f64>() / sorted.len().max(1) as f64;
    let hull = lower_hull(&sorted);
    // The sum of the distances to a supporting line is smallest on the edge of the hull over the mean.
    let edge = hull
        .windows(2)
        .find(|edge| edge[0].0 <= mean && mean <= edge[1].0)?;
    let rate = (edge[1].1 - edge[0].1) / (edge[1].0 - edge[0].0);
    if (rate - 1.0).abs() > RATE_MAX {
        return None;
    }
    let offset_s = edge[0].1 - rate * edge[0].0;
    let mut delays: Vec<f64> = receipts
        .iter()
        .map(|(d, h)| h - offset_s - rate * d)
        .filter(|delay| delay.is_finite())
        .collect();
    delays.sort_by(f64::total_cmp);
    Some(ClockFit {
        offset_s,
        rate,
        delay_s: [*delays.last()?, delays[delays.len() / 2]],
    })
}

/// Andrew's monotone chain, lower half, of points sorted by their first coordinate.
fn lower_hull(sorted: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut hull: Vec<(f64, f64)> = Vec::new();
    for p in sorted {
        while let [.., a, b] = hull[..] {
            let turn = (b.0 - a.0) * (p.1 - a.1) - (b.1 - a.1) * (p.0 - a.0);
            if turn > 0.0 {
                break;
            }
            hull.pop();
        }
        hull.push(*p);
    }
    hull
}

/// A counter of few bits made whole: the difference of two readings modulo 2^bits, taken as signed.
///
/// Right as long as the true change between two *received* readings stays below half of the range; after a longer gap the place is
/// unknown, and whoever counts the gap must start anew ([`Unwrap::restart`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unwrap {
    bits: u32,
    last: Option<u64>,
    whole: i64,
}

impl Unwrap {
    /// For a counter of `bits` bits, 1 to 64; more are taken as 64.
    pub fn new(bits: u32) -> Self {
        Self {
            bits: bits.clamp(1, 64),
            last: None,
            whole: 0,
        }
    }

    /// The whole count at a reading; the first reading counts as itself, signed.
    pub fn push(&mut self, reading: u64) -> i64 {
        let mask = u64::MAX >> (64 - self.bits);
        let reading = reading & mask;
        let from = self.last.unwrap_or(0);
        let difference = reading.wrapping_sub(from) & mask;
        let negative = difference >> (self.bits - 1) == 1;
        let signed = if negative {
            (difference | !mask) as i64
        } else {
            difference as i64
        };
        self.whole = match self.last {
            // A counter that stands high at the first reading stands there; only motion has a sign.
            None => reading as i64,
            Some(_) => self.whole.wrapping_add(signed),
        };
        self.last = Some(reading);
        self.whole
    }

    /// Forgets where the counter was.
    pub fn restart(&mut self) {
        *self = Self::new(self.bits);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn drift_is_found_under_delays_that_only_ever_add() {
        // 37 ppm slow, offset 12.5 s; delays of 0.3 ms and more, in a fixed zigzag with outliers of half a second.
        let receipts: Vec<(f64, f64)> = (0..2000)
            .map(|k| {
                let device = 0.01 * f64::from(k);
                let delay = match k % 10 {
                    0 => 0.0003,
                    9 if k % 170 == 9 => 0.5,
                    m => 0.0003 + 0.0011 * f64::from(m * 7 % 10),
                };
                (device, 12.5 + 1.000_037 * device + delay)
            })
            .collect();
        let fit = fit_clock(&receipts).expect("two thousand receipts");
        assert!((fit.drift_ppm() - 37.0).abs() < 0.01, "{fit:?}");
        assert!((fit.offset_s - 12.5003).abs() < 1e-7, "{fit:?}");
        assert!((fit.delay_s[0] - 0.4997).abs() < 1e-6);
        assert!((fit.host(10.0) - (12.5003 + 10.000_37)).abs() < 1e-6);
    }

    #[test]
    fn what_is_no_clock_gives_none() {
        assert_eq!(fit_clock(&[]), None);
        assert_eq!(fit_clock(&[(1.0, 2.0)]), None);
        assert_eq!(fit_clock(&[(1.0, 2.0), (1.0, 3.0)]), None);
        assert_eq!(fit_clock(&[(0.0, 0.0), (1.0, 2.0)]), None, "twice as fast");
        assert_eq!(fit_clock(&[(f64::NAN, 0.0), (1.0, f64::INFINITY)]), None);
    }

    #[test]
    fn a_sixteen_bit_counter_goes_on_past_its_end_in_either_direction() {
        let mut unwrap = Unwrap::new(16);
        assert_eq!(unwrap.push(65_530), 65_530);
        assert_eq!(unwrap.push(4), 65_540);
        assert_eq!(unwrap.push(65_000), 65_000);
        unwrap.restart();
        assert_eq!(unwrap.push(3), 3);
    }

    proptest! {
        #[test]
        fn steps_below_half_the_range_are_followed_exactly(
            bits in 2u32..=64,
            steps in proptest::collection::vec(any::<i64>(), 1..50),
        ) {
            let half = 1i128 << (bits - 1);
            let modulus = 1i128 << bits;
            let mut unwrap = Unwrap::new(bits);
            prop_assert_eq!(unwrap.push(0), 0);
            let mut truth: i128 = 0;
            for step in steps {
                // Into -half+1 ..= half-1.
                let step = i128::from(step).rem_euclid(2 * half - 1) - half + 1;
                let next = truth + step;
                if next.abs() > i128::from(i64::MAX) {
                    continue;
                }
                truth = next;
                let reading = truth.rem_euclid(modulus) as u64;
                prop_assert_eq!(i128::from(unwrap.push(reading)), truth);
            }
        }
    }
}

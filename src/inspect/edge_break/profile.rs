//! The profile of an edge without a model: mean heights over each flank in bins, and the extremes that they show.

use std::ops::Range;

use super::fit::Shape;
use super::{Form, Quantified, Zone};
use crate::geometry::fit::{mad_sigma, median};
use crate::inspect::monte_carlo::Draws;

/// Bins on each flank, at most.
const BINS: f64 = 28.0;

/// Points that a bin should hold: its mean then is known to a quarter of the noise.
const COUNT: f64 = 15.0;

/// Fewest points of a bin that counts.
const COUNT_MIN: f64 = 5.0;

/// Standard uncertainties at which a bin lies off a flank: 56 bins are asked, so that a false alarm is rare.
const LEFT: f64 = 4.0;

/// Bins of a plateau up to which its ends count for much.
const FEW: usize = 4;

/// A shape is refused where a bin lies off it by this much of the noise of one point: less is form, and no burr or notch.
const OFF_SHAPE: f64 = 1.5;

#[derive(Debug, Clone, Copy, Default)]
struct Bin {
    count: f64,
    height: f64,
    u: f64,
}

impl Bin {
    fn counts(&self) -> bool {
        self.count >= COUNT_MIN
    }
}

/// Mean heights along both flanks, from the virtual edge.
pub(super) struct Profile {
    width: f64,
    sides: [Vec<Bin>; 2],
    turn: f64,
}

/// Where a point lies along the flank that it is nearer to: (side, distance from the virtual edge).
fn place(d: [f64; 2], turn: f64) -> (usize, f64) {
    let side = usize::from(d[1] > d[0]);
    (side, (-d[1 - side] / turn.sin()).max(0.0))
}

impl Profile {
    pub(super) fn new(zone: &Zone<'_>) -> Self {
        let reach = zone.reach[0].max(zone.reach[1]);
        // The stations of a stretch put points at all distances, so that bins may be finer than the spacing.
        let density = zone.points.len() as f64 / (zone.reach[0] + zone.reach[1]);
        let width = (reach / BINS).max(COUNT / density);
        let mut profile = Self {
            width,
            sides: [Vec::new(), Vec::new()],
            turn: zone.turn,
        };
        let values = profile.collect(zone, |d, side, _| d[side]);
        profile.sides = [0, 1].map(|i| {
            let bins = values[i].iter().enumerate();
            bins.map(|(k, v)| zone.bin(i, (k as f64 + 0.5) * width, v))
                .collect()
        });
        profile
    }

    fn collect(
        &self,
        zone: &Zone<'_>,
        value: impl Fn([f64; 2], usize, f64) -> f64,
    ) -> [Vec<Vec<f64>>; 2] {
        let mut values = zone
            .reach
            .map(|r| vec![Vec::new(); (r / self.width).ceil().max(1.0) as usize]);
        for p in &zone.points {
            let turn = zone.turns[p.wedge];
            let (side, along) = place(p.d, turn);
            let last = values[side].len() - 1;
            let bin = ((along / self.width) as usize).min(last);
            values[side][bin].push(value(p.d, side, turn));
        }
        values
    }

    /// Whether some bin lies off `shape` by more than noise and form.
    pub(super) fn departs_from(&self, zone: &Zone<'_>, shape: &Shape) -> bool {
        let values = self.collect(zone, |d, _, turn| shape.distance(d, turn));
        (0..2).any(|i| {
            values[i].iter().enumerate().any(|(k, v)| {
                let bin = zone.bin(i, (k as f64 + 0.5) * self.width, v);
                bin.counts() && bin.height.abs() > (LEFT * bin.u).max(OFF_SHAPE * zone.sigma)
            })
        })
    }

    /// The bins that make up the largest height over a flank, `sign` 1, or depth, `sign` -1, and their mean height: the extreme bin and its
    /// neighbours that cannot be told from it. `None` where no bin is significantly off the flank.
    fn plateau(&self, side: usize, sign: f64) -> Option<(Range<usize>, f64)> {
        let bins = &self.sides[side];
        let best = self.best(side, sign)?;
        let top = bins[best];
        if sign * top.height <= LEFT * top.u {
            return None;
        }
        let alike = |k: &usize| {
            let bin = bins[*k];
            bin.counts() && (bin.height - top.height).abs() <= 2.0 * bin.u.hypot(top.u)
        };
        let up = (best + 1..bins.len()).take_while(alike).count();
        let down = (0..best).rev().take_while(alike).count();
        let chosen = best - down..best + up + 1;
        let (mut weight, mut sum) = (0.0, 0.0);
        for bin in &bins[chosen.clone()] {
            weight += bin.u.powi(-2);
            sum += bin.height * bin.u.powi(-2);
        }
        Some((chosen, sum / weight))
    }

    /// The extreme bin.
    fn best(&self, side: usize, sign: f64) -> Option<usize> {
        let bins = &self.sides[side];
        (0..bins.len())
            .filter(|k| bins[*k].counts())
            .max_by(|a, b| (sign * bins[*a].height).total_cmp(&(sign * bins[*b].height)))
    }

    /// The largest height over each flank, `sign` 1, or depth, `sign` -1; 0 where none is significant.
    fn extreme(&self, side: usize, sign: f64) -> Quantified {
        let bins = &self.sides[side];
        let Some(best) = self.best(side, sign) else {
            return Quantified {
                value: 0.0,
                u: self.width,
            };
        };
        let Some((chosen, mean)) = self.plateau(side, sign) else {
            return Quantified {
                value: 0.0,
                u: bins[best].u,
            };
        };
        // How far the plateau lies below its own best bin shows what bins half on a wall take away, and luck adds. Of a few bins the ends,
        // which are such, are a large part.
        let share = if chosen.len() <= FEW { 1.0 } else { 0.5 };
        let weight: f64 = bins[chosen].iter().map(|bin| bin.u.powi(-2)).sum();
        let fall = share * (bins[best].height - mean);
        Quantified {
            value: sign * mean,
            u: weight.sqrt().recip().hypot(fall),
        }
    }

    /// The excess with new noise on every bin: bins of the plateau are drawn about its mean, the others about what they show.
    pub(super) fn excess_again(&self, draws: &mut Draws) -> [Quantified; 2] {
        let mut drawn = Self {
            sides: self.sides.clone(),
            ..*self
        };
        for (side, bins) in drawn.sides.iter_mut().enumerate() {
            let plateau = self.plateau(side, 1.0);
            let level = plateau.as_ref().map(|p| p.1);
            for (k, bin) in bins.iter_mut().enumerate().filter(|(_, b)| b.counts()) {
                if let (Some((chosen, _)), Some(level)) = (&plateau, level)
                    && chosen.contains(&k)
                {
                    bin.height = level;
                }
                bin.height += bin.u * draws.normal();
            }
        }
        drawn.excess()
    }

    /// Excess over each flank.
    pub(super) fn excess(&self) -> [Quantified; 2] {
        [0, 1].map(|i| self.extreme(i, 1.0))
    }

    /// Where the profile leaves a flank, seen from outside: the far end of the outermost bin off it (`sign` 0: either way).
    fn detachment(&self, side: usize, sign: f64) -> Option<Quantified> {
        let left = |bin: &Bin| {
            let off = if sign == 0.0 {
                bin.height.abs()
            } else {
                sign * bin.height
            };
            bin.counts() && off > LEFT * bin.u
        };
        let k = self.sides[side].iter().rposition(left)?;
        // The profile may leave in this bin or in the next, where too few points of the next show it.
        Some(Quantified {
            value: (k as f64 + 0.5) * self.width,
            u: self.width / 3f64.sqrt(),
        })
    }

    /// The sizes of a shape that no model holds.
    pub(super) fn form(&self) -> Form {
        let nothing = Quantified {
            value: 0.0,
            u: self.width / 12f64.sqrt(),
        };
        let (sin, cos) = (0.5 * self.turn).sin_cos();
        let mut highest = ([0.0, f64::MIN], 0.0);
        for (i, bins) in self.sides.iter().enumerate() {
            let side = if i == 0 { 1.0 } else { -1.0 };
            for (k, bin) in bins.iter().enumerate().filter(|(_, b)| b.counts()) {
                let along = k as f64 * self.width;
                let up = -along * sin + bin.height * cos;
                if up > highest.0[1] {
                    highest = ([side * (along * cos + bin.height * sin), up], bin.u);
                }
            }
        }
        let missing = [0, 1].map(|i| {
            let depth = self.extreme(i, -1.0);
            // What the other flank lacks is missing below this one.
            let other = self.detachment(1 - i, -1.0).map(|q| Quantified {
                value: q.value * self.turn.sin(),
                u: q.u * self.turn.sin(),
            });
            match other {
                Some(o) if o.value - 2.0 * o.u > depth.value || depth.value == 0.0 => o,
                _ => depth,
            }
        });
        Form {
            detachment: [0, 1].map(|i| self.detachment(i, 0.0).unwrap_or(nothing)),
            truncation: Quantified {
                value: -highest.0[1].max(-1e9),
                u: highest.1.hypot(nothing.u * sin),
            },
            excess: self.excess(),
            missing,
            highest: highest.0,
        }
    }
}

impl Zone<'_> {
    /// Mean of the values of a bin at `along` on flank `side`, trimmed, with the flank's own uncertainty there.
    fn bin(&self, side: usize, along: f64, values: &[f64]) -> Bin {
        if values.is_empty() {
            return Bin::default();
        }
        let middle = median(&mut values.to_vec());
        let off: Vec<f64> = values.iter().map(|v| v - middle).collect();
        let sigma = mad_sigma(&off).max(self.sigma);
        let kept: Vec<f64> = values
            .iter()
            .copied()
            .filter(|v| (v - middle).abs() <= 3.5 * sigma)
            .collect();
        let n = kept.len().max(1) as f64;
        let flank = self.stretch.wedges.iter().map(|w| {
            let c = &w.flanks[side].covariance;
            c[0][0] + 2.0 * along * c[0][1] + along * along * c[1][1]
        });
        let stations = self.stretch.wedges.len() as f64;
        let shared = flank.sum::<f64>() / (stations * stations) * self.stretch.shared_factor[side];
        Bin {
            count: kept.len() as f64,
            height: kept.iter().sum::<f64>() / n,
            u: (sigma * sigma / n + shared).sqrt(),
        }
    }
}

//! Where the transition zone of an edge ends: edge break, spot smear and mixed points all leave the flank there.

use super::variance::{self, Noise};
use super::{FlankPoints, FlankSettings, Memo, Range, WindowFit, Windows, row};

/// Standard deviations of a bin's mean at which it has left the flank: 4 bins, 4 levels and two sides give a false
/// alarm at one block in 130, and a false alarm costs a few points only.
const LEFT: f64 = 3.5;

/// Stations that are judged together.
const BLOCK: usize = 5;

/// Bins a level.
const BINS: usize = 4;

/// The inner end of the usable flank at one station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cut {
    /// Distance from the nominal edge, mm.
    pub(super) cut_mm: f64,
    /// Whether the transition seems to go on beyond half of the reach.
    pub(super) too_wide: bool,
}

/// The cut of every station; `None` where nothing could be fitted.
///
/// Walks inwards: the flank is fitted from the cut to the reach and extrapolated over the next inner half; the residuals
/// there are averaged in bins, over blocks of stations. The first bin whose mean lies outside the noise ends the
/// walk. A rounded edge leaves its flank like `(T - r)^2 / 2T`, so the detachment point T lies
/// further out than the first significant bin by what the noise hides, and the cut is moved there. Form deviation of
/// the flank itself counts as noise: what is as large further out is no transition.
pub(super) fn find_cuts<const P: usize>(
    points: &FlankPoints,
    windows: &Windows,
    settings: &FlankSettings,
    memo: &mut Memo,
) -> Vec<Option<Cut>> {
    let blocks = windows.count.div_ceil(BLOCK);
    let walks: Vec<Walk> = (0..blocks)
        .map(|b| {
            let stations = b * BLOCK..((b + 1) * BLOCK).min(windows.count);
            walk::<P>(points, windows, settings, (stations, memo))
        })
        .collect();
    let common = common_cut(&walks).min(0.6 * settings.reach_mm);
    (0..windows.count)
        .map(|k| {
            let block = k / BLOCK;
            // A transition that widens along the edge shows in the neighbouring block first.
            let near = &walks[block.saturating_sub(1)..(block + 2).min(blocks)];
            let own = walks[block].cut?;
            let widest = near
                .iter()
                .filter_map(|w| w.cut)
                .map(|c| c.cut_mm)
                .fold(0.0, f64::max);
            Some(Cut {
                cut_mm: own.cut_mm.max(widest.min(2.0 * own.cut_mm)).max(common),
                ..own
            })
        })
        .collect()
}

/// What one block's way inwards showed.
#[derive(Debug, Clone, Default)]
struct Walk {
    cut: Option<Cut>,
    /// Every bin on the way, from outside to inside. The places are the same for all blocks.
    seen: Vec<SeenBin>,
}

/// A bin on the way.
#[derive(Debug, Clone, Copy)]
struct SeenBin {
    /// Its outer end, mm.
    outer: f64,
    /// Its mean over its standard uncertainty.
    z: f64,
    /// That uncertainty, mm.
    u: f64,
}

/// The cut that the blocks of an edge show together: the smear of a spot is the same all along, and too small to be seen in one block
/// alone. No block counts for more than it would have to be left out itself. 0 where nothing shows.
fn common_cut(walks: &[Walk]) -> f64 {
    let longest = walks.iter().map(|w| w.seen.len()).max().unwrap_or(0);
    for k in 0..longest {
        let bins: Vec<&SeenBin> = walks
            .iter()
            .filter_map(|w| w.seen.get(k))
            .filter(|b| b.u > 0.0)
            .collect();
        let n = bins.len() as f64;
        let sum: f64 = bins.iter().map(|b| b.z.clamp(-LEFT, LEFT)).sum();
        if n >= 3.0 && sum.abs() > LEFT * n.sqrt() {
            let u = bins.iter().map(|b| b.u).sum::<f64>() / n;
            let hidden = LEFT * u / n.sqrt();
            return detachment(bins[0].outer, hidden);
        }
    }
    0.0
}

/// Where a rounded edge detaches whose departure reaches `hidden` at distance `first`, mm.
fn detachment(first: f64, hidden: f64) -> f64 {
    first + hidden + (hidden * hidden + 2.0 * first * hidden).sqrt()
}

fn walk<const P: usize>(
    points: &FlankPoints,
    windows: &Windows,
    settings: &FlankSettings,
    (stations, memo): (std::ops::Range<usize>, &mut Memo),
) -> Walk {
    let mut cut = 0.5 * settings.reach_mm;
    let mut any = false;
    let mut way = Walk::default();
    while cut > settings.cut_mm {
        let inner = (0.5 * cut).max(settings.cut_mm);
        let count = (((cut - inner) / settings.spacing_mm) as usize).clamp(1, BINS);
        let mut bins = Bins::new(inner, cut, count);
        let range = |k: usize| Range {
            centre: windows.centre(k),
            width: windows.step_mm,
            cut_mm: cut,
            reach_mm: settings.reach_mm,
        };
        let fits: Vec<(usize, WindowFit<P>)> = stations
            .clone()
            .filter_map(|k| {
                let fit = memo.fit(points, (windows, k), &range(k), settings);
                Some((k, fit.ok()?))
            })
            .collect();
        any |= !fits.is_empty();
        let noise = variance::pooled(fits.iter().map(|f| &f.1));
        for (k, window) in &fits {
            bins.take_in(points, &range(*k), window, &noise);
        }
        bins.note(&mut way.seen);
        if let Some((bin, hidden)) = bins.outermost_left() {
            let detached = detachment(bins.outer_end(bin), hidden);
            way.cut = Some(Cut {
                cut_mm: detached.min(0.6 * settings.reach_mm),
                too_wide: detached > 0.5 * settings.reach_mm,
            });
            return way;
        }
        cut = inner;
    }
    way.cut = any.then_some(Cut {
        cut_mm: settings.cut_mm,
        too_wide: false,
    });
    way
}

/// Mean residual of one bin over a block: sum, its variance, points.
#[derive(Debug, Clone, Copy, Default)]
struct Bin {
    sum: f64,
    variance: f64,
    count: f64,
}

struct Bins {
    inner: f64,
    outer: f64,
    bins: Vec<Bin>,
}

impl Bins {
    fn new(inner: f64, outer: f64, count: usize) -> Self {
        Self {
            inner,
            outer,
            bins: vec![Bin::default(); count],
        }
    }

    fn outer_end(&self, bin: usize) -> f64 {
        self.inner + (self.outer - self.inner) * (bin + 1) as f64 / self.bins.len() as f64
    }

    /// Adds one station's residuals against its flank beyond `range.cut_mm`.
    fn take_in<const P: usize>(
        &mut self,
        points: &FlankPoints,
        range: &Range,
        window: &WindowFit<P>,
        noise: &Noise,
    ) {
        let inside = Range {
            cut_mm: self.inner,
            reach_mm: self.outer,
            ..*range
        };
        let count = self.bins.len();
        let mut own = vec![(0.0, 0.0, [0.0; P]); count];
        let scale = count as f64 / (self.outer - self.inner);
        // Bounded, so that one outlier does not end the walk.
        let limit = 4.0 * window.sigma;
        for i in inside.indices(points) {
            let row = row::<P>(points.r[i], points.s[i] - range.centre);
            let bin = (((points.r[i] - self.inner) * scale) as usize).min(count - 1);
            own[bin].0 += (points.deviation[i] - window.fit.predict(&row)).clamp(-limit, limit);
            own[bin].1 += 1.0;
            for (sum, x) in own[bin].2.iter_mut().zip(row) {
                *sum += x;
            }
        }
        for (bin, (sum, n, rows)) in self.bins.iter_mut().zip(own) {
            bin.sum += sum;
            bin.count += n;
            bin.variance += noise.of_sum(n, &rows, window);
        }
    }

    /// Adds all bins to `seen`, from outside to inside.
    fn note(&self, seen: &mut Vec<SeenBin>) {
        for (k, bin) in self.bins.iter().enumerate().rev() {
            let spread = bin.variance.sqrt();
            let known = bin.count > 0.0 && spread > 0.0;
            seen.push(SeenBin {
                outer: self.outer_end(k),
                z: if known { bin.sum / spread } else { 0.0 },
                u: if known { spread / bin.count } else { 0.0 },
            });
        }
    }

    /// The outermost bin that has left the flank, and the deviation that its noise could hide, mm.
    fn outermost_left(&self) -> Option<(usize, f64)> {
        (0..self.bins.len()).rev().find_map(|k| {
            let bin = &self.bins[k];
            let u = bin.variance.sqrt();
            (bin.count > 0.0 && u > 0.0 && bin.sum.abs() > LEFT * u)
                .then(|| (k, LEFT * u / bin.count))
        })
    }
}

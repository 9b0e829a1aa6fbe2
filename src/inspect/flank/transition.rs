//! Where the transition zone of an edge ends: edge break, spot smear and mixed points all leave the flank there.

use super::variance::{self, Noise};
use super::{FlankPoints, FlankSettings, Range, WindowFit, Windows, fit_window, row};

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
) -> Vec<Option<Cut>> {
    let blocks = windows.count.div_ceil(BLOCK);
    let found: Vec<Option<Cut>> = (0..blocks)
        .map(|b| {
            let stations = b * BLOCK..((b + 1) * BLOCK).min(windows.count);
            walk::<P>(points, windows, settings, stations)
        })
        .collect();
    (0..windows.count)
        .map(|k| {
            let block = k / BLOCK;
            // A transition that widens along the edge shows in the neighbouring block first.
            let near = &found[block.saturating_sub(1)..(block + 2).min(blocks)];
            let own = found[block]?;
            let widest = near.iter().flatten().map(|c| c.cut_mm).fold(0.0, f64::max);
            Some(Cut {
                cut_mm: own.cut_mm.max(widest.min(2.0 * own.cut_mm)),
                ..own
            })
        })
        .collect()
}

fn walk<const P: usize>(
    points: &FlankPoints,
    windows: &Windows,
    settings: &FlankSettings,
    stations: std::ops::Range<usize>,
) -> Option<Cut> {
    let mut cut = 0.5 * settings.reach_mm;
    let mut seen = false;
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
            .filter_map(|k| Some((k, fit_window(points, &range(k), settings).ok()?)))
            .collect();
        seen |= !fits.is_empty();
        let noise = variance::pooled(fits.iter().map(|f| &f.1));
        for (k, window) in &fits {
            bins.take_in(points, &range(*k), window, &noise);
        }
        if let Some((bin, hidden)) = bins.outermost_left() {
            let first = bins.outer_end(bin);
            let detached = first + hidden + (hidden * hidden + 2.0 * first * hidden).sqrt();
            return Some(Cut {
                cut_mm: detached.min(0.6 * settings.reach_mm),
                too_wide: detached > 0.5 * settings.reach_mm,
            });
        }
        cut = inner;
    }
    seen.then_some(Cut {
        cut_mm: settings.cut_mm,
        too_wide: false,
    })
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

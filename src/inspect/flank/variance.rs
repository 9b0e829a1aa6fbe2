//! How uncertain a flank fit is: white noise, noise that the points of a scan line share, and lack of fit.
//!
//! Residuals are grouped, by scan line and by cells of the patch; a variance component for the groups is estimated by
//! the method of moments (Henderson's method 3), exact for the degrees of freedom that the fit has used up. Where the
//! component is significant it enters the covariance with its whole weight; where it is not, the noise is white.

use std::collections::BTreeMap;

use super::{Design, Series, WindowFit};
use crate::inspect::clusters::{Clusters, NO_GROUP, SIGNIFICANT, product};

/// Weight of the neighbouring stations' noise against the station's own, in degrees of freedom.
const PRIOR_FREEDOM: f64 = 30.0;

/// The noise at one station.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Noise {
    white: f64,
    line: f64,
    cell: f64,
    /// Whether the cells differ by more than noise.
    pub(super) lack_of_fit: bool,
}

impl Noise {
    /// Covariance of (offset, tilt).
    pub(super) fn covariance<const P: usize>(&self, window: &WindowFit<P>) -> [[f64; 2]; 2] {
        let full = self.full(window);
        [[full[0][0], full[0][1]], [full[1][0], full[1][1]]]
    }

    /// The fit's map from points to (offset, tilt), with the noise that [`Self::covariance`] holds, `form` times its variance.
    pub(super) fn design<const P: usize>(&self, window: &WindowFit<P>, form: f64) -> Design {
        let unit = |i: usize| std::array::from_fn(|k| if k == i { 1.0 } else { 0.0 });
        let of = |row: &[f64; P]| [0, 1].map(|i| product(&unit(i), &window.fit.cofactor, row));
        let shared = |component: f64, clusters: &Clusters<P>| {
            component
                * product(
                    &window.fit.cofactor[0],
                    &clusters.scatter,
                    &window.fit.cofactor[0],
                )
        };
        let by_line = shared(self.line, &window.lines) >= shared(self.cell, &window.cells);
        let component = if by_line { self.line } else { self.cell };
        let mut groups: BTreeMap<u32, [f64; 2]> = BTreeMap::new();
        let mut influence = Vec::with_capacity(window.used.len());
        for (row, line, cell) in &window.used {
            let own = of(row);
            influence.push(own);
            let group = if by_line { *line } else { *cell };
            if component > 0.0 && group != NO_GROUP {
                let sum = groups.entry(group).or_insert([0.0; 2]);
                sum[0] += own[0];
                sum[1] += own[1];
            }
        }
        Design {
            influence,
            groups: groups.into_iter().collect(),
            groups_are_lines: by_line,
            sigma_mm: [self.white, component].map(|v| (v * form).sqrt()),
        }
    }

    /// Covariance of all coefficients. Lines and cells overlap, so the larger of the two counts, not their sum.
    pub(super) fn full<const P: usize>(&self, window: &WindowFit<P>) -> [[f64; P]; P] {
        let cofactor = &window.fit.cofactor;
        let of = |component: f64, scatter: &[[f64; P]; P]| -> [[f64; P]; P] {
            std::array::from_fn(|i| {
                std::array::from_fn(|j| component * product(&cofactor[i], scatter, &cofactor[j]))
            })
        };
        let lines = of(self.line, &window.lines.scatter);
        let cells = of(self.cell, &window.cells.scatter);
        let larger = if lines[0][0] >= cells[0][0] {
            lines
        } else {
            cells
        };
        std::array::from_fn(|i| std::array::from_fn(|j| self.white * cofactor[i][j] + larger[i][j]))
    }

    /// Variance of the sum of `n` residuals, whose rows sum to `rows`, of points that the fit did not use.
    pub(super) fn of_sum<const P: usize>(
        &self,
        n: f64,
        rows: &[f64; P],
        window: &WindowFit<P>,
    ) -> f64 {
        self.white * n + self.cell * n * n + product(rows, &self.full(window), rows)
    }
}

/// The noise of several windows judged as one.
pub(super) fn pooled<'a, const P: usize>(windows: impl Iterator<Item = &'a WindowFit<P>>) -> Noise {
    let mut cells: Option<Clusters<P>> = None;
    let (mut square, mut freedom) = (0.0, 0.0);
    for window in windows {
        match &mut cells {
            Some(sum) => sum.merge(&window.cells),
            None => cells = Some(window.cells.clone()),
        }
        let own = (window.fit.used - P) as f64;
        square += own * window.sigma.powi(2);
        freedom += own;
    }
    let cell = cells.and_then(|c| c.components()).map_or(0.0, |c| c.1);
    Noise {
        white: square / freedom.max(1.0),
        line: 0.0,
        cell,
        lack_of_fit: cell > 0.0,
    }
}

/// The noise of every station, from its own residuals and its neighbours'.
///
/// The component of the scan lines is one for the whole flank; lack of fit is local and judged over five stations.
pub(super) fn estimate<const P: usize>(series: &Series<P>) -> Vec<Noise> {
    let mut lines: Option<Clusters<P>> = None;
    for window in series.iter().flatten() {
        match &mut lines {
            Some(sum) => sum.merge(&window.lines),
            None => lines = Some(window.lines.clone()),
        }
    }
    let line = lines.and_then(|l| l.components()).map_or(0.0, |c| c.1);
    (0..series.len())
        .map(|k| station_noise(series, k, line))
        .collect()
}

fn station_noise<const P: usize>(series: &Series<P>, k: usize, line: f64) -> Noise {
    let Ok(own) = &series[k] else {
        return Noise::default();
    };
    let near = series[k.saturating_sub(2)..(k + 3).min(series.len())]
        .iter()
        .flatten();
    let together = pooled(near);
    let freedom = (own.fit.used - P) as f64;
    let white =
        (freedom * own.sigma.powi(2) + PRIOR_FREEDOM * together.white) / (freedom + PRIOR_FREEDOM);
    // Judged together, and alone: a local dent must not hide among good neighbours.
    let alone = own.cells.components().map_or(0.0, |c| c.1);
    let component = together.cell.max(alone);
    Noise {
        white,
        line,
        cell: component,
        lack_of_fit: component > 0.0,
    }
}

/// By how much the covariance of every station grows because its model is too poor, at least 1.
///
/// Form deviation is smooth: it moves the extrapolation to the edge by more than its residuals suggest. What it
/// moves is seen by comparing the offset with that of a model with one unknown more: without form deviation the
/// difference has the variance of the richer offset less that of the poorer one (Hausman 1978); what is beyond that,
/// over five stations, is form.
pub(super) fn form_factors<const P: usize, const Q: usize>(
    series: &Series<P>,
    richer: &Series<Q>,
    noise: &[Noise],
) -> Vec<f64> {
    let differences: Vec<Option<(f64, f64, f64)>> = (0..series.len())
        .map(|k| {
            let (Ok(poor), Ok(rich)) = (&series[k], &richer[k]) else {
                return None;
            };
            let variance = noise[k].full(poor)[0][0];
            let ratio = rich.fit.cofactor[0][0] / poor.fit.cofactor[0][0];
            let expected = variance * (ratio - 1.0);
            let difference = rich.fit.coefficients[0] - poor.fit.coefficients[0];
            (expected > 0.0).then_some((difference * difference, expected, variance))
        })
        .collect();
    (0..series.len())
        .map(|k| {
            let near = &differences[k.saturating_sub(2)..(k + 3).min(series.len())];
            let Some((square, expected, variance)) = differences[k] else {
                return 1.0;
            };
            let together = form_variance(near.iter().flatten());
            let alone = form_variance([(square, expected, variance)].iter());
            1.0 + together.max(alone) / variance
        })
        .collect()
}

/// Mean excess of (difference squared, its expectation, _) where it is significant, otherwise 0.
fn form_variance<'a>(differences: impl Iterator<Item = &'a (f64, f64, f64)>) -> f64 {
    let (mut chi, mut excess, mut count) = (0.0, 0.0, 0.0);
    for (square, expected, _) in differences {
        chi += square / expected;
        excess += square - expected;
        count += 1.0;
    }
    // One difference alone is no sample: chi-square with one freedom passes 3 sqrt(2) + 1 once in 45.
    let limit = if count < 2.0 {
        16.0
    } else {
        count + 2.0 * SIGNIFICANT * (2.0f64 * count).sqrt()
    };
    if chi > limit { excess / count } else { 0.0 }
}

/// Stations over which form deviation is taken to be one and the same: those that it is judged over.
const FORM_LENGTH: f64 = 5.0;

/// Variance of the mean offset over the stations, over what it would be if they shared nothing.
pub(super) fn shared_factor<const P: usize>(
    series: &Series<P>,
    noise: &[Noise],
    form: &[f64],
) -> f64 {
    let (mut alone, mut shared) = (0.0, 0.0);
    let mut lines: BTreeMap<u32, f64> = BTreeMap::new();
    for ((window, noise), form) in series.iter().zip(noise).zip(form) {
        let Ok(window) = window else { continue };
        let total = noise.full(window)[0][0];
        let white = noise.white * window.fit.cofactor[0][0];
        let own_lines: f64 = window.lines.influence.iter().map(|(_, w)| w * w).sum();
        // Lines and cells overlap; what is no line is form.
        let local = (total - white - noise.line * own_lines).max(0.0) + total * (form - 1.0);
        alone += total * form;
        shared += white + FORM_LENGTH * local;
        for (line, weight) in &window.lines.influence {
            *lines.entry(*line).or_insert(0.0) += weight;
        }
    }
    let line: f64 = noise.iter().map(|n| n.line).fold(0.0, f64::max);
    shared += line * lines.values().map(|w| w * w).sum::<f64>();
    if alone > 0.0 {
        (shared / alone).max(1.0)
    } else {
        1.0
    }
}

//! How far apart measured points lie, along and across the scan lines, and how noisy they are.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use rayon::prelude::*;

use super::moments::Moments;
use super::{Neighbors, Origin, PointCloud};

/// Places looked at; the medians over them are good to a few percent.
const SAMPLES: usize = 3_000;
/// Neighbours within which spacing is judged.
const NEIGHBOURS: usize = 24;
/// Neighbours among which the next scan line is sought: reaches it at 1:25.
const FAR_NEIGHBOURS: usize = 160;
/// Ratio of across to along from which on a place counts as one in scan lines.
const LINES_FROM: f64 = 4.0;
/// Share of such places from which on a cloud counts as one of scan lines: random samples show 0.12; of five merged views with lines
/// at 1:5, where most places are seen by several, 0.30 remain.
const LINES_SHARE: f64 = 0.22;
/// The places in lines whose distance to the next line is taken: views that overlap shorten it, and borders lengthen it.
const ACROSS_QUANTILE: f64 = 0.35;

/// Spacing of the points of a cloud; `along_mm` and `across_mm` are equal where no scan lines are seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spacing {
    /// Along a scan line, mm.
    pub along_mm: f64,
    /// From a scan line to the next, mm.
    pub across_mm: f64,
    /// Square root of the area a point has to itself, mm.
    pub mean_mm: f64,
}

impl Spacing {
    /// Whether the points lie in lines.
    pub fn in_lines(&self) -> bool {
        self.across_mm > self.along_mm * 1.01
    }
}

/// The spacing of `cloud`; all zero where it has fewer than three distinct points.
///
/// From the lattice where there is one; else medians over a sample of places, where across the lines counts the radius within which a
/// place has neighbours in every direction of its tangent plane; that holds for merged views and unorganised points alike.
pub fn spacing(cloud: &PointCloud, neighbors: &Neighbors) -> Spacing {
    let samples: Vec<[f64; 3]> = sample(neighbors.places(), SAMPLES)
        .par_iter()
        .filter_map(|&i| local_spacing(cloud, neighbors, cloud.positions[i as usize]))
        .collect();
    let middle = |at: usize| quantile(samples.iter().map(|s| s[at]).collect(), 0.5);
    let (mean, along) = (middle(0), middle(1));
    if let Some((along, across)) = lattice_spacing(cloud) {
        return Spacing {
            along_mm: along.min(across),
            across_mm: along.max(across),
            mean_mm: mean,
        };
    }
    let lined: Vec<f64> = samples
        .iter()
        .filter(|s| s[2] > LINES_FROM * s[1])
        .map(|s| s[2])
        .collect();
    if lined.len() as f64 > LINES_SHARE * samples.len() as f64 {
        let across = quantile(lined, ACROSS_QUANTILE);
        Spacing {
            along_mm: along,
            across_mm: across,
            mean_mm: (along * across).sqrt(),
        }
    } else {
        Spacing {
            along_mm: mean,
            across_mm: mean,
            mean_mm: mean,
        }
    }
}

/// Spacing and noise of a scan that comes in pieces of some ten thousand points.
#[derive(Debug, Default)]
pub(crate) struct Estimator {
    /// Of every piece: along, across, mean, mm.
    spacings: [Vec<f64>; 3],
    variances: Vec<(f64, f64)>,
}

/// Places of a piece at which its noise is looked at.
const PIECE_SAMPLES: usize = 150;

impl Estimator {
    /// Takes a piece; one without a lattice, or too small for one, says nothing of the spacing.
    pub(crate) fn add(&mut self, piece: &PointCloud, neighbors: &Neighbors) {
        let Some((along, across)) = lattice_spacing(piece) else {
            return;
        };
        let spacing = Spacing {
            along_mm: along.min(across),
            across_mm: along.max(across),
            mean_mm: (along * across).sqrt(),
        };
        let values = [spacing.along_mm, spacing.across_mm, spacing.mean_mm];
        for (list, value) in self.spacings.iter_mut().zip(values) {
            list.push(value);
        }
        let variances = variances(piece, neighbors, &spacing, PIECE_SAMPLES);
        self.variances.extend(variances);
    }

    /// What the pieces so far say together: spacing, and noise in mm; `None` where they say nothing.
    pub(crate) fn estimate(&self) -> Option<(Spacing, f64)> {
        if self.variances.is_empty() {
            return None;
        }
        let [along_mm, across_mm, mean_mm] =
            [0, 1, 2].map(|k| quantile(self.spacings[k].clone(), 0.5));
        let spacing = Spacing {
            along_mm,
            across_mm,
            mean_mm,
        };
        Some((spacing, noise_of(&self.variances)))
    }
}

/// Median distance from column to column and from profile to profile, mm, where the cloud has a lattice.
fn lattice_spacing(cloud: &PointCloud) -> Option<(f64, f64)> {
    if cloud.origins.is_empty() || cloud.check_lattice().is_err() {
        return None;
    }
    let mut order: Vec<u32> = (0..cloud.len() as u32).collect();
    let mut median_step = |key: &(dyn Fn(&Origin) -> (u16, u32, u32) + Sync)| {
        order.par_sort_unstable_by_key(|i| (key(&cloud.origins[*i as usize]), *i));
        let steps = order.windows(2).filter_map(|w| {
            let [from, to] = [w[0], w[1]].map(|i| key(&cloud.origins[i as usize]));
            let next = (from.0, from.1) == (to.0, to.1) && to.2 > from.2;
            let [a, b] = [w[0], w[1]].map(|i| cloud.positions[i as usize]);
            next.then(|| a.distance(b))
        });
        let steps: Vec<f64> = steps.filter(|d| *d > 0.0 && d.is_finite()).collect();
        (!steps.is_empty()).then(|| quantile(steps, 0.5))
    };
    let along = median_step(&|o| (o.view, o.profile, u32::from(o.column)))?;
    let across = median_step(&|o| (o.view, u32::from(o.column), o.profile))?;
    Some((along, across))
}

/// Mean spacing, distance to the second nearest neighbour, and radius that has neighbours all around.
fn local_spacing(cloud: &PointCloud, neighbors: &Neighbors, p: DVec3) -> Option<[f64; 3]> {
    let mut found = Vec::new();
    neighbors.nearest(p, FAR_NEIGHBOURS, &mut found);
    if found.len() < 3 {
        return None;
    }
    let near = found[found.len().min(NEIGHBOURS) - 1];
    let others = (found.len().min(NEIGHBOURS) - 1) as f64;
    let mean = (PI * near.1 / others).sqrt();
    let mut moments = Moments::default();
    for (i, _) in &found {
        moments.add(cloud.positions[*i as usize] - p);
    }
    let plane = moments.plane();
    let v = plane.normal.cross(plane.major);
    let mut angles: Vec<f64> = Vec::new();
    let mut around = found[found.len() - 1].1.sqrt();
    for (i, d2) in found.iter().skip(1) {
        let d = cloud.positions[*i as usize] - p;
        angles.push(d.dot(v).atan2(d.dot(plane.major)));
        if angles.len() > 2 && widest_gap(&mut angles) < 100f64.to_radians() {
            around = d2.sqrt();
            break;
        }
    }
    Some([mean, found[2].1.sqrt(), around])
}

/// The widest angle, rad, between directions that follow each other around the circle; sorts them.
pub(crate) fn widest_gap(angles: &mut [f64]) -> f64 {
    angles.sort_unstable_by(f64::total_cmp);
    let (Some(first), Some(last)) = (angles.first(), angles.last()) else {
        return TAU;
    };
    angles
        .windows(2)
        .map(|w| w[1] - w[0])
        .fold(first + TAU - last, f64::max)
}

/// Standard deviation, mm, of the points normal to the surface.
///
/// From residuals of local quadric fits, corrected for degrees of freedom; a low quantile over many places, so that edges, outliers and
/// small radii do not raise it.
pub fn noise_mm(cloud: &PointCloud, neighbors: &Neighbors, spacing: &Spacing) -> f64 {
    noise_of(&variances(cloud, neighbors, spacing, SAMPLES))
}

/// Residual variances, mm², and degrees of freedom at about so many places.
fn variances(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    spacing: &Spacing,
    samples: usize,
) -> Vec<(f64, f64)> {
    let ratio = (spacing.across_mm / spacing.along_mm.max(f64::MIN_POSITIVE)).clamp(1.0, 20.0);
    let k = (32.0 * (ratio / 1.5).max(1.0)) as usize;
    sample(neighbors.places(), samples)
        .par_iter()
        .filter_map(|&i| quadric_variance(cloud, neighbors, (cloud.positions[i as usize], k)))
        .collect()
}

/// The noise that the quiet ones of many places show, mm.
fn noise_of(variances: &[(f64, f64)]) -> f64 {
    const QUANTILE: f64 = 0.15;
    const NORMAL_QUANTILE: f64 = -1.036;
    if variances.is_empty() {
        return 0.0;
    }
    let freedom = quantile(variances.iter().map(|v| v.1).collect(), 0.5);
    // Wilson and Hilferty: quantiles of chi-squared over its degrees of freedom.
    let spread = 2.0 / (9.0 * freedom);
    let expected = (1.0 - spread + NORMAL_QUANTILE * spread.sqrt()).powi(3);
    let seen = quantile(variances.iter().map(|v| v.0).collect(), QUANTILE);
    (seen / expected).sqrt()
}

/// Residual variance, mm², and degrees of freedom of the quadric height function through the `k` nearest places.
fn quadric_variance(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    (p, k): (DVec3, usize),
) -> Option<(f64, f64)> {
    let mut found = Vec::new();
    neighbors.nearest(p, k, &mut found);
    if found.len() < 10 {
        return None;
    }
    let mut moments = Moments::default();
    for (i, _) in &found {
        moments.add(cloud.positions[*i as usize] - p);
    }
    let plane = moments.plane();
    let reach = found[found.len() - 1].1.sqrt();
    let v = plane.normal.cross(plane.major);
    let mut columns: [Vec<f64>; 7] = std::array::from_fn(|_| Vec::with_capacity(found.len()));
    for (i, _) in &found {
        let d = (cloud.positions[*i as usize] - p - plane.centre) / reach;
        let (x, y) = (d.dot(plane.major), d.dot(v));
        for (column, value) in
            columns
                .iter_mut()
                .zip([1.0, x, y, x * x, x * y, y * y, d.dot(plane.normal)])
        {
            column.push(value);
        }
    }
    let (rest, rank) = residual_after(columns);
    let freedom = found.len() as f64 - rank as f64;
    Some((rest * reach * reach / freedom, freedom))
}

/// Squared length of the last column after taking out the others (Gram and Schmidt), and the rank of those.
fn residual_after(mut columns: [Vec<f64>; 7]) -> (f64, usize) {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let mut rank = 0;
    for c in 0..columns.len() - 1 {
        let (done, rest) = columns.split_at_mut(c + 1);
        let current = &done[c];
        let length2 = dot(current, current);
        if length2 < 1e-8 {
            continue;
        }
        rank += 1;
        for other in rest {
            let f = dot(current, other) / length2;
            for (o, x) in other.iter_mut().zip(current) {
                *o -= f * x;
            }
        }
    }
    let last = &columns[columns.len() - 1];
    (dot(last, last), rank)
}

fn sample(places: &[u32], samples: usize) -> Vec<u32> {
    let step = (places.len() / samples).max(1);
    places.iter().copied().step_by(step).collect()
}

/// The value below which the share `q` lies; zero for no values.
fn quantile(mut values: Vec<f64>, q: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * q) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

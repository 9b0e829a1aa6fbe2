//! What the pose may be off because the part is not as drawn: faces, and patches of them, that share a deviation.

use std::collections::HashMap;

use foldhash::fast::FixedState;
use nalgebra::{Matrix6, Vector6};

use super::{Observation, Step};
use crate::geometry::fit::{mad_sigma, median};
use crate::inspect::clusters::SIGNIFICANT;

/// The patch of its face that an observation lies on, a third of the part's half-diagonal wide.
pub(super) fn patch_of(o: &Observation, size_mm: f64) -> u64 {
    let foot = o.point - o.residual_mm * o.normal;
    // Shifted off the planes through the origin, on which the foot's rounding would choose the cell.
    let cell = (3.0 * foot / size_mm + 0.377).floor().as_i64vec3();
    let place = (cell.x.wrapping_mul(0x1F_FFF7) ^ cell.y.wrapping_mul(0x3F_FF1D)) ^ cell.z;
    u64::from(o.face) << 40 | (place as u64 & 0xFF_FFFF_FFFF)
}

/// Variance of the median of normal noise over that of the mean: pi / 2.
const MEDIAN_VARIANCE: f64 = std::f64::consts::FRAC_PI_2;

/// What the pose may be off because faces, or patches of them, depart from the nominal by amounts that nobody knows.
///
/// Every group is taken to be shifted at random; the variance of the shifts is estimated from the median residuals of *all*
/// groups, those that the robust fit turned down included: which of two opposite faces is off cannot be told from the scan.
/// The median, because the points of an edge break or of the spot's smear at a face's rim are no shift of the face.
/// Where no group is redundant (three datum faces) the shifts cannot be seen, and the groups define the frame.
pub(super) fn form(
    observations: &[Observation],
    (step, inverse): (&Step, &Matrix6<f64>),
    group: impl Fn(&Observation) -> u64,
    size_mm: f64,
) -> Matrix6<f64> {
    // By group, as they come: weighted sum of rows, sum of weights, residuals.
    let mut groups: Vec<(Vector6<f64>, f64, Vec<f64>)> = Vec::new();
    let mut index: HashMap<u64, usize, FixedState> = HashMap::default();
    let mut last = None;
    for (o, w) in observations.iter().zip(&step.weights) {
        if o.u_mm > 0.0 {
            continue;
        }
        let name = group(o);
        // Neighbours along a scan line mostly belong together.
        let at = match last {
            Some((known, at)) if known == name => at,
            _ => *index.entry(name).or_insert(groups.len()),
        };
        if at == groups.len() {
            groups.push(Default::default());
        }
        last = Some((name, at));
        let entry = &mut groups[at];
        entry.0 += *w * o.scaled_row(size_mm);
        entry.1 += w;
        entry.2.push(o.residual_mm);
    }
    let total = observations.len() as f64;
    let (mut square, mut expected, mut freedom) = (0.0, 0.0, 0.0);
    let mut scatter = Matrix6::zeros();
    for (rows, weight, residuals) in &mut groups {
        scatter += *rows * rows.transpose();
        let count = residuals.len() as f64;
        // A handful of stray points is no face.
        if count < 20.0f64.max(0.002 * total) {
            continue;
        }
        let middle = median(residuals);
        let sigma = mad_sigma(residuals);
        let leverage = (rows.transpose() * inverse * *rows)[0] / weight.max(1e-9);
        let left = (1.0 - leverage).clamp(0.0, 1.0);
        square += middle * middle;
        expected += left * MEDIAN_VARIANCE * sigma * sigma / count;
        freedom += left;
    }
    let excess = square - expected;
    if freedom < 0.5 || excess < SIGNIFICANT * expected * (2.0 / freedom).sqrt() {
        return Matrix6::zeros();
    }
    inverse * scatter * inverse * (excess / freedom)
}

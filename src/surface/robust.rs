//! A tangent plane that a neighbouring flank does not tilt.

use glam::DVec3;
use rayon::prelude::*;

use super::levin::gaussian;
use super::scale::Scale;
use crate::points::moments::Moments;
use crate::points::{Neighbors, PointCloud};

/// Planes tried; three random neighbours all lie on a flank that holds 0.4 of them in one of them with a probability of 0.96.
const TRIALS: usize = 48;

/// Neighbours that the tried planes pass through, at most: the nearest ones.
const DRAWN_FROM: usize = 20;

/// The unit normal at the first of `points` (relative to it, nearest first) and the weighted part of the points on its plane.
///
/// The plane is the one of many through three neighbours with the least truncated squares, then fitted to the points on it; the point
/// itself must lie on it. The choice of neighbours is fixed, so the answer is always the same.
pub(crate) fn robust_normal(points: &[DVec3], scale: &Scale) -> Option<(DVec3, f64)> {
    let n = points.len();
    if n < 6 {
        return None;
    }
    let h = points[n - 1].length().max(f64::MIN_POSITIVE);
    let base = 2.5 * scale.noise_mm + 2.5 * scale.floor_mm();
    // A surface may leave its tangent plane like a cylinder of twenty spacings' radius.
    let bend = 0.025 / scale.spacing_mm;
    let width = |p: &DVec3| base + bend * p.length_squared();
    let weights: Vec<f64> = points
        .iter()
        .map(|p| gaussian(p.length_squared(), h))
        .collect();
    let score = |normal: DVec3, through: DVec3| -> f64 {
        (points.iter().zip(&weights))
            .map(|(p, w)| {
                let r = normal.dot(*p - through) / width(p);
                w * (1.0 - r * r).max(0.0)
            })
            .sum()
    };
    let mut best = (0.0, DVec3::Z, DVec3::ZERO);
    let mut dice = 0x9e37_79b9_7f4a_7c15_u64;
    for _ in 0..TRIALS {
        let [a, b, c] = draw(&mut dice, n.min(DRAWN_FROM)).map(|i| points[i]);
        let cross = (b - a).cross(c - a);
        let size = cross.length();
        if size.is_nan()
            || size <= 0.2 * (b - a).length() * (c - a).length()
            || size < 0.1 * scale.spacing_mm * scale.spacing_mm
        {
            continue;
        }
        let normal = cross / size;
        if normal.dot(a).abs() > base {
            continue;
        }
        let value = score(normal, a);
        if value > best.0 {
            best = (value, normal, a);
        }
    }
    if best.0 <= 0.0 {
        return None;
    }
    let (mut normal, mut through) = (best.1, best.2);
    for _ in 0..2 {
        let mut moments = Moments::default();
        for p in points {
            if normal.dot(*p - through).abs() < width(p) {
                moments.add(*p);
            }
        }
        if moments.count() < 4.0 {
            break;
        }
        let plane = moments.plane();
        normal = plane.normal;
        through = plane.centre;
    }
    let total: f64 = weights.iter().sum();
    let on: f64 = (points.iter().zip(&weights))
        .filter(|(p, _)| normal.dot(**p - through).abs() < width(p))
        .map(|(_, w)| w)
        .sum();
    Some((normal, on / total))
}

/// Median over a sample of places of the standard deviation of the points around the plane that most of the nearest lie on, mm.
///
/// Least median of squares tells two parallel sheets apart without knowing any scale. It comes out low by up to a third, and high where the
/// surface curves: a bound, not an estimate.
pub(crate) fn noise_of_planes_mm(cloud: &PointCloud, neighbors: &Neighbors) -> f64 {
    const SAMPLES: usize = 999;
    let order = neighbors.order();
    let step = order.len().div_ceil(SAMPLES).max(1);
    let mut all: Vec<f64> = order
        .par_iter()
        .step_by(step)
        .filter_map(|&i| noise_of_plane(cloud, neighbors, cloud.positions[i as usize]))
        .collect();
    all.sort_unstable_by(f64::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(0.0)
}

fn noise_of_plane(cloud: &PointCloud, neighbors: &Neighbors, p: DVec3) -> Option<f64> {
    let mut found = Vec::new();
    neighbors.nearest(p, 24, &mut found);
    let points: Vec<DVec3> = found
        .iter()
        .map(|(i, _)| cloud.positions[*i as usize] - p)
        .collect();
    if points.len() < 12 {
        return None;
    }
    let mut dice = 0x2545_f491_4f6c_dd1d_u64;
    let mut best = (f64::INFINITY, DVec3::Z, DVec3::ZERO);
    for _ in 0..TRIALS {
        let [a, b, c] = draw(&mut dice, points.len()).map(|i| points[i]);
        let cross = (b - a).cross(c - a);
        let size = cross.length();
        if size.is_nan() || size <= 0.2 * (b - a).length() * (c - a).length() {
            continue;
        }
        let normal = cross.normalize();
        let mut off: Vec<f64> = points.iter().map(|p| normal.dot(*p - a).abs()).collect();
        // A quantile that one of two sheets still reaches.
        let rank = off.len() * 4 / 10;
        let quantile = *off.select_nth_unstable_by(rank, f64::total_cmp).1;
        if quantile < best.0 {
            best = (quantile, normal, a);
        }
    }
    // 40 % of a normal distribution lie within 0.524 standard deviations.
    let limit = 3.0 * best.0 / 0.524;
    let mut moments = Moments::default();
    for p in points
        .iter()
        .filter(|p| best.1.dot(**p - best.2).abs() <= limit)
    {
        moments.add(*p);
    }
    let count = moments.count();
    (count > 5.0).then(|| (moments.plane().variances[2] * count / (count - 3.0)).sqrt())
}

/// Three different numbers below `n`.
fn draw(dice: &mut u64, n: usize) -> [usize; 3] {
    let mut next = || {
        *dice = dice
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((*dice >> 33) as usize) % n
    };
    let a = next();
    let mut b = next();
    while b == a {
        b = (b + 1) % n;
    }
    let mut c = next();
    while c == a || c == b {
        c = (c + 1) % n;
    }
    [a, b, c]
}

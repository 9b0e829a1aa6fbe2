//! A loop of points laid into the parameters of a surface: unwrapped where it is closed, led along poles.

use glam::DVec3;

use super::trim::UvLoop;
use crate::geometry::Surface;
use crate::geometry::newton::Range;

/// Parameters of a point; `None` for the one that a pole leaves open.
#[derive(Debug, Clone, Copy)]
struct Laid {
    at: [Option<f64>; 2],
    /// The value the search happened to give, for the parameter that is open.
    raw: [f64; 2],
}

/// The loop in the parameters of the surface, with its first point at the end again.
///
/// At a pole one parameter is free: the loop is led along the pole's line in the direction that keeps the material on its left.
pub(super) fn unroll(surface: &Surface, points: &[DVec3]) -> UvLoop {
    let Some(first) = points.first() else {
        return Vec::new();
    };
    let ranges = surface.ranges();
    let size = points
        .iter()
        .map(|p| p.distance(*first))
        .fold(0.0, f64::max);
    let mut laid: Vec<Laid> = Vec::with_capacity(points.len());
    let mut near = None;
    for p in points {
        let mut uv = surface.nearest(*p, near);
        let stray = near.is_some() && surface.point(uv.0, uv.1).distance(*p) > 1e-4 * size;
        if stray {
            uv = surface.nearest(*p, None);
        }
        near = Some(uv);
        laid.push(Laid {
            at: open_at_poles(surface, uv, ranges, 1e-6 * size),
            raw: [uv.0, uv.1],
        });
    }
    // Start at a point where both parameters are known.
    let Some(start) = laid.iter().position(|l| l.at.iter().all(Option::is_some)) else {
        return Vec::new();
    };
    // The last point repeats the first where the loop is closed.
    laid.pop();
    if laid.is_empty() {
        return Vec::new();
    }
    let start = start % laid.len();
    laid.rotate_left(start);
    laid.push(laid[0]);
    lead(&laid, ranges)
}

/// Unwraps the points in turn.
fn lead(laid: &[Laid], ranges: [Range; 2]) -> UvLoop {
    let mut out: UvLoop = Vec::with_capacity(laid.len() + 4);
    let mut here = laid[0].raw;
    out.push((here[0], here[1]));
    // Side of the pole that the loop has just been to, by parameter.
    let mut pole: [Option<f64>; 2] = [None; 2];
    for l in &laid[1..] {
        let mut next = here;
        for k in 0..2 {
            if let Some(t) = l.at[k] {
                next[k] = nearest_turn(t, here[k], ranges[k]);
            }
        }
        let open = [l.at[0].is_none(), l.at[1].is_none()];
        for k in 0..2 {
            let other = 1 - k;
            if open[k] {
                let side = (next[other] - here[other]).signum();
                pole[k] = pole[k].or(Some(side));
                continue;
            }
            if let Some(side) = pole[k].take() {
                // Walk along the pole at its own value of the other parameter, then leave it.
                next[k] = along_pole(here[k], next[k], ranges[k], side, k);
                let mut on_pole = here;
                on_pole[k] = next[k];
                out.push((on_pole[0], on_pole[1]));
            }
        }
        out.push((next[0], next[1]));
        here = next;
    }
    out
}

/// The image of `t` nearest to `here` in a closed direction.
fn nearest_turn(t: f64, here: f64, range: Range) -> f64 {
    match range.period() {
        Some(p) => t + p * ((here - t) / p).round(),
        None => t,
    }
}

/// Where a walk along a pole ends: material lies left of it, so in u it goes down at the upper end of v, in v up.
fn along_pole(from: f64, to: f64, range: Range, side: f64, parameter: usize) -> f64 {
    let Some(p) = range.period() else {
        return to;
    };
    let down = (side > 0.0) == (parameter == 0);
    let mut way = (to - from).rem_euclid(p);
    if way < 1e-6 * p || way > (1.0 - 1e-6) * p {
        // Out on the meridian it came in on.
        return from;
    }
    if down {
        way -= p;
    }
    from + way
}

/// Parameters of a point, without one in which the surface has no extent there.
fn open_at_poles(
    surface: &Surface,
    uv: (f64, f64),
    ranges: [Range; 2],
    resolution_mm: f64,
) -> [Option<f64>; 2] {
    let known = [Some(uv.0), Some(uv.1)];
    match surface {
        Surface::Plane(_) | Surface::Cylinder { .. } => return known,
        _ => {}
    }
    let d = surface.derivatives(uv.0, uv.1);
    let width = |r: Range| {
        let w = r.to - r.from;
        if w.is_finite() { w } else { 0.0 }
    };
    let open = |derivative: DVec3, r: Range| {
        width(r) > 0.0 && derivative.length() * width(r) < resolution_mm.max(1e-9)
    };
    [
        known[0].filter(|_| !open(d.du, ranges[0])),
        known[1].filter(|_| !open(d.dv, ranges[1])),
    ]
}

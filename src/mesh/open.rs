//! Surfaces with borders: what of a part was seen.
//!
//! A scan is open nearly always. Closed, its mesh bridges what was never seen by triangles far larger than the spacing around; these are
//! left out. A sheet, which bounds no body, is grown from the umbrellas ([`super::sheet`]).

use std::collections::HashMap;

use super::Body;
use super::check::Groups;
use super::delaunay::{Delaunay, GHOST, place};
use super::sheet::{BRIDGE, is_needle, sheet};
use super::star::vertices;

/// An edge longer than so many times the typical ones of nine in ten vertices bridges whatever its surroundings.
const LONGEST: f64 = 4.0;

/// The triangles of the points' surface that bridge nothing, as a manifold with borders.
pub(super) fn seen_triangles(body: &Body) -> Vec<[u32; 3]> {
    let delaunay = &body.delaunay;
    let typical = typical_edges(delaunay, &sure(body));
    let most = longest_seen(&typical);
    let is_seen = |t: [u32; 3], times: f64| {
        (0..3).all(|k| {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            let length = delaunay.points[a as usize].distance(delaunay.points[b as usize]);
            length <= (times * typical[a as usize].min(typical[b as usize])).min(most)
        })
    };
    let count = delaunay.points.len();
    without_specks(count, one_fan_each(count, sheet(body, is_seen)))
}

/// The triangles of points in one plane that bridge nothing, their front towards `apex`, the one vertex that lies off the plane.
pub(super) fn plane_triangles(delaunay: &Delaunay, apex: u32) -> Vec<[u32; 3]> {
    let mut triangles: Vec<[u32; 3]> = (0..delaunay.cells.len() as u32)
        .filter(|c| !delaunay.is_ghost(*c))
        .map(|c| c << 2 | place(&delaunay.cells[c as usize], apex) as u32)
        .map(|f| vertices(delaunay, f))
        // Facets are seen from the other side than their corner.
        .map(|[a, b, c]| [a, c, b])
        .collect();
    let typical = typical_edges(delaunay, &triangles);
    let most = longest_seen(&typical);
    // No point of another sheet is near: an edge into a sparser place is none that bridges.
    let is_seen = |t: &[u32; 3]| {
        (0..3).all(|k| {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            let length = delaunay.points[a as usize].distance(delaunay.points[b as usize]);
            length <= (BRIDGE * typical[a as usize].max(typical[b as usize])).min(most)
        })
    };
    triangles.retain(is_seen);
    // Noise hangs no specks into a plane.
    one_fan_each(delaunay.points.len(), triangles)
}

/// Leaves out pieces of a few triangles around none of whose vertices they close: what noise hangs into the slits between scan lines.
fn without_specks(vertices: usize, mut triangles: Vec<[u32; 3]>) -> Vec<[u32; 3]> {
    /// Triangles of a speck at the most: two rings of six.
    const SPECK: u32 = 12;
    let mut pieces = Groups::new(vertices);
    for t in &triangles {
        pieces.join(t[0], t[1]);
        pieces.join(t[0], t[2]);
    }
    let mut sizes = vec![0u32; vertices];
    // Around a vertex with a whole ring every edge there has two triangles.
    let mut ends: Vec<(u32, u32)> = Vec::with_capacity(6 * triangles.len());
    for t in &triangles {
        sizes[pieces.of(t[0]) as usize] += 1;
        for k in 0..3 {
            ends.push((t[k], t[(k + 1) % 3]));
            ends.push((t[k], t[(k + 2) % 3]));
        }
    }
    ends.sort_unstable();
    let mut has_ring = vec![false; vertices];
    for of_one in ends.chunk_by(|a, b| a.0 == b.0) {
        if of_one
            .chunk_by(|a, b| a.1 == b.1)
            .all(|edge| edge.len() == 2)
        {
            has_ring[pieces.of(of_one[0].0) as usize] = true;
        }
    }
    triangles.retain(|t| {
        let piece = pieces.of(t[0]) as usize;
        has_ring[piece] || sizes[piece] > SPECK
    });
    triangles
}

/// The facets whose smallest sphere is empty, needles left out: nearly all are on the surface.
fn sure(body: &Body) -> Vec<[u32; 3]> {
    let delaunay = &body.delaunay;
    (0..4 * delaunay.cells.len() as u32)
        .filter(|f| body.facets.is_gabriel(*f))
        .map(|f| vertices(delaunay, f))
        .filter(|t| !t.contains(&GHOST) && !is_needle(delaunay, *t))
        .collect()
}

/// For every vertex the median of the lengths of its triangles' edges.
fn typical_edges(delaunay: &Delaunay, triangles: &[[u32; 3]]) -> Vec<f64> {
    let mut lengths: Vec<Vec<f32>> = vec![Vec::new(); delaunay.points.len()];
    for t in triangles {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            let length = delaunay.points[a as usize].distance(delaunay.points[b as usize]) as f32;
            lengths[a as usize].push(length);
            lengths[b as usize].push(length);
        }
    }
    let typical = |all: &mut Vec<f32>| {
        if all.is_empty() {
            return 0.0;
        }
        let at = (all.len() - 1) / 2;
        f64::from(*all.select_nth_unstable_by(at, f32::total_cmp).1)
    };
    lengths.iter_mut().map(typical).collect()
}

/// Length above which an edge bridges whatever its surroundings: along a border even typical edges may be bridges.
fn longest_seen(typical: &[f64]) -> f64 {
    let mut all: Vec<f64> = typical.iter().copied().filter(|l| *l > 0.0).collect();
    if all.is_empty() {
        return f64::INFINITY;
    }
    let at = (all.len() - 1) * 9 / 10;
    LONGEST * *all.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Leaves every vertex one fan or ring of triangles, the largest.
fn one_fan_each(vertices: usize, mut triangles: Vec<[u32; 3]>) -> Vec<[u32; 3]> {
    loop {
        let mut at: Vec<Vec<u32>> = vec![Vec::new(); vertices];
        for (i, t) in triangles.iter().enumerate() {
            t.iter().for_each(|v| at[*v as usize].push(i as u32));
        }
        let mut is_kept = vec![true; triangles.len()];
        let mut found = false;
        for v in 0..vertices as u32 {
            let own = &at[v as usize];
            let fans = fans(v, own, &triangles);
            let mut sizes: HashMap<u32, usize> = HashMap::new();
            fans.iter().for_each(|f| *sizes.entry(*f).or_default() += 1);
            let Some((&largest, _)) = sizes
                .iter()
                .max_by_key(|(f, n)| (**n, std::cmp::Reverse(**f)))
            else {
                continue;
            };
            for (i, fan) in own.iter().zip(&fans) {
                if *fan != largest {
                    is_kept[*i as usize] = false;
                    found = true;
                }
            }
        }
        if !found {
            return triangles;
        }
        let mut kept = is_kept.iter();
        triangles.retain(|_| kept.next().copied().unwrap_or(true));
    }
}

/// For every triangle at `v` which fan it belongs to: those that share an edge at `v`.
fn fans(v: u32, own: &[u32], triangles: &[[u32; 3]]) -> Vec<u32> {
    let mut fan: Vec<u32> = (0..own.len() as u32).collect();
    let shares = |i: u32, j: u32| {
        let (s, t) = (triangles[i as usize], triangles[j as usize]);
        s.iter().any(|x| *x != v && t.contains(x))
    };
    for i in 0..own.len() {
        for j in 0..i {
            if fan[i] != fan[j] && shares(own[i], own[j]) {
                let (low, high) = (fan[i].min(fan[j]), fan[i].max(fan[j]));
                fan.iter_mut()
                    .filter(|f| **f == high)
                    .for_each(|f| *f = low);
            }
        }
    }
    fan
}

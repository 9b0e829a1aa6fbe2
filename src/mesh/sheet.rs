//! A sheet with borders, grown from the umbrellas of points that bound no body.
//!
//! We differ: where umbrellas do not match, the thesis leaves holes (Ma 2011, §3.4), and a scan from one side falls into pieces. Here facets are
//! taken one by one, those of all three umbrellas first, then the others by size, as long as the whole stays a manifold of two sides
//! without folds. Needles come after the others, facets that nothing speaks for only close slits, and facets come in that no umbrella has but whose smallest sphere is empty: on scan lines an umbrella
//! of the smallest facets is one of points of its own line.

use glam::DVec3;
use rayon::prelude::*;

use super::Body;
use super::delaunay::{Delaunay, GHOST};
use super::solid::Senses;
use super::star::vertices;

/// Two triangles that meet at an edge at a lesser angle than this, rad (cosine), are a fold and no surface: 25 degrees.
const FOLD: f64 = 0.906;

/// A triangle bridges where an edge of it is longer than so many times the typical edges at its ends: a scan line is up to twenty
/// times denser along than across, and there typical is the longer.
pub(super) const BRIDGE: f64 = 4.0;
/// The same for facets that nothing speaks for but that two of their edges are borders: they close slits and must not creep over holes.
const FILL: f64 = 1.5;
/// Level of such facets.
const FILLS: u32 = 3;
/// A triangle with an angle above this, rad (cosine), is a needle: 145 degrees.
const NEEDLE: f64 = -0.82;

/// The triangles at a vertex: their other two corners, and their place in the list of all.
type Link = Vec<([u32; 2], u32)>;

struct Sheet<'a> {
    delaunay: &'a Delaunay,
    links: Vec<Link>,
    triangles: Vec<[u32; 3]>,
    senses: Senses,
}

/// The triangles of the sheet, all turned alike within each piece. `fits` tells which have no edge longer
/// than so many times the typical ones at its ends.
pub(super) fn sheet(body: &Body, fits: impl Fn([u32; 3], f64) -> bool + Sync) -> Vec<[u32; 3]> {
    let delaunay = &body.delaunay;
    let mut wanted: Vec<(u32, u32, u32)> = (0..4 * delaunay.cells.len() as u32)
        .into_par_iter()
        .filter(|f| delaunay.neighbors[(f >> 2) as usize][(f & 3) as usize] > f >> 2)
        .filter_map(|f| {
            let matches = body.facets.matches(f);
            let corners = vertices(delaunay, f);
            if corners.contains(&GHOST) || !fits(corners, BRIDGE) {
                return None;
            }
            let is_known = matches > 0 || body.facets.is_gabriel(f);
            let level = match is_needle(delaunay, corners) {
                false if matches == 3 => 0,
                false if is_known => 1,
                true if is_known => 2,
                _ => FILLS,
            };
            if level == FILLS && !fits(corners, FILL) {
                return None;
            }
            let radius = body.facets.radius(f >> 2, (f & 3) as usize);
            // The bits of a positive number sort as the number does.
            Some((level, radius.to_bits(), f))
        })
        .collect();
    wanted.par_sort_unstable();
    let mut sheet = Sheet {
        delaunay,
        links: vec![Link::new(); delaunay.points.len()],
        triangles: Vec::new(),
        senses: Senses::new(wanted.len()),
    };
    for (level, _, facet) in &wanted {
        sheet.try_to_take(vertices(delaunay, *facet), usize::from(*level == FILLS) * 2);
    }
    // A slit closes from its ends.
    loop {
        let before = sheet.triangles.len();
        wanted.retain(|w| !sheet.try_to_take(vertices(delaunay, w.2), 2));
        if sheet.triangles.len() == before {
            break;
        }
    }
    let Sheet {
        mut triangles,
        mut senses,
        ..
    } = sheet;
    for (i, t) in triangles.iter_mut().enumerate() {
        if senses.of(i as u32).1 {
            t.swap(0, 1);
        }
    }
    triangles
}

/// Whether the three corners are nearly on a line: of points of one scan line, whose triangles are smaller than those between lines, and no surface.
pub(super) fn is_needle(delaunay: &Delaunay, t: [u32; 3]) -> bool {
    let [a, b, c] = t.map(|v| delaunay.points[v as usize]);
    let cosine = |at: DVec3, p: DVec3, q: DVec3| {
        (p - at)
            .normalize_or_zero()
            .dot((q - at).normalize_or_zero())
    };
    cosine(a, b, c).min(cosine(b, c, a)).min(cosine(c, a, b)) < NEEDLE
}

impl Sheet<'_> {
    /// Takes a triangle where there is room for it and at least so many others are beside it; whether it did.
    fn try_to_take(&mut self, t: [u32; 3], least_beside: usize) -> bool {
        if !(0..3).all(|k| self.has_room(t[k], [t[(k + 1) % 3], t[(k + 2) % 3]])) {
            return false;
        }
        let own = self.triangles.len() as u32;
        let mut joins: Vec<(u32, bool)> = Vec::new();
        for k in 0..3 {
            let (a, b, apex) = (t[k], t[(k + 1) % 3], t[(k + 2) % 3]);
            let Some(other) = self.beside(a, b) else {
                continue;
            };
            let their = self.triangles[other as usize];
            let far = their.into_iter().find(|v| *v != a && *v != b).unwrap_or(a);
            if self.folds(a, b, apex, far) {
                return false;
            }
            // Neighbours that agree go along their edge in opposite ways.
            let is_alike = (0..3).any(|i| their[i] == b && their[(i + 1) % 3] == a);
            joins.push((other, !is_alike));
        }
        if joins.len() < least_beside {
            return false;
        }
        for (i, (a, a_other)) in joins.iter().enumerate() {
            for (b, b_other) in &joins[..i] {
                let ((p, p_turned), (q, q_turned)) = (self.senses.of(*a), self.senses.of(*b));
                if p == q && (p_turned ^ a_other) != (q_turned ^ b_other) {
                    return false;
                }
            }
        }
        for (other, turned) in joins {
            self.senses.join(own, other, turned);
        }
        for k in 0..3 {
            let ends = [t[(k + 1) % 3], t[(k + 2) % 3]];
            self.links[t[k] as usize].push((ends, own));
        }
        self.triangles.push(t);
        true
    }

    /// Whether another triangle at `v` with these other corners leaves fans there, or makes one whole ring.
    fn has_room(&self, v: u32, [a, b]: [u32; 2]) -> bool {
        let link = &self.links[v as usize];
        let at = |u: u32| link.iter().filter(|s| s.0.contains(&u)).count();
        let (at_a, at_b) = (at(a), at(b));
        if at_a > 1 || at_b > 1 {
            return false;
        }
        let is_ring = !link.is_empty() && link.iter().all(|s| s.0.iter().all(|u| at(*u) == 2));
        if is_ring {
            return false;
        }
        if at_a == 0 || at_b == 0 {
            return true;
        }
        // A ring may close only around the vertex as a whole.
        let (mut from, mut end, mut walked) = (u32::MAX, a, 0);
        while let Some(s) = link.iter().find(|s| s.0.contains(&end) && s.1 != from) {
            from = s.1;
            end = if s.0[0] == end { s.0[1] } else { s.0[0] };
            walked += 1;
        }
        end != b || walked == link.len()
    }

    /// A triangle with this edge.
    fn beside(&self, a: u32, b: u32) -> Option<u32> {
        let link = &self.links[a as usize];
        link.iter().find(|s| s.0.contains(&b)).map(|s| s.1)
    }

    /// Whether the triangles at edge `a` `b` with corners `c` and `d` lie nearly on one another.
    fn folds(&self, a: u32, b: u32, c: u32, d: u32) -> bool {
        let at = |v: u32| self.delaunay.points[v as usize];
        let along = (at(b) - at(a)).normalize_or_zero();
        let across = |v: u32| -> DVec3 { (at(v) - at(a)).reject_from_normalized(along) };
        across(c)
            .normalize_or_zero()
            .dot(across(d).normalize_or_zero())
            > FOLD
    }
}

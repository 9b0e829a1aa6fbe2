//! Edges of the mesh laid along the sharp edges of the part.
//!
//! We differ: the cone of the thesis works only while umbrellas are matched, and takes part only where they do not match at once (Ma 2011,
//! §5.4.3). Afterwards an edge between two triangles is exchanged for the other diagonal of the two, where a cell fills the
//! four corners, if that gathers the bends of the surface on fewer and shorter edges. The mesh stays made of Delaunay facets: it
//! cannot cross itself.

use glam::DVec3;

use super::delaunay::{Delaunay, GHOST};
use super::mend::{Ring, defect};
use super::star::Stars;

/// Rounds over all cells; later ones change next to nothing.
const MOST_ROUNDS: usize = 8;
/// A change gains at least this share of the bends it touches: less is rounding.
const LEAST_GAIN: f64 = 1e-6;

/// Exchanges diagonals until none gains; the number exchanged.
pub fn sharpen(delaunay: &Delaunay, stars: &Stars, inside: &mut [bool]) -> usize {
    let mut ring = Ring::default();
    let mut exchanged = 0;
    let mut cells: Vec<u32> = (0..delaunay.cells.len() as u32)
        .filter(|c| !delaunay.cells[*c as usize].contains(&GHOST))
        .collect();
    for _ in 0..MOST_ROUNDS {
        let mut next = Vec::new();
        for &cell in &cells {
            let Some(quad) = Quad::of(delaunay, inside, cell) else {
                continue;
            };
            if quad.gain(delaunay, inside) <= LEAST_GAIN {
                continue;
            }
            let corners = delaunay.cells[cell as usize];
            if corners
                .iter()
                .any(|v| defect(delaunay, stars, inside, *v, &mut ring) > 0)
            {
                continue;
            }
            inside[cell as usize] ^= true;
            if corners
                .iter()
                .any(|v| defect(delaunay, stars, inside, *v, &mut ring) > 0)
            {
                inside[cell as usize] ^= true;
                continue;
            }
            exchanged += 1;
            for v in corners {
                next.extend(stars.of(v).iter().map(|code| code >> 2));
            }
        }
        if next.is_empty() {
            break;
        }
        next.sort_unstable();
        next.dedup();
        next.retain(|c| !delaunay.cells[*c as usize].contains(&GHOST));
        cells = next;
    }
    exchanged
}

/// A cell with two facets on the surface, which meet at the edge `old`; its other two facets meet at the edge `new`.
struct Quad {
    cell: u32,
    /// Places of corners in the cell.
    old: [usize; 2],
    new: [usize; 2],
}

impl Quad {
    fn of(delaunay: &Delaunay, inside: &[bool], cell: u32) -> Option<Self> {
        let own = inside[cell as usize];
        let neighbors = delaunay.neighbors[cell as usize];
        let on_surface = neighbors.map(|n| inside[n as usize] != own);
        if on_surface.iter().filter(|s| **s).count() != 2 {
            return None;
        }
        // The facets opposite to the ends of `new` are on the surface.
        let (mut old, mut new) = ([0; 2], [0; 2]);
        let (mut o, mut n) = (0, 0);
        for (at, is_on) in on_surface.into_iter().enumerate() {
            if is_on {
                new[n] = at;
                n += 1;
            } else {
                old[o] = at;
                o += 1;
            }
        }
        Some(Self { cell, old, new })
    }

    /// By what share the bends of the edges at stake are less after the exchange.
    fn gain(&self, delaunay: &Delaunay, inside: &[bool]) -> f64 {
        let corners = delaunay.cells[self.cell as usize];
        let at = |v: u32| delaunay.points[v as usize];
        let [r, s] = self.old.map(|k| corners[k]);
        let [p, q] = self.new.map(|k| corners[k]);
        let mut before = bend(at(r), at(s), at(p), at(q));
        let mut after = bend(at(p), at(q), at(r), at(s));
        for (i, own) in [(0, r), (1, s)] {
            for (j, other) in [(0, p), (1, q)] {
                // The surface's facet at this edge is opposite to the other end of `new`.
                let facet = self.new[1 - j];
                let beyond = across_edge(
                    delaunay,
                    inside,
                    self.cell,
                    facet,
                    own,
                    other,
                    corners[self.old[1 - i]],
                );
                before += bend(at(own), at(other), at(corners[self.old[1 - i]]), at(beyond));
                after += bend(at(own), at(other), at(corners[self.new[1 - j]]), at(beyond));
            }
        }
        if before > 0.0 {
            (before - after) / before
        } else {
            0.0
        }
    }
}

/// Length of the edge from `a` to `b` times the square root of the angle, rad, by which the surface turns there between its triangles with `c` and `d`.
///
/// The root makes one sharp edge cheaper than two half as sharp.
fn bend(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
    let along = b - a;
    let (m, n) = (along.cross(c - a), (-along).cross(d - b));
    let angle = m.cross(n).length().atan2(m.dot(n));
    along.length() * angle.sqrt()
}

/// The third corner of the other surface triangle at edge `a` `b` of the surface facet opposite corner `at` of `cell`, whose third corner is `third`.
fn across_edge(
    delaunay: &Delaunay,
    inside: &[bool],
    cell: u32,
    at: usize,
    a: u32,
    b: u32,
    third: u32,
) -> u32 {
    debug_assert!(a != b && third != a && third != b);
    let mut n = delaunay.neighbors[cell as usize][at];
    let beyond = inside[n as usize];
    let mut third = third;
    let mut facet = delaunay.mirror(cell, n);
    loop {
        let corners = delaunay.cells[n as usize];
        let across = corners[facet];
        let exit = corners.iter().position(|c| *c == third).unwrap_or(facet);
        let next = delaunay.neighbors[n as usize][exit];
        third = across;
        if inside[next as usize] != beyond {
            return third;
        }
        facet = delaunay.mirror(n, next);
        n = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bends_of_a_flat_a_right_and_a_folded_edge() {
        let (a, b) = (DVec3::ZERO, DVec3::X * 2.0);
        let c = DVec3::new(1.0, 1.0, 0.0);
        assert_eq!(bend(a, b, c, DVec3::new(0.3, -2.0, 0.0)), 0.0);
        let right = bend(a, b, c, DVec3::new(1.0, 0.0, -1.0));
        assert!((right - 2.0 * std::f64::consts::FRAC_PI_2.sqrt()).abs() < 1e-12);
        let folded = bend(a, b, c, DVec3::new(1.0, 3.0, 0.0));
        assert!((folded - 2.0 * std::f64::consts::PI.sqrt()).abs() < 1e-12);
    }
}

//! What stands around the vertices of a triangulation: cells, facets, and a place for marks on facets.

use std::sync::atomic::{AtomicU8, Ordering};

use glam::DVec3;
use rayon::prelude::*;

use super::delaunay::{Delaunay, GHOST};

/// The corners of cells at every vertex: four times the cell plus the corner, ascending.
#[derive(Debug, Clone)]
pub struct Stars {
    starts: Vec<u32>,
    corners: Vec<u32>,
}

impl Stars {
    /// The stars of all vertices; 16 bytes a cell.
    pub fn new(delaunay: &Delaunay) -> Self {
        let count = delaunay.points.len();
        let mut starts = vec![0u32; count + 2];
        let finite = |v: &&u32| **v != GHOST;
        for v in delaunay.cells.iter().flatten().filter(finite) {
            starts[*v as usize + 2] += 1;
        }
        for v in 0..count {
            starts[v + 2] += starts[v + 1];
        }
        let mut corners = vec![0; starts[count + 1] as usize];
        for (code, v) in delaunay
            .cells
            .iter()
            .flatten()
            .enumerate()
            .filter(|(_, v)| **v != GHOST)
        {
            let at = &mut starts[*v as usize + 1];
            corners[*at as usize] = code as u32;
            *at += 1;
        }
        starts.pop();
        Self { starts, corners }
    }

    /// The corners at `v`.
    #[inline]
    pub fn of(&self, v: u32) -> &[u32] {
        &self.corners[self.starts[v as usize] as usize..self.starts[v as usize + 1] as usize]
    }
}

/// A cell and one of its corners from their number.
#[inline]
pub fn corner(code: u32) -> (u32, usize) {
    (code >> 2, (code & 3) as usize)
}

/// Where the marks of the facet opposite corner `at` of `cell` are kept: with the lower-numbered of its two cells.
#[inline]
pub fn facet(delaunay: &Delaunay, cell: u32, at: usize) -> u32 {
    let neighbor = delaunay.neighbors[cell as usize][at];
    if cell < neighbor {
        cell << 2 | at as u32
    } else {
        neighbor << 2 | delaunay.mirror(cell, neighbor) as u32
    }
}

/// The vertices of the facet opposite a corner.
#[inline]
pub fn vertices(delaunay: &Delaunay, facet: u32) -> [u32; 3] {
    let (cell, at) = corner(facet);
    let c = delaunay.cells[cell as usize];
    super::delaunay::FACETS[at].map(|k| c[k])
}

/// Sizes of facets and marks on them.
pub struct Facets {
    /// For each corner of each cell the circumradius, mm times scale, of the facet opposite; infinite for facets with a ghost.
    radii: Vec<[f32; 4]>,
    /// Bits, at the lower-numbered cell: which corners have the facet in their umbrella, and [`GABRIEL`].
    marks: Vec<[AtomicU8; 4]>,
}

/// Mark of a facet whose smallest sphere through its corners holds no point.
const GABRIEL: u8 = 1 << 4;

impl Facets {
    /// Measures all facets.
    pub fn new(delaunay: &Delaunay) -> Self {
        let measured = (0..delaunay.cells.len() as u32).into_par_iter();
        let (radii, marks) = measured.map(|cell| measure(delaunay, cell)).unzip();
        Self { radii, marks }
    }

    /// Circumradius of a facet.
    #[inline]
    pub fn radius(&self, cell: u32, at: usize) -> f32 {
        self.radii[cell as usize][at]
    }

    #[inline]
    fn bits(&self, facet: u32) -> u8 {
        self.marks[(facet >> 2) as usize][(facet & 3) as usize].load(Ordering::Relaxed)
    }

    /// Whether no point lies in the smallest sphere through the facet's corners.
    #[inline]
    pub fn is_gabriel(&self, facet: u32) -> bool {
        self.bits(facet) & GABRIEL != 0
    }

    /// In how many of the three umbrellas the facet is (the absolute matching index of Ma 2011, §3.3.3).
    #[inline]
    pub fn matches(&self, facet: u32) -> u32 {
        (self.bits(facet) & 0xf).count_ones()
    }

    /// Whether the facet is in the umbrella of its vertex `v`.
    #[inline]
    pub fn is_in_umbrella_of(&self, delaunay: &Delaunay, facet: u32, v: u32) -> bool {
        self.bits(facet) & place_bit(delaunay, facet, v) != 0
    }

    /// Puts the facet into the umbrella of `v`, or takes it out. Different vertices do not disturb one another.
    pub fn set(&self, delaunay: &Delaunay, facet: u32, v: u32, into: bool) {
        let mark = &self.marks[(facet >> 2) as usize][(facet & 3) as usize];
        let bit = place_bit(delaunay, facet, v);
        if into {
            mark.fetch_or(bit, Ordering::Relaxed);
        } else {
            mark.fetch_and(!bit, Ordering::Relaxed);
        }
    }
}

#[inline]
fn place_bit(delaunay: &Delaunay, facet: u32, v: u32) -> u8 {
    let c = delaunay.cells[(facet >> 2) as usize];
    if c[0] == v {
        1
    } else if c[1] == v {
        2
    } else if c[2] == v {
        4
    } else {
        8
    }
}

fn measure(delaunay: &Delaunay, cell: u32) -> ([f32; 4], [AtomicU8; 4]) {
    let mut radii = [f32::INFINITY; 4];
    let mut marks = [0u8; 4];
    for at in 0..4 {
        let mut corners = vertices(delaunay, cell << 2 | at as u32);
        if corners.contains(&GHOST) {
            continue;
        }
        // The same order from both sides, for the same rounding.
        corners.sort_unstable();
        let [a, b, c] = corners.map(|v| delaunay.points[v as usize]);
        let (centre, squared) = circle(a, b, c);
        radii[at] = squared.sqrt() as f32;
        let neighbor = delaunay.neighbors[cell as usize][at];
        if cell < neighbor {
            // A point on the sphere up to rounding is not in it: grids are full of them.
            let holds = |v: u32| {
                v != GHOST
                    && delaunay.points[v as usize].distance_squared(centre) < squared * (1.0 - 1e-9)
            };
            let is_empty =
                !holds(delaunay.cells[cell as usize][at]) && !holds(delaunay.across(cell, at));
            marks[at] = if is_empty { GABRIEL } else { 0 };
        }
    }
    (radii, marks.map(AtomicU8::new))
}

/// Centre and squared radius of the circle through three points; infinite for three on a line.
pub fn circle(a: DVec3, b: DVec3, c: DVec3) -> (DVec3, f64) {
    let (u, v) = (b - a, c - a);
    let n = u.cross(v);
    let way = (n.cross(u) * v.length_squared() + v.cross(n) * u.length_squared())
        / (2.0 * n.length_squared());
    if way.is_finite() {
        (a + way, way.length_squared())
    } else {
        (a, f64::INFINITY)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_circle_goes_through_its_points() {
        let [a, b, c] = [
            DVec3::new(1.0, 2.0, 3.0),
            DVec3::new(4.0, -1.0, 0.5),
            DVec3::new(-2.0, 0.0, 1.0),
        ];
        let (centre, squared) = circle(a, b, c);
        for p in [a, b, c] {
            assert!(
                (p.distance_squared(centre) - squared).abs() < 1e-12 * squared,
                "rounding"
            );
        }
        assert!((b - a).cross(c - a).dot(centre - a).abs() < 1e-12);
        assert_eq!(circle(a, a, b).1, f64::INFINITY);
    }
}

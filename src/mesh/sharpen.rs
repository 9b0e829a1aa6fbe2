//! Edges of the mesh laid along the sharp edges of the part.
//!
//! We differ: the cone of the thesis works only while umbrellas are matched, and takes part only where they do not match at once (Ma 2011,
//! §5.4.3). Afterwards cells are turned, up to three neighbours at a time, where that gathers the bends of the surface on fewer and shorter
//! edges: one cell that fills the four corners of two triangles exchanges their diagonal. The mesh stays made of Delaunay facets: it cannot
//! cross itself.

use glam::DVec3;

use super::defect::{Ring, change_of_right, defect};
use super::delaunay::{Delaunay, GHOST};
use super::star::Stars;

/// Rounds over all cells; later ones change next to nothing.
const MOST_ROUNDS: usize = 8;
/// A change gains at least this share of the bends it touches: less is rounding.
const LEAST_GAIN: f64 = 1e-6;
/// Two and three cells are tried together where the surface turns by at least this angle, rad: on a smooth surface one cell is enough.
const SHARP: f64 = 0.35;

/// Turns cells until none gains; the number of changes.
pub fn sharpen(delaunay: &Delaunay, stars: &Stars, inside: &mut [bool]) -> usize {
    let mut work = Work {
        delaunay,
        stars,
        inside,
        ring: Ring::default(),
        edges: Vec::new(),
        corners: Vec::new(),
    };
    let mut changed = 0;
    let mut cells: Vec<u32> = (0..delaunay.cells.len() as u32)
        .filter(|c| !delaunay.is_ghost(*c))
        .collect();
    for _ in 0..MOST_ROUNDS {
        let mut next = Vec::new();
        for &cell in &cells {
            let exposed = work.exposed(cell);
            if exposed == 0 {
                continue;
            }
            let mut turned = exposed == 2 && work.try_turning(&[cell]);
            if !turned && work.is_sharp_at(cell) {
                let side = work.inside[cell as usize];
                let beside = delaunay.neighbors[cell as usize];
                let may_follow =
                    |w: &Work, n: u32| !delaunay.is_ghost(n) && w.inside[n as usize] == side;
                turned = beside
                    .into_iter()
                    .any(|n| may_follow(&work, n) && work.try_turning(&[cell, n]));
                turned = turned
                    || beside.into_iter().any(|n| {
                        may_follow(&work, n)
                            && (beside.into_iter().filter(|m| *m > n))
                                .chain(
                                    delaunay.neighbors[n as usize]
                                        .into_iter()
                                        .filter(|m| *m != cell),
                                )
                                .any(|m| may_follow(&work, m) && work.try_turning(&[cell, n, m]))
                    });
            }
            if turned {
                changed += 1;
                for v in delaunay.cells[cell as usize] {
                    next.extend(stars.of(v).iter().map(|code| code >> 2));
                }
            }
        }
        if next.is_empty() {
            break;
        }
        next.sort_unstable();
        next.dedup();
        next.retain(|c| !delaunay.is_ghost(*c));
        cells = next;
    }
    changed
}

struct Work<'a> {
    delaunay: &'a Delaunay,
    stars: &'a Stars,
    inside: &'a mut [bool],
    ring: Ring,
    /// Edges at stake: a cell and the places of their ends in it.
    edges: Vec<((u32, u32), u32, [usize; 2])>,
    corners: Vec<u32>,
}

impl Work<'_> {
    /// Facets of a cell that are on the surface.
    fn exposed(&self, cell: u32) -> usize {
        let own = self.inside[cell as usize];
        let beside = self.delaunay.neighbors[cell as usize];
        beside
            .iter()
            .filter(|n| self.inside[**n as usize] != own)
            .count()
    }

    /// Whether the surface turns sharply at an edge of the cell.
    fn is_sharp_at(&self, cell: u32) -> bool {
        let length = |w: &Self, i: usize, j: usize| {
            let [a, b] = [i, j].map(|k| w.delaunay.cells[cell as usize][k]);
            w.delaunay.points[a as usize].distance(w.delaunay.points[b as usize])
        };
        let own = self.inside[cell as usize];
        let beside = self.delaunay.neighbors[cell as usize];
        let is_exposed = beside.map(|n| self.inside[n as usize] != own);
        (0..4).any(|i| {
            (0..i).any(|j| {
                if !(0..4).any(|k| k != i && k != j && is_exposed[k]) {
                    return false;
                }
                let bend = self.bend_at(cell, [i, j]);
                bend.is_some_and(|b| b > SHARP.sqrt() * length(self, i, j))
            })
        })
    }

    /// Turns cells if that leaves all vertices right and the bends less.
    fn try_turning(&mut self, cells: &[u32]) -> bool {
        if !self.keeps_count(cells) {
            return false;
        }
        self.edges.clear();
        self.corners.clear();
        for &cell in cells {
            let corners = self.delaunay.cells[cell as usize];
            self.corners.extend(corners);
            for i in 0..4 {
                for j in 0..i {
                    let (a, b) = (corners[i].min(corners[j]), corners[i].max(corners[j]));
                    self.edges.push(((a, b), cell, [i, j]));
                }
            }
        }
        self.edges.sort_unstable();
        self.edges.dedup_by_key(|e| e.0);
        self.corners.sort_unstable();
        self.corners.dedup();
        let Some(before) = self.bends() else {
            return false;
        };
        self.flip(cells);
        let after = self.bends();
        let gains = after.is_some_and(|after| before - after > LEAST_GAIN * before);
        self.flip(cells);
        // Vertices that were wrong before stay as they are.
        let may_turn = gains && self.are_right() && self.stay_right(cells);
        if may_turn {
            self.flip(cells);
        }
        may_turn
    }

    /// Whether the surface has as many triangles after cells, all on one side, are turned: through the same vertices another number is another
    /// number of pieces or handles.
    fn keeps_count(&self, cells: &[u32]) -> bool {
        let beside = cells
            .iter()
            .flat_map(|c| self.delaunay.neighbors[*c as usize]);
        let is_across = |n: u32| self.inside[n as usize] != self.inside[cells[0] as usize];
        let sum: i32 = beside
            .filter(|n| !cells.contains(n))
            .map(|n| if is_across(n) { -1 } else { 1 })
            .sum();
        sum == 0
    }

    /// Whether vertices that are right are so after cells are turned.
    fn stay_right(&mut self, cells: &[u32]) -> bool {
        if let [cell] = cells {
            let mut corners = self.corners.iter();
            return corners.all(|v| change_of_right(self.delaunay, self.inside, *v, *cell) == 0);
        }
        self.flip(cells);
        let are_right = self.are_right();
        self.flip(cells);
        are_right
    }

    fn flip(&mut self, cells: &[u32]) {
        for &cell in cells {
            self.inside[cell as usize] ^= true;
        }
    }

    fn are_right(&mut self) -> bool {
        let (ring, inside) = (&mut self.ring, &*self.inside);
        let mut corners = self.corners.iter();
        corners.all(|v| defect(self.delaunay, self.stars, inside, *v, ring) == 0)
    }

    /// Sum of the bends of the edges at stake, or none where more than two triangles meet at one.
    fn bends(&self) -> Option<f64> {
        let each = |e: &((u32, u32), u32, [usize; 2])| self.bend_at(e.1, e.2);
        self.edges.iter().map(each).sum()
    }

    /// The bend of the surface at the edge between two corners of a cell: 0 where it is not on the surface, none where more than two triangles meet.
    fn bend_at(&self, cell: u32, ends: [usize; 2]) -> Option<f64> {
        let [a, b] = ends.map(|k| self.delaunay.cells[cell as usize][k]);
        let mut thirds = [GHOST; 2];
        let mut found = 0;
        // Around the edge: out of each cell by the facet that it was not entered by.
        let mut enter = (0..4).find(|k| !ends.contains(k))?;
        let mut at = cell;
        loop {
            let corners = self.delaunay.cells[at as usize];
            let exit = (0..4).find(|k| *k != enter && corners[*k] != a && corners[*k] != b)?;
            let next = self.delaunay.neighbors[at as usize][exit];
            if self.inside[at as usize] != self.inside[next as usize] {
                if found == 2 {
                    return None;
                }
                // The facet opposite `exit` has the corner entered opposite to.
                thirds[found] = corners[enter];
                found += 1;
            }
            // The facet shared has `corners[enter]`; in the next cell the one to leave by is opposite to it.
            let shared = corners[enter];
            enter = self.delaunay.mirror(at, next);
            debug_assert!(self.delaunay.cells[next as usize].contains(&shared));
            at = next;
            if at == cell {
                break;
            }
        }
        if found == 0 {
            return Some(0.0);
        }
        let point = |v: u32| self.delaunay.points[v as usize];
        Some(bend(point(a), point(b), point(thirds[0]), point(thirds[1])))
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

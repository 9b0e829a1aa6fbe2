//! The body nearest to a wish whose surface is a manifold: carved out of the hull.
//!
//! All cells inside are a body, the convex hull. From without, cells that are wished outside are taken off it as long as around every vertex
//! inside and outside stay one piece each (Boissonnat, *Geometric structures for three-dimensional shape representation*, 1984): no wish, however
//! wrong, makes a vertex wrong, and the body has no handle.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use super::defect::change_of_right;
use super::delaunay::{Delaunay, GHOST};
use super::star::Facets;

/// A cell on the surface, and the radius of the widest of its facets there.
#[derive(PartialEq)]
struct Exposed(f32, u32);

impl Eq for Exposed {}

impl Ord for Exposed {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.total_cmp(&other.0).then(other.1.cmp(&self.1))
    }
}

impl PartialOrd for Exposed {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

struct Carver<'a> {
    delaunay: &'a Delaunay,
    inside: Vec<bool>,
    /// Which vertices are on the surface of the body, not within it.
    is_reached: Vec<bool>,
}

/// Which cells are inside the body nearest to the `wish`, or, without one, the body under the narrowest facets; ghosts are outside in all.
///
/// Vertices that the surface does not reach stay within; through holes and voids stay closed by a layer of cells.
pub(super) fn carve(delaunay: &Delaunay, facets: &Facets, wish: Option<&[bool]>) -> Vec<bool> {
    let cells = 0..delaunay.cells.len() as u32;
    let mut is_reached = vec![false; delaunay.points.len()];
    let hull = delaunay
        .cells
        .iter()
        .filter(|c| c.contains(&GHOST))
        .flatten();
    hull.filter(|v| **v != GHOST)
        .for_each(|v| is_reached[*v as usize] = true);
    let mut carver = Carver {
        delaunay,
        inside: cells.map(|c| !delaunay.is_ghost(c)).collect(),
        is_reached,
    };
    carver.take_off(
        facets,
        |c| wish.is_none_or(|wish| !wish[c as usize]),
        wish.is_none(),
    );
    carver.inside
}

impl Carver<'_> {
    /// Cells one by one, those under the widest facets first.
    fn take_off(&mut self, facets: &Facets, is_unwanted: impl Fn(u32) -> bool, by_width: bool) {
        /// A cell that could not be taken off is tried again when others have gone; seldom more than twice.
        const ROUNDS: usize = 8;
        let cells = 0..self.inside.len() as u32;
        let mut waiting: Vec<u32> = cells
            .filter(|c| self.inside[*c as usize] && is_unwanted(*c))
            .collect();
        for _ in 0..ROUNDS {
            let mut heap: BinaryHeap<Exposed> = (waiting.iter())
                .filter_map(|c| self.exposed(facets, *c))
                .collect();
            let before = waiting.len();
            while let Some(Exposed(_, cell)) = heap.pop() {
                let may_go =
                    self.inside[cell as usize] && (!by_width || self.narrows(facets, cell));
                if may_go && self.try_without(cell) {
                    for n in self.delaunay.neighbors[cell as usize] {
                        if self.inside[n as usize] && is_unwanted(n) {
                            heap.extend(self.exposed(facets, n));
                        }
                    }
                }
            }
            waiting.retain(|c| self.inside[*c as usize]);
            if waiting.len() == before {
                break;
            }
        }
    }

    /// The cell, where a facet of it is on the surface.
    fn exposed(&self, facets: &Facets, cell: u32) -> Option<Exposed> {
        let beside = self.delaunay.neighbors[cell as usize];
        let radii = (0..4)
            .filter(|at| !self.inside[beside[*at] as usize])
            .map(|at| facets.radius(cell, at));
        radii.max_by(f32::total_cmp).map(|r| Exposed(r, cell))
    }

    /// Whether the surface reaches a vertex more, or becomes narrower, without a cell.
    fn narrows(&self, facets: &Facets, cell: u32) -> bool {
        let beside = self.delaunay.neighbors[cell as usize];
        let widest = |side: bool| {
            let radii = (0..4)
                .filter(|at| self.inside[beside[*at] as usize] == side)
                .map(|at| facets.radius(cell, at));
            radii.fold(0.0, f32::max)
        };
        let corners = self.delaunay.cells[cell as usize];
        corners.iter().any(|v| !self.is_reached[*v as usize]) || widest(false) > widest(true)
    }

    /// Takes a cell off where that makes no vertex wrong that was right or within; whether it did.
    fn try_without(&mut self, cell: u32) -> bool {
        let corners = self.delaunay.cells[cell as usize];
        // A first cell off a vertex within leaves inside and outside one piece each.
        let stays_right = |v: &u32| {
            !self.is_reached[*v as usize]
                || change_of_right(self.delaunay, &self.inside, *v, cell) == 0
        };
        let may_go = corners.iter().all(stays_right);
        if may_go {
            self.inside[cell as usize] = false;
            corners
                .iter()
                .for_each(|v| self.is_reached[*v as usize] = true);
        }
        may_go
    }
}

//! A body whose surface is a manifold through every vertex: cells are turned from inside to outside and back until around every vertex both
//! are one piece each.
//!
//! We differ: the thesis has no such step (Ma 2011, §3.4); where it does not converge its mesh has holes.

use std::collections::HashMap;

use rayon::prelude::*;

use super::delaunay::{Delaunay, GHOST};
use super::solid::Solid;
use super::star::{Facets, Stars, corner};

/// How the mending went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Mending {
    /// Vertices around which inside and outside were not one piece each, before.
    pub before: usize,
    /// And after.
    pub after: usize,
    /// Cells turned for good.
    pub turns: usize,
}

/// Room for the look around one vertex.
#[derive(Default)]
pub(super) struct Ring {
    parent: Vec<u32>,
}

/// How far the cells around `v` are from one piece inside and one outside: 0 where they are.
pub(super) fn defect(
    delaunay: &Delaunay,
    stars: &Stars,
    inside: &[bool],
    v: u32,
    ring: &mut Ring,
) -> u32 {
    let star = stars.of(v);
    let parent = &mut ring.parent;
    parent.clear();
    parent.extend(0..star.len() as u32);
    let of = |parent: &mut Vec<u32>, mut i: u32| {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    };
    let (mut in_pieces, mut out_pieces) = (0u32, 0u32);
    for code in star {
        if inside[(code >> 2) as usize] {
            in_pieces += 1
        } else {
            out_pieces += 1
        }
    }
    for (i, code) in star.iter().enumerate() {
        let (cell, own) = corner(*code);
        let is_in = inside[cell as usize];
        for at in (0..4).filter(|at| *at != own) {
            let n = delaunay.neighbors[cell as usize][at];
            if n < cell || inside[n as usize] != is_in {
                continue;
            }
            let j = star.partition_point(|c| c >> 2 < n);
            let (a, b) = (of(parent, i as u32), of(parent, j as u32));
            if a != b {
                parent[a.max(b) as usize] = a.min(b);
                if is_in {
                    in_pieces -= 1
                } else {
                    out_pieces -= 1
                }
            }
        }
    }
    in_pieces.abs_diff(1) + out_pieces.abs_diff(1)
}

/// Turns cells until around every vertex inside and outside are one piece each, as far as it goes.
///
/// A search around one wrong vertex at a time: of all cells at the wrong vertices the one is turned that leaves the fewest wrong, among equals
/// the one that votes and sizes speak for. A turned cell rests a while, so that the search leaves blind alleys; what did not lead to fewer
/// wrong vertices is taken back. One thread; the order is that of the vertices.
pub fn mend(delaunay: &Delaunay, stars: &Stars, facets: &Facets, solid: &mut Solid) -> Mending {
    let count = delaunay.points.len() as u32;
    let inside = &solid.inside;
    let defects: Vec<u8> = (0..count)
        .into_par_iter()
        .map_init(Ring::default, |ring, v| {
            defect(delaunay, stars, inside, v, ring).min(255) as u8
        })
        .collect();
    let mut wrong: Vec<u32> = (0..count).filter(|v| defects[*v as usize] > 0).collect();
    let before = wrong.len();
    let mut search = Search {
        delaunay,
        stars,
        facets,
        solid,
        defects,
        ring: Ring::default(),
        journal: Vec::new(),
        rests: HashMap::new(),
        touched: Vec::new(),
        may_dig: false,
        pieces_before: 0,
    };
    let mut turns = 0;
    for steps in [20, 60, 200, 600] {
        search.may_dig = steps >= 200;
        for &v in &wrong {
            if search.defects[v as usize] > 0 {
                turns += search.around(v, steps);
            }
        }
        wrong.append(&mut search.touched);
        wrong.sort_unstable();
        wrong.dedup();
        wrong.retain(|v| search.defects[*v as usize] > 0);
        if wrong.is_empty() {
            break;
        }
    }
    turns += search.close_handles();
    Mending {
        before,
        after: wrong.len(),
        turns,
    }
}

struct Search<'a> {
    delaunay: &'a Delaunay,
    stars: &'a Stars,
    facets: &'a Facets,
    solid: &'a mut Solid,
    defects: Vec<u8>,
    ring: Ring,
    /// Cells turned in the present search.
    journal: Vec<u32>,
    /// Until which step a cell rests.
    rests: HashMap<u32, usize>,
    /// Vertices that a search left wrong.
    touched: Vec<u32>,
    /// Whether a search may begin with a row of cells from its vertex to the other side.
    may_dig: bool,
    pieces_before: usize,
}

/// Wrong vertices whose cells are looked at for one turn.
const LOOKED_AT: usize = 3;
/// Steps for which a turned cell rests: longer than the groups of cells that have to turn together.
const REST: usize = 12;

impl Search<'_> {
    /// Searches around wrong vertex `v` for at most `steps`; the number of turns that stay.
    fn around(&mut self, v: u32, steps: usize) -> usize {
        self.journal.clear();
        self.rests.clear();
        let mut wrong = vec![v];
        let (mut sum, mut best_sum, mut best_length) = (0i32, 0i32, 0);
        if self.may_dig {
            for cell in self.row_to_other_side(v) {
                sum += self.change_of_turning(cell);
                self.turn(cell);
                wrong.extend(self.delaunay.cells[cell as usize]);
            }
            wrong.sort_unstable();
            wrong.dedup();
            if sum < best_sum {
                (best_sum, best_length) = (sum, self.journal.len());
            }
        }
        for step in 0..steps {
            wrong.retain(|w| self.defects[*w as usize] > 0);
            if wrong.is_empty() {
                break;
            }
            let mut best: Option<(i32, f32, u32)> = None;
            for w in wrong.iter().rev().take(LOOKED_AT) {
                self.best_turn(*w, step, &mut best);
            }
            let Some((change, _, cell)) = best else { break };
            self.turn(cell);
            self.rests.insert(cell, step + REST + cell as usize % 5);
            for c in self.delaunay.cells[cell as usize] {
                if self.defects[c as usize] > 0 && !wrong.contains(&c) {
                    wrong.push(c);
                }
            }
            sum += change;
            if sum < best_sum {
                (best_sum, best_length) = (sum, self.journal.len());
            }
        }
        while self.journal.len() > best_length {
            let Some(cell) = self.journal.pop() else {
                break;
            };
            self.turn(cell);
            self.journal.pop();
        }
        for cell in &self.journal {
            self.touched.extend(self.delaunay.cells[*cell as usize]);
        }
        self.journal.len()
    }

    /// Closes handles and voids that no vertex needs: where turning a cell would make the surface smaller but leaves vertices wrong, turns it
    /// and looks whether the rest follows. Kept is what ends with no vertex wrong, fewer triangles and smaller ones.
    fn close_handles(&mut self) -> usize {
        let mut turns = 0;
        self.pieces_before = self.pieces();
        for _ in 0..4 {
            let mut closed = 0;
            for cell in 0..self.delaunay.cells.len() as u32 {
                if self.is_blocked(cell) {
                    closed += self.follow(cell);
                }
            }
            turns += closed;
            if closed == 0 {
                break;
            }
        }
        turns
    }

    /// Pieces of the surface that hang together.
    fn pieces(&self) -> usize {
        let triangles = super::solid::surface(self.delaunay, &self.solid.inside);
        let mut groups = super::check::Groups::new(self.delaunay.points.len());
        let joined = (triangles.iter())
            .flat_map(|t| [(t[0], t[1]), (t[0], t[2])])
            .filter(|(a, b)| groups.join(*a, *b))
            .count();
        self.delaunay.points.len() - joined
    }

    /// Whether turning the cell would make the surface smaller, but not without vertices that are wrong.
    fn is_blocked(&mut self, cell: u32) -> bool {
        let corners = self.delaunay.cells[cell as usize];
        let (triangles, _) = self.growth_of_turning(cell);
        triangles <= 0
            && self.solid.votes[cell as usize].unsigned_abs() <= 4
            && !corners.contains(&GHOST)
            && corners.iter().all(|c| self.defects[*c as usize] == 0)
            && self.change_of_turning(cell) > 0
    }

    /// Turns a cell and what has to follow; the number of turns, none where it came to nothing.
    fn follow(&mut self, cell: u32) -> usize {
        const STEPS: usize = 16;
        self.journal.clear();
        self.rests.clear();
        let (mut triangles, mut growth) = (0, 0.0);
        let mut wrong: Vec<u32> = Vec::new();
        let mut next = Some(cell);
        for step in 0..STEPS {
            let Some(cell) = next else { break };
            let grown = self.growth_of_turning(cell);
            (triangles, growth) = (triangles + grown.0, growth + grown.1);
            self.turn(cell);
            self.rests.insert(cell, usize::MAX);
            for c in self.delaunay.cells[cell as usize] {
                if self.defects[c as usize] > 0 && !wrong.contains(&c) {
                    wrong.push(c);
                }
            }
            wrong.retain(|w| self.defects[*w as usize] > 0);
            if wrong.is_empty() {
                break;
            }
            let mut best: Option<(i32, f32, u32)> = None;
            for w in wrong.iter().rev().take(LOOKED_AT) {
                self.best_turn(*w, step, &mut best);
            }
            next = best.map(|b| b.2);
        }
        if wrong.is_empty() && triangles < 0 && growth < 0.0 {
            // Fewer triangles with the same vertices: a handle less, or a piece more.
            let pieces = self.pieces();
            if pieces <= self.pieces_before {
                self.pieces_before = pieces;
                return self.journal.len();
            }
        }
        while let Some(cell) = self.journal.pop() {
            self.turn(cell);
            self.journal.pop();
        }
        0
    }

    /// How many triangles the surface has more after turning a cell, and how much larger the sum of their radii is.
    fn growth_of_turning(&self, cell: u32) -> (i32, f32) {
        let inside = self.solid.inside[cell as usize];
        (0..4).fold((0, 0.0), |(triangles, growth), at| {
            let n = self.delaunay.neighbors[cell as usize][at];
            let radius = self.facets.radius(cell, at).min(1e30);
            if self.solid.inside[n as usize] == inside {
                (triangles + 1, growth + radius)
            } else {
                (triangles - 1, growth - radius)
            }
        })
    }

    /// A shortest row of cells from the star of `v` to a cell of the other side, without that one; empty where the star has both sides.
    fn row_to_other_side(&self, v: u32) -> Vec<u32> {
        const MOST: usize = 2_000;
        let star = self.stars.of(v);
        let side = |cell: u32| self.solid.inside[cell as usize];
        let own = side(star[0] >> 2);
        if star.iter().any(|c| side(c >> 2) != own) {
            return Vec::new();
        }
        let mut found: Vec<(u32, usize)> = Vec::new();
        let mut seen: std::collections::HashSet<u32> = std::collections::HashSet::new();
        for code in star {
            if !self.delaunay.is_ghost(code >> 2) && seen.insert(code >> 2) {
                found.push((code >> 2, usize::MAX));
            }
        }
        let mut at = 0;
        while at < found.len().min(MOST) {
            for n in self.delaunay.neighbors[found[at].0 as usize] {
                if side(n) != own {
                    let mut row = Vec::new();
                    let mut from = at;
                    while from != usize::MAX {
                        row.push(found[from].0);
                        from = found[from].1;
                    }
                    return row;
                }
                if !self.delaunay.is_ghost(n) && seen.insert(n) {
                    found.push((n, at));
                }
            }
            at += 1;
        }
        Vec::new()
    }

    fn best_turn(&mut self, v: u32, step: usize, best: &mut Option<(i32, f32, u32)>) {
        for code in self.stars.of(v) {
            let cell = code >> 2;
            let corners = self.delaunay.cells[cell as usize];
            let rests = self.rests.get(&cell).is_some_and(|until| *until > step);
            // A cell that hangs on nothing of its new side would be a body, or a void, of its own.
            let side = self.solid.inside[cell as usize];
            let hangs = |n: &u32| self.solid.inside[*n as usize] != side;
            let neighbors = self.delaunay.neighbors[cell as usize];
            if rests || corners.contains(&GHOST) || !neighbors.iter().any(hangs) {
                continue;
            }
            let change = self.change_of_turning(cell);
            let cost = self.cost_of_turning(cell);
            let is_better = best.is_none_or(|(c, w, b)| (change, cost, cell) < (c, w, b));
            if is_better {
                *best = Some((change, cost, cell));
            }
        }
    }

    fn turn(&mut self, cell: u32) {
        self.solid.inside[cell as usize] ^= true;
        self.journal.push(cell);
        for c in self.delaunay.cells[cell as usize] {
            let now = defect(
                self.delaunay,
                self.stars,
                &self.solid.inside,
                c,
                &mut self.ring,
            );
            self.defects[c as usize] = now.min(255) as u8;
        }
    }

    /// How many more defects there are after turning a cell.
    fn change_of_turning(&mut self, cell: u32) -> i32 {
        self.solid.inside[cell as usize] ^= true;
        let mut change = 0;
        for c in self.delaunay.cells[cell as usize] {
            let now = defect(
                self.delaunay,
                self.stars,
                &self.solid.inside,
                c,
                &mut self.ring,
            );
            change += now.min(255) as i32 - i32::from(self.defects[c as usize]);
        }
        self.solid.inside[cell as usize] ^= true;
        change
    }

    fn cost_of_turning(&self, cell: u32) -> f32 {
        cost_of_turning(self.delaunay, self.facets, self.solid, cell)
    }
}

/// What speaks against turning a cell: growth of the surface's facets, in mean facets of the cell, and its corners' votes.
pub(super) fn cost_of_turning(
    delaunay: &Delaunay,
    facets: &Facets,
    solid: &Solid,
    cell: u32,
) -> f32 {
    let inside = solid.inside[cell as usize];
    let (mut growth, mut sum) = (0.0, 0.0);
    for at in 0..4 {
        let n = delaunay.neighbors[cell as usize][at];
        let radius = facets.radius(cell, at).min(1e30);
        growth += if solid.inside[n as usize] == inside {
            radius
        } else {
            -radius
        };
        sum += radius;
    }
    let votes = f32::from(solid.votes[cell as usize]);
    4.0 * growth / sum + if inside { 0.5 * votes } else { -0.5 * votes }
}

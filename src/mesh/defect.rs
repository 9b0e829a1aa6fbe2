//! How far the cells around a vertex are from one piece inside and one outside, and what turning one of them changes.

use super::delaunay::Delaunay;
use super::star::{Stars, corner};

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

/// For every cell of a vertex's star the three beside it there, by their places in the star.
pub(super) fn beside(delaunay: &Delaunay, star: &[u32]) -> Vec<[u32; 3]> {
    let each = |code: &u32| {
        let (cell, own) = corner(*code);
        let neighbors = delaunay.neighbors[cell as usize];
        let place = |k: usize| {
            let n = neighbors[if k < own { k } else { k + 1 }];
            star.partition_point(|c| c >> 2 < n) as u32
        };
        [0, 1, 2].map(place)
    };
    star.iter().map(each).collect()
}

/// How many more defects `v`, which has none, has after a cell there is turned.
///
/// Around it inside and outside are a disk each. The cells at the edge from `v` to another corner of the cell tell whether the border of the disks
/// passes there.
pub(super) fn change_of_right(delaunay: &Delaunay, inside: &[bool], v: u32, cell: u32) -> i8 {
    let own = inside[cell as usize];
    let corners = delaunay.cells[cell as usize];
    let others = (0..4).filter(|k| corners[*k] != v);
    let neighbors = delaunay.neighbors[cell as usize];
    let is_across = |k: usize| inside[neighbors[k] as usize] != own;
    // How many of the three sides of the cell are on the border.
    match others.clone().filter(|k| is_across(*k)).count() {
        // The other side falls into two, and the own into as many as corners on the border part.
        0 => {
            let on_border = others
                .filter(|k| !is_one_around(delaunay, inside, cell, (v, corners[*k])))
                .count();
            on_border.max(1) as i8
        }
        // The corner opposite to the side on the border.
        1 => {
            let mut opposite = others.filter(|k| is_across(*k));
            let parts = opposite.any(|k| !is_one_around(delaunay, inside, cell, (v, corners[k])));
            i8::from(parts)
        }
        2 => 0,
        _ => 1,
    }
}

/// Whether all cells around the edge between two corners of a cell are on its side.
fn is_one_around(delaunay: &Delaunay, inside: &[bool], cell: u32, (a, b): (u32, u32)) -> bool {
    let own = inside[cell as usize];
    let corners = delaunay.cells[cell as usize];
    let is_end = |v: u32| v == a || v == b;
    // Out of each cell by the facet that it was not entered by.
    let mut enter = (0..4).find(|k| !is_end(corners[*k])).unwrap_or(0);
    let mut at = cell;
    loop {
        let corners = delaunay.cells[at as usize];
        let exit = (0..4).find(|k| *k != enter && !is_end(corners[*k]));
        let next = delaunay.neighbors[at as usize][exit.unwrap_or(enter)];
        if inside[next as usize] != own {
            return false;
        }
        if next == cell {
            return true;
        }
        enter = delaunay.mirror(at, next);
        at = next;
    }
}

/// What is known of a wrong vertex.
pub(super) struct Look {
    /// For every cell of its star the three beside it there.
    pub beside: Vec<[u32; 3]>,
    /// For every cell of its star how many more defects turning it makes there; empty where a cell has turned since.
    pub changes: Vec<i8>,
}

/// Room for the look at all cells around one vertex.
#[derive(Default)]
pub(super) struct Around {
    /// When each cell was reached, from 1 on, and the earliest that is reached from behind it.
    reached: Vec<u32>,
    earliest: Vec<u32>,
    /// The piece that each cell is of.
    piece: Vec<u32>,
    /// Into how many pieces its own falls without it.
    falls_into: Vec<u32>,
    /// Cells on the way, each with where it was come from and how many of those beside it have been looked at.
    way: Vec<(u32, u32, usize)>,
}

impl Around {
    /// For every cell of a vertex's star how many more defects the vertex has after the cell is turned, into `changes`; [`beside`] tells what is beside
    /// it.
    ///
    /// All at once in time linear in the star: a cell whose piece falls apart without it is an articulation of the piece (Tarjan, *Depth-first
    /// search and linear graph algorithms*, 1972).
    pub fn changes(
        &mut self,
        star: &[u32],
        beside: &[[u32; 3]],
        inside: &[bool],
        changes: &mut Vec<i8>,
    ) {
        let count = star.len();
        let is_in = |i: u32| inside[(star[i as usize] >> 2) as usize];
        for list in [
            &mut self.reached,
            &mut self.earliest,
            &mut self.piece,
            &mut self.falls_into,
        ] {
            list.clear();
            list.resize(count, 0);
        }
        let mut pieces = [0u32; 2];
        let mut time = 0;
        for start in 0..count as u32 {
            if self.reached[start as usize] == 0 {
                pieces[usize::from(is_in(start))] += 1;
                self.walk(start, &mut time, beside, is_in);
            }
        }
        let change = |i: u32| {
            let side = is_in(i);
            let [own, other] = [side, !side].map(|s| i64::from(pieces[usize::from(s)]));
            let across =
                beside[i as usize].map(|j| (is_in(j) != side).then(|| self.piece[j as usize]));
            let is_new = |k: &usize| across[*k].is_some() && !across[..*k].contains(&across[*k]);
            let joined = (0..3).filter(is_new).count() as i64;
            let own_after = own - 1 + i64::from(self.falls_into[i as usize]);
            let other_after = other + 1 - joined;
            let far = |pieces: i64| (pieces - 1).abs();
            // Each side gains or loses two pieces at the most.
            (far(own_after) + far(other_after) - far(own) - far(other)) as i8
        };
        changes.clear();
        changes.extend((0..count as u32).map(change));
    }

    /// Walks depth first over the piece of cell `start`.
    fn walk(
        &mut self,
        start: u32,
        time: &mut u32,
        beside: &[[u32; 3]],
        is_in: impl Fn(u32) -> bool,
    ) {
        let reach = |around: &mut Self, i: u32, from: u32, time: &mut u32| {
            *time += 1;
            around.reached[i as usize] = *time;
            around.earliest[i as usize] = *time;
            around.piece[i as usize] = start;
            around.way.push((i, from, 0));
        };
        let side = is_in(start);
        reach(self, start, start, time);
        while let Some((i, from, looked)) = self.way.last_mut() {
            let (i, from) = (*i, *from);
            if *looked == 3 {
                self.way.pop();
                if i != start {
                    let earliest = self.earliest[i as usize];
                    let before = &mut self.earliest[from as usize];
                    *before = (*before).min(earliest);
                    // Without `from` nothing leads from here to what was reached before it.
                    if earliest >= self.reached[from as usize] {
                        self.falls_into[from as usize] += 1;
                    }
                    // And what is before it is one more.
                    self.falls_into[i as usize] += 1;
                }
                continue;
            }
            let j = beside[i as usize][*looked];
            *looked += 1;
            if is_in(j) != side || j == from {
                continue;
            }
            match self.reached[j as usize] {
                0 => reach(self, j, i, time),
                when => {
                    let own = &mut self.earliest[i as usize];
                    *own = (*own).min(when);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    #[test]
    fn changes_are_what_turning_each_cell_makes_of_the_defect() {
        // Any sides at all: most are far from one piece each.
        let at = |i: u32| {
            DVec3::new(
                f64::from(i * i % 31),
                f64::from(i * 7 % 29),
                f64::from(i * i * i % 37),
            )
        };
        let points: Vec<DVec3> = (0..120).map(at).collect();
        let delaunay = Delaunay::new(&points).expect("a body");
        let stars = Stars::new(&delaunay);
        let (mut around, mut ring) = (Around::default(), Ring::default());
        let mut right = 0;
        for share in [1u64, 3, 5, 7] {
            let is_inside = |c: u64| c.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 61 < share;
            let mut inside: Vec<bool> = (0..delaunay.cells.len() as u64).map(is_inside).collect();
            for v in 0..delaunay.points.len() as u32 {
                let star = stars.of(v);
                let mut found = Vec::new();
                around.changes(star, &beside(&delaunay, star), &inside, &mut found);
                let before = defect(&delaunay, &stars, &inside, v, &mut ring);
                for (code, change) in star.iter().zip(found) {
                    inside[(code >> 2) as usize] ^= true;
                    let after = defect(&delaunay, &stars, &inside, v, &mut ring);
                    inside[(code >> 2) as usize] ^= true;
                    let true_change = i64::from(after) - i64::from(before);
                    assert_eq!(true_change, i64::from(change));
                    if before == 0 {
                        let cell = code >> 2;
                        let local = change_of_right(&delaunay, &inside, v, cell);
                        assert_eq!(true_change, i64::from(local));
                        right += 1;
                    }
                }
            }
        }
        assert!(right > 500, "{right} cells at vertices without a defect");
        assert!(right > 500, "{right} cells at vertices without a defect");
    }
}

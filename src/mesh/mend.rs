//! A body whose surface is a manifold through every vertex: cells are turned from inside to outside and back until around every vertex both
//! are one piece each.
//!
//! We differ: the thesis has no such step (Ma 2011, §3.4); where it does not converge its mesh has holes.

use std::collections::{HashMap, HashSet, VecDeque};

use rayon::prelude::*;

use super::carve::carve;
use super::check::topology;
use super::defect::{Around, Look, Ring, beside, change_of_right, defect};
use super::delaunay::{Delaunay, GHOST};
use super::solid::{Solid, surface};
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

/// Turns cells until around every vertex inside and outside are one piece each, as far as it goes.
///
/// A search around one wrong vertex at a time: of all cells at the wrong vertices the one is turned that leaves the fewest wrong, among equals
/// the one that votes and sizes speak for. A turned cell rests a while, so that the search leaves blind alleys; what did not lead to fewer
/// wrong vertices is taken back. One thread; the order is that of the vertices. Only counted where it is not
/// wanted.
pub fn mend(
    delaunay: &Delaunay,
    stars: &Stars,
    facets: &Facets,
    solid: &mut Solid,
    is_wanted: bool,
) -> Mending {
    /// Where more than one vertex in so many is wrong, umbrellas made no body to begin with. Measured over tables 5.2 and the peers of the bench and
    /// 21 thin plates: at 5 one plate more falls apart; at 100 the noisiest body with a hole is lost, since carving knows fewer holes.
    const NO_BODY: usize = 20;
    let found = defects(delaunay, stars, &solid.inside);
    let before = found.iter().filter(|d| **d > 0).count();
    if !is_wanted || before == 0 {
        return Mending {
            before,
            after: before,
            turns: 0,
        };
    }
    let wish = solid.inside.clone();
    let all = (delaunay, stars, facets);
    let first = search(all, solid, found, None);
    if first.after == 0 && NO_BODY * before <= delaunay.points.len() {
        return first;
    }
    let mut best = (rank(delaunay, first, &solid.inside), first);
    for wish_of_carving in [Some(&*wish), None] {
        let mut other = solid.clone();
        other.inside = carve(delaunay, facets, wish_of_carving);
        let found = defects(delaunay, stars, &other.inside);
        let mending = Mending {
            before,
            ..search(all, &mut other, found, Some(&wish))
        };
        let own = rank(delaunay, mending, &other.inside);
        if own < best.0 {
            *solid = other;
            best = (own, mending);
        }
    }
    best.1
}

/// What is compared of two bodies through the same points: wrong vertices, then pieces and handles together, then the area of the surface.
fn rank(delaunay: &Delaunay, mending: Mending, inside: &[bool]) -> (usize, i64, f64) {
    let triangles = surface(delaunay, inside);
    let t = topology(delaunay.points.len(), &triangles);
    let twice = triangles.iter().map(|t| {
        let [a, b, c] = t.map(|v| delaunay.points[v as usize]);
        (b - a).cross(c - a).length()
    });
    (
        mending.after,
        2 * t.pieces as i64 - t.euler / 2,
        twice.sum(),
    )
}

/// For every vertex its defect.
fn defects(delaunay: &Delaunay, stars: &Stars, inside: &[bool]) -> Vec<u32> {
    (0..delaunay.points.len() as u32)
        .into_par_iter()
        .map_init(Ring::default, |ring, v| {
            defect(delaunay, stars, inside, v, ring)
        })
        .collect()
}

/// Searches around all vertices that have `defects`; where the body was carved, for what is left of the `wish` as well.
fn search(
    (delaunay, stars, facets): (&Delaunay, &Stars, &Facets),
    solid: &mut Solid,
    defects: Vec<u32>,
    wish: Option<&[bool]>,
) -> Mending {
    let count = delaunay.points.len() as u32;
    let mut wrong: Vec<u32> = (0..count).filter(|v| defects[*v as usize] > 0).collect();
    let before = wrong.len();
    let mut search = Search {
        delaunay,
        stars,
        facets,
        solid,
        defects,
        journal: Vec::new(),
        rests: HashMap::new(),
        touched: Vec::new(),
        looks: HashMap::new(),
        around: Around::default(),
        may_dig: false,
    };
    let mut turns = 0;
    for steps in [20, 60, 200, 600] {
        search.may_dig = steps >= 200;
        for &v in &wrong {
            if search.defects[v as usize] > 0 && !(search.may_dig && search.is_hub(v)) {
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
    turns += search.repair(&wrong);
    if let Some(wish) = wish {
        turns += search.open_plugs(wish);
    }
    turns += search.close_handles();
    // Islands that were joined to one another are joined to the rest in the next round.
    for _ in 0..4 {
        let joined = search.join_islands();
        turns += joined;
        if joined == 0 {
            break;
        }
    }
    Mending {
        before,
        after: search.defects.par_iter().filter(|d| **d > 0).count(),
        turns,
    }
}

struct Search<'a> {
    delaunay: &'a Delaunay,
    stars: &'a Stars,
    facets: &'a Facets,
    solid: &'a mut Solid,
    defects: Vec<u32>,
    /// Cells turned in the present search.
    journal: Vec<u32>,
    /// Until which step a cell rests.
    rests: HashMap<u32, usize>,
    /// Vertices that a search left wrong.
    touched: Vec<u32>,
    looks: HashMap<u32, Look>,
    around: Around,
    /// Whether a search may begin with a row of cells from its vertex to the other side.
    may_dig: bool,
}

/// Cells around a vertex above which it is a hub, as rows of points in one plane make them: looked at one by one they cost the square of their number.
/// Measured on the bench and 21 thin plates: 64, 1,024 and no such limit give the same genus, links and volumes.
const HUB: usize = 256;
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
            let may_look = |w: &&u32| **w == v || !self.is_hub(**w);
            let looked_at: Vec<u32> = (wrong.iter().rev().filter(may_look))
                .take(LOOKED_AT)
                .copied()
                .collect();
            for w in looked_at {
                self.best_turn(w, step, &mut best);
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
        self.take_back(best_length);
        for cell in &self.journal {
            self.touched.extend(self.delaunay.cells[*cell as usize]);
        }
        self.journal.len()
    }

    /// Searches wider around vertices that are still wrong, for a change after which none is.
    fn repair(&mut self, wrong: &[u32]) -> usize {
        /// Where more are wrong there is no body.
        const MOST: usize = 100;
        let mut turns = 0;
        for &v in wrong.iter().take(MOST) {
            if self.defects[v as usize] > 0 && !self.is_hub(v) {
                let mut starts: Vec<Vec<u32>> = (self.choices(v).into_iter())
                    .filter(|c| self.may_turn(*c))
                    .map(|c| vec![c])
                    .collect();
                let mut row = self.row_to_other_side(v);
                row.sort_unstable();
                starts.extend((!row.is_empty()).then_some(row));
                turns += self.best_way(starts, None);
            }
        }
        turns
    }

    /// Turns what is left of the `wish` outside, plugs in through holes, voids and bridges between bodies: a plug at once. Kept
    /// is what ends with no vertex wrong and a smaller surface, though it has a handle or a piece more.
    fn open_plugs(&mut self, wish: &[bool]) -> usize {
        let mut turns = 0;
        let mut is_seen = vec![false; wish.len()];
        for start in 0..wish.len() as u32 {
            let is_left = |s: &Self, c: u32| {
                s.solid.inside[c as usize] && !wish[c as usize] && !s.delaunay.is_ghost(c)
            };
            if is_seen[start as usize] || !is_left(self, start) {
                continue;
            }
            is_seen[start as usize] = true;
            let mut plug = vec![start];
            let mut at = 0;
            while at < plug.len() {
                for n in self.delaunay.neighbors[plug[at] as usize] {
                    if !is_seen[n as usize] && is_left(self, n) {
                        is_seen[n as usize] = true;
                        plug.push(n);
                    }
                }
                at += 1;
            }
            let (_, growth, _) = self.turn_all(&plug);
            let mut corners = plug.iter().flat_map(|c| self.delaunay.cells[*c as usize]);
            if growth < 0.0 && corners.all(|v| self.defects[v as usize] == 0) {
                turns += self.journal.len();
            } else {
                self.take_back(0);
            }
        }
        turns
    }

    /// Closes handles and voids that no vertex needs: where turning a cell would make the surface smaller but leaves vertices wrong, turns it
    /// and looks whether the rest follows. Kept is what ends with no vertex wrong, fewer triangles and smaller ones.
    fn close_handles(&mut self) -> usize {
        const STEPS: usize = 16;
        let mut turns = 0;
        for _ in 0..4 {
            let mut closed = 0;
            for cell in 0..self.delaunay.cells.len() as u32 {
                if self.is_blocked(cell) {
                    let (triangles, growth) = self.follow(cell, STEPS);
                    let is_less = triangles.is_some_and(|t| t < 0);
                    if is_less && growth < 0.0 && self.hangs_together() {
                        closed += self.journal.len();
                    } else {
                        self.take_back(0);
                    }
                }
            }
            turns += closed;
            if closed == 0 {
                break;
            }
        }
        turns
    }

    /// Turns one of the `starts`, rows of cells, and what has to follow, such that no vertex is wrong, the surface hangs together and has `wanted` triangles
    /// more, where that is said: the change with the fewest cells among those that are looked at, and of these the one after which the surface is smallest. How many
    /// cells turned; 0 where nothing was found.
    ///
    /// Breadth first, the most promising sets of each size only.
    fn best_way(&mut self, starts: Vec<Vec<u32>>, wanted: Option<i32>) -> usize {
        const WIDTH: usize = 100;
        const DEPTH: usize = 16;
        let mut front = starts;
        let mut seen: HashSet<Vec<u32>> = HashSet::new();
        for _ in 0..DEPTH {
            let mut found: Option<(f32, Vec<u32>)> = None;
            let mut next: Vec<(i32, f32, Vec<u32>)> = Vec::new();
            for set in front {
                let (triangles, growth, cost) = self.turn_all(&set);
                let corners = set.iter().flat_map(|c| self.delaunay.cells[*c as usize]);
                let mut wrong: Vec<u32> = corners
                    .filter(|v| *v != GHOST && self.defects[*v as usize] > 0)
                    .collect();
                wrong.sort_unstable();
                wrong.dedup();
                let is_better = found.as_ref().is_none_or(|f| growth < f.0);
                let is_wanted = wanted.is_none_or(|w| triangles == w);
                if wrong.is_empty() && is_wanted && is_better && self.hangs_together() {
                    found = Some((growth, set.clone()));
                }
                let sum: i32 = wrong.iter().map(|w| self.defects[*w as usize] as i32).sum();
                let near = wrong.iter().filter(|w| !self.is_hub(**w));
                let mut choice: Vec<u32> = near.flat_map(|w| self.choices(*w)).collect();
                choice.sort_unstable();
                choice.dedup();
                for cell in choice {
                    if set.contains(&cell) || !self.may_turn(cell) {
                        continue;
                    }
                    let mut larger = set.clone();
                    larger.insert(larger.partition_point(|c| *c < cell), cell);
                    if seen.insert(larger.clone()) {
                        let change = self.change_of_turning(cell);
                        next.push((sum + change, cost + self.cost_of_turning(cell), larger));
                    }
                }
                self.take_back(0);
            }
            if let Some((_, set)) = found {
                self.turn_all(&set);
                return set.len();
            }
            next.sort_unstable_by(|a, b| {
                (a.0.cmp(&b.0))
                    .then(a.1.total_cmp(&b.1))
                    .then_with(|| a.2.cmp(&b.2))
            });
            next.truncate(WIDTH);
            front = next.into_iter().map(|n| n.2).collect();
        }
        0
    }

    /// Turns cells, into an empty journal: how many triangles the surface has more, how much larger the sum of their radii is, and the cost.
    fn turn_all(&mut self, cells: &[u32]) -> (i32, f32, f32) {
        self.journal.clear();
        let mut sums = (0, 0.0, 0.0);
        for cell in cells {
            let (triangles, growth) = self.growth_of_turning(*cell);
            let cost = self.cost_of_turning(*cell);
            sums = (sums.0 + triangles, sums.1 + growth, sums.2 + cost);
            self.turn(*cell);
        }
        sums
    }

    /// Whether the cell is none at infinity and hangs on its new side: otherwise it would be a body, or a void, of its own.
    fn may_turn(&self, cell: u32) -> bool {
        let side = self.solid.inside[cell as usize];
        let mut neighbors = self.delaunay.neighbors[cell as usize].iter();
        !self.delaunay.is_ghost(cell) && neighbors.any(|n| self.solid.inside[*n as usize] != side)
    }

    /// Joins islands, closed pieces of a few vertices beside the others, to what lies nearest: a row of cells is turned, and what has to follow. Kept
    /// is what makes one piece of two without a handle.
    fn join_islands(&mut self) -> usize {
        /// Vertices of the largest island; more are a body, or a void, of its own. Measured like [`HUB`]: 20 and 500 give the same figures.
        const ISLAND: usize = 100;
        const MOST: usize = 1_000;
        let triangles = super::solid::surface(self.delaunay, &self.solid.inside);
        let count = self.delaunay.points.len();
        let mut groups = super::check::Groups::new(count);
        for t in &triangles {
            groups.join(t[0], t[1]);
            groups.join(t[0], t[2]);
        }
        let piece: Vec<u32> = (0..count as u32).map(|v| groups.of(v)).collect();
        let mut members: HashMap<u32, Vec<u32>> = HashMap::new();
        for v in 0..count as u32 {
            members.entry(piece[v as usize]).or_default().push(v);
        }
        let is_island = |m: &Vec<u32>| (4..=ISLAND).contains(&m.len());
        let mut islands: Vec<Vec<u32>> = members.into_values().filter(is_island).collect();
        islands.sort_unstable();
        // More are no islands beside a surface.
        islands.truncate(MOST);
        let mut turns = 0;
        // Pieces that have become part of another.
        let mut joined: HashSet<u32> = HashSet::new();
        for island in islands {
            if joined.contains(&piece[island[0] as usize]) {
                continue;
            }
            let mut rows: Vec<Vec<u32>> = (island.iter())
                .flat_map(|v| [false, true].map(|side| self.row_to_other_piece(*v, side, &piece)))
                .filter(|row| !row.is_empty())
                .collect();
            rows.iter_mut().for_each(|row| row.sort_unstable());
            rows.sort_unstable_by(|a, b| a.len().cmp(&b.len()).then_with(|| a.cmp(b)));
            rows.dedup();
            // Two pieces with the same vertices have four triangles less than one.
            let turned = self.best_way(rows, Some(4));
            let cells = self.journal.iter().take(turned);
            let corners = cells.flat_map(|c| self.delaunay.cells[*c as usize]);
            joined.extend(corners.map(|v| piece[v as usize]));
            turns += turned;
        }
        turns
    }

    /// A shortest row of cells on one side of the surface from `v` to a vertex of another piece, which the last of them has; empty where there is none.
    fn row_to_other_piece(&self, v: u32, inside: bool, piece: &[u32]) -> Vec<u32> {
        const MOST: usize = 2_000;
        let own = piece[v as usize];
        let goes = |c: u32| self.solid.inside[c as usize] == inside && !self.delaunay.is_ghost(c);
        let start = self.stars.of(v).iter().map(|code| code >> 2);
        let mut found: Vec<(u32, usize)> = start
            .filter(|c| goes(*c))
            .map(|c| (c, usize::MAX))
            .collect();
        let mut seen: HashSet<u32> = found.iter().map(|f| f.0).collect();
        let mut at = 0;
        while at < found.len().min(MOST) {
            let cell = found[at].0;
            let is_other = |u: &u32| piece[*u as usize] != own;
            if self.delaunay.cells[cell as usize].iter().any(is_other) {
                let mut row = Vec::new();
                let mut from = at;
                while from != usize::MAX {
                    row.push(found[from].0);
                    from = found[from].1;
                }
                row.reverse();
                return row;
            }
            for n in self.delaunay.neighbors[cell as usize] {
                if goes(n) && seen.insert(n) {
                    found.push((n, at));
                }
            }
            at += 1;
        }
        Vec::new()
    }

    /// Whether turning the cell would make the surface smaller, but not without vertices that are wrong.
    fn is_blocked(&mut self, cell: u32) -> bool {
        let corners = self.delaunay.cells[cell as usize];
        let (triangles, _) = self.growth_of_turning(cell);
        triangles <= 0
            && self.solid.votes[cell as usize].unsigned_abs() <= 4
            && !corners.contains(&GHOST)
            && corners
                .iter()
                .all(|c| self.defects[*c as usize] == 0 && !self.is_hub(*c))
            && self.change_of_turning(cell) > 0
    }

    /// Turns a cell and what has to follow, into the journal; how many triangles the surface has more, none where vertices stay wrong, and how much
    /// larger the sum of their radii is.
    fn follow(&mut self, cell: u32, steps: usize) -> (Option<i32>, f32) {
        self.journal.clear();
        self.rests.clear();
        self.follow_on(cell, steps)
    }

    fn follow_on(&mut self, cell: u32, steps: usize) -> (Option<i32>, f32) {
        let (mut triangles, mut growth) = (0, 0.0);
        let mut wrong: Vec<u32> = Vec::new();
        for turned in &self.journal {
            wrong.extend(self.delaunay.cells[*turned as usize]);
        }
        wrong.sort_unstable();
        wrong.dedup();
        let mut next = Some(cell);
        for step in 0..steps {
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
                return (Some(triangles), growth);
            }
            let mut best: Option<(i32, f32, u32)> = None;
            for w in wrong.iter().rev().take(LOOKED_AT) {
                self.best_turn(*w, step, &mut best);
            }
            next = best.map(|b| b.2);
        }
        (None, growth)
    }

    /// Turns the cells of the journal back until `length` are left.
    fn take_back(&mut self, length: usize) {
        while self.journal.len() > length {
            let Some(cell) = self.journal.pop() else {
                return;
            };
            self.turn(cell);
            self.journal.pop();
        }
    }

    /// Whether the surface at the cells of the journal is one piece: fewer triangles with the same vertices are a handle less, or a piece more.
    ///
    /// Looks around all their corners in turn until all have met, or one has no further to go.
    fn hangs_together(&self) -> bool {
        let mut number: HashMap<u32, u32> = HashMap::new();
        let mut fronts: Vec<VecDeque<u32>> = Vec::new();
        for cell in &self.journal {
            for v in self.delaunay.cells[*cell as usize] {
                number.entry(v).or_insert_with(|| {
                    fronts.push(VecDeque::from([v]));
                    fronts.len() as u32 - 1
                });
            }
        }
        let mut groups = super::check::Groups::new(fronts.len());
        let mut parts = fronts.len();
        while parts > 1 {
            let mut open = vec![false; fronts.len()];
            for (i, front) in fronts.iter_mut().enumerate() {
                let Some(v) = front.pop_front() else {
                    continue;
                };
                self.each_neighbor(v, |u| match number.get(&u) {
                    Some(other) => parts -= usize::from(groups.join(i as u32, *other)),
                    None => {
                        number.insert(u, i as u32);
                        front.push_back(u);
                    }
                });
            }
            for (i, front) in fronts.iter().enumerate() {
                open[groups.of(i as u32) as usize] |= !front.is_empty();
            }
            if parts > 1 && (0..fronts.len()).any(|i| groups.of(i as u32) == i as u32 && !open[i]) {
                return false;
            }
        }
        true
    }

    /// Calls `with` for the other corners of the surface's triangles at `v`.
    fn each_neighbor(&self, v: u32, mut with: impl FnMut(u32)) {
        for code in self.stars.of(v) {
            let (cell, own) = corner(*code);
            if !self.solid.inside[cell as usize] {
                continue;
            }
            for at in (0..4).filter(|at| *at != own) {
                if !self.solid.inside[self.delaunay.neighbors[cell as usize][at] as usize] {
                    let corners = self.delaunay.cells[cell as usize];
                    (0..4)
                        .filter(|k| *k != at && *k != own)
                        .for_each(|k| with(corners[k]));
                }
            }
        }
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
        let mut seen: HashSet<u32> = HashSet::new();
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

    fn is_hub(&self, v: u32) -> bool {
        self.stars.of(v).len() > HUB
    }

    /// The cells that may be turned for the sake of wrong vertex `v`: all around it, but of a hub only those in or beside the smaller pieces there.
    fn choices(&self, v: u32) -> Vec<u32> {
        let star = self.stars.of(v);
        if !self.is_hub(v) {
            return star.iter().map(|code| code >> 2).collect();
        }
        let inside = &self.solid.inside;
        let mut pieces = super::check::Groups::new(star.len());
        let beside = |i: usize| {
            let (cell, own) = corner(star[i]);
            let neighbors = self.delaunay.neighbors[cell as usize];
            let others = (0..4).filter(move |at| *at != own);
            others.map(move |at| star.partition_point(|c| c >> 2 < neighbors[at]))
        };
        let is_in = |i: usize| inside[(star[i] >> 2) as usize];
        for i in 0..star.len() {
            for j in beside(i).filter(|j| *j < i && is_in(*j) == is_in(i)) {
                pieces.join(i as u32, j as u32);
            }
        }
        let piece: Vec<u32> = (0..star.len() as u32).map(|i| pieces.of(i)).collect();
        let mut sizes = vec![0usize; star.len()];
        piece.iter().for_each(|p| sizes[*p as usize] += 1);
        let largest = |side: bool| {
            let own = (0..star.len()).filter(|i| is_in(*i) == side);
            own.max_by_key(|i| sizes[piece[*i] as usize])
                .map(|i| piece[i])
        };
        let kept = [largest(false), largest(true)];
        let is_small = |i: usize| !kept.contains(&Some(piece[i]));
        let is_passed = kept.contains(&None);
        // Of a vertex that the surface passes by, cells that the surface reaches.
        let is_near = |i: usize| {
            let (cell, own) = corner(star[i]);
            inside[self.delaunay.neighbors[cell as usize][own] as usize] != is_in(i)
        };
        (0..star.len())
            .filter(|i| is_small(*i) || beside(*i).any(is_small) || (is_passed && is_near(*i)))
            .map(|i| star[i] >> 2)
            .collect()
    }

    fn best_turn(&mut self, v: u32, step: usize, best: &mut Option<(i32, f32, u32)>) {
        for cell in self.choices(v) {
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
        let corners = self.delaunay.cells[cell as usize];
        for c in corners.into_iter().filter(|c| *c != GHOST) {
            let change = self.change_at(c, cell);
            self.defects[c as usize] =
                self.defects[c as usize].saturating_add_signed(change.into());
            if let Some(look) = self.looks.get_mut(&c) {
                look.changes.clear();
            }
        }
        self.solid.inside[cell as usize] ^= true;
        self.journal.push(cell);
    }

    /// How many more defects there are after turning a cell.
    fn change_of_turning(&mut self, cell: u32) -> i32 {
        let corners = self.delaunay.cells[cell as usize];
        corners
            .map(|c| i32::from(self.change_at(c, cell)))
            .iter()
            .sum()
    }

    /// How many more defects there are around `v` after turning a cell there.
    fn change_at(&mut self, v: u32, cell: u32) -> i8 {
        /// Looks that are kept at the most.
        const KEPT: usize = 1 << 14;
        let inside = &self.solid.inside;
        if self.defects[v as usize] == 0 {
            return change_of_right(self.delaunay, inside, v, cell);
        }
        if self.looks.len() >= KEPT {
            self.looks.clear();
        }
        let star = self.stars.of(v);
        let look = self.looks.entry(v).or_insert_with(|| Look {
            beside: beside(self.delaunay, star),
            changes: Vec::new(),
        });
        if look.changes.is_empty() {
            (self.around).changes(star, &look.beside, inside, &mut look.changes);
        }
        look.changes[star.partition_point(|code| code >> 2 < cell)]
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

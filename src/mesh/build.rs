//! How points enter a triangulation: one by one along a curve, on all threads at once.
//!
//! Each point clears the cells whose spheres hold it and fills the cavity with cells of its own (Bowyer 1981, Watson 1981). A thread locks the
//! cells of a cavity and those around it before it changes any; where another thread has one of them it lets go of all and puts the point
//! off. The walk to a point locks nothing: what it reads may be half changed, so the cell it ends in is tested again under lock. As the
//! triangulation is a function of the set of points alone, no order of threads shows in it once its cells are sorted.

use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU32, Ordering::*};

use glam::DVec3;
use rayon::prelude::*;

use super::delaunay::{FACETS, GHOST, place};
use super::predicates::Signs;

/// Cells a point has on average among points on a surface is below this, ghosts included; more are made room for as they come.
const CELLS_PER_POINT: f64 = 6.8;
/// Corners of a cavity up to which its facets find one another through a table.
const TABLE: usize = 64;
/// Threads that may work at once; more would get in one another's way.
const MOST_THREADS: usize = 32;
/// Points of a round for each thread below which one thread inserts them all.
const LEAST_SHARE: usize = 2_000;
/// Points a thread takes at a time.
const GRAIN: usize = 512;
/// Numbers of cells a thread takes at a time.
const BLOCK: u32 = 1_024;

/// Lock of a cell that nobody has.
const OPEN: u8 = 0;
/// Lock of a number without a cell.
const DEAD: u8 = u8::MAX;

/// A cell: corners, and the cells across the facets opposite to them.
///
/// Who has the lock may read and change both. Others may read the numbers, which are always ones of some vertex or cell, but must not rely on them.
#[derive(Default)]
#[repr(align(32))]
struct Slot {
    corners: [AtomicU32; 4],
    neighbors: [AtomicU32; 4],
}

impl Slot {
    #[inline]
    fn corners(&self) -> [u32; 4] {
        self.corners.each_ref().map(|c| c.load(Relaxed))
    }

    #[inline]
    fn neighbors(&self) -> [u32; 4] {
        self.neighbors.each_ref().map(|n| n.load(Relaxed))
    }

    /// Puts the corners in ascending order, but for the last two where that would turn the cell inside out.
    fn sort(&self) {
        let (corners, neighbors) = (self.corners(), self.neighbors());
        let mut by = [0, 1, 2, 3];
        let mut is_odd = false;
        for (i, j) in [(0, 1), (2, 3), (0, 2), (1, 3), (1, 2)] {
            if corners[by[i]] > corners[by[j]] {
                by.swap(i, j);
                is_odd = !is_odd;
            }
        }
        if is_odd {
            by.swap(2, 3);
        }
        self.set(by.map(|k| corners[k]), by.map(|k| neighbors[k]));
    }

    fn set(&self, corners: [u32; 4], neighbors: [u32; 4]) {
        for k in 0..4 {
            self.corners[k].store(corners[k], Relaxed);
            self.neighbors[k].store(neighbors[k], Relaxed);
        }
    }
}

/// The growing triangulation, which all threads see.
struct Site {
    points: Vec<DVec3>,
    signs: Signs,
    slots: Vec<Slot>,
    /// For every cell [`OPEN`], [`DEAD`], or the mark of the thread that has it.
    locks: Vec<AtomicU8>,
    /// Numbers up to this are given out.
    used: AtomicU32,
    /// Whether a thread found no number left.
    is_full: AtomicBool,
}

/// What became of a point.
enum Outcome {
    Inserted,
    /// Another thread was in the way.
    Busy,
    /// There was no number for a cell.
    Full,
}

/// Points, corners and neighbours of the triangulation of `points`, of which `first` are four positively oriented ones. `order` are all
/// vertices, `rounds` the ranges in it that double the density evenly.
///
/// The cells come sorted by their corners, and the corners of each in ascending order but for the last two, which make it positive.
pub(super) fn build(
    points: Vec<DVec3>,
    first: [u32; 4],
    order: &[u32],
    rounds: &[Range<usize>],
) -> (Vec<DVec3>, Vec<[u32; 4]>, Vec<[u32; 4]>) {
    let mut site = Site::new(points, first);
    let threads = rayon::current_num_threads().min(MOST_THREADS);
    let mut workers = vec![Worker::new(0, site.points.len())];
    let mut done = 0;
    for round in rounds {
        let vertices = &order[round.clone()];
        done += vertices.len();
        let room = (done as f64 * CELLS_PER_POINT) as usize + threads * BLOCK as usize;
        site.grow_to(room);
        if threads == 1 || vertices.len() < threads * LEAST_SHARE {
            workers[0].insert_alone(&mut site, vertices, &first);
            continue;
        }
        for tag in workers.len()..threads {
            workers.push(Worker::new(tag, site.points.len()));
        }
        insert_together(&mut site, &mut workers, vertices, &first);
    }
    site.finish()
}

/// Inserts `vertices`, in order along the curve, with all workers: each begins with a stretch of its own, and helps at the far end of others' when it
/// is done.
fn insert_together(site: &mut Site, workers: &mut [Worker], vertices: &[u32], first: &[u32; 4]) {
    let count = workers.len();
    let at = |i: usize| vertices.len() * i / count;
    let stretches: Vec<Mutex<Range<usize>>> =
        (0..count).map(|i| Mutex::new(at(i)..at(i + 1))).collect();
    loop {
        site.is_full.store(false, Relaxed);
        rayon::scope(|scope| {
            let (site, stretches) = (&*site, &stretches);
            for (own, worker) in workers.iter_mut().enumerate() {
                scope.spawn(move |_| worker.work(site, vertices, first, own, stretches));
            }
        });
        // Numbers that are left go to the one that works alone, points that were put off with them.
        let mut put_off = Vec::new();
        let (one, others) = workers.split_at_mut(1);
        put_off.append(&mut one[0].put_off);
        for other in others {
            put_off.append(&mut other.put_off);
            one[0].free.append(&mut other.free);
            one[0].free.extend(std::mem::take(&mut other.block));
        }
        one[0].insert_alone(site, &put_off, first);
        let is_done = |s: &Mutex<Range<usize>>| s.lock().is_ok_and(|s| s.is_empty());
        if stretches.iter().all(is_done) {
            return;
        }
        site.grow();
    }
}

impl Site {
    fn new(points: Vec<DVec3>, first: [u32; 4]) -> Self {
        let room = (points.len() as f64 * CELLS_PER_POINT) as usize + 64 * BLOCK as usize;
        let mut site = Self {
            signs: Signs::of(&points),
            points,
            slots: Vec::with_capacity(room),
            locks: Vec::with_capacity(room),
            used: AtomicU32::new(5),
            is_full: AtomicBool::new(false),
        };
        site.grow_to(64);
        site.slots[0].set(first, [1, 2, 3, 4]);
        for (at, facet) in FACETS.into_iter().enumerate() {
            // The ghost stands across the facet, which is seen from outside in the other sense.
            let [a, b, c] = facet.map(|k| first[k]);
            let ghost = |corner: u32| 1 + place(&first, corner) as u32;
            site.slots[1 + at].set([b, a, c, GHOST], [ghost(b), ghost(a), ghost(c), 0]);
        }
        site.locks[..5].iter().for_each(|l| l.store(OPEN, Relaxed));
        site
    }

    fn grow(&mut self) {
        self.grow_to(self.slots.len() + self.slots.len() / 4 + 2 * BLOCK as usize);
    }

    fn grow_to(&mut self, room: usize) {
        if room > self.slots.len() {
            self.slots.resize_with(room, Slot::default);
            self.locks.resize_with(room, || AtomicU8::new(DEAD));
        }
    }

    #[inline]
    fn at(&self, v: u32) -> DVec3 {
        self.points[v as usize]
    }

    /// Whether `p` lies in the sphere of a cell; the caller has its lock.
    #[inline]
    fn falls(&self, cell: u32, p: DVec3) -> bool {
        let slot = &self.slots[cell as usize];
        let corners = slot.corners();
        let Some(at) = corners.iter().position(|c| *c == GHOST) else {
            return self
                .signs
                .in_sphere_perturbed(corners.map(|c| self.at(c)), p);
        };
        let [a, b, c] = FACETS[at].map(|k| self.at(corners[k]));
        match self.signs.orient(a, b, c, p) {
            // In the plane of a hull facet the sphere of the cell behind it is the facet's circle. That cell cannot fall while
            // the ghost beside it is locked.
            0.0 => {
                let behind = &self.slots[slot.neighbors[at].load(Relaxed) as usize];
                let corners = behind.corners();
                self.signs
                    .in_sphere_perturbed(corners.map(|c| self.at(c)), p)
            }
            side => side > 0.0,
        }
    }

    /// A number with a cell, `cell` or one near it.
    fn living(&self, mut cell: u32) -> u32 {
        while self.locks[cell as usize].load(Relaxed) == DEAD {
            cell = cell.checked_sub(1).unwrap_or(self.slots.len() as u32 - 1);
        }
        cell
    }

    /// Points, cells and neighbours, the cells sorted by their corners.
    fn finish(self) -> (Vec<DVec3>, Vec<[u32; 4]>, Vec<[u32; 4]>) {
        /// Vertices whose cells a thread sorts at a time.
        const STRETCH: usize = 4_096;
        self.slots.par_iter().for_each(Slot::sort);
        let (starts, mut cells) = self.by_lowest_corner();
        let number: Vec<AtomicU32> = (0..self.slots.len()).map(|_| AtomicU32::new(0)).collect();
        let mut stretches = Vec::new();
        let mut rest = cells.as_mut_slice();
        for v in (0..self.points.len()).step_by(STRETCH) {
            let last = (v + STRETCH).min(self.points.len());
            let (own, others) = rest.split_at_mut((starts[last] - starts[v]) as usize);
            stretches.push((v..last, own));
            rest = others;
        }
        stretches.into_par_iter().for_each(|(vertices, own)| {
            let base = starts[vertices.start];
            for v in vertices {
                let range = (starts[v] - base) as usize..(starts[v + 1] - base) as usize;
                own[range].sort_unstable();
            }
            for (at, [.., old]) in own.iter().enumerate() {
                number[*old as usize].store(base + at as u32, Relaxed);
            }
        });
        let neighbors = (cells.par_iter())
            .map(|[.., old]| {
                let own = self.slots[*old as usize].neighbors();
                own.map(|n| number[n as usize].load(Relaxed))
            })
            .collect();
        cells
            .par_iter_mut()
            .for_each(|cell| *cell = self.slots[cell[3] as usize].corners());
        (self.points, cells, neighbors)
    }

    /// For every vertex where the cells begin of which it is the lowest corner, and in that order the other corners of all cells and their numbers.
    fn by_lowest_corner(&self) -> (Vec<u32>, Vec<[u32; 4]>) {
        let cells = || {
            let living = (self.locks.iter().enumerate()).filter(|(_, l)| l.load(Relaxed) != DEAD);
            living.map(|(cell, _)| (cell, self.slots[cell].corners()))
        };
        let mut starts = vec![0u32; self.points.len() + 2];
        for (_, corners) in cells() {
            starts[corners[0] as usize + 2] += 1;
        }
        for v in 1..starts.len() {
            starts[v] += starts[v - 1];
        }
        let mut keys = vec![[0; 4]; starts[self.points.len() + 1] as usize];
        for (cell, [lowest, a, b, c]) in cells() {
            let at = &mut starts[lowest as usize + 1];
            keys[*at as usize] = [a, b, c, cell as u32];
            *at += 1;
        }
        starts.pop();
        (starts, keys)
    }
}

/// A facet on the rim of a cavity, made into a cell with the new point.
#[derive(Clone, Copy)]
struct Rim {
    /// The cell inside that the facet was of, with the new point in place of the corner opposite.
    corners: [u32; 4],
    /// Where the new point stands in it.
    at: usize,
    outer: u32,
    outer_at: usize,
}

/// What one thread needs for its work.
struct Worker {
    /// Mark on cells around a cavity; one more is the mark of those that fall.
    mark: u8,
    hint: u32,
    /// Numbers without a cell.
    free: Vec<u32>,
    block: Range<u32>,
    put_off: Vec<u32>,
    fallen: Vec<u32>,
    rims: Vec<Rim>,
    fresh: Vec<u32>,
    /// For every vertex and the ghost its number on the present rim.
    numbers: Vec<u8>,
    numbered: Vec<u32>,
    /// Facet of the rim by the numbers of the ends of its directed edges.
    table: Vec<u8>,
}

const NO_NUMBER: u8 = u8::MAX;

impl Worker {
    fn new(tag: usize, points: usize) -> Self {
        Self {
            mark: 2 * tag as u8 + 2,
            hint: 0,
            free: Vec::new(),
            block: 0..0,
            put_off: Vec::new(),
            fallen: Vec::new(),
            rims: Vec::new(),
            fresh: Vec::new(),
            numbers: vec![NO_NUMBER; points + 1],
            numbered: Vec::new(),
            table: vec![0; TABLE * TABLE],
        }
    }

    /// Inserts `vertices` while no other thread works.
    fn insert_alone(&mut self, site: &mut Site, vertices: &[u32], first: &[u32; 4]) {
        for &v in vertices.iter().filter(|v| !first.contains(v)) {
            while !matches!(self.insert::<true>(site, v), Outcome::Inserted) {
                site.grow();
            }
        }
    }

    /// Inserts points of its own stretch, then of others', until there are none or no room.
    fn work(
        &mut self,
        site: &Site,
        vertices: &[u32],
        first: &[u32; 4],
        own: usize,
        stretches: &[Mutex<Range<usize>>],
    ) {
        while let Some(some) = take(own, stretches) {
            for (done, &v) in vertices[some.clone()].iter().enumerate() {
                if first.contains(&v) {
                    continue;
                }
                match self.insert::<false>(site, v) {
                    Outcome::Inserted => {}
                    Outcome::Busy => self.put_off.push(v),
                    Outcome::Full => {
                        site.is_full.store(true, Relaxed);
                        self.put_off
                            .extend_from_slice(&vertices[some.start + done..some.end]);
                        return;
                    }
                }
            }
            if site.is_full.load(Relaxed) {
                return;
            }
            // Another thread may have moved on since.
            for v in std::mem::take(&mut self.put_off) {
                if !matches!(self.insert::<false>(site, v), Outcome::Inserted) {
                    self.put_off.push(v);
                }
            }
        }
    }

    fn insert<const ALONE: bool>(&mut self, site: &Site, v: u32) -> Outcome {
        let p = site.at(v);
        let start = self.locate::<ALONE>(site, p);
        if !self.clear::<ALONE>(site, start, v, p) {
            self.let_go(site);
            return Outcome::Busy;
        }
        if !self.number(site) {
            self.let_go(site);
            return Outcome::Full;
        }
        self.fill(site);
        Outcome::Inserted
    }

    /// A cell whose sphere holds `p`: the one that contains it, or a ghost that sees it. Only where no other thread works is it sure.
    fn locate<const ALONE: bool>(&self, site: &Site, p: DVec3) -> u32 {
        let mut cell = if ALONE && site.locks[self.hint as usize].load(Relaxed) != DEAD {
            self.hint
        } else {
            site.living(self.hint)
        };
        let slot = &site.slots[cell as usize];
        if let Some(at) = slot.corners().iter().position(|c| *c == GHOST) {
            cell = slot.neighbors[at].load(Relaxed);
        }
        let mut from = cell;
        // A walk that crosses every facet it sees ends in a Delaunay triangulation (De Floriani et al. 1991).
        'walk: loop {
            let slot = &site.slots[cell as usize];
            let corners = slot.corners();
            if corners.contains(&GHOST) {
                return cell;
            }
            let points = corners.map(|c| site.at(c));
            for (next, facet) in slot.neighbors().into_iter().zip(&FACETS) {
                if next == from {
                    continue;
                }
                let [a, b, c] = facet.map(|k| points[k]);
                if site.signs.orient(a, b, c, p) < 0.0 {
                    from = cell;
                    cell = if ALONE { next } else { site.living(next) };
                    continue 'walk;
                }
            }
            return cell;
        }
    }

    /// Takes the lock of a cell that this thread does not have; false where another has it.
    #[inline]
    fn lock<const ALONE: bool>(&self, site: &Site, cell: u32, mark: u8) -> bool {
        let lock = &site.locks[cell as usize];
        if ALONE {
            lock.store(mark, Relaxed);
            return true;
        }
        lock.compare_exchange(OPEN, mark, Acquire, Relaxed).is_ok()
    }

    /// Finds the cells that fall to vertex `v`, and the rim of the cavity they leave; false where another thread is in the way.
    fn clear<const ALONE: bool>(&mut self, site: &Site, start: u32, v: u32, p: DVec3) -> bool {
        let (kept, fallen) = (self.mark, self.mark + 1);
        self.fallen.clear();
        self.rims.clear();
        if !self.lock::<ALONE>(site, start, fallen) {
            return false;
        }
        self.fallen.push(start);
        if !ALONE && !site.falls(start, p) {
            return false;
        }
        let mut done = 0;
        while let Some(&cell) = self.fallen.get(done) {
            done += 1;
            let slot = &site.slots[cell as usize];
            let corners = slot.corners();
            for (at, outer) in slot.neighbors().into_iter().enumerate() {
                let mark = site.locks[outer as usize].load(Relaxed);
                if mark == fallen {
                    continue;
                }
                if mark != kept {
                    if !self.lock::<ALONE>(site, outer, kept) {
                        return false;
                    }
                    if site.falls(outer, p) {
                        site.locks[outer as usize].store(fallen, Relaxed);
                        self.fallen.push(outer);
                        continue;
                    }
                }
                let mut corners = corners;
                corners[at] = v;
                let outer_at = place(&site.slots[outer as usize].neighbors(), cell);
                self.rims.push(Rim {
                    corners,
                    at,
                    outer,
                    outer_at,
                });
            }
        }
        true
    }

    /// Gives all locks back; nothing was changed.
    #[cold]
    fn let_go(&mut self, site: &Site) {
        let rims = self.rims.iter().map(|r| r.outer);
        for cell in self.fallen.drain(..).chain(rims) {
            site.locks[cell as usize].store(OPEN, Release);
        }
        self.free.append(&mut self.fresh);
    }

    /// Finds a number for the cell of every facet of the rim; false where there are not enough.
    fn number(&mut self, site: &Site) -> bool {
        self.fresh.clear();
        let spare = self.rims.len().min(self.fallen.len());
        for _ in spare..self.rims.len() {
            let id = self.free.pop().or_else(|| self.block.next()).or_else(|| {
                let start = site.used.fetch_add(BLOCK, Relaxed);
                let end = (start + BLOCK).min(site.slots.len() as u32);
                self.block = start.min(end)..end;
                if self.block.is_empty() {
                    // For others, after room was made.
                    site.used.fetch_sub(BLOCK, Relaxed);
                }
                self.block.next()
            });
            let Some(id) = id else { return false };
            self.fresh.push(id);
        }
        true
    }

    /// Makes a cell of every facet of the rim.
    fn fill(&mut self, site: &Site) {
        let fallen = self.mark + 1;
        for id in &self.fresh {
            site.locks[*id as usize].store(fallen, Relaxed);
        }
        let spare = self.rims.len().min(self.fallen.len());
        self.fresh.extend_from_slice(&self.fallen[..spare]);
        for (rim, &id) in self.rims.iter().zip(&self.fresh) {
            let slot = &site.slots[id as usize];
            for (own, corner) in slot.corners.iter().zip(rim.corners) {
                own.store(corner, Relaxed);
            }
            slot.neighbors[rim.at].store(rim.outer, Relaxed);
            site.slots[rim.outer as usize].neighbors[rim.outer_at].store(id, Relaxed);
        }
        if !self.join_by_table(site) {
            self.join_by_sorting(site);
        }
        for dead in self.fallen.drain(spare..) {
            site.locks[dead as usize].store(DEAD, Relaxed);
            self.free.push(dead);
        }
        for (rim, id) in self.rims.iter().zip(&self.fresh) {
            site.locks[rim.outer as usize].store(OPEN, Release);
            site.locks[*id as usize].store(OPEN, Release);
        }
        self.hint = self.fresh[0];
        self.fresh.clear();
    }

    /// Joins the fresh cells with one another; false where the rim has too many corners for the table.
    fn join_by_table(&mut self, site: &Site) -> bool {
        let ghost = site.points.len();
        let mut fits = true;
        self.numbered.clear();
        'rims: for (facet, rim) in self.rims.iter().enumerate() {
            let mut numbers = [0usize; 3];
            for (number, k) in numbers.iter_mut().zip(FACETS[rim.at]) {
                let slot = (rim.corners[k] as usize).min(ghost);
                if self.numbers[slot] == NO_NUMBER {
                    if self.numbered.len() == TABLE {
                        fits = false;
                        break 'rims;
                    }
                    self.numbers[slot] = self.numbered.len() as u8;
                    self.numbered.push(slot as u32);
                }
                *number = self.numbers[slot] as usize;
            }
            // A sphere with n corners has 2 n - 4 facets: they fit a byte.
            let [a, b, c] = numbers;
            self.table[a * TABLE + b] = facet as u8;
            self.table[b * TABLE + c] = facet as u8;
            self.table[c * TABLE + a] = facet as u8;
        }
        if fits {
            for (rim, &id) in self.rims.iter().zip(&self.fresh) {
                let facet = FACETS[rim.at];
                let [a, b, c] =
                    facet.map(|k| self.numbers[(rim.corners[k] as usize).min(ghost)] as usize);
                let own = &site.slots[id as usize].neighbors;
                own[facet[2]].store(self.fresh[self.table[b * TABLE + a] as usize], Relaxed);
                own[facet[0]].store(self.fresh[self.table[c * TABLE + b] as usize], Relaxed);
                own[facet[1]].store(self.fresh[self.table[a * TABLE + c] as usize], Relaxed);
            }
        }
        for &slot in &self.numbered {
            self.numbers[slot as usize] = NO_NUMBER;
        }
        fits
    }

    #[cold]
    fn join_by_sorting(&mut self, site: &Site) {
        let mut edges: Vec<((u32, u32), u32, usize)> = Vec::with_capacity(3 * self.rims.len());
        for (rim, &id) in self.rims.iter().zip(&self.fresh) {
            let facet = FACETS[rim.at];
            for k in 0..3 {
                let (a, b) = (rim.corners[facet[k]], rim.corners[facet[(k + 1) % 3]]);
                edges.push(((a.min(b), a.max(b)), id, facet[(k + 2) % 3]));
            }
        }
        edges.sort_unstable();
        for pair in edges.chunks_exact(2) {
            let [(_, a, a_at), (_, b, b_at)] = [pair[0], pair[1]];
            site.slots[a as usize].neighbors[a_at].store(b, Relaxed);
            site.slots[b as usize].neighbors[b_at].store(a, Relaxed);
        }
    }
}

/// Some points of the worker's own stretch, from its beginning, or of another's, from its end.
fn take(own: usize, stretches: &[Mutex<Range<usize>>]) -> Option<Range<usize>> {
    for i in 0..stretches.len() {
        // A thread that panics takes the whole scope with it.
        let Ok(mut rest) = stretches[(own + i) % stretches.len()].lock() else {
            continue;
        };
        if rest.is_empty() {
            continue;
        }
        let count = GRAIN.min(rest.len());
        return Some(if i == 0 {
            rest.start += count;
            rest.start - count..rest.start
        } else {
            rest.end -= count;
            rest.end..rest.end + count
        });
    }
    None
}

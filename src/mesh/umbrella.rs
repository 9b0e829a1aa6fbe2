//! Umbrella facet matching (Ma 2011, chapter 3): every vertex picks a ring of facets around itself from the Delaunay triangulation, and
//! picks again until its neighbours pick the same.

use std::cmp::Ordering;

use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::cone::Cones;
use super::delaunay::{Delaunay, FACETS, GHOST};
use super::star::{Facets, Stars, corner, facet, vertices};

/// Rounds of matching after which what is not matched stays so; the author's slowest took 11.
const MOST_ROUNDS: usize = 40;
/// Vertices a worker takes at a time.
const GRAIN: usize = 512;

/// How the matching went.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Matching {
    /// Vertices whose umbrella is fully matched, after the first umbrellas and after every round.
    pub matched: Vec<usize>,
}

/// A facet at the vertex that is at work: the facet, its rank, and its other two corners by their numbers around the vertex.
#[derive(Clone, Copy)]
struct Spoke {
    facet: u32,
    /// Lower goes first.
    level: u8,
    radius: f32,
    ends: [u32; 2],
}

/// Room for the work at one vertex.
#[derive(Default)]
struct Bench {
    spokes: Vec<Spoke>,
    around: Vec<u32>,
    /// Direction of each vertex around, as an angle about the axis of the umbrella.
    angles: Vec<f64>,
    /// Trees of the vertices around: who stands for the tree, and the angle walked from there.
    trees: Vec<(u32, f64)>,
    /// Spokes that the trees are made of.
    taken: Vec<u32>,
    reached: Vec<u32>,
    best: Vec<u32>,
}

/// What all vertices look at.
#[derive(Clone, Copy)]
struct Work<'a> {
    delaunay: &'a Delaunay,
    stars: &'a Stars,
    facets: &'a Facets,
    axes: &'a [Vec3],
    /// Which vertices are not fully matched.
    is_open: &'a [bool],
    cones: Option<&'a Cones>,
}

/// Which facets an umbrella is picked from, and in what order.
#[derive(Clone, Copy, PartialEq)]
pub enum Queue {
    /// Gabriel facets where they hold a ring, else all; by size (Ma 2011, §3.3.2).
    Initial,
    /// All; by matching index, then by the vertex's own choice, then by size (Ma 2011, §3.3.3).
    Matching,
    /// All; by matching index, then by size, which all vertices see alike.
    Settling,
    /// All; matched ones and those within the normal vector cone, then as [`Queue::Matching`] (Ma 2011, §5.4.2).
    Cone,
}

/// Finds the umbrellas of all vertices, and leaves them as marks on `facets`.
///
/// All vertices choose at once from what all had chosen before, so the result does not depend on the number of threads. Ends when all are matched,
/// nothing changes, or after 40 rounds: where data are noisy or too sparse some vertices change their minds for ever.
pub fn match_umbrellas(
    delaunay: &Delaunay,
    stars: &Stars,
    facets: &Facets,
    with_cone: bool,
) -> Matching {
    let mut active: Vec<u32> = (0..delaunay.points.len() as u32).collect();
    let total = active.len();
    let axes = axes(delaunay, stars);
    let mut is_open = vec![true; total];
    let mut cones = None;
    let mut matching = Matching::default();
    let mut queue = Queue::Initial;
    for _ in 0..=MOST_ROUNDS {
        if queue == Queue::Cone && cones.is_none() {
            cones = Some(Cones::new(delaunay, stars, facets, &axes, &is_open));
        }
        let work = Work {
            delaunay,
            stars,
            facets,
            axes: &axes,
            is_open: &is_open,
            cones: cones.as_ref(),
        };
        choose(&work, &active, queue);
        let before = active.len();
        let is_still_open = |v: &u32| !is_matched(delaunay, stars, facets, *v);
        let still: Vec<u32> = active.par_iter().copied().filter(is_still_open).collect();
        active.iter().for_each(|v| is_open[*v as usize] = false);
        still.iter().for_each(|v| is_open[*v as usize] = true);
        active = still;
        matching.matched.push(total - active.len());
        // A round that matches less than one in fifty of the rest is followed by none that matches more.
        let pays = before - active.len() > before / 50;
        queue = match queue {
            _ if active.is_empty() => break,
            Queue::Initial => Queue::Matching,
            Queue::Matching if !pays && with_cone => Queue::Cone,
            Queue::Matching | Queue::Cone if !pays => Queue::Settling,
            Queue::Settling if !pays => break,
            other => other,
        };
    }
    matching
}

/// Whether all facets of the umbrella of `v` are in the umbrellas of all their corners.
pub fn is_matched(delaunay: &Delaunay, stars: &Stars, facets: &Facets, v: u32) -> bool {
    facets_at(delaunay, stars, v)
        .filter(|(f, ..)| facets.is_in_umbrella_of(delaunay, *f, v))
        .all(|(f, ..)| facets.matches(f) == 3)
}

/// The facets at `v`, once each: facet, its cell and opposite corner. Facets with the ghost are left out.
pub fn facets_at<'a>(
    delaunay: &'a Delaunay,
    stars: &'a Stars,
    v: u32,
) -> impl Iterator<Item = (u32, u32, usize)> + 'a {
    stars.of(v).iter().flat_map(move |code| {
        let (cell, own) = corner(*code);
        let corners = delaunay.cells[cell as usize];
        (0..4usize).filter_map(move |at| {
            let ghostly = (0..4).any(|k| k != at && corners[k] == GHOST);
            let is_first = cell < delaunay.neighbors[cell as usize][at];
            (at != own && is_first && !ghostly).then_some((cell << 2 | at as u32, cell, at))
        })
    })
}

/// A facet of an umbrella: its place, and its other two corners in the sense of the ring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Panel {
    /// The facet.
    pub facet: u32,
    /// Its corner that it shares with the panel before.
    pub from: u32,
    /// Its corner that it shares with the panel after.
    pub to: u32,
}

/// The umbrella of `v` in the order of its ring, into `ring`; the normals (from - v) x (to - v) then agree, with `axis` on the whole.
pub fn umbrella(
    delaunay: &Delaunay,
    stars: &Stars,
    facets: &Facets,
    (v, axis): (u32, DVec3),
    ring: &mut Vec<Panel>,
) {
    ring.clear();
    for (f, ..) in facets_at(delaunay, stars, v) {
        if facets.is_in_umbrella_of(delaunay, f, v) {
            let [a, b, c] = vertices(delaunay, f);
            let (from, to) = if a == v {
                (b, c)
            } else if b == v {
                (c, a)
            } else {
                (a, b)
            };
            ring.push(Panel { facet: f, from, to });
        }
    }
    for i in 1..ring.len() {
        let end = ring[i - 1].to;
        let Some(next) = (i..ring.len()).find(|j| ring[*j].from == end || ring[*j].to == end)
        else {
            break;
        };
        ring.swap(i, next);
        if ring[i].from != end {
            let Panel { facet, from, to } = ring[i];
            ring[i] = Panel {
                facet,
                from: to,
                to: from,
            };
        }
    }
    let p = delaunay.points[v as usize];
    let at = |u: u32| delaunay.points[u as usize] - p;
    let sum: DVec3 = ring.iter().map(|s| at(s.from).cross(at(s.to))).sum();
    if sum.dot(axis) < 0.0 {
        ring.reverse();
        for panel in ring.iter_mut() {
            let Panel { facet, from, to } = *panel;
            *panel = Panel {
                facet,
                from: to,
                to: from,
            };
        }
    }
}

/// Lets all `active` vertices choose.
fn choose(work: &Work, active: &[u32], queue: Queue) {
    let Work {
        delaunay,
        stars,
        facets,
        ..
    } = *work;
    let chosen: Vec<(Vec<u32>, Vec<u32>)> = active
        .par_chunks(GRAIN)
        .map_init(Bench::default, |bench, some| {
            let (mut ends, mut all) = (Vec::with_capacity(some.len()), Vec::new());
            for &v in some {
                bench.choose(work, v, queue);
                all.extend_from_slice(&bench.best);
                ends.push(all.len() as u32);
            }
            (ends, all)
        })
        .collect();
    active
        .par_chunks(GRAIN)
        .zip(&chosen)
        .for_each(|(some, (ends, all))| {
            let mut start = 0;
            for (&v, &end) in some.iter().zip(ends) {
                if queue != Queue::Initial {
                    for (f, ..) in facets_at(delaunay, stars, v) {
                        facets.set(delaunay, f, v, false);
                    }
                }
                for &f in &all[start..end as usize] {
                    facets.set(delaunay, f, v, true);
                }
                start = end as usize;
            }
        });
}

impl Bench {
    /// Leaves the umbrella of `v` in `best`; empty where the vertex has none.
    fn choose(&mut self, work: &Work, v: u32, queue: Queue) {
        self.collect(work, v, queue);
        self.spokes.sort_unstable_by(best_first);
        self.ring();
    }

    fn collect(&mut self, work: &Work, v: u32, queue: Queue) {
        let Work {
            delaunay,
            stars,
            facets,
            axes,
            ..
        } = *work;
        let cone = match (queue, work.cones) {
            (Queue::Cone, Some(cones)) => cones.of(
                delaunay,
                stars,
                facets,
                v,
                axes[v as usize].as_dvec3(),
                work.is_open,
            ),
            _ => None,
        };
        self.spokes.clear();
        self.around.clear();
        for (facet, cell, at) in facets_at(delaunay, stars, v) {
            let level = match queue {
                Queue::Initial => u8::from(facets.is_gabriel(facet)),
                Queue::Matching => {
                    let own = facets.is_in_umbrella_of(delaunay, facet, v);
                    2 * facets.matches(facet) as u8 + u8::from(own)
                }
                Queue::Settling => facets.matches(facet) as u8,
                Queue::Cone => {
                    let matches = facets.matches(facet) as u8;
                    let own = facets.is_in_umbrella_of(delaunay, facet, v);
                    let holds = || {
                        let radius = facets.radius(cell, at);
                        cone.as_ref()
                            .is_some_and(|c| c.holds(delaunay, facet, radius))
                    };
                    let first = matches == 3 || holds();
                    8 * u8::from(first) + 2 * matches + u8::from(own)
                }
            };
            let corners = delaunay.cells[cell as usize];
            let mut ends = (0..4)
                .filter(|k| *k != at && corners[*k] != v)
                .map(|k| corners[k]);
            // A facet at `v` has two other corners.
            let ends = [ends.next().unwrap_or(v), ends.next().unwrap_or(v)];
            self.around.extend(ends);
            self.spokes.push(Spoke {
                facet,
                level,
                radius: facets.radius(cell, at),
                ends,
            });
        }
        self.around.sort_unstable();
        self.around.dedup();
        for spoke in &mut self.spokes {
            // Every end was put in.
            spoke.ends = spoke
                .ends
                .map(|e| self.around.partition_point(|a| *a < e) as u32);
        }
        let axis = axes[v as usize].as_dvec3();
        let x = axis.any_orthonormal_vector();
        let y = axis.cross(x);
        let p = delaunay.points[v as usize];
        self.angles.clear();
        self.angles.extend(self.around.iter().map(|a| {
            let d = delaunay.points[*a as usize] - p;
            d.dot(y).atan2(d.dot(x))
        }));
    }

    /// Joins facets, best first, until some go all the way around the axis; whether they do. These are the umbrella.
    ///
    /// Of all rings around the axis it is the one whose worst facet is best, and so for every part of it.
    fn ring(&mut self) -> bool {
        self.best.clear();
        self.taken.clear();
        self.trees.clear();
        self.trees
            .extend((0..self.around.len() as u32).map(|i| (i, 0.0)));
        for s in 0..self.spokes.len() {
            let [a, b] = self.spokes[s].ends;
            // A facet spans less than half a turn.
            let step = self.angles[b as usize] - self.angles[a as usize];
            let step = step - TAU * (step / TAU).round();
            let ((a_root, a_angle), (b_root, b_angle)) = (self.root(a), self.root(b));
            if a_root == b_root {
                if (a_angle + step - b_angle).abs() > PI {
                    self.close(s, a, b);
                    return true;
                }
            } else {
                self.trees[b_root as usize] = (a_root, a_angle + step - b_angle);
                self.taken.push(s as u32);
            }
        }
        false
    }

    /// The vertex that stands for the tree of `i`, and the angle walked from there to `i`.
    fn root(&self, mut i: u32) -> (u32, f64) {
        let mut angle = 0.0;
        while self.trees[i as usize].0 != i {
            let (up, step) = self.trees[i as usize];
            angle += step;
            i = up;
        }
        (i, angle)
    }

    /// The ring of spoke `s` from `a` to `b` and the way back through the tree.
    fn close(&mut self, s: usize, a: u32, b: u32) {
        const NONE: u32 = u32::MAX;
        // For every vertex the spoke by which it was reached from `a`.
        let by = &mut self.reached;
        by.clear();
        by.resize(self.around.len(), NONE);
        let mut walked = true;
        while walked && by[b as usize] == NONE {
            walked = false;
            for &t in &self.taken {
                let [c, d] = self.spokes[t as usize].ends;
                for (from, to) in [(c, d), (d, c)] {
                    let is_reached = from == a || by[from as usize] != NONE;
                    if is_reached && to != a && by[to as usize] == NONE {
                        by[to as usize] = t;
                        walked = true;
                    }
                }
            }
        }
        self.best.push(self.spokes[s].facet);
        let mut at = b;
        while at != a {
            let spoke = self.spokes[by[at as usize] as usize];
            self.best.push(spoke.facet);
            at = if spoke.ends[0] == at {
                spoke.ends[1]
            } else {
                spoke.ends[0]
            };
        }
    }
}

fn best_first(a: &Spoke, b: &Spoke) -> Ordering {
    (b.level.cmp(&a.level))
        .then(a.radius.total_cmp(&b.radius))
        .then(a.facet.cmp(&b.facet))
}

/// For every vertex the direction to the farthest corner of its Voronoi cell, its pole, which lies across the surface (Amenta and Bern, *Surface
/// reconstruction by Voronoi filtering*, 1999); where the cell is unbounded, the mean direction of the hull.
fn axes(delaunay: &Delaunay, stars: &Stars) -> Vec<Vec3> {
    let axis = |v: u32| {
        let p = delaunay.points[v as usize];
        let (mut farthest, mut pole, mut beyond) = (0.0, DVec3::ZERO, DVec3::ZERO);
        for code in stars.of(v) {
            let (cell, _) = corner(*code);
            let corners = delaunay.cells[cell as usize];
            if let Some(ghost) = corners.iter().position(|c| *c == GHOST) {
                let [a, b, c] = FACETS[ghost].map(|k| delaunay.points[corners[k] as usize]);
                beyond -= (b - a).cross(c - a).normalize_or_zero();
                continue;
            }
            let centre = circumcentre(corners.map(|c| delaunay.points[c as usize]));
            let distance = p.distance_squared(centre);
            if distance > farthest && distance.is_finite() {
                (farthest, pole) = (distance, centre - p);
            }
        }
        let direction = beyond.try_normalize().or(pole.try_normalize());
        direction.unwrap_or(DVec3::Z).as_vec3().normalize()
    };
    (0..delaunay.points.len() as u32)
        .into_par_iter()
        .map(axis)
        .collect()
}

/// The point as far from all four corners; not finite where they are nearly in one plane.
fn circumcentre([a, b, c, d]: [DVec3; 4]) -> DVec3 {
    let (u, v, w) = (b - a, c - a, d - a);
    let volume = 2.0 * u.dot(v.cross(w));
    a + (v.cross(w) * u.length_squared()
        + w.cross(u) * v.length_squared()
        + u.cross(v) * w.length_squared())
        / volume
}

/// The two sides of the umbrella of every vertex, as bits at the corners of cells: which corners have the cell on their second side.
///
/// The second return value tells which vertices have an umbrella with two sides.
pub fn sides(delaunay: &Delaunay, stars: &Stars, facets: &Facets) -> (Vec<u8>, Vec<bool>) {
    use std::sync::atomic::{AtomicU8, Ordering::Relaxed};
    let bits: Vec<AtomicU8> = (0..delaunay.cells.len())
        .map(|_| AtomicU8::new(0))
        .collect();
    let two_sided = (0..delaunay.points.len() as u32)
        .into_par_iter()
        .map_init(Vec::new, |stack, v| {
            let star = stars.of(v);
            let mut side = vec![u8::MAX; star.len()];
            let mut parts = 0u8;
            for start in 0..star.len() {
                if side[start] != u8::MAX {
                    continue;
                }
                stack.push(start);
                side[start] = parts;
                while let Some(i) = stack.pop() {
                    let (cell, own) = corner(star[i]);
                    for at in (0..4).filter(|at| *at != own) {
                        let n = delaunay.neighbors[cell as usize][at];
                        let j = star.partition_point(|c| c >> 2 < n);
                        if side[j] == u8::MAX
                            && !facets.is_in_umbrella_of(delaunay, facet(delaunay, cell, at), v)
                        {
                            side[j] = parts;
                            stack.push(j);
                        }
                    }
                }
                parts = parts.saturating_add(1).min(u8::MAX - 1);
            }
            for (code, side) in star.iter().zip(&side) {
                if *side == 1 {
                    bits[(code >> 2) as usize].fetch_or(1 << (code & 3), Relaxed);
                }
            }
            parts == 2
        })
        .collect();
    (
        bits.into_iter().map(AtomicU8::into_inner).collect(),
        two_sided,
    )
}

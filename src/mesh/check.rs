//! What must hold of a triangulation and of a mesh, checked from the definitions.

use rayon::prelude::*;

use super::delaunay::{Delaunay, FACETS, GHOST};
use super::predicates::Signs;

/// Checks everything that makes `delaunay` the Delaunay triangulation of its points, with exact signs: neighbours agree, cells are
/// positively oriented, no facet's sphere holds the corner across it (which makes every sphere empty), the hull is convex, every
/// vertex is used, and Euler's formula holds.
///
/// # Errors
/// The first thing that does not hold, in words.
pub fn check_delaunay(delaunay: &Delaunay) -> Result<(), String> {
    let signs = Signs::of(&delaunay.points);
    let mut used = vec![false; delaunay.points.len()];
    for cell in 0..delaunay.cells.len() as u32 {
        check_cell(delaunay, &signs, cell)?;
        for v in delaunay.cells[cell as usize] {
            if v != GHOST {
                used[v as usize] = true;
            }
        }
    }
    if let Some(v) = used.iter().position(|u| !u) {
        return Err(format!("vertex {v} is in no cell"));
    }
    // With the ghost the cells fill a three-sphere: V - E + F - C = 0, and every facet has two cells.
    let mut edges: Vec<(u32, u32)> = Vec::with_capacity(6 * delaunay.cells.len());
    for c in &delaunay.cells {
        for (i, j) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
            edges.push((c[i].min(c[j]), c[i].max(c[j])));
        }
    }
    edges.sort_unstable();
    edges.dedup();
    let (v, e, c) = (delaunay.points.len() + 1, edges.len(), delaunay.cells.len());
    if v + c != e {
        return Err(format!(
            "Euler: {v} vertices, {e} edges, {c} cells: V + C - E is not 0"
        ));
    }
    Ok(())
}

fn check_cell(delaunay: &Delaunay, signs: &Signs, cell: u32) -> Result<(), String> {
    let at = |v: u32| delaunay.points[v as usize];
    let corners = delaunay.cells[cell as usize];
    if corners.iter().filter(|c| **c == GHOST).count() > 1 {
        return Err(format!("cell {cell}: more than one ghost"));
    }
    let ghost = corners.iter().position(|c| *c == GHOST);
    if ghost.is_none() {
        let [a, b, c, d] = corners.map(at);
        if signs.orient(a, b, c, d) <= 0.0 {
            return Err(format!("cell {cell}: flat or turned inside out"));
        }
    }
    for (k, facet) in FACETS.iter().enumerate() {
        let neighbor = delaunay.neighbors[cell as usize][k];
        let mirror = delaunay.mirror(cell, neighbor);
        if delaunay.neighbors[neighbor as usize][mirror] != cell {
            return Err(format!(
                "cell {cell}: its neighbour {neighbor} does not know it"
            ));
        }
        let mut own = facet.map(|f| corners[f]);
        let other = delaunay.cells[neighbor as usize];
        let mut its = FACETS[mirror].map(|f| other[f]);
        own.sort_unstable();
        its.sort_unstable();
        if own != its {
            return Err(format!(
                "cells {cell} and {neighbor}: facets {own:?} and {its:?} differ"
            ));
        }
        let across = other[mirror];
        if across == GHOST {
            continue;
        }
        match ghost {
            None => {
                if signs.in_sphere(corners.map(at), at(across)) > 0.0 {
                    return Err(format!("cell {cell}: vertex {across} lies in its sphere"));
                }
                if signs.in_sphere_perturbed(corners.map(at), at(across)) {
                    return Err(format!(
                        "cell {cell}: vertex {across} lies in its perturbed sphere"
                    ));
                }
            }
            Some(g) if g != k => {
                let [a, b, c] = FACETS[g].map(|f| at(corners[f]));
                if signs.orient(a, b, c, at(across)) > 0.0 {
                    return Err(format!(
                        "ghost {cell}: the hull is not convex at vertex {across}"
                    ));
                }
            }
            Some(_) => {}
        }
    }
    Ok(())
}

/// What a set of triangles is, topologically.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Topology {
    /// Vertices that triangles use.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
    /// Edges of one triangle only.
    pub open_edges: usize,
    /// Edges of more than two triangles, or of two that do not agree which side is out.
    pub bad_edges: usize,
    /// Vertices whose triangles are neither one fan nor one ring.
    pub bad_vertices: usize,
    /// Pieces that hang together.
    pub pieces: usize,
    /// V - E + F.
    pub euler: i64,
}

impl Topology {
    /// Whether every edge has two triangles.
    pub fn is_watertight(&self) -> bool {
        self.triangles > 0 && self.open_edges == 0 && self.bad_edges == 0
    }

    /// Whether the triangles are a surface everywhere, with borders or without, whose triangles agree which side is out.
    pub fn is_manifold(&self) -> bool {
        self.bad_edges == 0 && self.bad_vertices == 0
    }

    /// Handles of all pieces together, where the surface is closed and manifold.
    pub fn genus(&self) -> Option<i64> {
        let closed = self.is_watertight() && self.is_manifold();
        closed.then(|| self.pieces as i64 - self.euler / 2)
    }
}

/// Counts what `triangles` over `vertices` vertices are.
///
/// Memory: 24 bytes a triangle and 20 a vertex.
pub fn topology(vertices: usize, triangles: &[[u32; 3]]) -> Topology {
    let mut pieces = Groups::new(vertices);
    for t in triangles {
        pieces.join(t[0], t[1]);
        pieces.join(t[0], t[2]);
    }
    let mut starts = vec![0usize; vertices + 1];
    for v in triangles.iter().flatten() {
        starts[*v as usize + 1] += 1;
    }
    for v in 0..vertices {
        starts[v + 1] += starts[v];
    }
    let used = (0..vertices).filter(|v| starts[v + 1] > starts[*v]);
    let (vertex_count, piece_count) = used.fold((0, 0), |(count, of_pieces), v| {
        let is_first = pieces.of(v as u32) == v as u32;
        (count + 1, of_pieces + usize::from(is_first))
    });
    let spokes = spokes(&starts, triangles);
    let around = |(seen, scratch): (Seen, Scratch), v: usize| {
        let mut scratch = scratch;
        let own = look(v as u32, &spokes[starts[v]..starts[v + 1]], &mut scratch);
        (seen + own, scratch)
    };
    let seen = (0..vertices)
        .into_par_iter()
        .fold(Default::default, around)
        .map(|(seen, _)| seen)
        .reduce(Seen::default, |a, b| a + b);
    Topology {
        vertices: vertex_count,
        triangles: triangles.len(),
        open_edges: seen.open_edges,
        bad_edges: seen.bad_edges,
        bad_vertices: seen.bad_vertices,
        pieces: piece_count,
        euler: vertex_count as i64 - seen.edges as i64 + triangles.len() as i64,
    }
}

/// For every vertex, from its place in `starts` on, the corner after it and the one before it in each of its triangles.
fn spokes(starts: &[usize], triangles: &[[u32; 3]]) -> Vec<[u32; 2]> {
    let mut next = starts.to_vec();
    let mut spokes = vec![[0; 2]; 3 * triangles.len()];
    for t in triangles {
        for k in 0..3 {
            let place = &mut next[t[k] as usize];
            spokes[*place] = [t[(k + 1) % 3], t[(k + 2) % 3]];
            *place += 1;
        }
    }
    spokes
}

/// What is seen around vertices; of edges those to vertices of higher number.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    edges: usize,
    open_edges: usize,
    bad_edges: usize,
    bad_vertices: usize,
}

impl std::ops::Add for Seen {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            edges: self.edges + other.edges,
            open_edges: self.open_edges + other.open_edges,
            bad_edges: self.bad_edges + other.bad_edges,
            bad_vertices: self.bad_vertices + other.bad_vertices,
        }
    }
}

/// The spokes of a vertex by the corner after it, and the corners before it, sorted.
type Scratch = (Vec<[u32; 2]>, Vec<u32>);

/// What is seen around vertex `v`.
fn look(v: u32, spokes: &[[u32; 2]], (after, before): &mut Scratch) -> Seen {
    let mut seen = Seen::default();
    after.clear();
    after.extend(spokes);
    after.sort_unstable();
    before.clear();
    before.extend(spokes.iter().map(|s| s[1]));
    before.sort_unstable();
    // Both lists in step, one neighbour after the other.
    let (mut i, mut j) = (0, 0);
    while i < after.len() || j < before.len() {
        let [a, b] = [after.get(i).map(|s| s[0]), before.get(j).copied()];
        let w = a.into_iter().chain(b).min().unwrap_or(v);
        let out = after[i..].iter().take_while(|s| s[0] == w).count();
        let back = before[j..].iter().take_while(|b| **b == w).count();
        (i, j) = (i + out, j + back);
        if w > v {
            seen.edges += 1;
            seen.open_edges += usize::from(out + back == 1);
            seen.bad_edges += usize::from(out > 1 || back > 1);
        }
    }
    let first = after.iter().find(|s| before.binary_search(&s[0]).is_err());
    // Begin where nothing comes before, if there is such a place.
    let Some(&[start, _]) = first.or(after.first()) else {
        return seen;
    };
    let (mut at, mut walked) = (start, 0);
    while walked <= after.len() {
        let Ok(found) = after.binary_search_by(|s| s[0].cmp(&at)) else {
            break;
        };
        at = after[found][1];
        walked += 1;
        if at == start {
            break;
        }
    }
    seen.bad_vertices += usize::from(walked != after.len());
    seen
}

/// Sets that are joined pair by pair.
#[derive(Debug, Clone)]
pub struct Groups {
    parent: Vec<u32>,
}

impl Groups {
    /// `count` sets of one.
    pub fn new(count: usize) -> Self {
        Self {
            parent: (0..count as u32).collect(),
        }
    }

    /// The member that stands for the set of `i`; the lowest, where sets were joined in any order.
    pub fn of(&mut self, mut i: u32) -> u32 {
        while self.parent[i as usize] != i {
            let up = self.parent[self.parent[i as usize] as usize];
            self.parent[i as usize] = up;
            i = up;
        }
        i
    }

    /// Joins the sets of `a` and `b`; whether they were two.
    pub fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.of(a), self.of(b));
        self.parent[a.max(b) as usize] = a.min(b);
        a != b
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tetrahedron_is_closed_and_two_that_touch_are_not_manifold() {
        let one = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let seen = topology(4, &one);
        assert!(seen.is_watertight() && seen.is_manifold());
        assert_eq!((seen.genus(), seen.pieces, seen.euler), (Some(0), 1, 2));

        let mut two = one.to_vec();
        two.extend(one.map(|t| t.map(|v| if v == 0 { 0 } else { v + 3 })));
        let seen = topology(7, &two);
        assert_eq!(
            (seen.bad_vertices, seen.bad_edges, seen.open_edges),
            (1, 0, 0)
        );
        assert!(seen.is_watertight() && !seen.is_manifold());

        let seen = topology(4, &one[1..]);
        assert_eq!((seen.open_edges, seen.bad_vertices), (3, 0));
        assert!(seen.is_manifold() && !seen.is_watertight() && seen.genus().is_none());

        let turned = [one[0], one[1], one[2], [0, 2, 3]];
        assert!(topology(4, &turned).bad_edges > 0);
    }
}

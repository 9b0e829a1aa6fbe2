//! Where a closed surface has handles that only a few edges go around: those that samples made, not the part.
//!
//! We differ: the thesis counts handles (Ma 2011, equation 3.2) and leaves them.

use std::collections::{HashMap, VecDeque};

use super::check::Groups;

/// How far around the end of a loop a shorter one is looked for, edges.
const REACH: u32 = 7;
const NONE: u32 = u32::MAX;

/// For every vertex the other ends of its edges, each with the triangle on the left of the way there.
struct Net {
    starts: Vec<u32>,
    spokes: Vec<(u32, u32)>,
}

impl Net {
    fn new(vertices: usize, triangles: &[[u32; 3]]) -> Self {
        let mut starts = vec![0u32; vertices + 2];
        for v in triangles.iter().flatten() {
            starts[*v as usize + 2] += 1;
        }
        for v in 1..starts.len() {
            starts[v] += starts[v - 1];
        }
        let mut spokes = vec![(0, 0); 3 * triangles.len()];
        for (i, t) in triangles.iter().enumerate() {
            for k in 0..3 {
                let at = &mut starts[t[k] as usize + 1];
                spokes[*at as usize] = (t[(k + 1) % 3], i as u32);
                *at += 1;
            }
        }
        starts.pop();
        Self { starts, spokes }
    }

    fn of(&self, v: u32) -> &[(u32, u32)] {
        &self.spokes[self.starts[v as usize] as usize..self.starts[v as usize + 1] as usize]
    }

    /// The triangle on the left of the way from `a` to `b`.
    fn left(&self, a: u32, b: u32) -> u32 {
        let found = self.of(a).iter().find(|s| s.0 == b);
        found.map_or(NONE, |s| s.1)
    }
}

/// Loops of at most `most` edges that no disc of the surface fills, as far as a neighbourhood shows; `triangles` are a closed manifold.
///
/// The edges that neither a tree of the vertices nor one of the triangles across the others has lie on the handles, two for each (Eppstein,
/// *Dynamic generators of topologically embedded graphs*, 2003); from their ends the shortest loops are found the same way (Erickson and
/// Whittlesey, *Greedy optimal homotopy and homology generators*, 2005).
pub(super) fn short_loops(vertices: usize, triangles: &[[u32; 3]], most: usize) -> Vec<Vec<u32>> {
    let net = Net::new(vertices, triangles);
    let mut found: Vec<Vec<u32>> = ends_on_handles(&net, vertices, triangles.len())
        .into_iter()
        .flat_map(|v| loops_at(&net, v, most))
        .collect();
    found.sort_unstable_by(|a, b| a.len().cmp(&b.len()).then(a.cmp(b)));
    found.dedup();
    found
}

/// Ends of the edges that are left over, far from the first vertex of every piece.
fn ends_on_handles(net: &Net, vertices: usize, triangles: usize) -> Vec<u32> {
    let mut up = vec![NONE; vertices];
    let mut depth = vec![NONE; vertices];
    let mut queue = VecDeque::new();
    let mut deepest = 0;
    for root in 0..vertices as u32 {
        if depth[root as usize] != NONE || net.of(root).is_empty() {
            continue;
        }
        depth[root as usize] = 0;
        queue.push_back(root);
        while let Some(v) = queue.pop_front() {
            for &(u, _) in net.of(v) {
                if depth[u as usize] == NONE {
                    depth[u as usize] = depth[v as usize] + 1;
                    deepest = deepest.max(depth[u as usize]);
                    up[u as usize] = v;
                    queue.push_back(u);
                }
            }
        }
    }
    // The deepest first: what is left over then are the shortest loops.
    let mut by_depth: Vec<Vec<u32>> = vec![Vec::new(); deepest as usize + 1];
    for v in (0..vertices as u32).filter(|v| depth[*v as usize] != NONE) {
        by_depth[depth[v as usize] as usize].push(v);
    }
    let mut groups = Groups::new(triangles);
    let mut ends = Vec::new();
    for v in by_depth.into_iter().rev().flatten() {
        for &(u, left) in net.of(v) {
            let is_first = (depth[u as usize], u) < (depth[v as usize], v);
            if is_first && up[v as usize] != u && !groups.join(left, net.left(u, v)) {
                ends.push(v);
            }
        }
    }
    ends
}

/// The loops through or near `root` that no disc within reach fills.
fn loops_at(net: &Net, root: u32, most: usize) -> Vec<Vec<u32>> {
    let mut order = vec![root];
    let mut number: HashMap<u32, u32> = HashMap::from([(root, 0)]);
    let mut up = vec![NONE];
    let mut depth = vec![0u32];
    let mut at = 0;
    while at < order.len() && depth[at] < REACH {
        for &(u, _) in net.of(order[at]) {
            if let std::collections::hash_map::Entry::Vacant(place) = number.entry(u) {
                place.insert(order.len() as u32);
                order.push(u);
                up.push(at as u32);
                depth.push(depth[at] + 1);
            }
        }
        at += 1;
    }
    // All triangles that reach out of the patch count as one.
    let mut faces: HashMap<u32, u32> = HashMap::new();
    let mut edges = Vec::new();
    for (i, &v) in order.iter().enumerate() {
        for &(u, left) in net.of(v) {
            let Some(&j) = number.get(&u) else { continue };
            let third = net.of(u).iter().find(|s| s.1 == left).map_or(NONE, |s| s.0);
            if number.contains_key(&third) {
                let next = faces.len() as u32 + 1;
                faces.entry(left).or_insert(next);
            }
            if (j as usize) < i && up[i] != j {
                edges.push((depth[i] + depth[j as usize], i as u32, j));
            }
        }
    }
    edges.sort_unstable_by_key(|(length, i, j)| (std::cmp::Reverse(*length), *i, *j));
    let mut groups = Groups::new(faces.len() + 1);
    let mut loops = Vec::new();
    for (_, i, j) in edges {
        let (v, u) = (order[i as usize], order[j as usize]);
        let face = |t: u32| faces.get(&t).copied().unwrap_or(0);
        if groups.join(face(net.left(v, u)), face(net.left(u, v))) {
            continue;
        }
        let (mut left, mut right) = (vec![i], vec![j]);
        let (mut a, mut b) = (i, j);
        while a != b {
            if depth[a as usize] >= depth[b as usize] {
                a = up[a as usize];
                left.push(a);
            } else {
                b = up[b as usize];
                right.push(b);
            }
        }
        // Both ways end in the vertex where they meet; the shorter may have it alone.
        right.retain(|x| *x != a);
        left.extend(right.into_iter().rev());
        if left.len() <= most {
            loops.push(left.into_iter().map(|x| order[x as usize]).collect());
        }
    }
    loops
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A torus of `around` by `across` vertices.
    fn torus(around: u32, across: u32) -> Vec<[u32; 3]> {
        let at = |i: u32, j: u32| (i % around) * across + j % across;
        (0..around)
            .flat_map(|i| (0..across).map(move |j| (i, j)))
            .flat_map(|(i, j)| {
                let (a, b) = (at(i, j), at(i + 1, j));
                let (c, d) = (at(i + 1, j + 1), at(i, j + 1));
                [[a, b, c], [a, c, d]]
            })
            .collect()
    }

    #[test]
    fn the_short_way_around_a_torus_is_found_and_none_on_a_sphere() {
        let thin = torus(40, 5);
        let found = short_loops(200, &thin, 8);
        assert_eq!(found.first().map(Vec::len), Some(5), "{found:?}");
        assert!(short_loops(1_600, &torus(40, 40), 8).is_empty());
        let octahedron = [
            [0, 2, 4],
            [2, 1, 4],
            [1, 3, 4],
            [3, 0, 4],
            [2, 0, 5],
            [1, 2, 5],
            [3, 1, 5],
            [0, 3, 5],
        ];
        assert!(short_loops(6, &octahedron, 8).is_empty());
    }
}

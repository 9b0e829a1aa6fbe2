//! Vertices at which the surface comes together more than once, parted: each becomes as many as there are rings of triangles around it.

use super::check::Groups;
use super::delaunay::{Delaunay, place};

/// Gives every ring of the surface's `triangles`, which are those of [`super::solid::surface`], a vertex of its own. For every new vertex the one
/// that it is a copy of; they are numbered from the last vertex of `delaunay` on.
///
/// Around an edge of four triangles those two belong together that have the inside between them: bodies that only touch are parted.
pub(super) fn part(delaunay: &Delaunay, inside: &[bool], triangles: &mut [[u32; 3]]) -> Vec<u32> {
    let facets: Vec<u32> = (0..4 * inside.len() as u32)
        .filter(|f| {
            let n = delaunay.neighbors[(f >> 2) as usize][(f & 3) as usize];
            inside[(f >> 2) as usize] && !inside[n as usize]
        })
        .collect();
    let mut corners = Groups::new(3 * facets.len());
    for (i, facet) in facets.iter().enumerate() {
        let t = triangles[i];
        for k in 0..3 {
            let beside = across(delaunay, inside, *facet, t[(k + 2) % 3]);
            // Every facet of the surface is in the list.
            let j = facets.partition_point(|f| *f < beside);
            for a in [k, (k + 1) % 3] {
                let b = (0..3).find(|b| triangles[j][*b] == t[a]).unwrap_or(a);
                corners.join((3 * i + a) as u32, (3 * j + b) as u32);
            }
        }
    }
    let mut roots = vec![u32::MAX; delaunay.points.len()];
    let mut copies = Vec::new();
    let mut copy_of = std::collections::HashMap::new();
    for (i, t) in triangles.iter_mut().enumerate() {
        for (k, v) in t.iter_mut().enumerate() {
            let root = corners.of((3 * i + k) as u32);
            let first = &mut roots[*v as usize];
            if *first == u32::MAX {
                *first = root;
            }
            if *first != root {
                let next = (delaunay.points.len() + copies.len()) as u32;
                let own = *copy_of.entry(root).or_insert(next);
                if own == next {
                    copies.push(*v);
                }
                *v = own;
            }
        }
    }
    copies
}

/// The facet of the surface that is met around the edge opposite to corner `third` of a facet, through the inside.
fn across(delaunay: &Delaunay, inside: &[bool], facet: u32, third: u32) -> u32 {
    let (mut cell, mut third) = (facet >> 2, third);
    let mut enter = (facet & 3) as usize;
    loop {
        let leave = place(&delaunay.cells[cell as usize], third);
        let next = delaunay.neighbors[cell as usize][leave];
        if !inside[next as usize] {
            return cell << 2 | leave as u32;
        }
        // The corner behind the facet that was entered by stays; it is the one to leave opposite to.
        third = delaunay.cells[cell as usize][enter];
        enter = delaunay.mirror(cell, next);
        cell = next;
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::super::check::topology;
    use super::super::solid::surface;
    use super::*;

    #[test]
    fn cells_that_touch_at_a_vertex_or_an_edge_are_parted() {
        // Ten points, and bodies of any two cells: many touch at an edge or a vertex.
        let at = |i: u32, z: f64| DVec3::new(f64::from(i).cos(), f64::from(i).sin() * 1.1, z);
        let points: Vec<DVec3> = (0..9)
            .map(|i| at(i, f64::from(i * i % 7) * 0.3))
            .chain([DVec3::new(0.1, 0.05, 1.0)])
            .collect();
        let delaunay = Delaunay::new(&points).expect("a body");
        let cells: Vec<usize> = (0..delaunay.cells.len())
            .filter(|c| !delaunay.is_ghost(*c as u32))
            .collect();
        let mut touching = 0;
        for first in &cells {
            for second in &cells {
                let mut inside = vec![false; delaunay.cells.len()];
                inside[*first] = true;
                inside[*second] = true;
                let mut triangles = surface(&delaunay, &inside);
                let is_bad = !topology(points.len(), &triangles).is_manifold();
                let copies = part(&delaunay, &inside, &mut triangles);
                let t = topology(points.len() + copies.len(), &triangles);
                assert!(t.is_manifold() && t.is_watertight(), "{t:?}");
                assert_eq!(is_bad, !copies.is_empty());
                touching += usize::from(is_bad);
            }
        }
        assert!(touching > 10, "{touching} pairs touch");
    }
}

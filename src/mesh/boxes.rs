//! A tree of boxes around triangles, for the question which of them are near.

use glam::DVec3;

/// Triangles around which one leaf lies.
const LEAF: usize = 8;

/// Boxes around runs of [`LEAF`] triangles in their order, two and two joined up to one. Triangles that follow one another should be neighbours.
///
/// Memory: 12 bytes a triangle.
pub(super) struct Boxes {
    /// Node 1 is the root, node `i` has the children `2 i` and `2 i + 1`; the leaves begin here.
    first: usize,
    /// Lower and upper corners.
    nodes: Vec<(DVec3, DVec3)>,
}

/// The box around nothing.
const EMPTY: (DVec3, DVec3) = (DVec3::INFINITY, DVec3::NEG_INFINITY);

impl Boxes {
    pub fn new(points: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let leaves = triangles.len().div_ceil(LEAF);
        let first = leaves.next_power_of_two();
        let mut boxes = Self {
            first,
            nodes: vec![EMPTY; first + leaves],
        };
        for leaf in 0..leaves {
            boxes.nodes[first + leaf] = around(points, triangles, leaf);
        }
        for i in (1..first).rev() {
            boxes.nodes[i] = boxes.joined(i);
        }
        boxes
    }

    /// The box around the children of a node.
    fn joined(&self, i: usize) -> (DVec3, DVec3) {
        let child = |i: usize| self.nodes.get(i).copied().unwrap_or(EMPTY);
        let (a, b) = (child(2 * i), child(2 * i + 1));
        (a.0.min(b.0), a.1.max(b.1))
    }

    /// Fits the boxes to a triangle that has changed.
    pub fn refit(&mut self, points: &[DVec3], triangles: &[[u32; 3]], triangle: u32) {
        let leaf = triangle as usize / LEAF;
        let mut i = self.first + leaf;
        let mut own = around(points, triangles, leaf);
        while i > 0 && self.nodes[i] != own {
            self.nodes[i] = own;
            i /= 2;
            own = self.joined(i);
        }
    }

    /// Whether `is_free` holds for all triangles whose leaves meet the box from `low` to `high`, and perhaps for others.
    pub fn all_near(
        &self,
        (low, high): (DVec3, DVec3),
        count: usize,
        mut is_free: impl FnMut(u32) -> bool,
    ) -> bool {
        // Of a node one child waits while the other is looked at.
        let mut waiting = [0usize; usize::BITS as usize + 1];
        waiting[0] = 1;
        let mut left = 1;
        while left > 0 {
            left -= 1;
            let i = waiting[left];
            let (from, to) = self.nodes.get(i).copied().unwrap_or(EMPTY);
            if !(from.cmple(high).all() && to.cmpge(low).all()) {
                continue;
            }
            if i < self.first {
                waiting[left] = 2 * i + 1;
                waiting[left + 1] = 2 * i;
                left += 2;
                continue;
            }
            let start = (i - self.first) * LEAF;
            if !(start..(start + LEAF).min(count)).all(|t| is_free(t as u32)) {
                return false;
            }
        }
        true
    }
}

/// The box around the triangles of a leaf.
fn around(points: &[DVec3], triangles: &[[u32; 3]], leaf: usize) -> (DVec3, DVec3) {
    let end = (leaf * LEAF + LEAF).min(triangles.len());
    let corners = triangles[leaf * LEAF..end].iter().flatten();
    corners.fold(EMPTY, |(low, high), v| {
        let p = points[*v as usize];
        (low.min(p), high.max(p))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_meets_a_box_is_found_before_and_after_a_change() {
        let at = |i: u32| DVec3::new(f64::from(i), f64::from(i * i % 7), f64::from(i % 3));
        let points: Vec<DVec3> = (0..60).map(at).collect();
        let mut triangles: Vec<[u32; 3]> = (0..58).map(|i| [i, i + 1, i + 2]).collect();
        let mut boxes = Boxes::new(&points, &triangles);
        for change in [None, Some((5, [40, 41, 59])), Some((57, [0, 1, 2]))] {
            if let Some((t, corners)) = change {
                triangles[t] = corners;
                boxes.refit(&points, &triangles, t as u32);
            }
            for i in 0..60 {
                let (low, high) = (at(i) - 0.6, at(i) + 0.4);
                let mut found = Vec::new();
                boxes.all_near((low, high), triangles.len(), |t| {
                    found.push(t);
                    true
                });
                for t in 0..triangles.len() as u32 {
                    let corners = triangles[t as usize].map(|v| points[v as usize]);
                    let meets = corners[0].min(corners[1]).min(corners[2]).cmple(high).all()
                        && corners[0].max(corners[1]).max(corners[2]).cmpge(low).all();
                    assert!(!meets || found.contains(&t), "{t} near {i}");
                }
                assert!(found.len() < 30, "{} near {i}", found.len());
            }
        }
    }
}

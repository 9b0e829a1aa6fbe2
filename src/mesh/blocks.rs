//! Space cut into blocks of points, to be worked on at once.

use glam::DVec3;

use super::curve::bounds;

/// Points in blocks that planes across the axes part, so that the hulls of two blocks have nothing in common.
///
/// Memory: 4 bytes a point.
pub(super) struct Blocks {
    /// The points of all blocks, one block after another, those of one in rising order.
    order: Vec<u32>,
    /// Where each block ends in `order`.
    ends: Vec<usize>,
}

impl Blocks {
    /// Of at most `most` points each, or of points that are all equal. Half as wide each time, so that as many cuts are made as there are sizes of
    /// detail, whatever the order and density of the points.
    pub fn new(points: &[DVec3], most: usize) -> Self {
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let mut ends = Vec::new();
        let all = 0..order.len();
        let mut waiting = vec![all];
        while let Some(range) = waiting.pop() {
            let own = &mut order[range.clone()];
            match (own.len() > most).then(|| cut(points, own)).flatten() {
                Some(middle) => {
                    let middle = range.start + middle;
                    waiting.extend([middle..range.end, range.start..middle]);
                }
                None => {
                    own.sort_unstable();
                    ends.push(range.end);
                }
            }
        }
        Self { order, ends }
    }

    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// The points of a block, in rising order.
    pub fn points(&self, block: usize) -> &[u32] {
        let start = block.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.order[start..self.ends[block]]
    }

    /// For every point its block.
    pub fn numbers(&self) -> Vec<u32> {
        let mut numbers = vec![0; self.order.len()];
        for block in 0..self.len() {
            for v in self.points(block) {
                numbers[*v as usize] = block as u32;
            }
        }
        numbers
    }
}

/// Brings the points below the middle of their longest side to the front; how many, or `None` where they cannot be parted.
fn cut(points: &[DVec3], own: &mut [u32]) -> Option<usize> {
    let (low, high) = bounds(own.iter().map(|v| points[*v as usize]));
    let axis = (high - low).max_position();
    let middle = 0.5 * low[axis] + 0.5 * high[axis];
    let mut below = 0;
    for i in 0..own.len() {
        if points[own[i] as usize][axis] < middle {
            own.swap(i, below);
            below += 1;
        }
    }
    (0 < below && below < own.len()).then_some(below)
}

/// Whether the box around a triangle meets another box.
pub(super) fn meets(corners: &[DVec3; 3], (low, high): (DVec3, DVec3)) -> bool {
    let [a, b, c] = *corners;
    a.min(b).min(c).cmple(high).all() && a.max(b).max(c).cmpge(low).all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_part_the_blocks_and_every_point_is_in_one() {
        let coarse = |i: u32| DVec3::new(f64::from(i % 7), f64::from(i % 11), f64::from(i % 13));
        let uneven = |i: u32| DVec3::splat(f64::from(i)).exp() * DVec3::new(1.0, 1e-3, 0.0);
        let equal = |_: u32| DVec3::ONE;
        for (points, most) in [
            ((0..1001).map(coarse).collect::<Vec<_>>(), 20),
            ((0..300).map(uneven).collect(), 4),
            ((0..50).map(equal).collect(), 50),
        ] {
            let blocks = Blocks::new(&points, most);
            let numbers = blocks.numbers();
            assert_eq!(numbers.len(), points.len());
            let around: Vec<(DVec3, DVec3)> = (0..blocks.len())
                .map(|i| bounds(blocks.points(i).iter().map(|v| points[*v as usize])))
                .collect();
            for i in 0..blocks.len() {
                let own = blocks.points(i);
                assert!(!own.is_empty() && own.len() <= most && own.is_sorted());
                assert!(own.iter().all(|v| numbers[*v as usize] == i as u32));
                for j in 0..i {
                    let is_parted = around[i].0.cmpgt(around[j].1).any()
                        || around[i].1.cmplt(around[j].0).any();
                    assert!(is_parted, "{i} {j}");
                }
            }
        }
        let nothing = Blocks::new(&[], 5);
        assert_eq!((nothing.len(), nothing.numbers().len()), (1, 0));
        // Many equal points cannot be parted.
        assert_eq!(Blocks::new(&[DVec3::ONE; 9], 5).points(0).len(), 9);
    }
}

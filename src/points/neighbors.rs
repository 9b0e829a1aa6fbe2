//! Nearest neighbours and neighbours within a radius, over one immutable k-d tree.
//!
//! The tree stands over copies of the points that are rotated by a fixed odd rotation and sorted along a Morton curve: axis-aligned
//! planar scans otherwise cost a tree that splits its axes in turn two to four times as much, and queries in that order find the
//! tree's nodes in the cache.

use std::num::NonZeroUsize;

use glam::{DQuat, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

/// Neighbours in a set of N points.
///
/// Points at exactly the same place count once: the first of them in input order stands for all, so that a million identical
/// points cost no more than one. Points that are not finite are never anybody's neighbour.
pub struct Neighbors {
    tree: Option<ImmutableKdTree<f64, 3>>,
    turn: DQuat,
    centre: DVec3,
    /// Input index of every distinct place, in Morton order: what the tree's items mean.
    places: Vec<u32>,
    /// All finite points, in Morton order.
    order: Vec<u32>,
    /// Where the points of `order` begin that lie at each place; one longer than `places`.
    starts: Vec<u32>,
}

/// An arbitrary rotation that maps no common direction of a part onto an axis.
fn odd_turn() -> DQuat {
    DQuat::from_axis_angle(DVec3::new(0.36, -0.48, 0.8).normalize(), 0.7391)
}

impl Neighbors {
    /// The neighbours among `positions` (mm), of which there are fewer than 2^32.
    pub fn new(positions: &[DVec3]) -> Self {
        let turn = odd_turn();
        let (low, high) = bounds(positions);
        let centre = (low + high) * 0.5;
        let reach = ((high - low).length() * 0.5).max(f64::MIN_POSITIVE);
        let mut keyed: Vec<(u64, u32)> = positions
            .par_iter()
            .enumerate()
            .filter(|(_, p)| p.is_finite())
            .map(|(i, p)| (morton(turn * ((*p - centre) / reach)), i as u32))
            .collect();
        keyed.par_sort_unstable();
        separate_equal_cells(&mut keyed, positions);

        let order: Vec<u32> = keyed.into_iter().map(|(_, i)| i).collect();
        let (places, starts) = distinct(&order, positions);
        let copies: Vec<[f64; 3]> = places
            .par_iter()
            .map(|&i| (turn * (positions[i as usize] - centre)).to_array())
            .collect();
        let tree = if copies.is_empty() {
            None
        } else {
            ImmutableKdTree::new_from_slice(&copies).ok()
        };
        Self {
            tree,
            turn,
            centre,
            places,
            order,
            starts,
        }
    }

    /// The at most `k` places nearest to `p`, into `out` as (input index, squared distance in mm²), nearest first.
    ///
    /// A place of the set is its own nearest neighbour. Where several are equally far as the last one, which of them comes is unspecified.
    pub fn nearest(&self, p: DVec3, k: usize, out: &mut Vec<(u32, f64)>) {
        self.nearest_places(p, k, out);
        for entry in out.iter_mut() {
            entry.0 = self.places[entry.0 as usize];
        }
    }

    /// All places nearer to `p` than `radius_mm`, into `out` as (input index, squared distance in mm²), nearest first.
    pub fn within(&self, p: DVec3, radius_mm: f64, out: &mut Vec<(u32, f64)>) {
        self.within_places(p, radius_mm, out);
        for entry in out.iter_mut() {
            entry.0 = self.places[entry.0 as usize];
        }
    }

    /// As [`Neighbors::nearest`], of the places nearer to `p` than `radius_mm` alone: far from all of them it costs almost nothing.
    pub fn nearest_within(&self, p: DVec3, k: usize, radius_mm: f64, out: &mut Vec<(u32, f64)>) {
        out.clear();
        let finite = p.is_finite() && radius_mm.is_finite();
        let (Some(tree), Some(k), true) = (&self.tree, NonZeroUsize::new(k), finite) else {
            return;
        };
        let found = tree
            .query(&self.inside(p))
            .nearest_n::<SquaredEuclidean<f64>>(k)
            .within(radius_mm * radius_mm)
            .execute();
        out.extend(
            found
                .iter()
                .map(|hit| (self.places[hit.item as usize], hit.distance)),
        );
        sort_by_distance(out);
    }

    /// Input indices of all finite points in an order that keeps neighbours together; queries in this order are the fastest.
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// Input index of every distinct place, in the order of [`Neighbors::order`].
    pub(crate) fn places(&self) -> &[u32] {
        &self.places
    }

    /// Input indices of the points that lie at place `rank` of [`Neighbors::places`].
    pub(crate) fn points_at(&self, rank: usize) -> &[u32] {
        &self.order[self.starts[rank] as usize..self.starts[rank + 1] as usize]
    }

    /// As [`Neighbors::nearest`], with ranks in [`Neighbors::places`] in place of input indices.
    pub(crate) fn nearest_places(&self, p: DVec3, k: usize, out: &mut Vec<(u32, f64)>) {
        out.clear();
        let (Some(tree), Some(k), true) = (&self.tree, NonZeroUsize::new(k), p.is_finite()) else {
            return;
        };
        let found = tree
            .query(&self.inside(p))
            .nearest_n::<SquaredEuclidean<f64>>(k)
            .execute();
        out.extend(found.iter().map(|hit| (hit.item, hit.distance)));
        sort_by_distance(out);
    }

    /// As [`Neighbors::within`], with ranks in [`Neighbors::places`] in place of input indices.
    pub(crate) fn within_places(&self, p: DVec3, radius_mm: f64, out: &mut Vec<(u32, f64)>) {
        out.clear();
        let (Some(tree), true) = (&self.tree, p.is_finite() && radius_mm.is_finite()) else {
            return;
        };
        let found = tree
            .query(&self.inside(p))
            .within::<SquaredEuclidean<f64>>(radius_mm * radius_mm)
            .unsorted()
            .execute();
        out.extend(found.iter().map(|hit| (hit.item, hit.distance)));
        sort_by_distance(out);
    }

    fn inside(&self, p: DVec3) -> [f64; 3] {
        (self.turn * (p - self.centre)).to_array()
    }
}

fn sort_by_distance(out: &mut [(u32, f64)]) {
    out.sort_unstable_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
}

fn bounds(positions: &[DVec3]) -> (DVec3, DVec3) {
    let mut finite = positions.iter().filter(|p| p.is_finite());
    let first = finite.next().copied().unwrap_or(DVec3::ZERO);
    finite.fold((first, first), |(low, high), p| (low.min(*p), high.max(*p)))
}

/// Place of `p`, in the ball of radius one, along the Morton curve: 21 bits an axis.
fn morton(p: DVec3) -> u64 {
    let cell = |x: f64| spread(((x * 0.5 + 0.5) * 2_097_151.0).clamp(0.0, 2_097_151.0) as u64);
    cell(p.x) | cell(p.y) << 1 | cell(p.z) << 2
}

/// The low 21 bits of `x`, two zero bits between each.
fn spread(x: u64) -> u64 {
    let x = (x | x << 32) & 0x001f_0000_0000_ffff;
    let x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    let x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    let x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

/// Brings equal points of one Morton cell together, each group in input order.
fn separate_equal_cells(keyed: &mut [(u64, u32)], positions: &[DVec3]) {
    for cell in keyed.chunk_by_mut(|a, b| a.0 == b.0) {
        if cell.len() > 1 {
            cell.sort_unstable_by(|a, b| {
                compare(positions[a.1 as usize], positions[b.1 as usize]).then(a.1.cmp(&b.1))
            });
        }
    }
}

fn compare(a: DVec3, b: DVec3) -> std::cmp::Ordering {
    // Adding zero makes -0 and +0, which are the same place, compare equal.
    let key = |v: f64| v + 0.0;
    (key(a.x).total_cmp(&key(b.x)))
        .then(key(a.y).total_cmp(&key(b.y)))
        .then(key(a.z).total_cmp(&key(b.z)))
}

fn distinct(order: &[u32], positions: &[DVec3]) -> (Vec<u32>, Vec<u32>) {
    let mut places = Vec::with_capacity(order.len());
    let mut starts = Vec::with_capacity(order.len() + 1);
    for (at, &i) in order.iter().enumerate() {
        if at == 0 || positions[i as usize] != positions[order[at - 1] as usize] {
            places.push(i);
            starts.push(at as u32);
        }
    }
    starts.push(order.len() as u32);
    (places, starts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn by_hand(positions: &[DVec3], p: DVec3) -> Vec<f64> {
        let mut d: Vec<f64> = positions.iter().map(|q| q.distance_squared(p)).collect();
        d.sort_by(f64::total_cmp);
        d
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn neighbours_are_those_that_comparing_all_points_finds(
            raw in proptest::collection::vec((-9.0f64..9.0, -9.0f64..9.0, 0.0f64..0.01), 1..200),
            k in 1usize..40,
            radius in 0.1f64..5.0,
        ) {
            let points: Vec<DVec3> = raw.into_iter().map(|(x, y, z)| DVec3::new(x, y, z)).collect();
            let neighbors = Neighbors::new(&points);
            let p = points[0];
            let truth = by_hand(&points, p);
            let mut found = Vec::new();

            neighbors.nearest(p, k, &mut found);
            prop_assert_eq!(found.len(), k.min(points.len()));
            for ((i, d2), expected) in found.iter().zip(&truth) {
                prop_assert!((points[*i as usize].distance_squared(p) - expected).abs() < 1e-10);
                prop_assert!((d2 - expected).abs() < 1e-10);
            }

            neighbors.nearest_within(p, k, radius, &mut found);
            let inside = truth.iter().filter(|d| **d < radius * radius).count();
            prop_assert_eq!(found.len(), k.min(inside));
            for ((_, d2), expected) in found.iter().zip(&truth) {
                prop_assert!((d2 - expected).abs() < 1e-10);
            }

            neighbors.within(p, radius, &mut found);
            let inside = truth.iter().filter(|d| **d < radius * radius).count();
            prop_assert_eq!(found.len(), inside);
        }
    }

    #[test]
    fn a_million_identical_points_are_one_place() {
        let mut points = vec![DVec3::new(1.0, 2.0, 3.0); 1_000_000];
        points.push(DVec3::new(1.0, 2.0, 4.0));
        let neighbors = Neighbors::new(&points);
        let mut found = Vec::new();
        neighbors.nearest(points[7], 5, &mut found);
        assert_eq!(
            found.iter().map(|f| f.0).collect::<Vec<_>>(),
            [0, 1_000_000]
        );
        assert_eq!(neighbors.order().len(), points.len());
    }

    #[test]
    fn planes_lines_nothing_and_not_finite_points_are_survived() {
        let mut found = Vec::new();
        let none = Neighbors::new(&[]);
        none.nearest(DVec3::ZERO, 3, &mut found);
        assert!(found.is_empty());

        let line: Vec<DVec3> = (0..5_000)
            .map(|i| DVec3::new(f64::from(i), 0.0, 0.0))
            .collect();
        Neighbors::new(&line).nearest(line[2_500], 3, &mut found);
        assert_eq!(found.len(), 3);
        assert_eq!(found[0].0, 2_500);

        let odd = [DVec3::NAN, DVec3::ZERO, DVec3::INFINITY, DVec3::X];
        let neighbors = Neighbors::new(&odd);
        neighbors.nearest(DVec3::ZERO, 9, &mut found);
        assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), [1, 3]);
        neighbors.nearest(DVec3::NAN, 9, &mut found);
        assert!(found.is_empty());
    }
}

//! The order in which points enter a triangulation: neighbours along a Hilbert curve follow one another.

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;

use super::predicates::compare;

/// Bits along each axis: 65,536 steps, finer than the spacing of any cloud that fits in memory.
const BITS: u32 = 16;

/// Indices of the distinct ones among finite `points` along a Hilbert curve through their bounding cube, and for every input index its
/// place in that list. Where several points are equal the first in input order stands for all.
pub fn along_hilbert_curve(points: &[DVec3]) -> (Vec<u32>, Vec<u32>) {
    let (low, high) = bounds(points.iter().copied());
    let size = (high - low).max_element().max(f64::MIN_POSITIVE);
    let steps = f64::from(1u32 << BITS) * (1.0 - 1e-9) / size;
    let mut keyed: Vec<(u64, u32)> = points
        .par_iter()
        .enumerate()
        .map(|(i, p)| {
            (
                hilbert(((*p - low) * steps).to_array().map(|x| x as u32)),
                i as u32,
            )
        })
        .collect();
    keyed.par_sort_unstable();
    for cell in keyed.chunk_by_mut(|a, b| a.0 == b.0) {
        if cell.len() > 1 {
            let at = |i: u32| points[i as usize];
            cell.sort_unstable_by(|a, b| compare(at(a.1), at(b.1)).then(a.1.cmp(&b.1)));
        }
    }
    let mut distinct: Vec<u32> = Vec::with_capacity(points.len());
    let mut place = vec![0; points.len()];
    for (_, i) in keyed {
        let is_new = distinct
            .last()
            .is_none_or(|last| points[*last as usize] != points[i as usize]);
        if is_new {
            distinct.push(i);
        }
        place[i as usize] = distinct.len() as u32 - 1;
    }
    (distinct, place)
}

pub fn bounds(points: impl IntoIterator<Item = DVec3>) -> (DVec3, DVec3) {
    let mut points = points.into_iter();
    let first = points.next().unwrap_or(DVec3::ZERO);
    points.fold((first, first), |(low, high), p| (low.min(p), high.max(p)))
}

/// Place of a cell of the cube along the curve (Skilling, *Programming the Hilbert curve*, 2004).
fn hilbert(mut x: [u32; 3]) -> u64 {
    let mut q = 1u32 << (BITS - 1);
    while q > 1 {
        let p = q - 1;
        for i in 0..3 {
            if x[i] & q != 0 {
                x[0] ^= p;
            } else {
                let t = (x[0] ^ x[i]) & p;
                x[0] ^= t;
                x[i] ^= t;
            }
        }
        q >>= 1;
    }
    x[1] ^= x[0];
    x[2] ^= x[1];
    let mut t = 0;
    let mut q = 1u32 << (BITS - 1);
    while q > 1 {
        if x[2] & q != 0 {
            t ^= q - 1;
        }
        q >>= 1;
    }
    let [a, b, c] = x.map(|x| spread(x ^ t));
    a << 2 | b << 1 | c
}

/// The low 21 bits of `x`, two zero bits between each.
fn spread(x: u32) -> u64 {
    let x = u64::from(x);
    let x = (x | x << 32) & 0x001f_0000_0000_ffff;
    let x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    let x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    let x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

/// Indices below `count` in rounds that each double the density evenly, in ascending order within a round, and the ranges of the rounds (Amenta, Choi and Rote,
/// *Incremental constructions con BRIO*, 2003): along a curve alone, scan lines make cavities of unbounded size.
pub fn in_rounds(count: usize) -> (Vec<u32>, Vec<Range<usize>>) {
    const ROUNDS: usize = 16;
    let round = |i: usize| {
        // The finisher of splitmix64: three of four indices go to the last round.
        let mut z = (i as u64).wrapping_add(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (((z ^ (z >> 31)).trailing_zeros() / 2) as usize).min(ROUNDS - 1)
    };
    let mut starts = [0usize; ROUNDS + 1];
    for i in 0..count {
        starts[ROUNDS - 1 - round(i) + 1] += 1;
    }
    for r in 0..ROUNDS {
        starts[r + 1] += starts[r];
    }
    let rounds = (0..ROUNDS).map(|r| starts[r]..starts[r + 1]).collect();
    let mut order = vec![0; count];
    for i in 0..count {
        let at = &mut starts[ROUNDS - 1 - round(i)];
        order[*at] = i as u32;
        *at += 1;
    }
    (order, rounds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_along_the_curve_are_steps_to_a_neighbouring_cell() {
        let mut cells: Vec<(u64, [u32; 3])> = (0..4096u32)
            .map(|i| [i & 15, i >> 4 & 15, i >> 8])
            .map(|c| (hilbert(c), c))
            .collect();
        cells.sort_unstable();
        for pair in cells.windows(2) {
            let steps: u32 = (0..3).map(|i| pair[0].1[i].abs_diff(pair[1].1[i])).sum();
            assert_eq!(steps, 1, "{pair:?}");
        }
    }

    #[test]
    fn equal_points_are_one_and_every_index_is_in_one_round() {
        let points: Vec<DVec3> = (0..300).map(|i| DVec3::splat(f64::from(i % 100))).collect();
        let (distinct, place) = along_hilbert_curve(&points);
        assert_eq!(distinct.len(), 100);
        assert!(
            distinct.iter().all(|i| *i < 100),
            "the first of equal points"
        );
        for (i, p) in place.iter().enumerate() {
            assert_eq!(points[distinct[*p as usize] as usize], points[i]);
        }
        let (mut order, rounds) = in_rounds(5_000);
        assert!(rounds.iter().all(|r| order[r.clone()].is_sorted()));
        assert_eq!(rounds.last().map(|r| r.end), Some(5_000));
        assert!(order[..1000].windows(2).filter(|w| w[0] > w[1]).count() < 16);
        order.sort_unstable();
        assert!(order.iter().enumerate().all(|(i, o)| i as u32 == *o));
    }
}

//! Points that lie exactly on one another.

use std::cmp::Ordering;

use glam::DVec3;
use rayon::prelude::*;

/// For each of N positions, whether no position before it is the same; minus zero is zero.
///
/// O(N log N) for any input: positions are sorted by a mix of their bits and compared in full where the mixes agree.
pub(crate) fn first_occurrences(positions: &[DVec3]) -> Vec<bool> {
    let mut keys: Vec<(u64, usize)> = positions
        .par_iter()
        .enumerate()
        .map(|(index, &p)| (mix(bits(p)), index))
        .collect();
    let same = |a: usize, b: usize| bits(positions[a]).cmp(&bits(positions[b]));
    keys.par_sort_unstable_by(|a, b| {
        a.0.cmp(&b.0)
            .then_with(|| same(a.1, b.1))
            .then_with(|| a.1.cmp(&b.1))
    });
    let mut first = vec![true; positions.len()];
    for pair in keys.windows(2) {
        if pair[0].0 == pair[1].0 && same(pair[0].1, pair[1].1) == Ordering::Equal {
            first[pair[1].1] = false;
        }
    }
    first
}

fn bits(p: DVec3) -> [u64; 3] {
    // Adding zero makes minus zero plus zero.
    (p + DVec3::ZERO).to_array().map(f64::to_bits)
}

/// Spreads the bits of three words over one, by the finisher of splitmix64 (Steele et al. 2014).
fn mix(words: [u64; 3]) -> u64 {
    words.into_iter().fold(0, |state, word| {
        let mut z = (state ^ word).wrapping_add(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    })
}

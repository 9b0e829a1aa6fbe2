//! Agglomerative clustering of lines through the origin by average linkage (Weber 2011, §3.4.3, 3.5), without allocation per use.
//!
//! The closest pair of clusters is merged first until no two are nearer than a bound. Chains of nearest neighbours (Murtagh 1983) merge
//! in another order and end in the same clusters: average linkage is reducible, so what merges brings no third cluster nearer. That
//! makes it quadratic in the number of lines, where looking for the closest pair of all each time is cubic.
//!
//! Angles and distances are held in single precision, good to 1e-6 rad: the sensitivities they are compared with start at 0.05.

use glam::DVec3;

/// Lanes that the loops over a row are cut into, for the compiler to make vector code of.
const LANES: usize = 8;
/// Coefficients of asin(sqrt z) / sqrt z on 0 to 1/2, by interpolation at Chebyshev nodes: twice the arc is good to 2e-7 rad.
const ARC: [f32; 7] = [
    1.000_000_1,
    0.166_650_87,
    0.075_493_6,
    0.038_985_714,
    0.060_246_795,
    -0.053_785_678,
    0.100_086_21,
];

/// Unit directions of lines through the origin: one of the two ends of each.
#[derive(Debug, Default)]
pub(super) struct Lines {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
}

impl Lines {
    /// Empties the set.
    pub fn clear(&mut self) {
        self.x.clear();
        self.y.clear();
        self.z.clear();
    }

    /// Takes in a line along the unit vector `n`.
    pub fn push(&mut self, n: DVec3) {
        self.x.push(n.x as f32);
        self.y.push(n.y as f32);
        self.z.push(n.z as f32);
    }

    /// Number of lines.
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// A direction of line `i`.
    pub fn get(&self, i: usize) -> DVec3 {
        DVec3::new(self.x[i].into(), self.y[i].into(), self.z[i].into())
    }

    /// The angles, rad, 0 to pi / 2, between the line along the unit vector `n` and the lines from `first` on, into `out`.
    ///
    /// Computed from the chord between the nearer ends, which keeps small angles exact where an arc cosine loses them.
    pub fn angles(&self, n: DVec3, first: usize, out: &mut [f32]) {
        let (nx, ny, nz) = (n.x as f32, n.y as f32, n.z as f32);
        let rest = self.x[first..].iter().zip(&self.y[first..]);
        for (((x, y), z), angle) in rest.zip(&self.z[first..]).zip(out) {
            let sign = (nx * x + ny * y + nz * z).signum();
            let (dx, dy, dz) = (x - sign * nx, y - sign * ny, z - sign * nz);
            // Square of half the chord, which is the sine of half the angle.
            let z = 0.25 * (dx * dx + dy * dy + dz * dz);
            let series = ARC.iter().rev().fold(0.0, |sum, c| sum * z + c);
            *angle = 2.0 * z.sqrt() * series;
        }
    }
}

/// The clusters of a set of lines, merged as far as the last bound.
///
/// The clusters lie in `0..total` of a square of mutual distances; those in `live..total` are further than the bound from all others.
#[derive(Debug, Default)]
pub(super) struct Linkage {
    distances: Vec<f32>,
    stride: usize,
    sizes: Vec<u32>,
    chain: Vec<usize>,
    live: usize,
    total: usize,
}

impl Linkage {
    /// Starts over, each line a cluster of its own.
    pub fn start(&mut self, lines: &Lines) {
        let n = lines.len();
        self.stride = n;
        self.total = n;
        if self.distances.len() < n * n {
            self.distances.resize(n * n, 0.0);
        }
        for i in 0..n {
            let row = i * n;
            lines.angles(lines.get(i), i, &mut self.distances[row + i..row + n]);
            self.distances[row + i] = f32::INFINITY;
            for j in i + 1..n {
                self.distances[j * n + i] = self.distances[row + j];
            }
        }
        self.sizes.clear();
        self.sizes.resize(n, 1);
    }

    /// Merges until the mean distance (3.5) of all pairs of clusters exceeds `bound_rad`, which must not fall between calls.
    pub fn merge_until(&mut self, bound_rad: f32) {
        self.live = self.total;
        self.chain.clear();
        while self.live > 0 {
            let top = self.chain.last().copied().unwrap_or(0);
            let below = (self.chain.len().checked_sub(2)).map(|i| self.chain[i]);
            if self.chain.is_empty() {
                self.chain.push(top);
            }
            let row = &self.distances[top * self.stride..][..self.live];
            let nearest = least(row);
            let next = row.iter().position(|d| *d <= nearest.min(bound_rad));
            match (next, below.filter(|b| row[*b] <= nearest)) {
                // Only the first of a chain gets here: every next one has the one below it within the bound.
                (None, _) => {
                    self.chain.clear();
                    self.live -= 1;
                    self.swap(top, self.live);
                }
                (_, Some(below)) => {
                    self.chain.truncate(self.chain.len() - 2);
                    self.merge(top.min(below), top.max(below));
                }
                (Some(next), None) => self.chain.push(next),
            }
        }
    }

    /// Number of lines in each cluster.
    pub fn sizes(&self) -> &[u32] {
        &self.sizes[..self.total]
    }

    /// Makes `keep` the union of both, with the mean of the distances weighted by the sizes, and `drop < live` disappear.
    fn merge(&mut self, keep: usize, drop: usize) {
        let n = self.stride;
        let (a, b) = (self.sizes[keep] as f32, self.sizes[drop] as f32);
        let (wa, wb) = (a / (a + b), b / (a + b));
        let (head, tail) = self.distances.split_at_mut(drop * n);
        let kept = &mut head[keep * n..][..self.total];
        for (d, e) in kept.iter_mut().zip(&tail[..self.total]) {
            *d = wa * *d + wb * e;
        }
        kept[keep] = f32::INFINITY;
        for i in 0..self.total {
            self.distances[i * n + keep] = self.distances[keep * n + i];
        }
        self.sizes[keep] += self.sizes[drop];
        self.live -= 1;
        self.put(self.live, drop);
        self.total -= 1;
        self.put(self.total, self.live);
    }

    /// Moves cluster `from` to the place `to`, whose own is given up.
    fn put(&mut self, from: usize, to: usize) {
        if from == to {
            return;
        }
        let n = self.stride;
        self.distances
            .copy_within(from * n..from * n + self.total, to * n);
        self.distances[to * n + to] = f32::INFINITY;
        for i in 0..self.total {
            self.distances[i * n + to] = self.distances[to * n + i];
        }
        self.sizes[to] = self.sizes[from];
        for c in self.chain.iter_mut().filter(|c| **c == from) {
            *c = to;
        }
    }

    /// Exchanges two clusters while the chain is empty.
    fn swap(&mut self, i: usize, j: usize) {
        if i == j {
            return;
        }
        let n = self.stride;
        let (i, j) = (i.min(j), i.max(j));
        let (head, tail) = self.distances.split_at_mut(j * n);
        head[i * n..][..self.total].swap_with_slice(&mut tail[..self.total]);
        for row in self.distances.chunks_exact_mut(n).take(self.total) {
            row.swap(i, j);
        }
        self.sizes.swap(i, j);
    }
}

/// The least of a row.
fn least(row: &[f32]) -> f32 {
    let mut least = [f32::INFINITY; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest = chunks.remainder();
    for chunk in chunks {
        for (l, d) in least.iter_mut().zip(chunk) {
            *l = if *d < *l { *d } else { *l };
        }
    }
    (least.iter().chain(rest)).fold(f32::INFINITY, |l, d| if *d < l { *d } else { l })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Merges the closest pair of all clusters, by their members, until it is further than `bound`; sorted sizes of what remains, and the
    /// distances merged at, the last one being that which was not.
    fn by_hand(lines: &[DVec3], bound: f64) -> (Vec<u32>, Vec<f64>) {
        let angle = |a: DVec3, b: DVec3| a.dot(b).abs().min(1.0).acos();
        let mut clusters: Vec<Vec<DVec3>> = lines.iter().map(|l| vec![*l]).collect();
        let mut heights = Vec::new();
        while clusters.len() > 1 {
            let mut best = (f64::INFINITY, 0, 0);
            for i in 0..clusters.len() {
                for j in i + 1..clusters.len() {
                    let pairs = (clusters[i].iter())
                        .flat_map(|a| clusters[j].iter().map(move |b| angle(*a, *b)));
                    let mean = pairs.sum::<f64>() / (clusters[i].len() * clusters[j].len()) as f64;
                    if mean < best.0 {
                        best = (mean, i, j);
                    }
                }
            }
            heights.push(best.0);
            if best.0 > bound {
                break;
            }
            let dropped = clusters.swap_remove(best.2);
            clusters[best.1].extend(dropped);
        }
        let mut sizes: Vec<u32> = clusters.iter().map(|c| c.len() as u32).collect();
        sizes.sort_unstable();
        (sizes, heights)
    }

    fn sizes(linkage: &Linkage) -> Vec<u32> {
        let mut sizes = linkage.sizes().to_vec();
        sizes.sort_unstable();
        sizes
    }

    fn set(directions: &[DVec3]) -> Lines {
        let mut lines = Lines::default();
        for d in directions {
            lines.push(*d);
        }
        lines
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        #[test]
        fn chains_end_in_the_clusters_of_merging_the_closest_pair_first(
            raw in proptest::collection::vec((-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0), 1..48),
            bounds in (0.02f64..0.8, 0.01f64..0.8),
        ) {
            let directions: Vec<DVec3> = raw
                .iter()
                .filter_map(|(x, y, z)| DVec3::new(*x, *y, *z).try_normalize())
                .collect();
            let mut linkage = Linkage::default();
            // Used before, for a larger set.
            let used: Vec<DVec3> = (0..50).map(any_direction).collect();
            linkage.start(&set(&used));
            linkage.merge_until(0.3);

            linkage.start(&set(&directions));
            // The second bound goes on from where the first one ended.
            for bound in [bounds.0, bounds.0 + bounds.1] {
                let (truth, heights) = by_hand(&directions, bound);
                linkage.merge_until(bound as f32);
                // Single precision tells no distance from the bound that is within 1e-5 of it.
                if heights.iter().all(|h| (h - bound).abs() > 1e-5) {
                    prop_assert_eq!(sizes(&linkage), truth);
                }
            }
        }

        #[test]
        fn angles_are_arc_cosines(a in (-1.0f64..1.0, -1.0f64..1.0, 0.1f64..1.0), turn in 0.0f64..6.3) {
            let n = DVec3::new(a.0, a.1, a.2).normalize();
            let m = glam::DQuat::from_axis_angle(n.any_orthonormal_vector(), turn) * n;
            let mut found = [0.0];
            set(&[m]).angles(n, 0, &mut found);
            let truth = n.cross(m).length().atan2(n.dot(m).abs());
            // Directions rounded to single precision, 6e-8 each, and the series.
            prop_assert!((f64::from(found[0]) - truth).abs() < 1e-6, "{} {truth}", found[0]);
        }
    }

    /// Directions for sets whose content does not matter.
    fn any_direction(i: u32) -> DVec3 {
        let (sin, cos) = (f64::from(i) * 0.7).sin_cos();
        DVec3::new(cos, sin, 0.3 * f64::from(i % 7)).normalize()
    }

    #[test]
    fn opposite_directions_are_one_line_and_two_bundles_two_clusters() {
        let near =
            |d: DVec3, i: u32| (d + DVec3::new(0.01, -0.02, 0.015) * f64::from(i % 3)).normalize();
        let bundles: Vec<DVec3> = (0..30)
            .map(|i| match i % 4 {
                0 => near(DVec3::X, i),
                1 => -near(DVec3::X, i),
                2 => near(DVec3::Y, i),
                _ => -near(DVec3::Y, i),
            })
            .collect();
        let mut linkage = Linkage::default();
        linkage.start(&set(&bundles));
        linkage.merge_until(0.2);
        assert_eq!(sizes(&linkage), [14, 16]);
        // A right angle apart: together only where everything is.
        linkage.merge_until(1.6);
        assert_eq!(sizes(&linkage), [30]);
    }

    #[test]
    fn nothing_and_no_numbers_are_survived() {
        let mut linkage = Linkage::default();
        linkage.start(&Lines::default());
        linkage.merge_until(1.0);
        assert!(linkage.sizes().is_empty());
        linkage.start(&set(&[DVec3::NAN, DVec3::X, DVec3::X]));
        linkage.merge_until(1.0);
        assert_eq!(sizes(&linkage), [1, 2]);
    }
}

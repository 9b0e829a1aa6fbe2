//! Multi-scale surface variation (Pauly et al. 2003), the baseline of Weber 2011, §3.7.7.
//!
//! The surface variation of the n points nearest to a place is the smallest eigenvalue of their covariance over the sum of all three. A
//! place weighs as many as there are n whose variation is above a bound.

use glam::DVec3;
use rayon::prelude::*;

use super::Class;
use crate::points::{Neighbors, PointCloud};

/// Constants of the comparison in §3.7.7.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Surface variation above which a scale counts: smallest eigenvalue over the sum of all, 0 to 1/3.
    pub variation: f64,
    /// Smallest and largest number of neighbours.
    pub neighbours: (usize, usize),
    /// Scales that must count: from the lower bound on beside a point that reaches the upper one.
    ///
    /// The thesis names both bounds and not what they do; this is the hysteresis of Pauly et al. in one step.
    pub weights: (u32, u32),
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            variation: 0.08,
            neighbours: (10, 40),
            weights: (25, 30),
        }
    }
}

/// The classes of N points, [`Class::Edge`] or [`Class::None`], in input order.
pub fn detect_by_variation(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    settings: &Settings,
) -> Vec<Class> {
    let places = neighbors.places();
    let (few, many) = settings.neighbours;
    let weights: Vec<u32> = places
        .par_iter()
        .map_init(Vec::new, |found, i| {
            let p = cloud.positions[*i as usize];
            neighbors.nearest(p, many, found);
            let mut sums = Sums::default();
            let mut weight = 0;
            for (at, (j, _)) in found.iter().enumerate() {
                sums.add(cloud.positions[*j as usize] - p);
                weight += u32::from(at + 1 >= few && sums.varies_more_than(settings.variation));
            }
            weight
        })
        .collect();
    let strong: Vec<bool> = (0..places.len())
        .into_par_iter()
        .map_init(Vec::new, |found, rank| {
            let (lower, upper) = settings.weights;
            if weights[rank] < lower || weights[rank] >= upper {
                return weights[rank] >= upper;
            }
            neighbors.nearest_places(cloud.positions[places[rank] as usize], few, found);
            found.iter().any(|f| weights[f.0 as usize] >= upper)
        })
        .collect();
    let mut classes = vec![Class::None; cloud.positions.len()];
    for (rank, _) in strong.iter().enumerate().filter(|(_, s)| **s) {
        for i in neighbors.points_at(rank) {
            classes[*i as usize] = Class::Edge;
        }
    }
    classes
}

/// Sums over the points nearest to a place, seen from it, mm and mm².
#[derive(Default)]
struct Sums {
    count: f64,
    first: DVec3,
    /// xx, yy, zz.
    square: DVec3,
    /// yz, zx, xy.
    mixed: DVec3,
}

impl Sums {
    fn add(&mut self, p: DVec3) {
        self.count += 1.0;
        self.first += p;
        self.square += p * p;
        self.mixed += DVec3::new(p.y * p.z, p.z * p.x, p.x * p.y);
    }

    /// Whether the surface variation is above `bound`.
    ///
    /// The smallest eigenvalue of a covariance exceeds `bound` times its trace where what is left after taking that off the diagonal is
    /// positive definite, which its leading minors tell (Sylvester) without an eigenvalue.
    fn varies_more_than(&self, bound: f64) -> bool {
        let mean = self.first / self.count;
        let s = self.square / self.count - mean * mean;
        let cross = DVec3::new(mean.y * mean.z, mean.z * mean.x, mean.x * mean.y);
        let m = self.mixed / self.count - cross;
        let d = s - bound * s.element_sum();
        let two = d.x * d.y - m.z * m.z;
        let three = d.z * two + m.y * (m.z * m.x - d.y * m.y) - m.x * (d.x * m.x - m.z * m.y);
        d.x > 0.0 && two > 0.0 && three > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::moments::Moments;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn minors_decide_as_eigenvalues_do(
            raw in proptest::collection::vec((-1.0f64..1.0, -1.0f64..1.0, -0.6f64..0.6), 4..40),
            bound in 0.01f64..0.3,
        ) {
            let (mut sums, mut moments) = (Sums::default(), Moments::default());
            for (x, y, z) in raw {
                sums.add(DVec3::new(x, y, z));
                moments.add(DVec3::new(x, y, z));
            }
            let [a, b, c] = moments.plane().variances;
            // Rounding tells nothing nearer to the bound.
            if (c - bound * (a + b + c)).abs() > 1e-12 {
                prop_assert_eq!(sums.varies_more_than(bound), c > bound * (a + b + c));
            }
        }
    }

    #[test]
    fn a_plane_does_not_vary_and_a_right_edge_does() {
        let (mut plane, mut edge) = (Sums::default(), Sums::default());
        for i in -3..=3 {
            for j in 0..=3 {
                let (x, y) = (f64::from(i), f64::from(j));
                plane.add(DVec3::new(x, y, 0.0));
                edge.add(DVec3::new(x, y, 0.0));
                edge.add(DVec3::new(x, 0.0, y));
            }
        }
        assert!(!plane.varies_more_than(0.01));
        // Across the edge: variance 21/16 along both sides and covariance -9/16 make an eigenvalue of 0.75, along it 4; with 0.75 + 1.875
        // + 4 the variation is 0.11.
        assert!(edge.varies_more_than(0.08) && !edge.varies_more_than(0.2));
    }
}

//! Multi-scale surface variation (Pauly et al. 2003), the baseline of Weber 2011, §3.7.7.

use rayon::prelude::*;

use super::Class;
use crate::points::moments::Moments;
use crate::points::{Neighbors, PointCloud};

/// Constants of the comparison in §3.7.7.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Surface variation above which a scale counts: smallest eigenvalue over the sum of all, 0 to 1/3.
    pub variation: f64,
    /// Smallest and largest number of neighbours.
    pub neighbours: (usize, usize),
    /// Scales that must count: from the lower bound on beside a point that reaches the upper one.
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
            let mut moments = Moments::default();
            let mut weight = 0;
            for (at, (j, _)) in found.iter().enumerate() {
                moments.add(cloud.positions[*j as usize] - p);
                if at + 1 >= few {
                    let [a, b, c] = moments.plane().variances;
                    weight += u32::from(c > settings.variation * (a + b + c));
                }
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

//! Gauss-map clustering as Weber's thesis has it, with one sensitivity for all points or a local one, to repeat its experiments.

use std::f64::consts::FRAC_PI_2;

use glam::DVec3;
use rayon::prelude::*;

use super::Class;
use crate::points::moments::eigen;
use crate::points::{Neighbors, PointCloud};

/// Most triangles a neighbourhood gives: half of 32 times 31 (§3.5.1: at most 32 neighbours).
const MOST_NEIGHBOURS: usize = 32;
/// Clusters with a smaller share of the triangles are noise. The thesis discards those "containing only a few points" (§3.4.3); a corner
/// of four faces has 6 percent in each.
const FEW: f64 = 0.05;
/// Numbers of clusters that make a feature (§3.4.3).
const CLUSTERS: std::ops::RangeInclusive<usize> = 2..=4;

/// The constants of the thesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Neighbours of a point: 16, sensible from 8 to 32 (§3.5.1).
    pub neighbours: usize,
    /// Distance, rad, at which clusters are no longer merged, 0 to pi / 2 (§3.5.2).
    pub sensitivity_rad: f64,
    /// Standard deviation, rad, of the angles to the median direction below which a neighbourhood is flat: 13 degrees (§3.4.3).
    pub flatness_rad: f64,
    /// Makes neighbourhood and sensitivity local (§3.6).
    pub adaptation: Option<Adaptation>,
}

/// The iteration of §3.6.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Adaptation {
    /// Factor on the sensitivity at each step.
    pub raise: f64,
    /// Share of features in a neighbourhood at which it ends.
    pub share: f64,
    /// Largest sensitivity, rad.
    pub most_sensitivity_rad: f64,
    /// Fewest neighbours.
    pub fewest_neighbours: usize,
}

impl Settings {
    /// The global method (§3.4, §3.5): 16 neighbours, sensitivity 0.6 (§3.7.3).
    pub fn global() -> Self {
        Self {
            neighbours: 16,
            sensitivity_rad: 0.6,
            flatness_rad: 13f64.to_radians(),
            adaptation: None,
        }
    }

    /// The local-adaptive method (§3.6, §3.7.4): from 20 neighbours and sensitivity 0.1, 10 percent and one neighbour at a step, down to 30
    /// percent features.
    ///
    /// We differ: with k = 8 reached, the sensitivity goes on to 1.2; the thesis leaves open which of its ends comes first.
    pub fn local_adaptive() -> Self {
        Self {
            neighbours: 20,
            sensitivity_rad: 0.1,
            adaptation: Some(Adaptation {
                raise: 1.1,
                share: 0.3,
                most_sensitivity_rad: 1.2,
                fewest_neighbours: 8,
            }),
            ..Self::global()
        }
    }
}

/// The classes of N points, [`Class::Edge`] or [`Class::None`], in input order.
pub fn detect_as_in_thesis(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    settings: &Settings,
) -> Vec<Class> {
    let most = settings.neighbours.clamp(4, MOST_NEIGHBOURS);
    let places = neighbors.places();
    let at = |rank: u32| cloud.positions[places[rank as usize] as usize];
    let around: Vec<Vec<u32>> = (0..places.len() as u32)
        .into_par_iter()
        .map_init(Vec::new, |found, rank| {
            neighbors.nearest_places(at(rank), most + 1, found);
            found.iter().map(|f| f.0).filter(|r| *r != rank).collect()
        })
        .collect();
    let is_feature = |rank: u32, count: usize, sensitivity: f64, clusters: &mut Clusters| {
        let around = &around[rank as usize];
        let near = &around[..around.len().min(count)];
        clusters.map(at(rank), near.iter().map(|r| at(*r)));
        CLUSTERS.contains(&clusters.count(sensitivity))
    };
    let mut features: Vec<bool> = (0..places.len() as u32)
        .into_par_iter()
        .map_init(Clusters::default, |clusters, rank| {
            let near = around[rank as usize].iter().map(|r| at(*r));
            clusters.map(at(rank), near);
            clusters.spread() >= settings.flatness_rad
                && CLUSTERS.contains(&clusters.count(settings.sensitivity_rad))
        })
        .collect();
    if let Some(adaptation) = settings.adaptation {
        adapt(&around, &mut features, (settings, &adaptation), is_feature);
    }
    let mut classes = vec![Class::None; cloud.positions.len()];
    for (rank, _) in features.iter().enumerate().filter(|(_, f)| **f) {
        for i in neighbors.points_at(rank) {
            classes[*i as usize] = Class::Edge;
        }
    }
    classes
}

/// Thins the candidates where more than a share of a neighbourhood are features, then drops those with at most one fellow (§3.6).
fn adapt(
    around: &[Vec<u32>],
    features: &mut [bool],
    (settings, adaptation): (&Settings, &Adaptation),
    is_feature: impl Fn(u32, usize, f64, &mut Clusters) -> bool,
) {
    let mut clusters = Clusters::default();
    for rank in 0..features.len() as u32 {
        let mut count = settings.neighbours;
        let mut sensitivity = settings.sensitivity_rad;
        while features[rank as usize] {
            let hood = &around[rank as usize];
            let hood = &hood[..hood.len().min(count)];
            let inside = hood.iter().filter(|r| features[**r as usize]).count();
            let crowded = inside as f64 > adaptation.share * hood.len() as f64;
            if !crowded || sensitivity > adaptation.most_sensitivity_rad.min(FRAC_PI_2) {
                break;
            }
            sensitivity *= adaptation.raise;
            count = (count - 1).max(adaptation.fewest_neighbours);
            for r in std::iter::once(&rank).chain(hood) {
                if features[*r as usize] {
                    features[*r as usize] = is_feature(*r, count, sensitivity, &mut clusters);
                }
            }
        }
    }
    let before = features.to_vec();
    for (rank, feature) in features.iter_mut().enumerate() {
        let fellows = around[rank].iter().filter(|r| before[**r as usize]).count();
        *feature &= fellows > 1;
    }
}

/// The discrete Gauss map of one point: unoriented normals of all triangles with two of its neighbours.
#[derive(Default)]
struct Clusters {
    normals: Vec<DVec3>,
    distances: Vec<f32>,
    sizes: Vec<u32>,
    chain: Vec<usize>,
}

impl Clusters {
    fn map(&mut self, p: DVec3, around: impl Iterator<Item = DVec3> + Clone) {
        self.normals.clear();
        for (i, a) in around.clone().enumerate() {
            for b in around.clone().skip(i + 1) {
                self.normals.extend((a - p).cross(b - p).try_normalize());
            }
        }
    }

    /// Standard deviation, rad, of the angles to the median direction, for which we take the axis of the normals.
    fn spread(&self) -> f64 {
        let mut m = [[0.0; 3]; 3];
        for n in &self.normals {
            let n = n.to_array();
            for i in 0..3 {
                for j in 0..3 {
                    m[i][j] += n[i] * n[j];
                }
            }
        }
        let axis = eigen(m).1[0];
        let squares: f64 = self
            .normals
            .iter()
            .map(|n| n.dot(axis).abs().min(1.0).acos().powi(2))
            .sum();
        (squares / self.normals.len().max(1) as f64).sqrt()
    }

    /// Number of clusters that are more than noise when merging by average linkage ends at `sensitivity` (rad).
    ///
    /// Chains of nearest neighbours merge in another order than the closest pair first, and end in the same clusters, since average
    /// linkage is reducible; that makes it quadratic in the number of triangles.
    fn count(&mut self, sensitivity: f64) -> usize {
        let n = self.normals.len();
        self.distances.clear();
        for a in &self.normals {
            self.distances.extend(
                self.normals
                    .iter()
                    .map(|b| a.dot(*b).abs().min(1.0).acos() as f32),
            );
        }
        self.sizes.clear();
        self.sizes.resize(n, 1);
        self.chain.clear();
        let mut done = vec![false; n];
        while let Some(start) = (0..n).find(|i| self.sizes[*i] > 0 && !done[*i]) {
            self.chain.push(start);
            while let Some(&top) = self.chain.last() {
                let below = self.chain.len().checked_sub(2).map(|i| self.chain[i]);
                let (next, distance) = self.nearest(top, below);
                if f64::from(distance) > sensitivity {
                    // Nothing will merge with the end of the chain: merging brings no cluster nearer to it.
                    done[top] = true;
                    self.chain.clear();
                } else if Some(next) == below {
                    self.chain.truncate(self.chain.len() - 2);
                    self.merge(top.min(next), top.max(next));
                } else {
                    self.chain.push(next);
                }
            }
        }
        let few = (FEW * n as f64).max(2.0);
        self.sizes.iter().filter(|s| f64::from(**s) >= few).count()
    }

    /// The nearest other cluster; `favourite` where it is as near.
    fn nearest(&self, of: usize, favourite: Option<usize>) -> (usize, f32) {
        let n = self.sizes.len();
        let mut best = favourite.map_or((of, f32::INFINITY), |f| (f, self.distances[of * n + f]));
        for other in (0..n).filter(|o| *o != of && self.sizes[*o] > 0) {
            let d = self.distances[of * n + other];
            if d < best.1 {
                best = (other, d);
            }
        }
        best
    }

    fn merge(&mut self, keep: usize, drop: usize) {
        let n = self.sizes.len();
        let (a, b) = (self.sizes[keep] as f32, self.sizes[drop] as f32);
        for other in (0..n).filter(|o| self.sizes[*o] > 0) {
            let d = (a * self.distances[keep * n + other] + b * self.distances[drop * n + other])
                / (a + b);
            self.distances[keep * n + other] = d;
            self.distances[other * n + keep] = d;
        }
        self.sizes[keep] += self.sizes[drop];
        self.sizes[drop] = 0;
    }
}

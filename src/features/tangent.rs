//! Tangent planes by least squares over the nearest neighbours, and the flatness test on the Gauss map.

use glam::DVec3;
use rayon::prelude::*;

use crate::points::Neighbors;
use crate::points::moments::Moments;

/// Neighbours, the place itself among them, of a tangent plane.
pub(super) const NEAR: usize = 24;
/// No neighbour.
pub(super) const NOBODY: u32 = u32::MAX;

/// The tangent plane at a place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tangent {
    /// Unit normal; its sign is arbitrary.
    pub normal: [f32; 3],
    /// Signed distance of the place from its plane, mm.
    pub height_mm: f32,
    /// Mean squared distance of the neighbours from the plane, mm².
    pub variance_mm2: f32,
    /// Radius of the neighbourhood, mm.
    pub reach_mm: f32,
}

impl Tangent {
    pub fn normal(&self) -> DVec3 {
        DVec3::from_array(self.normal.map(f64::from))
    }
}

/// Tangent planes of M places, with their neighbours.
pub(super) struct Tangents {
    pub planes: Vec<Tangent>,
    /// M times [`NEAR`] ranks, nearest first, filled up with [`NOBODY`].
    neighbours: Vec<u32>,
}

impl Tangents {
    /// The planes of all `positions` (mm); `neighbors` ranks them in the same order.
    pub fn new(positions: &[DVec3], neighbors: &Neighbors) -> Self {
        let mut neighbours = vec![NOBODY; positions.len() * NEAR];
        let planes = neighbours
            .par_chunks_mut(NEAR)
            .zip(positions.par_iter())
            .map_init(Vec::new, |found, (list, p)| {
                neighbors.nearest_places(*p, NEAR, found);
                drop_ties(found);
                for (slot, (rank, _)) in list.iter_mut().zip(found.iter()) {
                    *slot = *rank;
                }
                tangent(positions, *p, found)
            })
            .collect();
        Self { planes, neighbours }
    }

    /// Ranks of the neighbours of a place, itself first.
    pub fn around(&self, rank: usize) -> &[u32] {
        let list = &self.neighbours[rank * NEAR..(rank + 1) * NEAR];
        let len = list.iter().position(|r| *r == NOBODY).unwrap_or(NEAR);
        &list[..len]
    }

    /// Mean squared sine between the normal of a place and those of its neighbours: the spread of its Gauss map.
    pub fn spread(&self, rank: usize) -> f64 {
        let n = self.planes[rank].normal();
        let around = self.around(rank);
        let sum: f64 = around
            .iter()
            .map(|j| 1.0 - n.dot(self.planes[*j as usize].normal()).powi(2))
            .sum();
        sum / around.len().max(1) as f64
    }
}

/// Drops all that are as far as the last one, so that which of several equally far ones were found does not matter.
pub(super) fn drop_ties(found: &mut Vec<(u32, f64)>) {
    if let Some(last) = found.last().map(|f| f.1 * (1.0 - 1e-9)) {
        let kept = found.partition_point(|f| f.1 < last);
        if kept >= 8 {
            found.truncate(kept);
        }
    }
}

fn tangent(positions: &[DVec3], p: DVec3, found: &[(u32, f64)]) -> Tangent {
    let mut moments = Moments::default();
    for (rank, _) in found {
        moments.add(positions[*rank as usize] - p);
    }
    let fit = moments.plane();
    Tangent {
        normal: fit.normal.as_vec3().to_array(),
        height_mm: -fit.normal.dot(fit.centre) as f32,
        variance_mm2: fit.variances[2] as f32,
        reach_mm: found.last().map_or(0.0, |f| f.1.sqrt()) as f32,
    }
}

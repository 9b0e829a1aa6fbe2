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
    /// Points in it.
    pub count: u32,
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

    /// Largest curvature at a place, 1/mm: how the normals of those neighbours that are `flat` change with the way to them; and the sum of
    /// the squares of the way in the direction in which it is least, mm².
    pub fn curvature(
        &self,
        positions: &[DVec3],
        rank: usize,
        flat: impl Fn(usize) -> bool,
    ) -> Option<(f64, f64)> {
        let n = self.planes[rank].normal();
        let u = n.any_orthonormal_vector();
        let v = n.cross(u);
        // Sums of the way's squares, and of its products with the change of the normal.
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        let mut change = [[0.0; 2]; 2];
        for j in self.around(rank) {
            if !flat(*j as usize) {
                continue;
            }
            let d = positions[*j as usize] - positions[rank];
            let (x, y) = (d.dot(u), d.dot(v));
            let m = self.planes[*j as usize].normal();
            let m = if m.dot(n) < 0.0 { -m } else { m };
            let (a, b) = (m.dot(u), m.dot(v));
            xx += x * x;
            xy += x * y;
            yy += y * y;
            change[0][0] += a * x;
            change[0][1] += a * y;
            change[1][0] += b * x;
            change[1][1] += b * y;
        }
        let det = xx * yy - xy * xy;
        if det.is_nan() || det <= 1e-6 * (xx + yy).powi(2) {
            return None;
        }
        let least = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        let p = (change[0][0] * yy - change[0][1] * xy) / det;
        let s = (change[1][1] * xx - change[1][0] * xy) / det;
        let q = (change[0][1] * xx - change[0][0] * xy) / det;
        let r = (change[1][0] * yy - change[1][1] * xy) / det;
        let mixed = 0.5 * (q + r);
        let bend = 0.5 * (p + s).abs() + (0.25 * (p - s) * (p - s) + mixed * mixed).sqrt();
        Some((bend, least))
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
    let mut fit = moments.plane();
    // One stray point tilts a plane and widens it; noise gives the farthest of 24 a quarter of the squares, an edge less.
    let squares = |(rank, _): &&(u32, f64)| {
        fit.normal
            .dot(positions[*rank as usize] - p - fit.centre)
            .powi(2)
    };
    let farthest = found
        .iter()
        .max_by(|a, b| squares(a).total_cmp(&squares(b)))
        .filter(|f| found.len() > 8 && squares(f) > 0.5 * fit.variances[2] * moments.count());
    if let Some(stray) = farthest {
        moments = Moments::default();
        for (rank, _) in found.iter().filter(|f| f.0 != stray.0) {
            moments.add(positions[*rank as usize] - p);
        }
        fit = moments.plane();
    }
    Tangent {
        normal: fit.normal.as_vec3().to_array(),
        height_mm: -fit.normal.dot(fit.centre) as f32,
        variance_mm2: fit.variances[2] as f32,
        reach_mm: found.last().map_or(0.0, |f| f.1.sqrt()) as f32,
        count: moments.count() as u32,
    }
}

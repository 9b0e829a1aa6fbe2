//! What others do, for comparison: smooth moving least squares, and normals from planes.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::levin::{Smoothing, gaussian, project, weighted_normal};
use super::polynomial::Degree;
use crate::points::Neighbors;
use crate::points::moments::Moments;

/// The smooth moving least squares surface (Weber 2011, §2.3.2.2): rounds every edge.
pub struct SmoothSurface<'a> {
    positions: &'a [DVec3],
    neighbors: &'a Neighbors,
    degree: Degree,
    h_mm: f64,
}

impl<'a> SmoothSurface<'a> {
    /// The surface through `positions` with the Gaussian weight exp(-d²/h²).
    pub fn new(
        positions: &'a [DVec3],
        neighbors: &'a Neighbors,
        degree: Degree,
        h_mm: f64,
    ) -> Self {
        Self {
            positions,
            neighbors,
            degree,
            h_mm,
        }
    }

    /// The nearest point of the surface and its unit normal; `None` where too few points lie within 2.5 h or the point would go farther than 2 h.
    pub fn project(&self, p: DVec3) -> Option<(DVec3, DVec3)> {
        let mut found = Vec::new();
        self.neighbors.within(p, 2.5 * self.h_mm, &mut found);
        let points: Vec<DVec3> = found
            .iter()
            .map(|(i, _)| self.positions[*i as usize] - p)
            .collect();
        let start = weighted_normal(&points, DVec3::ZERO, self.h_mm)?;
        let smoothing = Smoothing {
            degree: self.degree,
            h_mm: self.h_mm,
            sigma_mm: 0.0,
            reach_mm: 2.0 * self.h_mm,
        };
        let (_, foot) = project(&points, DVec3::ZERO, start, &smoothing)?;
        (foot.position.length() <= 2.0 * self.h_mm).then(|| (p + foot.position, foot.normal))
    }

    /// All points of the cloud: position, unit normal, or `None` where a point was not projected.
    pub fn project_all(&self) -> Vec<Option<(DVec3, DVec3)>> {
        self.positions
            .par_iter()
            .map(|p| self.project(*p))
            .collect()
    }
}

/// Unit normals of the planes of least squares through each point's `k` neighbours (Hoppe et al. 1992; Ma 2011, §4.2.1), signs arbitrary.
pub fn plane_normals(positions: &[DVec3], neighbors: &Neighbors, k: usize) -> Vec<Vec3> {
    normals(positions, neighbors, k, |points| {
        let mut moments = Moments::default();
        points.iter().for_each(|p| moments.add(*p));
        (points.len() > 2).then(|| moments.plane().normal)
    })
}

/// The same with Gaussian weights whose sigma² is a third of the squared distance to the farthest neighbour (Pauly et al. 2003; Ma 2011, §4.2.1).
pub fn weighted_plane_normals(positions: &[DVec3], neighbors: &Neighbors, k: usize) -> Vec<Vec3> {
    normals(positions, neighbors, k, |points| {
        let farthest = points.last()?.length_squared();
        let h = (farthest / 3.0).sqrt();
        debug_assert!(h == 0.0 || gaussian(farthest, h) > 0.0);
        weighted_normal(points, DVec3::ZERO, h)
    })
}

fn normals(
    positions: &[DVec3],
    neighbors: &Neighbors,
    k: usize,
    of: impl Fn(&[DVec3]) -> Option<DVec3> + Sync,
) -> Vec<Vec3> {
    positions
        .par_iter()
        .map_init(
            || (Vec::new(), Vec::new()),
            |(found, points), p| {
                neighbors.nearest(*p, k, found);
                points.clear();
                points.extend(found.iter().map(|(i, _)| positions[*i as usize] - *p));
                of(points).map_or(Vec3::ZERO, |n| n.as_vec3())
            },
        )
        .collect()
}

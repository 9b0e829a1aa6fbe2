//! The normal vector cone (Ma 2011, §5.4.3): vertices whose umbrella is not matched prefer facets that continue the flat surface beside them, so
//! that facets meet at sharp edges and do not cut them off.

use std::f64::consts::FRAC_PI_4;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::delaunay::Delaunay;
use super::star::{Facets, Stars, vertices};
use super::umbrella::{Panel, umbrella};

/// Half opening of the generic cone (Ma 2011, §5.4.3).
const GENERIC: f64 = FRAC_PI_4;
/// The flat cone opens at least so far, rad: below, rounding of coordinates decides.
const NARROWEST: f64 = 0.02;
/// Facets up to so many times the largest of the present umbrella are within range.
const RANGE: f32 = 2.0;

/// How flat the surface is around every vertex.
///
/// We differ: the thesis takes twice the mean dihedral angle of all matched facets for the whole cloud, and names a local threshold as what it
/// lacks (Ma 2011, §5.5); here it is twice the mean over the umbrellas of the neighbours that are matched.
pub(super) struct Cones {
    /// Mean dihedral angle within the umbrella, rad; negative where it is not matched.
    bends: Vec<f32>,
}

/// The cone at one vertex.
pub(super) struct Cone {
    nominal: DVec3,
    least_cosine: f64,
    largest: f32,
}

impl Cones {
    pub fn new(
        delaunay: &Delaunay,
        stars: &Stars,
        facets: &Facets,
        axes: &[Vec3],
        is_open: &[bool],
    ) -> Self {
        let bend = |ring: &mut Vec<Panel>, v: u32| {
            if is_open[v as usize] {
                return -1.0;
            }
            umbrella(
                delaunay,
                stars,
                facets,
                (v, axes[v as usize].as_dvec3()),
                ring,
            );
            let normals: Vec<DVec3> = ring
                .iter()
                .map(|panel| normal(delaunay, v, panel))
                .collect();
            let sum: f64 = (0..normals.len())
                .map(|i| normals[i].angle_between(normals[(i + 1) % normals.len()]))
                .filter(|angle| angle.is_finite())
                .sum();
            (sum / normals.len().max(1) as f64) as f32
        };
        let bends = (0..delaunay.points.len() as u32)
            .into_par_iter()
            .map_init(Vec::new, bend)
            .collect();
        Self { bends }
    }

    /// The cone at `v`, or none where nothing is known of the surface there.
    pub fn of(
        &self,
        delaunay: &Delaunay,
        stars: &Stars,
        facets: &Facets,
        v: u32,
        axis: DVec3,
        is_open: &[bool],
    ) -> Option<Cone> {
        let mut ring = Vec::new();
        umbrella(delaunay, stars, facets, (v, axis), &mut ring);
        let p = delaunay.points[v as usize];
        let panels: Vec<(Panel, DVec3)> =
            ring.iter().map(|s| (*s, normal(delaunay, v, s))).collect();
        // Matched facets at a matched neighbour: behind them the surface is finished.
        let is_firm = |s: &Panel| {
            facets.matches(s.facet) == 3 && !(is_open[s.from as usize] && is_open[s.to as usize])
        };
        let firm: Vec<DVec3> = panels
            .iter()
            .filter(|(s, _)| is_firm(s))
            .map(|s| s.1)
            .collect();
        let bends = ring
            .iter()
            .map(|s| self.bends[s.from as usize])
            .filter(|b| *b >= 0.0);
        let (count, sum) = bends.fold((0, 0.0), |(n, sum), b| (n + 1, sum + f64::from(b)));
        let flat = (2.0 * sum / f64::from(count.max(1))).clamp(NARROWEST, GENERIC);
        let least = flat.cos();
        let is_flat = count > 0
            && !firm.is_empty()
            && firm.iter().all(|a| firm.iter().all(|b| a.dot(*b) >= least));
        let nominal: DVec3 = panels
            .iter()
            .map(|(s, n)| {
                let (a, b) = (
                    delaunay.points[s.from as usize] - p,
                    delaunay.points[s.to as usize] - p,
                );
                let more = if is_flat && is_firm(s) { 1.0 } else { 0.0 };
                *n * ((f64::from(facets.matches(s.facet)) + more) * a.angle_between(b))
            })
            .filter(|n| n.is_finite())
            .sum();
        let largest = ring
            .iter()
            .map(|s| facets.radius(s.facet >> 2, (s.facet & 3) as usize));
        Some(Cone {
            nominal: nominal.try_normalize()?,
            least_cosine: if is_flat { least } else { GENERIC.cos() },
            largest: RANGE * largest.fold(0.0, f32::max),
        })
    }
}

impl Cone {
    /// Whether a facet lies within the cone and its range.
    pub fn holds(&self, delaunay: &Delaunay, facet: u32, radius: f32) -> bool {
        let [a, b, c] = vertices(delaunay, facet).map(|v| delaunay.points[v as usize]);
        let n = (b - a).cross(c - a).normalize_or_zero();
        radius <= self.largest && n.dot(self.nominal).abs() >= self.least_cosine
    }
}

fn normal(delaunay: &Delaunay, v: u32, panel: &Panel) -> DVec3 {
    let p = delaunay.points[v as usize];
    let (a, b) = (
        delaunay.points[panel.from as usize] - p,
        delaunay.points[panel.to as usize] - p,
    );
    a.cross(b).normalize_or_zero()
}

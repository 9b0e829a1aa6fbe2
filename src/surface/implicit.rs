//! Implicit moving least squares of others, for comparison: algebraic spheres (APSS) and robust kernel regression (RIMLS).
//!
//! Both take points with normals, here those of weighted planes. We differ from both papers in that the normals need no common orientation:
//! those around a query are turned to the side of the nearest point's.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::baseline::weighted_plane_normals;
use crate::points::Neighbors;

/// Neighbours of the planes that the normals come from.
const NORMAL_NEIGHBOURS: usize = 16;
/// Steps of one projection at most.
const STEPS: usize = 12;
/// Rounds of reweighting (Öztireli et al. 2009, algorithm 1).
const ROUNDS: usize = 4;
/// Width of the second weight, in lengths of differences of unit normals (Öztireli et al. 2009, §4: 0.5 to 1.5).
const NORMAL_WIDTH: f64 = 0.8;

/// What is fitted around a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImplicitKind {
    /// A sphere in its algebraic form (Guennebaud and Gross 2007; the closed form of Guennebaud et al. 2008).
    Apss,
    /// Planes of the points with weights against outliers (Öztireli et al. 2009).
    Rimls,
}

/// The zero set of a function fitted around every place.
pub struct ImplicitSurface<'a> {
    positions: &'a [DVec3],
    neighbors: &'a Neighbors,
    normals: Vec<Vec3>,
    kind: ImplicitKind,
    support_mm: f64,
}

/// A neighbour as a query sees it: where it lies from it, its turned unit normal, and 1 - d² / support².
type Seen = (DVec3, DVec3, f64);

impl<'a> ImplicitSurface<'a> {
    /// The surface through `positions`; points up to `support_mm` count, with the weight (1 - d² / support²)⁴.
    pub fn new(
        positions: &'a [DVec3],
        neighbors: &'a Neighbors,
        kind: ImplicitKind,
        support_mm: f64,
    ) -> Self {
        Self {
            positions,
            neighbors,
            normals: weighted_plane_normals(positions, neighbors, NORMAL_NEIGHBOURS),
            kind,
            support_mm,
        }
    }

    /// A point of the surface near `p` and its unit normal; `None` where fewer than six points count or the way would be longer than the support.
    pub fn project(&self, p: DVec3) -> Option<(DVec3, DVec3)> {
        let mut x = p;
        let mut found = Vec::new();
        for step in 1..=STEPS {
            let seen = self.seen(x, &mut found)?;
            let (value, gradient) = match self.kind {
                ImplicitKind::Apss => sphere(&seen)?,
                ImplicitKind::Rimls => robust(&seen, self.support_mm)?,
            };
            let square = gradient.length_squared();
            if square.is_nan() || square < 1e-6 {
                return None;
            }
            let way = gradient * (value / square);
            x -= way;
            if x.distance(p) > self.support_mm {
                return None;
            }
            if way.length() < 1e-4 * self.support_mm || step == STEPS {
                return Some((x, gradient.normalize()));
            }
        }
        None
    }

    /// All points of the cloud: position, unit normal, or `None` where a point was not projected.
    pub fn project_all(&self) -> Vec<Option<(DVec3, DVec3)>> {
        self.positions
            .par_iter()
            .map(|p| self.project(*p))
            .collect()
    }

    fn seen(&self, x: DVec3, found: &mut Vec<(u32, f64)>) -> Option<Vec<Seen>> {
        self.neighbors.within(x, self.support_mm, found);
        let side = self.normals[found.first()?.0 as usize];
        let one = |(i, squared): &(u32, f64)| {
            let normal = self.normals[*i as usize];
            let turned = if normal.dot(side) < 0.0 {
                -normal
            } else {
                normal
            };
            let rest = 1.0 - squared / (self.support_mm * self.support_mm);
            (self.positions[*i as usize] - x, turned.as_dvec3(), rest)
        };
        let seen: Vec<Seen> = found.iter().map(one).collect();
        (seen.len() >= 6).then_some(seen)
    }
}

/// Value and gradient, at the query, of the algebraic sphere whose gradients fit the normals.
fn sphere(seen: &[Seen]) -> Option<(f64, DVec3)> {
    let (mut w_sum, mut p_sum, mut n_sum) = (0.0, DVec3::ZERO, DVec3::ZERO);
    let (mut pn, mut pp) = (0.0, 0.0);
    for (p, n, rest) in seen {
        let w = rest.powi(4);
        w_sum += w;
        p_sum += *p * w;
        n_sum += *n * w;
        pn += w * p.dot(*n);
        pp += w * p.length_squared();
    }
    let spread = pp - p_sum.length_squared() / w_sum;
    if spread.is_nan() || spread <= 1e-12 * pp {
        return None;
    }
    let quadratic = 0.5 * (pn - p_sum.dot(n_sum) / w_sum) / spread;
    let linear = (n_sum - p_sum * (2.0 * quadratic)) / w_sum;
    let constant = -(linear.dot(p_sum) + quadratic * pp) / w_sum;
    Some((constant, linear))
}

/// Value and gradient, at the query, of the robust mean of the points' planes.
fn robust(seen: &[Seen], support_mm: f64) -> Option<(f64, DVec3)> {
    let width = 0.5 * support_mm;
    let (mut value, mut gradient) = (0.0, DVec3::ZERO);
    for round in 0..ROUNDS {
        let (mut w_sum, mut value_sum, mut n_sum) = (0.0, 0.0, DVec3::ZERO);
        let (mut slope_sum, mut slope_value_sum) = (DVec3::ZERO, DVec3::ZERO);
        for (p, n, rest) in seen {
            let off = -p.dot(*n);
            let trust = if round == 0 {
                1.0
            } else {
                let (a, b) = ((off - value) / width, n.distance(gradient) / NORMAL_WIDTH);
                (-a * a - b * b).exp()
            };
            let w = trust * rest.powi(4);
            // The weight's gradient by the query, which lies at the origin.
            let slope = *p * (8.0 * trust * rest.powi(3) / (support_mm * support_mm));
            w_sum += w;
            value_sum += w * off;
            n_sum += *n * w;
            slope_sum += slope;
            slope_value_sum += slope * off;
        }
        if w_sum.is_nan() || w_sum <= 1e-9 {
            return None;
        }
        value = value_sum / w_sum;
        gradient = (slope_value_sum - slope_sum * value + n_sum) / w_sum;
    }
    Some((value, gradient))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lattice(z: impl Fn(f64, f64) -> f64) -> Vec<DVec3> {
        (-15..=15)
            .flat_map(|i| (-15..=15).map(move |j| (f64::from(i) * 0.2, f64::from(j) * 0.2)))
            .map(|(x, y)| DVec3::new(x, y, z(x, y)))
            .collect()
    }

    #[test]
    fn a_plane_stays_a_plane_for_both() {
        let positions = lattice(|x, y| 0.3 * x - 0.2 * y);
        let neighbors = Neighbors::new(&positions);
        for kind in [ImplicitKind::Apss, ImplicitKind::Rimls] {
            let surface = ImplicitSurface::new(&positions, &neighbors, kind, 0.7);
            let (at, normal) = surface.project(DVec3::new(0.11, 0.07, 0.3)).expect("near");
            let truth = DVec3::new(-0.3, 0.2, 1.0).normalize();
            // Normals are kept in single precision.
            assert!(at.dot(truth).abs() < 1e-6, "{kind:?}: {at}");
            assert!(normal.dot(truth).abs() > 1.0 - 1e-9, "{kind:?}: {normal}");
        }
    }

    #[test]
    fn algebraic_spheres_keep_a_sphere_better_than_planes_do() {
        let positions = lattice(|x, y| (64.0 - x * x - y * y).sqrt());
        let neighbors = Neighbors::new(&positions);
        let off = |kind| {
            let surface = ImplicitSurface::new(&positions, &neighbors, kind, 0.9);
            let query = DVec3::new(0.5, -0.3, 8.1);
            let (at, _) = surface.project(query).expect("near");
            (at.length() - 8.0).abs()
        };
        let (spheres, planes) = (off(ImplicitKind::Apss), off(ImplicitKind::Rimls));
        // The normals of planes through a slanted lattice are not quite the sphere's.
        assert!(
            spheres < 1e-3 && spheres < 0.5 * planes,
            "{spheres} {planes}"
        );
    }

    #[test]
    fn what_lies_far_away_is_not_projected() {
        let positions = lattice(|_, _| 0.0);
        let neighbors = Neighbors::new(&positions);
        let surface = ImplicitSurface::new(&positions, &neighbors, ImplicitKind::Apss, 0.7);
        assert!(surface.project(DVec3::new(0.0, 0.0, 5.0)).is_none());
        assert!(surface.project(DVec3::NAN).is_none());
    }
}

//! The sharp moving least squares of Weber 2011, §4.3, as it stands there: for comparison.
//!
//! Needs points marked as features, lying on the edge. A neighbourhood with at least four of them is cut along a cubic Bézier curve through
//! four, what is lost is replaced by samples of the curve, and the rest is projected as usual. Where the thesis leaves something open the
//! doc comment says what was taken.

use glam::DVec3;
use rayon::prelude::*;

use super::levin::{Smoothing, project, weighted_normal};
use super::polynomial::Degree;
use crate::features::Class;
use crate::points::Neighbors;

/// Fewer feature points than this make no curve (Weber 2011, §4.3.3).
const LINE_LEAST: usize = 4;
/// Neighbours whose vectors to the curve differ by more than 45° lie on the other side (Weber 2011, §4.3.5).
const COS_OTHER_SIDE: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Clusters of triangle normals farther apart than this, rad, are not joined. The thesis gives no number here; it is half of the smallest
/// turn angle of its examples.
const JOIN_RAD: f64 = 0.35;

/// The author's two parameters and the degree (Weber 2011, §4.4.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThesisSettings {
    /// Neighbours of a point.
    pub k: usize,
    /// h of the Gaussian weight exp(-d²/h²), mm.
    pub h_mm: f64,
    /// Degree of the local polynomials.
    pub degree: Degree,
}

/// A cubic Bézier curve along an edge, its four control points in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalLine(pub [DVec3; 4]);

/// The surface through N points of which some are marked as features.
pub struct ThesisSurface<'a> {
    positions: &'a [DVec3],
    neighbors: &'a Neighbors,
    is_feature: Vec<bool>,
    /// For every feature point those of its neighbourhood on the same edge, ascending; empty for other points.
    connected: Vec<Vec<u32>>,
    settings: ThesisSettings,
}

impl LocalLine {
    /// The point at `t` in 0 to 1.
    pub fn at(&self, t: f64) -> DVec3 {
        let [a, b, c, d] = self.0;
        let s = 1.0 - t;
        a * (s * s * s) + b * (3.0 * s * s * t) + c * (3.0 * s * t * t) + d * (t * t * t)
    }

    /// The nearest point of the curve to `p`: of 33 samples the best, then three times between its neighbours.
    pub fn nearest(&self, p: DVec3) -> DVec3 {
        let (mut low, mut high) = (0.0, 1.0);
        let mut best = 0.5;
        for _ in 0..4 {
            let step = (high - low) / 32.0;
            let distance = |k: &i32| self.at(low + step * f64::from(*k)).distance_squared(p);
            let k = (0..=32).min_by(|a, b| distance(a).total_cmp(&distance(b)));
            best = low + step * f64::from(k.unwrap_or(0));
            (low, high) = ((best - step).max(0.0), (best + step).min(1.0));
        }
        self.at(best)
    }
}

impl<'a> ThesisSurface<'a> {
    /// The surface through `positions` with `classes` from a detector; edges and corners count as features.
    ///
    /// # Panics
    /// Where there are fewer classes than positions.
    pub fn new(
        positions: &'a [DVec3],
        neighbors: &'a Neighbors,
        classes: &[Class],
        settings: ThesisSettings,
    ) -> Self {
        let is_feature: Vec<bool> = classes[..positions.len()]
            .iter()
            .map(|c| matches!(c, Class::Edge | Class::Corner))
            .collect();
        let connected = (0..positions.len())
            .into_par_iter()
            .map(|f| match is_feature[f] {
                true => connected(f, (positions, neighbors), &is_feature, settings.k),
                false => Vec::new(),
            })
            .collect();
        Self {
            positions,
            neighbors,
            is_feature,
            connected,
            settings,
        }
    }

    /// The local feature line of the neighbourhood of `p`; `None` where fewer than four feature points of one edge lie in it.
    ///
    /// At a corner that of the edge of the nearest feature point (Weber 2011, §4.3.6). We differ where a sector holds no point: then both inner
    /// control points are the ones nearest to the thirds of the chord, and of several in a sector it is these as well, where the thesis takes any.
    pub fn feature_line(&self, p: DVec3) -> Option<LocalLine> {
        let mut found = Vec::new();
        self.neighbors.nearest(p, self.settings.k, &mut found);
        self.line_of(&found)
    }

    fn line_of(&self, found: &[(u32, f64)]) -> Option<LocalLine> {
        let nearest = found.iter().find(|f| self.is_feature[f.0 as usize])?.0;
        let same_edge = &self.connected[nearest as usize];
        let points: Vec<DVec3> = (found.iter().map(|f| f.0))
            .filter(|i| *i == nearest || same_edge.binary_search(i).is_ok())
            .map(|i| self.positions[i as usize])
            .collect();
        if points.len() < LINE_LEAST {
            return None;
        }
        let (mut ends, mut far) = ((0, 1), -1.0);
        for i in 0..points.len() {
            for j in 0..i {
                let d = points[i].distance_squared(points[j]);
                if d > far {
                    (ends, far) = ((j, i), d);
                }
            }
        }
        let (first, last) = (points[ends.0], points[ends.1]);
        let mut inner: Vec<DVec3> = (points.iter().enumerate())
            .filter(|(i, _)| *i != ends.0 && *i != ends.1)
            .map(|(_, p)| *p)
            .collect();
        inner.sort_by(|a, b| {
            a.distance_squared(first)
                .total_cmp(&b.distance_squared(first))
        });
        let pick = |t: f64, from: &[DVec3]| {
            let aim = first.lerp(last, t);
            from.iter()
                .copied()
                .min_by(|a, b| a.distance_squared(aim).total_cmp(&b.distance_squared(aim)))
        };
        let half = inner.partition_point(|p| p.distance_squared(first) <= p.distance_squared(last));
        let (near, beyond) = if half == 0 || half == inner.len() {
            let middle = inner.len() / 2;
            (&inner[..middle], &inner[middle..])
        } else {
            (&inner[..half], &inner[half..])
        };
        Some(LocalLine([
            first,
            pick(1.0 / 3.0, near)?,
            pick(2.0 / 3.0, beyond)?,
            last,
        ]))
    }

    /// The nearest point of the surface to `p` and its unit normal; `None` where too few points are near or it would go farther than their reach.
    pub fn project(&self, p: DVec3) -> Option<(DVec3, DVec3)> {
        let mut found = Vec::new();
        self.neighbors.nearest(p, self.settings.k, &mut found);
        let reach_mm = found.last()?.1.sqrt();
        let mut points: Vec<DVec3> = found
            .iter()
            .map(|(i, _)| self.positions[*i as usize] - p)
            .collect();
        if let Some(line) = self.line_of(&found) {
            let own = line.nearest(p) - p;
            let before = points.len();
            points.retain(|q| {
                let theirs = line.nearest(p + *q) - (p + *q);
                let (a, b) = (own.length(), theirs.length());
                // A point on the curve itself is on both sides.
                a.min(b) < 1e-6 * reach_mm || own.dot(theirs) >= COS_OTHER_SIDE * a * b
            });
            let lost = before - points.len();
            let sample = |k: usize| line.at((k as f64 + 0.5) / lost as f64) - p;
            points.extend((0..lost).map(sample));
        }
        let smoothing = Smoothing {
            degree: self.settings.degree,
            h_mm: self.settings.h_mm,
            sigma_mm: 0.0,
            reach_mm,
        };
        let start = weighted_normal(&points, DVec3::ZERO, smoothing.h_mm)?;
        let (_, foot) = project(&points, DVec3::ZERO, start, &smoothing)?;
        (foot.position.length() <= reach_mm).then(|| (p + foot.position, foot.normal))
    }

    /// All points of the cloud: position, unit normal, or `None` where a point was not projected.
    pub fn project_all(&self) -> Vec<Option<(DVec3, DVec3)>> {
        self.positions
            .par_iter()
            .map(|p| self.project(*p))
            .collect()
    }
}

/// Feature points in the neighbourhood of feature point `f` that lie on the same edge, ascending (Weber 2011, §4.3.6).
///
/// The normals of all triangles of both feature points and another point fall into two clusters there, one a flank.
fn connected(
    f: usize,
    (positions, neighbors): (&[DVec3], &Neighbors),
    is_feature: &[bool],
    k: usize,
) -> Vec<u32> {
    let mut found = Vec::new();
    neighbors.nearest(positions[f], k, &mut found);
    let (features, others): (Vec<u32>, Vec<u32>) = found
        .iter()
        .map(|n| n.0)
        .filter(|i| *i as usize != f)
        .partition(|i| is_feature[*i as usize]);
    let mut same: Vec<u32> = features
        .into_iter()
        .filter(|g| {
            let along = positions[*g as usize] - positions[f];
            let normals = others.iter().filter_map(|i| {
                let to = positions[*i as usize] - positions[f];
                let cross = along.cross(to);
                // Slivers have no direction.
                (cross.length() > 0.1 * along.length() * to.length()).then(|| cross.normalize())
            });
            clusters(normals.collect()) == 2
        })
        .collect();
    same.sort_unstable();
    same
}

/// Number of clusters of unoriented unit normals by average linkage, those of a single one left out.
fn clusters(normals: Vec<DVec3>) -> usize {
    let angle = |a: DVec3, b: DVec3| a.dot(b).abs().min(1.0).acos();
    let mut groups: Vec<Vec<DVec3>> = normals.into_iter().map(|n| vec![n]).collect();
    loop {
        let mut best = (JOIN_RAD, None);
        for i in 0..groups.len() {
            for j in 0..i {
                let pairs = groups[i]
                    .iter()
                    .flat_map(|a| groups[j].iter().map(|b| angle(*a, *b)));
                let mean = pairs.sum::<f64>() / (groups[i].len() * groups[j].len()) as f64;
                if mean < best.0 {
                    best = (mean, Some((i, j)));
                }
            }
        }
        let Some((i, j)) = best.1 else { break };
        let joined = groups.swap_remove(i);
        groups[j].extend(joined);
    }
    groups.iter().filter(|g| g.len() > 1).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The three faces of a cube's corner on a grid, spacing one, with points on the edges.
    fn corner() -> (Vec<DVec3>, Vec<Class>) {
        let mut positions = Vec::new();
        for i in 0..8 {
            for j in 0..8 {
                let (a, b) = (f64::from(i), f64::from(j));
                positions.push(DVec3::new(a, b, 0.0));
                if j > 0 {
                    positions.push(DVec3::new(a, 0.0, b));
                }
                if i > 0 && j > 0 {
                    positions.push(DVec3::new(0.0, a, b));
                }
            }
        }
        let classes = positions.iter().map(|p| {
            let on = p.to_array().iter().filter(|x| **x == 0.0).count();
            [Class::None, Class::None, Class::Edge, Class::Corner][on]
        });
        let classes = classes.collect();
        (positions, classes)
    }

    #[test]
    fn at_a_corner_the_line_is_that_of_the_nearest_edge_alone() {
        let (positions, classes) = corner();
        let neighbors = Neighbors::new(&positions);
        let settings = ThesisSettings {
            k: 20,
            h_mm: 1.0,
            degree: Degree::Two,
        };
        let surface = ThesisSurface::new(&positions, &neighbors, &classes, settings);
        let line = surface
            .feature_line(DVec3::new(3.0, 0.4, 0.1))
            .expect("an edge is near");
        for k in 0..=10 {
            let p = line.at(f64::from(k) / 10.0);
            assert!(p.y == 0.0 && p.z == 0.0, "the x axis, exactly: {p}");
        }
        assert!(surface.feature_line(DVec3::new(5.0, 5.0, 0.0)).is_none());
    }

    #[test]
    fn a_point_beside_the_edge_stays_on_its_face() {
        let (positions, classes) = corner();
        let neighbors = Neighbors::new(&positions);
        let settings = ThesisSettings {
            k: 20,
            h_mm: 1.0,
            degree: Degree::Two,
        };
        let surface = ThesisSurface::new(&positions, &neighbors, &classes, settings);
        let (at, normal) = surface
            .project(DVec3::new(4.0, 0.6, 0.05))
            .expect("near the surface");
        // Members and samples all lie on z = 0: what is left is rounding.
        assert!(
            at.z.abs() < 1e-9 && normal.z.abs() > 1.0 - 1e-9,
            "{at} {normal}"
        );
    }

    #[test]
    fn the_nearest_point_of_a_straight_curve_is_the_foot() {
        let line = LocalLine([0.0, 1.0, 2.0, 3.0].map(|x| DVec3::new(x, 0.0, 0.0)));
        let foot = line.nearest(DVec3::new(1.23, 0.7, -2.0));
        // The last of four refinements has steps of 3 / 32 / 16³ of the curve.
        assert!(foot.distance(DVec3::new(1.23, 0.0, 0.0)) < 1e-4, "{foot}");
    }
}

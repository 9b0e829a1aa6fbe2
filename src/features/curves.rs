//! Polylines through the points found on edges.

use glam::DVec3;

use super::{Class, Detection};
use crate::points::{Neighbors, PointCloud};

/// A polyline along an edge, mm.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Its vertices, in order.
    pub points: Vec<DVec3>,
    /// Whether the last joins the first.
    pub closed: bool,
}

/// Distance of the vertices, spacings.
const STEP: f64 = 2.0;
/// Farthest next vertex, spacings.
const REACH: f64 = 4.5;
/// Cosine of the sharpest turn of a curve from vertex to vertex: 60 degrees.
const STRAIGHT: f64 = 0.5;

/// Curves through the points of class edge or corner; each ends at a corner, at a gap, or where it began.
///
/// Grown from vertex to vertex in both directions (Daniels et al. 2007, §3.5). We differ: vertices are means of the marked points around
/// them, not points projected by a fit, so that a vertex is good to a part of the spacing only.
pub fn curves(cloud: &PointCloud, detection: &Detection) -> Vec<Curve> {
    let step = STEP * detection.spacing.across_mm.max(detection.spacing.mean_mm);
    let vertices = vertices(cloud, detection, step);
    let positions: Vec<DVec3> = vertices.iter().map(|v| v.0).collect();
    let neighbors = Neighbors::new(&positions);
    let mut used = vec![false; vertices.len()];
    let mut curves = Vec::new();
    for start in 0..vertices.len() {
        if used[start] || vertices[start].1 {
            continue;
        }
        used[start] = true;
        let mut walk = Walk {
            vertices: &vertices,
            neighbors: &neighbors,
            reach_mm: REACH / STEP * step,
            used: &mut used,
        };
        let mut chain = walk.from(start, None);
        let back = chain.get(1).map(|i| vertices[start].0 - vertices[*i].0);
        let mut other = walk.from(start, back);
        other.reverse();
        other.pop();
        other.append(&mut chain);
        let points: Vec<DVec3> = other.iter().map(|i| vertices[*i].0).collect();
        if points.len() > 1 {
            let closed = points.len() > 4
                && points[0].distance(points[points.len() - 1]) < REACH / STEP * step;
            curves.push(Curve { points, closed });
        }
    }
    curves
}

/// Means of the marked points, about `step` mm apart, and whether each is a corner.
fn vertices(cloud: &PointCloud, detection: &Detection, step: f64) -> Vec<(DVec3, bool)> {
    let marked: Vec<(DVec3, bool)> = (cloud.positions.iter().zip(&detection.classes))
        .filter(|(_, c)| matches!(c, Class::Edge | Class::Corner))
        .map(|(p, c)| (*p, *c == Class::Corner))
        .collect();
    let positions: Vec<DVec3> = marked.iter().map(|m| m.0).collect();
    let neighbors = Neighbors::new(&positions);
    let mut covered = vec![false; marked.len()];
    let mut vertices = Vec::new();
    let mut found = Vec::new();
    // Corners first, so that each becomes a vertex of its own.
    for corners in [true, false] {
        for &i in neighbors.order() {
            let (p, corner) = marked[i as usize];
            if covered[i as usize] || corner != corners {
                continue;
            }
            neighbors.within(p, step, &mut found);
            found.retain(|f| marked[f.0 as usize].1 == corner);
            let sum: DVec3 = found.iter().map(|f| positions[f.0 as usize]).sum();
            found.iter().for_each(|f| covered[f.0 as usize] = true);
            covered[i as usize] = true;
            vertices.push((sum / found.len().max(1) as f64, corner));
        }
    }
    vertices
}

struct Walk<'a> {
    vertices: &'a [(DVec3, bool)],
    neighbors: &'a Neighbors,
    reach_mm: f64,
    used: &'a mut [bool],
}

impl Walk<'_> {
    /// Vertices from `at` on, itself first, ahead in `direction` where one is given.
    fn from(&mut self, mut at: usize, mut direction: Option<DVec3>) -> Vec<usize> {
        let mut chain = vec![at];
        let mut found = Vec::new();
        loop {
            let here = self.vertices[at].0;
            self.neighbors.within(here, self.reach_mm, &mut found);
            let next = found.iter().map(|f| f.0 as usize).find(|j| {
                let way = self.vertices[*j].0 - here;
                let ahead =
                    direction.is_none_or(|d| way.dot(d) > STRAIGHT * way.length() * d.length());
                *j != at && ahead && (!self.used[*j] || self.vertices[*j].1)
            });
            let Some(next) = next else { break };
            direction = Some(self.vertices[next].0 - here);
            chain.push(next);
            self.used[next] = true;
            if self.vertices[next].1 {
                break;
            }
            at = next;
        }
        chain
    }
}

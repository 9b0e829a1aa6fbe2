//! Normals at points from the triangles of a mesh through them (Ma 2011, chapter 4), and one sense for normals that have none.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::Body;
use super::solid::Senses;
use crate::geometry::fit::NormalSums;
use crate::points::{Neighbors, PointCloud, noise_mm, spacing};
use crate::surface::weighted_plane_normals;

/// How far around a point its normal looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rings {
    /// The triangles at the point.
    One,
    /// And those at their corners.
    Two,
    /// The points of three rings, under noise that leaves triangles no direction.
    Three,
    /// One or three, by the noise of the points.
    Auto,
}

/// Unit normals of N points.
#[derive(Debug, Clone)]
pub struct Normals {
    /// N normals, outwards; zero where nothing is known.
    pub normals: Vec<Vec3>,
    /// The rings that were looked at.
    pub rings: Rings,
    /// Points whose normal is that of a weighted plane, for want of triangles.
    pub by_plane: usize,
}

/// Noise over spacing from which on three rings are taken: on a torus of ten thousand points one ring is best without noise, three from 0.015 on.
/// Two are best between, but so little noise cannot be told from the bend of a surface.
const THREE_RINGS_FROM: f64 = 0.02;
/// Facets of the second ring that turn by more than this, rad (cosine), from the first lie beyond an edge.
const BEYOND_EDGE: f64 = 0.82;
/// Neighbours of the weighted plane (Ma 2011, §4.4.2).
const PLANE_NEIGHBOURS: usize = 40;

/// The normals of the points of `cloud`, of which `body` was made.
///
/// We differ: the thesis takes the facets of an umbrella whether its neighbours have them or not, weighted by matching index times angle (Ma
/// 2011, equation 4.6), and a plane where fewer than three match. Here every vertex has the closed ring of the mesh. Where the surface
/// turns smoothly and points are clean, that normal is corrected by a cubic through two rings; under strong noise it is that of a quadric through three. The plane remains for points without triangles. Orientation needs no
/// propagation: the body has an outside. How many rings follows from the noise of the points, not from the user.
pub fn normals(body: &Body, cloud: &PointCloud, neighbors: &Neighbors, rings: Rings) -> Normals {
    let rings = match rings {
        Rings::Auto => {
            let spacing = spacing(cloud, neighbors);
            if noise_mm(cloud, neighbors, &spacing) > THREE_RINGS_FROM * spacing.mean_mm {
                Rings::Three
            } else {
                Rings::One
            }
        }
        chosen => chosen,
    };
    let count = body.delaunay.points.len() as u32;
    let around = Around::new(body);
    let one: Vec<DVec3> = (0..count)
        .into_par_iter()
        .map(|v| ring_sum(&around, v).normalize_or_zero())
        .collect();
    let of_vertex: Vec<Vec3> = match rings {
        Rings::Two => (0..count)
            .into_par_iter()
            .map(|v| two_rings(&around, v, &one).as_vec3())
            .collect(),
        Rings::Three => {
            let two: Vec<DVec3> = (0..count)
                .into_par_iter()
                .map(|v| two_rings(&around, v, &one))
                .collect();
            (0..count)
                .into_par_iter()
                .map(|v| {
                    quadric(&around, v, &two)
                        .unwrap_or(two[v as usize])
                        .as_vec3()
                })
                .collect()
        }
        _ => (0..count)
            .into_par_iter()
            .map(|v| cubic(&around, v, &one).unwrap_or(one[v as usize]).as_vec3())
            .collect(),
    };
    let mut normals: Vec<Vec3> = (body.delaunay.vertex_of.iter())
        .map(|v| of_vertex[*v as usize])
        .collect();
    let mut by_plane = 0;
    if normals.contains(&Vec3::ZERO) {
        let planes = weighted_plane_normals(&cloud.positions, neighbors, PLANE_NEIGHBOURS);
        for (normal, plane) in normals.iter_mut().zip(planes) {
            if *normal == Vec3::ZERO {
                *normal = plane;
                by_plane += 1;
            }
        }
        orient_normals(&cloud.positions, neighbors, &mut normals);
    }
    Normals {
        normals,
        rings,
        by_plane,
    }
}

/// The triangles of the surface at every vertex of the triangulation.
struct Around<'a> {
    body: &'a Body,
    starts: Vec<u32>,
    /// Three times the triangle plus the place of the vertex.
    corners: Vec<u32>,
}

impl<'a> Around<'a> {
    fn new(body: &'a Body) -> Self {
        let count = body.delaunay.points.len();
        let mut around = Self {
            body,
            starts: vec![0; count + 2],
            corners: vec![0; 3 * body.surface.len()],
        };
        let vertices = || body.surface.iter().flatten().map(|v| vertex(body, *v));
        for v in vertices() {
            around.starts[v as usize + 2] += 1;
        }
        for v in 0..count {
            around.starts[v + 2] += around.starts[v + 1];
        }
        for (corner, v) in vertices().enumerate() {
            let at = &mut around.starts[v as usize + 1];
            around.corners[*at as usize] = corner as u32;
            *at += 1;
        }
        around
    }

    fn at(&self, v: u32) -> DVec3 {
        self.body.delaunay.points[v as usize]
    }

    /// Outward normal (twice the area long) and other corners of every triangle at `v`.
    fn triangles(&self, v: u32) -> impl Iterator<Item = (DVec3, [u32; 2])> {
        let corners = self.starts[v as usize] as usize..self.starts[v as usize + 1] as usize;
        self.corners[corners].iter().map(move |corner| {
            let triangle = self.body.surface[(corner / 3) as usize];
            let k = (corner % 3) as usize;
            let others = [1, 2].map(|i| vertex(self.body, triangle[(k + i) % 3]));
            let [b, c] = others.map(|u| self.at(u) - self.at(v));
            (b.cross(c), others)
        })
    }
}

/// The vertex of the triangulation that a vertex of the surface is, or is a copy of.
fn vertex(body: &Body, v: u32) -> u32 {
    let count = body.delaunay.points.len();
    (v as usize)
        .checked_sub(count)
        .map_or(v, |i| body.copies[i])
}

/// Outward normals of the triangles at `v`, weighted by area.
///
/// We differ: the thesis weighs by angle (Ma 2011, equation 4.6); on a torus, where normals are known, areas leave half of its error.
fn ring_sum(around: &Around, v: u32) -> DVec3 {
    around.triangles(v).map(|(normal, _)| normal).sum()
}

/// The normal of the cubic height function through `v` and the corners of both rings, or none where the surface does not turn smoothly there.
fn cubic(surface: &Around, v: u32, one: &[DVec3]) -> Option<DVec3> {
    /// One more than coefficients.
    const LEAST_POINTS: usize = 14;
    /// Slopes above this are no correction of the normal but another surface.
    const STEEPEST: f64 = 0.3;
    let own = one[v as usize];
    let mut around: Vec<u32> = surface.triangles(v).flat_map(|t| t.1).collect();
    for i in 0..around.len() {
        around.extend(surface.triangles(around[i]).flat_map(|t| t.1));
    }
    around.sort_unstable();
    around.dedup();
    around.retain(|u| *u != v);
    let is_smooth = around
        .iter()
        .all(|u| one[*u as usize].dot(own) > BEYOND_EDGE);
    if around.len() < LEAST_POINTS || !is_smooth {
        return None;
    }
    let p = surface.at(v);
    let x = own.any_orthonormal_vector();
    let y = own.cross(x);
    let ways: Vec<DVec3> = around.iter().map(|u| surface.at(*u) - p).collect();
    let reach = ways.iter().map(|d| d.length()).fold(0.0, f64::max);
    let mut sums = NormalSums::<9>::default();
    for d in &ways {
        let (a, b) = (d.dot(x) / reach, d.dot(y) / reach);
        // Steep in the distance: what a cubic leaves out grows with the fourth power.
        let weight = (reach * reach / d.length_squared()).powi(2);
        let row = [
            a,
            b,
            a * a,
            a * b,
            b * b,
            a * a * a,
            a * a * b,
            a * b * b,
            b * b * b,
        ];
        sums.add(&row, d.dot(own) / reach, weight);
    }
    let ([a, b, ..], _) = sums.solve()?;
    let is_close = a.hypot(b) < STEEPEST;
    is_close.then(|| (own - x * a - y * b).normalize())
}

/// The triangles of both rings weighted by area, those beyond an edge left out.
fn two_rings(surface: &Around, v: u32, one: &[DVec3]) -> DVec3 {
    let own = one[v as usize];
    let mut around = vec![v];
    around.extend(surface.triangles(v).flat_map(|t| t.1));
    around.sort_unstable();
    around.dedup();
    let mut sum = DVec3::ZERO;
    for u in around {
        for (normal, _) in surface.triangles(u) {
            if normal.normalize_or_zero().dot(own) > BEYOND_EDGE {
                sum += normal;
            }
        }
    }
    sum.try_normalize().unwrap_or(own)
}

/// The normal of the quadric height function over the points of three rings around `v`, those beyond an edge left out, or none where there are too
/// few.
///
/// We differ: the thesis takes triangles of two rings under noise and still falls behind planes through neighbours where it is strong (Ma 2011,
/// figures 4.11 and 4.12); the rings of the mesh keep apart what lies on two sides of a wall or an edge, and the fit averages as
/// many points as planes do.
fn quadric(surface: &Around, v: u32, two: &[DVec3]) -> Option<DVec3> {
    const LEAST_POINTS: usize = 12;
    const RINGS: usize = 3;
    let own = two[v as usize];
    let mut around = vec![v];
    let mut done = 0;
    for _ in 0..RINGS {
        let reached = around.len();
        for i in done..reached {
            for u in surface.triangles(around[i]).flat_map(|t| t.1) {
                if two[u as usize].dot(own) > BEYOND_EDGE && !around.contains(&u) {
                    around.push(u);
                }
            }
        }
        done = reached;
    }
    if around.len() < LEAST_POINTS {
        return None;
    }
    let p = surface.at(v);
    let x = own.any_orthonormal_vector();
    let y = own.cross(x);
    let ways = around.iter().map(|u| surface.at(*u) - p);
    let reach = ways.clone().map(|d| d.length()).fold(0.0, f64::max);
    let mut sums = NormalSums::<6>::default();
    for d in ways {
        let (a, b) = (d.dot(x) / reach, d.dot(y) / reach);
        sums.add(&[a, b, 1.0, a * a, a * b, b * b], d.dot(own) / reach, 1.0);
    }
    let ([a, b, ..], _) = sums.solve()?;
    Some((own - x * a - y * b).normalize())
}

/// Turns `normals` to one sense: along the edges of the graph of nearest neighbours, the most parallel first (Hoppe et al. 1992; Ma 2011,
/// §4.3); of every piece of the graph the highest point, in z, looks up.
pub fn orient_normals(positions: &[DVec3], neighbors: &Neighbors, normals: &mut [Vec3]) {
    const NEIGHBOURS: usize = 10;
    let mut edges: Vec<(u32, u32, u32)> = (0..positions.len() as u32)
        .into_par_iter()
        .map_init(Vec::new, |found, i| {
            neighbors.nearest(positions[i as usize], NEIGHBOURS, found);
            let n = normals[i as usize];
            let edge = |(j, _): &(u32, f64)| {
                let turn = 1.0 - n.dot(normals[*j as usize]).abs().min(1.0);
                // The bits of a positive number sort as the number does.
                (turn.to_bits(), i.min(*j), i.max(*j))
            };
            found
                .iter()
                .map(edge)
                .filter(|e| e.1 != e.2)
                .collect::<Vec<_>>()
        })
        .flatten_iter()
        .collect();
    edges.par_sort_unstable();
    let mut senses = Senses::new(positions.len());
    for (_, i, j) in edges {
        senses.join(i, j, normals[i as usize].dot(normals[j as usize]) < 0.0);
    }
    let mut highest: Vec<(u32, bool)> = vec![(u32::MAX, false); positions.len()];
    for i in 0..positions.len() as u32 {
        let (root, turned) = senses.of(i);
        let top = &mut highest[root as usize];
        if top.0 == u32::MAX || positions[i as usize].z > positions[top.0 as usize].z {
            *top = (i, turned);
        }
    }
    for i in 0..positions.len() as u32 {
        let (root, turned) = senses.of(i);
        let (top, top_turned) = highest[root as usize];
        let looks_down = normals[top as usize].z < 0.0;
        if i != top && (turned ^ top_turned ^ looks_down) {
            normals[i as usize] = -normals[i as usize];
        }
    }
    let tops: Vec<u32> = highest
        .iter()
        .map(|t| t.0)
        .filter(|t| *t != u32::MAX)
        .collect();
    for top in tops {
        let n = &mut normals[top as usize];
        if n.z < 0.0 {
            *n = -*n;
        }
    }
}

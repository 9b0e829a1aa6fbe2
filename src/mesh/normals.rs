//! Normals at points from the triangles of a mesh through them (Ma 2011, chapter 4), and one sense for normals that have none.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::Body;
use super::delaunay::{FACETS, GHOST};
use super::solid::Senses;
use super::star::{corner, facet};
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
/// 2011, equation 4.6), and a plane where fewer than three match. Here every vertex has the closed ring of the mesh; facets that
/// matching alone found weigh their index, the others one. Where the surface turns smoothly and points are clean, that
/// normal is corrected by a cubic through two rings; under strong noise it is that of a quadric through three. The plane remains for points without triangles. Orientation needs no
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
    let one: Vec<DVec3> = (0..count)
        .into_par_iter()
        .map(|v| ring_sum(body, v).normalize_or_zero())
        .collect();
    let of_vertex: Vec<Vec3> = match rings {
        Rings::Two => (0..count)
            .into_par_iter()
            .map(|v| two_rings(body, v, &one).as_vec3())
            .collect(),
        Rings::Three => {
            let two: Vec<DVec3> = (0..count)
                .into_par_iter()
                .map(|v| two_rings(body, v, &one))
                .collect();
            (0..count)
                .into_par_iter()
                .map(|v| quadric(body, v, &two).unwrap_or(two[v as usize]).as_vec3())
                .collect()
        }
        _ => (0..count)
            .into_par_iter()
            .map(|v| cubic(body, v, &one).unwrap_or(one[v as usize]).as_vec3())
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

/// Calls `with` for every triangle of the surface at `v`: its outward normal (twice the area long), other corners, and facet.
fn triangles_at(body: &Body, v: u32, mut with: impl FnMut(DVec3, [u32; 2], u32)) {
    let delaunay = &body.delaunay;
    for code in body.stars.of(v) {
        let (cell, own) = corner(*code);
        if !body.solid.inside[cell as usize] {
            continue;
        }
        for at in (0..4).filter(|at| *at != own) {
            if body.solid.inside[delaunay.neighbors[cell as usize][at] as usize] {
                continue;
            }
            let corners = FACETS[at].map(|k| delaunay.cells[cell as usize][k]);
            debug_assert!(!corners.contains(&GHOST));
            let [a, b, c] = corners.map(|u| delaunay.points[u as usize]);
            let normal = (b - a).cross(c - a);
            let at_v = corners.iter().position(|u| *u == v).unwrap_or(0);
            let others = [corners[(at_v + 1) % 3], corners[(at_v + 2) % 3]];
            with(normal, others, facet(delaunay, cell, at));
        }
    }
}

/// Outward normals of the triangles at `v`, weighted by matching index times area.
///
/// We differ: the thesis weighs by angle (Ma 2011, equation 4.6); on a torus, where normals are known, areas leave half of its error.
fn ring_sum(body: &Body, v: u32) -> DVec3 {
    let mut sum = DVec3::ZERO;
    triangles_at(body, v, |normal, _, facet| {
        sum += normal * f64::from(body.facets.matches(facet).max(1));
    });
    sum
}

/// The normal of the cubic height function through `v` and the corners of both rings, or none where the surface does not turn smoothly there.
fn cubic(body: &Body, v: u32, one: &[DVec3]) -> Option<DVec3> {
    /// One more than coefficients.
    const LEAST_POINTS: usize = 14;
    /// Slopes above this are no correction of the normal but another surface.
    const STEEPEST: f64 = 0.3;
    let own = one[v as usize];
    let mut around = Vec::new();
    triangles_at(body, v, |_, others, _| around.extend(others));
    for i in 0..around.len() {
        triangles_at(body, around[i], |_, others, _| around.extend(others));
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
    let p = body.delaunay.points[v as usize];
    let x = own.any_orthonormal_vector();
    let y = own.cross(x);
    let ways: Vec<DVec3> = around
        .iter()
        .map(|u| body.delaunay.points[*u as usize] - p)
        .collect();
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
fn two_rings(body: &Body, v: u32, one: &[DVec3]) -> DVec3 {
    let own = one[v as usize];
    let mut around = vec![v];
    triangles_at(body, v, |_, others, _| around.extend(others));
    around.sort_unstable();
    around.dedup();
    let mut sum = DVec3::ZERO;
    for u in around {
        triangles_at(body, u, |normal, _, _| {
            if normal.normalize_or_zero().dot(own) > BEYOND_EDGE {
                sum += normal;
            }
        });
    }
    sum.try_normalize().unwrap_or(own)
}

/// The normal of the quadric height function over the points of three rings around `v`, those beyond an edge left out, or none where there are too
/// few.
///
/// We differ: the thesis takes triangles of two rings under noise and still falls behind planes through neighbours where it is strong (Ma 2011,
/// figures 4.11 and 4.12); the rings of the mesh keep apart what lies on two sides of a wall or an edge, and the fit averages as
/// many points as planes do.
fn quadric(body: &Body, v: u32, two: &[DVec3]) -> Option<DVec3> {
    const LEAST_POINTS: usize = 12;
    const RINGS: usize = 3;
    let own = two[v as usize];
    let mut around = vec![v];
    let mut done = 0;
    for _ in 0..RINGS {
        let reached = around.len();
        for i in done..reached {
            triangles_at(body, around[i], |_, others, _| {
                for u in others {
                    if two[u as usize].dot(own) > BEYOND_EDGE && !around.contains(&u) {
                        around.push(u);
                    }
                }
            });
        }
        done = reached;
    }
    if around.len() < LEAST_POINTS {
        return None;
    }
    let p = body.delaunay.points[v as usize];
    let x = own.any_orthonormal_vector();
    let y = own.cross(x);
    let ways = around.iter().map(|u| body.delaunay.points[*u as usize] - p);
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

//! Edges as truth: where two surfaces really meet, beside a station of the nominal edge.

use glam::{DMat3, DVec3};

use super::solid::Surfaces;
use super::surface::SurfaceId;

/// Whether the material lies within 180 degrees of the edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeKind {
    /// Included angle below 180 degrees.
    Convex,
    /// Included angle above 180 degrees.
    Concave,
}

/// A place on a nominal edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    /// On the nominal edge, mm.
    pub point: DVec3,
    /// Unit tangent of the edge.
    pub tangent: DVec3,
    /// Outward unit normals of the two nominal faces at the point.
    pub normals: [DVec3; 2],
}

/// What a perfect measurement of an edge at a station would say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeTruth {
    /// The virtual edge: where the two surfaces, prolonged, meet in the plane across the nominal edge, mm.
    pub point: DVec3,
    /// Deviation along the nominal normal of the first face, mm; plus is material outside the nominal.
    pub d1_mm: f64,
    /// Along that of the second face.
    pub d2_mm: f64,
    /// Angle through the material, rad.
    pub included_angle_rad: f64,
    /// Outward unit normals of the two real surfaces at the virtual edge.
    pub normals: [DVec3; 2],
}

impl Surfaces {
    /// The virtual edge of two surfaces beside a station, by Newton's method from the station; `None` where the surfaces do not
    /// meet nearby (parallel, or no solution to 1e-10 mm within 30 steps).
    pub fn edge_truth(
        &self,
        station: &Station,
        pair: [SurfaceId; 2],
        kind: EdgeKind,
    ) -> Option<EdgeTruth> {
        let [a, b] = pair.map(|id| self.get(id));
        let mut p = station.point;
        for _ in 0..30 {
            let residual = DVec3::new(
                a.value(p),
                b.value(p),
                (p - station.point).dot(station.tangent),
            );
            // rows are the gradients
            let rows = DMat3::from_cols(a.gradient(p), b.gradient(p), station.tangent).transpose();
            if rows.determinant().abs() < 1e-9 {
                return None;
            }
            let step = rows.inverse() * residual;
            p -= step;
            if step.length() < 1e-12 {
                break;
            }
        }
        if a.value(p).abs().max(b.value(p).abs()) > 1e-10 {
            return None;
        }
        let normals = [a.normal(p, 0), b.normal(p, 0)];
        let turn = normals[0].angle_between(normals[1]);
        let departure = p - station.point;
        Some(EdgeTruth {
            point: p,
            d1_mm: departure.dot(station.normals[0]),
            d2_mm: departure.dot(station.normals[1]),
            included_angle_rad: match kind {
                EdgeKind::Convex => std::f64::consts::PI - turn,
                EdgeKind::Concave => std::f64::consts::PI + turn,
            },
            normals,
        })
    }
}

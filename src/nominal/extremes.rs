//! Points of a face that may bound its box: where its surface looks along an axis.

use glam::DVec3;

use super::face::Face;
use crate::geometry::Surface;

/// Points of the face, the furthest along each axis among them unless that is on an edge.
pub(super) fn extremes(face: &Face) -> Vec<DVec3> {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let both = axes.into_iter().flat_map(|a| [a, -a]);
    match &face.surface {
        // The furthest point of a plane or a ruled surface is on its border.
        Surface::Plane(_) | Surface::Cylinder { .. } | Surface::Cone { .. } => Vec::new(),
        Surface::Sphere { frame, radius_mm } => {
            used(face, both.map(|d| frame.origin + d * *radius_mm))
        }
        Surface::Torus {
            frame,
            major_mm,
            minor_mm,
        } => {
            let outermost = both.map(|d| {
                let across = (d - frame.z * d.dot(frame.z)).normalize_or(frame.x);
                frame.origin + across * *major_mm + d * *minor_mm
            });
            used(face, outermost)
        }
        Surface::Nurbs(_) | Surface::Swept(_) => sampled(face),
    }
}

/// The points of the surface nearest to some, where they lie inside the face.
fn used(face: &Face, points: impl Iterator<Item = DVec3>) -> Vec<DVec3> {
    points
        .map(|p| face.surface.nearest(p, None))
        .filter(|uv| face.contains(*uv))
        .map(|(u, v)| face.surface.point(u, v))
        .collect()
}

/// A grid over the face, fine enough that what bulges between its points is a thousandth of its size.
fn sampled(face: &Face) -> Vec<DVec3> {
    let mut out = Vec::new();
    for strip in face.trim.strips(face.trim.even_breaks(48)) {
        for (from, to) in &strip.across {
            out.extend((0..=48).map(|k| {
                let across = from + (to - from) * f64::from(k) / 48.0;
                let (u, v) = face.trim.uv(strip.along, across);
                face.surface.point(u, v)
            }));
        }
    }
    out
}

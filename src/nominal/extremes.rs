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

/// A grid over the face, and from its outermost places uphill to where the surface looks along an axis.
fn sampled(face: &Face) -> Vec<DVec3> {
    let mut places = Vec::new();
    for strip in face.trim.strips(face.trim.even_breaks(24)) {
        for (from, to) in &strip.across {
            places.extend((0..=24).map(|k| {
                let across = from + (to - from) * f64::from(k) / 24.0;
                let uv = face.trim.uv(strip.along, across);
                (uv, face.surface.point(uv.0, uv.1))
            }));
        }
    }
    let mut out: Vec<DVec3> = places.iter().map(|p| p.1).collect();
    for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
        for way in [axis, -axis] {
            let reach = |p: &&((f64, f64), DVec3)| p.1.dot(way);
            let best = places.iter().max_by(|a, b| reach(a).total_cmp(&reach(b)));
            out.extend(best.and_then(|(uv, _)| summit(face, *uv, way)));
        }
    }
    out
}

/// The place near `uv` that is outermost along `way`, by Newton's method; `None` where it leaves the face: the border is.
fn summit(face: &Face, mut uv: (f64, f64), way: DVec3) -> Option<DVec3> {
    for _ in 0..20 {
        let d = face.surface.derivatives(uv.0, uv.1);
        let (gu, gv) = (d.du.dot(way), d.dv.dot(way));
        let (a, b, c) = (d.duu.dot(way), d.duv.dot(way), d.dvv.dot(way));
        let det = a * c - b * b;
        if !(det > 0.0 && a < 0.0) {
            return None;
        }
        let step = ((b * gv - c * gu) / det, (b * gu - a * gv) / det);
        uv = (uv.0 + step.0, uv.1 + step.1);
        if !face.contains(uv) {
            return None;
        }
        if (d.du * step.0 + d.dv * step.1).length() <= 1e-9 * d.point.length() {
            break;
        }
    }
    Some(face.surface.point(uv.0, uv.1))
}

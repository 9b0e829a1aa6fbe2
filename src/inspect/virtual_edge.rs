//! The virtual edge at a station: where the two flanks meet, and how well that is known.
//!
//! Source: features-and-standards, section 5, characteristics 3 (deviations), 5b (virtual edge), 13 (included angle), 21.

use glam::{DMat2, DVec2, DVec3};

use super::flank::FlankFit;
use crate::nominal::{EdgeKind, Station};

/// The intersection of two flanks in the plane across the tangent, without the alignment's share of the uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VirtualEdge {
    /// The virtual edge, mm.
    pub point: DVec3,
    /// d1, d2, mm.
    pub d_mm: [f64; 2],
    /// Covariance of (d1, d2, included angle), in mm and rad.
    pub covariance: [[f64; 3]; 3],
    /// Included angle through the material, rad.
    pub included_angle_rad: f64,
}

/// Included angle of the nominal at a station, through the material, rad.
pub fn nominal_angle(station: &Station, kind: EdgeKind) -> f64 {
    let between = station.into_face[0].angle_between(station.into_face[1]);
    match kind {
        EdgeKind::Convex => between,
        EdgeKind::Concave => std::f64::consts::TAU - between,
    }
}

/// The virtual edge of `flanks` at `station`; `None` where the flanks are parallel.
///
/// Solves `(p - p0) . n_i - sag_i = offset_i + tilt_i (p - p0) . b_i` for p across t by Newton's method. `bend(i, p)` is the
/// height (sag) of nominal face i over its tangent plane at p0 and its slope there along b_i, both 0 for a plane: they make the
/// intersection and its angle those of the curved faces, where these meet. The covariance is the linear propagation of both flanks', which share no points.
pub fn intersect(
    station: &Station,
    kind: EdgeKind,
    flanks: [&FlankFit; 2],
    bend: impl Fn(usize, DVec3) -> [f64; 2],
) -> Option<VirtualEdge> {
    let [n, b] = [station.normals, station.into_face];
    // Coordinates in the plane across t.
    let x_axis = n[0];
    let y_axis = station.tangent.cross(n[0]).try_normalize()?;
    let flat = |v: DVec3| DVec2::new(v.dot(x_axis), v.dot(y_axis));
    let rows: [DVec2; 2] = std::array::from_fn(|i| flat(n[i]) - flanks[i].tilt * flat(b[i]));
    let matrix = DMat2::from_cols(rows[0], rows[1]).transpose();
    // sin(turn) below 0.5 degrees: the intersection runs away.
    if matrix.determinant().abs() < 8e-3 {
        return None;
    }
    let inverse = matrix.inverse();
    let at = |place: DVec2| station.point + place.x * x_axis + place.y * y_axis;
    let mut place = DVec2::ZERO;
    for _ in 0..4 {
        let p = at(place);
        let right: [f64; 2] = std::array::from_fn(|i| flanks[i].offset_mm + bend(i, p)[0]);
        place = inverse * DVec2::from(right);
    }
    let shift = place.x * x_axis + place.y * y_axis;
    let toward: [f64; 2] = std::array::from_fn(|i| shift.dot(b[i]));
    // d(place)/d(offset_i) and d(place)/d(tilt_i) = r_i d(place)/d(offset_i).
    let by_offset: [DVec2; 2] = [inverse.x_axis, inverse.y_axis];
    let mut jacobian = [[0.0; 4]; 3];
    for (k, normal) in n.iter().enumerate() {
        for i in 0..2 {
            let change = flat(*normal).dot(by_offset[i]);
            jacobian[k][2 * i] = change;
            jacobian[k][2 * i + 1] = change * toward[i];
        }
    }
    let mut angle = nominal_angle(station, kind);
    for i in 0..2 {
        let slope = flanks[i].tilt + bend(i, at(place))[1];
        angle += slope.atan();
        jacobian[2][2 * i + 1] = 1.0 / (1.0 + slope.powi(2));
    }
    Some(VirtualEdge {
        point: station.point + shift,
        d_mm: [shift.dot(n[0]), shift.dot(n[1])],
        covariance: propagate(&jacobian, flanks),
        included_angle_rad: angle,
    })
}

fn propagate(jacobian: &[[f64; 4]; 3], flanks: [&FlankFit; 2]) -> [[f64; 3]; 3] {
    let mut covariance = [[0.0; 3]; 3];
    for (i, row) in covariance.iter_mut().enumerate() {
        for (j, entry) in row.iter_mut().enumerate() {
            for (f, flank) in flanks.iter().enumerate() {
                for a in 0..2 {
                    for c in 0..2 {
                        *entry += jacobian[i][2 * f + a]
                            * flank.covariance[a][c]
                            * jacobian[j][2 * f + c];
                    }
                }
            }
        }
    }
    covariance
}

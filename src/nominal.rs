//! A CAD file as faces and the sharp edges between them, in mm, in the part frame.

use glam::DVec3;

/// A point of a surface: the foot of a perpendicular.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Foot {
    /// Parameters of the surface.
    pub uv: (f64, f64),
    /// Position, mm.
    pub point: DVec3,
    /// Outward unit normal of the face (out of the material).
    pub normal: DVec3,
}

/// A place along a sharp edge, with the frame in which deviations are measured (features-and-standards, section 5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    /// Arc length from the start of the edge, mm.
    pub s_mm: f64,
    /// p0: the place on the nominal edge, mm.
    pub point: DVec3,
    /// t: unit tangent along the edge.
    pub tangent: DVec3,
    /// n1, n2: outward unit normals of the two faces.
    pub normals: [DVec3; 2],
    /// b1, b2: unit directions in each face, across t, away from the edge into the face.
    pub into_face: [DVec3; 2],
}

/// Convex or concave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeKind {
    /// Included angle below 180 degrees: material inside.
    Convex,
    /// Included angle above 180 degrees.
    Concave,
}

//! What inspection asks of a nominal: exact feet on its faces, samples of them, and frames along its sharp edges.

use std::collections::HashSet;

use glam::DVec3;

use crate::geometry::Surface;
use crate::nominal::{EdgeKind, Foot, Nominal, Pmi, Station};

/// A place on a face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodySample {
    /// Position, mm.
    pub point: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Index of the face.
    pub face: u32,
    /// Parameters on its surface.
    pub uv: (f64, f64),
}

/// A sharp edge between two faces.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyEdge {
    /// `e1`, `e2` ... in the order of the nominal.
    pub id: String,
    /// Number of the edge's entity in the STEP file.
    pub entity: u64,
    /// Indices of the two faces, in the order of the normals of its stations.
    pub faces: [u32; 2],
    /// Convex or concave.
    pub kind: EdgeKind,
    /// Length, mm.
    pub length_mm: f64,
    /// Whether its end is its start.
    pub closed: bool,
}

/// What a face holds as a datum feature, in the part frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DatumShape {
    /// A plane.
    Plane,
    /// A cylinder or cone: a place on its axis, mm, and its unit direction.
    Axis(DVec3, DVec3),
    /// A sphere: its centre, mm.
    Centre(DVec3),
}

/// A nominal part, in mm, in the part frame.
pub trait Body: Sync {
    /// Number of faces.
    fn face_count(&self) -> usize;
    /// Number of the face's entity in the STEP file.
    fn face_entity(&self, face: u32) -> u64;
    /// The foot of the perpendicular from `p` on the face's whole surface; `None` where there is none.
    /// `near` are parameters to start from.
    fn foot(&self, face: u32, p: DVec3, near: Option<(f64, f64)>) -> Option<Foot>;
    /// Whether the place with parameters `uv` lies inside the face's boundary.
    fn contains(&self, face: u32, uv: (f64, f64)) -> bool;
    /// Places on all faces, about `spacing_mm` apart.
    fn samples(&self, spacing_mm: f64) -> Vec<BodySample>;
    /// Its sharp edges.
    fn edges(&self) -> Vec<BodyEdge>;
    /// Pairs of faces, the smaller index first, that pass into each other without a sharp edge anywhere; ascending.
    fn smooth_pairs(&self) -> Vec<[u32; 2]> {
        Vec::new()
    }
    /// The frame at arc length `s_mm` of the sharp edge with index `edge`.
    fn station(&self, edge: usize, s_mm: f64) -> Station;
    /// Smallest and largest coordinates, mm.
    fn bounds(&self) -> [DVec3; 2];
    /// What a face holds as a datum feature; `None` for a free-form face, or where nobody knows.
    fn datum_shape(&self, face: u32) -> Option<DatumShape> {
        let _ = face;
        None
    }
    /// Dimensions, tolerances and datum features that come with the nominal.
    fn pmi(&self) -> &[Pmi] {
        &[]
    }
}

fn ordered([a, b]: [u32; 2]) -> [u32; 2] {
    [a.min(b), a.max(b)]
}

impl Body for Nominal {
    fn face_count(&self) -> usize {
        self.faces.len()
    }

    fn face_entity(&self, face: u32) -> u64 {
        self.faces[face as usize].entity
    }

    fn foot(&self, face: u32, p: DVec3, near: Option<(f64, f64)>) -> Option<Foot> {
        self.faces[face as usize].foot(p, near)
    }

    fn contains(&self, face: u32, uv: (f64, f64)) -> bool {
        self.faces[face as usize].contains(uv)
    }

    fn samples(&self, spacing_mm: f64) -> Vec<BodySample> {
        Nominal::samples(self, spacing_mm)
            .into_iter()
            .map(|sample| BodySample {
                point: sample.point,
                normal: sample.normal,
                face: sample.face,
                uv: sample.uv,
            })
            .collect()
    }

    fn edges(&self) -> Vec<BodyEdge> {
        self.sharp_edges
            .iter()
            .map(|edge| BodyEdge {
                id: edge.id.clone(),
                entity: edge.entity,
                faces: edge.faces,
                kind: edge.kind,
                length_mm: edge.length_mm,
                closed: edge.closed,
            })
            .collect()
    }

    fn smooth_pairs(&self) -> Vec<[u32; 2]> {
        let sharp: HashSet<[u32; 2]> = self.sharp_edges.iter().map(|e| ordered(e.faces)).collect();
        let joined = self.edges.iter().filter_map(|edge| match edge.faces[..] {
            [a, b] if a != b && !sharp.contains(&ordered([a, b])) => Some(ordered([a, b])),
            _ => None,
        });
        let mut pairs: Vec<[u32; 2]> = joined.collect();
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    }

    fn station(&self, edge: usize, s_mm: f64) -> Station {
        self.sharp_edges[edge].station(self, s_mm)
    }

    fn bounds(&self) -> [DVec3; 2] {
        self.bounding_box_mm
    }

    fn datum_shape(&self, face: u32) -> Option<DatumShape> {
        match &self.faces[face as usize].surface {
            Surface::Plane(_) => Some(DatumShape::Plane),
            Surface::Cylinder { frame, .. } | Surface::Cone { frame, .. } => {
                Some(DatumShape::Axis(frame.origin, frame.z))
            }
            Surface::Sphere { frame, .. } => Some(DatumShape::Centre(frame.origin)),
            Surface::Torus { .. } | Surface::Swept(_) | Surface::Nurbs(_) => None,
        }
    }

    fn pmi(&self) -> &[Pmi] {
        Nominal::pmi(self)
    }
}

//! A CAD file as faces and the sharp edges between them, in mm, in the part frame.

mod bodies;
mod build;
mod closest;
mod corner;
mod error;
mod extremes;
mod face;
mod iges;
mod iges_build;
mod iges_shapes;
mod net;
mod part21;
mod path;
mod pmi;
mod shapes;
mod sharp;
mod trim;
mod unroll;

use std::io::Read;
use std::path::Path;

use glam::DVec3;

pub use corner::{Corner, End};
pub use error::NominalError;
pub use face::{Face, SurfaceSample};
pub use pmi::{Measure, Pmi, PmiKind};
pub use sharp::{MIN_TURN_ANGLE_RAD, SharpEdge};

use crate::geometry::Curve;

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

/// A part as its CAD file describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Nominal {
    /// File name, or what the caller called it.
    pub name: String,
    /// Solids and surface models, each occurrence of an assembly counted.
    pub bodies: usize,
    /// In the order of the file.
    pub faces: Vec<Face>,
    /// In the order in which the faces use them.
    pub edges: Vec<Edge>,
    /// `e1`, `e2` ... in the order of `edges`.
    pub sharp_edges: Vec<SharpEdge>,
    /// What could not be used, and why.
    pub refused: Vec<Refused>,
    /// Curves that bound no face: centre lines, sketches, construction geometry. Never measured.
    pub wires: Vec<Wire>,
    /// Smallest and largest coordinates of faces, wires and loose points, mm.
    pub bounding_box_mm: [DVec3; 2],
    /// Smallest and largest coordinates of the faces alone, mm.
    pub faces_box_mm: [DVec3; 2],
    corners: Vec<Corner>,
    pmi: Vec<Pmi>,
    /// Of `edges`, by arc length.
    paths: Vec<path::Path>,
    /// Indices of the edges that bound each face.
    borders: Vec<Vec<u32>>,
}

/// A bounded curve of a wireframe.
#[derive(Debug, Clone, PartialEq)]
pub struct Wire {
    /// Its number in the file.
    pub entity: u64,
    /// The whole curve.
    pub curve: Curve,
    /// Parameters of start and end.
    pub range: (f64, f64),
    /// In mm.
    pub length_mm: f64,
}

/// A bounded curve where faces meet.
#[derive(Debug, Clone, PartialEq)]
pub struct Edge {
    /// Number of the EDGE_CURVE in the file.
    pub entity: u64,
    /// Body of its faces.
    pub body: usize,
    /// The whole curve.
    pub curve: Curve,
    /// Parameters of start and end; the end may be the smaller, or lie a turn on.
    pub range: (f64, f64),
    /// Faces that use it, in ascending order; one face twice where the edge is its seam.
    pub faces: Vec<u32>,
    /// In mm.
    pub length_mm: f64,
}

/// Something of the file that is not used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused {
    /// Its number in the file.
    pub entity: u64,
    /// Why.
    pub reason: String,
}

/// Largest file that is read.
const MAX_BYTES: u64 = 512 << 20;

impl Nominal {
    /// The part in a STEP (AP203, AP214, AP242) or IGES file; the first line tells which.
    pub fn read(path: &Path) -> Result<Self, NominalError> {
        let name = path.display().to_string();
        let failed = |source| NominalError::Io {
            name: name.clone(),
            source,
        };
        let file = std::fs::File::open(path).map_err(failed)?;
        let mut bytes = Vec::new();
        file.take(MAX_BYTES + 1)
            .read_to_end(&mut bytes)
            .map_err(failed)?;
        Self::parse(&bytes, &name)
    }

    /// The part in the text of a STEP or IGES file; `name` is for messages.
    pub fn parse(bytes: &[u8], name: &str) -> Result<Self, NominalError> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(NominalError::TooLarge {
                name: name.into(),
                bytes: bytes.len() as u64,
                limit: MAX_BYTES,
            });
        }
        if iges::is_iges(bytes) {
            return iges_build::build(bytes, name);
        }
        build::build(bytes, name)
    }

    /// Where sharp edges end: corners of the part, and places where one edge goes on or fades.
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Dimensions, tolerances and datum features that an AP242 file carries; empty for other files.
    pub fn pmi(&self) -> &[Pmi] {
        &self.pmi
    }

    /// Area of all faces, mm2.
    pub fn area_mm2(&self) -> f64 {
        self.faces.iter().map(Face::area_mm2).sum()
    }

    /// Volume inside the faces, mm3: of use where the bodies are solids.
    pub fn volume_mm3(&self) -> f64 {
        self.faces.iter().map(Face::volume_mm3).sum()
    }

    /// Length of all edges, each counted once, mm.
    pub fn edge_length_mm(&self) -> f64 {
        self.edges.iter().map(|e| e.length_mm).sum()
    }

    /// Points inside the faces about `spacing_mm` apart, in the order of the faces; the same for the same part.
    ///
    /// The spacing is widened where it would give more than ten million points.
    pub fn samples(&self, spacing_mm: f64) -> Vec<SurfaceSample> {
        let least = (self.area_mm2() / 1e7).sqrt();
        let spacing_mm = if spacing_mm.is_finite() {
            spacing_mm.max(least)
        } else {
            self.bounding_box_mm[0].distance(self.bounding_box_mm[1])
        };
        let mut out = Vec::new();
        for (i, face) in self.faces.iter().enumerate() {
            face.sample(i as u32, spacing_mm, &mut out);
        }
        out
    }
}

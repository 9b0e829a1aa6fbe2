//! Watertight meshes through every point, and the normals they give.
//!
//! The way of Ma 2011: the Delaunay triangulation of the points; around every point an umbrella of its facets; umbrellas picked again until
//! neighbours pick the same. What does not come to match is decided by the cells: every umbrella votes which of its cells are inside, the
//! cheapest parting of all cells follows the votes without wide facets, and cells are turned until the surface between inside and outside is a
//! manifold through every point. At last diagonals are exchanged until the edges of the mesh lie along those of the part.

mod blocks;
mod boxes;
mod build;
mod carve;
pub mod check;
mod cone;
mod crossing;
mod curve;
mod cut;
mod defect;
pub mod delaunay;
mod flip;
pub mod mend;
pub mod normals;
mod open;
mod part;
pub mod picture;
mod predicates;
mod sheet;
pub mod solid;
pub mod star;
pub mod umbrella;
pub mod write;

use std::borrow::Cow;
use std::time::Instant;

use glam::DVec3;

pub use check::{Topology, check_delaunay, topology};
pub use delaunay::{Delaunay, DelaunayError};
pub use normals::{Normals, Rings, normals, orient_normals};
pub use write::{MeshForm, mesh_bytes};

use mend::{Mending, mend};
use solid::{Solid, settle, surface, vote};
use star::{Facets, Stars};
use umbrella::{Matching, match_umbrellas};

/// How a mesh is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Whether unmatched vertices prefer facets that continue the flat surface beside them (Ma 2011, chapter 5).
    pub cone: bool,
    /// Whether triangles that bridge what was never seen are left out; the mesh then has borders.
    pub open: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            cone: true,
            open: false,
        }
    }
}

/// A mesh of V vertices, each a point of the input, and F triangles.
#[derive(Debug, Clone)]
pub struct Mesh {
    /// V positions, mm: the distinct input points in input order; behind them again those at which the surface comes together more than once, where
    /// it is parted.
    pub positions: Vec<DVec3>,
    /// For every vertex the index of the first input point there.
    pub sources: Vec<u32>,
    /// F triangles, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// What the triangles are, counted from nothing but themselves.
    pub topology: Topology,
    /// Vertices whose umbrella was fully matched, after every round of matching.
    pub matching: Matching,
    /// Vertices that the matching left in disorder, and what became of them.
    pub mending: Mending,
    /// Seconds by stage.
    pub seconds: Vec<(&'static str, f64)>,
}

impl Mesh {
    /// Share of the vertices, in percent, around which the mesh has one closed ring of triangles: a fully matched umbrella (Ma 2011, §3.4).
    pub fn matched_percent(&self) -> f64 {
        percent(
            self.positions.len() - self.mending.after.min(self.positions.len()),
            self.positions.len(),
        )
    }

    /// The same by matching alone, before cells were turned.
    pub fn matched_by_umbrellas_percent(&self) -> f64 {
        percent(
            self.matching.matched.last().copied().unwrap_or(0),
            self.positions.len(),
        )
    }

    /// |2 V + 4 (G - B) - F| for B pieces with G handles together (Ma 2011, equation 3.2, where B is 1); G is taken as 0 where the mesh
    /// is open or no manifold.
    pub fn delta_f(&self) -> u64 {
        let t = &self.topology;
        let pieces = t.pieces as i64;
        let expected = 2 * self.positions.len() as i64 + 4 * (t.genus().unwrap_or(0) - pieces);
        expected.abs_diff(t.triangles as i64)
    }
}

fn percent(part: usize, of: usize) -> f64 {
    100.0 * part as f64 / of.max(1) as f64
}

/// The points as a body: their triangulation, the umbrellas, and which cells are inside.
pub struct Body {
    /// The triangulation.
    pub delaunay: Delaunay,
    /// Cells at every vertex.
    pub stars: Stars,
    /// Sizes of facets and the marks of umbrellas.
    pub facets: Facets,
    /// Which cells are inside.
    pub solid: Solid,
    /// How umbrellas matched.
    pub matching: Matching,
    /// How vertices were mended.
    pub mending: Mending,
    /// Triangles of the closed surface, counter-clockwise seen from outside: those between inside and outside, of which diagonals were exchanged. Empty
    /// where the mesh shall be open.
    pub surface: Vec<[u32; 3]>,
    /// Vertices that the surface has once more, numbered behind those of the triangulation: where it comes together twice it is parted.
    pub copies: Vec<u32>,
    /// Seconds by stage.
    pub seconds: Vec<(&'static str, f64)>,
}

impl Body {
    /// The body whose surface goes through all `positions`, mm.
    ///
    /// The result does not depend on the number of threads. Memory: about 80 bytes a cell at the most, 6.6 cells a point.
    ///
    /// # Errors
    /// [`DelaunayError`].
    pub fn new(positions: &[DVec3], settings: Settings) -> Result<Self, DelaunayError> {
        let mut seconds = Vec::new();
        let mut clock = Instant::now();
        let mut lap = |stage| {
            seconds.push((stage, clock.elapsed().as_secs_f64()));
            clock = Instant::now();
        };
        let delaunay = Delaunay::new(positions)?;
        lap("delaunay");
        let stars = Stars::new(&delaunay);
        let facets = Facets::new(&delaunay);
        lap("facets");
        let matching = match_umbrellas(&delaunay, &stars, &facets, settings.cone);
        lap("umbrellas");
        let mut solid = vote(&delaunay, &stars, &facets);
        settle(&delaunay, &stars, &facets, &mut solid);
        lap("inside");
        // What closes an open scan is thrown away again: cells as large as the part, at vertices of thousands.
        let mending = mend(&delaunay, &stars, &facets, &mut solid, !settings.open);
        lap("mend");
        let (mut triangles, mut copies) = (Vec::new(), Vec::new());
        if !settings.open {
            triangles = surface(&delaunay, &solid.inside);
            if mending.after > 0 {
                copies = part::part(&delaunay, &solid.inside, &mut triangles);
            }
            if settings.cone {
                let mut points = Cow::Borrowed(&delaunay.points[..]);
                if !copies.is_empty() {
                    let again = copies.iter().map(|v| delaunay.points[*v as usize]);
                    points.to_mut().extend(again);
                }
                flip::flip(&points, &mut triangles);
            }
        }
        lap("flip");
        Ok(Self {
            delaunay,
            stars,
            facets,
            solid,
            matching,
            mending,
            surface: triangles,
            copies,
            seconds,
        })
    }

    /// The surface as a mesh of `positions`, the same that the body was made of.
    pub fn mesh(&self, positions: &[DVec3], settings: Settings) -> Mesh {
        let start = Instant::now();
        let mut sources = self.delaunay.sources.clone();
        sources.sort_unstable();
        let mut numbers: Vec<u32> = (self.delaunay.sources.iter())
            // Every source is in the list it was copied to.
            .map(|s| sources.partition_point(|other| other < s) as u32)
            .collect();
        let triangles = if settings.open {
            open::seen_triangles(self)
        } else {
            for v in &self.copies {
                numbers.push(sources.len() as u32);
                sources.push(self.delaunay.sources[*v as usize]);
            }
            self.surface.clone()
        };
        let triangles = numbered(triangles, &numbers);
        let mut seconds = self.seconds.clone();
        seconds.push(("surface", start.elapsed().as_secs_f64()));
        Mesh {
            positions: sources.iter().map(|s| positions[*s as usize]).collect(),
            topology: topology(sources.len(), &triangles),
            sources,
            triangles,
            matching: self.matching.clone(),
            mending: self.mending,
            seconds,
        }
    }
}

/// Triangles of vertices of the triangulation with the `numbers` of the mesh, each begun with its lowest corner and sorted: the mesh is the same whatever
/// the order of the cells.
fn numbered(triangles: Vec<[u32; 3]>, numbers: &[u32]) -> Vec<[u32; 3]> {
    let mut triangles: Vec<[u32; 3]> = (triangles.into_iter())
        .map(|t| {
            let [a, b, c] = t.map(|v| numbers[v as usize]);
            if a < b && a < c {
                [a, b, c]
            } else if b < c {
                [b, c, a]
            } else {
                [c, a, b]
            }
        })
        .collect();
    triangles.sort_unstable();
    triangles
}

/// The mesh of `positions` that lie exactly in one plane: their Delaunay triangulation there, without what bridges the unseen; its front looks along Z, or along
/// Y or X where the plane holds the axes before.
///
/// With one more point off the plane the cells are those over the plane's triangles: a sphere through it and a triangle's corners meets the
/// plane in the circle through the corners. So all signs stay exact and nothing is shaken.
fn plane_mesh(positions: &[DVec3]) -> Result<Mesh, DelaunayError> {
    let start = Instant::now();
    let (low, high) = curve::bounds(positions.iter().copied());
    let size = (high - low).max_element();
    // A plane holds two axes at the most.
    let off = |axis: DVec3| {
        let mut points = positions.to_vec();
        points.push(positions.first().copied().unwrap_or(low) + axis * size);
        Delaunay::new(&points)
    };
    let delaunay = (off(DVec3::Z).or_else(|_| off(DVec3::Y))).or_else(|_| off(DVec3::X))?;
    let apex = delaunay.vertex_of[positions.len()];
    let mut sources = delaunay.sources.clone();
    sources.sort_unstable();
    // The apex came last.
    sources.pop();
    let numbers: Vec<u32> = (delaunay.sources.iter())
        .map(|s| sources.partition_point(|other| other < s) as u32)
        .collect();
    let triangles = numbered(open::plane_triangles(&delaunay, apex), &numbers);
    Ok(Mesh {
        positions: sources.iter().map(|s| positions[*s as usize]).collect(),
        topology: topology(sources.len(), &triangles),
        sources,
        triangles,
        matching: Matching::default(),
        mending: Mending::default(),
        seconds: vec![("plane", start.elapsed().as_secs_f64())],
    })
}

/// Meshes `positions`, mm. Where they lie exactly in one plane there is an open mesh only.
///
/// # Errors
/// [`DelaunayError`].
pub fn mesh(positions: &[DVec3], settings: Settings) -> Result<Mesh, DelaunayError> {
    match Body::new(positions, settings) {
        Ok(body) => Ok(body.mesh(positions, settings)),
        Err(DelaunayError::Flat { dimension: 2, .. }) if settings.open => plane_mesh(positions),
        Err(error) => Err(error),
    }
}

//! Exact solids: where a ray meets them first, on which surface, and where their true edges lie.
//!
//! Surfaces are implicit functions ([`Surface`]); solids are unions, intersections and differences of their regions
//! ([`Solid`]). Rays are intersected by closed forms or by isolating every root of the exact polynomial, never by marching.

mod bounds;
mod edge;
mod mesh;
mod polynomial;
mod solid;
mod span;
mod surface;
#[cfg(test)]
mod tests;

use glam::DVec3;

pub use bounds::Bounds;
pub use edge::{EdgeKind, EdgeTruth, Station};
pub use mesh::MeshError;
pub use solid::{Solid, Surfaces};
pub use span::Ray;
pub use surface::{HeightField, Surface, SurfaceId};

use solid::First;
use span::Window;

/// Rays end here: no scene is larger, mm.
const FARTHEST: f64 = 1e6;

/// Solids to be looked at, in a frame of their own.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Every surface by number.
    pub surfaces: Surfaces,
    /// All there is.
    pub solid: Solid,
    /// Where light does not come back from: stains, holes of unknown depth, missing paint.
    pub dark: Vec<Bounds>,
}

/// Where a ray meets a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Along the ray, mm.
    pub distance: f64,
    /// Where, mm.
    pub point: DVec3,
    /// Outward unit normal of the solid.
    pub normal: DVec3,
    /// Of what.
    pub surface: SurfaceId,
}

impl Scene {
    /// A scene of one solid, everywhere bright.
    pub fn new(surfaces: Surfaces, solid: Solid) -> Scene {
        Scene {
            surfaces,
            solid,
            dark: Vec::new(),
        }
    }

    /// Where the ray first enters the solid; nothing when it misses. A ray that starts inside meets what it enters after it left.
    pub fn cast(&self, ray: &Ray) -> Option<Hit> {
        let window = Window {
            from: 0.0,
            to: FARTHEST,
        };
        let crossing = match self.solid.first(&self.surfaces, ray, window) {
            First::Nothing => return None,
            First::At(crossing) => crossing,
            First::Inside => {
                let spans = self.solid.spans(&self.surfaces, ray, window);
                spans.iter().find(|s| s.enter.surface.is_some())?.enter
            }
        };
        let point = ray.at(crossing.t);
        let surface = crossing.surface?;
        let normal = self.surfaces.get(surface).normal(point, crossing.facet);
        Some(Hit {
            distance: crossing.t,
            point,
            normal: if normal.dot(ray.direction) > 0.0 {
                -normal
            } else {
                normal
            },
            surface,
        })
    }

    /// Whether anything lies between the start of the ray and `distance` mm along it.
    pub fn blocks(&self, ray: &Ray, distance: f64) -> bool {
        let window = Window {
            from: 0.0,
            to: distance,
        };
        !matches!(
            self.solid.first(&self.surfaces, ray, window),
            First::Nothing
        )
    }

    /// Whether the point is inside the solid.
    pub fn contains(&self, point: DVec3) -> bool {
        self.solid.contains(&self.surfaces, point)
    }

    /// Whether no light comes back from the point.
    pub fn is_dark(&self, point: DVec3) -> bool {
        self.dark.iter().any(|patch| patch.contains(point))
    }
}

//! Watertight meshes through every point, and the normals they give.

pub mod check;
mod cone;
mod curve;
pub mod delaunay;
pub mod mend;
mod predicates;
pub mod solid;
pub mod star;
pub mod umbrella;

//! Watertight meshes through every point, and the normals they give.

pub mod check;
mod curve;
pub mod delaunay;
mod predicates;
pub mod solid;
pub mod star;
pub mod umbrella;

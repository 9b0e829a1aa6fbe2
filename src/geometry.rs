//! Rigid transforms, fits with residuals and covariance, NURBS curves and surfaces.

pub mod fit;
pub mod rigid;

pub use rigid::RigidTransform;

//! Rigid transforms, fits with residuals and covariance, NURBS curves and surfaces.

pub mod basis;
mod convert;
pub mod curve;
pub mod fit;
pub mod frame;
mod nets;
pub mod newton;
pub mod nurbs_curve;
pub mod nurbs_surface;
mod pieces;
pub mod rigid;
mod search;
pub mod sphere;
pub mod surface;
pub mod sweep;

pub use curve::Curve;
pub use frame::Frame;
pub use nurbs_curve::NurbsCurve;
pub use nurbs_surface::NurbsSurface;
pub use rigid::RigidTransform;
pub use surface::Surface;

//! A pose from nothing.

use crate::geometry::RigidTransform;
use crate::inspect::assign::Surface;
use crate::inspect::body::Body;

use super::Scan;

/// A pose that fits, and whether others fit as well.
pub(super) struct Found {
    pub(super) pose: RigidTransform,
    pub(super) ambiguous: bool,
    pub(super) findings: Vec<String>,
}

pub(super) fn search<B: Body>(_scan: &Scan<'_>, _surface: &Surface<'_, B>) -> Option<Found> {
    None
}

//! What an inspection found, in the part frame. [`crate::report`] gives it its outer forms.

use glam::DVec3;

use crate::features::Class;
use crate::geometry::RigidTransform;
use crate::nominal::{EdgeKind, Station};
use crate::points::Spacing;

/// The answer of a value, an edge or a part. The worst rules upward, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Verdict {
    /// Not evaluated.
    Undefined,
    /// Within the limits.
    Ok,
    /// A limit lies inside the uncertainty zone, or data or alignment are inadequate.
    NotDecidable,
    /// Outside the limits.
    NotOk,
}

/// Everything that one inspection found.
#[derive(Debug, Clone, PartialEq)]
pub struct Inspection {
    /// How the scan lies in the part frame.
    pub alignment: Alignment,
    /// One for every sharp edge of the nominal.
    pub edges: Vec<EdgeResult>,
    /// Edges in the scan where the nominal has none: polylines, mm, part frame.
    pub unexpected_edges: Vec<Vec<DVec3>>,
    /// Ids of nominal edges without a detection although the data are adequate.
    pub missing_edges: Vec<String>,
    /// Worst of the edges and of the alignment.
    pub verdict: Verdict,
    /// Seconds by stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
    /// What was wrong with the data; the result goes on.
    pub findings: Vec<String>,
    /// What the scan is like and which of its points lie on edges; `None` where nothing was estimated.
    pub scan: Option<ScanEstimate>,
}

/// What was estimated from the scan itself.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanEstimate {
    /// Along and across the lines, and their mean.
    pub spacing: Spacing,
    /// Standard deviation of the points normal to the surface, mm.
    pub noise_mm: f64,
    /// N classes, in the order of the cloud.
    pub classes: Vec<Class>,
}

/// How the scan lies in the part frame, and how well that is known.
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// The pose found.
    pub part_from_machine: RigidTransform,
    /// Root mean square of the residuals of the points used, mm.
    pub rms_mm: f64,
    /// Points used.
    pub points: usize,
    /// Covariance of (rotation vector in rad about the part origin, translation in mm), row-major 6 x 6.
    pub covariance: [[f64; 6]; 6],
    /// Directions of motion that the data hold only weakly, in words ("rotation about x", "along z").
    pub weak_directions: Vec<String>,
    /// Ok, or NotDecidable with the reason in the findings.
    pub status: Verdict,
}

/// One nominal edge as measured.
#[derive(Debug, Clone, PartialEq)]
pub struct EdgeResult {
    /// `e1`, `e2` ... in the order of the nominal, or the recipe's name.
    pub id: String,
    /// Number of the edge's entity in the STEP file.
    pub nominal_entity: u64,
    /// Convex or concave.
    pub kind: EdgeKind,
    /// Nominal length, mm.
    pub length_mm: f64,
    /// Share of the length that was measured, 0 to 1.
    pub coverage: f64,
    /// In order of arc length.
    pub stations: Vec<StationResult>,
    /// Mean deviations over the measured stations; `None` where none was measured.
    pub mean: Option<EdgeMean>,
    /// Worst of the stations against the limits of the recipe.
    pub verdict: Verdict,
}

/// Mean deviation of an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeMean {
    /// Means of d1 and d2, mm.
    pub d_mm: [f64; 2],
    /// Their standard uncertainties, what the stations share included, mm.
    pub u_d_mm: [f64; 2],
}

/// One station as measured; `measured` is `None` where it was not.
#[derive(Debug, Clone, PartialEq)]
pub struct StationResult {
    /// The nominal place and its frame.
    pub station: Station,
    /// What was measured there.
    pub measured: Option<Measured>,
    /// Points used on each flank.
    pub points: [usize; 2],
    /// Verdict of the station.
    pub verdict: Verdict,
    /// Why it was not measured or not decidable; empty otherwise.
    pub reason: String,
}

/// The virtual edge at a station and its deviations. Sign: plus = material outside the nominal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Intersection of the two fitted flanks in the plane across the tangent, mm, part frame.
    pub point: DVec3,
    /// d1, d2 = (p - p0) . n1, n2, mm.
    pub d_mm: [f64; 2],
    /// Standard uncertainties of d1 and d2, mm, all contributions.
    pub u_d_mm: [f64; 2],
    /// Included angle between the flanks through the material, rad.
    pub included_angle_rad: f64,
    /// Its standard uncertainty, rad.
    pub u_included_angle_rad: f64,
    /// Residual standard deviation of each flank fit, mm.
    pub residual_mm: [f64; 2],
}

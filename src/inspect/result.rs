//! What an inspection found, in the part frame. [`crate::report`] gives it its outer forms.

use glam::DVec3;

use super::flank::FlankModel;
use super::monte_carlo::Trials;
use crate::geometry::RigidTransform;
use crate::nominal::{EdgeKind, Station};
use crate::points::Spacing;

use super::characteristic::Characteristic;

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
    /// Where three faces or more meet.
    pub corners: Vec<CornerResult>,
    /// Gap and flush, as the recipe asks.
    pub gaps: Vec<GapResult>,
    /// Edges in the scan where the nominal has none: polylines, mm, part frame.
    pub unexpected_edges: Vec<Vec<DVec3>>,
    /// Ids of nominal edges without a detection although the data are adequate.
    pub missing_edges: Vec<String>,
    /// Worst of the edges and of the alignment.
    pub verdict: Verdict,
    /// The trials of the Monte Carlo method; `None` where uncertainties are of first order.
    pub trials: Option<Trials>,
    /// Seconds by stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
    /// What was wrong with the data; the result goes on.
    pub findings: Vec<String>,
    /// What the scan is like; `None` where nothing was estimated.
    pub scan: Option<ScanEstimate>,
}

/// What was estimated from the scan itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanEstimate {
    /// Along and across the lines, and their mean.
    pub spacing: Spacing,
    /// Standard deviation of the points normal to the surface, mm.
    pub noise_mm: f64,
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
    /// How the pose was found.
    pub method: Method,
    /// STEP entities of the faces that the best fit used; empty = all.
    pub faces: Vec<u64>,
    /// The datum features that the pose rests on.
    pub datums: Vec<DatumResult>,
    /// What they leave free, in words: there the pose is that of the best fit.
    pub free_of_datums: Vec<String>,
}

impl Default for Alignment {
    /// The identity, of which nothing is known.
    fn default() -> Self {
        Self {
            part_from_machine: RigidTransform::IDENTITY,
            rms_mm: 0.0,
            points: 0,
            covariance: [[0.0; 6]; 6],
            weak_directions: Vec::new(),
            status: Verdict::Undefined,
            method: Method::BestFit,
            faces: Vec::new(),
            datums: Vec::new(),
            free_of_datums: Vec::new(),
        }
    }
}

/// How a pose was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// The scan was taken as it lies.
    AsGiven,
    /// Least squares over the faces.
    BestFit,
    /// On datum features.
    Datums,
}

/// A datum feature as measured.
#[derive(Debug, Clone, PartialEq)]
pub struct DatumResult {
    /// The recipe's name.
    pub name: String,
    /// What it holds.
    pub kind: DatumKind,
    /// 1 holds before 2, 2 before 3.
    pub priority: u32,
    /// STEP entities of its faces; empty for a reference point.
    pub faces: Vec<u64>,
    /// Points used.
    pub points: usize,
    /// How far it lies off its nominal at the pose: the place, mm.
    pub residual_mm: f64,
    /// And its direction, rad, where it has one.
    pub residual_rad: Option<f64>,
    /// Standard uncertainty of its place, mm.
    pub u_mm: f64,
    /// Standard deviation of its points about it, mm: noise and form.
    pub form_mm: f64,
}

/// What a datum feature holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DatumKind {
    /// A reference point: one direction.
    Point,
    /// A plane.
    Plane,
    /// The axis of a cylinder or cone.
    Axis,
    /// The centre of a sphere.
    Centre,
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
    /// Share of the length of which only one flank was seen, 0 to 1.
    pub boundary_share: f64,
    /// In order of arc length.
    pub stations: Vec<StationResult>,
    /// The shape of the edge itself, one a stretch of stations, in order of arc length; empty where it was not seen.
    pub breaks: Vec<EdgeBreak>,
    /// The edge as a curve; `None` where fewer than four stations were measured.
    pub form: Option<EdgeForm>,
    /// The values that can be judged.
    pub characteristics: Vec<Characteristic>,
    /// Mean deviations over the measured stations; `None` where none was measured.
    pub mean: Option<EdgeMean>,
    /// Worst of the characteristics and the coverage.
    pub verdict: Verdict,
}

/// The measured edge as a curve. Source: features-and-standards, section 5, characteristics 14 and 15.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeForm {
    /// Diameter of the smallest cylinder around the measured points; `None` where the nominal edge is not straight.
    pub straightness_mm: Option<Quantified>,
    /// Twice the largest distance from the nominal edge.
    pub line_profile_mm: Quantified,
    /// Arc length of that place.
    pub s_worst_mm: f64,
    /// The same after the rigid motion that fits the edge alone best.
    pub line_form_mm: Option<Quantified>,
    /// Largest angle to the nominal tangent, and its arc length; `None` where no stretch is long enough.
    pub direction_rad: Option<(Quantified, f64)>,
}

/// A corner as measured.
#[derive(Debug, Clone, PartialEq)]
pub struct CornerResult {
    /// `c1`, `c2` ...
    pub id: String,
    /// Nominal place, mm.
    pub nominal: DVec3,
    /// STEP entities of its faces.
    pub faces: Vec<u64>,
    /// Ids of the edges that end in it.
    pub edges: Vec<String>,
    /// Intersection of the measured flanks, mm; `None` = not measured.
    pub measured: Option<DVec3>,
    /// Its distance from the nominal place.
    pub total_mm: Option<Quantified>,
    /// Root mean square of what the faces beyond three leave; `None` with three.
    pub residual_mm: Option<f64>,
    /// Largest distance allowed, mm.
    pub limit_mm: Option<f64>,
    /// Against that limit.
    pub verdict: Verdict,
    /// Why it was not measured; empty otherwise.
    pub reason: String,
}

/// Gap and flush between two edges.
#[derive(Debug, Clone, PartialEq)]
pub struct GapResult {
    /// The recipe's name.
    pub name: String,
    /// Ids of the two edges.
    pub edges: [String; 2],
    /// One a station of the first edge that has the second opposite.
    pub stations: Vec<GapStation>,
    /// Limits of the gap, mm.
    pub gap_limits_mm: Option<[f64; 2]>,
    /// Limits of the flush, mm.
    pub flush_limits_mm: Option<[f64; 2]>,
    /// Worst of the stations.
    pub verdict: Verdict,
    /// Why nothing was measured; empty otherwise.
    pub reason: String,
}

/// Gap and flush at a station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GapStation {
    /// Arc length on the first edge, mm.
    pub s_mm: f64,
    /// Distance of the two edges in the face.
    pub gap_mm: Quantified,
    /// Offset of the second edge along the normal of the face; plus = it stands out.
    pub flush_mm: Quantified,
    /// Gap and flush of the nominal, mm.
    pub nominal_mm: [f64; 2],
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
    /// The one flank that was seen, where only one was.
    pub boundary: Option<Boundary>,
    /// Points used on each flank.
    pub points: [usize; 2],
    /// Verdict of the station.
    pub verdict: Verdict,
    /// Why it was not measured or not decidable; empty otherwise.
    pub reason: String,
}

/// A station of which only one flank was seen: the edge is a boundary of the scan, and only its offset along that flank's normal is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Boundary {
    /// The flank that was seen: 0 or 1.
    pub flank: usize,
    /// The measured face at the nominal edge, mm, part frame.
    pub point: DVec3,
    /// Its deviation along the normal of the face, mm; plus = material outside the nominal.
    pub d_mm: Quantified,
    /// What its uncertainty is made of.
    pub budget: Budget,
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
    /// What `u_d_mm` is made of.
    pub budget_d: [Budget; 2],
    /// What `u_included_angle_rad` is made of.
    pub budget_angle: Budget,
    /// Covariance of d1 and d2, mm2, all contributions.
    pub covariance_d_mm2: f64,
    /// Distance of the measured edge from the nominal one across the tangent, mm.
    pub total_mm: Quantified,
    /// What the deviation of each flank was modelled by.
    pub flank_model: [FlankModel; 2],
    /// The highest place of the real profile along the bisector; `None` where the edge itself was not seen.
    pub ridge: Option<EdgePoint>,
    /// The edge at the depth asked for: on each flank the place at that distance from the virtual edge, its deviation from
    /// its own face; `None` without a depth, beyond the flank's reach, or inside the edge break.
    pub at_depth: [Option<DepthPoint>; 2],
}

/// Another point that stands for the edge at a station, beside the virtual edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgePoint {
    /// Where it lies, mm, part frame.
    pub point: DVec3,
    /// Its d1, d2, mm, and their standard uncertainties.
    pub d_mm: [Quantified; 2],
}

/// A place on a flank at a stated depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthPoint {
    /// Where it lies, mm, part frame.
    pub point: DVec3,
    /// Deviation from its face along the face's normal at the edge, mm.
    pub d_mm: Quantified,
}

/// A value with its standard uncertainty, both in the unit of the field's name.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quantified {
    /// The value.
    pub value: f64,
    /// Its standard uncertainty, all contributions.
    pub u: f64,
}

/// What a standard uncertainty is made of: its independent contributions, in the unit of the value.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Budget {
    /// The points: noise, correlated noise and lack of fit of the flanks.
    pub points: f64,
    /// The alignment: the same error of pose for all values of a part.
    pub alignment: f64,
    /// The calibration of the sensors: the same error for all parts.
    pub calibration: f64,
    /// Temperature: the uncertainty of the part's expansion.
    pub temperature: f64,
}

impl Budget {
    /// The standard uncertainty: root of the sum of squares (JCGM 100, 5.1.2).
    pub fn u(&self) -> f64 {
        let parts = [
            self.points,
            self.alignment,
            self.calibration,
            self.temperature,
        ];
        parts.iter().map(|u| u * u).sum::<f64>().sqrt()
    }
}

/// The real edge against the ideal sharp one, over a stretch of stations: what lies between the two flanks.
///
/// Source: features-and-standards, section 5, characteristics 6 to 12.
#[derive(Debug, Clone, PartialEq)]
pub struct EdgeBreak {
    /// First and last arc length of the stretch, mm.
    pub s_mm: [f64; 2],
    /// What the shape is, with the size that belongs to it.
    pub shape: BreakShape,
    /// Distance from the virtual edge to the place where each flank ends, mm.
    pub detachment_mm: [Quantified; 2],
    /// Distance from the virtual edge to the highest place of the real profile, mm.
    pub truncation_mm: Quantified,
    /// Largest excess outside the ideal sharp edge, mm; 0 where none is seen above its uncertainty.
    pub burr_mm: Quantified,
    /// Largest depth missing inside the ideal sharp edge, along the inward normal of each face, mm: for an edge that is meant to be broken the
    /// size of the break, in the sense of ISO 13715 an undercut where it is not.
    pub undercut_mm: [Quantified; 2],
    /// Points in the transition zone that were used.
    pub points: usize,
}

/// Shape of an edge break.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BreakShape {
    /// No break that the data can tell from a sharp edge: a radius would have to be below this, mm, with 95 % probability.
    Sharp {
        /// Upper bound of the radius.
        radius_below_mm: f64,
    },
    /// A cylinder tangent to both flanks.
    Round {
        /// Its radius, mm.
        radius_mm: Quantified,
    },
    /// A plane that cuts both flanks.
    Chamfer {
        /// Distances from the virtual edge along flank 1 and 2, mm.
        legs_mm: [Quantified; 2],
        /// Angle of the chamfer's plane to flank 1, rad.
        angle_rad: Quantified,
    },
    /// Broken, but the data do not tell a cylinder from a plane.
    Undecided {
        /// The radius if it is a cylinder, mm.
        radius_mm: Quantified,
        /// The legs if it is a plane, mm.
        legs_mm: [Quantified; 2],
    },
    /// Neither: a burr, an undercut, damage.
    Irregular,
}

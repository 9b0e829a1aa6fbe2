//! The wire types of `acies-report/1`, as JSON shows them. Their order here is the order of the keys.
//!
//! Lengths in mm, angles in degrees, positions and directions in the part frame. Uncertainties `u_...` are standard
//! uncertainties (one sigma). Keys may be added within a version; none is renamed, removed or given another unit.

use indexmap::IndexMap;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use super::because::{AdviceCode, Because, Judged, ReasonCode};
pub use crate::inspect::quantity::Quantity;

/// A position (mm) or a direction: x, y, z.
pub type Xyz = [f64; 3];

/// What an inspection found, in the form that leaves the program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(title = "acies-report/1")]
pub struct Report {
    /// Name and version of this contract.
    pub schema: Schema,
    /// Name of the part.
    pub part: String,
    /// Name of the nominal it was compared with.
    pub nominal: String,
    /// When the scan ended: RFC 3339, UTC.
    pub created: String,
    /// The program that measured.
    pub software: Software,
    /// True where the instruments were simulated.
    pub simulated: bool,
    /// Seed of the simulation, where there was one.
    pub seed: Option<u64>,
    /// The answer for the part: the worst of edges, alignment and missing edges.
    pub verdict: Status,
    /// Why the verdict is what it is, in one sentence.
    pub reason: String,
    /// What to do next, in one sentence.
    pub advice: String,
    /// Reason and advice in parts, for programs and other languages; not in a report that was written before this key was added.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub because: Option<Because>,
    /// What the values were judged by.
    pub recipe: Recipe,
    /// What the scan is like.
    pub scan: Scan,
    /// The instruments that took part.
    pub devices: Vec<Device>,
    /// How the scan lies in the part frame.
    pub alignment: Alignment,
    /// How the uncertainties were propagated.
    pub uncertainty: Uncertainty,
    /// One for every sharp edge of the nominal.
    pub edges: Vec<Edge>,
    /// Where three faces or more meet.
    pub corners: Vec<Corner>,
    /// Gap and flush between edges, as the recipe asks.
    pub gaps: Vec<Gap>,
    /// Edges found where the nominal has none: polylines.
    pub unexpected_edges: Vec<Vec<Xyz>>,
    /// Ids of the nominal edges that were not found although the data are adequate.
    pub missing_edges: Vec<String>,
    /// What was wrong with the data; the result went on.
    pub findings: Vec<String>,
    /// Seconds by stage, in order of the work.
    pub seconds: IndexMap<String, f64>,
}

/// How uncertainties were propagated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Uncertainty {
    /// Of all values but the ridge, the edge at depth, the means of edges and boundaries, which are of first order.
    pub method: UncertaintyMethod,
    /// Fewest and most trials of a station; null for first order.
    pub trials: Option<[usize; 2]>,
    /// Most trials of an edge break.
    pub break_trials: Option<usize>,
    /// Trials of form, corners and gaps.
    pub derived_trials: Option<usize>,
    /// Seed of the trials.
    pub seed: Option<u64>,
    /// Stations whose values did not stand still to two digits of u when the trials ended.
    pub unstable_stations: Option<usize>,
}

/// How uncertainties were propagated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum UncertaintyMethod {
    /// By first derivatives (JCGM 100).
    FirstOrder,
    /// By trials (JCGM 101).
    MonteCarlo,
}

/// Name and version of the contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Schema {
    /// The first.
    #[serde(rename = "acies-report/1")]
    V1,
}

/// The answer for a value, a station, an edge or the part. The worst rules upward.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    JsonSchema,
    utoipa::ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// Not evaluated: no limits, or not measured.
    Undefined,
    /// Within the limits.
    Ok,
    /// A limit lies inside the uncertainty zone, or data or alignment are inadequate.
    NotDecidable,
    /// Outside the limits.
    NotOk,
}

/// The program that measured.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Software {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
}

/// What the values were judged by. The limits themselves stand beside each characteristic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Recipe {
    /// SHA-256 of the recipe's text, hexadecimal; empty where no file was read.
    pub sha256: String,
    /// How the uncertainty of a value counts against a limit.
    pub rule: Rule,
    /// Half the width of the uncertainty zone in standard uncertainties; null for the simple rule.
    pub guard_band_k: Option<f64>,
    /// Probability that conformity or its contrary must have; null for the other rules.
    pub conformance_probability: Option<f64>,
    /// Limits of every edge for which the recipe says nothing else.
    pub limits: Limits,
    /// Whether tolerances of the nominal's PMI count as limits; each characteristic says where its own come from.
    pub limits_from_pmi: bool,
    /// Share of an edge that must be measured for it to be decidable, 0 to 1.
    pub minimum_coverage: Option<f64>,
    /// Standard uncertainty of d1 and d2 from the calibration of the sensors, part of every u_d.
    pub u_calibration_mm: Option<f64>,
    /// Standard uncertainty of the included angle from the calibration of the sensors.
    pub u_calibration_deg: Option<f64>,
}

/// How the uncertainty of a value counts against a limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// The value alone decides.
    Simple,
    /// A limit inside the uncertainty zone leaves the value undecided.
    GuardBand,
    /// Conformity, or non-conformity, must be as probable as stated (in the manner of ISO 14253-1).
    Conformance,
}

/// Lower and upper limits; null = not evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Limits {
    /// Of d1.
    pub d1_mm: Option<[f64; 2]>,
    /// Of d2.
    pub d2_mm: Option<[f64; 2]>,
    /// Of the included angle minus the nominal one.
    pub angle_deviation_deg: Option<[f64; 2]>,
}

/// What the scan is like.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Scan {
    /// Points measured.
    pub points: usize,
    /// Median distance to the nearest neighbour.
    pub spacing_mm: Option<f64>,
    /// Typical distance of neighbours on one laser line.
    pub spacing_along_line_mm: Option<f64>,
    /// Typical distance of neighbouring laser lines.
    pub spacing_across_lines_mm: Option<f64>,
    /// Standard deviation of the points about the surface.
    pub noise_mm: Option<f64>,
    /// Lost on the way, all devices together.
    pub losses: Losses,
}

/// What was lost on the way from the instruments.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Losses {
    /// Profiles received whole.
    pub received: u64,
    /// Profiles missing by sequence number.
    pub lost_on_link: u64,
    /// Profiles the device dropped by its own count.
    pub dropped_by_device: u64,
    /// Frames or lines thrown away because a check failed.
    pub rejected: u64,
    /// Bytes thrown away in search of the next frame.
    pub skipped_bytes: u64,
}

/// One instrument, as it named itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Device {
    /// Its name in the cell's configuration.
    pub name: String,
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Serial number; empty where it has none.
    pub serial: String,
    /// Firmware.
    pub firmware: String,
    /// Null for an instrument that answers or fails, as a probe does.
    pub losses: Option<Losses>,
}

/// How the scan lies in the part frame, and how well that is known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Alignment {
    /// Homogeneous matrix, row-major; null where no pose was found.
    pub part_from_machine: Option<[[f64; 4]; 4]>,
    /// Root mean square of the residuals.
    pub rms_mm: Option<f64>,
    /// Points used.
    pub points: usize,
    /// Covariance of (rotation vector in rad, translation in mm) about the part's origin, row-major; null where unknown.
    pub covariance: Option<[[f64; 6]; 6]>,
    /// Directions of motion that the data hold only weakly.
    pub weak_directions: Vec<String>,
    /// Ok, or not decidable.
    pub status: Status,
    /// How the pose was found.
    pub method: AlignmentMethod,
    /// STEP entities of the faces of the best fit; empty = all.
    pub faces: Vec<u64>,
    /// The datum features that the pose rests on; empty for another method.
    pub datums: Vec<Datum>,
    /// What the datums leave free: there the pose is that of the best fit.
    pub free_of_datums: Vec<String>,
}

/// How a pose was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AlignmentMethod {
    /// The scan was taken as lying in the part frame.
    AsGiven,
    /// Least squares over the faces.
    BestFit,
    /// On datum features.
    Datums,
}

/// A datum feature as measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Datum {
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
    /// How far it lies off its nominal place at the pose.
    pub residual_mm: Option<f64>,
    /// And off its nominal direction; null where it has none.
    pub residual_deg: Option<f64>,
    /// Standard uncertainty of its place.
    pub u_mm: Option<f64>,
    /// Standard deviation of its points about it: noise and form.
    pub form_mm: Option<f64>,
}

/// What a datum feature holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
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

/// Convex or concave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Included angle below 180 degrees.
    Convex,
    /// Included angle above 180 degrees.
    Concave,
}

/// One nominal edge as measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Edge {
    /// Its name: `e1`, `e2` ... or the recipe's.
    pub id: String,
    /// Number of its entity in the STEP file.
    pub nominal_entity: u64,
    /// Convex or concave.
    pub kind: Kind,
    /// Nominal length.
    pub length_mm: Option<f64>,
    /// Share of the length that was measured, 0 to 1.
    pub coverage: f64,
    /// Share of the length of which only one flank was seen, 0 to 1.
    pub boundary_share: Option<f64>,
    /// In order of arc length.
    pub stations: Vec<Station>,
    /// The shape of the edge itself, one a stretch of stations; empty where it was not seen.
    pub breaks: Vec<Break>,
    /// The edge as a curve; null where fewer than four stations were measured.
    pub form: Option<Form>,
    /// The measured stations in a few numbers.
    pub summary: Summary,
    /// The values that have a verdict.
    pub characteristics: Vec<Characteristic>,
    /// Worst of the stations and the coverage.
    pub verdict: Status,
}

/// One place along a nominal edge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Station {
    /// Arc length from the start of the edge.
    pub s_mm: f64,
    /// The nominal place.
    pub nominal: Xyz,
    /// Unit tangent along the edge.
    pub tangent: Xyz,
    /// Outward unit normal of the first face.
    pub n1: Xyz,
    /// Outward unit normal of the second face.
    pub n2: Xyz,
    /// Nominal included angle through the material.
    pub nominal_included_angle_deg: f64,
    /// The virtual edge: where the two fitted flanks meet. Null = not measured.
    pub measured: Option<Xyz>,
    /// Deviation along n1; plus = material outside the nominal.
    pub d1_mm: Option<f64>,
    /// Deviation along n2.
    pub d2_mm: Option<f64>,
    /// Standard uncertainty of d1.
    pub u_d1_mm: Option<f64>,
    /// Standard uncertainty of d2.
    pub u_d2_mm: Option<f64>,
    /// Angle between the fitted flanks, through the material.
    pub included_angle_deg: Option<f64>,
    /// Its standard uncertainty.
    pub u_included_angle_deg: Option<f64>,
    /// Distance of the measured edge from the nominal one across the tangent, and its standard uncertainty.
    pub total_mm: Option<Value>,
    /// The one flank that was seen, where only one was; then d1, d2 and the rest are null. Null elsewhere.
    pub boundary: Option<Boundary>,
    /// What the deviation of each flank was modelled by.
    pub flank_models: Option<[FlankModel; 2]>,
    /// The highest place of the real profile along the bisector; null where the edge itself was not seen.
    pub ridge: Option<EdgePoint>,
    /// On each flank the place at the depth that the recipe asks for; null without one or where it was not seen.
    pub at_depth: [Option<DepthPoint>; 2],
    /// Residual standard deviation of the fit to the first flank.
    pub residual_1_mm: Option<f64>,
    /// Residual standard deviation of the fit to the second flank.
    pub residual_2_mm: Option<f64>,
    /// What u_d1, u_d2 and u_included_angle are made of; only where it was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<[Budget; 3]>,
    /// Points used on the first flank.
    pub points_1: usize,
    /// Points used on the second flank.
    pub points_2: usize,
    /// Verdict of the station.
    pub status: Status,
    /// Why it was not measured or not decidable; empty otherwise.
    pub reason: String,
}

/// The measured stations of an edge in a few numbers; null where nothing was measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Summary {
    /// Stations placed on the edge.
    pub stations: usize,
    /// Stations measured.
    pub measured: usize,
    /// Stations measured as a share of those placed, 0 to 1.
    pub measured_share: f64,
    /// Deviation along n1, mm.
    pub d1_mm: Option<Spread>,
    /// Deviation along n2, mm.
    pub d2_mm: Option<Spread>,
    /// Included angle minus the nominal one, degrees.
    pub angle_deviation_deg: Option<Spread>,
}

/// How a value runs along an edge.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Spread {
    /// The value nearest to a limit or farthest outside; without limits the one farthest from zero.
    pub worst: f64,
    /// Its standard uncertainty.
    pub u_worst: Option<f64>,
    /// Where it is: arc length.
    pub s_worst_mm: f64,
    /// Mean of the measured stations.
    pub mean: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Standard deviation over the stations.
    pub standard_deviation: Option<f64>,
    /// Root mean square.
    pub rms: Option<f64>,
    /// 2.5 per cent of the values lie below.
    pub percentile_2_5: Option<f64>,
    /// 97.5 per cent of the values lie below.
    pub percentile_97_5: Option<f64>,
    /// Share of the values outside the limits, 0 to 1; null without limits.
    pub outside_share: Option<f64>,
}

/// What the deviation of a flank from its nominal face is modelled by, chosen from the data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FlankModel {
    /// The nominal face displaced: offset, tilt across and slope along the edge.
    Displaced,
    /// A bend across the edge as well.
    Bent,
    /// Bend, twist and bow, all of the second order.
    Quadric,
}

/// A station of which one flank was seen: a boundary of the scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Boundary {
    /// The flank that was seen: 1 or 2.
    pub flank: usize,
    /// Where its face lies at the nominal edge.
    pub point: Xyz,
    /// Its deviation along the normal of its face; judged as d1 or d2.
    pub d_mm: Value,
    /// What its uncertainty is made of; only where it was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<Budget>,
}

/// Another point that stands for the edge at a station.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EdgePoint {
    /// Where it lies.
    pub point: Xyz,
    /// Its d1.
    pub d1_mm: Value,
    /// Its d2.
    pub d2_mm: Value,
}

/// A place on a flank at a stated depth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DepthPoint {
    /// Where it lies.
    pub point: Xyz,
    /// Its deviation along the normal of its face.
    pub d_mm: Value,
}

/// What a standard uncertainty is made of, in the unit of its value; the parts add in squares.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Budget {
    /// The points: noise, correlated noise, lack of fit.
    pub points: Option<f64>,
    /// The alignment, the same error for all values of the part.
    pub alignment: Option<f64>,
    /// The calibration of the sensors, the same error for all parts.
    pub calibration: Option<f64>,
    /// The temperature of the part.
    pub temperature: Option<f64>,
}

/// A value with its standard uncertainty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Value {
    /// The value; null where it is no number.
    pub value: Option<f64>,
    /// Its standard uncertainty.
    pub u: Option<f64>,
}

/// The real edge against the ideal sharp one, over a stretch of stations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Break {
    /// First and last arc length.
    pub s_mm: [f64; 2],
    /// What the shape is.
    pub shape: Shape,
    /// Radius of a round edge.
    pub radius_mm: Option<Value>,
    /// Where the edge is sharp as far as the data tell: a radius would be below this with 95 % probability.
    pub radius_below_mm: Option<f64>,
    /// Legs of a chamfer along the first and the second flank.
    pub chamfer_legs_mm: Option<[Value; 2]>,
    /// Angle of a chamfer to the first flank.
    pub chamfer_angle_deg: Option<Value>,
    /// Distance from the virtual edge to where each flank ends.
    pub detachment_mm: [Value; 2],
    /// Distance from the virtual edge to the highest place of the real profile.
    pub truncation_mm: Value,
    /// Largest excess outside the ideal sharp edge.
    pub burr_mm: Value,
    /// Largest depth missing inside it, along each normal.
    pub undercut_mm: [Value; 2],
    /// Points used.
    pub points: usize,
}

/// The shape of an edge break.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Shape {
    /// No break that the data can tell.
    Sharp,
    /// Tangent to both flanks.
    Round,
    /// A plane across both flanks.
    Chamfer,
    /// Broken, and the data do not tell round from chamfer: radius and legs are given, of which one applies.
    Undecided,
    /// Neither.
    Irregular,
}

/// The measured edge as a curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Form {
    /// Diameter of the smallest cylinder around a straight edge; null for a curved one.
    pub straightness_mm: Option<Value>,
    /// Twice the largest distance from the nominal edge where the alignment puts it.
    pub line_profile_mm: Value,
    /// Arc length of that place.
    pub s_worst_mm: Option<f64>,
    /// The same with the edge moved to where it fits best.
    pub line_form_mm: Option<Value>,
    /// Largest angle to the nominal tangent.
    pub direction_deg: Option<Value>,
}

/// Where three faces or more meet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Corner {
    /// `c1`, `c2` ...
    pub id: String,
    /// Nominal place.
    pub nominal: Xyz,
    /// STEP entities of its faces.
    pub faces: Vec<u64>,
    /// Ids of the edges that end in it.
    pub edges: Vec<String>,
    /// Intersection of the measured flanks; null = not measured.
    pub measured: Option<Xyz>,
    /// Its distance from the nominal place.
    pub total_mm: Option<f64>,
    /// Standard uncertainty of that distance.
    pub u_total_mm: Option<f64>,
    /// Root mean square of what the faces beyond three leave.
    pub residual_mm: Option<f64>,
    /// Largest distance allowed; null = not evaluated.
    pub upper_mm: Option<f64>,
    /// Against that limit.
    pub verdict: Status,
    /// Why it was not measured; empty otherwise.
    pub reason: String,
}

/// Gap and flush between two edges.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Gap {
    /// The recipe's name.
    pub name: String,
    /// Ids of the two edges.
    pub edges: [String; 2],
    /// Limits of the gap.
    pub gap_limits_mm: Option<[f64; 2]>,
    /// Limits of the flush.
    pub flush_limits_mm: Option<[f64; 2]>,
    /// In order of arc length on the first edge.
    pub stations: Vec<GapStation>,
    /// Worst of the stations.
    pub verdict: Status,
    /// Why nothing was measured; empty otherwise.
    pub reason: String,
}

/// Gap and flush at one station.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GapStation {
    /// Arc length on the first edge.
    pub s_mm: f64,
    /// Distance of the edges in the face beside the gap.
    pub gap_mm: Option<f64>,
    /// Its standard uncertainty.
    pub u_gap_mm: Option<f64>,
    /// The nominal gap.
    pub nominal_gap_mm: Option<f64>,
    /// Offset of the second edge along the normal of that face.
    pub flush_mm: Option<f64>,
    /// Its standard uncertainty.
    pub u_flush_mm: Option<f64>,
    /// The nominal flush.
    pub nominal_flush_mm: Option<f64>,
}

/// A value of an edge with its limits and its verdict.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Characteristic {
    /// Edge and quantity: `e1.d1`.
    pub id: String,
    /// What is compared.
    pub quantity: Quantity,
    /// `mm` or `deg`.
    pub unit: String,
    /// The worst station's value; null = not measured.
    pub value: Option<f64>,
    /// Its standard uncertainty.
    pub u: Option<f64>,
    /// Where: arc length.
    pub s_mm: Option<f64>,
    /// Lower limit; null = none on this side.
    pub lower: Option<f64>,
    /// Upper limit; null = none on this side.
    pub upper: Option<f64>,
    /// Where the limits come from: `recipe`, or the entity `#n` of the nominal's PMI; null without limits.
    pub limits_from: Option<String>,
    /// Probability that the value conforms; null where the rule asks for none.
    pub conformance: Option<f64>,
    /// Worst verdict of all its values.
    pub verdict: Status,
    /// Why it has no value, or why it is not decidable; empty otherwise.
    pub reason: String,
    /// What u is made of; null where it is not known apart.
    pub budget: Option<Budget>,
}

impl Report {
    /// The report as one indented JSON object: the same report gives the same text.
    pub fn to_json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self)
            .expect("the wire types have string keys and no failing serialiser");
        text.push('\n');
        text
    }

    /// The JSON Schema of `acies-report/1`, generated from these types.
    pub fn json_schema() -> serde_json::Value {
        schemars::schema_for!(Report).to_value()
    }
}

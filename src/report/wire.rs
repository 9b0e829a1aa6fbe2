//! The wire types of `acies-report/1`, as JSON shows them. Their order here is the order of the keys.
//!
//! Lengths in mm, angles in degrees, positions and directions in the part frame. Uncertainties `u_...` are standard
//! uncertainties (one sigma). Keys may be added within a version; none is renamed, removed or given another unit.

use indexmap::IndexMap;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

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
    /// What the values were judged by.
    pub recipe: Recipe,
    /// What the scan is like.
    pub scan: Scan,
    /// The instruments that took part.
    pub devices: Vec<Device>,
    /// How the scan lies in the part frame.
    pub alignment: Alignment,
    /// One for every sharp edge of the nominal.
    pub edges: Vec<Edge>,
    /// Edges found where the nominal has none: polylines.
    pub unexpected_edges: Vec<Vec<Xyz>>,
    /// Ids of the nominal edges that were not found although the data are adequate.
    pub missing_edges: Vec<String>,
    /// What was wrong with the data; the result went on.
    pub findings: Vec<String>,
    /// Seconds by stage, in order of the work.
    pub seconds: IndexMap<String, f64>,
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
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
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
    /// How the uncertainty of a value counts against a limit.
    pub rule: Rule,
    /// Half the width of the uncertainty zone in standard uncertainties; null for the simple rule.
    pub guard_band_k: Option<f64>,
    /// Limits of every edge for which the recipe says nothing else.
    pub limits: Limits,
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
    /// In order of arc length.
    pub stations: Vec<Station>,
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
    /// Residual standard deviation of the fit to the first flank.
    pub residual_1_mm: Option<f64>,
    /// Residual standard deviation of the fit to the second flank.
    pub residual_2_mm: Option<f64>,
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
    /// Lower limit; null = not evaluated.
    pub lower: Option<f64>,
    /// Upper limit; null = not evaluated.
    pub upper: Option<f64>,
    /// Worst verdict of all measured stations.
    pub verdict: Status,
}

/// What a characteristic compares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Deviation along n1.
    D1,
    /// Deviation along n2.
    D2,
    /// Included angle minus the nominal one.
    AngleDeviation,
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

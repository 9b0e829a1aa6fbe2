//! Alignment of a scan to the nominal, measurement of every sharp edge, uncertainty, verdict.
//!
//! The way through: [`align()`] finds the pose, [`assign`] the nominal face of every point, [`flank`] measures the deviation of
//! each flank at every station, [`virtual_edge`] intersects them, [`verdict`] compares with the limits of the [`recipe`].

pub mod align;
pub mod assign;
pub mod body;
mod clusters;
mod collect;
pub mod compare;
mod contributions;
mod edge_break;
pub mod flank;
pub mod measure;
pub mod monte_carlo;
pub mod recipe;
pub mod result;
pub mod verdict;
pub mod virtual_edge;

use std::time::Instant;

pub use align::{AlignOptions, Start, Touch};
pub use body::Body;
pub use recipe::Recipe;
pub use result::Inspection;

use align::{Aligned, Scan, align};
use assign::Surface;
use body::BodyEdge;
use measure::{MeasureSettings, MeasuredEdge, measure_edges};
use result::{EdgeResult, ScanEstimate, StationResult, Verdict};

use crate::features::{self, Method};
use crate::points::{Frame, Neighbors, PointCloud, noise_mm, spacing};

/// Share of the part's half-diagonal beyond which a point belongs to something else.
const GATE: f64 = 0.1;

/// What is asked of an inspection.
pub struct Request<'a> {
    /// Limits, rule, datums, calibration.
    pub recipe: &'a Recipe,
    /// What is known of the pose.
    pub start: Start,
    /// Contacts of a probe with the part, in the frame of the scan.
    pub touches: &'a [Touch],
    /// Told the name of every stage as it begins.
    pub progress: &'a (dyn Fn(&'static str) + Sync),
}

impl<'a> Request<'a> {
    /// A request without touches and without anyone to tell.
    pub fn new(recipe: &'a Recipe, start: Start) -> Self {
        Self {
            recipe,
            start,
            touches: &[],
            progress: &|_| {},
        }
    }
}

/// Inspects `cloud` against `nominal`. Bad data are findings of the result: there is no error.
pub fn inspect<B: Body>(cloud: &PointCloud, nominal: &B, request: &Request<'_>) -> Inspection {
    let mut stages = Stages::new(request.progress);
    stages.begin("spacing and noise");
    let neighbors = Neighbors::new(&cloud.positions);
    let spacing = spacing(cloud, &neighbors);
    let scan = Scan {
        cloud,
        neighbors: &neighbors,
        spacing,
        noise_mm: noise_mm(cloud, &neighbors, &spacing),
    };
    stages.begin("alignment");
    let surface = Surface::new(nominal);
    let mut findings = Vec::new();
    let datums = datum_faces(nominal, &request.recipe.datum_faces, &mut findings);
    let options = AlignOptions {
        datum_faces: &datums,
        touches: request.touches,
    };
    let Aligned {
        alignment,
        findings: of_alignment,
    } = align(&scan, &surface, request.start, &options);
    findings.extend(of_alignment);

    stages.begin("faces of the points");
    let pose = alignment.part_from_machine;
    let part = cloud.map(Frame::Part, |p| pose.point(p), |v| pose.vector(v));
    let [low, high] = nominal.bounds();
    let places = surface.places(&part, GATE * 0.5 * (high - low).length());
    stages.begin("edges");
    let settings = MeasureSettings {
        along_mm: scan.spacing.along_mm,
        across_mm: scan.spacing.across_mm,
        noise_mm: scan.noise_mm,
        station_step_mm: request.recipe.station_step_mm,
        pose_covariance: alignment.covariance,
        u_calibration_mm: request.recipe.u_calibration_mm,
        u_calibration_rad: request.recipe.u_calibration_rad,
        flank_mm: None,
        depth_mm: None,
        expansion: None,
    };
    let measured = measure_edges(&part, &places, &surface, &settings);
    stages.begin("comparison of edges found");
    let detection = features::detect(cloud, &neighbors, Method::Adaptive);
    let edges = nominal.edges();
    let compared = compare::compare(&part, &detection, nominal, (&edges, &measured));

    let results: Vec<EdgeResult> = edges
        .iter()
        .zip(measured)
        .map(|(edge, measured)| {
            findings.extend(measured.remarks.iter().cloned());
            judged(edge, measured, request.recipe)
        })
        .collect();
    report_unknown_edges(&edges, request.recipe, &mut findings);
    let verdict = verdict::judge_part(results.iter().map(|e| e.verdict), alignment.status);
    Inspection {
        alignment,
        edges: results,
        unexpected_edges: compared.unexpected,
        missing_edges: compared.missing,
        verdict,
        seconds: stages.end(),
        findings,
        scan: Some(ScanEstimate {
            spacing: scan.spacing,
            noise_mm: scan.noise_mm,
            classes: detection.classes,
        }),
    }
}

/// Indices of the faces with these entities; an entity that is no face becomes a finding.
fn datum_faces<B: Body>(nominal: &B, entities: &[u64], findings: &mut Vec<String>) -> Vec<u32> {
    let mut faces = Vec::new();
    for entity in entities {
        let found = (0..nominal.face_count() as u32).find(|f| nominal.face_entity(*f) == *entity);
        match found {
            Some(face) => faces.push(face),
            None => findings.push(format!(
                "recipe: datum_faces: #{entity} is no face of the nominal, expected the entity of a face; the datum is left out"
            )),
        }
    }
    faces
}

fn report_unknown_edges(edges: &[BodyEdge], recipe: &Recipe, findings: &mut Vec<String>) {
    for entry in &recipe.edges {
        let known = edges
            .iter()
            .any(|edge| recipe.edge(&edge.id, edge.entity) == Some(entry));
        if !known {
            findings.push(format!(
                "recipe: edge: {} is no sharp edge of the nominal, expected its entity or id; the entry is left out",
                match &entry.key {
                    recipe::EdgeKey::Entity(entity) => format!("#{entity}"),
                    recipe::EdgeKey::Id(id) => format!("{id:?}"),
                }
            ));
        }
    }
}

fn judged(edge: &BodyEdge, measured: MeasuredEdge, recipe: &Recipe) -> EdgeResult {
    let limits = recipe.limits(&edge.id, edge.entity);
    let total = measured.stations.len().max(1);
    let stations: Vec<StationResult> = measured
        .stations
        .into_iter()
        .map(|s| {
            let (measured, verdict, reason) = match s.outcome {
                Ok(m) => {
                    let nominal = virtual_edge::nominal_angle(&s.station, edge.kind);
                    let (verdict, reason) =
                        verdict::judge_station(&m, nominal, &limits, recipe.rule);
                    (Some(m), verdict, reason)
                }
                // The edge as a whole answers for what is missing, by its coverage.
                Err(reason) => (None, Verdict::Undefined, reason),
            };
            StationResult {
                station: s.station,
                measured,
                points: s.points,
                verdict,
                reason,
            }
        })
        .collect();
    let coverage = stations.iter().filter(|s| s.measured.is_some()).count() as f64 / total as f64;
    let verdict = verdict::judge_edge(
        stations.iter().map(|s| s.verdict),
        coverage,
        recipe.minimum_coverage,
        &limits,
    );
    let name = recipe
        .edge(&edge.id, edge.entity)
        .and_then(|e| e.name.clone());
    EdgeResult {
        id: name.unwrap_or_else(|| edge.id.clone()),
        nominal_entity: edge.entity,
        kind: edge.kind,
        length_mm: edge.length_mm,
        coverage,
        stations,
        breaks: measured.breaks,
        mean: measured.mean,
        verdict,
    }
}

/// Seconds by stage.
struct Stages<'a> {
    tell: &'a (dyn Fn(&'static str) + Sync),
    done: Vec<(&'static str, f64)>,
    current: Option<(&'static str, Instant)>,
}

impl<'a> Stages<'a> {
    fn new(tell: &'a (dyn Fn(&'static str) + Sync)) -> Self {
        Self {
            tell,
            done: Vec::new(),
            current: None,
        }
    }

    fn begin(&mut self, name: &'static str) {
        self.close();
        (self.tell)(name);
        self.current = Some((name, Instant::now()));
    }

    fn close(&mut self) {
        if let Some((name, since)) = self.current.take() {
            self.done.push((name, since.elapsed().as_secs_f64()));
        }
    }

    fn end(mut self) -> Vec<(&'static str, f64)> {
        self.close();
        self.done
    }
}

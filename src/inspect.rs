//! Alignment of a scan to the nominal, measurement of every sharp edge, uncertainty, verdict.
//!
//! The way through: [`align()`] finds the pose, [`assign`] the nominal face of every point, [`flank`] measures the deviation of
//! each flank at every station, [`virtual_edge`] intersects them, [`verdict`] compares with the limits of the [`recipe`].

pub mod align;
pub mod assign;
mod attention;
pub mod body;
pub mod characteristic;
mod clusters;
mod collect;
pub mod compare;
mod contributions;
pub mod corner;
pub mod datums;
mod edge_break;
pub mod flank;
pub mod form;
mod from_pmi;
pub mod gap;
mod growing;
pub mod measure;
mod measuring;
pub mod monte_carlo;
pub mod quantity;
pub mod recipe;
pub mod result;
pub mod verdict;
pub mod virtual_edge;

use std::time::Instant;

use glam::DVec3;

pub use align::{AlignOptions, Start, Touch};
pub use assign::{Sampled, Surface};
pub use body::Body;
pub use growing::{EdgeSoFar, Growing};
pub use monte_carlo::MonteCarlo;
pub use recipe::Recipe;
pub use result::Inspection;

use align::{Aligned, DatumFeature, Scan, align};
use attention::{Outline, Patches};
use body::BodyEdge;
use characteristic::{EdgeValues, at_station, characteristics};
use compare::Scanned;
use corner::CornerSettings;
use measure::{MeasureSettings, MeasuredEdge, measure_edges_stepped};
use monte_carlo::{Derivation, StationTrials, Trials, measure_edges_drawn};
use quantity::{Extent, Limits, Quantity};
use recipe::{EdgeFacts, EdgeKey, GapRecipe, Resolved};
use result::{Alignment, EdgeResult, GapResult, ScanEstimate, StationResult, Verdict};
use verdict::judge;

use crate::points::{Frame, Neighbors, PointCloud, Spacing, noise_mm, spacing};

/// Share of the part's half-diagonal beyond which a point belongs to something else.
const GATE: f64 = 0.1;

/// What is asked of an inspection.
pub struct Request<'a> {
    /// Limits, rule, datums, calibration.
    pub recipe: &'a Recipe,
    /// What is known of the pose.
    pub start: Start,
    /// Temperature of the part, degrees Celsius; `None` = nobody says.
    pub temperature_c: Option<f64>,
    /// Contacts of a probe with the part, in the frame of the scan.
    pub touches: &'a [Touch],
    /// How uncertainties are propagated.
    pub uncertainty: Uncertainty,
    /// Told the name of every stage as it begins.
    pub progress: &'a (dyn Fn(&'static str) + Sync),
    /// Told how many edges of how many have had their trials.
    pub trials_done: &'a (dyn Fn(usize, usize) + Sync),
}

/// How uncertainties are propagated.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Uncertainty {
    /// By first derivatives (JCGM 100).
    #[default]
    FirstOrder,
    /// By trials (JCGM 101): all but the ridge, the edge at depth, the means of edges and boundaries, which are of first order.
    MonteCarlo(MonteCarlo),
}

impl<'a> Request<'a> {
    /// A request without touches and without anyone to tell.
    pub fn new(recipe: &'a Recipe, start: Start) -> Self {
        Self {
            recipe,
            start,
            temperature_c: None,
            touches: &[],
            uncertainty: Uncertainty::FirstOrder,
            progress: &|_| {},
            trials_done: &|_, _| {},
        }
    }
}

/// Inspects `cloud` against `nominal`. Bad data are findings of the result: there is no error.
pub fn inspect<B: Body>(cloud: &PointCloud, nominal: &B, request: &Request<'_>) -> Inspection {
    inspect_on(cloud, &Surface::new(nominal), request)
}

/// As [`inspect`], of a nominal that has been sampled already.
pub fn inspect_on<B: Body>(
    cloud: &PointCloud,
    surface: &Surface<'_, B>,
    request: &Request<'_>,
) -> Inspection {
    let nominal = surface.body;
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
    let mut findings = Vec::new();
    let datums = Datums::of(nominal, request.recipe, &mut findings);
    let options = datums.options(request);
    let Aligned {
        mut alignment,
        findings: of_alignment,
        ..
    } = align(&scan, surface, request.start, &options);
    findings.extend(of_alignment);
    if datums.unknown {
        alignment.status = Verdict::NotDecidable;
    }

    stages.begin("faces of the points");
    let pose = alignment.part_from_machine;
    let part = cloud.map(Frame::Part, |p| pose.point(p), |v| pose.vector(v));
    let [low, high] = nominal.bounds();
    let places = surface.places(&part, GATE * 0.5 * (high - low).length());
    stages.begin("edges");
    let settings = MeasureSettings {
        pose_covariance: alignment.covariance,
        ..measure_settings(&scan.spacing, scan.noise_mm, request, &mut findings)
    };
    let facts = all_edge_facts(nominal);
    let (resolved, of_recipe) = resolve(nominal, &facts, request.recipe);
    findings.extend(of_recipe);
    let steps: Vec<Option<f64>> = resolved.iter().map(|r| r.station_step_mm).collect();
    let (measured, trials) = match &request.uncertainty {
        Uncertainty::FirstOrder => {
            let edges = measure_edges_stepped(&part, &places, surface, &settings, &steps);
            (edges, None)
        }
        Uncertainty::MonteCarlo(how) => {
            let given = (&settings, &steps[..]);
            let told = request.trials_done;
            let (edges, trials, kept) =
                measure_edges_drawn(&part, &places, surface, given, how, told);
            (edges, Some((trials, kept)))
        }
    };
    stages.begin("comparison of edges found");
    let edges = nominal.edges();
    let outline = Outline::new(nominal, &edges, compare::near_mm(&scan.spacing));
    let mut patches = Patches::default();
    patches.add(&part.positions, &places, &outline);
    let scanned = Scanned {
        clouds: &[(&part, None)],
        patches: &patches,
        outline: &outline,
        spacing: scan.spacing,
        noise_mm: scan.noise_mm,
    };
    let found = compare::look(&scanned);
    let compared = compare::compare(&scanned, found, (&edges, &measured));
    let taken = Taken {
        alignment,
        findings,
        measured,
        compared,
        trials,
        estimate: ScanEstimate {
            spacing: scan.spacing,
            noise_mm: scan.noise_mm,
        },
    };
    judge_all(nominal, request, (&edges, &resolved), taken, stages)
}

/// What the recipe says that the pose rests on.
struct Datums {
    faces: Vec<u32>,
    features: Vec<DatumFeature>,
    /// Whether a feature that is asked for is not in the nominal.
    unknown: bool,
}

impl Datums {
    fn of<B: Body>(nominal: &B, recipe: &Recipe, findings: &mut Vec<String>) -> Self {
        let faces = datum_faces(nominal, &recipe.datum_faces, findings);
        let (features, unknown) = datums::datum_features(nominal, &recipe.datums);
        findings.extend(unknown.iter().map(|datum| {
            format!(
                "recipe: alignment: datum {:?}: {}, expected {}; nothing is decided without it",
                datum.name, datum.found, datum.expected
            )
        }));
        Self {
            faces,
            features,
            unknown: !unknown.is_empty(),
        }
    }

    fn options<'a>(&'a self, request: &Request<'a>) -> AlignOptions<'a> {
        AlignOptions {
            datum_faces: &self.faces,
            datums: if self.unknown { &[] } else { &self.features },
            touches: request.touches,
            held: request.recipe.held,
            ..AlignOptions::default()
        }
    }
}

/// What is measured with, but for the covariance of the pose.
fn measure_settings(
    spacing: &Spacing,
    noise_mm: f64,
    request: &Request<'_>,
    findings: &mut Vec<String>,
) -> MeasureSettings {
    let recipe = request.recipe;
    MeasureSettings {
        along_mm: spacing.along_mm,
        across_mm: spacing.across_mm,
        noise_mm,
        station_step_mm: recipe.station_step_mm,
        pose_covariance: [[0.0; 6]; 6],
        u_calibration_mm: recipe.u_calibration_mm,
        u_calibration_rad: recipe.u_calibration_rad,
        flank_mm: recipe.flank_mm,
        depth_mm: recipe.depth_mm,
        expansion: expansion(request, findings),
    }
}

/// What was measured of a part, not judged yet.
struct Taken {
    alignment: Alignment,
    findings: Vec<String>,
    measured: Vec<MeasuredEdge>,
    compared: compare::Compared,
    trials: Option<(Trials, StationTrials)>,
    estimate: ScanEstimate,
}

/// Compares what was measured with the limits of the recipe.
fn judge_all<B: Body>(
    nominal: &B,
    request: &Request<'_>,
    (edges, resolved): (&[BodyEdge], &[Resolved]),
    taken: Taken,
    stages: Stages<'_>,
) -> Inspection {
    let Taken {
        alignment,
        mut findings,
        measured,
        compared,
        trials,
        estimate,
    } = taken;
    let recipe = request.recipe;
    let mut results: Vec<EdgeResult> = edges
        .iter()
        .zip(measured)
        .zip(resolved)
        .map(|((edge, measured), asked)| {
            findings.extend(measured.remarks.iter().cloned());
            judged(edge, measured, asked, request.recipe)
        })
        .collect();
    let corner_settings = CornerSettings {
        limit_mm: recipe.corner_mm,
        rule: recipe.rule,
        pose_covariance: &alignment.covariance,
        u_calibration_mm: recipe.u_calibration_mm,
    };
    let nominal_corners = corner::corners(nominal, edges);
    let mut corners = corner::measure(
        nominal,
        &nominal_corners,
        (edges, &results),
        &corner_settings,
    );
    let asked_gaps = asked_gaps(edges, recipe, &mut findings);
    let mut gaps: Vec<GapResult> = asked_gaps
        .iter()
        .map(|(asked, [a, b])| gap::measure(asked, [&results[*a], &results[*b]], recipe.rule))
        .collect();
    if let Some((_, kept)) = &trials {
        let derivation = Derivation {
            body: nominal,
            edges,
            recipe,
            corners: &nominal_corners,
            corner_settings,
            gaps: &asked_gaps,
        };
        let forms = kept.take_over(&derivation, &results, (&mut corners, &mut gaps));
        for ((result, form), (edge, asked)) in results
            .iter_mut()
            .zip(forms)
            .zip(edges.iter().zip(resolved))
        {
            result.form = form;
            judge_edge(result, edge, asked, recipe);
        }
        corners
            .iter_mut()
            .for_each(|c| corner::judge_corner(c, recipe.rule));
        gaps.iter_mut().for_each(|g| gap::judge_gap(g, recipe.rule));
    }
    let values = results
        .iter()
        .map(|e| e.verdict)
        .chain(corners.iter().map(|c| c.verdict))
        .chain(gaps.iter().map(|g| g.verdict))
        .chain(compared_verdict(&compared, resolved, edges, request.recipe))
        .chain(environment_verdict(request, &mut findings));
    let verdict = verdict::judge_part(values, alignment.status);
    Inspection {
        alignment,
        edges: results,
        corners,
        gaps,
        unexpected_edges: compared.unexpected,
        missing_edges: compared.missing,
        verdict,
        trials: trials.map(|(trials, _)| trials),
        seconds: stages.end(),
        findings,
        scan: Some(estimate),
    }
}

/// What every sharp edge of `nominal` is selected by.
pub fn all_edge_facts<B: Body>(nominal: &B) -> Vec<EdgeFacts> {
    let edges = nominal.edges();
    (0..edges.len())
        .map(|e| edge_facts(nominal, e, &edges[e]))
        .collect()
}

/// Seventeen places along it show its box and its angles: nominal edges of parts are smoother than that.
fn edge_facts<B: Body>(nominal: &B, index: usize, edge: &BodyEdge) -> EdgeFacts {
    let stations = (0..=16).map(|k| nominal.station(index, edge.length_mm * f64::from(k) / 16.0));
    let mut facts = EdgeFacts {
        id: edge.id.clone(),
        entity: edge.entity,
        faces: edge.faces.map(|face| nominal.face_entity(face)),
        kind: edge.kind,
        box_mm: [DVec3::INFINITY, DVec3::NEG_INFINITY],
        turn_angle_rad: [f64::INFINITY, 0.0],
    };
    for station in stations {
        let turn = station.normals[0].angle_between(station.normals[1]);
        let [low, high] = facts.box_mm;
        facts.box_mm = [low.min(station.point), high.max(station.point)];
        let [least, most] = facts.turn_angle_rad;
        facts.turn_angle_rad = [least.min(turn), most.max(turn)];
    }
    facts
}

/// What holds for every edge of `facts`, by the recipe and where it asks for them by the nominal's own tolerances, and findings: an entry
/// that means no edge, a tolerance that gives no limit. A name for several edges gets their ids behind it.
pub fn resolve<B: Body>(
    nominal: &B,
    facts: &[EdgeFacts],
    recipe: &Recipe,
) -> (Vec<Resolved>, Vec<String>) {
    let mut findings = Vec::new();
    for entry in &recipe.edges {
        if !facts.iter().any(|edge| entry.select.means(edge)) {
            findings.push(format!(
                "recipe: edge: {} is no sharp edge of the nominal, expected its entity or id; the entry is left out",
                entry.select.words()
            ));
        }
    }
    let mut by_nominal = vec![Limits::default(); facts.len()];
    if recipe.limits_from_pmi {
        let (limits, unused) = from_pmi::limits_from_pmi(nominal, facts, &recipe.datums);
        by_nominal = limits;
        findings.extend(unused);
    }
    let mut resolved: Vec<Resolved> = facts
        .iter()
        .zip(by_nominal)
        .map(|(edge, by_nominal)| recipe.of_edge(edge, by_nominal))
        .collect();
    let names: Vec<Option<String>> = resolved.iter().map(|edge| edge.name.clone()).collect();
    for (edge, facts) in resolved.iter_mut().zip(facts) {
        let shared = names.iter().filter(|name| **name == edge.name).count() > 1;
        if let Some(name) = edge.name.as_mut().filter(|_| shared) {
            *name = format!("{name} {}", facts.id);
        }
    }
    (resolved, findings)
}

/// Missing edges count where they have limits, unexpected ones where the recipe says so.
fn compared_verdict(
    compared: &compare::Compared,
    resolved: &[Resolved],
    edges: &[BodyEdge],
    recipe: &Recipe,
) -> Option<Verdict> {
    let missing = edges
        .iter()
        .zip(resolved)
        .any(|(edge, asked)| !asked.limits.is_empty() && compared.missing.contains(&edge.id));
    let counts = (missing && recipe.missing_edges_count)
        || (!compared.unexpected.is_empty() && recipe.unexpected_edges_count);
    counts.then_some(Verdict::NotOk)
}

/// The expansion to correct for: that of the recipe at the temperature of the request.
fn expansion(request: &Request<'_>, findings: &mut Vec<String>) -> Option<measure::Expansion> {
    let asked = request.recipe.expansion?;
    let Some(temperature_c) = request.temperature_c else {
        findings.push(
            "temperature of the part: nobody said, expected it for the correction of its expansion; nothing is corrected"
                .to_owned(),
        );
        return None;
    };
    Some(measure::Expansion {
        coefficient_per_k: asked.coefficient_per_k,
        u_coefficient_per_k: asked.u_coefficient_per_k,
        temperature_c,
        u_temperature_k: asked.u_temperature_k,
    })
}

/// Nothing is decided outside the temperatures of the recipe, or where nobody knows the temperature.
fn environment_verdict(request: &Request<'_>, findings: &mut Vec<String>) -> Option<Verdict> {
    let [low, high] = request.recipe.temperature_c?;
    let seen = match request.temperature_c {
        Some(t) if (low..=high).contains(&t) => return None,
        Some(t) => format!("{t} degrees Celsius"),
        None => "nobody said".to_owned(),
    };
    findings.push(format!(
        "temperature of the part: {seen}, expected {low} to {high} degrees Celsius; nothing is decided"
    ));
    Some(Verdict::NotDecidable)
}

/// The gaps of the recipe with the indices of their edges; one whose edges are not there becomes a finding.
fn asked_gaps<'a>(
    edges: &[BodyEdge],
    recipe: &'a Recipe,
    findings: &mut Vec<String>,
) -> Vec<(&'a GapRecipe, [usize; 2])> {
    let find = |key: &EdgeKey| {
        edges.iter().position(|edge| match key {
            EdgeKey::Entity(entity) => *entity == edge.entity,
            EdgeKey::Id(id) => *id == edge.id,
        })
    };
    let mut gaps = Vec::new();
    for asked in &recipe.gaps {
        match [find(&asked.edges[0]), find(&asked.edges[1])] {
            [Some(a), Some(b)] if a != b => {
                gaps.push((asked, [a, b]));
            }
            _ => findings.push(format!(
                "recipe: gap {:?}: {:?} are not two sharp edges of the nominal, expected their ids or entities; the gap is left out",
                asked.name, asked.edges
            )),
        }
    }
    gaps
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

fn judged(
    edge: &BodyEdge,
    measured: MeasuredEdge,
    asked: &Resolved,
    recipe: &Recipe,
) -> EdgeResult {
    let total = measured.stations.len().max(1);
    let stations: Vec<StationResult> = measured
        .stations
        .into_iter()
        .map(|s| {
            let (measured, reason) = match s.outcome {
                Ok(measured) => (Some(measured), String::new()),
                // The edge as a whole answers for what is missing, by its coverage.
                Err(reason) => (None, reason),
            };
            let mut station = StationResult {
                station: s.station,
                measured,
                boundary: s.boundary,
                points: s.points,
                verdict: Verdict::Undefined,
                reason,
            };
            judge_station(&mut station, edge, asked, recipe);
            station
        })
        .collect();
    let share = |of: &dyn Fn(&StationResult) -> bool| {
        stations.iter().filter(|s| of(s)).count() as f64 / total as f64
    };
    let coverage = share(&|s| s.measured.is_some());
    let boundary_share = share(&|s| s.boundary.is_some());
    let mut result = EdgeResult {
        id: asked.name.clone().unwrap_or_else(|| edge.id.clone()),
        nominal_entity: edge.entity,
        kind: edge.kind,
        length_mm: edge.length_mm,
        coverage,
        boundary_share,
        form: form::form(&stations, recipe.direction_mm),
        stations,
        breaks: measured.breaks,
        characteristics: Vec::new(),
        mean: measured.mean,
        verdict: Verdict::Undefined,
    };
    judge_edge(&mut result, edge, asked, recipe);
    result
}

/// The characteristics of an edge and its verdict.
fn judge_edge(result: &mut EdgeResult, edge: &BodyEdge, asked: &Resolved, recipe: &Recipe) {
    // Where limits ask for nothing but what a boundary shows, its stations answer for the edge.
    let asked_here: Vec<Quantity> = Quantity::all()
        .filter(|q| q.extent() == Extent::Station && asked.limits.of(*q).is_some())
        .collect();
    let answers = |s: &&StationResult| {
        let shown = |q: &Quantity| at_station(s, edge.kind, *q).is_some();
        let boundary = s.boundary.is_some() && !asked_here.is_empty();
        s.measured.is_some() || (boundary && asked_here.iter().all(shown))
    };
    let total = result.stations.len().max(1) as f64;
    let answered = result.stations.iter().filter(answers).count() as f64 / total;
    let values = EdgeValues {
        kind: edge.kind,
        stations: &result.stations,
        breaks: &result.breaks,
        form: result.form.as_ref(),
    };
    let characteristics = characteristics(&values, &asked.limits, recipe.rule);
    result.verdict = verdict::judge_edge(
        characteristics.iter().map(|c| c.verdict),
        answered,
        recipe.minimum_coverage,
        !asked.limits.is_empty(),
    );
    result.characteristics = characteristics;
}

/// The worst verdict on the values of a station, and the reason where it is `NotDecidable`.
fn judge_station(station: &mut StationResult, edge: &BodyEdge, asked: &Resolved, recipe: &Recipe) {
    let mut reasons = Vec::new();
    for quantity in Quantity::all() {
        let Some(value) = at_station(station, edge.kind, quantity) else {
            continue;
        };
        let verdict = judge(value.value, value.u, asked.limits.of(quantity), recipe.rule);
        if verdict == Verdict::NotDecidable {
            reasons.push(format!(
                "a limit of {} lies inside its uncertainty",
                quantity.words()
            ));
        }
        station.verdict = station.verdict.max(verdict);
    }
    if station.verdict == Verdict::NotDecidable {
        if !station.reason.is_empty() {
            reasons.insert(0, std::mem::take(&mut station.reason));
        }
        station.reason = reasons.join("; ");
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

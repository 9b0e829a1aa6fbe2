//! From what an inspection found to the wire types: units changed, nothing that is not finite let through.

use std::f64::consts::PI;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use glam::DVec3;

use super::Facts;
use super::characteristic::{on_the_wire, spread};
use super::conclusion;
use super::wire::{self, Quantity, Report, Status};
use crate::inspect::flank::FlankModel;
use crate::inspect::monte_carlo::Trials;
use crate::inspect::recipe::{Recipe, Rule};
use crate::inspect::result::{
    Alignment, BreakShape, Budget, CornerResult, DatumKind, DatumResult, EdgeBreak, EdgeForm,
    EdgeResult, GapResult, Inspection, Measured, Method, Quantified, StationResult, Verdict,
};
use crate::nominal::EdgeKind;
use crate::words::Language;

impl Report {
    /// The report of `inspection`, with `facts` beside it.
    ///
    /// Numbers that are not finite become `null`. Where that hits a measured value, its station says so in `reason` and is at
    /// best not decidable, and so are its edge and the part.
    pub fn new(inspection: &Inspection, facts: &Facts) -> Self {
        let mut findings = inspection.findings.clone();
        let edges: Vec<_> = inspection
            .edges
            .iter()
            .map(|edge| edge_from_result(edge, facts, &mut findings))
            .collect();
        let alignment = alignment_from_result(&inspection.alignment);
        // A good alignment makes no part OK: where no value was judged, nothing was.
        let beside_the_edges = [status_from_verdict(inspection.verdict), alignment.status]
            .into_iter()
            .filter(|status| *status > Status::Ok);
        let verdict = edges
            .iter()
            .map(|edge| edge.verdict)
            .chain(beside_the_edges)
            .max()
            .unwrap_or(Status::Undefined);
        let mut report = Report {
            schema: wire::Schema::V1,
            part: facts.part.clone(),
            nominal: facts.nominal.clone(),
            created: rfc3339(facts.created),
            software: wire::Software {
                name: "acies".to_owned(),
                version: env!("CARGO_PKG_VERSION").to_owned(),
            },
            simulated: facts.simulated_seed.is_some(),
            seed: facts.simulated_seed,
            verdict,
            reason: String::new(),
            advice: String::new(),
            because: None,
            recipe: recipe_on_the_wire(&facts.recipe),
            scan: scan_from_facts(facts),
            devices: devices_from_facts(facts),
            alignment,
            uncertainty: uncertainty_from_trials(inspection.trials),
            edges,
            corners: inspection
                .corners
                .iter()
                .filter_map(corner_from_result)
                .collect(),
            gaps: inspection.gaps.iter().map(gap_from_result).collect(),
            unexpected_edges: inspection
                .unexpected_edges
                .iter()
                .map(|line| line.iter().copied().filter_map(xyz).collect())
                .collect(),
            missing_edges: inspection.missing_edges.clone(),
            findings,
            seconds: seconds_by_stage(&inspection.seconds),
        };
        let because = conclusion::conclude(&report);
        report.reason = because.reason(Language::En);
        report.advice = because.advice(Language::En);
        report.because = Some(because);
        report
    }
}

/// Times outside 1970 to 9999 are clamped: no clock shows them, and RFC 3339 cannot write them.
fn rfc3339(time: SystemTime) -> String {
    let end_of_9999 = UNIX_EPOCH + Duration::from_secs(253_402_300_799);
    humantime::format_rfc3339_seconds(time.clamp(UNIX_EPOCH, end_of_9999)).to_string()
}

/// Beyond this (a thousand kilometres in mm) a number is as useless as infinity, and squares of it would overflow later.
const LARGEST: f64 = 1e9;

pub(super) fn finite(value: f64) -> Option<f64> {
    (value.abs() <= LARGEST).then_some(value)
}

fn degrees(angle_rad: f64) -> Option<f64> {
    finite(angle_rad.to_degrees())
}

fn xyz(v: DVec3) -> Option<wire::Xyz> {
    let [x, y, z] = v.to_array().map(finite);
    Some([x?, y?, z?])
}

pub(super) fn status_from_verdict(verdict: Verdict) -> Status {
    match verdict {
        Verdict::Undefined => Status::Undefined,
        Verdict::Ok => Status::Ok,
        Verdict::NotDecidable => Status::NotDecidable,
        Verdict::NotOk => Status::NotOk,
    }
}

/// A stage that comes twice (a second view) is summed.
fn seconds_by_stage(seconds: &[(&'static str, f64)]) -> indexmap::IndexMap<String, f64> {
    let mut by_stage = indexmap::IndexMap::new();
    for &(stage, seconds) in seconds.iter().filter(|(_, seconds)| seconds.is_finite()) {
        *by_stage.entry(stage.to_owned()).or_insert(0.0) += seconds;
    }
    by_stage
}

fn recipe_on_the_wire(recipe: &Recipe) -> wire::Recipe {
    let (rule, guard_band_k, conformance_probability) = match recipe.rule {
        Rule::Simple => (wire::Rule::Simple, None, None),
        Rule::GuardBand(k) => (wire::Rule::GuardBand, finite(k), None),
        Rule::Conformance(p) => (wire::Rule::Conformance, None, finite(p)),
    };
    let limits = |quantity: Quantity| {
        let limits = recipe.limits.of(quantity)?;
        finite_limits(Some(limits.map(|limit| quantity.unit().outside(limit))))
    };
    wire::Recipe {
        sha256: recipe.sha256.clone(),
        rule,
        guard_band_k,
        conformance_probability,
        limits: wire::Limits {
            d1_mm: limits(Quantity::D1),
            d2_mm: limits(Quantity::D2),
            angle_deviation_deg: limits(Quantity::AngleDeviation),
        },
        limits_from_pmi: recipe.limits_from_pmi,
        minimum_coverage: finite(recipe.minimum_coverage),
        u_calibration_mm: finite(recipe.u_calibration_mm),
        u_calibration_deg: degrees(recipe.u_calibration_rad),
    }
}

fn finite_limits(limits: Option<[f64; 2]>) -> Option<[f64; 2]> {
    limits.filter(|limits| limits.iter().all(|limit| finite(*limit).is_some()))
}

fn losses_from_device(losses: acies_drivers::device::Losses) -> wire::Losses {
    wire::Losses {
        received: losses.received,
        lost_on_link: losses.lost_on_link,
        dropped_by_device: losses.dropped_by_device,
        rejected: losses.rejected,
        skipped_bytes: losses.skipped_bytes,
    }
}

fn scan_from_facts(facts: &Facts) -> wire::Scan {
    let mut losses = wire::Losses::default();
    for device in facts.devices.iter().filter_map(|device| device.losses) {
        losses.received = losses.received.saturating_add(device.received);
        losses.lost_on_link = losses.lost_on_link.saturating_add(device.lost_on_link);
        losses.dropped_by_device = losses
            .dropped_by_device
            .saturating_add(device.dropped_by_device);
        losses.rejected = losses.rejected.saturating_add(device.rejected);
        losses.skipped_bytes = losses.skipped_bytes.saturating_add(device.skipped_bytes);
    }
    wire::Scan {
        points: facts.scan.points,
        spacing_mm: facts.scan.spacing_mm.and_then(finite),
        spacing_along_line_mm: facts.scan.spacing_along_line_mm.and_then(finite),
        spacing_across_lines_mm: facts.scan.spacing_across_lines_mm.and_then(finite),
        noise_mm: facts.scan.noise_mm.and_then(finite),
        losses,
    }
}

fn devices_from_facts(facts: &Facts) -> Vec<wire::Device> {
    facts
        .devices
        .iter()
        .map(|device| wire::Device {
            name: device.name.clone(),
            vendor: device.identity.vendor.clone(),
            model: device.identity.model.clone(),
            serial: device.identity.serial.clone(),
            firmware: device.identity.firmware.clone(),
            losses: device.losses.map(losses_from_device),
        })
        .collect()
}

fn alignment_from_result(alignment: &Alignment) -> wire::Alignment {
    let matrix = alignment.part_from_machine.matrix();
    let rows = matrix.transpose().to_cols_array_2d();
    let has_pose = rows.iter().flatten().all(|entry| finite(*entry).is_some());
    let covariance = alignment.covariance;
    let mut status = status_from_verdict(alignment.status);
    if !has_pose {
        status = status.max(Status::NotDecidable);
    }
    wire::Alignment {
        part_from_machine: has_pose.then_some(rows),
        rms_mm: finite(alignment.rms_mm),
        points: alignment.points,
        covariance: covariance
            .iter()
            .flatten()
            .all(|entry| finite(*entry).is_some())
            .then_some(covariance),
        weak_directions: alignment.weak_directions.clone(),
        status,
        method: match alignment.method {
            Method::AsGiven => wire::AlignmentMethod::AsGiven,
            Method::BestFit => wire::AlignmentMethod::BestFit,
            Method::Datums => wire::AlignmentMethod::Datums,
        },
        faces: alignment.faces.clone(),
        datums: alignment.datums.iter().map(datum_from_result).collect(),
        free_of_datums: alignment.free_of_datums.clone(),
    }
}

fn uncertainty_from_trials(trials: Option<Trials>) -> wire::Uncertainty {
    wire::Uncertainty {
        method: match trials {
            Some(_) => wire::UncertaintyMethod::MonteCarlo,
            None => wire::UncertaintyMethod::FirstOrder,
        },
        trials: trials.map(|t| t.stations),
        break_trials: trials.map(|t| t.breaks),
        derived_trials: trials.map(|t| t.derived),
        seed: trials.map(|t| t.seed),
        unstable_stations: trials.map(|t| t.unstable),
    }
}

fn datum_from_result(found: &DatumResult) -> wire::Datum {
    wire::Datum {
        name: found.name.clone(),
        kind: match found.kind {
            DatumKind::Point => wire::DatumKind::Point,
            DatumKind::Plane => wire::DatumKind::Plane,
            DatumKind::Axis => wire::DatumKind::Axis,
            DatumKind::Centre => wire::DatumKind::Centre,
        },
        priority: found.priority,
        faces: found.faces.clone(),
        points: found.points,
        residual_mm: finite(found.residual_mm),
        residual_deg: found.residual_rad.and_then(degrees),
        u_mm: finite(found.u_mm),
        form_mm: finite(found.form_mm),
    }
}

fn edge_from_result(edge: &EdgeResult, facts: &Facts, findings: &mut Vec<String>) -> wire::Edge {
    let mut stations = Vec::with_capacity(edge.stations.len());
    let mut verdict = status_from_verdict(edge.verdict);
    for (index, result) in edge.stations.iter().enumerate() {
        match station_from_result(result, edge.kind, facts.with_budgets) {
            Some(station) => {
                if station.status > status_from_verdict(result.verdict) {
                    verdict = verdict.max(station.status);
                }
                stations.push(station);
            }
            None => findings.push(format!(
                "edge {}: the nominal place of station {index} is not a number below 1e9; the station is left out",
                edge.id
            )),
        }
    }
    let summary = summary(edge, &stations);
    let characteristics = edge
        .characteristics
        .iter()
        .map(|found| {
            let budget = worst_budget(edge, found.quantity, found.s_mm);
            on_the_wire(&edge.id, found, facts.recipe.rule, budget)
        })
        .collect();
    wire::Edge {
        id: edge.id.clone(),
        nominal_entity: edge.nominal_entity,
        kind: match edge.kind {
            EdgeKind::Convex => wire::Kind::Convex,
            EdgeKind::Concave => wire::Kind::Concave,
        },
        length_mm: finite(edge.length_mm),
        coverage: finite(edge.coverage).unwrap_or(summary.measured_share),
        boundary_share: finite(edge.boundary_share),
        stations,
        breaks: edge.breaks.iter().filter_map(break_from_result).collect(),
        form: edge.form.as_ref().map(form_from_result),
        summary,
        characteristics,
        verdict,
    }
}

fn summary(edge: &EdgeResult, stations: &[wire::Station]) -> wire::Summary {
    let of = |quantity| {
        let mut all = edge.characteristics.iter();
        all.find(|c| c.quantity == quantity).and_then(spread)
    };
    let measured = stations.iter().filter(|s| s.measured.is_some()).count();
    wire::Summary {
        stations: stations.len(),
        measured,
        measured_share: measured as f64 / stations.len().max(1) as f64,
        d1_mm: of(Quantity::D1),
        d2_mm: of(Quantity::D2),
        angle_deviation_deg: of(Quantity::AngleDeviation),
    }
}

/// What the uncertainty of the worst value is made of, where that value belongs to a station.
fn worst_budget(edge: &EdgeResult, quantity: Quantity, s_mm: Option<f64>) -> Option<Budget> {
    let mut stations = edge.stations.iter();
    let station = stations.find(|station| Some(station.station.s_mm) == s_mm)?;
    if let Some(boundary) = &station.boundary {
        return Some(boundary.budget);
    }
    let measured = station.measured.as_ref()?;
    match quantity {
        Quantity::D1 => Some(measured.budget_d[0]),
        Quantity::D2 => Some(measured.budget_d[1]),
        Quantity::AngleDeviation => Some(measured.budget_angle),
        _ => None,
    }
}

fn value(found: Quantified) -> wire::Value {
    wire::Value {
        value: finite(found.value),
        u: finite(found.u),
    }
}

fn value_in_degrees(found: Quantified) -> wire::Value {
    wire::Value {
        value: degrees(found.value),
        u: degrees(found.u),
    }
}

/// `None` where its place is no number.
fn break_from_result(found: &EdgeBreak) -> Option<wire::Break> {
    let mut stretch = wire::Break {
        s_mm: [finite(found.s_mm[0])?, finite(found.s_mm[1])?],
        shape: wire::Shape::Irregular,
        radius_mm: None,
        radius_below_mm: None,
        chamfer_legs_mm: None,
        chamfer_angle_deg: None,
        detachment_mm: found.detachment_mm.map(value),
        truncation_mm: value(found.truncation_mm),
        burr_mm: value(found.burr_mm),
        undercut_mm: found.undercut_mm.map(value),
        points: found.points,
    };
    match found.shape {
        BreakShape::Sharp { radius_below_mm } => {
            stretch.shape = wire::Shape::Sharp;
            stretch.radius_below_mm = finite(radius_below_mm);
        }
        BreakShape::Round { radius_mm } => {
            stretch.shape = wire::Shape::Round;
            stretch.radius_mm = Some(value(radius_mm));
        }
        BreakShape::Chamfer { legs_mm, angle_rad } => {
            stretch.shape = wire::Shape::Chamfer;
            stretch.chamfer_legs_mm = Some(legs_mm.map(value));
            stretch.chamfer_angle_deg = Some(value_in_degrees(angle_rad));
        }
        BreakShape::Undecided { radius_mm, legs_mm } => {
            stretch.shape = wire::Shape::Undecided;
            stretch.radius_mm = Some(value(radius_mm));
            stretch.chamfer_legs_mm = Some(legs_mm.map(value));
        }
        BreakShape::Irregular => {}
    }
    Some(stretch)
}

fn form_from_result(found: &EdgeForm) -> wire::Form {
    wire::Form {
        straightness_mm: found.straightness_mm.map(value),
        line_profile_mm: value(found.line_profile_mm),
        s_worst_mm: finite(found.s_worst_mm),
        line_form_mm: found.line_form_mm.map(value),
        direction_deg: found
            .direction_rad
            .map(|(found, _)| value_in_degrees(found)),
    }
}

/// `None` where its nominal place is no number.
fn corner_from_result(found: &CornerResult) -> Option<wire::Corner> {
    Some(wire::Corner {
        id: found.id.clone(),
        nominal: xyz(found.nominal)?,
        faces: found.faces.clone(),
        edges: found.edges.clone(),
        measured: found.measured.and_then(xyz),
        total_mm: found.total_mm.and_then(|total| finite(total.value)),
        u_total_mm: found.total_mm.and_then(|total| finite(total.u)),
        residual_mm: found.residual_mm.and_then(finite),
        upper_mm: found.limit_mm.and_then(finite),
        verdict: status_from_verdict(found.verdict),
        reason: found.reason.clone(),
    })
}

fn gap_from_result(found: &GapResult) -> wire::Gap {
    let stations = found.stations.iter().filter_map(|station| {
        Some(wire::GapStation {
            s_mm: finite(station.s_mm)?,
            gap_mm: finite(station.gap_mm.value),
            u_gap_mm: finite(station.gap_mm.u),
            nominal_gap_mm: finite(station.nominal_mm[0]),
            flush_mm: finite(station.flush_mm.value),
            u_flush_mm: finite(station.flush_mm.u),
            nominal_flush_mm: finite(station.nominal_mm[1]),
        })
    });
    wire::Gap {
        name: found.name.clone(),
        edges: found.edges.clone(),
        gap_limits_mm: finite_limits(found.gap_limits_mm),
        flush_limits_mm: finite_limits(found.flush_limits_mm),
        stations: stations.collect(),
        verdict: status_from_verdict(found.verdict),
        reason: found.reason.clone(),
    }
}

/// `None` where the nominal place itself is not finite.
fn station_from_result(
    result: &StationResult,
    kind: EdgeKind,
    with_budget: bool,
) -> Option<wire::Station> {
    let place = &result.station;
    let turn_angle_rad = place.normals[0].angle_between(place.normals[1]);
    let nominal_included_angle_rad = match kind {
        EdgeKind::Convex => PI - turn_angle_rad,
        EdgeKind::Concave => PI + turn_angle_rad,
    };
    let mut station = wire::Station {
        s_mm: finite(place.s_mm)?,
        nominal: xyz(place.point)?,
        tangent: xyz(place.tangent)?,
        n1: xyz(place.normals[0])?,
        n2: xyz(place.normals[1])?,
        nominal_included_angle_deg: degrees(nominal_included_angle_rad)?,
        measured: None,
        d1_mm: None,
        d2_mm: None,
        u_d1_mm: None,
        u_d2_mm: None,
        included_angle_deg: None,
        u_included_angle_deg: None,
        total_mm: None,
        boundary: result.boundary.as_ref().and_then(|found| {
            Some(wire::Boundary {
                flank: found.flank + 1,
                point: xyz(found.point)?,
                d_mm: value(found.d_mm),
                budget: with_budget.then(|| budget_on_the_wire(found.budget, 1.0)),
            })
        }),
        flank_models: None,
        ridge: None,
        at_depth: [None; 2],
        residual_1_mm: None,
        residual_2_mm: None,
        budget: None,
        points_1: result.points[0],
        points_2: result.points[1],
        status: status_from_verdict(result.verdict),
        reason: result.reason.clone(),
    };
    if let Some(measured) = &result.measured {
        fill_measured(&mut station, measured);
        station.budget = with_budget.then(|| budgets(measured));
    }
    Some(station)
}

fn budgets(measured: &Measured) -> [wire::Budget; 3] {
    let [d1, d2] = measured.budget_d;
    let each = [(d1, 1.0), (d2, 1.0), (measured.budget_angle, 180.0 / PI)];
    each.map(|(budget, scale)| budget_on_the_wire(budget, scale))
}

fn budget_on_the_wire(budget: Budget, scale: f64) -> wire::Budget {
    wire::Budget {
        points: finite(scale * budget.points),
        alignment: finite(scale * budget.alignment),
        calibration: finite(scale * budget.calibration),
        temperature: finite(scale * budget.temperature),
    }
}

/// Takes over what is finite; says what was not.
fn fill_measured(station: &mut wire::Station, measured: &Measured) {
    let point = xyz(measured.point);
    let [d1, d2] = measured.d_mm.map(finite);
    let (Some(_), Some(_), Some(_)) = (point, d1, d2) else {
        lower(station, "the measured edge is not a number below 1e9");
        return;
    };
    station.measured = point;
    (station.d1_mm, station.d2_mm) = (d1, d2);
    [station.u_d1_mm, station.u_d2_mm] = measured.u_d_mm.map(finite);
    station.included_angle_deg = degrees(measured.included_angle_rad);
    station.u_included_angle_deg = degrees(measured.u_included_angle_rad);
    station.total_mm = Some(value(measured.total_mm));
    station.flank_models = Some(measured.flank_model.map(|model| match model {
        FlankModel::Displaced => wire::FlankModel::Displaced,
        FlankModel::Bent => wire::FlankModel::Bent,
        FlankModel::Quadric => wire::FlankModel::Quadric,
    }));
    station.ridge = measured.ridge.and_then(|ridge| {
        Some(wire::EdgePoint {
            point: xyz(ridge.point)?,
            d1_mm: value(ridge.d_mm[0]),
            d2_mm: value(ridge.d_mm[1]),
        })
    });
    station.at_depth = measured.at_depth.map(|place| {
        let place = place?;
        Some(wire::DepthPoint {
            point: xyz(place.point)?,
            d_mm: value(place.d_mm),
        })
    });
    [station.residual_1_mm, station.residual_2_mm] = measured.residual_mm.map(finite);
    let without = [
        (station.u_d1_mm, "uncertainty of d1"),
        (station.u_d2_mm, "uncertainty of d2"),
        (station.included_angle_deg, "included angle"),
        (
            station.u_included_angle_deg,
            "uncertainty of the included angle",
        ),
    ]
    .into_iter()
    .filter(|(value, _)| value.is_none());
    for (_, name) in without {
        lower(station, &format!("the {name} is not a number below 1e9"));
    }
}

fn lower(station: &mut wire::Station, reason: &str) {
    station.status = station.status.max(Status::NotDecidable);
    if !station.reason.is_empty() {
        station.reason.push_str("; ");
    }
    station.reason.push_str(reason);
}

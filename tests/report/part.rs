//! A made-up inspection of a part with straight, concave, circular and wavy edges, as realistic as its numbers need to be.

use std::f64::consts::TAU;
use std::time::{Duration, UNIX_EPOCH};

use acies::geometry::RigidTransform;
use acies::inspect::characteristic::{EdgeValues, characteristics};
use acies::inspect::flank::FlankModel;
use acies::inspect::quantity::Quantity;
use acies::inspect::recipe::{Limits, Recipe, Rule};
use acies::inspect::result::{
    Alignment, Budget, DatumKind, DatumResult, EdgeResult, Inspection, Measured, Method,
    Quantified, StationResult, Verdict,
};
use acies::nominal::{EdgeKind, Station};
use acies::report::{DeviceFacts, Facts, ScanFacts};
use acies_drivers::device::{Identity, Losses};
use glam::{DQuat, DVec3};

/// The limits of d1 and d2, mm.
pub const LIMIT_MM: f64 = 0.1;

/// What is wrong along an edge: s in 0..1 to (d1, d2), mm.
type Defect = fn(f64) -> [f64; 2];

struct Shape {
    kind: EdgeKind,
    length_mm: f64,
    place: Box<dyn Fn(f64) -> DVec3>,
    normals: Box<dyn Fn(f64) -> [DVec3; 2]>,
    defect: Defect,
    /// Shares of the length that were not measured.
    hole: [f64; 2],
}

fn straight(from: [f64; 3], to: [f64; 3], normals: [[f64; 3]; 2], defect: Defect) -> Shape {
    let (from, to) = (DVec3::from(from), DVec3::from(to));
    let normals = normals.map(DVec3::from);
    Shape {
        kind: EdgeKind::Convex,
        length_mm: from.distance(to),
        place: Box::new(move |t| from.lerp(to, t)),
        normals: Box::new(move |_| normals),
        defect,
        hole: [2.0, 2.0],
    }
}

const X: [f64; 3] = [1.0, 0.0, 0.0];
const MINUS_X: [f64; 3] = [-1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];
const MINUS_Y: [f64; 3] = [0.0, -1.0, 0.0];
const Z: [f64; 3] = [0.0, 0.0, 1.0];

fn good(t: f64) -> [f64; 2] {
    [0.012 * (3.0 * t).sin(), -0.008 + 0.01 * t]
}

/// A stepped block, 90 x 60 x 40 mm, with a bore in the low step and a wavy flank.
fn shapes() -> Vec<Shape> {
    let wave = |t: f64| 3.0 * (TAU * t).sin();
    let mut shapes = vec![
        straight([0., 0., 40.], [40., 0., 40.], [MINUS_Y, Z], good),
        straight([40., 0., 40.], [40., 60., 40.], [X, Z], |t| {
            [0.135 - 0.02 * t, 0.01]
        }),
        straight([0., 0., 40.], [0., 60., 40.], [MINUS_X, Z], |t| {
            [-0.01, 0.094 * t]
        }),
        straight([40., 0., 20.], [40., 60., 20.], [X, Z], good),
        straight([90., 0., 20.], [90., 60., 20.], [X, Z], good),
        straight([40., 0., 20.], [90., 0., 20.], [MINUS_Y, Z], |t| {
            [0.03 * t, -0.02]
        }),
        straight([0., 0., 0.], [0., 0., 40.], [MINUS_X, MINUS_Y], good),
        straight([90., 0., 0.], [90., 0., 20.], [X, MINUS_Y], good),
    ];
    shapes[3].kind = EdgeKind::Concave;
    shapes[4].hole = [0.35, 0.62];
    shapes.push(Shape {
        kind: EdgeKind::Convex,
        length_mm: TAU * 12.0,
        place: Box::new(|t| {
            DVec3::new(65.0, 28.0, 20.0) + 12.0 * DVec3::new((TAU * t).cos(), (TAU * t).sin(), 0.0)
        }),
        normals: Box::new(|t| [-DVec3::new((TAU * t).cos(), (TAU * t).sin(), 0.0), DVec3::Z]),
        defect: |t| [0.03 * (TAU * t).cos(), 0.015 * (2.0 * TAU * t).sin()],
        hole: [2.0, 2.0],
    });
    shapes.push(Shape {
        kind: EdgeKind::Convex,
        length_mm: 92.2,
        place: Box::new(move |t| DVec3::new(90.0 * t, 60.0 + wave(t), 20.0)),
        normals: Box::new(move |t| {
            let slope = 3.0 * TAU / 90.0 * (TAU * t).cos();
            [DVec3::new(-slope, 1.0, 0.0).normalize(), DVec3::Z]
        }),
        defect: |t| [0.05 * (TAU * t).sin() + 0.01, -0.01],
        hole: [0.9, 1.1],
    });
    shapes.push(straight([0., 60., 40.], [40., 60., 40.], [Y, Z], good));
    shapes
}

/// Repeatable noise of unit variance, by a sum of four uniform numbers.
fn noise(seed: &mut u64) -> f64 {
    let mut uniform = || {
        *seed = seed
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (*seed >> 11) as f64 / (1u64 << 53) as f64
    };
    let sum: f64 = (0..4).map(|_| uniform()).sum();
    (sum - 2.0) * 3f64.sqrt()
}

fn judge(d_mm: [f64; 2], u_mm: [f64; 2]) -> Verdict {
    let one = |d: f64, u: f64| {
        if d.abs() - 2.0 * u > LIMIT_MM {
            Verdict::NotOk
        } else if d.abs() + 2.0 * u <= LIMIT_MM {
            Verdict::Ok
        } else {
            Verdict::NotDecidable
        }
    };
    one(d_mm[0], u_mm[0]).max(one(d_mm[1], u_mm[1]))
}

fn station(shape: &Shape, t: f64, seed: &mut u64) -> StationResult {
    let point = (shape.place)(t);
    let tangent = ((shape.place)(t + 1e-4) - (shape.place)(t - 1e-4)).normalize();
    let normals = (shape.normals)(t);
    let place = Station {
        s_mm: t * shape.length_mm,
        point,
        tangent,
        normals,
        into_face: [-normals[1], -normals[0]],
    };
    if (shape.hole[0]..shape.hole[1]).contains(&t) {
        return StationResult {
            station: place,
            measured: None,
            boundary: None,
            points: [14, 0],
            verdict: Verdict::NotDecidable,
            reason: "no points on either flank".to_owned(),
        };
    }
    let u_mm = [0.004 + 0.002 * (5.0 * t).sin().abs(), 0.005];
    let exact = (shape.defect)(t);
    let d_mm = [
        exact[0] + u_mm[0] * noise(seed),
        exact[1] + u_mm[1] * noise(seed),
    ];
    let turn = normals[0].angle_between(normals[1]);
    let nominal_angle = match shape.kind {
        EdgeKind::Convex => std::f64::consts::PI - turn,
        EdgeKind::Concave => std::f64::consts::PI + turn,
    };
    let verdict = judge(d_mm, u_mm);
    StationResult {
        station: place,
        boundary: None,
        measured: Some(Measured {
            point: point + d_mm[0] * normals[0] + d_mm[1] * normals[1],
            d_mm,
            u_d_mm: u_mm,
            included_angle_rad: nominal_angle + 0.0015 * noise(seed),
            u_included_angle_rad: 0.0015,
            residual_mm: [0.019, 0.021],
            budget_d: u_mm.map(|u| Budget {
                points: u,
                ..Budget::default()
            }),
            budget_angle: Budget {
                points: 0.0015,
                ..Budget::default()
            },
            covariance_d_mm2: 0.0,
            total_mm: Quantified {
                value: (d_mm[0] * normals[0] + d_mm[1] * normals[1]).length(),
                u: u_mm[0],
            },
            flank_model: [FlankModel::Displaced; 2],
            ridge: None,
            at_depth: [None; 2],
        }),
        points: [184, 172],
        verdict,
        reason: if verdict == Verdict::NotDecidable {
            "a limit of d1 lies inside its uncertainty".to_owned()
        } else {
            String::new()
        },
    }
}

fn edge(index: usize, shape: &Shape, stations: usize, seed: &mut u64) -> EdgeResult {
    let stations: Vec<_> = (0..stations)
        .map(|i| station(shape, (i as f64 + 0.5) / stations as f64, seed))
        .collect();
    let measured = stations.iter().filter(|s| s.measured.is_some()).count();
    EdgeResult {
        id: format!("e{}", index + 1),
        nominal_entity: 120 + 17 * index as u64,
        kind: shape.kind,
        length_mm: shape.length_mm,
        coverage: measured as f64 / stations.len() as f64,
        boundary_share: 0.0,
        breaks: Vec::new(),
        form: None,
        characteristics: Vec::new(),
        mean: None,
        verdict: stations
            .iter()
            .map(|s| s.verdict)
            .max()
            .unwrap_or(Verdict::Undefined),
        stations,
    }
}

/// Judges every value of `inspection` anew.
pub fn judge_again(inspection: &mut Inspection, recipe: &Recipe) {
    for edge in &mut inspection.edges {
        let values = EdgeValues {
            kind: edge.kind,
            stations: &edge.stations,
            breaks: &edge.breaks,
            form: edge.form.as_ref(),
        };
        edge.characteristics = characteristics(&values, &recipe.limits, recipe.rule);
    }
}

/// The inspection: one edge outside its limits, one in the zone, one with a hole, one partly hidden.
pub fn inspection(stations: usize) -> Inspection {
    let mut seed = 7;
    let edges: Vec<_> = shapes()
        .iter()
        .enumerate()
        .map(|(index, shape)| edge(index, shape, stations, &mut seed))
        .collect();
    let mut covariance = [[0.0; 6]; 6];
    for (i, row) in covariance.iter_mut().enumerate() {
        row[i] = if i < 3 { 4e-10 } else { 4e-6 };
    }
    let mut inspection = Inspection {
        trials: None,
        corners: Vec::new(),
        gaps: Vec::new(),
        alignment: Alignment {
            part_from_machine: RigidTransform::new(
                DQuat::from_rotation_z(0.52),
                DVec3::new(-12.5, 4.25, -100.0),
            ),
            rms_mm: 0.0213,
            points: 48_210,
            covariance,
            weak_directions: vec![],
            status: Verdict::Ok,
            method: Method::Datums,
            datums: vec![DatumResult {
                name: "A <top>".to_owned(),
                kind: DatumKind::Plane,
                priority: 1,
                faces: vec![17],
                points: 4_100,
                residual_mm: 0.0,
                residual_rad: Some(1e-5),
                u_mm: 0.0004,
                form_mm: 0.012,
            }],
            free_of_datums: vec!["rotation about z".to_owned()],
            ..Alignment::default()
        },
        unexpected_edges: vec![vec![
            DVec3::new(10.0, 20.0, 40.0),
            DVec3::new(16.0, 26.0, 40.0),
            DVec3::new(24.0, 29.0, 40.0),
        ]],
        missing_edges: vec![],
        verdict: edges
            .iter()
            .map(|e| e.verdict)
            .max()
            .unwrap_or(Verdict::Undefined),
        edges,
        seconds: vec![
            ("alignment", 0.41),
            ("edges", 0.22),
            ("comparison of edges found", 0.93),
        ],
        findings: vec!["213 of 412480 points were not finite and were left out".to_owned()],
        scan: None,
    };
    judge_again(&mut inspection, &facts().recipe);
    inspection
}

/// Facts beside it: a simulated cell with a profiler and a probe.
pub fn facts() -> Facts {
    let identity = |model: &str, serial: &str| Identity {
        vendor: "Acies".to_owned(),
        model: model.to_owned(),
        serial: serial.to_owned(),
        firmware: "1.0.3".to_owned(),
    };
    Facts {
        with_budgets: false,
        part: "stepped block".to_owned(),
        nominal: "stepped-block.step".to_owned(),
        created: UNIX_EPOCH + Duration::from_secs(1_780_000_000),
        simulated_seed: Some(7),
        scan: ScanFacts {
            points: 412_480,
            spacing_mm: Some(0.071),
            spacing_along_line_mm: Some(0.071),
            spacing_across_lines_mm: Some(0.5),
            noise_mm: Some(0.02),
        },
        devices: vec![
            DeviceFacts {
                name: "front".to_owned(),
                identity: identity("open-profile 640", "SIM-0001"),
                losses: Some(Losses {
                    received: 1_284,
                    lost_on_link: 3,
                    dropped_by_device: 0,
                    rejected: 1,
                    skipped_bytes: 96,
                }),
            },
            DeviceFacts {
                name: "probe".to_owned(),
                identity: identity("grbl-probe", ""),
                losses: None,
            },
        ],
        recipe: Recipe {
            rule: Rule::GuardBand(2.0),
            limits: Limits::default()
                .with(Quantity::D1, [-LIMIT_MM, LIMIT_MM])
                .with(Quantity::D2, [-LIMIT_MM, LIMIT_MM])
                .with(
                    Quantity::AngleDeviation,
                    [-1f64.to_radians(), 1f64.to_radians()],
                ),
            ..Recipe::default()
        },
    }
}

/// Puts `bad` in the place of a number: 1 to 8 a measured value of the first edge, the others elsewhere.
pub fn spoil(
    inspection: &mut Inspection,
    facts: &mut Facts,
    (place, station): (usize, usize),
    bad: f64,
) {
    let edge = &mut inspection.edges[0];
    let result = &mut edge.stations[station];
    let measured = result
        .measured
        .as_mut()
        .expect("the first edge is measured everywhere");
    match place {
        1 => measured.point.x = bad,
        2 | 3 => measured.d_mm[place - 2] = bad,
        4 | 5 => measured.u_d_mm[place - 4] = bad,
        6 => measured.included_angle_rad = bad,
        7 => measured.u_included_angle_rad = bad,
        8 => measured.d_mm = [bad; 2],
        9 => measured.residual_mm = [bad; 2],
        10 => result.station.s_mm = bad,
        11 => result.station.point.y = bad,
        12 => result.station.normals[1].z = bad,
        13 => edge.length_mm = bad,
        14 => edge.coverage = bad,
        15 => inspection.alignment.rms_mm = bad,
        16 => inspection.alignment.covariance[2][3] = bad,
        17 => inspection.alignment.part_from_machine.translation.x = bad,
        18 => inspection.unexpected_edges[0][1].z = bad,
        19 => facts.scan.noise_mm = Some(bad),
        _ => facts.recipe.limits = facts.recipe.limits.with(Quantity::D1, [-bad, bad]),
    }
    judge_again(inspection, &facts.recipe);
}

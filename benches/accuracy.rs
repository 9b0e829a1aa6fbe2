//! How well edges are measured against exact truth: `cargo bench --bench accuracy -- MODE [SEEDS]`.
//!
//! - `bound`: errors of d1 and d2 over the bound 2 sigma / sqrt(N), random points and scan lines with a smeared edge;
//! - `defects`: known defects, error of each over its uncertainty;
//! - `honesty`: share of true values inside the 95 % intervals with the alignment free, and Monte Carlo over first order;
//! - `speed`: seconds of `measure_edges` for a million points and twenty edges.

#![allow(clippy::print_stdout, reason = "its tables are what it is for")]

#[path = "../tests/edges/freeform.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod freeform;
#[path = "../tests/edges/part.rs"]
mod part;
#[path = "../tests/inspect/solids.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod solids;

use std::time::Instant;

use acies::geometry::RigidTransform;
use acies::inspect::align::{AlignOptions, Scan, Start, align};
use acies::inspect::assign::Surface;
use acies::inspect::body::Body;
use acies::inspect::measure::{MeasureSettings, MeasuredEdge, measure_edges};
use acies::inspect::monte_carlo::{MonteCarlo, measure_monte_carlo};
use acies::inspect::result::{BreakShape, EdgeBreak, Quantified};
use acies::points::{Frame, Neighbors, PointCloud};
use freeform::FreeForm;
use glam::{DVec2, DVec3};
use part::{Break, Layout, Made, empty_cloud};
use rayon::prelude::*;
use solids::{Noise, Solid};

const SIGMA: f64 = 0.010;
const FLANK: f64 = 2.0;

fn main() {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| !a.starts_with("--"))
        .collect();
    let seeds: Option<u64> = arguments.iter().find_map(|a| a.parse().ok());
    let asked = |mode: &str| {
        arguments.iter().any(|a| a == mode) || arguments.iter().all(|a| a.parse::<u64>().is_ok())
    };
    if asked("bound") {
        bound(seeds.unwrap_or(30));
    }
    if asked("defects") {
        defects(seeds.unwrap_or(20));
    }
    if asked("honesty") {
        honesty(seeds.unwrap_or(20));
    }
    if asked("speed") {
        speed();
    }
}

/// A prism with the included angles 60, 90, 120 and 150 degrees; its vertical edges are 3k + 2.
fn block() -> Solid {
    let sides = [
        (19.05, 0.0),
        (26.31, 120.0),
        (12.0, 210.0),
        (9.0, 270.0),
        (9.0, 300.0),
    ];
    let mut at = DVec2::ZERO;
    let mut outline = Vec::new();
    for (length, angle) in sides {
        outline.push(at);
        at += length * DVec2::from_angle(f64::to_radians(angle));
    }
    Solid::prism(&outline, 30.0)
}

const STRAIGHT: [(usize, &str); 4] = [
    (5, "60 degrees"),
    (8, "90 degrees"),
    (11, "120 degrees"),
    (14, "150 degrees"),
];

fn settings(along_mm: f64, across_mm: f64) -> MeasureSettings {
    MeasureSettings {
        along_mm,
        across_mm,
        noise_mm: SIGMA,
        station_step_mm: Some(1.0),
        pose_covariance: [[0.0; 6]; 6],
        u_calibration_mm: 0.0,
        u_calibration_rad: 0.0,
        flank_mm: Some(FLANK),
        depth_mm: None,
        expansion: None,
    }
}

fn measure<B: Body>(body: &B, cloud: &PointCloud, settings: &MeasureSettings) -> Vec<MeasuredEdge> {
    let surface = Surface::new(body);
    let places = surface.places(cloud, 2.0);
    measure_edges(cloud, &places, &surface, settings)
}

// ---- figure 1 ----

#[derive(Default, Clone)]
struct Errors {
    error: Vec<f64>,
    z: Vec<f64>,
    used: f64,
    lost: usize,
}

impl Errors {
    fn take_in<B: Body>(&mut self, made: &Made<'_, B>, edge: &MeasuredEdge) {
        for station in &edge.stations {
            let Ok(m) = &station.outcome else {
                self.lost += 1;
                continue;
            };
            let truth = made.true_d(&station.station);
            for (i, truth) in truth.iter().enumerate() {
                self.error.push(m.d_mm[i] - truth);
                self.z.push((m.d_mm[i] - truth) / m.u_d_mm[i]);
                self.used += station.points[i] as f64;
            }
        }
    }

    fn row(&self, name: &str, offered: f64) {
        let n = self.error.len() as f64;
        let mean = self.error.iter().sum::<f64>() / n;
        let rms = (self.error.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
        let z = (self.z.iter().map(|z| z * z).sum::<f64>() / n).sqrt();
        let used = self.used / n;
        let within = 100.0 * self.z.iter().filter(|z| z.abs() < 1.96).count() as f64 / n;
        println!(
            "{name:<24} {n:>6} {used:>7.0} {:>8.3} {:>8.3} {:>8.3} +-{:.3} {z:>7.3} {within:>7.1} {:>5}",
            rms / (2.0 * SIGMA / offered.sqrt()),
            rms / (2.0 * SIGMA / used.sqrt()),
            mean / rms,
            1.0 / n.sqrt(),
            self.lost
        );
    }
}

fn bound(seeds: u64) {
    for (title, layout, spacing) in [
        (
            "random, 100 points a mm2",
            Layout::Random(100.0),
            [0.1, 0.1],
        ),
        (
            "lines 1:10, the last two spot widths of 0.06 mm smeared",
            Layout::Lines {
                along: 0.0316,
                across: 0.316,
                smear: 0.12,
            },
            [0.0316, 0.316],
        ),
    ] {
        println!("{title}; noise {SIGMA} mm, stations 1 mm, flanks {FLANK} mm, {seeds} seeds");
        println!(
            "{:<24} {:>6} {:>7} {:>8} {:>8} {:>15} {:>7} {:>7} {:>5}",
            "edge", "values", "N used", "of N", "of used", "bias/rms", "z rms", "95 %", "lost"
        );
        let mut straight = vec![Errors::default(); STRAIGHT.len()];
        let (mut circle, mut free) = (Errors::default(), Errors::default());
        let settings = settings(spacing[0], spacing[1]);
        for seed in 1..=seeds {
            let mut noise = Noise(seed);
            let mut solid = block();
            for made in &mut solid.made {
                made.offset = 0.06 * (noise.uniform() - 0.5);
            }
            let mut cloud = empty_cloud();
            let deviation = |e: usize| {
                let faces = solid.edges()[e].faces;
                let solid = &solid;
                move |i: usize, p: DVec3| solid.made_at(faces[i], p)
            };
            let functions: Vec<_> = STRAIGHT.iter().map(|(e, _)| deviation(*e)).collect();
            let made: Vec<Made<'_, Solid>> = STRAIGHT
                .iter()
                .zip(&functions)
                .map(|((e, _), f)| Made::new(&solid, *e, f, Break::Sharp))
                .collect();
            for made in &made {
                made.scan(layout, (0.0, 30.0), &mut cloud, &mut noise);
            }
            let edges = measure(&solid, &cloud, &settings);
            for ((errors, made), (e, _)) in straight.iter_mut().zip(&made).zip(STRAIGHT) {
                errors.take_in(made, &edges[e]);
            }
            let offsets = [0, 1].map(|_| 0.06 * (noise.uniform() - 0.5));
            let shifted = |i: usize, _: DVec3| offsets[i];
            one(
                &Solid::cylinder(6.0, 10.0),
                1,
                &shifted,
                layout,
                &settings,
                &mut noise,
                &mut circle,
            );
            one(
                &FreeForm::new(),
                0,
                &shifted,
                layout,
                &settings,
                &mut noise,
                &mut free,
            );
        }
        let offered = FLANK / (spacing[0] * spacing[1]);
        for (errors, (_, name)) in straight.iter().zip(STRAIGHT) {
            errors.row(name, offered);
        }
        circle.row("circular (cylinder rim)", offered);
        free.row("free-form", offered);
        println!();
    }
}

fn one<B: Body>(
    body: &B,
    edge: usize,
    deviation: &dyn Fn(usize, DVec3) -> f64,
    layout: Layout,
    settings: &MeasureSettings,
    noise: &mut Noise,
    errors: &mut Errors,
) {
    let made = Made::new(body, edge, deviation, Break::Sharp);
    let mut cloud = empty_cloud();
    made.scan(
        layout,
        (0.0, body.edges()[edge].length_mm),
        &mut cloud,
        noise,
    );
    errors.take_in(&made, &measure(body, &cloud, settings)[edge]);
}

// ---- figure 3 ----

/// Errors, uncertainties and values of one characteristic.
#[derive(Default)]
struct Recovered {
    error: Vec<f64>,
    u: Vec<f64>,
    other: usize,
}

impl Recovered {
    fn add(&mut self, found: Quantified, truth: f64) {
        self.error.push(found.value - truth);
        self.u.push(found.u);
    }

    fn row(&self, name: &str, truth: f64) {
        let n = self.error.len() as f64;
        if n == 0.0 {
            println!(
                "{name:<44} {truth:>9.4}   never found, {} other",
                self.other
            );
            return;
        }
        let mean = self.error.iter().sum::<f64>() / n;
        let rms = (self.error.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
        let u = self.u.iter().sum::<f64>() / n;
        let z: Vec<f64> = self.error.iter().zip(&self.u).map(|(e, u)| e / u).collect();
        let z_rms = (z.iter().map(|z| z * z).sum::<f64>() / n).sqrt();
        let within = 100.0 * z.iter().filter(|z| z.abs() < 1.96).count() as f64 / n;
        println!(
            "{name:<44} {truth:>9.4} {n:>6} {mean:>10.5} {rms:>9.5} {u:>9.5} {z_rms:>7.2} {within:>7.1} {:>5}",
            self.other
        );
    }
}

/// Measures a 90 degree edge (or another of the block) of this shape over `seeds` seeds.
fn broken(
    solid: &Solid,
    edge: usize,
    shape: Break,
    deviation: &dyn Fn(usize, DVec3) -> f64,
    seeds: u64,
    mut take: impl FnMut(&Made<'_, Solid>, &MeasuredEdge),
) {
    for seed in 1..=seeds {
        let mut noise = Noise(1000 + seed);
        let made = Made::new(solid, edge, deviation, shape);
        let mut cloud = empty_cloud();
        made.scan(Layout::Random(100.0), (0.0, 30.0), &mut cloud, &mut noise);
        let edges = measure(solid, &cloud, &settings(0.1, 0.1));
        take(&made, &edges[edge]);
    }
}

fn defects(seeds: u64) {
    println!(
        "known defects, {seeds} seeds, 100 points a mm2, noise {SIGMA} mm, stations 1 mm, stretches of 5"
    );
    println!(
        "{:<44} {:>9} {:>6} {:>10} {:>9} {:>9} {:>7} {:>7} {:>5}",
        "defect", "truth", "values", "mean error", "rms", "mean u", "z rms", "95 %", "other"
    );
    let block = block();
    let none = |_: usize, _: DVec3| 0.0;
    let shifted = |i: usize, _: DVec3| if i == 0 { 0.020 } else { 0.0 };
    let mut offset = Recovered::default();
    broken(&block, 8, Break::Sharp, &shifted, seeds, |made, edge| {
        for station in &edge.stations {
            match &station.outcome {
                Ok(m) => offset.add(
                    Quantified {
                        value: m.d_mm[0],
                        u: m.u_d_mm[0],
                    },
                    made.true_d(&station.station)[0],
                ),
                Err(_) => offset.other += 1,
            }
        }
    });
    offset.row("face offset (d1), mm", 0.020);
    let place = block.station(8, 0.0);
    let angle = 0.05f64.to_radians();
    let tilted = |i: usize, p: DVec3| {
        if i == 0 {
            angle.tan() * (p - place.point).dot(place.into_face[0])
        } else {
            0.0
        }
    };
    let mut tilt = Recovered::default();
    broken(&block, 8, Break::Sharp, &tilted, seeds, |made, edge| {
        for station in &edge.stations {
            match &station.outcome {
                Ok(m) => tilt.add(
                    Quantified {
                        value: m.included_angle_rad,
                        u: m.u_included_angle_rad,
                    },
                    made.true_angle(&station.station),
                ),
                Err(_) => tilt.other += 1,
            }
        }
    });
    tilt.row(
        "face tilt (included angle), rad",
        std::f64::consts::FRAC_PI_2 + angle,
    );
    let angle_profile = Solid::prism(
        &[
            (0.0, 0.0),
            (20.0, 0.0),
            (20.0, 8.0),
            (8.0, 8.0),
            (8.0, 16.0),
            (0.0, 16.0),
        ]
        .map(DVec2::from),
        30.0,
    );
    let concave = (0..angle_profile.edges().len())
        .find(|e| angle_profile.edges()[*e].kind == acies::nominal::EdgeKind::Concave)
        .expect("an L has a concave edge");
    for (solid, edge, name) in [
        (&block, 5, "60 degrees"),
        (&block, 8, "90 degrees"),
        (&block, 11, "120 degrees"),
        (&block, 14, "150 degrees"),
        (&angle_profile, concave, "concave"),
    ] {
        for radius in [0.2, 0.05] {
            let mut found = Recovered::default();
            let mut below: f64 = 0.0;
            let mut kinds = [0; 4];
            broken(
                solid,
                edge,
                Break::Round(radius),
                &none,
                seeds,
                |_, edge| {
                    found.breaks(edge, |shape| match shape.shape {
                        BreakShape::Round { radius_mm } => Some((radius_mm, radius)),
                        BreakShape::Sharp { radius_below_mm } => {
                            below = below.max(radius_below_mm);
                            kinds[0] += 1;
                            None
                        }
                        BreakShape::Chamfer { .. } => {
                            kinds[1] += 1;
                            None
                        }
                        BreakShape::Irregular => {
                            kinds[2] += 1;
                            None
                        }
                        BreakShape::Undecided { .. } => {
                            kinds[3] += 1;
                            None
                        }
                    });
                },
            );
            found.row(&format!("radius, {name}, mm"), radius);
            if found.other > 0 {
                let [sharp, chamfer, irregular, undecided] = kinds;
                println!(
                    "    other: {sharp} sharp (below {below:.3} mm at most), {chamfer} chamfers, {undecided} undecided, {irregular} irregular"
                );
            }
        }
    }
    let mut sharp = Recovered::default();
    let mut bounds = Vec::new();
    broken(&block, 8, Break::Sharp, &none, seeds, |_, edge| {
        sharp.breaks(edge, |shape| {
            if let BreakShape::Sharp { radius_below_mm } = shape.shape {
                bounds.push(radius_below_mm);
                return Some((
                    Quantified {
                        value: radius_below_mm,
                        u: radius_below_mm,
                    },
                    0.0,
                ));
            }
            None
        });
    });
    sharp.row("radius below, sharp edge, mm", 0.0);
    let legs = Break::Chamfer(0.3, 0.3);
    let mut rows: [Recovered; 4] = Default::default();
    broken(&block, 8, legs, &none, seeds, |_, edge| {
        for shape in &edge.breaks {
            match shape.shape {
                BreakShape::Chamfer { legs_mm, angle_rad } => {
                    rows[0].add(legs_mm[0], 0.3);
                    rows[1].add(legs_mm[1], 0.3);
                    rows[2].add(angle_rad, std::f64::consts::FRAC_PI_4);
                    rows[3].add(shape.truncation_mm, 0.3 * std::f64::consts::FRAC_1_SQRT_2);
                }
                _ => rows.iter_mut().for_each(|r| r.other += 1),
            }
        }
    });
    rows[0].row("chamfer leg 1, mm", 0.3);
    rows[1].row("chamfer leg 2, mm", 0.3);
    rows[2].row("chamfer angle, rad", std::f64::consts::FRAC_PI_4);
    rows[3].row(
        "chamfer truncation, mm",
        0.3 * std::f64::consts::FRAC_1_SQRT_2,
    );
    let mut burr = Recovered::default();
    broken(
        &block,
        8,
        Break::Burr(0.05, 0.1),
        &none,
        seeds,
        |_, edge| {
            burr.breaks(edge, |shape| {
                (shape.burr_mm.value > 0.0).then_some((shape.burr_mm, 0.05))
            });
        },
    );
    burr.row("burr, mm", 0.05);
    let mut notch: [Recovered; 2] = Default::default();
    broken(
        &block,
        8,
        Break::Undercut(0.1, 0.3),
        &none,
        seeds,
        |_, edge| {
            for shape in &edge.breaks {
                if shape.shape == BreakShape::Irregular {
                    notch[0].add(shape.undercut_mm[0], 0.1);
                    notch[1].add(shape.undercut_mm[1], 0.3);
                } else {
                    notch.iter_mut().for_each(|r| r.other += 1);
                }
            }
        },
    );
    notch[0].row("undercut below face 1, mm", 0.1);
    notch[1].row("undercut below face 2, mm", 0.3);
    println!();
}

impl Recovered {
    fn breaks(
        &mut self,
        edge: &MeasuredEdge,
        mut pick: impl FnMut(&EdgeBreak) -> Option<(Quantified, f64)>,
    ) {
        for shape in &edge.breaks {
            match pick(shape) {
                Some((found, truth)) => self.add(found, truth),
                None => self.other += 1,
            }
        }
    }
}

// ---- figure 2 ----

/// A part with three exact datum faces and others displaced, its upright edges rounded, scanned anywhere.
fn honesty(seeds: u64) {
    let radius = 0.3;
    let clock = Instant::now();
    let mut rows: [Recovered; 4] = Default::default();
    let mut ratios: [Vec<f64>; 3] = Default::default();
    let mut drawn_inside = [0.0; 3];
    let mut drawn_count = 0.0;
    let mut refused = 0;
    for seed in 1..=seeds {
        let mut noise = Noise(7000 + seed);
        let mut solid = block();
        for (f, made) in solid.made.iter_mut().enumerate() {
            // Top and two of the sides are the datums.
            if ![1, 2, 3].contains(&f) {
                made.offset = 0.06 * (noise.uniform() - 0.5);
            }
        }
        let deviation = |e: usize| {
            let faces = solid.edges()[e].faces;
            let solid = &solid;
            move |i: usize, p: DVec3| solid.made_at(faces[i], p)
        };
        let functions: Vec<_> = STRAIGHT.iter().map(|(e, _)| deviation(*e)).collect();
        let made: Vec<Made<'_, Solid>> = STRAIGHT
            .iter()
            .zip(&functions)
            .map(|((e, _), f)| Made::new(&solid, *e, f, Break::Round(radius)))
            .collect();
        let mut cloud = empty_cloud();
        for made in &made {
            made.scan(Layout::Random(60.0), (1.0, 29.0), &mut cloud, &mut noise);
        }
        scatter_faces(&solid, &mut cloud, &mut noise);
        let machine_from_part = noise.motion(0.3, 5.0);
        let scan = cloud.map(
            Frame::Machine,
            |p| machine_from_part.point(p),
            |v| machine_from_part.vector(v),
        );
        let neighbors = Neighbors::new(&scan.positions);
        let surface = Surface::new(&solid);
        let spacing = acies::points::spacing(&scan, &neighbors);
        let start = noise.motion(0.02, 0.2) * machine_from_part.inverse();
        let aligned = align(
            &Scan {
                cloud: &scan,
                neighbors: &neighbors,
                spacing,
                noise_mm: SIGMA,
            },
            &surface,
            Start::Rough(start),
            &AlignOptions {
                datum_faces: &[1, 2, 3],
                touches: &[],
                ..AlignOptions::default()
            },
        );
        if aligned.alignment.status != acies::inspect::result::Verdict::Ok {
            refused += 1;
            continue;
        }
        let pose: RigidTransform = aligned.alignment.part_from_machine;
        let part = scan.map(Frame::Part, |p| pose.point(p), |v| pose.vector(v));
        let places = surface.places(&part, 2.0);
        let settings = MeasureSettings {
            pose_covariance: aligned.alignment.covariance,
            ..settings(0.129, 0.129)
        };
        let edges = measure_edges(&part, &places, &surface, &settings);
        let drawn = (seed <= 10).then(|| {
            let how = MonteCarlo {
                seed,
                block: 2_000,
                blocks_max: 2,
                ..MonteCarlo::default()
            };
            measure_monte_carlo(&part, &places, &surface, &settings, &how)
        });
        for ((e, _), made) in STRAIGHT.iter().zip(&made) {
            for (k, station) in edges[*e].stations.iter().enumerate() {
                let Ok(m) = &station.outcome else { continue };
                let truth = made.true_d(&station.station);
                for i in 0..2 {
                    rows[i].add(
                        Quantified {
                            value: m.d_mm[i],
                            u: m.u_d_mm[i],
                        },
                        truth[i],
                    );
                }
                let angle = made.true_angle(&station.station);
                rows[2].add(
                    Quantified {
                        value: m.included_angle_rad,
                        u: m.u_included_angle_rad,
                    },
                    angle,
                );
                if let Some(Some(d)) = drawn.as_ref().map(|all| all[*e][k]) {
                    let pairs = [
                        (d.d_mm[0], m.u_d_mm[0], truth[0]),
                        (d.d_mm[1], m.u_d_mm[1], truth[1]),
                        (d.included_angle_rad, m.u_included_angle_rad, angle),
                    ];
                    drawn_count += 1.0;
                    for (v, (value, u, truth)) in pairs.iter().enumerate() {
                        ratios[v].push(value.u / u);
                        drawn_inside[v] +=
                            f64::from(value.interval[0] <= *truth && *truth <= value.interval[1]);
                    }
                }
            }
            rows[3].breaks(&edges[*e], |shape| match shape.shape {
                BreakShape::Round { radius_mm } => Some((radius_mm, radius)),
                _ => None,
            });
        }
    }
    println!(
        "honesty with the alignment free, {seeds} seeds, {refused} alignments refused, {:.0} s",
        clock.elapsed().as_secs_f64()
    );
    println!(
        "{:<44} {:>9} {:>6} {:>10} {:>9} {:>9} {:>7} {:>7} {:>5}",
        "value", "", "values", "mean error", "rms", "mean u", "z rms", "95 %", "other"
    );
    for (row, name) in
        rows.iter()
            .zip(["d1, mm", "d2, mm", "included angle, rad", "edge radius, mm"])
    {
        row.row(
            name,
            if name.starts_with("edge") {
                radius
            } else {
                0.0
            },
        );
    }
    for (v, name) in ["d1", "d2", "included angle"].iter().enumerate() {
        let n = ratios[v].len() as f64;
        let mean = ratios[v].iter().sum::<f64>() / n;
        let spread = (ratios[v].iter().map(|r| (r - mean).powi(2)).sum::<f64>() / n).sqrt();
        println!(
            "Monte Carlo over first order, {name}: {mean:.3} +- {spread:.3}; its own interval holds {:.1} % of {drawn_count}",
            100.0 * drawn_inside[v] / drawn_count
        );
    }
    println!();
}

/// Points all over the faces of the block, away from its upright edges: what holds the alignment.
fn scatter_faces(solid: &Solid, cloud: &mut PointCloud, noise: &mut Noise) {
    let edges: Vec<_> = STRAIGHT
        .iter()
        .map(|(e, _)| solid.station(*e, 15.0).point)
        .chain([solid.station(2, 15.0).point])
        .collect();
    for sample in solid.samples(0.4) {
        let clear = edges
            .iter()
            .all(|p| (p.truncate() - sample.point.truncate()).length() > 2.6);
        if !clear || sample.face == 0 {
            continue;
        }
        let height = solid.made_at(sample.face, sample.point) + SIGMA * noise.normal();
        cloud.positions.push(sample.point + height * sample.normal);
    }
}

// ---- speed ----

fn speed() {
    let mut noise = Noise(1);
    // Six corners: eighteen edges, about twenty.
    let outline: Vec<DVec2> = (0..6)
        .map(|k| 40.0 * DVec2::from_angle(f64::from(k) * std::f64::consts::TAU / 6.0))
        .collect();
    let solid = Solid::prism(&outline, 40.0);
    let area = 2.0 * 4157.0 + 6.0 * 1600.0;
    let spacing = (area / 1e6f64).sqrt();
    let positions: Vec<DVec3> = solid
        .samples(spacing)
        .into_iter()
        .map(|s| s.point + SIGMA * noise.normal() * s.normal)
        .collect();
    let cloud = PointCloud::from_positions(Frame::Part, positions);
    let surface = Surface::new(&solid);
    let places = surface.places(&cloud, 2.0);
    let settings = MeasureSettings {
        station_step_mm: None,
        flank_mm: None,
        ..settings(spacing, spacing)
    };
    for _ in 0..3 {
        let clock = Instant::now();
        let neighbors = Neighbors::new(&cloud.positions);
        let far: f64 = (0..cloud.positions.len())
            .into_par_iter()
            .map_init(Vec::new, |found, i| {
                neighbors.nearest(cloud.positions[i], 20, found);
                found.last().map_or(0.0, |f| f.1)
            })
            .sum();
        let search = clock.elapsed().as_secs_f64();
        println!(
            "20 neighbours of every point: {search:.2} s (mean square of the farthest {:.4} mm2)",
            far / 1e6
        );
        let clock = Instant::now();
        let edges = measure_edges(&cloud, &places, &surface, &settings);
        let stations: usize = edges.iter().map(|e| e.stations.len()).sum();
        println!(
            "measure_edges: {} points, {} edges, {stations} stations: {:.2} s on {} threads",
            cloud.positions.len(),
            edges.len(),
            clock.elapsed().as_secs_f64(),
            rayon::current_num_threads()
        );
    }
}

//! Inspection against exact solids whose deviations are known: honesty of every uncertainty, reasons, alignment.

#![allow(
    clippy::print_stdout,
    reason = "the figures are to be seen with --nocapture"
)]

#[path = "inspect/solids.rs"]
mod solids;
#[path = "inspect/trials.rs"]
mod trials;
#[path = "inspect/whole.rs"]
mod whole;

use acies::geometry::RigidTransform;
use acies::geometry::fit::invert_spd;
use acies::inspect::align::{AlignOptions, Aligned, Scan, Start, Touch, align};
use acies::inspect::assign::Surface;
use acies::inspect::body::Body;
use acies::inspect::measure::{MeasureSettings, MeasuredEdge, measure_edges};
use acies::inspect::result::Verdict;
use acies::inspect::{Recipe, Request, inspect};
use acies::nominal::Nominal;
use acies::points::{Frame, Neighbors, PointCloud};
use glam::{DVec2, DVec3};
use solids::{ACROSS, ALONG, Made, Noise, Solid};

const SIGMA: f64 = 0.010;

/// An L.
const ANGLE_PROFILE: [(f64, f64); 6] = [
    (0.0, 0.0),
    (20.0, 0.0),
    (20.0, 8.0),
    (8.0, 8.0),
    (8.0, 16.0),
    (0.0, 16.0),
];

const SETTINGS: MeasureSettings = MeasureSettings {
    along_mm: ALONG,
    across_mm: ACROSS,
    noise_mm: SIGMA,
    station_step_mm: None,
    pose_covariance: [[0.0; 6]; 6],
    u_calibration_mm: 0.0,
    u_calibration_rad: 0.0,
    flank_mm: None,
    depth_mm: None,
    expansion: None,
};

/// Measures a cloud that lies in the part frame exactly.
fn measure(solid: &Solid, cloud: &PointCloud) -> Vec<MeasuredEdge> {
    let surface = Surface::new(solid);
    let places = surface.places(cloud, 2.0);
    measure_edges(cloud, &places, &surface, &SETTINGS)
}

/// z-scores collected over stations, edges and seeds.
#[derive(Default)]
struct Scores {
    z: Vec<f64>,
    angle_z: Vec<f64>,
    mean_z: Vec<f64>,
    unmeasured: usize,
}

impl Scores {
    fn take_in(&mut self, solid: &Solid, edges: &[MeasuredEdge], wanted: impl Fn(usize) -> bool) {
        for (e, edge) in edges.iter().enumerate().filter(|(e, _)| wanted(*e)) {
            let mut truth = [0.0; 2];
            let mut n = 0.0;
            for station in &edge.stations {
                let Ok(measured) = &station.outcome else {
                    self.unmeasured += 1;
                    continue;
                };
                let expected = solid.true_d(e, &station.station);
                for (i, sum) in truth.iter_mut().enumerate() {
                    self.z
                        .push((measured.d_mm[i] - expected[i]) / measured.u_d_mm[i]);
                    *sum += expected[i];
                }
                n += 1.0;
                let nominal = acies::inspect::virtual_edge::nominal_angle(
                    &station.station,
                    solid.edges()[e].kind,
                );
                let deviation = measured.included_angle_rad - nominal;
                let expected = solid.true_angle_deviation(e, &station.station);
                self.angle_z
                    .push((deviation - expected) / measured.u_included_angle_rad);
            }
            if let Some(mean) = &edge.mean {
                for (i, sum) in truth.iter().enumerate() {
                    self.mean_z.push((mean.d_mm[i] - sum / n) / mean.u_d_mm[i]);
                }
            }
        }
    }

    /// rms of z is 1 within 3 sqrt(1 / 2n); the share within 2 is 0.9545 within 3 sqrt(0.0434 / n); 0.03 more on both for
    /// what is by design: trimming, cuts chosen from the data, noise that is estimated.
    fn assert_honest(&self, name: &str) {
        for (what, z) in [
            ("d", &self.z),
            ("angle", &self.angle_z),
            ("mean", &self.mean_z),
        ] {
            let n = z.len() as f64;
            let rms = (z.iter().map(|z| z * z).sum::<f64>() / n).sqrt();
            let share = z.iter().filter(|z| z.abs() < 2.0).count() as f64 / n;
            println!(
                "{name}, {what}: n {n}, z rms {rms:.3}, within two {share:.3}, unmeasured {}",
                self.unmeasured
            );
            assert!(
                (rms - 1.0).abs() < 3.0 * (0.5 / n).sqrt() + 0.03,
                "{name}, {what}: {rms}"
            );
            assert!(
                (share - 0.9545).abs() < 3.0 * (0.0434 / n).sqrt() + 0.03,
                "{name}, {what}: {share}"
            );
        }
    }
}

/// A cuboid of which every face is off by up to 0.15 mm and tilted by up to 2 mrad.
fn made_cuboid(noise: &mut Noise) -> Solid {
    let mut solid = Solid::cuboid(20.0, 14.0, 10.0);
    make(&mut solid, noise);
    solid
}

fn make(solid: &mut Solid, noise: &mut Noise) {
    for face in 0..solid.face_count() as u32 {
        let normal = solid
            .samples(1.0)
            .iter()
            .find(|s| s.face == face)
            .expect("every face has samples")
            .normal;
        let gradient = 0.002 * noise.direction();
        solid.made[face as usize] = Made {
            offset: 0.3 * (noise.uniform() - 0.5),
            gradient: gradient - gradient.dot(normal) * normal,
        };
    }
}

#[test]
fn edges_of_a_cuboid_are_measured_honestly() {
    let mut scores = Scores::default();
    let (mut ratio, mut stations) = (0.0, 0.0);
    for seed in 1..=4 {
        let mut noise = Noise(seed);
        let solid = made_cuboid(&mut noise);
        let cloud = solid.scan(&[1, 2, 3, 4, 5], SIGMA, &mut noise);
        let edges = measure(&solid, &cloud);
        // Edges of the bottom are no part of this test.
        let upper = |e: usize| solid.edges()[e].faces[0] != 0;
        scores.take_in(&solid, &edges, upper);
        for edge in edges
            .iter()
            .enumerate()
            .filter(|(e, _)| upper(*e))
            .map(|(_, e)| e)
        {
            for station in &edge.stations {
                let Ok(m) = &station.outcome else { continue };
                for i in 0..2 {
                    let bound = 2.0 * SIGMA / (station.points[i] as f64).sqrt();
                    ratio += m.u_d_mm[i] / bound;
                    stations += 1.0;
                }
            }
        }
    }
    scores.assert_honest("cuboid");
    assert_eq!(scores.unmeasured, 0);
    println!(
        "u over the bound 2 sigma / sqrt(N): {:.3}",
        ratio / stations
    );
    assert!(ratio / stations < 1.2, "{}", ratio / stations);
}

#[test]
fn a_wedge_and_a_concave_edge_are_measured_honestly() {
    let wedge = [(0.0, 0.0), (20.0, 0.0), (0.0, 12.0)].map(DVec2::from);
    let angle = ANGLE_PROFILE.map(DVec2::from);
    for (name, outline) in [("wedge", &wedge[..]), ("angle profile", &angle[..])] {
        let mut scores = Scores::default();
        for seed in 1..=3 {
            let mut noise = Noise(seed);
            let mut solid = Solid::prism(outline, 12.0);
            make(&mut solid, &mut noise);
            let faces: Vec<u32> = (0..solid.face_count() as u32).collect();
            let cloud = solid.scan(&faces, SIGMA, &mut noise);
            scores.take_in(&solid, &measure(&solid, &cloud), |_| true);
        }
        scores.assert_honest(name);
    }
}

#[test]
fn the_rims_of_a_cylinder_are_measured_honestly() {
    let mut scores = Scores::default();
    for seed in 1..=6 {
        let mut noise = Noise(seed);
        let mut solid = Solid::cylinder(8.0, 12.0);
        solid.made[1].offset = 0.1;
        solid.made[2].offset = -0.08;
        solid.made[1].gradient = DVec3::new(0.001, -0.002, 0.0);
        let cloud = solid.scan(&[1, 2], SIGMA, &mut noise);
        scores.take_in(&solid, &measure(&solid, &cloud), |e| e == 1);
    }
    scores.assert_honest("cylinder");
    assert_eq!(scores.unmeasured, 0);
}

#[test]
fn an_edge_with_one_flank_seen_is_a_boundary() {
    let mut noise = Noise(3);
    let solid = Solid::cuboid(20.0, 14.0, 10.0);
    let cloud = solid.scan(&[1], SIGMA, &mut noise);
    let edges = measure(&solid, &cloud);
    for (edge, result) in solid.edges().iter().zip(&edges) {
        for station in &result.stations {
            let reason = station.outcome.as_ref().expect_err("one flank is no edge");
            if edge.faces[0] == 1 {
                assert_eq!(
                    *reason,
                    format!(
                        "boundary: only flank 1 (face #11) was seen, no points on flank 2 (face #{})",
                        edge.faces[1] + 10
                    )
                );
            } else {
                assert_eq!(reason, "no points on either flank");
            }
        }
        assert!(result.mean.is_none());
    }
}

// ---- alignment ----

fn align_scan(solid: &Solid, cloud: &PointCloud, start: Start, options: &AlignOptions) -> Aligned {
    let neighbors = Neighbors::new(&cloud.positions);
    let spacing = acies::points::spacing(cloud, &neighbors);
    let scan = Scan {
        cloud,
        neighbors: &neighbors,
        spacing,
        noise_mm: acies::points::noise_mm(cloud, &neighbors, &spacing),
    };
    align(&scan, &Surface::new(solid), start, options)
}

/// Squared Mahalanobis length of the pose error: chi-square with 6 degrees of freedom where the covariance is honest.
fn mahalanobis(aligned: &Aligned, truth: &RigidTransform) -> f64 {
    let error = aligned.alignment.part_from_machine * truth.inverse();
    let turn = error.rotation.to_scaled_axis();
    let v = [
        turn.x,
        turn.y,
        turn.z,
        error.translation.x,
        error.translation.y,
        error.translation.z,
    ];
    let inverse = invert_spd(&aligned.alignment.covariance).expect("a covariance");
    (0..6)
        .map(|i| v[i] * (0..6).map(|j| inverse[i][j] * v[j]).sum::<f64>())
        .sum()
}

fn moved(cloud: &PointCloud, machine_from_part: &RigidTransform) -> PointCloud {
    cloud.map(
        Frame::Machine,
        |p| machine_from_part.point(p),
        |v| machine_from_part.vector(v),
    )
}

#[test]
fn a_rough_start_is_refined_to_within_its_covariance() {
    let (mut exact, mut made) = (0.0, 0.0);
    const SEEDS: u64 = 3;
    for seed in 1..=SEEDS {
        for with_deviations in [false, true] {
            let mut noise = Noise(seed);
            let mut solid = Solid::prism(&ANGLE_PROFILE.map(DVec2::from), 12.0);
            let datums = [1, 2, 3];
            if with_deviations {
                make(&mut solid, &mut noise);
                for d in datums {
                    solid.made[d as usize] = Made::default();
                }
            }
            let machine_from_part = noise.motion(0.2, 2.0);
            let cloud = moved(
                &solid.scan(&[1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise),
                &machine_from_part,
            );
            let start = noise.motion(0.15, 1.0) * machine_from_part.inverse();
            let options = AlignOptions {
                datum_faces: if with_deviations { &datums } else { &[] },
                ..AlignOptions::default()
            };
            let aligned = align_scan(&solid, &cloud, Start::Rough(start), &options);
            assert_eq!(
                aligned.alignment.status,
                Verdict::Ok,
                "{:?}",
                aligned.findings
            );
            let squared = mahalanobis(&aligned, &machine_from_part.inverse());
            println!(
                "seed {seed}, datums {with_deviations}: chi-square {squared:.2}, rms {:.4}",
                aligned.alignment.rms_mm
            );
            if with_deviations {
                made += squared
            } else {
                exact += squared
            }
        }
    }
    // Mean of 3 chi-squares of 6 degrees of freedom: 6, standard deviation 2; 2.5 of them.
    let n = SEEDS as f64;
    println!(
        "mean chi-square: all faces {:.2}, datums {:.2}",
        exact / n,
        made / n
    );
    assert!((0.9..11.1).contains(&(exact / n)), "{}", exact / n);
    assert!((0.9..11.1).contains(&(made / n)), "{}", made / n);
}

#[test]
fn faces_that_depart_widen_the_covariance() {
    let mut sum = 0.0;
    for seed in 1..=4 {
        let mut noise = Noise(seed);
        let mut solid = Solid::prism(&ANGLE_PROFILE.map(DVec2::from), 12.0);
        make(&mut solid, &mut noise);
        let cloud = solid.scan(&[0, 1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise);
        let start = noise.motion(0.1, 1.0);
        let aligned = align_scan(
            &solid,
            &cloud,
            Start::Rough(start),
            &AlignOptions::default(),
        );
        let squared = mahalanobis(&aligned, &RigidTransform::IDENTITY);
        println!(
            "seed {seed}: {squared:.2} rms {:.3}",
            aligned.alignment.rms_mm
        );
        sum += squared;
    }
    println!("mean {:.2}", sum / 4.0);
    assert!(sum / 4.0 < 18.0);
}

#[test]
fn a_cylinder_may_turn_and_that_is_said() {
    let mut noise = Noise(5);
    let solid = Solid::cylinder(8.0, 12.0);
    let cloud = solid.scan(&[1, 2], SIGMA, &mut noise);
    let aligned = align_scan(
        &solid,
        &cloud,
        Start::Rough(noise.motion(0.1, 0.5)),
        &AlignOptions::default(),
    );
    assert_eq!(aligned.alignment.weak_directions, ["rotation about z"]);
    assert_eq!(
        aligned.alignment.status,
        Verdict::Ok,
        "no edge moves: {:?}",
        aligned.findings
    );
    let side = align_scan(
        &solid,
        &solid.scan(&[2], SIGMA, &mut noise),
        Start::Rough(noise.motion(0.02, 0.2)),
        &AlignOptions::default(),
    );
    assert_eq!(
        side.alignment.weak_directions,
        ["along z", "rotation about z"]
    );
    assert_eq!(side.alignment.status, Verdict::NotDecidable);
    assert!(
        side.findings[0].contains("which moves edge e1"),
        "{:?}",
        side.findings
    );
}

#[test]
fn touches_hold_what_the_scan_does_not() {
    let mut noise = Noise(6);
    let solid = Solid::cuboid(20.0, 14.0, 10.0);
    let cloud = solid.scan(&[1], SIGMA, &mut noise);
    let touch = |x: f64, y: f64, z: f64| Touch {
        point: DVec3::new(x, y, z),
        u_mm: 0.002,
    };
    let touches = [
        touch(0.0, 7.0, 5.0),
        touch(4.0, 0.0, 5.0),
        touch(16.0, 0.0, 5.0),
    ];
    let without = align_scan(
        &solid,
        &cloud,
        Start::Rough(RigidTransform::IDENTITY),
        &AlignOptions::default(),
    );
    assert_eq!(without.alignment.status, Verdict::NotDecidable);
    let options = AlignOptions {
        touches: &touches,
        ..AlignOptions::default()
    };
    let start = noise.motion(0.02, 0.3);
    let with = align_scan(&solid, &cloud, Start::Rough(start), &options);
    assert_eq!(with.alignment.status, Verdict::Ok, "{:?}", with.findings);
    let squared = mahalanobis(&with, &RigidTransform::IDENTITY);
    println!("touches: {squared:.2}");
    // 0.999 quantile of chi-square with 6 degrees of freedom.
    assert!(squared < 22.5, "{squared}");
}

#[test]
fn a_pose_is_found_from_nothing() {
    {
        let seed = 1;
        let mut noise = Noise(seed);
        let solid = Solid::prism(&ANGLE_PROFILE.map(DVec2::from), 12.0);
        let angle = 3.0 * noise.uniform();
        let machine_from_part = noise.motion(angle, 200.0);
        let cloud = moved(
            &solid.scan(&[1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise),
            &machine_from_part,
        );
        for known in [true, false] {
            let mut cloud = cloud.clone();
            if !known {
                cloud.origins.clear();
                cloud.views.clear();
            }
            let clock = std::time::Instant::now();
            let aligned = align_scan(&solid, &cloud, Start::Auto, &AlignOptions::default());
            println!("{:?} {:?}", clock.elapsed(), aligned.findings);
            assert_eq!(
                aligned.alignment.status,
                Verdict::Ok,
                "{:?}",
                aligned.findings
            );
            let squared = mahalanobis(&aligned, &machine_from_part.inverse());
            println!("seed {seed}, sensor known {known}: chi-square {squared:.2}");
            // 0.999 quantile of chi-square with 6 degrees of freedom.
            assert!(squared < 22.5, "seed {seed}: {squared}");
        }
    }
}

#[test]
fn a_symmetric_part_is_ambiguous() {
    let mut noise = Noise(2);
    let solid = Solid::cuboid(20.0, 14.0, 10.0);
    let scan = solid.scan(&[1, 2, 3, 4, 5], SIGMA, &mut noise);
    let cloud = moved(&scan, &noise.motion(1.0, 50.0));
    let aligned = align_scan(&solid, &cloud, Start::Auto, &AlignOptions::default());
    assert_eq!(aligned.alignment.status, Verdict::NotDecidable);
    assert!(
        aligned
            .findings
            .iter()
            .any(|f| f.starts_with("alignment: 4 poses fit the scan equally well")),
        "a cuboid maps onto itself by the identity and three half turns: {:?}",
        aligned.findings
    );
}

/// Plane, cylindrical and free-form faces as read from STEP.
#[test]
fn a_part_read_from_step_and_sampled_as_drawn_has_no_deviation() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
    let nominal = Nominal::read(&path).expect("the demo's part");
    let mut noise = Noise(4);
    let spacing_mm = 0.3;
    let positions: Vec<DVec3> = Nominal::samples(&nominal, spacing_mm)
        .into_iter()
        .map(|s| s.point + SIGMA * noise.normal() * s.normal)
        .collect();
    let cloud = PointCloud::from_positions(Frame::Part, positions);
    let surface = Surface::new(&nominal);
    let places = surface.places(&cloud, 2.0);
    let settings = MeasureSettings {
        along_mm: spacing_mm,
        across_mm: spacing_mm,
        ..SETTINGS
    };
    let mut z = Vec::new();
    for edge in measure_edges(&cloud, &places, &surface, &settings) {
        for station in &edge.stations {
            let measured = station.outcome.as_ref().expect("every edge is all there");
            z.extend([0, 1].map(|i| measured.d_mm[i] / measured.u_d_mm[i]));
        }
    }
    let n = z.len() as f64;
    let rms = (z.iter().map(|z| z * z).sum::<f64>() / n).sqrt();
    let share = z.iter().filter(|z| z.abs() < 2.0).count() as f64 / n;
    println!("n {n}, z rms {rms:.3}, within two {share:.3}");
    // As in Scores::assert_honest.
    assert!((rms - 1.0).abs() < 3.0 * (0.5 / n).sqrt() + 0.03, "{rms}");
    assert!(
        (share - 0.9545).abs() < 3.0 * (0.0434 / n).sqrt() + 0.03,
        "{share}"
    );
}

#[test]
fn an_inspection_judges_by_its_recipe() {
    let mut noise = Noise(8);
    let mut solid = Solid::cuboid(8.0, 6.0, 5.0);
    // The right side is 0.2 mm too far out.
    solid.made[3].offset = 0.2;
    let machine_from_part = noise.motion(0.5, 20.0);
    let scan = solid.scan(&[1, 2, 3, 4, 5], SIGMA, &mut noise);
    let cloud = moved(&scan, &machine_from_part);
    let recipe = Recipe::parse(
        "rule = { guard_band = 2.0 }\ndatum_faces = [11, 12, 15, 99]\n[limits]\nd_mm = [-0.05, 0.05]\n\
         [[edge]]\nid = \"e2\"\nname = \"front lip\"\nd1_mm = [-0.1, 0.1]\n[[edge]]\nentity = 7\n",
    )
    .expect("a recipe");
    let start = noise.motion(0.05, 0.3) * machine_from_part.inverse();
    let told = std::sync::Mutex::new(Vec::new());
    let inspection = inspect(
        &cloud,
        &solid,
        &Request {
            progress: &|stage| told.lock().expect("one thread tells").push(stage),
            ..Request::new(&recipe, Start::Rough(start))
        },
    );
    assert_eq!(
        inspection.alignment.status,
        Verdict::Ok,
        "{:?}",
        inspection.findings
    );
    assert_eq!(inspection.verdict, Verdict::NotOk);
    let stages: Vec<&str> = inspection.seconds.iter().map(|s| s.0).collect();
    assert_eq!(*told.lock().expect("all told"), stages);
    for (edge, nominal) in inspection.edges.iter().zip(solid.edges()) {
        let expected = if nominal.faces == [0, 3] {
            // The bottom was not scanned, and the boundary of the right side is as far out as the side.
            Verdict::NotOk
        } else if nominal.faces.contains(&0) {
            Verdict::NotDecidable
        } else if nominal.id == "e2" {
            Verdict::Ok
        } else if nominal.faces.contains(&3) {
            Verdict::NotOk
        } else {
            Verdict::Ok
        };
        assert_eq!(edge.verdict, expected, "{} of {:?}", edge.id, nominal.faces);
    }
    assert!(inspection.edges.iter().any(|e| e.id == "front lip"));
    for expected in [
        "recipe: datum_faces: #99 is no face of the nominal, expected the entity of a face; the datum is left out",
        "recipe: edge: #7 is no sharp edge of the nominal, expected its entity or id; the entry is left out",
    ] {
        assert!(
            inspection.findings.iter().any(|f| f == expected),
            "{:?}",
            inspection.findings
        );
    }
}

#[test]
fn a_scan_of_nothing_and_a_scan_elsewhere_are_findings() {
    let solid = Solid::cuboid(8.0, 6.0, 5.0);
    let recipe = Recipe::default();
    let empty = PointCloud::from_positions(Frame::Machine, Vec::new());
    for start in [
        Start::None,
        Start::Auto,
        Start::Rough(RigidTransform::IDENTITY),
    ] {
        let inspection = inspect(&empty, &solid, &Request::new(&recipe, start));
        assert!(inspection.edges.iter().all(|e| e.coverage == 0.0));
        if start == Start::Auto {
            assert_eq!(
                inspection.findings,
                ["alignment: no pose of the scan fits the nominal; give a rough start"]
            );
        }
    }
    let same = PointCloud::from_positions(Frame::Machine, vec![DVec3::splat(1e4); 10_000]);
    let start = Start::Rough(RigidTransform::IDENTITY);
    let inspection = inspect(&same, &solid, &Request::new(&recipe, start));
    assert_eq!(inspection.verdict, Verdict::NotDecidable);
    assert!(
        inspection.findings[0].starts_with("alignment: fewer than 20 points lie near the nominal"),
        "{:?}",
        inspection.findings
    );
}

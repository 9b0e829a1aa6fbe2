//! Alignment against exact solids: found from far starts, and every wrong, mirrored, symmetric or half-held pose named as such.

#[allow(dead_code, reason = "the inspection's tests use the rest")]
#[path = "inspect/solids.rs"]
mod solids;

#[path = "align/datums.rs"]
mod datums;

use std::path::Path;

use acies::geometry::RigidTransform;
use acies::geometry::fit::invert_spd;
use acies::inspect::align::datum::{Datum, DatumError, pose_from_datums};
use acies::inspect::align::{AlignOptions, Aligned, Conclusion, Scan, Start, StartWithin, align};
use acies::inspect::assign::{NO_FACE, Surface};
use acies::inspect::body::Body;
use acies::inspect::result::Verdict;
use acies::nominal::Nominal;
use acies::points::{Frame, Neighbors, PointCloud, noise_mm, spacing};
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};
use solids::{Noise, Solid};

const SIGMA: f64 = 0.010;

/// An L without any symmetry but the mirror half way up.
fn angle() -> Solid {
    let outline = [
        (0.0, 0.0),
        (10.0, 0.0),
        (10.0, 4.0),
        (4.0, 4.0),
        (4.0, 8.0),
        (0.0, 8.0),
    ];
    Solid::prism(&outline.map(DVec2::from), 6.0)
}

fn aligned<B: Body>(body: &B, cloud: &PointCloud, start: Start, options: &AlignOptions) -> Aligned {
    let neighbors = Neighbors::new(&cloud.positions);
    let spacing = spacing(cloud, &neighbors);
    let scan = Scan {
        cloud,
        neighbors: &neighbors,
        spacing,
        noise_mm: noise_mm(cloud, &neighbors, &spacing),
    };
    align(&scan, &Surface::new(body), start, options)
}

fn moved(cloud: &PointCloud, machine_from_part: &RigidTransform) -> PointCloud {
    cloud.map(
        Frame::Machine,
        |p| machine_from_part.point(p),
        |v| machine_from_part.vector(v),
    )
}

/// The error of a pose: rotation vector and translation, part frame.
fn error(pose: &RigidTransform, truth: &RigidTransform) -> [f64; 6] {
    let motion = *pose * truth.inverse();
    // The shorter way round: q and -q are one rotation.
    let q = motion.rotation;
    let q = if q.w < 0.0 { -q } else { q };
    let (a, b) = (q.to_scaled_axis().to_array(), motion.translation.to_array());
    [a[0], a[1], a[2], b[0], b[1], b[2]]
}

/// Squared length of an error in its standard deviations: chi-square with 6 degrees of freedom where the covariance is honest.
fn mahalanobis(aligned: &Aligned, truth: &RigidTransform) -> f64 {
    let v = error(&aligned.alignment.part_from_machine, truth);
    let inverse = invert_spd(&aligned.alignment.covariance).expect("a covariance");
    (0..6)
        .map(|i| v[i] * (0..6).map(|j| inverse[i][j] * v[j]).sum::<f64>())
        .sum()
}

/// A start off by 20 degrees about the middle of the part and by half its diagonal.
fn far_start<B: Body>(body: &B, truth: &RigidTransform, noise: &mut Noise) -> Start {
    let [low, high] = body.bounds();
    let middle = 0.5 * (low + high);
    let off = noise.motion(20f64.to_radians(), 0.5 * (high - low).length());
    let about = RigidTransform::new(
        off.rotation,
        middle - off.rotation * middle + off.translation,
    );
    Start::Rough(about * *truth)
}

#[test]
fn a_start_off_by_twenty_degrees_and_half_the_part_is_enough() {
    let solid = angle();
    for seed in 1..=4 {
        let mut noise = Noise(seed);
        let machine_from_part = noise.motion(1.0, 300.0);
        let truth = machine_from_part.inverse();
        // From above and two sides only, and from all around but below.
        let seen: &[u32] = if seed % 2 == 0 {
            &[1, 2, 3]
        } else {
            &[1, 2, 3, 4, 5, 6, 7]
        };
        let cloud = moved(&solid.scan(seen, SIGMA, &mut noise), &machine_from_part);
        let start = far_start(&solid, &truth, &mut noise);
        let found = aligned(&solid, &cloud, start, &AlignOptions::default());
        assert_eq!(found.conclusion, Conclusion::Good, "{:?}", found.findings);
        assert_eq!(found.alignment.status, Verdict::Ok);
        // 0.9999 quantile of chi-square with 6 degrees of freedom: four seeds, one in 2500 by chance.
        let squared = mahalanobis(&found, &truth);
        assert!(squared < 27.9, "seed {seed}: {squared}");
    }
}

#[test]
fn one_side_from_nothing_is_found_or_not_called_good() {
    let solid = angle();
    let mut noise = Noise(11);
    let machine_from_part = noise.motion(2.5, 800.0);
    let truth = machine_from_part.inverse();
    let cloud = moved(
        &solid.scan(&[1, 2, 3, 4, 5], SIGMA, &mut noise),
        &machine_from_part,
    );
    let found = aligned(&solid, &cloud, Start::Auto, &AlignOptions::default());
    assert_eq!(found.conclusion, Conclusion::Good, "{:?}", found.findings);
    // 0.999 quantile of chi-square with 6 degrees of freedom.
    let squared = mahalanobis(&found, &truth);
    assert!(squared < 22.5, "{squared}");
}

#[test]
fn covariances_are_honest_over_seeds() {
    let solid = angle();
    let near = AlignOptions {
        start_within: StartWithin {
            turn_rad: 0.05,
            shift_share: 0.1,
        },
        ..AlignOptions::default()
    };
    const SEEDS: u64 = 16;
    let mut sum = 0.0;
    for seed in 1..=SEEDS {
        let mut noise = Noise(100 + seed);
        let machine_from_part = noise.motion(1.0, 50.0);
        let truth = machine_from_part.inverse();
        let cloud = moved(
            &solid.scan(&[1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise),
            &machine_from_part,
        );
        let start = Start::Rough(noise.motion(0.03, 0.3) * truth);
        let found = aligned(&solid, &cloud, start, &near);
        assert_eq!(found.conclusion, Conclusion::Good, "{:?}", found.findings);
        sum += mahalanobis(&found, &truth);
    }
    // 0.025 and 0.975 quantiles of chi-square with 96 degrees of freedom.
    assert!((70.8..125.0).contains(&sum), "{sum}");
}

/// A casting of planes, holes and fillets that pass smoothly into them, as drawn but for noise: no form is there, so that the stated
/// covariance is that of the noise, of the points that are used and of Tukey's weights.
#[test]
fn fillets_as_drawn_are_no_form() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data/step/nist_ctc_03_asme1_ap242-e2.stp");
    if !path.is_file() {
        eprintln!("skipped: {} is not there", path.display());
        return;
    }
    let nominal = Nominal::read(&path).expect("a part");
    let area: f64 = nominal.faces.iter().map(|face| face.area_mm2()).sum();
    let spacing_mm = (area / 200_000.0).sqrt();
    let sigma = 0.1 * spacing_mm;
    let mut noise = Noise(11);
    let mut information = Matrix6::zeros();
    let positions = Nominal::samples(&nominal, spacing_mm).into_iter().map(|s| {
        let turn = s.point.cross(s.normal);
        let row = Vector6::new(turn.x, turn.y, turn.z, s.normal.x, s.normal.y, s.normal.z);
        information += row * row.transpose() / (sigma * sigma);
        s.point + sigma * noise.normal() * s.normal
    });
    let cloud = PointCloud::from_positions(Frame::Machine, positions.collect());
    let start = Start::Rough(RigidTransform::IDENTITY);
    let found = aligned(&nominal, &cloud, start, &AlignOptions::default());
    assert_eq!(found.conclusion, Conclusion::Good, "{:?}", found.findings);
    let stated = Matrix6::from_fn(|i, j| found.alignment.covariance[i][j]);
    let over_bound = (stated * information).trace() / 6.0;
    // Tukey's weights cost a twentieth, points near edges the rest; it was 4.2 when the noise of a point chose what lies near it.
    assert!((1.0..1.5).contains(&over_bound), "{over_bound}");
}

#[test]
fn a_symmetric_part_is_named_with_its_symmetry() {
    let mut noise = Noise(2);
    let solid = Solid::cuboid(10.0, 7.0, 5.0);
    let scan = solid.scan(&[1, 2, 3, 4, 5], SIGMA, &mut noise);
    let cloud = moved(&scan, &noise.motion(1.0, 50.0));
    let found = aligned(&solid, &cloud, Start::Auto, &AlignOptions::default());
    assert_eq!(
        found.conclusion,
        Conclusion::Ambiguous(4),
        "{:?}",
        found.findings
    );
    assert_eq!(found.alignment.status, Verdict::NotDecidable);
    for axis in ["x", "y", "z"] {
        let name = format!("a turn by 180 degrees about {axis}");
        assert!(found.findings[0].contains(&name), "{:?}", found.findings);
    }
}

#[test]
fn one_tooth_of_many_is_ambiguous_from_a_rough_start() {
    // Teeth 2 mm wide every 4 mm, of which the scan saw the middle two periods.
    let mut outline = vec![DVec2::new(0.0, -2.0), DVec2::new(24.0, -2.0)];
    for k in (0..6).rev() {
        let x = 4.0 * f64::from(k);
        outline.extend(
            [
                (x + 4.0, 0.0),
                (x + 3.0, 0.0),
                (x + 3.0, 2.0),
                (x + 1.0, 2.0),
                (x + 1.0, 0.0),
            ]
            .map(DVec2::from),
        );
    }
    outline.push(DVec2::new(0.0, 0.0));
    let solid = Solid::prism(&outline, 6.0);
    let mut noise = Noise(9);
    let faces: Vec<u32> = (0..solid.face_count() as u32).collect();
    let whole = solid.scan(&faces, SIGMA, &mut noise);
    let middle = |p: &DVec3| p.x > 8.0 && p.x < 16.0;
    let part: Vec<DVec3> = whole.positions.into_iter().filter(middle).collect();
    let cloud = PointCloud::from_positions(Frame::Part, part);
    let start = Start::Rough(noise.motion(0.1, 1.0));
    let found = aligned(&solid, &cloud, start, &AlignOptions::default());
    assert!(
        matches!(found.conclusion, Conclusion::Ambiguous(n) if n >= 3),
        "{:?}",
        found.findings
    );
    assert!(
        found.findings[0].contains("mm along x"),
        "{:?}",
        found.findings
    );
}

#[test]
fn a_flat_patch_holds_three_directions_and_says_so() {
    let mut noise = Noise(6);
    let solid = Solid::cuboid(10.0, 7.0, 5.0);
    let cloud = solid.scan(&[1], SIGMA, &mut noise);
    let start = Start::Rough(noise.motion(0.02, 0.2));
    let found = aligned(&solid, &cloud, start, &AlignOptions::default());
    assert_eq!(
        found.alignment.weak_directions,
        ["along x", "along y", "rotation about z"]
    );
    assert_eq!(found.conclusion, Conclusion::Free, "{:?}", found.findings);
    assert_eq!(found.alignment.status, Verdict::NotDecidable);
    assert!(
        found.eigenvalues[2] < 1.0 && found.eigenvalues[3] > 100.0,
        "{:?}",
        found.eigenvalues
    );
}

/// The demo's part, sampled as drawn.
fn demo_scan(nominal: &Nominal, noise: &mut Noise) -> Vec<DVec3> {
    Nominal::samples(nominal, 0.5)
        .into_iter()
        .map(|s| s.point + SIGMA * noise.normal() * s.normal)
        .collect()
}

#[test]
fn a_mirrored_part_and_another_part_are_not_fitted() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
    let nominal = Nominal::read(&path).expect("the demo's part");
    let mut noise = Noise(4);
    let points = demo_scan(&nominal, &mut noise);
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0));
    let mirrored = points.iter().map(|p| flip * *p).collect();
    let cloud = PointCloud::from_positions(Frame::Machine, mirrored);
    let found = aligned(&nominal, &cloud, Start::Auto, &AlignOptions::default());
    assert_eq!(
        found.conclusion,
        Conclusion::Mirrored,
        "{:?}",
        found.findings
    );
    assert_eq!(found.alignment.status, Verdict::NotDecidable);

    let other = angle();
    let scan = other.scan(&[1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise);
    let cuboid = Solid::cuboid(10.0, 8.0, 6.0);
    for start in [Start::Auto, Start::Rough(RigidTransform::IDENTITY)] {
        let found = aligned(&cuboid, &scan, start, &AlignOptions::default());
        // A cuboid looks the same after half turns, so that a scan of something else fits it badly in several ways alike.
        assert!(
            matches!(
                found.conclusion,
                Conclusion::Misfit | Conclusion::Ambiguous(_)
            ),
            "{:?}",
            found.findings
        );
        assert_eq!(found.alignment.status, Verdict::NotDecidable);
    }
}

#[test]
fn held_degrees_of_freedom_stay_where_they_are() {
    let solid = angle();
    let mut noise = Noise(5);
    let cloud = solid.scan(&[1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise);
    // The fixture is right about z and along z; the rest is to be found.
    let off = RigidTransform::new(
        DQuat::from_scaled_axis(DVec3::new(0.02, -0.015, 0.0)),
        DVec3::new(0.2, -0.1, 0.0),
    );
    let options = AlignOptions {
        held: [false, false, true, false, false, true],
        ..AlignOptions::default()
    };
    let start = off.inverse();
    let found = aligned(&solid, &cloud, Start::Rough(start), &options);
    let motion = found.alignment.part_from_machine * start.inverse();
    assert!(motion.rotation.to_scaled_axis().z.abs() < 1e-12, "held");
    assert!(motion.translation.z.abs() < 1e-12, "held");
    let covariance = found.alignment.covariance;
    assert!((0..6).all(|k| covariance[2][k] == 0.0 && covariance[k][5] == 0.0));
    let left = error(
        &found.alignment.part_from_machine,
        &RigidTransform::IDENTITY,
    );
    // The inverse of a turn and a shift turns about z and shifts along z by products of theirs: 0.02 x 0.2 mm.
    assert!(left.iter().all(|x| x.abs() < 0.006), "{left:?}");
    // A start is what they are held at.
    let without = aligned(&solid, &cloud, Start::Auto, &options);
    assert_eq!(without.conclusion, Conclusion::NotFound);
}

#[test]
fn six_reference_points_make_the_exact_pose() {
    let mut noise = Noise(21);
    let truth = noise.motion(0.4, 30.0);
    let machine_from_part = truth.inverse();
    // 3-2-1: three points on z = 0, two on y = 0, one on x = 0, each probed somewhere else on its face.
    let points = [
        (DVec3::Z, DVec3::new(10.0, 10.0, 0.0)),
        (DVec3::Z, DVec3::new(90.0, 12.0, 0.0)),
        (DVec3::Z, DVec3::new(50.0, 60.0, 0.0)),
        (DVec3::Y, DVec3::new(10.0, 0.0, 20.0)),
        (DVec3::Y, DVec3::new(90.0, 0.0, 20.0)),
        (DVec3::X, DVec3::new(0.0, 30.0, 15.0)),
    ];
    let datums: Vec<Datum> = points
        .iter()
        .map(|(direction, nominal)| {
            let slide = noise.direction() * 2.0;
            Datum::Point {
                nominal: *nominal,
                direction: *direction,
                measured: machine_from_part
                    .point(*nominal + slide - slide.dot(*direction) * *direction),
                u_mm: 0.003,
            }
        })
        .collect();
    let found = pose_from_datums(RigidTransform::IDENTITY, &datums).expect("a pose");
    let left = error(&found.part_from_machine, &truth);
    assert!(
        left.iter().all(|x| x.abs() < 1e-10),
        "rounding of 100 mm: {left:?}"
    );
    assert!(found.weak_directions.is_empty());
    // One point alone holds x: its own uncertainty comes through, levered turns apart, to the place where it holds.
    let Datum::Point { measured, .. } = datums[5] else {
        unreachable!("all are points")
    };
    let at = found.part_from_machine.point(measured);
    let row = [0.0, at.z, -at.y, 1.0, 0.0, 0.0];
    let variance: f64 = (0..6)
        .map(|i| row[i] * (0..6).map(|j| found.covariance[i][j] * row[j]).sum::<f64>())
        .sum();
    assert!((variance.sqrt() - 0.003).abs() < 1e-9, "{variance}");

    let five = pose_from_datums(RigidTransform::IDENTITY, &datums[..5]).expect("a pose");
    assert_eq!(five.weak_directions, ["along x"]);
    let bad = Datum::Centre {
        nominal: DVec3::ZERO,
        measured: DVec3::NAN,
        u_mm: 0.01,
    };
    assert_eq!(pose_from_datums(truth, &[bad]), Err(DatumError::Bad(0)));
}

#[test]
fn a_plane_an_axis_and_a_centre_hold_what_they_should() {
    let mut noise = Noise(22);
    let truth = noise.motion(0.5, 20.0);
    let back = truth.inverse();
    let plane = Datum::Plane {
        nominal: [DVec3::ZERO, DVec3::Z],
        measured: [back.point(DVec3::new(7.0, 3.0, 0.0)), back.vector(DVec3::Z)],
        u: [0.002, 1e-4],
    };
    let axis = Datum::Axis {
        nominal: [DVec3::new(20.0, 10.0, 0.0), DVec3::Z],
        // Found at another height, and pointing the other way.
        measured: [
            back.point(DVec3::new(20.0, 10.0, 8.0)),
            back.vector(-DVec3::Z),
        ],
        u: [0.002, 1e-3],
    };
    let centre = Datum::Centre {
        nominal: DVec3::new(60.0, 10.0, 5.0),
        measured: back.point(DVec3::new(60.0, 10.0, 5.0)),
        u_mm: 0.004,
    };
    let two = pose_from_datums(RigidTransform::IDENTITY, &[plane, axis]).expect("a pose");
    assert_eq!(two.weak_directions, ["rotation about z"]);
    let all = pose_from_datums(RigidTransform::IDENTITY, &[plane, axis, centre]).expect("a pose");
    assert!(all.weak_directions.is_empty());
    let left = error(&all.part_from_machine, &truth);
    // Unit vectors hold a turn to some 1e-10 rad; the places lie within 100 mm.
    assert!(left.iter().all(|x| x.abs() < 1e-7), "rounding: {left:?}");
    assert!(
        all.residuals.iter().all(|r| *r < 1e-6),
        "{:?}",
        all.residuals
    );
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let solid = angle();
    let mut noise = Noise(31);
    let cloud = solid.scan(&[1, 2, 3, 4, 5, 6, 7], SIGMA, &mut noise);
    let start = far_start(&solid, &RigidTransform::IDENTITY, &mut noise);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("threads")
            .install(|| aligned(&solid, &cloud, start, &AlignOptions::default()))
    };
    assert_eq!(on(1), on(3));
}

/// The cells of the look-up against the nearest of all faces by hand.
#[test]
fn every_point_is_assigned_to_the_nearest_face() {
    let solid = angle();
    let surface = Surface::new(&solid);
    let mut noise = Noise(41);
    let [low, high] = solid.bounds();
    let mut found = Vec::new();
    let mut checked = 0;
    for _ in 0..4000 {
        let at = DVec3::new(noise.uniform(), noise.uniform(), noise.uniform());
        let p = low - 0.3 + at * (high - low + 0.6);
        let distances: Vec<f64> = (0..solid.face_count() as u32)
            .filter_map(|f| {
                let foot = solid.foot(f, p, None)?;
                solid.contains(f, foot.uv).then(|| p.distance(foot.point))
            })
            .collect();
        let nearest = distances.iter().copied().fold(f64::INFINITY, f64::min);
        if nearest > 0.5 {
            continue;
        }
        let place = surface.place(p, None, 0.5, &mut found);
        assert_ne!(place.face, NO_FACE, "{p}");
        // A corner outside every face may be nearer than a foot.
        assert!(
            place.distance_mm <= nearest + 1e-12,
            "{p}: {} and {nearest}",
            place.distance_mm
        );
        checked += 1;
    }
    assert!(checked > 1000, "{checked}");
}

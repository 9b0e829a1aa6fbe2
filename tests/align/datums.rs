//! Poses on datum features, against made faces whose planes are known: what a primary, a secondary and a tertiary datum hold.

use acies::geometry::RigidTransform;
use acies::inspect::align::{AlignOptions, Conclusion, Start};
use acies::inspect::body::Body;
use acies::inspect::result::{DatumKind, Inspection, Method, Verdict};
use acies::inspect::{Recipe, Request, inspect};
use acies::points::PointCloud;
use glam::DVec3;

use super::solids::{Made, Noise, Solid};
use super::{SIGMA, aligned, angle, mahalanobis, moved};

const SEEN: [u32; 7] = [1, 2, 3, 4, 5, 6, 7];

/// The top A, the front B (y = 0) and the right side C (x = 10), each off and askew by its own amount, and the others off as well.
fn made_angle() -> Solid {
    let mut solid = angle();
    let made = |offset, gradient| Made { offset, gradient };
    solid.made[1] = made(0.06, DVec3::new(0.003, -0.002, 0.0));
    solid.made[2] = made(-0.04, DVec3::new(0.002, 0.0, 0.003));
    solid.made[3] = made(0.05, DVec3::new(0.0, -0.004, 0.002));
    solid.made[4] = made(0.08, DVec3::ZERO);
    solid.made[6] = made(-0.07, DVec3::ZERO);
    solid
}

fn inspected(solid: &Solid, cloud: &PointCloud, start: RigidTransform, text: &str) -> Inspection {
    let recipe = Recipe::parse(text).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    inspect(cloud, solid, &Request::new(&recipe, Start::Rough(start)))
}

/// Normal and a place of the made face, moved by `by`.
fn made_plane(solid: &Solid, face: u32, by: &RigidTransform) -> (DVec3, DVec3) {
    let centre = solid.centre(face);
    let normal = solid.foot(face, centre, None).expect("a plane").normal;
    let made = solid.made[face as usize];
    // n . (p - centre) = offset + gradient . (p - centre), the gradient within the face.
    let place = centre + made.offset * normal;
    (
        by.vector((normal - made.gradient).normalize()),
        by.point(place),
    )
}

const THREE_PLANES: &str = "[[alignment.datum]]\nname = \"A\"\nfaces = [11]\n\
    [[alignment.datum]]\nname = \"B\"\nfaces = [12]\npriority = 2\n\
    [[alignment.datum]]\nname = \"C\"\nfaces = [13]\npriority = 3\n";

#[test]
fn three_planes_hold_in_the_order_of_their_priority() {
    let solid = made_angle();
    let mut noise = Noise(51);
    let machine_from_part = noise.motion(1.2, 80.0);
    let scan = solid.scan(&SEEN, SIGMA, &mut noise);
    let cloud = moved(&scan, &machine_from_part);
    let start = noise.motion(0.02, 0.2) * machine_from_part.inverse();
    let found = inspected(&solid, &cloud, start, THREE_PLANES);
    let alignment = &found.alignment;
    assert_eq!(alignment.method, Method::Datums, "{:?}", found.findings);
    assert_eq!(alignment.status, Verdict::Ok, "{:?}", found.findings);
    assert!(alignment.free_of_datums.is_empty());

    // From the frame in which the faces were made to that of the datums.
    let by = alignment.part_from_machine * machine_from_part;
    let [a, b, c] = [1, 2, 3].map(|face| made_plane(&solid, face, &by));
    // The smallest face has some 750 points, over 6 mm at least: 4 standard deviations of a place and of a tilt.
    let (mm, rad) = (
        4.0 * SIGMA / 27.0,
        4.0 * SIGMA / 27.0 / (6.0 / 12f64.sqrt()),
    );
    assert!((a.0 - DVec3::Z).length() < rad, "A holds two turns");
    assert!((a.1.z - 6.0).abs() < mm, "A holds z: {}", a.1.z);
    // Of B what A leaves: its direction across z, and its place.
    let across = DVec3::new(b.0.x, b.0.y, 0.0).normalize();
    assert!((across + DVec3::Y).length() < 2.0 * rad, "B: {across}");
    // The measured place is the middle of the points, which the free tilt of B passes through.
    let lean = b.0.z.abs() * 3.0 + mm;
    assert!(b.1.y.abs() < lean, "B holds y: {}", b.1.y);
    let lean = (c.0 - DVec3::X).length() * 3.0 + mm;
    assert!((c.1.x - 10.0).abs() < lean, "C holds x: {}", c.1.x);

    // A fits exactly; B keeps the angle to A that it was made with, C those to both.
    let off: Vec<(f64, f64)> = alignment
        .datums
        .iter()
        .map(|d| (d.residual_mm, d.residual_rad.expect("planes")))
        .collect();
    assert!(off[0].0 < 1e-6 && off[0].1 < 1e-6, "{off:?}");
    let askew = (a.0.dot(b.0)).abs();
    assert!(
        (off[1].1 - askew).abs() < 2.0 * rad,
        "{off:?}, made {askew}"
    );
    assert!(off[1].0 < 1e-6 && off[2].0 < 1e-6, "{off:?}");
    assert!(off[2].1 > 5.0 * rad, "C leans by its own: {off:?}");
    assert!(alignment.datums.iter().all(|d| d.kind == DatumKind::Plane));
}

/// Without deviations the truth is the pose itself, and the covariance must be honest about it.
#[test]
fn six_reference_points_find_the_pose_of_the_scan() {
    let solid = angle();
    let text = [
        ("A1", [1.0, 1.0, 6.0], 1),
        ("A2", [9.0, 1.0, 6.0], 1),
        ("A3", [1.5, 7.0, 6.0], 1),
        ("B1", [2.0, 0.0, 3.0], 2),
        ("B2", [8.5, 0.0, 3.0], 2),
        ("C1", [0.0, 4.0, 3.0], 3),
    ]
    .map(|(name, place, priority)| {
        format!(
            "[[alignment.datum]]\nname = {name:?}\npoint_mm = {place:?}\nradius_mm = 0.9\npriority = {priority}\n"
        )
    })
    .concat();
    let mut sum = 0.0;
    const SEEDS: u64 = 4;
    for seed in 1..=SEEDS {
        let mut noise = Noise(60 + seed);
        let machine_from_part = noise.motion(0.8, 60.0);
        let truth = machine_from_part.inverse();
        let cloud = moved(&solid.scan(&SEEN, SIGMA, &mut noise), &machine_from_part);
        let start = noise.motion(0.02, 0.2) * truth;
        let found = inspected(&solid, &cloud, start, &text);
        assert_eq!(
            found.alignment.method,
            Method::Datums,
            "{:?}",
            found.findings
        );
        assert!(found.alignment.datums.iter().all(|d| d.residual_mm < 1e-6));
        let as_aligned = acies::inspect::align::Aligned {
            alignment: found.alignment,
            findings: Vec::new(),
            conclusion: Conclusion::Good,
            eigenvalues: [1.0; 6],
        };
        sum += mahalanobis(&as_aligned, &truth);
    }
    // 0.0005 and 0.9995 quantiles of chi-square with 24 degrees of freedom.
    assert!((7.5..53.5).contains(&sum), "{sum}");
}

#[test]
fn a_plane_and_an_axis_leave_the_turn_about_it_to_the_best_fit() {
    let mut solid = Solid::cylinder(6.0, 9.0);
    // Too thick: the axis does not mind.
    solid.made[2].offset = 0.04;
    let mut noise = Noise(71);
    let machine_from_part = noise.motion(0.6, 40.0);
    let cloud = moved(&solid.scan(&[1, 2], SIGMA, &mut noise), &machine_from_part);
    let start = noise.motion(0.01, 0.1) * machine_from_part.inverse();
    let text = "[[alignment.datum]]\nname = \"axis\"\nfaces = [12]\n\
        [[alignment.datum]]\nname = \"top\"\nfaces = [11]\npriority = 2";
    let found = inspected(&solid, &cloud, start, text);
    let alignment = &found.alignment;
    assert_eq!(alignment.method, Method::Datums, "{:?}", found.findings);
    assert_eq!(alignment.datums[0].kind, DatumKind::Axis);
    assert_eq!(alignment.free_of_datums, ["rotation about z"]);
    let by = alignment.part_from_machine * machine_from_part;
    // 8600 points on the side: a shift is known to sigma sqrt(2 / n), a tilt to that over the height's 9 / sqrt(12).
    let mm = 5.0 * SIGMA * f64::sqrt(2.0 / 8600.0);
    let axis = by.vector(DVec3::Z);
    assert!((axis - DVec3::Z).length() < mm / 2.6, "{axis}");
    let place = by.point(4.5 * DVec3::Z);
    assert!(place.truncate().length() < mm, "{place}");
    let top = by.point(9.0 * DVec3::Z);
    // 3500 points on the top.
    assert!(
        (top.z - 9.0).abs() < 5.0 * SIGMA / f64::sqrt(3500.0),
        "{top}"
    );
}

#[test]
fn a_datum_that_cannot_be_measured_decides_nothing_and_says_why() {
    let solid = angle();
    let mut noise = Noise(81);
    let cloud = solid.scan(&SEEN, SIGMA, &mut noise);
    let with = |cases: &[(&str, &str)]| {
        let mut text = "[limits]\nd_mm = [-1, 1]\n".to_owned();
        for (datum, _) in cases {
            text += &format!("[[alignment.datum]]\n{datum}\n");
        }
        let found = inspected(&solid, &cloud, RigidTransform::IDENTITY, &text);
        for (datum, said) in cases {
            assert!(
                found.findings.iter().any(|f| f.contains(said)),
                "{datum}: {said}\nnot in {:?}",
                found.findings
            );
        }
        assert_eq!(found.alignment.status, Verdict::NotDecidable);
        assert_eq!(found.verdict, Verdict::NotDecidable);
        assert_eq!(found.alignment.method, Method::BestFit);
    };
    with(&[
        ("faces = [99]", "#99, expected the STEP entity of a face"),
        (
            "pmi = \"A\"",
            "PMI datum A, expected a nominal with semantic datum features",
        ),
    ]);
    with(&[
        (
            "faces = [10]",
            "0 points on its faces, expected at least 20",
        ),
        (
            "faces = [11, 12]",
            "#11 and #12 are not one plane, axis or centre",
        ),
        ("point_mm = [5, 3, 9]", "lies 3.000 mm off the part"),
        (
            "point_mm = [5, 3, 6]\nradius_mm = 0.1",
            "expected at least 20; scan it, or give radius_mm",
        ),
        (
            "point_mm = [5, 3, 6]\ndirection = [1, 0, 0.01]",
            "its direction meets the face under 89 degrees",
        ),
    ]);
}

#[test]
fn chosen_faces_hold_the_best_fit_alone() {
    let mut solid = angle();
    // Two faces are off by much; without them the pose is that of the others.
    solid.made[4].offset = 0.09;
    solid.made[7].offset = -0.09;
    let mut noise = Noise(91);
    let cloud = solid.scan(&SEEN, SIGMA, &mut noise);
    let options = AlignOptions {
        datum_faces: &[1, 2, 3],
        ..AlignOptions::default()
    };
    let start = Start::Rough(noise.motion(0.02, 0.2));
    let found = aligned(&solid, &cloud, start, &options);
    assert_eq!(found.alignment.faces, [11, 12, 13]);
    assert_eq!(found.alignment.method, Method::BestFit);
    // 0.9999 quantile of chi-square with 6 degrees of freedom.
    let squared = mahalanobis(&found, &RigidTransform::IDENTITY);
    assert!(squared < 27.9, "{squared}");
}

#[test]
fn mistakes_of_datums_come_at_once() {
    let text = "[[alignment.datum]]\nname = \"A\"\n[[alignment.datum]]\nfaces = [1]\npmi = \"A\"\n\
        [[alignment.datum]]\nfaces = []\n[[alignment.datum]]\nfaces = [1]\nradius_mm = 2\npriority = 9\n\
        [[alignment.datum]]\npoint_mm = [1, 2]\n\
        [[alignment.datum]]\nname = \"E\"\nfaces = [4]\n[[alignment.datum]]\nname = \"E\"\nfaces = [5]\n";
    let mistakes = Recipe::parse(text).expect_err("seven mistakes");
    let lines: Vec<String> = mistakes.iter().map(ToString::to_string).collect();
    for expected in [
        "alignment.datum[0].faces: nothing, expected one of faces, point_mm and pmi",
        "alignment.datum[1].faces: faces and pmi, expected one of faces, point_mm and pmi",
        "alignment.datum[2].faces: [], expected the STEP entities of its faces",
        "alignment.datum[3].radius_mm: no point_mm beside it, expected it with a reference point only",
        "alignment.datum[3].priority: 9, expected",
        "alignment.datum[4].point_mm: [1, 2], expected a place",
        "alignment.datum[6].name: \"E\" again, expected one name a datum",
    ] {
        assert!(
            lines.iter().any(|line| line.starts_with(expected)),
            "{expected}\nnot in {lines:#?}"
        );
    }
    assert_eq!(mistakes.len(), 7, "{lines:#?}");
}

/// Taken as it lies, the made faces are off by what they were made with: the top by 0.06 mm at the middle of its points and sqrt(13) mrad.
#[test]
fn a_scan_taken_as_it_lies_says_how_far_its_datums_are_off() {
    let solid = made_angle();
    let cloud = solid.scan(&SEEN, SIGMA, &mut Noise(57));
    let recipe = Recipe::parse(THREE_PLANES).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    let found = inspect(&cloud, &solid, &Request::new(&recipe, Start::None));
    let alignment = &found.alignment;
    assert_eq!(alignment.method, Method::AsGiven);
    assert_eq!(alignment.part_from_machine, RigidTransform::IDENTITY);
    assert_eq!(alignment.datums.len(), 3, "{:?}", found.findings);
    for (datum, face) in alignment.datums.iter().zip([1, 2, 3]) {
        let made = solid.made[face];
        // The middle of the points lies off the face's by a tenth of its size where a neighbour hides some: 0.3 mm at 5 mrad.
        let off = datum.residual_mm - made.offset.abs();
        assert!(
            off.abs() < 0.3 * made.gradient.length() + 4.0 * datum.u_mm,
            "{datum:?}"
        );
        let turned = datum.residual_rad.expect("planes") - made.gradient.length();
        assert!(
            turned.abs() < 4.0 * SIGMA / 27.0 / (6.0 / 12f64.sqrt()),
            "{datum:?}"
        );
    }
    let said = "the recipe's datums hold nothing";
    assert!(
        found.findings.iter().any(|f| f.contains(said)),
        "{:?}",
        found.findings
    );
}

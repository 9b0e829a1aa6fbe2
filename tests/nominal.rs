//! STEP files read as nominals, against Open CASCADE's answers and against bodies known in closed form.

#[path = "nominal/closest.rs"]
mod closest;
#[path = "nominal/hostile.rs"]
mod hostile;
#[path = "nominal/iges.rs"]
mod iges;
#[path = "nominal/pmi.rs"]
mod pmi;

use std::collections::BTreeSet;
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::path::{Path, PathBuf};

use acies::nominal::{EdgeKind, End, Nominal, PmiKind};
use glam::DVec3;
use proptest::prelude::*;

const BOX: &str = include_str!("nominal/box.step");
const CYLINDER: &str = include_str!("nominal/cylinder.step");

fn parse(text: &str) -> Nominal {
    Nominal::parse(text.as_bytes(), "part.step").expect("a readable part")
}

/// What the reader says about a text that gives no nominal.
fn refusal(text: &str) -> String {
    Nominal::parse(text.as_bytes(), "part.step")
        .expect_err("must be refused")
        .to_string()
}

#[test]
fn a_box_has_twelve_convex_edges_and_its_known_measures() {
    let n = parse(BOX);
    assert_eq!((n.bodies, n.faces.len(), n.edges.len()), (1, 6, 12));
    assert_eq!(n.refused, []);
    assert!(
        (n.area_mm2() - 2200.0).abs() < 1e-9,
        "rounding of a sum of thousands"
    );
    assert!((n.volume_mm3() - 6000.0).abs() < 1e-9);
    assert!((n.edge_length_mm() - 240.0).abs() < 1e-12);
    assert_eq!(
        n.bounding_box_mm,
        [DVec3::ZERO, DVec3::new(30.0, 20.0, 10.0)]
    );
    assert_eq!(n.sharp_edges.len(), 12);
    for (i, e) in n.sharp_edges.iter().enumerate() {
        assert_eq!(e.id, format!("e{}", i + 1));
        assert_eq!(e.kind, EdgeKind::Convex);
        assert!(!e.closed);
        assert!((e.turn_angle_rad(&n, 0.3 * e.length_mm) - FRAC_PI_2).abs() < 1e-14);
    }
    assert_eq!(n.sharp_edges[0].entity, 28, "the number in the file");
}

#[test]
fn stations_of_a_box_look_out_of_it_and_into_its_faces() {
    let n = parse(BOX);
    let centre = DVec3::new(15.0, 10.0, 5.0);
    for e in &n.sharp_edges {
        let stations = e.stations(&n, 1.0);
        assert_eq!(stations.len(), e.length_mm.round() as usize);
        for (k, s) in stations.iter().enumerate() {
            assert!((s.s_mm - (k as f64 + 0.5)).abs() < 1e-12);
            for i in 0..2 {
                assert!(
                    s.normals[i].dot(s.point - centre) > 0.0,
                    "out of the material"
                );
                // Into one face is against the normal of the other, at a right angle.
                assert!((s.into_face[i] + s.normals[1 - i]).length() < 1e-14);
                let face = &n.faces[e.faces[i] as usize];
                let foot = face.foot(s.point + s.into_face[i], None).expect("a plane");
                assert!(face.contains(foot.uv));
                let foot = face.foot(s.point - s.into_face[i], None).expect("a plane");
                assert!(!face.contains(foot.uv));
            }
            assert!(s.tangent.dot(s.normals[0]).abs() < 1e-15);
        }
        let middle = e.station(&n, 0.5 * e.length_mm);
        let (s, d) = e.nearest(middle.point + middle.normals[0] * 0.25);
        assert!((s - middle.s_mm).abs() < 1e-9 && (d - 0.25).abs() < 1e-12);
    }
}

#[test]
fn a_box_has_eight_corners_of_three_edges_and_a_cylinder_none() {
    let n = parse(BOX);
    assert_eq!(n.corners().len(), 8);
    for c in n.corners() {
        assert!(c.is_vertex());
        assert_eq!((c.edges.len(), c.faces.len()), (3, 3));
        for (edge, end) in &c.edges {
            let e = &n.sharp_edges[*edge];
            let s_mm = if *end == End::Start { 0.0 } else { e.length_mm };
            assert!(e.point(s_mm).distance(c.position) < 1e-12);
            assert!(e.faces.iter().all(|f| c.faces.contains(f)));
        }
        let [low, high] = n.bounding_box_mm;
        for k in 0..3 {
            assert!(c.position[k] == low[k] || c.position[k] == high[k]);
        }
    }
    assert_eq!(parse(CYLINDER).corners(), [], "its edges are rings");
}

#[test]
fn a_cylinder_in_inches_is_read_in_mm() {
    let n = parse(CYLINDER);
    let (r, h) = (25.4, 50.8);
    assert_eq!((n.faces.len(), n.edges.len()), (3, 3));
    // Borders are polylines with a chord of 8e-6 of their length: 1e-4 of the area of a disc.
    let area = TAU * r * h + TAU * r * r;
    assert!((n.area_mm2() / area - 1.0).abs() < 2e-4, "{}", n.area_mm2());
    assert!((n.volume_mm3() / (PI * r * r * h) - 1.0).abs() < 3e-4);
    let [low, high] = n.bounding_box_mm;
    // The polyline passes the extremes by its chord at most.
    assert!((low - DVec3::new(-r, -r, 0.0)).length() < 2e-3);
    assert!((high - DVec3::new(r, r, h)).length() < 2e-3);
    assert_eq!(n.sharp_edges.len(), 2, "the seam is no sharp edge");
    for e in &n.sharp_edges {
        assert!(e.closed && e.kind == EdgeKind::Convex);
        assert!((e.length_mm - TAU * r).abs() < 1e-9);
        for s in e.stations(&n, 5.0) {
            let radial = DVec3::new(s.point.x, s.point.y, 0.0) / r;
            let side = s.normals.iter().any(|n| (*n - radial).length() < 1e-12);
            assert!(side, "one normal is the cylinder's");
        }
    }
    let side = &n.faces[0];
    let outside = DVec3::new(30.4, 0.0, 10.0);
    let distance = side.signed_distance(outside, None).expect("a normal");
    assert!((distance - 5.0).abs() < 1e-12, "plus outside the material");
}

#[test]
fn the_same_part_turned_inside_out_still_looks_outward() {
    let faces = CYLINDER.replace("(#45),#30,.T.", "(#45),#30,.F.");
    let faces = faces.replace("(#52),#31,.F.", "(#52),#31,.T.");
    let n = parse(&faces.replace("(#62),#32,.T.", "(#62),#32,.F."));
    assert!(n.volume_mm3() > 0.0);
    let top = n.faces[2]
        .foot(DVec3::new(1.0, 1.0, 60.0), None)
        .expect("a plane");
    assert!((top.normal - DVec3::Z).length() < 1e-12);
    assert!(n.sharp_edges.iter().all(|e| e.kind == EdgeKind::Convex));
}

#[test]
fn samples_cover_the_faces_evenly() {
    let n = parse(CYLINDER);
    let spacing = 1.5;
    let samples = n.samples(spacing);
    let expected = n.area_mm2() / (spacing * spacing);
    // Rows and thinning are rounded to whole points: a few per cent of some thousands.
    assert!(
        (samples.len() as f64 / expected - 1.0).abs() < 0.05,
        "{} of {expected}",
        samples.len()
    );
    let mut per_face = [0usize; 3];
    for s in &samples {
        per_face[s.face as usize] += 1;
        let face = &n.faces[s.face as usize];
        assert!(face.contains(s.uv));
        assert!(face.signed_distance(s.point, None).expect("a normal").abs() < 1e-9);
    }
    for (face, count) in n.faces.iter().zip(per_face) {
        let share = face.area_mm2() / n.area_mm2();
        assert!((count as f64 / samples.len() as f64 - share).abs() < 0.02);
    }
    assert_eq!(samples, n.samples(spacing), "the same every time");
}

#[test]
fn what_is_no_step_file_is_refused_with_the_place() {
    assert_eq!(
        refusal(""),
        "part.step: the file is empty, expected a STEP file; export the part again"
    );
    assert_eq!(
        refusal("solid cube\n facet normal 0 0 1\n"),
        "part.step: line 1: the file begins with \"solid cube\\n facet normal\", expected \"ISO-10303-21;\"; \
         give a STEP file (.stp, .step)"
    );
    let half = &BOX[..BOX.len() / 2];
    let line = half.lines().count();
    assert_eq!(
        refusal(half),
        format!(
            "part.step: line {line}: the file ends without \"END-ISO-10303-21;\", it was cut off; copy or export it again"
        )
    );
    let garbled = BOX.replace("#46=ADVANCED_FACE(", "#46=ADVANCED_FACE)");
    let text = refusal(&garbled);
    assert!(
        text.starts_with("part.step: parse error at line 53, column ")
            && text.ends_with("; export the part again"),
        "{text}"
    );
    let missing = Nominal::read(Path::new("no/such/part.step")).expect_err("no file");
    let text = missing.to_string();
    assert!(
        text.starts_with("no/such/part.step: cannot be read: "),
        "{text}"
    );
    assert!(
        text.ends_with("; check the path and its permissions"),
        "{text}"
    );
}

#[test]
fn a_file_without_exact_geometry_says_what_it_has() {
    let none = CYLINDER.replace("#71=MANIFOLD_SOLID_BREP('cylinder',#70);\n", "");
    let none = none.replace("#72=ADVANCED_BREP_SHAPE_REPRESENTATION('',(#71),#6);\n", "");
    assert_eq!(
        refusal(&none),
        "part.step: no solid or surface model, but 3 loose faces (#46 ADVANCED_FACE); export the part as exact \
         geometry (boundary representation: AP203, AP214 or AP242)"
    );
}

#[test]
fn a_missing_entity_costs_its_face_and_no_more() {
    let n = parse(&BOX.replace("#45=PLANE('',#44);\n", ""));
    assert_eq!(n.faces.len(), 5);
    assert_eq!(n.refused.len(), 1);
    assert_eq!(n.refused[0].entity, 46);
    assert_eq!(
        n.refused[0].reason,
        "#45: the file refers to it but does not contain it"
    );
    assert_eq!(
        n.sharp_edges.len(),
        8,
        "edges of the missing face have one side only"
    );
}

#[test]
fn impossible_values_are_named_with_their_entity() {
    let reason = |from: &str, to: &str| {
        assert!(CYLINDER.contains(from), "{from}");
        let n = parse(&CYLINDER.replace(from, to));
        let r = &n.refused[0];
        format!("#{}: {}", r.entity, r.reason)
    };
    assert_eq!(
        reason(
            "#30=CYLINDRICAL_SURFACE('',#14,1.)",
            "#30=CYLINDRICAL_SURFACE('',#14,-1.)"
        ),
        "#46: #30: CYLINDRICAL_SURFACE with a length of -25.4 mm, expected one above 0 and at most 1e9"
    );
    assert_eq!(
        reason(
            "#17=CARTESIAN_POINT('',(1.,0.,2.))",
            "#17=CARTESIAN_POINT('',(1.,0.,2.E300))"
        ),
        "#46: #17: a coordinate of 5.08e301 mm, expected at most 1e9"
    );
    assert_eq!(
        reason(
            "#17=CARTESIAN_POINT('',(1.,0.,2.))",
            "#17=CARTESIAN_POINT('',(1.,0.,'x'))"
        ),
        "#46: #17: attribute 2 of CARTESIAN_POINT is not a list of numbers"
    );
    assert_eq!(
        reason("#30=CYLINDRICAL_SURFACE", "#30=BLOB_SURFACE"),
        "#46: #30: a surface of type BLOB_SURFACE is not read"
    );
    assert_eq!(
        reason(
            "#44=EDGE_LOOP('',(#40,#41,#42,#43))",
            "#44=EDGE_LOOP('',(#41,#43))"
        ),
        "#46: its 1 loops enclose no area of its cylindrical_surface"
    );
}

#[test]
fn a_body_of_which_nothing_is_left_is_an_error() {
    let n = BOX.replace("ADVANCED_FACE", "FACE");
    assert_eq!(
        refusal(&n),
        "part.step: none of its 6 faces can be used, the first because #46: a face of type FACE is not read; \
         export the part again"
    );
}

fn data() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    if root.is_dir() {
        return Some(root);
    }
    eprintln!("skipped: {} is not there", root.display());
    None
}

/// Largest part of a reader's answer that may differ from Open CASCADE's.
struct Tolerance {
    /// Of the box's diagonal: borders are polylines, and writers round.
    box_share: f64,
    /// Of the area: the same, and Open CASCADE's own integration.
    area_share: f64,
}

#[test]
fn real_files_agree_with_open_cascade() {
    let Some(root) = data() else { return };
    let tolerance = Tolerance {
        box_share: 1e-3,
        area_share: 1e-3,
    };
    let text = std::fs::read(root.join("cad-oracle.json")).expect("the oracle");
    let oracle: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    let mut read = 0;
    for entry in std::fs::read_dir(root.join("step")).expect("the folder") {
        let path = entry.expect("an entry").path();
        let name = path
            .file_name()
            .expect("a name")
            .to_string_lossy()
            .into_owned();
        if name.contains("-tg.") {
            continue;
        }
        let n = Nominal::read(&path).unwrap_or_else(|e| panic!("{e}"));
        let o = &oracle[&name];
        let number = |key: &str| o[key].as_f64().expect("a number");
        assert_eq!(
            n.faces.len() as u64,
            o["faces"].as_u64().expect("a count"),
            "{name}"
        );
        assert_eq!(n.refused, [], "{name}");
        let area = n.area_mm2() / number("area_mm2");
        assert!(
            (area - 1.0).abs() < tolerance.area_share,
            "{name}: area {area}"
        );
        assert_box(&n, &o["bbox_mm"], tolerance.box_share, &name);
        // Open CASCADE adds seams and wires to the edges that faces share.
        let wires: f64 = n.wires.iter().map(|w| w.length_mm).sum();
        let length = (n.edge_length_mm() + wires) / number("edge_length_sum_mm");
        assert!(length < 1.0 + 1e-5, "{name}: length {length}");
        read += 1;
    }
    assert_eq!(read, 16, "all but the tessellated one");
}

fn assert_box(n: &Nominal, oracle: &serde_json::Value, share: f64, name: &str) {
    let values: Vec<f64> = oracle
        .as_array()
        .expect("a box")
        .iter()
        .map(|x| x.as_f64().expect("a number"))
        .collect();
    let [low, high] = n.bounding_box_mm;
    let mine = [low.to_array(), high.to_array()].concat();
    let diagonal = low.distance(high);
    for (a, b) in mine.iter().zip(&values) {
        assert!(
            (a - b).abs() <= share * diagonal,
            "{name}: box {mine:?}, expected {values:?}"
        );
    }
}

#[test]
fn solids_have_the_volume_that_open_cascade_gives_them() {
    let Some(root) = data() else { return };
    let text = std::fs::read(root.join("cad-oracle.json")).expect("the oracle");
    let oracle: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    // Orientation or trimming gone wrong in one face changes the volume by its share of the part.
    for name in [
        "IPP_simple_AP203.stp",
        "DCX_DaimlerChryslerTestPartAP214.stp",
        "netgen_frame.step",
        "nist_ctc_01_asme1_ap242-e1.stp",
        "occt_linkrods.step",
        "occt_screw.step",
        "pyocc_as1_pe_203.stp",
        "stepcode_dm1-id-214.stp",
        "stepcode_sg1-c5-214.stp",
    ] {
        let n = Nominal::read(&root.join("step").join(name)).unwrap_or_else(|e| panic!("{e}"));
        let share = n.volume_mm3() / oracle[name]["volume_mm3"].as_f64().expect("a number");
        assert!((share - 1.0).abs() < 2e-3, "{name}: {share}");
    }
}

#[test]
fn the_tessellated_file_is_refused_with_what_it_holds() {
    let Some(root) = data() else { return };
    let path = root.join("step/nist_ftc_08_asme1_ap242-e1-tg.stp");
    let text = Nominal::read(&path)
        .expect_err("tessellated only")
        .to_string();
    let (_, said) = text.split_once(".stp: ").expect("the name first");
    assert_eq!(
        said,
        "no solid or surface model, but 1 tessellated solid (#11436 TESSELLATED_SOLID), 1 tessellated shell (#25216 \
         TESSELLATED_SHELL), 273 tessellated faces (#141 COMPLEX_TRIANGULATED_FACE); export the part as exact geometry \
         (boundary representation: AP203, AP214 or AP242)"
    );
}

#[test]
fn the_dimensions_of_a_nist_file_are_those_of_its_drawing() {
    let Some(root) = data() else { return };
    let path = root.join("step/nist_ftc_06_asme1_ap242-e2.stp");
    let n = Nominal::read(&path).unwrap_or_else(|e| panic!("{e}"));
    let count = |f: fn(&PmiKind) -> bool| n.pmi().iter().filter(|p| f(&p.kind)).count();
    assert_eq!(
        count(|k| matches!(k, PmiKind::Dimension { .. })),
        24,
        "14 sizes, 10 locations"
    );
    let letters: BTreeSet<&str> = n
        .pmi()
        .iter()
        .filter_map(|p| match &p.kind {
            PmiKind::DatumFeature { letter } => Some(&letter[..]),
            _ => None,
        })
        .collect();
    assert!(
        ["A", "B", "C", "D"].iter().all(|l| letters.contains(l)),
        "{letters:?}"
    );
    // #270 in the file: a radius of 0.5 inch, plus and minus 0.02 inch.
    let radius = n.pmi().iter().find(|p| p.entity == 270).expect("a radius");
    let PmiKind::Dimension {
        what,
        value,
        deviations,
    } = &radius.kind
    else {
        panic!("{radius:?}")
    };
    assert_eq!(what, "radius");
    assert!((value.value() - 12.7).abs() < 1e-6);
    let [lower, upper] = deviations.expect("limits");
    assert!((lower + 0.508).abs() < 1e-6 && (upper - 0.508).abs() < 1e-6);
    // #112: a position in the datum system of #330.
    let position = n
        .pmi()
        .iter()
        .find(|p| p.entity == 112)
        .expect("a position");
    let PmiKind::Tolerance {
        what,
        zone_mm,
        datums,
        ..
    } = &position.kind
    else {
        panic!("{position:?}")
    };
    assert_eq!(what, "position");
    assert!(*zone_mm > 0.0 && *zone_mm < 2.0 && !datums.is_empty());
    for p in n.pmi() {
        assert!(
            p.faces
                .iter()
                .all(|f| n.faces.iter().any(|g| g.entity == *f))
        );
    }
    // Some apply to edges, points and notes.
    let with_faces = n.pmi().iter().filter(|p| !p.faces.is_empty()).count();
    assert!(
        with_faces * 4 > n.pmi().len() * 3,
        "{with_faces} of {}",
        n.pmi().len()
    );
}

#[test]
fn the_sharp_curves_of_the_abc_model_are_those_of_its_labels() {
    let Some(root) = data() else { return };
    let folder = root.join("abc");
    let n = Nominal::read(&folder.join("00009999_003df34c1a7b4dc2bd43c5f4_step_000.step"))
        .unwrap_or_else(|e| panic!("{e}"));
    // Radius and centre of each circle labelled sharp; the label file has the first one twice.
    let labelled = [
        (19.0, [0.0, 0.0, 11.0]),
        (0.1, [2.7, 0.87, 1.0]),
        (0.75, [-8.1, -0.84, 1.0]),
        (0.25, [0.0, 0.0, 1.0]),
        (0.25, [0.0, 0.0, 9.2]),
        (0.1, [2.7, 0.87, 8.5]),
        (0.75, [-8.1, -0.84, 6.0]),
    ];
    assert_eq!(n.sharp_edges.len(), labelled.len());
    for (radius, centre) in labelled {
        let on = DVec3::from(centre) + DVec3::X * radius;
        let found = n.sharp_edges.iter().find(|e| e.nearest(on).1 < 1e-9);
        let e = found.unwrap_or_else(|| panic!("no sharp edge at {on}"));
        assert!((e.length_mm - TAU * radius).abs() < 1e-9);
        // Studs on a floor: concave at their feet, convex at their heads and at the outer rim.
        let foot = centre[2] == 1.0;
        assert_eq!(e.kind == EdgeKind::Concave, foot, "{on}");
    }
}

#[test]
fn the_demo_part_has_its_edges() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
    let n = Nominal::read(&path).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(n.refused, []);
    assert_eq!((n.faces.len(), n.sharp_edges.len()), (10, 20));
    let concave: Vec<&str> = n
        .sharp_edges
        .iter()
        .filter(|e| e.kind == EdgeKind::Concave)
        .map(|e| e.curve().kind())
        .collect();
    assert_eq!(
        concave,
        ["line", "circle"],
        "foot of the block, foot of the boss"
    );
    let free_form = n
        .sharp_edges
        .iter()
        .filter(|e| e.curve().kind() == "b_spline_curve");
    for e in free_form {
        for s in e.stations(&n, 1.0) {
            for i in 0..2 {
                let face = &n.faces[e.faces[i] as usize];
                let miss = face.signed_distance(s.point, None).expect("a normal");
                assert!(
                    miss.abs() < 1e-6,
                    "the edge lies on its faces to the file's digits: {miss}"
                );
                assert!(s.normals[i].dot(s.tangent).abs() < 1e-6);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 192, ..ProptestConfig::default() })]

    #[test]
    fn damaged_bytes_are_read_or_refused(
        in_box in any::<bool>(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0u8..4), 1..12),
    ) {
        let mut bytes = if in_box { BOX } else { CYLINDER }.as_bytes().to_vec();
        for (place, value, what) in changes {
            let i = place.index(bytes.len());
            match what {
                0 => bytes[i] = value,
                1 => { bytes.remove(i); }
                2 => bytes.insert(i, value),
                // Another digit keeps the grammar and changes the meaning.
                _ => if bytes[i].is_ascii_digit() { bytes[i] = b'0' + value % 10 },
            }
        }
        if let Ok(n) = Nominal::parse(&bytes, "part.step") {
            prop_assert!(n.area_mm2().is_finite());
            for e in &n.sharp_edges {
                let stations = e.stations(&n, e.length_mm / 3.0);
                prop_assert!(stations.iter().all(|s| s.point.is_finite() && s.tangent.is_finite()));
            }
            let samples = n.samples(n.area_mm2().sqrt() / 20.0);
            prop_assert!(samples.iter().all(|s| s.point.is_finite() && s.normal.is_finite()));
        }
    }
}

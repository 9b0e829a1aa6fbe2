//! Tolerances and datums of NIST's test parts as limits and alignment of an inspection. What the files say stands in their drawings.

use std::collections::BTreeMap;

use acies::inspect::quantity::{LimitSource, Quantity};
use acies::inspect::result::{DatumKind, Method};
use acies::inspect::{Recipe, Request, Start, all_edge_facts, inspect, resolve};
use acies::nominal::{Nominal, PmiKind};
use acies::points::{Frame, PointCloud};

use super::data;

const ON_A_B_C: &str = "limits_from_pmi = true\n[limits]\nd_mm = [-9, 9]\n\
    [[alignment.datum]]\npmi = \"A\"\n[[alignment.datum]]\npmi = \"B\"\npriority = 2\n\
    [[alignment.datum]]\npmi = \"C\"\npriority = 3\n";

fn part(name: &str) -> Option<Nominal> {
    let path = data()?.join("step").join(name);
    Some(Nominal::read(&path).unwrap_or_else(|e| panic!("{e}")))
}

fn recipe(text: &str) -> Recipe {
    Recipe::parse(text).unwrap_or_else(|mistakes| panic!("{mistakes:?}"))
}

#[test]
fn a_datum_on_both_halves_of_a_hole_names_both() {
    let Some(nominal) = part("nist_ctc_01_asme1_ap242-e1.stp") else {
        return;
    };
    let datums: BTreeMap<&str, &[u64]> = nominal
        .pmi()
        .iter()
        .filter_map(|p| match &p.kind {
            PmiKind::DatumFeature { letter } => Some((letter.as_str(), p.faces.as_slice())),
            _ => None,
        })
        .collect();
    // #34 by GEOMETRIC_ITEM_SPECIFIC_USAGE, #35 and #36 by ITEM_IDENTIFIED_REPRESENTATION_USAGE.
    let expected: [(&str, &[u64]); 3] = [("A", &[861]), ("B", &[853, 854]), ("C", &[839, 840])];
    assert_eq!(datums, expected.into_iter().collect());
}

#[test]
fn limits_come_from_the_tolerances_of_the_file_and_say_which() {
    let Some(nominal) = part("nist_ctc_01_asme1_ap242-e1.stp") else {
        return;
    };
    let facts = all_edge_facts(&nominal);
    let (resolved, findings) = resolve(&nominal, &facts, &recipe(ON_A_B_C));
    // #26: surface profile 1.25 | A | B | C on the faces #786 and #787.
    let mut profiles = 0;
    for (edge, resolved) in facts.iter().zip(&resolved) {
        for (side, quantity) in [Quantity::D1, Quantity::D2].into_iter().enumerate() {
            let limits = resolved.limits.of(quantity);
            if matches!(edge.faces[side], 786 | 787) {
                assert_eq!(limits, Some([-0.625, 0.625]));
                let source = resolved.limits.source(quantity);
                assert_eq!(source, Some(LimitSource::Pmi(26)));
                profiles += 1;
            } else {
                assert_eq!(limits, Some([-9.0, 9.0]), "{edge:?}");
                let source = resolved.limits.source(quantity);
                assert_eq!(source, Some(LimitSource::Recipe));
            }
        }
    }
    assert!(profiles > 2, "{profiles}");
    let said = |text: &str| findings.iter().any(|f| f.contains(text));
    // #27 refines #26 in the frame of A alone.
    assert!(
        said("#27: no limit of an edge: its datums are A"),
        "{findings:?}"
    );
    // #21 and #22 are of slots: the place of their middle planes.
    assert!(said(
        "#21, #22: no limit of an edge: position is of a face or of a feature of size"
    ));
    assert!(said("#57: no limit of an edge: flatness is of a face"));

    // In another frame the profile does not count.
    let best_fit = recipe("limits_from_pmi = true");
    let (resolved, findings) = resolve(&nominal, &facts, &best_fit);
    assert!(resolved.iter().all(|r| r.limits.of(Quantity::D1).is_none()));
    assert!(
        findings
            .iter()
            .any(|f| f.contains("its datums are A, B, C")),
        "{findings:?}"
    );
}

#[test]
fn a_zone_that_lies_unevenly_is_no_limit() {
    let Some(nominal) = part("nist_ctc_02_asme1_ap242-e2.stp") else {
        return;
    };
    let facts = all_edge_facts(&nominal);
    let (resolved, findings) = resolve(&nominal, &facts, &recipe(ON_A_B_C));
    let sources: Vec<LimitSource> = resolved
        .iter()
        .flat_map(|r| [Quantity::D1, Quantity::D2].map(|q| r.limits.source(q)))
        .flatten()
        .collect();
    // #56, #57 and #58 are UNEQUALLY_DISPOSED.
    for entity in [56, 57, 58] {
        assert!(!sources.contains(&LimitSource::Pmi(entity)));
    }
    let uneven = findings.iter().find(|f| f.contains("unevenly"));
    assert!(
        uneven.is_some_and(|f| f.starts_with("PMI #56, #57, #58: ")),
        "{findings:?}"
    );
}

/// A plane, the axis of a hole and that of another make the pose of a scan of the part as drawn.
#[test]
fn the_datums_of_the_file_hold_the_alignment() {
    let Some(nominal) = part("nist_ctc_01_asme1_ap242-e1.stp") else {
        return;
    };
    let spacing = (nominal.area_mm2() / 60_000.0).sqrt();
    let points = Nominal::samples(&nominal, spacing)
        .into_iter()
        .map(|s| s.point);
    let cloud = PointCloud::from_positions(Frame::Machine, points.collect());
    let recipe = recipe(ON_A_B_C);
    let start = Start::Rough(acies::geometry::RigidTransform::IDENTITY);
    let found = inspect(&cloud, &nominal, &Request::new(&recipe, start));
    assert_eq!(
        found.alignment.method,
        Method::Datums,
        "{:?}",
        found.findings
    );
    let kinds: Vec<DatumKind> = found.alignment.datums.iter().map(|d| d.kind).collect();
    assert_eq!(kinds, [DatumKind::Plane, DatumKind::Axis, DatumKind::Axis]);
    assert!(found.alignment.free_of_datums.is_empty());
    // The samples lie on the faces to rounding.
    let pose = found.alignment.part_from_machine;
    let [low, high] = nominal.faces_box_mm;
    for corner in [low, high] {
        assert!(pose.point(corner).distance(corner) < 1e-5, "{pose:?}");
    }
    let from_file = found
        .edges
        .iter()
        .flat_map(|e| &e.characteristics)
        .filter(|c| c.limits_from == Some(LimitSource::Pmi(26)))
        .count();
    assert!(from_file > 2, "{from_file}");
}

//! Limits of edges from the tolerances that a nominal carries, where they mean the same as a quantity of ours.
//!
//! | in the file | on | becomes |
//! |---|---|---|
//! | surface or line profile, zone t, evenly about the nominal | a face of the edge | d along that face's normal within +-t/2 |
//! | position, zone t | one plane alone, a face of the edge | the same |
//! | line profile, zone t, with datums | the edge | line profile at most t |
//! | line profile, zone t, without datums | the edge | line profile without datums at most t |
//! | straightness, zone t | the edge | straightness at most t |
//! | angle between the edge's two faces, with limits | both faces | deviation of the included angle |
//!
//! d along the normal of a face is the deviation of that face where it ends, so that the zone of its profile holds for d as well. That is
//! so only in the frame in which the zone lies: a tolerance with datums counts only where the alignment rests on the same datums in the
//! same order, and one without datums bounds a form and no place. Sizes, orientations and forms of faces say nothing about an edge;
//! edge breaks and burrs have no entity of their own in these files. Where several tolerances bound one quantity the tightest counts.
//!
//! Source: features-and-standards, section 4 (ISO 1101, ISO 1660, ISO 5459); ISO 10303-47.

use std::collections::BTreeMap;

use super::body::{Body, DatumShape};
use super::quantity::{Limits, Quantity};
use super::recipe::{DatumRecipe, DatumSource, EdgeFacts};
use crate::nominal::{EdgeKind, Measure, Pmi, PmiKind};

/// An angle of the file is that of an edge if it differs by less than this, rad.
const SAME_ANGLE: f64 = 2e-3;

/// Entities that a finding names.
const NAMED: usize = 6;

/// For every edge of `facts` its limits by the nominal's PMI, and findings on what gives none.
pub fn limits_from_pmi<B: Body>(
    nominal: &B,
    facts: &[EdgeFacts],
    datums: &[DatumRecipe],
) -> (Vec<Limits>, Vec<String>) {
    let mut limits = vec![Limits::default(); facts.len()];
    let mut unused: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    let letters = letters(datums);
    let is_plane = |entity: u64| {
        (0..nominal.face_count() as u32)
            .filter(|face| nominal.face_entity(*face) == entity)
            .all(|face| nominal.datum_shape(face) == Some(DatumShape::Plane))
    };
    for pmi in nominal.pmi() {
        if let Err(why) = take(pmi, facts, letters.as_deref(), is_plane, &mut limits) {
            unused.entry(why).or_default().push(pmi.entity);
        }
    }
    if nominal.pmi().is_empty() {
        let finding = "recipe: limits_from_pmi: the nominal carries no PMI, expected an AP242 file with semantic tolerances; no limit is taken from it";
        return (limits, vec![finding.to_owned()]);
    }
    let findings = unused.iter().map(|(why, entities)| {
        let named: Vec<String> = entities
            .iter()
            .take(NAMED)
            .map(|e| format!("#{e}"))
            .collect();
        let more = entities.len().saturating_sub(NAMED);
        let mut named = named.join(", ");
        if more > 0 {
            named = format!("{named} and {more} more");
        }
        format!("PMI {named}: no limit of an edge: {why}")
    });
    (limits, findings.collect())
}

/// Letters of the datums that the alignment rests on, in order; `None` where some are not from the PMI, or there are none.
fn letters(datums: &[DatumRecipe]) -> Option<Vec<&str>> {
    let mut ordered: Vec<&DatumRecipe> = datums.iter().collect();
    ordered.sort_by_key(|datum| datum.priority);
    let letters: Option<Vec<&str>> = ordered
        .iter()
        .map(|datum| match &datum.source {
            DatumSource::Pmi(letter) => Some(letter.as_str()),
            _ => None,
        })
        .collect();
    letters.filter(|letters| !letters.is_empty())
}

/// Enters what `pmi` says of the edges, or says why it says nothing.
fn take(
    pmi: &Pmi,
    facts: &[EdgeFacts],
    letters: Option<&[&str]>,
    is_plane: impl Fn(u64) -> bool,
    limits: &mut [Limits],
) -> Result<(), String> {
    let mut enter = |edge: usize, quantity: Quantity, pair: [f64; 2]| {
        limits[edge] = limits[edge].tightened(quantity, pair, pmi.entity);
    };
    match &pmi.kind {
        PmiKind::DatumFeature { .. } => Ok(()),
        PmiKind::Dimension {
            value: Measure::Angle(angle),
            deviations: Some(deviations),
            ..
        } => {
            let mut found = false;
            for (edge, facts) in facts.iter().enumerate() {
                let both =
                    pmi.faces.len() == 2 && facts.faces.iter().all(|f| pmi.faces.contains(f));
                if let Some(pair) = both.then(|| of_angle(facts, *angle, *deviations)).flatten() {
                    enter(edge, Quantity::AngleDeviation, pair);
                    found = true;
                }
            }
            if found {
                Ok(())
            } else {
                Err("its angle is not that of two faces at a sharp edge".to_owned())
            }
        }
        PmiKind::Dimension { .. } => Err("a size or a distance is not of an edge".to_owned()),
        PmiKind::Tolerance {
            what,
            zone_mm,
            datums,
            unequal,
        } => {
            let profile = matches!(what.as_str(), "surface_profile" | "line_profile");
            let straightness = what == "straightness";
            // On several planes it is of a slot or a tab, whose middle plane has its place.
            let one_plane = matches!(pmi.faces[..], [face] if is_plane(face));
            let place = profile || (what == "position" && one_plane);
            if !place && !straightness {
                return Err(format!(
                    "{} is of a face or of a feature of size",
                    what.replace('_', " ")
                ));
            }
            if *unequal {
                return Err("its zone lies unevenly about the nominal".to_owned());
            }
            let same = letters.is_some_and(|l| l.iter().eq(datums.iter()));
            if !datums.is_empty() && !same {
                return Err(format!(
                    "its datums are {}, and the alignment does not rest on these; give them as [[alignment.datum]] with pmi",
                    datums.join(", ")
                ));
            }
            let mut found = false;
            for (edge, facts) in facts.iter().enumerate() {
                if pmi.edges.contains(&facts.entity) {
                    let quantity = match (straightness, what.as_str(), datums.is_empty()) {
                        (true, ..) => Quantity::Straightness,
                        (_, "line_profile", true) => Quantity::LineForm,
                        (_, "line_profile", false) => Quantity::LineProfile,
                        _ => continue,
                    };
                    enter(edge, quantity, [f64::NEG_INFINITY, *zone_mm]);
                    found = true;
                }
                for (side, quantity) in [Quantity::D1, Quantity::D2].into_iter().enumerate() {
                    if place && !datums.is_empty() && pmi.faces.contains(&facts.faces[side]) {
                        enter(edge, quantity, [-0.5 * zone_mm, 0.5 * zone_mm]);
                        found = true;
                    }
                }
            }
            if found {
                Ok(())
            } else if datums.is_empty() && !pmi.faces.is_empty() {
                Err(format!(
                    "{} without datums bounds the form of a face",
                    what.replace('_', " ")
                ))
            } else {
                Err("it applies to no sharp edge and to no face with one".to_owned())
            }
        }
    }
}

/// The deviation of the included angle that `deviations` of `angle` allow; `None` where `angle` is not that of the edge. A drawing may
/// give the angle through the material or the one beside it, which grows where the other shrinks.
fn of_angle(facts: &EdgeFacts, angle: f64, deviations: [f64; 2]) -> Option<[f64; 2]> {
    let [least, most] = facts.turn_angle_rad;
    if most - least > SAME_ANGLE {
        return None;
    }
    let turn = 0.5 * (least + most);
    let included = match facts.kind {
        EdgeKind::Convex => std::f64::consts::PI - turn,
        EdgeKind::Concave => std::f64::consts::PI + turn,
    };
    let is = |other: f64| (angle - other).abs() < SAME_ANGLE;
    let [lower, upper] = deviations;
    // The angle between the normals opens with the material where it is concave, and closes where it is convex.
    if is(included) || (is(turn) && facts.kind == EdgeKind::Concave) {
        Some([lower, upper])
    } else if is(turn) || is(std::f64::consts::TAU - included) {
        Some([-upper, -lower])
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn facts(kind: EdgeKind, turn_deg: f64) -> EdgeFacts {
        EdgeFacts {
            id: "e1".to_owned(),
            entity: 7,
            faces: [17, 45],
            kind,
            box_mm: [DVec3::ZERO, DVec3::ONE],
            turn_angle_rad: [turn_deg.to_radians(); 2],
        }
    }

    /// A convex edge of 60 degrees through the material: its faces' normals turn by 120, and 300 lie outside.
    #[test]
    fn the_angle_of_a_drawing_may_be_on_either_side_of_the_faces() {
        let edge = facts(EdgeKind::Convex, 120.0);
        let of = |angle: f64| of_angle(&edge, angle.to_radians(), [-0.01, 0.02]);
        assert_eq!(of(60.0), Some([-0.01, 0.02]));
        assert_eq!(of(300.0), Some([-0.02, 0.01]));
        assert_eq!(of(120.0), Some([-0.02, 0.01]), "the supplement");
        assert_eq!(of(90.0), None);
        // Concave, 240 through the material, 120 in the air, 60 the supplement, which grows with the material.
        let edge = facts(EdgeKind::Concave, 60.0);
        let of = |angle: f64| of_angle(&edge, angle.to_radians(), [-0.01, 0.02]);
        assert_eq!(of(240.0), Some([-0.01, 0.02]));
        assert_eq!(of(120.0), Some([-0.02, 0.01]));
        assert_eq!(of(60.0), Some([-0.01, 0.02]));
    }

    fn tolerance(what: &str, datums: &[&str], unequal: bool) -> Pmi {
        Pmi {
            entity: 99,
            name: String::new(),
            kind: PmiKind::Tolerance {
                what: what.to_owned(),
                zone_mm: 0.4,
                datums: datums.iter().map(ToString::to_string).collect(),
                unequal,
            },
            faces: vec![45],
            edges: Vec::new(),
        }
    }

    fn taken(pmi: &Pmi, letters: Option<&[&str]>) -> Result<Limits, String> {
        let edges = [facts(EdgeKind::Convex, 90.0)];
        let mut limits = [Limits::default()];
        take(pmi, &edges, letters, |_| false, &mut limits).map(|()| limits[0])
    }

    #[test]
    fn a_profile_counts_in_the_frame_of_its_own_datums_only() {
        let profile = tolerance("surface_profile", &["A", "B"], false);
        let limits = taken(&profile, Some(&["A", "B"])).expect("the same frame");
        assert_eq!(limits.of(Quantity::D2), Some([-0.2, 0.2]));
        assert_eq!(limits.of(Quantity::D1), None, "another face");
        for letters in [None, Some(&["B", "A"][..]), Some(&["A", "B", "C"])] {
            assert!(taken(&profile, letters).is_err_and(|why| why.contains("A, B")));
        }
        let loose = tolerance("surface_profile", &[], false);
        assert!(taken(&loose, Some(&["A"])).is_err_and(|why| why.contains("without datums")));
        let unequal = tolerance("surface_profile", &["A"], true);
        assert!(taken(&unequal, Some(&["A"])).is_err_and(|why| why.contains("unevenly")));
        // Of a hole: its zone is about an axis.
        let hole = tolerance("position", &["A"], false);
        assert!(taken(&hole, Some(&["A"])).is_err());
        let flat = tolerance("flatness", &[], false);
        assert!(taken(&flat, None).is_err_and(|why| why.starts_with("flatness is of a face")));
    }

    #[test]
    fn a_line_profile_or_straightness_on_the_edge_is_its_own() {
        let on_edge = |what: &str, datums: &[&str]| {
            let pmi = Pmi {
                faces: Vec::new(),
                edges: vec![7],
                ..tolerance(what, datums, false)
            };
            taken(&pmi, Some(&["A"])).expect("it applies to the edge")
        };
        let at_most = Some([f64::NEG_INFINITY, 0.4]);
        assert_eq!(
            on_edge("line_profile", &["A"]).of(Quantity::LineProfile),
            at_most
        );
        assert_eq!(on_edge("line_profile", &[]).of(Quantity::LineForm), at_most);
        assert_eq!(
            on_edge("straightness", &[]).of(Quantity::Straightness),
            at_most
        );
    }
}

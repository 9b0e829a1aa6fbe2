//! The part against its STEP file and its stated defects.

use super::*;
use crate::scene::Ray;

#[test]
fn the_step_file_has_the_same_free_form_face() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/demo/part.step");
    let file = std::fs::read_to_string(path).unwrap();
    let one_line = file.replace(['\n', '\r', ' '], "");
    assert!(one_line.contains("PRODUCT('acies-demo-part'"));
    assert!(one_line.contains("SI_UNIT(.MILLI.,.METRE.)"));
    let entity = |id: &str| {
        let start = one_line.find(&format!(";{id}=")).unwrap() + 1;
        let end = start + one_line[start..].find(';').unwrap();
        &one_line[start..end]
    };
    let start = one_line
        .find("B_SPLINE_SURFACE_WITH_KNOTS('',3,3,((")
        .unwrap();
    let grid = &one_line[start..start + one_line[start..].find("))").unwrap()];
    let ids: Vec<&str> = grid[grid.find('#').unwrap()..]
        .split([',', '(', ')'])
        .filter(|s| s.starts_with('#'))
        .collect();
    assert_eq!(ids.len(), 16);
    for (n, id) in ids.into_iter().enumerate() {
        let text = entity(id);
        let inner = &text[text.rfind('(').unwrap() + 1..text.find(')').unwrap()];
        let p: Vec<f64> = inner.split(',').map(|v| v.parse().unwrap()).collect();
        let (i, j) = (n / 4, n % 4);
        let expected = [32.0 * i as f64 / 3.0, 50.0 * j as f64 / 3.0, TOP.z[i][j]];
        for (found, expected) in p.iter().zip(expected) {
            // written with 12 digits or more
            assert!(
                (found - expected).abs() < 1e-9,
                "control point {i} {j}: {p:?}"
            );
        }
    }
    let faces = one_line.matches("=ADVANCED_FACE(").count();
    // 20 edges of the part and the seam of the boss
    assert_eq!((faces, one_line.matches("=EDGE_CURVE(").count()), (10, 21));
}

#[test]
fn every_station_of_the_nominal_lies_on_both_its_faces_and_its_tangent_along_both() {
    let part = DemoPart::new(&Defects::none());
    assert_eq!(part.edges.len(), 20);
    for edge in &part.edges {
        for station in part.stations(edge, 2.0) {
            for face in edge.faces {
                let surface = part.nominal.surfaces.get(face);
                assert!(surface.value(station.point).abs() < 1e-12, "{}", edge.name);
                let along = surface.gradient(station.point).dot(station.tangent);
                assert!(along.abs() < 1e-12, "{}: {along}", edge.name);
            }
            // material on the inner side of a convex edge only, on three sides of a concave one
            let [a, b] = station.normals;
            let across = part.nominal.contains(station.point + 0.01 * (a - b));
            assert_eq!(across, edge.kind == EdgeKind::Concave, "{}", edge.name);
            assert!(part.nominal.contains(station.point - 0.01 * (a + b)));
        }
    }
}

#[test]
fn a_part_as_drawn_deviates_nowhere() {
    let part = DemoPart::new(&Defects::none());
    for edge in &part.edges {
        for station in part.stations(edge, 5.0) {
            let truth = part.truth(&station).unwrap();
            assert!(
                truth.d1_mm.abs().max(truth.d2_mm.abs()) < 1e-9,
                "{}",
                edge.name
            );
        }
    }
}

/// Truth of an edge by name: deviations along its first and second face, and the included angle in degrees.
fn truths(part: &DemoPart, name: &str) -> Vec<[f64; 3]> {
    let edge = part.edges.iter().find(|e| e.name == name).unwrap();
    let stations = part.stations(edge, 3.0);
    stations
        .iter()
        .map(|s| {
            let t = part.truth(s).unwrap();
            [t.d1_mm, t.d2_mm, t.included_angle_rad.to_degrees()]
        })
        .collect()
}

#[test]
fn the_demos_defects_are_what_they_say() {
    let part = DemoPart::new(&Defects::demo());
    let all = |name: &str, expected: [f64; 3]| {
        for found in truths(&part, name) {
            for (f, e) in found.iter().zip(expected) {
                assert!(
                    (f - e).abs() < 1e-9,
                    "{name}: {found:?}, expected {expected:?}"
                );
            }
        }
    };
    // the front turns about this very edge; less than 90 degrees are left of the material
    all("front", [0.0, 0.0, 89.75]);
    all("back", [0.0, 0.0, 90.0]);
    // a chamfer takes the edge away and leaves the virtual one
    all("right", [0.0, 0.0, 90.0]);
    all("wall foot", [0.060, 0.0, 270.0]);
    all("boss top", [0.030, 0.0, 90.0]);
    all("boss foot", [0.030, 0.0, 270.0]);
    for found in truths(&part, "wall top") {
        assert!((found[0] - 0.060).abs() < 1e-9);
        // the top goes on as the same polynomial, so along its own normal it departs by its curvature only
        assert!(found[1].abs() < 1e-4, "{found:?}");
    }
    // the front leans out above the plate: 12 mm higher by 12 tan(0.25 deg), seen along the nominal normal
    for found in truths(&part, "front top") {
        assert!((0.045..0.060).contains(&found[0]), "{found:?}");
    }
}

#[test]
fn the_made_part_has_its_defects_under_a_ray() {
    let part = DemoPart::new(&Defects::demo());
    let cast = |o: [f64; 3], d: [f64; 3]| {
        let hit = part.made.cast(&Ray::new(o.into(), d.into())).unwrap();
        (
            hit.distance,
            part.made.surfaces.get(hit.surface).name.clone(),
        )
    };
    let (d, name) = cast([50.0, 40.0, 18.0], [-1.0, 0.0, 0.0]);
    assert!((d - 17.94).abs() < 1e-10 && name == "wall");
    let (d, name) = cast([70.0, -10.0, 2.0], [0.0, 1.0, 0.0]);
    let missing = 10.0 * 0.25_f64.to_radians().tan();
    assert!((d - 10.0 - missing).abs() < 1e-10 && name == "front");
    let (d, name) = cast([56.0, 25.0, 40.0], [0.0, 0.0, -1.0]);
    assert!((d - 20.0).abs() < 1e-10 && name == "boss top");
    let (d, name) = cast([79.8, 25.0, 40.0], [0.0, 0.0, -1.0]);
    assert!((d - 28.2).abs() < 1e-10 && name == "chamfer");
    assert!(part.made.is_dark(DVec3::new(53.0, 0.0, 12.0)));
    assert!(!part.made.is_dark(DVec3::new(49.9, 0.0, 12.0)));
}

#[test]
fn a_station_on_no_edge_has_no_truth() {
    let part = DemoPart::new(&Defects::demo());
    let nowhere = Station {
        point: DVec3::new(60.0, 3.0, 12.0),
        tangent: DVec3::X,
        normals: [DVec3::NEG_Y, DVec3::Z],
    };
    assert_eq!(part.truth(&nowhere), None);
}

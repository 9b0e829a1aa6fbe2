//! Whole inspections with a recipe: corners, gaps, edges that are missing or too many, the environment, form.

use std::f64::consts::PI;

use acies::geometry::RigidTransform;
use acies::inspect::body::Body;
use acies::inspect::quantity::Quantity;
use acies::inspect::result::{Inspection, Verdict};
use acies::inspect::{Growing, Recipe, Request, Start, Surface, inspect};
use acies::points::{Frame, PointCloud};
use glam::{DMat3, DVec2, DVec3};

use super::SIGMA;
use super::solids::{Made, Noise, Solid};

fn recipe(text: &str) -> Recipe {
    Recipe::parse(text).unwrap_or_else(|mistakes| panic!("{mistakes:?}"))
}

fn inspected(solid: &Solid, cloud: &PointCloud, text: &str) -> Inspection {
    let recipe = recipe(text);
    inspect(cloud, solid, &Request::new(&recipe, Start::None))
}

fn outline(points: &[(f64, f64)]) -> Vec<DVec2> {
    points.iter().copied().map(DVec2::from).collect()
}

/// The faces of a prism: 0 bottom, 1 top, then one a side.
fn all_but_the_bottom(solid: &Solid) -> Vec<u32> {
    (1..solid.face_count() as u32).collect()
}

#[test]
fn corners_are_where_the_made_faces_meet() {
    let mut noise = Noise(41);
    let mut solid = Solid::cuboid(20.0, 14.0, 10.0);
    // Top, front (y = 0), right (x = 20), back, left.
    let offsets = [0.0, 0.05, -0.04, 0.03, 0.02, -0.06];
    for (made, offset) in solid.made.iter_mut().zip(offsets) {
        *made = Made {
            offset,
            gradient: DVec3::ZERO,
        };
    }
    let cloud = solid.scan(&all_but_the_bottom(&solid), SIGMA, &mut noise);
    let found = inspected(&solid, &cloud, "[limits]\ncorner_mm = 0.08");
    assert_eq!(found.corners.len(), 8);
    let normals = [
        -DVec3::Z,
        DVec3::Z,
        -DVec3::Y,
        DVec3::X,
        DVec3::Y,
        -DVec3::X,
    ];
    let mut measured = 0;
    for corner in &found.corners {
        if corner.nominal.z == 0.0 {
            assert_eq!(corner.measured, None, "{corner:?}");
            assert_eq!(corner.verdict, Verdict::NotDecidable);
            assert!(corner.reason.contains("not measured"), "{}", corner.reason);
            continue;
        }
        measured += 1;
        let at_face = |n: &DVec3| {
            let height = if n.x + n.y + n.z > 0.0 {
                n.dot(DVec3::new(20.0, 14.0, 10.0))
            } else {
                0.0
            };
            (n.dot(corner.nominal) - height).abs() < 1e-9
        };
        let truth: DVec3 = normals
            .iter()
            .zip(offsets)
            .filter(|(n, _)| at_face(n))
            .map(|(n, offset)| offset * *n)
            .sum();
        let total = corner.total_mm.expect("the upper corners are seen");
        let error = total.value - truth.length();
        assert!(error.abs() < 4.0 * total.u, "{corner:?}, truth {truth}");
        assert!(total.u < SIGMA, "a corner is better known than a point");
        let expected = if truth.length() < 0.08 {
            Verdict::Ok
        } else {
            Verdict::NotOk
        };
        assert_eq!(corner.verdict, expected, "{corner:?}");
    }
    assert_eq!(measured, 4);
    // Independent of the code under test: three planes meet where the matrix of their normals says.
    let matrix = DMat3::from_cols(DVec3::Z, -DVec3::Y, DVec3::X);
    assert!((matrix.determinant().abs() - 1.0).abs() < 1e-12);
}

/// A U: the two arms face each other across a slot of 10 mm, and end on one height.
pub(crate) const SLOT: [(f64, f64); 8] = [
    (0.0, 0.0),
    (30.0, 0.0),
    (30.0, 10.0),
    (20.0, 10.0),
    (20.0, 5.0),
    (10.0, 5.0),
    (10.0, 10.0),
    (0.0, 10.0),
];

/// The edge along z at this x, on top of an arm.
pub(crate) fn slot_edge(solid: &Solid, x: f64) -> String {
    let edges = solid.edges();
    let place = |e: usize| solid.station(e, 0.5 * edges[e].length_mm).point;
    let found = (0..edges.len()).find(|e| place(*e).distance(DVec3::new(x, 10.0, 12.5)) < 1e-6);
    edges[found.expect("an edge along z")].id.clone()
}

#[test]
fn gap_and_flush_are_those_of_the_made_arms() {
    let mut noise = Noise(42);
    let mut solid = Solid::prism(&outline(&SLOT), 25.0);
    let made = |offset| Made {
        offset,
        gradient: DVec3::ZERO,
    };
    // Sides in the order of the outline: 4 = top of the right arm, 5 = its wall, 7 = the left arm's wall, 8 = its top.
    solid.made[4] = made(0.03);
    solid.made[5] = made(0.06);
    solid.made[7] = made(-0.02);
    solid.made[8] = made(-0.05);
    let seen: Vec<u32> = (2..10).collect();
    let cloud = solid.scan(&seen, SIGMA, &mut noise);
    let edge = |x| slot_edge(&solid, x);
    let text = format!(
        "[[gap]]\nname = \"slot\"\nedges = [{:?}, {:?}]\ngap_mm = [9.9, 10.1]\nflush_mm = [-0.05, 0.05]\n\
         [[gap]]\nname = \"nowhere\"\nedges = [\"e1\", 77]",
        edge(10.0),
        edge(20.0)
    );
    let found = inspected(&solid, &cloud, &text);
    assert_eq!(found.gaps.len(), 1);
    assert!(found.findings.iter().any(|f| f.contains("nowhere")));
    let slot = &found.gaps[0];
    assert!(slot.stations.len() > 5, "{}", slot.stations.len());
    for station in &slot.stations {
        assert_eq!(station.nominal_mm.map(|v| (v * 1e9).round()), [1e10, 0.0]);
        let gap = station.gap_mm.value - (10.0 - 0.06 + 0.02);
        let flush = station.flush_mm.value - (0.03 + 0.05);
        assert!(gap.abs() < 4.0 * station.gap_mm.u, "{station:?}");
        assert!(flush.abs() < 4.0 * station.flush_mm.u, "{station:?}");
    }
    assert_eq!(slot.verdict, Verdict::NotOk, "the flush is 0.08");
    assert_eq!(found.verdict, Verdict::NotOk);
}

#[test]
fn an_edge_that_was_never_made_is_missing_and_makes_the_part_not_ok() {
    let mut noise = Noise(43);
    // A roof of 5 degrees on either side; made is a flat top at half its height.
    let rise = 15.0 * 5f64.to_radians().tan();
    let roof = Solid::prism(
        &outline(&[
            (0.0, 0.0),
            (30.0, 0.0),
            (30.0, 10.0),
            (15.0, 10.0 + rise),
            (0.0, 10.0),
        ]),
        30.0,
    );
    let flat = Solid::cuboid(30.0, 10.0 + 0.5 * rise, 30.0);
    let cloud = flat.scan(&[1, 2, 3, 4, 5], SIGMA, &mut noise);
    let ridge = {
        let edges = roof.edges();
        let turned = |e: &usize| {
            let station = roof.station(*e, 1.0);
            station.normals[0].angle_between(station.normals[1]) < 0.3
        };
        edges[(0..edges.len()).find(turned).expect("the ridge")]
            .id
            .clone()
    };
    let wide = format!("[[edge]]\nid = {ridge:?}\nd_mm = [-5, 5]");
    let found = inspected(&roof, &cloud, &wide);
    let of_ridge = found.edges.iter().find(|e| e.id == ridge);
    let reasons: Vec<&str> = of_ridge
        .iter()
        .flat_map(|e| e.stations.iter().map(|s| s.reason.as_str()))
        .collect();
    assert!(found.missing_edges.contains(&ridge), "{reasons:?}");
    assert_eq!(found.verdict, Verdict::NotOk);
    let lenient = format!("missing_edges = \"report\"\n{wide}");
    let found = inspected(&roof, &cloud, &lenient);
    assert!(found.missing_edges.contains(&ridge));
    assert_ne!(found.verdict, Verdict::NotOk);
}

#[test]
fn a_step_that_the_nominal_does_not_have_is_unexpected() {
    let mut noise = Noise(44);
    let nominal = Solid::prism(
        &outline(&[(0.0, 0.0), (30.0, 0.0), (30.0, 10.0), (0.0, 10.0)]),
        20.0,
    );
    let stepped = Solid::prism(
        &outline(&[
            (0.0, 0.0),
            (30.0, 0.0),
            (30.0, 10.0),
            (13.0, 10.0),
            (13.0, 9.2),
            (0.0, 9.2),
        ]),
        20.0,
    );
    let seen: Vec<u32> = (1..stepped.face_count() as u32).collect();
    let cloud = stepped.scan(&seen, SIGMA, &mut noise);
    let found = inspected(&nominal, &cloud, "unexpected_edges = \"not_ok\"");
    let step = found
        .unexpected_edges
        .iter()
        .flatten()
        .filter(|p| (p.x - 13.0).abs() < 1.0 && p.y > 8.5)
        .count();
    assert!(step > 5, "{:?}", found.unexpected_edges);
    assert_eq!(found.verdict, Verdict::NotOk);
    let found = inspected(&nominal, &cloud, "");
    assert!(!found.unexpected_edges.is_empty());
    assert_eq!(found.verdict, Verdict::Undefined);
}

#[test]
fn nothing_is_decided_outside_the_temperatures_of_the_recipe_or_without_one() {
    let mut noise = Noise(45);
    let solid = Solid::cuboid(12.0, 10.0, 8.0);
    let cloud = solid.scan(&all_but_the_bottom(&solid), SIGMA, &mut noise);
    let recipe = recipe(
        "minimum_coverage = 0.0\n[environment]\ntemperature_c = [18, 22]\n[limits]\nd_mm = [-0.5, 0.5]",
    );
    let verdict = |temperature_c| {
        let request = Request {
            temperature_c,
            ..Request::new(&recipe, Start::None)
        };
        let found = inspect(&cloud, &solid, &request);
        let said = found.findings.iter().any(|f| f.starts_with("temperature"));
        (found.verdict, said)
    };
    assert_eq!(verdict(Some(20.0)), (Verdict::Ok, false));
    assert_eq!(verdict(Some(23.0)), (Verdict::NotDecidable, true));
    assert_eq!(verdict(None), (Verdict::NotDecidable, true));
}

/// The edge point of the published QIF 3.0 results sample (qif-community, `QIF_Results_Sample.QIF`, features 9 to 17): what its
/// writer states is the component of the deviation along the normal of the edge's face.
#[test]
fn d_along_the_normal_is_what_the_qif_sample_states() {
    use acies::inspect::flank::FlankFit;
    use acies::inspect::virtual_edge::intersect;
    use acies::nominal::{EdgeKind, Station};

    let point = DVec3::new(2460.7099609375, 770.604614257813, 944.993591308594);
    let normal = DVec3::new(-0.735465884156764, -0.307902932144901, 0.603560864882807);
    let adjacent = DVec3::new(0.0411800179070127, -0.909449806293281, -0.413769568671128);
    let measured = DVec3::new(2460.72, 770.62, 944.98);
    let stated = -0.020323885079998;

    let normals = [normal, adjacent];
    let tangent = normal.cross(adjacent).normalize();
    let station = Station {
        s_mm: 0.0,
        point,
        tangent,
        normals,
        into_face: [-tangent.cross(normal), tangent.cross(adjacent)],
    };
    // Two flanks parallel to their faces, through the measured point.
    let flank = |n: DVec3| FlankFit {
        offset_mm: (measured - point).dot(n),
        tilt: 0.0,
        slope: 0.0,
        second: [0.0; 3],
        covariance: [[0.0; 2]; 2],
        sigma_mm: 0.0,
        points: 100,
        cut_mm: 0.0,
        lack_of_fit: false,
    };
    let flanks = normals.map(flank);
    let edge = intersect(
        &station,
        EdgeKind::Convex,
        [&flanks[0], &flanks[1]],
        |_, _| [0.0; 2],
    );
    let edge = edge.expect("two faces at 82 degrees");
    // The sample prints 15 decimals of a difference of numbers near 2460, which are good to 4.5e-13.
    assert!((edge.d_mm[0] - stated).abs() < 1e-12, "{}", edge.d_mm[0]);
    assert!((edge.d_mm[1] + 0.007_955).abs() < 1e-6, "{}", edge.d_mm[1]);
}

/// A face that is off and tilted moves a straight edge as a whole: a line profile, no form, and the direction of the tilt.
#[test]
fn form_along_an_edge_is_apart_from_its_place() {
    let mut noise = Noise(46);
    let mut solid = Solid::cuboid(40.0, 9.0, 6.0);
    // The front face y = 0 turns about z by 2 mrad: its edges run askew by as much.
    solid.made[2] = Made {
        offset: 0.1,
        gradient: 0.002 * DVec3::X,
    };
    let cloud = solid.scan(&all_but_the_bottom(&solid), SIGMA, &mut noise);
    let text = "[limits]\nstraightness_mm = 0.05\nline_profile_mm = 0.1";
    let found = inspected(&solid, &cloud, text);
    let edges = solid.edges();
    let top_front = (0..edges.len())
        .find(|e| {
            let place = solid.station(*e, 0.5 * edges[*e].length_mm).point;
            place.distance(DVec3::new(20.0, 0.0, 6.0)) < 1e-6
        })
        .expect("the upper front edge");
    let edge = &found.edges[top_front];
    let form = edge.form.expect("it was measured");
    let profile = form.line_profile_mm;
    // 0.1 mm and 2 mrad over half of the length less half a station: a station is at most 3 mm here.
    assert!((profile.value - 2.0 * (0.1 + 0.04)).abs() < 2.0 * 0.003 + 4.0 * profile.u);
    let straightness = form.straightness_mm.expect("straight");
    assert!(straightness.value < 0.02, "{straightness:?}");
    assert!(form.line_form_mm.expect("stations").value < 0.02);
    let (direction, _) = form.direction_rad.expect("stations");
    assert!(
        (direction.value - 0.002).abs() < 5.0 * direction.u + 1e-4,
        "{direction:?}"
    );
    let verdict = |quantity| {
        let found = edge.characteristics.iter().find(|c| c.quantity == quantity);
        found.map(|c| c.verdict)
    };
    assert_eq!(verdict(Quantity::Straightness), Some(Verdict::Ok));
    assert_eq!(verdict(Quantity::LineProfile), Some(Verdict::NotOk));
    let angle = edge
        .characteristics
        .iter()
        .find(|c| c.quantity == Quantity::AngleDeviation);
    assert!(
        angle
            .and_then(|c| c.statistics)
            .is_some_and(|s| s.max.abs() < PI / 180.0)
    );
}

/// A drop that the laser does not look down: the front of a cuboid is not in the scan, and the edges of its neighbours with it are boundaries.
#[test]
fn the_boundary_of_a_drop_is_measured_along_the_flank_that_was_seen() {
    let mut solid = Solid::cuboid(30.0, 9.0, 6.0);
    let made = |offset, gradient| Made { offset, gradient };
    solid.made[1] = made(0.07, DVec3::new(0.001, 0.0, 0.0));
    solid.made[3] = made(-0.05, DVec3::new(0.0, 0.002, 0.0));
    let text = |d: &str| format!("[[edge]]\nfaces = [11, 12]\n{d}");
    let edges = solid.edges();
    let front: Vec<usize> = (0..edges.len())
        .filter(|e| edges[*e].faces.contains(&2) && !edges[*e].faces.contains(&0))
        .collect();
    let top = front.iter().position(|e| edges[*e].faces.contains(&1));
    let top = front[top.expect("the top's front edge")];
    let side = usize::from(edges[top].faces[1] == 1);
    let (own, other) = (["d1_mm", "d2_mm"][side], ["d1_mm", "d2_mm"][1 - side]);
    let (mut squares, mut count) = (0.0, 0.0);
    for seed in 1..=3 {
        let mut noise = Noise(200 + seed);
        let cloud = solid.scan(&[1, 3, 4, 5], SIGMA, &mut noise);
        let found = inspected(&solid, &cloud, &text(&format!("{own} = [-0.1, 0.1]")));
        for e in &front {
            for station in &found.edges[*e].stations {
                assert!(station.measured.is_none());
                let Some(seen) = station.boundary else {
                    continue;
                };
                assert!(station.reason.starts_with("boundary: only flank"));
                let face = edges[*e].faces[seen.flank];
                assert_ne!(face, 2);
                // Of a plane face the deviation at the nominal edge.
                let truth = solid.made_at(face, station.station.point);
                squares += ((seen.d_mm.value - truth) / seen.d_mm.u).powi(2);
                count += 1.0;
                assert!(seen.d_mm.u < SIGMA, "{seen:?}");
            }
        }
        let edge = &found.edges[top];
        assert_eq!(edge.coverage, 0.0);
        assert!(edge.boundary_share > 0.9, "{}", edge.boundary_share);
        assert_eq!(
            edge.verdict,
            Verdict::Ok,
            "0.07 and half of 30 mm by 1 mrad lie within"
        );
    }
    // Mean of n squares of standard normal numbers: 1 with a standard deviation of sqrt(2 / n), and some for the estimated noise.
    let mean = squares / count;
    let chance = 3.0 * f64::sqrt(2.0 / count) + 0.06;
    assert!((mean - 1.0).abs() < chance, "{mean} of {count}");

    let cloud = solid.scan(&[1, 3, 4, 5], SIGMA, &mut Noise(210));
    let verdict = |limits: &str| inspected(&solid, &cloud, &text(limits)).edges[top].verdict;
    assert_eq!(verdict(&format!("{own} = [-0.05, 0.05]")), Verdict::NotOk);
    // What the unseen flank must be asked for decides nothing.
    let both = format!("{own} = [-0.1, 0.1]\n{other} = [-0.1, 0.1]");
    assert_eq!(verdict(&both), Verdict::NotDecidable);
}

/// Pieces of a scan as they would come: so many profiles of every view, then the next of every view.
fn pieces(cloud: &PointCloud, profiles: u32) -> Vec<PointCloud> {
    let last = cloud.origins.iter().map(|o| o.profile).max().unwrap_or(0);
    let mut pieces = Vec::new();
    for first in (0..=last).step_by(profiles as usize) {
        for view in 0..cloud.views.len() {
            let own: Vec<usize> = (0..cloud.len())
                .filter(|i| {
                    let origin = cloud.origins[*i];
                    usize::from(origin.view) == view
                        && (first..first + profiles).contains(&origin.profile)
                })
                .collect();
            pieces.push(cloud.subset(&own));
        }
    }
    pieces
}

#[test]
fn a_part_measured_while_it_is_scanned_is_as_one_measured_afterwards() {
    let mut noise = Noise(47);
    let mut solid = Solid::prism(
        &outline(&[
            (0.0, 0.0),
            (40.0, 0.0),
            (40.0, 12.0),
            (15.0, 12.0),
            (15.0, 20.0),
            (0.0, 20.0),
        ]),
        30.0,
    );
    for made in &mut solid.made {
        made.offset = 0.02 * (noise.uniform() - 0.5);
        made.gradient = DVec3::new(0.001 * noise.uniform(), 0.0, 0.001 * noise.uniform());
    }
    let cloud = solid.scan(&all_but_the_bottom(&solid), SIGMA, &mut noise);
    let moved = noise.motion(0.03, 0.3);
    let machine = cloud.map(Frame::Machine, |p| moved.point(p), |v| moved.vector(v));
    let recipe = recipe("station_step_mm = 1.5\n[limits]\nd_mm = [-0.08, 0.08]");
    let request = || Request::new(&recipe, Start::Rough(RigidTransform::IDENTITY));
    let afterwards = inspect(&machine, &solid, &request());
    let mut growing = Growing::new(Surface::new(&solid), request());
    let mut so_far = Vec::new();
    for (k, piece) in pieces(&machine, 6).into_iter().enumerate() {
        growing.push(piece);
        if k % 16 == 15 {
            so_far = growing.measure();
        }
    }
    assert_eq!(growing.len(), machine.len());
    assert!(so_far.iter().any(|edge| edge.coverage > 0.5), "{so_far:?}");
    let meanwhile = growing.finish();
    assert_eq!(meanwhile.verdict, afterwards.verdict);
    assert_eq!(meanwhile.alignment.status, afterwards.alignment.status);
    assert_eq!(meanwhile.missing_edges, afterwards.missing_edges);
    let mut compared = 0;
    let mut worst: f64 = 0.0;
    for (a, b) in meanwhile.edges.iter().zip(&afterwards.edges) {
        assert_eq!(a.stations.len(), b.stations.len());
        for (a, b) in a.stations.iter().zip(&b.stations) {
            let (Some(a), Some(b)) = (&a.measured, &b.measured) else {
                assert_eq!(a.measured.is_some(), b.measured.is_some(), "{a:?} {b:?}");
                continue;
            };
            compared += 1;
            for i in 0..2 {
                worst = worst.max((a.d_mm[i] - b.d_mm[i]).abs() / b.u_d_mm[i]);
                assert!((a.u_d_mm[i] / b.u_d_mm[i] - 1.0).abs() < 0.1, "{a:?} {b:?}");
            }
        }
    }
    println!("{compared} stations, worst difference {worst:.4} of u");
    assert!(compared > 150, "{compared}");
    // The poses come from other choices of points: a tenth of what they are known to.
    assert!(worst < 0.3, "{worst}");
}

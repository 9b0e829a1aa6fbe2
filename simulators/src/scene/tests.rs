//! Rays, normals and edges against closed forms, signs and sampling.

use glam::{DVec2, DVec3};
use proptest::prelude::*;

use super::span::Window;
use super::*;
use crate::pose::Pose;

/// Distances are exact to this, mm: coordinates of some 100 mm, a few roundings, roots of well-conditioned quadratics.
const EXACT: f64 = 1e-10;

fn one(build: impl FnOnce(&mut Surfaces) -> Solid) -> Scene {
    let mut surfaces = Surfaces::default();
    let solid = build(&mut surfaces);
    Scene::new(surfaces, solid)
}

fn hit(scene: &Scene, origin: [f64; 3], direction: [f64; 3]) -> Option<f64> {
    let hit = scene.cast(&Ray::new(origin.into(), direction.into()))?;
    Some(hit.distance)
}

#[track_caller]
fn close(found: Option<f64>, expected: f64) {
    let found = found.expect("a hit");
    assert!(
        (found - expected).abs() < EXACT,
        "{found}, expected {expected}"
    );
}

#[test]
fn rays_meet_primitives_where_closed_forms_say() {
    let plane = one(|s| Solid::region(s.add(Surface::plane("p", DVec3::Z * 3.0, DVec3::Z))));
    close(hit(&plane, [1.0, 2.0, 10.0], [0.6, 0.0, -0.8]), 7.0 / 0.8);
    assert_eq!(hit(&plane, [1.0, 2.0, 10.0], [1.0, 0.0, 0.0]), None);

    let cuboid = one(|s| s.cuboid("b", DVec3::ZERO, DVec3::new(4.0, 5.0, 6.0)).0);
    close(hit(&cuboid, [-3.0, 1.0, 1.0], [1.0, 0.0, 0.0]), 3.0);
    close(hit(&cuboid, [1.0, 1.0, 16.0], [0.0, 0.0, -1.0]), 10.0);
    assert_eq!(hit(&cuboid, [-3.0, 5.1, 1.0], [1.0, 0.0, 0.0]), None);

    let sphere = one(|s| s.sphere("s", DVec3::new(1.0, 2.0, 3.0), 2.0).0);
    // 1.2 beside the centre: the chord begins 1.6 before it
    close(hit(&sphere, [2.2, 2.0, 50.0], [0.0, 0.0, -1.0]), 47.0 - 1.6);

    let cylinder = one(|s| s.cylinder("c", DVec3::ZERO, DVec3::Z * 10.0, 5.0).0);
    close(hit(&cylinder, [-20.0, 3.0, 4.0], [1.0, 0.0, 0.0]), 16.0);
    close(hit(&cylinder, [1.0, 1.0, 30.0], [0.0, 0.0, -1.0]), 20.0);

    let cone = one(|s| s.cone("k", DVec3::ZERO, DVec3::Z * 10.0, 0.25_f64.atan()).0);
    // radius z/4: at z = 8 it is 2
    close(hit(&cone, [-20.0, 0.0, 8.0], [1.0, 0.0, 0.0]), 18.0);
    close(hit(&cone, [0.0, 0.0, -7.0], [0.0, 0.0, 1.0]), 7.0);
    assert_eq!(hit(&cone, [-20.0, 0.0, -8.0], [1.0, 0.0, 0.0]), None);

    let torus = one(|s| s.torus("t", DVec3::ZERO, DVec3::Z, [5.0, 1.0]).0);
    close(hit(&torus, [-20.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 14.0);
    close(hit(&torus, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 4.0);
    close(hit(&torus, [5.6, 0.0, 9.0], [0.0, 0.0, -1.0]), 9.0 - 0.8);
    assert_eq!(hit(&torus, [0.0, 0.0, 9.0], [0.0, 0.0, -1.0]), None);
}

#[test]
fn a_height_field_is_met_where_its_polynomial_says() {
    let field = crate::demo_part::TOP;
    let scene = one(|s| s.below_field("f", field, 0.0).0);
    for (x, y) in [(1.0, 1.0), (16.0, 25.0), (31.0, 48.0), (10.0, 3.0)] {
        close(
            hit(&scene, [x, y, 100.0], [0.0, 0.0, -1.0]),
            100.0 - field.height(x, y),
        );
    }
    // a grazing ray: the first place where a fine march goes under, and the exact one, agree to the march's step
    let ray = Ray::new(DVec3::new(-5.0, 20.0, 24.2), DVec3::new(1.0, 0.05, 0.01));
    let hit = scene.cast(&ray).unwrap();
    let marched = (0..400_000)
        .map(|i| f64::from(i) * 1e-4)
        .find(|&t| scene.contains(ray.at(t)))
        .unwrap();
    assert!(
        (0.0..1.1e-4).contains(&(marched - hit.distance)),
        "{marched} {}",
        hit.distance
    );
    assert!((hit.point.z - field.height(hit.point.x, hit.point.y)).abs() < EXACT);
}

#[test]
fn a_bezier_height_field_is_the_face_of_its_control_points() {
    let field = crate::demo_part::TOP;
    // de Casteljau in three dimensions on equally spaced control points
    let lerp = |p: [DVec3; 4], t: f64| {
        let mut p = p;
        for n in (1..4).rev() {
            for i in 0..n {
                p[i] = p[i].lerp(p[i + 1], t);
            }
        }
        p[0]
    };
    for (u, v) in [(0.0, 0.0), (0.3, 0.8), (1.0, 0.5), (0.77, 0.11)] {
        let rows: [DVec3; 4] = std::array::from_fn(|i| {
            let points = std::array::from_fn(|j| {
                DVec3::new(32.0 * i as f64 / 3.0, 50.0 * j as f64 / 3.0, field.z[i][j])
            });
            lerp(points, v)
        });
        let p = lerp(rows, u);
        assert!((p.z - field.height(p.x, p.y)).abs() < 1e-13);
    }
}

fn every_surface() -> Vec<Surface> {
    let axis = DVec3::new(1.0, 2.0, -0.5).normalize();
    let centre = DVec3::new(0.3, -0.2, 0.1);
    let mut field = Surface::height_field("field", crate::demo_part::TOP);
    field.place(&Pose::turn_about(DVec3::new(16.0, 25.0, 24.0), axis, 0.3));
    vec![
        Surface::plane("plane", centre, axis),
        Surface::cylinder("cylinder", centre, axis, 2.0),
        Surface::cone("cone", centre - 3.0 * axis, axis, 0.4),
        Surface::sphere("sphere", centre, 2.0),
        Surface::torus("torus", centre, axis, [3.0, 1.0]),
        field,
    ]
}

#[test]
fn gradients_are_the_derivatives_of_values() {
    for surface in every_surface() {
        for i in 0..20 {
            let t = f64::from(i);
            let p = DVec3::new(1.0 + t.sin(), 2.0 + (1.7 * t).cos(), 1.5 + (2.3 * t).sin());
            let h = 1e-5;
            let numeric = DVec3::from_array(std::array::from_fn(|k| {
                let step = DVec3::AXES[k] * h;
                (surface.value(p + step) - surface.value(p - step)) / (2.0 * h)
            }));
            // third derivatives of a few units times h^2, and rounding over h
            let off = (numeric - surface.gradient(p)).length();
            assert!(off < 1e-8, "{}: {off:e}", surface.name);
        }
    }
}

#[test]
fn a_mesh_of_a_box_is_met_like_the_box() {
    let corner = |i: u32| {
        DVec3::new(
            f64::from(i & 1) * 4.0,
            f64::from(i >> 1 & 1) * 5.0,
            f64::from(i >> 2) * 6.0,
        )
    };
    let corners: Vec<DVec3> = (0..8).map(corner).collect();
    let faces = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let triangles: Vec<[u32; 3]> = faces
        .iter()
        .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
        .collect();
    let mesh = one(|s| s.mesh("m", &corners, &triangles).unwrap().0);
    let solid = one(|s| s.cuboid("b", DVec3::ZERO, DVec3::new(4.0, 5.0, 6.0)).0);
    let mut hits = 0;
    for i in 0..40 {
        for j in 0..40 {
            // many of these run exactly through edges of triangles
            let target = DVec3::new(f64::from(i) * 0.25 - 2.0, f64::from(j) * 0.25 - 2.0, 3.0);
            let ray = Ray::new(
                DVec3::new(2.0, 2.5, 40.0),
                target - DVec3::new(2.0, 2.5, 40.0),
            );
            let (a, b) = (mesh.cast(&ray), solid.cast(&ray));
            let rim = |p: DVec3| {
                let d = (p - DVec3::new(2.0, 2.5, 3.0)).abs() - DVec3::new(2.0, 2.5, 3.0);
                d.to_array().iter().filter(|d| d.abs() < 1e-9).count() > 1
            };
            match (a, b) {
                (Some(a), Some(b)) => {
                    hits += 1;
                    assert!((a.distance - b.distance).abs() < EXACT);
                    assert!(rim(b.point) || a.normal.distance(b.normal) < 1e-12);
                }
                (None, None) => {}
                (a, b) => assert!(a.or(b).is_some_and(|h| rim(h.point)), "{a:?} {b:?}"),
            }
        }
    }
    assert!(hits > 300, "{hits}");
    assert!(mesh.contains(DVec3::new(1.0, 1.0, 1.0)));
    assert!(!mesh.contains(DVec3::new(1.0, 1.0, 7.0)));
}

#[test]
fn open_and_impossible_meshes_are_refused() {
    let mut s = Surfaces::default();
    let corners = [DVec3::ZERO, DVec3::X, DVec3::Y];
    let open = s.mesh("m", &corners, &[[0, 1, 2]]).unwrap_err();
    assert_eq!(
        open.to_string(),
        "mesh: edge 0 to 1 is used 1 times forward and 0 backward, expected once each; close the mesh"
    );
    let missing = s.mesh("m", &corners, &[[0, 1, 7]]).unwrap_err();
    assert_eq!(
        missing.to_string(),
        "mesh: triangle 0 refers to vertex 7, expected less than 3"
    );
}

#[test]
fn a_prism_of_any_polygon_is_met_on_the_right_side() {
    // an L: sides 0 bottom, 1 right low, 2 step, 3 inner wall, 4 top, 5 left
    let polygon =
        [(0., 0.), (8., 0.), (8., 3.), (3., 3.), (3., 9.), (0., 9.)].map(|(x, y)| DVec2::new(x, y));
    let mut s = Surfaces::default();
    let (solid, ids) = s.prism("l", &polygon, [0.0, 2.0]);
    let scene = Scene::new(s, solid);
    let cast = |o: [f64; 3], d: [f64; 3]| scene.cast(&Ray::new(o.into(), d.into())).unwrap();
    let inner = cast([7.0, 6.0, 1.0], [-1.0, 0.0, 0.0]);
    assert_eq!((inner.distance, inner.surface), (4.0, ids[2 + 3]));
    let step = cast([7.0, 6.0, 1.0], [0.0, -1.0, 0.0]);
    assert_eq!((step.distance, step.surface), (3.0, ids[2 + 2]));
    let top = cast([1.0, 1.0, 9.0], [0.0, 0.0, -1.0]);
    assert_eq!((top.distance, top.surface), (7.0, ids[1]));
    assert!(
        scene
            .cast(&Ray::new(DVec3::new(5.0, 5.0, 9.0), DVec3::NEG_Z))
            .is_none()
    );
    assert!(
        scene.contains(DVec3::new(1.0, 8.0, 1.0)) && !scene.contains(DVec3::new(5.0, 5.0, 1.0))
    );
}

#[test]
fn edges_lie_where_both_real_surfaces_meet() {
    let mut s = Surfaces::default();
    let station = Station {
        point: DVec3::new(3.0, 0.0, 0.0),
        tangent: DVec3::X,
        normals: [DVec3::NEG_Y, DVec3::Z],
    };
    // both faces moved outward, the first also turned by 1 degree about the nominal edge
    let turn = 1.0_f64.to_radians();
    let turned = DVec3::new(0.0, -turn.cos(), -turn.sin());
    let a = s.add(Surface::plane("a", turned * 0.05, turned));
    let b = s.add(Surface::plane("b", DVec3::Z * 0.02, DVec3::Z));
    let truth = s.edge_truth(&station, [a, b], EdgeKind::Convex).unwrap();
    assert!((truth.d2_mm - 0.02).abs() < 1e-14);
    let d1 = (0.05 + 0.02 * turn.sin()) / turn.cos();
    assert!((truth.d1_mm - d1).abs() < 1e-14, "{} {d1}", truth.d1_mm);
    let expected = std::f64::consts::FRAC_PI_2 - turn;
    assert!((truth.included_angle_rad - expected).abs() < 1e-12);
    let concave = s.edge_truth(&station, [a, b], EdgeKind::Concave).unwrap();
    assert!((concave.included_angle_rad + expected - std::f64::consts::TAU).abs() < 1e-12);
    assert_eq!(s.edge_truth(&station, [b, b], EdgeKind::Convex), None);
}

/// Everything at once: differences and unions of all kinds, placed askew.
fn pile() -> Scene {
    one(|s| {
        let (ball, _) = s.sphere("ball", DVec3::new(2.0, 1.0, 0.5), 2.0);
        let (bar, _) = s.cuboid(
            "bar",
            DVec3::new(-4.0, -1.0, -1.0),
            DVec3::new(4.0, 1.5, 1.0),
        );
        let (bore, _) = s.cylinder("bore", DVec3::new(-2.0, 0.0, -3.0), DVec3::Z * 6.0, 0.7);
        let (ring, _) = s.torus(
            "ring",
            DVec3::new(0.0, 0.0, 1.0),
            DVec3::new(0.2, 0.1, 1.0),
            [2.5, 0.6],
        );
        let (tip, _) = s.cone("tip", DVec3::new(0.0, 0.0, 4.0), DVec3::NEG_Z * 3.5, 0.5);
        let star = [(0., 2.), (-1., -2.), (0., -1.), (1., -2.)].map(|(x, y)| DVec2::new(x, y));
        let (mut star, _) = s.prism("star", &star, [-2.5, -0.5]);
        s.place(&mut star, &Pose::turn_about(DVec3::ZERO, DVec3::X, 0.7));
        let (mut hill, _) = s.below_field("hill", crate::demo_part::TOP, 20.0);
        s.place(&mut hill, &Pose::shift(DVec3::new(-16.0, -25.0, -24.0)));
        let (core, _) = s.cuboid("core", DVec3::splat(-6.0), DVec3::splat(6.0));
        let hill = Solid::all([hill, core]);
        let mut all = Solid::any([
            bar.minus(bore),
            ball,
            star,
            tip.minus(ring.clone()),
            ring,
            hill.complement(),
        ])
        .minus(s.sphere("bite", DVec3::new(3.5, 1.0, 1.0), 1.0).0);
        s.place(
            &mut all,
            &Pose::turn_about(DVec3::new(1.0, 0.0, 0.0), DVec3::new(0.6, 0.0, 0.8), 0.9),
        );
        all
    })
}

/// How near a point is to the nearest surface, whatever bounds what: near it, signs cannot be trusted.
fn clearance(scene: &Scene, p: DVec3) -> f64 {
    scene
        .surfaces
        .iter()
        .map(|(_, s)| s.value(p).abs())
        .fold(f64::INFINITY, f64::min)
}

fn direction() -> impl Strategy<Value = DVec3> {
    prop::array::uniform3(-1.0..1.0_f64)
        .prop_map(DVec3::from)
        .prop_filter("too short", |d| d.length() > 0.1)
}

proptest! {
    #[test]
    fn spans_agree_with_signs(o in prop::array::uniform3(-8.0..8.0_f64), d in direction(), t in prop::collection::vec(-15.0..15.0_f64, 20)) {
        let scene = pile();
        let ray = Ray::new(o.into(), d);
        let window = Window { from: -20.0, to: 20.0 };
        let spans = scene.solid.spans(&scene.surfaces, &ray, window);
        for pair in spans.windows(2) {
            prop_assert!(pair[0].leave.t <= pair[1].enter.t);
        }
        for t in t {
            let p = ray.at(t);
            if clearance(&scene, p) > 1e-7 {
                let inside = spans.iter().any(|s| s.enter.t <= t && t <= s.leave.t);
                prop_assert_eq!(inside, scene.contains(p), "t {} in {:?}", t, spans);
            }
        }
    }

    #[test]
    fn a_hit_is_the_first_entry_and_lies_on_its_surface(o in prop::array::uniform3(-8.0..8.0_f64), d in direction()) {
        let scene = pile();
        let ray = Ray::new(DVec3::from(o), d);
        if let Some(hit) = scene.cast(&ray) {
            let off = scene.surfaces.get(hit.surface).value(hit.point).abs();
            prop_assert!(off < 1e-9, "{} off {}", off, scene.surfaces.get(hit.surface).name);
            prop_assert!(hit.normal.dot(ray.direction) <= 1e-9);
            prop_assert!(scene.blocks(&ray, hit.distance + 1e-6));
            let before = scene.contains(ray.origin) || !scene.blocks(&ray, hit.distance - 1e-6);
            prop_assert!(before);
        }
    }
}

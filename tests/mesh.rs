//! Triangulations checked by their definitions, meshes by Euler's formula and exact bodies, normals by true ones.

use std::path::Path;
use std::process::Command;

use acies::mesh::{
    Body, Delaunay, DelaunayError, Mesh, Rings, Settings, check_delaunay, mesh, normals,
    orient_normals, topology,
};
use acies::points::{Neighbors, Unit, read};
use acies::surface::{plane_normals, weighted_plane_normals};
use glam::{DVec2, DVec3};
use proptest::prelude::*;

#[path = "mesh/bodies.rs"]
mod bodies;
mod clouds;
#[path = "mesh/embedded.rs"]
mod embedded;

use clouds::score::cloud;
use clouds::solids::{self, Hole, extrusion};

const OPEN: Settings = Settings {
    cone: true,
    open: true,
};

/// The triangulation, checked.
fn triangulated(points: &[DVec3]) -> Delaunay {
    let delaunay = Delaunay::new(points).expect("points that span space");
    if let Err(wrong) = check_delaunay(&delaunay) {
        panic!("{} points: {wrong}", points.len());
    }
    delaunay
}

/// The closed mesh of all points, checked to be one.
fn closed(name: &str, points: &[DVec3], genus: i64) -> Mesh {
    let made = mesh(points, Settings::default()).expect("points that span space");
    let t = made.topology;
    assert!(
        t.is_watertight() && t.is_manifold(),
        "{name}: {t:?}, {:?}",
        made.mending
    );
    assert_eq!(
        t.vertices,
        made.positions.len(),
        "{name}: every point is a vertex"
    );
    assert_eq!((t.pieces, t.genus()), (1, Some(genus)), "{name}");
    assert_eq!(
        t.triangles as i64,
        2 * t.vertices as i64 + 4 * (genus - 1),
        "{name}"
    );
    assert_eq!(
        (made.matched_percent(), made.delta_f()),
        (100.0, 0),
        "{name}"
    );
    made
}

fn volume(made: &Mesh) -> f64 {
    let six: f64 = (made.triangles.iter())
        .map(|t| {
            let [a, b, c] = t.map(|v| made.positions[v as usize]);
            a.dot(b.cross(c))
        })
        .sum();
    six / 6.0
}

fn area(made: &Mesh) -> f64 {
    let twice: f64 = (made.triangles.iter())
        .map(|t| {
            let [a, b, c] = t.map(|v| made.positions[v as usize]);
            (b - a).cross(c - a).length()
        })
        .sum();
    twice / 2.0
}

fn grid(steps: usize) -> Vec<DVec3> {
    let at = |i: usize| {
        DVec3::new(
            (i % steps) as f64,
            (i / steps % steps) as f64,
            (i / steps / steps) as f64,
        )
    };
    (0..steps * steps * steps).map(at).collect()
}

/// A file of the data folder, or none, said aloud, where the folder is absent.
fn data(name: &str) -> Option<Vec<DVec3>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data")
        .join(name);
    if !path.exists() {
        eprintln!("passed by: {} is absent", path.display());
        return None;
    }
    Some(
        read(&path, Unit::Millimetre)
            .expect("a readable model")
            .cloud
            .positions,
    )
}

#[test]
fn grids_and_cospherical_points_are_triangulated_without_flat_cells() {
    for steps in [2, 3, 10] {
        let delaunay = triangulated(&grid(steps));
        // Each cube of the grid falls into five or six cells.
        let cubes = (steps - 1).pow(3);
        assert!((5 * cubes..=6 * cubes).contains(&delaunay.finite_cells()));
    }
    // All on spheres around the origin: integer points of equal length, exactly cospherical.
    let range = -8i32..=8;
    let shell: Vec<DVec3> = (range.clone())
        .flat_map(|x| (-8i32..=8).map(move |y| (x, y)))
        .flat_map(|(x, y)| (-8i32..=8).map(move |z| (x, y, z)))
        .filter(|(x, y, z)| [81, 101].contains(&(x * x + y * y + z * z)))
        .map(|(x, y, z)| DVec3::new(f64::from(x), f64::from(y), f64::from(z)))
        .collect();
    assert!(shell.len() > 150);
    triangulated(&shell);
    // A raster of scan lines over two planes.
    let raster: Vec<DVec3> = (0..6_000)
        .map(|i| {
            let (x, y) = (f64::from(i % 200) * 0.1, f64::from(i / 200));
            if x < 10.0 {
                DVec3::new(x, y, 0.0)
            } else {
                DVec3::new(10.0, y, 10.0 - x)
            }
        })
        .collect();
    triangulated(&raster);
}

#[test]
fn repeated_points_count_once_and_flat_sets_are_refused() {
    let mut points = grid(4);
    points.extend(vec![DVec3::ONE; 10_000]);
    points.extend(grid(4));
    let delaunay = triangulated(&points);
    assert_eq!(delaunay.points.len(), 64);
    for (i, v) in delaunay.vertex_of.iter().enumerate() {
        assert_eq!(delaunay.points[*v as usize], points[i]);
    }
    assert!(
        delaunay.sources.iter().all(|s| *s < 64),
        "the first of equal points"
    );

    let refused = |points: &[DVec3]| Delaunay::new(points).map(|_| ()).unwrap_err();
    let flat = |distinct, dimension| DelaunayError::Flat {
        distinct,
        dimension,
    };
    assert_eq!(refused(&[]), flat(0, 0));
    assert_eq!(refused(&vec![DVec3::ONE; 10_000]), flat(1, 0));
    let line: Vec<DVec3> = (0..100)
        .map(|i| DVec3::new(1.0, 2.0, -3.0) * f64::from(i))
        .collect();
    assert_eq!(refused(&line), flat(100, 1));
    let plane: Vec<DVec3> = grid(10)
        .into_iter()
        .map(|p| DVec3::new(p.x, p.y, p.x + p.y))
        .collect();
    assert_eq!(refused(&plane), flat(100, 2));
    assert_eq!(
        refused(&plane).to_string(),
        "points: 100 distinct ones, all in one plane, expected a body in space; scan further sides of the part"
    );
    assert_eq!(
        refused(&[DVec3::ONE, DVec3::NAN]),
        DelaunayError::NotFinite { index: 1 }
    );
}

#[test]
fn absurd_scales_are_survived() {
    let mut cloud = bodies::ellipsoid(200, DVec3::new(1.0, 2.0, 3.0)).points;
    cloud.push(DVec3::new(1e-310, -1e-200, 0.0));
    for scale in [1e-300, 1e-60, 1.0, 1e60, 1e300] {
        let scaled: Vec<DVec3> = cloud.iter().map(|p| *p * scale).collect();
        assert_eq!(triangulated(&scaled).points.len(), 201, "{scale}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn any_set_is_triangulated_and_its_order_does_not_matter(
        raw in proptest::collection::vec((0u8..6, 0u8..6, 0u8..6), 5..120),
        fine in proptest::collection::vec((-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0), 0..60),
        is_fine in any::<bool>(),
    ) {
        // Small whole numbers: most questions are degenerate.
        let mut points: Vec<DVec3> = raw
            .into_iter()
            .map(|(x, y, z)| DVec3::new(f64::from(x), f64::from(y), f64::from(z)))
            .collect();
        if is_fine {
            points.extend(fine.into_iter().map(|(x, y, z)| DVec3::new(x, y, z)));
        }
        let cells = |d: &Delaunay| {
            let mut all: Vec<Vec<[u64; 3]>> = d.cells.iter().map(|c| {
                let mut corners: Vec<[u64; 3]> = c.iter()
                    .map(|v| d.points.get(*v as usize).map_or([0; 3], |p| p.to_array().map(f64::to_bits)))
                    .collect();
                corners.sort_unstable();
                corners
            }).collect();
            all.sort_unstable();
            all
        };
        let Ok(delaunay) = Delaunay::new(&points) else { return Ok(()) };
        prop_assert_eq!(check_delaunay(&delaunay), Ok(()));
        points.reverse();
        let other = Delaunay::new(&points).expect("the same points");
        prop_assert_eq!(cells(&delaunay), cells(&other));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn no_mesh_crosses_itself(
        raw in proptest::collection::vec((-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, 0.0f64..1.0), 6..90),
        kind in 0usize..4,
        steps in 3.0f64..400.0,
    ) {
        // Whole numbers on a ball, on a box, on both with noise, anywhere.
        let points: Vec<DVec3> = (raw.iter())
            .map(|(x, y, z, depth)| (DVec3::new(*x, *y, *z), depth))
            .map(|(p, depth)| match kind {
                0 => p.normalize_or_zero(),
                1 => p / p.abs().max_element(),
                2 => p.normalize_or_zero() * (1.0 - 0.1 * depth),
                _ => p,
            })
            .map(|p| (p * steps).round())
            .collect();
        let Ok(made) = mesh(&points, Settings::default()) else { return Ok(()) };
        let whole = |v: u32| made.positions[v as usize].to_array().map(|x| x as i128);
        let triangles: Vec<[embedded::Point; 3]> =
            made.triangles.iter().map(|t| t.map(whole)).collect();
        for (i, s) in triangles.iter().enumerate() {
            for t in &triangles[..i] {
                prop_assert!(!embedded::cross_one_another(*s, *t), "{:?} and {:?}", s, t);
            }
        }
    }
}

#[test]
fn the_checker_finds_what_is_wrong() {
    let good = triangulated(&bodies::ellipsoid(100, DVec3::ONE).points);
    let with = |change: &dyn Fn(&mut Delaunay)| {
        let mut bad = good.clone();
        change(&mut bad);
        check_delaunay(&bad).is_err()
    };
    assert!(with(&|d| d.cells[3].swap(0, 1)));
    assert!(with(&|d| d.neighbors[5].swap(1, 2)));
    assert!(with(&|d| d.points[7] *= 1.5));
    assert!(with(&|d| d.points.push(DVec3::ZERO)));
}

#[test]
fn known_models_have_their_known_cells() {
    if let Some(bunny) = data("models/stanford-bunny.obj") {
        assert_eq!(
            Delaunay::new(&bunny).expect("a body").finite_cells(),
            246_215
        );
    }
}

#[test]
fn bodies_are_closed_through_every_point() {
    let made = closed("torus", &bodies::torus(60, 60).points, 1);
    let exact = 2.0 * std::f64::consts::PI.powi(2) * 10.0 * 16.0;
    // Chords of 60 around: the volume of the inscribed body is below by 0.2 to 0.6 percent.
    assert!(
        (0.99 * exact..exact).contains(&volume(&made)),
        "{} of {exact}",
        volume(&made)
    );
    let made = closed(
        "ellipsoid",
        &bodies::ellipsoid(9_950, DVec3::new(1.0, 2.0, 4.0)).points,
        0,
    );
    let exact = 4.0 / 3.0 * std::f64::consts::PI * 8.0;
    assert!((0.998 * exact..exact).contains(&volume(&made)));
    closed(
        "three holes",
        &bodies::three_holes().even(4_000, 500).points,
        3,
    );
    closed(
        "cube with hole",
        &solids::cube_with_hole(10.0).even(2_224, 280).points,
        1,
    );
}

#[test]
fn faces_of_a_cube_are_flat_and_its_edges_sharp() {
    let sampled = solids::cube(10.0).even(4_000, 360);
    let made = closed("cube", &sampled.points, 0);
    // Points on the edges do not hit the corners: what is missing are the corners beyond them.
    assert!(
        (999.5..=1000.0).contains(&volume(&made)),
        "{}",
        volume(&made)
    );
    let off = made.triangles.iter().filter(|t| {
        let [a, b, c] = t.map(|v| made.positions[v as usize]);
        let n = (b - a).cross(c - a).normalize_or_zero().abs();
        n.max_element() < 1.0 - 1e-9
    });
    // At the eight corners, and where a point of a face lies too near an edge for its link to be Delaunay, a triangle lies on no face.
    let off = off.count();
    assert!(off <= 3 * 8, "{off} triangles off the faces");
}

#[test]
fn scale_place_and_bodies_apart_or_within_change_nothing() {
    let sphere = bodies::ellipsoid(2_000, DVec3::ONE * 10.0).points;
    let with =
        |scale: f64, at: DVec3| -> Vec<DVec3> { sphere.iter().map(|p| *p * scale + at).collect() };
    // A thousandth of a millimetre in all; a kilometre away.
    closed("tiny", &with(1e-4, DVec3::ZERO), 0);
    closed("far", &with(1.0, DVec3::new(1e6, 1e6, -1e6)), 0);
    for (name, second) in [
        ("apart", with(1.0, DVec3::X * 40.0)),
        ("beside, a spacing between", with(1.0, DVec3::X * 20.7)),
        ("within, a void", with(0.5, DVec3::ZERO)),
    ] {
        let mut both = sphere.clone();
        both.extend(second);
        let made = mesh(&both, Settings::default()).expect("bodies");
        let t = made.topology;
        assert!(t.is_watertight() && t.is_manifold(), "{name}: {t:?}");
        assert_eq!(
            (t.pieces, t.genus(), made.delta_f()),
            (2, Some(0), 0),
            "{name}"
        );
        // A void counts negative: its triangles look into it.
        let whole = 4.0 / 3.0 * std::f64::consts::PI * 1000.0;
        let expected = if name.starts_with("within") {
            0.875
        } else {
            2.0
        } * whole;
        let share = volume(&made) / expected;
        assert!((0.98..1.0).contains(&share), "{name}: {share}");
    }
}

#[test]
fn noise_and_random_samples_are_closed_too() {
    closed("block", &solids::block().sample(20_000, 0.1, 1).points, 2);
    let clean = solids::cube_with_hole(10.0).even(6_000, 500);
    // Table 2 of Weber's thesis: noise in percent of R = 8.5 at a spacing of 0.25.
    for percent in [0.4, 0.8, 1.2] {
        let reach = percent / 100.0 * 8.5 / 0.25 * clean.spacing;
        closed(
            &format!("{percent} %"),
            &clean.clone().shaken(reach, 5).points,
            1,
        );
    }
}

#[test]
fn the_mesh_depends_neither_on_threads_nor_on_the_order_of_points() {
    let points = solids::block().sample(8_000, 0.1, 4).points;
    let with = |threads: usize| {
        let pool = rayon_pool(threads);
        pool.install(|| {
            mesh(&points, Settings::default())
                .expect("a body")
                .triangles
        })
    };
    let one = with(1);
    assert_eq!(one, with(2));
    let reversed: Vec<DVec3> = points.iter().rev().copied().collect();
    let last = points.len() as u32 - 1;
    let mut back: Vec<[u32; 3]> = (mesh(&reversed, Settings::default())
        .expect("a body")
        .triangles
        .iter())
    .map(|t| {
        let mut t = t.map(|v| last - v);
        let low = (0..3).min_by_key(|k| t[*k]).unwrap_or(0);
        t.rotate_left(low);
        t
    })
    .collect();
    back.sort_unstable();
    assert_eq!(one, back);
}

#[test]
fn the_triangulation_has_the_same_bits_on_any_number_of_threads() {
    // Long cells through the middle that all threads want, and nothing but cospherical points.
    for points in [
        bodies::ellipsoid(30_000, DVec3::new(1.0, 1.0, 1.0)).points,
        grid(28),
    ] {
        let with = |threads: usize| rayon_pool(threads).install(|| triangulated(&points));
        let one = with(1);
        for threads in [2, 5] {
            let other = with(threads);
            assert_eq!(one.cells, other.cells);
            assert_eq!(one.neighbors, other.neighbors);
        }
    }
}

fn rayon_pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads")
}

#[test]
fn open_scans_keep_their_borders() {
    let sampled = solids::wedge(20.0, 2.0).sample(5_000, 0.05, 3);
    let made = mesh(&sampled.points, OPEN).expect("a body");
    let t = made.topology;
    assert!(
        t.is_manifold() && !t.is_watertight() && t.open_edges > 50,
        "{t:?}"
    );
    // Two squares of 20; the outermost points lie up to a spacing inside the border, noise roughens.
    let share = area(&made) / 800.0;
    assert!((0.9..1.1).contains(&share), "{share} of the area");
    let longest = (made.triangles.iter())
        .flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])])
        .map(|(a, b)| made.positions[a as usize].distance(made.positions[b as usize]))
        .fold(0.0, f64::max);
    assert!(longest < 8.0 * sampled.spacing, "{longest} bridges");
}

#[test]
fn an_exact_plane_is_an_open_mesh() {
    // A grid with a hole in it, in three planes: the whole squares of the grid outside the hole are the mesh.
    let grid: Vec<(f64, f64)> = (0..61 * 41)
        .map(|i| (f64::from(i % 61), f64::from(i / 61)))
        .filter(|(x, y)| (x - 30.0).hypot(y - 20.0) > 10.0)
        .collect();
    for (place, front) in [
        (
            (|x, y| DVec3::new(x, y, 3.0)) as fn(f64, f64) -> DVec3,
            DVec3::Z,
        ),
        (|x, y| DVec3::new(x, 3.0, y), DVec3::Y),
        (|x, y| DVec3::new(x, y, x + y), DVec3::new(-1.0, -1.0, 1.0)),
    ] {
        let points: Vec<DVec3> = grid.iter().map(|(x, y)| place(*x, *y)).collect();
        let refused = mesh(&points, Settings::default()).map(|_| ());
        assert!(matches!(
            refused,
            Err(DelaunayError::Flat { dimension: 2, .. })
        ));
        let made = mesh(&points, OPEN).expect("an open mesh");
        let t = made.topology;
        assert!(t.is_manifold() && t.pieces == 1, "{t:?}");
        // A ring; every point is a vertex.
        assert_eq!((t.euler, t.vertices), (0, points.len()));
        let sum: DVec3 = (made.triangles.iter())
            .map(|t| {
                let [a, b, c] = t.map(|v| made.positions[v as usize]);
                (b - a).cross(c - a) / 2.0
            })
            .sum();
        // Of the hole at least the square in its circle stays open, and no more than the circle with a step around it.
        let open = 60.0 * 40.0 - sum.dot(front) / front.length_squared();
        assert!((200.0..380.2).contains(&open), "{open} of the plane");
        assert!(sum.cross(front).length() < 1e-9 * sum.length());
    }
}

#[test]
fn a_scan_by_lines_from_one_side_is_a_sheet() {
    // Lines ten times sparser than the points along them.
    let (along, across) = (0.2, 2.0);
    let view = DVec3::new(0.1, 0.05, 1.0).normalize();
    let block = solids::block();
    let sampled = block.scan(&[view], (along, across), 0.1 * along, 3);
    let made = mesh(&sampled.points, OPEN).expect("a body");
    let t = made.topology;
    assert!(t.is_manifold(), "{t:?}");
    // Points that noise puts across their neighbours on the line are passed by, and slits stay where they were.
    let used = t.vertices as f64 / made.positions.len() as f64;
    assert!(used > 0.95, "{used} of the points, {t:?}");
    let seen: f64 = (sampled.points.iter().zip(&sampled.faces))
        .filter_map(|(p, f)| block.faces[usize::from(*f)].hit(*p + view * 100.0, -view))
        .map(|(_, n)| along * across / n.dot(view).abs())
        .sum();
    let share = area(&made) / seen;
    // Less a line at the borders, and slits between lines.
    assert!(
        (0.8..1.02).contains(&share),
        "{share} of the area seen, {t:?}"
    );
}

#[test]
fn normals_of_smooth_bodies_are_nearer_than_those_of_planes_and_look_out() {
    // The author's means and deviations (Ma 2011, table 4.1).
    let torus = (bodies::torus(60, 60), [0.00105, 0.00120, 0.00058]);
    let axes = DVec3::new(1.0, 2.0, 4.0);
    for (known, author) in [
        torus,
        (bodies::ellipsoid(9_950, axes), [0.00126, 0.00176, 0.00174]),
    ] {
        let cloud = cloud(&known.points);
        let neighbors = Neighbors::new(&cloud.positions);
        let body = Body::new(&cloud.positions, Settings::default()).expect("a body");
        let found = normals(&body, &cloud, &neighbors, Rings::One);
        assert_eq!(found.by_plane, 0);
        let inward = found
            .normals
            .iter()
            .zip(&known.normals)
            .filter(|(n, t)| n.as_dvec3().dot(**t) < 0.9);
        assert_eq!(inward.count(), 0);
        let ours = bodies::errors(&found.normals, &known.normals);
        let better = ours.iter().zip(&author).all(|(own, his)| own < his);
        assert!(better, "{ours:?} against the author's {author:?}");
        let [mean, ..] = ours;
        for mut other in [
            plane_normals(&cloud.positions, &neighbors, 30),
            weighted_plane_normals(&cloud.positions, &neighbors, 40),
        ] {
            let [plane, ..] = bodies::errors(&other, &known.normals);
            assert!(mean < 0.5 * plane, "{mean} against {plane}");
            orient_normals(&cloud.positions, &neighbors, &mut other);
            let inward = other
                .iter()
                .zip(&known.normals)
                .filter(|(n, t)| n.as_dvec3().dot(**t) < 0.0);
            assert_eq!(inward.count(), 0, "propagated over the graph of neighbours");
        }
    }
}

#[test]
fn noise_chooses_the_rings() {
    let clean = bodies::torus(100, 100);
    for (reach, expected) in [(0.0, Rings::One), (0.1, Rings::Three)] {
        let cloud = cloud(&bodies::shaken(&clean.points, reach, 7));
        let neighbors = Neighbors::new(&cloud.positions);
        let body = Body::new(&cloud.positions, Settings::default()).expect("a body");
        let found = normals(&body, &cloud, &neighbors, Rings::Auto);
        assert_eq!(found.rings, expected, "noise {reach} mm");
        let error = |rings| {
            bodies::errors(
                &normals(&body, &cloud, &neighbors, rings).normals,
                &clean.normals,
            )[0]
        };
        let own = error(expected);
        for other in [Rings::One, Rings::Two, Rings::Three] {
            let its = error(other);
            assert!(own <= its, "noise {reach} mm, {other:?}: {own} and {its}");
        }
        if expected == Rings::Three {
            let planes = plane_normals(&cloud.positions, &neighbors, 30);
            assert!(own < bodies::errors(&planes, &clean.normals)[0]);
        }
    }
}

#[test]
fn an_edge_that_the_triangulation_lacks_is_an_edge_of_the_mesh() {
    // An angle whose inner edge has points of both faces so near that no empty ball goes through two points of the edge.
    let (legs, thick, near) = (6i32, 2i32, 1.0 / 64.0);
    let is_in = |x: i32, z: i32| {
        let around = [(x - 1, z - 1), (x - 1, z), (x, z - 1), (x, z)];
        let cells = around.map(|(x, z)| {
            (0..legs).contains(&x) && (0..legs).contains(&z) && (x < thick || z < thick)
        });
        (cells.contains(&true), cells.contains(&false))
    };
    let mut points = Vec::new();
    for (x, z) in (0..=legs).flat_map(|x| (0..=legs).map(move |z| (x, z))) {
        for y in 0..=8 {
            let (inside, outside) = is_in(x, z);
            if inside && (outside || y == 0 || y == 8) {
                points.push(DVec3::new(f64::from(x), f64::from(y), f64::from(z)));
            }
        }
    }
    let inner = f64::from(thick);
    for y in 0..8 {
        let along = f64::from(y) + 0.5;
        points.push(DVec3::new(inner + near, along, inner));
        points.push(DVec3::new(inner, along, inner + near));
    }
    let place = |p: DVec3| points.iter().position(|q| *q == p).expect("made") as u32;
    let links: Vec<(u32, u32)> = (0..8)
        .map(|y| [y, y + 1].map(|y| place(DVec3::new(inner, f64::from(y), inner))))
        .map(|[a, b]| (a.min(b), a.max(b)))
        .collect();
    let delaunay = triangulated(&points);
    let is_there = |(a, b): &&(u32, u32)| {
        let [a, b] = [*a, *b].map(|i| delaunay.vertex_of[i as usize]);
        (delaunay.cells.iter()).any(|c| c.contains(&a) && c.contains(&b))
    };
    assert_eq!(links.iter().filter(is_there).count(), 0);
    let made = closed("angle", &points, 0);
    assert_eq!(kept(&made, &links), (8, 8));
    // The faces are met exactly.
    let exact = f64::from(8 * (2 * legs * thick - thick * thick));
    assert!((volume(&made) - exact).abs() < 1e-9, "{}", volume(&made));
}

#[test]
fn sharp_edges_of_the_fandisk_are_edges_of_the_mesh() {
    let Some(points) = data("models/fandisk.obj") else {
        return;
    };
    let made = closed("fandisk", &points, 0);
    let (found, all) = kept(&made, &clouds::fandisk::sharp_edges(25.0));
    assert!(found as f64 >= 0.995 * all as f64, "{found} of {all}");
}

#[test]
fn a_part_with_few_points_on_flat_faces_has_its_three_holes() {
    let Some(sampled) = clouds::models::labelled("mechpart.recon.m") else {
        return;
    };
    let made = closed("mechpart", &sampled.points, 3);
    let place = |p: DVec3| {
        sampled
            .points
            .iter()
            .position(|q| *q == p)
            .map(|i| i as u32)
    };
    let ends = |line: &clouds::Line| match line {
        clouds::Line::Segment(a, b) => Some((place(*a)?, place(*b)?)),
        _ => None,
    };
    let sharp: Vec<(u32, u32)> = (sampled.edges.iter())
        .filter_map(ends)
        .map(|(a, b)| (a.min(b), a.max(b)))
        .collect();
    let (found, all) = kept(&made, &sharp);
    assert_eq!(all, 904);
    assert!(found as f64 >= 0.99 * all as f64, "{found} of {all}");
}

/// How many of the edges are edges of the mesh, and how many there are.
fn kept(made: &Mesh, wanted: &[(u32, u32)]) -> (usize, usize) {
    let edges: std::collections::HashSet<(u32, u32)> = (made.triangles.iter())
        .flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])])
        .map(|(a, b)| (made.sources[a as usize], made.sources[b as usize]))
        .map(|(a, b)| (a.min(b), a.max(b)))
        .collect();
    let found = wanted.iter().filter(|e| edges.contains(e)).count();
    (found, wanted.len())
}

#[test]
fn small_through_holes_stay_open() {
    let profile = [(0.0, 0.0), (40.0, 0.0), (40.0, 4.0), (0.0, 4.0)].map(|(x, z)| DVec2::new(x, z));
    for (i, radius) in [0.9, 1.2, 1.6, 2.0].into_iter().enumerate() {
        let hole = Hole {
            centre: DVec2::new(20.0, 10.0),
            radius,
            top: 4.0,
            bottom: 0.0,
            blind: false,
        };
        let clean = extrusion(&profile, 20.0, &[hole]).even(4_000 + 101 * i, 400 + 7 * i);
        let around = std::f64::consts::TAU * radius / clean.spacing;
        assert!(
            around < 8.0 * 1.4f64.powi(i as i32),
            "{around} spacings around"
        );
        let noise = 0.1 * clean.spacing;
        closed(&format!("{radius}, exact"), &clean.points, 1);
        closed(
            &format!("{radius}, noise"),
            &clean.shaken(noise, 5).points,
            1,
        );
    }
}

#[test]
fn plates_thinner_than_the_spacing_are_one_body() {
    let profile =
        |z: f64| [(0.0, 0.0), (30.0, 0.0), (30.0, z), (0.0, z)].map(|(x, z)| DVec2::new(x, z));
    for (name, times) in [("random", 0.05), ("lattice", 0.5)] {
        let thick = 0.5 * times;
        let count = (1_200.0 + 100.0 * thick) as usize * 4;
        let plate = extrusion(&profile(thick), 20.0, &[]);
        let random = plate.sample(count, 0.0, 1).points;
        let lattice: Vec<DVec3> = (0..61 * 41 * 2)
            .map(|i| {
                let (x, y, upper) = (i % 61, i / 61 % 41, f64::from(i / (61 * 41)));
                let shift = 0.25 * upper;
                DVec3::new(
                    f64::from(x) * 0.5 + shift,
                    f64::from(y) * 0.5 + shift,
                    upper * thick,
                )
            })
            .collect();
        let points = if name == "random" { random } else { lattice };
        let made = closed(&format!("{name}, {times} spacings"), &points, 0);
        // Of random points the outermost lie off the edges, and dents are of the order of the thickness.
        let share = volume(&made) / (600.0 * thick);
        assert!(
            (0.9..1.0 + 1e-9).contains(&share),
            "{name}, {times}: {share}"
        );
    }
}

#[test]
fn a_wrong_vertex_among_ten_million_and_islands_beside_it_are_mended() {
    // The points around it, and every eight-thousandth of the others.
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mesh/islands.xyz");
    let points = read(&path, Unit::Millimetre)
        .expect("points")
        .cloud
        .positions;
    assert_eq!(points.len(), 1_346);
    // The block has two through holes.
    closed("part of ten million", &points, 2);
}

fn acies(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_acies"))
        .args(arguments)
        .output()
        .expect("the program runs");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.code().unwrap_or(-1),
        text(&output.stdout),
        text(&output.stderr),
    )
}

#[test]
fn the_program_meshes_writes_and_refuses() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("mesh");
    std::fs::create_dir_all(&folder).expect("a folder");
    let at = |name: &str| folder.join(name).display().to_string();
    let mut random = clouds::Random::new(11);
    let points = solids::cube_with_hole(10.0).even(1_500, 200).points;
    let lines: Vec<String> = points
        .iter()
        .map(|p| format!("{} {} {}", p.x, p.y, p.z))
        .collect();
    std::fs::write(at("scan.xyz"), lines.join("\n")).expect("a scan");
    for ending in ["ply", "stl", "obj"] {
        let out = at(&format!("mesh.{ending}"));
        let (status, json, wrong) = acies(&["mesh", &at("scan.xyz"), "-o", &out, "--json"]);
        assert_eq!(status, 0, "{wrong}");
        let said: serde_json::Value = serde_json::from_str(&json).expect("one JSON object");
        assert_eq!(
            (said["vertices"].as_u64(), said["triangles"].as_u64()),
            (Some(1_500), Some(3_000))
        );
        assert_eq!(
            (said["watertight"].as_bool(), said["manifold"].as_bool()),
            (Some(true), Some(true))
        );
        assert_eq!(
            (said["genus"].as_i64(), said["delta_f"].as_u64()),
            (Some(1), Some(0))
        );
        assert_eq!(said["matched_percent"].as_f64(), Some(100.0));
        assert!(said["seconds"]["delaunay"].as_f64().is_some());
        let back = read(Path::new(&out), Unit::Millimetre)
            .expect("its own file")
            .cloud
            .positions;
        assert!(back.len() >= 1_500, "{ending}: {} points", back.len());
    }
    let (status, said, _) = acies(&["mesh", &at("scan.xyz")]);
    assert_eq!(status, 0);
    assert!(
        said.starts_with(
            "1500 vertices, 3000 triangles in 1 pieces: watertight, manifold, 100.00 % matched"
        ),
        "{said}"
    );

    let (status, json, wrong) = acies(&[
        "normals",
        &at("scan.xyz"),
        "-o",
        &at("normals.ply"),
        "--json",
    ]);
    assert_eq!(status, 0, "{wrong}");
    let said: serde_json::Value = serde_json::from_str(&json).expect("one JSON object");
    assert_eq!(
        (said["points"].as_u64(), said["without"].as_u64()),
        (Some(1_500), Some(0))
    );
    for method in ["plane", "weighted-plane"] {
        assert_eq!(
            acies(&["normals", &at("scan.xyz"), "--method", method]).0,
            0
        );
    }

    std::fs::write(at("flat.xyz"), "0 0 0\n1 0 0\n0 1 0\n1 1 0\n3 1 0\n").expect("a scan");
    for command in ["mesh", "normals"] {
        let (status, _, wrong) = acies(&[command, &at("flat.xyz")]);
        assert_eq!(status, 65);
        assert!(
            wrong.contains("flat.xyz: points: 5 distinct ones, all in one plane"),
            "{wrong}"
        );
        let (status, _, wrong) = acies(&[command, &at("scan.xyz"), "-o", &at("mesh.doc")]);
        assert_eq!(status, 64, "{wrong}");
        assert_eq!(acies(&[command, &at("absent.xyz")]).0, 74);
    }
    assert_eq!(topology(0, &[]).vertices, 0);

    let (status, said, wrong) = acies(&["mesh", &at("flat.xyz"), "--open"]);
    assert_eq!(status, 0, "{wrong}");
    assert!(said.starts_with("5 vertices, 3 triangles"), "{said}");

    // Points in a volume are on no surface.
    let lines: Vec<String> = (0..3_000)
        .map(|_| random.unit())
        .collect::<Vec<f64>>()
        .chunks(3)
        .map(|c| format!("{} {} {}", c[0], c[1], c[2]))
        .collect();
    std::fs::write(at("volume.xyz"), lines.join("\n")).expect("a scan");
    let (status, said, wrong) = acies(&["mesh", &at("volume.xyz")]);
    assert_eq!(status, 0, "{wrong}");
    assert!(said.contains("do not lie on a surface"), "{said}");

    // Points that are no part of the surface are in the mesh, and told.
    let mut sphere = bodies::ellipsoid(2_000, DVec3::ONE * 10.0).points;
    sphere.extend((0..20).map(|i| DVec3::new(30.0 + 7.0 * f64::from(i), f64::from(i % 3), 1.0)));
    let lines: Vec<String> = sphere
        .iter()
        .map(|p| format!("{} {} {}", p.x, p.y, p.z))
        .collect();
    std::fs::write(at("outliers.xyz"), lines.join("\n")).expect("a scan");
    let (status, said, wrong) = acies(&["mesh", &at("outliers.xyz")]);
    assert_eq!(status, 0, "{wrong}");
    assert!(
        said.contains(" points lie more than") && said.contains("remove them first"),
        "{said}"
    );
}

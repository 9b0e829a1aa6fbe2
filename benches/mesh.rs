//! The figures of triangulation, meshes and normals, each row beside the aim or the author's number.
//!
//! `cargo bench --bench mesh -- PART...` with the parts `delaunay`, `table52`, `peers`, `normals`, `sharp`, `open`, `large`; all but `large` (ten million
//! points) by default. Speeds are also given as ratios to a reference of the same run: twenty neighbours of every point on a k-d tree, one
//! thread. `PICTURES=FOLDER` writes shaded pictures of the meshes.

#![allow(clippy::print_stdout)]

use std::collections::{HashMap, HashSet};
use std::time::Instant;

use acies::mesh::{Body, Delaunay, Mesh, Rings, Settings, check_delaunay, mesh, normals, picture};
use acies::points::{Neighbors, Unit, read};
use acies::surface::{plane_normals, weighted_plane_normals};
use glam::DVec3;

#[path = "../tests/mesh/bodies.rs"]
mod bodies;
#[path = "../tests/clouds/mod.rs"]
mod clouds;

use clouds::score::cloud;
use clouds::{Line, Random, solids};

/// Pairs of points, the lower index first.
type Edges = Vec<(u32, u32)>;

/// A file of the data folder, or none, said aloud.
fn data(name: &str) -> Option<Vec<DVec3>> {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data")
        .join(name);
    let found = read(&path, Unit::Millimetre)
        .ok()
        .map(|r| r.cloud.positions);
    if found.is_none() {
        println!("skipped: {} is absent", path.display());
    }
    found
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let done = work();
    (done, start.elapsed().as_secs_f64())
}

/// Seconds for twenty neighbours of every point, tree included, on one thread.
fn reference(points: &[DVec3]) -> f64 {
    let work = || {
        let neighbors = Neighbors::new(points);
        let mut found = Vec::new();
        let mut sum = 0.0;
        for i in neighbors.order() {
            neighbors.nearest(points[*i as usize], 20, &mut found);
            sum += found.last().map_or(0.0, |f| f.1);
        }
        sum
    };
    let (sum, seconds) = timed(work);
    assert!(sum >= 0.0);
    seconds
}

/// Most memory that the program has held so far, GB, where the system says.
fn peak_gb() -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find(|l| l.starts_with("VmHWM:"));
    let kb = line.and_then(|l| l.split_whitespace().nth(1)?.parse::<f64>().ok());
    kb.unwrap_or(f64::NAN) / 1e6
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

/// Spheres far apart with ten exactly cospherical points each: corners of a box and two more on its sphere.
fn tens_on_spheres(spheres: usize) -> Vec<DVec3> {
    let mut random = Random::new(5);
    let mut points = Vec::with_capacity(10 * spheres);
    for _ in 0..spheres {
        let centre = DVec3::new(random.unit(), random.unit(), random.unit()) * 4096.0;
        let centre = centre.round();
        for i in 0..8 {
            let sign = |bit: i32| if i & bit == 0 { -1.0 } else { 1.0 };
            points.push(centre + DVec3::new(sign(1), 2.0 * sign(2), 2.0 * sign(4)));
        }
        // 1 + 4 + 4 = 9 = 3².
        points.push(centre + DVec3::X * 3.0);
        points.push(centre - DVec3::Y * 3.0);
    }
    points
}

fn delaunay() {
    println!(
        "\ncloud                      points      cells  seconds  ratio to 20 neighbours   checked"
    );
    let mut rows: Vec<(&str, Vec<DVec3>, Option<usize>)> = Vec::new();
    if let Some(bunny) = data("models/stanford-bunny.obj") {
        rows.push(("bunny", bunny, Some(246_215)));
    }
    rows.push((
        "ellipsoid 36k",
        bodies::ellipsoid(36_000, DVec3::new(1.0, 2.0, 4.0)).points,
        None,
    ));
    rows.push((
        "part500k",
        solids::block().sample(500_000, 0.1, 1).points,
        None,
    ));
    rows.push((
        "part2M",
        solids::block().sample(2_000_000, 0.1, 1).points,
        None,
    ));
    rows.push(("grid 100^3", grid(100), None));
    rows.push(("tens on spheres 1M", tens_on_spheres(100_000), None));
    let mut copies = vec![DVec3::ONE; 10_000];
    copies.extend(grid(3));
    rows.push(("10,000 copies and 3^3", copies, None));
    for (name, points, known) in rows {
        let (first, mut seconds) = timed(|| Delaunay::new(&points).expect("a body"));
        let checked = check_delaunay(&first);
        let cells = first.finite_cells();
        drop(first);
        if points.len() <= 500_000 {
            for _ in 0..2 {
                seconds = seconds.min(timed(|| Delaunay::new(&points)).1);
            }
        }
        let ratio = seconds / reference(&points);
        let note = known.map_or(String::new(), |k| format!(", known {k}"));
        println!(
            "{name:22} {:10} {cells:10} {seconds:8.3} {ratio:12.2}     {checked:?}{note}",
            points.len()
        );
    }
}

fn row(name: &str, points: &[DVec3], genus: i64, settings: Settings) -> Mesh {
    let (made, seconds) = timed(|| mesh(points, settings).expect("a body"));
    let t = made.topology;
    let expected = 2 * made.positions.len() as i64 + 4 * (genus - 1);
    let right = t.genus() == Some(genus) && t.pieces == 1 && t.triangles as i64 == expected;
    println!(
        "{name:24} {:8} {:9} / {expected:9} {:7.2} {:8.3} {:6} {seconds:8.2}  {}",
        made.positions.len(),
        t.triangles,
        made.matched_by_umbrellas_percent(),
        made.matched_percent(),
        (expected - t.triangles as i64).abs(),
        if right {
            "closed, true genus".to_owned()
        } else {
            format!("< {t:?}")
        },
    );
    let stages: Vec<String> = made
        .seconds
        .iter()
        .map(|(n, s)| format!("{n} {s:.2}"))
        .collect();
    println!("    {}", stages.join(", "));
    picture_of(name, &made);
    made
}

fn picture_of(name: &str, made: &Mesh) {
    if let Ok(folder) = std::env::var("PICTURES") {
        let sight = DVec3::new(0.5, 0.7, -0.6);
        let bytes = picture::render(&made.positions, &made.triangles, sight, (1200, 900));
        let path = format!("{folder}/{}.png", name.replace([' ', '%', '.', ':'], "-"));
        println!("    picture {path}: {:?}", std::fs::write(&path, bytes));
    }
}

fn head() {
    println!(
        "\ncloud                    vertices  triangles /  expected  umbr. % matched %  dF    seconds"
    );
}

/// Table 5.2: 100 % and Delta F 0 everywhere, with the cone; Delta F here against the true genus.
fn table52() {
    println!("\nMa 2011, table 5.2: bunny 72.4 s, fandisk 9.2 s, cube with hole 3.9 s");
    head();
    let settings = Settings::default();
    if let Some(bunny) = data("models/stanford-bunny.obj") {
        row("bunny", &bunny, 0, settings);
    }
    if let Some(fandisk) = data("models/fandisk.obj") {
        row("fandisk", &fandisk, 0, settings);
    }
    row(
        "cube with hole 2,224",
        &solids::cube_with_hole(10.0).even(2_224, 280).points,
        1,
        settings,
    );
    row(
        "block 40,000",
        &solids::block().sample(40_000, 0.0, 1).points,
        2,
        settings,
    );
    row("torus 3,600", &bodies::torus(60, 60).points, 1, settings);
    row(
        "ellipsoid 9,950",
        &bodies::ellipsoid(9_950, DVec3::new(1.0, 2.0, 4.0)).points,
        0,
        settings,
    );
    row(
        "three holes 4,000",
        &bodies::three_holes().even(4_000, 500).points,
        3,
        settings,
    );
}

/// The edges of the triangulation: a mesh of its facets has no others.
fn possible(points: &[DVec3]) -> HashSet<(u32, u32)> {
    let delaunay = Delaunay::new(points).expect("a body");
    let source = |v: u32| {
        delaunay
            .sources
            .get(v as usize)
            .copied()
            .unwrap_or(u32::MAX)
    };
    let ordered = |a: u32, b: u32| (a.min(b), a.max(b));
    (delaunay.cells.iter())
        .map(|c| c.map(source))
        .flat_map(|c| {
            [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)].map(|(i, j)| ordered(c[i], c[j]))
        })
        .collect()
}

/// For every input point those that the mesh has edges to.
fn beside(made: &Mesh) -> HashMap<u32, Vec<u32>> {
    let mut beside: HashMap<u32, Vec<u32>> = HashMap::new();
    // An edge has two triangles, and each goes along it one way.
    for t in &made.triangles {
        for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
            let [a, b] = [a, b].map(|v| made.sources[v as usize]);
            beside.entry(a).or_default().push(b);
        }
    }
    beside
}

fn is_edge(beside: &HashMap<u32, Vec<u32>>, (a, b): (u32, u32)) -> bool {
    beside.get(&a).is_some_and(|others| others.contains(&b))
}

/// Whether edges of the mesh lead from one point to another over points for which `is_near` holds.
fn follows(
    beside: &HashMap<u32, Vec<u32>>,
    (from, to): (u32, u32),
    is_near: impl Fn(u32) -> bool,
) -> bool {
    let mut reached = vec![from];
    let mut at = 0;
    while at < reached.len() && !reached.contains(&to) {
        for next in beside.get(&reached[at]).into_iter().flatten() {
            if !reached.contains(next) && (*next == to || is_near(*next)) {
                reached.push(*next);
            }
        }
        at += 1;
    }
    reached.contains(&to)
}

/// Links along true edges, for clouds whose points on edges come first and in order, and triangles off the surface.
///
/// A link that the mesh lacks is followed where its edges lead there over points that lie within 3 % of a spacing of the true edge: points of the faces
/// beside it. Off the surface is a triangle whose centre is farther from it than that.
fn links(made: &Mesh, sampled: &clouds::Sampled, solid: &clouds::Solid) {
    let beside = beside(made);
    let possible = possible(&sampled.points);
    let near = 0.03 * sampled.spacing;
    let on_edge = sampled.on_edge.iter().filter(|o| **o).count() as u32;
    let point = |i: u32| sampled.points[i as usize];
    let is_near = |i: u32| sampled.edges.iter().any(|l| l.distance(point(i)) < near);
    let along = |i: &u32| {
        // Made there; rounding only.
        let is_on = |l: &Line| l.distance(point(*i - 1)) < 1e-9 && l.distance(point(*i)) < 1e-9;
        sampled.edges.iter().any(is_on)
    };
    let all: Vec<(u32, u32)> = (1..on_edge).filter(along).map(|i| (i - 1, i)).collect();
    let found = all.iter().filter(|l| is_edge(&beside, **l)).count();
    let most = all.iter().filter(|l| possible.contains(l)).count();
    let followed =
        (all.iter()).filter(|l| !is_edge(&beside, **l) && follows(&beside, **l, is_near));
    let followed = followed.count();
    let is_off = |t: &&[u32; 3]| {
        let [a, b, c] = t.map(|v| made.positions[v as usize]);
        let (n, centre) = ((b - a).cross(c - a).normalize_or_zero(), (a + b + c) / 3.0);
        let meets = |way: DVec3| {
            let mut hits = (solid.faces.iter()).filter_map(|f| f.hit(centre - way * near, way));
            hits.any(|(t, _)| t < 2.0 * near)
        };
        ![n, DVec3::X, DVec3::Y, DVec3::Z].into_iter().any(meets)
    };
    let off = made.triangles.iter().filter(is_off).count();
    println!(
        "    {found} of {} links along the true edges, {followed} of the others are followed; {most} are in the triangulation; {off} triangles off the surface",
        all.len()
    );
}

fn peers() {
    println!("\npeers.md: best of them leaves these open or incomplete");
    head();
    let settings = Settings::default();
    let (cube, hole) = (solids::cube(10.0), solids::cube_with_hole(10.0));
    for (name, solid, counts, genus) in [
        ("cube 10,250", &cube, (10_250, 580), 0),
        ("hole 17,400", &hole, (17_400, 839), 1),
        ("hole 58,720", &hole, (58_720, 1_350), 1),
    ] {
        let sampled = solid.even(counts.0, counts.1);
        let made = row(name, &sampled.points, genus, settings);
        links(&made, &sampled, solid);
    }
    let block = solids::block().sample(40_000, 0.0, 1);
    let made = row("block 40,000 at random", &block.points, 2, settings);
    links(&made, &block, &solids::block());
    for percent in [0.4, 0.8, 1.2, 2.0] {
        let clean = solids::cube_with_hole(10.0).even(17_400, 839);
        let reach = percent / 100.0 * 8.5 / 0.25 * clean.spacing;
        row(
            &format!("hole 17,400 noise {percent} %"),
            &clean.shaken(reach, 5).points,
            1,
            settings,
        );
    }
    if let Some((vertices, faces)) = clouds::fandisk::model() {
        let faces: Vec<[usize; 3]> = faces.iter().map(|f| f.map(|v| v as usize)).collect();
        let sampled = clouds::score::mesh(&vertices, &faces, 41_250, 25.0);
        row("fandisk 41,250", &sampled.points, 0, settings);
    }
    row(
        "part500k noise 0.1 s",
        &solids::block().sample(500_000, 0.1, 1).points,
        2,
        settings,
    );
}

fn normal_rows() {
    println!("\nMa 2011, table 4.1: mean, root mean square, standard deviation, rad");
    println!(
        "{:12} {:16} {:>8} {:>8} {:>8}",
        "cloud", "method", "mean", "rms", "std"
    );
    let mut rows = vec![
        (
            "torus 3600",
            bodies::torus(60, 60),
            [0.00105, 0.00120, 0.00058],
        ),
        (
            "ellipsoid",
            bodies::ellipsoid(9_950, DVec3::new(1.0, 2.0, 4.0)),
            [0.00126, 0.00176, 0.00174],
        ),
    ];
    if let Some((points, faces)) = clouds::fandisk::model() {
        let mut sums = vec![DVec3::ZERO; points.len()];
        for f in &faces {
            let [a, b, c] = f.map(|v| points[v as usize]);
            f.iter()
                .for_each(|v| sums[*v as usize] += (b - a).cross(c - a));
        }
        let truth = sums.iter().map(|n| n.normalize_or_zero()).collect();
        let known = bodies::Known {
            points,
            normals: truth,
        };
        rows.push(("fandisk 6475", known, [0.01791, 0.07970, 0.07766]));
    }
    rows.push(("cube 866", cube_866(), [0.03122, 0.10691, 0.10231]));
    for (name, known, author) in &rows {
        let cloud = cloud(&known.points);
        let neighbors = Neighbors::new(&cloud.positions);
        let body = Body::new(&cloud.positions, Settings::default()).expect("a body");
        let found = normals(&body, &cloud, &neighbors, Rings::Auto);
        let all = [
            ("umbrella", bodies::errors(&found.normals, &known.normals)),
            (
                "plane",
                bodies::errors(
                    &plane_normals(&cloud.positions, &neighbors, 30),
                    &known.normals,
                ),
            ),
            (
                "weighted plane",
                bodies::errors(
                    &weighted_plane_normals(&cloud.positions, &neighbors, 40),
                    &known.normals,
                ),
            ),
            ("(author)", *author),
        ];
        for (method, [mean, rms, std]) in all {
            println!("{name:12} {method:16} {mean:8.5} {rms:8.5} {std:8.5}");
        }
    }
    println!("\nfigures 4.11 and 4.12: torus of 10,000, mean error, rad");
    println!("noise    one ring  two rings  three      automatic  plane 30  chosen");
    let clean = bodies::torus(125, 80);
    for level in [0.0, 0.04, 0.08, 0.12, 0.16, 0.2] {
        // The author's unit: the mean distance to ten neighbours, 1.2 spacings here.
        let spacing = (4.0 * std::f64::consts::PI.powi(2) * 40.0 / 10_000.0).sqrt();
        let cloud = cloud(&bodies::shaken(&clean.points, level * 1.2 * spacing, 3));
        let neighbors = Neighbors::new(&cloud.positions);
        let body = Body::new(&cloud.positions, Settings::default()).expect("a body");
        let error = |rings| {
            bodies::errors(
                &normals(&body, &cloud, &neighbors, rings).normals,
                &clean.normals,
            )[0]
        };
        let plane = bodies::errors(
            &plane_normals(&cloud.positions, &neighbors, 30),
            &clean.normals,
        )[0];
        println!(
            "{level:5.2} {:10.4} {:10.4} {:10.4} {:10.4} {plane:10.4}  {:?}",
            error(Rings::One),
            error(Rings::Two),
            error(Rings::Three),
            error(Rings::Auto),
            normals(&body, &cloud, &neighbors, Rings::Auto).rings,
        );
    }
}

/// 866 points of a cube's lattice of twelve steps, with the mean of the normals of their faces.
fn cube_866() -> bodies::Known {
    let mut known = bodies::Known {
        points: Vec::new(),
        normals: Vec::new(),
    };
    let n = 12;
    for i in 0..(n + 1) * (n + 1) * (n + 1) {
        let c = [i % (n + 1), i / (n + 1) % (n + 1), i / (n + 1) / (n + 1)];
        let out = c.map(|c| {
            if c == 0 {
                -1.0
            } else if c == n {
                1.0
            } else {
                0.0
            }
        });
        let normal = DVec3::from_array(out);
        if normal != DVec3::ZERO {
            known.points.push(DVec3::from_array(c.map(|c| c as f64)));
            known.normals.push(normal.normalize());
        }
    }
    known
}

/// Sides of needles no higher than the rounding of their points are marked as sharp too: a mesh without the needle has the points between as corners, and its
/// edges follow the side within a thousandth of its length.
fn sharp() {
    println!(
        "\nsharp edges of the model that are edges of the mesh; aim 99.5 % with the cone filter and the exchange of diagonals"
    );
    let mut rows: Vec<(&str, (Vec<DVec3>, Edges))> = Vec::new();
    if let Some((points, _)) = clouds::fandisk::model() {
        rows.push((
            "fandisk, 25 degrees",
            (points, clouds::fandisk::sharp_edges(25.0)),
        ));
    }
    for name in ["mechpart.recon.m", "standingblob.orig.m"] {
        rows.extend(labelled(name).map(|found| (name, found)));
    }
    for (name, (points, edges)) in rows {
        let possible = possible(&points);
        let most = edges.iter().filter(|e| possible.contains(e)).count();
        for cone in [false, true] {
            let made = mesh(&points, Settings { cone, open: false }).expect("a body");
            let beside = beside(&made);
            let found = edges.iter().filter(|e| is_edge(&beside, **e)).count();
            let is_followed = |e: &&(u32, u32)| {
                let [a, b] = [e.0, e.1].map(|i| points[i as usize]);
                let line = Line::Segment(a, b);
                let near = 0.001 * a.distance(b);
                !is_edge(&beside, **e)
                    && follows(&beside, **e, |i| line.distance(points[i as usize]) < near)
            };
            let followed = edges.iter().filter(is_followed).count();
            println!(
                "{name:22} cone {cone:5} {found:5} of {:5} {:6.2} %, {followed} of the others followed ({most} in the triangulation)  matched {:.2} %, genus {:?}, {:?}",
                edges.len(),
                100.0 * found as f64 / edges.len() as f64,
                made.matched_percent(),
                made.topology.genus(),
                made.mending,
            );
        }
    }
}

/// Points and sharp edges of a Hoppe mesh file, or none where the data folder is absent.
fn labelled(name: &str) -> Option<(Vec<DVec3>, Edges)> {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data/sharp-labels")
        .join(name);
    let text = std::fs::read_to_string(path).ok()?;
    let mut numbers = HashMap::new();
    let (mut points, mut edges) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        if words.first() == Some(&"Vertex") {
            let x: Vec<f64> = words[2..5].iter().filter_map(|w| w.parse().ok()).collect();
            numbers.insert(words[1].to_owned(), points.len() as u32);
            points.push(DVec3::from_slice(&x));
        } else if words.first() == Some(&"Edge") && line.contains("sharp") {
            let (a, b) = (numbers[words[1]], numbers[words[2]]);
            edges.push((a.min(b), a.max(b)));
        }
    }
    Some((points, edges))
}

/// Scans by lines from one side and from several: how much of what was seen is meshed, in how many pieces, and how long the bridges.
fn open_scans() {
    println!("\n--open on scan lines of the block, noise a tenth of the step along a line");
    println!(
        "scan                     points    used % area/seen pieces largest % open edges   off      seconds"
    );
    let views = [
        DVec3::new(0.1, 0.05, 1.0),
        DVec3::new(0.8, 0.3, 0.6),
        DVec3::new(-0.8, 0.35, 0.6),
        DVec3::new(0.25, 0.8, 0.6),
        DVec3::new(-0.3, -0.85, 0.6),
    ]
    .map(DVec3::normalize);
    for ratio in [1.0, 5.0, 10.0, 20.0] {
        for many in [false, true] {
            let used = if many { &views[..] } else { &views[..1] };
            let across = 0.12 * f64::max(ratio, 3.0) * if many { 2.0 } else { 1.0 };
            let along = across / ratio;
            let solid = solids::block();
            let sampled = solid.scan(used, (along, across), 0.1 * along, 3);
            open_row(
                &format!("1:{ratio} {} views", used.len()),
                &solid,
                &sampled,
                used,
                (along, across),
            );
        }
    }
}

fn open_row(
    name: &str,
    solid: &clouds::Solid,
    sampled: &clouds::Sampled,
    views: &[DVec3],
    (along, across): (f64, f64),
) {
    let settings = Settings {
        open: true,
        ..Settings::default()
    };
    let (made, seconds) = timed(|| mesh(&sampled.points, settings).expect("a body"));
    let t = made.topology;
    // Every point stands for the part of its face that its ray's step covers; seen from one side only.
    let seen: f64 = (sampled.points.iter().zip(&sampled.faces))
        .filter_map(|(p, face)| {
            let hit = |v: &DVec3| {
                let (_, n) = solid.faces[usize::from(*face)].hit(*p + *v * 100.0, -*v)?;
                Some(n.dot(*v).abs())
            };
            hit(&views[0])
        })
        .map(|cosine| along * across / cosine)
        .sum();
    let (mut total, mut off) = (0.0, 0);
    let mut parent: Vec<u32> = (0..made.positions.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for triangle in &made.triangles {
        let [a, b, c] = triangle.map(|v| made.positions[v as usize]);
        total += 0.5 * (b - a).cross(c - a).length();
        let n = (b - a).cross(c - a).normalize_or_zero();
        let centre = (a + b + c) / 3.0;
        // From so near that a ray into a hole meets its wall on this side.
        let reach = 0.5 * across;
        let is_near = |way: DVec3| {
            let from = centre - way * reach;
            let mut hits = solid.faces.iter().filter_map(|f| f.hit(from, way));
            hits.any(|(t, _)| t < 2.0 * reach)
        };
        let ways = [n, DVec3::X, DVec3::Y, DVec3::Z];
        off += usize::from(!ways.iter().any(|way| is_near(*way)));
        for v in &triangle[1..] {
            let (i, j) = (root(&mut parent, triangle[0]), root(&mut parent, *v));
            parent[i.max(j) as usize] = i.min(j);
        }
    }
    let mut sizes = HashMap::new();
    for triangle in &made.triangles {
        *sizes
            .entry(root(&mut parent, triangle[0]))
            .or_insert(0usize) += 1;
    }
    let largest = sizes.values().max().copied().unwrap_or(0);
    println!(
        "{name:22} {:8} {:9.2} {:8.3} {:6} {:9.2} {:10} {off:8} {seconds:8.2} {}",
        made.positions.len(),
        100.0 * t.vertices as f64 / made.positions.len() as f64,
        if views.len() == 1 {
            total / seen
        } else {
            f64::NAN
        },
        t.pieces,
        100.0 * largest as f64 / made.triangles.len().max(1) as f64,
        t.open_edges,
        if t.is_manifold() {
            "manifold"
        } else {
            "NOT manifold"
        },
    );
    picture_of(name, &made);
}

fn large() {
    println!("\nten million points; aim: below 8 GB");
    let points = solids::block().sample(10_000_000, 0.1, 1).points;
    println!("    {:.2} GB before", peak_gb());
    head();
    row("block 10,000,000", &points, 2, Settings::default());
    println!("    {:.2} GB at the most", peak_gb());
}

fn main() {
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| !a.starts_with("--"))
        .collect();
    let parts: [(&str, fn()); 7] = [
        ("delaunay", delaunay),
        ("table52", table52),
        ("peers", peers),
        ("normals", normal_rows),
        ("sharp", sharp),
        ("open", open_scans),
        ("large", large),
    ];
    for (name, part) in parts {
        let is_wanted = wanted.iter().any(|w| w == name) || (wanted.is_empty() && name != "large");
        if is_wanted {
            part();
        }
    }
}

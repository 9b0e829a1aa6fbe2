//! Reconstruction on bodies whose surface is known: distances, normals and times, beside what other programs reach.
//!
//! `cargo bench --bench reconstruction` prints the tables. `-- quick` makes the large clouds smaller, `-- hard` runs blunt and acute edges,
//! close sheets and slots, `-- two-million` the largest cloud, `-- memory` counts bytes, `-- only=NAME` the clouds whose name contains NAME, and
//! `-- tables` prints Weber's tables only, and `-- pictures=FOLDER` draws the fandisk before and after; both find its mesh, where there
//! is one, in `../shared/data/models`.

#![allow(clippy::print_stdout)]

#[path = "../tests/surface/figures.rs"]
mod figures;
#[path = "reconstruction/tables.rs"]
mod tables;
#[path = "../tests/surface/truth.rs"]
mod truth;

use std::time::Instant;

use acies::points::picture::{ViewDirection, render};
use acies::points::{Frame, Neighbors, PointCloud};
use acies::surface::{
    Degree, Place, Reconstruction, Scale, Settings, SmoothSurface, reconstruct, resample,
};
use figures::Trial;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let has = |word: &str| arguments.iter().any(|a| a == word);
    let value = |key: &str| arguments.iter().find_map(|a| a.strip_prefix(key));
    if let Some(folder) = value("pictures=") {
        let mesh = mesh_of_fandisk().expect("../shared/data/models/fandisk.obj");
        fandisk(&mesh, folder);
        return;
    }
    if has("tables") {
        tables::print_all(mesh_of_fandisk().as_deref());
        return;
    }
    if has("memory") {
        // All work on this thread: the counter counts by thread.
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .use_current_thread();
        let pool = pool.build().expect("a pool");
        for trial in [
            figures::block_trial(60_000),
            figures::block_trial(200_000),
            figures::block_trial(500_000),
            figures::lines_trial(0.6),
        ] {
            pool.install(|| memory(&trial));
        }
        return;
    }
    let mut trials = if has("hard") {
        hard_trials()
    } else if has("two-million") {
        vec![figures::block_trial(2_000_000)]
    } else {
        usual_trials(has("quick"))
    };
    if let Some(only) = value("only=") {
        trials.retain(|t| t.name.contains(only));
    }
    println!(
        "Distances in spacings (scan lines: in spacings across), angles in degrees; `edge` is within three of a true edge,"
    );
    println!(
        "`gap` the mean distance of the true edge to the nearest output point without and with the feature lines' samples,"
    );
    println!(
        "`x k20` the time as a multiple of a search for 20 neighbours of all points in the same run."
    );
    println!(
        "{:<34}{:>15}{:>17}{:>15}{:>13}{:>8}{:>10}{:>20}{:>8}{:>7}",
        "cloud",
        "input flat/edge",
        "output flat/edge",
        "gap own/all",
        "false/max",
        "worst",
        "projected",
        "normals flat/edge",
        "seconds",
        "x k20",
    );
    for trial in &trials {
        row(trial);
    }
    if !has("hard") && !has("two-million") && value("only=").is_none() {
        println!();
        println!(
            "Goals: 0.005/0.02/0.10, 0.05/0.06/0.15, 0.11/0.15/0.25, 0.032/0.04/0.20, 0.004/0.008/0.25; normals 1/2; x k20 6."
        );
        println!(
            "Others on the block, flat/edge: PCL order 2 0.039/0.107, CGAL jet 0.041/0.108, CGAL bilateral 0.040/0.117, APSS 0.056/0.072;"
        );
        println!("their normals within three spacings of an edge: 15.1 to 17.0.");
        tables::print_all(mesh_of_fandisk().as_deref());
    }
}

fn usual_trials(quick: bool) -> Vec<Trial> {
    vec![
        figures::cube_trial(52, 0.0),
        figures::cube_trial(52, 0.8),
        figures::cube_trial(52, 2.0),
        figures::block_trial(if quick { 60_000 } else { 500_000 }),
        figures::lines_trial(if quick { 1.5 } else { 0.6 }),
    ]
}

fn hard_trials() -> Vec<Trial> {
    let mut trials = vec![figures::cube_trial(30, 0.0), figures::cube_trial(24, 0.0)];
    for angle in [172.0, 165.0, 150.0, 120.0, 60.0, 40.0, 25.0] {
        let name = format!("ridge of {angle} degrees");
        trials.push(figures::body_trial(&name, truth::ridge(angle), 8_000, 0.1));
    }
    let plate_mm = (800.0f64 / 8_000.0).sqrt();
    for gap in [0.6, 1.0, 2.0] {
        let name = format!("plates {gap} spacings apart");
        trials.push(figures::body_trial(
            &name,
            truth::plates(gap * plate_mm),
            8_000,
            0.05,
        ));
    }
    for width in [2.0, 4.0, 6.0] {
        let name = format!("slot {width} spacings wide");
        let slot = truth::slot(width * 0.25, width * 0.25);
        trials.push(figures::body_trial(&name, slot, 8_000, 0.1));
    }
    for (name, count, noise) in [
        ("block without noise", 60_000, 0.0),
        ("block, noise 0.3", 60_000, 0.3),
        ("block, coarse", 4_000, 0.1),
    ] {
        trials.push(figures::body_trial(
            name,
            truth::stepped_block(),
            count,
            noise,
        ));
    }
    trials
}

fn row(trial: &Trial) {
    let cloud = figures::cloud_of(&trial.seen);
    let neighbors = Neighbors::new(&cloud.positions);
    let search = neighbour_search(&cloud.positions, &neighbors, 20);
    let start = Instant::now();
    let result = reconstruct(&cloud, &neighbors, Settings::default()).expect("enough points");
    let seconds = start.elapsed().as_secs_f64();
    let search = 0.5 * (search + neighbour_search(&cloud.positions, &neighbors, 20));
    let f = trial.figures(&result);
    println!(
        "{:<34}{:>15}{:>17}{:>15}{:>13}{:>8.3}{:>10.4}{:>20}{:>8.2}{:>7.1}",
        trial.name,
        format!("{:.4}/{:.4}", f.input_flat, f.input_edge),
        format!("{:.4}/{:.4}", f.flat, f.edge),
        format!("{:.3}/{:.3}", f.edge_gap_own, f.edge_gap),
        format!("{:.4}/{:.2}", f.line_false, f.line_worst),
        f.worst,
        f.projected,
        format!(
            "{:.2}/{:.2} ({:.2})",
            f.normal_flat, f.normal_edge, f.normal_edge_measured
        ),
        seconds,
        seconds / search,
    );
}

/// Bytes a point that the reconstruction holds at most above its input and the neighbours, counted at the allocator.
fn memory(trial: &Trial) {
    let cloud = figures::cloud_of(&trial.seen);
    let neighbors = Neighbors::new(&cloud.positions);
    let measured = allocation_counter::measure(|| {
        let result = reconstruct(&cloud, &neighbors, Settings::default()).expect("enough points");
        assert_eq!(result.positions.len(), cloud.positions.len());
    });
    println!(
        "{:<34}{:>9.1} bytes a point at the most",
        trial.name,
        measured.bytes_max as f64 / cloud.positions.len() as f64
    );
}

/// Seconds for the `k` nearest neighbours of all points, the reference of all times here.
fn neighbour_search(positions: &[DVec3], neighbors: &Neighbors, k: usize) -> f64 {
    let start = Instant::now();
    let far: f64 = neighbors
        .order()
        .par_chunks(256)
        .map_init(Vec::new, |found, part| {
            let mut far = 0.0f64;
            for &i in part {
                neighbors.nearest(positions[i as usize], k, found);
                far = far.max(found.last().map_or(0.0, |f| f.1));
            }
            far
        })
        .reduce(|| 0.0, f64::max);
    assert!(far > 0.0);
    start.elapsed().as_secs_f64()
}

/// The text of the fandisk's mesh where it lies beside the project.
fn mesh_of_fandisk() -> Option<String> {
    let beside = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::fs::read_to_string(beside.join("models/fandisk.obj")).ok()
}

/// `count` area samples of a mesh with noise in spacings, the spacing, mm, and the edges of the mesh that turn by more than 10 degrees.
fn fandisk_samples(mesh: &str, count: usize, noise: f64) -> (Vec<DVec3>, f64, Vec<truth::Edge>) {
    let triangles = obj_triangles(mesh);
    let (positions, spacing_mm) = sample(&triangles, count, noise);
    let key = |p: DVec3| p.to_array().map(f64::to_bits);
    let mut sides: std::collections::HashMap<_, DVec3> = std::collections::HashMap::new();
    let mut creases = Vec::new();
    for [a, b, c] in &triangles {
        let normal = (*b - *a).cross(*c - *a).normalize_or_zero();
        for (p, q) in [(*a, *b), (*b, *c), (*c, *a)] {
            match sides.remove(&(key(q), key(p))) {
                Some(other) if other.dot(normal) < 10f64.to_radians().cos() => {
                    creases.push(truth::Edge::Segment(p, q));
                }
                Some(_) => {}
                None => drop(sides.insert((key(p), key(q)), normal)),
            }
        }
    }
    (positions, spacing_mm, creases)
}

/// Samples the fandisk with noise of a tenth of the spacing, reconstructs it, and draws input, smooth and sharp output.
fn fandisk(mesh: &str, folder: &str) {
    let (positions, _, _) = fandisk_samples(mesh, 41_250, 0.1);
    let data = Neighbors::new(&positions);
    let cloud = PointCloud::from_positions(Frame::Part, positions);
    let result = reconstruct(&cloud, &data, Settings::default()).expect("enough points");
    let on = |place: Place| result.lines.iter().filter(|l| l.place == place).count();
    println!(
        "{:?}, {} samples of edges, {} of corners",
        result.scale,
        on(Place::Edge),
        on(Place::Corner)
    );
    let scale = Scale::of(&cloud, &data);
    let smooth = SmoothSurface::new(&cloud.positions, &data, Degree::Two, scale.smoothing_mm())
        .project_all();
    let rounded: Vec<(DVec3, Vec3)> = smooth
        .into_iter()
        .flatten()
        .map(|(p, n)| (p, n.as_vec3()))
        .collect();
    draw(folder, "smooth", &rounded);
    draw(folder, "sharp", &with_lines(&result));
    let dense = resample(&cloud, &data, 0.5 * scale.spacing_mm).expect("a spacing");
    let dense: Vec<_> = dense.positions.into_iter().zip(dense.normals).collect();
    draw(folder, "resampled", &dense);
    let raw = acies::surface::plane_normals(&cloud.positions, &data, 20);
    let input: Vec<_> = cloud.positions.iter().copied().zip(raw).collect();
    draw(folder, "input", &input);
}

fn with_lines(result: &Reconstruction) -> Vec<(DVec3, Vec3)> {
    result
        .positions
        .iter()
        .copied()
        .zip(result.normals.iter().copied())
        .collect()
}

/// Writes a picture shaded by the angles to a red, a green and a blue lamp; both sides of a surface are lit.
fn draw(folder: &str, name: &str, points: &[(DVec3, Vec3)]) {
    let lamps = [
        Vec3::new(0.8, 0.3, 0.5),
        Vec3::new(-0.5, 0.7, 0.5),
        Vec3::new(-0.2, -0.6, 0.75),
    ];
    let positions: Vec<DVec3> = points.iter().map(|p| p.0).collect();
    let lit = |n: Vec3| lamps.map(|lamp| (50.0 + 195.0 * n.dot(lamp.normalize()).abs()) as u8);
    let colours: Vec<[u8; 3]> = points.iter().map(|(_, n)| lit(*n)).collect();
    let bytes = render(&positions, &colours, ViewDirection::Auto, (1200, 900));
    std::fs::write(format!("{folder}/fandisk-{name}.png"), bytes).expect("a writable folder");
}

fn obj_triangles(text: &str) -> Vec<[DVec3; 3]> {
    let mut vertices: Vec<DVec3> = Vec::new();
    let mut triangles = Vec::new();
    for line in text.lines() {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => {
                let v: Vec<f64> = words.filter_map(|w| w.parse().ok()).collect();
                vertices.push(DVec3::new(v[0], v[1], v[2]));
            }
            Some("f") => {
                let index = |w: &str| w.split('/').next().and_then(|i| i.parse::<usize>().ok());
                let corners: Vec<DVec3> =
                    words.filter_map(index).map(|i| vertices[i - 1]).collect();
                triangles.push([corners[0], corners[1], corners[2]]);
            }
            _ => {}
        }
    }
    triangles
}

/// `count` random points of the triangles by area with noise in spacings, and the spacing.
fn sample(triangles: &[[DVec3; 3]], count: usize, noise: f64) -> (Vec<DVec3>, f64) {
    let mut dice = truth::Dice(3);
    let mut sums = Vec::with_capacity(triangles.len());
    let mut area = 0.0;
    for [a, b, c] in triangles {
        area += 0.5 * (*b - *a).cross(*c - *a).length();
        sums.push(area);
    }
    let spacing = (area / count as f64).sqrt();
    let point = |_| {
        let t = dice.unit() * area;
        let [a, b, c] = triangles[sums.partition_point(|s| *s < t).min(sums.len() - 1)];
        let (mut u, mut v) = (dice.unit(), dice.unit());
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        a + (b - a) * u + (c - a) * v + dice.cloud() * (noise * spacing)
    };
    ((0..count).map(point).collect(), spacing)
}

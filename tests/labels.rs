//! Edges found on models whose sharp edges somebody else has marked: precision and recall against their labels.
//!
//! The models are no scans: their vertices are few, uneven and lie exactly on the edges. The bounds here only say that detection
//! works on them at all; the figures are printed (`cargo test --test labels -- --nocapture`).
#![allow(
    clippy::print_stdout,
    reason = "the figures are to be seen with --nocapture"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use acies::features::{Class, Method, detect};
use acies::points::{self, Frame, Neighbors, PointCloud, Unit};
use glam::DVec3;

/// Vertices, triangles and marked edges of a model.
struct Labelled {
    vertices: Vec<DVec3>,
    sharp: BTreeSet<[usize; 2]>,
}

/// Share of the detections within a spacing of a marked edge, and of the marked vertices with a detection within a spacing.
struct Figures {
    precision: f64,
    recall: f64,
}

fn data(path: &str) -> Option<PathBuf> {
    let found = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data")
        .join(path);
    if !found.exists() {
        println!("skipped: no ../shared/data/{path} beside the project");
        return None;
    }
    Some(found)
}

/// `Vertex i x y z`, and `Edge a b {sharp}`, by the numbers in the file.
fn read_m(path: &Path) -> Labelled {
    let text = fs::read_to_string(path).expect("a readable model");
    let mut index = BTreeMap::new();
    let mut model = Labelled {
        vertices: Vec::new(),
        sharp: BTreeSet::new(),
    };
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["Vertex", number, x, y, z, ..] => {
                index.insert(number.to_string(), model.vertices.len());
                let value = |word: &str| word.parse::<f64>().expect("a number");
                model
                    .vertices
                    .push(DVec3::new(value(x), value(y), value(z)));
            }
            ["Edge", a, b, flags @ ..] if flags.concat().contains("sharp") => {
                model.sharp.insert([index[*a], index[*b]]);
            }
            _ => {}
        }
    }
    model
}

/// The edges of a triangle mesh whose faces meet at more than 25 degrees of turn.
fn read_obj(path: &Path) -> Labelled {
    let text = fs::read_to_string(path).expect("a readable model");
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["v", x, y, z, ..] => {
                let value = |word: &str| word.parse::<f64>().expect("a number");
                vertices.push(DVec3::new(value(x), value(y), value(z)));
            }
            ["f", corners @ ..] => {
                let first =
                    |word: &&str| word.split('/').next().and_then(|n| n.parse::<usize>().ok());
                faces.push(
                    corners
                        .iter()
                        .map(|c| first(c).expect("a vertex") - 1)
                        .collect::<Vec<_>>(),
                );
            }
            _ => {}
        }
    }
    let mut normals: BTreeMap<[usize; 2], Vec<DVec3>> = BTreeMap::new();
    for face in &faces {
        let [a, b, c] = [vertices[face[0]], vertices[face[1]], vertices[face[2]]];
        let normal: DVec3 = (b - a).cross(c - a).normalize_or_zero();
        for k in 0..3 {
            let (i, j) = (face[k], face[(k + 1) % 3]);
            normals
                .entry([i.min(j), i.max(j)])
                .or_default()
                .push(normal);
        }
    }
    let limit = 25.0_f64.to_radians().cos();
    let is_sharp = |pair: &Vec<DVec3>| pair.len() == 2 && pair[0].dot(pair[1]) < limit;
    let sharp = normals
        .iter()
        .filter(|(_, pair)| is_sharp(pair))
        .map(|(edge, _)| *edge)
        .collect();
    Labelled { vertices, sharp }
}

fn distance_to_segment(p: DVec3, a: DVec3, b: DVec3) -> f64 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    p.distance(a + along * t)
}

fn figures(name: &str, model: &Labelled) -> Figures {
    let cloud = PointCloud::from_positions(Frame::Part, model.vertices.clone());
    let neighbors = Neighbors::new(&cloud.positions);
    let detection = detect(&cloud, &neighbors, Method::Adaptive);
    let spacing = detection.spacing.mean_mm;
    let on_edge = |class: &Class| matches!(class, Class::Edge | Class::Corner);
    let found: Vec<DVec3> = (cloud.positions.iter().zip(&detection.classes))
        .filter(|(_, class)| on_edge(class))
        .map(|(p, _)| *p)
        .collect();
    let ends = |edge: &[usize; 2]| (model.vertices[edge[0]], model.vertices[edge[1]]);
    let near_truth = |p: &DVec3| {
        model
            .sharp
            .iter()
            .map(ends)
            .any(|(a, b)| distance_to_segment(*p, a, b) <= spacing)
    };
    let marked: BTreeSet<usize> = model.sharp.iter().flatten().copied().collect();
    let near_found = |v: &usize| {
        found
            .iter()
            .any(|p| p.distance(model.vertices[*v]) <= spacing)
    };
    let share = |hits: usize, of: usize| hits as f64 / of.max(1) as f64;
    let figures = Figures {
        precision: share(found.iter().filter(|p| near_truth(p)).count(), found.len()),
        recall: share(
            marked.iter().filter(|v| near_found(v)).count(),
            marked.len(),
        ),
    };
    println!(
        "{name}: {} vertices, {} marked, {} found, spacing {spacing:.4}, precision {:.3}, recall {:.3}",
        cloud.len(),
        marked.len(),
        found.len(),
        figures.precision,
        figures.recall
    );
    figures
}

#[test]
fn hoppes_labelled_meshes() {
    for name in ["mechpart.recon.m", "standingblob.orig.m"] {
        let Some(path) = data(&format!("sharp-labels/{name}")) else {
            continue;
        };
        let figures = figures(name, &read_m(&path));
        assert!(
            figures.precision > PRECISION && figures.recall > RECALL,
            "{name}"
        );
    }
}

#[test]
fn fandisk_by_its_dihedral_angles() {
    let Some(path) = data("models/fandisk.obj") else {
        return;
    };
    let figures = figures("fandisk.obj", &read_obj(&path));
    assert!(figures.precision > PRECISION && figures.recall > RECALL);
}

/// A sharp circle of a feature file: centre, radius, axis.
struct Circle {
    centre: DVec3,
    radius: f64,
    axis: DVec3,
}

/// The curves marked `sharp: true` and `type: Circle`.
fn sharp_circles(text: &str) -> Vec<Circle> {
    let vector = |line: &str| {
        let inside = line.split(['[', ']']).nth(1).expect("a list");
        let values: Vec<f64> = inside
            .split(',')
            .map(|word| word.trim().parse().expect("a number"))
            .collect();
        DVec3::new(values[0], values[1], values[2])
    };
    let curves = text
        .split("surfaces:")
        .next()
        .expect("the curves")
        .split("\n- ");
    let field = |curve: &str, key: &str| {
        let line = curve
            .lines()
            .find_map(|line| line.trim().strip_prefix(key).map(str::to_owned));
        line.unwrap_or_default()
    };
    curves
        .filter(|curve| curve.contains("sharp: true") && curve.contains("type: Circle"))
        .map(|curve| Circle {
            centre: vector(&field(curve, "location:")),
            radius: field(curve, "radius:").trim().parse().expect("a radius"),
            axis: vector(&field(curve, "z_axis:")),
        })
        .collect()
}

/// Points spread by area over the triangles of a binary STL file, at random places of a fixed seed (SplitMix64).
fn area_samples(bytes: &[u8], count: usize) -> Vec<DVec3> {
    let number = |at: usize| {
        f64::from(f32::from_le_bytes(
            bytes[at..at + 4].try_into().expect("four bytes"),
        ))
    };
    // In metres, while the feature file is in mm.
    let corner = |at: usize| 1e3 * DVec3::new(number(at), number(at + 4), number(at + 8));
    let triangles: Vec<[DVec3; 3]> = (84..bytes.len() - 49)
        .step_by(50)
        .map(|at| [12, 24, 36].map(|k| corner(at + k)))
        .collect();
    let area = |[a, b, c]: &[DVec3; 3]| 0.5 * (*b - *a).cross(*c - *a).length();
    let total: f64 = triangles.iter().map(area).sum();
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    let (mut samples, mut sum) = (Vec::with_capacity(count), 0.0);
    for triangle in &triangles {
        sum += area(triangle);
        while (samples.len() as f64 + 0.5) * total / (count as f64) < sum {
            let (u, v) = (random().sqrt(), random());
            let [a, b, c] = triangle;
            samples.push(*a * (1.0 - u) + *b * (u * (1.0 - v)) + *c * (u * v));
        }
    }
    samples
}

#[test]
fn an_abc_model_by_its_feature_file() {
    let name = "00009999_003df34c1a7b4dc2bd43c5f4";
    let Some(stl) = data(&format!("abc/{name}_trimesh_000.stl")) else {
        return;
    };
    let Some(yml) = data(&format!("abc/{name}_features_000.yml")) else {
        return;
    };
    let vertices = points::read(&stl, Unit::Metre)
        .expect("a readable model")
        .cloud;
    let of_vertices = detect(
        &vertices,
        &Neighbors::new(&vertices.positions),
        Method::Adaptive,
    );
    println!(
        "abc, vertices as points: {} points, {} on edges (its flat faces have no vertices inside)",
        vertices.len(),
        of_vertices.count(Class::Edge)
    );
    let samples = area_samples(&fs::read(&stl).expect("a readable model"), 40_000);
    let cloud = PointCloud::from_positions(Frame::Part, samples);
    let detection = detect(&cloud, &Neighbors::new(&cloud.positions), Method::Adaptive);
    let spacing = detection.spacing.mean_mm;
    // A circle of less than five spacings is no edge in samples of this spacing.
    let circles = sharp_circles(&fs::read_to_string(yml).expect("a readable feature file"));
    let seen: Vec<&Circle> = circles
        .iter()
        .filter(|circle| circle.radius > 5.0 * spacing)
        .collect();
    let found: Vec<DVec3> = (cloud.positions.iter().zip(&detection.classes))
        .filter(|(_, class)| matches!(class, Class::Edge | Class::Corner))
        .map(|(p, _)| *p)
        .collect();
    let to_circle = |p: DVec3, circle: &Circle| {
        let off = p - circle.centre;
        let height = off.dot(circle.axis);
        height.hypot((off - circle.axis * height).length() - circle.radius)
    };
    let mut hit = 0;
    let mut places = 0;
    for circle in &seen {
        let x = circle.axis.any_orthonormal_vector();
        for k in 0..360 {
            let (sin, cos) = f64::from(k).to_radians().sin_cos();
            let place = circle.centre + (x * cos + circle.axis.cross(x) * sin) * circle.radius;
            places += 1;
            hit += usize::from(found.iter().any(|p| p.distance(place) <= spacing));
        }
    }
    let right = found
        .iter()
        .filter(|p| {
            circles
                .iter()
                .any(|circle| to_circle(**p, circle) <= spacing)
        })
        .count();
    let precision = right as f64 / found.len().max(1) as f64;
    let recall = f64::from(hit as u32) / f64::from(places.max(1));
    println!(
        "abc, 40,000 area samples: {} of {} circles resolved, {} found, spacing {spacing:.4}, precision {precision:.3}, recall {recall:.3}",
        seen.len(),
        circles.len(),
        found.len()
    );
    assert!(!seen.is_empty() && recall > RECALL);
}

/// What is found is mostly an edge to a person, too; how much of what a person marks is found depends on how blunt it is.
const PRECISION: f64 = 0.7;
const RECALL: f64 = 0.15;

//! Models of other people whose sharp edges are marked, or told by their faces, as clouds with known edges.
//!
//! They lie beside the project and are not part of it; each is none where it is absent.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fs;
use std::path::PathBuf;

use glam::DVec3;

use super::score::mesh;
use super::{Line, Sampled};

/// Turn of neighbouring faces, degrees, from which on their edge is sharp.
const SHARP_DEG: f64 = 25.0;

fn data(path: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data")
        .join(path)
}

fn vector(words: &[&str]) -> DVec3 {
    let value = |w: &&str| w.trim().parse::<f64>().expect("a number");
    DVec3::new(value(&words[0]), value(&words[1]), value(&words[2]))
}

/// `count` area samples of the fandisk.
pub fn fandisk(count: usize) -> Option<Sampled> {
    let (vertices, faces) = super::fandisk::model()?;
    let faces: Vec<[usize; 3]> = faces.iter().map(|f| f.map(|v| v as usize)).collect();
    Some(mesh(&vertices, &faces, count, SHARP_DEG))
}

/// The vertices of a mesh of Hoppe's with the edges marked in it.
pub fn labelled(name: &str) -> Option<Sampled> {
    let text = fs::read_to_string(data("sharp-labels").join(name)).ok()?;
    let mut place = BTreeMap::new();
    let (mut edges, mut area) = (Vec::new(), 0.0);
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["Vertex", number, xyz @ ..] => {
                place.insert(number.to_string(), vector(xyz));
            }
            ["Face", _, a, b, c, ..] => {
                let [a, b, c] = [a, b, c].map(|i| place[*i]);
                area += 0.5 * (b - a).cross(c - a).length();
            }
            ["Edge", a, b, flags @ ..] if flags.concat().contains("sharp") => {
                edges.push(Line::Segment(place[*a], place[*b]));
            }
            _ => {}
        }
    }
    let points: Vec<DVec3> = place.into_values().collect();
    Some(Sampled {
        spacing: (area / points.len() as f64).sqrt(),
        points,
        edges,
        ..Sampled::default()
    })
}

/// `count` area samples of the model of the ABC set, in mm; its edges are the circles its feature file calls sharp, those first that
/// have more than five spacings of radius, whose number comes with it.
pub fn abc(count: usize) -> Option<(Sampled, usize)> {
    let name = "00009999_003df34c1a7b4dc2bd43c5f4";
    let bytes = fs::read(data(&format!("abc/{name}_trimesh_000.stl"))).ok()?;
    let features = fs::read_to_string(data(&format!("abc/{name}_features_000.yml"))).ok()?;
    let number = |at: usize| {
        let four = bytes[at..at + 4].try_into().expect("four bytes");
        f64::from(f32::from_le_bytes(four))
    };
    // In metres, while the feature file is in mm.
    let corner = |at: usize| 1e3 * DVec3::new(number(at), number(at + 4), number(at + 8));
    let triangles = (84..bytes.len() - 49).step_by(50);
    let vertices: Vec<DVec3> = triangles
        .flat_map(|at| [12, 24, 36].map(|k| corner(at + k)))
        .collect();
    let faces: Vec<[usize; 3]> = (0..vertices.len() / 3)
        .map(|i| [3 * i, 3 * i + 1, 3 * i + 2])
        .collect();
    let mut sampled = mesh(&vertices, &faces, count, SHARP_DEG);
    let (near, far): (Vec<Line>, Vec<Line>) =
        sharp_circles(&features).partition(|circle| circle.length() > 5.0 * TAU * sampled.spacing);
    let resolved = near.len();
    sampled.edges = near.into_iter().chain(far).collect();
    Some((sampled, resolved))
}

/// The curves marked `sharp: true` and `type: Circle`.
fn sharp_circles(text: &str) -> impl Iterator<Item = Line> {
    let curves = text.split("surfaces:").next().unwrap_or_default();
    let sharp = curves
        .split("\n- ")
        .filter(|c| c.contains("sharp: true") && c.contains("type: Circle"));
    sharp.map(|curve| {
        let field = |key: &str| {
            let mut lines = curve.lines();
            lines.find_map(|line| line.trim().strip_prefix(key))
        };
        let list = |key: &str| {
            let list = field(key).expect("a field").trim();
            vector(&list.trim_matches(['[', ']']).split(',').collect::<Vec<_>>())
        };
        let radius: f64 = (field("radius:").expect("a radius").trim().parse()).expect("a number");
        let axis = list("z_axis:").normalize();
        let start = axis.any_orthonormal_vector() * radius;
        Line::Arc(list("location:"), axis, start, TAU)
    })
}

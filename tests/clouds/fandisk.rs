//! The fandisk's own triangles, from the data folder: which of its edges are sharp.

use std::collections::BTreeMap;

use glam::DVec3;

/// Vertices and triangles, or none where the data folder is absent.
pub fn model() -> Option<(Vec<DVec3>, Vec<[u32; 3]>)> {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../shared/data/models/fandisk.obj"
    );
    let text = std::fs::read_to_string(path).ok()?;
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.first() {
            Some(&"v") => {
                let x: Vec<f64> = words[1..4].iter().filter_map(|w| w.parse().ok()).collect();
                vertices.push(DVec3::from_slice(&x));
            }
            Some(&"f") => {
                let corner = |w: &str| w.split('/').next().and_then(|i| i.parse::<u32>().ok());
                let f: Vec<u32> = words[1..4].iter().filter_map(|w| corner(w)).collect();
                faces.push([f[0] - 1, f[1] - 1, f[2] - 1]);
            }
            _ => {}
        }
    }
    Some((vertices, faces))
}

/// Edges, lower vertex first, at which its triangles turn by more than `turn_deg`; empty where the data folder is absent.
pub fn sharp_edges(turn_deg: f64) -> Vec<(u32, u32)> {
    let Some((vertices, faces)) = model() else {
        return Vec::new();
    };
    let mut sides: BTreeMap<(u32, u32), Vec<DVec3>> = BTreeMap::new();
    for f in &faces {
        let [a, b, c] = f.map(|v| vertices[v as usize]);
        let normal = (b - a).cross(c - a).normalize_or_zero();
        for k in 0..3 {
            let (a, b) = (f[k], f[(k + 1) % 3]);
            sides.entry((a.min(b), a.max(b))).or_default().push(normal);
        }
    }
    let limit = turn_deg.to_radians().cos();
    let is_sharp = |n: &[DVec3]| n.len() == 2 && n[0].dot(n[1]) < limit;
    sides
        .into_iter()
        .filter(|(_, n)| is_sharp(n))
        .map(|(e, _)| e)
        .collect()
}

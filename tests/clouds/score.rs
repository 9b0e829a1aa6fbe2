//! Precision and recall of a detection against the true edges.

use acies::features::Class;
use acies::points::{Frame, Neighbors, PointCloud};
use glam::DVec3;

use super::{Line, Sampled};

/// How well edges were found.
#[derive(Debug, Clone, Copy, Default)]
pub struct Score {
    /// Share of the detected points within one spacing of a true edge.
    pub precision: f64,
    /// Share of the edges' length with a detection within one spacing, or of the points made on edges that are detected.
    pub recall: f64,
    /// Detected points.
    pub detected: usize,
}

impl Score {
    pub fn f1(&self) -> f64 {
        2.0 * self.precision * self.recall / (self.precision + self.recall).max(1e-12)
    }
}

/// The cloud as the library takes it.
pub fn cloud(points: &[DVec3]) -> PointCloud {
    PointCloud {
        frame: Frame::Part,
        positions: points.to_vec(),
        origins: Vec::new(),
        views: Vec::new(),
    }
}

pub fn is_edge(class: &Class) -> bool {
    matches!(class, Class::Edge | Class::Corner)
}

/// Distance to the nearest of the lines.
pub fn distance(lines: &[Line], p: DVec3) -> f64 {
    lines
        .iter()
        .map(|l| l.distance(p))
        .fold(f64::INFINITY, f64::min)
}

/// The score of the points for which `found` holds.
pub fn score(sampled: &Sampled, found: &[bool]) -> Score {
    let detected: Vec<DVec3> = sampled
        .points
        .iter()
        .zip(found)
        .filter(|(_, f)| **f)
        .map(|(p, _)| *p)
        .collect();
    let s = sampled.spacing;
    let good = detected
        .iter()
        .filter(|p| distance(&sampled.edges, **p) <= s * (1.0 + 1e-9))
        .count();
    let recall = if sampled.on_edge.is_empty() {
        length_recall(sampled, &detected)
    } else {
        let on_edge = sampled.on_edge.iter().filter(|o| **o).count();
        let hit = sampled
            .on_edge
            .iter()
            .zip(found)
            .filter(|(o, f)| **o && **f)
            .count();
        hit as f64 / on_edge as f64
    };
    Score {
        precision: good as f64 / detected.len().max(1) as f64,
        recall,
        detected: detected.len(),
    }
}

/// Share of the edges' length within one spacing of a detected point; of a scan, where it has points of two faces that near.
fn length_recall(sampled: &Sampled, detected: &[DVec3]) -> f64 {
    let s = sampled.spacing;
    let hits = Neighbors::new(detected);
    let all = Neighbors::new(&sampled.points);
    let near = |set: &Neighbors, p: DVec3| {
        let mut found = Vec::new();
        set.nearest(p, 1, &mut found);
        found.first().is_some_and(|f| f.1 <= s * s)
    };
    let mut around = Vec::new();
    let (mut length, mut covered) = (0usize, 0usize);
    for edge in &sampled.edges {
        let steps = (edge.length() / (0.1 * s)).ceil().max(1.0) as usize;
        for i in 0..steps {
            let p = edge.at((i as f64 + 0.5) / steps as f64);
            if sampled.scanned {
                all.within(p, s, &mut around);
                let face = |i: u32| sampled.faces.get(i as usize);
                if around.iter().all(|a| face(a.0) == face(around[0].0)) {
                    continue;
                }
            }
            length += 1;
            covered += usize::from(near(&hits, p));
        }
    }
    covered as f64 / length.max(1) as f64
}

/// The score of a detection.
pub fn score_classes(sampled: &Sampled, classes: &[Class]) -> Score {
    let found: Vec<bool> = classes.iter().map(is_edge).collect();
    score(sampled, &found)
}

/// The score of marking exactly the points within one spacing of a true edge.
pub fn oracle(sampled: &Sampled) -> Score {
    let found: Vec<bool> = sampled
        .points
        .iter()
        .map(|p| distance(&sampled.edges, *p) <= sampled.spacing)
        .collect();
    score(sampled, &found)
}

/// `count` area samples of a triangle mesh, whose true edges are those where neighbouring faces turn by more than `turn_deg`.
pub fn mesh(vertices: &[DVec3], faces: &[[usize; 3]], count: usize, turn_deg: f64) -> Sampled {
    let normal = |f: &[usize; 3]| {
        let [a, b, c] = f.map(|i| vertices[i]);
        (b - a).cross(c - a)
    };
    let mut sides: std::collections::BTreeMap<(usize, usize), Vec<DVec3>> = Default::default();
    for f in faces {
        for i in 0..3 {
            let (a, b) = (f[i], f[(i + 1) % 3]);
            let side = sides.entry((a.min(b), a.max(b))).or_default();
            side.push(normal(f).normalize_or_zero());
        }
    }
    let limit = turn_deg.to_radians().cos();
    let sharp = sides
        .iter()
        .filter(|(_, n)| n.len() == 2 && n[0].dot(n[1]) < limit);
    let edges = sharp
        .map(|((a, b), _)| Line::Segment(vertices[*a], vertices[*b]))
        .collect();
    let mut ends = Vec::new();
    let mut area = 0.0;
    for f in faces {
        area += 0.5 * normal(f).length();
        ends.push(area);
    }
    let mut random = super::Random::new(21);
    let points = (0..count)
        .map(|_| {
            let pick = random.unit() * area;
            let f = faces[ends.partition_point(|e| *e < pick).min(faces.len() - 1)];
            let [a, b, c] = f.map(|i| vertices[i]);
            let (s, t) = (random.unit().sqrt(), random.unit());
            a * (1.0 - s) + b * (s * (1.0 - t)) + c * (s * t)
        })
        .collect();
    Sampled {
        points,
        spacing: (area / count as f64).sqrt(),
        edges,
        ..Sampled::default()
    }
}

//! How far a reconstruction lies from the truth, in units of the spacing.

// The tests and the bench each use a part.
#![allow(dead_code)]

use acies::points::{Frame, Neighbors, PointCloud};
use acies::surface::{Reconstruction, Settings, reconstruct};
use glam::DVec3;

use super::truth::{Body, Dice, Seen, cube_with_hole, cube_with_hole_points, stepped_block};

/// A cloud with its truth.
pub struct Trial {
    pub name: String,
    pub body: Body,
    pub seen: Vec<Seen>,
    /// Unit of all figures, mm.
    pub unit_mm: f64,
}

/// What the table shows, distances in units of the spacing.
#[derive(Debug, Clone, Copy)]
pub struct Figures {
    pub input_flat: f64,
    pub input_edge: f64,
    pub flat: f64,
    pub edge: f64,
    /// Mean distance of the true edge to the nearest output point, without and with the samples of the feature lines.
    pub edge_gap_own: f64,
    pub edge_gap: f64,
    /// Largest distance of any output point.
    pub worst: f64,
    pub projected: f64,
    /// Mean angle to the normal of the true face nearest to the output, degrees: elsewhere, within 3 of an edge.
    pub normal_flat: f64,
    pub normal_edge: f64,
    /// The same against the face a point was measured on.
    pub normal_edge_measured: f64,
    /// Rms and largest distance of the feature line samples to the true edges.
    pub line_rms: f64,
    pub line_worst: f64,
    /// Part of the samples farther than one spacing from every true edge.
    pub line_false: f64,
    pub lines: usize,
}

pub fn cloud_of(seen: &[Seen]) -> PointCloud {
    PointCloud {
        frame: Frame::Part,
        positions: seen.iter().map(|s| s.noisy).collect(),
        origins: Vec::new(),
        views: Vec::new(),
    }
}

/// The cube with hole, 17,400 points at `n` = 52, with noise uniform in a ball of `percent` of 8.5 mm.
pub fn cube_trial(n: usize, percent: f64) -> Trial {
    let mut dice = Dice(7);
    let body = cube_with_hole();
    let points = cube_with_hole_points(n);
    let unit_mm = (body.area() / points.len() as f64).sqrt();
    let radius = 8.5 * percent / 100.0;
    let seen = points
        .into_iter()
        .map(|(clean, face)| Seen {
            noisy: clean + dice.ball() * radius,
            clean,
            face,
        })
        .collect();
    Trial {
        name: format!("cube with hole, {percent} % noise"),
        body,
        seen,
        unit_mm,
    }
}

/// The stepped block, `count` random points, Gaussian noise of 0.1 spacings in every direction.
pub fn block_trial(count: usize) -> Trial {
    body_trial("machined block", stepped_block(), count, 0.1)
}

/// `count` random points of a body, Gaussian noise of `ratio` spacings in every direction.
pub fn body_trial(name: &str, body: Body, count: usize, ratio: f64) -> Trial {
    let mut dice = Dice(11);
    let unit_mm = (body.area() / count as f64).sqrt();
    let seen = body
        .points(count, &mut dice)
        .into_iter()
        .map(|(clean, face)| Seen {
            noisy: clean + dice.cloud() * (ratio * unit_mm),
            clean,
            face,
        })
        .collect();
    Trial {
        name: format!("{name}, {count}"),
        body,
        seen,
        unit_mm,
    }
}

/// The stepped block seen from one side in scan lines, ten times as dense along as across.
pub fn lines_trial(across_mm: f64) -> Trial {
    let mut dice = Dice(13);
    let body = stepped_block();
    let towards = DVec3::new(0.45, -0.35, 0.82);
    let seen = body.scan(
        towards,
        (0.1 * across_mm, across_mm),
        (0.01 * across_mm, &mut dice),
    );
    Trial {
        name: format!("block in scan lines 1:10, {}", seen.len()),
        body,
        seen,
        unit_mm: across_mm,
    }
}

impl Trial {
    pub fn run(&self, settings: Settings) -> (Figures, Reconstruction) {
        let cloud = cloud_of(&self.seen);
        let neighbors = Neighbors::new(&cloud.positions);
        let result = reconstruct(&cloud, &neighbors, settings).expect("enough points");
        (self.figures(&result), result)
    }

    pub fn figures(&self, result: &Reconstruction) -> Figures {
        let s = self.unit_mm;
        let near: Vec<bool> = self
            .seen
            .iter()
            .map(|p| self.body.edge_distance(p.clean) < 3.0 * s)
            .collect();
        let rms = |at: &dyn Fn(usize) -> DVec3, edge: bool| {
            let d: Vec<f64> = (0..near.len())
                .filter(|i| near[*i] == edge)
                .map(|i| self.body.distance(at(i)) / s)
                .collect();
            (d.iter().map(|d| d * d).sum::<f64>() / d.len().max(1) as f64).sqrt()
        };
        let input = |i: usize| self.seen[i].noisy;
        let output = |i: usize| result.positions[i];
        let worst = (0..near.len())
            .map(|i| self.body.distance(output(i)) / s)
            .fold(0.0, f64::max);
        let normals = self.normal_angles(result);
        let mean = |v: &[(f64, f64)], edge: bool, second: bool| {
            let picked: Vec<f64> = (v.iter().zip(&near))
                .enumerate()
                .filter(|(i, (_, n))| **n == edge && result.projected[*i])
                .map(|(_, (a, _))| if second { a.1 } else { a.0 })
                .collect();
            picked.iter().sum::<f64>() / picked.len().max(1) as f64
        };
        let lines: Vec<f64> = result
            .lines
            .iter()
            .map(|l| self.body.edge_distance(l.position) / s)
            .collect();
        Figures {
            input_flat: rms(&input, false),
            input_edge: rms(&input, true),
            flat: rms(&output, false),
            edge: rms(&output, true),
            edge_gap_own: self.edge_gap(&result.positions),
            edge_gap: self.edge_gap(
                &result
                    .positions
                    .iter()
                    .copied()
                    .chain(result.lines.iter().map(|l| l.position))
                    .collect::<Vec<_>>(),
            ),
            worst,
            projected: result.projected.iter().filter(|p| **p).count() as f64 / near.len() as f64,
            normal_flat: mean(&normals, false, false),
            normal_edge: mean(&normals, true, false),
            normal_edge_measured: mean(&normals, true, true),
            line_rms: (lines.iter().map(|d| d * d).sum::<f64>() / lines.len().max(1) as f64).sqrt(),
            line_worst: lines.iter().copied().fold(0.0, f64::max),
            line_false: lines.iter().filter(|d| **d > 1.0).count() as f64
                / lines.len().max(1) as f64,
            lines: lines.len(),
        }
    }

    /// Angles, degrees, to the normal of the true face nearest to the output and to that of the face measured.
    fn normal_angles(&self, result: &Reconstruction) -> Vec<(f64, f64)> {
        let mut others = std::collections::HashMap::new();
        for sharp in &result.sharp {
            others.insert(sharp.index, sharp.other_normals);
        }
        (0..self.seen.len())
            .map(|i| {
                let p = result.positions[i];
                let mut normals = vec![result.normals[i].as_dvec3()];
                if let Some(more) = others.get(&(i as u32)) {
                    normals.extend(more.iter().map(|n| n.as_dvec3()));
                }
                let (_, nearest) = self
                    .body
                    .faces
                    .iter()
                    .map(|f| f.nearest(p))
                    .min_by(|a, b| a.0.distance(p).total_cmp(&b.0.distance(p)))
                    .expect("a body has faces");
                let measured = self.body.faces[self.seen[i].face]
                    .nearest(self.seen[i].clean)
                    .1;
                let angle = |truth: DVec3| {
                    let cosine = normals
                        .iter()
                        .map(|n| n.dot(truth).abs())
                        .fold(0.0, f64::max);
                    cosine.min(1.0).acos().to_degrees()
                };
                (angle(nearest), angle(measured))
            })
            .collect()
    }

    /// Mean distance of places on the true edges to the nearest output point; places not seen from both flanks are left out.
    fn edge_gap(&self, output: &[DVec3]) -> f64 {
        let s = self.unit_mm;
        let neighbors = Neighbors::new(output);
        let clean: Vec<DVec3> = self.seen.iter().map(|p| p.clean).collect();
        let input = Neighbors::new(&clean);
        let (mut sum, mut count) = (0.0, 0usize);
        let mut found = Vec::new();
        for edge in &self.body.edges {
            let steps = (edge.length() / (0.1 * s)).ceil() as usize;
            for k in 0..=steps {
                let p = edge.at(k as f64 / steps as f64);
                input.within(p, 1.5 * s, &mut found);
                let first = found.first().map(|f| self.seen[f.0 as usize].face);
                if found
                    .iter()
                    .all(|f| Some(self.seen[f.0 as usize].face) == first)
                {
                    continue;
                }
                neighbors.nearest(p, 1, &mut found);
                sum += found[0].1.sqrt() / s;
                count += 1;
            }
        }
        sum / count.max(1) as f64
    }
}

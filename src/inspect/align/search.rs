//! A pose from nothing: pairs of oriented points, voting, and refinement of the best.
//!
//! A pair of points with normals has four numbers that no motion changes: the distance, the angles of both normals with
//! the line between them, and the angle between the normals. Pairs of the scan look up pairs of the nominal with the same numbers and
//! vote for the pose that brings them together (Drost et al. 2010, "Model globally, match locally"). We differ: the
//! nominal's samples are exact, the candidates are ranked by distances to the exact faces, and a pose is an answer only when
//! no other fits as well.

use std::collections::HashMap;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::twist::Twist;
use super::{AlignOptions, Scan, Task, size};
use crate::geometry::RigidTransform;
use crate::geometry::fit::{fit_plane, median};
use crate::inspect::assign::{Surface, towards};
use crate::inspect::body::Body;

/// Samples of the nominal that take part in pairs.
const MODEL: usize = 500;

/// Points of the scan that pairs start from, and that they end at.
const ANCHORS: usize = 60;
const PARTNERS: usize = 500;

/// Cells of the distance over the nominal's diagonal, of the angles over pi, and of the turn about the anchor's normal.
const DISTANCE_CELLS: f64 = 25.0;
const ANGLE_CELLS: f64 = 15.0;
const TURN_CELLS: usize = 30;

/// Poses that are ranked by distances, and those of them that are refined.
const REFINED: usize = 16;

/// Points and steps of their refinement.
const REFINEMENT: (usize, usize) = (500, 15);

/// A pose whose residuals are below this many times those of the best fits as well: the part's own deviations may hide
/// the difference.
const AS_WELL: f64 = 1.6;

/// A pose that fits, and whether others fit as well.
pub(super) struct Found {
    pub(super) pose: RigidTransform,
    pub(super) ambiguous: bool,
    pub(super) findings: Vec<String>,
}

/// A point with its outward normal.
#[derive(Debug, Clone, Copy)]
struct Oriented {
    point: DVec3,
    normal: DVec3,
}

/// The best pose; `None` where no pose brings half of the scan near the nominal.
pub(super) fn search<B: Body>(scan: &Scan<'_>, surface: &Surface<'_, B>) -> Option<Found> {
    let model = model_points(surface);
    let scene = scene_points(scan);
    if model.len() < 3 || scene.len() < 3 {
        return None;
    }
    let mut candidates = vote(&model, &scene, 2.0 * size(surface.body));
    let few = scan.subset(300);
    let score = |pose: &RigidTransform| score(pose, scan, surface, &few);
    candidates.sort_by(|a, b| a.1.total_cmp(&b.1).reverse());
    candidates.truncate(400);
    let mut ranked: Vec<(f64, RigidTransform)> = candidates
        .par_iter()
        .map(|(pose, _)| (score(pose), *pose))
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let starts = distinct(&ranked, 0.15 * size(surface.body), surface);
    let task = Task {
        scan,
        surface,
        options: &AlignOptions::default(),
        size_mm: size(surface.body),
    };
    let mut refined: Vec<(f64, RigidTransform, Vec<Twist>)> = starts
        .into_par_iter()
        .filter_map(|start| {
            let (pose, weak) = task.coarse(start, REFINEMENT)?;
            Some((score(&pose), pose, weak))
        })
        .collect();
    refined.sort_by(|a, b| a.0.total_cmp(&b.0));
    judge(refined, scan, surface)
}

/// The best of the refined poses, and whether a different one fits as well.
fn judge<B: Body>(
    refined: Vec<(f64, RigidTransform, Vec<Twist>)>,
    scan: &Scan<'_>,
    surface: &Surface<'_, B>,
) -> Option<Found> {
    let size_mm = size(surface.body);
    let (best, pose, weak) = refined.first()?;
    if *best > 0.1 * size_mm {
        return None;
    }
    let floor = scan.noise_mm.max(1e-6 * size_mm);
    let others: Vec<&RigidTransform> = refined[1..]
        .iter()
        .filter(|(s, other, _)| {
            *s < AS_WELL * best.max(floor) && is_different(pose, other, weak, size_mm)
        })
        .map(|(_, other, _)| other)
        .collect();
    let mut distinct: Vec<&RigidTransform> = Vec::new();
    for other in others {
        if distinct
            .iter()
            .all(|d| is_different(d, other, weak, size_mm))
        {
            distinct.push(other);
        }
    }
    let mut findings = Vec::new();
    if !distinct.is_empty() {
        findings.push(format!(
            "alignment: {} poses fit the scan equally well, expected one; the part is symmetric or too little of it was scanned: \
             give a rough start",
            distinct.len() + 1
        ));
    }
    Some(Found {
        pose: *pose,
        ambiguous: !distinct.is_empty(),
        findings,
    })
}

/// Whether two poses differ by more than a motion that the data do not hold.
fn is_different(a: &RigidTransform, b: &RigidTransform, weak: &[Twist], size_mm: f64) -> bool {
    let mut motion = Twist::logarithm(&(*b * a.inverse()));
    // Out of the motion goes its share along each weak direction; they are orthonormal with rotations counted at the rim.
    for w in weak {
        let dot = motion.turn.dot(w.turn) * size_mm * size_mm + motion.shift.dot(w.shift);
        let norm = w.turn.length_squared() * size_mm * size_mm + w.shift.length_squared();
        motion.turn -= dot / norm * w.turn;
        motion.shift -= dot / norm * w.shift;
    }
    motion.size(size_mm) > 0.1 * size_mm
}

/// Median distance of the points `few` to the nominal, mm: an outer quarter may be fixtures and reflections.
fn score<B: Body>(
    pose: &RigidTransform,
    scan: &Scan<'_>,
    surface: &Surface<'_, B>,
    few: &[u32],
) -> f64 {
    let size_mm = size(surface.body);
    let mut found = Vec::new();
    let mut distances: Vec<f64> = few
        .iter()
        .map(|i| {
            let i = *i as usize;
            let p = pose.point(scan.cloud.positions[i]);
            let view = towards(scan.cloud, i).map(|v| pose.vector(v));
            let place = surface.place(p, view, size_mm, &mut found);
            if place.face == crate::inspect::assign::NO_FACE {
                size_mm
            } else {
                place.distance_mm
            }
        })
        .collect();
    let n = distances.len();
    if n == 0 {
        return f64::INFINITY;
    }
    distances.sort_by(f64::total_cmp);
    // Root mean square of the nearer three quarters, and their limit, so that one wrong face counts.
    let kept = &distances[..(3 * n).div_ceil(4)];
    (kept.iter().map(|d| d * d).sum::<f64>() / kept.len() as f64).sqrt()
        + 0.1 * median(&mut distances.clone())
}

/// The first poses of `ranked` that differ from each other by more than `apart` mm, at most [`REFINED`].
fn distinct<B: Body>(
    ranked: &[(f64, RigidTransform)],
    apart: f64,
    surface: &Surface<'_, B>,
) -> Vec<RigidTransform> {
    let [low, high] = surface.body.bounds();
    let corners: Vec<DVec3> = (0..8)
        .map(|k| {
            DVec3::new(
                if k & 1 == 0 { low.x } else { high.x },
                if k & 2 == 0 { low.y } else { high.y },
                if k & 4 == 0 { low.z } else { high.z },
            )
        })
        .collect();
    let mut kept: Vec<RigidTransform> = Vec::new();
    for (_, pose) in ranked {
        let far = |other: &RigidTransform| {
            corners.iter().any(|c| {
                let p = other.inverse().point(*c);
                pose.point(p).distance(*c) > apart
            })
        };
        if kept.iter().all(far) {
            kept.push(*pose);
        }
        if kept.len() == REFINED {
            break;
        }
    }
    kept
}

fn model_points<B: Body>(surface: &Surface<'_, B>) -> Vec<Oriented> {
    let samples = surface.samples();
    let points: Vec<DVec3> = samples.iter().map(|s| s.point).collect();
    // In the order of a space-filling curve every k-th sample spreads evenly.
    let order = crate::points::Neighbors::new(&points);
    let step = order.order().len().div_ceil(MODEL).max(1);
    order
        .order()
        .iter()
        .step_by(step)
        .map(|i| Oriented {
            point: samples[*i as usize].point,
            normal: samples[*i as usize].normal,
        })
        .collect()
}

/// Points of the scan with normals from planes through their neighbourhoods, towards the sensor, or away from the middle of the scan
/// where no sensor is known.
fn scene_points(scan: &Scan<'_>) -> Vec<Oriented> {
    let cloud = scan.cloud;
    let indices = scan.subset(PARTNERS);
    let Some((low, high)) = cloud.bounds() else {
        return Vec::new();
    };
    let middle = 0.5 * (low + high);
    let radius = 3.0 * scan.spacing.across_mm.max(scan.spacing.along_mm);
    indices
        .par_iter()
        .map_init(
            || (Vec::new(), Vec::new()),
            |(found, near), i| {
                let i = *i as usize;
                let p = cloud.positions[i];
                scan.neighbors.within(p, radius, found);
                near.clear();
                near.extend(
                    found
                        .iter()
                        .take(200)
                        .map(|(j, _)| cloud.positions[*j as usize]),
                );
                let plane = fit_plane(near)?;
                // On an edge there is no normal.
                if plane.rms > 3.0 * scan.noise_mm + 0.02 * radius {
                    return None;
                }
                let outward = towards(cloud, i).unwrap_or(p - middle);
                let normal = if plane.normal.dot(outward) < 0.0 {
                    -plane.normal
                } else {
                    plane.normal
                };
                Some(Oriented { point: p, normal })
            },
        )
        .flatten()
        .collect()
}

/// The numbers of a pair that no motion changes, in cells.
fn key(a: &Oriented, b: &Oriented, diagonal: f64) -> Option<[u8; 4]> {
    let d = b.point - a.point;
    let length = d.length();
    if length < 0.05 * diagonal {
        return None;
    }
    let angle = |x: f64| (x.clamp(-1.0, 1.0).acos() / std::f64::consts::PI * ANGLE_CELLS) as u8;
    let unit = d / length;
    Some([
        (length / diagonal * DISTANCE_CELLS).min(250.0) as u8,
        angle(a.normal.dot(unit)),
        angle(b.normal.dot(unit)),
        angle(a.normal.dot(b.normal)),
    ])
}

/// The frame of an anchor: x along its normal.
fn frame(a: &Oriented) -> DMat3 {
    let (y, z) = a.normal.any_orthonormal_pair();
    DMat3::from_cols(a.normal, y, z)
}

/// The turn of `b` about the normal of `a`, in the frame of `a`.
fn turn(a: &Oriented, axes: &DMat3, b: &Oriented) -> f64 {
    let d = axes.transpose() * (b.point - a.point);
    d.z.atan2(d.y)
}

/// The best poses for every anchor, with their votes.
fn vote(model: &[Oriented], scene: &[Oriented], diagonal: f64) -> Vec<(RigidTransform, f64)> {
    let model_axes: Vec<DMat3> = model.iter().map(frame).collect();
    let mut table: HashMap<[u8; 4], Vec<(u32, f32)>> = HashMap::new();
    for (i, a) in model.iter().enumerate() {
        for (j, b) in model.iter().enumerate() {
            if i != j
                && let Some(key) = key(a, b, diagonal)
            {
                let angle = turn(a, &model_axes[i], b) as f32;
                table.entry(key).or_default().push((i as u32, angle));
            }
        }
    }
    let step = scene.len().div_ceil(ANCHORS).max(1);
    let anchors: Vec<&Oriented> = scene.iter().step_by(step).collect();
    anchors
        .par_iter()
        .flat_map_iter(|anchor| {
            let model_axes = &model_axes;
            let axes = frame(anchor);
            let mut votes = vec![0.0f64; model.len() * TURN_CELLS];
            for partner in scene {
                let Some(key) = key(anchor, partner, diagonal) else {
                    continue;
                };
                let Some(pairs) = table.get(&key) else {
                    continue;
                };
                let own = turn(anchor, &axes, partner);
                // A pair that many pairs of the nominal look like says little.
                let weight = 1.0 / (pairs.len() as f64).sqrt();
                for (i, angle) in pairs {
                    let between = (f64::from(*angle) - own).rem_euclid(std::f64::consts::TAU);
                    let cell = (between / std::f64::consts::TAU * TURN_CELLS as f64) as usize;
                    votes[*i as usize * TURN_CELLS + cell.min(TURN_CELLS - 1)] += weight;
                }
            }
            best_cells(&votes).into_iter().map(move |(cell, count)| {
                let (i, t) = (cell / TURN_CELLS, cell % TURN_CELLS);
                let angle = (t as f64 + 0.5) / TURN_CELLS as f64 * std::f64::consts::TAU;
                let about = DMat3::from_rotation_x(angle);
                let rotation = model_axes[i] * about * axes.transpose();
                let shift = model[i].point - rotation * anchor.point;
                (RigidTransform::from_matrix(rotation, shift), count)
            })
        })
        .collect()
}

/// The eight cells with the most votes.
fn best_cells(votes: &[f64]) -> Vec<(usize, f64)> {
    let mut cells: Vec<usize> = (0..votes.len()).collect();
    let count = 8.min(cells.len());
    let order = |a: &usize, b: &usize| votes[*b].total_cmp(&votes[*a]).then(a.cmp(b));
    if cells.len() > count {
        cells.select_nth_unstable_by(count - 1, order);
        cells.truncate(count);
    }
    cells.sort_by(order);
    cells.into_iter().map(|c| (c, votes[c])).collect()
}

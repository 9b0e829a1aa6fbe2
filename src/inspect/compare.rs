//! Edges found in the scan against edges of the nominal: what is missing, what is unexpected.
//!
//! Source: features-and-standards, section 5, characteristic 18. Where data are inadequate an edge is not measured, never
//! missing.

use std::collections::BTreeMap;

use glam::DVec3;

use super::body::{Body, BodyEdge};
use super::measure::{MeasuredEdge, PARALLEL};
use crate::features::{Class, Detection};
use crate::points::{Neighbors, PointCloud};

/// Spacings within which an edge found belongs to a nominal edge, beside what the edge break takes.
const NEAR: f64 = 4.0;

/// Length in spacings from which edge points without a nominal edge are an edge, not an accident.
const LONG: f64 = 10.0;

/// Share of a nominal edge without anything found at which it is missing.
const MISSING: f64 = 0.95;

/// What the comparison found.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Compared {
    /// Polylines, mm, part frame.
    pub unexpected: Vec<Vec<DVec3>>,
    /// Ids of nominal edges.
    pub missing: Vec<String>,
}

/// Compares the edges that `detection` found in `cloud`, which lies in the part frame, with those of the nominal.
pub fn compare<B: Body>(
    cloud: &PointCloud,
    detection: &Detection,
    nominal: &B,
    edges: (&[BodyEdge], &[MeasuredEdge]),
) -> Compared {
    let spacing = detection.spacing.across_mm;
    if spacing <= 0.0 {
        return Compared::default();
    }
    let (edges, measured) = edges;
    let found: Vec<DVec3> = cloud
        .positions
        .iter()
        .zip(&detection.classes)
        .filter(|(_, class)| matches!(class, Class::Edge | Class::Corner))
        .map(|(p, _)| *p)
        .collect();
    let near = NEAR * spacing;
    Compared {
        unexpected: unexpected(&found, nominal, edges, near),
        missing: missing(&found, edges, measured, near),
    }
}

fn unexpected<B: Body>(
    found: &[DVec3],
    nominal: &B,
    edges: &[BodyEdge],
    near: f64,
) -> Vec<Vec<DVec3>> {
    let mut along = Vec::new();
    for (e, edge) in edges.iter().enumerate() {
        let count = (edge.length_mm / (0.5 * near)).ceil().clamp(1.0, 1e5) as usize;
        for k in 0..=count {
            let s = edge.length_mm * k as f64 / count as f64;
            along.push(nominal.station(e, s).point);
        }
    }
    let known = Neighbors::new(&along);
    let mut hit = Vec::new();
    let strange: Vec<DVec3> = found
        .iter()
        .copied()
        .filter(|p| {
            known.nearest(*p, 1, &mut hit);
            hit.first().is_none_or(|h| h.1 > near * near)
        })
        .collect();
    let mut lines: Vec<Vec<DVec3>> = clusters(&strange, 0.5 * near)
        .into_iter()
        .filter_map(|cluster| polyline(&cluster, 0.5 * near))
        .filter(|line| length(line) > LONG / NEAR * near)
        .collect();
    lines.sort_by(|a, b| length(b).total_cmp(&length(a)));
    lines
}

/// Groups of points that hang together by steps of at most `step` mm.
fn clusters(points: &[DVec3], step: f64) -> Vec<Vec<DVec3>> {
    let neighbors = Neighbors::new(points);
    let mut group = vec![usize::MAX; points.len()];
    let mut groups: Vec<Vec<DVec3>> = Vec::new();
    let (mut stack, mut near) = (Vec::new(), Vec::new());
    for seed in 0..points.len() {
        if group[seed] != usize::MAX {
            continue;
        }
        let number = groups.len();
        groups.push(Vec::new());
        group[seed] = number;
        stack.push(seed);
        while let Some(i) = stack.pop() {
            groups[number].push(points[i]);
            neighbors.within(points[i], step, &mut near);
            for (j, _) in &near {
                let j = *j as usize;
                if group[j] == usize::MAX {
                    group[j] = number;
                    stack.push(j);
                }
            }
        }
    }
    groups
}

/// A polyline along an elongated cluster: means of slices across its longest direction; `None` for fewer than 8 points.
fn polyline(cluster: &[DVec3], step: f64) -> Option<Vec<DVec3>> {
    if cluster.len() < 8 {
        return None;
    }
    let axis = crate::geometry::fit::fit_line(cluster)?;
    let mut slices: BTreeMap<i64, (DVec3, f64)> = BTreeMap::new();
    for p in cluster {
        let at = ((*p - axis.centre).dot(axis.direction) / step).floor();
        let slice = slices.entry(at as i64).or_insert((DVec3::ZERO, 0.0));
        slice.0 += *p;
        slice.1 += 1.0;
    }
    Some(slices.into_values().map(|(sum, n)| sum / n).collect())
}

fn length(line: &[DVec3]) -> f64 {
    line.windows(2).map(|pair| pair[0].distance(pair[1])).sum()
}

/// Edges whose flanks were both seen over most of their length, and along which nothing was found.
fn missing(
    found: &[DVec3],
    edges: &[BodyEdge],
    measured: &[MeasuredEdge],
    near: f64,
) -> Vec<String> {
    let tree = Neighbors::new(found);
    let mut hit = Vec::new();
    let mut ids = Vec::new();
    for (edge, measured) in edges.iter().zip(measured) {
        let (mut adequate, mut without) = (0.0, 0.0);
        for station in &measured.stations {
            let place = match &station.outcome {
                Ok(measured) => measured.point,
                // Both flanks are seen, and they go on into each other.
                Err(reason) if reason == PARALLEL => station.station.point,
                Err(_) => continue,
            };
            adequate += 1.0;
            tree.nearest(place, 1, &mut hit);
            without += f64::from(hit.first().is_none_or(|h| h.1 > near * near));
        }
        let enough = adequate > 0.5 * measured.stations.len() as f64;
        if enough && without >= MISSING * adequate {
            ids.push(edge.id.clone());
        }
    }
    ids
}

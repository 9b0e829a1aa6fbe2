//! Edges found in the scan against edges of the nominal: what is missing, what is unexpected.
//!
//! Source: features-and-standards, section 5, characteristic 18. Where data are inadequate an edge is not measured, never
//! missing.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use glam::DVec3;

use super::attention::{Attention, CellSet, Outline, Patches};
use super::body::BodyEdge;
use super::measure::{MeasuredEdge, MeasuredStation, PARALLEL};
use crate::features::{self, Class, Method};
use crate::points::{Neighbors, PointCloud, Spacing};

/// Spacings within which an edge found belongs to a nominal edge, beside what the edge break takes.
pub(super) const NEAR: f64 = 4.0;

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

/// Points in the part frame with what their patches say of them.
pub(super) struct Scanned<'a> {
    /// One or more parts of the scan, with the cells in which they lie where these are known.
    pub(super) clouds: &'a [(&'a PointCloud, Option<&'a CellSet>)],
    pub(super) patches: &'a Patches,
    pub(super) outline: &'a Outline,
    pub(super) spacing: Spacing,
    pub(super) noise_mm: f64,
}

/// Distance within which what is found belongs to a nominal edge, mm.
pub(super) fn near_mm(spacing: &Spacing) -> f64 {
    NEAR * spacing.across_mm
}

/// What the detector finds where the deviation from the nominal gives it reason to look.
pub(super) fn look(scanned: &Scanned<'_>) -> Vec<DVec3> {
    if scanned.outline.near_mm() <= 0.0 {
        return Vec::new();
    }
    let cells = scanned
        .patches
        .suspicious(scanned.outline, scanned.noise_mm);
    edges_found(scanned, &cells, &[])
}

/// Compares the edges of a scan, of which [`look`] has `found` some, with those of the nominal. The detector looks again where a station
/// shows no edge of its own.
pub(super) fn compare(
    scanned: &Scanned<'_>,
    mut found: Vec<DVec3>,
    edges: (&[BodyEdge], &[MeasuredEdge]),
) -> Compared {
    let outline = scanned.outline;
    if outline.near_mm() <= 0.0 {
        return Compared::default();
    }
    let doubtful = doubtful(edges.1);
    let all: Vec<DVec3> = doubtful.iter().flatten().copied().collect();
    if !all.is_empty() {
        found.extend(edges_found(scanned, &CellSet::default(), &all));
    }
    Compared {
        unexpected: unexpected(&found, outline),
        missing: missing(&found, edges, &doubtful, outline.near_mm()),
    }
}

/// The points of the scan around `cells` and `places` that lie on an edge.
fn edges_found(scanned: &Scanned<'_>, cells: &CellSet, places: &[DVec3]) -> Vec<DVec3> {
    let mut counts = Vec::new();
    let attention = Attention::new(scanned.outline, cells, places);
    let clouds = scanned.clouds.iter();
    let touched = clouds.filter(|(_, cells)| cells.is_none_or(|cells| attention.touches(cells)));
    let parts = touched.map(|(cloud, _)| {
        let (seen, count) = attention.of(&cloud.positions);
        counts.extend(count);
        cloud.subset(&seen)
    });
    // All parts name the same views.
    let together = parts.reduce(|mut all, part| {
        all.positions.extend(part.positions);
        all.origins.extend(part.origins);
        all
    });
    let Some(some) = together else {
        return Vec::new();
    };
    let neighbors = Neighbors::new(&some.positions);
    let known = (scanned.spacing, scanned.noise_mm);
    let detection = features::detect_knowing(&some, &neighbors, known, Method::Adaptive);
    let is_edge = |class: &Class| matches!(class, Class::Edge | Class::Corner);
    let found = some.positions.iter().zip(&detection.classes);
    found
        .zip(&counts)
        .filter(|((_, class), counts)| **counts && is_edge(class))
        .map(|((p, _), _)| *p)
        .collect()
}

fn unexpected(found: &[DVec3], outline: &Outline) -> Vec<Vec<DVec3>> {
    let strange: Vec<DVec3> = found
        .iter()
        .copied()
        .filter(|p| !outline.is_near(*p))
        .collect();
    let near_mm = outline.near_mm();
    let mut lines: Vec<Vec<DVec3>> = clusters(&strange, 0.5 * near_mm)
        .into_iter()
        .filter_map(|cluster| polyline(&cluster, 0.5 * near_mm))
        .filter(|line| length(line) > LONG / NEAR * near_mm)
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

/// Places of the stations, by edge, whose flanks were both seen and do not turn as those of an edge do: by half the nominal's angle.
fn doubtful(measured: &[MeasuredEdge]) -> Vec<Vec<DVec3>> {
    let place = |station: &MeasuredStation| match &station.outcome {
        Ok(measured) => {
            let [first, second] = station.station.normals;
            let turn = PI - measured.included_angle_rad;
            let nominal = first.angle_between(second);
            (turn.abs() < 0.5 * nominal).then_some(measured.point)
        }
        // Both flanks are seen, and they go on into each other.
        Err(reason) => (reason == PARALLEL).then_some(station.station.point),
    };
    let of = |edge: &MeasuredEdge| edge.stations.iter().filter_map(place).collect();
    measured.iter().map(of).collect()
}

/// Edges whose flanks were both seen over most of their length, and along which nothing was found.
fn missing(
    found: &[DVec3],
    (edges, measured): (&[BodyEdge], &[MeasuredEdge]),
    doubtful: &[Vec<DVec3>],
    near_mm: f64,
) -> Vec<String> {
    let tree = Neighbors::new(found);
    let mut hit = Vec::new();
    let mut ids = Vec::new();
    for ((edge, measured), doubtful) in edges.iter().zip(measured).zip(doubtful) {
        let both = |s: &&MeasuredStation| match &s.outcome {
            Ok(_) => true,
            Err(reason) => reason == PARALLEL,
        };
        let adequate = measured.stations.iter().filter(both).count() as f64;
        let mut without = 0.0;
        for place in doubtful {
            tree.nearest(*place, 1, &mut hit);
            without += f64::from(hit.first().is_none_or(|h| h.1 > near_mm * near_mm));
        }
        let enough = adequate > 0.5 * measured.stations.len() as f64;
        if enough && without >= MISSING * adequate {
            ids.push(edge.id.clone());
        }
    }
    ids
}

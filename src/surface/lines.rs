//! Feature lines from many sightings: samples that several points agree on, evenly spaced.

use std::collections::HashMap;

use glam::{DVec3, I64Vec3};

use super::Place;
use super::bulk::LinePoint;

/// Weight of the sightings that make a sample of a line or a corner; one from on the line itself has weight one.
const WEIGHT_LEAST: f64 = 2.0;

/// A place on a feature line as one point saw it.
#[derive(Clone, Copy)]
pub(super) struct Sighting {
    pub line: LinePoint,
    /// How far the point that saw it lies from it, in spacings.
    pub distance: f64,
}

/// Things in cells, found by their place.
pub(super) struct Grid<T> {
    cell_mm: f64,
    cells: HashMap<I64Vec3, Vec<(DVec3, T)>>,
}

impl<T> Grid<T> {
    /// An empty grid for distances up to `cell_mm`.
    pub fn new(cell_mm: f64) -> Self {
        Self {
            cell_mm: cell_mm.max(f64::MIN_POSITIVE),
            cells: HashMap::new(),
        }
    }

    fn cell(&self, p: DVec3) -> I64Vec3 {
        (p / self.cell_mm).floor().as_i64vec3()
    }

    /// Whatever lies in the cells around `p`: everything nearer than a cell is among it.
    pub fn around(&self, p: DVec3) -> impl Iterator<Item = &(DVec3, T)> {
        let home = self.cell(p);
        let steps = (0..27).map(|k| I64Vec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1));
        steps
            .filter_map(move |step| self.cells.get(&(home + step)))
            .flatten()
    }

    pub fn add(&mut self, p: DVec3, thing: T) {
        let cell = self.cell(p);
        self.cells.entry(cell).or_default().push((p, thing));
    }
}

impl Grid<()> {
    /// Adds `p` unless a point nearer than `distance_mm` (at most the cell) is there.
    pub fn take(&mut self, p: DVec3, distance_mm: f64) -> bool {
        let squared = distance_mm * distance_mm;
        if self
            .around(p)
            .any(|(q, ())| q.distance_squared(p) < squared)
        {
            return false;
        }
        self.add(p, ());
        true
    }
}

/// The samples, about `spacing_mm` apart, that enough of the `sightings` agree on; corners come first.
///
/// A sample is the weighted mean of the sightings nearer than the spacing, taken across the line only so that curved lines are not shortened.
pub(super) fn agree(sightings: Vec<Sighting>, spacing_mm: f64) -> Vec<LinePoint> {
    let (corners, edges): (Vec<_>, Vec<_>) =
        (sightings.into_iter()).partition(|s| s.line.place == Place::Corner);
    let mut taken = Grid::new(spacing_mm);
    let mut samples = Vec::new();
    // Sightings of a corner scatter in all directions.
    for (sightings, reach) in [(corners, 2.0 * spacing_mm), (edges, spacing_mm)] {
        let mut all = Grid::new(reach);
        for (index, sighting) in sightings.iter().enumerate() {
            all.add(sighting.line.position, index);
        }
        for sighting in &sightings {
            let p = sighting.line.position;
            if taken
                .around(p)
                .any(|(q, ())| q.distance(p) < 0.7 * spacing_mm)
            {
                continue;
            }
            let Some(sample) = mean(&sighting.line, (&sightings, &all), reach) else {
                continue;
            };
            if taken.take(sample.position, 0.7 * spacing_mm) {
                samples.push(sample);
            }
        }
    }
    samples
}

fn mean(
    at: &LinePoint,
    (sightings, all): (&[Sighting], &Grid<usize>),
    reach: f64,
) -> Option<LinePoint> {
    let tangent = at.normals[0]
        .cross(at.normals[1])
        .as_dvec3()
        .normalize_or_zero();
    let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
    for (q, index) in all.around(at.position) {
        let other = &sightings[*index];
        let same = at
            .normals
            .iter()
            .all(|n| other.line.normals.iter().any(|m| n.dot(*m).abs() > 0.9));
        if same && q.distance(at.position) < reach {
            let weight = 1.0 / (1.0 + other.distance * other.distance);
            sum += (*q - at.position) * weight;
            weights += weight;
        }
    }
    if weights < WEIGHT_LEAST {
        return None;
    }
    let off = sum / weights;
    let off = if at.place == Place::Edge {
        off - tangent * off.dot(tangent)
    } else {
        off
    };
    Some(LinePoint {
        position: at.position + off,
        ..*at
    })
}

//! Feature lines from many sightings: samples that several points agree on, evenly spaced.

use std::collections::HashMap;

use glam::{DVec3, IVec3};

use super::Place;
use super::bulk::LinePoint;

/// Weight of the sightings that make a sample of a line or a corner; one from on the line itself has weight one.
const WEIGHT_LEAST: f64 = 2.0;

/// Samples of the shortest line: as long as one neighbourhood's radius.
const LINE_LEAST: usize = 8;

/// Sightings within a cell of this many spacings of the samples are kept as one.
const CONDENSE: f64 = 0.7;

/// Places on feature lines as many points saw them; those that lie within a spacing of lines of each other are kept as one.
///
/// What is kept grows with the length of the lines, not with the number of points that see them.
pub(super) struct Sightings {
    spacing_mm: f64,
    cells: HashMap<IVec3, u32>,
    all: Vec<Sighting>,
}

/// The weighted mean of what was seen within one cell of one line.
struct Sighting {
    line: LinePoint,
    weight: f64,
    /// Weight of the one among them whose normals are kept.
    best: f64,
    /// The next in the same cell, or `NONE`.
    next: u32,
}

const NONE: u32 = u32::MAX;

impl Sightings {
    /// No sightings yet, of lines whose samples will be `spacing_mm` apart.
    pub fn new(spacing_mm: f64) -> Self {
        Self {
            spacing_mm: spacing_mm.max(f64::MIN_POSITIVE),
            cells: HashMap::new(),
            all: Vec::new(),
        }
    }

    /// Takes in a place seen by a point that lies `distance` spacings of the points from it.
    pub fn add(&mut self, line: LinePoint, distance: f64) {
        let weight = 1.0 / (1.0 + distance * distance);
        let cell = (line.position / (CONDENSE * self.spacing_mm))
            .floor()
            .as_ivec3();
        let first = self.cells.entry(cell).or_insert(NONE);
        let mut at = *first;
        while at != NONE {
            let known = &mut self.all[at as usize];
            if known.line.place == line.place && same_line(&line, &known.line) {
                known.weight += weight;
                let step = (line.position - known.line.position) * (weight / known.weight);
                known.line.position += step;
                if weight > known.best {
                    known.best = weight;
                    known.line.normals = line.normals;
                }
                return;
            }
            at = known.next;
        }
        let next = std::mem::replace(first, self.all.len() as u32);
        self.all.push(Sighting {
            line,
            weight,
            best: weight,
            next,
        });
    }
}

/// Whether every normal of `a` is one of `b`, to 25 degrees.
fn same_line(a: &LinePoint, b: &LinePoint) -> bool {
    let mut normals = a.normals.iter();
    normals.all(|n| b.normals.iter().any(|m| n.dot(*m).abs() > 0.9))
}

/// Things in cells, found by their place.
pub(super) struct Grid<T> {
    cell_mm: f64,
    cells: HashMap<IVec3, u32>,
    /// Place, thing, and the next in the same cell, or `NONE`.
    things: Vec<(DVec3, T, u32)>,
}

impl<T> Grid<T> {
    /// An empty grid for distances up to `cell_mm`.
    pub fn new(cell_mm: f64) -> Self {
        Self {
            cell_mm: cell_mm.max(f64::MIN_POSITIVE),
            cells: HashMap::new(),
            things: Vec::new(),
        }
    }

    fn cell(&self, p: DVec3) -> IVec3 {
        (p / self.cell_mm).floor().as_ivec3()
    }

    /// Whatever lies in the cells around `p`: everything nearer than a cell is among it.
    pub fn around(&self, p: DVec3) -> impl Iterator<Item = (DVec3, &T)> {
        let home = self.cell(p);
        let steps = (0..27).map(|k| IVec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1));
        steps.flat_map(move |step| {
            let first = self.cells.get(&home.saturating_add(step));
            let thing = |at: u32| self.things.get(at as usize);
            std::iter::successors(first.and_then(|at| thing(*at)), move |t| thing(t.2))
                .map(|(p, t, _)| (*p, t))
        })
    }

    pub fn add(&mut self, p: DVec3, thing: T) {
        let cell = self.cell(p);
        let first = self.cells.entry(cell).or_insert(NONE);
        let next = std::mem::replace(first, self.things.len() as u32);
        self.things.push((p, thing, next));
    }
}

impl Grid<()> {
    /// Adds `p` unless a point nearer than `distance_mm` (at most the cell) is there.
    pub fn take(&mut self, p: DVec3, distance_mm: f64) -> bool {
        let squared = distance_mm * distance_mm;
        if self.around(p).any(|(q, _)| q.distance_squared(p) < squared) {
            return false;
        }
        self.add(p, ());
        true
    }
}

/// The samples, about a spacing apart, that enough of the sightings agree on; corners come first.
///
/// A sample is the weighted mean of the sightings nearer than the spacing, taken across the line only so that curved lines are not shortened.
pub(super) fn agree(sightings: Sightings) -> Vec<LinePoint> {
    let Sightings {
        spacing_mm, all, ..
    } = sightings;
    let mut taken = Grid::new(spacing_mm);
    let mut samples = Vec::new();
    // Sightings of a corner scatter in all directions.
    for (place, reach) in [(Place::Corner, 2.0 * spacing_mm), (Place::Edge, spacing_mm)] {
        let of_place = || all.iter().filter(|s| s.line.place == place);
        let mut near = Grid::new(reach);
        for sighting in of_place() {
            near.add(sighting.line.position, sighting);
        }
        for sighting in of_place() {
            let p = sighting.line.position;
            let is_near = |(q, _): (DVec3, &())| q.distance(p) < 0.7 * spacing_mm;
            if taken.around(p).any(is_near) {
                continue;
            }
            let Some(sample) = mean(&sighting.line, &near, reach) else {
                continue;
            };
            if taken.take(sample.position, 0.7 * spacing_mm) {
                samples.push(sample);
            }
        }
    }
    long_enough(samples, spacing_mm)
}

/// The samples without those of lines shorter than [`LINE_LEAST`] samples: chance makes short ones on noisy flats.
fn long_enough(samples: Vec<LinePoint>, spacing_mm: f64) -> Vec<LinePoint> {
    let reach = 3.0 * spacing_mm;
    let mut near = Grid::new(reach);
    for (index, sample) in samples.iter().enumerate() {
        near.add(sample.position, index);
    }
    let mut is_kept = vec![false; samples.len()];
    let mut is_seen = vec![false; samples.len()];
    let mut chain = Vec::new();
    for start in 0..samples.len() {
        if is_seen[start] {
            continue;
        }
        is_seen[start] = true;
        chain.clear();
        chain.push(start);
        let mut done = 0;
        while done < chain.len() {
            let p = samples[chain[done]].position;
            for (q, &index) in near.around(p) {
                if !is_seen[index] && q.distance(p) < reach {
                    is_seen[index] = true;
                    chain.push(index);
                }
            }
            done += 1;
        }
        if chain.len() >= LINE_LEAST {
            chain.iter().for_each(|i| is_kept[*i] = true);
        }
    }
    let kept = samples.into_iter().zip(is_kept);
    kept.filter(|(_, kept)| *kept).map(|(s, _)| s).collect()
}

fn mean(at: &LinePoint, near: &Grid<&Sighting>, reach: f64) -> Option<LinePoint> {
    let tangent = at.normals[0]
        .cross(at.normals[1])
        .as_dvec3()
        .normalize_or_zero();
    let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
    for (q, other) in near.around(at.position) {
        if q.distance(at.position) < reach && same_line(at, &other.line) {
            sum += (q - at.position) * other.weight;
            weights += other.weight;
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

//! Cells of space that know which faces of the nominal can be the nearest to a point in them.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::NO_FACE;
use crate::inspect::body::{Body, BodySample};
use crate::points::Neighbors;

/// Edge of a cell in spacings of the samples.
const CELL: f64 = 3.0;

/// Cells around the nominal, so that a part that stands out a little still falls into one.
const MARGIN: i64 = 4;

/// A cell further away than this many cells from every sample knows its nearest sample only.
const NEAR_CELLS: f64 = 2.0;

/// Samples are this many spacings from the place of the face that they stand for, at most.
const SAMPLING: f64 = 1.5;

/// Samples of one face of which the normals differ by more than this cosine are separate places to start from.
const SAME_SHEET: f64 = 0.5;

/// Cells of the rough table are this many cells wide.
const ROUGH: i64 = 3;

/// Marks the only candidate of a cell that lies in the middle of its face.
const MIDDLE: u32 = 1 << 31;

/// Most candidates of a cell; where more faces meet, points are looked up one by one.
const MOST: usize = 12;

/// The nearest sample of a cell, rounded: for the search, not for the fit.
#[derive(Debug, Clone, Copy)]
pub(in crate::inspect) struct Near {
    pub(in crate::inspect) point: Vec3,
    pub(in crate::inspect) normal: Vec3,
}

/// Cells over the bounds of the samples.
pub(super) struct Grid {
    low: DVec3,
    inverse: f64,
    count: [i64; 3],
    nearest: Vec<Near>,
    /// The same for cells three times as wide: few enough to stay in the cache.
    rough: Vec<Near>,
    rough_count: [i64; 3],
    /// Where the candidates of each cell begin; one longer than the cells.
    starts: Vec<u32>,
    /// Indices of samples: one for every face and sheet that can be nearest, nearest first.
    candidates: Vec<u32>,
}

impl Grid {
    pub(super) fn new<B: Body>(
        body: &B,
        samples: &[BodySample],
        tree: &Neighbors,
        spacing_mm: f64,
    ) -> Self {
        // One bit of an index is a mark.
        if samples.len() >= MIDDLE as usize {
            return Self::empty();
        }
        let fold = |pick: fn(DVec3, DVec3) -> DVec3| samples.iter().map(|s| s.point).reduce(pick);
        let (Some(low), Some(high)) = (fold(DVec3::min), fold(DVec3::max)) else {
            return Self::empty();
        };
        let mut edge = CELL * spacing_mm;
        // The samples are some 1/200 of the diagonal apart; a nominal with faces outside its bounds must not take all memory.
        edge = edge.max((high - low).max_element() / 120.0);
        if !(edge > 0.0 && edge.is_finite()) {
            return Self::empty();
        }
        let low = low - MARGIN as f64 * edge;
        let count = ((high - low) / edge).to_array();
        let count = count.map(|c| c.ceil() as i64 + MARGIN);
        let cells = (count[0] * count[1] * count[2]) as usize;
        let look = Look {
            body,
            samples,
            tree,
            radius_mm: 0.5 * 3.0f64.sqrt() * edge,
            edge_mm: edge,
            spacing_mm,
        };
        let centre = |cell: usize| {
            let c = cell as i64;
            let at = [
                c % count[0],
                c / count[0] % count[1],
                c / (count[0] * count[1]),
            ];
            low + edge * DVec3::from_array(at.map(|i| i as f64 + 0.5))
        };
        let (nearest, lists): (Vec<Near>, Vec<Vec<u32>>) = (0..cells)
            .into_par_iter()
            .with_min_len(256)
            .map_init(Vec::new, |found, cell| look.cell(centre(cell), found))
            .unzip();
        let mut starts = Vec::with_capacity(cells + 1);
        let mut candidates = Vec::new();
        for list in &lists {
            starts.push(candidates.len() as u32);
            candidates.extend_from_slice(list);
        }
        starts.push(candidates.len() as u32);
        let rough_count = count.map(|c| (c + ROUGH - 1) / ROUGH);
        let rough = (0..rough_count[0] * rough_count[1] * rough_count[2])
            .map(|c| {
                let [x, y, _] = rough_count;
                let at = [c % x, c / x % y, c / (x * y)];
                // The cell in the middle of the wide one.
                let at: [i64; 3] =
                    std::array::from_fn(|k| (ROUGH * at[k] + ROUGH / 2).min(count[k] - 1));
                nearest[(at[0] + count[0] * (at[1] + count[1] * at[2])) as usize]
            })
            .collect();
        Self {
            low,
            inverse: 1.0 / edge,
            count,
            nearest,
            rough,
            rough_count,
            starts,
            candidates,
        }
    }

    fn empty() -> Self {
        Self {
            low: DVec3::ZERO,
            inverse: 0.0,
            count: [0; 3],
            nearest: Vec::new(),
            rough: Vec::new(),
            rough_count: [0; 3],
            starts: Vec::new(),
            candidates: Vec::new(),
        }
    }

    /// Samples to start from for a point `p`; empty where it lies far from everything.
    pub(super) fn candidates(&self, p: DVec3) -> &[u32] {
        let at = ((p - self.low) * self.inverse).to_array();
        let mut cell = 0;
        for k in [2, 1, 0] {
            // Not finite falls out as well.
            if !(at[k] >= 0.0 && at[k] < self.count[k] as f64) {
                return &[];
            }
            cell = cell * self.count[k] as usize + at[k] as usize;
        }
        &self.candidates[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    /// The nearest sample of the cell of `p`, or of the cell at the border nearest to it.
    pub(super) fn near(&self, p: DVec3) -> Option<&Near> {
        let at = ((p - self.low) * self.inverse).as_ivec3().to_array();
        let mut cell = 0;
        for k in [2, 1, 0] {
            cell = cell * self.count[k] + i64::from(at[k]).clamp(0, (self.count[k] - 1).max(0));
        }
        self.nearest.get(cell as usize)
    }

    /// As [`Grid::near`], by cells three times as wide.
    pub(super) fn rough(&self, p: DVec3) -> Option<&Near> {
        let at = ((p - self.low) * (self.inverse / ROUGH as f64))
            .as_ivec3()
            .to_array();
        let mut cell = 0;
        for k in [2, 1, 0] {
            let last = (self.rough_count[k] - 1).max(0);
            cell = cell * self.rough_count[k] + i64::from(at[k]).clamp(0, last);
        }
        self.rough.get(cell as usize)
    }
}

/// The sample that a candidate stands for, and whether every point of the cell lies in the middle of its face.
#[inline]
pub(super) fn sample_of(candidate: u32) -> (usize, bool) {
    ((candidate & !MIDDLE) as usize, candidate & MIDDLE != 0)
}

struct Look<'a, B: Body> {
    body: &'a B,
    samples: &'a [BodySample],
    tree: &'a Neighbors,
    radius_mm: f64,
    edge_mm: f64,
    spacing_mm: f64,
}

impl<B: Body> Look<'_, B> {
    fn cell(&self, centre: DVec3, found: &mut Vec<(u32, f64)>) -> (Near, Vec<u32>) {
        self.tree.nearest(centre, 1, found);
        let Some((first, squared)) = found.first().copied() else {
            let near = Near {
                point: centre.as_vec3(),
                normal: Vec3::ZERO,
            };
            return (near, Vec::new());
        };
        let sample = &self.samples[first as usize];
        let near = Near {
            point: sample.point.as_vec3(),
            normal: sample.normal.as_vec3(),
        };
        let nearest_mm = squared.sqrt();
        if nearest_mm > NEAR_CELLS * self.edge_mm {
            return (near, Vec::new());
        }
        let reach = nearest_mm + 2.0 * self.radius_mm + SAMPLING * self.spacing_mm;
        self.tree.within(centre, reach, found);
        let mut list: Vec<u32> = Vec::new();
        let mut last = (NO_FACE, DVec3::ZERO);
        for (i, _) in found.iter() {
            let s = &self.samples[*i as usize];
            if s.face == last.0 && s.normal.dot(last.1) > SAME_SHEET {
                continue;
            }
            last = (s.face, s.normal);
            let known = list.iter().any(|j| {
                let t = &self.samples[*j as usize];
                t.face == s.face && t.normal.dot(s.normal) > SAME_SHEET
            });
            if !known {
                list.push(*i);
                if list.len() > MOST {
                    return (near, Vec::new());
                }
            }
        }
        if let [only] = list[..]
            && self.is_middle(&self.samples[only as usize], centre)
        {
            list[0] |= MIDDLE;
        }
        (near, list)
    }

    /// Whether the feet of a cell's corners lie inside the boundary of the face of `sample`. A hole between them would have
    /// brought its own face into the cell.
    fn is_middle(&self, sample: &BodySample, centre: DVec3) -> bool {
        (0..8).all(|k| {
            let sign = |bit: u32| if k & bit == 0 { -0.5 } else { 0.5 };
            let corner = centre + self.edge_mm * DVec3::new(sign(1), sign(2), sign(4));
            let foot = self.body.foot(sample.face, corner, Some(sample.uv));
            foot.is_some_and(|f| self.body.contains(sample.face, f.uv))
        })
    }
}

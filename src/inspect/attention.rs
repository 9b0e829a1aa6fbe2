//! Where a scan may show an edge that the nominal does not have: everywhere else the detector need not look.
//!
//! The nominal is smooth away from its sharp edges, so a crease of the part is a kink of the deviation from it. The deviation is
//! fitted by a plane in every patch of a face: where it neither slopes nor scatters there is no edge. A surface that kinks by the
//! least angle that the detector tells slopes by at least half of it on one side.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};

use foldhash::fast::FixedState;
use glam::{DMat2, DMat3, DQuat, DVec2, DVec3, IVec3};
use rayon::prelude::*;

use super::assign::{NO_FACE, Place};
use super::body::{Body, BodyEdge};

/// Width of a patch in spacings: an edge shorter than this is an accident.
const PATCH: f64 = 8.0;

/// Points without which a patch says nothing.
const ENOUGH: f64 = 12.0;

/// Half of half the least turn that the detector tells (8 degrees), as a slope: the other half is for a face that is tilted itself.
const SLOPE: f64 = 0.035;

/// Variance over that of the noise from which on a patch scatters: places differ in noise, and the noise is that of the quiet ones.
const SCATTER: f64 = 2.0;

/// Standard deviations of chance.
const CHANCE: f64 = 3.0;

/// Patches around a suspicious one in which an edge would be found.
const LOOK: i32 = 1;

/// Patches around those that the detector needs to see.
const SEE: i32 = 2;

/// Points that one task looks at: a piece of a scan that comes bit by bit is a few of them.
const BLOCK: usize = 1 << 12;

/// A cell of space, about a patch wide.
type Cell = IVec3;

/// The nominal edges, for telling what lies near one.
pub(super) struct Outline {
    /// Places along the edges.
    places: Vec<DVec3>,
    /// Of every cell in which something near one may lie, which places may be near.
    near: HashMap<Cell, Vec<u32>, FixedState>,
    grid: Grid,
    near_mm: f64,
}

impl Outline {
    /// `near_mm` is the distance within which what is found belongs to a nominal edge.
    pub(super) fn new<B: Body>(nominal: &B, edges: &[BodyEdge], near_mm: f64) -> Self {
        let grid = Grid::new(PATCH / super::compare::NEAR * near_mm);
        let mut places = Vec::new();
        for (e, edge) in edges.iter().enumerate() {
            let count = (edge.length_mm / (0.5 * near_mm)).ceil().clamp(1.0, 1e5) as usize;
            let at = |k: usize| edge.length_mm * k as f64 / count as f64;
            places.extend((0..=count).map(|k| nominal.station(e, at(k)).point));
        }
        let mut near: HashMap<Cell, Vec<u32>, FixedState> = HashMap::default();
        for (i, place) in places.iter().enumerate() {
            for cell in grid.cells_within(*place, near_mm) {
                near.entry(cell).or_default().push(i as u32);
            }
        }
        Self {
            places,
            near,
            grid,
            near_mm,
        }
    }

    /// Distance within which what is found belongs to a nominal edge, mm.
    pub(super) fn near_mm(&self) -> f64 {
        self.near_mm
    }

    /// The cells in which `positions` lie.
    pub(super) fn cells_of(&self, positions: &[DVec3]) -> CellSet {
        let mut cells = CellSet::default();
        let mut last = None;
        for p in positions {
            let cell = self.grid.cell(*p);
            // Neighbours follow one another.
            if last.replace(cell) != Some(cell) {
                cells.insert(cell);
            }
        }
        cells
    }

    /// Whether `p` lies near a nominal edge.
    pub(super) fn is_near(&self, p: DVec3) -> bool {
        let is_near = |i: &u32| {
            let place = self.places[*i as usize];
            place.distance_squared(p) <= self.near_mm * self.near_mm
        };
        let places = self.near.get(&self.grid.cell(p));
        places.is_some_and(|places| places.iter().any(is_near))
    }
}

/// What the patches of a scan say, added up point by point.
#[derive(Default)]
pub(super) struct Patches {
    moments: HashMap<(u32, Cell), Moments, FixedState>,
}

impl Patches {
    /// Adds points, which lie in the part frame, with their places; the same sums whatever the number of threads.
    pub(super) fn add(&mut self, positions: &[DVec3], places: &[Place], outline: &Outline) {
        let blocks: Vec<Vec<((u32, Cell), Moments)>> = positions
            .par_chunks(BLOCK)
            .zip(places.par_chunks(BLOCK))
            .map(|(positions, places)| runs(positions, places, outline))
            .collect();
        for (patch, moments) in blocks.into_iter().flatten() {
            match self.moments.entry(patch) {
                Entry::Occupied(mut known) => known.get_mut().merge(&moments),
                Entry::Vacant(new) => {
                    new.insert(moments);
                }
            }
        }
    }

    /// Cells whose surface may hold an edge.
    pub(super) fn suspicious(&self, outline: &Outline, noise_mm: f64) -> CellSet {
        let suspicious = |((_, cell), moments): (&(u32, Cell), &Moments)| {
            moments
                .is_suspicious(outline.grid.size_mm, noise_mm)
                .then_some(*cell)
        };
        self.moments.iter().filter_map(suspicious).collect()
    }
}

/// The moments of the patches that a block of points touches, a patch as often as the scan lines cross it.
fn runs(positions: &[DVec3], places: &[Place], outline: &Outline) -> Vec<((u32, Cell), Moments)> {
    let mut runs: Vec<((u32, Cell), Moments)> = Vec::new();
    for (p, place) in positions.iter().zip(places) {
        if place.face == NO_FACE || outline.is_near(*p) {
            continue;
        }
        let cell = outline.grid.cell(*p);
        let patch = (place.face, cell);
        let offset = *p - outline.grid.centre(cell);
        match runs.last_mut().filter(|(last, _)| *last == patch) {
            Some((_, moments)) => moments.add(offset, place),
            None => {
                let mut moments = Moments::default();
                moments.add(offset, place);
                runs.push((patch, moments));
            }
        }
    }
    runs
}

/// Where the detector is to look.
pub(super) struct Attention<'a> {
    outline: &'a Outline,
    /// Where an edge counts.
    look: CellSet,
    /// And what has to be seen around that.
    see: CellSet,
}

impl<'a> Attention<'a> {
    /// To what lies around `cells` and around `places`.
    pub(super) fn new(outline: &'a Outline, cells: &CellSet, places: &[DVec3]) -> Self {
        let grown = |reach: i32| -> CellSet {
            let places = places.iter().map(|p| outline.grid.cell(*p));
            let all = cells.iter().copied().chain(places);
            all.flat_map(|cell| around(cell, reach)).collect()
        };
        Self {
            outline,
            look: grown(LOOK),
            see: grown(LOOK + SEE),
        }
    }

    /// Whether points in `cells` are to be seen.
    pub(super) fn touches(&self, cells: &CellSet) -> bool {
        !self.see.is_disjoint(cells)
    }

    /// Indices of the points that are to be seen, ascending, and of each whether an edge there counts.
    pub(super) fn of(&self, positions: &[DVec3]) -> (Vec<usize>, Vec<bool>) {
        let found: Vec<(usize, bool)> = positions
            .par_iter()
            .enumerate()
            .filter_map(|(i, p)| {
                let cell = self.outline.grid.cell(*p);
                let seen = self.see.contains(&cell);
                seen.then(|| (i, self.look.contains(&cell)))
            })
            .collect();
        found.into_iter().unzip()
    }
}

fn around(cell: Cell, reach: i32) -> impl Iterator<Item = Cell> {
    let reach = IVec3::splat(reach);
    cells(cell.saturating_sub(reach), cell.saturating_add(reach))
}

/// The cells from `low` to `high`, both included.
fn cells(low: Cell, high: Cell) -> impl Iterator<Item = Cell> {
    (low.x..=high.x).flat_map(move |x| {
        (low.y..=high.y).flat_map(move |y| (low.z..=high.z).map(move |z| IVec3::new(x, y, z)))
    })
}

/// Cells in a turned lattice: what runs along an axis of the part does not run along their walls.
struct Grid {
    turn: DQuat,
    size_mm: f64,
}

impl Grid {
    fn new(size_mm: f64) -> Self {
        Self {
            turn: DQuat::from_axis_angle(DVec3::new(0.48, 0.6, -0.64), 0.5217),
            size_mm: size_mm.max(1e-9),
        }
    }

    fn cell(&self, p: DVec3) -> Cell {
        (self.turn * p / self.size_mm).floor().as_ivec3()
    }

    /// The cells of the box around what lies within `reach_mm` of `p`.
    fn cells_within(&self, p: DVec3, reach_mm: f64) -> impl Iterator<Item = Cell> {
        let at = |shift_mm: f64| {
            let corner = (self.turn * p + shift_mm) / self.size_mm;
            corner.floor().as_ivec3()
        };
        cells(at(-reach_mm), at(reach_mm))
    }

    fn centre(&self, cell: Cell) -> DVec3 {
        self.turn.conjugate() * ((cell.as_dvec3() + 0.5) * self.size_mm)
    }
}

/// Sums over the points of a patch: places about the middle of the cell, deviations, normals.
#[derive(Debug, Clone, Copy, Default)]
struct Moments {
    count: f64,
    place: DVec3,
    places: DMat3,
    deviation: f64,
    by_place: DVec3,
    squares: f64,
    normal: DVec3,
}

impl Moments {
    fn add(&mut self, offset: DVec3, place: &Place) {
        let d = place.deviation_mm;
        self.count += 1.0;
        self.place += offset;
        self.places += DMat3::from_cols(offset * offset.x, offset * offset.y, offset * offset.z);
        self.deviation += d;
        self.by_place += offset * d;
        self.squares += d * d;
        self.normal += place.normal;
    }

    fn merge(&mut self, other: &Self) {
        self.count += other.count;
        self.place += other.place;
        self.places += other.places;
        self.deviation += other.deviation;
        self.by_place += other.by_place;
        self.squares += other.squares;
        self.normal += other.normal;
    }

    /// Whether the deviation slopes or scatters more than noise does.
    fn is_suspicious(&self, size_mm: f64, noise_mm: f64) -> bool {
        let Some(normal) = self.normal.try_normalize() else {
            return self.count > 0.0;
        };
        if self.count < ENOUGH {
            return false;
        }
        let n = self.count;
        let (u, v) = normal.any_orthonormal_pair();
        let flat = |p: DVec3| DVec2::new(p.dot(u), p.dot(v));
        let mean = flat(self.place / n);
        let second = [u, v].map(|axis| flat(self.places * axis));
        let spread = DMat2::from_cols(second[0] - n * mean * mean.x, second[1] - n * mean * mean.y);
        let by_place = flat(self.by_place) - mean * self.deviation;
        let squares = self.squares - self.deviation * self.deviation / n;
        // A patch that is a mere line along a border slopes along it only.
        let ridge = DMat2::from_diagonal(DVec2::splat(1e-4 * n * size_mm * size_mm));
        let slope = (spread + ridge).inverse() * by_place;
        let rest = (squares - slope.dot(by_place)).max(0.0) / (n - 3.0);
        let variance = noise_mm * noise_mm;
        if rest > variance * (SCATTER + CHANCE * (2.0 / (n - 3.0)).sqrt()) {
            return true;
        }
        let along = slope.normalize_or_zero();
        let held = along.dot(spread * along).max(1e-12 * size_mm * size_mm);
        slope.length() > SLOPE + CHANCE * (rest.max(variance) / held).sqrt()
    }
}

pub(super) type CellSet = HashSet<Cell, FixedState>;

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::nominal::Nominal;

    #[test]
    fn what_is_near_an_edge_is_what_its_places_say() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
        let nominal = Nominal::read(&path).expect("the demo's part");
        let edges = Body::edges(&nominal);
        let outline = Outline::new(&nominal, &edges, 0.5);
        let mut counts = [0, 0];
        for (i, place) in outline.places.iter().enumerate().step_by(7) {
            // A direction of its own for each, and up to three times as far as what is near.
            let way = DVec3::new(
                (i as f64).sin(),
                (2.3 * i as f64).cos(),
                (0.7 * i as f64).sin(),
            );
            let p = *place + way * (i % 31) as f64 * 0.05;
            let nearest = outline.places.iter().map(|q| q.distance(p));
            let expected = nearest.fold(f64::INFINITY, f64::min) <= 0.5;
            assert_eq!(outline.is_near(p), expected, "{p}");
            counts[usize::from(expected)] += 1;
        }
        assert!(counts.iter().all(|count| *count > 50), "{counts:?}");
    }
}

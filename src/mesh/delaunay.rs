//! The Delaunay triangulation of points in space.
//!
//! Points enter one by one along a Hilbert curve in rounds; each clears the cells whose spheres hold it and fills the cavity with cells
//! of its own (Bowyer 1981, Watson 1981). All signs are exact, and cospherical points are told apart by a perturbation that
//! depends on coordinates alone: the triangulation is a function of the set of points, whatever their order, with no flat cell in it.

use glam::DVec3;

use super::curve::{along_hilbert_curve, in_rounds};
use super::predicates::{Signs, collinear};

/// The vertex at infinity: a cell with it stands outside a facet of the convex hull.
pub const GHOST: u32 = u32::MAX;

/// The facet opposite to each corner, from its positive side seen so that [`Signs::orient`] of facet and corner is positive.
pub const FACETS: [[usize; 3]; 4] = [[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]];

/// Cells a point has on average among points on a surface is below this, ghosts included; more are made room for as they come.
const CELLS_PER_POINT: f64 = 6.8;

/// Corners of a cavity up to which its facets find one another through a table.
const TABLE: usize = 64;

/// Why there is no triangulation in space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DelaunayError {
    /// The points span less than space: a plane, a line or a point.
    #[error(
        "points: {distinct} distinct ones, all in one {}, expected a body in space",
        ["point", "line", "plane"][*.dimension as usize]
    )]
    Flat {
        /// Distinct points.
        distinct: usize,
        /// Dimension of what they span: 0, 1 or 2.
        dimension: u8,
    },
    /// A coordinate is NaN or infinite.
    #[error("points: point {index} is not finite; remove such points first")]
    NotFinite {
        /// The first such point.
        index: usize,
    },
    /// More points than cells can be numbered for.
    #[error("points: {count}, expected at most 150,000,000; mesh the scan in parts")]
    TooMany {
        /// The points given.
        count: usize,
    },
}

/// The Delaunay triangulation of V distinct points: C cells, ghosts among them, each with four corners and four neighbours.
///
/// Memory: 32 bytes a cell (36 while it is built), about 6.6 cells a point on a surface; 28 bytes a point.
#[derive(Debug, Clone)]
pub struct Delaunay {
    /// V distinct points along a Hilbert curve, mm times `scale`.
    pub points: Vec<DVec3>,
    /// Power of two that the coordinates were multiplied by; 1 for all but absurd ones.
    pub scale: f64,
    /// For every vertex the index of the first input point at its place.
    pub sources: Vec<u32>,
    /// For every input point the vertex at its place.
    pub vertex_of: Vec<u32>,
    /// Corners of each cell, [`Signs::orient`] of them positive; one of them may be [`GHOST`].
    pub cells: Vec<[u32; 4]>,
    /// The cell across the facet opposite to each corner.
    pub neighbors: Vec<[u32; 4]>,
}

impl Delaunay {
    /// Triangulates `positions`, mm. Repeated points count once.
    ///
    /// Coordinates are exact unless they are smaller than 2^-148 of the largest, which are rounded to multiples of 2^-200 of it.
    ///
    /// # Errors
    /// [`DelaunayError`].
    pub fn new(positions: &[DVec3]) -> Result<Self, DelaunayError> {
        const MOST: usize = 150_000_000;
        if positions.len() > MOST {
            return Err(DelaunayError::TooMany {
                count: positions.len(),
            });
        }
        if let Some(index) = positions.iter().position(|p| !p.is_finite()) {
            return Err(DelaunayError::NotFinite { index });
        }
        let (all, scale) = without_extremes(positions);
        let (sources, vertex_of) = along_hilbert_curve(&all);
        let points: Vec<DVec3> = sources.iter().map(|i| all[*i as usize]).collect();
        drop(all);
        let order = in_rounds(points.len());
        let first = first_cell(&points, &order)?;
        let mut builder = Builder::new(points, first);
        for &v in &order {
            if !first.contains(&v) {
                builder.insert(v);
            }
        }
        let (points, cells, neighbors) = builder.finish();
        Ok(Self {
            points,
            scale,
            sources,
            vertex_of,
            cells,
            neighbors,
        })
    }

    /// Cells without a corner at infinity.
    pub fn finite_cells(&self) -> usize {
        self.cells.iter().filter(|c| !c.contains(&GHOST)).count()
    }

    /// Whether a cell has the corner at infinity.
    #[inline]
    pub fn is_ghost(&self, cell: u32) -> bool {
        self.cells[cell as usize].contains(&GHOST)
    }

    /// The place among the neighbours of `neighbor` where `cell` stands.
    #[inline]
    pub fn mirror(&self, cell: u32, neighbor: u32) -> usize {
        place(&self.neighbors[neighbor as usize], cell)
    }

    /// The corner of the cell across the facet opposite to corner `at`, which is not on that facet.
    #[inline]
    pub fn across(&self, cell: u32, at: usize) -> u32 {
        let neighbor = self.neighbors[cell as usize][at];
        self.cells[neighbor as usize][self.mirror(cell, neighbor)]
    }
}

#[inline]
fn place(of: &[u32; 4], what: u32) -> usize {
    if of[0] == what {
        0
    } else if of[1] == what {
        1
    } else if of[2] == what {
        2
    } else {
        3
    }
}

/// The points, scaled by a power of two where products of five of their differences could over- or underflow.
fn without_extremes(positions: &[DVec3]) -> (Vec<DVec3>, f64) {
    const SMALL: f64 = 1.0 / (1u128 << 100) as f64;
    const LARGE: f64 = (1u128 << 100) as f64;
    let largest = positions
        .iter()
        .map(|p| p.abs().max_element())
        .fold(0.0, f64::max);
    let (scale, largest) = if largest == 0.0 || (SMALL..LARGE).contains(&largest) {
        (1.0, largest)
    } else {
        // Twice the exponent of the largest, so that a subnormal one comes up too; halved steps keep the factor finite.
        let exponent = (-largest.log2().floor()).clamp(-1020.0, 1020.0);
        (exponent.exp2(), largest * exponent.exp2())
    };
    // Adding and taking away this constant rounds to multiples of 2^-200 of the largest; it makes minus zero plus zero.
    let grain = 1.5 * 2f64.powi(-148) * largest.log2().ceil().max(-200.0).exp2();
    let snap = |x: f64| {
        let x = x * scale;
        if x.abs() < 0.5 * grain {
            (x + grain) - grain
        } else {
            x
        }
    };
    let points = positions
        .iter()
        .map(|p| DVec3::from_array(p.to_array().map(snap)))
        .collect();
    (points, scale)
}

/// Four vertices, the first in `order` that are not coplanar, positively oriented.
fn first_cell(points: &[DVec3], order: &[u32]) -> Result<[u32; 4], DelaunayError> {
    let at = |v: u32| points[v as usize];
    let flat = |dimension| DelaunayError::Flat {
        distinct: points.len(),
        dimension,
    };
    let mut rest = order.iter().copied();
    let a = rest.next().ok_or(flat(0))?;
    let b = rest.next().ok_or(flat(0))?;
    let c = rest
        .find(|&v| !collinear(at(a), at(b), at(v)))
        .ok_or(flat(1))?;
    // Points before `c` lie on the line through `a` and `b`, so in every plane through it.
    let signs = Signs::of(points);
    let side = |v: u32| signs.orient(at(a), at(b), at(c), at(v));
    let d = rest.find(|&v| side(v) != 0.0).ok_or(flat(2))?;
    Ok(if side(d) > 0.0 {
        [a, b, c, d]
    } else {
        [b, a, c, d]
    })
}

/// A facet on the rim of a cavity, made into a cell with the new point.
#[derive(Clone, Copy)]
struct Rim {
    /// The cell inside that the facet was of, with the new point in place of the corner opposite.
    corners: [u32; 4],
    /// Where the new point stands in it.
    at: usize,
    outer: u32,
    outer_at: usize,
}

struct Builder {
    points: Vec<DVec3>,
    signs: Signs,
    cells: Vec<[u32; 4]>,
    neighbors: Vec<[u32; 4]>,
    /// Twice the number of the insertion that last looked at a cell, plus one where the cell fell to it.
    marks: Vec<u32>,
    free: Vec<u32>,
    insertion: u32,
    hint: u32,
    fallen: Vec<u32>,
    rims: Vec<Rim>,
    fresh: Vec<u32>,
    /// For every vertex and the ghost its number on the present rim.
    numbers: Vec<u8>,
    numbered: Vec<u32>,
    /// Facet of the rim by the numbers of the ends of its directed edges.
    table: Vec<u8>,
}

const NO_NUMBER: u8 = u8::MAX;

impl Builder {
    fn new(points: Vec<DVec3>, first: [u32; 4]) -> Self {
        let room = (points.len() as f64 * CELLS_PER_POINT) as usize + 16;
        let mut cells = Vec::with_capacity(room);
        let mut neighbors = Vec::with_capacity(room);
        cells.push(first);
        neighbors.push([1, 2, 3, 4]);
        for facet in FACETS {
            // The ghost stands across the facet, which is seen from outside in the other sense.
            let [a, b, c] = facet.map(|k| first[k]);
            cells.push([b, a, c, GHOST]);
            let ghost = |corner: u32| 1 + place(&first, corner) as u32;
            neighbors.push([ghost(b), ghost(a), ghost(c), 0]);
        }
        let count = points.len();
        let mut marks = Vec::with_capacity(room);
        marks.resize(cells.len(), 0);
        Self {
            signs: Signs::of(&points),
            points,
            cells,
            neighbors,
            marks,
            free: Vec::new(),
            insertion: 0,
            hint: 0,
            fallen: Vec::new(),
            rims: Vec::new(),
            fresh: Vec::new(),
            numbers: vec![NO_NUMBER; count + 1],
            numbered: Vec::new(),
            table: vec![0; TABLE * TABLE],
        }
    }

    #[inline]
    fn at(&self, v: u32) -> DVec3 {
        self.points[v as usize]
    }

    fn insert(&mut self, v: u32) {
        self.insertion += 1;
        let p = self.at(v);
        let start = self.locate(p);
        self.clear(start, v, p);
        self.fill();
    }

    /// A cell whose sphere holds `p`: the one that contains it, or a ghost that sees it.
    fn locate(&self, p: DVec3) -> u32 {
        let mut cell = self.hint;
        if let Some(at) = self.cells[cell as usize].iter().position(|c| *c == GHOST) {
            cell = self.neighbors[cell as usize][at];
        }
        let mut from = cell;
        // A walk that crosses every facet it sees ends in a Delaunay triangulation (De Floriani et al. 1991).
        'walk: loop {
            let corners = self.cells[cell as usize];
            let corner_points = corners.map(|c| self.at(c));
            let neighbors = self.neighbors[cell as usize];
            for (next, facet) in neighbors.into_iter().zip(&FACETS) {
                if next == from {
                    continue;
                }
                let [a, b, c] = facet.map(|k| corner_points[k]);
                if self.signs.orient(a, b, c, p) < 0.0 {
                    from = cell;
                    cell = next;
                    if self.cells[cell as usize].contains(&GHOST) {
                        return cell;
                    }
                    continue 'walk;
                }
            }
            return cell;
        }
    }

    fn falls(&self, cell: u32, p: DVec3) -> bool {
        let corners = self.cells[cell as usize];
        let Some(at) = corners.iter().position(|c| *c == GHOST) else {
            return self
                .signs
                .in_sphere_perturbed(corners.map(|c| self.at(c)), p);
        };
        let [a, b, c] = FACETS[at].map(|k| self.at(corners[k]));
        match self.signs.orient(a, b, c, p) {
            // In the plane of a hull facet the sphere of the cell behind it is the facet's circle.
            0.0 => {
                let behind = self.cells[self.neighbors[cell as usize][at] as usize];
                self.signs
                    .in_sphere_perturbed(behind.map(|c| self.at(c)), p)
            }
            side => side > 0.0,
        }
    }

    /// Finds the cells that fall to vertex `v`, and the rim of the cavity they leave.
    fn clear(&mut self, start: u32, v: u32, p: DVec3) {
        let (kept, fallen) = (2 * self.insertion, 2 * self.insertion + 1);
        self.fallen.clear();
        self.rims.clear();
        self.fallen.push(start);
        self.marks[start as usize] = fallen;
        let mut done = 0;
        while let Some(&cell) = self.fallen.get(done) {
            done += 1;
            let neighbors = self.neighbors[cell as usize];
            for (at, &outer) in neighbors.iter().enumerate() {
                let mark = self.marks[outer as usize];
                if mark == fallen {
                    continue;
                }
                if mark != kept && self.falls(outer, p) {
                    self.marks[outer as usize] = fallen;
                    self.fallen.push(outer);
                    continue;
                }
                self.marks[outer as usize] = kept;
                let mut corners = self.cells[cell as usize];
                corners[at] = v;
                let outer_at = place(&self.neighbors[outer as usize], cell);
                self.rims.push(Rim {
                    corners,
                    at,
                    outer,
                    outer_at,
                });
            }
        }
    }

    /// Makes a cell of every facet of the rim.
    fn fill(&mut self) {
        self.fresh.clear();
        let spare = self.rims.len().min(self.fallen.len());
        self.free.extend_from_slice(&self.fallen[spare..]);
        self.fresh.extend_from_slice(&self.fallen[..spare]);
        while self.fresh.len() < self.rims.len() {
            let id = self.free.pop().unwrap_or_else(|| {
                self.cells.push([0; 4]);
                self.neighbors.push([0; 4]);
                self.marks.push(0);
                self.cells.len() as u32 - 1
            });
            self.fresh.push(id);
        }
        for (rim, &id) in self.rims.iter().zip(&self.fresh) {
            self.cells[id as usize] = rim.corners;
            self.neighbors[id as usize][rim.at] = rim.outer;
            self.neighbors[rim.outer as usize][rim.outer_at] = id;
        }
        if !self.join_by_table() {
            self.join_by_sorting();
        }
        self.hint = self.fresh[0];
    }

    /// Joins the fresh cells with one another; false where the rim has too many corners for the table.
    fn join_by_table(&mut self) -> bool {
        let ghost = self.points.len();
        let mut fits = true;
        self.numbered.clear();
        'rims: for (facet, rim) in self.rims.iter().enumerate() {
            let mut numbers = [0usize; 3];
            for (number, k) in numbers.iter_mut().zip(FACETS[rim.at]) {
                let slot = (rim.corners[k] as usize).min(ghost);
                if self.numbers[slot] == NO_NUMBER {
                    if self.numbered.len() == TABLE {
                        fits = false;
                        break 'rims;
                    }
                    self.numbers[slot] = self.numbered.len() as u8;
                    self.numbered.push(slot as u32);
                }
                *number = self.numbers[slot] as usize;
            }
            // A sphere with n corners has 2 n - 4 facets: they fit a byte.
            let [a, b, c] = numbers;
            self.table[a * TABLE + b] = facet as u8;
            self.table[b * TABLE + c] = facet as u8;
            self.table[c * TABLE + a] = facet as u8;
        }
        if fits {
            for (rim, &id) in self.rims.iter().zip(&self.fresh) {
                let facet = FACETS[rim.at];
                let [a, b, c] =
                    facet.map(|k| self.numbers[(rim.corners[k] as usize).min(ghost)] as usize);
                let own = &mut self.neighbors[id as usize];
                own[facet[2]] = self.fresh[self.table[b * TABLE + a] as usize];
                own[facet[0]] = self.fresh[self.table[c * TABLE + b] as usize];
                own[facet[1]] = self.fresh[self.table[a * TABLE + c] as usize];
            }
        }
        for &slot in &self.numbered {
            self.numbers[slot as usize] = NO_NUMBER;
        }
        fits
    }

    #[cold]
    fn join_by_sorting(&mut self) {
        let mut edges: Vec<((u32, u32), u32, usize)> = Vec::with_capacity(3 * self.rims.len());
        for (rim, &id) in self.rims.iter().zip(&self.fresh) {
            let facet = FACETS[rim.at];
            for k in 0..3 {
                let (a, b) = (rim.corners[facet[k]], rim.corners[facet[(k + 1) % 3]]);
                edges.push(((a.min(b), a.max(b)), id, facet[(k + 2) % 3]));
            }
        }
        edges.sort_unstable();
        for pair in edges.chunks_exact(2) {
            let [(_, a, a_at), (_, b, b_at)] = [pair[0], pair[1]];
            self.neighbors[a as usize][a_at] = b;
            self.neighbors[b as usize][b_at] = a;
        }
    }

    /// Points, cells and neighbours, without the cells that are no more.
    fn finish(mut self) -> (Vec<DVec3>, Vec<[u32; 4]>, Vec<[u32; 4]>) {
        self.free.sort_unstable();
        while let Some(hole) = self.free.pop() {
            let last = self.cells.len() as u32 - 1;
            if hole != last {
                self.cells[hole as usize] = self.cells[last as usize];
                let neighbors = self.neighbors[last as usize];
                self.neighbors[hole as usize] = neighbors;
                for n in neighbors {
                    let at = place(&self.neighbors[n as usize], last);
                    self.neighbors[n as usize][at] = hole;
                }
            }
            self.cells.pop();
            self.neighbors.pop();
        }
        (self.points, self.cells, self.neighbors)
    }
}

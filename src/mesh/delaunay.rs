//! The Delaunay triangulation of points in space.
//!
//! Points enter one by one along a Hilbert curve in rounds ([`super::build`]). All signs are exact, and cospherical points are told apart by a
//! perturbation that depends on coordinates alone: the triangulation is a function of the set of points, whatever their order and the number of
//! threads, with no flat cell in it.

use glam::DVec3;

use super::build::build;
use super::curve::{along_hilbert_curve, in_rounds};
use super::predicates::{Signs, collinear};

/// The vertex at infinity: a cell with it stands outside a facet of the convex hull.
pub const GHOST: u32 = u32::MAX;

/// The facet opposite to each corner, from its positive side seen so that [`Signs::orient`] of facet and corner is positive.
pub const FACETS: [[usize; 3]; 4] = [[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]];

/// Why there is no triangulation in space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DelaunayError {
    /// The points span less than space: a plane, a line or a point.
    #[error(
        "points: {distinct} distinct ones, all in one {}, expected a body in space; scan further sides of the part",
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
/// Memory: 32 bytes a cell (about 70 while cells are sorted), some 6.6 cells a point on a surface; 32 bytes a point.
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
    /// Corners of each cell, [`Signs::orient`] of them positive; one of them may be [`GHOST`]. Sorted: first by the lowest corner.
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
        let (order, rounds) = in_rounds(points.len());
        let first = first_cell(&points, &order)?;
        let (points, cells, neighbors) = build(points, first, &order, &rounds);
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
pub(super) fn place(of: &[u32; 4], what: u32) -> usize {
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

//! Exact signs of determinants: which side of a plane, which side of a sphere.
//!
//! A floating-point filter answers most questions; `robust` (Shewchuk 1997) answers the rest exactly. Both hold where no product of five
//! coordinate differences over- or underflows; [`super::delaunay`] scales its points so that none can.

use glam::{DVec2, DVec3};
use robust::{Coord, Coord3D};

/// Bound of the rounding error of [`Signs::orient`] over the product of the largest differences along x, y and z.
///
/// Shewchuk's (7 + 56 u) u times the permanent, u = 2^-53, and the permanent is at most six such products; rounded up for the
/// bound's own four roundings.
const ORIENT_ERROR: f64 = 4.7e-15;

/// The same for [`Signs::in_sphere`], times the square of the largest difference: (16 + 224 u) u times 4 · 3 · 6 such products.
const IN_SPHERE_ERROR: f64 = 1.29e-13;

fn coord(p: DVec3) -> Coord3D<f64> {
    Coord3D {
        x: p.x,
        y: p.y,
        z: p.z,
    }
}

/// Signs for one set of points.
#[derive(Debug, Clone, Copy, Default)]
pub struct Signs {
    /// Differences up to this are so few steps of the grid on which all coordinates lie that floating point computes
    /// [`Signs::in_sphere`] of them without rounding.
    exact: f64,
}

impl Signs {
    /// Looks for the grid on which all coordinates of `points` lie: a common one of scan lines and counted steps.
    pub fn of(points: &[DVec3]) -> Self {
        // Products of five differences of at most n steps, 72 of them, stay below 2^53 steps for n up to 660.
        const STEPS: f64 = 512.0;
        let grain = |x: f64| match x.to_bits() {
            bits if bits << 1 == 0 => i64::MAX,
            bits => (bits >> 52 & 0x7ff) as i64 + (bits | 1 << 52).trailing_zeros() as i64 - 1075,
        };
        let least = points
            .iter()
            .flat_map(|p| p.to_array())
            .map(grain)
            .min()
            .unwrap_or(i64::MAX);
        let exact = STEPS * 2f64.powi(least.clamp(-1000, 1000) as i32);
        Self { exact }
    }

    /// Positive where `d` lies on the side of the plane through `a`, `b`, `c` from which they are seen clockwise; zero where the four
    /// are coplanar. Only the sign means anything.
    #[inline]
    pub fn orient(&self, a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
        let (ad, bd, cd) = (a - d, b - d, c - d);
        let det = ad.z * (bd.x * cd.y - cd.x * bd.y)
            + bd.z * (cd.x * ad.y - ad.x * cd.y)
            + cd.z * (ad.x * bd.y - bd.x * ad.y);
        let most = ad.abs().max(bd.abs()).max(cd.abs());
        let product = most.x * most.y * most.z;
        // No product: all four in one plane across an axis, for differences never underflow to zero.
        if det.abs() > ORIENT_ERROR * product || product == 0.0 || most.max_element() <= self.exact
        {
            return det;
        }
        robust::orient3d(coord(a), coord(b), coord(c), coord(d))
    }

    /// Positive where `p` lies inside the sphere through `a`, `b`, `c`, `d`, for which [`Signs::orient`] is positive; zero on the
    /// sphere. Only the sign means anything.
    #[inline]
    pub fn in_sphere(&self, [a, b, c, d]: [DVec3; 4], p: DVec3) -> f64 {
        let (ae, be, ce, de) = (a - p, b - p, c - p, d - p);
        let ab = ae.x * be.y - be.x * ae.y;
        let bc = be.x * ce.y - ce.x * be.y;
        let cd = ce.x * de.y - de.x * ce.y;
        let da = de.x * ae.y - ae.x * de.y;
        let ac = ae.x * ce.y - ce.x * ae.y;
        let bd = be.x * de.y - de.x * be.y;
        let abc = ae.z * bc - be.z * ac + ce.z * ab;
        let bcd = be.z * cd - ce.z * bd + de.z * bc;
        let cda = ce.z * da + de.z * ac + ae.z * cd;
        let dab = de.z * ab + ae.z * bd + be.z * da;
        let det = (de.length_squared() * abc - ce.length_squared() * dab)
            + (be.length_squared() * cda - ae.length_squared() * bcd);
        let most = ae.abs().max(be.abs()).max(ce.abs().max(de.abs()));
        let largest = most.max_element();
        let bound = IN_SPHERE_ERROR * (most.x * most.y * most.z) * (largest * largest);
        if det.abs() > bound || largest <= self.exact {
            return det;
        }
        robust::insphere(coord(a), coord(b), coord(c), coord(d), coord(p))
    }

    /// Whether `p` lies inside the sphere through the corners of a positively oriented cell, a point on the sphere being sent to one side.
    ///
    /// The points are thought of as lifted by infinitely small amounts, the more the later they come in the order of x, y, z; so the answers
    /// to all questions fit one another, and the triangulation depends on the set of points alone (Devillers and Teillaud, *Perturbations
    /// for Delaunay and weighted Delaunay 3D triangulations*, 2011). All five points are distinct.
    #[inline]
    pub fn in_sphere_perturbed(&self, corners: [DVec3; 4], p: DVec3) -> bool {
        let side = self.in_sphere(corners, p);
        if side != 0.0 {
            return side > 0.0;
        }
        self.on_sphere(corners, p)
    }

    #[cold]
    fn on_sphere(&self, corners: [DVec3; 4], p: DVec3) -> bool {
        const P: usize = 4;
        let all = [corners[0], corners[1], corners[2], corners[3], p];
        let mut order = [0, 1, 2, 3, P];
        order.sort_unstable_by(|&i, &j| compare(all[j], all[i]));
        for &i in &order[..3] {
            if i == P {
                // The lift of `p` alone moves it out of the sphere.
                return false;
            }
            // The lift of corner `i` moves the sphere over `p` if both lie on one side of the other three corners.
            let mut replaced = corners;
            replaced[i] = p;
            let side = self.orient(replaced[0], replaced[1], replaced[2], replaced[3]);
            if side != 0.0 {
                return side > 0.0;
            }
        }
        false
    }
}

/// The order of x, then y, then z.
pub fn compare(a: DVec3, b: DVec3) -> std::cmp::Ordering {
    (a.x.total_cmp(&b.x))
        .then(a.y.total_cmp(&b.y))
        .then(a.z.total_cmp(&b.z))
}

/// Whether three points lie exactly on one line.
pub fn collinear(a: DVec3, b: DVec3, c: DVec3) -> bool {
    let area = |a: DVec2, b: DVec2, c: DVec2| {
        let coord = |p: DVec2| Coord { x: p.x, y: p.y };
        robust::orient2d(coord(a), coord(b), coord(c))
    };
    let flat = |f: fn(DVec3) -> DVec2| area(f(a), f(b), f(c)) == 0.0;
    flat(|p| DVec2::new(p.x, p.y))
        && flat(|p| DVec2::new(p.y, p.z))
        && flat(|p| DVec2::new(p.z, p.x))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIGNS: Signs = Signs { exact: 0.0 };

    const CELL: [DVec3; 4] = [
        DVec3::ZERO,
        DVec3::new(0.0, 1.0, 0.0),
        DVec3::new(1.0, 0.0, 0.0),
        DVec3::new(0.0, 0.0, 1.0),
    ];

    #[test]
    fn signs_are_those_of_the_definition() {
        assert!(SIGNS.orient(CELL[0], CELL[1], CELL[2], CELL[3]) > 0.0);
        assert!(SIGNS.in_sphere(CELL, DVec3::splat(0.3)) > 0.0);
        assert!(SIGNS.in_sphere(CELL, DVec3::splat(1.1)) < 0.0);
        assert_eq!(SIGNS.in_sphere(CELL, DVec3::ONE), 0.0);
        assert_eq!(
            SIGNS.orient(CELL[0], CELL[1], CELL[2], DVec3::new(7.0, 3.0, 0.0)),
            0.0
        );
    }

    #[test]
    fn the_filter_never_contradicts_the_exact_sign() {
        // Points a few units in the last place off a plane and off a sphere.
        let tiny = f64::EPSILON;
        for i in -40..40i32 {
            for j in -3..3i32 {
                let p = DVec3::new(0.4, 0.6, f64::from(i) * tiny * 0.01 + f64::from(j) * 1e-18);
                let exact =
                    robust::orient3d(coord(CELL[0]), coord(CELL[1]), coord(CELL[2]), coord(p));
                assert_eq!(
                    SIGNS.orient(CELL[0], CELL[1], CELL[2], p).partial_cmp(&0.0),
                    exact.partial_cmp(&0.0)
                );
                let q = DVec3::ONE + DVec3::new(0.0, f64::from(j), f64::from(i)) * tiny;
                let [a, b, c, d] = CELL.map(coord);
                let exact = robust::insphere(a, b, c, d, coord(q));
                assert_eq!(
                    SIGNS.in_sphere(CELL, q).partial_cmp(&0.0),
                    exact.partial_cmp(&0.0)
                );
            }
        }
    }

    #[test]
    fn cospherical_points_are_sent_to_one_side_whatever_the_order_of_the_corners() {
        // The eight corners of a cube: for each cell among them and each point, even permutations of the cell agree.
        let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64);
        let mut asked = 0;
        for code in 0..4096usize {
            let [a, b, c, d] = [code & 7, code >> 3 & 7, code >> 6 & 7, code >> 9].map(corner);
            if SIGNS.orient(a, b, c, d) <= 0.0 {
                continue;
            }
            for p in (0..8).map(corner).filter(|p| ![a, b, c, d].contains(p)) {
                let side = SIGNS.in_sphere_perturbed([a, b, c, d], p);
                assert_eq!(side, SIGNS.in_sphere_perturbed([b, c, a, d], p));
                assert_eq!(side, SIGNS.in_sphere_perturbed([b, a, d, c], p));
                asked += 1;
            }
        }
        assert!(asked > 1000);
        assert!(collinear(DVec3::ZERO, DVec3::ONE, DVec3::splat(0.3)));
        assert!(!collinear(
            DVec3::ZERO,
            DVec3::ONE,
            DVec3::new(0.3, 0.3, 0.3 + 1e-16)
        ));
    }

    #[test]
    fn the_grid_of_the_points_is_found_and_changes_no_sign() {
        let steps: Vec<DVec3> = (0..64u8)
            .map(|i| DVec3::new(f64::from(i & 3), f64::from(i >> 2 & 3), f64::from(i >> 4)) * 0.375)
            .collect();
        let on_grid = Signs::of(&steps);
        assert_eq!(on_grid.exact, 512.0 * 0.375 / 3.0);
        assert!(Signs::of(&[DVec3::splat(0.1)]).exact < 1e-13);
        for i in 0..60 {
            for j in 0..64 {
                let cell = [
                    steps[i],
                    steps[(7 * i + 1) % 64],
                    steps[(11 * i + 5) % 64],
                    steps[(i * i + 3) % 64],
                ];
                let p = steps[j];
                let sign = |x: f64| x.partial_cmp(&0.0);
                assert_eq!(
                    sign(on_grid.in_sphere(cell, p)),
                    sign(SIGNS.in_sphere(cell, p))
                );
                assert_eq!(
                    sign(on_grid.orient(cell[0], cell[1], cell[2], p)),
                    sign(SIGNS.orient(cell[0], cell[1], cell[2], p))
                );
            }
        }
    }
}

//! Whether triangles cross or touch, with exact signs.

use glam::{DVec2, DVec3};
use robust::{Coord, orient2d};

use super::predicates::Signs;

/// Corners of a triangle: their numbers, by which shared ones are known, and places.
pub type Corners = ([u32; 3], [DVec3; 3]);

/// Whether two triangles, neither of them degenerate, have more in common than the corners, or the edge, that they share by number.
pub fn overlap(signs: &Signs, (own, p): &Corners, (other, q): &Corners) -> bool {
    let shared = own.map(|v| other.iter().position(|u| *u == v));
    match shared.iter().flatten().count() {
        0 => (0..3).any(|k| {
            touches(signs, [p[k], p[(k + 1) % 3]], q) || touches(signs, [q[k], q[(k + 1) % 3]], p)
        }),
        1 => {
            let i = (0..3).find(|k| shared[*k].is_some()).unwrap_or(0);
            let j = shared[i].unwrap_or(0);
            touches(signs, [p[(i + 1) % 3], p[(i + 2) % 3]], q)
                || touches(signs, [q[(j + 1) % 3], q[(j + 2) % 3]], p)
        }
        2 => {
            let i = (0..3).find(|k| shared[*k].is_none()).unwrap_or(0);
            let j = (0..3).find(|k| !own.contains(&other[*k])).unwrap_or(0);
            let (u, v) = (p[(i + 1) % 3], p[(i + 2) % 3]);
            if signs.orient(p[0], p[1], p[2], q[j]) != 0.0 {
                return false;
            }
            let flat = Flat::of(p);
            flat.side(u, v, p[i]) * flat.side(u, v, q[j]) > 0.0
        }
        _ => true,
    }
}

/// Whether a segment has a point in common with a triangle, its border included.
pub fn touches(signs: &Signs, [p, q]: [DVec3; 2], triangle: &[DVec3; 3]) -> bool {
    let [a, b, c] = *triangle;
    let (from, to) = (signs.orient(a, b, c, p), signs.orient(a, b, c, q));
    // Signs, not a product: that of two small volumes is zero.
    if (from > 0.0 && to > 0.0) || (from < 0.0 && to < 0.0) {
        return false;
    }
    if from == 0.0 && to == 0.0 {
        let flat = Flat::of(triangle);
        return flat.holds(triangle, p)
            || flat.holds(triangle, q)
            || (0..3).any(|k| flat.meet([p, q], [triangle[k], triangle[(k + 1) % 3]]));
    }
    let around = [(a, b), (b, c), (c, a)].map(|(x, y)| signs.orient(p, q, x, y));
    around.iter().all(|s| *s >= 0.0) || around.iter().all(|s| *s <= 0.0)
}

/// Whether a point lies in the tetrahedron of four points that are not coplanar, its border included.
pub fn is_within(signs: &Signs, [a, b, c, d]: [DVec3; 4], p: DVec3) -> bool {
    let sides = [
        signs.orient(a, b, c, p),
        signs.orient(a, c, d, p),
        signs.orient(a, d, b, p),
        signs.orient(b, d, c, p),
    ];
    sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0)
}

/// Whether the diagonals `ab` and `cd` of four coplanar points cross each other inside both.
pub fn diagonals_cross(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> bool {
    let flat = Flat::of(&[a, b, c]);
    flat.side(a, b, c) * flat.side(a, b, d) < 0.0 && flat.side(c, d, a) * flat.side(c, d, b) < 0.0
}

/// A plane seen along one of the axes, so that a triangle in it does not degenerate.
struct Flat {
    axis: usize,
}

impl Flat {
    fn of(triangle: &[DVec3; 3]) -> Self {
        let [a, b, c] = *triangle;
        let n = (b - a).cross(c - a).abs().to_array();
        let mut axes = [0, 1, 2];
        axes.sort_by(|i, j| n[*j].total_cmp(&n[*i]));
        let is_seen = |axis: &usize| Self { axis: *axis }.side(a, b, c) != 0.0;
        let axis = axes.into_iter().find(is_seen).unwrap_or(axes[0]);
        Self { axis }
    }

    /// The sign of the sense in which three points are passed through: -1, 0 or 1.
    fn side(&self, a: DVec3, b: DVec3, c: DVec3) -> f64 {
        let at = |p: DVec3| {
            let q = match self.axis {
                0 => DVec2::new(p.y, p.z),
                1 => DVec2::new(p.z, p.x),
                _ => DVec2::new(p.x, p.y),
            };
            Coord { x: q.x, y: q.y }
        };
        let area = orient2d(at(a), at(b), at(c));
        if area == 0.0 { 0.0 } else { area.signum() }
    }

    /// Whether the triangle, its border included, holds a point of its plane.
    fn holds(&self, triangle: &[DVec3; 3], p: DVec3) -> bool {
        let sides = [0, 1, 2].map(|k| self.side(triangle[k], triangle[(k + 1) % 3], p));
        sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0)
    }

    /// Whether two segments have a point in common, where neither end of the first lies on the second.
    fn meet(&self, [p, q]: [DVec3; 2], [a, b]: [DVec3; 2]) -> bool {
        let (from, to) = (self.side(a, b, p), self.side(a, b, q));
        let (first, second) = (self.side(p, q, a), self.side(p, q, b));
        if from == 0.0 && to == 0.0 {
            // All on one line.
            return p.min(q).cmple(a).all() && a.cmple(p.max(q)).all();
        }
        from * to <= 0.0 && first * second <= 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangles_overlap_beyond_what_they_share() {
        // Ids are places of a small lattice, so that shared corners are equal ones.
        let at = |i: u32| DVec3::new(f64::from(i % 5), f64::from(i / 5 % 5), f64::from(i / 25));
        let signs = Signs::of(&(0..125).map(at).collect::<Vec<_>>());
        let v = |x: u32, y: u32, z: u32| x + 5 * y + 25 * z;
        let made = |ids: [u32; 3]| (ids, ids.map(at));
        let floor = made([v(0, 0, 1), v(4, 0, 1), v(0, 4, 1)]);
        for (other, expected) in [
            // Apart, through, touching with a corner, in the plane beside and upon.
            ([v(0, 0, 2), v(4, 0, 2), v(0, 4, 2)], false),
            ([v(1, 1, 0), v(1, 1, 2), v(2, 1, 2)], true),
            ([v(1, 1, 1), v(1, 1, 2), v(2, 1, 2)], true),
            ([v(4, 4, 1), v(4, 1, 1), v(3, 4, 1)], false),
            ([v(4, 4, 1), v(2, 2, 1), v(3, 4, 1)], true),
            ([v(4, 4, 1), v(1, 1, 1), v(4, 2, 1)], true),
            // One corner shared: away, through, along the plane.
            ([v(0, 0, 1), v(0, 0, 2), v(1, 1, 2)], false),
            ([v(0, 0, 1), v(2, 2, 0), v(2, 2, 2)], true),
            ([v(0, 0, 1), v(4, 4, 1), v(4, 3, 1)], true),
            ([v(4, 0, 1), v(4, 4, 1), v(3, 4, 1)], false),
            // An edge shared: bent, opposite, folded over.
            ([v(0, 0, 1), v(4, 0, 1), v(0, 4, 2)], false),
            ([v(4, 0, 1), v(0, 4, 1), v(4, 4, 1)], false),
            ([v(4, 0, 1), v(0, 4, 1), v(1, 1, 1)], true),
        ] {
            assert_eq!(overlap(&signs, &floor, &made(other)), expected, "{other:?}");
            assert_eq!(overlap(&signs, &made(other), &floor), expected, "{other:?}");
        }
        let cell = [v(0, 0, 0), v(4, 0, 0), v(0, 4, 0), v(0, 0, 4)].map(at);
        assert!(is_within(&signs, cell, at(v(1, 1, 1))) && is_within(&signs, cell, at(v(2, 2, 0))));
        assert!(!is_within(&signs, cell, at(v(2, 2, 2))));
        let square = [v(0, 0, 0), v(2, 2, 0), v(2, 0, 0), v(0, 2, 0)].map(at);
        let [a, b, c, d] = square;
        assert!(diagonals_cross(a, b, c, d) && !diagonals_cross(a, c, b, d));
        assert!(!diagonals_cross(a, b, c, at(v(1, 1, 0))));
    }
}

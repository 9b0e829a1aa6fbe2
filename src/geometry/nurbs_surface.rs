//! Rational B-spline surfaces.

use glam::{DVec3, DVec4};

use super::RigidTransform;
use super::basis::{Basis, Knots};
use super::newton::{Range, SurfaceDerivatives, nearest_on_surface};
use super::nurbs_curve::{NurbsError, homogeneous};

/// A rational B-spline surface of any degrees up to [`super::basis::MAX_DEGREE`], mm.
#[derive(Debug, Clone, PartialEq)]
pub struct NurbsSurface {
    knots_u: Knots,
    knots_v: Knots,
    /// Control points times weight, and the weight; rows of constant u, one after the other.
    points: Vec<DVec4>,
    rational: bool,
    closed: [bool; 2],
    cells: Cells,
}

/// A grid of patches of the surface, each inside a ball, for the global search.
#[derive(Debug, Clone, PartialEq, Default)]
struct Cells {
    u: Vec<f64>,
    v: Vec<f64>,
    centres: Vec<DVec3>,
    radii: Vec<f64>,
}

/// Degrees and knots (multiplicities expanded) of the two directions.
#[derive(Debug, Clone, PartialEq)]
pub struct NurbsShape {
    /// Degree in u and in v.
    pub degrees: [usize; 2],
    /// Count of control points in u and in v.
    pub counts: [usize; 2],
    /// Knots in u and in v.
    pub knots: [Vec<f64>; 2],
}

impl NurbsSurface {
    /// The surface of these control points, given row by row with v running fastest; no `weights` means all equal.
    pub fn new(
        shape: NurbsShape,
        points: &[DVec3],
        weights: Option<&[f64]>,
    ) -> Result<Self, NurbsError> {
        let [ku, kv] = shape.knots;
        let knots_u = Knots::new(shape.degrees[0], shape.counts[0], ku)?;
        let knots_v = Knots::new(shape.degrees[1], shape.counts[1], kv)?;
        if points.len() != shape.counts[0] * shape.counts[1] {
            return Err(NurbsError::WeightCount {
                weights: shape.counts[0] * shape.counts[1],
                points: points.len(),
            });
        }
        let (points, rational) = homogeneous(points, weights)?;
        let mut surface = Self {
            knots_u,
            knots_v,
            points,
            rational,
            closed: [false; 2],
            cells: Cells::default(),
        };
        surface.closed = surface.find_closed();
        surface.cells = surface.search_cells();
        Ok(surface)
    }

    /// Knot vectors of u and v.
    pub fn knots(&self) -> [&Knots; 2] {
        [&self.knots_u, &self.knots_v]
    }

    /// Control points with their weights, v running fastest.
    pub fn control_points(&self) -> impl ExactSizeIterator<Item = (DVec3, f64)> + '_ {
        self.points.iter().map(|p| (p.truncate() / p.w, p.w))
    }

    /// Ranges of u and v, closed where the surface meets itself.
    pub fn ranges(&self) -> [Range; 2] {
        let range = |k: &Knots, closed| {
            let (from, to) = k.domain();
            Range { from, to, closed }
        };
        [
            range(&self.knots_u, self.closed[0]),
            range(&self.knots_v, self.closed[1]),
        ]
    }

    /// Position at parameters, brought into the domain.
    pub fn point(&self, u: f64, v: f64) -> DVec3 {
        let (u, v) = self.bring(u, v);
        let (su, sv) = (self.knots_u.span(u), self.knots_v.span(v));
        let (nu, nv) = (self.knots_u.values(su, u), self.knots_v.values(sv, v));
        let (p, q, stride) = (
            self.knots_u.degree(),
            self.knots_v.degree(),
            self.knots_v.points(),
        );
        let mut sum = DVec4::ZERO;
        for (i, b) in nu[..=p].iter().enumerate() {
            let start = (su - p + i) * stride + sv - q;
            let row = &self.points[start..=start + q];
            let mut inner = DVec4::ZERO;
            for (c, point) in nv[..=q].iter().zip(row) {
                inner += *point * *c;
            }
            sum += inner * *b;
        }
        if self.rational {
            sum.truncate() / sum.w
        } else {
            sum.truncate()
        }
    }

    /// Position and derivatives to second order at parameters, brought into the domain.
    pub fn derivatives(&self, u: f64, v: f64) -> SurfaceDerivatives {
        let (u, v) = self.bring(u, v);
        let (su, sv) = (self.knots_u.span(u), self.knots_v.span(v));
        let nu = self.knots_u.derivatives(su, u);
        let nv = self.knots_v.derivatives(sv, v);
        let [s, du, dv, duu, duv, dvv] = self.sums(su, sv, &nu, &nv);
        if !self.rational {
            return SurfaceDerivatives {
                point: s.truncate(),
                du: du.truncate(),
                dv: dv.truncate(),
                duu: duu.truncate(),
                duv: duv.truncate(),
                dvv: dvv.truncate(),
            };
        }
        // Derivatives of the quotient (The NURBS Book, equation 4.20).
        let w = s.w.recip();
        let point = s.truncate() * w;
        let p_u = (du.truncate() - point * du.w) * w;
        let p_v = (dv.truncate() - point * dv.w) * w;
        SurfaceDerivatives {
            point,
            du: p_u,
            dv: p_v,
            duu: (duu.truncate() - p_u * (2.0 * du.w) - point * duu.w) * w,
            duv: (duv.truncate() - p_u * dv.w - p_v * du.w - point * duv.w) * w,
            dvv: (dvv.truncate() - p_v * (2.0 * dv.w) - point * dvv.w) * w,
        }
    }

    /// Parameters of the nearest point and its distance: from the hint alone, or over the whole surface without one.
    pub fn nearest(&self, p: DVec3, near: Option<(f64, f64)>) -> ((f64, f64), f64) {
        let ranges = self.ranges();
        let refine = |uv| nearest_on_surface(|u, v| self.derivatives(u, v), p, uv, ranges);
        if let Some(uv) = near {
            let (uv, d2) = refine(uv);
            return (uv, d2.sqrt());
        }
        let cells = &self.cells;
        let d2 = |i: usize| cells.centres[i].distance_squared(p);
        let mut first = (0, d2(0));
        for i in 1..cells.centres.len() {
            let d = d2(i);
            if d < first.1 {
                first = (i, d);
            }
        }
        let mut best = refine(cells.uv(first.0));
        let mut reach = best.1.sqrt();
        for i in 0..cells.centres.len() {
            let bound = reach + cells.radii[i];
            let d = d2(i);
            if d < bound * bound && i != first.0 {
                let found = refine(cells.uv(i));
                if found.1 < best.1 {
                    best = found;
                    reach = best.1.sqrt();
                }
            }
        }
        (best.0, reach)
    }

    /// The surface moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        let mut moved = self.clone();
        for p in &mut moved.points {
            *p = (by.rotation * p.truncate() + by.translation * p.w).extend(p.w);
        }
        for c in &mut moved.cells.centres {
            *c = by.point(*c);
        }
        moved
    }

    #[inline]
    fn bring(&self, u: f64, v: f64) -> (f64, f64) {
        let [ru, rv] = self.ranges();
        (ru.bring(u), rv.bring(v))
    }

    /// Homogeneous sums of S, Su, Sv, Suu, Suv, Svv.
    #[inline]
    fn sums(&self, su: usize, sv: usize, nu: &[Basis; 3], nv: &[Basis; 3]) -> [DVec4; 6] {
        let (p, q, stride) = (
            self.knots_u.degree(),
            self.knots_v.degree(),
            self.knots_v.points(),
        );
        let mut out = [DVec4::ZERO; 6];
        let [value_u, first_u, second_u] = nu;
        let weights = value_u.iter().zip(first_u).zip(second_u);
        for (i, ((w, dw), ddw)) in weights.enumerate().take(p + 1) {
            let start = (su - p + i) * stride + sv - q;
            let row = &self.points[start..=start + q];
            let (mut a, mut da, mut dda) = (DVec4::ZERO, DVec4::ZERO, DVec4::ZERO);
            for (j, point) in row.iter().enumerate() {
                a += *point * nv[0][j];
                da += *point * nv[1][j];
                dda += *point * nv[2][j];
            }
            out[0] += a * *w;
            out[1] += a * *dw;
            out[2] += da * *w;
            out[3] += a * *ddw;
            out[4] += da * *dw;
            out[5] += dda * *w;
        }
        out
    }

    fn find_closed(&self) -> [bool; 2] {
        let [(u0, u1), (v0, v1)] = [self.knots_u.domain(), self.knots_v.domain()];
        let at = |from: f64, to: f64, k: usize| from + (to - from) * k as f64 / 12.0;
        let mut gap = [0.0f64; 2];
        let mut size = 0.0f64;
        let centre = self.point(0.5 * (u0 + u1), 0.5 * (v0 + v1));
        for k in 0..=12 {
            let (u, v) = (at(u0, u1, k), at(v0, v1, k));
            let ends = [
                self.point(u0, v),
                self.point(u1, v),
                self.point(u, v0),
                self.point(u, v1),
            ];
            gap[0] = gap[0].max(ends[0].distance(ends[1]));
            gap[1] = gap[1].max(ends[2].distance(ends[3]));
            size = ends.iter().map(|e| e.distance(centre)).fold(size, f64::max);
        }
        // Writers round coordinates to 1e-7 of the size and worse.
        gap.map(|g| g <= 1e-6 * size)
    }

    fn search_cells(&self) -> Cells {
        let nodes = |k: &Knots| {
            let breaks = k.breaks();
            let spans = breaks.len() - 1;
            let pieces = if k.degree() == 1 && spans > 2 {
                1
            } else {
                (8usize).div_ceil(spans).max(2)
            };
            let mut nodes = Vec::with_capacity(2 * pieces * spans + 1);
            for w in breaks.windows(2) {
                // Two steps a cell: border, middle.
                nodes.extend(
                    (0..2 * pieces).map(|i| w[0] + (w[1] - w[0]) * i as f64 / (2 * pieces) as f64),
                );
            }
            nodes.push(breaks[spans]);
            nodes
        };
        let (nu, nv) = (nodes(&self.knots_u), nodes(&self.knots_v));
        let mut rows: Vec<Vec<DVec3>> = Vec::with_capacity(nu.len());
        for u in &nu {
            rows.push(nv.iter().map(|v| self.point(*u, *v)).collect());
        }
        let mut cells = Cells {
            u: nu.iter().copied().skip(1).step_by(2).collect(),
            v: nv.iter().copied().skip(1).step_by(2).collect(),
            ..Cells::default()
        };
        for i in 0..cells.u.len() {
            for j in 0..cells.v.len() {
                let centre = rows[2 * i + 1][2 * j + 1];
                let radius = rows[2 * i..=2 * i + 2]
                    .iter()
                    .flat_map(|row| &row[2 * j..=2 * j + 2])
                    .map(|p| p.distance(centre))
                    .fold(0.0, f64::max);
                cells.centres.push(centre);
                // A cell spans a part of one polynomial piece: between its nine samples it bulges by less than a quarter.
                cells.radii.push(1.25 * radius);
            }
        }
        cells
    }
}

impl Cells {
    fn uv(&self, i: usize) -> (f64, f64) {
        (self.u[i / self.v.len()], self.v[i % self.v.len()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_1_SQRT_2;

    /// An eighth of the unit sphere as a rational biquadratic patch with a pole (Piegl and Tiller, section 8.2).
    fn octant() -> NurbsSurface {
        let arc = [(1.0, 0.0, 1.0), (1.0, 1.0, FRAC_1_SQRT_2), (0.0, 1.0, 1.0)];
        let mut points = Vec::new();
        let mut weights = Vec::new();
        for (x, y, w) in arc {
            for (r, z, v) in arc {
                points.push(DVec3::new(r * x, r * y, z));
                weights.push(w * v);
            }
        }
        let knots = vec![0., 0., 0., 1., 1., 1.];
        let shape = NurbsShape {
            degrees: [2, 2],
            counts: [3, 3],
            knots: [knots.clone(), knots],
        };
        NurbsSurface::new(shape, &points, Some(&weights)).expect("a patch")
    }

    /// A bicubic surface with hills, 6 x 5 control points.
    fn hills() -> NurbsSurface {
        let mut points = Vec::new();
        for i in 0..6 {
            for j in 0..5 {
                let (x, y) = (f64::from(i) * 10.0, f64::from(j) * 8.0);
                points.push(DVec3::new(x, y, 9.0 * (0.21 * x).sin() * (0.19 * y).cos()));
            }
        }
        let shape = NurbsShape {
            degrees: [3, 3],
            counts: [6, 5],
            knots: [
                vec![0., 0., 0., 0., 0.3, 0.7, 1., 1., 1., 1.],
                vec![0., 0., 0., 0., 2., 3., 3., 3., 3.],
            ],
        };
        NurbsSurface::new(shape, &points, None).expect("a surface")
    }

    #[test]
    fn the_rational_octant_is_a_sphere() {
        let s = octant();
        for i in 0..=10 {
            for j in 0..=10 {
                let (u, v) = (f64::from(i) * 0.1, f64::from(j) * 0.1);
                let d = s.derivatives(u, v);
                assert!((d.point.length() - 1.0).abs() < 1e-14);
                assert!(d.point.dot(d.du).abs() < 1e-13 && d.point.dot(d.dv).abs() < 1e-13);
                // |S|^2 = 1 differentiated twice.
                assert!((d.point.dot(d.duu) + d.du.length_squared()).abs() < 1e-12);
                assert!((d.point.dot(d.duv) + d.du.dot(d.dv)).abs() < 1e-12);
                assert!((d.point.dot(d.dvv) + d.dv.length_squared()).abs() < 1e-12);
                assert!((s.point(u, v) - d.point).length() < 1e-15);
            }
        }
    }

    #[test]
    fn the_nearest_point_of_the_octant_is_on_the_ray_from_its_centre() {
        let s = octant();
        for k in 1..40 {
            let a = f64::from(k) * 0.039;
            let ray = DVec3::new(a.cos() * 0.8, a.sin() * 0.8, 0.6);
            let (_, d) = s.nearest(ray * 1.7, None);
            assert!((d - 0.7).abs() < 1e-12);
            let (uv, _) = s.nearest(ray * 0.6, None);
            assert!((s.point(uv.0, uv.1) - ray).length() < 1e-7);
        }
    }

    #[test]
    fn derivatives_agree_with_central_differences() {
        let s = hills();
        let h = 1e-5;
        for (u, v) in [(0.13, 0.4), (0.5, 1.9), (0.85, 2.7)] {
            let d = s.derivatives(u, v);
            let by = |du: f64, dv: f64| s.derivatives(u + du, v + dv);
            // Truncation h^2 times third derivatives of 1e4; rounding 1e-14 / h.
            let close = |a: DVec3, b: DVec3| (a - b).length() < 1e-5 * (1.0 + a.length());
            assert!(close(
                d.du,
                (by(h, 0.0).point - by(-h, 0.0).point) / (2.0 * h)
            ));
            assert!(close(
                d.dv,
                (by(0.0, h).point - by(0.0, -h).point) / (2.0 * h)
            ));
            assert!(close(d.duu, (by(h, 0.0).du - by(-h, 0.0).du) / (2.0 * h)));
            assert!(close(d.duv, (by(0.0, h).du - by(0.0, -h).du) / (2.0 * h)));
            assert!(close(d.dvv, (by(0.0, h).dv - by(0.0, -h).dv) / (2.0 * h)));
        }
    }

    #[test]
    fn the_cold_search_never_misses_what_sampling_finds() {
        let s = hills();
        let grid = 160;
        let samples: Vec<DVec3> = (0..=grid)
            .flat_map(|i| (0..=grid).map(move |j| (i, j)))
            .map(|(i, j)| s.point(f64::from(i) / 160.0, 3.0 * f64::from(j) / 160.0))
            .collect();
        for k in 0..400 {
            let a = f64::from(k);
            let p = DVec3::new(
                25.0 + 40.0 * (1.7 * a).sin(),
                16.0 + 30.0 * (2.3 * a).cos(),
                25.0 * (0.9 * a).sin(),
            );
            let sampled = samples
                .iter()
                .map(|q| q.distance(p))
                .fold(f64::INFINITY, f64::min);
            let (uv, d) = s.nearest(p, None);
            assert!(d <= sampled + 1e-9, "{p}: {d}, but a sample at {sampled}");
            assert!((s.point(uv.0, uv.1).distance(p) - d).abs() < 1e-12);
        }
    }
}

//! Rational B-spline surfaces.

use std::sync::OnceLock;

use glam::{DVec3, DVec4};
use rayon::prelude::*;

use super::RigidTransform;
use super::basis::{Basis, Knots};
use super::nets::Powers;
use super::newton::{Range, SurfaceDerivatives, nearest_on_surface};
use super::nurbs_curve::{NurbsError, homogeneous};
use super::pieces::Pieces;
use super::search::{Best, Search};

/// A rational B-spline surface of any degrees up to [`super::basis::MAX_DEGREE`], mm.
#[derive(Debug, Clone, PartialEq)]
pub struct NurbsSurface {
    knots_u: Knots,
    knots_v: Knots,
    /// Control points times weight, and the weight; rows of constant u, one after the other.
    points: Vec<DVec4>,
    rational: bool,
    closed: [bool; 2],
    pieces: [Pieces; 2],
    search: Tree,
}

/// The tree for the global search, made when it is first asked for.
#[derive(Debug, Clone, Default)]
struct Tree(OnceLock<Search>);

impl PartialEq for Tree {
    /// It follows from the surface: surfaces are the same with and without it.
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// Points of one block of a batch: each block is the same whatever the number of threads.
const BLOCK: usize = 512;

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
            pieces: [Pieces::new(&knots_u), Pieces::new(&knots_v)],
            knots_u,
            knots_v,
            points,
            rational,
            closed: [false; 2],
            search: Tree::default(),
        };
        surface.closed = surface.find_closed();
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
        let sums = match (self.knots_u.degree(), self.knots_v.degree()) {
            (1, 1) => self.second_sums::<2, 2>(u, v),
            (2, 2) => self.second_sums::<3, 3>(u, v),
            (3, 3) => self.second_sums::<4, 4>(u, v),
            (3, 1) => self.second_sums::<4, 2>(u, v),
            (1, 3) => self.second_sums::<2, 4>(u, v),
            (5, 5) => self.second_sums::<6, 6>(u, v),
            _ => {
                let (su, sv) = (self.knots_u.span(u), self.knots_v.span(v));
                let nu = self.knots_u.derivatives(su, u);
                let nv = self.knots_v.derivatives(sv, v);
                self.sums(su, sv, &nu, &nv)
            }
        };
        self.quotient(sums)
    }

    /// Position and derivatives by u and v at parameters, brought into the domain.
    pub fn first_derivatives(&self, u: f64, v: f64) -> [DVec3; 3] {
        let (u, v) = self.bring(u, v);
        let [s, du, dv] = match (self.knots_u.degree(), self.knots_v.degree()) {
            (1, 1) => self.first_sums::<2, 2>(u, v),
            (2, 2) => self.first_sums::<3, 3>(u, v),
            (3, 3) => self.first_sums::<4, 4>(u, v),
            (3, 1) => self.first_sums::<4, 2>(u, v),
            (1, 3) => self.first_sums::<2, 4>(u, v),
            (5, 5) => self.first_sums::<6, 6>(u, v),
            _ => {
                let d = self.derivatives(u, v);
                return [d.point, d.du, d.dv];
            }
        };
        if !self.rational {
            return [s.truncate(), du.truncate(), dv.truncate()];
        }
        let w = s.w.recip();
        let point = s.truncate() * w;
        [
            point,
            (du.truncate() - point * du.w) * w,
            (dv.truncate() - point * dv.w) * w,
        ]
    }

    /// [`Self::first_derivatives`] of many places, on all cores.
    pub fn first_derivatives_of(&self, places: &[(f64, f64)]) -> Vec<[DVec3; 3]> {
        let of = |(u, v): &(f64, f64)| self.first_derivatives(*u, *v);
        places.par_iter().with_min_len(BLOCK).map(of).collect()
    }

    /// Parameters of the nearest point and its distance: from the hint alone, or of the whole surface without one.
    ///
    /// Without a hint the answer is the global minimum, proved by bounds on every part of the surface.
    pub fn nearest(&self, p: DVec3, near: Option<(f64, f64)>) -> ((f64, f64), f64) {
        if let Some(uv) = near {
            let (uv, d2) = self.downhill(p, uv);
            return (uv, d2.sqrt());
        }
        let best = self.search(p, Best::NONE, &|_| true);
        (best.uv, best.d2.sqrt())
    }

    /// The nearest of the minima that are accepted and nearer than `limit_mm`: parameters and distance.
    pub fn nearest_where(
        &self,
        p: DVec3,
        limit_mm: f64,
        accept: impl Fn((f64, f64)) -> bool,
    ) -> Option<((f64, f64), f64)> {
        let limit = Best {
            d2: limit_mm * limit_mm,
            ..Best::NONE
        };
        let best = self.search(p, limit, &accept);
        (best.d2 < limit.d2).then(|| (best.uv, best.d2.sqrt()))
    }

    /// [`Self::nearest`] of many points, on all cores. Each search begins at the foot of the point before: points in the
    /// order of a scan are faster, those in any order are no less sure.
    pub fn nearest_of(&self, points: &[DVec3]) -> Vec<((f64, f64), f64)> {
        let block = |points: &[DVec3]| {
            let mut last: Option<(f64, f64)> = None;
            let found: Vec<_> = points
                .iter()
                .map(|p| {
                    let start = last.map_or(Best::NONE, |uv| {
                        let (uv, d2) = self.downhill(*p, uv);
                        Best { uv, d2 }
                    });
                    let best = self.search(*p, start, &|_| true);
                    last = Some(best.uv);
                    (best.uv, best.d2.sqrt())
                })
                .collect();
            found
        };
        points.par_chunks(BLOCK).flat_map_iter(block).collect()
    }

    fn downhill(&self, p: DVec3, from: (f64, f64)) -> ((f64, f64), f64) {
        nearest_on_surface(|u, v| self.derivatives(u, v), p, from, self.ranges())
    }

    fn search(&self, p: DVec3, best: Best, accept: &impl Fn((f64, f64)) -> bool) -> Best {
        if !p.is_finite() {
            return best;
        }
        let tree = self.search.0.get_or_init(|| Search::new(self));
        tree.nearest(self, p, best, accept)
    }

    /// Control points times weight, and the weight, v running fastest.
    pub(super) fn homogeneous(&self) -> &[DVec4] {
        &self.points
    }

    pub(super) fn is_rational(&self) -> bool {
        self.rational
    }

    /// One polynomial piece in powers; `None` where a degree is too high for that.
    pub(super) fn powers(&self, i: usize, j: usize) -> Option<Powers> {
        let [pu, pv] = self.pieces();
        let (cu, cv) = (pu.coefficients(i), pv.coefficients(j));
        if cu.is_empty() || cv.is_empty() {
            return None;
        }
        let (n, m) = (self.knots_u.degree() + 1, self.knots_v.degree() + 1);
        let (u, v) = (pu.span_of(i) + 1 - n, pv.span_of(j) + 1 - m);
        let side = super::pieces::MAX_DEGREE + 1;
        let mut out = [DVec4::ZERO; 36];
        for k in 0..n {
            let row = &self.points[(u + k) * self.knots_v.points() + v..][..m];
            for b in 0..m {
                let across = (row.iter().zip(&cv[b * m..])).map(|(p, c)| *p * *c);
                let across: DVec4 = across.sum();
                for a in 0..n {
                    out[a * side + b] += across * cu[a * n + k];
                }
            }
        }
        Some(Powers::new(out, self.rational))
    }

    pub(super) fn pieces(&self) -> [&Pieces; 2] {
        [&self.pieces[0], &self.pieces[1]]
    }

    /// The surface moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        let mut moved = self.clone();
        for p in &mut moved.points {
            *p = (by.rotation * p.truncate() + by.translation * p.w).extend(p.w);
        }
        moved.search = Tree::default();
        moved
    }

    #[inline]
    fn bring(&self, u: f64, v: f64) -> (f64, f64) {
        let [ru, rv] = self.ranges();
        (ru.bring(u), rv.bring(v))
    }

    /// Homogeneous sums of S, Su, Sv for degrees N - 1 and M - 1.
    #[inline]
    fn first_sums<const N: usize, const M: usize>(&self, u: f64, v: f64) -> [DVec4; 3] {
        let (iu, [nu, du]) = self.pieces[0].first::<N>(u);
        let (iv, [nv, dv]) = self.pieces[1].first::<M>(v);
        let stride = self.knots_v.points();
        let mut out = [DVec4::ZERO; 3];
        for i in 0..N {
            let row = &self.points[(iu + i) * stride + iv..][..M];
            let (mut a, mut da) = (DVec4::ZERO, DVec4::ZERO);
            for j in 0..M {
                a += row[j] * nv[j];
                da += row[j] * dv[j];
            }
            out[0] += a * nu[i];
            out[1] += a * du[i];
            out[2] += da * nu[i];
        }
        out
    }

    /// Homogeneous sums of S, Su, Sv, Suu, Suv, Svv for degrees N - 1 and M - 1.
    #[inline]
    fn second_sums<const N: usize, const M: usize>(&self, u: f64, v: f64) -> [DVec4; 6] {
        let (iu, [nu, du, ddu]) = self.pieces[0].second::<N>(u);
        let (iv, [nv, dv, ddv]) = self.pieces[1].second::<M>(v);
        let stride = self.knots_v.points();
        let mut out = [DVec4::ZERO; 6];
        for i in 0..N {
            let row = &self.points[(iu + i) * stride + iv..][..M];
            let (mut a, mut da, mut dda) = (DVec4::ZERO, DVec4::ZERO, DVec4::ZERO);
            for j in 0..M {
                a += row[j] * nv[j];
                da += row[j] * dv[j];
                dda += row[j] * ddv[j];
            }
            out[0] += a * nu[i];
            out[1] += a * du[i];
            out[2] += da * nu[i];
            out[3] += a * ddu[i];
            out[4] += da * du[i];
            out[5] += dda * nu[i];
        }
        out
    }

    /// Derivatives from their homogeneous sums (The NURBS Book, equation 4.20).
    #[inline]
    fn quotient(&self, [s, du, dv, duu, duv, dvv]: [DVec4; 6]) -> SurfaceDerivatives {
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

//! Exact conversion to rational B-splines, knot insertion and degree elevation.

use std::f64::consts::FRAC_PI_2;

use glam::{DVec3, DVec4};

use super::nurbs_surface::NurbsShape;
use super::sweep::SweepPath;
use super::{Curve, Frame, NurbsCurve, NurbsSurface, Surface};

/// Control points times weight, and the weight, with degree and knots: a curve before it is checked.
#[derive(Debug, Clone)]
struct Raw {
    degree: usize,
    points: Vec<DVec4>,
    knots: Vec<f64>,
}

impl Raw {
    fn of(curve: &NurbsCurve) -> Self {
        Self {
            degree: curve.knots().degree(),
            points: curve
                .control_points()
                .map(|(p, w)| (p * w).extend(w))
                .collect(),
            knots: curve.knots().as_slice().to_vec(),
        }
    }

    fn line(from: DVec3, to: DVec3, (a, b): (f64, f64)) -> Self {
        Self {
            degree: 1,
            points: vec![from.extend(1.0), to.extend(1.0)],
            knots: vec![a, a, b, b],
        }
    }

    /// `x cos t + y sin t` about a centre, from one angle to another.
    fn arc(centre: DVec3, x: DVec3, y: DVec3, (from, to): (f64, f64)) -> Self {
        // At most a quarter turn a piece keeps the weights above 0.7.
        let pieces = ((to - from).abs() / FRAC_PI_2 - 1e-9)
            .ceil()
            .clamp(1.0, 64.0) as usize;
        let half = 0.5 * (to - from) / pieces as f64;
        let at = |t: f64| x * t.cos() + y * t.sin();
        let mut points = vec![(centre + at(from)).extend(1.0)];
        let mut knots = vec![from; 3];
        for k in 0..pieces {
            let start = from + 2.0 * half * k as f64;
            let w = half.cos();
            // The corner of the tangents lies 1 / w out.
            points.push((centre * w + at(start + half)).extend(w));
            points.push((centre + at(start + 2.0 * half)).extend(1.0));
            knots.extend([start + 2.0 * half; 2]);
        }
        knots.push(to);
        let count = knots.len();
        knots[count - 3..].fill(to);
        Self {
            degree: 2,
            points,
            knots,
        }
    }

    fn domain(&self) -> (f64, f64) {
        (self.knots[self.degree], self.knots[self.points.len()])
    }

    /// Boehm's knot insertion: the same curve with one more knot at `t`, inside the domain.
    fn with_knot(&self, t: f64) -> Self {
        let (k, p) = (&self.knots, self.degree);
        let span = k.partition_point(|x| *x <= t) - 1;
        let span = span.min(self.points.len() - 1);
        let mut points = Vec::with_capacity(self.points.len() + 1);
        for i in 0..=self.points.len() {
            points.push(if i + p <= span {
                self.points[i]
            } else if i > span {
                self.points[i - 1]
            } else {
                let width = k[i + p] - k[i];
                let share = if width > 0.0 { (t - k[i]) / width } else { 0.0 };
                self.points[i - 1] * (1.0 - share) + self.points[i] * share
            });
        }
        let mut knots = k.clone();
        knots.insert(span + 1, t);
        Self {
            degree: p,
            points,
            knots,
        }
    }

    fn multiplicity(&self, t: f64) -> usize {
        self.knots.iter().filter(|k| **k == t).count()
    }

    /// The same curve as Bezier pieces: every inner knot as often as the degree, the ends once more.
    fn in_pieces(&self) -> Self {
        let (from, to) = self.domain();
        let mut raw = self.clone();
        let mut inner: Vec<f64> = self
            .knots
            .iter()
            .copied()
            .filter(|k| *k >= from && *k <= to)
            .collect();
        inner.dedup();
        for t in inner {
            while raw.multiplicity(t) < self.degree {
                raw = raw.with_knot(t);
            }
        }
        // Knots outside the domain of an unclamped curve carry nothing now.
        let first = raw.knots.partition_point(|k| *k < from);
        let start = raw.knots.partition_point(|k| *k <= from) - self.degree;
        let end = raw.knots.partition_point(|k| *k < to) + self.degree;
        debug_assert!(first <= start + 1);
        let knots = &raw.knots[start..end.min(raw.knots.len())];
        let count = knots.len() + 1 - self.degree;
        let points = raw.points[start - 1..][..count].to_vec();
        let mut all = vec![from];
        all.extend(knots);
        all.push(to);
        Self {
            degree: self.degree,
            points,
            knots: all,
        }
    }

    /// The same curve one degree higher, in pieces.
    fn elevated(&self) -> Self {
        let raw = self.in_pieces();
        let p = raw.degree;
        let mut points = vec![raw.points[0]];
        for piece in raw.points[..].windows(p + 1).step_by(p) {
            for i in 1..=p {
                let share = i as f64 / (p + 1) as f64;
                points.push(piece[i - 1] * share + piece[i] * (1.0 - share));
            }
            points.push(piece[p]);
        }
        let mut breaks = raw.knots.clone();
        breaks.dedup();
        let last = breaks.len() - 1;
        let times = |i: usize| p + 1 + usize::from(i == 0 || i == last);
        let knots = breaks.iter().enumerate();
        Self {
            degree: p + 1,
            points,
            knots: knots
                .flat_map(|(i, b)| std::iter::repeat_n(*b, times(i)))
                .collect(),
        }
    }

    fn build(&self) -> Option<NurbsCurve> {
        let points: Vec<DVec3> = self.points.iter().map(|p| p.truncate() / p.w).collect();
        let weights: Vec<f64> = self.points.iter().map(|p| p.w).collect();
        NurbsCurve::new(self.degree, &points, Some(&weights), self.knots.clone()).ok()
    }
}

impl NurbsCurve {
    /// The same curve with one more knot (Boehm). `None` outside the domain or where the knot is as often as the degree.
    pub fn with_knot(&self, t: f64) -> Option<Self> {
        let raw = Raw::of(self);
        let (from, to) = raw.domain();
        let inside = t > from && t < to && raw.multiplicity(t) < raw.degree;
        if inside {
            raw.with_knot(t).build()
        } else {
            None
        }
    }

    /// The same curve one degree higher; `None` at the highest degree there is.
    ///
    /// Every inner knot is then as often as the old degree and once more: the curve is as smooth as it was, its knots do not say so.
    pub fn elevated(&self) -> Option<Self> {
        Raw::of(self).elevated().build()
    }
}

impl Curve {
    /// The piece between two parameters as a rational B-spline, in the direction of the range: the same points, for lines
    /// and splines at the same parameters.
    ///
    /// A B-spline curve comes whole. `None` for an endless range, and for a hyperbola (its far arms lose digits).
    pub fn to_nurbs(&self, range: (f64, f64)) -> Option<NurbsCurve> {
        self.raw(range)?.build()
    }

    fn raw(&self, (from, to): (f64, f64)) -> Option<Raw> {
        if !(to - from).is_finite() || from == to {
            return None;
        }
        let (low, high) = (from.min(to), from.max(to));
        let raw = match self {
            Self::Line { .. } => Raw::line(self.point(low), self.point(high), (low, high)),
            Self::Circle { frame, radius_mm } => Raw::arc(
                frame.origin,
                frame.x * *radius_mm,
                frame.y * *radius_mm,
                (low, high),
            ),
            Self::Ellipse {
                frame,
                semi_axes_mm: [a, b],
            } => Raw::arc(frame.origin, frame.x * *a, frame.y * *b, (low, high)),
            Self::Parabola { .. } => {
                // A quadratic: its middle control point is where the tangents of the ends meet.
                let ([a, da, _], b) = (self.derivatives(low), self.point(high));
                let corner = a + da * (0.5 * (high - low));
                Raw {
                    degree: 2,
                    points: [a, corner, b].map(|p| p.extend(1.0)).to_vec(),
                    knots: vec![low, low, low, high, high, high],
                }
            }
            Self::Hyperbola { .. } => return None,
            Self::Nurbs(c) => Raw::of(c),
        };
        Some(if to < from { reversed(raw) } else { raw })
    }
}

/// The same curve the other way, over the same domain.
fn reversed(mut raw: Raw) -> Raw {
    let (from, to) = raw.domain();
    raw.points.reverse();
    raw.knots.reverse();
    raw.knots.iter_mut().for_each(|k| *k = from + to - *k);
    raw
}

impl Surface {
    /// The part over ranges of u and v (each from low to high) as a rational B-spline: exactly the same points.
    ///
    /// A B-spline surface comes whole. `None` for endless ranges and profiles that have no such form.
    pub fn to_nurbs(&self, u: (f64, f64), v: (f64, f64)) -> Option<NurbsSurface> {
        if !((u.1 - u.0).is_finite() && (v.1 - v.0).is_finite() && u.0 < u.1 && v.0 < v.1) {
            return None;
        }
        let meridian_line = |frame: &Frame, at: &dyn Fn(f64) -> (f64, f64)| {
            let point = |t: f64| {
                let (r, h) = at(t);
                frame.origin + frame.x * r + frame.z * h
            };
            revolved(frame, u, &Raw::line(point(v.0), point(v.1), v))
        };
        let meridian_arc = |frame: &Frame, major: f64, r: f64| {
            let centre = frame.origin + frame.x * major;
            revolved(frame, u, &Raw::arc(centre, frame.x * r, frame.z * r, v))
        };
        match self {
            Self::Plane(f) => {
                let side = |u: f64| {
                    let at = |v: f64| f.origin + f.x * u + f.y * v;
                    Raw::line(at(v.0), at(v.1), v)
                };
                tensor(&[side(u.0), side(u.1)], 1, vec![u.0, u.0, u.1, u.1])
            }
            Self::Cylinder { frame, radius_mm } => meridian_line(frame, &|t| (*radius_mm, t)),
            Self::Cone {
                frame,
                radius_mm,
                half_angle_rad,
            } => meridian_line(frame, &|t| (radius_mm + t * half_angle_rad.tan(), t)),
            Self::Sphere { frame, radius_mm } => meridian_arc(frame, 0.0, *radius_mm),
            Self::Torus {
                frame,
                major_mm,
                minor_mm,
            } => meridian_arc(frame, *major_mm, *minor_mm),
            Self::Swept(s) => match s.path() {
                SweepPath::Around(axis) => revolved(axis, u, &s.profile().raw(v)?),
                SweepPath::Along(direction) => {
                    let profile = s.profile().raw(u)?;
                    let moved = |t: f64| Raw {
                        points: (profile.points.iter())
                            .map(|p| *p + (*direction * (t * p.w)).extend(0.0))
                            .collect(),
                        ..profile.clone()
                    };
                    let across = tensor(&[moved(v.0), moved(v.1)], 1, vec![v.0, v.0, v.1, v.1])?;
                    across.transposed()
                }
            },
            Self::Nurbs(s) => Some((**s).clone()),
        }
    }
}

/// A profile turned about z of a frame, u the angle.
fn revolved(frame: &Frame, u: (f64, f64), profile: &Raw) -> Option<NurbsSurface> {
    let circle = Raw::arc(DVec3::ZERO, DVec3::X, DVec3::Y, u);
    let rows: Vec<Raw> = (circle.points.iter())
        .map(|c| {
            let turned = |p: &DVec4| {
                let l = p.truncate() - frame.origin * p.w;
                let (x, y, z) = (l.dot(frame.x), l.dot(frame.y), l.dot(frame.z));
                let local = DVec3::new(x * c.x - y * c.y, x * c.y + y * c.x, z * c.w);
                (frame.vector(local) + frame.origin * (p.w * c.w)).extend(p.w * c.w)
            };
            Raw {
                points: profile.points.iter().map(turned).collect(),
                ..profile.clone()
            }
        })
        .collect();
    tensor(&rows, circle.degree, circle.knots)
}

/// The surface whose rows of constant u are these.
fn tensor(rows: &[Raw], degree_u: usize, knots_u: Vec<f64>) -> Option<NurbsSurface> {
    let all: Vec<DVec4> = rows.iter().flat_map(|r| r.points.iter().copied()).collect();
    let points: Vec<DVec3> = all.iter().map(|p| p.truncate() / p.w).collect();
    let weights: Vec<f64> = all.iter().map(|p| p.w).collect();
    let shape = NurbsShape {
        degrees: [degree_u, rows[0].degree],
        counts: [rows.len(), rows[0].points.len()],
        knots: [knots_u, rows[0].knots.clone()],
    };
    NurbsSurface::new(shape, &points, Some(&weights)).ok()
}

impl NurbsSurface {
    /// Straight lines between two curves at equal shares of their domains: u along the curves, v from 0 to 1 across.
    pub fn ruled(first: &NurbsCurve, second: &NurbsCurve) -> Option<Self> {
        let (mut a, mut b) = (Raw::of(first).in_pieces(), Raw::of(second).in_pieces());
        for raw in [&mut a, &mut b] {
            let (from, to) = raw.domain();
            let count = raw.knots.len();
            for k in &mut raw.knots {
                *k = (*k - from) / (to - from);
            }
            raw.knots[count - 1] = 1.0;
        }
        while a.degree < b.degree {
            a = a.elevated();
        }
        while b.degree < a.degree {
            b = b.elevated();
        }
        let all: Vec<f64> = a.knots.iter().chain(&b.knots).copied().collect();
        for t in all {
            let most = a.multiplicity(t).max(b.multiplicity(t));
            for raw in [&mut a, &mut b] {
                while raw.multiplicity(t) < most {
                    *raw = raw.with_knot(t);
                }
            }
        }
        tensor(&[a, b], 1, vec![0.0, 0.0, 1.0, 1.0])?.transposed()
    }

    /// The same surface with u and v in each other's place; its normal looks the other way.
    pub fn transposed(&self) -> Option<Self> {
        let [ku, kv] = self.knots();
        let (rows, columns) = (ku.points(), kv.points());
        let all: Vec<(DVec3, f64)> = self.control_points().collect();
        let order = (0..columns).flat_map(|j| (0..rows).map(move |i| i * columns + j));
        let (points, weights): (Vec<DVec3>, Vec<f64>) = order.map(|k| all[k]).unzip();
        let shape = NurbsShape {
            degrees: [kv.degree(), ku.degree()],
            counts: [columns, rows],
            knots: [kv.as_slice().to_vec(), ku.as_slice().to_vec()],
        };
        Self::new(shape, &points, Some(&weights)).ok()
    }

    /// The curve of constant u (`along_v`) or of constant v through a parameter of the domain.
    pub fn iso_curve(&self, along_v: bool, t: f64) -> Option<NurbsCurve> {
        let [ku, kv] = self.knots();
        let (fixed, free) = if along_v { (ku, kv) } else { (kv, ku) };
        let (from, to) = fixed.domain();
        let t = t.clamp(from, to);
        let span = fixed.span(t);
        let basis = fixed.values(span, t);
        let all: Vec<(DVec3, f64)> = self.control_points().collect();
        let columns = kv.points();
        let points = (0..free.points()).map(|k| {
            let mut sum = DVec4::ZERO;
            for (j, b) in basis[..=fixed.degree()].iter().enumerate() {
                let i = span - fixed.degree() + j;
                let (p, w) = all[if along_v {
                    i * columns + k
                } else {
                    k * columns + i
                }];
                sum += (p * w).extend(w) * *b;
            }
            sum
        });
        Raw {
            degree: free.degree(),
            points: points.collect(),
            knots: free.as_slice().to_vec(),
        }
        .build()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sweep::Sweep;

    fn frame() -> Frame {
        let (origin, z) = (DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.3, -0.2, 1.0));
        Frame::new(origin, z, DVec3::X).expect("a frame")
    }

    #[test]
    fn curves_keep_their_points() {
        let ellipse = Curve::Ellipse {
            frame: frame(),
            semi_axes_mm: [5.0, 2.0],
        };
        let parabola = Curve::Parabola {
            frame: frame(),
            focal_mm: 1.5,
        };
        for (curve, range) in [
            (&ellipse, (0.4, 5.9)),
            (&ellipse, (2.0, 0.5)),
            (&parabola, (-1.0, 2.0)),
        ] {
            let spline = curve.to_nurbs(range).expect("a spline");
            let (from, to) = spline.knots().domain();
            for k in 0..=40 {
                let p = spline.point(from + (to - from) * f64::from(k) / 40.0);
                assert!(curve.nearest(p).1 < 1e-13, "{}", curve.kind());
            }
            assert!(spline.point(from).distance(curve.point(range.0)) < 1e-13);
            assert!(spline.point(to).distance(curve.point(range.1)) < 1e-13);
        }
    }

    #[test]
    fn elevation_and_insertion_change_nothing() {
        let points: Vec<DVec3> = (0..7)
            .map(|i| {
                DVec3::new(
                    f64::from(i),
                    (1.3 * f64::from(i)).sin(),
                    0.1 * f64::from(i * i),
                )
            })
            .collect();
        let weights = [1.0, 2.0, 0.7, 1.0, 1.5, 1.0, 0.9];
        // Clamped, and with knots running on beyond the domain.
        let clamped = vec![0., 0., 0., 0., 0.3, 0.3, 0.7, 1.1, 1.1, 1.1, 1.1];
        let running = (0..11).map(f64::from).collect();
        for knots in [clamped, running] {
            let c = NurbsCurve::new(3, &points, Some(&weights), knots).expect("a curve");
            let (from, to) = c.knots().domain();
            let at = |k: i32| from + (to - from) * f64::from(k) / 50.0;
            let higher = c.elevated().expect("degree 4");
            assert_eq!(higher.knots().degree(), 4);
            let finer = c
                .with_knot(at(17))
                .and_then(|c| c.with_knot(at(17)))
                .expect("two knots");
            assert_eq!(finer.knots().points(), 9);
            for k in 0..=50 {
                let p = c.point(at(k));
                assert!(higher.point(at(k)).distance(p) < 1e-13);
                assert!(finer.point(at(k)).distance(p) < 1e-13);
            }
        }
    }

    #[test]
    fn surfaces_keep_their_points() {
        let frame = frame();
        let circle = Curve::Circle {
            frame: Frame::new(frame.origin + frame.x * 9.0, frame.y, frame.x).expect("a frame"),
            radius_mm: 2.0,
        };
        let swept = |s: Option<Sweep>| Surface::Swept(Box::new(s.expect("a sweep")));
        let all = [
            (Surface::Plane(frame), (-1.0, 2.0), (0.0, 3.0)),
            (
                Surface::Cylinder {
                    frame,
                    radius_mm: 4.0,
                },
                (1.0, 6.5),
                (-2.0, 3.0),
            ),
            (
                Surface::Cone {
                    frame,
                    radius_mm: 3.0,
                    half_angle_rad: 0.5,
                },
                (0.0, 6.0),
                (0.0, 3.0),
            ),
            (
                Surface::Sphere {
                    frame,
                    radius_mm: 5.0,
                },
                (0.2, 3.0),
                (-1.5, 1.0),
            ),
            (
                Surface::Torus {
                    frame,
                    major_mm: 6.0,
                    minor_mm: 2.0,
                },
                (0.0, 6.2),
                (0.5, 5.0),
            ),
            (
                swept(Sweep::around(circle.clone(), frame)),
                (0.1, 4.0),
                (0.0, 3.0),
            ),
            (
                swept(Sweep::along(circle, DVec3::new(0.2, 1.0, 0.1))),
                (0.3, 4.0),
                (-1.0, 2.0),
            ),
        ];
        for (surface, u, v) in all {
            let spline = surface.to_nurbs(u, v).expect("a spline");
            let [ku, kv] = spline.knots();
            assert_eq!((ku.domain(), kv.domain()), (u, v));
            for i in 0..=12 {
                for j in 0..=12 {
                    let at = |(a, b): (f64, f64), k: i32| a + (b - a) * f64::from(k) / 12.0;
                    let p = spline.point(at(u, i), at(v, j));
                    let (fu, fv) = surface.nearest(p, None);
                    // Coordinates of size 20 round at 4e-15.
                    assert!(
                        surface.point(fu, fv).distance(p) < 1e-12,
                        "{}",
                        surface.kind()
                    );
                }
            }
            let corner = spline.point(u.0, v.1).distance(surface.point(u.0, v.1));
            assert!(corner < 1e-12, "{}", surface.kind());
        }
    }

    #[test]
    fn a_ruled_surface_joins_its_curves() {
        let circle = Curve::Circle {
            frame: frame(),
            radius_mm: 2.0,
        };
        let a = circle.to_nurbs((0.0, 3.0)).expect("an arc");
        let b = Curve::Line {
            origin: DVec3::new(0.0, 0.0, 9.0),
            direction: DVec3::X,
        };
        let b = b.to_nurbs((0.0, 4.0)).expect("a line");
        let s = NurbsSurface::ruled(&a, &b).expect("a surface");
        for k in 0..=20 {
            let t = f64::from(k) / 20.0;
            assert!(s.point(t, 0.0).distance(a.point(3.0 * t)) < 1e-13);
            assert!(s.point(t, 1.0).distance(b.point(4.0 * t)) < 1e-13);
            let iso = s.iso_curve(true, t).expect("a line");
            assert!(iso.point(0.5).distance(s.point(t, 0.5)) < 1e-13);
        }
    }
}

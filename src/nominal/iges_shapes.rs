//! Curves and surfaces of an IGES file (IGES 5.3, chapter 4) as ours, in mm, each moved by its transformation matrix.

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

use super::iges::{Entry, Iges, Values};
use super::part21::{Read, refuse};
use super::shapes::{Sensed, extruded, offset, revolved};
use crate::geometry::nurbs_surface::NurbsShape;
use crate::geometry::{Curve, Frame, NurbsCurve, NurbsSurface, RigidTransform, Surface};

/// How deep entities may lie inside others.
const MAX_DEPTH: usize = 12;
/// Pieces that one composite curve may have.
const MAX_PIECES: usize = 100_000;
/// Control points of one curve or surface.
const MAX_CONTROL_POINTS: usize = 4_000_000;

/// A bounded piece of a curve, from its start to its end.
#[derive(Debug, Clone)]
pub(super) struct Piece {
    /// Directory number of the curve.
    pub id: u64,
    pub curve: Curve,
    pub range: (f64, f64),
}

impl Piece {
    pub fn start(&self) -> DVec3 {
        self.curve.point(self.range.0)
    }

    pub fn end(&self) -> DVec3 {
        self.curve.point(self.range.1)
    }

    pub fn reversed(mut self) -> Self {
        self.range = (self.range.1, self.range.0);
        self
    }

    fn transformed(self, by: &RigidTransform) -> Self {
        Self {
            curve: self.curve.transformed(by),
            ..self
        }
    }
}

/// Reads the shapes of one file.
pub(super) struct IgesShapes<'a> {
    pub file: &'a Iges<'a>,
}

impl IgesShapes<'_> {
    fn point(&self, v: &Values, i: usize) -> Read<DVec3> {
        let n = v.numbers(i, 3)?;
        let p = DVec3::new(n[0], n[1], n[2]) * self.file.unit_mm;
        if p.abs().max_element() <= 1e9 {
            return Ok(p);
        }
        let far = p.abs().max_element();
        let what = format!("a coordinate of {far:e} mm, expected at most 1e9");
        Err(refuse(v.entry.id, what))
    }

    fn length(&self, v: &Values, i: usize) -> Read<f64> {
        let mm = v.number(i)? * self.file.unit_mm;
        if mm > 0.0 && mm <= 1e9 {
            return Ok(mm);
        }
        let what = format!("a length of {mm} mm, expected one above 0 and at most 1e9");
        Err(refuse(v.entry.id, what))
    }

    /// The matrix of an entity (type 124), with the matrices that it is itself moved by.
    pub fn transform(&self, entry: &Entry) -> Read<RigidTransform> {
        let mut id = entry.transform;
        let mut out = RigidTransform::IDENTITY;
        for _ in 0..MAX_DEPTH {
            if id == 0 {
                return Ok(out);
            }
            let v = self.file.values(id)?;
            if v.entry.kind != 124 {
                let what = format!("its matrix #{id} is of type {}, expected 124", v.entry.kind);
                return Err(refuse(entry.id, what));
            }
            let n = v.numbers(0, 12)?;
            let row = |k: usize| DVec3::new(n[k], n[k + 1], n[k + 2]);
            let matrix = DMat3::from_cols(row(0), row(4), row(8)).transpose();
            let off = (matrix * matrix.transpose() - DMat3::IDENTITY).to_cols_array();
            if off.iter().any(|x| x.abs() > 1e-4) || matrix.determinant() < 0.0 {
                return Err(refuse(
                    id,
                    "a matrix (type 124) that mirrors or scales is not read",
                ));
            }
            let shift = DVec3::new(n[3], n[7], n[11]) * self.file.unit_mm;
            out = RigidTransform::from_matrix(matrix, shift) * out;
            id = v.entry.transform;
        }
        Err(refuse(entry.id, "matrices nested too deep, or in a circle"))
    }

    /// A point (type 116) or direction (type 123).
    fn triple(&self, id: u64, kind: u32) -> Read<DVec3> {
        let v = self.file.values(id)?;
        if v.entry.kind != kind {
            let what = format!("is of type {}, expected {kind}", v.entry.kind);
            return Err(refuse(id, what));
        }
        let by = self.transform(&v.entry)?;
        if kind == 116 {
            return Ok(by.point(self.point(&v, 0)?));
        }
        let n = v.numbers(0, 3)?;
        let d = DVec3::new(n[0], n[1], n[2]).try_normalize();
        d.map(|d| by.vector(d))
            .ok_or_else(|| refuse(id, "a direction without length"))
    }

    /// The pieces of a curve in the order in which it runs.
    pub fn curve(&self, id: u64) -> Read<Vec<Piece>> {
        let mut out = Vec::new();
        self.curve_at(id, 0, &mut out)?;
        Ok(out)
    }

    fn curve_at(&self, id: u64, depth: usize, out: &mut Vec<Piece>) -> Read<()> {
        if depth > MAX_DEPTH || out.len() > MAX_PIECES {
            return Err(refuse(
                id,
                "curves nested too deep, in a circle, or too many",
            ));
        }
        let v = self.file.values(id)?;
        let by = self.transform(&v.entry)?;
        let first = out.len();
        let (curve, range) = match v.entry.kind {
            100 => self.arc(&v)?,
            102 => {
                let count = v.count(0, MAX_PIECES)?;
                for part in v.pointers(1, count)? {
                    if self.file.entry(part)?.kind != 116 {
                        self.curve_at(part, depth + 1, out)?;
                    }
                }
                let moved: Vec<Piece> = out.drain(first..).map(|p| p.transformed(&by)).collect();
                out.extend(moved);
                return Ok(());
            }
            104 => self.conic(&v)?,
            110 => {
                let (from, to) = (self.point(&v, 0)?, self.point(&v, 3)?);
                let length = from.distance(to);
                let Some(direction) = (to - from).try_normalize() else {
                    // A line of no length joins two pieces.
                    return Ok(());
                };
                let line = Curve::Line {
                    origin: from,
                    direction,
                };
                (line, (0.0, length))
            }
            112 => self.spline_curve(&v)?,
            126 => self.nurbs_curve(&v)?,
            other => return Err(refuse(id, format!("a curve of type {other} is not read"))),
        };
        out.push(Piece { id, curve, range }.transformed(&by));
        Ok(())
    }

    /// Counterclockwise about z in a plane z = ZT.
    fn arc(&self, v: &Values) -> Read<(Curve, (f64, f64))> {
        let n = v.numbers(0, 7)?;
        let at = |x: f64, y: f64| DVec3::new(x, y, n[0]) * self.file.unit_mm;
        let (centre, from, to) = (at(n[1], n[2]), at(n[3], n[4]), at(n[5], n[6]));
        let frame = Frame::new(centre, DVec3::Z, from - centre);
        let radius_mm = from.distance(centre);
        let frame = frame.filter(|_| radius_mm > 0.0 && radius_mm < 1e9);
        let frame = frame.ok_or_else(|| refuse(v.entry.id, "an arc without a radius"))?;
        let end = Frame::angle_of(frame.local(to).truncate());
        // Start and end at one point: the whole circle.
        let end = if end * radius_mm <= 1e-9 * radius_mm {
            TAU
        } else {
            end
        };
        Ok((Curve::Circle { frame, radius_mm }, (0.0, end)))
    }

    /// A x2 + B xy + C y2 + D x + E y + F = 0, in its own axes as the specification wants it.
    fn conic(&self, v: &Values) -> Read<(Curve, (f64, f64))> {
        let n = v.numbers(0, 11)?;
        let [a, b, c, d, e, f] = [n[0], n[1], n[2], n[3], n[4], n[5]];
        let unit = self.file.unit_mm;
        let at = |x: f64, y: f64| DVec3::new(x, y, n[6]) * unit;
        let (from, to) = (at(n[7], n[8]), at(n[9], n[10]));
        let size = a.abs().max(c.abs());
        let small = |x: f64| x.abs() <= 1e-9 * size.max(f.abs());
        let origin = DVec3::Z * (n[6] * unit);
        let frame = |z: DVec3, x: DVec3| {
            Frame::new(origin, z, x).ok_or_else(|| refuse(v.entry.id, "a conic without axes"))
        };
        let centred = small(b) && small(d) && small(e);
        let (p, q) = (-f / a, -f / c);
        if centred && p > 0.0 && q > 0.0 && p.is_finite() && q.is_finite() {
            let semi_axes_mm = [p.sqrt() * unit, q.sqrt() * unit];
            let frame = frame(DVec3::Z, DVec3::X)?;
            let angle = |w: DVec3| (w.y / semi_axes_mm[1]).atan2(w.x / semi_axes_mm[0]);
            let start = angle(from);
            let way = (angle(to) - start).rem_euclid(TAU);
            let way = if way < 1e-9 { TAU } else { way };
            let ellipse = Curve::Ellipse {
                frame,
                semi_axes_mm,
            };
            return Ok((ellipse, (start, start + way)));
        }
        let curve = if centred && p * q < 0.0 {
            let (z, x) = if p > 0.0 {
                (DVec3::Z, DVec3::X)
            } else {
                (-DVec3::Z, DVec3::Y)
            };
            let (p, q) = if p > 0.0 { (p, -q) } else { (q, -p) };
            // The branch on which the curve starts.
            let x = x * from.dot(x).signum();
            Curve::Hyperbola {
                frame: frame(z, x)?,
                semi_axes_mm: [p.sqrt() * unit, q.sqrt() * unit],
            }
        } else if small(b) && small(f) && small(c) && small(d) && !small(a) && !small(e) {
            Curve::Parabola {
                frame: frame(DVec3::Z, DVec3::Y * -(e / a).signum())?,
                focal_mm: (e / a).abs() * unit / 4.0,
            }
        } else if small(b) && small(f) && small(a) && small(e) && !small(c) && !small(d) {
            Curve::Parabola {
                frame: frame(DVec3::Z, DVec3::X * -(d / c).signum())?,
                focal_mm: (d / c).abs() * unit / 4.0,
            }
        } else {
            let what = "a conic (type 104) that is not in its own axes is not read";
            return Err(refuse(v.entry.id, what));
        };
        let range = (curve.nearest(from).0, curve.nearest(to).0);
        Ok((curve, range))
    }

    /// Cubics a + b s + c s2 + d s3 from break to break (type 112).
    fn spline_curve(&self, v: &Values) -> Read<(Curve, (f64, f64))> {
        let pieces = v.count(3, MAX_CONTROL_POINTS)?;
        let breaks = v.numbers(4, pieces + 1)?;
        let c = v.numbers(5 + pieces, 12 * pieces)?;
        let mut points = Vec::with_capacity(3 * pieces + 1);
        for (k, w) in breaks.windows(2).enumerate() {
            let at = |power: usize| {
                let i = 12 * k + power;
                DVec3::new(c[i], c[i + 4], c[i + 8]) * self.file.unit_mm
            };
            let bezier = bezier([at(0), at(1), at(2), at(3)], w[1] - w[0]);
            points.extend(&bezier[usize::from(k > 0)..]);
        }
        let curve = NurbsCurve::new(3, &points, None, bezier_knots(&breaks));
        let curve = curve.map_err(|e| refuse(v.entry.id, e.to_string()))?;
        let range = (breaks[0], breaks[pieces]);
        Ok((Curve::Nurbs(curve), range))
    }

    fn nurbs_curve(&self, v: &Values) -> Read<(Curve, (f64, f64))> {
        let (last, degree) = (v.count(0, MAX_CONTROL_POINTS)?, v.count(1, 64)?);
        let count = last + 1;
        let knots = v.numbers(6, count + degree + 1)?;
        let at = 6 + knots.len();
        let weights = v.numbers(at, count)?;
        let at = at + count;
        v.numbers(at, 3 * count)?;
        let points: Vec<DVec3> = (0..count)
            .map(|i| self.point(v, at + 3 * i))
            .collect::<Read<_>>()?;
        let curve = NurbsCurve::new(degree, &points, Some(&weights), knots);
        let curve = curve.map_err(|e| refuse(v.entry.id, e.to_string()))?;
        let (from, to) = curve.knots().domain();
        let at = at + 3 * count;
        let ends = (v.number(at).unwrap_or(from), v.number(at + 1).unwrap_or(to));
        let range = (ends.0.clamp(from, to), ends.1.clamp(from, to));
        let range = if range.0 == range.1 {
            (from, to)
        } else {
            range
        };
        Ok((Curve::Nurbs(curve), range))
    }

    /// The surface of an entity.
    pub fn surface(&self, id: u64) -> Read<Sensed<Surface>> {
        self.surface_at(id, 0)
    }

    fn surface_at(&self, id: u64, depth: usize) -> Read<Sensed<Surface>> {
        if depth > MAX_DEPTH {
            return Err(refuse(id, "surfaces nested too deep, or in a circle"));
        }
        let v = self.file.values(id)?;
        let by = self.transform(&v.entry)?;
        let plain = Sensed::plain;
        let sensed = match v.entry.kind {
            108 => plain(self.plane(&v)?),
            114 => plain(Surface::Nurbs(Box::new(self.spline_surface(&v)?))),
            118 => plain(self.ruled(&v)?),
            120 => self.revolution(&v)?,
            122 => {
                let piece = self.one_piece(v.pointer(0)?)?;
                let to = self.point(&v, 1)?;
                let along = (to - piece.start()).try_normalize();
                let along = along.ok_or_else(|| refuse(id, "an extrusion without direction"))?;
                let mut profile = Sensed::plain(piece.curve);
                profile.reversed = piece.range.1 < piece.range.0;
                extruded(id, profile, along)?
            }
            128 => plain(Surface::Nurbs(Box::new(self.nurbs_surface(&v)?))),
            140 => {
                let basis = self.surface_at(v.pointer(4)?, depth + 1)?;
                let n = v.numbers(0, 3)?;
                let (u, w) = (basis.shape.ranges()[0], basis.shape.ranges()[1]);
                let middle = |r: crate::geometry::newton::Range| {
                    let m = 0.5 * (r.from + r.to);
                    if m.is_finite() { m } else { 0.3 }
                };
                let normal = basis.shape.normal(middle(u), middle(w)).unwrap_or(DVec3::Z);
                let side = DVec3::new(n[0], n[1], n[2]).dot(normal);
                let sign = if side < 0.0 { -1.0 } else { 1.0 };
                let distance_mm = sign * v.number(3)? * self.file.unit_mm;
                Sensed {
                    shape: offset(id, basis.shape, distance_mm)?,
                    reversed: basis.reversed,
                }
            }
            190 | 192 | 194 | 196 | 198 => plain(self.analytic(&v)?),
            other => return Err(refuse(id, format!("a surface of type {other} is not read"))),
        };
        Ok(Sensed {
            shape: sensed.shape.transformed(&by),
            reversed: sensed.reversed,
        })
    }

    fn one_piece(&self, id: u64) -> Read<Piece> {
        let mut pieces = self.curve(id)?;
        match pieces.len() {
            1 => Ok(pieces.remove(0)),
            n => Err(refuse(
                id,
                format!("a profile of {n} pieces is not read, expected one"),
            )),
        }
    }

    /// A x + B y + C z = D.
    fn plane(&self, v: &Values) -> Read<Surface> {
        let n = v.numbers(0, 4)?;
        let normal = DVec3::new(n[0], n[1], n[2]);
        let origin = normal * (n[3] * self.file.unit_mm / normal.length_squared());
        let frame = Frame::new(origin, normal, DVec3::X).filter(|f| f.origin.is_finite());
        let frame = frame.ok_or_else(|| refuse(v.entry.id, "a plane without a normal"))?;
        Ok(Surface::Plane(frame))
    }

    /// Straight lines between equal parameters of two curves (form 1), or equal arc lengths (form 0) of lines.
    fn ruled(&self, v: &Values) -> Read<Surface> {
        let first = self.one_piece(v.pointer(0)?)?;
        let mut second = self.one_piece(v.pointer(1)?)?;
        if v.or_zero(2)? != 0.0 {
            second = second.reversed();
        }
        let straight = |p: &Piece| matches!(p.curve, Curve::Line { .. });
        if v.entry.form == 0 && !(straight(&first) && straight(&second)) {
            let what = "a ruled surface by arc length (type 118 form 0) between curves is not read";
            return Err(refuse(v.entry.id, what));
        }
        let spline = |p: &Piece| p.curve.to_nurbs(p.range);
        let ruled = spline(&first)
            .zip(spline(&second))
            .and_then(|(a, b)| NurbsSurface::ruled(&a, &b));
        let ruled =
            ruled.ok_or_else(|| refuse(v.entry.id, "a ruled surface of curves without ends"))?;
        Ok(Surface::Nurbs(Box::new(ruled)))
    }

    fn revolution(&self, v: &Values) -> Read<Sensed<Surface>> {
        let axis = self.one_piece(v.pointer(0)?)?;
        let Curve::Line { direction, .. } = axis.curve else {
            return Err(refuse(
                v.entry.id,
                "the axis of a revolution must be a line (type 110)",
            ));
        };
        let frame = Frame::new(axis.start(), direction, direction.any_orthogonal_vector());
        let frame = frame.ok_or_else(|| refuse(v.entry.id, "a revolution without an axis"))?;
        let piece = self.one_piece(v.pointer(1)?)?;
        let mut profile = Sensed::plain(piece.curve);
        profile.reversed = piece.range.1 < piece.range.0;
        revolved(v.entry.id, profile, frame)
    }

    /// Pieces a b c d in s times 1 t t2 t3 (type 114), one row and one column of no use after the last.
    fn spline_surface(&self, v: &Values) -> Read<NurbsSurface> {
        let (m, n) = (v.count(2, 1 << 20)?, v.count(3, 1 << 20)?);
        let (us, vs) = (v.numbers(4, m + 1)?, v.numbers(5 + m, n + 1)?);
        let start = 6 + m + n;
        if m == 0 || n == 0 {
            return Err(refuse(v.entry.id, "a spline surface without patches"));
        }
        let (rows, columns) = (3 * m + 1, 3 * n + 1);
        // Every patch is there before room is made for its points.
        v.number(start + 48 * ((m - 1) * (n + 1) + n) - 1)?;
        let mut points = vec![DVec3::ZERO; rows * columns];
        for i in 0..m {
            for j in 0..n {
                let c = v.numbers(start + 48 * (i * (n + 1) + j), 48)?;
                let by_t = [0, 1, 2, 3].map(|t| {
                    let at = |s: usize| {
                        let k = 4 * t + s;
                        DVec3::new(c[k], c[16 + k], c[32 + k]) * self.file.unit_mm
                    };
                    bezier([at(0), at(1), at(2), at(3)], us[i + 1] - us[i])
                });
                for s in 0..4 {
                    let column = bezier(by_t.map(|row| row[s]), vs[j + 1] - vs[j]);
                    for (t, p) in column.into_iter().enumerate() {
                        points[(3 * i + s) * columns + 3 * j + t] = p;
                    }
                }
            }
        }
        let shape = NurbsShape {
            degrees: [3, 3],
            counts: [rows, columns],
            knots: [bezier_knots(&us), bezier_knots(&vs)],
        };
        NurbsSurface::new(shape, &points, None).map_err(|e| refuse(v.entry.id, e.to_string()))
    }

    fn nurbs_surface(&self, v: &Values) -> Read<NurbsSurface> {
        let (k1, k2) = (v.count(0, 1 << 22)?, v.count(1, 1 << 22)?);
        let degrees = [v.count(2, 64)?, v.count(3, 64)?];
        let counts = [k1 + 1, k2 + 1];
        let total = counts[0].saturating_mul(counts[1]);
        if total > MAX_CONTROL_POINTS {
            return Err(refuse(
                v.entry.id,
                format!("{total} control points, at most {MAX_CONTROL_POINTS} are read"),
            ));
        }
        let u = v.numbers(9, counts[0] + degrees[0] + 1)?;
        let w = v.numbers(9 + u.len(), counts[1] + degrees[1] + 1)?;
        let at = 9 + u.len() + w.len();
        // The file has u running fastest.
        let weights = v.numbers(at, total)?;
        let at = at + total;
        v.numbers(at, 3 * total)?;
        let order = (0..counts[0]).flat_map(|i| (0..counts[1]).map(move |j| j * counts[0] + i));
        let mut points = Vec::with_capacity(total);
        let mut turned = Vec::with_capacity(total);
        for k in order {
            points.push(self.point(v, at + 3 * k)?);
            turned.push(weights[k]);
        }
        let shape = NurbsShape {
            degrees,
            counts,
            knots: [u, w],
        };
        NurbsSurface::new(shape, &points, Some(&turned))
            .map_err(|e| refuse(v.entry.id, e.to_string()))
    }

    /// Types 190 to 198: a point, an axis, sizes, and a direction in form 1.
    fn analytic(&self, v: &Values) -> Read<Surface> {
        let id = v.entry.id;
        let origin = self.triple(v.pointer(0)?, 116)?;
        let sizes = match v.entry.kind {
            192 | 196 => 1,
            190 => 0,
            _ => 2,
        };
        let sphere = v.entry.kind == 196;
        let first_size = if sphere { 1 } else { 2 };
        let has_axis = !sphere || v.entry.form == 1;
        let axis_at = if sphere { 2 } else { 1 };
        let z = if has_axis {
            self.triple(v.pointer(axis_at)?, 123)?
        } else {
            DVec3::Z
        };
        let reference = if sphere { 3 } else { first_size + sizes };
        let x = if v.entry.form == 1 {
            self.triple(v.pointer(reference)?, 123)?
        } else {
            z.any_orthonormal_vector()
        };
        let frame =
            Frame::new(origin, z, x).ok_or_else(|| refuse(id, "a surface without an axis"))?;
        let size = |k: usize| self.length(v, first_size + k);
        Ok(match v.entry.kind {
            190 => Surface::Plane(frame),
            192 => Surface::Cylinder {
                frame,
                radius_mm: size(0)?,
            },
            194 => {
                let radius_mm = v.number(2)? * self.file.unit_mm;
                let half_angle_rad = v.number(3)?.to_radians();
                if !(0.0..=1e9).contains(&radius_mm) || !(1e-9..1.57).contains(&half_angle_rad) {
                    let what = format!(
                        "a cone of {radius_mm} mm and {half_angle_rad} rad, expected 0 to 1e9 mm and 0 to 1.57 rad"
                    );
                    return Err(refuse(id, what));
                }
                Surface::Cone {
                    frame,
                    radius_mm,
                    half_angle_rad,
                }
            }
            196 => Surface::Sphere {
                frame,
                radius_mm: size(0)?,
            },
            _ => Surface::Torus {
                frame,
                major_mm: size(0)?,
                minor_mm: size(1)?,
            },
        })
    }
}

/// Control points of the cubic with these powers over a length.
fn bezier([a, b, c, d]: [DVec3; 4], length: f64) -> [DVec3; 4] {
    let (b, c, d) = (b * length, c * length * length, d * length.powi(3));
    [a, a + b / 3.0, a + b * (2.0 / 3.0) + c / 3.0, a + b + c + d]
}

/// Knots of cubics that are joined as they are.
fn bezier_knots(breaks: &[f64]) -> Vec<f64> {
    let last = breaks.len() - 1;
    let times = |i: usize| if i == 0 || i == last { 4 } else { 3 };
    let pairs = breaks.iter().enumerate();
    pairs
        .flat_map(|(i, b)| std::iter::repeat_n(*b, times(i)))
        .collect()
}

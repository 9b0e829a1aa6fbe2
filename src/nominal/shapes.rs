//! Curves and surfaces of a STEP file (ISO 10303-42) as ours.

use glam::DVec3;

use super::Refused;
use super::part21::{Part21, Read, Record, Units, refuse};
use crate::geometry::nurbs_surface::NurbsShape;
use crate::geometry::sweep::Sweep;
use crate::geometry::{Curve, Frame, NurbsCurve, NurbsSurface, Surface};

/// A curve or surface, and whether the file's own runs, or faces, the other way.
#[derive(Debug, Clone)]
pub(super) struct Sensed<T> {
    pub shape: T,
    pub reversed: bool,
}

impl<T> Sensed<T> {
    pub fn plain(shape: T) -> Self {
        Self {
            shape,
            reversed: false,
        }
    }
}

/// How deep a curve or surface may lie inside others.
const MAX_DEPTH: usize = 8;
/// Control points of one curve or surface.
const MAX_CONTROL_POINTS: usize = 4_000_000;
/// Sine of the angle below which two directions of a file are parallel: writers give 6 to 16 digits.
const PARALLEL: f64 = 1e-7;

/// Reads shapes in the units of one representation.
pub(super) struct Shapes<'a> {
    pub file: &'a Part21,
    pub units: Units,
}

impl Shapes<'_> {
    /// The position of a VERTEX_POINT or CARTESIAN_POINT.
    pub fn vertex(&self, id: u64) -> Read<DVec3> {
        if self.file.is(id, "VERTEX_POINT") {
            let point = self.file.record(id)?.reference(1)?;
            return self.file.point(point, self.units);
        }
        self.file.point(id, self.units)
    }

    /// AXIS2_PLACEMENT_3D.
    pub fn placement(&self, id: u64) -> Read<Frame> {
        let r = self.file.expect(id, "AXIS2_PLACEMENT_3D")?;
        let origin = self.file.point(r.reference(1)?, self.units)?;
        let axis = |i: usize, default: DVec3| match r.optional(i)? {
            Some(d) => self.file.direction(d),
            None => Ok(default),
        };
        let (z, x) = (axis(2, DVec3::Z)?, axis(3, DVec3::X)?);
        Frame::new(origin, z, x).ok_or_else(|| refuse(id, "a placement without an axis"))
    }

    /// AXIS1_PLACEMENT.
    fn axis(&self, id: u64) -> Read<Frame> {
        let r = self.file.expect(id, "AXIS1_PLACEMENT")?;
        let origin = self.file.point(r.reference(1)?, self.units)?;
        let z = match r.optional(2)? {
            Some(d) => self.file.direction(d)?,
            None => DVec3::Z,
        };
        Frame::new(origin, z, z.any_orthogonal_vector())
            .ok_or_else(|| refuse(id, "a placement without an axis"))
    }

    fn vector(&self, id: u64) -> Read<DVec3> {
        let r = self.file.expect(id, "VECTOR")?;
        self.file.direction(r.reference(1)?)
    }

    /// A length attribute in mm, above zero.
    fn length(&self, r: &Record<'_>, i: usize) -> Read<f64> {
        let mm = r.number(i)? * self.units.length_mm;
        if mm > 0.0 && mm <= 1e9 {
            Ok(mm)
        } else {
            Err(refuse(
                r.id,
                format!(
                    "{} with a length of {mm} mm, expected one above 0 and at most 1e9",
                    r.name
                ),
            ))
        }
    }

    /// The curve `id`.
    pub fn curve(&self, id: u64) -> Read<Sensed<Curve>> {
        self.curve_at(id, 0)
    }

    fn curve_at(&self, id: u64, depth: usize) -> Read<Sensed<Curve>> {
        if depth > MAX_DEPTH {
            return Err(refuse(id, "a curve nested too deep"));
        }
        if let Some(curve) = self.spline_curve(id)? {
            return Ok(Sensed::plain(Curve::Nurbs(curve)));
        }
        let r = self.file.record(id)?;
        let frame = || self.placement(r.reference(1)?);
        Ok(Sensed::plain(match r.name {
            "LINE" => Curve::Line {
                origin: self.file.point(r.reference(1)?, self.units)?,
                direction: self.vector(r.reference(2)?)?.normalize(),
            },
            "CIRCLE" => Curve::Circle {
                frame: frame()?,
                radius_mm: self.length(&r, 2)?,
            },
            "ELLIPSE" => Curve::Ellipse {
                frame: frame()?,
                semi_axes_mm: [self.length(&r, 2)?, self.length(&r, 3)?],
            },
            "PARABOLA" => Curve::Parabola {
                frame: frame()?,
                focal_mm: self.length(&r, 2)?,
            },
            "HYPERBOLA" => Curve::Hyperbola {
                frame: frame()?,
                semi_axes_mm: [self.length(&r, 2)?, self.length(&r, 3)?],
            },
            "POLYLINE" => self.polyline(&r)?,
            "TRIMMED_CURVE" => {
                let mut basis = self.curve_at(r.reference(1)?, depth + 1)?;
                basis.reversed ^= !r.flag(4)?;
                return Ok(basis);
            }
            "SURFACE_CURVE" | "SEAM_CURVE" | "INTERSECTION_CURVE" | "BOUNDED_SURFACE_CURVE" => {
                return self.curve_at(r.reference(1)?, depth + 1);
            }
            other => return Err(refuse(id, format!("a curve of type {other} is not read"))),
        }))
    }

    /// A curve of a wireframe as bounded pieces.
    pub fn bounded_curves(&self, id: u64) -> Read<Vec<(Curve, (f64, f64))>> {
        match self.file.type_of(id).as_str() {
            "COMPOSITE_CURVE" => {
                let mut out = Vec::new();
                for segment in self.file.record(id)?.references(1)? {
                    let parent = self.file.record(segment)?.reference(2)?;
                    if self.file.is(parent, "COMPOSITE_CURVE") {
                        return Err(refuse(
                            parent,
                            "a composite curve inside another is not read",
                        ));
                    }
                    out.extend(self.bounded_curves(parent)?);
                }
                Ok(out)
            }
            "TRIMMED_CURVE" => Ok(vec![self.trimmed(&self.file.record(id)?)?]),
            _ => {
                let curve = self.curve(id)?.shape;
                let r = curve.range();
                if !(r.to - r.from).is_finite() {
                    return Err(refuse(
                        id,
                        format!("an unbounded {} in a wireframe", curve.kind()),
                    ));
                }
                Ok(vec![(curve, (r.from, r.to))])
            }
        }
    }

    fn trimmed(&self, r: &Record<'_>) -> Read<(Curve, (f64, f64))> {
        let basis = r.reference(1)?;
        let curve = self.curve(basis)?;
        let forward = r.flag(4)? ^ curve.reversed;
        let end = |i: usize| -> Read<DVec3> {
            if let Some(point) = r.first_reference(i) {
                return self.file.point(point, self.units);
            }
            let value = r
                .first_number(i)
                .ok_or_else(|| refuse(r.id, "a trim without value"))?;
            let factor = match &curve.shape {
                Curve::Circle { .. } | Curve::Ellipse { .. } => self.units.angle_rad,
                Curve::Line { .. } => {
                    let vector = self.file.record(self.file.record(basis)?.reference(2)?)?;
                    vector.number(2)? * self.units.length_mm
                }
                _ => 1.0,
            };
            Ok(curve.shape.point(value * factor))
        };
        let range = edge_range(&curve.shape, [end(2)?, end(3)?], false, forward)
            .map_err(|reason| refuse(r.id, reason))?;
        Ok((curve.shape, range))
    }

    fn polyline(&self, r: &Record<'_>) -> Read<Curve> {
        let points = self.points(&r.references(1)?)?;
        let last = points.len().saturating_sub(1);
        let mut knots = vec![0.0];
        knots.extend((0..=last).map(|i| i as f64));
        knots.push(last as f64);
        let curve = NurbsCurve::new(1, &points, None, knots);
        curve
            .map(Curve::Nurbs)
            .map_err(|e| refuse(r.id, e.to_string()))
    }

    fn points(&self, ids: &[u64]) -> Read<Vec<DVec3>> {
        ids.iter()
            .map(|p| self.file.point(*p, self.units))
            .collect()
    }

    /// A B-spline curve of any of its types; `None` where `id` is no such curve.
    fn spline_curve(&self, id: u64) -> Read<Option<NurbsCurve>> {
        let Some((base, knots, weights)) = self.spline_parts(id, "CURVE", 6)? else {
            return Ok(None);
        };
        let degree = base.count(1)?;
        let points = self.points(&base.references(2)?)?;
        let knots = match knots {
            Some(k) => expand(id, &k.numbers(7)?, &counts(&k, 6)?)?,
            None => self.knots_by_rule(id, "CURVE", degree, points.len())?,
        };
        let weights = weights.map(|w| w.numbers(6)).transpose()?;
        NurbsCurve::new(degree, &points, weights.as_deref(), knots)
            .map(Some)
            .map_err(|e| refuse(id, e.to_string()))
    }

    /// A B-spline surface of any of its types; `None` where `id` is no such surface.
    fn spline_surface(&self, id: u64) -> Read<Option<NurbsSurface>> {
        let Some((base, knots, weights)) = self.spline_parts(id, "SURFACE", 8)? else {
            return Ok(None);
        };
        let degrees = [base.count(1)?, base.count(2)?];
        let rows = base.reference_rows(3)?;
        let width = rows.first().map_or(0, Vec::len);
        if rows.iter().any(|r| r.len() != width) || rows.len() * width > MAX_CONTROL_POINTS {
            return Err(refuse(
                id,
                format!(
                    "control points in rows of different length, or more than {MAX_CONTROL_POINTS}"
                ),
            ));
        }
        let points = self.points(&rows.concat())?;
        let knots = match knots {
            Some(k) => [
                expand(id, &k.numbers(10)?, &counts(&k, 8)?)?,
                expand(id, &k.numbers(11)?, &counts(&k, 9)?)?,
            ],
            None => [
                self.knots_by_rule(id, "SURFACE", degrees[0], rows.len())?,
                self.knots_by_rule(id, "SURFACE", degrees[1], width)?,
            ],
        };
        let weights = weights
            .map(|w| w.number_rows(8))
            .transpose()?
            .map(|w| w.concat());
        let shape = NurbsShape {
            degrees,
            counts: [rows.len(), width],
            knots,
        };
        NurbsSurface::new(shape, &points, weights.as_deref())
            .map(Some)
            .map_err(|e| refuse(id, e.to_string()))
    }

    /// Base, knots and weights of a B-spline `CURVE` or `SURFACE`, wherever its form puts them.
    ///
    /// Positions count as in the form of one type, where the base has `inherited` attributes with the name.
    #[allow(clippy::type_complexity)]
    fn spline_parts(
        &self,
        id: u64,
        what: &str,
        inherited: usize,
    ) -> Read<Option<(Record<'_>, Option<Record<'_>>, Option<Record<'_>>)>> {
        let base = format!("B_SPLINE_{what}");
        let with_knots = format!("B_SPLINE_{what}_WITH_KNOTS");
        let rational = format!("RATIONAL_B_SPLINE_{what}");
        if let Some(b) = self.file.part(id, &base, 1) {
            let k = self.file.part(id, &with_knots, inherited);
            return Ok(Some((b, k, self.file.part(id, &rational, inherited))));
        }
        let Ok(r) = self.file.record(id) else {
            return if self.file.entities().contains_key(&id) {
                Ok(None)
            } else {
                Err(refuse(id, "the file refers to it but does not contain it"))
            };
        };
        let ruled = ["QUASI_UNIFORM", "UNIFORM", "BEZIER"];
        if r.name == with_knots {
            return Ok(Some((r, Some(r), None)));
        }
        let by_rule = ruled.iter().any(|n| r.name == format!("{n}_{what}"));
        Ok(by_rule.then_some((r, None, None)))
    }

    /// The knots that the types without a knot vector imply.
    fn knots_by_rule(&self, id: u64, what: &str, degree: usize, points: usize) -> Read<Vec<f64>> {
        if degree == 0 || points <= degree || points > MAX_CONTROL_POINTS {
            return Err(refuse(
                id,
                format!("{points} control points for degree {degree}"),
            ));
        }
        let is = |n: &str| self.file.is(id, &format!("{n}_{what}"));
        let count = points + degree + 1;
        if is("UNIFORM") {
            return Ok((0..count).map(|i| i as f64 - degree as f64).collect());
        }
        let clamped = |i: usize| i.saturating_sub(degree).min(points - degree);
        if is("QUASI_UNIFORM") {
            return Ok((0..count).map(|i| clamped(i) as f64).collect());
        }
        if is("BEZIER") && (points - 1).is_multiple_of(degree) {
            let pieces = (points - 1) / degree;
            let knot = |i: usize| (i.saturating_sub(1) / degree).min(pieces) as f64;
            return Ok((0..count).map(knot).collect());
        }
        Err(refuse(
            id,
            format!("{} gives no knots", self.file.type_of(id)),
        ))
    }

    /// The surface `id`.
    pub fn surface(&self, id: u64) -> Read<Sensed<Surface>> {
        self.surface_at(id, 0)
    }

    fn surface_at(&self, id: u64, depth: usize) -> Read<Sensed<Surface>> {
        if depth > MAX_DEPTH {
            return Err(refuse(id, "a surface nested too deep"));
        }
        if let Some(s) = self.spline_surface(id)? {
            return Ok(Sensed::plain(Surface::Nurbs(Box::new(s))));
        }
        let r = self.file.record(id)?;
        let frame = || self.placement(r.reference(1)?);
        Ok(Sensed::plain(match r.name {
            "PLANE" => Surface::Plane(frame()?),
            "CYLINDRICAL_SURFACE" => Surface::Cylinder {
                frame: frame()?,
                radius_mm: self.length(&r, 2)?,
            },
            "CONICAL_SURFACE" => self.cone(&r, frame()?)?,
            "SPHERICAL_SURFACE" => Surface::Sphere {
                frame: frame()?,
                radius_mm: self.length(&r, 2)?,
            },
            "TOROIDAL_SURFACE" | "DEGENERATE_TOROIDAL_SURFACE" => Surface::Torus {
                frame: frame()?,
                major_mm: self.length(&r, 2)?,
                minor_mm: self.length(&r, 3)?,
            },
            "SURFACE_OF_LINEAR_EXTRUSION" => {
                let profile = self.curve_at(r.reference(1)?, depth + 1)?;
                return extruded(id, profile, self.vector(r.reference(2)?)?.normalize());
            }
            "SURFACE_OF_REVOLUTION" => {
                let profile = self.curve_at(r.reference(1)?, depth + 1)?;
                return revolved(id, profile, self.axis(r.reference(2)?)?);
            }
            "OFFSET_SURFACE" => {
                let basis = self.surface_at(r.reference(1)?, depth + 1)?;
                let sign = if basis.reversed { -1.0 } else { 1.0 };
                let distance_mm = sign * r.number(2)? * self.units.length_mm;
                return Ok(Sensed {
                    shape: offset(id, basis.shape, distance_mm)?,
                    reversed: basis.reversed,
                });
            }
            "RECTANGULAR_TRIMMED_SURFACE" => {
                let mut basis = self.surface_at(r.reference(1)?, depth + 1)?;
                basis.reversed ^= r.flag(6)? != r.flag(7)?;
                return Ok(basis);
            }
            "CURVE_BOUNDED_SURFACE" => return self.surface_at(r.reference(1)?, depth + 1),
            other => return Err(refuse(id, format!("a surface of type {other} is not read"))),
        }))
    }

    fn cone(&self, r: &Record<'_>, frame: Frame) -> Read<Surface> {
        let radius_mm = r.number(2)? * self.units.length_mm;
        let angle = r.number(3)? * self.units.angle_rad;
        if !(0.0..=1e9).contains(&radius_mm) || angle.abs() >= 1.57 {
            return Err(refuse(
                r.id,
                format!(
                    "a cone of {radius_mm} mm and {angle} rad, expected 0 to 1e9 mm and below 1.57 rad"
                ),
            ));
        }
        if angle.abs() < 1e-9 {
            return Ok(Surface::Cylinder { frame, radius_mm });
        }
        // A cone that narrows along its axis widens along the opposite one.
        let frame = if angle < 0.0 {
            Frame {
                y: -frame.y,
                z: -frame.z,
                ..frame
            }
        } else {
            frame
        };
        Ok(Surface::Cone {
            frame,
            radius_mm,
            half_angle_rad: angle.abs(),
        })
    }
}

/// Parameters of start and end of an edge on its curve.
pub(super) fn edge_range(
    curve: &Curve,
    [start, end]: [DVec3; 2],
    closed: bool,
    forward: bool,
) -> Result<(f64, f64), String> {
    let range = curve.range();
    let ((from, miss_from), (mut to, miss_to)) = (curve.nearest(start), curve.nearest(end));
    let size = start.distance(end) + start.length() + 1.0;
    let miss = miss_from.max(miss_to);
    if miss > 1e-2 * size {
        return Err(format!("its vertices lie {miss:.3e} mm beside its curve"));
    }
    let Some(period) = range.period() else {
        if closed || from == to {
            return Err(format!(
                "it starts and ends at one point of an open {}",
                curve.kind()
            ));
        }
        return Ok((from, to));
    };
    if closed {
        to = if forward {
            from + period
        } else {
            from - period
        };
        return Ok((from, to));
    }
    // Two vertices at one place, on a closed curve: the whole turn.
    let rounding = 1e-9 * period;
    if forward && to <= from + rounding {
        to += period;
    } else if !forward && to >= from - rounding {
        to -= period;
    }
    Ok((from, to))
}

/// Each knot as often as its multiplicity says.
fn expand(id: u64, knots: &[f64], multiplicities: &[usize]) -> Read<Vec<f64>> {
    let total: usize = multiplicities.iter().sum();
    if knots.len() != multiplicities.len() || total > MAX_CONTROL_POINTS {
        return Err(refuse(
            id,
            format!(
                "{} knots with {} multiplicities adding to {total}",
                knots.len(),
                multiplicities.len()
            ),
        ));
    }
    let pairs = knots.iter().zip(multiplicities);
    Ok(pairs
        .flat_map(|(k, m)| std::iter::repeat_n(*k, *m))
        .collect())
}

fn counts(r: &Record<'_>, i: usize) -> Read<Vec<usize>> {
    r.numbers(i)?
        .iter()
        .map(|n| {
            if (1.0..=1e6).contains(n) {
                Ok(*n as usize)
            } else {
                Err(refuse(
                    r.id,
                    format!("a knot multiplicity of {n}, expected 1 to 1e6"),
                ))
            }
        })
        .collect()
}

/// A surface with the reversal that makes its normal that of the sweep `du` x `dv` at a common point.
fn faced(shape: Surface, point: DVec3, normal: DVec3, reversed: bool) -> Sensed<Surface> {
    let (u, v) = shape.nearest(point, None);
    let against = shape.normal(u, v).is_some_and(|n| n.dot(normal) < 0.0);
    Sensed {
        shape,
        reversed: reversed ^ against,
    }
}

pub(super) fn extruded(id: u64, profile: Sensed<Curve>, along: DVec3) -> Read<Sensed<Surface>> {
    let [at, tangent, _] = profile.shape.derivatives(0.0);
    let bad = || refuse(id, "an extrusion along its own profile");
    match &profile.shape {
        Curve::Line { origin, direction } => {
            let normal = direction.cross(along);
            let frame =
                Frame::new(*origin, normal, *direction).filter(|_| normal.length() > PARALLEL);
            let plane = Surface::Plane(frame.ok_or_else(bad)?);
            Ok(faced(plane, at, normal, profile.reversed))
        }
        Curve::Circle { frame, radius_mm } if frame.z.cross(along).length() < PARALLEL => {
            let cylinder = Surface::Cylinder {
                frame: *frame,
                radius_mm: *radius_mm,
            };
            Ok(faced(cylinder, at, tangent.cross(along), profile.reversed))
        }
        _ => {
            let sweep = Sweep::along(profile.shape, along);
            let sweep = sweep.ok_or_else(|| refuse(id, "an extrusion of a curve without ends"))?;
            Ok(Sensed {
                shape: Surface::Swept(Box::new(sweep)),
                reversed: profile.reversed,
            })
        }
    }
}

pub(super) fn revolved(id: u64, profile: Sensed<Curve>, axis: Frame) -> Read<Sensed<Surface>> {
    let analytic = match &profile.shape {
        Curve::Line { origin, direction } => {
            Some(revolved_line(*origin, *direction, axis).ok_or_else(|| {
                refuse(
                    id,
                    "the revolution of a line that passes its axis (a hyperboloid) is not read",
                )
            })?)
        }
        Curve::Circle { frame, radius_mm } => revolved_circle(frame, *radius_mm, axis),
        _ => None,
    };
    let Some(surface) = analytic else {
        let sweep = Sweep::around(profile.shape, axis);
        let sweep = sweep.ok_or_else(|| refuse(id, "the revolution of a curve without ends"))?;
        return Ok(Sensed {
            shape: Surface::Swept(Box::new(sweep)),
            reversed: profile.reversed,
        });
    };
    // Anywhere off the axis tells which way the file's surface faces.
    let off_axis = |t: &f64| axis.local(profile.shape.point(*t)).truncate().length() > 1e-6;
    let t = [0.3, 1.7, 3.9].into_iter().find(off_axis);
    let [at, tangent, _] = profile.shape.derivatives(t.unwrap_or(0.3));
    let around = axis.z.cross(at - axis.origin);
    Ok(faced(surface, at, around.cross(tangent), profile.reversed))
}

/// Plane, cylinder or cone; `None` where line and axis share no plane.
fn revolved_line(origin: DVec3, direction: DVec3, axis: Frame) -> Option<Surface> {
    let from = axis.local(origin);
    let (dx, dy, dz) = (
        direction.dot(axis.x),
        direction.dot(axis.y),
        direction.dot(axis.z),
    );
    let across = (dx * dx + dy * dy).sqrt();
    if across < PARALLEL {
        let radius_mm = from.truncate().length();
        return (radius_mm > 0.0).then_some(Surface::Cylinder {
            frame: axis,
            radius_mm,
        });
    }
    if dz.abs() < PARALLEL {
        let frame = Frame {
            origin: axis.origin + axis.z * from.z,
            ..axis
        };
        return Some(Surface::Plane(frame));
    }
    // Where the line comes nearest the axis it must meet it: the apex.
    let t = -(from.x * dx + from.y * dy) / (across * across);
    let apex = origin + direction * t;
    let miss = axis.local(apex).truncate().length();
    if miss > 1e-6 * (1.0 + from.length()) {
        return None;
    }
    // The nappe of the line's given point; its far side is not part of the face.
    let side = if from.z >= axis.local(apex).z {
        1.0
    } else {
        -1.0
    };
    let frame = Frame {
        origin: apex,
        x: axis.x,
        y: axis.y * side,
        z: axis.z * side,
    };
    Some(Surface::Cone {
        frame,
        radius_mm: 0.0,
        half_angle_rad: (across / dz.abs()).atan(),
    })
}

/// Sphere or torus; `None` where circle and axis share no plane.
fn revolved_circle(circle: &Frame, radius_mm: f64, axis: Frame) -> Option<Surface> {
    let centre = axis.local(circle.origin);
    let major_mm = centre.truncate().length();
    let frame = Frame {
        origin: axis.origin + axis.z * centre.z,
        ..axis
    };
    let resolution = 1e-7 * (1.0 + centre.length());
    // The plane of the circle must hold the axis.
    if circle.z.dot(axis.z).abs() > PARALLEL
        || circle.z.dot(axis.origin - circle.origin).abs() > resolution
    {
        return None;
    }
    if major_mm <= resolution {
        return Some(Surface::Sphere { frame, radius_mm });
    }
    (major_mm >= radius_mm).then_some(Surface::Torus {
        frame,
        major_mm,
        minor_mm: radius_mm,
    })
}

pub(super) fn offset(id: u64, basis: Surface, distance_mm: f64) -> Result<Surface, Refused> {
    let grown = |r: f64| {
        if r + distance_mm > 0.0 {
            Ok(r + distance_mm)
        } else {
            Err(refuse(id, "an offset beyond the centre of its surface"))
        }
    };
    Ok(match basis {
        Surface::Plane(f) => Surface::Plane(Frame {
            origin: f.origin + f.z * distance_mm,
            ..f
        }),
        Surface::Cylinder { frame, radius_mm } => Surface::Cylinder {
            frame,
            radius_mm: grown(radius_mm)?,
        },
        Surface::Sphere { frame, radius_mm } => Surface::Sphere {
            frame,
            radius_mm: grown(radius_mm)?,
        },
        Surface::Torus {
            frame,
            major_mm,
            minor_mm,
        } => Surface::Torus {
            frame,
            major_mm,
            minor_mm: grown(minor_mm)?,
        },
        Surface::Cone {
            mut frame,
            radius_mm,
            half_angle_rad,
        } => {
            frame.origin -= frame.z * (distance_mm / half_angle_rad.sin());
            Surface::Cone {
                frame,
                radius_mm,
                half_angle_rad,
            }
        }
        other => {
            return Err(refuse(
                id,
                format!("an offset of a {} is not read", other.kind()),
            ));
        }
    })
}

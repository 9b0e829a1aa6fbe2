//! Analytic surfaces as implicit functions: negative inside, with gradients and the exact intervals of a ray.

use std::sync::Arc;

use glam::DVec3;

use super::mesh::Facets;
use super::polynomial::{bernstein_from_values, sign_changes};
use super::span::{Crossing, Ray, Span, Spans, Window};
use crate::pose::Pose;

/// Number of a surface in its [`Surfaces`](super::Surfaces).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SurfaceId(pub u32);

/// A surface that bounds a region of space; the region is where its value is not positive.
#[derive(Debug, Clone)]
pub struct Surface {
    /// For people.
    pub name: String,
    pub(super) shape: Shape,
}

/// Shapes in their own frame: axes along z, centres at the origin.
#[derive(Debug, Clone)]
pub(super) enum Shape {
    /// Held in the scene's frame, since it is by far the most frequent.
    Plane {
        normal: DVec3,
        offset: f64,
    },
    Cylinder {
        pose: Pose,
        radius: f64,
    },
    /// Apex at the origin, opening towards +z.
    Cone {
        pose: Pose,
        half_angle: f64,
    },
    Sphere {
        pose: Pose,
        radius: f64,
    },
    Torus {
        pose: Pose,
        major: f64,
        minor: f64,
    },
    HeightField {
        pose: Pose,
        field: HeightField,
    },
    Facets {
        pose: Pose,
        facets: Arc<Facets>,
    },
}

/// z as a bicubic Bezier function of x and y over a rectangle.
///
/// Its graph is a non-rational NURBS face of degree (3, 3): the control point (i, j) lies at thirds of the rectangle, at the
/// height `z[i][j]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeightField {
    /// Lower and upper x of the rectangle, mm.
    pub x: [f64; 2],
    /// Lower and upper y, mm.
    pub y: [f64; 2],
    /// Control heights, mm; the first index runs along x.
    pub z: [[f64; 4]; 4],
}

impl HeightField {
    /// Height at (x, y), mm; beyond the rectangle the same polynomial goes on.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.blend(
            cubic((x - self.x[0]) / (self.x[1] - self.x[0])),
            cubic((y - self.y[0]) / (self.y[1] - self.y[0])),
        )
    }

    fn blend(&self, a: [f64; 4], b: [f64; 4]) -> f64 {
        let row = |z: &[f64; 4]| b[0] * z[0] + b[1] * z[1] + b[2] * z[2] + b[3] * z[3];
        let [p, q, r, s] = &self.z;
        a[0] * row(p) + a[1] * row(q) + a[2] * row(r) + a[3] * row(s)
    }

    /// Derivatives of the height by x and by y.
    pub fn slopes(&self, x: f64, y: f64) -> [f64; 2] {
        let (w, h) = (self.x[1] - self.x[0], self.y[1] - self.y[0]);
        let (u, v) = ((x - self.x[0]) / w, (y - self.y[0]) / h);
        let (a, b) = (cubic(u), cubic(v));
        let (da, db) = (cubic_slope(u), cubic_slope(v));
        [self.blend(da, b) / w, self.blend(a, db) / h]
    }

    /// Least and greatest control height: the surface over the rectangle lies between them.
    pub fn range(&self) -> [f64; 2] {
        self.z
            .iter()
            .flatten()
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], &z| {
                [low.min(z), high.max(z)]
            })
    }
}

fn cubic(t: f64) -> [f64; 4] {
    let s = 1.0 - t;
    [s * s * s, 3.0 * s * s * t, 3.0 * s * t * t, t * t * t]
}

fn cubic_slope(t: f64) -> [f64; 4] {
    let s = 1.0 - t;
    [
        -3.0 * s * s,
        3.0 * s * s - 6.0 * s * t,
        6.0 * s * t - 3.0 * t * t,
        3.0 * t * t,
    ]
}

impl Surface {
    /// Everything below the plane through `point` with outward normal `normal`.
    pub fn plane(name: &str, point: DVec3, normal: DVec3) -> Surface {
        let normal = normal.normalize();
        let offset = normal.dot(point);
        Self::named(name, Shape::Plane { normal, offset })
    }

    /// Everything within `radius` of an axis.
    pub fn cylinder(name: &str, point: DVec3, axis: DVec3, radius: f64) -> Surface {
        let pose = Pose::along(point, axis);
        Self::named(name, Shape::Cylinder { pose, radius })
    }

    /// Everything in one nappe of a cone that opens from `apex` along `axis`.
    pub fn cone(name: &str, apex: DVec3, axis: DVec3, half_angle_rad: f64) -> Surface {
        let pose = Pose::along(apex, axis);
        let half_angle = half_angle_rad;
        Self::named(name, Shape::Cone { pose, half_angle })
    }

    /// Everything within `radius` of a centre.
    pub fn sphere(name: &str, centre: DVec3, radius: f64) -> Surface {
        let pose = Pose::shift(centre);
        Self::named(name, Shape::Sphere { pose, radius })
    }

    /// Everything within `radii[1]` of the circle of radius `radii[0]` about `axis`.
    pub fn torus(name: &str, centre: DVec3, axis: DVec3, radii: [f64; 2]) -> Surface {
        let pose = Pose::along(centre, axis);
        let [major, minor] = radii;
        Self::named(name, Shape::Torus { pose, major, minor })
    }

    /// Everything below the graph of a height field.
    pub fn height_field(name: &str, field: HeightField) -> Surface {
        let pose = Pose::IDENTITY;
        Self::named(name, Shape::HeightField { pose, field })
    }

    pub(super) fn facets(name: &str, facets: Facets) -> Surface {
        let pose = Pose::IDENTITY;
        let facets = Arc::new(facets);
        Self::named(name, Shape::Facets { pose, facets })
    }

    fn named(name: &str, shape: Shape) -> Surface {
        Surface {
            name: name.to_owned(),
            shape,
        }
    }

    /// Value of the implicit function, mm: negative inside, zero on the surface. It is the signed distance for all shapes but
    /// the height field (the height above it), the region around a cone's apex, and facets (`NaN`).
    pub fn value(&self, point: DVec3) -> f64 {
        match &self.shape {
            Shape::Plane { normal, offset } => normal.dot(point) - offset,
            Shape::Facets { .. } => f64::NAN,
            Shape::Cylinder { pose, radius } => {
                let p = local(pose, point);
                p.x.hypot(p.y) - radius
            }
            Shape::Cone { pose, half_angle } => {
                let p = local(pose, point);
                p.x.hypot(p.y) * half_angle.cos() - p.z * half_angle.sin()
            }
            Shape::Sphere { pose, radius } => (point - pose.translation).length() - radius,
            Shape::Torus { pose, major, minor } => {
                let p = local(pose, point);
                (p.x.hypot(p.y) - major).hypot(p.z) - minor
            }
            Shape::HeightField { pose, field } => {
                let p = local(pose, point);
                p.z - field.height(p.x, p.y)
            }
        }
    }

    /// Gradient of [`Surface::value`]; zero on an axis, where it has none, and for facets.
    pub fn gradient(&self, point: DVec3) -> DVec3 {
        match &self.shape {
            Shape::Plane { normal, .. } => *normal,
            Shape::Facets { .. } => DVec3::ZERO,
            Shape::Cylinder { pose, .. } => {
                let p = local(pose, point);
                pose.direction(DVec3::new(p.x, p.y, 0.0).normalize_or_zero())
            }
            Shape::Cone { pose, half_angle } => {
                let p = local(pose, point);
                let out = DVec3::new(p.x, p.y, 0.0).normalize_or_zero();
                pose.direction(out * half_angle.cos() - DVec3::Z * half_angle.sin())
            }
            Shape::Sphere { pose, .. } => (point - pose.translation).normalize_or_zero(),
            Shape::Torus { pose, major, .. } => {
                let p = local(pose, point);
                let out = DVec3::new(p.x, p.y, 0.0).normalize_or_zero();
                pose.direction((p - out * *major).normalize_or_zero())
            }
            Shape::HeightField { pose, field } => {
                let p = local(pose, point);
                let [sx, sy] = field.slopes(p.x, p.y);
                pose.direction(DVec3::new(-sx, -sy, 1.0))
            }
        }
    }

    /// Outward unit normal of the region at a point of the surface; `facet` is the one that was hit, where there are facets.
    pub fn normal(&self, point: DVec3, facet: u32) -> DVec3 {
        match &self.shape {
            Shape::Facets { pose, facets } => pose.direction(facets.normal(facet)),
            _ => self.gradient(point).normalize_or_zero(),
        }
    }

    pub(super) fn place(&mut self, placement: &Pose) {
        match &mut self.shape {
            Shape::Plane { normal, offset } => {
                let point = placement.point(*normal * *offset);
                *normal = placement.direction(*normal);
                *offset = normal.dot(point);
            }
            Shape::Cylinder { pose, .. }
            | Shape::Cone { pose, .. }
            | Shape::Sphere { pose, .. }
            | Shape::Torus { pose, .. }
            | Shape::HeightField { pose, .. }
            | Shape::Facets { pose, .. } => *pose = placement.after(*pose),
        }
    }

    /// The parts of the ray inside the region, within the window.
    pub(super) fn spans(&self, id: SurfaceId, ray: &Ray, window: Window) -> Spans {
        match &self.shape {
            Shape::Plane { normal, offset } => plane_spans(id, (*normal, *offset), ray, window),
            Shape::Cylinder { pose, radius } => {
                let (o, d) = local_ray(pose, ray);
                let a = d.x * d.x + d.y * d.y;
                let b = o.x * d.x + o.y * d.y;
                let c = o.x * o.x + o.y * o.y - radius * radius;
                convex_spans(id, (a, b, c), window)
            }
            Shape::Sphere { pose, radius } => {
                let o = ray.origin - pose.translation;
                let c = o.length_squared() - radius * radius;
                convex_spans(id, (1.0, o.dot(ray.direction), c), window)
            }
            Shape::Cone { pose, half_angle } => {
                cone_spans(id, local_ray(pose, ray), *half_angle, window)
            }
            Shape::Torus { pose, major, minor } => {
                torus_spans(id, local_ray(pose, ray), [*major, *minor], window)
            }
            Shape::HeightField { pose, field } => {
                field_spans(id, local_ray(pose, ray), field, window)
            }
            Shape::Facets { pose, facets } => {
                let (o, d) = local_ray(pose, ray);
                facets.spans(id, &Ray::along(o, d), window)
            }
        }
    }
}

fn local(pose: &Pose, point: DVec3) -> DVec3 {
    pose.rotation.transpose() * (point - pose.translation)
}

fn local_ray(pose: &Pose, ray: &Ray) -> (DVec3, DVec3) {
    let back = pose.rotation.transpose();
    (back * (ray.origin - pose.translation), back * ray.direction)
}

fn plane_spans(id: SurfaceId, plane: (DVec3, f64), ray: &Ray, window: Window) -> Spans {
    let mut spans = window.whole();
    spans.retain(|span| span.cut(plane, id, ray));
    spans
}

/// Spans of a convex region a t^2 + 2 b t + c <= 0 with a >= 0.
fn convex_spans(id: SurfaceId, (a, b, c): (f64, f64, f64), window: Window) -> Spans {
    if a < 1e-24 {
        return if c <= 0.0 {
            window.whole()
        } else {
            Spans::new()
        };
    }
    match quadratic(a, b, c) {
        Some([t1, t2]) => window.keep(Crossing::at(t1, id), Crossing::at(t2, id)),
        None => Spans::new(),
    }
}

/// Both roots of a t^2 + 2 b t + c, ascending, without cancellation.
fn quadratic(a: f64, b: f64, c: f64) -> Option<[f64; 2]> {
    let discriminant = b * b - a * c;
    if discriminant <= 0.0 {
        return None;
    }
    let q = -(b + discriminant.sqrt().copysign(b));
    let (t1, t2) = (q / a, c / q);
    Some([t1.min(t2), t1.max(t2)])
}

fn cone_spans(id: SurfaceId, (o, d): (DVec3, DVec3), half_angle: f64, window: Window) -> Spans {
    let (sin, cos) = half_angle.sin_cos();
    let (s2, c2) = (sin * sin, cos * cos);
    let a = (d.x * d.x + d.y * d.y) * c2 - d.z * d.z * s2;
    let b = (o.x * d.x + o.y * d.y) * c2 - o.z * d.z * s2;
    let c = (o.x * o.x + o.y * o.y) * c2 - o.z * o.z * s2;
    let z = |t: f64| o.z + t * d.z;
    if a.abs() < 1e-14 {
        // parallel to a generator: one crossing, and inside for ever on its far or near side
        let crossing = Crossing::at(-c / (2.0 * b), id);
        return match (b != 0.0 && z(crossing.t) >= 0.0, b < 0.0) {
            (false, _) => Spans::new(),
            (true, true) => window.keep(crossing, Crossing::OPEN_END),
            (true, false) => window.keep(Crossing::OPEN_START, crossing),
        };
    }
    let [t1, t2] = match quadratic(a, b, c) {
        Some(roots) => roots,
        // a steep ray always meets both nappes, if only in the apex
        None if a < 0.0 => [-b / a; 2],
        None => return Spans::new(),
    };
    let (first, second) = (Crossing::at(t1, id), Crossing::at(t2, id));
    if a > 0.0 {
        if z(0.5 * (t1 + t2)) > 0.0 {
            window.keep(first, second)
        } else {
            Spans::new()
        }
    } else if d.z > 0.0 {
        window.keep(second, Crossing::OPEN_END)
    } else {
        window.keep(Crossing::OPEN_START, first)
    }
}

fn torus_spans(
    id: SurfaceId,
    (o, d): (DVec3, DVec3),
    [major, minor]: [f64; 2],
    window: Window,
) -> Spans {
    let reach = (major + minor) * (1.0 + 1e-9);
    let Some([t1, t2]) = quadratic(1.0, o.dot(d), o.length_squared() - reach * reach) else {
        return Spans::new();
    };
    let Some(inner) = window.narrowed(t1, t2) else {
        return Spans::new();
    };
    // degree 4 in t, scaled to about one
    let scale = 1.0 / (reach * reach * minor * minor);
    let quartic = |t: f64| {
        let p = o + t * d;
        let k = p.length_squared() + major * major - minor * minor;
        (k * k - 4.0 * major * major * (p.x * p.x + p.y * p.y)) * scale
    };
    inside_between::<5>(id, quartic, inner)
}

/// Spans where a polynomial of degree `N - 1` is negative; the window must be finite.
fn inside_between<const N: usize>(
    id: SurfaceId,
    polynomial: impl Fn(f64) -> f64,
    window: Window,
) -> Spans {
    let length = window.to - window.from;
    let values: [f64; N] =
        std::array::from_fn(|i| polynomial(window.from + length * i as f64 / (N - 1) as f64));
    let coefficients = bernstein_from_values(&values);
    let mut inside = coefficients[0] < 0.0;
    let mut start = Crossing::OPEN_START.moved(window.from);
    let mut spans = Spans::new();
    for root in sign_changes(coefficients) {
        let crossing = Crossing::at(window.from + length * root, id);
        if inside {
            spans.push(Span {
                enter: start,
                leave: crossing,
            });
        }
        start = crossing;
        inside = !inside;
    }
    if inside {
        spans.push(Span {
            enter: start,
            leave: Crossing::OPEN_END.moved(window.to),
        });
    }
    spans
}

fn field_spans(
    id: SurfaceId,
    (o, d): (DVec3, DVec3),
    field: &HeightField,
    window: Window,
) -> Spans {
    // between the planes of least and greatest height the graph may be met, above never, below always
    let [low, high] = field.range();
    let (low, high) = (low - 1e-6, high + 1e-6);
    let (mut near, mut far) = ((low - o.z) / d.z, (high - o.z) / d.z);
    let rising = d.z > 0.0;
    if d.z.abs() < 1e-12 {
        (near, far) = (f64::NEG_INFINITY, f64::INFINITY);
        if o.z > high {
            return Spans::new();
        } else if o.z < low {
            return window.whole();
        }
    } else if !rising {
        (near, far) = (far, near);
    }
    let mut spans = Spans::new();
    if rising && window.from < near {
        spans.extend(window.keep(Crossing::OPEN_START, Crossing::OPEN_END.moved(near)));
    }
    if let Some(inner) = window.narrowed(near, far) {
        let (w, h) = (
            1.0 / (field.x[1] - field.x[0]),
            1.0 / (field.y[1] - field.y[0]),
        );
        let (u, du) = ((o.x - field.x[0]) * w, d.x * w);
        let (v, dv) = ((o.y - field.y[0]) * h, d.y * h);
        let height = |t: f64| o.z + t * d.z - field.blend(cubic(u + t * du), cubic(v + t * dv));
        for span in inside_between::<7>(id, height, inner) {
            super::span::append(&mut spans, span);
        }
    }
    if !rising && far < window.to {
        for span in window.keep(Crossing::OPEN_START.moved(far), Crossing::OPEN_END) {
            super::span::append(&mut spans, span);
        }
    }
    spans
}

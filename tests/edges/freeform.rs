//! A body with one free-form edge: a wavy top and a wavy wall, curved both ways, with exact feet by Newton's method.

use acies::inspect::body::{Body, BodyEdge, BodySample};
use acies::nominal::{EdgeKind, Foot, Station};
use glam::{DMat2, DVec2, DVec3};

/// Top z = f(x, y) for y > g(x); wall y = g(x) below it, seen from -y.
pub struct FreeForm {
    pub length_x: f64,
    depth: f64,
    /// Arc length of the edge at x = k * STEP.
    arc: Vec<f64>,
    /// Whether the surfaces end where the faces do, as those of CAD files may: a foot beyond the edge is then on the edge.
    ends: bool,
}

const STEP: f64 = 0.01;

fn top(x: f64, y: f64) -> (f64, DVec2, DMat2) {
    let (sx, cx) = (0.25 * x).sin_cos();
    let (sy, cy) = (0.20 * y + 0.4).sin_cos();
    let value = 0.8 * sx + 1.2 * cy;
    let gradient = DVec2::new(0.2 * cx, -0.24 * sy);
    let hessian = DMat2::from_cols(DVec2::new(-0.05 * sx, 0.0), DVec2::new(0.0, -0.048 * cy));
    (value, gradient, hessian)
}

fn wall(x: f64) -> (f64, f64, f64) {
    let (s, c) = (0.3 * x + 0.5).sin_cos();
    (1.1 * s, 0.33 * c, -0.099 * s)
}

impl FreeForm {
    pub fn new() -> Self {
        let length_x = 30.0;
        let mut arc = vec![0.0];
        let mut sum = 0.0;
        for k in 0..(length_x / STEP) as usize {
            // Simpson's rule a step.
            let speed = |x: f64| Self::tangent(x).length();
            let x = k as f64 * STEP;
            sum += STEP / 6.0 * (speed(x) + 4.0 * speed(x + 0.5 * STEP) + speed(x + STEP));
            arc.push(sum);
        }
        Self {
            length_x,
            depth: 8.0,
            arc,
            ends: false,
        }
    }

    /// The same body on surfaces that end at its edge.
    pub fn ending() -> Self {
        Self {
            ends: true,
            ..Self::new()
        }
    }

    /// The place of the edge nearest to `p`: x, y, z.
    fn on_edge(p: DVec3) -> DVec3 {
        let at = |x: f64| DVec3::new(x, wall(x).0, top(x, wall(x).0).0);
        let mut x = p.x;
        for _ in 0..30 {
            let t = Self::tangent(x);
            x += (p - at(x)).dot(t) / t.length_squared();
        }
        at(x)
    }

    fn tangent(x: f64) -> DVec3 {
        let (y, dy, _) = wall(x);
        let (_, g, _) = top(x, y);
        DVec3::new(1.0, dy, g.x + g.y * dy)
    }

    fn x_at(&self, s: f64) -> f64 {
        let k = self
            .arc
            .partition_point(|a| *a < s)
            .clamp(1, self.arc.len() - 1);
        let (a, b) = (self.arc[k - 1], self.arc[k]);
        ((k - 1) as f64 + (s - a) / (b - a)) * STEP
    }
}

impl Body for FreeForm {
    fn face_count(&self) -> usize {
        2
    }

    fn face_entity(&self, face: u32) -> u64 {
        10 + u64::from(face)
    }

    fn foot(&self, face: u32, p: DVec3, _near: Option<(f64, f64)>) -> Option<Foot> {
        if face == 0 {
            let mut at = DVec2::new(p.x, p.y);
            for _ in 0..30 {
                let (z, g, h) = top(at.x, at.y);
                let off = z - p.z;
                let slope = at - DVec2::new(p.x, p.y) + off * g;
                let outer = DMat2::from_cols(g * g.x, g * g.y);
                let step = (DMat2::IDENTITY + outer + off * h).inverse() * slope;
                at -= step;
                if step.length() < 1e-13 {
                    break;
                }
            }
            if self.ends && at.y < wall(at.x).0 {
                at = Self::on_edge(p).truncate();
            }
            let (z, g, _) = top(at.x, at.y);
            return Some(Foot {
                uv: (at.x, at.y),
                point: DVec3::new(at.x, at.y, z),
                normal: DVec3::new(-g.x, -g.y, 1.0).normalize(),
            });
        }
        let mut x = p.x;
        for _ in 0..30 {
            let (y, d, dd) = wall(x);
            let step = (x - p.x + (y - p.y) * d) / (1.0 + d * d + (y - p.y) * dd);
            x -= step;
            if step.abs() < 1e-13 {
                break;
            }
        }
        let mut z = p.z;
        if self.ends && z > top(x, wall(x).0).0 {
            let edge = Self::on_edge(p);
            (x, z) = (edge.x, edge.z);
        }
        let (y, d, _) = wall(x);
        Some(Foot {
            uv: (x, z),
            point: DVec3::new(x, y, z),
            normal: DVec3::new(d, -1.0, 0.0).normalize(),
        })
    }

    fn contains(&self, face: u32, (u, v): (f64, f64)) -> bool {
        let (y, ..) = wall(u);
        let inside = (0.0..=self.length_x).contains(&u);
        inside
            && if face == 0 {
                (y..=y + self.depth).contains(&v)
            } else {
                let (z, ..) = top(u, y);
                (z - self.depth..=z).contains(&v)
            }
    }

    fn samples(&self, spacing_mm: f64) -> Vec<BodySample> {
        let mut samples = Vec::new();
        let along = (self.length_x / spacing_mm).ceil() as usize;
        let across = (self.depth / spacing_mm).ceil() as usize;
        for i in 0..along {
            let x = (i as f64 + 0.5) / along as f64 * self.length_x;
            let (wall_y, slope, _) = wall(x);
            let (edge_z, ..) = top(x, wall_y);
            for j in 0..across {
                let r = (j as f64 + 0.5) / across as f64 * self.depth;
                let (z, g, _) = top(x, wall_y + r);
                samples.push(BodySample {
                    point: DVec3::new(x, wall_y + r, z),
                    normal: DVec3::new(-g.x, -g.y, 1.0).normalize(),
                    face: 0,
                    uv: (x, wall_y + r),
                });
                samples.push(BodySample {
                    point: DVec3::new(x, wall_y, edge_z - r),
                    normal: DVec3::new(slope, -1.0, 0.0).normalize(),
                    face: 1,
                    uv: (x, edge_z - r),
                });
            }
        }
        samples
    }

    fn edges(&self) -> Vec<BodyEdge> {
        vec![BodyEdge {
            id: "e1".to_string(),
            entity: 1000,
            faces: [0, 1],
            kind: EdgeKind::Convex,
            length_mm: *self.arc.last().expect("not empty"),
            closed: false,
        }]
    }

    fn station(&self, _edge: usize, s_mm: f64) -> Station {
        let x = self.x_at(s_mm);
        let (y, slope, _) = wall(x);
        let (z, g, _) = top(x, y);
        let tangent = Self::tangent(x).normalize();
        let normals = [
            DVec3::new(-g.x, -g.y, 1.0).normalize(),
            DVec3::new(slope, -1.0, 0.0).normalize(),
        ];
        let into = |n: DVec3, hint: DVec3| {
            let b = tangent.cross(n).normalize();
            if b.dot(hint) > 0.0 { b } else { -b }
        };
        Station {
            s_mm,
            point: DVec3::new(x, y, z),
            tangent,
            normals,
            into_face: [into(normals[0], DVec3::Y), into(normals[1], -DVec3::Z)],
        }
    }

    fn bounds(&self) -> [DVec3; 2] {
        let points = self.samples(1.0);
        let fold = |pick: fn(DVec3, DVec3) -> DVec3| {
            points
                .iter()
                .map(|s| s.point)
                .reduce(pick)
                .expect("samples")
        };
        [fold(DVec3::min), fold(DVec3::max)]
    }
}

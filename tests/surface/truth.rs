//! Bodies whose surface and edges are known exactly, points on them, and how far an answer lies from the truth.

// The tests and the bench each use a part.
#![allow(dead_code)]

use glam::DVec3;

/// A piece of a body's boundary.
pub enum Face {
    /// A rectangle from `corner` along two orthogonal sides, less circular holes (centre in mm along the sides, radius).
    Rectangle {
        corner: DVec3,
        sides: [DVec3; 2],
        holes: Vec<(f64, f64, f64)>,
    },
    /// The wall of a round hole from `base` along `axis` (its length is the depth).
    Wall {
        base: DVec3,
        axis: DVec3,
        radius: f64,
    },
}

/// A sharp edge.
pub enum Edge {
    Segment(DVec3, DVec3),
    /// Centre, unit axis, radius.
    Circle(DVec3, DVec3, f64),
}

/// A body.
pub struct Body {
    pub faces: Vec<Face>,
    pub edges: Vec<Edge>,
}

/// Random numbers, SplitMix64.
pub struct Dice(pub u64);

impl Dice {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in 0..1.
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let (a, b) = (1.0 - self.unit(), self.unit());
        (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }

    /// Standard normal in three directions.
    pub fn cloud(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }

    /// Uniform in the ball of radius one.
    pub fn ball(&mut self) -> DVec3 {
        loop {
            let p = DVec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0;
            if p.length_squared() <= 1.0 {
                return p;
            }
        }
    }
}

impl Face {
    pub fn rectangle(corner: DVec3, u: DVec3, v: DVec3, holes: &[(f64, f64, f64)]) -> Self {
        Face::Rectangle {
            corner,
            sides: [u, v],
            holes: holes.to_vec(),
        }
    }

    pub fn area(&self) -> f64 {
        match self {
            Face::Rectangle { sides, holes, .. } => {
                let cut: f64 = holes.iter().map(|h| std::f64::consts::PI * h.2 * h.2).sum();
                sides[0].length() * sides[1].length() - cut
            }
            Face::Wall { axis, radius, .. } => std::f64::consts::TAU * radius * axis.length(),
        }
    }

    /// A point, uniform by area.
    pub fn sample(&self, dice: &mut Dice) -> DVec3 {
        match self {
            Face::Rectangle {
                corner,
                sides,
                holes,
            } => loop {
                let (a, b) = (dice.unit(), dice.unit());
                let (x, y) = (a * sides[0].length(), b * sides[1].length());
                if holes.iter().all(|h| (x - h.0).hypot(y - h.1) >= h.2) {
                    return *corner + sides[0] * a + sides[1] * b;
                }
            },
            Face::Wall { base, axis, radius } => {
                let (u, v) = axis.normalize().any_orthonormal_pair();
                let (s, c) = (dice.unit() * std::f64::consts::TAU).sin_cos();
                *base + *axis * dice.unit() + (u * c + v * s) * *radius
            }
        }
    }

    /// Nearest point of the face, and its unit normal there.
    pub fn nearest(&self, p: DVec3) -> (DVec3, DVec3) {
        match self {
            Face::Rectangle {
                corner,
                sides,
                holes,
            } => {
                let [a, b] = sides.map(|s| s.length());
                let (u, v) = (sides[0] / a, sides[1] / b);
                let d = p - *corner;
                let (mut x, mut y) = (d.dot(u).clamp(0.0, a), d.dot(v).clamp(0.0, b));
                for h in holes {
                    let (dx, dy) = (x - h.0, y - h.1);
                    let r = dx.hypot(dy);
                    if r < h.2 {
                        let (ex, ey) = if r > 0.0 {
                            (dx / r, dy / r)
                        } else {
                            (1.0, 0.0)
                        };
                        (x, y) = (h.0 + ex * h.2, h.1 + ey * h.2);
                    }
                }
                (*corner + u * x + v * y, u.cross(v))
            }
            Face::Wall { base, axis, radius } => {
                let along = axis.normalize();
                let d = p - *base;
                let z = d.dot(along);
                let out = (d - along * z).normalize_or(along.any_orthonormal_vector());
                (
                    *base + along * z.clamp(0.0, axis.length()) + out * *radius,
                    out,
                )
            }
        }
    }

    /// Distance along the unit `ray` from `from` to the face, where it is hit.
    pub fn hit(&self, from: DVec3, ray: DVec3) -> Vec<f64> {
        match self {
            Face::Rectangle {
                corner,
                sides,
                holes,
            } => {
                let [a, b] = sides.map(|s| s.length());
                let (u, v) = (sides[0] / a, sides[1] / b);
                let n = u.cross(v);
                if n.dot(ray).abs() < 1e-12 {
                    return Vec::new();
                }
                let t = n.dot(*corner - from) / n.dot(ray);
                let d = from + ray * t - *corner;
                let (x, y) = (d.dot(u), d.dot(v));
                let inside = (0.0..=a).contains(&x) && (0.0..=b).contains(&y);
                if inside && holes.iter().all(|h| (x - h.0).hypot(y - h.1) >= h.2) {
                    vec![t]
                } else {
                    Vec::new()
                }
            }
            Face::Wall { base, axis, radius } => {
                let along = axis.normalize();
                let across = |d: DVec3| d - along * d.dot(along);
                let (f, r) = (across(from - *base), across(ray));
                let (a, b, c) = (
                    r.length_squared(),
                    f.dot(r),
                    f.length_squared() - radius * radius,
                );
                let root = b * b - a * c;
                if root <= 0.0 || a <= 0.0 {
                    return Vec::new();
                }
                [(-b - root.sqrt()) / a, (-b + root.sqrt()) / a]
                    .into_iter()
                    .filter(|t| {
                        (0.0..=axis.length()).contains(&(from + ray * *t - *base).dot(along))
                    })
                    .collect()
            }
        }
    }
}

impl Edge {
    pub fn length(&self) -> f64 {
        match self {
            Edge::Segment(a, b) => a.distance(*b),
            Edge::Circle(_, _, r) => std::f64::consts::TAU * r,
        }
    }

    /// The point at part `t` of the edge.
    pub fn at(&self, t: f64) -> DVec3 {
        match self {
            Edge::Segment(a, b) => a.lerp(*b, t),
            Edge::Circle(c, n, r) => {
                let (u, v) = n.any_orthonormal_pair();
                let (s, o) = (t * std::f64::consts::TAU).sin_cos();
                *c + (u * o + v * s) * *r
            }
        }
    }

    pub fn distance(&self, p: DVec3) -> f64 {
        match self {
            Edge::Segment(a, b) => {
                let d = *b - *a;
                let t = ((p - *a).dot(d) / d.length_squared()).clamp(0.0, 1.0);
                p.distance(*a + d * t)
            }
            Edge::Circle(c, n, r) => {
                let d = p - *c;
                let z = d.dot(*n);
                ((d - *n * z).length() - r).hypot(z)
            }
        }
    }
}

impl Body {
    pub fn area(&self) -> f64 {
        self.faces.iter().map(Face::area).sum()
    }

    /// Distance to the surface.
    pub fn distance(&self, p: DVec3) -> f64 {
        self.faces
            .iter()
            .map(|f| f.nearest(p).0.distance(p))
            .fold(f64::INFINITY, f64::min)
    }

    /// Distance to the nearest sharp edge.
    pub fn edge_distance(&self, p: DVec3) -> f64 {
        self.edges
            .iter()
            .map(|e| e.distance(p))
            .fold(f64::INFINITY, f64::min)
    }

    /// `count` points, uniform by area, and the face each lies on.
    pub fn points(&self, count: usize, dice: &mut Dice) -> Vec<(DVec3, usize)> {
        let area = self.area();
        let mut ends = Vec::new();
        let mut sum = 0.0;
        for face in &self.faces {
            sum += face.area();
            ends.push(sum / area);
        }
        (0..count)
            .map(|_| {
                let t = dice.unit();
                let face = ends
                    .iter()
                    .position(|e| t < *e)
                    .unwrap_or(self.faces.len() - 1);
                (self.faces[face].sample(dice), face)
            })
            .collect()
    }

    /// What parallel rays see of the body: lines `across` apart, points `along` apart on a line, noise of `sigma` along the rays.
    pub fn scan(
        &self,
        towards: DVec3,
        (along, across): (f64, f64),
        (sigma, dice): (f64, &mut Dice),
    ) -> Vec<Seen> {
        let ray = -towards.normalize();
        let u = ray.cross(DVec3::new(0.3, 1.0, 0.2)).normalize();
        let v = ray.cross(u);
        let centre = DVec3::new(50.0, 30.0, 15.0);
        let mut seen = Vec::new();
        let lines = (80.0 / across) as i64;
        let columns = (80.0 / along) as i64;
        for line in -lines..=lines {
            for column in -columns..=columns {
                let from =
                    centre + v * (line as f64 * across) + u * (column as f64 * along) - ray * 200.0;
                let mut first = (f64::INFINITY, 0);
                for (index, face) in self.faces.iter().enumerate() {
                    for t in face.hit(from, ray) {
                        if t < first.0 {
                            first = (t, index);
                        }
                    }
                }
                if first.0.is_finite() {
                    let clean = from + ray * first.0;
                    seen.push(Seen {
                        noisy: clean + ray * (sigma * dice.normal()),
                        clean,
                        face: first.1,
                    });
                }
            }
        }
        seen
    }
}

/// A measured point with its truth.
#[derive(Clone, Copy)]
pub struct Seen {
    pub noisy: DVec3,
    pub clean: DVec3,
    pub face: usize,
}

fn box_edges(low: DVec3, high: DVec3) -> Vec<Edge> {
    let p = |x: bool, y: bool, z: bool| {
        DVec3::new(
            if x { high.x } else { low.x },
            if y { high.y } else { low.y },
            if z { high.z } else { low.z },
        )
    };
    let mut edges = Vec::new();
    for (a, b) in [(false, false), (false, true), (true, false), (true, true)] {
        edges.push(Edge::Segment(p(false, a, b), p(true, a, b)));
        edges.push(Edge::Segment(p(a, false, b), p(a, true, b)));
        edges.push(Edge::Segment(p(a, b, false), p(a, b, true)));
    }
    edges
}

/// A cube of side 10 around the origin with a hole of radius 2 along z.
pub fn cube_with_hole() -> Body {
    let (x, y, z) = (DVec3::X * 10.0, DVec3::Y * 10.0, DVec3::Z * 10.0);
    let c = DVec3::splat(-5.0);
    let hole = [(5.0, 5.0, 2.0)];
    let faces = vec![
        Face::rectangle(c, x, y, &hole),
        Face::rectangle(c + z, x, y, &hole),
        Face::rectangle(c, y, z, &[]),
        Face::rectangle(c + x, y, z, &[]),
        Face::rectangle(c, z, x, &[]),
        Face::rectangle(c + y, z, x, &[]),
        Face::Wall {
            base: DVec3::new(0.0, 0.0, -5.0),
            axis: z,
            radius: 2.0,
        },
    ];
    let mut edges = box_edges(c, -c);
    edges.push(Edge::Circle(DVec3::new(0.0, 0.0, -5.0), DVec3::Z, 2.0));
    edges.push(Edge::Circle(DVec3::new(0.0, 0.0, 5.0), DVec3::Z, 2.0));
    Body { faces, edges }
}

/// Points of [`cube_with_hole`] in a regular pattern with points on the edges, about 17,400 at `n` = 52 intervals a side.
pub fn cube_with_hole_points(n: usize) -> Vec<(DVec3, usize)> {
    let body = cube_with_hole();
    let step = 10.0 / n as f64;
    let mut points = Vec::new();
    let edge_free = |p: DVec3| p.x.hypot(p.y) > 2.0 + 0.5 * step;
    for (index, face) in body.faces.iter().enumerate() {
        match face {
            Face::Rectangle { corner, sides, .. } => {
                for i in 0..=n {
                    for j in 0..=n {
                        let p = *corner
                            + sides[0] * (i as f64 / n as f64)
                            + sides[1] * (j as f64 / n as f64);
                        if index > 1 || edge_free(p) {
                            points.push((p, index));
                        }
                    }
                }
            }
            Face::Wall { base, axis, radius } => {
                let around = (std::f64::consts::TAU * radius / step).round() as usize;
                for i in 0..=n {
                    for j in 0..around {
                        let (s, c) = (std::f64::consts::TAU * j as f64 / around as f64).sin_cos();
                        points.push((
                            *base + *axis * (i as f64 / n as f64) + DVec3::new(c, s, 0.0) * *radius,
                            index,
                        ));
                    }
                }
            }
        }
    }
    let key = |p: DVec3| (p * 1e6).round().as_i64vec3().to_array();
    let mut known = std::collections::HashSet::new();
    points.retain(|(p, _)| known.insert(key(*p)));
    points
}

/// A block of 100 x 60 x 30 with a step down to 15 and two through holes.
pub fn stepped_block() -> Body {
    let v = DVec3::new;
    let (a, b) = ((30.0, 30.0, 10.0), (80.0, 30.0, 6.0));
    let side = |y: f64| {
        [
            Face::rectangle(v(0.0, y, 0.0), v(60.0, 0.0, 0.0), v(0.0, 0.0, 30.0), &[]),
            Face::rectangle(v(60.0, y, 0.0), v(40.0, 0.0, 0.0), v(0.0, 0.0, 15.0), &[]),
        ]
    };
    let mut faces = vec![
        Face::rectangle(
            v(0.0, 0.0, 0.0),
            v(100.0, 0.0, 0.0),
            v(0.0, 60.0, 0.0),
            &[a, b],
        ),
        Face::rectangle(
            v(0.0, 0.0, 30.0),
            v(60.0, 0.0, 0.0),
            v(0.0, 60.0, 0.0),
            &[a],
        ),
        Face::rectangle(
            v(60.0, 0.0, 15.0),
            v(40.0, 0.0, 0.0),
            v(0.0, 60.0, 0.0),
            &[(20.0, 30.0, 6.0)],
        ),
        Face::rectangle(v(0.0, 0.0, 0.0), v(0.0, 60.0, 0.0), v(0.0, 0.0, 30.0), &[]),
        Face::rectangle(
            v(60.0, 0.0, 15.0),
            v(0.0, 60.0, 0.0),
            v(0.0, 0.0, 15.0),
            &[],
        ),
        Face::rectangle(
            v(100.0, 0.0, 0.0),
            v(0.0, 60.0, 0.0),
            v(0.0, 0.0, 15.0),
            &[],
        ),
    ];
    faces.extend(side(0.0));
    faces.extend(side(60.0));
    let hole = |x: f64, depth: f64, radius: f64| Face::Wall {
        base: v(x, 30.0, 0.0),
        axis: v(0.0, 0.0, depth),
        radius,
    };
    faces.push(hole(30.0, 30.0, 10.0));
    faces.push(hole(80.0, 15.0, 6.0));

    let profile = [
        (0.0, 0.0),
        (100.0, 0.0),
        (100.0, 15.0),
        (60.0, 15.0),
        (60.0, 30.0),
        (0.0, 30.0),
    ];
    let mut edges = Vec::new();
    for (i, p) in profile.iter().enumerate() {
        let q = profile[(i + 1) % profile.len()];
        for y in [0.0, 60.0] {
            edges.push(Edge::Segment(v(p.0, y, p.1), v(q.0, y, q.1)));
        }
        edges.push(Edge::Segment(v(p.0, 0.0, p.1), v(p.0, 60.0, p.1)));
    }
    for (x, depth, radius) in [(30.0, 30.0, 10.0), (80.0, 15.0, 6.0)] {
        edges.push(Edge::Circle(v(x, 30.0, 0.0), DVec3::Z, radius));
        edges.push(Edge::Circle(v(x, 30.0, depth), DVec3::Z, radius));
    }
    Body { faces, edges }
}

/// Two square plates of side 20 that meet along the y axis at an included angle.
pub fn ridge(included_deg: f64) -> Body {
    let half = (included_deg / 2.0).to_radians();
    let y = DVec3::Y * 20.0;
    let down = |sign: f64| DVec3::new(sign * half.sin(), 0.0, -half.cos()) * 20.0;
    Body {
        faces: vec![
            Face::rectangle(DVec3::ZERO, y, down(1.0), &[]),
            Face::rectangle(DVec3::ZERO, y, down(-1.0), &[]),
        ],
        edges: vec![Edge::Segment(DVec3::ZERO, y)],
    }
}

/// Two parallel square plates of side 20, `gap` apart; no edge.
pub fn plates(gap: f64) -> Body {
    let (x, y) = (DVec3::X * 20.0, DVec3::Y * 20.0);
    Body {
        faces: vec![
            Face::rectangle(DVec3::ZERO, x, y, &[]),
            Face::rectangle(DVec3::Z * gap, x, y, &[]),
        ],
        edges: vec![Edge::Segment(DVec3::splat(1e6), DVec3::splat(1e6 + 1.0))],
    }
}

/// A slot of the given width and depth in a plate of side 20, closed at its ends by nothing.
pub fn slot(width: f64, depth: f64) -> Body {
    let y = DVec3::Y * 20.0;
    let v = |x: f64, z: f64| DVec3::new(x, 0.0, z);
    let w = 0.5 * width;
    Body {
        faces: vec![
            Face::rectangle(v(-10.0, 0.0), DVec3::X * (10.0 - w), y, &[]),
            Face::rectangle(v(w, 0.0), DVec3::X * (10.0 - w), y, &[]),
            Face::rectangle(v(-w, -depth), DVec3::X * width, y, &[]),
            Face::rectangle(v(-w, -depth), DVec3::Z * depth, y, &[]),
            Face::rectangle(v(w, -depth), DVec3::Z * depth, y, &[]),
        ],
        edges: [(-w, 0.0), (w, 0.0), (-w, -depth), (w, -depth)]
            .map(|(x, z)| Edge::Segment(v(x, z), v(x, z) + y))
            .into(),
    }
}

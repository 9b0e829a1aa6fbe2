//! Exact solids with exact edges, and clouds sampled or scanned from them: the truth of the tests of detection.
//!
//! Uses nothing of the detector. A solid is a list of faces (parts of planes, cylinders and cones) and of edges (segments and arcs).

#![allow(dead_code)]

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};

pub mod fandisk;
pub mod models;
pub mod score;
pub mod solids;
pub mod thesis;

/// A generator of reproducible numbers (splitmix64).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in 0 to 1.
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in `low` to `high`.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let r = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        r * (TAU * self.unit()).cos()
    }

    /// Uniform in the ball of radius one.
    pub fn in_ball(&mut self) -> DVec3 {
        loop {
            let p = DVec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0;
            if p.length_squared() <= 1.0 {
                return p;
            }
        }
    }
}

/// A bounded part of a surface.
#[derive(Debug, Clone)]
pub enum Face {
    /// Inside `outline` (counter-clockwise in u, v) and outside the discs `holes` (centre, radius).
    Flat {
        origin: DVec3,
        u: DVec3,
        v: DVec3,
        outline: Vec<DVec2>,
        holes: Vec<(DVec2, f64)>,
    },
    /// Around the line from `base` along `axis` (its length is the height), radius growing from `radii.0` to `radii.1`;
    /// from angle `from` over `sweep`, counted from `start`.
    Round {
        base: DVec3,
        axis: DVec3,
        start: DVec3,
        radii: (f64, f64),
        sweep: f64,
    },
    /// A full disc across `normal`.
    Disc {
        centre: DVec3,
        normal: DVec3,
        radius: f64,
    },
}

/// A sharp edge, or a part of the border of an open surface.
#[derive(Debug, Clone, Copy)]
pub enum Line {
    Segment(DVec3, DVec3),
    /// Centre, unit axis, vector to the start, angle.
    Arc(DVec3, DVec3, DVec3, f64),
}

#[derive(Debug, Clone, Default)]
pub struct Solid {
    pub faces: Vec<Face>,
    pub edges: Vec<Line>,
    pub borders: Vec<Line>,
}

impl Line {
    pub fn length(&self) -> f64 {
        match self {
            Line::Segment(a, b) => a.distance(*b),
            Line::Arc(_, _, start, sweep) => start.length() * sweep,
        }
    }

    /// The point at the share `t` of the length.
    pub fn at(&self, t: f64) -> DVec3 {
        match self {
            Line::Segment(a, b) => a.lerp(*b, t),
            Line::Arc(c, axis, start, sweep) => {
                let (sin, cos) = (t * sweep).sin_cos();
                *c + *start * cos + axis.cross(*start) * sin
            }
        }
    }

    pub fn distance(&self, p: DVec3) -> f64 {
        match self {
            Line::Segment(a, b) => {
                let d = *b - *a;
                let t = ((p - *a).dot(d) / d.length_squared()).clamp(0.0, 1.0);
                p.distance(*a + d * t)
            }
            Line::Arc(c, axis, start, sweep) => {
                let d = p - *c;
                let (x, y) = (d.dot(*start), d.dot(axis.cross(*start)));
                let angle = y.atan2(x).rem_euclid(TAU);
                if angle <= *sweep {
                    let flat = d - *axis * d.dot(*axis);
                    d.dot(*axis).hypot(flat.length() - start.length())
                } else {
                    p.distance(self.at(0.0)).min(p.distance(self.at(1.0)))
                }
            }
        }
    }
}

impl Face {
    pub fn area(&self) -> f64 {
        match self {
            Face::Flat { outline, holes, .. } => {
                let n = outline.len();
                let twice: f64 = (0..n)
                    .map(|i| outline[i].perp_dot(outline[(i + 1) % n]))
                    .sum();
                let holes: f64 = holes.iter().map(|h| 0.5 * TAU * h.1 * h.1).sum();
                0.5 * twice.abs() - holes
            }
            Face::Round {
                axis, radii, sweep, ..
            } => {
                let slant = axis.length().hypot(radii.1 - radii.0);
                0.5 * sweep * (radii.0 + radii.1) * slant
            }
            Face::Disc { radius, .. } => 0.5 * TAU * radius * radius,
        }
    }

    fn covers(outline: &[DVec2], holes: &[(DVec2, f64)], q: DVec2) -> bool {
        let n = outline.len();
        let mut inside = false;
        for i in 0..n {
            let (a, b) = (outline[i], outline[(i + 1) % n]);
            if (a.y > q.y) != (b.y > q.y) && q.x < a.x + (b.x - a.x) * (q.y - a.y) / (b.y - a.y) {
                inside = !inside;
            }
        }
        inside && holes.iter().all(|(c, r)| c.distance(q) >= *r)
    }

    /// A point of the face from two numbers in 0 to 1, or none where they hit a hole.
    pub fn sample(&self, s: f64, t: f64) -> Option<DVec3> {
        match self {
            Face::Flat {
                origin,
                u,
                v,
                outline,
                holes,
            } => {
                let low = outline.iter().copied().reduce(DVec2::min)?;
                let high = outline.iter().copied().reduce(DVec2::max)?;
                let q = low + (high - low) * DVec2::new(s, t);
                Self::covers(outline, holes, q).then(|| *origin + *u * q.x + *v * q.y)
            }
            Face::Round {
                base,
                axis,
                start,
                radii: (a, b),
                sweep,
            } => {
                // Area grows with the radius: invert its integral.
                let h = if (b - a).abs() < 1e-12 {
                    t
                } else {
                    ((a * a + t * (b * b - a * a)).sqrt() - a) / (b - a)
                };
                let (sin, cos) = (s * sweep).sin_cos();
                let up = axis.normalize();
                let out = *start * cos + up.cross(*start) * sin;
                Some(*base + *axis * h + out * (a + (b - a) * h))
            }
            Face::Disc {
                centre,
                normal,
                radius,
            } => {
                let (sin, cos) = (s * TAU).sin_cos();
                let u = normal.any_orthonormal_vector();
                Some(*centre + (u * cos + normal.cross(u) * sin) * (radius * t.sqrt()))
            }
        }
    }

    /// Distance along the ray to the face, and the unit normal there.
    pub fn hit(&self, from: DVec3, along: DVec3) -> Option<(f64, DVec3)> {
        match self {
            Face::Flat {
                origin,
                u,
                v,
                outline,
                holes,
            } => {
                let n = u.cross(*v);
                let t = (*origin - from).dot(n) / along.dot(n);
                if !t.is_finite() || t <= 1e-9 {
                    return None;
                }
                let d = from + along * t - *origin;
                Self::covers(outline, holes, DVec2::new(d.dot(*u), d.dot(*v))).then_some((t, n))
            }
            Face::Round { .. } => self.hit_round(from, along),
            Face::Disc {
                centre,
                normal,
                radius,
            } => {
                let t = (*centre - from).dot(*normal) / along.dot(*normal);
                let near = (from + along * t).distance(*centre) <= *radius;
                (t.is_finite() && t > 1e-9 && near).then_some((t, *normal))
            }
        }
    }

    fn hit_round(&self, from: DVec3, along: DVec3) -> Option<(f64, DVec3)> {
        let Face::Round {
            base,
            axis,
            start,
            radii: (r0, r1),
            sweep,
        } = self
        else {
            return None;
        };
        let (up, height) = (axis.normalize(), axis.length());
        let slope = (r1 - r0) / height;
        let d = from - *base;
        let (dz, az) = (d.dot(up), along.dot(up));
        let (df, af) = (d - up * dz, along - up * az);
        let (rd, ra) = (r0 + slope * dz, slope * az);
        let a = af.dot(af) - ra * ra;
        let b = df.dot(af) - rd * ra;
        let c = df.dot(df) - rd * rd;
        let root = (b * b - a * c).sqrt();
        let mut found: Option<(f64, DVec3)> = None;
        for t in [(-b - root) / a, (-b + root) / a] {
            if !t.is_finite() || t <= 1e-9 {
                continue;
            }
            let (z, flat) = (dz + az * t, df + af * t);
            let angle = flat
                .dot(up.cross(*start))
                .atan2(flat.dot(*start))
                .rem_euclid(TAU);
            let inside = (0.0..=height).contains(&z) && angle <= *sweep && rd + ra * t >= 0.0;
            if inside && found.is_none_or(|f| t < f.0) {
                found = Some((t, (flat.normalize_or_zero() - up * slope).normalize()));
            }
        }
        found
    }
}

/// A cloud with what is known about it.
#[derive(Debug, Clone, Default)]
pub struct Sampled {
    pub points: Vec<DVec3>,
    /// Spacing that scores count in.
    pub spacing: f64,
    /// Edges that count.
    pub edges: Vec<Line>,
    /// Borders of the data where known.
    pub borders: Vec<Line>,
    /// Whether the points come from rays, which miss some edges: those do not count.
    pub scanned: bool,
    /// The face each point lies on; empty where not kept.
    pub faces: Vec<u16>,
    /// Whether each point was made on an edge; empty where none was.
    pub on_edge: Vec<bool>,
}

impl Solid {
    pub fn area(&self) -> f64 {
        self.faces.iter().map(Face::area).sum()
    }

    /// `count` points uniform by area, with normal noise of `noise` spacings in every direction.
    pub fn sample(&self, count: usize, noise: f64, seed: u64) -> Sampled {
        let mut random = Random::new(seed);
        let area = self.area();
        let spacing = (area / count as f64).sqrt();
        let mut ends = Vec::new();
        let mut sum = 0.0;
        for face in &self.faces {
            sum += face.area();
            ends.push(sum);
        }
        let mut points = Vec::with_capacity(count);
        while points.len() < count {
            let pick = random.unit() * sum;
            let face = &self.faces[ends.partition_point(|e| *e < pick).min(ends.len() - 1)];
            // Rejection within the face keeps the faces' shares.
            let p = loop {
                if let Some(p) = face.sample(random.unit(), random.unit()) {
                    break p;
                }
            };
            let n = DVec3::new(random.normal(), random.normal(), random.normal());
            points.push(p + n * (noise * spacing));
        }
        Sampled {
            points,
            spacing,
            edges: self.edges.clone(),
            borders: self.borders.clone(),
            scanned: false,
            faces: Vec::new(),
            on_edge: Vec::new(),
        }
    }

    /// Evenly spread points with some on the edges, as Weber made his: `on_edges` of `count`, evenly along the edges' lengths.
    pub fn even(&self, count: usize, on_edges: usize) -> Sampled {
        let area = self.area();
        let spacing = (area / count as f64).sqrt();
        let total: f64 = self.edges.iter().map(Line::length).sum();
        let mut points = Vec::with_capacity(count);
        let mut walked = 0.0;
        let step = total / on_edges as f64;
        for edge in &self.edges {
            let length = edge.length();
            while (points.len() as f64 + 1e-9) * step < walked + length && points.len() < on_edges {
                points.push(edge.at((points.len() as f64 * step - walked) / length));
            }
            walked += length;
        }
        let edge_points = points.len();
        let mut owed = 0.0;
        for face in &self.faces {
            owed += face.area() / area * (count - edge_points) as f64;
            // A sequence of low discrepancy (Roberts' R2): evenly spread, any number.
            let (mut s, mut t) = (0.5, 0.5);
            while (points.len() - edge_points) as f64 + 0.5 < owed {
                s = (s + 0.754_877_666_246_692_8) % 1.0;
                t = (t + 0.569_840_290_998_053_2) % 1.0;
                if let Some(p) = face.sample(s, t) {
                    points.push(p);
                }
            }
        }
        let on_edge = (0..points.len()).map(|i| i < edge_points).collect();
        Sampled {
            points,
            spacing,
            edges: self.edges.clone(),
            borders: self.borders.clone(),
            scanned: false,
            faces: Vec::new(),
            on_edge,
        }
    }

    /// Scan by parallel rays from each of `views` (unit vectors towards the sensor): lines `across` apart, points `along` apart on
    /// them, noise along the ray. A surface seen at less than ten degrees gives no point.
    pub fn scan(
        &self,
        views: &[DVec3],
        (along, across): (f64, f64),
        noise: f64,
        seed: u64,
    ) -> Sampled {
        let mut random = Random::new(seed);
        let (mut points, mut faces) = (Vec::new(), Vec::new());
        let reach: f64 = 4.0 * self.radius();
        for towards in views {
            let u = towards.any_orthonormal_vector();
            let v = towards.cross(u);
            let half = (0.5 * reach / across) as i64;
            let columns = (0.5 * reach / along) as i64;
            for line in -half..half {
                for column in -columns..columns {
                    let place =
                        u * (column as f64 + 0.137) * along + v * (line as f64 + 0.291) * across;
                    let from = place + *towards * reach;
                    let ray = -*towards;
                    let nearest = self
                        .faces
                        .iter()
                        .enumerate()
                        .filter_map(|(i, f)| f.hit(from, ray).map(|(t, n)| (t, n, i as u16)))
                        .min_by(|a, b| a.0.total_cmp(&b.0));
                    if let Some((t, normal, face)) = nearest
                        && normal.dot(ray).abs() > 0.17
                    {
                        points.push(from + ray * (t + noise * random.normal()));
                        faces.push(face);
                    }
                }
            }
        }
        Sampled {
            points,
            spacing: across,
            edges: self.edges.clone(),
            borders: self.borders.clone(),
            scanned: true,
            faces,
            on_edge: Vec::new(),
        }
    }

    /// Largest distance of an edge or border from the origin.
    pub fn radius(&self) -> f64 {
        self.edges
            .iter()
            .chain(&self.borders)
            .flat_map(|e| [e.at(0.0), e.at(0.5), e.at(1.0)])
            .map(DVec3::length)
            .fold(0.0, f64::max)
    }
}

impl Sampled {
    /// With uniform noise in a ball of `radius`.
    pub fn shaken(mut self, radius: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        for p in &mut self.points {
            *p += random.in_ball() * radius;
        }
        self
    }

    /// With the share `share` of points uniform in the bounding box added.
    pub fn with_outliers(mut self, share: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let low = self
            .points
            .iter()
            .copied()
            .fold(DVec3::INFINITY, DVec3::min);
        let high = self
            .points
            .iter()
            .copied()
            .fold(DVec3::NEG_INFINITY, DVec3::max);
        for _ in 0..(self.points.len() as f64 * share) as usize {
            let r = DVec3::new(random.unit(), random.unit(), random.unit());
            self.points.push(low + (high - low) * r);
        }
        self
    }
}

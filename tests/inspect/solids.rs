//! Exact solids with known deviations, and scans of them: the truth that inspection is held against.

use acies::geometry::RigidTransform;
use acies::inspect::body::{Body, BodyEdge, BodySample, DatumShape};
use acies::nominal::{EdgeKind, Foot, Station};
use acies::points::{Frame, Origin, PointCloud, View};
use glam::{DQuat, DVec2, DVec3};

/// Seeded normal numbers (SplitMix64 and Box-Muller).
pub struct Noise(pub u64);

impl Noise {
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn normal(&mut self) -> f64 {
        let u = 1.0 - self.uniform();
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }

    pub fn direction(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal()).normalize()
    }

    /// A rotation about a random axis by `angle_rad` and a shift by `shift_mm` in a random direction.
    pub fn motion(&mut self, angle_rad: f64, shift_mm: f64) -> RigidTransform {
        let axis = self.direction();
        RigidTransform::new(
            DQuat::from_axis_angle(axis, angle_rad),
            shift_mm * self.direction(),
        )
    }
}

/// The shape of a face.
#[derive(Clone)]
enum Shape {
    /// A polygon in the plane through `origin` spanned by `u` and `v`, u x v outward.
    Plane {
        origin: DVec3,
        u: DVec3,
        v: DVec3,
        outline: Vec<DVec2>,
    },
    /// A disc about `origin` of this radius.
    Disc {
        origin: DVec3,
        u: DVec3,
        v: DVec3,
        radius: f64,
    },
    /// The outside of a cylinder about z.
    Side { radius: f64, height: f64 },
}

/// How a face was made: its signed distance to the nominal is `offset + gradient . (p - centre)`.
#[derive(Clone, Copy, Default)]
pub struct Made {
    pub offset: f64,
    pub gradient: DVec3,
}

struct Line {
    start: DVec3,
    end: DVec3,
}

enum Curve {
    Line(Line),
    /// About z, at height z, radius; side 0 is the cap.
    Circle {
        z: f64,
        radius: f64,
    },
}

/// A nominal solid, and how it was made.
pub struct Solid {
    faces: Vec<Shape>,
    pub made: Vec<Made>,
    edges: Vec<(BodyEdge, Curve)>,
    convex: bool,
}

impl Solid {
    /// A prism of `height` over an outline that runs counter-clockwise in the plane z = 0.
    pub fn prism(outline: &[DVec2], height: f64) -> Self {
        let n = outline.len();
        let flat = |p: DVec2, z: f64| DVec3::new(p.x, p.y, z);
        let mut faces = vec![
            Shape::Plane {
                origin: DVec3::ZERO,
                u: DVec3::Y,
                v: DVec3::X,
                outline: outline.iter().map(|p| DVec2::new(p.y, p.x)).collect(),
            },
            Shape::Plane {
                origin: DVec3::Z * height,
                u: DVec3::X,
                v: DVec3::Y,
                outline: outline.to_vec(),
            },
        ];
        let mut edges = Vec::new();
        let mut convex = true;
        for k in 0..n {
            let (a, b) = (outline[k], outline[(k + 1) % n]);
            let length = (b - a).length();
            let along = (b - a) / length;
            faces.push(Shape::Plane {
                origin: flat(a, 0.0),
                u: along.extend(0.0),
                v: DVec3::Z,
                outline: [(0.0, 0.0), (length, 0.0), (length, height), (0.0, height)]
                    .map(DVec2::from)
                    .to_vec(),
            });
            let side = 2 + k as u32;
            edges.push(([0, side], EdgeKind::Convex, flat(a, 0.0), flat(b, 0.0)));
            edges.push((
                [1, side],
                EdgeKind::Convex,
                flat(a, height),
                flat(b, height),
            ));
            let before = outline[(k + n - 1) % n];
            let kind = if (a - before).perp_dot(b - a) > 0.0 {
                EdgeKind::Convex
            } else {
                convex = false;
                EdgeKind::Concave
            };
            let previous = 2 + ((k + n - 1) % n) as u32;
            edges.push(([previous, side], kind, flat(a, 0.0), flat(a, height)));
        }
        let edges = edges
            .into_iter()
            .enumerate()
            .map(|(k, (faces, kind, start, end))| {
                let edge = BodyEdge {
                    id: format!("e{}", k + 1),
                    entity: 1000 + k as u64,
                    faces,
                    kind,
                    length_mm: (end - start).length(),
                    closed: false,
                };
                (edge, Curve::Line(Line { start, end }))
            })
            .collect();
        Self {
            made: vec![Made::default(); faces.len()],
            faces,
            edges,
            convex,
        }
    }

    pub fn cuboid(x: f64, y: f64, z: f64) -> Self {
        let outline = [(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)].map(DVec2::from);
        Self::prism(&outline, z)
    }

    /// A cylinder about z: faces bottom, top, side; edges bottom rim, top rim.
    pub fn cylinder(radius: f64, height: f64) -> Self {
        let disc = |z: f64, v: DVec3| Shape::Disc {
            origin: DVec3::Z * z,
            u: DVec3::X,
            v,
            radius,
        };
        let faces = vec![
            disc(0.0, -DVec3::Y),
            disc(height, DVec3::Y),
            Shape::Side { radius, height },
        ];
        let rim = |k: u32, z: f64| {
            let edge = BodyEdge {
                id: format!("e{}", k + 1),
                entity: 1000 + u64::from(k),
                faces: [k, 2],
                kind: EdgeKind::Convex,
                length_mm: std::f64::consts::TAU * radius,
                closed: true,
            };
            (edge, Curve::Circle { z, radius })
        };
        Self {
            made: vec![Made::default(); 3],
            faces,
            edges: vec![rim(0, 0.0), rim(1, height)],
            convex: true,
        }
    }

    /// Where the deviation of a made face is its offset.
    pub fn centre(&self, face: u32) -> DVec3 {
        match &self.faces[face as usize] {
            Shape::Plane {
                origin,
                u,
                v,
                outline,
            } => {
                let middle = outline.iter().sum::<DVec2>() / outline.len() as f64;
                *origin + middle.x * *u + middle.y * *v
            }
            Shape::Disc { origin, .. } => *origin,
            Shape::Side { height, .. } => DVec3::Z * 0.5 * *height,
        }
    }

    /// Signed distance of the made face to the nominal one at `p`.
    pub fn made_at(&self, face: u32, p: DVec3) -> f64 {
        let made = &self.made[face as usize];
        made.offset + made.gradient.dot(p - self.centre(face))
    }

    /// The true d1, d2 at a station: where the made faces meet in the plane across t.
    pub fn true_d(&self, edge: usize, station: &Station) -> [f64; 2] {
        let faces = self.edges[edge].0.faces;
        let mut p = station.point;
        // Fixed point: the gradients are below 0.01, so each round gains two digits.
        let turn = station.normals[0].dot(station.normals[1]);
        for _ in 0..20 {
            let height = faces.map(|f| self.made_at(f, p));
            // p - p0 = x n1 + y n2 with the wanted heights over both faces.
            let scale = 1.0 - turn * turn;
            let x = (height[0] - turn * height[1]) / scale;
            let y = (height[1] - turn * height[0]) / scale;
            p = station.point + x * station.normals[0] + y * station.normals[1];
        }
        station.normals.map(|n| (p - station.point).dot(n))
    }

    /// The true deviation of the included angle.
    pub fn true_angle_deviation(&self, edge: usize, station: &Station) -> f64 {
        let faces = self.edges[edge].0.faces;
        (0..2)
            .map(|i| {
                self.made[faces[i] as usize]
                    .gradient
                    .dot(station.into_face[i])
                    .atan()
            })
            .sum()
    }

    /// A scan of the made solid, in the part frame: every face of `seen` from its own normal (the side of a cylinder from
    /// four directions), points each 0.08 mm in lines 0.4 mm apart, white noise of `sigma` along the normal.
    pub fn scan(&self, seen: &[u32], sigma: f64, noise: &mut Noise) -> PointCloud {
        let mut cloud = PointCloud {
            frame: Frame::Part,
            positions: Vec::new(),
            origins: Vec::new(),
            views: Vec::new(),
        };
        for &face in seen {
            match &self.faces[face as usize] {
                Shape::Plane { origin, u, v, .. } | Shape::Disc { origin, u, v, .. } => {
                    let normal = u.cross(*v);
                    let view = add_view(&mut cloud, normal);
                    self.scan_plane(&mut cloud, (face, view), (*origin, *u, *v), sigma, noise);
                }
                Shape::Side { radius, height } => {
                    for quarter in 0..4 {
                        let middle = f64::from(quarter) * std::f64::consts::FRAC_PI_2;
                        let towards = DVec3::new(middle.cos(), middle.sin(), 0.0);
                        let view = add_view(&mut cloud, towards);
                        let size = (*radius, *height);
                        self.scan_side(&mut cloud, (face, view), size, sigma, noise);
                    }
                }
            }
        }
        cloud
    }

    fn scan_plane(
        &self,
        cloud: &mut PointCloud,
        (face, view): (u32, u16),
        (origin, u, v): (DVec3, DVec3, DVec3),
        sigma: f64,
        noise: &mut Noise,
    ) {
        let normal = u.cross(v);
        let (low, high) = self.extent(face);
        let lines = ((high.y - low.y + 2.0) / ACROSS) as u32;
        let columns = ((high.x - low.x + 2.0) / ALONG) as u32;
        let phase = DVec2::new(noise.uniform() * ALONG, noise.uniform() * ACROSS);
        for profile in 0..lines {
            for column in 0..columns {
                let at = low - 1.0
                    + phase
                    + DVec2::new(f64::from(column) * ALONG, f64::from(profile) * ACROSS);
                let foot = origin + at.x * u + at.y * v;
                let p = foot + self.made_at(face, foot) * normal;
                if self.is_on(face, p) {
                    cloud.positions.push(p + sigma * noise.normal() * normal);
                    cloud.origins.push(Origin {
                        view,
                        column: column as u16,
                        profile,
                    });
                }
            }
        }
    }

    fn scan_side(
        &self,
        cloud: &mut PointCloud,
        (face, view): (u32, u16),
        (radius, height): (f64, f64),
        sigma: f64,
        noise: &mut Noise,
    ) {
        let middle = f64::from(view % 4) * std::f64::consts::FRAC_PI_2;
        let towards = cloud.views[view as usize].towards_sensor;
        let middle = if towards.z == 0.0 {
            towards.y.atan2(towards.x)
        } else {
            middle
        };
        let columns = (std::f64::consts::FRAC_PI_2 * radius / ALONG) as u32;
        for profile in 0..((height + 2.0) / ACROSS) as u32 {
            for column in 0..columns {
                let angle = middle
                    + (f64::from(column) / f64::from(columns) - 0.5) * std::f64::consts::FRAC_PI_2;
                let outward = DVec3::new(angle.cos(), angle.sin(), 0.0);
                let foot = radius * outward + DVec3::Z * (f64::from(profile) * ACROSS - 0.9);
                let p = foot + self.made_at(face, foot) * outward;
                if self.is_on(face, p) {
                    cloud.positions.push(p + sigma * noise.normal() * outward);
                    cloud.origins.push(Origin {
                        view,
                        column: column as u16,
                        profile,
                    });
                }
            }
        }
    }

    fn extent(&self, face: u32) -> (DVec2, DVec2) {
        match &self.faces[face as usize] {
            Shape::Plane { outline, .. } => (
                outline.iter().copied().reduce(DVec2::min).expect("corners"),
                outline.iter().copied().reduce(DVec2::max).expect("corners"),
            ),
            Shape::Disc { radius, .. } => (DVec2::splat(-radius), DVec2::splat(*radius)),
            Shape::Side { .. } => unreachable!("scanned otherwise"),
        }
    }

    /// Whether a point of the made face lies on the made solid.
    fn is_on(&self, face: u32, p: DVec3) -> bool {
        if !self.convex && face < 2 {
            let foot = self.foot(face, p, None).expect("a plane");
            return self.contains(face, foot.uv);
        }
        self.edges.iter().all(|(edge, _)| {
            let other = match edge.faces {
                [a, b] if a == face => b,
                [a, b] if b == face => a,
                _ => return true,
            };
            let foot = self.foot(other, p, None).expect("faces reach everywhere");
            let height = (p - foot.point).dot(foot.normal) - self.made_at(other, p);
            match edge.kind {
                EdgeKind::Convex => height <= 0.0,
                EdgeKind::Concave => height >= 0.0,
            }
        })
    }
}

pub const ALONG: f64 = 0.08;
pub const ACROSS: f64 = 0.4;

fn add_view(cloud: &mut PointCloud, towards_sensor: DVec3) -> u16 {
    cloud.views.push(View {
        device: "test".to_string(),
        towards_sensor,
    });
    (cloud.views.len() - 1) as u16
}

impl Body for Solid {
    fn face_count(&self) -> usize {
        self.faces.len()
    }

    fn face_entity(&self, face: u32) -> u64 {
        10 + u64::from(face)
    }

    fn foot(&self, face: u32, p: DVec3, _near: Option<(f64, f64)>) -> Option<Foot> {
        match &self.faces[face as usize] {
            Shape::Plane { origin, u, v, .. } | Shape::Disc { origin, u, v, .. } => {
                let uv = ((p - origin).dot(*u), (p - origin).dot(*v));
                Some(Foot {
                    uv,
                    point: *origin + uv.0 * *u + uv.1 * *v,
                    normal: u.cross(*v),
                })
            }
            Shape::Side { radius, .. } => {
                let normal = DVec3::new(p.x, p.y, 0.0).try_normalize()?;
                Some(Foot {
                    uv: (p.y.atan2(p.x), p.z),
                    point: *radius * normal + DVec3::Z * p.z,
                    normal,
                })
            }
        }
    }

    fn contains(&self, face: u32, uv: (f64, f64)) -> bool {
        match &self.faces[face as usize] {
            Shape::Plane { outline, .. } => {
                let p = DVec2::from(uv);
                let crossings = (0..outline.len()).filter(|&k| {
                    let (a, b) = (outline[k], outline[(k + 1) % outline.len()]);
                    (a.y > p.y) != (b.y > p.y)
                        && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x)
                });
                crossings.count() % 2 == 1
            }
            Shape::Disc { radius, .. } => DVec2::from(uv).length() <= *radius,
            Shape::Side { height, .. } => (0.0..=*height).contains(&uv.1),
        }
    }

    fn samples(&self, spacing_mm: f64) -> Vec<BodySample> {
        let mut samples = Vec::new();
        for face in 0..self.faces.len() as u32 {
            let (low, high) = match &self.faces[face as usize] {
                Shape::Side { height, .. } => (
                    DVec2::new(-std::f64::consts::PI, 0.0),
                    DVec2::new(std::f64::consts::PI, *height),
                ),
                _ => self.extent(face),
            };
            let step = match &self.faces[face as usize] {
                Shape::Side { radius, .. } => DVec2::new(spacing_mm / radius, spacing_mm),
                _ => DVec2::splat(spacing_mm),
            };
            let count = ((high - low) / step).ceil().max(DVec2::ONE);
            for i in 0..count.x as u32 {
                for j in 0..count.y as u32 {
                    let at = DVec2::new(f64::from(i) + 0.5, f64::from(j) + 0.5);
                    let uv = low + at / count * (high - low);
                    if self.contains(face, uv.into()) {
                        samples.push(self.sample(face, uv));
                    }
                }
            }
        }
        samples
    }

    fn edges(&self) -> Vec<BodyEdge> {
        self.edges.iter().map(|(edge, _)| edge.clone()).collect()
    }

    fn station(&self, edge: usize, s_mm: f64) -> Station {
        let (edge, curve) = &self.edges[edge];
        let (point, tangent) = match curve {
            Curve::Line(line) => {
                let along = (line.end - line.start).normalize();
                (line.start + s_mm * along, along)
            }
            Curve::Circle { z, radius } => {
                let (sin, cos) = (s_mm / radius).sin_cos();
                (
                    DVec3::new(radius * cos, radius * sin, *z),
                    DVec3::new(-sin, cos, 0.0),
                )
            }
        };
        let normals = edge
            .faces
            .map(|f| self.foot(f, point, None).expect("on the face").normal);
        // Into face i: across t and n_i, away from the other face's outside (convex) or inside (concave).
        let into_face = [0, 1].map(|i| {
            let across = tangent.cross(normals[i]);
            let outward = across.dot(normals[1 - i]) > 0.0;
            if outward == (edge.kind == EdgeKind::Convex) {
                -across
            } else {
                across
            }
        });
        Station {
            s_mm,
            point,
            tangent,
            normals,
            into_face,
        }
    }

    fn bounds(&self) -> [DVec3; 2] {
        let samples = self.samples(1.0);
        let fold = |pick: fn(DVec3, DVec3) -> DVec3| {
            samples.iter().map(|s| s.point).reduce(pick).expect("faces")
        };
        [fold(DVec3::min), fold(DVec3::max)]
    }

    fn datum_shape(&self, face: u32) -> Option<DatumShape> {
        Some(match &self.faces[face as usize] {
            Shape::Plane { .. } | Shape::Disc { .. } => DatumShape::Plane,
            Shape::Side { .. } => DatumShape::Axis(DVec3::ZERO, DVec3::Z),
        })
    }
}

impl Solid {
    fn sample(&self, face: u32, uv: DVec2) -> BodySample {
        let point = match &self.faces[face as usize] {
            Shape::Plane { origin, u, v, .. } | Shape::Disc { origin, u, v, .. } => {
                *origin + uv.x * *u + uv.y * *v
            }
            Shape::Side { radius, .. } => {
                DVec3::new(radius * uv.x.cos(), radius * uv.x.sin(), uv.y)
            }
        };
        let foot = self.foot(face, point, None).expect("on the face");
        BodySample {
            point,
            normal: foot.normal,
            face,
            uv: (uv.x, uv.y),
        }
    }
}

//! One trimmed face.

use glam::DVec3;

use super::Foot;
use super::trim::Trim;
use crate::geometry::Surface;

/// A face of a body: a surface, the part of it that is used, and the side of the material.
#[derive(Debug, Clone, PartialEq)]
pub struct Face {
    /// Number of the ADVANCED_FACE in the file.
    pub entity: u64,
    /// Its body, counted from 0.
    pub body: usize,
    /// Unbounded surface under the face.
    pub surface: Surface,
    pub(super) trim: Trim,
    /// Whether the surface's own normal points out of the material.
    pub(super) outward: bool,
    area_mm2: f64,
    volume_mm3: f64,
}

/// A point of a face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceSample {
    /// Position, mm.
    pub point: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Index of the face.
    pub face: u32,
    /// Parameters on its surface.
    pub uv: (f64, f64),
}

/// Gauss - Legendre with five points on 0 to 1: nodes and weights.
const GAUSS: [(f64, f64); 5] = [
    (0.046_910_077_030_668, 0.118_463_442_528_094_5),
    (0.230_765_344_947_158_4, 0.239_314_335_249_683_2),
    (0.5, 0.284_444_444_444_444_4),
    (0.769_234_655_052_841_5, 0.239_314_335_249_683_2),
    (0.953_089_922_969_332, 0.118_463_442_528_094_5),
];

impl Face {
    /// A face with its area; the area is infinite where the loops leave the surface unbounded.
    pub(super) fn new(
        entity: u64,
        body: usize,
        surface: Surface,
        trim: Trim,
        outward: bool,
    ) -> Self {
        let mut face = Self {
            entity,
            body,
            surface,
            trim,
            outward,
            area_mm2: 0.0,
            volume_mm3: 0.0,
        };
        (face.area_mm2, face.volume_mm3) = face.integrate();
        face
    }

    /// The nearest point of the face's surface, also beyond the trimming: B-spline surfaces end with their domain, others do not.
    ///
    /// `near` starts the search on surfaces with many minima: give the parameters of a neighbouring point where there is one.
    /// `None` where the surface has no normal (the apex of a cone) or `p` is not finite.
    pub fn foot(&self, p: DVec3, near: Option<(f64, f64)>) -> Option<Foot> {
        if !p.is_finite() {
            return None;
        }
        let uv = self.surface.nearest(p, near);
        self.at(uv)
    }

    /// Distance from the nearest point of the surface along its outward normal, mm: plus outside the material.
    pub fn signed_distance(&self, p: DVec3, near: Option<(f64, f64)>) -> Option<f64> {
        let foot = self.foot(p, near)?;
        Some((p - foot.point).dot(foot.normal))
    }

    /// Whether the parameters lie inside the trimming, its border within the chord of its polylines.
    pub fn contains(&self, uv: (f64, f64)) -> bool {
        self.trim.contains(uv)
    }

    /// In mm2.
    pub fn area_mm2(&self) -> f64 {
        self.area_mm2
    }

    /// Share of the face in the volume of its body, mm3: the integral of p . n / 3 over it.
    pub fn volume_mm3(&self) -> f64 {
        self.volume_mm3
    }

    /// The point at parameters.
    pub(super) fn at(&self, uv: (f64, f64)) -> Option<Foot> {
        let normal = self.surface.normal(uv.0, uv.1)?;
        Some(Foot {
            uv,
            point: self.surface.point(uv.0, uv.1),
            normal: if self.outward { normal } else { -normal },
        })
    }

    /// Turns the material to the other side.
    pub(super) fn turn_over(&mut self) {
        self.outward = !self.outward;
        self.volume_mm3 = -self.volume_mm3;
    }

    /// Area, and integral of p . n / 3.
    fn integrate(&self) -> (f64, f64) {
        let (mut area, mut volume) = (0.0, 0.0);
        let pieces = match &self.surface {
            Surface::Plane(_) | Surface::Cylinder { .. } | Surface::Cone { .. } => 1,
            Surface::Sphere { .. } | Surface::Torus { .. } => 2,
            Surface::Swept(_) => 4,
            Surface::Nurbs(s) => s
                .knots()
                .map(|k| k.breaks().len() - 1)
                .into_iter()
                .max()
                .unwrap_or(1)
                .min(16),
        };
        for strip in self.trim.strips(self.trim.exact_breaks()) {
            for (from, to) in &strip.across {
                if !(to - from).is_finite() {
                    return (f64::INFINITY, 0.0);
                }
                let step = (to - from) / pieces as f64;
                for piece in 0..pieces {
                    for (x, w) in GAUSS {
                        let across = from + step * (piece as f64 + x);
                        let (u, v) = self.trim.uv(strip.along, across);
                        let d = self.surface.derivatives(u, v);
                        let n = d.du.cross(d.dv);
                        let share = w * step * strip.width;
                        area += n.length() * share;
                        volume += d.point.dot(n) * share / 3.0;
                    }
                }
            }
        }
        (area, if self.outward { volume } else { -volume })
    }

    /// Appends points about `spacing_mm` apart.
    pub(super) fn sample(&self, face: u32, spacing_mm: f64, out: &mut Vec<SurfaceSample>) {
        let before = out.len();
        let (from, to) = self.trim.extent();
        // Widest the face gets for a step along: strips keep the spacing there and points are thinned elsewhere.
        let widest = self
            .probes(12)
            .map(|(uv, _)| self.metric(uv).0)
            .fold(0.0, f64::max);
        let count = ((to - from) * widest / spacing_mm)
            .ceil()
            .clamp(1.0, 20_000.0) as usize;
        let mut due = 0.5;
        for strip in self.trim.strips(self.trim.even_breaks(count)) {
            for (low, high) in &strip.across {
                let middle = self.trim.uv(strip.along, 0.5 * (low + high));
                let length = (high - low) * self.metric(middle).1;
                let steps = (length / spacing_mm).ceil().clamp(1.0, 20_000.0) as usize;
                let step = (high - low) / steps as f64;
                for k in 0..steps {
                    let uv = self.trim.uv(strip.along, low + step * (k as f64 + 0.5));
                    let (along, across) = self.metric(uv);
                    due += along * strip.width * across * step / (spacing_mm * spacing_mm);
                    if due >= 1.0 {
                        due -= due.floor();
                        out.extend(self.sample_at(face, uv));
                    }
                }
            }
        }
        if out.len() == before {
            let middle = self.probes(3).max_by(|a, b| a.1.total_cmp(&b.1));
            out.extend(middle.and_then(|(uv, _)| self.sample_at(face, uv)));
        }
    }

    /// Middles of the stretches inside on a few strips, with the length of the stretch.
    pub(super) fn probes(&self, strips: usize) -> impl Iterator<Item = ((f64, f64), f64)> + '_ {
        self.trim
            .strips(self.trim.even_breaks(strips))
            .flat_map(move |s| {
                let along = s.along;
                let inside = s.across.into_iter();
                inside.map(move |(a, b)| (self.trim.uv(along, 0.5 * (a + b)), b - a))
            })
    }

    fn sample_at(&self, face: u32, uv: (f64, f64)) -> Option<SurfaceSample> {
        let foot = self.at(uv)?;
        Some(SurfaceSample {
            point: foot.point,
            normal: foot.normal,
            face,
            uv,
        })
    }

    /// Length of the derivatives in the directions along and across of the trimming.
    fn metric(&self, uv: (f64, f64)) -> (f64, f64) {
        let d = self.surface.derivatives(uv.0, uv.1);
        let (u, v) = (d.du.length(), d.dv.length());
        if self.trim.is_swapped() {
            (v, u)
        } else {
            (u, v)
        }
    }
}

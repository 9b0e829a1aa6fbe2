//! Surfaces swept by a curve: along a line or around an axis.

use glam::{DVec2, DVec3};

use super::newton::{Range, SurfaceDerivatives, nearest_on_curve};
use super::{Curve, Frame, RigidTransform};

/// A profile and how it is swept.
#[derive(Debug, Clone, PartialEq)]
pub struct Sweep {
    profile: Curve,
    path: SweepPath,
    /// Parameters of the profile, dense enough that each minimum of the distance has one beside it.
    seeds: Vec<f64>,
}

/// The motion of the profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SweepPath {
    /// Along a unit vector: u is the profile's parameter, v the way in mm.
    Along(DVec3),
    /// Around z of a frame: u is the angle, v the profile's parameter.
    Around(Frame),
}

impl Sweep {
    /// The surface of a profile moved along `direction`; `None` where that has no direction or the profile no end.
    pub fn along(profile: Curve, direction: DVec3) -> Option<Self> {
        let direction = direction.try_normalize()?;
        Self::new(profile, SweepPath::Along(direction))
    }

    /// The surface of a profile turned about z of `axis`; `None` where the profile has no end.
    pub fn around(profile: Curve, axis: Frame) -> Option<Self> {
        Self::new(profile, SweepPath::Around(axis))
    }

    fn new(profile: Curve, path: SweepPath) -> Option<Self> {
        let range = profile.range();
        if !(range.from.is_finite() && range.to.is_finite()) {
            return None;
        }
        let breaks = match &profile {
            Curve::Nurbs(c) => c.knots().breaks(),
            _ => vec![range.from, range.to],
        };
        let pieces = (64 / (breaks.len() - 1)).max(4);
        let mut seeds: Vec<f64> = breaks
            .windows(2)
            .flat_map(|w| {
                let step = (w[1] - w[0]) / pieces as f64;
                let from = w[0];
                (0..pieces).map(move |i| from + step * i as f64)
            })
            .collect();
        seeds.push(range.to);
        Some(Self {
            profile,
            path,
            seeds,
        })
    }

    /// The curve that is swept.
    pub fn profile(&self) -> &Curve {
        &self.profile
    }

    /// How it is moved.
    pub fn path(&self) -> &SweepPath {
        &self.path
    }

    /// The word of ISO 10303-42.
    pub fn kind(&self) -> &'static str {
        match self.path {
            SweepPath::Along(_) => "surface_of_linear_extrusion",
            SweepPath::Around(_) => "surface_of_revolution",
        }
    }

    /// Ranges of u and v.
    pub fn ranges(&self) -> [Range; 2] {
        match self.path {
            SweepPath::Along(_) => [self.profile.range(), Range::UNBOUNDED],
            SweepPath::Around(_) => [Range::TURN, self.profile.range()],
        }
    }

    /// Position and derivatives to second order.
    pub fn derivatives(&self, u: f64, v: f64) -> SurfaceDerivatives {
        match &self.path {
            SweepPath::Along(direction) => {
                let [c, dc, ddc] = self.profile.derivatives(u);
                SurfaceDerivatives {
                    point: c + *direction * v,
                    du: dc,
                    dv: *direction,
                    duu: ddc,
                    duv: DVec3::ZERO,
                    dvv: DVec3::ZERO,
                }
            }
            SweepPath::Around(axis) => {
                let [c, dc, ddc] = self.profile.derivatives(v);
                let (s, k) = u.sin_cos();
                // A vector turned by u, and the derivatives of that by u.
                let turned = |d: DVec3| {
                    let (x, y, z) = (d.dot(axis.x), d.dot(axis.y), d.dot(axis.z));
                    let (tx, ty) = (k * x - s * y, s * x + k * y);
                    (
                        axis.x * tx + axis.y * ty + axis.z * z,
                        axis.y * tx - axis.x * ty,
                        axis.x * -tx - axis.y * ty,
                    )
                };
                let (point, du, duu) = turned(c - axis.origin);
                let (dv, duv, _) = turned(dc);
                SurfaceDerivatives {
                    point: axis.origin + point,
                    du,
                    dv,
                    duu,
                    duv,
                    dvv: turned(ddc).0,
                }
            }
        }
    }

    /// Parameters of the nearest point: a search over the profile alone, in the plane that the sweep leaves.
    pub fn nearest(&self, p: DVec3, near: Option<(f64, f64)>) -> (f64, f64) {
        let t = match (near, &self.path) {
            (Some((u, _)), SweepPath::Along(_)) => self.downhill(p, u).0,
            (Some((_, v)), SweepPath::Around(_)) => self.downhill(p, v).0,
            (None, _) => self.search(p),
        };
        self.across(p, t)
    }

    /// Parameters of the point of the sweep through `t` of the profile that is nearest.
    fn across(&self, p: DVec3, t: f64) -> (f64, f64) {
        match &self.path {
            SweepPath::Along(direction) => (t, (p - self.profile.point(t)).dot(*direction)),
            SweepPath::Around(axis) => {
                let of = |q: DVec3| Frame::angle_of(axis.local(q).truncate());
                let u = of(p) - of(self.profile.point(t));
                (Range::TURN.bring(u), t)
            }
        }
    }

    fn search(&self, p: DVec3) -> f64 {
        let found = self.profile_minima(p).into_iter();
        found
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map_or(self.seeds[0], |f| f.0)
    }

    /// Parameters of every local minimum of the distance over the whole surface, some perhaps twice.
    pub fn minima(&self, p: DVec3) -> Vec<(f64, f64)> {
        let found = self.profile_minima(p).into_iter();
        found.map(|(t, _)| self.across(p, t)).collect()
    }

    /// Parameters on the profile, and squared distances, reached downhill from every seed that its neighbours do not beat.
    fn profile_minima(&self, p: DVec3) -> Vec<(f64, f64)> {
        let d2 = |i: usize| {
            let at = [self.profile.point(self.seeds[i]), DVec3::ZERO, DVec3::ZERO];
            self.flat(p, at)[0].distance_squared(self.flat_target(p))
        };
        let last = self.seeds.len() - 1;
        let mut out = Vec::new();
        let mut before = f64::INFINITY;
        let mut here = d2(0);
        for i in 0..=last {
            let after = if i < last { d2(i + 1) } else { f64::INFINITY };
            if here <= before && here <= after {
                out.push(self.downhill(p, self.seeds[i]));
            }
            (before, here) = (here, after);
        }
        out
    }

    fn downhill(&self, p: DVec3, start: f64) -> (f64, f64) {
        let curve = |t| self.flat(p, self.profile.derivatives(t));
        nearest_on_curve(curve, self.flat_target(p), start, self.profile.range())
    }

    /// Where the point lies in the plane of the search.
    fn flat_target(&self, p: DVec3) -> DVec3 {
        match &self.path {
            SweepPath::Along(_) => DVec3::ZERO,
            SweepPath::Around(axis) => {
                let l = axis.local(p);
                DVec3::new(l.truncate().length(), l.z, 0.0)
            }
        }
    }

    /// Profile and derivatives seen along the sweep: from the point, across the direction; or as radius and height.
    fn flat(&self, p: DVec3, [c, dc, ddc]: [DVec3; 3]) -> [DVec3; 3] {
        match &self.path {
            SweepPath::Along(direction) => {
                [c - p, dc, ddc].map(|d| d - *direction * d.dot(*direction))
            }
            SweepPath::Around(axis) => {
                let l = axis.local(c);
                let radial = l.truncate();
                let d = DVec2::new(dc.dot(axis.x), dc.dot(axis.y));
                let dd = DVec2::new(ddc.dot(axis.x), ddc.dot(axis.y));
                let radius = radial.length().max(f64::MIN_POSITIVE);
                let slope = radial.dot(d) / radius;
                let bend = (d.length_squared() + radial.dot(dd) - slope * slope) / radius;
                [
                    DVec3::new(radius, l.z, 0.0),
                    DVec3::new(slope, dc.dot(axis.z), 0.0),
                    DVec3::new(bend, ddc.dot(axis.z), 0.0),
                ]
            }
        }
    }

    /// The surface moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        Self {
            profile: self.profile.transformed(by),
            path: match self.path {
                SweepPath::Along(d) => SweepPath::Along(by.vector(d)),
                SweepPath::Around(f) => SweepPath::Around(f.transformed(by)),
            },
            seeds: self.seeds.clone(),
        }
    }
}

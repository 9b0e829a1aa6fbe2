//! Surfaces: analytic ones kept exact, swept ones, and rational B-splines.

use std::f64::consts::FRAC_PI_2;

use glam::{DVec2, DVec3};

use super::newton::{Range, SurfaceDerivatives};
use super::sweep::Sweep;
use super::{Frame, NurbsSurface, RigidTransform};

/// A surface in mm; parameters as in ISO 10303-42, its normal is du x dv.
#[derive(Debug, Clone, PartialEq)]
pub enum Surface {
    /// x and y of its frame.
    Plane(Frame),
    /// Around z of its frame: u the angle, v the height.
    Cylinder {
        /// Axis.
        frame: Frame,
        /// In mm.
        radius_mm: f64,
    },
    /// Around z of its frame: u the angle, v the height; the radius grows with v.
    Cone {
        /// Axis.
        frame: Frame,
        /// Radius at height 0, mm.
        radius_mm: f64,
        /// Between axis and surface, above 0 and below 90 degrees.
        half_angle_rad: f64,
    },
    /// u the longitude, v the latitude.
    Sphere {
        /// Centre and axes.
        frame: Frame,
        /// In mm.
        radius_mm: f64,
    },
    /// u around the axis, v around the tube. A tube wider than its ring ends at the axis.
    Torus {
        /// Axis.
        frame: Frame,
        /// From the axis to the middle of the tube, mm; negative for the part of a wide tube inside itself.
        major_mm: f64,
        /// Radius of the tube, mm.
        minor_mm: f64,
    },
    /// A curve moved along a line or about an axis.
    Swept(Box<Sweep>),
    /// A rational B-spline surface.
    Nurbs(Box<NurbsSurface>),
}

impl Surface {
    /// Ranges of u and v.
    pub fn ranges(&self) -> [Range; 2] {
        match self {
            Self::Plane(_) => [Range::UNBOUNDED; 2],
            Self::Cylinder { .. } => [Range::TURN, Range::UNBOUNDED],
            Self::Cone {
                radius_mm,
                half_angle_rad,
                ..
            } => [
                Range::TURN,
                Range::open(-radius_mm / half_angle_rad.tan(), f64::INFINITY),
            ],
            Self::Sphere { .. } => [Range::TURN, Range::open(-FRAC_PI_2, FRAC_PI_2)],
            Self::Torus {
                major_mm, minor_mm, ..
            } if major_mm.abs() < *minor_mm => {
                let cusp = (-major_mm / minor_mm).acos();
                [Range::TURN, Range::open(-cusp, cusp)]
            }
            Self::Torus { .. } => [Range::TURN; 2],
            Self::Swept(s) => s.ranges(),
            Self::Nurbs(s) => s.ranges(),
        }
    }

    /// Position at parameters.
    pub fn point(&self, u: f64, v: f64) -> DVec3 {
        match self {
            Self::Plane(f) => f.origin + f.x * u + f.y * v,
            Self::Nurbs(s) => s.point(u, v),
            _ => self.derivatives(u, v).point,
        }
    }

    /// Position and derivatives to second order.
    pub fn derivatives(&self, u: f64, v: f64) -> SurfaceDerivatives {
        match self {
            Self::Plane(f) => SurfaceDerivatives {
                point: f.origin + f.x * u + f.y * v,
                du: f.x,
                dv: f.y,
                duu: DVec3::ZERO,
                duv: DVec3::ZERO,
                dvv: DVec3::ZERO,
            },
            Self::Cylinder { frame, radius_mm } => {
                turned(frame, u, [[*radius_mm, v], [0.0, 1.0], [0.0; 2]])
            }
            Self::Cone {
                frame,
                radius_mm,
                half_angle_rad,
            } => {
                let slope = half_angle_rad.tan();
                turned(
                    frame,
                    u,
                    [[radius_mm + v * slope, v], [slope, 1.0], [0.0; 2]],
                )
            }
            Self::Sphere {
                frame,
                radius_mm: r,
            } => {
                let (s, c) = v.sin_cos();
                turned(
                    frame,
                    u,
                    [[r * c, r * s], [-r * s, r * c], [-r * c, -r * s]],
                )
            }
            Self::Torus {
                frame,
                major_mm,
                minor_mm: r,
            } => {
                let (s, c) = v.sin_cos();
                turned(
                    frame,
                    u,
                    [[major_mm + r * c, r * s], [-r * s, r * c], [-r * c, -r * s]],
                )
            }
            Self::Swept(s) => s.derivatives(u, v),
            Self::Nurbs(s) => s.derivatives(u, v),
        }
    }

    /// Unit normal du x dv; at a pole the limit along v where there is one. `None` at a cone's apex.
    pub fn normal(&self, u: f64, v: f64) -> Option<DVec3> {
        let at = |u: f64, v: f64| {
            let d = self.derivatives(u, v);
            let n = d.du.cross(d.dv);
            // Parallel or vanished derivatives leave rounding in place of a normal.
            (n.length() > 1e-9 * d.du.length() * d.dv.length() && n.length() > 1e-30)
                .then(|| n.normalize())
        };
        match self {
            Self::Sphere { frame, radius_mm } => {
                Some((self.point(u, v) - frame.origin) / *radius_mm)
            }
            Self::Nurbs(_) | Self::Swept(_) => at(u, v).or_else(|| {
                let [ru, rv] = self.ranges();
                let inward = |r: Range, t: f64| {
                    if r.from.is_finite() && r.to.is_finite() {
                        t + 1e-6 * (0.5 * (r.from + r.to) - t)
                    } else {
                        t
                    }
                };
                at(inward(ru, u), inward(rv, v))
            }),
            _ => at(u, v),
        }
    }

    /// Parameters of the nearest point: over the whole surface, or from a hint where the kind has many minima.
    ///
    /// Analytic kinds answer exactly and need no hint; a B-spline surface is clamped to its domain.
    pub fn nearest(&self, p: DVec3, near: Option<(f64, f64)>) -> (f64, f64) {
        match self {
            Self::Plane(f) => {
                let l = f.local(p);
                (l.x, l.y)
            }
            Self::Cylinder { frame, .. } => {
                let l = frame.local(p);
                (Frame::angle_of(l.truncate()), l.z)
            }
            Self::Cone {
                frame,
                radius_mm,
                half_angle_rad,
            } => {
                let l = frame.local(p);
                let (s, c) = half_angle_rad.sin_cos();
                let along = (l.truncate().length() - radius_mm) * s + l.z * c;
                // Beyond the apex the apex itself is nearest.
                let v = (along * c).max(-radius_mm * c / s);
                (Frame::angle_of(l.truncate()), v)
            }
            Self::Sphere { frame, .. } => {
                let l = frame.local(p);
                let across = l.truncate();
                (Frame::angle_of(across), l.z.atan2(across.length()))
            }
            Self::Torus {
                frame,
                major_mm,
                minor_mm,
            } => {
                let l = frame.local(p);
                let tube = DVec2::new(l.truncate().length() - major_mm, l.z);
                if major_mm.abs() >= *minor_mm {
                    return (Frame::angle_of(l.truncate()), Frame::angle_of(tube));
                }
                let cusp = (-major_mm / minor_mm).acos();
                let v = tube.y.atan2(tube.x).clamp(-cusp, cusp);
                (Frame::angle_of(l.truncate()), v)
            }
            Self::Swept(s) => s.nearest(p, near),
            Self::Nurbs(s) => s.nearest(p, near).0,
        }
    }

    /// The surface moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        let mut moved = self.clone();
        match &mut moved {
            Self::Plane(frame)
            | Self::Cylinder { frame, .. }
            | Self::Cone { frame, .. }
            | Self::Sphere { frame, .. }
            | Self::Torus { frame, .. } => *frame = frame.transformed(by),
            Self::Swept(s) => **s = s.transformed(by),
            Self::Nurbs(s) => **s = s.transformed(by),
        }
        moved
    }

    /// The word of ISO 10303-42 for this kind.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Plane(_) => "plane",
            Self::Cylinder { .. } => "cylindrical_surface",
            Self::Cone { .. } => "conical_surface",
            Self::Sphere { .. } => "spherical_surface",
            Self::Torus { .. } => "toroidal_surface",
            Self::Swept(s) => s.kind(),
            Self::Nurbs(_) => "b_spline_surface",
        }
    }
}

/// A meridian (radius and height with two derivatives) turned by `u` about z.
#[inline]
fn turned(
    frame: &Frame,
    u: f64,
    [[r, h], [dr, dh], [ddr, ddh]]: [[f64; 2]; 3],
) -> SurfaceDerivatives {
    let (out, around) = frame.around(u);
    SurfaceDerivatives {
        point: frame.origin + out * r + frame.z * h,
        du: around * r,
        dv: out * dr + frame.z * dh,
        duu: out * -r,
        duv: around * dr,
        dvv: out * ddr + frame.z * ddh,
    }
}

#[cfg(test)]
mod tests {
    use super::super::Curve;
    use super::*;

    fn all() -> Vec<Surface> {
        let frame = Frame::new(
            DVec3::new(1.0, 2.0, 3.0),
            DVec3::new(0.3, -0.2, 1.0),
            DVec3::X,
        )
        .expect("a frame");
        let torus = |major_mm, minor_mm| Surface::Torus {
            frame,
            major_mm,
            minor_mm,
        };
        let ellipse = Curve::Ellipse {
            frame: Frame::new(frame.origin + frame.x * 9.0, frame.y, frame.x).expect("a frame"),
            semi_axes_mm: [3.0, 1.5],
        };
        let revolved = Sweep::around(ellipse.clone(), frame).expect("a closed profile");
        let extruded = Sweep::along(ellipse, DVec3::new(0.2, 1.0, 0.1)).expect("a closed profile");
        vec![
            Surface::Plane(frame),
            Surface::Cylinder {
                frame,
                radius_mm: 4.0,
            },
            Surface::Cone {
                frame,
                radius_mm: 3.0,
                half_angle_rad: 0.5,
            },
            Surface::Sphere {
                frame,
                radius_mm: 5.0,
            },
            torus(6.0, 2.0),
            torus(1.0, 5.0),
            torus(-1.0, 5.0),
            Surface::Swept(Box::new(revolved)),
            Surface::Swept(Box::new(extruded)),
        ]
    }

    #[test]
    fn derivatives_agree_with_central_differences() {
        let h = 1e-5;
        for s in all() {
            for (u, v) in [(0.4, 0.3), (2.0, -0.7), (5.5, 1.1)] {
                let d = s.derivatives(u, v);
                let by = |du: f64, dv: f64| s.derivatives(u + du, v + dv);
                // Truncation h^2 times third derivatives of 10; rounding 1e-15 / h.
                let close = |a: DVec3, b: DVec3| (a - b).length() < 1e-8;
                assert!(
                    close(d.du, (by(h, 0.0).point - by(-h, 0.0).point) / (2.0 * h)),
                    "{}",
                    s.kind()
                );
                assert!(
                    close(d.dv, (by(0.0, h).point - by(0.0, -h).point) / (2.0 * h)),
                    "{}",
                    s.kind()
                );
                assert!(
                    close(d.duu, (by(h, 0.0).du - by(-h, 0.0).du) / (2.0 * h)),
                    "{}",
                    s.kind()
                );
                assert!(
                    close(d.duv, (by(0.0, h).du - by(0.0, -h).du) / (2.0 * h)),
                    "{}",
                    s.kind()
                );
                assert!(
                    close(d.dvv, (by(0.0, h).dv - by(0.0, -h).dv) / (2.0 * h)),
                    "{}",
                    s.kind()
                );
            }
        }
    }

    #[test]
    fn no_sample_is_nearer_than_the_nearest_point() {
        for s in all() {
            let [ru, rv] = s.ranges();
            let end = |t: f64, instead: f64| if t.is_finite() { t } else { instead };
            let (u0, u1) = (end(ru.from, -30.0), end(ru.to, 30.0));
            let (v0, v1) = (end(rv.from, -30.0), end(rv.to, 30.0));
            let mut samples = Vec::new();
            for i in 0..=90 {
                for j in 0..=90 {
                    let at = |a: f64, b: f64, k: i32| a + (b - a) * f64::from(k) / 90.0;
                    samples.push(s.point(at(u0, u1, i), at(v0, v1, j)));
                }
            }
            for k in 0..40 {
                let a = f64::from(k);
                let p = DVec3::new(
                    9.0 * (1.7 * a).sin(),
                    9.0 * (2.3 * a).cos(),
                    3.0 + 8.0 * (0.9 * a).sin(),
                );
                let (u, v) = s.nearest(p, None);
                let d = s.point(u, v).distance(p);
                let sampled = samples
                    .iter()
                    .map(|q| q.distance(p))
                    .fold(f64::INFINITY, f64::min);
                assert!(
                    d <= sampled + 1e-9,
                    "{}: {d}, but a sample at {sampled}",
                    s.kind()
                );
            }
        }
    }
}

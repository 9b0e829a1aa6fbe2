//! Curves in space: analytic ones kept exact, and rational B-splines.

use std::f64::consts::PI;

use glam::DVec3;

use super::newton::{Range, nearest_on_curve};
use super::{Frame, NurbsCurve, RigidTransform};

/// A curve in mm, unbounded or closed where its kind is; parameters as in ISO 10303-42, a line's in mm.
#[derive(Debug, Clone, PartialEq)]
pub enum Curve {
    /// A straight line through `origin` along the unit vector `direction`.
    Line {
        /// Where the parameter is 0.
        origin: DVec3,
        /// Unit vector.
        direction: DVec3,
    },
    /// A circle in the plane of x and y of its frame, by angle from x.
    Circle {
        /// Centre and plane.
        frame: Frame,
        /// In mm.
        radius_mm: f64,
    },
    /// An ellipse in the plane of x and y of its frame, by eccentric angle.
    Ellipse {
        /// Centre and axes.
        frame: Frame,
        /// Half axes along x and y, mm.
        semi_axes_mm: [f64; 2],
    },
    /// `focal_mm * (t^2 x + 2 t y)` from the vertex.
    Parabola {
        /// Vertex and axes.
        frame: Frame,
        /// From vertex to focus, mm.
        focal_mm: f64,
    },
    /// `a cosh t x + b sinh t y` from the centre.
    Hyperbola {
        /// Centre and axes.
        frame: Frame,
        /// a and b, mm.
        semi_axes_mm: [f64; 2],
    },
    /// A rational B-spline curve.
    Nurbs(NurbsCurve),
}

impl Curve {
    /// Where the parameter lives.
    pub fn range(&self) -> Range {
        match self {
            Self::Line { .. } | Self::Parabola { .. } | Self::Hyperbola { .. } => Range::UNBOUNDED,
            Self::Circle { .. } | Self::Ellipse { .. } => Range::TURN,
            Self::Nurbs(curve) => curve.range(),
        }
    }

    /// Position at `t`; closed curves go on beyond their range.
    pub fn point(&self, t: f64) -> DVec3 {
        match self {
            Self::Line { origin, direction } => *origin + *direction * t,
            Self::Nurbs(curve) => curve.point(t),
            _ => self.derivatives(t)[0],
        }
    }

    /// Position, first and second derivative at `t`.
    pub fn derivatives(&self, t: f64) -> [DVec3; 3] {
        let conic = |frame: &Frame, [x, y]: [f64; 2], [dx, dy]: [f64; 2], [ddx, ddy]: [f64; 2]| {
            [
                frame.origin + frame.x * x + frame.y * y,
                frame.x * dx + frame.y * dy,
                frame.x * ddx + frame.y * ddy,
            ]
        };
        match self {
            Self::Line { origin, direction } => [*origin + *direction * t, *direction, DVec3::ZERO],
            Self::Circle { frame, radius_mm } => {
                let (s, c) = t.sin_cos();
                let (s, c) = (s * radius_mm, c * radius_mm);
                conic(frame, [c, s], [-s, c], [-c, -s])
            }
            Self::Ellipse {
                frame,
                semi_axes_mm: [a, b],
            } => {
                let (s, c) = t.sin_cos();
                conic(frame, [a * c, b * s], [-a * s, b * c], [-a * c, -b * s])
            }
            Self::Parabola { frame, focal_mm: f } => conic(
                frame,
                [f * t * t, 2.0 * f * t],
                [2.0 * f * t, 2.0 * f],
                [2.0 * f, 0.0],
            ),
            Self::Hyperbola {
                frame,
                semi_axes_mm: [a, b],
            } => {
                let (s, c) = (t.sinh(), t.cosh());
                conic(frame, [a * c, b * s], [a * s, b * c], [a * c, b * s])
            }
            Self::Nurbs(curve) => curve.derivatives(t),
        }
    }

    /// Parameter of the nearest point of the whole curve, and the distance.
    pub fn nearest(&self, p: DVec3) -> (f64, f64) {
        let local = |frame: &Frame| frame.local(p);
        let t = match self {
            Self::Line { origin, direction } => (p - *origin).dot(*direction),
            Self::Circle { frame, .. } => Frame::angle_of(local(frame).truncate()),
            Self::Ellipse {
                frame,
                semi_axes_mm,
            } => {
                let l = local(frame);
                return self.ellipse_nearest(p, [l.x, l.y], *semi_axes_mm);
            }
            Self::Parabola { frame, focal_mm } => {
                self.downhill(p, local(frame).y / (2.0 * focal_mm))
            }
            Self::Hyperbola {
                frame,
                semi_axes_mm,
            } => self.downhill(p, (local(frame).y / semi_axes_mm[1]).asinh()),
            Self::Nurbs(curve) => return curve.nearest(p),
        };
        (t, self.point(t).distance(p))
    }

    /// The curve moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        let mut moved = self.clone();
        match &mut moved {
            Self::Line { origin, direction } => {
                *origin = by.point(*origin);
                *direction = by.vector(*direction);
            }
            Self::Circle { frame, .. }
            | Self::Ellipse { frame, .. }
            | Self::Parabola { frame, .. }
            | Self::Hyperbola { frame, .. } => *frame = frame.transformed(by),
            Self::Nurbs(curve) => *curve = curve.transformed(by),
        }
        moved
    }

    /// The word of ISO 10303-42 for this kind.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Line { .. } => "line",
            Self::Circle { .. } => "circle",
            Self::Ellipse { .. } => "ellipse",
            Self::Parabola { .. } => "parabola",
            Self::Hyperbola { .. } => "hyperbola",
            Self::Nurbs(_) => "b_spline_curve",
        }
    }

    fn downhill(&self, p: DVec3, start: f64) -> f64 {
        nearest_on_curve(|t| self.derivatives(t), p, start, self.range()).0
    }

    /// The nearest point lies in the quadrant of the point: there the distance has one minimum.
    fn ellipse_nearest(&self, p: DVec3, [x, y]: [f64; 2], [a, b]: [f64; 2]) -> (f64, f64) {
        // In the first quadrant: f(t) = (a^2 - b^2) sin t cos t - a x sin t + b y cos t falls through zero at the foot.
        let slope = |t: f64| {
            let (s, c) = t.sin_cos();
            (a * a - b * b) * s * c - a * x.abs() * s + b * y.abs() * c
        };
        let (mut low, mut high) = (0.0, 0.5 * PI);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if slope(middle) > 0.0 {
                low = middle;
            } else {
                high = middle;
            }
        }
        let t = 0.5 * (low + high);
        let t = match (x < 0.0, y < 0.0) {
            (false, false) => t,
            (true, false) => PI - t,
            (true, true) => PI + t,
            (false, true) => 2.0 * PI - t,
        };
        (t, self.point(t).distance(p))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Frame {
        Frame::new(
            DVec3::new(1.0, 2.0, 3.0),
            DVec3::new(0.2, -0.4, 1.0),
            DVec3::X,
        )
        .expect("a frame")
    }

    fn all() -> Vec<Curve> {
        let f = frame();
        vec![
            Curve::Line {
                origin: f.origin,
                direction: f.x,
            },
            Curve::Circle {
                frame: f,
                radius_mm: 5.0,
            },
            Curve::Ellipse {
                frame: f,
                semi_axes_mm: [7.0, 2.0],
            },
            Curve::Ellipse {
                frame: f,
                semi_axes_mm: [1.5, 4.0],
            },
            Curve::Parabola {
                frame: f,
                focal_mm: 0.8,
            },
            Curve::Hyperbola {
                frame: f,
                semi_axes_mm: [2.0, 1.0],
            },
        ]
    }

    #[test]
    fn derivatives_agree_with_central_differences() {
        let h = 1e-4;
        for c in all() {
            for t in [-0.9, 0.0, 0.3, 1.7] {
                let [_, d, dd] = c.derivatives(t);
                let (before, here, after) = (c.point(t - h), c.point(t), c.point(t + h));
                // Truncation h^2 times third derivatives of size 10; rounding 1e-15 / h^2.
                assert!(
                    (d - (after - before) / (2.0 * h)).length() < 1e-6,
                    "{}",
                    c.kind()
                );
                assert!(
                    (dd - (after - here * 2.0 + before) / (h * h)).length() < 1e-5,
                    "{}",
                    c.kind()
                );
            }
        }
    }

    #[test]
    fn no_sample_is_nearer_than_the_nearest_point() {
        for c in all() {
            for k in 0..60 {
                let a = f64::from(k);
                let p = DVec3::new(
                    6.0 * (1.3 * a).sin(),
                    7.0 * (0.7 * a).cos(),
                    3.0 + (2.1 * a).sin(),
                );
                let (t, d) = c.nearest(p);
                assert!((c.point(t).distance(p) - d).abs() < 1e-12);
                for i in -700..=700 {
                    let other = c.point(f64::from(i) * 0.01).distance(p);
                    // The bisection for the ellipse leaves 1e-18 of a turn; the other kinds are exact.
                    assert!(
                        d <= other + 1e-9,
                        "{}: {d} at {t}, {other} beside it",
                        c.kind()
                    );
                }
            }
        }
    }
}

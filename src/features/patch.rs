//! Planes and quadrics through the points of a small neighbourhood, in units of the spacing, seen from the point in question.

use glam::DVec3;

use crate::points::moments::Moments;

/// An unoriented plane: `normal . x = offset`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plane {
    pub normal: DVec3,
    pub offset: f64,
}

impl Plane {
    /// The plane of least orthogonal squares.
    pub fn through(points: impl Iterator<Item = DVec3>) -> Self {
        let mut moments = Moments::default();
        points.for_each(|p| moments.add(p));
        let fit = moments.plane();
        Self {
            normal: fit.normal,
            offset: fit.normal.dot(fit.centre),
        }
    }

    /// Signed distance.
    pub fn distance(&self, p: DVec3) -> f64 {
        self.normal.dot(p) - self.offset
    }
}

/// A height function of second degree over a plane, or of first where `coefficients[3..]` are zero.
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    origin: DVec3,
    frame: [DVec3; 3],
    coefficients: [f64; 6],
}

/// What a fit left over.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    pub surface: Surface,
    /// Sum of squared residuals, each capped.
    pub squares: f64,
    /// Points fitted.
    pub count: usize,
    /// Parameters fitted.
    pub parameters: usize,
}

impl Fit {
    /// Bayes' information criterion at noise of variance `variance`: smaller is better.
    pub fn criterion(&self, variance: f64) -> f64 {
        self.squares / variance + self.parameters as f64 * (self.count.max(2) as f64).ln()
    }
}

impl Surface {
    /// The plane as a surface.
    fn flat(plane: Plane, near: DVec3) -> Self {
        let n = plane.normal;
        let u = n.any_orthonormal_vector();
        Self {
            origin: near - n * plane.distance(near),
            frame: [u, n.cross(u), n],
            coefficients: [0.0; 6],
        }
    }

    fn local(&self, p: DVec3) -> [f64; 3] {
        let d = p - self.origin;
        self.frame.map(|axis| d.dot(axis))
    }

    /// Height of `p` above the surface along the frame's normal, and the gradient of that height.
    pub fn height(&self, p: DVec3) -> (f64, DVec3) {
        let [x, y, z] = self.local(p);
        let c = &self.coefficients;
        let h = c[0] + c[1] * x + c[2] * y + c[3] * x * x + c[4] * x * y + c[5] * y * y;
        let hx = c[1] + 2.0 * c[3] * x + c[4] * y;
        let hy = c[2] + c[4] * x + 2.0 * c[5] * y;
        let [u, v, n] = self.frame;
        (z - h, n - u * hx - v * hy)
    }

    /// Signed distance to first order.
    pub fn distance(&self, p: DVec3) -> f64 {
        let (h, gradient) = self.height(p);
        h / gradient.length()
    }

    /// Largest curvature at the middle of the fit, for a frame nearly tangent.
    pub fn curvature(&self) -> f64 {
        let [xx, xy, yy] = [
            2.0 * self.coefficients[3],
            self.coefficients[4],
            2.0 * self.coefficients[5],
        ];
        let mean = 0.5 * (xx + yy);
        mean.abs() + (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()
    }

    /// Unit direction in which the middle of a curved fit bends most.
    pub fn bending(&self) -> Option<DVec3> {
        let [xx, xy, yy] = [
            2.0 * self.coefficients[3],
            self.coefficients[4],
            2.0 * self.coefficients[5],
        ];
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let along = |a: f64| self.frame[0] * a.cos() + self.frame[1] * a.sin();
        // The angle is that of the larger, not of the stronger curvature.
        let strong = if xx + yy < 0.0 {
            angle + 0.5 * std::f64::consts::PI
        } else {
            angle
        };
        self.is_curved().then(|| along(strong))
    }

    /// Whether the surface is curved.
    pub fn is_curved(&self) -> bool {
        self.coefficients[3..].iter().any(|c| *c != 0.0)
    }
}

/// The better, by Bayes' criterion, of the plane and the quadric through `points`.
///
/// `variance` is that of the noise; residuals count up to three standard deviations. `None` for fewer than three points.
pub(super) fn fit(points: &[DVec3], variance: f64) -> Option<Fit> {
    let count = points.len();
    if count < 3 {
        return None;
    }
    let mut moments = Moments::default();
    points.iter().for_each(|p| moments.add(*p));
    let plane = moments.plane();
    let flat = Plane {
        normal: plane.normal,
        offset: plane.normal.dot(plane.centre),
    };
    let cap = 9.0 * variance;
    let simple = Fit {
        surface: Surface::flat(flat, plane.centre),
        squares: points
            .iter()
            .map(|p| flat.distance(*p).powi(2).min(cap))
            .sum(),
        count,
        parameters: 3,
    };
    let worth_bending = simple.squares > variance * 3.0 * (count as f64).ln();
    if count < 9 || !worth_bending {
        return Some(simple);
    }
    let mut curved = simple.surface;
    for _ in 0..2 {
        let Some(better) = bend(&curved, points) else {
            return Some(simple);
        };
        curved = better;
        // Weights by a slope of a fifth differ from one by four percent.
        let reach2 = 4.0 * plane.variances[0];
        if curved.curvature().powi(2) * reach2 < 0.04 {
            break;
        }
    }
    let bent = Fit {
        surface: curved,
        squares: points
            .iter()
            .map(|p| curved.distance(*p).powi(2).min(cap))
            .sum(),
        count,
        parameters: 6,
    };
    Some(if bent.criterion(variance) < simple.criterion(variance) {
        bent
    } else {
        simple
    })
}

/// What the height function of fourth degree over the frame of `under` leaves over: the criterion of a surface whose curvature changes.
pub(super) fn varying(under: &Surface, points: &[DVec3], variance: f64) -> Option<f64> {
    const TERMS: usize = 15;
    let count = points.len();
    if count < 2 * TERMS {
        return None;
    }
    let reach = points
        .iter()
        .map(|p| under.local(*p))
        .fold(0.0, |r: f64, [x, y, _]| r.max(x * x + y * y))
        .sqrt();
    let row = |p: DVec3| {
        let [x, y, z] = under.local(p).map(|c| c / reach);
        let (x2, y2) = (x * x, y * y);
        let c = &under.coefficients;
        let hx = c[1] + reach * (2.0 * c[3] * x + c[4] * y);
        let hy = c[2] + reach * (c[4] * x + 2.0 * c[5] * y);
        (
            [
                1.0,
                x,
                y,
                x2,
                x * y,
                y2,
                x2 * x,
                x2 * y,
                x * y2,
                y2 * y,
                x2 * x2,
                x2 * x * y,
                x2 * y2,
                x * y * y2,
                y2 * y2,
            ],
            z,
            1.0 / (1.0 + hx * hx + hy * hy),
        )
    };
    let mut a = [[0.0; TERMS]; TERMS];
    let mut b = [0.0; TERMS];
    for p in points {
        let (row, z, weight) = row(*p);
        for i in 0..TERMS {
            let w = weight * row[i];
            b[i] += w * z;
            for j in i..TERMS {
                a[i][j] += w * row[j];
            }
        }
    }
    let c = solve(a, b)?;
    let cap = 9.0 * variance;
    let squares: f64 = points
        .iter()
        .map(|p| {
            let (row, z, weight) = row(*p);
            let h: f64 = row.iter().zip(&c).map(|(r, c)| r * c).sum();
            ((z - h).powi(2) * weight * reach * reach).min(cap)
        })
        .sum();
    Some(squares / variance + TERMS as f64 * (count as f64).ln())
}

/// Least squares of the six coefficients in the frame of `start`, each height weighted by the slope of `start` there.
fn bend(start: &Surface, points: &[DVec3]) -> Option<Surface> {
    let mut a = [[0.0; 6]; 6];
    let mut b = [0.0; 6];
    let c = &start.coefficients;
    for p in points {
        let [x, y, z] = start.local(*p);
        let row = [1.0, x, y, x * x, x * y, y * y];
        let hx = c[1] + 2.0 * c[3] * x + c[4] * y;
        let hy = c[2] + c[4] * x + 2.0 * c[5] * y;
        let weight = 1.0 / (1.0 + hx * hx + hy * hy);
        for i in 0..6 {
            let w = weight * row[i];
            b[i] += w * z;
            for j in i..6 {
                a[i][j] += w * row[j];
            }
        }
    }
    solve(a, b).map(|coefficients| Surface {
        coefficients,
        ..*start
    })
}

/// Solves the symmetric system whose upper triangle is `a`; `None` where it is singular.
pub(super) fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    let scale = (0..N).map(|i| a[i][i]).fold(0.0, f64::max);
    for k in 0..N {
        let pivot = a[k][k];
        if pivot.is_nan() || pivot <= 1e-12 * scale {
            return None;
        }
        for i in k + 1..N {
            let f = a[k][i] / pivot;
            let pivot_row = a[k];
            for (value, above) in a[i].iter_mut().zip(&pivot_row).skip(i) {
                *value -= f * above;
            }
            b[i] -= f * b[k];
        }
    }
    for k in (0..N).rev() {
        let rest: f64 = (k + 1..N).map(|j| a[k][j] * b[j]).sum();
        b[k] = (b[k] - rest) / a[k][k];
    }
    Some(b)
}

/// The point nearest to `start` that lies on both surfaces, and the unit tangent of their intersection there.
///
/// Newton's method on both heights, taking the shortest step each time; `None` where the surfaces run parallel.
pub(super) fn foot(one: &Surface, other: &Surface, start: DVec3) -> Option<(DVec3, DVec3)> {
    let mut at = start;
    let mut tangent = DVec3::ZERO;
    let rounds = if one.is_curved() || other.is_curved() {
        6
    } else {
        2
    };
    for _ in 0..rounds {
        let ((h1, g1), (h2, g2)) = (one.height(at), other.height(at));
        let (h1, g1) = (h1 / g1.length(), g1.normalize());
        let (h2, g2) = (h2 / g2.length(), g2.normalize());
        let c = g1.dot(g2);
        let s2 = 1.0 - c * c;
        if s2.is_nan() || s2 < 1e-5 {
            return None;
        }
        tangent = g1.cross(g2) / s2.sqrt();
        let on_both = at - g1 * ((h1 - c * h2) / s2) - g2 * ((h2 - c * h1) / s2);
        // Keep to the plane across the edge through the start, so that the foot is the nearest point of the curve.
        at = on_both + tangent * tangent.dot(start - on_both);
        if (at - start).length_squared() > 64.0 {
            return None;
        }
    }
    Some((at, tangent))
}

/// The point where three surfaces meet, near `start`.
pub(super) fn meeting(surfaces: [&Surface; 3], start: DVec3) -> Option<DVec3> {
    let mut at = start;
    for _ in 0..6 {
        let [(h0, g0), (h1, g1), (h2, g2)] = surfaces.map(|s| s.height(at));
        let det = g0.dot(g1.cross(g2));
        if det.is_nan() || det.abs() < 0.02 * g0.length() * g1.length() * g2.length() {
            return None;
        }
        at -= (g1.cross(g2) * h0 + g2.cross(g0) * h1 + g0.cross(g1) * h2) / det;
        if (at - start).length_squared() > 64.0 {
            return None;
        }
    }
    Some(at)
}

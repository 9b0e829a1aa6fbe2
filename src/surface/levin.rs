//! Levin's projection of one point: the reference plane, then the polynomial over it.

use glam::{DMat3, DVec3};

use super::polynomial::{Degree, Equations, Jet, LocalFrame, Polynomial};
use crate::points::moments::eigen;

/// Steps of the search for the reference plane at most; from the weighted plane of least squares, two do nearly always.
const PLANE_STEPS: usize = 8;

/// The search ends where a step turns the plane by less than this, rad, and moves it by less than this part of h.
const PLANE_CHANGE: f64 = 1e-3;

/// Rounds of orthogonal projection: each moves the polynomial's centre to the foot found before.
const FOOT_ROUNDS: usize = 4;

/// The local approximation of a surface near a query point.
#[derive(Debug, Clone)]
pub(crate) struct LocalSurface {
    pub frame: LocalFrame,
    pub polynomial: Polynomial,
}

/// A point of the surface with what the local approximation says about it. Positions in the query's frame of reference.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Foot {
    pub position: DVec3,
    pub normal: DVec3,
    pub jet: Jet,
    /// In the local frame of the approximation.
    pub inside: DVec3,
}

/// Weights and degree of the approximation, and the noise by which it shrinks insignificant curvature.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Smoothing {
    pub degree: Degree,
    /// h of the Gaussian weight exp(-d²/h²), mm.
    pub h_mm: f64,
    pub sigma_mm: f64,
    /// How far from its centre a local approximation is believed, mm.
    pub reach_mm: f64,
}

/// The Gaussian weight exp(-d²/h²) of a squared distance (Weber 2011, eq. 4.3).
#[inline]
pub(crate) fn gaussian(squared: f64, h_mm: f64) -> f64 {
    exp_of_minus(squared / (h_mm * h_mm))
}

/// exp(-x) for x >= 0, to a part in 100,000 up to x = 4 and to a percent of its own size up to x = 10, where no weight counts any more.
///
/// A seventh of all time went into the library's function, which cannot be vectorised. Taylor series of exp(-x/16), squared four times.
#[inline]
pub(crate) fn exp_of_minus(x: f64) -> f64 {
    let t = x * (-1.0 / 16.0);
    let series =
        1.0 + t * (1.0 + t * (0.5 + t * (1.0 / 6.0 + t * (1.0 / 24.0 + t * (1.0 / 120.0)))));
    let two = series * series;
    let four = two * two;
    let eight = four * four;
    if x < 30.0 { eight * eight } else { 0.0 }
}

/// Unit normal of the weighted plane of least squares around `centre`; `None` for points on a line or fewer than three.
pub(crate) fn weighted_normal(points: &[DVec3], centre: DVec3, h_mm: f64) -> Option<DVec3> {
    let (mut weights, mut sum) = (0.0, DVec3::ZERO);
    let (mut square, mut mixed) = (DVec3::ZERO, DVec3::ZERO);
    for p in points {
        let d = *p - centre;
        let w = gaussian(d.length_squared(), h_mm);
        weights += w;
        sum += d * w;
        square += d * d * w;
        mixed += DVec3::new(d.y * d.z, d.z * d.x, d.x * d.y) * w;
    }
    if points.len() < 3 || weights <= 0.0 {
        return None;
    }
    let mean = sum / weights;
    let s = square / weights - mean * mean;
    let m = mixed / weights - DVec3::new(mean.y * mean.z, mean.z * mean.x, mean.x * mean.y);
    let (values, vectors) = eigen([[s.x, m.z, m.y], [m.z, s.y, m.x], [m.y, m.x, s.z]]);
    (values[1] > 1e-12 * values[0]).then_some(vectors[2])
}

/// Levin's reference plane of `query`: its unit normal n and the offset t such that q = query + t n lies on it.
///
/// Minimises the sum of <n, p_i - query - t n>² exp(-|p_i - query - t n|²/h²) over n and t together, by Gauss-Newton steps with the
/// gradient of the weights included, from the normal `start` (Weber 2011, §2.3.2.2, eq. 2.17).
pub(crate) fn reference_plane(
    points: &[DVec3],
    query: DVec3,
    start: DVec3,
    h_mm: f64,
) -> Option<(DVec3, f64)> {
    let (mut normal, mut offset) = (start, 0.0);
    let inverse = 1.0 / (h_mm * h_mm);
    for step in 0..PLANE_STEPS {
        // As far away as h the sum is stationary in t although no plane is there: the first step takes the weights as they are.
        let pull = if step == 0 { 0.0 } else { inverse };
        let (u, v) = normal.any_orthonormal_pair();
        let mut hessian = [[0.0f64; 3]; 3];
        let mut gradient = [0.0f64; 3];
        for p in points {
            let d = *p - query;
            let along = normal.dot(d);
            let residual = along - offset;
            let squared = d.length_squared() - offset * (2.0 * along - offset);
            let w = exp_of_minus(squared.max(0.0) * inverse);
            let (a, b) = (u.dot(d), v.dot(d));
            let tilt = w * residual * (1.0 + residual * offset * pull);
            gradient[0] -= w * residual * (1.0 - residual * residual * pull);
            gradient[1] += tilt * a;
            gradient[2] += tilt * b;
            hessian[0][0] += w;
            hessian[0][1] -= w * a;
            hessian[0][2] -= w * b;
            hessian[1][1] += w * a * a;
            hessian[1][2] += w * a * b;
            hessian[2][2] += w * b * b;
        }
        let [back, about_v, about_u] = solve_symmetric(hessian, gradient)?;
        offset -= back;
        normal = (normal - u * about_v - v * about_u).normalize();
        if offset.is_nan() || offset.abs() > 3.0 * h_mm {
            return None;
        }
        let turned = about_v.abs().max(about_u.abs());
        if turned < PLANE_CHANGE && back.abs() < PLANE_CHANGE * h_mm {
            break;
        }
    }
    Some((normal, offset))
}

fn solve_symmetric(m: [[f64; 3]; 3], right: [f64; 3]) -> Option<[f64; 3]> {
    let matrix = DMat3::from_cols_array_2d(&[
        [m[0][0], m[0][1], m[0][2]],
        [m[0][1], m[1][1], m[1][2]],
        [m[0][2], m[1][2], m[2][2]],
    ]);
    let size = m[0][0] * m[1][1] * m[2][2];
    let determinant = matrix.determinant();
    if determinant.is_nan() || determinant <= 1e-9 * size {
        return None;
    }
    Some((matrix.inverse() * DVec3::from_array(right)).to_array())
}

/// Both steps of Levin's projection for `query`, over the given points.
pub(crate) fn approximate(
    points: &[DVec3],
    query: DVec3,
    start: DVec3,
    smoothing: &Smoothing,
) -> Option<LocalSurface> {
    let (normal, offset) = reference_plane(points, query, start, smoothing.h_mm)?;
    let frame = LocalFrame::new(query + normal * offset, normal);
    let polynomial = fit(points, &frame, smoothing)?;
    Some(LocalSurface { frame, polynomial })
}

/// The polynomial over `frame`, weighted around its origin (Weber 2011, §2.3.2.2, eq. 2.18).
pub(crate) fn fit(
    points: &[DVec3],
    frame: &LocalFrame,
    smoothing: &Smoothing,
) -> Option<Polynomial> {
    equations(points, frame, smoothing).solve(smoothing.sigma_mm)
}

fn equations(points: &[DVec3], frame: &LocalFrame, smoothing: &Smoothing) -> Equations {
    let mut equations = Equations::new(smoothing.degree, smoothing.h_mm);
    equations.add_all(points.iter().map(|p| {
        let at = frame.inside(*p);
        (at, gaussian(at.length_squared(), smoothing.h_mm))
    }));
    equations
}

impl LocalSurface {
    /// The nearest point of the approximation to `p`; `None` where it lies beyond `reach_mm`.
    pub fn foot(&self, p: DVec3, reach_mm: f64) -> Option<Foot> {
        let (inside, jet) = self.polynomial.foot(self.frame.inside(p), reach_mm)?;
        Some(Foot {
            position: self.frame.outside(inside),
            normal: self.frame.direction(jet.normal()),
            jet,
            inside,
        })
    }

    /// Signed distance of `p` to the approximation, mm, to first order, and the unit normal above or below it.
    pub fn look(&self, p: DVec3) -> (f64, DVec3) {
        let at = self.frame.inside(p);
        let jet = self.polynomial.jet(at.x, at.y);
        let cosine = 1.0 / (1.0 + jet.gradient.length_squared()).sqrt();
        let normal = DVec3::new(-jet.gradient.x, -jet.gradient.y, 1.0) * cosine;
        ((at.z - jet.height) * cosine, self.frame.direction(normal))
    }

    /// Signed distance of `p` to the approximation, mm, to first order; positive on the side of the frame's normal.
    pub fn distance(&self, p: DVec3) -> f64 {
        let at = self.frame.inside(p);
        let jet = self.polynomial.jet(at.x, at.y);
        (at.z - jet.height) / (1.0 + jet.gradient.length_squared()).sqrt()
    }

    /// Variance, mm², of the surface at `foot` along its normal, under noise of `sigma_mm`: that of the unshrunk estimate, which is linear
    /// in the points, and the square of what the shrinking changed, for the bias that it may have brought in.
    pub fn variance(&self, points: &[DVec3], foot: &Foot, smoothing: &Smoothing) -> Option<f64> {
        let terms = self.polynomial.terms();
        let equations = equations(points, &self.frame, smoothing);
        let inverse = equations.inverse(terms)?;
        let unshrunk = equations.solve(0.0)?;
        let changed = unshrunk.height(foot.inside.x, foot.inside.y) - foot.inside.z;
        let scale = smoothing.h_mm;
        let at = super::polynomial::monomials(foot.inside.x / scale, foot.inside.y / scale);
        let mut row = [0.0; super::polynomial::TERMS_MAX];
        for (i, column) in inverse.iter().enumerate().take(terms) {
            row[i] = (0..terms).map(|j| at[j] * column[j]).sum();
        }
        let mut sum = 0.0;
        for p in points {
            let q = self.frame.inside(*p);
            let phi = super::polynomial::monomials(q.x / scale, q.y / scale);
            let w = gaussian(q.length_squared(), scale);
            let influence: f64 = w * (0..terms).map(|j| row[j] * phi[j]).sum::<f64>();
            sum += influence * influence;
        }
        // Heights run along the frame's normal, the surface's own is tilted against it.
        Some(
            (sum * smoothing.sigma_mm * smoothing.sigma_mm + changed * changed)
                / (1.0 + foot.jet.gradient.length_squared()),
        )
    }
}

/// The point of the moving least squares surface nearest to `query`.
///
/// We differ: the thesis reads the height above the plane's origin, which is biased where the surface curves and the query lies off
/// it. Here the approximation is centred anew on the foot until that stays.
pub(crate) fn project(
    points: &[DVec3],
    query: DVec3,
    start: DVec3,
    smoothing: &Smoothing,
) -> Option<(LocalSurface, Foot)> {
    let mut centre = query;
    let mut normal = start;
    for round in 0..FOOT_ROUNDS {
        let local = approximate(points, centre, normal, smoothing)?;
        let foot = local.foot(query, smoothing.reach_mm)?;
        let moved = foot.position.distance(local.frame.origin);
        if moved < 0.05 * smoothing.h_mm || round + 1 == FOOT_ROUNDS {
            return Some((local, foot));
        }
        centre = foot.position;
        normal = local.frame.normal;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of z = x²/20 + xy/30 on a grid of spacing 0.2 with heights that scatter by 0.02.
    fn saddle() -> Vec<DVec3> {
        let mut points = Vec::new();
        for i in -8..=8 {
            for j in -8..=8 {
                let (x, y) = (f64::from(i) * 0.2, f64::from(j) * 0.2);
                let scatter = 0.02 * (f64::from(i * 37 + j * 101)).sin();
                points.push(DVec3::new(x, y, x * x / 20.0 + x * y / 30.0 + scatter));
            }
        }
        points
    }

    /// What Levin minimises, straight from its definition, for the normal (a, b, 1) / |(a, b, 1)| and the offset t.
    fn energy(points: &[DVec3], query: DVec3, h: f64, [a, b, t]: [f64; 3]) -> f64 {
        let n = DVec3::new(a, b, 1.0).normalize();
        let q = query + n * t;
        let term = |p: &DVec3| n.dot(*p - q).powi(2) * (-p.distance_squared(q) / (h * h)).exp();
        points.iter().map(term).sum()
    }

    #[test]
    fn the_reference_plane_is_where_trying_finds_the_minimum_too() {
        let points = saddle();
        let (query, h) = (DVec3::new(0.3, -0.2, 0.25), 0.6);
        // Coordinates in turn, steps halved where none helps: slow, and without any derivative.
        let mut best = [0.0, 0.0, -0.25];
        let mut step = 0.1;
        while step > 1e-6 {
            let before = best;
            for k in 0..3 {
                for way in [-step, step] {
                    let mut tried = best;
                    tried[k] += way;
                    if energy(&points, query, h, tried) < energy(&points, query, h, best) {
                        best = tried;
                    }
                }
            }
            if best == before {
                step *= 0.5;
            }
        }
        let start = weighted_normal(&points, query, h).expect("a plane");
        let (normal, offset) = reference_plane(&points, query, start, h).expect("a plane");
        let (normal, offset) = if normal.z < 0.0 {
            (-normal, -offset)
        } else {
            (normal, offset)
        };
        let truth = DVec3::new(best[0], best[1], 1.0).normalize();
        // Twice what the last step may change; the weights' approximation of exp is good to 1e-5.
        assert!(
            normal.distance(truth) < 2.0 * PLANE_CHANGE,
            "{normal} {truth}"
        );
        assert!(
            (offset - best[2]).abs() < 2.0 * PLANE_CHANGE * h,
            "{offset} {}",
            best[2]
        );
    }

    #[test]
    fn the_projection_is_orthogonal_where_a_vertical_one_is_not() {
        // A cylinder of radius 2 along y; queries off it must go straight to the axis.
        let mut points = Vec::new();
        for i in -30..=30 {
            for j in -12..=12 {
                let (s, c) = (f64::from(i) * 0.05).sin_cos();
                points.push(DVec3::new(2.0 * s, f64::from(j) * 0.1, 2.0 * c));
            }
        }
        let smoothing = |degree| Smoothing {
            degree,
            h_mm: 0.3,
            sigma_mm: 0.0,
            reach_mm: 0.9,
        };
        for degree in [Degree::Two, Degree::Three] {
            for (angle, off) in [(0.2f64, 0.3), (-0.4, -0.25), (0.0, 0.2)] {
                let out = DVec3::new(angle.sin(), 0.0, angle.cos());
                let query = out * (2.0 + off) + DVec3::Y * 0.13;
                // A start that is tilted by ten degrees.
                let start = (out + DVec3::Y * 0.17).normalize();
                let (_, foot) = project(&points, query, start, &smoothing(degree)).expect("near");
                let truth = out * 2.0 + DVec3::Y * 0.13;
                // A quadric leaves the circle by x⁴ / (8 r³) within h.
                assert!(
                    foot.position.distance(truth) < 1e-3,
                    "{} {truth}",
                    foot.position
                );
                assert!(foot.normal.dot(out).abs() > 0.9999, "{}", foot.normal);
                let bend = foot.jet.curvatures()[0].abs();
                assert!(
                    (bend - 0.5).abs() < 0.02,
                    "{degree:?}: {bend}, a radius of 2 bends by 0.5"
                );
            }
        }
    }
}

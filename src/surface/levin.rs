//! Levin's projection of one point: the reference plane, then the polynomial over it.

use glam::{DMat3, DVec3};

use super::polynomial::{Degree, Equations, Jet, LocalFrame, Polynomial};
use crate::points::moments::eigen;

/// Steps of the search for the reference plane; from the weighted plane of least squares, two change it by less than a part in a thousand.
const PLANE_STEPS: usize = 2;

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
    for _ in 0..PLANE_STEPS {
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
            let tilt = w * residual * (1.0 + residual * offset * inverse);
            gradient[0] -= w * residual * (1.0 - residual * residual * inverse);
            gradient[1] += tilt * a;
            gradient[2] += tilt * b;
            hessian[0][0] += w;
            hessian[0][1] -= w * a;
            hessian[0][2] -= w * b;
            hessian[1][1] += w * a * a;
            hessian[1][2] += w * a * b;
            hessian[2][2] += w * b * b;
        }
        let step = solve_symmetric(hessian, gradient)?;
        offset -= step[0];
        normal = (normal - u * step[1] - v * step[2]).normalize();
        if offset.is_nan() || offset.abs() > 3.0 * h_mm {
            return None;
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

//! Least-squares spheres: centre, radius, covariance, and the points that belong to one among others.

use glam::DVec3;
use nalgebra::{Matrix4, Vector4};

use super::fit::mad_sigma;

/// A sphere through points by least squares of the radial distances.
#[derive(Debug, Clone, PartialEq)]
pub struct SphereFit {
    /// Centre, mm.
    pub centre: DVec3,
    /// Radius, mm.
    pub radius_mm: f64,
    /// Standard deviation of one point along its radius, mm, from the residuals.
    pub sigma_mm: f64,
    /// Covariance of (centre, radius), mm squared, for independent points.
    pub covariance: [[f64; 4]; 4],
    /// Indices of the points used, ascending.
    pub used: Vec<u32>,
}

/// Rounds of Gauss-Newton with the outliers chosen anew: the sets settle within a few.
const ROUNDS: usize = 30;

/// Residuals beyond this many standard deviations belong to something else: of a million normal ones none is.
const OUTLIER: f64 = 5.0;

/// Fits a sphere to `points`, those farther than five standard deviations left out; `None` for fewer than five points or points that hold
/// no sphere (on one circle, in one plane).
pub fn fit_sphere(points: &[DVec3]) -> Option<SphereFit> {
    let first = algebraic(points)?;
    refine(points, first, f64::INFINITY)
}

/// Finds the sphere of radius `radius_mm` among `points`, of which many may belong to its stem, its base or nothing: the place that
/// most points agree upon within `tolerance_mm`, then refined with a free radius. Deterministic.
pub fn find_sphere(points: &[DVec3], radius_mm: f64, tolerance_mm: f64) -> Option<SphereFit> {
    const TRIES: u64 = 600;
    const LOOKED_AT: usize = 4000;
    let step = points.len().div_ceil(LOOKED_AT).max(1);
    let few: Vec<DVec3> = points.iter().copied().step_by(step).collect();
    if few.len() < 8 {
        return None;
    }
    let mut best: Option<(usize, Vector4<f64>)> = None;
    for attempt in 0..TRIES {
        let pick = |k: u64| few[(mixed(4 * attempt + k) % few.len() as u64) as usize];
        let Some(sphere) = algebraic(&[pick(0), pick(1), pick(2), pick(3)]) else {
            continue;
        };
        if (sphere[3] - radius_mm).abs() > 0.25 * radius_mm {
            continue;
        }
        let centre = DVec3::new(sphere[0], sphere[1], sphere[2]);
        let close = |p: &&DVec3| (p.distance(centre) - radius_mm).abs() < tolerance_mm;
        let votes = few.iter().filter(close).count();
        if best.as_ref().is_none_or(|(most, _)| votes > *most) {
            best = Some((votes, sphere));
        }
    }
    let (_, mut start) = best?;
    start[3] = radius_mm;
    refine(points, start, 3.0 * tolerance_mm)
}

/// SplitMix64: the n-th of a fixed sequence of well mixed numbers.
fn mixed(n: u64) -> u64 {
    let mut z = (n + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Linear least squares of |p|^2 = 2 c.p + (r^2 - |c|^2), about the mean for the sake of digits: (centre, radius).
fn algebraic(points: &[DVec3]) -> Option<Vector4<f64>> {
    if points.len() < 4 {
        return None;
    }
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let (mut matrix, mut right) = (Matrix4::zeros(), Vector4::zeros());
    for p in points {
        let q = *p - mean;
        let row = Vector4::new(2.0 * q.x, 2.0 * q.y, 2.0 * q.z, 1.0);
        matrix += row * row.transpose();
        right += row * q.length_squared();
    }
    let solved = matrix.cholesky()?.solve(&right);
    let centre = DVec3::new(solved[0], solved[1], solved[2]);
    let radius = (solved[3] + centre.length_squared()).sqrt();
    let centre = centre + mean;
    (radius.is_finite() && centre.is_finite())
        .then(|| Vector4::new(centre.x, centre.y, centre.z, radius))
}

/// Gauss-Newton from `sphere`, with points farther than `gate_mm` or five standard deviations left out.
fn refine(points: &[DVec3], mut sphere: Vector4<f64>, gate_mm: f64) -> Option<SphereFit> {
    let centre = |s: &Vector4<f64>| DVec3::new(s[0], s[1], s[2]);
    let residual = |s: &Vector4<f64>, p: DVec3| p.distance(centre(s)) - s[3];
    let mut used: Vec<u32> = Vec::new();
    let mut inverse = Matrix4::zeros();
    for round in 0..ROUNDS {
        let gate = if round == 0 {
            gate_mm
        } else {
            let seen: Vec<f64> = used
                .iter()
                .map(|i| residual(&sphere, points[*i as usize]))
                .collect();
            gate_mm
                .min(OUTLIER * mad_sigma(&seen))
                .max(1e-9 * sphere[3])
        };
        used = (0..points.len() as u32)
            .filter(|i| residual(&sphere, points[*i as usize]).abs() <= gate)
            .collect();
        if used.len() < 5 {
            return None;
        }
        let (mut matrix, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for i in &used {
            let p = points[*i as usize];
            let outward = (p - centre(&sphere)).normalize_or_zero();
            let row = Vector4::new(outward.x, outward.y, outward.z, 1.0);
            matrix += row * row.transpose();
            right += row * residual(&sphere, p);
        }
        // A cap so small that centre and radius cannot be told apart is no sphere.
        let eigen = matrix.symmetric_eigenvalues();
        if eigen.min() < 1e-9 * eigen.max() {
            return None;
        }
        inverse = matrix.try_inverse()?;
        let step = inverse * right;
        sphere += step;
        if !sphere.iter().all(|v| v.is_finite()) {
            return None;
        }
        if step.norm() < 1e-12 * sphere[3].max(1.0) && round > 3 {
            break;
        }
    }
    let squares: f64 = used
        .iter()
        .map(|i| residual(&sphere, points[*i as usize]).powi(2))
        .sum();
    let sigma = (squares / (used.len() as f64 - 4.0).max(1.0)).sqrt();
    Some(SphereFit {
        centre: centre(&sphere),
        radius_mm: sphere[3],
        sigma_mm: sigma,
        covariance: std::array::from_fn(|i| {
            std::array::from_fn(|j| inverse[(i, j)] * sigma * sigma)
        }),
        used,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Unit vectors spread evenly over the cap within `angle_rad` of +z, on a spiral.
    fn cap(count: usize, angle_rad: f64) -> Vec<DVec3> {
        let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
        (0..count)
            .map(|k| {
                let share = (k as f64 + 0.5) / count as f64;
                let z = 1.0 - share * (1.0 - angle_rad.cos());
                let r = (1.0 - z * z).sqrt();
                let (sin, cos) = (golden * k as f64).sin_cos();
                DVec3::new(r * cos, r * sin, z)
            })
            .collect()
    }

    fn noise(k: u64) -> f64 {
        let uniform = |n| (mixed(n) >> 11) as f64 / (1u64 << 53) as f64;
        // Twelve uniform numbers less six: normal enough, variance 1.
        (0..12).map(|i| uniform(1_000 + 12 * k + i)).sum::<f64>() - 6.0
    }

    #[test]
    fn a_noisy_cap_gives_its_sphere_within_the_stated_uncertainty() {
        let truth = DVec3::new(120.0, -45.0, 310.0);
        let mut z2 = 0.0;
        for seed in 0..40u64 {
            let points: Vec<DVec3> = cap(400, 1.2)
                .iter()
                .enumerate()
                .map(|(k, n)| truth + *n * (12.5 + 0.01 * noise(seed * 400 + k as u64)))
                .collect();
            let fit = fit_sphere(&points).expect("a sphere");
            let error = [
                fit.centre.x - truth.x,
                fit.centre.y - truth.y,
                fit.centre.z - truth.z,
                fit.radius_mm - 12.5,
            ];
            for (i, e) in error.iter().enumerate() {
                z2 += e * e / fit.covariance[i][i] / 160.0;
            }
        }
        // 160 numbers, centre z and radius nearly the same: the mean square is 1 within 4 sqrt(2 / 120).
        assert!((z2 - 1.0).abs() < 4.0 * (2.0f64 / 120.0).sqrt(), "{z2}");
    }

    #[test]
    fn the_sphere_is_found_on_its_stem_and_among_stray_points() {
        let truth = DVec3::new(5.0, 6.0, 80.0);
        let mut points: Vec<DVec3> = cap(2000, 1.3)
            .iter()
            .enumerate()
            .map(|(k, n)| truth + *n * (10.0 + 0.02 * noise(k as u64)))
            .collect();
        // A base plate, a stem, and a cloud of nothing.
        points.extend((0..3000).map(|k| {
            let (a, b) = (f64::from(k % 60), f64::from(k / 60));
            DVec3::new(a - 25.0, b - 20.0, 55.0)
        }));
        points.extend((0..500).map(|k| {
            let (sin, cos) = f64::from(k).sin_cos();
            truth + DVec3::new(3.0 * cos, 3.0 * sin, -10.0 - 0.03 * f64::from(k))
        }));
        points.extend((0..300u64).map(|k| {
            let at = |n| (mixed(50_000 + 3 * k + n) % 1000) as f64 * 0.06;
            DVec3::new(at(0) - 25.0, at(1) - 25.0, 50.0 + at(2))
        }));
        let fit = find_sphere(&points, 10.0, 0.1).expect("it is there");
        assert!(fit.centre.distance(truth) < 0.01, "{:?}", fit.centre);
        assert!((fit.radius_mm - 10.0).abs() < 0.01);
    }

    #[test]
    fn what_holds_no_sphere_is_refused() {
        let circle: Vec<DVec3> = (0..100)
            .map(|k| {
                let (sin, cos) = (f64::from(k) * 0.1).sin_cos();
                DVec3::new(cos, sin, 0.0)
            })
            .collect();
        assert_eq!(fit_sphere(&circle), None);
        assert_eq!(fit_sphere(&[DVec3::ONE; 50]), None);
        assert_eq!(fit_sphere(&[DVec3::NAN; 50]), None);
        assert_eq!(find_sphere(&circle, 1.0, 0.01), None);
        assert_eq!(find_sphere(&[], 1.0, 0.01), None);
    }
}

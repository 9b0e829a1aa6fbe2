//! Least-squares fits with residuals and covariance: linear models, planes, lines.

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SMatrix, SVector, SymmetricEigen};

/// Residuals beyond this many standard deviations are left out of a robust fit: 1 Gaussian residual in 2150.
pub const TRIM: f64 = 3.5;

/// Variance of a standard normal variable that is cut at +-[`TRIM`]: what a trimmed sample shows of the true variance.
const TRIMMED_VARIANCE: f64 = 0.993_89;

/// Median absolute deviation of a standard normal variable.
const NORMAL_MAD: f64 = 0.674_49;

/// The coefficients of `y = x . c` in P unknowns, with what their uncertainty is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinearFit<const P: usize> {
    /// The P coefficients.
    pub coefficients: [f64; P],
    /// Inverse of the normal matrix: the coefficients' covariance for observations of unit variance.
    pub cofactor: [[f64; P]; P],
    /// Sum of the squared residuals of the observations used.
    pub residual_sum: f64,
    /// Observations used.
    pub used: usize,
}

impl<const P: usize> LinearFit<P> {
    /// The value of the model at `row`.
    pub fn predict(&self, row: &[f64; P]) -> f64 {
        (0..P).map(|k| row[k] * self.coefficients[k]).sum()
    }

    /// Estimated variance of one observation, unbiased for white noise.
    pub fn variance(&self) -> f64 {
        self.residual_sum / (self.used.saturating_sub(P).max(1)) as f64
    }

    /// Variance of the prediction at `row` for observations of unit variance.
    pub fn leverage(&self, row: &[f64; P]) -> f64 {
        (0..P)
            .flat_map(|i| (0..P).map(move |j| (i, j)))
            .map(|(i, j)| row[i] * self.cofactor[i][j] * row[j])
            .sum()
    }
}

/// Sums of the normal equations, observation by observation.
#[derive(Debug, Clone, Copy)]
pub struct NormalSums<const P: usize> {
    matrix: [[f64; P]; P],
    right: [f64; P],
    weight: f64,
}

impl<const P: usize> Default for NormalSums<P> {
    fn default() -> Self {
        Self {
            matrix: [[0.0; P]; P],
            right: [0.0; P],
            weight: 0.0,
        }
    }
}

impl<const P: usize> NormalSums<P> {
    /// Takes in one observation of weight `weight`.
    pub fn add(&mut self, row: &[f64; P], value: f64, weight: f64) {
        for i in 0..P {
            let scaled = weight * row[i];
            for (sum, x) in self.matrix[i][..=i].iter_mut().zip(row) {
                *sum += scaled * x;
            }
            self.right[i] += scaled * value;
        }
        self.weight += weight;
    }

    /// Takes in the observations of another sum.
    pub fn merge(&mut self, other: &Self) {
        for i in 0..P {
            for j in 0..=i {
                self.matrix[i][j] += other.matrix[i][j];
            }
            self.right[i] += other.right[i];
        }
        self.weight += other.weight;
    }

    /// The full symmetric normal matrix.
    pub fn matrix(&self) -> [[f64; P]; P] {
        std::array::from_fn(|i| std::array::from_fn(|j| self.matrix[i.max(j)][i.min(j)]))
    }

    /// Coefficients and cofactor matrix, or `None` where the observations do not determine them.
    pub fn solve(&self) -> Option<([f64; P], [[f64; P]; P])> {
        let cofactor = invert_spd(&self.matrix())?;
        let mut coefficients = [0.0; P];
        for i in 0..P {
            coefficients[i] = (0..P).map(|j| cofactor[i][j] * self.right[j]).sum();
        }
        Some((coefficients, cofactor))
    }
}

/// Inverse of a symmetric positive definite matrix, scaled to unit diagonal before it is factored; `None` where it is
/// singular to working precision (relative pivot below 1e-12).
pub fn invert_spd<const P: usize>(matrix: &[[f64; P]; P]) -> Option<[[f64; P]; P]> {
    let mut scale = [0.0; P];
    for (i, s) in scale.iter_mut().enumerate() {
        let diagonal = matrix[i][i];
        if !diagonal.is_finite() || diagonal <= 0.0 {
            return None;
        }
        *s = 1.0 / diagonal.sqrt();
    }
    let scaled = SMatrix::<f64, P, P>::from_fn(|i, j| matrix[i][j] * scale[i] * scale[j]);
    let factor = scaled.cholesky()?;
    let lower = factor.l_dirty();
    if (0..P).any(|i| lower[(i, i)] * lower[(i, i)] < 1e-12) {
        return None;
    }
    let mut inverse = [[0.0; P]; P];
    for j in 0..P {
        let mut unit = SVector::<f64, P>::zeros();
        unit[j] = 1.0;
        factor.solve_mut(&mut unit);
        for i in 0..P {
            inverse[i][j] = unit[i] * scale[i] * scale[j];
        }
    }
    Some(inverse)
}

/// Ordinary least squares over `rows` and `values`; `None` where they do not determine the coefficients.
pub fn fit_linear<const P: usize>(rows: &[[f64; P]], values: &[f64]) -> Option<LinearFit<P>> {
    let all = vec![true; rows.len()];
    fit_chosen(rows, values, &all)
}

/// A fit that outliers do not move, and which observations it used.
#[derive(Debug, Clone, PartialEq)]
pub struct RobustFit<const P: usize> {
    /// Ordinary least squares over the observations kept.
    pub fit: LinearFit<P>,
    /// For every observation, whether it was kept.
    pub kept: Vec<bool>,
    /// Standard deviation of one observation, corrected for the trimming.
    pub sigma: f64,
}

/// Trimmed least squares: least absolute residuals first, then ordinary least squares over the residuals within
/// [`TRIM`] standard deviations, repeated until the choice stands. `None` where fewer than P + 1 observations remain or
/// they do not determine the coefficients.
///
/// `floor` is the least standard deviation that is believed: residuals below it are never outliers.
pub fn fit_robust<const P: usize>(
    rows: &[[f64; P]],
    values: &[f64],
    floor: f64,
) -> Option<RobustFit<P>> {
    let start = least_absolute(rows, values)?;
    let mut residuals: Vec<f64> = residuals_of(rows, values, &start);
    let mut sigma = mad_sigma(&residuals).max(floor);
    let mut kept: Vec<bool> = residuals.iter().map(|e| e.abs() <= TRIM * sigma).collect();
    let mut fit = fit_chosen(rows, values, &kept)?;
    for _ in 0..10 {
        if fit.used <= P {
            return None;
        }
        sigma = (fit.variance() / TRIMMED_VARIANCE).sqrt().max(floor);
        residuals = residuals_of(rows, values, &fit.coefficients);
        let mut changed = false;
        for (keep, e) in kept.iter_mut().zip(&residuals) {
            let inside = e.abs() <= TRIM * sigma;
            changed |= inside != *keep;
            *keep = inside;
        }
        if !changed {
            break;
        }
        fit = fit_chosen(rows, values, &kept)?;
    }
    (fit.used > P).then_some(RobustFit { fit, kept, sigma })
}

fn residuals_of<const P: usize>(
    rows: &[[f64; P]],
    values: &[f64],
    coefficients: &[f64; P],
) -> Vec<f64> {
    rows.iter()
        .zip(values)
        .map(|(row, y)| y - (0..P).map(|k| row[k] * coefficients[k]).sum::<f64>())
        .collect()
}

fn fit_chosen<const P: usize>(
    rows: &[[f64; P]],
    values: &[f64],
    kept: &[bool],
) -> Option<LinearFit<P>> {
    let mut sums = NormalSums::<P>::default();
    let mut used = 0;
    for ((row, y), keep) in rows.iter().zip(values).zip(kept) {
        if *keep {
            sums.add(row, *y, 1.0);
            used += 1;
        }
    }
    let (coefficients, cofactor) = sums.solve()?;
    let mut fit = LinearFit {
        coefficients,
        cofactor,
        residual_sum: 0.0,
        used,
    };
    for ((row, y), keep) in rows.iter().zip(values).zip(kept) {
        if *keep {
            fit.residual_sum += (y - fit.predict(row)).powi(2);
        }
    }
    Some(fit)
}

/// Least sum of absolute residuals, by six reweighted fits: a start that a fifth of outliers does not carry away.
fn least_absolute<const P: usize>(rows: &[[f64; P]], values: &[f64]) -> Option<[f64; P]> {
    let mut coefficients = fit_linear(rows, values)?.coefficients;
    for _ in 0..6 {
        let residuals = residuals_of(rows, values, &coefficients);
        // Residuals well inside the noise count alike, or one exact hit would hold the fit.
        let level = 0.3 * mad_sigma(&residuals);
        if level <= 0.0 {
            break;
        }
        let mut sums = NormalSums::<P>::default();
        for ((row, y), e) in rows.iter().zip(values).zip(&residuals) {
            sums.add(row, *y, 1.0 / e.abs().max(level));
        }
        coefficients = sums.solve()?.0;
    }
    Some(coefficients)
}

/// Standard deviation from the median of the absolute residuals: half of the data may be outliers.
pub fn mad_sigma(residuals: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residuals.iter().map(|e| e.abs()).collect();
    median(&mut sizes) / NORMAL_MAD
}

/// The median, reordering `values`; 0 for none.
pub fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// A plane with how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneFit {
    /// Centre of the points.
    pub centre: DVec3,
    /// Unit normal; of the two the one whose largest component is positive.
    pub normal: DVec3,
    /// Unit directions in the plane, along which the points spread most and least.
    pub axes: [DVec3; 2],
    /// Root mean square of the distances, corrected for the three degrees of freedom.
    pub rms: f64,
    /// Standard uncertainty of the plane's place at its centre.
    pub u_offset: f64,
    /// Standard uncertainty of the tilt along each axis, rad.
    pub u_tilt_rad: [f64; 2],
    /// Points used.
    pub points: usize,
}

/// The plane of least squared distances; `None` for fewer than three points or points on one line.
pub fn fit_plane(points: &[DVec3]) -> Option<PlaneFit> {
    let (centre, values, vectors) = principal_axes(points)?;
    let n = points.len();
    if n < 3 || values[1] <= 1e-12 * values[0] {
        return None;
    }
    let rms = (values[2].max(0.0) / (n - 3).max(1) as f64).sqrt();
    let normal = vectors[2];
    let largest = normal
        .to_array()
        .into_iter()
        .max_by(|a, b| a.abs().total_cmp(&b.abs()))?;
    Some(PlaneFit {
        centre,
        normal: if largest < 0.0 { -normal } else { normal },
        axes: [vectors[0], vectors[1]],
        rms,
        u_offset: rms / (n as f64).sqrt(),
        u_tilt_rad: [rms / values[0].sqrt(), rms / values[1].sqrt()],
        points: n,
    })
}

/// A line with how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineFit {
    /// Centre of the points.
    pub centre: DVec3,
    /// Unit direction.
    pub direction: DVec3,
    /// Root mean square of one component of the distances across the line, corrected for the degrees of freedom.
    pub rms: f64,
    /// Standard uncertainty of the line's place at its centre, each direction across.
    pub u_offset: f64,
    /// Standard uncertainty of the direction, each direction across, rad.
    pub u_direction_rad: f64,
    /// Points used.
    pub points: usize,
}

/// The line of least squared distances; `None` for fewer than two distinct points.
pub fn fit_line(points: &[DVec3]) -> Option<LineFit> {
    let (centre, values, vectors) = principal_axes(points)?;
    let n = points.len();
    if n < 2 || values[0] <= 0.0 {
        return None;
    }
    let rms = ((values[1] + values[2]).max(0.0) / (2 * (n - 2).max(1)) as f64).sqrt();
    Some(LineFit {
        centre,
        direction: vectors[0],
        rms,
        u_offset: rms / (n as f64).sqrt(),
        u_direction_rad: rms / values[0].sqrt(),
        points: n,
    })
}

/// Centre, and the sums of squares along the principal axes with the axes, largest first; `None` for no points.
fn principal_axes(points: &[DVec3]) -> Option<(DVec3, [f64; 3], [DVec3; 3])> {
    if points.is_empty() {
        return None;
    }
    let centre = points.iter().sum::<DVec3>() / points.len() as f64;
    let mut scatter = DMat3::ZERO;
    for p in points {
        let d = *p - centre;
        scatter += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    if !scatter.is_finite() {
        return None;
    }
    let eigen = SymmetricEigen::new(Matrix3::from_column_slice(&scatter.to_cols_array()));
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let axis = |k: usize| {
        let column = eigen.eigenvectors.column(k);
        DVec3::new(column[0], column[1], column[2]).normalize_or_zero()
    };
    Some((
        centre,
        order.map(|k| eigen.eigenvalues[k].max(0.0)),
        order.map(axis),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Deterministic standard normal numbers (SplitMix64 and Box-Muller), for tests only.
    struct Normal(u64);

    impl Normal {
        fn uniform(&mut self) -> f64 {
            self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
        }

        fn next(&mut self) -> f64 {
            let u = 1.0 - self.uniform();
            (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
        }
    }

    #[test]
    fn a_tenth_of_gross_outliers_does_not_move_a_robust_fit() {
        let mut noise = Normal(7);
        let (mut rows, mut values) = (Vec::new(), Vec::new());
        for k in 0..500 {
            let r = k as f64 / 100.0;
            rows.push([1.0, r]);
            let outlier = if k % 10 == 3 { 2.0 } else { 0.0 };
            values.push(0.3 - 0.02 * r + 0.01 * noise.next() + outlier);
        }
        let robust = fit_robust(&rows, &values, 0.0).expect("500 observations of 2 unknowns");
        let u = robust.sigma * robust.fit.cofactor[0][0].sqrt();
        assert!(
            (robust.fit.coefficients[0] - 0.3).abs() < 4.0 * u,
            "4 sigma"
        );
        assert!(
            (robust.sigma - 0.01).abs() < 4.0 * 0.01 / 900f64.sqrt(),
            "a standard deviation from 450 samples is known to 1/sqrt(900)"
        );
        assert!(
            robust.kept.iter().filter(|k| !**k).count() >= 50,
            "50 were put in"
        );
    }

    #[test]
    fn fits_that_the_data_do_not_determine_are_refused() {
        assert!(fit_linear(&[[1.0, 2.0], [1.0, 2.0]], &[0.0, 1.0]).is_none());
        assert!(fit_plane(&[DVec3::ZERO, DVec3::X, 2.0 * DVec3::X]).is_none());
        assert!(fit_line(&[DVec3::ONE, DVec3::ONE]).is_none());
        assert!(fit_plane(&[DVec3::NAN, DVec3::X, DVec3::Y]).is_none());
    }

    #[test]
    fn plane_and_line_uncertainties_are_honest() {
        let mut noise = Normal(11);
        let (mut plane_chi, mut line_chi) = (0.0, 0.0);
        for _ in 0..200 {
            let mut flat = Vec::new();
            let mut thin = Vec::new();
            for _ in 0..60 {
                let (x, y) = (10.0 * noise.uniform(), 4.0 * noise.uniform());
                flat.push(DVec3::new(x, y, 0.01 * noise.next()));
                thin.push(DVec3::new(x, 0.01 * noise.next(), 0.01 * noise.next()));
            }
            let plane = fit_plane(&flat).expect("a plane");
            plane_chi += (plane.centre.dot(DVec3::Z) / plane.u_offset).powi(2);
            plane_chi += (plane.normal.x / plane.u_tilt_rad[0]).powi(2);
            let line = fit_line(&thin).expect("a line");
            line_chi += (line.centre.y / line.u_offset).powi(2);
            line_chi += (line.direction.y / line.u_direction_rad).powi(2);
        }
        // 400 squared normal variables have mean 400 and standard deviation 28; Student's factor adds 4 %.
        assert!((plane_chi - 400.0).abs() < 4.0 * 28.0 + 16.0, "{plane_chi}");
        assert!((line_chi - 400.0).abs() < 4.0 * 28.0 + 16.0, "{line_chi}");
    }
}
